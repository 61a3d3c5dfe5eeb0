"""Missions that a battery's cut-off ends: beside an independent integration, its derivative, its words, bad input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from worlds import paper

import mmrjax as mm
from calibration.data import robot_file
from mmrjax.missions import mission_batch
from mmrjax.missions.mission import mission
from mmrjax.missions.mission_steps import MARKS
from mmrjax.missions.profile import profile
from mmrjax.model import paper_robots, params
from mmrjax.model.signals import STATUSES
from tests.commands import rows

HOUR = profile([0.0, 3600.0], "voltage", duty=1.0, slope_deg=10.0, payload=5.0)
#: Room for the steps of a mission, as the command keeps; one program serves all with the same cut-off.
KEEP = 4096


@pytest.fixture(scope="module")
def robot():
    return params.without_weak_types(paper_robots.nominal())


def with_battery(robot, cutoff=3.3, delay=1.0, **changes):
    battery = dataclasses.replace(robot.battery, voltage_cutoff=cutoff, delay_cutoff=delay)
    return params.replace(
        dataclasses.replace(robot, battery=battery), {f"battery.{n}": x for n, x in changes.items()}
    )


# --- an independent integration -------------------------------------------------------------------------------------


def integrated(cutoff, delay=1.0):
    """Time [s] and distance [m] at which tracks at full duty are cut off: SciPy's Radau on the plain rates of `paper`
    with heat of winding and housing, and its root of the cell's voltage."""
    side = paper.Side(0.0, np.radians(10.0), 5.0, battery=True)
    cold = side.R

    def cell(y):
        return side.supply(y[0], y[4]) / paper.CELLS

    def rates(t, y):
        winding, housing = y[5:]
        side.R = cold * (1 + 0.00393 * (winding - 25))
        flow = (winding - housing) / 1.7
        heat = (side.R * y[0] ** 2 - flow) * 1.7 / 16.3, (flow - (housing - 25) / 6.0) * 6.0 / 593.0
        return [*side.rates(t, y[:5]), *heat]

    def falls(t, y):
        return cell(y) - cutoff

    falls.terminal, falls.direction = True, -1
    accuracy = {"method": "Radau", "rtol": 1e-8, "atol": 1e-8 * np.array([10, 1000, 1, 1, 100, 50, 50.0])}
    start = solve_ivp(rates, [0, 10], [0, 0, 0, 0, 0, 25.0, 25.0], **accuracy)
    assert cell(start.y[:, -1]) > cutoff  # the surge of the start is over
    found = solve_ivp(rates, [10, 3600], start.y[:, -1], events=falls, **accuracy)
    after = solve_ivp(rates, [0, delay], found.y[:, -1], **accuracy)
    return found.t[-1] + delay, after.y[3, -1]


@pytest.fixture(scope="module")
def followed():
    def one(robot, keep=KEEP):
        at = mm.Conditions(configuration=np.array([0]), battery=np.array([1.0]))
        found = jax.device_get(mission_batch.simulate_batch(robot, at, HOUR, None, keep))
        return jax.tree.map(lambda x: x[0], found)

    return one


@pytest.fixture(scope="module")
def cut(robot, followed):
    return followed(with_battery(robot))


@pytest.mark.slow
def test_cutoff_ends_the_mission_where_an_independent_integration_does(cut):
    """990.3 s and 816 m, where whole steps gave 1161 s and 944 m."""
    time, distance = integrated(3.3)
    assert STATUSES[int(cut.result.status)] == "cut_off"
    assert cut.total.time == pytest.approx(time, rel=2e-5)
    assert float(cut.total.of["path"]) == pytest.approx(distance, rel=5e-5)


@pytest.mark.slow
def test_steps_land_on_the_crossing_and_the_delay_counts_from_there(cut, robot):
    course, count = cut.course, int(cut.steps - cut.rejected)
    marks = [MARKS[k] if k >= 0 else "" for k in course.event[:count]]
    assert marks[-1] == "cut_off" and marks.count("cut_off") == 1
    k = len(marks) - 1 - marks[::-1].index("below_cut_off")
    cell = course.signals.voltage_source[:count] / robot.battery.cells
    assert cell[k] == pytest.approx(3.3, abs=1e-6)
    assert (cell[k + 1 :] < 3.3).all() and "above_cut_off" not in marks[k:]
    assert course.time[count - 1] - course.time[k] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.slow
def test_endurance_and_range_are_those_of_the_cut_off(cut, robot):
    at = mm.Conditions(configuration=0, battery=1.0)
    numbers = mission_batch.mission_numbers(with_battery(robot), at, cut)
    assert float(numbers["endurance"]) == cut.total.time and float(numbers["state_of_charge"]) > 0.1
    assert float(numbers["range"]) == float(cut.total.of["path"])


@pytest.mark.slow
def test_the_inrush_recovers_in_time_and_a_longer_stay_below_does_not(robot, followed):
    """The start presses the cells below for 9 ms: a delay that is shorter ends the mission there, timed."""
    short = followed(with_battery(robot, delay=0.004))
    assert STATUSES[int(short.result.status)] == "cut_off" and short.total.time < 0.005
    marks, count = short.course.event, int(short.steps - short.rejected)
    k = int(np.flatnonzero(marks[:count] == MARKS.index("below_cut_off"))[-1])
    assert short.course.time[count - 1] - short.course.time[k] == pytest.approx(0.004, abs=1e-12)


@pytest.mark.nightly
def test_moment_of_the_cut_off_has_the_derivative_of_differences(robot):
    """By four parameters at once: the implicit function theorem at the event, through heat and charge."""
    names = ("battery.resistance", "battery.voltage_full", "motor.resistance", "6T2A.mass")
    low = with_battery(robot)
    base = {p.name: float(p.value) for p in params.walk_parameters(low)}
    at = mm.Conditions(configuration=0, battery=1.0, discharge=3000.0)
    weigh = jnp.asarray([1.0, 0.02, 1.0, 1.0])

    def ends(x):
        changed = params.replace(low, {n: base[n] * (1 + w * e) for n, w, e in zip(names, weigh, x, strict=True)})
        found = mission(changed, at, HOUR, tolerance=1e-7)
        return jnp.stack([found.total.time, found.total.of["path"], found.discharge])

    both = jax.jit(lambda x: (ends(x), jax.jacfwd(ends)(x)))
    zero, h = jnp.zeros(4), 1e-3
    _, exact = both(zero)
    for k in range(4):
        apart = (both(zero.at[k].add(h))[0] - both(zero.at[k].add(-h))[0]) / (2 * h)
        assert_allclose(exact[:, k], apart, rtol=2e-3, atol=1e-3, err_msg=names[k])
        assert abs(apart[0]) > 1.0  # s: the moment moves


@pytest.mark.slow
def test_charge_that_is_off_shows_in_what_is_unaccounted_for(cut):
    """The energy of a battery follows from its charge: one that has drifted by 1.3e-4 is not overlooked."""
    through = float(cut.total.of["drawn"])
    assert abs(cut.total.unaccounted) < 1e-6 * through
    drifted = dataclasses.replace(cut.total, supplied=cut.total.supplied * (1 + 1.3e-4))
    assert drifted.unaccounted == pytest.approx(1.3e-4 * through, rel=1e-2)


# --- what is said ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tmp_path(tmp_path_factory):
    """One folder for all commands of this file."""
    return tmp_path_factory.mktemp("cutoff")


@pytest.mark.slow
def test_names_shared_by_a_run_and_a_mission_are_the_same_quantities(tmp_path, mmrjax):
    """The same three seconds by both, at a current limit, so that current of motors and of the supply differ, and
    backward, so that the two distances do. A mission heats up by some degrees, of which 2 % are allowed for."""
    (tmp_path / "three.csv").write_text("time_s,supply_voltage_V\n0,-24\n3,-24\n")
    asked = ("simulate", "--configuration", "4W2T", "--set", "driver.current_limit=1.5", "--no-report")
    by_run = ("--model", "drive", "--voltage", "-24", "--duration", "3", "--out", "run")
    for words in (by_run, ("--profile", "three.csv", "--out", "mission")):
        mmrjax(*asked, *words)
    compared = set()
    for name in ("runs.csv", "history.csv"):
        one, other = (rows(tmp_path / out / name)[-1] for out in ("run", "mission"))
        for column in set(one) & set(other):
            try:
                values = float(one[column]), float(other[column])
            except ValueError:
                continue
            assert values[1] == pytest.approx(values[0], rel=0.02, abs=1e-3), (name, column)
            compared.add(column)
    assert compared >= {
        "peak_current_A",
        "total_current_A",
        "displacement_m",
        "traction_N",
        "voltage_V",
        "speed_mm_s",
    }
    last = rows(tmp_path / "mission/history.csv")[-1]
    assert float(last["distance_m"]) == pytest.approx(-float(last["displacement_m"]), rel=1e-6)


def test_a_cut_off_below_an_empty_cell_is_said_where_a_file_states_it(tmp_path):
    (tmp_path / "low.toml").write_text("[battery]\nvoltage_cutoff = 2.9\n")
    assert robot_file.parse_robot_file(tmp_path / "low.toml").remarks == (
        "low.toml, battery.voltage_cutoff: 2.9 V is below the 3.41 V of an empty cell without load: it acts only "
        "beyond 10.4 A",
    )
    (tmp_path / "low.toml").write_text("[battery]\nvoltage_cutoff = 3.45\n")
    assert robot_file.parse_robot_file(tmp_path / "low.toml").remarks == ()


def test_python_says_what_is_wrong_with_a_cut_off(robot):
    at = mm.Conditions(configuration=["6T2A", "6T2A"], battery=1.0, discharge=[0.0, 7000.0])
    with pytest.raises(
        mm.UsageError, match=r"discharge\[1\]: got 7000 C; a cell is then at 3.\d+ V, below its cut-off"
    ):
        mm.simulate(with_battery(robot, 3.5), at, profile=HOUR, history=False)
    with pytest.raises(mm.UsageError, match=r"battery\.voltage_cutoff: got 4.19 V; expected less than voltage_full"):
        mm.simulate(with_battery(robot, 4.19), at)
    hungry = with_battery(robot, 2.9, current_other=20.0)
    remark = pytest.warns(UserWarning, match=r"2\.9 V is below the 3\.41 V of an empty cell")
    with remark, pytest.raises(mm.UsageError, match=r"discharge\[1\]: got 7000 C; a cell is then at 2\.\d+ V"):
        mm.simulate(hungry, at, profile=HOUR, history=False)
