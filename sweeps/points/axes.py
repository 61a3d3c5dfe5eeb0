"""Design of a sweep from its configuration: axes, ranges, distributions and fixed conditions, checked by name."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.data import Json, Names
from calibration.data.columns import IMPOSED as IMPOSED_COLUMNS
from calibration.data.columns import LEVERS
from calibration.data.contradictions import reason_without_levers
from calibration.data.input_errors import (
    SEEDS,
    BadConfiguration,
    stated_count,
    stated_number,
    stated_word,
)
from mmrjax.fidelities import variation
from mmrjax.fidelities.variation import Axis
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import SURFACES
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.config_campaign import Campaign
from sweeps.options import parse_axis
from sweeps.points.sampled_design import DESIGNS, ROW, Design, DrawnSamples, Samples, in_blocks
from sweeps.points.tasks import task_of_configuration

CONFIGURATION, SURFACE = "configuration", "surface"
#: Conditions that act only on vehicles, and only on loads on a shaft.
ON_GROUND, ON_SHAFT = ("slope_deg", "payload", "total_mass", "adhesion"), ("load_torque",)
#: Maximum number of values of one axis. They are kept in memory, unlike samples.
MAX_AXIS_VALUES = 10_000_000
#: Maximum number of points. Their numbers have 64 bits.
MAX_POINTS = 2**62

Quantile = Callable[[np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class SweepPlan:
    """Points of a sweep and their constant conditions.

    Attributes:
        design: the points.
        axes: unit and limits of each varied name.
        conditions: constant conditions by name, `configuration` as an index.
        surface: surface of Table 5, which scales the adhesion of each configuration. None if adhesion is stated or
            varies.
        data: input files of the design, in addition to the configuration.
        rows: conditions of the runs of a table, which the axis `ROW` selects.
    """

    design: Design
    axes: dict[str, Axis]
    conditions: dict[str, float]
    surface: str | None = None
    data: Names = ()
    rows: Conditions | None = None

    @staticmethod
    def of_rows(rows: Conditions, samples: DrawnSamples | None = None) -> SweepPlan:
        """Plan with the runs of a table, of shape (runs,), each combined with every sample."""
        return SweepPlan(Design({ROW: np.arange(rows.shape[0], dtype=float)}, samples), {}, {}, rows=rows)

    def varied(self, robot: Robot) -> variation.Variation:
        """Robot with the varied parameters and conditions, without axes that belong to a task."""
        names = variation.variable_names(robot)
        return variation.Variation(robot, tuple(name for name in self.design.names if name in names))

    def fixed(self) -> Conditions:
        """Conditions that do not vary, of shape ()."""
        given = {name: value for name, value in self.conditions.items() if name != CONFIGURATION}
        return Conditions(int(self.conditions.get(CONFIGURATION, 0)), **given)


def plan_design(config: Campaign, robot: Robot, where: str) -> SweepPlan:
    """Checks a configuration and returns its plan.

    Args:
        where: name of its file, for messages.

    Raises:
        BadConfiguration: a name is unknown or stated twice, an axis has no values, a range is reversed, a value is
            out of bounds, or similar.
    """
    task = task_of_configuration(config, robot)
    axes = {
        name: _axis_values(name, stated, robot, f"{where}, axes.{name}", task.axes)
        for name, stated in config.axes.items()
    }
    samples, data = _sampled_design(config.samples, robot, f"{where}, samples")
    if not axes and samples is None:
        raise BadConfiguration(f"{where}: no [axes] or [samples]; vary at least one quantity")
    design = Design(axes, samples)
    fixed, surface = _fixed_conditions(config.conditions, robot, f"{where}, conditions")
    fixed |= task.added_conditions(
        {**{name: np.array([value]) for name, value in fixed.items()}, **axes}, robot, where
    )
    for k, name in enumerate(design.names):
        if name in fixed or name in design.names[:k]:
            raise BadConfiguration(f"{where}, {name}: given twice; give it once, under conditions, axes or samples")
    names = {*fixed, *design.names}
    on_battery = fixed.get("battery", 0.0) > 0.5
    if on_battery and "voltage" in names:
        raise BadConfiguration(f"{where}: voltage has no effect on a battery; remove one of the two")
    _check_acting_conditions(names, robot, where, surface)
    configuration_indices = np.atleast_1d(axes.get(CONFIGURATION, fixed.get(CONFIGURATION, 0.0)))
    configuration_names = [robot.configurations.names[int(k)] for k in configuration_indices]
    capabilities.check_turning(robot, names, configuration_names, where)
    for name in configuration_names if not names.isdisjoint(LEVERS) else ():
        if reason := reason_without_levers(robot, name):
            raise BadConfiguration(f"{where}, {min(names & {*LEVERS})}: {reason}")
    imposed_axis = robot.rig.imposed
    if not robot.rig.inherits and imposed_axis not in names and not on_battery:
        default = capabilities.imposed_default(robot, f"{where}, conditions.{imposed_axis}")
        fixed[imposed_axis] = default * IMPOSED_COLUMNS[imposed_axis][1]
    if surface is not None and "adhesion" in names:
        raise BadConfiguration(
            f"{where}, conditions.surface: got {surface} in addition to adhesion; give one of the two"
        )
    if design.points > MAX_POINTS:
        raise BadConfiguration(f"{where}: got {design.points:.3g} points; expected at most {MAX_POINTS:.3g}")
    plan = SweepPlan(design, dict(task.axes), fixed, surface, data)
    all_axes = {**task.axes, **plan.varied(robot).axes}
    return dataclasses.replace(plan, axes={name: all_axes[name] for name in design.names})


def _check_acting_conditions(names: set[str], robot: Robot, where: str, surface: str | None) -> None:
    """Rejects conditions that do not act on the robot."""
    axes_of_imposed = {
        "voltage": ("voltage", "duty", "open"), "motor_speed": ("motor_speed", "motor_acceleration"),
        "motor_current": ("motor_current",),
    }  # fmt: skip
    inapplicable = {
        name for imposed, axis_names in axes_of_imposed.items() if imposed != robot.rig.imposed for name in axis_names
    }
    for name in sorted(names & inapplicable):
        raise BadConfiguration(
            f"{where}, {name}: the robot's file imposes the {robot.rig.imposed.replace('_', ' ')}; vary "
            f"{robot.rig.imposed} instead"
        )
    stated_names = {*names, *([SURFACE] if surface is not None else [])}
    ground, shaft = (
        [f"{where}, {name}" for name in sorted(stated_names & {*acting})]
        for acting in ((*ON_GROUND, SURFACE), ON_SHAFT)
    )
    capabilities.check_acting(robot, ground, shaft)
    if surface is not None and not robot.rig.scales_adhesion:
        raise BadConfiguration(
            f"{where}, conditions.surface: got {surface}; a rig's surfaces are configurations "
            f"({', '.join(robot.configurations)}); vary or set configuration"
        )


def _find_axis(name: str, robot: Robot, where: str) -> Axis:
    names = variation.variable_names(robot)
    stated_word(name, names, where, "neither a parameter of the robot nor a condition", 3)
    return variation.Variation(robot, (name,)).axes[name]


def _axis_value(name: str, value: Any, where: str) -> float:
    """A number, for the battery also true or false."""
    return float(value) if name == "battery" and isinstance(value, bool) else stated_number(value, where)


def _check_within(values: Float[np.ndarray, " n"], axis: Axis, where: str) -> None:
    low, high = axis.bounds
    for value in values[~((values >= low) & (values <= high))][:1]:
        unit = "" if axis.unit in ("", "-") else f" {axis.unit}"
        raise BadConfiguration(f"{where}: got {value:g}; expected {low:g} to {high:g}{unit} ({axis.meaning})")


def _configuration(name: Any, robot: Robot, where: str) -> float:
    problem = f"got {name!r}; the robot has no such configuration"
    return float(robot.configurations.index(stated_word(name, robot.configurations, where, problem)))


# --- grids ------------------------------------------------------------------------------------------------------


def _axis_values(name: str, stated: Any, robot: Robot, where: str, task_axes: Mapping[str, Axis]) -> np.ndarray:
    axis = task_axes[name] if name in task_axes else _find_axis(name, robot, where)
    entries = stated if isinstance(stated, list) else [stated]
    if name == CONFIGURATION:
        names = robot.configurations.names if stated == "all" else entries
        values = np.array([_configuration(entry, robot, where) for entry in names])
    elif isinstance(stated, dict):
        _check_keys(stated, _RANGE_KEYS, ("start", "stop", "number"), where)
        start, stop = (stated_number(stated[k], f"{where}.{k}") for k in ("start", "stop"))
        number = stated_count(stated["number"], f"{where}.number", 1, MAX_AXIS_VALUES)
        scale = stated.get("scale", "linear")
        stated_word(scale, ("linear", "log"), f"{where}.scale", f"got {scale!r}")
        if start > stop or (start == stop) != (number == 1):
            raise BadConfiguration(
                f"{where}: got start {start:g}, stop {stop:g}, number {number}; expected start below stop and 2 "
                "values or more"
            )
        if scale == "log" and start <= 0:
            raise BadConfiguration(f"{where}.start: got {start:g}; expected a number above 0 with scale log")
        values = np.linspace(start, stop, number) if scale == "linear" else np.geomspace(start, stop, number)
    elif isinstance(stated, str):
        values = np.array(parse_axis(where, stated))
    else:
        values = np.array([_axis_value(name, entry, where) for entry in entries])
    if not len(values):
        raise BadConfiguration(f"{where}: got no values; expected at least one")
    if len(values) > MAX_AXIS_VALUES:
        raise BadConfiguration(
            f"{where}: got {len(values)} values; expected at most {MAX_AXIS_VALUES} (except in [samples])"
        )
    if len(np.unique(values)) < len(values):
        raise BadConfiguration(f"{where}: got a value twice; give it once")
    _check_within(values, axis, where)
    return values


_RANGE_KEYS = ("start", "stop", "number", "scale")


def _check_keys(stated: Json, allowed: Names, needed: Names, where: str) -> None:
    for key in stated:
        stated_word(key, allowed, f"{where}.{key}", "no such key")
    for key in needed:
        if key not in stated:
            raise BadConfiguration(f"{where}: {key} is missing; expected {', '.join(needed)}")


# --- fixed conditions -------------------------------------------------------------------------------------------


def _fixed_conditions(stated: Json, robot: Robot, where: str) -> tuple[dict[str, float], str | None]:
    allowed = (*variation.CONDITIONS, SURFACE)
    fixed: dict[str, float] = {}
    surface = None
    for name, value in stated.items():
        place = f"{where}.{name}"
        stated_word(name, allowed, place, "no such condition")
        if name == SURFACE:
            is_label = isinstance(value, str) and not robot.rig.scales_adhesion
            surface = value if is_label else stated_word(value, SURFACES, place, f"got {value!r}")
        elif name == CONFIGURATION:
            fixed[name] = _configuration(value, robot, place)
        else:
            fixed[name] = _axis_value(name, value, place)
            _check_within(np.array([fixed[name]]), _find_axis(name, robot, place), place)
    return fixed, surface


# --- samples ----------------------------------------------------------------------------------------------------

_SAMPLE_KEYS = ("design", "number", "seed", "over", "posterior")


def _sampled_design(stated: Json, robot: Robot, where: str) -> tuple[Samples | None, Names]:
    """Sampled design, if any, and its input files."""
    if not stated:
        return None, ()
    _check_keys(stated, _SAMPLE_KEYS, ("design", "number"), where)
    design = stated_word(stated["design"], DESIGNS, f"{where}.design", f"got {stated['design']!r}")
    number = stated_count(stated["number"], f"{where}.number", 1, 2**52)
    seed = stated_count(stated.get("seed", 0), f"{where}.seed", 0, SEEDS)
    overrides = stated.get("over", {})
    if not isinstance(overrides, dict):
        raise BadConfiguration(f"{where}.over: got {overrides!r}; expected a table of names and distributions")
    marginals = {
        name: _quantile(name, distribution, robot, f"{where}.over.{name}") for name, distribution in overrides.items()
    }
    joint = None
    data = Names()
    if "posterior" in stated:
        from calibration.data import posterior_file

        folder = stated["posterior"]
        posterior_place = f"{where}.posterior"
        if not isinstance(folder, str):
            raise BadConfiguration(f"{posterior_place}: got {folder!r}; expected a run folder of calibrate or loop")
        path = Path(folder)
        path = path / posterior_file.FILE if path.is_dir() else path
        joint = posterior_file.read_posterior(path)
        joint.check(robot, posterior_place)
        data = (str(path),)
    if not marginals and joint is None:
        raise BadConfiguration(
            f"{where}: nothing to sample; give a table `over` of names and distributions, or `posterior`"
        )
    return Samples(design, number, seed, marginals, joint), data


#: Keys of each distribution.
DISTRIBUTIONS: dict[str, Names] = {
    "uniform": ("low", "high"),
    "loguniform": ("low", "high"),
    "normal": ("mean", "sd"),
    "lognormal": ("median", "sd_log"),
    "triangular": ("low", "mode", "high"),
    "prior": (),
}


def _quantile(name: str, stated: Any, robot: Robot, where: str) -> Quantile:
    """Quantile function of a distribution, truncated at the bounds of the sampled quantity."""
    axis = _find_axis(name, robot, where)
    if name == CONFIGURATION:
        raise BadConfiguration(f"{where}: cannot be sampled; put it under axes or conditions")
    table = {"distribution": stated} if isinstance(stated, str) else stated
    kind = table.get("distribution") if isinstance(table, dict) else None
    kind = stated_word(kind, DISTRIBUTIONS, f"{where}.distribution", f"got {kind!r}")
    needed = DISTRIBUTIONS[kind]
    _check_keys(table, ("distribution", *needed), needed, where)
    numbers = {key: stated_number(table[key], f"{where}.{key}") for key in needed}
    ordered = [numbers[key] for key in ("low", "mode", "high") if key in numbers]
    if ordered != sorted(ordered) or (ordered and ordered[0] == ordered[-1]):
        stated_text = ", ".join(f"{key} {value:g}" for key, value in numbers.items())
        raise BadConfiguration(f"{where}: got {stated_text}; expected {' below '.join(k for k in needed)}")
    for key in ("sd", "sd_log"):
        if numbers.get(key, 1.0) <= 0:
            raise BadConfiguration(f"{where}.{key}: got {numbers[key]:g}; expected more than 0")
    _check_within(np.array([v for k, v in numbers.items() if not k.startswith("sd")]), axis, where)
    if kind == "prior":
        if not axis.prior_sd or axis.value is None:
            other_names = ", ".join(k for k in DISTRIBUTIONS if k != kind)
            raise BadConfiguration(f"{where}: {name} has no prior; expected one of {other_names}")
        from scipy.special import ndtri

        from calibration.inference import priors

        coordinates = priors.parameter_coordinates(robot, [name])
        return lambda u: in_blocks(coordinates.value, ndtri(u)[:, None])[:, 0]
    return _truncated_quantile(kind, numbers, axis.bounds, where)


def _truncated_quantile(kind: str, numbers: dict[str, float], bounds: tuple[float, float], where: str) -> Quantile:
    from scipy.special import ndtr, ndtri

    positive = {"loguniform": "low", "lognormal": "median"}.get(kind)
    if positive and numbers[positive] <= 0:
        raise BadConfiguration(
            f"{where}.{positive}: got {numbers[positive]:g}; expected a number above 0 with {kind}"
        )
    if kind in ("uniform", "loguniform"):
        low, high = numbers["low"], numbers["high"]
        if kind == "uniform":
            return lambda u: low + (high - low) * u
        return lambda u: low * np.exp(u * math.log(high / low))
    if kind == "triangular":
        low, mode, high = numbers["low"], numbers["mode"], numbers["high"]
        mode_probability = (mode - low) / (high - low)
        return lambda u: np.where(
            u < mode_probability,
            low + np.sqrt(u * (high - low) * (mode - low)),
            high - np.sqrt((1 - u) * (high - low) * (high - mode)),
        )
    # normal in the value or its logarithm, truncated at the bounds
    centre, sd = numbers.values()
    if kind == "normal":
        lower, upper = (ndtr((b - centre) / sd) for b in bounds)
        return lambda u: np.clip(centre + sd * ndtri(lower + (upper - lower) * u), *bounds)
    lower, upper = (ndtr(math.log(b / centre) / sd) if b > 0 else 0.0 for b in bounds)
    return lambda u: np.clip(centre * np.exp(sd * ndtri(lower + (upper - lower) * u)), *bounds)
