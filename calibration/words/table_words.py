"""Sentences about a table before any fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from calibration.data.columns import LOAD
from calibration.data.input_errors import bound_text
from calibration.inference import fit_notes

#: Measurements that determine a parameter which the data do not, by the start or end of its name.
WOULD_MEASURE = {
    "battery.": "runs on the on-board battery (Source Mode 1)",
    "motor.inductance": "a time history of the start-up current, with samples every tenth of a millisecond",
    "motor.inertia": "a time history of the start",
    ".inertia": "a time history of the start",
    "motor.resistance_thermal": "long runs at high current with the effect winding_heating present",
    "motor.temperature_ambient": "runs at several room temperatures with the effect winding_heating present",
    ".friction.dynamic": "a history in which the movers spin faster than V_d (a start on a slippery slope)",
    ".friction.speed_dynamic": "a history in which the movers spin faster than V_s (a start on a slippery slope)",
    ".guide_share": "the fidelities steady and drive (the track model puts it out; free guide_friction there)",
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
    for key, what in WOULD_MEASURE.items():
        if name.startswith(key) or name.endswith(key):
            return what
    return "runs under conditions in which it acts"


def unmeasured_parameter(note: fit_notes.Unmeasured) -> str:
    """A free parameter that moves no reading."""
    return (
        f"{note.name}: nothing in these data measures it; its value is its prior's. {would_measure(note.name)} would"
    )


def differing_repeats(note: fit_notes.Repeats) -> str:
    """Rows under the same conditions whose readings differ."""
    (first, second), (one, other) = note.rows, map(bound_text, note.values)
    more = f" (and so {note.more} more)" if note.more else ""
    said = (
        f"{note.source} rows {first} and {second}, {note.column}: the same conditions gave {one} and {other}, "
        f"{note.apart} apart{more}"
    )
    if note.unused:
        many = len(note.unused) > 1
        name = f'state [columns] {note.near} = "{note.unused[0]}"' if note.near else "name it under [columns]"
        return (
            f"{said}; {', '.join(note.unused)} {'vary' if many else 'varies'} there and {'are' if many else 'is'} "
            f"not used as a condition: {name}, or give each level of a load a configuration"
        )
    wrong = f"{said}; if one is wrong, remove it"
    return f"{wrong}, else find what changed between such rows that the table does not state" if note.more else wrong


def unused_columns(note: fit_notes.Unused) -> str:
    """Columns that vary and have no role, and what each may be."""
    names = [name for name, _ in note.columns]
    vary, are = ("vary", "are") if len(names) > 1 else ("varies", "is")
    said = [f"{note.source}: {', '.join(names)} {vary} from row to row and {are} not used"]
    for name, near in note.columns:
        if near:
            said.append(f'if {name} is {near}, state [columns] {near} = "{name}" in the robot\'s file')
    return "; ".join(said)


def nothing_varies(note: fit_notes.NothingVaries) -> str:
    """Runs of one condition."""
    many = len(note.unused) > 1
    unused = f"{', '.join(note.unused)} {'vary' if many else 'varies'} and {'are' if many else 'is'} not used: name "
    unused += (
        f"{'them' if many else 'it'} under [columns] if {'they are conditions' if many else 'it is a condition'}, or "
    )
    return (
        f"{note.source}: nothing varies in these {note.rows} runs but noise, so nothing can be told from them; "
        f"{unused * bool(note.unused)}record runs at several values of {note.column} or of the load"
    )


def copied_channel(note: fit_notes.Copied) -> str:
    """A channel that is a line of another."""
    start = f"{note.intercept:.4g} {'+' if note.slope >= 0 else '-'} " if note.intercept else ""
    slope = abs(note.slope) if note.intercept else note.slope
    said = f"{note.source}, {note.column}: in every row {start}{slope:.4g} times {note.of}, to the last digit"
    if note.tied:
        return f"{said}; if it is computed from it and no reading, remove it, as its noise then counts twice"
    if note.column == LOAD:
        return (
            f"{said}: it is computed and was never measured, so it tells nothing of torque constant, friction or "
            "efficiency; remove the column and keep the rows without a load, or give a torque that was set or read"
        )
    return f"{said}: it is computed from it and no reading; remove it from channels and table, or read an instrument"


def constant_condition(note: fit_notes.Constant) -> str:
    """A condition that does not vary."""
    here = f"{note.column} is {bound_text(note.value)} in every row"
    return f"{here}: {ALIKE[note.alike]}, and only their priors tell them apart"


def ends_early(note: fit_notes.EndsEarly) -> str:
    """Histories that end before the robot is under way."""
    at = "" if math.isnan(note.share) else f", at {note.share:.0%} of the speed of steady travel"
    return (
        f"{_runs(note.runs, 'ends', 'end')} after {note.lasts:.2g} s at the latest{at}: before the robot is under "
        "way, so what resists its travel is known by its priors; record until the speed is steady"
    )


def never_grips(note: fit_notes.NeverGrips) -> str:
    """Histories in which the movers slide to the end."""
    return (
        f"{_runs(note.runs, 'never grips', 'never grip')}: in the end the robot travels at {note.share:.0%} of the "
        "speed of its movers, so what the ground holds before it slides is not measured there"
    )


def _runs(names: tuple[str, ...], one: str, several: str) -> str:
    return f"run {names[0]} {one}" if len(names) == 1 else f"runs {', '.join(names)} {several}"


def coarse_steps(note: fit_notes.CoarseSteps) -> str:
    """Steps that do not resolve waves."""
    return (
        f"runs of {note.lasts:.0f} s are followed in steps of {1e3 * note.step:.0f} ms: waves of a shaft faster than "
        "some ten steps are not resolved; cut the runs to look for them"
    )


def inherited_priors(note: fit_notes.InheritedPriors) -> str:
    """A part that is not the nominal robot's while friction of it is."""
    changed = ", ".join(
        f"{name} {bound_text(mine)} for {bound_text(nominal)}" for name, mine, nominal in note.changed
    )
    one = len(note.kept) == 1
    return (
        f"{note.part} is not the nominal robot's ({changed}), but its {', '.join(note.kept)} still "
        f"{'is' if one else 'are'}: {'that prior comes' if one else 'those priors come'} from another robot; state "
        "yours in the robot's file or with --prior"
    )


def off_by(note: fit_notes.OffBy) -> str:
    """Readings that no robot like this one shows."""
    off, size = (note.factor, "large") if note.factor > 1 else (1 / note.factor, "small")
    what = f"{note.column}: readings are about {bound_text(float(f'{off:.2g}'))} times too {size} for this robot"
    alike = f"; {' and '.join(note.others)} alike: check {note.imposed} and the robot's file" if note.others else ""
    if note.units:
        return f"{what}; are they in {' or '.join(note.units)}? expected {note.unit}{alike}"
    return f"{what}{alike}" if note.others else f"{what}; check the unit, {note.unit}, and the robot's file"


#: Kind of note → a sentence with its fields, or a function that makes one.
SAID: dict[type, str | Callable[[Any], str]] = {
    fit_notes.Unmeasured: unmeasured_parameter,
    fit_notes.Constant: constant_condition,
    fit_notes.Repeats: differing_repeats,
    fit_notes.LargerNoise: "{channel}: {pairs} pairs of rows at the same conditions scatter "
    "{factor:.2g} times as much "
    "as the {source} noise says; its sd is taken {factor:.2g} times as large. Check the repeats, or state the noise "
    "with --noise",
    fit_notes.Unused: unused_columns,
    fit_notes.NoLoadGives: "{source}, {theirs}: friction and a constant torque of a load leave {share:.0%} of its "
    "variance unexplained; if a brake sets it, it is a condition: state [columns] load_torque_Nm = "
    '"{theirs}" in the robot\'s file, and take output_torque out of its channels',
    fit_notes.NothingVaries: nothing_varies,
    fit_notes.Copied: copied_channel,
    fit_notes.Turned: "{source}, {theirs}: off by {off:.2g} (rms) from what the file's numbers give, "
    "with the other sign "
    'by {turned:.2g}; if it is turned round, state [columns] {column} = {{column = "{theirs}", factor = -1}}',
    fit_notes.StiffSupply: "{column} is {value:g} in every row: taken for a stiff supply; if it is "
    "no reading, remove "
    "the column",
    fit_notes.EndsEarly: ends_early,
    fit_notes.NeverGrips: never_grips,
    fit_notes.Thinned: "{source}: readings of {kept} of {rows} rows are used, evenly in time, and "
    "what drives the runs "
    "in all of them; --rows uses more or fewer, and settle uses all",
    fit_notes.ThinnedTable: "{source}: {kept} of {rows} rows are used, spread evenly over the conditions; row "
    "numbers count these; --rows uses more or fewer",
    fit_notes.CoarseSteps: coarse_steps,
    fit_notes.StopsOnSlope: "run {runs}: the motors are not driven on a slope; histories have smooth "
    "friction at rest, "
    "and a robot that should stand there creeps by some mm/s. Leave rows at rest out where their readings are finer "
    "than that",
    fit_notes.InheritedPriors: inherited_priors,
    fit_notes.OffBy: off_by,
    fit_notes.SlopesIn: "slope_deg: the current rises {rise:.2g} times as fast with the slope as "
    "this robot's; are the "
    "slopes in {unit}? expected degrees",
}
