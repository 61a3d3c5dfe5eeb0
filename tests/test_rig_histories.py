"""Histories of rigs: an imposed speed with a delay, and beginnings that are measured or free, given back."""

import contextlib
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import robot_file
from calibration.inference import noise, observers, priors
from calibration.inference.calibration import calibrate
from calibration.inference.linearization import balance_probe
from calibration.inference.observers import run_grids
from calibration.inference.observers.time_histories import Histories
from mmrjax.effects import UNNAMED
from mmrjax.fidelities import histories as integrator
from mmrjax.model import balances, channels, params, quantities
from mmrjax.model.conditions import Conditions
from mmrjax.model.rig import Rig, RunStart, RunStarts
from mmrjax.model.signals import State
from tests.commands import csv_text, ends, read_rig, read_table, refused, rows, with_columns

DRIVE = """
schema = "mmrjax.robot/2"
base = "none"
imposed = "{imposed}"
channels = [{channels}]
start = "{start}"
{top}
[motor]
resistance = 3.0
torque_constant = 0.05
inertia = 2e-6
friction_coulomb = 2e-3
{motor}
[gearbox]
ratio = 16
efficiency_load = 0.8
"""
BENCH = """
[rig]
{rig}
[bench]
load = "shaft"
inertia = {inertia}
loss_coulomb = "0.2 ± 50 %"
loss_viscous = 0.01
"""
ARM = """
[arm]
load = "shaft"
inertia = 0.01
loss_coulomb = "0.05 ± 50 %"
loss_viscous = 0.01
torque_gravity = "0.6 ± 20 %"
"""
USUAL = {
    "imposed": "voltage", "start": "rest", "rig": 'delay = "0 ± 0.05"', "inertia": 0.02, "top": "", "motor": "",
}  # fmt: skip
OPTIONS = {"model": "drive", "starts": 4, "blocks": False, "profiles": False}


def drive(folder, *shown, load=BENCH, **changed):
    """A drive that shows these channels, with its load, read from its file."""
    channels = ", ".join(f'"{name}"' for name in shown)
    return read_rig(folder, (DRIVE + load).format(channels=channels, **USUAL | changed))


def written(tmp_path, robot, columns, sd, readings=0.0):
    """A table of readings with their sds [the columns' units]."""
    rows = len(columns["time_s"])
    readings = np.broadcast_to(readings, (rows, len(sd)))
    for k, channel in enumerate(robot.channels):
        columns = columns | {channel.column: readings[:, k], channel.sd_column: np.full(rows, sd[k])}
    return read_table(tmp_path, csv_text(columns), robot, "table.csv")


def history(tmp_path, robot, truth, columns, sd, seed):
    """A table whose readings are those of `truth` with noise of the sds [the columns' units]."""
    blank = written(tmp_path, robot, columns, sd)
    shown = np.asarray(eqx.filter_jit(observers.observer_kind(blank).of(blank, truth))(truth).reading)
    factor = np.array([c.factor for c in robot.channels])
    noise = np.array(sd) * np.random.default_rng(seed).standard_normal(shown.shape)
    return written(tmp_path, robot, columns, sd, shown / factor + noise)


def test_the_speed_at_which_a_run_begins_moves_with_the_robot(tmp_path):
    """Where a speed is imposed a run begins at it, and what moves with the shafts at what the robot makes of it."""
    cart = '[cart]\nload = "linear"\nmass_kg = 3.0\nlead_mm = 5.0\n'
    robot, times = drive(tmp_path, "speed", load=cart, imposed="motor_speed"), jnp.array([0.0, 0.1, 0.2])
    given = Conditions(motor_speed=100.0, motor_acceleration=0.0)
    names = ("cart.radius", "gearbox.ratio")
    values = {p.name: float(p.value) for p in params.walk_parameters(robot) if p.name in names}

    @jax.jit
    def slopes(shares):
        def speed(shares):
            changed = {name: values[name] * share for name, share in zip(names, shares, strict=True)}
            found = integrator.history_signals(params.replace(robot, changed), given, times).speed
            return found, found

        return jax.jacfwd(speed, has_aux=True)(shares)

    slope, speed = slopes(jnp.ones(2))
    assert_allclose(speed, 100.0 / 16 * 0.005 / (2 * np.pi), rtol=1e-9)
    assert_allclose(slope, speed[:, None] * np.array([1.0, -1.0]), rtol=1e-9)  # v = r ω / i


@pytest.mark.parametrize("duty", [False, True])
@pytest.mark.parametrize(
    "load, shown, stated, said",
    [
        (BENCH, "motor_current", "", "motor_current_A: got 1 A"),
        (BENCH, "motor_speed", "", "motor_speed_rpm: got 1 rpm"),
        (BENCH, "motor_speed", "[instruments.motor_speed]\nsigned = false\n", ""),
        (BENCH, "motor_current", "[instruments.motor_current]\nsigned = false\n", ""),
        (ARM, "motor_current", "", ""),  # its weight may drive the motor
        (BENCH, "total_current", "", "total_current_A: got 1 A"),
    ],
)
def test_readings_without_a_sign_are_refused_unless_the_file_says_so(tmp_path, load, shown, stated, said, duty):
    """Of a log that goes both ways: a speed, and a current that nothing but the voltage drives."""
    robot, t = drive(tmp_path, shown, load=stated + load), np.arange(0, 2, 0.02)
    way = np.where(t < 1, 1.0, -1.0)
    driven = {"supply_voltage_V": 12.0, "duty": way / 2} if duty else {"supply_voltage_V": 6 * way}
    columns = {"time_s": t, **driven, channels.find_channel(shown).column: np.abs(way)}
    text = csv_text(dict(zip(columns, np.broadcast_arrays(*columns.values()), strict=True)))
    runs = read_table(tmp_path, text, robot)
    nothing = noise.Noise(*(None for _ in dataclasses.fields(noise.Noise)))
    cure = rf"expected negative readings in reverse; or set \[instruments.{shown}\] signed = false"
    bridge = duty and shown == "total_current"  # which turns the supply's current back
    with refused(rf"{said} at -6 V; {cure}") if said and not bridge else contextlib.nullcontext():
        assert Histories.check(runs, nothing) == []


@pytest.mark.slow
def test_the_beginning_of_an_arm_in_motion_is_found(tmp_path):
    robot = drive(tmp_path, "total_current", "motor_speed", "output_angle", load=ARM, start="free")
    begins = RunStarts(
        {"begin_a": RunStart(motor_speed=30.0, angle=0.3), "begin_b": RunStart(motor_speed=-20.0, angle=0.1)}
    )
    truth = params.replace(robot, {"arm.torque_gravity": 0.66, "arm.loss_coulomb": 0.08})
    truth = dataclasses.replace(truth, rig=dataclasses.replace(truth.rig, begins=begins))
    t = np.arange(0, 3, 0.03)
    voltage = 2.5 * np.sin(1.5 * t) + 0.5
    columns = {
        "run_id": np.repeat(["a", "b"], len(t)),
        "time_s": np.tile(t, 2),
        "supply_voltage_V": np.concatenate([voltage, -voltage]),
    }
    runs = history(tmp_path, robot, truth, columns, [0.01, 20.0, 0.6], 2)
    found = calibrate(runs, robot, **OPTIONS)
    expected = {
        "arm.torque_gravity": 0.66, "arm.loss_coulomb": 0.08, "rig.begin_a.motor_speed": 30.0,
        "rig.begin_a.angle": 0.3, "rig.begin_b.motor_speed": -20.0, "rig.begin_b.angle": 0.1,
    }  # fmt: skip
    for name, value in expected.items():
        estimate = found.parameters[name]
        assert abs(estimate.value - value) < 4 * estimate.sd, name
    assert found.parameters["arm.torque_gravity"].sd < 0.01


def test_beginnings_are_measured_by_the_first_samples(tmp_path):
    """A line through five samples, whatever channel shows the speed. Only free ones are free."""
    lines = ["time_s,supply_voltage_V,output_speed_rpm,output_angle_deg"]
    lines += [f"{t},6,{60 + 100 * t},{30 + 360 * t + 300 * t**2}" for t in np.arange(0, 0.2, 0.01)]
    for start in ("measured", "free"):
        robot = drive(tmp_path, "output_speed", "output_angle", load=ARM, start=start)
        runs = read_table(tmp_path, "\n".join(lines), robot)
        kind = observers.observer_kind(runs)
        known = noise.noise_from_table(runs, kind.sizes(runs), "output_speed=1rpm,output_angle=1deg")
        begun = run_grids.measure_initial_states(robot, runs, known)
        assert begun.rig.begins.names == ("begin_",)
        begin = begun.rig.begins.members[0]
        assert begin.motor_speed == pytest.approx(60 * quantities.RPM * 16, rel=1e-9)
        assert begin.angle == pytest.approx(np.radians(30), abs=0.002)
        assert bool(priors.initial_state_names(begun)) == (start == "free")


def test_a_robot_at_rest_has_no_beginnings(tmp_path):
    robot = drive(tmp_path, "motor_speed", load=ARM)
    assert robot.rig.begins is None and jnp.asarray(robot.rig.delay) == 0


def test_what_is_imposed_acts_later_by_the_delay():
    rig = Rig(delay=0.2)
    times, values = jnp.asarray([0.0, 1.0, 2.0]), jnp.asarray([3.0, 5.0, 4.0])
    at, of_run = jnp.asarray([-1.0, 0.1, 0.7, 1.2, 1.7, 9.0]), jnp.asarray([-0.5, 0.0, 0.3])
    shown, clock = jax.jit(lambda: (rig.between(values, *rig.before(times, at)), rig.clock(of_run)))()
    assert shown.tolist() == pytest.approx([3.0, 3.0, 4.0, 5.0, 4.5, 4.0])
    assert clock.tolist() == pytest.approx([-0.5, 0.0, 0.5])


def test_a_delay_reads_the_run_of_each_row_and_takes_memory_by_rows():
    """Two runs, the rows in no order. A run of 3000 rows takes less than each row's own copy of the run."""
    times = np.array([[0.0, 0.5, 1.0], [0.0, 0.25, 0.5]])
    every = np.stack([10 * times, -times], -1)
    order = [1, 0, 1, 0, 0], [2, 1, 1, 2, 0], [[4, 1, 3], [2, 0, -1]]
    run, instant, rows_of = (jnp.asarray(x) for x in order)
    steps = every[:, :-1], every[:, :-1], every[:, 1:], np.zeros((2, 2))  # on straight lines
    made = Histories(Conditions(0, 1.0), jnp.asarray(times), run, instant, rows_of, rows_of)
    seen = jax.jit(lambda x: made.delayed_values(x, Rig(delay=0.1)))(steps)
    at = np.maximum(times[run, instant] - 0.1, 0.0)
    assert_allclose(seen, np.stack([10 * at, -at], -1), rtol=1e-12)

    count = 3000
    along, of_first = jnp.asarray(np.arange(count)), jnp.asarray(np.arange(count)[None])
    long = Histories(
        Conditions(0, 1.0), np.linspace(0, 1, count)[None], np.zeros(count, int), along, of_first, of_first
    )
    late = jax.jit(lambda x: long.delayed_values((x[:, :-1], x[:, :-1], x[:, 1:], x[:, 1:, 0]), Rig(delay=0.1)))
    program = late.lower(np.zeros((1, count, 2))).compile()
    assert program.memory_analysis().temp_size_in_bytes < 8 * 100 * count


def imposed_speed(tmp_path, runs, filled=written):
    """A rig whose motor's speed is imposed over time, and the table of so many runs of it, whatever it reads."""
    robot = drive(tmp_path, "total_current", imposed="motor_speed", start="measured", rig="delay = 0.0")
    t = np.tile(np.arange(0, 1, 0.05), runs)
    run = np.repeat(np.arange(runs), 20)
    speed = (200 * np.sin(6 * t + run) + 50 * np.sin(14 * t)) / quantities.RPM
    columns = {"time_s": t, "run_id": run, "motor_speed_rpm": speed}
    return robot, filled(tmp_path, robot, columns, [0.01])


@pytest.mark.slow
def test_a_defect_moves_the_current_of_an_imposed_speed_at_once(tmp_path):
    """The sum over all knots against the derivative by a constant defect."""
    robot, runs = imposed_speed(tmp_path, 1)
    observer, effect = observers.observer_kind(runs).of(runs, robot), balance_probe("track")

    def readings(amplitude):
        return observer(
            dataclasses.replace(robot, effects=(dataclasses.replace(effect, amplitude=amplitude),))
        ).reading

    expected = np.asarray(jax.jit(jax.jacfwd(readings))(jnp.asarray(0.0)))[:, 0]
    found = np.asarray(jax.jit(lambda r: observer.changes(r, (effect,), ())[0])(robot))[0, 0]
    assert_allclose(found.sum(0)[:, 0], expected, rtol=1e-7)
    assert_allclose(np.diag(found[:, :, 0]), expected, rtol=1e-7)  # of the knot at each sample alone
    assert (np.abs(expected) > 0.9).all()  # 1 / (16 × 0.05 N·m/A), over or by an efficiency of 0.8


def test_curves_of_a_drive_that_reverses_count_along_its_travel(tmp_path):
    """Its mirror image shows the mirror image of a curve, where it is looked for as where it is in a robot."""
    robot, runs = imposed_speed(tmp_path, 2)
    speed = np.repeat(np.linspace(-400, 400, 20)[None], 2, 0)
    speed[1] = -speed[0]
    runs = with_columns(runs, motor_speed_rpm=speed.ravel() / quantities.RPM)
    observer = observers.observer_kind(runs).of(runs, robot)
    columns = {**runs.columns, "total_current_A": np.sign(speed.ravel()) + speed.ravel() / 100}
    bases = observer.bases(columns, np.ones(len(runs), bool), robot)
    seen = 0
    for basis in bases:
        for (place, variable), columns_of in zip(basis.names, np.asarray(basis.columns), strict=True):
            assert "belt" not in variable  # a shaft runs on no tracks
            if variable in ("speed_motor", "current"):
                both = columns_of.reshape(2, 20, -1)
                assert_allclose(both[0], -both[1], atol=1e-9)
                assert np.abs(both[0][:, 0]).min() > 0.9, (place, variable)  # a loss as large at any speed
                seen += 1
    assert seen >= 2
    curve = UNNAMED["curve_track_speed_motor"](amplitude=1.0, y1=2.0, y3=-1.0)
    term = jax.jit(
        lambda speed: curve.term(robot, balances.begin_signals(robot, Conditions(0), State(0.0, speed, 0.0, 0.0)))
    )
    ahead, back = (float(term(way * 300.0)) for way in (1, -1))
    assert ahead == pytest.approx(-back) and abs(ahead) > 0.1


def test_every_row_of_an_imposed_speed_has_the_acceleration_of_the_motion_there(tmp_path):
    """That of the parabola through three rows. A run of one row has none."""
    robot, _ = imposed_speed(tmp_path, 1)
    ramps = {"a": [100.0, 120.0, 160.0, 160.0, 150.0], "b": [0.0, -30.0, -60.0], "c": [7.0]}
    columns = {
        "time_s": np.concatenate([0.1 * np.arange(len(w)) for w in ramps.values()]),
        "run_id": np.repeat(list(ramps), [len(w) for w in ramps.values()]),
        "motor_speed_rpm": np.concatenate(list(ramps.values())) / quantities.RPM,
    }
    rows = Histories.of(written(tmp_path, robot, columns, [0.01]), robot).of_rows
    expected = [100.0, 300.0, 200.0, -50.0, -150.0, -300.0, -300.0, -300.0, 0.0]
    assert_allclose(rows.motor_acceleration, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_histories_are_compared_with_a_robot(tmp_path, mmrjax):
    imposed_speed(tmp_path, 2, lambda path, robot, *told: history(path, robot, robot, *told, 3))
    ends(mmrjax("compare table.csv --robot rig.toml --no-report --out found"), code=0)
    table = rows(tmp_path / "found/comparison.csv")
    error = [float(r["simulated_total_current_A"]) - float(r["total_current_A"]) for r in table]
    assert len(table) == 40 and np.std(error) == pytest.approx(0.01, rel=0.4) and table[20]["run_id"] == "1"
    assert table[21]["time_s"] == "0.05"


@pytest.mark.parametrize(
    "stated, free",
    [("", True), ("delay = 0.0", True), (USUAL["rig"], True), ("delay = 0.03", True), ('delay = "0 ± 0"', False)],
)
def test_the_loop_looks_for_a_delay_that_no_file_rules_out(tmp_path, stated, free):
    robot = drive(tmp_path, "motor_speed", rig=stated)
    names = priors.loop_parameter_names(robot, ("bench",), *observers.Histories.free())
    assert ("rig.delay" in names) == free and "motor.inertia" in names
    of_settled = priors.loop_parameter_names(robot, ("bench",), *observers.KINDS[1].free())
    assert "rig.delay" not in of_settled


@pytest.mark.parametrize("faster, step", [(1, 0.01), (5, 0.005)])
def test_a_log_of_an_imposed_speed_soon_has_even_steps(tmp_path, faster, step):
    """Two a sample, 10 ms at most: readings follow at once from the speed, but what effects remember."""
    robot, runs = imposed_speed(tmp_path, 2)  # at 20 Hz
    runs = with_columns(runs, time_s=runs["time_s"] / faster)
    times = np.asarray(Histories.of(runs, robot).times)
    steps = np.diff(times, axis=1)
    late = (steps > 0) & (times[:, :-1] > 4.5 * step)
    assert_allclose(steps[late], step, rtol=1e-9)
    assert np.sum(steps > 0) - np.sum(late) < 2 * 50


@pytest.mark.parametrize("imposed", ["voltage", "motor_current"])
def test_steps_are_short_where_a_drive_passes_through_rest(tmp_path, imposed):
    """Of a current from a higher speed on and earlier. By the rates of an angle where no speed is shown, all along where
    neither is. Without a backlash the moment of rest is found within a step, which may be as long as elsewhere."""
    robot, stiff = (
        drive(tmp_path, "motor_speed", "output_angle", load=BENCH + more, imposed=imposed, rig="delay = 0.02")
        for more in ("backlash = 0.01\n", "")
    )
    t, column = np.arange(0, 2, 0.02), {"voltage": "supply_voltage_V", "motor_current": "motor_current_A"}[imposed]
    speed = 2000 * np.clip((1.5 - t) / 0.3, -1, 1) * np.minimum(t / 0.2, 1)  # through rest at 1.5 s
    angle = np.cumsum(speed) * 0.02 * 6
    shown = {"motor_speed_rpm": speed, "output_angle_deg": angle}
    runs = read_table(tmp_path, csv_text({"time_s": t, column: np.where(t < 1.2, 8, -8), **shown}), robot)

    def longest(runs, begin, end, robot=robot):
        times = np.asarray(Histories.of(runs, robot).times)[0]
        inside = (times[:-1] >= begin - 1e-9) & (times[1:] <= end + 1e-9)
        return np.diff(times)[inside].max().round(9)

    fine, usual = 0.02 / 16, 0.005
    # from 0.07 s before a tenth of the largest speed on; of a current from 0.1 s before three tenths
    begin, end = {"voltage": (1.4, 1.54), "motor_current": (1.32, 1.6)}[imposed]
    none = np.full(len(t), np.nan)
    by_angle = with_columns(runs, motor_speed_rpm=none)
    for shown in (runs, by_angle):
        assert longest(shown, begin, end) == pytest.approx(fine) and longest(shown, begin - 0.06, end) > 2 * fine
        assert longest(shown, 0.6, 1.2) == longest(shown, 1.7, 1.98) == pytest.approx(usual)
    hidden = with_columns(by_angle, output_angle_deg=none)
    assert longest(hidden, 0.6, 1.2) == pytest.approx(fine)
    assert longest(hidden, 0.6, 1.98, stiff) == longest(runs, begin, end, stiff) == pytest.approx(usual)


def test_a_voltage_on_lines_is_the_mean_of_each_step_and_no_jump(tmp_path):
    """The means of all steps make up the integral of the broken line. Nothing else than what is imposed is on lines."""
    robot = drive(tmp_path, "motor_speed", top='between_rows = "linear"')
    runs = read_table(
        tmp_path,
        "time_s,supply_voltage_V,duty,motor_speed_rpm\n0,2,1,0\n0.1,12,1,0\n0.3,4,0.5,0\n0.4,4,0.5,0\n",
        robot,
    )
    made = observers.observer_kind(runs).of(runs, robot)
    volts, times = np.asarray(made.conditions.voltage)[0], np.asarray(made.times)[0]
    assert np.sum(volts[:-1] * np.diff(times)) == pytest.approx(0.1 * 7 + 0.2 * 8 + 0.1 * 4)
    after = np.searchsorted(times, 0.1)
    assert volts[after] == pytest.approx(12 - 40 * 0.5 * (times[after + 1] - 0.1)) and volts[-1] == 4
    duty = np.asarray(made.conditions.duty)[0]
    assert duty[np.searchsorted(times, 0.2)] == pytest.approx(0.75, abs=0.01)
    held = observers.observer_kind(runs).of(
        runs, dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, between_rows="held"))
    )
    jumps = np.asarray(held.times)[0]
    first = jumps[np.searchsorted(jumps, 0.1) + 1] - 0.1
    assert first < 2 * integrator.CHANGE[0] < 0.1 * (times[after + 1] - times[after])


def test_what_is_between_rows_is_written(tmp_path):
    robot = drive(tmp_path, "motor_speed", top='between_rows = "linear"')
    robot_file.write_robot(robot, tmp_path / "robot.toml")
    assert robot_file.load_robot(str(tmp_path / "robot.toml")).rig.between_rows == robot.rig.between_rows == "linear"


def test_a_jump_of_the_voltage_is_exact_in_every_step(tmp_path):
    """L / R of 3.3 ms, a shaft so heavy that it stands: the current's closed form at the end of steps of 20, 10 and 5 ms
    after a start and a jump, within one, and its derivative by the resistance."""
    robot = drive(tmp_path, "motor_current", motor="inductance = 0.01", inertia=1e3)
    times = jnp.array([0.0, 0.02, 0.03, 0.035, 0.04, 0.04])  # the last instant begins a step, as the observer has it
    driven = Conditions(voltage=np.array([6.0, 6.0, 9.0, 9.0, 9.0, 9.0]))

    def of(resistance):
        changed = params.replace(robot, {"motor.resistance": resistance})
        steps = integrator.course_between_instants(changed, driven, times)
        currents = tuple(x.current for x in (steps.first, steps.begin, steps.end))
        between = integrator.StepCourse.read((*currents, steps.decays), jnp.array([0.5, 0.5, 0.4, 0.5, 0.5]))
        found = jnp.append(steps.first.current, between[2])
        return found[1:], found[1:]

    def exact(resistance):
        left = np.exp(-resistance / 0.01 * np.array([0.02, 0.03, 0.005, 0.01, 0.002]))
        return np.append(6 * (1 - left[:2]), 9 - (3 + 6 * left[1]) * left[2:]) / resistance

    slope, shown = map(np.asarray, jax.jit(jax.jacfwd(of, has_aux=True))(3.0))
    assert_allclose(shown, exact(3.0), rtol=1e-4)
    assert_allclose(slope, (exact(3.003) - exact(2.997)) / 0.006, rtol=2e-3)


THROUGH_REST = ("bench.inertia", "bench.loss_coulomb", "motor.friction_coulomb")


@pytest.fixture(scope="module")
def through_rest(tmp_path_factory):
    """Derivatives of the speeds of a run by shares of its parameters, and differences of steps without end."""
    robot = drive(tmp_path_factory.mktemp("rig"), "motor_current", "motor_speed")
    every = np.arange(0, 1.2, 0.02)
    values = {p.name: float(p.value) for p in params.walk_parameters(robot)}

    def speeds(longest):
        times = integrator.time_grid(every, longest=longest)
        volts = 6.0 * np.where(np.sin(2 * np.pi * (1.3 * times + 0.4 * times**2)) >= 0, 1.0, -1.0)
        held = Conditions(voltage=volts)

        def of(shares):
            changed = {name: values[name] * (1 + share) for name, share in zip(THROUGH_REST, shares, strict=True)}
            found = integrator.history_signals(params.replace(robot, changed), held, jnp.asarray(times))
            return found.speed_motor[np.searchsorted(times, every)]

        return of

    fine, one = speeds(4e-5), np.eye(len(THROUGH_REST))
    still, ahead, behind = np.split(
        np.asarray(jax.jit(jax.vmap(fine))(np.concatenate([0 * one[:1], 0.02 * one, -0.02 * one]))), [1, 4]
    )
    assert (np.diff(np.sign(still[0])) != 0).sum() >= 4
    slopes = jax.jit(jax.jacfwd(speeds(6e-4)))(np.zeros(len(THROUGH_REST)))
    return np.asarray(slopes).T, (ahead - behind) / 0.04


@pytest.mark.parametrize("name", THROUGH_REST)
def test_derivatives_through_rest_are_those_of_steps_without_end(through_rest, name):
    """Where a direction turns friction jumps, by what no stage of a step shows: the derivative of what the stages
    compute forgets that the moment of rest moves."""
    slope, wide = (x[THROUGH_REST.index(name)] for x in through_rest)
    assert np.linalg.norm(slope - wide) < 0.05 * np.linalg.norm(wide)


@pytest.mark.slow
def test_steps_follow_the_rows_of_a_log_whose_input_changes_at_each(tmp_path, monkeypatch):
    """A second of a voltage at 50 Hz, against steps that stay short after each change."""
    robot = drive(tmp_path, "total_current", "motor_speed", rig="delay = 0.0", inertia=0.002)
    t = np.arange(0, 1, 0.02)
    volts = 12 * np.sin(5 * t) + 6 * np.sign(np.sin(11 * t)) + 0.5 * np.random.default_rng(1).standard_normal(50)
    driven = {"time_s": t, "supply_voltage_V": volts, "total_current_A": 0 * t, "motor_speed_rpm": 0 * t}
    runs = read_table(tmp_path, csv_text(driven), robot)
    made = observers.observer_kind(runs).of(runs, robot)
    shown = np.asarray(made(robot).reading)
    monkeypatch.setattr(run_grids.histories, "CHANGE", (1e-6, 0.1))
    monkeypatch.setattr(run_grids, "LONGEST", 5e-5)
    fine = observers.observer_kind(runs).of(runs, robot)
    exact = np.asarray(fine(robot).reading)
    assert made.times.size < 7 * len(runs) and 25 * made.times.size < fine.times.size
    error = np.sqrt(np.mean((shown - exact) ** 2, 0) / np.mean(exact**2, 0))
    assert (error < 2e-3).all() and (error > 1e-6).all()
