"""Uncertain inputs of a study: their names and distributions, and their values as functions of scores."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from calibration.data import Names
from calibration.data.input_errors import BadConfiguration, stated_word
from calibration.data.posterior_file import Posterior
from calibration.inference import priors
from calibration.inference.identifiability import posterior_of_coordinates
from mmrjax import fidelities
from mmrjax.errors import UsageError
from mmrjax.fidelities.variation import CONDITIONS, Axis, Variation
from mmrjax.model import params
from mmrjax.model.robot import Robot

#: Smallest distance from the ends of the unit interval, which limits normal scores to 6 sds.
EDGE = 1e-9

#: Distribution without parameters.
NO_PARAMETERS = Posterior(
    coordinates=(), units=(), mean=np.zeros(0), covariance=np.zeros((0, 0)), location=np.zeros(0), spread=np.zeros(0),
    low=np.zeros(0), high=np.zeros(0), softness=np.zeros(0), kinds=(),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class UncertainInputs:
    """Uncertain inputs: parameters, normal in their coordinates, and conditions, uniform in their ranges.

    Attributes:
        parameters: distribution of the parameters. They are independent unless from a posterior.
        low, high: ranges of the conditions [own units].
        conditions: names of the conditions.
        axes: properties of each input, by name.
        is_posterior: True for the correlated parameters of a fit.
    """

    parameters: Posterior
    conditions: Names
    low: np.ndarray
    high: np.ndarray
    axes: dict[str, Axis]
    is_posterior: bool = False

    @property
    def names(self) -> Names:
        """Names of the inputs: parameters, then conditions."""
        return (*self.parameters.coordinates, *self.conditions)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def columns(self) -> Names:
        """Columns of a point: inputs, and parameters tied to them."""
        return (*self.parameters.names, *self.conditions)

    def values(self, scores: Any) -> Any:
        """Values of `columns` at independent scores: standard normal for parameters, 0 to 1 for conditions.

        A NumPy array is computed with NumPy, without compilation. Anything else can be traced by JAX.

        Args:
            scores: scores, shape (..., inputs).

        Returns:
            Values, shape (..., columns).
        """
        p = len(self.parameters)
        theta = self.parameters.at(self.parameters.mean + scores[..., :p] @ self.parameters.root.T)
        uniform_values = self.low + (self.high - self.low) * scores[..., p:]
        return (np if isinstance(scores, np.ndarray) else jnp).concatenate([theta, uniform_values], -1)

    @cached_property
    def slope(self) -> Float[np.ndarray, "columns inputs"]:
        """Derivatives of the values with respect to the scores, at the medians."""
        return np.asarray(jax.jit(jax.jacfwd(self.values))(self.centre))

    def scores(self, unit: Float[np.ndarray, "... inputs"]) -> Float[np.ndarray, "... inputs"]:
        """Scores of points of the unit cube."""
        p = len(self.parameters)
        return np.concatenate([ndtri(np.clip(unit[..., :p], EDGE, 1 - EDGE)), unit[..., p:]], -1)

    @property
    def uniform(self) -> np.ndarray:
        """True for conditions, whose scores are uniform, shape (inputs,)."""
        return np.arange(len(self)) >= len(self.parameters)

    @property
    def centre(self) -> np.ndarray:
        """Scores of the medians."""
        return np.where(self.uniform, 0.5, 0.0)

    @property
    def column_indices(self) -> np.ndarray:
        """Index of each input in `columns`."""
        p, tied = len(self.parameters), len(self.parameters.tied)
        return np.concatenate([np.arange(p), np.arange(p + tied, p + tied + len(self.conditions))])

    def acting(self, configuration: str, configurations: Sequence[str]) -> np.ndarray:
        """Indices of the inputs that act in a configuration."""
        other_prefixes = tuple(f"{name}." for name in configurations if name != configuration)
        return np.array([k for k, name in enumerate(self.names) if not name.startswith(other_prefixes)], int)


#: Parameters that are inputs of a rig only if its file states a prior for them.
_FROM_OTHER_ROBOTS = (
    "driver.",
    "rig.",
    "motor.resistance_thermal_",
    "motor.time_constant_",
    "motor.temperature_ambient",
)


def default_input_names(
    robot: Robot, configurations: Sequence[str], battery: bool, model: str = "steady", turns: bool = False
) -> Names:
    """Names of the parameters that have a prior of nonzero width, for these configurations.

    Parameters of an unused battery, guide parameters on wheels, and parameters that the fidelity does not use (in
    straight travel or in turns) are left out.
    """
    absent_configurations = [name for name in robot.configurations if name not in configurations]
    wheeled = [name for name in configurations if float(robot.configurations[name].on_tracks) < 0.5]
    excluded = tuple(f"{name}." for name in absent_configurations) + (() if battery else ("battery.",))
    guide_names = {f"{name}.{g}" for name in wheeled for g in (priors.GUIDE_SHARE, priors.GUIDE_FRICTION)}
    by_name = params.parameters_by_name(robot)
    left_out = {*guide_names, *fidelities.unread_parameters(model, by_name, turns), *robot.rig.exact}
    if not robot.rig.inherits:  # parameters of another robot do not count
        prior_names = {name for name, _, _ in robot.rig.priors}
        left_out |= {name for name in by_name if name.startswith(_FROM_OTHER_ROBOTS) and name not in prior_names} | {
            *robot.rig.unknown
        }
    return tuple(
        name
        for name, p in by_name.items()
        if not name.startswith(excluded) and name not in left_out and p.spec.prior_sd(float(p.value)) > 0
    )


def inputs_from_priors(
    robot: Robot, words: Sequence[str], ranges: Mapping[str, tuple[float, float]]
) -> UncertainInputs:
    """Inputs from the priors of parameters, around the values of the robot, and from ranges of conditions.

    Args:
        words: names of parameters. `motor.*` stands for a group.
        ranges: ranges of conditions.

    Raises:
        BadConfiguration: a name is unknown (the message lists the choices), its prior has zero width, or a range is
            invalid.
    """
    by_name = params.parameters_by_name(robot)
    expanded = (priors.expand_name(word, list(by_name), "--parameters") for word in words)
    names = list(dict.fromkeys(itertools.chain(*expanded)))
    for name in names:
        if not by_name[name].spec.prior_sd(float(by_name[name].value)) > 0:
            raise BadConfiguration(
                f"--parameters {name}: its prior has no width (value 0 with a relative sd); give it a value with "
                "--set, or remove it"
            )
    try:
        coordinates = priors.parameter_coordinates(robot, names) if names else None
    except BadConfiguration as error:
        raise BadConfiguration(str(error).replace("--prior", "--parameters")) from None
    count = len(names)
    parameters = (
        posterior_of_coordinates(coordinates, np.zeros(count), np.eye(count)) if coordinates else NO_PARAMETERS
    )
    return inputs_from_posterior(robot, parameters, ranges, is_posterior=False)


def inputs_from_posterior(
    robot: Robot, parameters: Posterior, ranges: Mapping[str, tuple[float, float]], *, is_posterior: bool = True
) -> UncertainInputs:
    """Inputs from ranges of conditions and the posterior of a calibrated robot, or another distribution."""
    for name in ranges:
        stated_word(name, [n for n in CONDITIONS if n != "configuration"], f"--vary {name}", "no such condition")
    try:
        axes = Variation(robot, (*parameters.names, *ranges)).axes
    except UsageError as error:
        raise BadConfiguration(str(error)) from None
    for name, (low, high) in ranges.items():
        lowest, highest = axes[name].bounds
        if not (math.isfinite(low) and math.isfinite(high) and lowest <= low < high <= highest):
            raise BadConfiguration(
                f"--vary {name}: got {low:g} to {high:g}; expected a range within {lowest:g} to {highest:g} "
                f"{axes[name].unit}, the smaller end first"
            )
    ends = np.array(list(ranges.values()), float).reshape(-1, 2)
    return UncertainInputs(parameters, tuple(ranges), ends[:, 0], ends[:, 1], axes, is_posterior)
