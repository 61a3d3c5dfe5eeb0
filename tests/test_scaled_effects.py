"""Robots with effects of a rig's size are read again as they were written, whatever the effect and the rig."""

import dataclasses
import pickle

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import rigs

import mmrjax as mm
from calibration.data import robot_file
from calibration.data import runs as records
from calibration.discovery import loop_input, scales
from mmrjax import effects
from mmrjax.effects.base import amplitude_of, free_shape_parameter, scaled_effect
from mmrjax.fidelities.steady import results_of_rows
from mmrjax.model import paper_robots, params
from mmrjax.model.quantities import RPM
from sweeps.commands import rig_new
from tests.commands import read_rig, read_table

#: Of rigs: kind and what is imposed; the largest and the smallest that a few draws give.
RIGS = [("bench", "voltage"), ("linear", "motor_speed"), ("wheeled", "voltage")]


def rig(kind, imposed, folder):
    """A rig's robot, its table, and the library at its size."""
    world = rigs.world(np.random.default_rng([27, len(kind)]), kind, imposed, rows=(16, 40))
    rigs.case(world).write(folder)
    robot = robot_file.read_robot(folder / "rig.toml")
    runs = records.read_runs(folder / "table.csv", robot=robot)
    return robot, runs, scales.scale_library(robot, runs.conditions(robot), effects.BY_NAME)


def with_all(robot, library, share):
    """A robot with every effect, each at a share of its limits, its shape at the middle of them."""
    robot = robot_file.add_effects(robot, tuple(library), library)
    values = {}
    for effect in robot.effects:
        amplitude, shape = amplitude_of(effect), free_shape_parameter(effect)
        values[f"effects.{effect.name}.amplitude"] = share * amplitude.spec.bounds[1]
        if shape is not None:
            low, high = shape.spec.bounds
            values[f"effects.{effect.name}.{shape.name}"] = low + 0.5 * (high - low)
    return params.replace(robot, {name: jnp.asarray(x) for name, x in values.items()})


def test_signals_of_the_nominal_robot_in_the_file_are_those_of_its_equations():
    robot, stored = scales._nominal_signals()
    volts, slopes, payloads, configurations = (
        axis.ravel()
        for axis in np.meshgrid(
            paper_robots.VOLTAGES_V, paper_robots.SLOPES_DEG, paper_robots.PAYLOADS_KG, (0, 1), indexing="ij"
        )
    )
    conditions = mm.Conditions(configurations.astype(int), volts, slopes, payloads)
    computed = results_of_rows(robot, conditions, static_at_rest=False)[1]
    for field in dataclasses.fields(stored):
        expected = getattr(computed, field.name)
        if isinstance(expected, jnp.ndarray):
            assert_allclose(getattr(stored, field.name), expected, rtol=1e-9, atol=1e-11, err_msg=field.name)


def test_a_size_is_a_size_however_small():
    """The square of a term that fades with speed may be zero, the term is not: no rig divides by that."""
    assert scales._rms_size([1e-200, 2e-200, 0.0, np.nan]) == pytest.approx(np.sqrt(2.5) * 1e-200, rel=1e-12, abs=0)
    assert np.isnan(scales._rms_size([0.0, np.nan]))


def test_offset_of_an_ammeter_follows_its_range_and_not_a_motor_without_load(tmp_path):
    """A motor of 57 A at standstill draws 0.2 A without load: a meter for it may be off by 0.4 A, but not by 2 A."""
    file = tmp_path / "rig.toml"
    file.write_text(
        'base = "none"\nchannels = ["motor_speed", "motor_current"]\n'
        "[motor]\nresistance = 0.42\ntorque_constant = 0.051\nfriction_coulomb = 0.009\n"
        '[gearbox]\nratio = 1.0\nefficiency_load = 1.0\n[brake]\nload = "shaft"\nloss_coulomb = 0.0\ninertia = 1e-4\n'
    )
    robot = robot_file.read_robot(file)
    size = mm.Conditions(0, voltage=[6.0, 12.0, 24.0])
    library = scales.scale_library(robot, size, effects.BY_NAME | effects.OF_CHANNELS)
    spec = amplitude_of(library["motor_current_offset"]()).spec
    assert 0.4 < spec.bounds[1] < 1.5 and spec.sd * 4 > 0.4


@pytest.mark.slow
def test_a_mass_that_was_weighed_is_off_by_no_more_than_that_of_the_packaged_robot(tmp_path):
    """Of a rig, as a share of its mass: a table of turns had been explained by -18 of its robot's 34 kg."""
    robot, _, library = rig("wheeled", "voltage", tmp_path)
    share, offset = (amplitude_of(library[name]()).spec for name in ("mass_error", "mass_offset"))
    assert share.bounds == (-0.3, 0.3) and share.sd == 0.03
    assert 0.2 < offset.bounds[1] / float(robot.configurations.members[0].mass) < 0.5


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind, imposed", RIGS)
def test_every_effect_of_a_rigs_size_is_read_again_as_it_was_written(tmp_path, kind, imposed):
    robot, _, library = rig(kind, imposed, tmp_path)
    off_library = 0
    for share in (0.01, 1.0):
        whole = with_all(robot, library, share)
        robot_file.write_robot(whole, tmp_path / "robot.toml")
        again = robot_file.read_robot(tmp_path / "robot.toml")
        assert eqx.tree_equal(whole.effects, again.effects)
        specs = [
            {p.name: p.spec for p in params.walk_parameters(r) if p.name.startswith("effects.")}
            for r in (whole, again)
        ]
        assert specs[0] == specs[1]
        assert eqx.tree_equal(pickle.loads(pickle.dumps(again)), again)
        plain = {p.name: p.spec.bounds for name in library for p in params.walk_parameters(effects.BY_NAME[name]())}
        off_library += sum(
            plain[p.name.rpartition(".")[2]] != p.spec.bounds
            for p in params.walk_parameters(again)
            if "effects." in p.name
        )
    assert off_library  # else there would be nothing to state


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind, imposed", RIGS)
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


def test_what_grows_with_the_load_is_judged_at_the_rated_current_of_the_motor(tmp_path):
    """A bench at a fifth of its rated current, 0.3 of that at stall: friction of a size of its own is as before, and a
    saturation leaves something of the torque constant, and a resistance something of the voltage, at that current."""
    robot, runs, library = rig("bench", "voltage", tmp_path)
    used = float(np.nanmax(np.abs(runs["total_current_A"]))) / float(robot.sides)
    volts = float(np.nanmax(np.abs(runs["supply_voltage_V"])))
    rated = 0.3 * volts / float(robot.motor.resistance)
    assert rated > 3 * used

    def most(name):
        return amplitude_of(library[name]()).spec.bounds[1]

    assert 0.2 < most("torque_constant_saturation") * rated**2 < 2
    assert most("torque_constant_saturation") * used**2 < 0.15
    assert most("series_resistance") * rated < 2 * volts
    for name in ("stribeck_motor", "stribeck_track", "brush_drop", "gear_load_loss", "churning"):
        sd, _, limits = library[name].factors
        assert limits == pytest.approx(sd, rel=0.1)
    assert library["torque_constant_saturation"].factors[2] < 0.1 * library["torque_constant_saturation"].factors[0]


@pytest.mark.slow
def test_a_motor_that_states_what_it_bears_is_judged_by_that(tmp_path):
    robot, runs, _ = rig("bench", "voltage", tmp_path)
    limits = []
    for hot in (90.0, 125.0):
        able = dataclasses.replace(robot, motor=dataclasses.replace(robot.motor, temperature_limit=hot))
        path = {"motor.resistance_thermal_winding": 4.0, "motor.resistance_thermal_housing": 400.0}
        able = params.replace(able, {name: jnp.asarray(value) for name, value in path.items()})
        kind = scales.scale_library(able, runs.conditions(able), effects.BY_NAME)["torque_constant_saturation"]
        limits.append(amplitude_of(kind()).spec.bounds[1] * float(able.current_continuous) ** 2)
    assert limits[0] == pytest.approx(limits[1], rel=1e-6)


def test_one_class_for_the_same_factors():
    kind = effects.BY_NAME["churning"]
    assert (
        scaled_effect(kind, (2.0, 1.0, 2.0))
        is scaled_effect(kind, (2.0, 1.0, 2.0))
        is not scaled_effect(kind, (3.0, 1.0, 3.0))
    )


@pytest.mark.slow
def test_friction_along_the_travel_is_sized_by_the_travel_and_looked_for_where_a_channel_shows_it(tmp_path):
    robot = servo(tmp_path)
    rows = ["0.4,0,0", "0.7,1.5,360", "1,3.0,720", "-0.9,4.0,-720"]
    runs = read_table(
        tmp_path, "supply_voltage_V,duty,time_s,output_angle_deg\n" + "\n".join(f"6,{r}" for r in rows) + "\n", robot
    )
    turned = scales.output_rotation(runs, robot)
    assert turned == pytest.approx(2 * np.pi * np.sqrt((1 + 4 + 4) / 3))
    kinds = [
        scales.scale_library(robot, runs.conditions(robot), effects.BY_NAME, x)["position_friction"]
        for x in (turned, 2 * turned)
    ]
    one, two = (amplitude_of(kind()).spec for kind in kinds)
    assert two.sd == pytest.approx(0.5 * one.sd) and two.bounds[1] == pytest.approx(0.5 * one.bounds[1])
    # At its sd it is as large over the travel as a torque of the same share.
    offset = scales.scale_library(robot, runs.conditions(robot), effects.BY_NAME, turned)["presliding"]
    assert one.sd * turned == pytest.approx(amplitude_of(offset()).spec.sd, rel=0.2)
    blind = dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, channels=("output_speed",)))
    assert not scales.effect_applies(effects.BY_NAME["position_friction"], blind)
    assert scales.effect_applies(effects.BY_NAME["angle_friction"], blind)


def servo(folder):
    """The robot of the template of a servo."""
    return read_rig(folder, rig_new.rig_template("servo"))


METERED = """
base = "none"
channels = ["total_current", "motor_speed", "output_torque"]
[motor]
resistance = "2.0 ± 1 %"
torque_constant = "0.025 ± 0.3 %"
friction_coulomb = "0.0015 ± 2 %"
[gearbox]
ratio = 20
efficiency_load = "0.75 ± 0.5 %"
[bench]
load = "shaft"
inertia = 0.002
loss_coulomb = "0.05 ± 1 %"
loss_viscous = "0.001 ± 1 %"
"""


def metered(tmp_path, off):
    """A bench whose torque meter reads so much high, and its table."""
    robot = read_rig(tmp_path, METERED)
    volts = np.repeat(np.linspace(3.0, 24.0, 10), 2)
    seen = mm.simulate(robot, mm.Conditions(voltage=volts))
    noise = 1 + 0.003 * np.random.default_rng(1).standard_normal((3, len(volts)))
    read = noise * [
        seen.total_current,
        np.asarray(seen.motor_speed) / RPM,
        np.asarray(seen.output_torque) * (1 + off),
    ]
    columns = ("total_current_A", "motor_speed_rpm", "output_torque_Nm")
    heads = [name for c in columns for name in (c, f"{c.rpartition('_')[0]}_sd_{c.rpartition('_')[2]}")]
    rows = [[v, *(y for x in xs for y in (x, 0.003 * x))] for v, xs in zip(volts, read.T, strict=True)]
    lines = [",".join(("supply_voltage_V", *heads)), *(",".join(f"{x:.6g}" for x in row) for row in rows)]
    return read_table(tmp_path, "\n".join(lines) + "\n", robot, "runs.csv"), robot


def test_the_loop_looks_for_an_error_of_every_instrument(tmp_path):
    runs, robot = metered(tmp_path, 0.0)
    scored = [e for e in loop_input.prepare_loop(runs, robot).library.values() if e.balance == "sensor"]
    assert {e.channel for e in scored} == set(robot.rig.channels)
    (torque,) = (e for e in scored if e.name == "output_torque_offset")
    size = np.sqrt(np.mean(runs["output_torque_Nm"] ** 2))
    assert amplitude_of(torque()).spec.bounds == pytest.approx(np.array([-1, 1]) * scales.MOST_OFF * size, rel=0.01)


@pytest.mark.nightly
@pytest.mark.parametrize("signed", [True, False])
def test_a_current_sensors_offset_is_named(tmp_path, signed):
    """Of a bench driven both ways. Where the sensor shows magnitudes a friction may look alike."""
    shown = f"[instruments.motor_current]\nsigned = {str(signed).lower()}\n"
    robot = read_rig(tmp_path, METERED.replace(', "output_torque"', ', "motor_current"') + shown)
    off = effects.OF_CHANNELS["motor_current_offset"](amplitude=0.02)
    volts = np.linspace(4.0, 24.0, 8)[:, None] * [1.0, -1.0]
    seen = mm.simulate(dataclasses.replace(robot, effects=(off,)), mm.Conditions(voltage=volts.ravel()))
    read = np.stack([seen.total_current, np.asarray(seen.motor_speed) / RPM, seen.motor_current])
    sd = 0.003 * np.abs(read).mean(1, keepdims=True)
    read += sd * np.random.default_rng(1).standard_normal(read.shape)
    heads = "supply_voltage_V,total_current_A,motor_speed_rpm,motor_current_A,"
    heads += "total_current_sd_A,motor_speed_sd_rpm,motor_current_sd_A"
    rows = np.column_stack([volts.ravel(), read.T, np.broadcast_to(sd.T, read.T.shape)])
    np.savetxt(tmp_path / "runs.csv", rows, "%.6g", ",", header=heads, comments="")
    found = mm.discover(records.read_runs(tmp_path / "runs.csv", robot=robot), robot)
    assert found.verdict in ("named", "class") and [e.name for e in found.effects] == [off.name]
    assert found.effects[0].parameters["amplitude"].value == pytest.approx(0.02, abs=0.005)
