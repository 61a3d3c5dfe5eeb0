"""Check of requirements: the margin of each at the worst corner of its envelope, and changes that would meet it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Json, Names
from calibration.data.contradictions import reason_without_stance
from calibration.data.input_errors import BadConfiguration, stated_word
from calibration.data.requirements_file import STAIRS, TREAD, Envelope, Requirement, Requirements
from calibration.inference.fit_notes import Remark, progress_remark
from mmrjax.compile.compiling import compiled
from mmrjax.derived.requirements import EnvelopePoint, Ratings, evaluate_requirement, ratings
from mmrjax.model import params
from mmrjax.model.paper_tables import adhesion_ratio, lateral_ratio
from mmrjax.model.quantities import AMBIENT, AXES, CHARGE, MM, PAYLOAD, SLOPE
from mmrjax.model.robot import Robot, turn_error
from mmrjax.model.signals import CONVERGED, STATUSES

#: Number of values along each axis of an envelope: its ends, and more if an output may have an extremum between them.
VALUES = {PAYLOAD: 3, SLOPE: 5, CHARGE: 5, AMBIENT: 2}
#: Parameters that a designer can change, without the name of their configuration. `battery.cells` is an integer.
CELLS = "battery.cells"
CHANGEABLE = (
    "gearbox.ratio", "gearbox.efficiency_load", "motor.resistance", "motor.torque_constant",
    "motor.resistance_thermal_winding", "motor.resistance_thermal_housing", "battery.capacity", "battery.resistance",
    "battery.current_other",
)  # fmt: skip
OF_CONFIGURATION = ("mass", "radius", "ground.friction.static", "ground.rolling_resistance", "track.loss_coulomb",
                    "turning.width")  # fmt: skip
#: Parameters that a designer can change for a posture.
OF_LEVERS = ("running_gear.lever_length", "running_gear.levers.roller")
#: Range of a change, in addition to the field's bounds: least and greatest multiple of the present value.
REACH = (0.1, 10.0)
#: Values of a parameter per call, values in the coarse search, and digits of a reported change.
ROWS, LADDER, DIGITS = 32, 24, 4


@dataclasses.dataclass(frozen=True)
class ParameterChange:
    """A change of a single parameter with which a requirement is met.

    Attributes:
        parameter: dotted name of the parameter.
        before, after: present and changed value [unit].
        unit: unit of the parameter.
        gradient: derivative of the quantity with respect to the parameter at the worst corner [unit of the quantity /
            unit].
        breaks: names of requirements that are met now and would be missed.
    """

    JSON = ("parameter", "from=before", "to=after", "unit", "gradient", "breaks")
    parameter: str
    before: float
    after: float
    unit: str
    gradient: float
    breaks: Names = ()


@dataclasses.dataclass(frozen=True)
class RequirementOutcome:
    """Result of checking a requirement.

    Attributes:
        requirement: the requirement, with its rating filled in.
        value: value of the quantity at the worst corner [unit of its name]. None if there is none.
        margin: margin to the limit, negative if missed. None without a value.
        status: status at the worst corner, one of `STATUSES`.
        at: the worst corner.
        change: single changes with which it would be met, the smallest first. Empty if it is met, or if there is
            none.
    """

    JSON = (
        "name=requirement.name", "required=requirement.limit", "sense=requirement.sense", "value", "margin",
        "unit=requirement.quantity.unit", "met", "status", "at", "change", "source=requirement.source",
    )  # fmt: skip
    requirement: Requirement
    value: float | None
    margin: float | None
    status: str
    at: Json
    change: tuple[ParameterChange, ...] = ()

    @property
    def met(self) -> bool:
        """True if the requirement is met."""
        return self.margin is not None and self.margin >= 0


def fill_in_ratings(robot: Robot, asked: Requirements) -> Requirements:
    """Requirements in which missing limits are replaced by the robot's own ratings.

    Raises:
        BadConfiguration: the robot has no such rating.
    """
    ratings_by_name = {
        "winding_C": robot.motor.temperature_limit, "motor_speed_rpm": robot.motor.speed_limit,
        "gearbox_speed_rpm": robot.gearbox.speed_limit, "gearbox_Nm": robot.gearbox.torque_limit,
    }  # fmt: skip
    filled_ratings = []
    for r in asked.each:
        limit = r.limit
        if limit is None:
            rating = ratings_by_name[r.name]
            if rating is None:
                raise BadConfiguration(f"{asked.source}, {r.name}: the robot states no rating; state a number")
            limit = rating / r.quantity.factor
        filled_ratings.append(dataclasses.replace(r, limit=limit))
    return dataclasses.replace(asked, each=tuple(filled_ratings))


def reject_impossible(robot: Robot, asked: Requirements) -> None:
    """Rejects requirements that cannot be evaluated for this robot.

    Raises:
        BadConfiguration: the robot lacks a configuration, cannot make a turn, or has no stated stance for a posture.
            Or the surface does not hold a slope of the envelope, whatever drives the robot: tan α above μ_s.
    """
    for r in asked.each:
        e = r.envelope
        requirement_place = f"{asked.source}, {r.name}"
        if e.configuration:
            wrong = f"the robot has no configuration {e.configuration}"
            stated_word(e.configuration, robot.configurations, requirement_place, wrong)
        turns = r.quantity.group in ("turn", "across")
        if turns and (why := turn_error(robot, (_configuration_name(robot, e),))):
            raise BadConfiguration(f"{requirement_place}: {why}")
        if r.quantity.group == "posture" and (why := reason_without_stance(robot)):
            raise BadConfiguration(f"{requirement_place}: {why}")
        chassis = robot.configurations[_configuration_name(robot, e)]
        friction = float(chassis.ground.friction.static) * adhesion_ratio(e.surface, float(chassis.on_tracks) > 0.5)
        steepest = math.degrees(math.atan(friction))
        if SLOPE in r.quantity.axes and e.slope_deg[1] > steepest:
            raise BadConfiguration(
                f"{requirement_place}: the envelope's slope_deg goes up to {e.slope_deg[1]:g}; {e.surface} holds "
                f"{_configuration_name(robot, e)} up to {steepest:.1f} deg (adhesion {friction:.2f}), whatever "
                "drives it"
            )


def _configuration_name(robot: Robot, envelope: Envelope) -> str:
    return envelope.configuration or robot.configurations.names[0]


def envelope_points(robot: Robot, requirement: Requirement) -> EnvelopePoint:
    """Points of a requirement's envelope: the ends of each range and values between, shape (points,).

    A condition without influence on the quantity has one value. The number of points depends only on the quantity.
    """
    e, axes = requirement.envelope, requirement.quantity.axes
    ambient = e.ambient_C or (float(robot.motor.temperature_ambient),) * 2
    ranges = {PAYLOAD: e.payload_kg, SLOPE: e.slope_deg, CHARGE: e.charge, AMBIENT: ambient}
    values = [np.linspace(*ranges[a], VALUES[a]) if a in axes else np.array([ranges[a][-1]]) for a in AXES]
    payload, slope, charge, warm = (x.ravel() for x in np.meshgrid(*values, indexing="ij"))
    name = _configuration_name(robot, e)
    on_tracks = float(robot.configurations[name].on_tracks) > 0.5

    def at_all_points(x: float) -> Float[Array, " points"]:
        return jnp.full(len(payload), x, float)

    return EnvelopePoint(
        configuration=jnp.full(len(payload), robot.configurations.index(name)),
        adhesion=at_all_points(adhesion_ratio(e.surface, on_tracks)),
        adhesion_lateral=at_all_points(lateral_ratio(e.surface, on_tracks)), battery=at_all_points(float(e.battery)),
        charge=jnp.asarray(charge), charge_end=at_all_points(e.charge_end), share=at_all_points(requirement.share),
        slope_deg=jnp.asarray(slope), payload=jnp.asarray(payload), ambient=jnp.asarray(warm),
        tread=at_all_points(MM * requirement.tread_mm),
    )  # fmt: skip


def _with_parameters(robot: Robot, rated: Ratings, names: Names, theta: Array) -> tuple[Robot, Ratings]:
    """Robot with parameters from a vector, and its ratings, which include `battery.cells`."""
    values = dict(zip(names, theta, strict=True))
    cells = values.pop(CELLS)
    return params.replace(robot, values), dataclasses.replace(rated, cells=cells)


def _robot_without_ratings(robot: Robot) -> Robot:
    """Robot with one cell and default ratings.

    Cells and ratings are separate numbers, so that all robots share one program.
    """
    usual, shaft, gear = type(robot.battery)(), type(robot.motor)(), type(robot.gearbox)()
    limits = ("voltage_charge", "voltage_cutoff", "delay_cutoff", "current_limit", "current_charge")
    robot = dataclasses.replace(
        robot,
        battery=dataclasses.replace(robot.battery, cells=1, **{name: getattr(usual, name) for name in limits}),
        motor=dataclasses.replace(
            robot.motor,
            **{n: getattr(shaft, n) for n in ("temperature_limit", "voltage_limit", "speed_limit")},
        ),
        gearbox=dataclasses.replace(
            robot.gearbox, **{name: getattr(gear, name) for name in ("speed_limit", "torque_limit")}
        ),
    )
    return params.without_weak_types(robot)


@compiled
def _quantity_at_points(
    robot: Robot,
    rated: Ratings,
    names: Names,
    rows: Float[Array, "rows parameters"],
    at: EnvelopePoint,
    name: str,
) -> tuple[Array, Array]:
    """Values and outcomes of a quantity for robots (rows of parameters) at points, shape (rows, points)."""

    def one(theta: Array, point: EnvelopePoint) -> tuple[Array, Array]:
        changed, changed_ratings = _with_parameters(robot, rated, names, theta)
        return evaluate_requirement(changed, point, changed_ratings, name)

    return jax.vmap(lambda theta: jax.vmap(lambda p: one(theta, p))(at))(rows)


@compiled
def _quantity_gradient(
    robot: Robot, rated: Ratings, names: Names, theta: Array, at: EnvelopePoint, name: str
) -> Array:
    """Derivative of a quantity at one point with respect to the parameters."""

    def value(theta: Array) -> Array:
        changed, changed_ratings = _with_parameters(robot, rated, names, theta)
        return evaluate_requirement(changed, at, changed_ratings, name)[0]

    return jax.grad(value)(theta)


@dataclasses.dataclass(frozen=True)
class _QuantityOfRobot:
    """The quantity of a requirement over its envelope, as a function of the parameters that may change."""

    robot: Robot
    requirement: Requirement
    names: Names

    @property
    def at(self) -> EnvelopePoint:
        return envelope_points(self.robot, self.requirement)

    def over(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values in the unit of the name, outcomes, and margins (-inf without a value), shape (rows, points)."""
        r, point, parts = self.requirement, self.at, []
        robot, rated = _robot_without_ratings(self.robot), ratings(self.robot)
        for first in range(0, len(rows), ROWS):
            chunk_rows = rows[np.minimum(np.arange(first, first + ROWS), len(rows) - 1)]
            chunk_results = jax.device_get(
                _quantity_at_points(robot, rated, self.names, jnp.asarray(chunk_rows), point, _computed_name(r))
            )
            parts.append([x[: len(rows) - first] for x in chunk_results])
        value, outcome = (np.concatenate(x) for x in zip(*parts, strict=True))
        value = value / r.quantity.factor
        counts = (outcome == CONVERGED) & np.isfinite(value)
        assert r.limit is not None  # see `fill_in_ratings`
        margin = (value - r.limit) * (1 if r.least else -1)
        return value, outcome, np.where(counts, margin, -np.inf)

    def worst(self, rows: np.ndarray) -> np.ndarray:
        """Margin at the worst corner, shape (rows,)."""
        return self.over(rows)[2].min(axis=1)


def _computed_name(requirement: Requirement) -> str:
    """Name under which a quantity is computed. Names of the same quantity share a program."""
    return "speed_m_s" if requirement.name == "speed_end_of_charge_m_s" else requirement.name


def check_requirements(
    robot: Robot,
    asked: Requirements,
    *,
    changes: bool = True,
    tell: Callable[[Remark], None] = lambda note: None,
) -> tuple[RequirementOutcome, ...]:
    """Compares a robot with requirements.

    Args:
        changes: True to search for changes with which missed requirements would be met.
        tell: callback for progress.

    Raises:
        BadConfiguration: see `reject_impossible` and `fill_in_ratings`.
    """
    reject_impossible(robot, asked)
    asked = fill_in_ratings(robot, asked)
    checked_requirements = []
    for r in asked.each:
        configuration = _configuration_name(robot, r.envelope)
        of_levers = OF_LEVERS if r.quantity.group == "posture" else ()
        by_name = params.parameters_by_name(robot)
        names = (*CHANGEABLE, *(f"{configuration}.{n}" for n in OF_CONFIGURATION))
        checked_requirements.append(
            _QuantityOfRobot(
                robot, r, (*{name: by_name[name] for name in names if name in by_name}, *of_levers, CELLS)
            )
        )
    outcomes = []
    for k, h in enumerate(checked_requirements, 1):
        tell(progress_remark("requirement", k, len(checked_requirements), h.requirement.quantity.label))
        outcomes.append(_check_requirement(h))
    if not changes:
        return tuple(outcomes)
    missed, answer = [k for k, o in enumerate(outcomes) if not o.met], list(outcomes)
    for n, k in enumerate(missed, 1):
        tell(progress_remark("changes", n, len(missed), checked_requirements[k].requirement.quantity.label))
        answer[k] = _add_changes(checked_requirements[k], outcomes[k], checked_requirements, outcomes)
    return tuple(answer)


def _present_values(held: _QuantityOfRobot) -> np.ndarray:
    value_of_name = params.values_by_name(held.robot)
    return np.array([held.robot.battery.cells if n == CELLS else value_of_name[n] for n in held.names], float)


def _check_requirement(held: _QuantityOfRobot) -> RequirementOutcome:
    r = held.requirement
    value, outcome, margin = (x[0] for x in held.over(_present_values(held)[None]))
    # A point without a value is worse than any other. Among points with the same outcome, the largest is the worst
    # corner.
    k = int(np.argmin(margin))
    status = STATUSES[outcome[k]]
    counts = np.isfinite(margin[k])
    if not counts and status == STATUSES[CONVERGED]:  # beyond all bounds: a temperature that never settles
        status = "unbounded"
    return RequirementOutcome(
        r,
        float(value[k]) if counts else None,
        float(margin[k]) if counts else None,
        status,
        _named_corner(held, k),
    )


def _named_corner(held: _QuantityOfRobot, k: int) -> Json:
    """A point as entries with the names of a requirements file."""
    r, point = held.requirement, held.at
    e = r.envelope
    places = {
        PAYLOAD: ("payload_kg", point.payload), SLOPE: ("slope_deg", point.slope_deg),
        AMBIENT: ("ambient_C", point.ambient),
        CHARGE: ("state_of_charge" if e.battery else "supply_voltage_V", point.charge),
    }  # fmt: skip
    corner: Json = {places[a][0]: round(float(np.asarray(places[a][1])[k]), 9) for a in r.quantity.axes}
    if r.name == "endurance_min":
        low = e.charge_end
        corner |= {
            "duty": "driving" if r.share else "standing",
            "share": r.share,
            "state_of_charge": [low, e.charge[1]],
        }
    if r.name == STAIRS:
        corner[TREAD] = r.tread_mm
    return {"configuration": _configuration_name(held.robot, e), "surface": e.surface, **corner}


def _add_changes(
    held: _QuantityOfRobot,
    outcome: RequirementOutcome,
    every: Sequence[_QuantityOfRobot],
    now: Sequence[RequirementOutcome],
) -> RequirementOutcome:
    changes = _find_changes(held, outcome)
    if not changes:
        return outcome
    rows = np.stack([_row_with_value(held, c.parameter, c.after) for c in changes])
    broken: list[list[str]] = [[] for _ in changes]
    for other, before in zip(every, now, strict=True):
        if other is held or not before.met:
            continue
        # Other configurations have other names. Common names are changed.
        present = np.tile(_present_values(other), (len(rows), 1))
        for k, name in enumerate(held.names):
            if name in other.names:
                present[:, other.names.index(name)] = rows[:, k]
        for names, margin in zip(broken, other.worst(present), strict=True):
            names += [other.requirement.name] if margin < 0 else []
    with_breaks = [
        dataclasses.replace(c, breaks=tuple(dict.fromkeys(b))) for c, b in zip(changes, broken, strict=True)
    ]
    order = sorted(with_breaks, key=lambda c: (len(c.breaks) > 0, abs(math.log(c.after / c.before))))
    return dataclasses.replace(outcome, change=tuple(order))


def _row_with_value(held: _QuantityOfRobot, name: str, value: float) -> np.ndarray:
    row = _present_values(held)
    row[held.names.index(name)] = value
    return row


def _find_changes(held: _QuantityOfRobot, outcome: RequirementOutcome) -> list[ParameterChange]:
    """Single changes with which a requirement is met.

    The direction follows from the derivative at the worst corner. The nearest value that meets the requirement at
    every corner is found by a coarse search and bisection. Each result is verified.
    """
    present_values, names = _present_values(held), held.names
    worst = int(np.argmin(held.over(present_values[None])[2][0]))
    point = jax.tree.map(lambda x: x[worst], held.at)
    slopes = np.asarray(
        _quantity_gradient(
            _robot_without_ratings(held.robot),
            ratings(held.robot),
            names,
            jnp.asarray(present_values),
            point,
            _computed_name(held.requirement),
        )
    )
    slopes = slopes / held.requirement.quantity.factor * (1 if held.requirement.least else -1)
    by_name = params.parameters_by_name(held.robot)
    changes = []
    for k, name in enumerate(names):
        if name == CELLS:
            bounds, unit = (1.0, 100.0), "-"
        else:
            bounds, unit = by_name[name].spec.bounds, by_name[name].spec.unit
        if present_values[k] <= 0:
            continue
        low, high = max(bounds[0], REACH[0] * present_values[k]), min(bounds[1], REACH[1] * present_values[k])
        uphill = slopes[k] if np.isfinite(slopes[k]) else 0.0
        if outcome.margin is not None and uphill == 0:
            continue  # no influence
        # Without a value the derivative is not informative, so both directions are tried.
        ends = (low, high) if outcome.margin is None or uphill == 0 else (high if uphill > 0 else low,)
        options = [v for end in ends if (v := _nearest_value(held, name, present_values[k], end)) is not None]
        if options:
            nearest_value = min(options, key=lambda v: abs(math.log(v / present_values[k])))
            sense = 1 if held.requirement.least else -1
            changes.append(
                ParameterChange(name, float(present_values[k]), nearest_value, unit, float(sense * slopes[k]))
            )
    return changes


def _nearest_value(held: _QuantityOfRobot, name: str, begin: float, end: float) -> float | None:
    """Parameter value nearest to `begin`, in the direction of `end`, that meets the requirement. None if there is
    none.
    """
    if begin == end:
        return None

    def meets(values: np.ndarray) -> np.ndarray:
        return held.worst(np.stack([_row_with_value(held, name, v) for v in values])) >= 0

    def steps(a: float, b: float, count: int) -> np.ndarray:
        if name == CELLS:
            integer_steps = np.arange(round(min(a, b)), round(max(a, b)) + 1, dtype=float)
            return (integer_steps if a < b else integer_steps[::-1])[1:]
        return np.geomspace(a, b, count + 1)[1:]

    ladder = steps(begin, end, LADDER)
    good = np.flatnonzero(meets(ladder))
    if not good.size:
        return None
    first_place = int(good[0])
    if name == CELLS:
        return float(ladder[first_place])
    a, b = (begin if first_place == 0 else ladder[first_place - 1]), ladder[first_place]
    for _ in range(3):
        finer = steps(a, b, ROWS)
        places_that_meet = np.flatnonzero(meets(finer))
        k = int(places_that_meet[0]) if places_that_meet.size else len(finer) - 1
        a, b = (a if k == 0 else finer[k - 1]), finer[k]
    # Rounded to few digits, away from `begin`. Each rounded value is tested.
    for digits in (DIGITS, DIGITS + 2, DIGITS + 4):
        up = end > begin
        step = 10.0 ** (math.floor(math.log10(abs(b))) - digits + 1)
        rounded = float(f"{(math.ceil if up else math.floor)(b / step - (1e-9 if up else -1e-9)) * step:.{digits}g}")
        if min(begin, end) <= rounded <= max(begin, end) and meets(np.array([rounded]))[0]:
            return rounded
    return float(b)


def count_outcomes(outcomes: Sequence[RequirementOutcome]) -> Mapping[str, int]:
    """Numbers of met and missed requirements."""
    met = sum(o.met for o in outcomes)
    return {"met": met, "missed": len(outcomes) - met}
