"""The command `explain`: meaning of a name, taken from the code that defines it."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from calibration.data import Names, effect_file, robot_file
from calibration.data.input_errors import BadConfiguration
from calibration.words import experiment_words
from mmrjax import derived, effects
from mmrjax.effects import Effect
from mmrjax.errors import similar_words
from mmrjax.fidelities import outputs
from mmrjax.missions import mission_batch
from mmrjax.model import channels, paper_robots, params, quantities
from mmrjax.model.params import Spec
from mmrjax.model.signals import Result
from sweeps.console import print_output
from sweeps.pages import words
from sweeps.report.climb_report import VERDICTS

#: Effects by name.
Library = dict[str, type[Effect]]
#: A line of an explanation: heading and text.
Line = tuple[str, str]
#: Function that returns lines on a name, none if it has no such meaning.
Explain = Callable[[str, Library], Iterator[Line]]
WIDTH, INDENT = 80, 16
#: Outputs of runs, and of missions.
EVERY_OUTPUT: tuple[Any, ...] = (*outputs.FURTHER, *derived.TABLE, *mission_batch.OUTPUTS, *mission_batch.OF_TURNS)

#: Keys of robot files that no fit frees, with their meanings.
KEYS = {name: meaning for name, (_, _, meaning) in robot_file.SETTINGS.items()}


def explain_name(name: str | None, files: Names) -> int:
    """Explains an effect, status, flag, output, channel or parameter by its name. Without a name, lists all.

    Raises:
        BadConfiguration: the name is unknown. The message lists the nearest ones.
    """
    library = {**effect_file.effect_library(files), **effects.BESIDE}
    names = explainable_names(library)
    if name is None:
        for kind, those in names.items():
            print_output(_wrapped(kind, ", ".join(those)))
        print_output("mmrjax explain NAME explains one.")
        return 0
    explained = False
    for kind, about in EXPLAINED.items():
        for k, (heading, text) in enumerate(about(name, library)):
            if k == 0:
                print_output(f"{name}: {kind}")
            print_output(_wrapped(heading, text))
            explained = True
    if not explained:
        below = [p for p in names["parameters"] if p.endswith(f".{name}")]
        if below:
            raise BadConfiguration(f"explain: got {name}; did you mean one of these? {', '.join(below)}")
        close = similar_words(name, [n for those in names.values() for n in those], 3)
        hint = f"did you mean {', '.join(close)}? " if close else ""
        raise BadConfiguration(f"explain: got {name}; {hint}mmrjax explain lists all names")
    return 0


def _wrapped(heading: str, text: str) -> str:
    head = f"  {heading} ".ljust(INDENT)  # the full name of a parameter may be longer
    return textwrap.fill(
        text, WIDTH, initial_indent=head, subsequent_indent=" " * INDENT, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip


def explainable_names(library: Library) -> dict[str, list[str]]:
    """Every name that can be explained, by kind."""
    return {
        "effects": [name for name in library if name not in effects.UNNAMED],
        "words of the reports": [word for word in words.GLOSSARY if word not in words.LOOP_VERDICTS],
        "statuses": list(words.STATUSES),
        "verdicts of the loop": list(words.LOOP_VERDICTS),
        "verdicts of a climb": list(VERDICTS),
        "flags": list(words.FLAGS),
        "channels": [c.name for c in channels.EVERY],
        "conditions": [*(c.name for c in quantities.LABELS), *(c.field for c in quantities.SET if c.field)],
        "outputs": list(dict.fromkeys(o.name for o in EVERY_OUTPUT)),
        "keys that no fit frees": list(KEYS),
        "parameters": [p.name for p in params.walk_parameters(paper_robots.nominal())],
    }


def _effect_lines(name: str, library: Library) -> Iterator[Line]:
    effect = library.get(name)
    if effect is None:
        return
    equation, meaning, source = experiment_words.effect_summary(effect)
    yield "equation", equation
    yield "stands for", meaning
    yield "enters", f"the {effect.balance} balance{f', channel {effect.channel}' if effect.channel else ''}"
    example = effect()
    for p in params.walk_parameters(example):
        if p.spec.amplitude:
            yield (
                "typical size",
                f"{p.spec.prior_sd(0.0):g} {p.spec.unit} ({p.spec.meaning}. Source: {p.spec.source})",
            )
            yield "bounds", _bounds_text(p.spec)
        else:
            yield f"  {p.name}", f"{float(p.value):g} {p.spec.unit}: {p.spec.meaning}"
    if declarations := ", ".join(experiment_words.effect_declarations(effect)):
        yield "properties", declarations
    hidden = f". Settled runs cannot distinguish it from {effect.settles_to}" if effect.settles_to else ""
    yield "in data", f"{effect.family()}{'. Only time histories show it' if effect.transient else hidden}"
    for line in _change_sentences(example):
        yield "", line
    for k, test in enumerate(experiment_words.effect_tests(effect)):
        yield "" if k else "on a bench", test
    if source:
        yield "source", source
    yield "in a file", f"[effects.{name}] amplitude = ..."


def _change_sentences(effect: Effect) -> Iterator[str]:
    """Sentences on the change of settled travel by a typical size of an effect, in percent of the readings.

    Empty if settled travel does not show the effect or the runs have no operating point.
    """
    if effect.transient or effect.needs_reverse:
        return
    import dataclasses

    import mmrjax as mm

    robot = paper_robots.nominal()
    spec = next(p.spec for p in params.walk_parameters(effect) if p.spec.amplitude)
    within = dataclasses.replace(robot, effects=(effect,))
    run = mm.Conditions(
        list(robot.configurations), voltage=24.0, slope_deg=5.0, payload=3.0, battery=float(effect.needs_battery)
    )
    sized = params.replace(within, {f"effects.{effect.name}.amplitude": np.asarray(spec.prior_sd(0.0))})
    without, with_it = (mm.simulate(r, run) for r in (within, sized))
    for k, name in enumerate(robot.configurations):
        shares = {}
        for c in robot.channels:
            reading_without, reading_with = float(without.reading[c.name][k]), float(with_it.reading[c.name][k])
            if np.isfinite(reading_with) and reading_without:
                shares[c.label] = 100 * (reading_with / reading_without - 1)
        if any(abs(x) > 5e-3 for x in shares.values()):
            changes = ", ".join(f"{label} {x:+.2g} %" for label, x in shares.items())
            yield f"change at its typical size ({name}, 24 V, 5°, 3 kg): {changes}"


def _status_lines(name: str, library: Library) -> Iterator[Line]:
    if name in words.STATUSES:
        yield "means", words.status_meaning(name)
        yield "exit code", "3, since a solver failed" if name == "failed" else "0"
        yield "in files", "column status of runs.csv, counts in result.json"


def _explain_by_table(meanings: Mapping[str, str], where: str = "") -> Explain:
    """Function that explains the names in a table of meanings. `where`: files in which they occur."""

    def about(name: str, library: Library) -> Iterator[Line]:
        if name in meanings:
            yield "means", meanings[name]
            if where:
                yield "in files", where

    return about


def _channel_lines(name: str, library: Library) -> Iterator[Line]:
    c = next((c for c in channels.EVERY if name in (c.name, c.column, c.sd_column)), None)
    if c is None:
        return
    low, high = c.range
    yield "is", f"{c.label} [{c.unit_shown}], as shown by its instrument{c.where and f': {c.where}'}"
    yield "column", f"{c.column}, its standard deviation {c.sd_column}, {low:g} to {high:g}"
    if c.other_units:
        yield "other units", ", ".join(c.other_units)
    yield "typical noise", f"{100 * c.sd_share:g} % of the reading, assumed without a stated noise"
    yield "shows in", " and ".join(["settled runs"] * c.settled + ["histories"] * c.over_time)
    sensor_effects = [e for e in library.values() if e.channel == c.name and e.name not in effects.UNNAMED]
    if sensor_effects:
        yield "its errors", ", ".join(e.name for e in sensor_effects)
        for k, test in enumerate(experiment_words.effect_tests(sensor_effects[0])):
            yield "" if k else "on a bench", test


def _operating_condition_lines(name: str, library: Library) -> Iterator[Line]:
    if label := next((label for label in quantities.LABELS if label.name == name), None):
        yield "is", label.label
        yield "column", label.column
    c = next((c for c in quantities.SET if name in (c.name, c.field, c.column)), None)
    if c is None:
        return
    low, high = c.range
    yield "is", f"{c.label} [{c.unit_shown or '-'}], {low:g} to {high:g}"
    yield "column", c.column
    if c.other_units:
        yield "other units", ", ".join(c.other_units)
    if c.field:
        yield "from Python", f"mm.Conditions({c.field}=...)"


def _output_lines(name: str, library: Library) -> Iterator[Line]:
    for o in (o for o in EVERY_OUTPUT if name in (o.name, o.column)):
        yield "is", f"{o.label} [{o.unit_shown}]"
        # The description is in the docstring of the class.
        text = " ".join((inspect.getdoc(Result) or "").partition("Attributes:")[2].split())
        match = re.search(
            rf"(?:^|[.\]] |, |; )(?:\w+, )*{o.name}(?:, \w+)*: (.*?)(?=\.? [a-z_]+(?:, [a-z_]+)*: |$)", text
        )
        if match is not None and o in outputs.FURTHER:
            yield "equation", match[1].rstrip(".")
        source_words = (
            "missions (--profile)" if o in (*mission_batch.OUTPUTS, *mission_batch.OF_TURNS) else "every run"
        )
        yield "column", f"{o.column}, of {'--outputs' if o in derived.TABLE else source_words}"


def _parameter_lines(name: str, library: Library) -> Iterator[Line]:
    robot = paper_robots.nominal()
    parameter = next((p for p in params.walk_parameters(robot) if p.name == name), None)
    if parameter is None:
        return
    spec = parameter.spec
    yield "means", f"{spec.meaning} [{spec.unit}]"
    yield "nominal", f"{float(parameter.value):g} {spec.unit}. Source: {spec.source}"
    sd = parameter.spec.prior_sd(float(parameter.value))
    relative = f" ({100 * parameter.spec.relative_sd:g} %)" if parameter.spec.relative_sd else ""
    yield "prior", f"standard deviation {sd:.3g} {parameter.spec.unit}{relative}"
    yield "bounds", _bounds_text(spec)
    first_part = name.partition(".")[0]
    part: Any = dict(robot.configurations.items()).get(first_part, robot)
    for step in name.split(".")[:-1]:
        part = getattr(part, step, part)
    equation = " ".join((inspect.getdoc(type(part)) or "").partition("\n\nAttributes:")[0].split())
    if part is not robot and equation:
        yield "equation", equation
    rests = [e.name for e in library.values() if name in e.rests_on]
    if rests:
        yield "scales", ", ".join(rests)
    yield (
        "change it",
        f"--set {name}=VALUE, or [{name.rpartition('.')[0]}] {name.rpartition('.')[2]} = VALUE in a file",
    )


def _bounds_text(spec: Spec) -> str:
    low, high = spec.bounds
    return f"{low:g} to {high:g} {spec.unit}"


#: Function that explains a name, by kind.
EXPLAINED: dict[str, Explain] = {
    "effect": _effect_lines,
    "status": _status_lines,
    "verdict of the loop": _explain_by_table(words.LOOP_VERDICTS, "verdict of result.json of mmrjax loop"),
    "verdict of a climb": _explain_by_table(
        {name: meaning for name, (_, meaning) in VERDICTS.items()}, "verdict of result.json of mmrjax climb"
    ),
    "flag": _explain_by_table(words.FLAGS, "column flags of runs.csv, counts in result.json"),
    "channel": _channel_lines,
    "output": _output_lines,
    "parameter": _parameter_lines,
    "key of a robot file": _explain_by_table(KEYS),
    "condition": _operating_condition_lines,
    "word of the reports": _explain_by_table(
        {k: v for k, v in words.GLOSSARY.items() if k not in words.LOOP_VERDICTS}
    ),
}
