"""Outputs of a robot as functions of inputs, for many points at once: values and exact derivatives."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Columns, Names
from calibration.data.contradictions import reason_without_stance
from calibration.data.input_errors import BadConfiguration, stated_word
from mmrjax import derived, fidelities
from mmrjax.compile.compiling import compiled
from mmrjax.fidelities import outputs as table_of_outputs
from mmrjax.fidelities.variation import STATUS, Variation, evaluate_points
from mmrjax.model import channels
from mmrjax.model.conditions import OF_SIDES, Conditions
from mmrjax.model.quantities import Quantity
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES, is_done

#: Points per call, for few and for many points: solves, runs over time, and the derivatives of both. With only these
#: shapes, studies of the same inputs and outputs share compiled programs.
CHUNKS = {"solves": (512, 32_768), "runs": (64, 2_048), "derivatives": (512, 512), "derivatives of runs": (64, 64)}
#: Default outputs, in addition to every channel.
DEFAULT = ("slip", "power_supply", "efficiency_chassis", "steepest_slope")


@dataclasses.dataclass(frozen=True)
class ModelOutputs:
    """Outputs at many points.

    Attributes:
        values: values of each output [SI], NaN if its run did not converge, shape (points,).
        statuses: source (a fidelity, or a module of derived outputs) → status of each point, shape (points,).
    """

    values: Columns
    statuses: Columns


def named_counts(counts: np.ndarray) -> dict[str, int]:
    """Number of points with each status that occurs, from the numbers by code."""
    return {STATUSES[k]: int(n) for k, n in enumerate(counts) if n}


def known_outputs(robot: Robot) -> dict[str, Quantity]:
    """Every output by name: those of a fidelity, then derived ones."""
    return {o.name: o for o in (*table_of_outputs.output_table(robot.channels), *derived.TABLE)}


def default_outputs(robot: Robot, turns: bool) -> Names:
    """Names of the outputs that are studied by default: every channel, and those defined for the robot's load."""
    outputs = known_outputs(robot)
    names = channels.channel_names(robot.channels)
    if turns:
        return (
            *names,
            *(name for name in DEFAULT if outputs[name] not in derived.OF_STRAIGHT),
            derived.OF_TURNS[0].name,
        )
    if not robot.has_ground:
        names = (*names, "power_supply")
    else:  # no slope stalls an imposed speed
        stalls = robot.rig.imposed != "motor_speed"
        names = (*names, *(name for name in DEFAULT if stalls or name != "steepest_slope"))
    return tuple(name for name in names if robot.knows(outputs[name].rests_on))


def chosen_outputs(names_or_groups: Names, robot: Robot, turns: bool = False) -> tuple[Quantity, ...]:
    """Outputs with these names, or the default ones if none is given. `start` stands for all outputs of a start.

    Args:
        turns: True if the robot is free to turn and has instruments for it.

    Raises:
        BadConfiguration: a name is unknown (the message lists the choices). Also if an output needs a ground or
            stance that the robot lacks, or a turn in straight travel, or straight travel in a turn.
    """
    outputs = known_outputs(robot)
    chosen = []
    start_names = tuple(d.name for d in derived.OF_START)
    of_turns = {*(o.name for o in derived.OF_TURNS), *(c.name for c in channels.OF_TURNS if c.settled)}
    for word in names_or_groups or default_outputs(robot, turns):
        for name in start_names if word == "start" else (word,):
            if not turns and name in of_turns and name not in channels.channel_names(robot.channels):
                raise BadConfiguration(
                    f"--outputs {name}: the robot travels straight; drive its sides differently, e.g. --vary "
                    f"{OF_SIDES[0]}=0.2:0.8"
                )
            stated_word(name, [*outputs, "start"], f"--outputs {name}", "no such output")
            if (output := outputs[name]) in derived.OF_GROUND and not robot.has_ground:
                raise BadConfiguration(f"--outputs {name}: the robot's load is a shaft, which has no ground")
            if unstated := robot.unknown(output.rests_on):
                raise BadConfiguration(
                    f"--outputs {name}: not known, as the robot's file does not state {' and '.join(unstated)}"
                )
            if turns and output in derived.OF_STRAIGHT:
                raise BadConfiguration(
                    f"--outputs {word}: only for straight travel, but varied inputs make the robot turn"
                )
            if output in derived.OF_POSTURE and (reason := reason_without_stance(robot)):
                raise BadConfiguration(f"--outputs {name}: {reason}")
            chosen.append(output)
    return tuple(dict.fromkeys(chosen))


@dataclasses.dataclass(frozen=True)
class Model:
    """Outputs of a robot as functions of some of its parameters and conditions.

    Attributes:
        robot: robot with the other parameters.
        columns: names of the parameters and conditions that vary.
        fidelity, options: fidelity of outputs that are not derived, and its options.
        outputs: outputs to compute.
    """

    robot: Robot
    columns: Names
    fidelity: str
    options: Mapping[str, float]
    outputs: tuple[Quantity, ...]

    @property
    def sources(self) -> dict[str, tuple[Quantity, ...]]:
        """Outputs by source: the name of the fidelity, or the module of derived outputs."""
        rows_of_source: dict[str, list[Quantity]] = {}
        for output in self.outputs:
            rows_of_source.setdefault(output.group or self.fidelity, []).append(output)
        return {source: tuple(rows) for source, rows in rows_of_source.items()}

    def chunk(self, source: str, points: int, differentiated: bool = False) -> int:
        """Number of points in one call."""
        is_rollout = source == derived.START or (
            source in fidelities.TABLE and fidelities.fidelity_facts(source).rollout
        )
        kind = (
            ("derivatives of runs" if is_rollout else "derivatives")
            if differentiated
            else "runs"
            if is_rollout
            else "solves"
        )
        few, many = CHUNKS[kind]
        return few if points <= 4 * few else many

    def __call__(self, values: Float[np.ndarray, "points columns"], conditions: Conditions) -> ModelOutputs:
        """Outputs at many points.

        Args:
            values: values of `columns`, one row for each point.
            conditions: conditions that do not vary, shape () or (points,).
        """
        return self.joined({source: self.of_source(source, values, conditions) for source in self.sources})

    def of_source(
        self, source: str, values: Float[np.ndarray, "points columns"], conditions: Conditions
    ) -> ModelOutputs:
        """Outputs of one source, see `sources`."""
        results = self._call_in_chunks(_values, source, values, conditions)
        codes = results.pop(STATUS).astype(int)
        return ModelOutputs(results, {source: codes})

    def joined(self, parts: Mapping[str, ModelOutputs]) -> ModelOutputs:
        """Outputs of all sources, in order."""
        values = {name: x for part in parts.values() for name, x in part.values.items()}
        statuses = {source: codes for part in parts.values() for source, codes in part.statuses.items()}
        return ModelOutputs({o.name: values[o.name] for o in self.outputs}, statuses)

    def ignores(self, source: str) -> Names:
        """Conditions that influence no output of a source."""
        ignored_by_output = [set(o.ignores) for o in self.sources[source]]
        return tuple(sorted(set.intersection(*ignored_by_output)))

    def derivatives(self, values: Float[np.ndarray, "points columns"], conditions: Conditions) -> Columns:
        """Exact derivative of each output with respect to each column [SI per unit], shape (points, columns).

        Zeros for a run without values.
        """
        columns: Columns = {}
        for source in self.sources:
            columns |= self._call_in_chunks(_derivatives, source, values, conditions)
        return {o.name: columns[o.name] for o in self.outputs}

    def _call_in_chunks(
        self, function: Callable[..., dict[str, Array]], source: str, values: np.ndarray, conditions: Conditions
    ) -> Columns:
        """Results of `_values` or `_derivatives` for one source, in chunks of equal size. The last chunk is padded
        with its last point.
        """
        variation = Variation(self.robot, self.columns)
        names = tuple(o.name for o in self.sources[source])
        options = dict(self.options) if source == self.fidelity else {}
        points = len(values)
        chunk_size = self.chunk(source, len(values), differentiated=function is _derivatives)
        is_shared = conditions.shape == ()  # broadcast by the program
        chunks = []
        for first in range(0, points, chunk_size):
            rows = np.minimum(np.arange(first, first + chunk_size), points - 1)
            row_conditions = (
                conditions if is_shared else jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], conditions)
            )
            chunk = function(variation, source, options, names, jnp.asarray(np.asarray(values)[rows]), row_conditions)
            chunks.append({name: np.asarray(x)[: points - first] for name, x in chunk.items()})
        return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}


def _outputs(
    variation: Variation,
    source: str,
    options: dict[str, float],
    names: Names,
    values: Array,
    conditions: Conditions,
) -> dict[str, Array]:
    """Outputs of a source, NaN if the run did not converge, and statuses."""
    if source in fidelities.TABLE:
        results = evaluate_points(variation, source, values, conditions, options, names)
    else:
        conditions = jax.tree.map(lambda x: jnp.broadcast_to(x, values.shape[:1]), conditions)
        compute = derived.compute_function(source)
        every_result = jax.vmap(lambda v, c: compute(*variation.at(v, c)))(values, conditions)
        results = {name: every_result[name] for name in (*names, STATUS)}
    solved = is_done(results[STATUS])
    return {name: x if name == STATUS else jnp.where(solved, x, jnp.nan) for name, x in results.items()}


_values = compiled(_outputs)


@compiled
def _derivatives(
    variation: Variation,
    source: str,
    options: dict[str, float],
    names: Names,
    values: Array,
    conditions: Conditions,
) -> dict[str, Array]:
    """Jacobian of all points. One tangent per column suffices, since outputs of a point depend only on its row."""

    def values_and_status(values: Array) -> tuple[dict[str, Array], Array]:
        results = _outputs(variation, source, options, names, values, conditions)
        status = results.pop(STATUS)
        return results, status

    def derivative_along(direction: Array) -> tuple[dict[str, Array], Array]:
        _, derivative, status = jax.jvp(
            values_and_status, (values,), (jnp.broadcast_to(direction, values.shape),), has_aux=True
        )
        return derivative, status

    derivatives, status = jax.vmap(derivative_along, out_axes=(-1, None))(
        jnp.eye(values.shape[1], dtype=values.dtype)
    )
    return {**derivatives, STATUS: status}
