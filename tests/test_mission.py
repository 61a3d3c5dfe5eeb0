"""Missions: against SciPy, closed forms, and themselves. Energy, derivatives, standing still, limits."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from worlds import events, paper

from mmrjax.errors import UsageError
from mmrjax.missions import mission_straight, mission_turning
from mmrjax.missions.mission import TOLERANCE, Start, mission
from mmrjax.missions.profile import MODES, Profile, profile
from mmrjax.model import energy, paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import FLAGS, STATUSES

ROWS = 8
_run = eqx.filter_jit(mission)


def run(robot, conditions, profile, start=None, tolerance=TOLERANCE):
    """A mission with its course. All that is stated here is a number of the program, so that most tests share one."""
    ambient = robot.motor.temperature_ambient
    start = start or Start(temperature_winding=ambient, temperature_housing=ambient)
    start = jax.tree.map(lambda x: jnp.asarray(x, float), start)
    return _run(robot, conditions, profile, start, tolerance=jnp.asarray(tolerance), keep=2000)


def rows(time, mode="voltage", **values):
    """A profile of ROWS rows whatever is asked, every field stated, so that few programs are compiled."""
    time = np.asarray(time, float)
    lacking = ROWS - len(time)
    padded = np.concatenate([time, time[-1] + 1e-3 * np.arange(1, lacking + 1)])
    modes = [mode] * len(time) if isinstance(mode, str) else list(mode)
    given = {"demand": 0.0, "voltage": 24.0, "duty": 1.0, "slope_deg": 0.0, "payload": 0.0, "current_other": 1.5}
    filled = {}
    for name, value in {**given, **values}.items():
        x = np.broadcast_to(np.asarray(value, float), time.shape)
        filled[name] = np.concatenate([x, np.repeat(x[-1], lacking)])
    return profile(padded, modes + [modes[-1]] * lacking, **filled)


def asked(configuration=0, **changes):
    return Conditions(configuration=configuration, **changes)


def flagged(flags):
    return {name for k, name in enumerate(FLAGS) if int(flags) >> k & 1}


@pytest.fixture(scope="module")
def robot():
    return params.without_weak_types(paper_robots.nominal())


MANY = (
    [0, 3, 4, 5, 8, 9, 11, 12],
    ["voltage", "coast", "brake", "voltage", "brake", "speed", "speed", "brake"],
    dict(
        demand=[0, 0, 0, 0, 0, 0.3, 0, 0],
        voltage=[24, 24, 24, -20, 24, 24, 24, 24],
        slope_deg=[0, 0, 0, 5, 0, 5, 5, 0],
    ),
)


# --- against an independent implementation ----------------------------------------------------------


#: Driven, braked to rest, driven backward and to the other side again, the current limited at each start.
DUTIES, TIMES, LIMIT = [1.0, 0.0, -1.0, 0.8], [0.0, 1.0, 2.0, 3.0, 4.5], 6.0
EXPLORED = ("6T2A.mass", "motor.torque_constant", "driver.current_limit")


@pytest.mark.slow
def test_mission_through_rest_at_the_current_limit_is_that_of_scipy(robot):
    """Distance and energy of each segment on the battery within 0.02 sds of 1 %, and their derivatives within 1 %."""
    p = rows(TIMES, ["voltage", "brake", "voltage", "voltage", "voltage"], duty=[*DUTIES, 0.8])
    start, base = Start(temperature_winding=25.0, temperature_housing=25.0), {**paper.NOMINAL, EXPLORED[2]: LIMIT}

    def outputs(shares):
        changed = {name: base[name] * share for name, share in zip(EXPLORED, shares, strict=True)}
        found = mission(params.replace(robot, changed), asked(battery=1.0), p, start, tolerance=1e-6)
        of = {name: x[0, : len(DUTIES)] for name, x in found.segments.of.items()}
        ends = jnp.stack([of["distance"], of["drawn"] - of["returned"]], -1)
        return ends, ends

    def exact(shares):
        changed = {name: base[name] * share for name, share in zip(EXPLORED, shares, strict=True)}
        ends = events.Robot(changed[EXPLORED[2]], base | changed).over(DUTIES, TIMES)
        return np.diff(ends[:, [3, 7]], axis=0, prepend=0.0)

    one = np.ones(len(EXPLORED))
    slopes, ends = (np.asarray(x) for x in eqx.filter_jit(jax.jacfwd(outputs, has_aux=True))(jnp.asarray(one)))
    assert (np.abs(ends - exact(one)) <= 2e-4 * np.abs(ends).max(0)).all()
    for k, step in enumerate(1e-3 * np.diag(one)):
        apart = (exact(one + step) - exact(one - step)) / 2e-3
        assert (np.abs(slopes[..., k] - apart) <= 0.01 * np.abs(apart).max(0)).all(), EXPLORED[k]


# --- energy -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("configuration", [0, 1])
@pytest.mark.parametrize("battery", [0.0, 1.0])
def test_energy_in_is_where_it_went_and_what_is_stored(robot, configuration, battery):
    """Through starts, stops, reversals and a descent. Stored energy from the states, not from the integrals."""
    time, mode, values = MANY
    p = rows(time, mode, **{**values, "slope_deg": [0, 0, 0, 5, 0, -20, -20, 0]})
    found = run(robot, asked(configuration, battery=battery, adhesion=2.0), p, tolerance=2e-6)
    assert STATUSES[int(found.result.status)] == "converged"
    through = float(found.total.of["drawn"] + found.total.of["returned"])
    assert abs(found.total.unaccounted) < 1e-6 * through
    assert abs(np.asarray(found.segments.unaccounted)).max() < 1e-6 * through
    assert float(found.total.of["drawn"]) > 100.0
    losses = [float(found.total.of[name]) for name in energy.SINKS if name not in ("lift", "driver")]
    assert min(losses) >= 0.0


@pytest.mark.slow
def test_regeneration_charges_the_battery_and_is_flagged_above_its_charge_voltage(robot):
    idle = params.replace(robot, {"battery.current_other": 0.0})
    p = rows([0, 60], slope_deg=-20.0, payload=8.0, current_other=0.0)
    found = run(idle, asked(1, battery=1.0, adhesion=2.3), p)
    assert found.discharge < -10.0 and found.total.energy < -1000.0
    assert "overvoltage" in flagged(found.result.flags)
    drained = run(idle, asked(1, battery=1.0, adhesion=2.3, discharge=3600.0), p)
    assert drained.discharge < 3600.0 and "overvoltage" not in flagged(drained.result.flags)


@pytest.mark.slow
def test_a_supply_that_takes_nothing_back_lets_the_motors_coast(robot):
    one_way = dataclasses.replace(robot, driver=dataclasses.replace(robot.driver, returns_current=False))
    p = rows([0, 5], voltage=10.0, slope_deg=-20.0, payload=8.0)
    found, both = run(one_way, asked(1, adhesion=2.3), p), run(robot, asked(1, adhesion=2.3), p)
    assert float(found.total.of["returned"]) < 1e-3 * float(both.total.of["returned"])
    assert float(found.peaks["speed"]) > 1.5 * float(both.peaks["speed"])
    assert abs(found.total.unaccounted) < 1e-4 * float(found.total.of["drawn"] + abs(found.total.of["lift"]))


# --- standing ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("configuration, mode, slope", [(0, "brake", 15.0), (0, "speed", 20.0), (1, "speed", 20.0)])
def test_a_robot_held_on_a_slope_for_an_hour_stays(robot, configuration, mode, slope):
    """By friction at rest where that suffices, else by the motors: less than a millimetre."""
    found = run(robot, asked(configuration, adhesion=2.0), rows([0, 3600], mode, slope_deg=slope))
    assert STATUSES[int(found.result.status)] == "converged"
    assert abs(float(found.total.of["distance"])) < 1e-3
    assert int(found.steps) < 600
    if mode == "brake":
        assert float(found.total.of["path"]) == 0.0


@pytest.mark.slow
def test_what_friction_cannot_hold_rolls_back(robot):
    found = run(robot, asked(1, adhesion=2.0), rows([0, 20], "coast", slope_deg=20.0))
    assert float(found.total.of["distance"]) < -20.0
    assert STATUSES[int(found.status[0, 0])] == "rolls_back"


# --- heat -------------------------------------------------------------------------------------------


def test_temperature_follows_the_two_bodies_in_closed_form(robot):
    """A robot held fast, whose winding is of a metal that keeps its resistance: two exponentials."""
    held = params.replace(robot, {"6T2A.track.loss_coulomb": 20.0})
    p = rows([0, 100], voltage=2.0)
    cool = Start(temperature_winding=25.0, temperature_housing=25.0)
    found = run(held, asked(), p, cool, tolerance=1e-9)
    assert float(found.total.of["path"]) == 0.0
    C_w, C_h = 16.3 / 1.7, 593.0 / 6.0

    # With copper: C_w T_w' = U² / (R (1 + α (T_w - 25))) - (T_w - T_h) / R_wh at a constant voltage.
    def rates(t, y):
        power = 4.0 / (0.611 * (1 + 0.00393 * (y[0] - 25)))
        flow = (y[0] - y[1]) / 1.7
        return [(power - flow) / C_w, (flow - (y[1] - 25) / 6.0) / C_h]

    end = solve_ivp(rates, [0, float(p.time[-1])], [25.0, 25.0], method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    assert found.temperature_winding == pytest.approx(end[0], rel=1e-6)
    assert found.temperature_housing == pytest.approx(end[1], rel=1e-6)
    assert float(found.peaks["temperature"]) == pytest.approx(end[0], rel=1e-6)


# --- limits -----------------------------------------------------------------------------------------


def test_the_current_limit_holds_and_is_flagged(robot):
    limited = params.replace(robot, {"driver.current_limit": 5.0})
    found = run(limited, asked(), rows([0, 3]))
    assert float(found.peaks["current"]) < 2 * 5.0 * 1.003
    assert "current_limited" in flagged(found.result.flags)
    free = run(robot, asked(), rows([0, 3]))
    assert float(free.peaks["current"]) > 60.0 and "current_limited" not in flagged(free.result.flags)
    assert limited.driver.current_limit == 5.0


def test_battery_standing_still_lasts_its_capacity_over_the_other_consumers_current(robot):
    found = run(robot, asked(battery=1.0), rows([0, 4 * 3600], "brake"))
    assert STATUSES[int(found.result.status)] == "battery_empty"
    assert found.total.time == pytest.approx(7920.0 / 1.5, rel=1e-9)


def test_a_demand_that_cannot_be_met_is_followed_as_far_as_possible_and_flagged(robot):
    found = run(robot, asked(), rows([0, 5], "speed", demand=2.0))
    assert "demand_missed" in flagged(found.flags[0, 0])
    most = run(robot, asked(), rows([0, 5]))
    assert float(found.result.reading["speed"]) == pytest.approx(float(most.result.reading["speed"]), rel=1e-3)
    met = run(robot, asked(), rows([0, 5], "speed", demand=0.4))
    assert "demand_missed" not in flagged(met.flags[0, 0])
    assert float(met.result.reading["speed"]) == pytest.approx(0.4, rel=1e-3)


# --- derivatives ------------------------------------------------------------------------------------


@pytest.mark.nightly
def test_derivatives_by_every_parameter_and_row_match_differences(robot):
    """Of Wh/m and peak temperature of a mission, in one Jacobian. Endurance has its closed form below."""
    time, mode, values = MANY
    start = rows(time, mode, **values)
    fixed = ("battery.", "6T2A", "running_gear.")  # on a supply, on wheels, with contacts lumped: not read
    named = {p.name: float(p.value) for p in params.walk_parameters(robot) if not p.name.startswith(fixed)}
    names = [name for name, value in named.items() if value != 0]
    columns = [n for n in ("time", "demand", "voltage", "slope_deg", "payload") if getattr(start, n) is not None]

    def outputs(x, moved):
        changed = params.replace(robot, {name: named[name] * x[k] for k, name in enumerate(names)})
        p = dataclasses.replace(start, **{n: getattr(start, n) + moved[n] for n in columns})
        found = mission(changed, asked(1, adhesion=2.0), p, tolerance=1e-9)
        return jnp.stack([found.total.energy / found.total.of["path"], found.peaks["temperature"]])

    x, moved = jnp.ones(len(names)), {n: jnp.zeros(ROWS) for n in columns}
    compiled, wrong = eqx.filter_jit(outputs), []
    value = np.asarray(compiled(x, moved))
    by_robot, by_row = eqx.filter_jit(lambda *a: jax.jacfwd(outputs, argnums=(0, 1))(*a))(x, moved)

    def check(what, exact, change, step):
        """At one of three steps: too long ones bend, too short ones show the steps' own rounding."""
        for h in (step, step / 3, step / 10):
            apart = (np.asarray(compiled(*change(h))) - np.asarray(compiled(*change(-h)))) / (2 * h)
            if (np.abs(exact - apart) <= 1e-4 * np.abs(apart) + 2e-5 * np.abs(value)).all():
                return
        wrong.append((what, np.asarray(exact).tolist(), apart.tolist()))

    for k, name in enumerate(names):
        check(name, by_robot[:, k], lambda h, k=k: (x.at[k].add(h), moved), 1e-3)
    for n in columns:
        for k in range(ROWS if n == "time" else ROWS - 1):
            if (n, k) == ("demand", 6):
                continue  # no speed demanded: a kink, since the way grows with a demand of either sign
            change = lambda h, n=n, k=k: (x, {**moved, n: moved[n].at[k].add(h)})  # noqa: E731
            check(f"{n}[{k}]", by_row[n][:, k], change, 1e-4 if n == "time" else 1e-3)
    assert not wrong, "\n".join(map(str, wrong))


@pytest.mark.slow
def test_endurance_has_the_derivative_of_its_closed_form(robot):
    def endurance(capacity):
        changed = params.replace(robot, {"battery.capacity": capacity})
        return mission(changed, asked(battery=1.0), rows([0, 4 * 3600], "brake")).total.time

    assert jax.jacfwd(endurance)(jnp.asarray(7920.0)) == pytest.approx(1 / 1.5, rel=1e-9)


def test_course_is_the_mission_over_time(robot):
    time, mode, values = MANY
    found = run(robot, asked(), rows(time, mode, **values))
    kept = int(np.isfinite(found.course.time).sum())
    assert kept == int(found.steps - found.rejected)
    assert (np.diff(np.asarray(found.course.time)[:kept]) > 0).all()
    assert found.course.energy[kept - 1] == pytest.approx(float(found.total.energy), rel=1e-12)
    assert found.course.time[kept - 1] == pytest.approx(float(found.total.time), rel=1e-12)
    current = 2 * np.abs(np.asarray(found.course.signals.current)[:kept]).max()
    assert current <= float(found.peaks["current"]) * (1 + 1e-12) and current > 0.99 * float(found.peaks["current"])


# --- what is wrong ----------------------------------------------------------------------------------

WRONG = {
    "got 1 row; expected two or more": dict(time=[0]),
    "row 3 has 1 s after 2 s; expected a later time": dict(time=[0, 2, 1]),
    "time: row 2 is not a finite number": dict(time=[0, np.nan]),
    "cycles: got 0; expected a whole number from 1": dict(time=[0, 1], cycles=0),
    f"mode, row 1: got fly; expected {', '.join(MODES)}": dict(time=[0, 1], mode="fly"),
    "no field slope; expected one of": dict(time=[0, 1], slope=3.0),
    "voltage: got 3 values; expected 2": dict(time=[0, 1], voltage=[1, 2, 3]),
    "voltage: row 2 is not finite": dict(time=[0, 1], voltage=[1, np.nan]),
    "duty: got 1.5; expected -1 to 1": dict(time=[0, 1], duty=1.5),
    "mode: got 1 value; expected 2": dict(time=[0, 1], mode=["brake"]),
    "got duty_left without duty_right; expected both": dict(time=[0, 1], duty_left=1.0),
    "got duty_left together with voltage_left; expected one": dict(
        time=[0, 1], duty_left=1.0, duty_right=1.0, voltage_left=9.0, voltage_right=9.0
    ),
    "duty_right: got 1.5; expected -1 to 1": dict(time=[0, 1], duty_left=1.0, duty_right=1.5),
    "got yaw_rate without speed; expected a demanded ground speed": dict(time=[0, 1], yaw_rate=1.0),
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_profiles_are_said(message):
    with pytest.raises(UsageError) as said:
        profile(**WRONG[message])
    assert message in str(said.value)


def test_every_unit_and_name_of_totals_is_integrated():
    assert all(set(energy.SINKS) < set(law.TOTALS) for law in (mission_straight, mission_turning))
    assert isinstance(rows([0, 1]), Profile)


@pytest.mark.slow
def test_cells_that_stay_below_their_cut_off_end_the_mission(robot):
    weak = dataclasses.replace(robot, battery=dataclasses.replace(robot.battery, voltage_cutoff=3.9))
    found = run(weak, asked(battery=1.0, discharge=2500.0), rows([0, 3600]))
    assert "cut_off" in flagged(found.result.flags) and STATUSES[int(found.result.status)] == "cut_off"
    assert found.total.time < 1000.0
    started = run(robot, asked(battery=1.0), rows([0, 5]))  # the inrush alone does not count
    assert float(started.peaks["cell_low"]) < 3.0 and "cut_off" not in flagged(started.result.flags)
