"""Whether a table's readings lie where its robot's can be, before anything is fitted: mostly a matter of units."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from calibration.data.input_errors import BadData, number
from calibration.data.runs import Runs
from calibration.described import described
from calibration.inference import observers
from calibration.inference.fit_notes import Note, OffBy, SlopesIn, Turned
from calibration.inference.operating import operating_readings
from mmrjax.model import channels, params
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot

#: Factors between readings and robot beyond which a table is refused, and beyond which that is said.
REFUSED, SAID = 5.0, 2.0
#: Factor by which readings may still lie outside for another unit to explain them, or two channels to be off alike.
ALIKE = 1.3
#: Shortest history whose later half shows about what steady travel does [s].
UNDER_WAY = 0.25
#: Factor beyond which another unit may explain torque and current of a rig whose friction nobody knows.
FAR = 50.0
#: Friction of a robot nobody has calibrated, as factors on what its file states.
FRICTION = (0.1, 1.0, 4.0)
#: Channels that show torque: what they show depends on friction, of which nothing is known of a rig from nothing.
OF_TORQUE = ("total_current", "motor_current", "output_torque", "winding_temperature")
#: Factor by which readings that are turned round come nearer to the robot, where their sign is doubted.
NEARER = 2.0
#: Readings smaller than this share of the channel's largest tell no factor.
SMALL = 0.05
#: What a robot could show is nothing, below this share of the readings: the yaw rate of one that goes straight.
NOTHING = 1e-9
#: A slope in other units than degrees: of one of those [deg]; how well the current has to follow it.
SLOPES = {"radians": 180 / math.pi, "percent": math.degrees(0.01)}
FOLLOWS = 0.9


def check_ranges(runs: Runs, robot: Robot) -> list[Note]:
    """Refuse readings that no robot like this one shows under these conditions; return what should be said of others.

    Each channel's readings are compared with steady travel of the robot as its file states it, and with a tenth and
    four times its friction: the median factor by which they lie outside. Of histories, those that have settled.

    Raises:
        BadData: a factor beyond `REFUSED`; of histories, which need not get under way, only where a known confusion
            of units explains it.
    """
    runs = runs.of(robot)
    kind = observers.kind(runs)
    runs, measured, lasts = kind.settled(runs, steady=True)
    if not len(runs):
        return []
    _check_masses(runs, robot)
    runs, measured = runs.where(lasts >= UNDER_WAY), measured[lasts >= UNDER_WAY]
    if not len(runs) or any(float(c.torque_gravity) > 0 for c in robot.configurations.members):
        return []
    if not robot.rig.inherits:
        _check_gear(runs, measured, robot)
    conditions = runs.conditions(robot)
    possible = np.stack([operating_readings(_rubbing(robot, f), conditions) for f in FRICTION])
    # A robot that moves with less friction and has no speed with more of it stands: any speed is possible between.
    slow = np.array([c.zero_at_rest for c in robot.channels])
    possible = np.where(slow & np.isnan(possible) & np.isfinite(possible[0]), 0.0, possible)
    if not np.isfinite(possible).any():
        return []
    factors = {c: _factor(measured[:, k], possible[:, :, k]) for k, c in enumerate(robot.channels)}
    said: list[Note] = []
    for k, (channel, factor) in enumerate(factors.items()):
        off = max(factor, 1 / factor)
        unknown = not robot.rig.inherits and channel.name in OF_TORQUE
        if off <= (FAR if unknown else SAID):
            continue
        units = _units(channel, measured[:, k], possible[:, :, k], robot)
        if not units and (
            unknown or kind.axis or _slips(robot, channel, factor)
        ):  # what slides has speeds of its own
            continue
        typical = _factor(measured[:, k], possible[1:2, :, k])
        found = OffBy(
            channel.column,
            channel.unit,
            typical if units else factor,
            tuple(units),
            tuple(_others(channel, factors)),
            runs.layout.imposed_column,
        )
        if off > REFUSED:
            raise BadData(f"{runs.source}, {described(found)}")
        said.append(found)
    return [*said, *_turned(runs, measured, possible), *_slopes(runs, measured, possible[1], robot)]


def turned_signs(runs: Runs, robot: Robot) -> list[Turned]:
    """Returns the channels of settled runs whose readings with the other sign are `NEARER` to the robot of the file.

    It needs a robot with a weight. Without a weight signs are checked row by row as a table is read.
    """
    runs = runs.of(robot)
    if not runs.layout.weight or any(float(c.torque_gravity) > 0 for c in robot.configurations.members):
        return []
    conditions = runs.conditions(robot)
    return _turned(
        runs, runs.measured(), np.stack([operating_readings(_rubbing(robot, f), conditions) for f in FRICTION])
    )


def _turned(runs: Runs, measured: np.ndarray, possible: np.ndarray) -> list[Turned]:
    """As `turned_signs`, of readings [SI], shape (runs, channels), and those of several robots, (robots, ...)."""
    found: list[Turned] = []
    for k, channel in enumerate(runs.channels if runs.layout.weight else ()):
        if not channel.directed or runs.layout.magnitude(channel.name):
            continue
        off, turned = (_rms(sign * measured[:, k] - possible[:, :, k]) for sign in (1.0, -1.0))
        if turned * NEARER < off:
            theirs = runs.headings.get(channel.column, channel.column)
            found.append(Turned(runs.source, channel.column, theirs, off / channel.factor, turned / channel.factor))
    return found if len(found) == 1 else []  # of several the file's numbers may be wrong as well


def _rms(off: np.ndarray) -> float:
    """The least root mean square along the rows of several robots, shape (robots, rows); infinite without numbers."""
    return min((float(np.sqrt(np.nanmean(x**2))) for x in off if np.isfinite(x).any()), default=math.inf)


def _rubbing(robot: Robot, factor: float) -> Robot:
    """The robot with so many times its friction torques, and its ground's resistance to rolling."""
    torques = [
        p
        for p in params.walk(robot)
        if p.name.endswith((".friction_coulomb", ".friction_viscous", ".loss_coulomb", ".loss_viscous"))
    ]
    return params.replace(robot, {p.name: factor * p.value for p in torques})


def _factor(measured: np.ndarray, possible: np.ndarray) -> float:
    """Median factor by which readings lie outside what is possible; 1 inside, or where nothing can be said.

    Args:
        measured: shape (runs,); possible: of several robots, NaN where one does not move, shape (robots, runs).
    """
    finite = np.isfinite(measured) & np.isfinite(possible).any(0)
    if not finite.any():
        return 1.0
    size = np.abs(possible[:, finite])
    low, high = np.nanmin(size, 0), np.nanmax(size, 0)
    tells = high > max(SMALL * np.nanmax(high), NOTHING * np.max(np.abs(measured[finite])))
    if not tells.any():  # a channel that steady travel does not show
        return 1.0
    low, high, x = low[tells], high[tells], np.abs(measured[finite][tells])
    x = np.maximum(x, 1e-9 * high)
    return float(np.median(x / np.clip(x, low, high)))


def _units(channel: Channel, measured: np.ndarray, possible: np.ndarray, robot: Robot) -> list[str]:
    """Units in which the readings would be possible, the likeliest first; the arguments as of `_factor`."""
    known = {unit: channel.factor / size for unit, size in channel.other_units}
    if channel.name == "motor_speed" and robot.has_ground:
        known["rpm of the driving wheel"] = 1 / float(robot.gearbox.ratio)
    left = {unit: abs(math.log(_factor(measured / f, possible))) for unit, f in known.items()}
    return sorted((u for u, x in left.items() if x < math.log(ALIKE)), key=left.__getitem__)


def _others(channel: Channel, factors: dict[Channel, float]) -> list[str]:
    """Columns of the other channels that are off by as much."""
    mine = factors[channel]
    return [c.column for c, f in factors.items() if c is not channel and abs(math.log(f / mine)) < math.log(ALIKE)]


def _slips(robot: Robot, channel: Channel, factor: float) -> bool:
    """Whether a vehicle's speed is low as its movers may slide, where nobody has stated the ground."""
    return not robot.rig.inherits and robot.has_ground and channel.name == "speed" and factor < 1


def _check_gear(runs: Runs, measured: np.ndarray, robot: Robot) -> None:
    """Refuse a gear ratio that is the inverse of what the speeds of motor and output show."""
    shown = dict(zip(channels.names(robot.channels), measured.T, strict=True))
    conditions = runs.conditions(robot)
    which = np.asarray(conditions.configuration)
    radius = np.asarray([float(c.radius) for c in robot.configurations.members])[which]
    output = shown.get("output_speed", shown["speed"] / radius if "speed" in shown else None)
    motor = shown.get("motor_speed", conditions.motor_speed)
    if motor is None:  # about what it turns at without load
        motor = np.asarray(conditions.voltage) / float(robot.motor.torque_constant)
    ratio = float(robot.gearbox.ratio)
    if output is None or abs(math.log(ratio)) < math.log(REFUSED):
        return
    turns = np.abs(np.asarray(motor)) / np.maximum(np.abs(output), 1e-12)
    turns = turns[np.isfinite(turns) & (turns > 0)]
    found = float(np.median(turns)) if turns.size else ratio
    if abs(math.log(found * ratio)) < math.log(SAID):
        raise BadData(
            f"{runs.source}: the motor turns about {number(float(f'{found:.2g}'))} times for one turn of the output, "
            f"but gearbox.ratio is {number(float(f'{ratio:.4g}'))}: is it upside down? expected motor turns per turn "
            "of the output"
        )


def _check_masses(runs: Runs, robot: Robot) -> None:
    """Refuse total masses that are no mass of this robot."""
    if not runs.has("total_mass_kg"):
        return
    own = np.asarray([float(c.mass) for c in robot.configurations.members])[runs.configurations(robot)]
    factor = float(np.median(runs["total_mass_kg"] / (own + runs["payload_kg"])))
    if max(factor, 1 / factor) > REFUSED:
        off, size = (factor, "large") if factor > 1 else (1 / factor, "small")
        raise BadData(
            f"{runs.source}, total_mass_kg: about {number(float(f'{off:.2g}'))} times too {size} for this robot "
            f"({', '.join(f'{number(m)} kg' for m in np.unique(own))} and the payload); check the unit, kg, and the "
            "mass in the robot's file"
        )


def _slopes(runs: Runs, measured: np.ndarray, possible: np.ndarray, robot: Robot) -> Iterator[SlopesIn]:
    """Say so where the current rises with the slope as if that were in another unit.

    Within runs that differ in their slope alone the current is about linear in it; the coefficient of what is
    measured on what is possible is 1 where slopes are in degrees.
    """
    k = next((k for k, c in enumerate(robot.channels) if c.name in ("total_current", "motor_current")), None)
    if k is None or "slope_deg" not in runs.axes:
        return
    slope, finite = runs["slope_deg"], np.isfinite(measured[:, k]) & np.isfinite(possible[:, k])
    columns = [
        c for c in ("configuration", runs.layout.imposed_column, "payload_kg", "surface", "duty") if runs.has(c)
    ]
    groups: dict[tuple[str, ...], list[int]] = {}
    for row in np.flatnonzero(finite):
        groups.setdefault(tuple(str(runs[c][row]) for c in columns), []).append(int(row))
    several = [g for g in groups.values() if np.ptp(slope[g]) > 0]
    if sum(len(g) - 1 for g in several) < 3:
        return
    x, y = (np.concatenate([v[g, k] - np.mean(v[g, k]) for g in several]) for v in (possible, measured))
    follows = float(x @ y / math.sqrt(max(float((x @ x) * (y @ y)), 1e-300)))
    rise = float(x @ y / max(float(x @ x), 1e-300))
    for unit, size in SLOPES.items():
        if follows > FOLLOWS and abs(math.log(max(rise, 1e-9) / size)) < math.log(1.25):
            yield SlopesIn(unit, rise)
