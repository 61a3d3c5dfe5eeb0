"""Robots with effects of a rig's size are read again as they were written, whatever the effect and the rig."""

from __future__ import annotations

import pickle

import equinox as eqx
import generator_rigs as gr
import jax.numpy as jnp
import numpy as np
import pytest

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.data.errors import BadConfiguration
from calibration.discovery import scales
from mmrjax import effects, params
from mmrjax.effects.scaled import amplitude_of, scaled, shape_of

#: Of rigs: kind and what is imposed; the largest and the smallest that a few draws give.
RIGS = [("bench", "voltage"), ("linear", "motor_speed"), ("wheeled", "voltage")]


def rig(kind, imposed, folder):
    """A rig's robot, its table, and the library at its size."""
    world = gr.world(np.random.default_rng([27, len(kind)]), kind, imposed, rows=(16, 40))
    gr.case(world).write(folder)
    robot = robot_file.read(folder / "rig.toml")
    runs = records.read(folder / "table.csv", robot=robot)
    return robot, runs, scales.library_for(robot, runs.conditions(robot), effects.BY_NAME)


def with_all(robot, library, share):
    """A robot with every effect, each at a share of its limits, its shape at the middle of them."""
    robot = robot_file.with_effects(robot, tuple(library), library)
    values = {}
    for effect in robot.effects:
        amplitude, shape = amplitude_of(effect), shape_of(effect)
        values[f"effects.{effect.name}.amplitude"] = share * amplitude.spec.bounds[1]
        if shape is not None:
            low, high = shape.spec.bounds
            values[f"effects.{effect.name}.{shape.name}"] = low + 0.5 * (high - low)
    return params.replace(robot, {name: jnp.asarray(x) for name, x in values.items()})


@pytest.mark.parametrize(("kind", "imposed"), RIGS)
def test_every_effect_of_a_rigs_size_is_read_again_as_it_was_written(tmp_path, kind, imposed):
    robot, _, library = rig(kind, imposed, tmp_path)
    off_library = 0
    for share in (0.01, 1.0):
        whole = with_all(robot, library, share)
        robot_file.write(whole, tmp_path / "robot.toml")
        again = robot_file.read(tmp_path / "robot.toml")
        assert eqx.tree_equal(whole.effects, again.effects)
        specs = [{p.name: p.spec for p in params.walk(r) if p.name.startswith("effects.")} for r in (whole, again)]
        assert specs[0] == specs[1]
        assert eqx.tree_equal(pickle.loads(pickle.dumps(again)), again)
        plain = {p.name: p.spec.bounds for name in library for p in params.walk(effects.BY_NAME[name]())}
        off_library += sum(
            plain[p.name.rpartition(".")[2]] != p.spec.bounds for p in params.walk(again) if "effects." in p.name
        )
    assert off_library  # else there would be nothing to state


def test_a_robot_with_effects_of_its_size_is_compared_and_swept(tmp_path, mmrjax):
    robot, _, library = rig("bench", "voltage", tmp_path)
    some = {name: library[name] for name in list(library)[:4]}
    robot_file.write(with_all(robot, some, 0.01), tmp_path / "robot.toml")
    options = ("--robot", tmp_path / "robot.toml", "--no-report")
    for command in (("compare", tmp_path / "table.csv"), ("sweep", "--voltages", 12)):
        code, _, err = mmrjax(*command, *options, "--out", tmp_path / command[0])
        assert code == 0, err
    assert eqx.tree_equal(
        robot_file.read(tmp_path / "compare" / "robot.toml").effects, robot_file.read(tmp_path / "robot.toml").effects
    )


@pytest.mark.parametrize(("kind", "imposed"), RIGS)
def test_an_instrument_is_off_by_no_more_than_a_share_of_what_it_shows(tmp_path, kind, imposed):
    robot, runs, library = rig(kind, imposed, tmp_path)
    size = dict(zip(runs.layout.measured_columns, np.sqrt(np.nanmean(runs.measured() ** 2, 0)), strict=True))
    offsets = [e for e in library.values() if e.balance == "sensor" and e.name.endswith("offset")]
    for effect in offsets:
        shown = size[next(c.column for c in robot.channels if c.name == effect.channel)]
        assert max(map(abs, amplitude_of(effect()).spec.bounds)) < 1.5 * scales.MOST_OFF * shown
    gains = [e for e in library.values() if e.balance == "sensor" and amplitude_of(e()).spec.unit == "-"]
    assert (gains or offsets) and all(
        max(map(abs, amplitude_of(e()).spec.bounds)) <= 1.001 * scales.MOST_OFF for e in gains
    )


def test_one_class_for_the_same_factors():
    kind = effects.BY_NAME["churning"]
    assert scaled(kind, (2.0, 1.0, 2.0)) is scaled(kind, (2.0, 1.0, 2.0)) is not scaled(kind, (3.0, 1.0, 3.0))


@pytest.mark.parametrize("stated", ["3", "[1, 2]", "[1, 2, 0]", '[1, 2, "x"]'])
def test_factors_are_three_positive_numbers(tmp_path, stated):
    (tmp_path / "robot.toml").write_text(f"[effects.churning]\nscaled = {stated}\namplitude = 0.0\n")
    with pytest.raises(
        BadConfiguration, match=r"effects\.churning\.scaled: got .* expected three numbers more than 0"
    ):
        robot_file.read(tmp_path / "robot.toml")
