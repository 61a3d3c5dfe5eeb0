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
    thermal_margin,
    travel_quantities,
)
from mmrjax.derived.requirements import evaluate_requirement as requirement
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
    d, c = design.drive, design.cell
    added_mass = d["mass"] + design.cells * parallel * c["mass"] - base_mass
    values: Json = {
        **{f"motor.{key}": d[key] for key in (
            "resistance", "torque_constant", "friction_coulomb", "friction_viscous", "inertia", "inductance",
            "resistance_thermal_winding", "resistance_thermal_housing",
        )},
        "gearbox.ratio": ratio, "gearbox.efficiency_load": d["efficiency"],
        "battery.capacity": parallel * c["capacity"], "battery.voltage_full": c["voltage_full"],
        "battery.resistance": c["resistance"] / parallel,
        **{f"{name}.mass": chassis.mass + added_mass for name, chassis in robot.configurations.items()},
        f"{configuration}.radius": radius,
    }  # fmt: skip
    rated = Ratings(design.cells, c["cutoff"], d["temperature"], d["torque"])
    return params.replace(robot, values), rated


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


def build_sizing_task(robot: Robot, asked: Requirements, options: PartOptions) -> SizingTask:
    """Evaluation points and demands of requirements. Points are the corners of each envelope, without repeats.

    A required slope or payload is a condition in which the robot must travel. Ratings of parts apply at points of
    continuous
    travel: those of such requirements or, if there are none, the middle of the envelope.
    """
    name = asked.envelope.configuration or robot.configurations.names[0]
    index: dict[tuple[float, ...], int] = {}
    envelope_points: list[EnvelopePoint] = []

    def row(point: EnvelopePoint) -> int:
        key = tuple(float(np.asarray(x)) for x in jax.tree.leaves(point))
        if key not in index:
            index[key] = len(envelope_points)
            envelope_points.append(point)
        return index[key]

    demands = []
    for r in asked.each:
        envelope = sheet.envelope_points(robot, r)
        rows = [tuple(row(p) for p in corner) for corner in _envelope_corners(robot, r, envelope)]
        demands.append((r, tuple(k for corner in dict.fromkeys(rows) for k in corner)))
    e = asked.envelope
    middle_demand = Requirement("speed_m_s", 0.0, True, dataclasses.replace(
        e, payload_kg=(sum(e.payload_kg) / 2,) * 2, slope_deg=(sum(e.slope_deg) / 2,) * 2,
        state_of_charge=(sum(e.state_of_charge) / 2,) * 2,
        supply_voltage_V=None if e.supply_voltage_V is None else (sum(e.supply_voltage_V) / 2,) * 2,
    ))  # fmt: skip
    middle = row(jax.tree.map(lambda x: x[0], sheet.envelope_points(robot, middle_demand)))
    travelling = tuple(sorted({k for r, rows in demands if r.name in LASTING for k in rows})) or (middle,)
    points: EnvelopePoint = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *envelope_points)
    one_cell = params.without_weak_types(
        dataclasses.replace(robot, battery=dataclasses.replace(robot.battery, cells=1))
    )
    return SizingTask(one_cell, name, options.base_mass, points, middle, tuple(demands), travelling)


def requirement_label(r: Requirement) -> str:
    extra = ""
    if r.name == "endurance_min":
        extra = f" driving {100 * r.share:g} % of the time" if r.share else " standing still"
    return f"{r.quantity.label}{extra}"


def _envelope_corners(robot: Robot, r: Requirement, at: EnvelopePoint) -> list[tuple[EnvelopePoint, ...]]:
    """Points of a requirement, grouped by the corners of its envelope."""
    count = len(np.asarray(at.payload))
    points = [jax.tree.map(lambda x, k=k: x[k], at) for k in range(count)]
    if r.name == "mass_kg" or (r.name == "endurance_min" and not r.share):
        return [(points[0],)]
    low, high = r.envelope.charge
    ends = {SLOPE: r.envelope.slope_deg, CHARGE: (low, high)}
    corners = [
        p
        for p in points
        if (SLOPE not in r.quantity.axes or float(p.slope_deg) in ends[SLOPE])
        and (CHARGE not in r.quantity.axes or float(p.charge) in ends[CHARGE])
        and float(p.payload) in r.envelope.payload_kg
    ]
    if r.name == "slope_deg":
        return [(dataclasses.replace(p, slope_deg=jnp.asarray(float(r.limit or 0.0))),) for p in corners]
    if r.name == "payload_kg":
        return [(dataclasses.replace(p, payload=jnp.asarray(float(r.limit or 0.0))),) for p in corners]
    if r.name == "endurance_min":
        # Nodes of the integral, and end of the charge.
        nodes = (np.polynomial.legendre.leggauss(NODES)[0] + 1) / 2
        charges = [*(high + (r.envelope.charge_end - high) * nodes), r.envelope.charge_end]
        return [tuple(dataclasses.replace(p, charge=jnp.asarray(float(c))) for c in charges) for p in corners]
    return [(p,) for p in corners]


def evaluate_design(asked: SizingTask, design: Design) -> tuple[Array, Array]:
    """Objectives (as in `OBJECTIVES`) and margins (as in `SizingTask.labels`) of one design. Can be traced by JAX.

    Margins are shares of the required or permitted value. A requirement is met if its margin is not negative.
    """
    robot, ratings = build_robot(asked.robot, asked.base_mass, asked.configuration, design)
    states = jax.vmap(lambda p: travel_quantities(robot, p, ratings)[0])(asked.points)
    mass = jnp.asarray(robot.configurations[asked.configuration].mass)
    energy = states["energy_per_metre_Wh"][asked.middle] / 3600.0

    def at_points(rows: tuple[int, ...]) -> tuple[EnvelopePoint, dict[str, Array]]:
        return jax.tree.map(lambda x: x[np.array(rows, int)], (asked.points, states))

    margins = [_demand_margin(asked, r, robot, ratings, *at_points(rows)) for r, rows in asked.demands]
    margins += _rating_margins(design, robot, *at_points(asked.travelling))
    objectives = jnp.stack([mass, energy, jnp.asarray(design.drive["cost"])])
    return objectives, jnp.stack(margins)


def _rating_margins(design: Design, robot: Robot, points: EnvelopePoint, states: Mapping[str, Array]) -> list[Array]:
    """Margins to the ratings of the parts, as in `RATED`."""
    battery = jnp.max(jnp.where(points.battery > 0.5, states["battery"], 0.0))
    return [
        jnp.min(_heat_margins(robot, points, states["current"], design.drive["temperature"])),
        1 - jnp.max(states["motor_speed_rpm"]) / design.drive["speed_motor"],
        1 - jnp.max(states["motor_speed_rpm"]) / design.drive["speed_gearbox"],
        1 - jnp.max(states["gearbox_Nm"]) / design.drive["torque"],
        1 - battery / (jnp.exp(design.continuous[..., 2]) * design.cell["current"]),
    ]


def _demand_margin(
    asked: SizingTask, r: Requirement, robot: Robot, ratings: Ratings, points: EnvelopePoint,
    states: Mapping[str, Array],
) -> Array:  # fmt: skip
    travels = jnp.min(jnp.minimum(states["left"], 1.0))
    cell_voltage_ratio = jnp.min(jnp.minimum(states["cell"] / ratings.voltage_cutoff, 1.0))
    if r.name == "mass_kg":
        share = 1 - jnp.asarray(robot.configurations[asked.configuration].mass) / _positive_limit(r)
        return -share if r.least else share
    if r.name == "slope_deg":
        return jnp.minimum(travels, cell_voltage_ratio)
    if r.name == "payload_kg":
        heat_margin = jnp.min(_heat_margins(robot, points, states["current"], jnp.asarray(ratings.temperature)))
        torque = 1 - jnp.max(states["gearbox_Nm"]) / ratings.torque
        return jnp.min(jnp.stack([travels, cell_voltage_ratio, heat_margin, torque]))
    if r.name == "endurance_min":
        return _endurance_margin(r, robot, ratings, states)
    if r.limit is None:  # ratings of the parts, required of every design
        return jnp.minimum(travels, cell_voltage_ratio)
    if r.name not in states:  # not a quantity of straight travel
        value, outcome = jax.vmap(lambda p: requirement(robot, p, ratings, r.name))(points)
        value, travels = value / r.quantity.factor, jnp.min(jnp.where(outcome == CONVERGED, 1.0, -1.0))
    else:
        value = states[r.name] / r.quantity.factor
    share = jnp.min(value / _positive_limit(r) - 1) if r.least else jnp.min(1 - value / _positive_limit(r))
    if r.name == "winding_C":
        share = jnp.min(_heat_margins(robot, points, states["current"], jnp.asarray(_positive_limit(r))))
    return jnp.min(jnp.stack([share, travels, cell_voltage_ratio]))


def _positive_limit(r: Requirement) -> float:
    return max(float(r.limit or 0.0), 1e-9)


def _heat_margins(robot: Robot, points: EnvelopePoint, current: Array, limit: Array) -> Array:
    return jax.vmap(lambda p, i: jnp.asarray(thermal_margin(robot, p, i, limit)))(points, current)


def _endurance_margin(r: Requirement, robot: Robot, ratings: Ratings, at: Mapping[str, Array]) -> Array:
    """Margin of the time until the charge ends, or until the cells reach their cut-off voltage."""
    battery = robot.battery
    capacity_used = battery.capacity * (r.envelope.charge[1] - r.envelope.charge_end)
    limit = r.quantity.factor * _positive_limit(r)
    if not r.share:
        end = battery.voltage_cell(0.0, battery.capacity * (1 - r.envelope.charge_end)) / ratings.voltage_cutoff - 1
        return jnp.minimum(capacity_used / battery.current(0.0) / limit - 1, end)
    weights = jnp.asarray(np.polynomial.legendre.leggauss(NODES)[1] / 2)
    motors = (at["battery"] - battery.current_other) * r.share
    current = jnp.asarray(battery.current(motors)).reshape(-1, NODES + 1)
    time = capacity_used * jnp.sum(weights / current[:, :NODES], axis=1)
    travels, cell_voltage_ratio = jnp.min(jnp.minimum(at["left"], 1.0)), jnp.min(at["cell"] / ratings.voltage_cutoff)
    return jnp.min(jnp.stack([jnp.min(time) / limit - 1, travels, cell_voltage_ratio]))
