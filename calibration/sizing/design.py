"""A design as numbers, its robot, and its margins to requirements and ratings of parts."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Json, Names
from calibration.data.requirements_file import Requirement, Requirements
from calibration.sizing import sheet
from calibration.sizing.part_options import PartOptions
from mmrjax.derived.requirements import (
    NODES,
    QUANTITIES,
    EnvelopePoint,
    Ratings,
    evaluate_requirement,
    thermal_margin,
    travel_quantities,
)
from mmrjax.model import params
from mmrjax.model.quantities import CHARGE, SLOPE
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED

#: Continuous numbers of a design, for which the search uses logarithms: total ratio, rolling radius [m], cells in
#: parallel.
CONTINUOUS = ("ratio", "radius", "parallel")
#: Quantities that can be minimised: name, unit and description.
OBJECTIVES = {
    "mass": ("kg", "mass without payload"),
    "energy": ("Wh/m", "energy per metre"),
    "cost": ("EUR", "price of motors and gearboxes"),
}
#: Requirements on continuous travel, at whose points the ratings of the parts apply.
LASTING = tuple(q.column for q in QUANTITIES.values() if q.group in ("travel", "payload"))
#: Ratings of parts.
RATED = ("winding", "motor speed", "gearbox input speed", "gearbox torque", "cell current")


class Design(eqx.Module):
    """One or more designs as numbers. Every field can have a batch axis.

    Attributes:
        continuous: logarithms of `CONTINUOUS`.
        drive, cell: values of the chosen drive and cell, by name, as in `PartOptions`.
        cells: number of cells in series.
    """

    continuous: Float[Array, "... 3"]
    drive: Mapping[str, Array]
    cell: Mapping[str, Array]
    cells: Array


def build_robot(robot: Robot, base_mass: float, configuration: str, design: Design) -> tuple[Robot, Ratings]:
    """Robot of a design, derived from an initial robot, and the ratings of its parts. Can be traced by JAX.

    The masses of motors, gearboxes and cells replace those of the initial robot. The voltage of a cell depends on the
    used share of its capacity as in the initial robot. Parallel cells divide its resistance by their number.
    """
    ratio, radius, parallel = (jnp.exp(design.continuous[..., k]) for k in range(3))
    drive, cell = design.drive, design.cell
    added_mass = drive["mass"] + design.cells * parallel * cell["mass"] - base_mass
    values: Json = {
        **{f"motor.{key}": drive[key] for key in (
            "resistance", "torque_constant", "friction_coulomb", "friction_viscous", "inertia", "inductance",
            "resistance_thermal_winding", "resistance_thermal_housing",
        )},
        "gearbox.ratio": ratio, "gearbox.efficiency_load": drive["efficiency"],
        "battery.capacity": parallel * cell["capacity"], "battery.voltage_full": cell["voltage_full"],
        "battery.resistance": cell["resistance"] / parallel,
        **{f"{name}.mass": chassis.mass + added_mass for name, chassis in robot.configurations.items()},
        f"{configuration}.radius": radius,
    }  # fmt: skip
    ratings = Ratings(design.cells, cell["cutoff"], drive["temperature"], drive["torque"])
    return params.replace(robot, values), ratings


class SizingTask(eqx.Module):
    """Requirements as points and demands. For each design, the balances are solved once per point.

    Attributes:
        robot: initial robot, with one cell (see `sheet`).
        configuration: index of the configuration to be sized.
        base_mass: mass of the initial parts in the robot's mass [kg].
        points: evaluation points, shape (points,).
        middle: index of the point in the middle of the envelope, at which energy is evaluated.
        demands: requirements, each with the indices of its points.
        travelling: indices of the points at which the ratings of the parts apply.
    """

    robot: Robot
    configuration: str = eqx.field(static=True)
    base_mass: float = eqx.field(static=True)
    points: EnvelopePoint
    middle: int = eqx.field(static=True)
    demands: tuple[tuple[Requirement, tuple[int, ...]], ...] = eqx.field(static=True)
    travelling: tuple[int, ...] = eqx.field(static=True)

    @property
    def labels(self) -> Names:
        """Label of each margin of `evaluate_design`."""
        return (*(requirement_label(r) for r, _ in self.demands), *RATED)


def build_sizing_task(robot: Robot, requirements: Requirements, options: PartOptions) -> SizingTask:
    """Evaluation points and demands of requirements. Points are the corners of each envelope, without repeats.

    A required slope or payload is a condition in which the robot must travel. Ratings of parts apply at points of
    continuous travel: those of requirements in `LASTING` or, without such requirements, the middle of the envelope.
    """
    name = requirements.envelope.configuration or robot.configurations.names[0]
    index_of_point: dict[tuple[float, ...], int] = {}
    envelope_points: list[EnvelopePoint] = []

    def point_index(point: EnvelopePoint) -> int:
        coordinates = tuple(float(np.asarray(x)) for x in jax.tree.leaves(point))
        if coordinates not in index_of_point:
            index_of_point[coordinates] = len(envelope_points)
            envelope_points.append(point)
        return index_of_point[coordinates]

    demands = []
    for r in requirements.each:
        points_of_envelope = sheet.envelope_points(robot, r)
        indices = [
            tuple(point_index(p) for p in corner) for corner in _envelope_corners(robot, r, points_of_envelope)
        ]
        demands.append((r, tuple(k for corner in dict.fromkeys(indices) for k in corner)))
    envelope = requirements.envelope
    middle_demand = Requirement("speed_m_s", 0.0, True, dataclasses.replace(
        envelope, payload_kg=(sum(envelope.payload_kg) / 2,) * 2, slope_deg=(sum(envelope.slope_deg) / 2,) * 2,
        state_of_charge=(sum(envelope.state_of_charge) / 2,) * 2,
        supply_voltage_V=None if envelope.supply_voltage_V is None else (sum(envelope.supply_voltage_V) / 2,) * 2,
    ))  # fmt: skip
    middle = point_index(jax.tree.map(lambda x: x[0], sheet.envelope_points(robot, middle_demand)))
    travelling = tuple(sorted({k for r, indices in demands if r.name in LASTING for k in indices})) or (middle,)
    points: EnvelopePoint = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *envelope_points)
    one_cell = params.without_weak_types(
        dataclasses.replace(robot, battery=dataclasses.replace(robot.battery, cells=1))
    )
    return SizingTask(one_cell, name, options.base_mass, points, middle, tuple(demands), travelling)


def requirement_label(requirement: Requirement) -> str:
    duty = ""
    if requirement.name == "endurance_min":
        duty = f" driving {100 * requirement.share:g} % of the time" if requirement.share else " standing still"
    return f"{requirement.quantity.label}{duty}"


def _envelope_corners(
    robot: Robot, requirement: Requirement, envelope: EnvelopePoint
) -> list[tuple[EnvelopePoint, ...]]:
    """Points of a requirement, grouped by the corners of its envelope."""
    point_count = len(np.asarray(envelope.payload))
    points = [jax.tree.map(lambda x, k=k: x[k], envelope) for k in range(point_count)]
    if requirement.name == "mass_kg" or (requirement.name == "endurance_min" and not requirement.share):
        return [(points[0],)]
    low, high = requirement.envelope.charge
    ends = {SLOPE: requirement.envelope.slope_deg, CHARGE: (low, high)}
    corners = [
        p
        for p in points
        if (SLOPE not in requirement.quantity.axes or float(p.slope_deg) in ends[SLOPE])
        and (CHARGE not in requirement.quantity.axes or float(p.charge) in ends[CHARGE])
        and float(p.payload) in requirement.envelope.payload_kg
    ]
    if requirement.name == "slope_deg":
        return [(dataclasses.replace(p, slope_deg=jnp.asarray(float(requirement.limit or 0.0))),) for p in corners]
    if requirement.name == "payload_kg":
        return [(dataclasses.replace(p, payload=jnp.asarray(float(requirement.limit or 0.0))),) for p in corners]
    if requirement.name == "endurance_min":
        # Nodes of the integral, and end of the charge.
        nodes = (np.polynomial.legendre.leggauss(NODES)[0] + 1) / 2
        charges = [*(high + (requirement.envelope.charge_end - high) * nodes), requirement.envelope.charge_end]
        return [tuple(dataclasses.replace(p, charge=jnp.asarray(float(c))) for c in charges) for p in corners]
    return [(p,) for p in corners]


def evaluate_design(task: SizingTask, design: Design) -> tuple[Array, Array]:
    """Objectives (as in `OBJECTIVES`) and margins (as in `SizingTask.labels`) of one design. Can be traced by JAX.

    Margins are shares of the required or permitted value. A requirement is met if its margin is not negative.
    """
    robot, ratings = build_robot(task.robot, task.base_mass, task.configuration, design)
    states = jax.vmap(lambda p: travel_quantities(robot, p, ratings)[0])(task.points)
    mass = jnp.asarray(robot.configurations[task.configuration].mass)
    energy = states["energy_per_metre_Wh"][task.middle] / 3600.0

    def states_at(indices: tuple[int, ...]) -> tuple[EnvelopePoint, dict[str, Array]]:
        return jax.tree.map(lambda x: x[np.array(indices, int)], (task.points, states))

    margins = [
        _demand_margin(task, requirement, robot, ratings, *states_at(indices))
        for requirement, indices in task.demands
    ]
    margins += _rating_margins(design, robot, *states_at(task.travelling))
    objectives = jnp.stack([mass, energy, jnp.asarray(design.drive["cost"])])
    return objectives, jnp.stack(margins)


def _rating_margins(design: Design, robot: Robot, points: EnvelopePoint, states: Mapping[str, Array]) -> list[Array]:
    """Margins to the ratings of the parts, as in `RATED`."""
    battery_current = jnp.max(jnp.where(points.battery > 0.5, states["battery"], 0.0))
    return [
        jnp.min(_heat_margins(robot, points, states["current"], design.drive["temperature"])),
        1 - jnp.max(states["motor_speed_rpm"]) / design.drive["speed_motor"],
        1 - jnp.max(states["motor_speed_rpm"]) / design.drive["speed_gearbox"],
        1 - jnp.max(states["gearbox_Nm"]) / design.drive["torque"],
        1 - battery_current / (jnp.exp(design.continuous[..., 2]) * design.cell["current"]),
    ]


def _demand_margin(
    task: SizingTask, requirement: Requirement, robot: Robot, ratings: Ratings, points: EnvelopePoint,
    states: Mapping[str, Array],
) -> Array:  # fmt: skip
    travel_margin = jnp.min(jnp.minimum(states["left"], 1.0))
    cell_voltage_margin = jnp.min(jnp.minimum(states["cell"] / ratings.voltage_cutoff, 1.0))
    if requirement.name == "mass_kg":
        margin = 1 - jnp.asarray(robot.configurations[task.configuration].mass) / _positive_limit(requirement)
        return -margin if requirement.least else margin
    if requirement.name == "slope_deg":
        return jnp.minimum(travel_margin, cell_voltage_margin)
    if requirement.name == "payload_kg":
        heat_margin = jnp.min(_heat_margins(robot, points, states["current"], jnp.asarray(ratings.temperature)))
        torque_margin = 1 - jnp.max(states["gearbox_Nm"]) / ratings.torque
        return jnp.min(jnp.stack([travel_margin, cell_voltage_margin, heat_margin, torque_margin]))
    if requirement.name == "endurance_min":
        return _endurance_margin(requirement, robot, ratings, states)
    if requirement.limit is None:  # ratings of the parts, required of every design
        return jnp.minimum(travel_margin, cell_voltage_margin)
    if requirement.name not in states:  # not a quantity of straight travel
        value, outcome = jax.vmap(lambda p: evaluate_requirement(robot, p, ratings, requirement.name))(points)
        value = value / requirement.quantity.factor
        travel_margin = jnp.min(jnp.where(outcome == CONVERGED, 1.0, -1.0))
    else:
        value = states[requirement.name] / requirement.quantity.factor
    margin = (
        jnp.min(value / _positive_limit(requirement) - 1)
        if requirement.least
        else jnp.min(1 - value / _positive_limit(requirement))
    )
    if requirement.name == "winding_C":
        margin = jnp.min(_heat_margins(robot, points, states["current"], jnp.asarray(_positive_limit(requirement))))
    return jnp.min(jnp.stack([margin, travel_margin, cell_voltage_margin]))


def _positive_limit(requirement: Requirement) -> float:
    return max(float(requirement.limit or 0.0), 1e-9)


def _heat_margins(robot: Robot, points: EnvelopePoint, current: Array, limit: Array) -> Array:
    return jax.vmap(lambda p, i: jnp.asarray(thermal_margin(robot, p, i, limit)))(points, current)


def _endurance_margin(requirement: Requirement, robot: Robot, ratings: Ratings, states: Mapping[str, Array]) -> Array:
    """Margin of the time until the charge ends, or until the cells reach their cut-off voltage."""
    battery = robot.battery
    capacity_used = battery.capacity * (requirement.envelope.charge[1] - requirement.envelope.charge_end)
    limit = requirement.quantity.factor * _positive_limit(requirement)
    if not requirement.share:
        end_margin = (
            battery.voltage_cell(0.0, battery.capacity * (1 - requirement.envelope.charge_end))
            / ratings.voltage_cutoff
            - 1
        )
        return jnp.minimum(capacity_used / battery.current(0.0) / limit - 1, end_margin)
    weights = jnp.asarray(np.polynomial.legendre.leggauss(NODES)[1] / 2)
    motor_current = (states["battery"] - battery.current_other) * requirement.share
    battery_current = jnp.asarray(battery.current(motor_current)).reshape(-1, NODES + 1)
    time = capacity_used * jnp.sum(weights / battery_current[:, :NODES], axis=1)
    travel_margin, cell_voltage_margin = (
        jnp.min(jnp.minimum(states["left"], 1.0)),
        jnp.min(states["cell"] / ratings.voltage_cutoff),
    )
    return jnp.min(jnp.stack([jnp.min(time) / limit - 1, travel_margin, cell_voltage_margin]))
