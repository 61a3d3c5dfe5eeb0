"""Changes of a simulated run's readings by errors of balances and by effects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from calibration.inference import linearization
from calibration.inference.linearization import ScoredEffect
from mmrjax.effects import Effect
from mmrjax.fidelities.drive import drive_rates, moving, state_of_unknowns
from mmrjax.fidelities.histories import (
    LinearisedRun,
    RunStep,
    first_conditions_and_state,
    run_response,
    run_steps,
    signals_of_instant,
)
from mmrjax.fidelities.rest import HELD
from mmrjax.model import balances, channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.elementary import value_and_slope


def sensor_readings(robot: Robot, signals: Signals) -> Array:
    """Readings of all channels at one instant, shape (channels,)."""
    by_name = balances.sensor(robot, signals)
    return jnp.stack([by_name[name] for name in channels.channel_names(robot.channels)], -1)


def changes_of_run(
    robot: Robot, probes: tuple[Effect, ...], effects: tuple[ScoredEffect, ...], *, kind: Any, delayed: bool
) -> Callable[[Conditions, Array, Array, LinearisedRun, Array, Array], tuple[Array, Array]]:
    """Function of a run that returns two changes of its readings.

    The first is by an error of the balance of each probe at each knot, shape (probes, knots, samples, channels). The
    second is by each effect, shape (samples, channels, instances). The function takes the conditions of the run, the
    times of its knots [s], and the index of the instant of each sample. Its other arguments are the simulated run,
    the times of its instants, and the times of its samples [s].

    Args:
        kind: type of the numbers.
        delayed: True if readings are delayed.
    """
    requested, size = [p.balance for p in probes], len(probes)
    others = dict.fromkeys(e.effect.balance for e in effects if e.effect.balance not in ("sensor", *requested))
    all_probes = (*probes, *map(linearization.balance_probe, others))
    places, none = [*requested, *others], jnp.zeros(len(all_probes))
    instances = [e.effect for e in effects for _ in e.at]
    # Index of the probe of each instance's balance, and 1 if there is one; 1 if it is an error of a channel.
    entering = np.array([places.index(e.balance) if e.balance in places else 0 for e in instances], int)
    enters = np.array([1.0 * (e.balance in places) for e in instances])
    names = channels.channel_names(robot.channels)
    at_sensor = np.array([[e.channel == c for e in instances] for c in names], float)
    effects = tuple(linearization.with_shape_of_robot(robot, e) for e in effects)

    def probed(amplitude: Array) -> Robot:
        return linearization.with_probes(robot, all_probes, amplitude)

    def of_run(
        conditions: Conditions, clock: Array, instants: Array, along: LinearisedRun, times: Array, time: Array
    ) -> tuple[Array, Array]:
        remembered, hat = _memory_along_run(robot, conditions, along, effects), _hat_functions(clock)
        wide = size * len(clock)

        def terms(t: Array, y: Array, held: Conditions, way: Array | None = None) -> Array:
            signals = moving(robot, held, state_of_unknowns(robot, y), way)
            return linearization.effect_terms(robot, signals, effects, remembered(t))

        def both(by_probes: Array, t: Array, term: Array) -> Array:
            """Changes by defects at all knots and by each instance, from the change by each probe."""
            knots = (by_probes[:, :size, None] * hat(t)).reshape(len(by_probes), -1)
            return jnp.concatenate([knots, by_probes[:, entering] * (enters * term)], 1)

        def source(t: Array, y: Array, held: Conditions, way: Array) -> Array:
            by_probes = jax.jacfwd(lambda a: drive_rates(probed(a), held, y, way))(none)
            return both(by_probes, t, terms(t, y, held, way))

        def seen(t: Array, y: Array, dy: Array, held: Conditions) -> Array:
            """Changes through the state, and immediate ones: with an imposed speed, current follows from torque."""

            def reading(y: Array, amplitude: Array) -> Array:
                if held.held is not None:
                    return sensor_readings(robot, signals_of_instant(probed(amplitude), held, y, HELD * held.held))
                return sensor_readings(robot, moving(probed(amplitude), held, state_of_unknowns(robot, y)))

            by_state, at_once = jax.jacfwd(reading, (0, 1))(y, none)
            term = terms(t, y, held)
            shows = jnp.concatenate([jnp.zeros((len(by_state), wide)), at_sensor * term], 1)
            return (by_state @ dy + both(at_once, t, term) + shows).astype(kind)

        first, begins = first_conditions_and_state(robot, conditions)
        by_probes = jax.jacfwd(lambda a: first_conditions_and_state(probed(a), conditions)[1])(none)
        begin_changes = by_probes[:, entering] * (enters * terms(clock[0], begins, first))
        unmoved = jnp.concatenate([jnp.zeros((len(begins), wide)), begin_changes], 1)
        changed = run_response(conditions, along, source, seen, unmoved)
        at_begin = seen(clock[0], begins, unmoved, first)
        knots = jnp.where(instants[:, None, None] > 0, changed[instants - 1, :, :wide], at_begin[:, :wide])
        knots = knots.reshape(len(instants), -1, size, len(clock))
        by_effects = jnp.concatenate([at_begin[None, :, wide:], changed[:, :, wide:]])
        if delayed:
            step, share = robot.rig.before(times, time)
            by_effects = by_effects[step] + share[:, None, None] * (by_effects[step + 1] - by_effects[step])
        else:
            by_effects = by_effects[instants]
        return knots.transpose(2, 3, 0, 1), by_effects

    return of_run


def _hat_functions(clock: Array) -> Callable[[Array], Array]:
    """Function of time that returns the hat function of each knot, shape (knots,).

    A hat is 1 at its knot and falls linearly to 0 at the neighbouring knots.
    """
    # A run that ended early repeats its last knot; only the first of these has a hat.
    real = jnp.concatenate([jnp.ones(1), (jnp.diff(clock) > 0).astype(clock.dtype)])
    before = jnp.concatenate([clock[:1], clock[:-1]])
    after = jnp.concatenate([clock[1:], clock[-1:] + 1.0])

    def hats(t: Array) -> Array:
        rising = ((t - before) / jnp.maximum(clock - before, 1e-12)).at[0].set(1.0)
        falling = jnp.where(after > clock, (after - t) / jnp.where(after > clock, after - clock, 1.0), 1.0)
        return real * jnp.clip(jnp.minimum(rising, falling), 0.0, 1.0)

    return hats


def _memory_along_run(
    robot: Robot, conditions: Conditions, along: LinearisedRun, effects: tuple[ScoredEffect, ...]
) -> Callable[[Array], list[Array]]:
    """Function of time that returns the memory of each effect along a simulated run, at each point of its grid.

    It follows the stages of the run (`histories.linearise_run`). The rate of a memory is linear, or nearly so, in the
    memory.
    """
    remembering = [e for e in effects if e.effect.memory_size is not None]
    no_memory = [jnp.zeros(len(e.at)) for e in effects]
    if not remembering:
        return lambda t: no_memory
    ends = np.cumsum([len(e.at) for e in remembering])[:-1]

    def rates(y: Array, held: Conditions, way: Array, memory: Array) -> Array:
        signals = moving(robot, held, state_of_unknowns(robot, y), way)
        parts = zip(remembering, jnp.split(memory, ends), strict=True)
        return jnp.concatenate([linearization.memory_rates(robot, e, signals, m) for e, m in parts])

    steps, constant = run_steps(conditions, jnp.append(along.clock[:, 0], along.clock[-1, 2]))

    def after(memory: Array, step: tuple[LinearisedRun, RunStep]) -> tuple[Array, Array]:
        run, run_step = step
        held, spans = run_step.all_conditions(constant), jnp.diff(run.clock)

        def stage(memory: Array, span: Array, k: int) -> Array:
            rate, slope = value_and_slope(lambda m: rates(run.stage_unknowns[k], held, run.directions[k], m), memory)
            return memory + span * rate / (1 - span * slope)

        first = stage(memory, spans[0], 0)
        step_ratio = jnp.where(run.passes, 1.0, spans[1] / jnp.where(spans[0] > 0, spans[0], 1.0))
        span = jnp.where(run.passes, spans[1], spans[0])
        last = stage(memory + step_ratio * (first - memory), span, 1)
        return last, jnp.stack([first, last])

    begin = first_conditions_and_state(robot, conditions)[1]
    angle = state_of_unknowns(robot, begin).distance / robot.chassis(conditions.configuration).radius
    at_begin = jnp.concatenate([linearization.initial_memory(robot, e, angle) for e in remembering])
    stages = jax.lax.scan(after, at_begin, (along, steps))[1]
    nodes = jnp.concatenate([at_begin[None], stages.reshape(-1, len(at_begin))])
    clock = jnp.append(along.clock[0, 0], along.clock[:, 1:].ravel())

    def at_time(t: Array) -> list[Array]:
        k = jnp.clip(jnp.searchsorted(clock, t, side="right") - 1, 0, len(clock) - 2)
        length = clock[k + 1] - clock[k]
        share = jnp.clip(jnp.where(length > 0, (t - clock[k]) / jnp.where(length > 0, length, 1.0), 0.0), 0.0, 1.0)
        parts = iter(jnp.split(nodes[k] + share * (nodes[k + 1] - nodes[k]), ends))
        return [
            zero if e.effect.memory_size is None else next(parts) for e, zero in zip(effects, no_memory, strict=True)
        ]

    return at_time
