"""Check before any fit that readings are possible for the robot. Most failures are wrong units."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import jax
import numpy as np
from jaxtyping import Float

from calibration.data import Names
from calibration.data.input_errors import BadData
from calibration.data.runs import Runs
from calibration.described import describe
from calibration.inference import observers
from calibration.inference.fit_notes import Remark
from calibration.inference.series_noise import rows_by_key
from mmrjax.fidelities.steady import results_of_rows
from mmrjax.model import channels, params
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Result, Signals, is_done

#: Adhesion ratio at which no robot slides; the motors' load depends only weakly on the slip.
GRIPPING = 20.0
#: Factors between readings and robot above which a table is refused, and above which a note reports it.
REFUSED, SAID = 5.0, 2.0
#: Largest remaining factor for another unit to explain readings, and ratio of two channels' factors to be the same.
ALIKE = 1.3
#: Shortest history with a later half near steady travel [s].
UNDER_WAY = 0.25
#: Factor above which another unit may explain torque and current of a rig with unknown friction.
FAR = 50.0
#: Friction of an uncalibrated robot, as factors on its file's values.
FRICTION = (0.1, 1.0, 4.0)
#: Channels of torque: their readings depend on friction, which is unknown for a rig without inheritance.
OF_TORQUE = ("total_current", "motor_current", "output_torque", "winding_temperature")
#: Factor by which readings with the other sign are nearer to the robot, for a note on their sign.
NEARER = 2.0
#: Readings smaller than this share of the channel's largest are excluded from the factor.
SMALL = 0.05
#: Possible readings below this share of the measured ones are zero: the yaw rate of a robot that drives straight.
NOTHING = 1e-9
#: Units of a slope other than degrees [deg]; least correlation of the current with the slope.
SLOPES = {"radians": 180 / math.pi, "percent": math.degrees(0.01)}
FOLLOWS = 0.9


def check_ranges(runs: Runs, robot: Robot) -> list[Remark]:
    """Rejects readings that no similar robot gives under these conditions. Returns remarks on other doubts.

    The readings of each channel are compared with steady travel of the robot, and of the robot with a tenth and four
    times its friction. The median factor between readings and that range decides. In histories, only settled ends are
    compared.

    Raises:
        BadData: a factor is beyond `REFUSED`. For histories, which may not reach steady travel, only if a known
            confusion of units explains it.
    """
    runs = runs.of(robot)
    observer = observers.observer_kind(runs)
    runs, measured, durations = observer.settled(runs, steady=True)
    if not len(runs):
        return []
    _check_masses(runs, robot)
    runs = runs.where(durations >= UNDER_WAY)
    measured = measured[durations >= UNDER_WAY]
    if not len(runs) or any(float(c.torque_gravity) > 0 for c in robot.configurations.members):
        return []
    if not robot.rig.inherits:
        _check_gear(runs, measured, robot)
    conditions = runs.conditions(robot)
    possible = np.stack([operating_readings(_with_friction_factor(robot, f), conditions) for f in FRICTION])
    # A robot that moves with less friction but not with more may stand still: any speed between is possible.
    is_zero_at_rest = np.array([c.zero_at_rest for c in robot.channels])
    possible = np.where(is_zero_at_rest & np.isnan(possible) & np.isfinite(possible[0]), 0.0, possible)
    if not np.isfinite(possible).any():
        return []
    factors = {c: _range_factor(measured[:, k], possible[:, :, k]) for k, c in enumerate(robot.channels)}
    remarks: list[Remark] = []
    for k, (channel, factor) in enumerate(factors.items()):
        ratio = max(factor, 1 / factor)
        has_unknown_friction = not robot.rig.inherits and channel.name in OF_TORQUE
        if ratio <= (FAR if has_unknown_friction else SAID):
            continue
        units = _possible_units(channel, measured[:, k], possible[:, :, k], robot)
        if not units and (
            has_unknown_friction
            or observer.axis
            or (not robot.rig.inherits and robot.has_ground and channel.name == "speed" and factor < 1)
        ):  # a sliding vehicle may have other speeds
            continue
        typical = _range_factor(measured[:, k], possible[1:2, :, k])
        remark = Remark(
            "off_by",
            column=channel.column,
            unit=channel.unit,
            factor=typical if units else factor,
            units=tuple(units),
            others=tuple(
                c.column
                for c, f in factors.items()
                if c is not channel and abs(math.log(f / factor)) < math.log(ALIKE)
            ),
            imposed=runs.layout.imposed_column,
        )
        if ratio > REFUSED:
            raise BadData(f"{runs.source}, {describe(remark)}")
        remarks.append(remark)
    return [
        *remarks,
        *_sign_remarks_of_readings(runs, measured, possible),
        *_slope_unit_remark(runs, measured, possible[1], robot),
    ]


def remarks_on_signs(runs: Runs, robot: Robot) -> list[Remark]:
    """Remarks on channels of settled runs that agree better (by `NEARER`) with the robot file if their sign is
    changed.

    For robots with a weight only. Without a weight, signs are checked row by row while a table is read.
    """
    runs = runs.of(robot)
    if not runs.layout.weight or any(float(c.torque_gravity) > 0 for c in robot.configurations.members):
        return []
    conditions = runs.conditions(robot)
    return _sign_remarks_of_readings(
        runs,
        runs.measured(),
        np.stack([operating_readings(_with_friction_factor(robot, f), conditions) for f in FRICTION]),
    )


def _sign_remarks_of_readings(runs: Runs, measured: np.ndarray, possible: np.ndarray) -> list[Remark]:
    """Remarks of `remarks_on_signs` for readings [SI], shape (runs, channels), and several robots, shape (robots,
    ...).
    """
    remarks: list[Remark] = []
    for k, channel in enumerate(runs.channels if runs.layout.weight else ()):
        if not channel.directed or runs.layout.magnitude(channel.name):
            continue
        rms, reversed_rms = (_smallest_rms(sign * measured[:, k] - possible[:, :, k]) for sign in (1.0, -1.0))
        if reversed_rms * NEARER < rms:
            heading = runs.heading(channel.column)
            remarks.append(
                Remark(
                    "turned",
                    source=runs.source,
                    column=channel.column,
                    theirs=heading,
                    off=rms / channel.factor,
                    turned=reversed_rms / channel.factor,
                )
            )
    return remarks if len(remarks) == 1 else []  # with several, the file's values may be wrong instead


def _smallest_rms(errors: np.ndarray) -> float:
    """Smallest root mean square over the rows among several robots, shape (robots, rows). inf without numbers."""
    return min((float(np.sqrt(np.nanmean(x**2))) for x in errors if np.isfinite(x).any()), default=math.inf)


def _with_friction_factor(robot: Robot, factor: float) -> Robot:
    """Robot whose friction torques and rolling resistance are multiplied by a factor."""
    torques = [
        p
        for p in params.walk_parameters(robot)
        if p.name.endswith((".friction_coulomb", ".friction_viscous", ".loss_coulomb", ".loss_viscous"))
    ]
    return params.replace(robot, {p.name: factor * p.value for p in torques})


def _range_factor(measured: np.ndarray, possible: np.ndarray) -> float:
    """Median factor between readings and their possible range. 1 inside the range, or if it cannot be determined.

    Args:
        measured: readings, shape (runs,).
        possible: readings of several robots, NaN if one does not move, shape (robots, runs).
    """
    finite = np.isfinite(measured) & np.isfinite(possible).any(0)
    if not finite.any():
        return 1.0
    size = np.abs(possible[:, finite])
    low = np.nanmin(size, 0)
    high = np.nanmax(size, 0)
    is_informative = high > max(SMALL * np.nanmax(high), NOTHING * np.max(np.abs(measured[finite])))
    if not is_informative.any():  # a channel that steady travel does not show
        return 1.0
    low = low[is_informative]
    high = high[is_informative]
    x = np.abs(measured[finite][is_informative])
    x = np.maximum(x, 1e-9 * high)
    return float(np.median(x / np.clip(x, low, high)))


def _possible_units(channel: Channel, measured: np.ndarray, possible: np.ndarray, robot: Robot) -> list[str]:
    """Units in which the readings would be possible, the most probable first. Arguments as in `_range_factor`."""
    other_units = {unit: channel.factor / size for unit, size in channel.sizes.items() if size != channel.factor}
    if channel.name == "motor_speed" and robot.has_ground:
        other_units["rpm of the driving wheel"] = 1 / float(robot.gearbox.ratio)
    distance = {unit: abs(math.log(_range_factor(measured / f, possible))) for unit, f in other_units.items()}
    return sorted((u for u, log_factor in distance.items() if log_factor < math.log(ALIKE)), key=distance.__getitem__)


def _check_gear(runs: Runs, measured: np.ndarray, robot: Robot) -> None:
    """Rejects a gear ratio if its inverse is the ratio of motor and output speeds."""
    readings = dict(zip(channels.channel_names(robot.channels), measured.T, strict=True))
    conditions = runs.conditions(robot)
    configuration = np.asarray(conditions.configuration)
    radius = np.asarray([float(c.radius) for c in robot.configurations.members])[configuration]
    output = readings.get("output_speed", readings["speed"] / radius if "speed" in readings else None)
    motor = readings.get("motor_speed", conditions.motor_speed)
    if motor is None:  # approximately its speed without load
        motor = np.asarray(conditions.voltage) / float(robot.motor.torque_constant)
    ratio = float(robot.gearbox.ratio)
    if output is None or abs(math.log(ratio)) < math.log(REFUSED):
        return
    ratios = np.abs(np.asarray(motor)) / np.maximum(np.abs(output), 1e-12)
    ratios = ratios[np.isfinite(ratios) & (ratios > 0)]
    measured_ratio = float(np.median(ratios)) if ratios.size else ratio
    if abs(math.log(measured_ratio * ratio)) < math.log(SAID):
        raise BadData(
            f"{runs.source}: the motor turns about {float(f'{measured_ratio:.2g}'):g} times for one turn of the "
            f"output, but gearbox.ratio is {float(f'{ratio:.4g}'):g}: is it upside down? expected motor turns "
            "per output turn"
        )


def _check_masses(runs: Runs, robot: Robot) -> None:
    """Rejects total masses that are impossible for the robot."""
    if not runs.has("total_mass_kg"):
        return
    robot_mass = np.asarray([float(c.mass) for c in robot.configurations.members])[runs.configurations(robot)]
    factor = float(np.median(runs["total_mass_kg"] / (robot_mass + runs["payload_kg"])))
    if max(factor, 1 / factor) > REFUSED:
        ratio, size = (factor, "large") if factor > 1 else (1 / factor, "small")
        raise BadData(
            f"{runs.source}, total_mass_kg: about {float(f'{ratio:.2g}'):g} times too {size} for this robot "
            f"({', '.join(f'{m:g} kg' for m in np.unique(robot_mass))} and the payload); check its unit, kg, and "
            "the robot's mass"
        )


def _slope_unit_remark(runs: Runs, measured: np.ndarray, possible: np.ndarray, robot: Robot) -> Iterator[Remark]:
    """Remark if the current rises with the slope as if the slope had another unit.

    Among runs that differ only in their slope, the current is nearly linear in it. The regression of measured on
    possible readings has the coefficient 1 for slopes in degrees.
    """
    k = next((k for k, c in enumerate(robot.channels) if c.name in ("total_current", "motor_current")), None)
    if k is None or "slope_deg" not in runs.axes:
        return
    slope = runs["slope_deg"]
    finite = np.isfinite(measured[:, k]) & np.isfinite(possible[:, k])
    columns = [
        c for c in ("configuration", runs.layout.imposed_column, "payload_kg", "surface", "duty") if runs.has(c)
    ]
    finite_rows = np.flatnonzero(finite)
    groups = rows_by_key(tuple(str(runs[c][row]) for c in columns) for row in finite_rows)
    groups_with_slopes = [finite_rows[g] for g in groups.values() if np.ptp(slope[finite_rows[g]]) > 0]
    if sum(len(g) - 1 for g in groups_with_slopes) < 3:
        return
    x, y = (np.concatenate([v[g, k] - np.mean(v[g, k]) for g in groups_with_slopes]) for v in (possible, measured))
    correlation = float(x @ y / math.sqrt(max(float((x @ x) * (y @ y)), 1e-300)))
    rise = float(x @ y / max(float(x @ x), 1e-300))
    for unit, size in SLOPES.items():
        if correlation > FOLLOWS and abs(math.log(max(rise, 1e-9) / size)) < math.log(1.25):
            yield Remark("slopes_in", unit=unit, rise=rise)


# --- operating points -----------------------------------------------------------------------------------


def operating_readings(
    robot: Robot, conditions: Conditions, names: Names | None = None
) -> Float[np.ndarray, "runs channels"]:
    """Predicted readings of steady travel without sliding, and of turns on their own surface [SI].

    NaN if the robot cannot move.

    Args:
        conditions: conditions of the runs, shape (runs,).
        names: names of the channels. None: those of the robot.
    """
    if not conditions.turns:  # the load of a turn is friction
        gripping = jax.device_put(np.full(conditions.shape[0], GRIPPING))
        conditions = dataclasses.replace(conditions, adhesion=gripping)
    readings = travel_of_rows(robot, conditions, rests=conditions.held is not None)[0]
    reading = np.stack([np.asarray(readings.reading[c]) for c in names or channels.channel_names(robot.channels)], 1)
    return np.where(np.asarray(is_done(readings.status))[:, None], reading, np.nan)


def travel_of_rows(robot: Robot, conditions: Conditions, rests: bool = False) -> tuple[Result, Signals]:
    """Results and signals of steady travel, see `results_of_rows`.

    The robot's own mass is stated in the conditions, so that tables with and without a mass share a program.
    """
    if not conditions.turns and conditions.total_mass is None:
        masses = np.asarray([float(c.mass) for c in robot.configurations.members])
        mass = masses[np.asarray(conditions.configuration)] + np.asarray(conditions.payload)
        conditions = dataclasses.replace(conditions, total_mass=jax.device_put(mass))
    rig = dataclasses.replace(robot.rig, begins=None)  # of histories
    return results_of_rows(dataclasses.replace(robot, rig=rig), conditions, rests)
