"""`rates`, `step` and `initial_state`: the fidelity `drive` in steps, under transformations, in either precision."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mmrjax as mm
from mmrjax import fidelities
from mmrjax.effects import BY_NAME
from mmrjax.fidelities import drive
from mmrjax.fidelities.drive import drive_rates as rates_of_unknowns
from mmrjax.model import paper_robots
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import State

DT = 0.01
RUNS = {
    "tracked": mm.Conditions("6T2A", voltage=24.0, slope_deg=5.0, payload=3.0),
    "wheeled": mm.Conditions("4W2T", voltage=15.0),
}


@pytest.fixture(scope="module")
def bench():
    """A motor that lifts a mass on a drum, and is not known further."""
    drum = Shaft(inertia=2e-3, loss_coulomb=0.02, torque_gravity=0.1)
    robot = paper_robots.blank_robot(Configurations({"winch": drum}), sides=1.0)
    motor = {"motor.resistance": 2.0, "motor.torque_constant": 0.05, "motor.inertia": 1e-5, "gearbox.ratio": 10.0}
    return mm.replace(robot, {**motor, "motor.inductance": 1e-3})


def test_states_hold_numbers_in_si_units_and_rates_are_those_of_drive(robot):
    conditions = RUNS["tracked"].resolved(robot)
    remembering = dataclasses.replace(robot, effects=(BY_NAME["thermal_drift"](amplitude=0.5),))
    for one in (robot, remembering):
        at_rest = mm.initial_state(one, conditions)
        state = dataclasses.replace(at_rest, current=3.0, speed_motor=500.0, speed=0.4, distance=1.5)
        found = mm.rates(one, state, None, conditions)
        assert jax.tree.structure(found) == jax.tree.structure(at_rest)
        sizes = jnp.asarray(drive.drive_units(one))
        y = jnp.stack([jnp.asarray(x, float) for x in (3.0, 500.0, 0.4, 1.5, 0.0, *state.memory.values())]) / sizes
        wanted = drive.state_of_unknowns(one, rates_of_unknowns(one, conditions, y))
        assert found.distance == 0.4 and float(found.current) != 0
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            assert_allclose(a, b, rtol=1e-12)


def test_steps_are_runs_of_drive(robot):
    """From rest at full voltage, at half the duty, and with the motors shorted to rest."""
    conditions = RUNS["tracked"]
    duties = jnp.repeat(jnp.asarray([1.0, 0.5, 0.0]), 40)

    @jax.jit
    def run(duties):
        def one(state, duty):
            state = mm.step(robot, state, duty, DT, conditions)
            return state, state

        return jax.lax.scan(one, mm.initial_state(robot, conditions), duties)[1]

    coarse = run(duties)
    times = jnp.arange(41) * DT
    of_drive = drive.drive(robot, conditions.resolved(robot), times, tolerance=1e-9)
    assert_allclose(coarse.speed[:40], of_drive.signals.speed[1:], atol=2e-4)
    assert_allclose(coarse.distance[:40], of_drive.distance[1:], atol=1e-4)
    assert of_drive.signals.speed[-1] > 0.4 and (coarse.speed[100:] == 0).all()
    assert np.ptp(coarse.distance[100:]) == 0 and abs(coarse.current[-1]) < 1e-6


@pytest.mark.parametrize("dt", [0.05, 0.02])
def test_starts_are_as_accurate_as_stated(dt, in_steps):
    """Largest error of the speed at any step, compared with steps of 1 ms."""
    for conditions in (RUNS["tracked"], mm.Conditions("4W2T", voltage=33.0)):
        found, exact = (in_steps(conditions, length) for length in (dt, 1e-3))
        exact = exact[round(dt / 1e-3) - 1 :: round(dt / 1e-3)]
        assert_allclose(found, exact, rtol=3e-3)


@pytest.fixture(scope="module")
def in_steps(robot):
    """Speeds of a start in steps of one length, over half a second. One program for all."""
    step = jax.jit(lambda state, dt, conditions: mm.step(robot, state, None, dt, conditions))

    def speeds(conditions, dt):
        conditions, found = conditions.resolved(robot), []
        state = mm.initial_state(robot, conditions)
        for _ in range(round(0.5 / dt)):
            state = step(state, dt, conditions)
            found.append(float(state.speed))
        return np.array(found)

    return speeds


def case(kind, robot, bench):
    """A robot, its conditions, and what a step under a duty does to its speed."""
    one, conditions = (bench, mm.Conditions(voltage=12.0)) if kind == "shaft" else (robot, RUNS[kind])

    def far(state, duty, given):
        after = mm.step(one, state, {"duty": duty}, DT, given)
        return after.speed_motor, after

    mapped = jax.vmap(jax.value_and_grad(far, argnums=1, has_aux=True), in_axes=(None, 0, None))
    return one, conditions, jax.jit(mapped)


@pytest.mark.quick("tracked-True", "shaft-False")
@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("kind", [*RUNS, "shaft"])
def test_a_step_can_be_traced_by_every_transformation(kind, double, robot, bench):
    """Conditions by name are an argument."""
    with jax.enable_x64(double):
        one, conditions, mapped = case(kind, robot, bench)
        (_, after), slope = jax.eval_shape(
            mapped, mm.initial_state(one, conditions), jnp.asarray([0.3, 0.9]), conditions
        )
    wanted = jnp.dtype("float64" if double else "float32")
    assert {(x.shape, x.dtype) for x in jax.tree.leaves((after, slope))} == {((2,), wanted)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*RUNS, "shaft"])
def test_derivatives_of_a_step_are_differences(kind, robot, bench):
    one, conditions, mapped = case(kind, robot, bench)
    state, duties = mm.initial_state(one, conditions), jnp.asarray([0.3, 0.9])
    (speed, _), slope = mapped(state, duties, conditions)
    h = 1e-5
    ahead, behind = (mm.step(one, state, 0.9 + d, DT, conditions).speed_motor for d in (h, -h))
    assert (slope > 0).all()
    assert_allclose(slope[1], (ahead - behind) / (2 * h), rtol=1e-5)
    with jax.enable_x64(False):
        (rough, _), rough_slope = mapped(mm.initial_state(one, conditions), jnp.asarray([0.3, 0.9]), conditions)
    assert_allclose(rough, speed, rtol=1e-4)
    assert_allclose(rough_slope, slope, rtol=1e-3)


def test_a_robot_rolls_at_first_as_steady_travels(robot):
    conditions = RUNS["wheeled"]
    state = mm.initial_state(robot, conditions, rolling=True)
    rate = mm.rates(robot, state, None, conditions)
    assert state.speed > 0.3 and abs(rate.speed) < 1e-9 and abs(rate.speed_motor) < 1e-6


WRONG = {
    "robot: got str; expected a Robot": dict(robot="nominal"),
    "conditions: got runs of shape (2,); expected one, and jax.vmap over several": dict(
        conditions=mm.Conditions(voltage=[15.0, 24.0])
    ),
    "conditions: got a command for each side; a step travels straight, use mmrjax.simulate": dict(
        conditions=mm.Conditions(duty_left=1.0, duty_right=0.5)
    ),
    "conditions: the motors' speed is imposed; a step needs a voltage or a current": dict(
        command={"motor_speed": 300.0}
    ),
    "conditions: got dict; expected mmrjax.Conditions(...)": dict(conditions={"voltage": 12.0}),
    "configuration: got 6T3A; did you mean 6T2A?": dict(conditions=mm.Conditions("6T3A")),
    "slope_deg: got 95; expected -45 to 45 deg": dict(conditions=mm.Conditions(slope_deg=95.0)),
    "duty: got nan; expected -1 to 1": dict(command=math.nan),
    "voltage: got nan; expected -10000 to 10000 V": dict(command={"voltage": math.nan}),
    "command: got volts; did you mean voltage?": dict(command={"volts": 12.0}),
    "command, duty: got 'full'; expected a number": dict(command="full"),
    "command, duty: got shape (2,); expected one number": dict(command=[0.5, 1.0]),
    "state: got float; expected one from mmrjax.initial_state": dict(state=0.4),
    "state: got one of another robot": dict(state=State(0.0, 0.0, 0.0, 0.0, {"thermal_drift": 0.0})),
    "state: got numbers of shape (2,); expected one state": dict(state=State(0.0, 0.0, np.zeros(2), 0.0)),
    "dt: got 0.0; expected a number of seconds above 0": dict(dt=0.0),
    "dt: got nan; expected a number of seconds above 0": dict(dt=math.nan),
    "dt: got NoneType; expected a number of seconds above 0": dict(dt=None),
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_use_of_a_step_is_one_sentence(message, robot):
    given = {"robot": robot, "state": mm.initial_state(robot), "command": 1.0, "dt": DT, **WRONG[message]}
    with pytest.raises(mm.UsageError) as error:
        mm.step(**given)
    assert str(error.value).startswith(message)


def reverse(model, **options):
    """Reverse mode through a run, traced and not compiled."""

    def speed(volts):
        return mm.simulate(
            paper_robots.nominal(), mm.Conditions(voltage=volts), model=model, history=False, **options
        ).speed

    return jax.eval_shape(jax.grad(speed), 24.0)


REFUSED = r"derivatives are forward \(jax.jacfwd, jax.jvp\)\. For jax.grad use model steady, or mmrjax.step for runs"


def test_reverse_mode_is_refused_in_a_sentence_where_a_fidelity_has_none(monkeypatch):
    assert reverse("steady").shape == ()
    forward_alone = dataclasses.replace(fidelities.fidelity_facts("steady"), reverse=False)
    monkeypatch.setitem(fidelities.TABLE, "steady", forward_alone)
    with pytest.raises(RuntimeError, match=f"^steady: {REFUSED}"):
        reverse("steady")


@pytest.mark.slow
@pytest.mark.parametrize("model", ["drive", "track"])
def test_fidelities_have_reverse_mode_as_they_state(model):
    if fidelities.fidelity_facts(model).reverse:
        assert reverse(model, duration=0.002).shape == ()
        return
    with pytest.raises(RuntimeError, match=f"^{model}: {REFUSED}"):
        reverse(model)


def test_conditions_by_name_are_an_argument_of_compiled_functions(robot):
    runs = mm.Conditions(["4W2T", "6T2A", "4W2T"], voltage=[15.0, 24.0, 33.0])
    which = jax.jit(lambda c: c.resolved(robot).configuration)(runs)
    assert which.tolist() == runs.resolved(robot).configuration.tolist() == [1, 0, 1]
    mapped = jax.vmap(lambda c: c.resolved(robot).configuration)(runs)
    assert mapped.tolist() == [1, 0, 1]
    half = jax.tree.map(lambda x: x[1:], runs).resolved(robot)
    assert half.configuration.tolist() == [0, 1] and half.voltage.tolist() == [24.0, 33.0]
    of_others = mm.Conditions(["legs", "6T2A", "4W2T"])
    assert jax.tree.map(lambda x: x[1:], of_others).resolved(robot).configuration.tolist() == [0, 1]
    with pytest.raises(KeyError, match="no configuration legs"):
        of_others.resolved(robot)
    with pytest.raises(KeyError, match="no configuration legs"):
        jax.jit(lambda c: c.resolved(robot).configuration)(mm.Conditions(["6T2A", "legs"]))


@pytest.mark.slow
def test_steps_converge(robot):
    """Against a hundred times as many, over a command that changes: the figures that the docstring states."""
    conditions = RUNS["wheeled"]
    duties = np.repeat([1.0, 0.4, -0.5, 0.0], 40)

    def run(parts):
        @jax.jit
        def whole(duties):
            def one(state, duty):
                part = lambda state, _: (mm.step(robot, state, duty, DT / parts, conditions), None)  # noqa: E731
                state = jax.lax.scan(part, state, None, length=parts)[0]
                return state, state

            return jax.lax.scan(one, mm.initial_state(robot, conditions), duties)[1]

        return whole(jnp.asarray(duties))

    exact, found = run(100), run(1)
    assert np.abs(found.speed - exact.speed).max() < 4e-3 and np.abs(found.distance - exact.distance).max() < 1e-4
