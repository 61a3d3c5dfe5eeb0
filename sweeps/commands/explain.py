"""The command `explain`: meaning of a name, taken from the code that defines it."""

from __future__ import annotations

import functools
import inspect
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping
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
from mmrjax.model.channels import Channel
from mmrjax.model.params import Parameter, Spec
from mmrjax.model.quantities import Condition
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Result
from sweeps.console import print_output
from sweeps.pages import words
from sweeps.report.climb_report import VERDICTS

#: Effects by name.
Library = dict[str, type[Effect]]
#: Lines of an explanation, each with heading and text.
Lines = Iterable[tuple[str, str]]
WIDTH, INDENT = 80, 16
#: Outputs of missions, of runs, and further ones.
OF_MISSIONS = (*mission_batch.OUTPUTS, *mission_batch.OF_TURNS)
OUTPUTS: tuple[Any, ...] = (*outputs.FURTHER, *derived.TABLE, *OF_MISSIONS)


def explain_name(name: str | None, files: Names) -> int:
    """Explains an effect, status, flag, output, channel or parameter by its name. Without a name, lists all.

    Raises:
        BadConfiguration: the name is unknown. The message lists the nearest ones.
    """
    kinds = explanations({**effect_file.effect_library(files), **effects.BESIDE})
    if name is None:
        for kind, by_name in kinds.items():
            print_output(_wrapped(kind, ", ".join(by_name)))
        print_output("mmrjax explain NAME explains one.")
        return 0
    names = [n for by_name in kinds.values() for n in by_name]
    quantities_shown = (*OUTPUTS, *channels.EVERY, *quantities.SET, *quantities.LABELS)
    columns = {
        getattr(q, field, None): q.name for q in quantities_shown for field in ("column", "sd_column", "field")
    }
    key = name if name in names else columns.get(name, name)
    for kind, by_name in kinds.items():
        if key in by_name:
            print_output(f"{name}: {kind}")
            for heading, text in by_name[key]():
                print_output(_wrapped(heading, text))
    if key not in names:
        if longer_names := [p for p in kinds["parameter"] if p.endswith(f".{name}")]:
            raise BadConfiguration(f"explain: got {name}; did you mean one of these? {', '.join(longer_names)}")
        similar_names = similar_words(name, names, 3)
        hint = f"did you mean {', '.join(similar_names)}? " if similar_names else ""
        raise BadConfiguration(f"explain: got {name}; {hint}mmrjax explain lists all names")
    return 0


def explanations(library: Library) -> dict[str, dict[str, Callable[[], Lines]]]:
    """Functions that return the lines on each name, by kind and name."""
    robot = paper_robots.nominal()
    verdict_place = "verdict of result.json of mmrjax {}"
    loop_verdicts = words.LOOP_VERDICTS
    climb_verdicts = {name: meaning for name, (_, meaning) in VERDICTS.items()}
    file_keys = {name: meaning for name, (_, _, meaning) in robot_file.SETTINGS.items()}
    glossary = {name: meaning for name, meaning in words.GLOSSARY.items() if name not in loop_verdicts}
    lines_of = functools.partial
    return {
        "effect": {
            name: lines_of(_effect_lines, effect) for name, effect in library.items() if name not in effects.UNNAMED
        },
        "status": {name: lines_of(_status_lines, name) for name in words.STATUSES},
        "verdict of the loop": _from_table(loop_verdicts, verdict_place.format("loop")),
        "verdict of a climb": _from_table(climb_verdicts, verdict_place.format("climb")),
        "flag": _from_table(words.FLAGS, "column flags of runs.csv, counts in result.json"),
        "channel": {channel.name: lines_of(_channel_lines, channel, library) for channel in channels.EVERY},
        "output": {output.name: lines_of(_output_lines, output.name) for output in OUTPUTS},
        "parameter": {
            parameter.name: lines_of(_parameter_lines, parameter, robot, library)
            for parameter in params.walk_parameters(robot)
        },
        "key of a robot file": _from_table(file_keys),
        "condition": {c.name: lines_of(_condition_lines, c) for c in (*quantities.LABELS, *quantities.SET)},
        "word of the reports": _from_table(glossary),
    }


def _from_table(meanings: Mapping[str, str], where: str = "") -> dict[str, Callable[[], Lines]]:
    """Explanations of the names in a table of meanings. `where`: files in which they occur."""
    place_lines = [("in files", where)] * bool(where)
    return {name: functools.partial(list, [("means", text), *place_lines]) for name, text in meanings.items()}


def _wrapped(heading: str, text: str) -> str:
    head = f"  {heading} ".ljust(INDENT)  # the full name of a parameter may be longer
    return textwrap.fill(
        text, WIDTH, initial_indent=head, subsequent_indent=" " * INDENT, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip


def _effect_lines(effect: type[Effect]) -> Lines:
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
    settled_text = f". Settled runs cannot distinguish it from {effect.settles_to}" if effect.settles_to else ""
    yield "in data", f"{effect.family()}{'. Only time histories show it' if effect.transient else settled_text}"
    for line in _change_sentences(example):
        yield "", line
    for k, test in enumerate(experiment_words.effect_tests(effect)):
        yield "" if k else "on a bench", test
    if source:
        yield "source", source
    yield "in a file", f"[effects.{effect.name}] amplitude = ..."


def _change_sentences(effect: Effect) -> Iterable[str]:
    """Sentences on the change of settled travel by a typical size of an effect, in percent of the readings.

    Empty if settled travel does not show the effect or the runs have no operating point.
    """
    if effect.transient or effect.needs_reverse:
        return
    import dataclasses

    import mmrjax as mm

    robot = paper_robots.nominal()
    spec = next(p.spec for p in params.walk_parameters(effect) if p.spec.amplitude)
    with_effect = dataclasses.replace(robot, effects=(effect,))
    conditions = mm.Conditions(
        list(robot.configurations), voltage=24.0, slope_deg=5.0, payload=3.0, battery=float(effect.needs_battery)
    )
    typical_size = params.replace(with_effect, {f"effects.{effect.name}.amplitude": np.asarray(spec.prior_sd(0.0))})
    without, with_it = (mm.simulate(r, conditions) for r in (with_effect, typical_size))
    for k, name in enumerate(robot.configurations):
        shares = {}
        for c in robot.channels:
            reading_without, reading_with = float(without.reading[c.name][k]), float(with_it.reading[c.name][k])
            if np.isfinite(reading_with) and reading_without:
                shares[c.label] = 100 * (reading_with / reading_without - 1)
        if any(abs(percent) > 5e-3 for percent in shares.values()):
            changes = ", ".join(f"{label} {percent:+.2g} %" for label, percent in shares.items())
            yield f"change at its typical size ({name}, 24 V, 5°, 3 kg): {changes}"


def _status_lines(name: str) -> Lines:
    yield "means", words.status_meaning(name)
    yield "exit code", "3, since a solver failed" if name == "failed" else "0"
    yield "in files", "column status of runs.csv, counts in result.json"


def _channel_lines(channel: Channel, library: Library) -> Lines:
    low, high = channel.range
    yield (
        "is",
        f"{channel.label} [{channel.unit_shown}], as shown by its instrument{channel.where and f': {channel.where}'}",
    )
    yield "column", f"{channel.column}, its standard deviation {channel.sd_column}, {low:g} to {high:g}"
    if channel.other_units:
        yield "other units", ", ".join(channel.other_units)
    yield "typical noise", f"{100 * channel.sd_share:g} % of the reading, assumed without a stated noise"
    yield "shows in", " and ".join(["settled runs"] * channel.settled + ["histories"] * channel.over_time)
    sensor_effects = [e for e in library.values() if e.channel == channel.name and e.name not in effects.UNNAMED]
    if sensor_effects:
        yield "its errors", ", ".join(e.name for e in sensor_effects)
        for k, test in enumerate(experiment_words.effect_tests(sensor_effects[0])):
            yield "" if k else "on a bench", test


def _condition_lines(condition: Any) -> Lines:
    if isinstance(condition, Condition):
        yield (
            "is",
            f"{condition.label} [{condition.unit_shown or '-'}], {condition.range[0]:g} to {condition.range[1]:g}",
        )
        if condition.other_units:
            yield "other units", ", ".join(condition.other_units)
        if condition.field:
            yield "from Python", f"mm.Conditions({condition.field}=...)"
    else:
        yield "is", condition.label
    yield "column", condition.column


def _output_lines(name: str) -> Lines:
    # The description is in the docstring of the class.
    text = " ".join((inspect.getdoc(Result) or "").partition("Attributes:")[2].split())
    match = re.search(rf"(?:^|[.\]] |, |; )(?:\w+, )*{name}(?:, \w+)*: (.*?)(?=\.? [a-z_]+(?:, [a-z_]+)*: |$)", text)
    for o in (o for o in OUTPUTS if o.name == name):
        yield "is", f"{o.label} [{o.unit_shown}]"
        if match is not None and o in outputs.FURTHER:
            yield "equation", match[1].rstrip(".")
        source = "missions (--profile)" if o in OF_MISSIONS else "every run"
        yield "column", f"{o.column}, of {'--outputs' if o in derived.TABLE else source}"


def _parameter_lines(parameter: Parameter, robot: Robot, library: Library) -> Lines:
    name = parameter.name
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
    scaled_effects = [e.name for e in library.values() if name in e.rests_on]
    if scaled_effects:
        yield "scales", ", ".join(scaled_effects)
    yield (
        "change it",
        f"--set {name}=VALUE, or [{name.rpartition('.')[0]}] {name.rpartition('.')[2]} = VALUE in a file",
    )


def _bounds_text(spec: Spec) -> str:
    low, high = spec.bounds
    return f"{low:g} to {high:g} {spec.unit}"
