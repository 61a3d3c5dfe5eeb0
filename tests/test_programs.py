"""Programs on disk: found again without tracing, and never those of other arguments, settings or source."""

from __future__ import annotations

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache
from numpy.testing import assert_allclose, assert_array_equal

from mmrjax import effects
from mmrjax.compile import programs
from mmrjax.compile.compiling import for_equations
from mmrjax.effects import UNNAMED
from mmrjax.model import paper_robots
from mmrjax.numerics.elementary import cosine, sine

MATRIX = np.array([[4.0, 1.0], [1.0, 3.0]])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty one in which programs are kept. JAX's own cache, which other tests fill, is not asked."""
    monkeypatch.setenv(programs.VARIABLE, str(tmp_path))
    monkeypatch.setattr(jax, "device_count", lambda: 1)
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    yield tmp_path
    jax.config.update("jax_enable_compilation_cache", True)
    compilation_cache.reset_cache()


def untraceable(function):
    """The function by its name, which fails where it is traced."""

    @functools.wraps(function)
    def fails(*args, **named):
        raise AssertionError("traced")

    return fails


def program(function, *args):
    """The program of a function for arguments like these, as a function of them. None: it has none."""
    found = programs.Programs(function).of((args, {}))
    return found and (lambda *args: found((args, {})))


def named(function, *args):
    return programs._program_name(function, jax.tree.map(programs._leaf_structure, (args, {})))


def test_a_second_process_finds_a_program_without_tracing(folder, compilations):
    answer = program(sine, MATRIX)(MATRIX)
    assert_allclose(answer, np.sin(MATRIX), rtol=1e-12, atol=1e-15)
    made = len(compilations)
    again = program(untraceable(sine), 2 * MATRIX)  # as a new process, with other numbers
    assert_allclose(again(2 * MATRIX), np.sin(2 * MATRIX), rtol=1e-12, atol=1e-15)
    assert_array_equal(again(MATRIX), answer)
    assert len(compilations) == made


def test_a_program_of_this_process_is_not_read_again(folder):
    kept = programs.Programs(sine)
    first = kept.of(((MATRIX,), {}))
    for path in folder.iterdir():
        path.unlink()
    assert kept.of(((3 * MATRIX,), {})) is first


def test_results_come_back_with_what_is_no_array(folder, robot):
    for function in (for_equations, untraceable(for_equations)):
        found = program(function, robot)(robot)
        assert found.configurations.names == robot.configurations.names and found.rig == robot.rig
        assert jax.tree.structure(found) == jax.tree.structure(robot)
        assert_array_equal(found.motor.resistance, robot.motor.resistance)


@pytest.mark.parametrize(
    "other",
    [
        (np.eye(3),),
        (np.eye(2, dtype=np.float32),),
        (np.eye(2, dtype=int),),
        (jnp.asarray(2.0),),
        (2.0,),
        (2,),
        (np.eye(2), np.eye(2)),
        ([np.eye(2)],),
        ("6T2A",),
    ],
)
def test_other_arguments_have_another_program(other):
    assert named(sine, *other) == named(sine, *other) != named(sine, np.eye(2))


def test_whole_numbers_floats_and_truths_are_told_apart(folder):
    assert len({named(sine, x) for x in (1, 1.0, True)}) == 3
    kept = programs.Programs(for_equations)
    found = [kept.of((((x, MATRIX),), {})).result[0] for x in (1, 1.0, True)]
    assert [type(x) for x in found] == [int, float, bool]


def test_another_function_class_or_curve_has_another_program():
    robot, plain = paper_robots.nominal(), np.eye(2)
    assert named(sine, plain) != named(cosine, plain)
    some = [effects.BY_NAME["churning"](), effects.BY_NAME["windage"](), *(curve() for curve in UNNAMED.values())]
    names = {named(sine, dataclasses.replace(robot, effects=(e,))) for e in some}
    assert len(names) == len(some)


def test_the_source_is_hashed_at_the_folder_of_the_packages():
    """A module that moved a folder down hashed no file, and old programs were run after an edit."""
    (root,) = programs.source_hash.__wrapped__.__defaults__
    assert all((root / package / "__init__.py").is_file() for package in programs.OWN)


def test_settings_and_source_are_part_of_a_name(monkeypatch, tmp_path):
    before = named(sine, MATRIX)
    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        assert named(sine, MATRIX) != before
    with monkeypatch.context() as patch:
        patch.setattr(programs, "source_hash", lambda: "other")
        assert named(sine, MATRIX) != before
    assert named(sine, MATRIX) == before
    found = set()
    for package in programs.OWN:
        (tmp_path / package / "room").mkdir(parents=True)
        for content in ("x = 1\n", "x = 2\n"):
            (tmp_path / package / "room/module.py").write_text(content)
            found.add(programs.source_hash.__wrapped__(tmp_path))
    assert len(found) == 2 * len(programs.OWN)


class Own(eqx.Module):
    """Of no package whose source is part of a name."""

    x: jax.Array


@pytest.mark.parametrize("what", [Own(jnp.zeros(2)), jax.random.key(0), untraceable, lambda x: x], ids=type)
def test_what_has_no_name_goes_the_usual_way(what, folder):
    assert program(for_equations, what, MATRIX) is None
    assert not list(folder.iterdir())


def test_tracers_go_the_usual_way(folder):
    kept = programs.Programs(sine)
    jax.eval_shape(lambda x: [x, kept.of(((x,), {}))][0], MATRIX)
    assert not list(folder.iterdir())


def test_an_option_that_this_xla_does_not_have_is_left_out_alone():
    seen = []

    class Lowered:
        def compile(self, options):
            seen.append(options)
            return jax.jit(lambda x: 2 * x).lower(1.0).compile(options)

    options = {"xla_cpu_no_such_option": True, "xla_backend_optimization_level": 1}
    assert programs.compile_with_options(Lowered(), options)(1.5) == 3.0
    assert seen == [{"xla_backend_optimization_level": 1}]


def test_programs_that_call_back_into_python_are_used_and_not_kept(folder):
    seen = []

    @functools.wraps(sine)
    def watched(matrix):
        jax.debug.callback(seen.append, matrix[0, 0])
        return sine(matrix)

    found = program(watched, MATRIX)(MATRIX)
    jax.effects_barrier()
    assert_allclose(found, np.sin(MATRIX), rtol=1e-12, atol=1e-15)
    assert seen == [4.0] and not list(folder.iterdir())


@pytest.mark.parametrize("ending", ["program", "executable"])
def test_broken_files_are_made_again(folder, ending):
    made = program(sine, MATRIX)(MATRIX)
    (broken,) = folder.glob(f"*.{ending}")
    broken.write_bytes(b"nonsense")
    assert_array_equal(made, program(sine, MATRIX)(MATRIX))


def test_nothing_is_kept_unless_a_folder_is_stated(folder, monkeypatch):
    monkeypatch.setenv(programs.VARIABLE, "")
    assert program(sine, MATRIX) is None
    monkeypatch.setenv(programs.VARIABLE, str(folder / "is not there"))
    found = program(sine, MATRIX)  # cannot be written to: the program is used all the same
    assert_allclose(found(MATRIX), np.sin(MATRIX), rtol=1e-12, atol=1e-15)
