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
    robot: Robot, probes: tuple[Effect, ...], effects: tuple[ScoredEffect, ...], *, number_type: Any, delayed: bool
) -> Callable[[Conditions, Array, Array, LinearisedRun, Array, Array], tuple[Array, Array]]:
    """Function of a run that returns two changes of its readings.

    The first is by an error of the balance of each probe at each knot, shape (probes, knots, samples, channels). The
    second is by each effect, shape (samples, channels, instances). The function takes the conditions of the run, the
    times of its knots [s], and the index of the instant of each sample. Its other arguments are the simulated run,
    the times of its instants, and the times of its samples [s].

    Args:
        number_type: type of the numbers.
        delayed: True if readings are delayed.
    """
    probed_balances = [p.balance for p in probes]
    size = len(probes)
    other_balances = dict.fromkeys(
        e.effect.balance for e in effects if e.effect.balance not in ("sensor", *probed_balances)
    )
    all_probes = (*probes, *map(linearization.balance_probe, other_balances))
    balances_changed = [*probed_balances, *other_balances]
    none = jnp.zeros(len(all_probes))
    instances = [e.effect for e in effects for _ in e.at]
    # Index of the probe of each instance's balance, and 1 if there is one; 1 if it is an error of a channel.
    probe_of_instance = np.array(
        [balances_changed.index(e.balance) if e.balance in balances_changed else 0 for e in instances], int
    )
    has_probe = np.array([1.0 * (e.balance in balances_changed) for e in instances])
    names = channels.channel_names(robot.channels)
    at_sensor = np.array([[e.channel == c for e in instances] for c in names], float)
    effects = tuple(linearization.with_shape_of_robot(robot, e) for e in effects)

    def probed(amplitude: Array) -> Robot:
        return linearization.with_probes(robot, all_probes, amplitude)

    def of_run(
        conditions: Conditions,
        knot_times: Array,
        instants: Array,
        simulated_run: LinearisedRun,
        times: Array,
        time: Array,
    ) -> tuple[Array, Array]:
        memory_at = _memory_along_run(robot, conditions, simulated_run, effects)
        hat_at = _hat_functions(knot_times)
        knot_columns = size * len(knot_times)

        def terms(t: Array, y: Array, conditions_of_step: Conditions, way: Array | None = None) -> Array:
            signals = moving(robot, conditions_of_step, state_of_unknowns(robot, y), way)
            return linearization.effect_terms(robot, signals, effects, memory_at(t))

        def changes_of_knots_and_effects(by_probes: Array, t: Array, term: Array) -> Array:
            """Changes by defects at all knots and by each instance, from the change by each probe."""
            knots = (by_probes[:, :size, None] * hat_at(t)).reshape(len(by_probes), -1)
            return jnp.concatenate([knots, by_probes[:, probe_of_instance] * (has_probe * term)], 1)

        def source(t: Array, y: Array, conditions_of_step: Conditions, way: Array) -> Array:
            by_probes = jax.jacfwd(lambda a: drive_rates(probed(a), conditions_of_step, y, way))(none)
            return changes_of_knots_and_effects(by_probes, t, terms(t, y, conditions_of_step, way))

        def changes_of_readings(t: Array, y: Array, dy: Array, conditions_of_step: Conditions) -> Array:
            """Changes through the state, and immediate ones: with an imposed speed, current follows from torque."""

            def reading(y: Array, amplitude: Array) -> Array:
                if conditions_of_step.held is not None:
                    return sensor_readings(
                        robot,
                        signals_of_instant(probed(amplitude), conditions_of_step, y, HELD * conditions_of_step.held),
                    )
                return sensor_readings(
                    robot, moving(probed(amplitude), conditions_of_step, state_of_unknowns(robot, y))
                )

            by_state, immediate = jax.jacfwd(reading, (0, 1))(y, none)
            term = terms(t, y, conditions_of_step)
            channel_errors = jnp.concatenate([jnp.zeros((len(by_state), knot_columns)), at_sensor * term], 1)
            return (by_state @ dy + changes_of_knots_and_effects(immediate, t, term) + channel_errors).astype(
                number_type
            )

        first_conditions, initial_state = first_conditions_and_state(robot, conditions)
        by_probes = jax.jacfwd(lambda a: first_conditions_and_state(probed(a), conditions)[1])(none)
        begin_changes = by_probes[:, probe_of_instance] * (
            has_probe * terms(knot_times[0], initial_state, first_conditions)
        )
        initial_changes = jnp.concatenate([jnp.zeros((len(initial_state), knot_columns)), begin_changes], 1)
        changes_over_time = run_response(conditions, simulated_run, source, changes_of_readings, initial_changes)
        at_begin = changes_of_readings(knot_times[0], initial_state, initial_changes, first_conditions)
        knots = jnp.where(
            instants[:, None, None] > 0, changes_over_time[instants - 1, :, :knot_columns], at_begin[:, :knot_columns]
        )
        knots = knots.reshape(len(instants), -1, size, len(knot_times))
        by_effects = jnp.concatenate([at_begin[None, :, knot_columns:], changes_over_time[:, :, knot_columns:]])
        if delayed:
            step, share = robot.rig.before(times, time)
            by_effects = by_effects[step] + share[:, None, None] * (by_effects[step + 1] - by_effects[step])
        else:
            by_effects = by_effects[instants]
        return knots.transpose(2, 3, 0, 1), by_effects

    return of_run


def _hat_functions(knot_times: Array) -> Callable[[Array], Array]:
    """Function of time that returns the hat function of each knot, shape (knots,).

    A hat is 1 at its knot and falls linearly to 0 at the neighbouring knots.
    """
    # A run that ended early repeats its last knot; only the first of these has a hat.
    is_distinct = jnp.concatenate([jnp.ones(1), (jnp.diff(knot_times) > 0).astype(knot_times.dtype)])
    before = jnp.concatenate([knot_times[:1], knot_times[:-1]])
    after = jnp.concatenate([knot_times[1:], knot_times[-1:] + 1.0])

    def hats(t: Array) -> Array:
        rising = ((t - before) / jnp.maximum(knot_times - before, 1e-12)).at[0].set(1.0)
        falling = jnp.where(
            after > knot_times, (after - t) / jnp.where(after > knot_times, after - knot_times, 1.0), 1.0
        )
        return is_distinct * jnp.clip(jnp.minimum(rising, falling), 0.0, 1.0)

    return hats


def _memory_along_run(
    robot: Robot, conditions: Conditions, simulated_run: LinearisedRun, effects: tuple[ScoredEffect, ...]
) -> Callable[[Array], list[Array]]:
    """Function of time that returns the memory of each effect along a simulated run, at each point of its grid.

    It follows the stages of the run (`histories.linearise_run`). The rate of a memory is linear, or nearly so, in the
    memory.
    """
    effects_with_memory = [e for e in effects if e.effect.memory_size is not None]
    no_memory = [jnp.zeros(len(e.at)) for e in effects]
    if not effects_with_memory:
        return lambda t: no_memory
    ends = np.cumsum([len(e.at) for e in effects_with_memory])[:-1]

    def rates(y: Array, conditions_of_step: Conditions, direction: Array, memory: Array) -> Array:
        signals = moving(robot, conditions_of_step, state_of_unknowns(robot, y), direction)
        parts = zip(effects_with_memory, jnp.split(memory, ends), strict=True)
        return jnp.concatenate([linearization.memory_rates(robot, e, signals, m) for e, m in parts])

    steps, constant = run_steps(conditions, jnp.append(simulated_run.clock[:, 0], simulated_run.clock[-1, 2]))

    def advance(memory: Array, step: tuple[LinearisedRun, RunStep]) -> tuple[Array, Array]:
        stages, run_step = step
        conditions_of_step = run_step.all_conditions(constant)
        spans = jnp.diff(stages.clock)

        def stage(memory: Array, span: Array, k: int) -> Array:
            rate, slope = value_and_slope(
                lambda m: rates(stages.stage_unknowns[k], conditions_of_step, stages.directions[k], m), memory
            )
            return memory + span * rate / (1 - span * slope)

        first = stage(memory, spans[0], 0)
        step_ratio = jnp.where(stages.passes, 1.0, spans[1] / jnp.where(spans[0] > 0, spans[0], 1.0))
        span = jnp.where(stages.passes, spans[1], spans[0])
        last = stage(memory + step_ratio * (first - memory), span, 1)
        return last, jnp.stack([first, last])

    begin = first_conditions_and_state(robot, conditions)[1]
    angle = state_of_unknowns(robot, begin).distance / robot.chassis(conditions.configuration).radius
    at_begin = jnp.concatenate([linearization.initial_memory(robot, e, angle) for e in effects_with_memory])
    memory_of_stages = jax.lax.scan(advance, at_begin, (simulated_run, steps))[1]
    nodes = jnp.concatenate([at_begin[None], memory_of_stages.reshape(-1, len(at_begin))])
    node_times = jnp.append(simulated_run.clock[0, 0], simulated_run.clock[:, 1:].ravel())

    def at_time(t: Array) -> list[Array]:
        k = jnp.clip(jnp.searchsorted(node_times, t, side="right") - 1, 0, len(node_times) - 2)
        length = node_times[k + 1] - node_times[k]
        share = jnp.clip(
            jnp.where(length > 0, (t - node_times[k]) / jnp.where(length > 0, length, 1.0), 0.0), 0.0, 1.0
        )
        parts = iter(jnp.split(nodes[k] + share * (nodes[k + 1] - nodes[k]), ends))
        return [
            zero if e.effect.memory_size is None else next(parts) for e, zero in zip(effects, no_memory, strict=True)
        ]

    return at_time
