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


def fill_in_ratings(robot: Robot, requirements: Requirements) -> Requirements:
    """Requirements in which missing limits are replaced by the robot's own ratings.

    Raises:
        BadConfiguration: the robot has no such rating.
    """
    ratings_by_name = {
        "winding_C": robot.motor.temperature_limit, "motor_speed_rpm": robot.motor.speed_limit,
        "gearbox_speed_rpm": robot.gearbox.speed_limit, "gearbox_Nm": robot.gearbox.torque_limit,
    }  # fmt: skip
    filled = []
    for requirement in requirements.each:
        limit = requirement.limit
        if limit is None:
            rating = ratings_by_name[requirement.name]
            if rating is None:
                raise BadConfiguration(
                    f"{requirements.source}, {requirement.name}: the robot states no rating; state a number"
                )
            limit = rating / requirement.quantity.factor
        filled.append(dataclasses.replace(requirement, limit=limit))
    return dataclasses.replace(requirements, each=tuple(filled))


def reject_impossible(robot: Robot, requirements: Requirements) -> None:
    """Rejects requirements that cannot be evaluated for this robot.

    Raises:
        BadConfiguration: the robot lacks a configuration, cannot make a turn, or has no stated stance for a posture.
            Or a slope of the envelope is too steep for the surface, whatever drives the robot: tan α above μ_s.
    """
    for r in requirements.each:
        envelope = r.envelope
        place = f"{requirements.source}, {r.name}"
        if envelope.configuration:
            problem = f"the robot has no configuration {envelope.configuration}"
            stated_word(envelope.configuration, robot.configurations, place, problem)
        is_turn = r.quantity.group in ("turn", "across")
        if is_turn and (reason := turn_error(robot, (_configuration_name(robot, envelope),))):
            raise BadConfiguration(f"{place}: {reason}")
        if r.quantity.group == "posture" and (reason := reason_without_stance(robot)):
            raise BadConfiguration(f"{place}: {reason}")
        chassis = robot.configurations[_configuration_name(robot, envelope)]
        friction = float(chassis.ground.friction.static) * adhesion_ratio(
            envelope.surface, float(chassis.on_tracks) > 0.5
        )
        steepest = math.degrees(math.atan(friction))
        if SLOPE in r.quantity.axes and envelope.slope_deg[1] > steepest:
            raise BadConfiguration(
                f"{place}: the envelope's slope_deg goes up to {envelope.slope_deg[1]:g}; {envelope.surface} holds "
                f"{_configuration_name(robot, envelope)} up to {steepest:.1f} deg (adhesion {friction:.2f}), "
                "whatever drives it"
            )


def _configuration_name(robot: Robot, envelope: Envelope) -> str:
    return envelope.configuration or robot.configurations.names[0]


def envelope_points(robot: Robot, requirement: Requirement) -> EnvelopePoint:
    """Points of a requirement's envelope: the ends of each range and values between, shape (points,).

    A condition without influence on the quantity has one value. The number of points depends only on the quantity.
    """
    envelope = requirement.envelope
    axes = requirement.quantity.axes
    ambient_range = envelope.ambient_C or (float(robot.motor.temperature_ambient),) * 2
    ranges = {
        PAYLOAD: envelope.payload_kg,
        SLOPE: envelope.slope_deg,
        CHARGE: envelope.charge,
        AMBIENT: ambient_range,
    }
    values = [np.linspace(*ranges[a], VALUES[a]) if a in axes else np.array([ranges[a][-1]]) for a in AXES]
    payload, slope, charge, ambient = (x.ravel() for x in np.meshgrid(*values, indexing="ij"))
    name = _configuration_name(robot, envelope)
    on_tracks = float(robot.configurations[name].on_tracks) > 0.5

    def at_all_points(x: float) -> Float[Array, " points"]:
        return jnp.full(len(payload), x, float)

    return EnvelopePoint(
        configuration=jnp.full(len(payload), robot.configurations.index(name)),
        adhesion=at_all_points(adhesion_ratio(envelope.surface, on_tracks)),
        adhesion_lateral=at_all_points(lateral_ratio(envelope.surface, on_tracks)),
        battery=at_all_points(float(envelope.battery)),
        charge=jnp.asarray(charge), charge_end=at_all_points(envelope.charge_end),
        share=at_all_points(requirement.share),
        slope_deg=jnp.asarray(slope), payload=jnp.asarray(payload), ambient=jnp.asarray(ambient),
        tread=at_all_points(MM * requirement.tread_mm),
    )  # fmt: skip


def _with_parameters(robot: Robot, ratings: Ratings, names: Names, theta: Array) -> tuple[Robot, Ratings]:
    """Robot with parameters from a vector, and its ratings, which include `battery.cells`."""
    values = dict(zip(names, theta, strict=True))
    cells = values.pop(CELLS)
    return params.replace(robot, values), dataclasses.replace(ratings, cells=cells)


def _robot_without_ratings(robot: Robot) -> Robot:
    """Robot with one cell and default ratings.

    Cells and ratings are separate numbers, so that all robots share one program.
    """
    default_battery = type(robot.battery)()
    default_motor = type(robot.motor)()
    default_gearbox = type(robot.gearbox)()
    limits = ("voltage_charge", "voltage_cutoff", "delay_cutoff", "current_limit", "current_charge")
    robot = dataclasses.replace(
        robot,
        battery=dataclasses.replace(
            robot.battery, cells=1, **{name: getattr(default_battery, name) for name in limits}
        ),
        motor=dataclasses.replace(
            robot.motor,
            **{n: getattr(default_motor, n) for n in ("temperature_limit", "voltage_limit", "speed_limit")},
        ),
        gearbox=dataclasses.replace(
            robot.gearbox, **{name: getattr(default_gearbox, name) for name in ("speed_limit", "torque_limit")}
        ),
    )
    return params.without_weak_types(robot)


@compiled
def _quantity_at_points(
    robot: Robot,
    ratings: Ratings,
    names: Names,
    rows: Float[Array, "rows parameters"],
    points: EnvelopePoint,
    name: str,
) -> tuple[Array, Array]:
    """Values and outcomes of a quantity for robots (rows of parameters) at points, shape (rows, points)."""

    def evaluate(theta: Array, point: EnvelopePoint) -> tuple[Array, Array]:
        changed, changed_ratings = _with_parameters(robot, ratings, names, theta)
        return evaluate_requirement(changed, point, changed_ratings, name)

    return jax.vmap(lambda theta: jax.vmap(lambda p: evaluate(theta, p))(points))(rows)


@compiled
def _quantity_gradient(
    robot: Robot, ratings: Ratings, names: Names, theta: Array, point: EnvelopePoint, name: str
) -> Array:
    """Derivative of a quantity at one point with respect to the parameters."""

    def value(theta: Array) -> Array:
        changed, changed_ratings = _with_parameters(robot, ratings, names, theta)
        return evaluate_requirement(changed, point, changed_ratings, name)[0]

    return jax.grad(value)(theta)


@dataclasses.dataclass(frozen=True)
class _QuantityOfRobot:
    """The quantity of a requirement over its envelope, as a function of the parameters that may change."""

    robot: Robot
    requirement: Requirement
    names: Names

    @property
    def points(self) -> EnvelopePoint:
        return envelope_points(self.robot, self.requirement)

    def evaluate(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values in the unit of the name, outcomes, and margins (-inf without a value), shape (rows, points)."""
        requirement = self.requirement
        points = self.points
        chunks = []
        robot = _robot_without_ratings(self.robot)
        rating_values = ratings(self.robot)
        for first in range(0, len(rows), ROWS):
            chunk_rows = rows[np.minimum(np.arange(first, first + ROWS), len(rows) - 1)]
            chunk_results = jax.device_get(
                _quantity_at_points(
                    robot, rating_values, self.names, jnp.asarray(chunk_rows), points, _computed_name(requirement)
                )
            )
            chunks.append([x[: len(rows) - first] for x in chunk_results])
        value, outcome = (np.concatenate(x) for x in zip(*chunks, strict=True))
        value = value / requirement.quantity.factor
        has_value = (outcome == CONVERGED) & np.isfinite(value)
        assert requirement.limit is not None  # see `fill_in_ratings`
        margin = (value - requirement.limit) * (1 if requirement.least else -1)
        return value, outcome, np.where(has_value, margin, -np.inf)

    def worst_margins(self, rows: np.ndarray) -> np.ndarray:
        """Margin at the worst corner, shape (rows,)."""
        return self.evaluate(rows)[2].min(axis=1)


def _computed_name(requirement: Requirement) -> str:
    """Name under which a quantity is computed. Names of the same quantity share a program."""
    return "speed_m_s" if requirement.name == "speed_end_of_charge_m_s" else requirement.name


def check_requirements(
    robot: Robot,
    requirements: Requirements,
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
    reject_impossible(robot, requirements)
    requirements = fill_in_ratings(robot, requirements)
    quantities = []
    for r in requirements.each:
        configuration = _configuration_name(robot, r.envelope)
        of_levers = OF_LEVERS if r.quantity.group == "posture" else ()
        by_name = params.parameters_by_name(robot)
        names = (*CHANGEABLE, *(f"{configuration}.{n}" for n in OF_CONFIGURATION))
        quantities.append(
            _QuantityOfRobot(
                robot, r, (*{name: by_name[name] for name in names if name in by_name}, *of_levers, CELLS)
            )
        )
    outcomes = []
    for number, quantity in enumerate(quantities, 1):
        tell(progress_remark("requirement", number, len(quantities), quantity.requirement.quantity.label))
        outcomes.append(_check_requirement(quantity))
    if not changes:
        return tuple(outcomes)
    missed = [number for number, o in enumerate(outcomes) if not o.met]
    outcomes_with_changes = list(outcomes)
    for n, number in enumerate(missed, 1):
        tell(progress_remark("changes", n, len(missed), quantities[number].requirement.quantity.label))
        outcomes_with_changes[number] = _add_changes(quantities[number], outcomes[number], quantities, outcomes)
    return tuple(outcomes_with_changes)


def _present_values(quantity: _QuantityOfRobot) -> np.ndarray:
    value_of_name = params.values_by_name(quantity.robot)
    return np.array(
        [quantity.robot.battery.cells if name == CELLS else value_of_name[name] for name in quantity.names], float
    )


def _check_requirement(quantity: _QuantityOfRobot) -> RequirementOutcome:
    r = quantity.requirement
    value, outcome, margin = (x[0] for x in quantity.evaluate(_present_values(quantity)[None]))
    # A point without a value is worse than any other. Among points with the same outcome, the largest is the worst
    # corner.
    worst = int(np.argmin(margin))
    status = STATUSES[outcome[worst]]
    has_value = np.isfinite(margin[worst])
    if not has_value and status == STATUSES[CONVERGED]:  # beyond all bounds: a temperature that never settles
        status = "unbounded"
    return RequirementOutcome(
        r,
        float(value[worst]) if has_value else None,
        float(margin[worst]) if has_value else None,
        status,
        _named_corner(quantity, worst),
    )


def _named_corner(quantity: _QuantityOfRobot, k: int) -> Json:
    """A point as entries with the names of a requirements file."""
    r, points = quantity.requirement, quantity.points
    envelope = r.envelope
    entries = {
        PAYLOAD: ("payload_kg", points.payload), SLOPE: ("slope_deg", points.slope_deg),
        AMBIENT: ("ambient_C", points.ambient),
        CHARGE: ("state_of_charge" if envelope.battery else "supply_voltage_V", points.charge),
    }  # fmt: skip
    corner: Json = {entries[axis][0]: round(float(np.asarray(entries[axis][1])[k]), 9) for axis in r.quantity.axes}
    if r.name == "endurance_min":
        low = envelope.charge_end
        corner |= {
            "duty": "driving" if r.share else "standing",
            "share": r.share,
            "state_of_charge": [low, envelope.charge[1]],
        }
    if r.name == STAIRS:
        corner[TREAD] = r.tread_mm
    return {"configuration": _configuration_name(quantity.robot, envelope), "surface": envelope.surface, **corner}


def _add_changes(
    quantity: _QuantityOfRobot,
    outcome: RequirementOutcome,
    quantities: Sequence[_QuantityOfRobot],
    outcomes: Sequence[RequirementOutcome],
) -> RequirementOutcome:
    changes = _find_changes(quantity, outcome)
    if not changes:
        return outcome
    rows = np.stack([_row_with_value(quantity, change.parameter, change.after) for change in changes])
    broken: list[list[str]] = [[] for _ in changes]
    for other, present_outcome in zip(quantities, outcomes, strict=True):
        if other is quantity or not present_outcome.met:
            continue
        # Other configurations have other names. Common names are changed.
        parameter_rows = np.tile(_present_values(other), (len(rows), 1))
        for k, name in enumerate(quantity.names):
            if name in other.names:
                parameter_rows[:, other.names.index(name)] = rows[:, k]
        for names, margin in zip(broken, other.worst_margins(parameter_rows), strict=True):
            names += [other.requirement.name] if margin < 0 else []
    with_breaks = [
        dataclasses.replace(change, breaks=tuple(dict.fromkeys(names)))
        for change, names in zip(changes, broken, strict=True)
    ]
    order = sorted(
        with_breaks, key=lambda change: (len(change.breaks) > 0, abs(math.log(change.after / change.before)))
    )
    return dataclasses.replace(outcome, change=tuple(order))


def _row_with_value(quantity: _QuantityOfRobot, name: str, value: float) -> np.ndarray:
    row = _present_values(quantity)
    row[quantity.names.index(name)] = value
    return row


def _find_changes(quantity: _QuantityOfRobot, outcome: RequirementOutcome) -> list[ParameterChange]:
    """Single changes with which a requirement is met.

    The direction follows from the derivative at the worst corner. The nearest value that meets the requirement at
    every corner is found by a coarse search and bisection. Each result is verified.
    """
    present_values = _present_values(quantity)
    names = quantity.names
    worst = int(np.argmin(quantity.evaluate(present_values[None])[2][0]))
    point = jax.tree.map(lambda x: x[worst], quantity.points)
    gradient = np.asarray(
        _quantity_gradient(
            _robot_without_ratings(quantity.robot),
            ratings(quantity.robot),
            names,
            jnp.asarray(present_values),
            point,
            _computed_name(quantity.requirement),
        )
    )
    gradient = gradient / quantity.requirement.quantity.factor * (1 if quantity.requirement.least else -1)
    by_name = params.parameters_by_name(quantity.robot)
    changes = []
    for k, name in enumerate(names):
        if name == CELLS:
            bounds = (1.0, 100.0)
            unit = "-"
        else:
            bounds, unit = by_name[name].spec.bounds, by_name[name].spec.unit
        if present_values[k] <= 0:
            continue
        low = max(bounds[0], REACH[0] * present_values[k])
        high = min(bounds[1], REACH[1] * present_values[k])
        slope = gradient[k] if np.isfinite(gradient[k]) else 0.0
        if outcome.margin is not None and slope == 0:
            continue  # no influence
        # Without a value the derivative is not informative, so both directions are tried.
        ends = (low, high) if outcome.margin is None or slope == 0 else (high if slope > 0 else low,)
        candidates = [v for end in ends if (v := _nearest_value(quantity, name, present_values[k], end)) is not None]
        if candidates:
            nearest_value = min(candidates, key=lambda v: abs(math.log(v / present_values[k])))
            sense = 1 if quantity.requirement.least else -1
            changes.append(
                ParameterChange(name, float(present_values[k]), nearest_value, unit, float(sense * gradient[k]))
            )
    return changes


def _nearest_value(quantity: _QuantityOfRobot, name: str, begin: float, end: float) -> float | None:
    """Parameter value nearest to `begin`, in the direction of `end`, that meets the requirement. None if there is
    none.
    """
    if begin == end:
        return None

    def meets(values: np.ndarray) -> np.ndarray:
        return quantity.worst_margins(np.stack([_row_with_value(quantity, name, v) for v in values])) >= 0

    def values_between(a: float, b: float, count: int) -> np.ndarray:
        if name == CELLS:
            integer_steps = np.arange(round(min(a, b)), round(max(a, b)) + 1, dtype=float)
            return (integer_steps if a < b else integer_steps[::-1])[1:]
        return np.geomspace(a, b, count + 1)[1:]

    coarse = values_between(begin, end, LADDER)
    meeting = np.flatnonzero(meets(coarse))
    if not meeting.size:
        return None
    first = int(meeting[0])
    if name == CELLS:
        return float(coarse[first])
    a = begin if first == 0 else coarse[first - 1]
    b = coarse[first]
    for _ in range(3):
        finer = values_between(a, b, ROWS)
        meeting_finer = np.flatnonzero(meets(finer))
        k = int(meeting_finer[0]) if meeting_finer.size else len(finer) - 1
        a = a if k == 0 else finer[k - 1]
        b = finer[k]
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
