"""Values that follow from a rig's numbers, and doubts about implausible numbers."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from calibration.data import Names, rig_file
from calibration.data.clock import applied_drive, intervals_by_run
from calibration.data.columns import CURRENT, LOAD, SPEED
from calibration.data.input_errors import three_digits
from calibration.data.robot_file import RobotFile
from calibration.data.row_checks import JUMP, time_constant
from calibration.data.runs import Runs
from calibration.data.unused_readings import drive_heading
from mmrjax.model import params
from mmrjax.model.gearmotor import slow_motor_current, slow_output_torque
from mmrjax.model.quantities import RPM, VOLTAGE
from mmrjax.model.robot import Robot
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import GRAVITY

BATTERY = "battery"
#: Smallest ratio of gearboxes with three or more stages, and the largest efficiency that makers state for them.
STAGES, EFFICIENCY = 100.0, 0.85
#: Shortest change of speed that the inertia of motors and load does not explain [time constants]. Fewest samples.
FAR, RISING = 100.0, 3


@dataclass(frozen=True)
class DerivedFact:
    """A value that follows from the numbers of a rig, for a plausibility check.

    Attributes:
        what: meaning, in words.
        value: value with its unit, as text.
        odd: reason to check the numbers, empty if there is none.
    """

    what: str
    value: str
    odd: str = ""


def derived_facts(robot: Robot) -> list[DerivedFact]:
    """Values that follow from the numbers of a robot's motor, gearbox and loads."""
    facts = [*_motor_facts(robot), _gearbox_fact(robot)]
    for name, load in robot.configurations.items():
        facts += _shaft_facts(robot, name, load) if isinstance(load, Shaft) else _vehicle_facts(robot, name)
    return facts


def _fact(
    what: str, value: float, unit: str, usual: tuple[float, float], advice: str, scale: float = 1.0
) -> DerivedFact:
    """Fact about a value, shown `scale` times as large. Outside its usual range it is odd and has the `advice`."""
    low, high = usual
    odd = "" if low <= value <= high else f"{advice} (usual: {three_digits(low)} to {three_digits(high)})"
    return DerivedFact(what, f"{three_digits(scale * value)} {unit}".rstrip(), odd)


def _motor_facts(robot: Robot) -> Iterator[DerivedFact]:
    motor, voltage = robot.motor, robot.motor.voltage_limit
    constant, resistance, inertia = (float(x) for x in (motor.torque_constant, motor.resistance, motor.inertia))
    knows_constant, knows_resistance = robot.knows(["motor.torque_constant"]), robot.knows(["motor.resistance"])
    if knows_constant:
        yield _fact(
            "no-load speed per volt", 1 / constant / RPM, "rpm/V", (5, 20_000),
            "is torque_constant in N·m/A? 1 mN·m/A is 0.001",
        )  # fmt: skip
        yield _fact(
            "current needed to overcome the motor's dry friction", float(motor.friction_coulomb) / constant, "A",
            (0, 10), "is friction_coulomb in N·m? it is torque_constant times the no-load current",
        )  # fmt: skip
        if voltage is not None:
            fastest = voltage / constant
            yield DerivedFact(
                f"no-load speed at {three_digits(voltage)} V",
                f"{three_digits(fastest / RPM)} rpm",
                "more than twice motor.speed_limit. Check torque_constant" * (fastest >= 2 * motor.speed_limit),
            )
    if knows_resistance and voltage is not None:
        yield _fact(
            f"stall current at {three_digits(voltage)} V", float(motor.current_stall(voltage)), "A", (0.02, 1000),
            "check motor.resistance",
        )  # fmt: skip
    if knows_constant and knows_resistance:
        torque_per_speed = constant**2 / resistance
        yield _fact(
            "torque over speed k²/R", torque_per_speed, "mN·m·s", (1e-7, 1.0),
            "torque_constant and resistance fit no one motor. Check their units", scale=1e3,
        )  # fmt: skip
        if inertia > 0:
            yield _fact(
                "mechanical time constant of the motor alone J R/k²", inertia / torque_per_speed, "ms", (5e-4, 0.5),
                "check motor.inertia (1 g·cm² is 1e-7 kg·m²), torque_constant and resistance", scale=1e3,
            )  # fmt: skip


def _gearbox_fact(robot: Robot) -> DerivedFact:
    ratio, efficiency = float(robot.gearbox.ratio), float(robot.gearbox.efficiency_load)
    text, odd = f"{ratio:g} : 1 with efficiency {efficiency:g}", ""
    if not 1 <= ratio <= 3000:
        odd = "expected motor turns per output turn (usual: 1 to 3000)"
    elif ratio >= STAGES and efficiency > EFFICIENCY:
        odd = f"an efficiency of {efficiency:g} is high for three or more stages (0.5 to {EFFICIENCY:g})"
    elif ratio == 1 and efficiency < 0.9:
        odd = f"an efficiency of {efficiency:g} without a gearbox. Is the ratio missing?"
    return DerivedFact("gearbox", text, odd)


def _current_fact(robot: Robot, what: str, torque: float, places: str) -> Iterator[DerivedFact]:
    """Current for a torque, compared with the stall current if a voltage limit is stated."""
    if not robot.knows(["motor.torque_constant"]):
        return
    current, limit = slow_motor_current(robot.motor, robot.gearbox, torque), robot.motor.voltage_limit
    fact = _fact(what, current, "A per motor", (0, 200), f"check {places}, and the gearbox")
    if limit is not None and robot.knows(["motor.resistance"]):
        stall = float(robot.motor.current_stall(limit))
        if current > stall:
            odd = f"above the stall current {three_digits(stall)} A at {three_digits(limit)} V, so it cannot move. "
            fact = replace(fact, odd=f"{odd}Check {places}")
    yield fact


def _shaft_facts(robot: Robot, name: str, load: Shaft) -> Iterator[DerivedFact]:
    friction, constant, gravity = (float(x) for x in (load.loss_coulomb, load.torque_constant, load.torque_gravity))
    inertia, motor_inertia, travel = float(load.inertia), float(robot.motor.inertia), 2 * math.pi * float(load.radius)
    places = f"{name}.loss_coulomb [N·m, at the output]"
    yield from _current_fact(robot, f"{name}: current to turn it slowly", friction + max(constant, 0.0), places)
    if gravity > 0:
        yield from _current_fact(
            robot, f"{name}: current to hold and lift the arm", friction + gravity, f"{name}.torque_gravity"
        )
        yield _fact(
            f"{name}: length of a pendulum with the same period", inertia * GRAVITY / gravity, "mm", (0.01, 3.0),
            f"{name}.inertia and {name}.torque_gravity are unlikely to belong to one arm (m l² and m g l)", scale=1e3,
        )  # fmt: skip
    if inertia > 0 and motor_inertia > 0:
        yield _fact(
            f"{name}: load inertia over motor inertia, both at the output",
            inertia / (motor_inertia * float(robot.gearbox.ratio) ** 2), "", (1e-4, 1e4),
            f"check {name}.inertia and motor.inertia [kg·m²]; 1 g·cm² is 1e-7",
        )  # fmt: skip
    if float(load.radius) != 1.0:
        yield _fact(f"{name}: travel per turn", travel, "mm", (1e-4, 10.0), "check the travel", scale=1e3)


def _vehicle_facts(robot: Robot, name: str) -> Iterator[DerivedFact]:
    load, motor, limit = params.values_by_name(robot.configurations[name]), robot.motor, robot.motor.voltage_limit
    sides, radius, loss = float(robot.sides), load["radius"], load["track.loss_coulomb"]
    weight = load["mass"] * GRAVITY
    resistance = load["ground.rolling_resistance"] + load["track.guide_friction"] * load["track.guide_share"]
    fact = _fact(f"{name}: weight", load["mass"], "kg", (0.05, 2000), f"is {name}.mass in kg?")
    yield replace(fact, value=f"{fact.value}, {three_digits(weight)} N")
    places = f"{name}.ground.rolling_resistance and {name}.track.loss_coulomb"
    torque = weight * resistance * radius / sides + loss
    yield from _current_fact(robot, f"{name}: current to roll slowly on the flat", torque, places)
    friction = load["ground.friction.static"]
    slope = math.degrees(math.atan(friction))
    fact = _fact(f"{name}: steepest slope without sliding", slope, "", (5, 60), "check friction.static")
    odd = "it cannot move on the flat: friction.static is below the resistance" * (friction <= resistance)
    yield replace(fact, value=f"{slope:.0f}°", odd=odd or fact.odd)
    if limit is None or not robot.knows(["motor.resistance"]):
        return
    pull = (slow_output_torque(motor, robot.gearbox, float(motor.current_stall(limit))) - loss) * sides / radius
    climb = pull / weight - resistance
    yield DerivedFact(
        f"{name}: steepest slope that the stall torque holds at {three_digits(limit)} V",
        "any" if climb >= 1 else f"{math.degrees(math.asin(max(climb, 0.0))):.0f}°",
        "its motors cannot move it. Check mass, ratio, torque_constant and resistance" * (climb <= 0),
    )
    yield _fact(
        f"{name}: no-load speed at {three_digits(limit)} V",
        limit / float(motor.torque_constant) / float(robot.gearbox.ratio) * radius, "m/s", (0.005, 15),
        f"check {name}.radius, gearbox.ratio and motor.torque_constant",
    )  # fmt: skip


def doubtful_time(runs: Runs, robot: Robot) -> str:
    """Reason to suspect that the time of a log is in milliseconds, empty without evidence.

    The speed at constant voltage would then change much more slowly than the inertia allows.
    """
    if not runs.sampled or robot.rig.imposed != "voltage":
        return ""
    constant = time_constant(robot)
    moving = [c for c in runs.present_channels if c.zero_at_rest and c.directed]
    stretches = [s.rows for run in intervals_by_run(runs) for s in run if len(s.rows) >= 4 * RISING]
    for stretch, channel in itertools.product(stretches, moving):
        readings = runs[channel.column][stretch]
        change = np.nanmedian(readings[len(readings) // 2 :]) - readings[0]
        if not abs(change) > 0.5 * np.nanmax(np.abs(runs[channel.column])):
            continue
        share = (readings - readings[0]) / change
        rises = np.flatnonzero((share > 0.1) & (share < 0.9))
        if len(rises) < RISING or np.any(np.diff(rises) > 1):
            continue
        first, last = stretch[rises[0]], stretch[rises[-1]]
        lasts, column = runs["time_s"][last] - runs["time_s"][first], runs.heading("time_s")
        if lasts >= FAR * constant:
            return (
                f"{runs.place(first, last)}: {channel.label} changes over {three_digits(lasts)} s "
                f"at a constant voltage, while these motors need about {three_digits(constant)} s. Is {column} in "
                f'milliseconds? Then name it time_ms, or state [columns] time_ms = "{column}"'
            )
    return ""


#: Usual range of the largest imposed current of a log, in multiples of the current that turns the load slowly.
LEAST, MOST = 0.1, 100.0


def doubtful_current(runs: Runs, robot: Robot) -> str:
    """Reason to doubt the unit of an imposed current or torque, empty without evidence.

    The current is far from the current that turns the loads slowly.
    """
    column, present = runs.layout.imposed_column, set(runs["configuration"])
    loads = [load for name, load in robot.configurations.items() if name in present and isinstance(load, Shaft)]
    if column != CURRENT or not loads:
        return ""
    slow_current = max(
        slow_motor_current(
            robot.motor,
            robot.gearbox,
            abs(float(load.loss_coulomb)) + abs(float(load.torque_constant)) + abs(float(load.torque_gravity)),
        )
        for load in loads
    )
    is_free = runs["held"] < 0.5 if runs.has("held") else np.full(len(runs), True)
    largest = float(np.nanmax(np.abs(runs[column][is_free]), initial=0.0))
    if slow_current == 0 or not is_free.any() or LEAST < largest / slow_current < MOST:
        return ""
    heading = runs.heading(column)
    is_motionless = largest > slow_current and not any(c.zero_at_rest and runs.has(c.column) for c in runs.channels)
    clamp_hint = "Was the shaft held? Then add a column held with 1 in these rows. " * is_motionless
    return (
        f"{runs.source}, {heading}: up to {three_digits(largest)} A, although by the file's numbers the load turns "
        f"slowly at {three_digits(slow_current)} A. {clamp_hint}Is it in another unit (mA, mN·m)? Then state "
        f'[columns] {column} = {{column = "{heading}", factor = ...}}'
    )


#: A clock jitters if the time between rows has at least this relative spread and at most this correlation with the
#: next. Fewest rows.
UNEVEN, TURNS_BACK, ROWS_OF_CLOCK = 0.1, -0.3, 50


def jitter_sentence(runs: Runs) -> str:
    """Sentence on a clock that jitters although rows are evenly spaced. Otherwise empty.

    With even rows and independent clock errors, successive time steps have a correlation of -1/2. If the rows
    themselves are uneven, time steps are independent.
    """
    for name, rows in runs.rows_by_run().items() if runs.sampled else ():
        steps = np.diff(runs["time_s"][rows])
        usual = float(np.median(steps)) if len(steps) > ROWS_OF_CLOCK else 0.0
        deviation = np.clip(steps - usual, -usual, usual)
        spread = float(np.std(deviation))
        if usual <= 0 or spread <= UNEVEN * usual or (steps > JUMP * usual).any():
            continue
        if float(np.mean(deviation[1:] * deviation[:-1])) < TURNS_BACK * spread**2:
            run = f" of run {name}" if name else ""
            return (
                f"{runs.place(rows[0], rows[-1])}, time_s: the clock{run} jitters by {three_digits(spread / 2**0.5)} "
                f"s around even spacing. Replace these times by even ones, {three_digits(float(np.mean(steps)))} s "
                "apart"
            )
    return ""


#: Rows up to this share of the largest voltage give resistance and back-EMF. Fewest such rows. Their largest relative
#: misfit. Smallest share of a larger voltage that its rows must show.
INNER, ROWS_INNER, FITS, REACHES = 0.25, 30, 0.2, 0.8


def saturation_sentence(runs: Runs) -> str:
    """Sentence on a command voltage that the driver does not reach, empty without evidence.

    Least squares of U = R I + k ω over rows at low voltage give R and k. If the driver limits the voltage, currents
    and speeds at higher commands correspond to one constant voltage.
    """
    # With a duty, the supply current is only a share of the motor current.
    currents = [c for c in (CURRENT, *["total_current_A"] * (not runs.has("duty"))) if runs.has(c)]
    columns = (*currents[:1], SPEED)
    if runs.layout.imposed != "voltage" or runs.turns or not runs.sampled or not currents or not runs.has(SPEED):
        return ""
    if any(runs.layout.magnitude(c.name) for c in runs.channels if c.column in columns):
        return ""
    drive, readings = applied_drive(runs), np.stack([runs[column] for column in columns], 1)
    is_read, size = np.isfinite(readings).all(1), np.abs(drive)
    is_inner = is_read & (drive != 0) & (size <= INNER * float(size.max()))
    if is_inner.sum() < ROWS_INNER:
        return ""
    predicted = readings @ np.linalg.lstsq(readings[is_inner], drive[is_inner], rcond=None)[0]
    if np.std(predicted[is_inner] - drive[is_inner]) > FITS * np.std(drive[is_inner]):
        return ""
    top = is_read & (size >= np.quantile(size[is_read], 0.9))
    limit = float(np.median(np.abs(predicted[top])))
    limited = is_read & (size > limit / REACHES)
    # If the voltage from these rows still rises, the driver does not limit it.
    if limited.sum() < ROWS_INNER or np.std(np.abs(predicted[limited])) > FITS * limit:
        return ""
    row = int(np.argmax(limited))
    return (
        f"{runs.place(row)}, {drive_heading(runs)}: commands {three_digits(drive[row])} V, but current and speed "
        f"show {three_digits(limit)} V at most, as in {100 * np.mean(limited):.2g} % of the log. Give the voltage "
        f"that the driver applies, or limit the column to {three_digits(limit)} V"
    )


#: Brake torque beyond which another unit is suspected, in multiples of the stall torque.
BEYOND = 3.0


def doubtful_torque(runs: Runs, robot: Robot) -> str:
    """Reason to doubt the unit of a brake torque, empty without evidence or if the speed is imposed.

    In most rows the torque is far above the motors' stall torque.
    """
    of_current = robot.rig.imposed == "motor_current"
    if not runs.has(LOAD) or not (of_current or (robot.rig.imposed == "voltage" and robot.knows(VOLTAGE))):
        return ""
    current = np.abs(applied_drive(runs)) / (1.0 if of_current else float(robot.motor.resistance))
    at_zero, at_one = (slow_output_torque(robot.motor, robot.gearbox, x) for x in (0.0, 1.0))  # linear in the current
    stall = np.maximum(at_zero + (at_one - at_zero) * current, 0.0)
    braked = (runs[LOAD] != 0) & (current > 0)
    exceeds_stall = braked & (np.abs(runs[LOAD]) > BEYOND * stall)
    if not braked.any() or exceeds_stall.sum() <= braked.sum() / 2:
        return ""
    row, heading = int(np.argmax(exceeds_stall)), runs.heading(LOAD)
    return (
        f"{runs.place(row)}, {heading}: got {three_digits(runs[LOAD][row])} N·m, but the motors stall at "
        f'{three_digits(stall[row])} N·m; is it in mN·m? then state [columns] load_torque_mNm = "{heading}"'
    )


#: Share of power of either sign that indicates swapped signs.
SWAPPED = 0.3


def swapped_sentence(runs: Runs) -> str:
    """Sentence on a motion whose sign changes within a log although the drive does not, empty for others."""
    if not (runs.sampled and runs.has(runs.layout.imposed_column)):
        return ""
    drive, rows_of_runs = np.nan_to_num(applied_drive(runs)), list(runs.rows_by_run().values())
    if not drive.min() < 0 < drive.max():
        return ""  # a signal that never changes sign may lack it, which other checks report
    for channel, readings in zip(runs.channels, runs.measured().T, strict=True):
        if not channel.zero_at_rest:
            continue
        power = np.zeros(len(drive))
        for rows in rows_of_runs:
            motion = readings[rows] if channel.settled or len(rows) < 2 else np.gradient(readings[rows])
            power[rows] = np.nan_to_num(drive[rows] * motion)
            power[rows] /= max(float(np.abs(power[rows]).mean()), 1e-300)
        for rows in (*rows_of_runs, np.concatenate(rows_of_runs)):
            total = np.cumsum(power[rows]) / max(float(np.abs(power[rows]).sum()), 1e-300)
            split = int(np.argmax(np.abs(total)))
            before, after = total[split], total[-1] - total[split]
            parts = np.split(drive[rows], [split + 1])
            # Of an angle, both parts need both directions: a load without friction returns its energy as it brakes.
            has_directions = channel.settled or all(x.min(initial=0.0) < 0 < x.max(initial=0.0) for x in parts)
            if has_directions and before * after < 0 and min(abs(before), abs(after)) > SWAPPED:
                return (
                    f"{runs.place(rows[split] + 1)}, {runs.heading(channel.column)}: from here on its sign is "
                    f"opposite to {drive_heading(runs)}. Correct one part"
                )
    return ""


def log_doubts(runs: Runs, robot: Robot) -> Names:
    """Doubts about a log, one sentence each: times, levels, limits, and units that do not fit the robot."""
    checks_of_runs = (jitter_sentence, saturation_sentence, swapped_sentence)
    checks_of_robot = (doubtful_time, doubtful_current, doubtful_torque)
    doubts = (*(check(runs) for check in checks_of_runs), *(check(runs, robot) for check in checks_of_robot))
    return tuple(filter(None, doubts))


@dataclass(frozen=True)
class NumberOrigin:
    """Origin of a parameter value.

    Attributes:
        name, value, unit: the parameter.
        sd: standard deviation, None if the file states none.
        why: origin, in words.
    """

    name: str
    value: float
    unit: str
    sd: float | None
    why: str


def number_origins(file: RobotFile) -> list[NumberOrigin]:
    """Origin of each number of a robot, part by part. Numbers that no file states come last in their part."""
    robot, names_in_file = file.robot, file.stated
    priors = {name: sd for name, _, sd in robot.rig.priors}
    reasons = {"motor.inductance": rig_file.WINDING_WHY, rig_file.CENTRE: rig_file.CENTRE_WHY}
    reasons |= {name: why for name, (_, why) in rig_file.DEFAULTS.items()}
    of_loads = rig_file.FOLLOWS | {key: why for key, (_, why) in rig_file.VEHICLE.items()}
    of_loads["radius"] = "not stated: travel is the angle"
    prefixes = (*(f"{name}." for name in robot.configurations), "motor.friction", "gearbox.")
    if any(name.startswith(f"{BATTERY}.") for name in names_in_file):
        prefixes += (f"{BATTERY}.",)
    if rig_file.WHEELBASE in names_in_file:
        prefixes += (rig_file.CENTRE,)
    if not robot.rig.inherits:
        prefixes += ("motor.inertia", *["motor.inductance"] * robot.rig.shows_voltage)
    origins = []
    for p in params.walk_parameters(robot):
        head, _, key = p.name.partition(".")
        if p.name in names_in_file:
            why = "computed from mass and travel of the linear unit" if head in file.linear else "the file"
        elif not p.name.startswith(prefixes):
            continue
        elif robot.rig.inherits:
            why = "its base"
        elif head == BATTERY and not robot.knows([p.name]):
            why = "not stated: an example value. Results on the battery depend on it"
        else:
            of_load = of_loads.get(key) if head in robot.configurations else None
            why = reasons.get(p.name) or of_load or "not stated: none"
        origins.append(NumberOrigin(p.name, float(p.value), p.spec.unit, priors.get(p.name), why))
    return origins
