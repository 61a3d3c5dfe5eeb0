"""Sentences about a table before any fit."""

from __future__ import annotations

import math
from collections.abc import Callable

from calibration.data import Names

#: Measurements that determine a parameter which the data do not, by the start or end of its name.
WOULD_MEASURE = {
    "battery.": "runs on the on-board battery (Source Mode 1)",
    "motor.inductance": "a time history of the start-up current, sampled every 0.1 ms",
    "motor.inertia": "a time history of the start",
    ".inertia": "a time history of the start",
    "motor.resistance_thermal": "long runs at high current with the effect winding_heating present",
    "motor.temperature_ambient": "runs at several room temperatures with the effect winding_heating present",
    ".friction.dynamic": "a history in which the movers spin faster than V_d (a start on a slippery slope)",
    ".friction.speed_dynamic": "a history in which the movers spin faster than V_s (a start on a slippery slope)",
    ".guide_share": "the fidelities steady and drive (the track model computes it, so fit guide_friction there)",
    ".mass": "a scale, or runs whose table does not state total_mass_kg",
}
#: Losses that data do not distinguish without variation of a condition.
ALIKE = {
    "guides": "without slopes, rolling resistance, guide friction and Coulomb losses have the same effect",
    "slope": "without slopes, rolling resistance and Coulomb losses have the same effect",
    "voltage": "at one voltage, losses that grow with speed and constant losses have the same effect",
    "speed": "at one speed, losses that grow with speed and constant losses have the same effect",
}


def would_measure(name: str) -> str:
    """Runs or instrument that would measure a parameter that these data do not."""
    for key, meaning in WOULD_MEASURE.items():
        if name.startswith(key) or name.endswith(key):
            return meaning
    return "runs under conditions in which it has an effect"


def differing_repeats(
    source: str,
    rows: tuple[int, int],
    column: str,
    values: tuple[float, float],
    apart: str,
    unused: Names = (),
    more: int = 0,
    near: str = "",
) -> str:
    """Rows under the same conditions whose readings differ."""
    (first, second), (one, other) = rows, values
    reading = (
        f"{source} rows {first} and {second}, {column}: the same conditions gave {one:g} and {other:g}, {apart} "
        f"apart{f' (and {more} more pairs like this)' * bool(more)}"
    )
    if unused:
        many = len(unused) > 1
        name = f'set [columns] {near} = "{unused[0]}"' if near else "name it under [columns]"
        return (
            f"{reading}. {', '.join(unused)} {'vary' if many else 'varies'} between these rows and "
            f"{'are' if many else 'is'} not used as a condition. Therefore {name}, or, for a load, give each level "
            "its own configuration"
        )
    wrong = f"{reading}. Remove the wrong row"
    return f"{wrong}, or find what changed between these rows and has no column in the table" if more else wrong


def unused_columns(source: str, columns: tuple[tuple[str, str], ...]) -> str:
    """Columns that vary and have no role, and what each may be."""
    names = [name for name, _ in columns]
    vary, are = ("vary", "are") if len(names) > 1 else ("varies", "is")
    sentences_unused = [f"{source}: {', '.join(names)} {vary} from row to row and {are} not used"]
    for name, near in columns:
        if near:
            sentences_unused.append(f'If {name} is {near}, set [columns] {near} = "{name}" in the robot\'s file')
    return ". ".join(sentences_unused)


def nothing_varies(source: str, rows: int, column: str, unused: Names = ()) -> str:
    """Runs of one condition."""
    vary, are, them, if_conditions = (
        ("vary", "are", "them", "they are conditions")
        if len(unused) > 1
        else ("varies", "is", "it", "it is a condition")
    )
    name = f"{', '.join(unused)} {vary} and {are} not used. Name {them} under [columns] if {if_conditions}, or "
    record = f"{'r' if unused else 'R'}ecord runs at several values of {column} or at several loads"
    return (
        f"{source}: these {rows} runs differ only by noise, so they determine nothing. {name * bool(unused)}{record}"
    )


def copied_channel(source: str, column: str, other: str, intercept: float, slope: float, tied: bool) -> str:
    """A channel that is a line of another."""
    start = f"{intercept:.4g} {'+' if slope >= 0 else '-'} " if intercept else ""
    factor = abs(slope) if intercept else slope
    sentence = f"{source}, {column}: equals {start}{factor:.4g} times {other} in every row, to the last digit"
    if tied:
        return (
            f"{sentence}. If it is computed rather than measured, remove it: the noise of {other} would count twice"
        )
    return f"{sentence}, so it is computed, not measured. Measure it, or remove it from the channels and the table"


def sentence_on_short_histories(runs: Names, lasts: float, share: float) -> str:
    """Histories that end before the robot is under way."""
    at_speed = "" if math.isnan(share) else f", at {share:.0%} of the speed of steady travel"
    return (
        f"{_runs(runs, 'ends', 'end')} after {lasts:.2g} s at the latest{at_speed}, before the speed is steady. "
        "So the resistance to travel is known only from its priors. Record until the speed is steady"
    )


def _runs(names: Names, one: str, several: str) -> str:
    return f"run {names[0]} {one}" if len(names) == 1 else f"runs {', '.join(names)} {several}"


def inherited_priors(part: str, changed: tuple[tuple[str, float, float], ...], kept: Names) -> str:
    """A part that is not the nominal robot's while friction of it is."""
    changes = ", ".join(f"{name} {own_value:g} instead of {nominal:g}" for name, own_value, nominal in changed)
    return (
        f"the {part} differs from that of the nominal robot ({changes}), but {', '.join(kept)} still "
        f"{'has' if len(kept) == 1 else 'have'} the nominal robot's prior. Set your values in the robot's file or "
        "with --prior"
    )


def sentence_on_implausible_readings(
    column: str, unit: str, factor: float, units: Names, others: Names, imposed: str
) -> str:
    """Readings that no robot like this one shows."""
    ratio, size = (factor, "large") if factor > 1 else (1 / factor, "small")
    subject = f"{column}: readings are about {float(f'{ratio:.2g}'):g} times too {size} for this robot"
    alike = f"; the same factor in {' and '.join(others)}: check {imposed} and the robot's file" if others else ""
    if units:
        return f"{subject}; are they in {' or '.join(units)}? expected {unit}{alike}"
    return f"{subject}{alike}" if others else f"{subject}; check the unit, {unit}, and the robot's file"


#: Code of a remark → a sentence with its values, or a function that makes one.
SAID: dict[str, str | Callable[..., str]] = {
    "unmeasured": lambda name: (
        f"{name} keeps its prior value, because these data do not determine it. To measure it, use "
        f"{would_measure(name)}"
    ),
    "constant": lambda column, value, alike: (
        f"{column} is {value:g} in every row: {ALIKE[alike]}, so only their priors distinguish them"
    ),
    "repeats": differing_repeats,
    "larger_noise": "{channel}: {pairs} pairs of rows at the same conditions scatter {factor:.2g} times as much "
    "as the {source} noise predicts, so its sd is multiplied by {factor:.2g}. Check the repeats, "
    "or state the noise with --noise",
    "unused": unused_columns,
    "no_load_gives": "{source}, {theirs}: the friction and the constant torque of the load leave {share:.0%} of its "
    "variance unexplained. If a brake sets this torque, it is a condition. Then set [columns] load_torque_Nm "
    '= "{theirs}" in the robot\'s file, and remove output_torque from its channels',
    "nothing_varies": nothing_varies,
    "copied": copied_channel,
    "turned": "{source}, {theirs}: differs by {off:.2g} (rms) from the values that follow from the robot file, "
    "but only by {turned:.2g} with the opposite sign. If the instrument's sign is reversed, set [columns] "
    '{column} = {{column = "{theirs}", factor = -1}}',
    "stiff_supply": "{column} is {value:g} in every row, so the supply is treated as stiff. If the voltage was not "
    "measured, remove the column",
    "lost_motion": lambda source, column, reversals, width, unit, angle, stiffness: (
        f"{source}, {column}: "
        + (
            f"the output lags the motor by {width:.2g} {unit} rms in proportion to its acceleration, as with a "
            "compliant "
            f'coupling, perhaps with backlash. Set damping and stiffness = "{stiffness:.2g} ± 50 %" (N·m/rad'
            if stiffness
            else f"at each of {reversals} reversals about {width:.2g} {unit} of motion is lost. Friction, inertia "
            f'and delay do not explain this, but backlash or a compliant coupling does. Set backlash = "{angle:.2g} '
            '± 30 %" (rad'
        )
        + " at the output) in the load's table of the robot file"
    ),
    "ends_early": sentence_on_short_histories,
    "never_grips": lambda runs, share: (
        f"{_runs(runs, 'slides', 'slide')} to the end: the robot then travels at {share:.0%} of the speed of its "
        "tracks or wheels. Such runs do not measure the static friction of the ground"
    ),
    "thinned": "{source}: the fit uses readings of {kept} of {rows} rows, evenly spaced in time, and the imposed "
    "quantity of all rows. Change the number with --rows, or use settle, which takes all rows",
    "thinned_table": "{source}: {kept} of {rows} rows are used, spread evenly over the conditions. Row numbers "
    "refer to the rows used. Set how many are used with --rows",
    "coarse_steps": lambda lasts, step: (
        f"runs of {lasts:.0f} s are simulated in steps of {1e3 * step:.0f} ms. Ripple of a shaft with a period below "
        "about ten steps is not resolved. Use shorter runs to look for it"
    ),
    "stops_on_slope": "run {runs}: the motors are not driven on a slope. Time histories smooth the friction at rest, "
    "so a robot that should stand still creeps at a few mm/s. Leave out rows at rest if their readings are more "
    "exact than that",
    "inherited_priors": inherited_priors,
    "off_by": sentence_on_implausible_readings,
    "slopes_in": "slope_deg: the current rises {rise:.2g} times as fast with the slope as for this robot; are "
    "the slopes in {unit}? expected degrees",
}
