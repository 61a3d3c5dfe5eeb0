"""Outputs of one climb, such as its margins, and their forward derivatives through the simulation.

The derivatives belong to the computed run, with its contacts opening and closing. They do not include that a
different robot may meet the edge with another grouser. Slopes over a range of each value, from several runs, include
it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.climbing import climb_simulation as climb
from mmrjax.climbing.climb_simulation import (
    OVER,
    RISES,
    SETTLES,
    TURNED_OVER,
    UNFINISHED,
    ClimbRecord,
    ClimbRuns,
    LeverSequence,
)
from mmrjax.climbing.footing import PITCH
from mmrjax.climbing.terrain import Terrain
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar, Scalars
from mmrjax.model.robot import Robot

#: Margins (and instants) within this distance of the smallest one count as well [-].
SMOOTH = 0.05
#: Number of runs for a slope.
BESIDE = 8
#: Outputs of a climb: unit and words. For a robot that gets over, they are computed up to the crest, where its centre
#: of mass passes the obstacle. They do not include its fall after that. Margins are shares.
OUTPUTS: dict[str, tuple[str, str]] = {
    "margin_success": ("-", "smoothed smallest of the four margins, above 0 if it gets over"),
    "margin_reach": (
        "-",
        "distance of its centre of mass past the obstacle, over half the wheelbase, 1 if over",
    ),
    "margin_upright": ("-", "margin to the tipping pitch, of that pitch"),
    "margin_grip": ("-", "unused share of the ground's friction limit"),
    "margin_torque": ("-", "unused share of the traction motors' stall torque"),
    "crest_time_s": ("s", "time to the crest, or to the verdict"),
    "crest_energy_J": ("J", "energy of all motors until then"),
    "crest_current_rms_A": ("A", "rms current of each traction motor until then"),
    "crest_current_most_A": ("A", "largest current of each traction motor until then"),
    "crest_front_current_most_A": ("A", "largest current of the front levers' motor"),
    "crest_rear_current_most_A": ("A", "largest current of the rear levers' motor"),
}


class ClimbInputs(NamedTuple):
    """Inputs of one climb. Fields have no batch axis."""

    robot: Robot
    conditions: Conditions
    terrain: Terrain
    sequence: LeverSequence


def smooth_minimum(values: Float[Array, " n"]) -> Scalar:
    """Smooth minimum of values, -τ log mean exp(-x / τ) with τ = `SMOOTH`. It lies between their minimum and mean."""
    lowest = jax.lax.stop_gradient(jnp.min(values))
    return lowest - SMOOTH * jnp.log(jnp.mean(jnp.exp(-(values - lowest) / SMOOTH)))


def crest_sample(terrain: Terrain, record: ClimbRecord, over: bool) -> int | None:
    """First sample whose centre of mass is past the obstacle. None if the robot does not get over it."""
    return int(jnp.argmax(record.centre > terrain.finish)) if over else None


def climb_outputs(robot: Robot, terrain: Terrain, record: ClimbRecord, crest: int | None) -> Scalars:
    """`OUTPUTS` of a climb until its verdict, from a record of shape (samples,)."""
    reach = jnp.asarray((record.centre - terrain.finish) / (robot.running_gear.wheelbase / 2))
    # the crest is between two samples
    share = jnp.ones(()) if crest is None else -reach[crest - 1] / (reach[crest] - reach[crest - 1])
    record_to_crest: ClimbRecord = jax.tree.map(lambda x: x[: None if crest is None else crest + 1], record)

    def at_crest(x: Scalar) -> Scalar:
        x = jnp.asarray(x)
        return x[-2] + share * (x[-1] - x[-2])

    is_powered = record_to_crest.time >= SETTLES + RISES
    stall = robot.motor.current_stall(jnp.where(is_powered, record_to_crest.voltage, 1.0))
    margins = {
        "margin_reach": reach[-1] if crest is None else jnp.ones(()),
        "margin_upright": smooth_minimum(1 - jnp.abs(record_to_crest.motion.q[:, PITCH]) / TURNED_OVER),
        "margin_grip": smooth_minimum(jnp.asarray(1 - record_to_crest.grip)),
        "margin_torque": smooth_minimum(1 - jnp.where(is_powered, record_to_crest.current, 0.0) / stall),
    }
    lever_currents = jnp.max(jnp.abs(record_to_crest.lever_current), axis=0)
    return {
        "margin_success": smooth_minimum(jnp.stack(list(margins.values()))),
        **margins,
        "crest_time_s": at_crest(record_to_crest.time),
        "crest_energy_J": at_crest(record_to_crest.energy["supply"] + record_to_crest.energy["levers"]),
        "crest_current_rms_A": jnp.sqrt(jnp.mean(record_to_crest.current**2)),
        "crest_current_most_A": jnp.max(jnp.abs(record_to_crest.current)),
        "crest_front_current_most_A": lever_currents[0],
        "crest_rear_current_most_A": lever_currents[1],
    }


class ClimbDerivatives(NamedTuple):
    """Outputs of a climb by name (see `OUTPUTS`), and their derivatives.

    Attributes:
        climb: the simulated climb.
        outputs: outputs of the climb.
        derivatives: derivatives of the outputs, of shape (values,).
        slope, slope_sd: slopes of straight lines through `BESIDE` runs along each value, and their standard
            deviations.
    """

    climb: ClimbRuns
    outputs: dict[str, float]
    derivatives: dict[str, Float[np.ndarray, " values"]]
    slope: dict[str, Float[np.ndarray, " values"]]
    slope_sd: dict[str, Float[np.ndarray, " values"]]


def climb_derivatives(
    inputs_of: Callable[[Float[Array, " values"]], ClimbInputs],
    values: Float[Array, " values"],
    widths: Float[Array, " values"],
    *,
    duration: float = climb.DURATION,
    step: float = climb.STEP,
    sample: float = climb.SAMPLE,
    part: float = 1.0,
    progress: Callable[[float], None] | None = None,
) -> ClimbDerivatives:
    """Outputs of one climb, their derivatives with respect to `values`, and slopes over `widths` to both sides.

    `inputs_of` returns robot, conditions, terrain and sequence for given values. The other arguments are as in
    `climb_batch`.
    """
    directions = jnp.eye(len(values))
    parts, samples, steps = climb.divide_run(duration, step, sample, part)
    interval = jnp.asarray(step, float)
    steps_per_sample = jnp.asarray(steps)
    run, run_derivatives = _value_and_derivatives_along(inputs_of, values, directions)

    def begin(run: ClimbInputs) -> Any:
        return climb.begin_climb(climb.build_climb_system(*run, interval))

    state, state_derivatives = _value_and_derivatives_along(begin, run, run_derivatives)
    records: list[Any] = []
    for k in range(parts):
        first_time = jnp.asarray(k * samples * steps * step)
        (state, record), (state_derivatives, record_derivatives) = _advance_part(
            (run, state), (run_derivatives, state_derivatives), first_time, interval, steps_per_sample, samples
        )
        records.append(jax.device_get((record, record_derivatives)))
        if progress is not None:
            progress((k + 1) / parts / 2)
        if state[2].verdict >= 0:
            break
    record = jax.tree.map(lambda *x: jnp.concatenate(x), *[r for r, _ in records])
    record_derivatives = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *[c for _, c in records])
    verdict = int(state[2].verdict)
    end_time = state[2].ended
    final_values = UNFINISHED if verdict < 0 else verdict, end_time, state[2].furthest
    all_runs = ClimbRuns(*jax.tree.map(lambda x: np.asarray(x)[None], (*final_values, record)))
    run_record = jax.tree.map(jnp.asarray, all_runs.run(0))
    count = len(run_record.time)
    crest = crest_sample(run.terrain, run_record, verdict == OVER)
    outputs, derivatives = _value_and_derivatives_along(
        lambda run_and_record: climb_outputs(
            run_and_record[0].robot, run_and_record[0].terrain, run_and_record[1], crest
        ),
        (run, run_record),
        (run_derivatives, jax.tree.map(lambda x: x[:, :count], record_derivatives)),
    )
    offsets = np.linspace(-1, 1, BESIDE)
    nearby_values = jnp.concatenate([values + np.outer(offsets, unit * widths) for unit in directions])
    nearby_inputs = jax.vmap(inputs_of)(nearby_values)
    batch = climb.climb_batch(
        *nearby_inputs, duration=duration, step=step, sample=sample, part=part,
        progress=None if progress is None else lambda share: progress((1 + share) / 2),
    )  # fmt: skip
    nearby_robots = (
        jax.tree.map(lambda x, k=k: x[k], (nearby_inputs.robot, nearby_inputs.terrain))
        for k in range(len(nearby_values))
    )
    nearby_outputs = [outputs_of_run(robot, terrain, batch, k) for k, (robot, terrain) in enumerate(nearby_robots)]
    slope, slope_sd = {}, {}
    for name in outputs:
        y = np.array([float(nearby[name]) for nearby in nearby_outputs]).reshape(-1, BESIDE)
        square = np.sum(offsets**2)
        deviations = y - y.mean(axis=1, keepdims=True)
        rise = deviations @ offsets / square
        residuals = deviations - np.outer(rise, offsets)
        slope[name] = rise / np.asarray(widths)
        slope_sd[name] = np.sqrt(np.sum(residuals**2, axis=1) / (BESIDE - 2) / square) / np.asarray(widths)
    return ClimbDerivatives(
        all_runs,
        {name: float(x) for name, x in outputs.items()},
        {name: np.asarray(x) for name, x in derivatives.items()},
        slope,
        slope_sd,
    )


def outputs_of_run(robot: Robot, terrain: Terrain, runs: ClimbRuns, k: int) -> Scalars:
    """`OUTPUTS` of run `k` of a batch."""
    record = jax.tree.map(jnp.asarray, runs.run(k))
    return climb_outputs(robot, terrain, record, crest_sample(terrain, record, bool(runs.verdict[k] == OVER)))


def _value_and_derivatives_along(function: Callable[[Any], Any], point: Any, directions: Any) -> tuple[Any, Any]:
    """Value of a function and its derivatives along `directions`. Leaves have a first axis (None: zero)."""
    numbers, static_parts = eqx.partition(point, eqx.is_inexact_array)
    static_outputs: list[Any] = []

    def derivative_along(direction: Any) -> tuple[Any, Any, Any]:
        def function_of_numbers(numbers: Any) -> tuple[Any, Any]:
            numeric, other_leaves = eqx.partition(function(eqx.combine(numbers, static_parts)), eqx.is_inexact_array)
            arrays, static_part = eqx.partition(other_leaves, eqx.is_array)
            static_outputs.append(static_part)
            return numeric, arrays

        return jax.jvp(function_of_numbers, (numbers,), (direction,), has_aux=True)

    values, derivatives, arrays = jax.vmap(derivative_along, out_axes=(None, 0, None))(directions)
    return eqx.combine(values, arrays, static_outputs[-1]), derivatives


@functools.partial(compiled, options=SELDOM)
def _advance_part(point: Any, directions: Any, first: Scalar, step: Scalar, steps: Scalar, samples: int) -> Any:
    def advance(point: tuple[ClimbInputs, Any]) -> Any:
        run, state = point
        return climb.advance_samples(climb.build_climb_system(*run, step), state, first, steps, samples)

    return _value_and_derivatives_along(advance, point, directions)
