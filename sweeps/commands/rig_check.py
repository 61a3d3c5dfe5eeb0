"""The command `rig check`: how a rig file is interpreted, whether its numbers are plausible, and what data can
determine.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Json, Names, rig_facts, settling, stated
from calibration.data.columns import IMPOSED, SUPPLY, Layout
from calibration.data.input_errors import BadConfiguration
from calibration.data.rig_facts import DerivedFact, NumberOrigin
from calibration.data.rig_file import FREE
from calibration.data.runs import Runs
from calibration.described import as_paragraph, describe, sentences
from calibration.inference import foresight, identifiability, priors
from calibration.inference.fit_notes import determination
from calibration.inference.foresight import InformationForecast, ParameterInformation
from calibration.inference.identifiability import undetermined_names
from calibration.words import fit_words
from mmrjax.errors import count_noun
from mmrjax.model import channels
from mmrjax.model.driver import FAST
from mmrjax.model.gearmotor import UNLIMITED
from mmrjax.model.quantities import GOALS, HEAT
from mmrjax.model.robot import Robot
from mmrjax.model.shaft import Shaft
from sweeps.config import RobotPart
from sweeps.console import print_json
from sweeps.inputs import load_robot, read_runs
from sweeps.pages import words
from sweeps.report.document import Block, Document, Note, Table, columns, remarks
from sweeps.report.terminal_renderer import print_document

#: Names of a list in a sentence, and remarks on a terminal.
NAMED, FEW = 8, 3


@dataclasses.dataclass(frozen=True)
class RigCheck:
    """Result of `rig check`.

    Attributes:
        file: file that was read.
        robot: robot of the file.
        examples: lines of the file that are marked as an example and still have the template's number.
        unmarked: other lines with the name and number of a template's example, except 0 and 1.
        origins: origins of its numbers.
        facts: values that follow from its numbers.
        runs: runs of the table, None without a table.
        foresight: parameters that the table can determine.
        doubts: sentences on doubts about a log: wrong signs, time or current in another unit.
    """

    file: str
    robot: Robot
    examples: tuple[int, ...]
    unmarked: tuple[int, ...]
    origins: tuple[NumberOrigin, ...]
    facts: tuple[DerivedFact, ...]
    runs: Runs | None = None
    foresight: InformationForecast | None = None
    doubts: Names = ()

    def understood(self) -> list[str]:
        """Sentences on the rig, its drive and its sensors."""
        robot, rig = self.robot, self.robot.rig
        count = int(robot.sides)
        motors = "One motor drives" if count == 1 else f"{count} motors with the same command drive"
        gear_words = f"{'its' if count == 1 else 'their'} gearbox {float(robot.gearbox.ratio):g} : 1"
        names: dict[str, list[str]] = {}
        for name, load in robot.configurations.items():
            names.setdefault(_load_words(load), []).append(name)
        loads = "; ".join(f"{_few(alike)}: {load}" for load, alike in names.items())
        imposed = {
            "voltage": "the voltage (times the duty in histories)",
            "motor_speed": "the motors' speed",
            "motor_current": "the current of each motor",
            **{goal: f"the goal of a controller ({goal.removeprefix('goal_')})" for goal in GOALS},
        }[rig.imposed]
        starts = {
            "rest": "start at rest",
            "measured": "start from the state in their first samples",
            "free": "start from a fitted state",
        }
        delay_words = f", with a delay of {float(rig.delay):g} s" * bool(rig.delay)
        row_words = ", interpolated between the rows of time histories" * (rig.between_rows == "linear")
        decay_words = "; between the pulses of a duty the motors coast" * (self.robot.driver.decay == FAST)
        return [
            f"{motors}, through {gear_words}, {loads}.",
            f"Imposed: {imposed}{delay_words}{row_words}{decay_words}. Time histories {starts[rig.start]}.",
        ]

    def remarks(self) -> list[str]:
        """Sentences on points to check, one each."""
        notes = []
        if self.robot.rig.inherits:
            notes.append('missing values come from the base, a packaged robot. base = "none" prevents this')
        widened = f"({stated.EXAMPLE}): {{}}. a fit widens each ± among them to {100 * stated.EXAMPLE_SHARE:g} %"
        for lines, text in (
            (self.examples, f"example number {widened}"), (self.unmarked, "example: {}. Check that it is yours"),
        ):  # fmt: skip
            if lines:
                numbers = text.format(", ".join(map(str, lines)))
                notes.append(f"{count_noun(len(lines), 'line')} with the template's {numbers}")
        notes += self.doubts
        if self.runs is not None and self.runs.has("duty") and self.runs.has("total_current_A"):
            notes.append("with a duty, total_current is that of the supply. Motor leads carry motor_current")
        notes += [f"{fact.what} {fact.value}: {fact.odd}" for fact in self.facts if fact.odd]
        without_sd = [o for o in self.origins if o.why.startswith("the file") and o.sd is None and o.value]
        if without_sd and not self.robot.rig.inherits:
            sds = priors.parameter_coordinates(self.robot, [o.name for o in without_sd]).prior_sd
            shares = [f"{o.name} (±{100 * sd / abs(o.value):.2g} %)" for o, sd in zip(without_sd, sds, strict=True)]
            notes.append(f"no ± is given, so the default ± is used: {_few(shares)}")
        if not self.robot.knows(HEAT) and self.robot.motor.temperature_limit < UNLIMITED:
            lacking = " and ".join(self.robot.unknown(HEAT))
            notes.append(f"motor.temperature_limit cannot be checked without {lacking}: add {lacking}")
        if self.robot.motor.voltage_limit is None and self.robot.rig.imposed == "voltage":
            notes.append("no motor.voltage_limit: experiments go up to the table's highest voltage")
        return notes

    def channels(self) -> list[Json]:
        """Name, column in the file, sign convention, resolution [unit] and source of the sd of each channel."""
        columns_by_channel = {name: column for name, column, _ in self.robot.rig.columns}
        rig, rows = (self if self.foresight is None else self.foresight).robot.rig, []
        for k, channel in enumerate(self.robot.channels):
            instrument = rig.instrument(channel.name)
            share = f"{100 * channel.sd_share:g} %"
            sd = f"{channel.sd_column} of the table, otherwise {share} of the reading"
            if self.foresight is not None:
                words_by_source = {
                    "columns": "of the table", "series": "estimated along series of rows",
                    "assumed": f"assumed, {share}, since there is no column {channel.sd_column}",
                }  # fmt: skip
                sd = words_by_source.get(self.foresight.noise[k], self.foresight.noise[k])
            rows.append(
                {
                    "channel": channel.name,
                    "column": columns_by_channel.get(channel.column, channel.column),
                    "signed": instrument.signed,
                    "quantum": None if instrument.quantum is None else instrument.quantum / channel.factor,
                    "unit": channel.unit,
                    "sd": sd,
                }
            )
        return rows

    def columns(self) -> list[Json]:
        """Use and range of each column of the table."""
        if self.runs is None:
            return []
        rows, headings, layout = [], self.runs.headings, Layout.of(self.robot)
        # columns of ground, or of another kind of drive
        idle = {*layout.idle, *([SUPPLY] if self.robot.rig.imposed != "voltage" else [])}
        uses = {c.sd_column: f"sd of {c.name}" for c in channels.EVERY}
        uses |= {c.column: f"channel {c.name}" for c in self.robot.channels}
        uses[IMPOSED[self.robot.rig.imposed][0]] = "imposed"
        for name, values in self.runs.columns.items():
            if name not in headings and name in idle:
                continue
            is_number = np.issubdtype(values.dtype, np.number)
            finite = values[np.isfinite(values)] if is_number else values
            distinct = np.unique(finite)
            rows.append(
                {
                    "column": name,
                    "theirs": headings.get(name, ""),
                    "use": uses.get(name, "condition") if name in headings else "not in the table",
                    "values": len(distinct),
                    "least": float(finite.min()) if is_number and len(finite) else None,
                    "greatest": float(finite.max()) if is_number and len(finite) else None,
                    "words": [] if is_number else distinct.tolist(),
                }
            )
        return rows

    def unused(self) -> list[str]:
        """Reason why each unused column is not used."""
        if self.runs is None:
            return []
        names = {c.column: c.name for c in channels.EVERY}
        notes = [
            f"{name}: not a channel of the rig. To use it, add {names[name]} to its channels"
            for name in self.runs.unknown
            if name in names
        ]
        if others := [name for name in self.runs.unknown if name not in names]:
            advice = "used only to group residuals. To use one, name it under [columns]"
            notes.append(f"{', '.join(others)}: {advice}")
        return notes

    def statement(self) -> str:
        """Sentence on the parameters that the table can determine."""
        if self.foresight is None:
            return "Add a table to see which parameters it determines."
        pairs = self.foresight.together
        prior_bound = undetermined_names([p.name for p in self.foresight.parameters if p.held], pairs)
        traded = {name for pair in pairs for name in (pair.one, pair.other)}
        determined = [p.name for p in self.foresight.parameters if not p.held and p.name not in traded]
        determined += [fit_words.determined_combination(p) for p in pairs]
        answer = f"These data determine {', '.join(determined) or 'no parameter'}"
        return answer + f"; {', '.join(prior_bound)} are not determined by these runs" * bool(prior_bound) + "."

    def determined(self, parameter: ParameterInformation) -> str:
        """`yes`, `no`, or the parameters with which the table determines this one in combination."""
        assert self.foresight is not None
        return describe(determination(parameter.name, parameter.held, self.foresight.together))

    def to_json(self) -> Json:
        """The whole check as JSON-able data."""
        runs = None
        if self.runs is not None:
            assert self.foresight is not None
            runs = {
                "source": self.runs.source,
                "rows": len(self.runs),
                "columns": self.columns(),
                "unused": self.unused(),
                "status": dict(sorted(Counter(self.foresight.status).items())),
                "parameters": [
                    {**dataclasses.asdict(p), "determined": self.determined(p)} for p in self.foresight.parameters
                ],
                "alike": [list(pair) for pair in self.foresight.alike],
                "separating": [list(columns) for columns in self.foresight.separating],
                "together": [pair.to_json() for pair in self.foresight.together],
            }
        return {
            "schema": "mmrjax.rig_check/1",
            "file": self.file,
            "understood": self.understood(),
            "imposed": self.robot.rig.imposed,
            "start": self.robot.rig.start,
            "configurations": list(self.robot.configurations),
            "channels": self.channels(),
            "numbers": [dataclasses.asdict(o) for o in self.origins],
            "facts": [dataclasses.asdict(f) for f in self.facts],
            "remarks": self.remarks(),
            "data": runs,
            "statement": self.statement(),
        }


def _few(names: Sequence[str]) -> str:
    """The first names of a list, and the number of others."""
    return ", ".join(names[:NAMED]) + f" and {len(names) - NAMED} others" * (len(names) > NAMED)


def _load_words(load: Any) -> str:
    if not isinstance(load, Shaft):
        movers = "tracks" if float(load.on_tracks) > 0.5 else "wheels"
        return f"a vehicle of {float(load.mass):g} kg on {movers}"
    words = [f"a shaft of {float(load.inertia):.3g} kg·m²"]
    words += ["an arm under gravity"] if float(load.torque_gravity) > 0 else []
    words += ["a constant torque"] if float(load.torque_constant) != 0 else []
    travel = float(load.radius)
    words += [f"{2e3 * np.pi * travel:.4g} mm of travel per turn"] if travel != 1.0 else []
    return ", ".join(words)


def check_rig_file(
    file: Path, data: str | None, effects: Names, as_json: bool, columns: str | None = None, verbose: bool = False
) -> int:
    """Reports how a rig file was interpreted, and which parameters a table can determine. Returns 0.

    Raises:
        BadConfiguration: the file cannot be read, or lacks entries. The message lists all of them.
        BadData: the table cannot be used with this rig.
    """
    if file.is_dir():
        raise BadConfiguration(f"{file}: is a folder; expected a rig's TOML file")
    if not file.is_file():
        raise BadConfiguration(f"{file}: no such file; mmrjax rig new {file} writes one to fill in")
    check = examine_rig_file(file, data, effects, columns)
    if as_json:
        print_json(check.to_json())
    else:
        print_document(check_document(check), brief=not verbose)
    return 0


def examine_rig_file(file: Path, data: str | None, effects: Names = (), columns: str | None = None) -> RigCheck:
    """Remarks on a rig's file, and on a table whose columns a preset may name."""
    robot_file = load_robot(RobotPart(robot=str(file), effects=effects))
    lines, robot = robot_file.text.splitlines(), robot_file.robot
    examples = tuple(k for k, line in enumerate(lines, 1) if stated.is_example(line))
    unmarked = tuple(k for k, line in enumerate(lines, 1) if stated.has_template_number(line) and k not in examples)
    origins, facts = tuple(rig_facts.number_origins(robot_file)), tuple(rig_facts.derived_facts(robot))
    check = RigCheck(robot_file.name, robot, examples, unmarked, origins, facts)
    if data is None:
        return check
    runs = read_runs(data, robot, columns=columns, measured=True, series=True)
    forecast = foresight.predict_identifiability(runs, robot)
    doubts = (
        *filter(None, (settling.doubtful_sign(runs),)),
        *rig_facts.log_doubts(runs, robot),
        *sentences(forecast.doubts),
    )
    return dataclasses.replace(check, runs=runs, foresight=forecast, doubts=doubts)


def check_document(check: RigCheck) -> Document:
    """The whole check as a document."""
    signs = {None: FREE, True: "signed", False: "magnitude"}
    steps = (
        FREE if c["quantum"] is None else f"{c['quantum']:.3g} {c['unit']}" if c["quantum"] else ""
        for c in check.channels()
    )
    blocks = [
        (c["channel"], c["column"], signs[c["signed"]], step, c["sd"])
        for c, step in zip(check.channels(), steps, strict=True)
    ]
    sds = ("" if o.sd is None else f"{o.sd:.2g}" if o.sd > 0 else "exact" for o in check.origins)
    numbers = [(o.name, o.value, sd, o.unit, o.why) for o, sd in zip(check.origins, sds, strict=True)]
    follows = [(fact.what, fact.value, "LOOK" if fact.odd else "ok") for fact in check.facts]
    table_words: Names = ()
    if check.runs is not None:
        used = [
            c["theirs"] or c["column"]
            for c in check.columns()
            if c["use"] not in ("condition", "not in the table") or (c["use"] == "condition" and c["values"] > 1)
        ]
        unused = f" Not in use: {', '.join(check.runs.unknown)}." * bool(check.runs.unknown)
        table_words = (f"{count_noun(len(check.runs), 'row')}. Columns in use: {', '.join(used)}.{unused}",)
    notes = check.remarks()
    first_remarks = f"Check: {as_paragraph(notes[:FEW])}" if notes else "Nothing to check."
    further_remarks = f" and {count_noun(len(notes) - FEW, 'further remark')}" * (len(notes) > FEW)
    return Document(
        check.file,
        f"{check.file}: {check.statement()}",
        (
            Note(" ".join(check.understood()), terminal=True),
            Table("channels", columns("channel", "column", "sign", "step |", "sd"), blocks, "channels"),
            Table("numbers", columns("parameter", "value | .5g", "± |", "unit", "from"), numbers, "numbers"),
            Table("facts", columns("fact", "value |", "check"), follows, "what follows"),
            *remarks(check.remarks()),
            *(_data_blocks(check, check.runs, check.foresight) if check.runs and check.foresight else ()),
        ),
        brief=(
            " ".join(check.understood()),
            *table_words,
            f"{first_remarks} --verbose prints all tables{further_remarks}.",
        ),
    )


def _data_blocks(check: RigCheck, runs: Runs, forecast: InformationForecast) -> tuple[Block, ...]:
    column_rows = [
        (
            c["column"] if c["theirs"] in ("", c["column"]) else f"{c['column']}, yours {c['theirs']}",
            c["use"], c["values"], *(("", "") if c["words"] else (c["least"], c["greatest"])),
            ", ".join(c["words"]) if len(c["words"]) < 5 else f"{', '.join(c['words'][:3])}, ...",
        )
        for c in check.columns()
    ]  # fmt: skip
    notes = check.unused()
    if len(forecast.status) < len(runs):
        notes.insert(0, f"loop and calibrate use {len(forecast.status)} of these rows (--rows)")
    has_clamped_rows = runs.has("held") or (
        runs.layout.imposed == "motor_speed" and not runs[runs.layout.imposed_column].any()
    )
    settled = {*words.SETTLED, *(["stalled"] if has_clamped_rows else [])}  # a held shaft is meant to stand still
    others = [
        f"{count_noun(count, 'row')}: {name}"
        for name, count in Counter(forecast.status).items()
        if name not in settled
    ]
    if others:
        notes.append(f"some rows have no steady state with the file's numbers ({', '.join(others)})")
    determined = [
        (p.name, p.value, p.prior_sd, p.unit, p.share, check.determined(p))
        for p in sorted(forecast.parameters, key=lambda p: p.share)
    ]
    headings = columns("parameter", "value | .4g", "prior ± | .2g", "unit", "posterior/prior | .2f", "determined")
    alike = (
        f"{one} and {other} are nearly indistinguishable in these data (correlation {size:+.2f})"
        + f"; {' or '.join(separating)} would separate them" * bool(separating)
        for (one, other, size), separating in zip(forecast.alike, forecast.separating, strict=True)
    )
    return (
        Table(
            "columns", columns("column", "used as", "values |", "from | .5g", "to | .5g", "words"), column_rows,
            f"{runs.source}: {count_noun(len(runs), 'row')}",
        ),
        *remarks(notes),
        Table(
            "determined", headings, determined,
            "parameters that these data determine (posterior sd over prior sd)",
        ),
        Note(f"not determined: above {identifiability.HELD:g}", terminal=True),
        *remarks(alike),
    )  # fmt: skip
