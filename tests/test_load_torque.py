"""Torque of a brake as a condition: against formulas, the same torque of the load, another implementation, differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_shaft import SPEEDS, bench, current_of
from test_worlds_rigs import steady
from worlds import logs, rigs

import mmrjax as mm
from mmrjax import balances
from mmrjax.conditions import Conditions
from mmrjax.errors import UsageError
from mmrjax.fidelities.drive import drive_batch
from mmrjax.fidelities.histories import grid, histories
from mmrjax.fidelities.steady import steady_batch, steady_outputs
from mmrjax.rig import Rig
from mmrjax.signals import STATUSES, State

VOLTS = np.array([24.0, 6.0, -12.0, 12.0])
TORQUE = np.array([0.5, 0.1, -0.3, 0.0])  # of a brake: against the way that each turns


def test_current_at_an_imposed_speed_follows_from_a_brake():
    """In both directions, a torque that drives the motor among them; its derivative is that of the formula."""

    def shown(torque):
        conditions = Conditions(motor_speed=SPEEDS, load_torque=torque)
        return steady_outputs(bench(), conditions, ("motor_current", "output_torque"))

    torque = jnp.asarray([-0.1, 1.0, 0.3, 2.0])
    found, slope = jax.jit(lambda x: jax.jvp(shown, (x,), (jnp.ones(4),)))(torque)
    np.testing.assert_allclose(found["motor_current"], current_of(SPEEDS, np.asarray(torque)), rtol=1e-9)
    np.testing.assert_allclose(
        found["output_torque"], np.sign(SPEEDS) * 0.2 + 0.01 * SPEEDS / 16 + np.asarray(torque), rtol=1e-9
    )
    drives = np.array([False, True, False, False])
    np.testing.assert_allclose(slope["motor_current"], np.where(drives, 0.8, 1 / 0.8) / 16 / 0.05, rtol=1e-9)


@pytest.mark.parametrize("loose", [False, True])
def test_a_brake_enters_as_a_constant_torque_of_the_load(loose):
    """Every signal of an instant, of a shaft with and without backlash, under an arm's weight."""
    rig, load = Rig(loose=loose), {"torque_gravity": 0.4, "backlash": 0.02 * loose}
    state = State(1.0, 120.0, 7.0, 0.0, distance=0.3, gap=0.012 if loose else None)
    moving = jax.jit(balances.moving)
    braked = moving(bench(rig, **load), Conditions(load_torque=0.3), state)
    stated = moving(bench(rig, torque_constant=0.3, **load), Conditions(), state)
    free = moving(bench(rig, **load), Conditions(), state)
    jax.tree.map(np.testing.assert_allclose, dataclasses.replace(braked, load_torque=None), stated)
    assert float(braked.acceleration) < float(free.acceleration)


def test_settled_rigs_with_a_brake_are_those_of_another_implementation():
    for imposed in ("voltage", "motor_speed"):
        w = rigs.world(np.random.default_rng([3, 1]), "bench", imposed)
        size = 0.5 * rigs._nominal(w.constants, w.rig.supply)[0]
        torque = size * np.random.default_rng(0).uniform(0, 1, len(w.conditions)) * w.conditions.direction
        w = dataclasses.replace(w, conditions=dataclasses.replace(w.conditions, load_torque=torque))
        found, _ = steady(w)
        s, sound = rigs.solve(w.rig, w.conditions, w.constants)
        free, _ = rigs.solve(w.rig, dataclasses.replace(w.conditions, load_torque=0 * torque), w.constants)
        assert sound.all()
        scale = np.abs(s.shown).max(1, keepdims=True)
        np.testing.assert_allclose(found / scale, s.shown / scale, atol=1e-6)
        assert (
            np.abs(free.shown - s.shown).max(1) > 1e-2 * scale[:, 0]
        ).any()  # a brake without effect would be seen


def test_a_torque_that_changes_from_step_to_step_is_followed():
    """A run from rest, which the torque begins to turn back before the current has risen."""
    times = grid(np.linspace(0, 0.6, 13))
    run = jax.jit(lambda x: histories(bench(), Conditions(voltage=24.0, load_torque=x), jnp.asarray(times)))
    changes = run(0.3 + 0.2 * np.sin(8 * times)).speed_motor
    end = float(run(np.full(len(times), 0.3)).speed_motor[-1])
    assert np.isfinite(changes).all() and abs(float(changes[-1]) - end) > 1.0
    assert 0.05 * end + 3.0 * current_of(end, 0.3) == pytest.approx(24.0, rel=1e-3)  # back-EMF and what torque takes


def _steady(torque):
    return steady_batch(bench(), Conditions(voltage=VOLTS, load_torque=torque))


def _driven(torque):
    return drive_batch(bench(), Conditions(voltage=VOLTS, load_torque=torque), jnp.asarray([0.0, 2.0, 4.0])).result


@pytest.mark.slow
def test_every_fidelity_settles_alike_under_a_brake():
    at, run = _steady(TORQUE), _driven(TORQUE)
    for name in ("motor_speed", "total_current", "output_torque"):
        np.testing.assert_allclose(run.reading[name], at.reading[name], rtol=1e-6)
    assert [STATUSES[s] for s in np.asarray(at.status)] == ["converged", "converged", "reverses", "converged"]
    without = steady_batch(bench(), Conditions(voltage=VOLTS))
    assert (np.abs(at.motor_speed)[:3] < np.abs(without.motor_speed)[:3]).all()  # it brakes either way
    np.testing.assert_array_equal(at.motor_speed[3], without.motor_speed[3])
    times = grid(np.linspace(0, 4.0, 9))
    shown = jax.jit(histories)(bench(), Conditions(voltage=24.0, load_torque=0.5), jnp.asarray(times))
    assert float(shown.speed_motor[-1]) == pytest.approx(float(at.motor_speed[0]), rel=1e-6)


@pytest.mark.slow
def test_derivatives_by_a_brake_are_differences():
    """Of settled travel and of a run over time; of a history by the load's own torque, which is the same."""
    for settles in (_steady, _driven):
        by_torque = jax.jvp(lambda x: settles(x).motor_speed, (jnp.asarray(TORQUE),), (jnp.ones(4),))[1]  # noqa: B023
        less, more = (settles(TORQUE + h).motor_speed for h in (-1e-4, 1e-4))
        np.testing.assert_allclose(by_torque, (more - less) / 2e-4, rtol=1e-4)
    times = jnp.asarray(grid(np.linspace(0, 0.6, 13)))

    @jax.jit
    def both(torque):
        shown = lambda own: histories(bench(torque_constant=own), Conditions(load_torque=torque), times).speed_motor  # noqa: E731
        return jax.jvp(shown, (0.0,), (1.0,))

    torque = 0.3 + 0.2 * jnp.sin(8 * times)
    less, more = (both(torque + h)[0] for h in (-1e-4, 1e-4))
    np.testing.assert_allclose(both(torque)[1], (more - less) / 2e-4, rtol=1e-3, atol=1e-3)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_log_with_a_brake_is_that_of_another_implementation(tmp_path):
    from test_worlds_logs import shown

    for imposed in ("voltage", "motor_speed"):
        rig = logs.rig(np.random.default_rng([5, 1]), imposed)
        steps = np.random.default_rng(2).uniform(0.0, 0.4 * rig.torque, (logs.RUNS, logs.ROWS // 4 + 1))
        torque = np.round(np.repeat(steps, 4, 1)[:, : logs.ROWS], 6) * np.sign(rig.inputs)
        rig = dataclasses.replace(rig, load_torque=torque)
        case = logs.case(rig, "", 0.0, 1)
        clean = logs.whitened(rig, logs.histories(rig, [rig.p])[0])
        free = logs.whitened(rig, logs.histories(dataclasses.replace(rig, load_torque=None), [rig.p])[0])
        mine = shown(tmp_path / imposed, case)[0]
        assert np.sqrt(np.mean((mine - clean) ** 2)) < 0.3
        assert np.sqrt(np.mean((free - clean) ** 2)) > 3.0


def test_a_brake_on_a_vehicle_is_refused():
    with pytest.raises(UsageError, match=r"load_torque: the robot is a vehicle.*slope_deg or payload"):
        mm.simulate(mm.nominal(), mm.Conditions(load_torque=0.1))
    profile = mm.profile.profile([0.0, 1.0], load_torque=0.1)
    with pytest.raises(UsageError, match="load_torque: the robot is a vehicle"):
        mm.simulate(mm.nominal(), mm.Conditions(), profile=profile)
