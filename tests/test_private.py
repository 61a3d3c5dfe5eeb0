"""Programs that were compiled are read from folders that nobody else can change, and from no others."""

import os
from pathlib import Path

import jax
import pytest

from mmrjax.compile import programs
from mmrjax.compile.programs import exposure_reason
from sweeps import compilation_cache


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A folder for caches, which the environment names."""
    monkeypatch.setenv("MMRJAX_CACHE", str(tmp_path / "caches"))
    monkeypatch.setenv("MMRJAX_PROGRAMS", "")
    return compilation_cache.cache_location()


def test_a_folder_of_the_users_alone_is_private(cache):
    assert exposure_reason(cache) == ""  # and one that does not exist yet
    cache.mkdir(parents=True, mode=0o700)
    (cache / "program").write_text("")
    assert exposure_reason(cache) == ""


def others_write(cache):
    cache.chmod(0o777)
    return f"others may write to {cache}"


def others_write_above(cache):
    cache.parent.chmod(0o757)
    return f"others may write to {cache.parent}"


def through_a_link(cache):
    others_write(cache)
    link = cache.parent.parent / "link"
    cache.rename(link.with_name("elsewhere"))
    cache.symlink_to(link.with_name("elsewhere"))
    return f"others may write to {cache}"


def of_another_user(cache):
    mine = os.geteuid()
    os.geteuid = lambda: mine + 1
    return f"{cache} belongs to another user"


@pytest.mark.parametrize("change", [others_write, others_write_above, through_a_link, of_another_user])
def test_a_folder_that_others_could_change_is_not_used_and_that_is_said(cache, capsys, change):
    cache.mkdir(parents=True, mode=0o700)
    mine, kept = os.geteuid, jax.config.values["jax_compilation_cache_dir"]
    try:
        reason = change(cache)
        assert exposure_reason(cache) == reason
        jax.config.update("jax_compilation_cache_dir", None)  # as in a process that begins
        assert compilation_cache.keep_programs() is None
        assert f"compiled programs are not cached: {reason}" in capsys.readouterr().err.replace("\n", " ")
        assert not programs._folder_is_private(str(cache))
        assert compilation_cache.describe_cache() == f"{cache}: not used, since {reason}"
    finally:
        os.geteuid = mine
        jax.config.update("jax_compilation_cache_dir", kept)
        programs._folder_is_private.cache_clear()


def test_a_sticky_folder_above_is_no_danger(cache):
    cache.mkdir(parents=True, mode=0o700)
    cache.parent.chmod(0o1777)
    assert exposure_reason(cache) == ""


def test_a_file_of_another_user_in_a_private_folder_is_not_read(cache, monkeypatch):
    cache.mkdir(parents=True, mode=0o700)
    (cache / "planted").write_text("")
    honest = Path.lstat

    def theirs(path):
        found = list(honest(path))
        found[4] += path.name == "planted"
        return os.stat_result(found)

    monkeypatch.setattr(Path, "lstat", theirs)
    assert exposure_reason(cache) == f"{cache / 'planted'} belongs to another user"


def test_a_program_of_an_exposed_folder_is_neither_read_nor_written(tmp_path, monkeypatch):
    monkeypatch.setenv(programs.VARIABLE, str(tmp_path))
    Path(tmp_path).chmod(0o777)
    asked = []
    monkeypatch.setattr(programs.Programs, "_loaded_or_lowered", lambda *a: lambda: asked.append(a))
    assert programs.Programs(exposure_reason).of(((1.0,), {})) is None and not asked
    Path(tmp_path).chmod(0o700)
    programs._folder_is_private.cache_clear()
    programs.Programs(exposure_reason).of(((1.0,), {}))
    assert asked
    programs._folder_is_private.cache_clear()
