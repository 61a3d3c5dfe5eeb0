"""What is installed works without the repository, and says what it is."""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

import mmrjax as mm
from tests.commands import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def test_citation_is_complete_and_of_this_version():
    text = (ROOT / "CITATION.cff").read_text("utf-8")
    known = dict(re.findall(r"^([\w-]+): *(.*)$", text, re.M))
    assert {"cff-version", "title", "message", "abstract", "authors", "date-released", "keywords"} <= set(known)
    assert (known["version"], known["license"]) == (PROJECT["version"], PROJECT["license"])


def test_the_release_has_one_version_one_date_and_a_tag(mmrjax):
    """In the package, the citation, the changelog and the command of CONTRIBUTING."""
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    (date,) = re.findall(r"^date-released: (.*)$", (ROOT / "CITATION.cff").read_text("utf-8"), re.M)
    assert mm.__version__ == PROJECT["version"] and mmrjax("--version")[:2] == (0, f"mmrjax {mm.__version__}\n")
    assert re.findall(r"^## (.*)$", changes, re.M)[0] in (f"{PROJECT['version']} ({date})", "Unreleased")
    assert f"## {PROJECT['version']} ({date})" in changes
    assert f"git tag -a v{PROJECT['version']} " in (ROOT / "CONTRIBUTING.md").read_text("utf-8")


def test_dockerfile_has_the_program_s_python_and_copies_what_it_needs():
    text = (ROOT / "Dockerfile").read_text("utf-8")
    assert f"python:{PROJECT['requires-python'].removeprefix('>=')}" in text and 'ENTRYPOINT ["mmrjax"]' in text
    away = (ROOT / ".dockerignore").read_text("utf-8").split()
    assert not {"mmrjax", "calibration", "sweeps", "pyproject.toml", "requirements.lock", "README.md"} & set(away)


def test_every_pin_installs_on_the_oldest_python_that_is_promised():
    """Also on its first patch release, which distributions ship for years."""
    oldest = f"{PROJECT['requires-python'].removeprefix('>=')}.0"
    pins = re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "requirements.lock").read_text("utf-8"), re.M)
    about = {d.name: d for d in importlib.metadata.distributions()}
    pinned = [about[name] for name, version in pins if name in about and about[name].version == version]
    pythons = {d.name: SpecifierSet(d.metadata.get("Requires-Python", "")) for d in pinned}
    assert pythons and [name for name, needed in pythons.items() if not needed.contains(oldest)] == []


def test_hosted_checks_run_targets_that_there_are_and_name_no_address():
    hosted = [ROOT / ".pre-commit-config.yaml", *(ROOT / ".github").rglob("*.yml")]
    checks = (ROOT / ".github/workflows/checks.yml").read_text("utf-8")
    makefile = (ROOT / "Makefile").read_text("utf-8")
    (tests,) = re.findall(r"tests: \[(.*?)\]", checks)
    targets = {*re.findall(r"run: make (\w+)", checks), *tests.split(", ")}
    assert {"lint", "quick", "docs", "slow", "nightly"} == targets
    assert all(re.search(rf"^{target}:", makefile, re.M) for target in targets)
    (versions,) = re.findall(r"python: \[(.*?)\]", checks)
    assert f'"{PROJECT["requires-python"].removeprefix(">=")}"' == versions.split(", ")[0] and len(hosted) >= 5
    assert not any("://" in path.read_text("utf-8") for path in hosted)


def copied(target):
    """Sources of the distributions, without what is kept next to them."""
    away = shutil.ignore_patterns("__pycache__", "*.egg-info", "build")
    for name in ("mmrjax", "calibration", "sweeps"):
        shutil.copytree(ROOT / name, target / name, ignore=away)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, target)
    return target


@pytest.mark.slow
def test_wheel_and_sdist_install_in_a_clean_environment(tmp_path):
    """With templates, tables, rigs, parts and profiles. Libraries come from this environment, no network is needed."""

    def run(*words, **options):
        done = subprocess.run(words, capture_output=True, text=True, timeout=600, check=False, **options)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    source = copied(tmp_path / "source")
    build = "import setuptools.build_meta as b; b.build_sdist('dist'); b.build_wheel('dist')"
    run(sys.executable, "-c", build, cwd=source)
    (wheel,), (sdist,) = (source / "dist").glob("*.whl"), (source / "dist").glob("*.tar.gz")
    assert (
        wheel.name.startswith(f"mmrjax-{PROJECT['version']}-") and sdist.name == f"mmrjax-{PROJECT['version']}.tar.gz"
    )
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    beside = [folder for folder in given if folder and not (Path(folder) / "mmrjax").is_dir()]
    libraries = os.pathsep.join([*beside, sysconfig.get_path("purelib")])
    for file in (wheel, sdist):
        place = tmp_path / file.suffix.strip(".")
        venv.create(place, symlinks=True)
        python = place / "bin/python"
        pip = (sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", "--quiet")
        isolation = () if file is wheel else ("--no-build-isolation",)
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"PYTHONPATH": libraries}
        run(*pip, *isolation, file, env=environment)
        where = run(python, "-c", "import mmrjax, sweeps; print(sweeps.__file__)", cwd=tmp_path, env=environment)
        assert Path(where.strip()).is_relative_to(place)
        command = place / "bin/mmrjax"
        assert run(command, "--version", cwd=tmp_path, env=environment) == f"mmrjax {PROJECT['version']}\n"
    for words in ("simulate --out a", "compare measured --out b", "rig new r.toml --kind bench", "explain windage"):
        run(command, *words.split(), cwd=tmp_path, env=environment)
    assert "<svg" in (tmp_path / "a/report.html").read_text("utf-8")
