"""Terrains and sequences of lever angles from outside: CSV with units in the column names, checked cell by cell."""

from __future__ import annotations

from collections.abc import Sequence as Rows
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from calibration.data import Columns, named_arrays
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.named_arrays import Check, check_rows
from calibration.data.sources import reading
from mmrjax.climbing import terrain
from mmrjax.climbing.climb_simulation import ON_GROUND, LeverSequence, roller_clearance
from mmrjax.climbing.terrain import Terrain
from mmrjax.model.robot import Robot

#: Another unit is suspected if a polyline is larger than the first, smaller than the second, or has a wall higher
#: than the third [m].
LARGEST, SMALLEST, WALL = 50.0, 1e-3, 5.0
#: Largest accepted motor voltage [V].
HIGHEST = 1000.0
#: Metres per unit.
_LENGTHS = {"m": 1.0, "mm": 1e-3}


def parse_stairs(text: str) -> tuple[float, float, int]:
    """Rise and tread [m] and count of «170x290x3» in mm.

    Raises:
        BadConfiguration: the text has another form, or rise or tread is missing.
    """
    cells = text.lower().replace("×", "x").split("x")
    numbers = [named_arrays.cell_number(c) for c in cells]
    if len(cells) != 3 or not np.isfinite(numbers).all():
        raise BadConfiguration(f"--stairs: got {text}; expected RISExTREADxCOUNT in mm, such as 170x290x3")
    rise, tread, count = numbers
    for name, value, least, most in (("rise", rise, 1, 2000), ("tread", tread, 10, 5000), ("count", count, 1, 50)):
        if not least <= value <= most or (name == "count" and value != int(value)):
            unit = "" if name == "count" else " mm"
            raise BadConfiguration(f"--stairs: got a {name} of {value:g}{unit}; expected {least} to {most}{unit}")
    return rise / 1000, tread / 1000, int(count)


def _read_columns(path: Path, option: str, headers: Rows[Rows[str]]) -> tuple[Columns, Rows[str]]:
    """Columns of a file, which must have one of several headers."""
    if not path.exists():
        raise BadConfiguration(f"{option}: got {path}, no such file")
    table = reading.read_whole_table(path)
    header = table.header
    names = next((names for names in headers if set(names) <= set(header)), None)
    if names is None:
        either = ", or ".join(" and ".join(names) for names in headers)
        raise BadData(f"{path.name}: got columns {', '.join(header) or 'none'}; expected {either}")
    for other_names in headers:
        if conflicting := [name for name in other_names if name in header and name not in names]:
            kept_names = ", ".join(name for name in names if name not in other_names)
            raise BadData(
                f"{path.name}: got columns {', '.join(conflicting)} and {kept_names}; expected one kind, "
                "remove the other"
            )
    if not len(table):
        raise BadData(f"{path.name}: has no rows; expected at least one")
    columns = {}
    for name, unit, raw in zip(header, table.units or [""] * len(header), table.values, strict=True):
        if name not in names:
            continue
        if unit and not name.endswith(f"_{unit}"):
            raise BadData(f"{path.name}: column {name} states {unit} in {table.units_from}; correct one of them")
        columns[name] = named_arrays.column_numbers(raw)
        for row in np.flatnonzero(~np.isfinite(columns[name]))[:1].tolist():
            cell = named_arrays.column_texts(raw)[row]
            raise BadData(f"{path.name} row {row + 1}, {name}: got {cell!r}; expected a number")
    return columns, names


def read_terrain(path: Path) -> Terrain:
    """Polyline from a file. Ground is level before its first and after its last point.

    Raises:
        BadConfiguration: no such file.
        BadData: columns lack units, cells lack numbers, the ground folds back, or metres and millimetres were
            confused.
    """
    columns, names = _read_columns(path, "--terrain", [("x_m", "z_m"), ("x_mm", "z_mm")])
    unit = names[0].rpartition("_")[2]
    x, z = (columns[name] * _LENGTHS[unit] for name in names)
    try:
        outline = terrain.polyline(x - x[0], z - z[0])
    except ValueError as error:
        raise BadData(f"{path.name}: {error}") from error
    across, rise = np.abs(np.diff(x)), np.abs(np.diff(z))
    largest, wall = max(np.ptp(x), np.ptp(z)), np.max(rise, where=rise > across, initial=0.0)
    if SMALLEST <= largest <= LARGEST and wall <= WALL:
        return outline
    fault, meant = f"is {largest:g} m large; expected at most {LARGEST:g} m", "mm"
    if largest < SMALLEST:
        fault, meant = f"is {1e3 * largest:g} mm large; expected at least {1e3 * SMALLEST:g} mm", "m"
    elif largest <= LARGEST:
        fault = f"has a wall of {wall:g} m; expected at most {WALL:g} m"
    # too small in mm, or too large in m
    unit_name = "metres" if meant == "m" else "millimetres"
    hint = "" if meant == unit else f"; is the file in {unit_name}? Then name its columns x_{meant} and z_{meant}"
    raise BadData(f"{path.name}: {fault}{hint}")


def read_sequence(path: Path, robot: Robot, begins: tuple[float, float]) -> LeverSequence:
    """Lever angles over distance or time from a file, or voltages of the lever motors.

    Args:
        begins: initial angles of front and rear levers [rad], used if the file states voltages.

    Raises:
        BadConfiguration: no such file.
        BadData: columns are wrong, cells lack numbers, knots do not increase, an angle is beyond the robot's range,
            or a voltage is beyond `HIGHEST`.
    """
    column_sets = [(x, f"front_{unit}", f"rear_{unit}") for unit in ("deg", "V") for x in ("x_mm", "time_s")]
    columns, (abscissa, *lever_columns) = _read_columns(path, "--sequence", column_sets)
    knots = columns[abscissa]
    over_time, has_volts = abscissa == "time_s", lever_columns[0] == "front_V"
    falls, before = np.diff(knots, prepend=-np.inf) <= 0, np.roll(knots, 1)
    checks: list[Check] = [(abscissa, falls, lambda row: f" after {before[row]:g}; expected increasing values")]
    if has_volts:
        allowed = f" V; expected -{HIGHEST:g} to {HIGHEST:g} V"
        checks += [(name, np.abs(columns[name]) > HIGHEST, allowed) for name in lever_columns]
    check_rows(path.name, columns, checks)
    x = jnp.asarray(knots if over_time else 1e-3 * knots)
    if has_volts:
        front, rear = (jnp.asarray(columns[name]) for name in lever_columns)
        return LeverSequence(x, front, rear, jnp.asarray(begins), over_time)
    for name in lever_columns:
        for k, value in enumerate(columns[name], 1):
            if why := lever_angle_refusal(robot, value):
                raise BadData(f"{path.name} row {k}, {name}: {why}")
    front, rear = (jnp.asarray(np.radians(columns[name])) for name in lever_columns)
    return LeverSequence(x, front, rear, over_time=over_time)


def lever_start_refusal(robot: Robot, angle: float) -> str:
    """Reason why levers cannot begin at an angle [deg] on level ground, empty if they can."""
    gear = robot.running_gear
    axle = robot.radius_pulley + gear.grouser_height
    clearance = float(roller_clearance(axle, gear, jnp.radians(angle)))
    if clearance >= -ON_GROUND:
        return ""
    least = -float(np.degrees(np.arcsin((axle - gear.levers.roller) / gear.lever_length)))
    return (
        f"at {angle:.4g} deg they begin {-1000 * clearance:.0f} mm below the ground; expected at least {least:.1f} "
        "deg, at which they touch it (a sequence may press them down later)"
    )


def lever_angle_refusal(robot: Robot, angle: float) -> str:
    """Reason why levers cannot reach an angle [deg], empty if they can."""
    levers = robot.running_gear.levers
    least, most = (float(np.degrees(np.asarray(x))) for x in (levers.angle_least, levers.angle_most))
    is_within = least - 1e-6 <= angle <= most + 1e-6
    return "" if is_within else f"got {angle:g} deg; expected {least:.4g} to {most:.4g} deg, the range of the levers"
