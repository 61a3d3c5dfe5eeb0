"""Variation over many points: parameters of a robot and conditions by name, and the outputs of each point."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax import fidelities
from mmrjax.compile.compiling import compiled
from mmrjax.errors import UsageError, allowed_words
from mmrjax.fidelities import outputs as table_of_outputs
from mmrjax.fidelities.base import RunBatch
from mmrjax.missions.profile import Profile
from mmrjax.model import params, quantities
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import Names
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CODES

#: Every condition of a run in words; `configuration` is an index into the robot's.
CONDITIONS: dict[str, str] = {
    "configuration": "configuration of the chassis",
    **{field: condition.label for field, condition in quantities.CONDITIONS.items()},
}
#: Further outputs of every point: code into `signals.STATUSES`, bit mask over `signals.FLAGS`.
STATUS, FLAGS = CODES


@dataclasses.dataclass(frozen=True)
class Axis:
    """A parameter or condition that varies.

    Attributes:
        name: dotted parameter, or condition.
        unit: unit of its values.
        meaning: meaning in words.
        bounds: least and greatest value allowed [unit].
        value: the robot's, or the default of a condition [unit]. None: the robot's own mass plus the payload.
        prior_sd: standard deviation of the parameter's prior around `value` [unit], None for a condition.
        spec: specification of the parameter's field, None for a condition.
    """

    name: str
    unit: str
    meaning: str
    bounds: tuple[float, float]
    value: float | None
    prior_sd: float | None = None
    spec: params.Spec | None = None


class Variation(eqx.Module):
    """A robot with some parameters and conditions that take other values at each point.

    Attributes:
        robot: common start of all points.
        names: names of what varies: dotted parameters as in `params.walk_parameters`, or conditions (`CONDITIONS`).

    Raises:
        UsageError: an unknown name, or a name stated twice. The message suggests similar ones.
    """

    robot: Robot
    names: Names = eqx.field(static=True)

    def __init__(self, robot: Robot, names: Names) -> None:
        allowed = variable_names(robot)
        for k, name in enumerate(names):
            if name not in allowed:
                raise UsageError(
                    f"{name}: neither a parameter of the robot nor a condition; {allowed_words(name, allowed, 3)}"
                )
            if name in names[:k]:
                raise UsageError(f"{name}: stated twice; expected each name once")
        self.robot, self.names = params.without_weak_types(robot), tuple(names)

    @property
    def axes(self) -> dict[str, Axis]:
        """Properties of each name that varies, in order."""
        parameters = params.parameters_by_name(self.robot)
        return {name: self._axis(name, parameters.get(name)) for name in self.names}

    def _axis(self, name: str, parameter: params.Parameter | None) -> Axis:
        if parameter is not None:
            spec = parameter.spec
            value = float(parameter.value)
            return Axis(name, spec.unit, spec.meaning, spec.bounds, value, spec.prior_sd(value), spec)
        if name == "configuration":
            return Axis(name, "", CONDITIONS[name], (0.0, len(self.robot.configurations) - 1.0), 0.0)
        condition = quantities.CONDITIONS[name]
        default = getattr(Conditions(), name)
        default_value = None if default is None else float(default)
        return Axis(name, condition.unit_shown, condition.label, condition.range, default_value)

    @property
    def varies_robot(self) -> bool:
        """True if some name is a parameter of the robot."""
        return any(name not in CONDITIONS for name in self.names)

    def at(self, values: Float[Array, "... names"], conditions: Conditions) -> tuple[Robot, Conditions]:
        """The robot and the conditions of a point, or of a batch. The leaves that vary have the shape of the batch.

        Args:
            values: values in the order of `names`, in the axes' units. `configuration` is an index, rounded.
            conditions: values of the other conditions, names of configurations resolved.
        """
        values_by_name: dict[str, Any] = {name: values[..., k] for k, name in enumerate(self.names)}
        condition_values = {name: values_by_name.pop(name) for name in self.names if name in CONDITIONS}
        if "configuration" in condition_values:
            condition_values["configuration"] = jnp.round(condition_values["configuration"]).astype(int)
        robot = params.replace(self.robot, values_by_name) if values_by_name else self.robot
        return robot, replace(conditions, **condition_values)


def variable_names(robot: Robot) -> Names:
    """Every name that may vary: conditions, then the robot's parameters."""
    return (*CONDITIONS, *(p.name for p in params.walk_parameters(robot)))


def evaluate_points(
    variation: Variation,
    fidelity: str,
    values: Float[Array, "points names"],
    conditions: Conditions,
    options: Mapping[str, float],
    outputs: Names,
    profile: Profile | None = None,
) -> dict[str, Array]:
    """Outputs of many points in one call, compiled once for each number of points.

    Traceable. Parts that do not vary are arguments of the compiled program, not constants in it.

    Args:
        fidelity: one of `fidelities.NAMES`.
        options: all of its options, from `FidelityFacts.resolved`.
        values: one row per point, in the order of `variation.names`.
        conditions: the other conditions, of shape () or (points,), names of configurations resolved.
        outputs: names of `outputs.output_table`, or of columns that the fidelity adds, also `flags`. Over a profile
            columns of `missions.OUTPUTS`.
        profile: a mission that every point follows, with the fidelity `missions.MODEL`, fields of shape (rows,).

    Returns:
        By name in SI units (a fidelity's own column in its unit), and `status`, arrays of shape (points,).

    Raises:
        UsageError: an output that the fidelity does not have.
    """
    evaluated = _evaluate(variation, fidelity, values, conditions, dict(options), tuple(outputs), profile)
    return {name: evaluated[name] for name in (*outputs, STATUS)}  # jit sorts the names


@compiled
def _evaluate(
    variation: Variation,
    fidelity: str,
    values: Array,
    conditions: Conditions,
    options: dict[str, float],
    names: Names,
    profile: Profile | None,
) -> dict[str, Array]:
    (points, _) = values.shape
    conditions = jax.tree.map(lambda x: jnp.broadcast_to(x, (points,)), conditions)
    channels = variation.robot.channels
    if profile is None and fidelity == "steady":
        from mmrjax.fidelities.steady import steady_outputs

        _check_names(names, table_of_outputs.output_names(channels))
        robot, point_conditions = variation.at(values, conditions)
        point_conditions = jax.tree.map(lambda x: jnp.broadcast_to(x, (points,)), point_conditions)
        return steady_outputs(robot, point_conditions, (*names, STATUS))

    def simulate(robot: Robot, conditions: Conditions) -> RunBatch:
        if profile is not None:
            from mmrjax.missions import mission_batch

            return mission_batch.run_missions(robot, conditions, profile)
        return fidelities.get_fidelity(fidelity).run(robot, conditions, options)

    if not variation.varies_robot:
        return pick_outputs(simulate(*variation.at(values, conditions)), channels, names)

    def evaluate_point(values: Array, conditions: Conditions) -> RunBatch:
        robot, point = variation.at(values, conditions)
        run = simulate(robot, jax.tree.map(lambda x: x[None], point))
        return jax.tree.map(lambda x: x[0], run)

    return pick_outputs(jax.vmap(evaluate_point)(values, conditions), channels, names)


def pick_outputs(run: RunBatch, channels: tuple[Channel, ...], names: Names) -> dict[str, Array]:
    """Outputs of a batch by name, as from `evaluate_points`, of a rig with these channels."""
    allowed = table_of_outputs.output_names(channels)
    _check_names(names, (*allowed, *run.columns))
    columns = {
        name: getattr(run.result, name) if name in allowed else run.columns[name] for name in names if name != FLAGS
    }
    further = {FLAGS: run.result.flags} if FLAGS in names else {}
    return {**columns, **further, STATUS: run.result.status}


def _check_names(names: Names, allowed: Names) -> None:
    for name in names:
        if name not in allowed and name != FLAGS:
            raise UsageError(f"outputs: got {name}; {allowed_words(name, (*allowed, FLAGS), 3)}")
