"""Report of `export`: comparison with the native model, what the format omits, and the file LAW.md."""

from __future__ import annotations

import re

import numpy as np

from calibration.data.input_errors import three_digits
from mmrjax import __version__
from mmrjax.errors import count_noun, printable
from mmrjax.model import channels
from mmrjax.model.shaft import MESH_DAMPING, MESH_FREQUENCY
from sweeps.export.comparison import APPROXIMATED, DROPPED, EXPORTED, HELD, NATIVE
from sweeps.export.formats import FORMATS, Export
from sweeps.export.joint import INSIDE
from sweeps.export.law_source import filled_template, jax_source, module_from_source
from sweeps.report import catalogue
from sweeps.report.document import Cell, Document, Note, Section, Table, remarks

#: Tone of a verdict's cell.
TONES = {HELD: "good", APPROXIMATED: "fair", DROPPED: "bad"}


def export_document(found: Export) -> Document:
    """Report of an exported drive."""
    compared = found.comparison
    fates = [(f.name, Cell(f.verdict, TONES[f.verdict]), 100 * f.kept, f.how) for f in compared.fates]
    rim = catalogue.note("export.rim", errors_title(found).capitalize())
    kept = catalogue.table("export.fates", fates), catalogue.note("export.kept")
    sections = [
        Section("What the format represents", kept, "holds"),
        Section("Errors", (_errors(found), rim), "errors"),
    ]
    if compared.refitted:
        table = catalogue.table("export.fitted", _fitted(found))
        sections.append(Section("Parameters of the format", (table, catalogue.note("export.fitted"))))
    if found.checks:
        sections.append(Section("Checks of the files", (catalogue.table("export.checks", [*found.checks.items()]),)))
    rows = [(f"`{c.name}`", c.value, c.unit, c.interval or None, c.meaning, c.source) for c in found.constants]
    conditions = Note(tuple(conditions_seen(found)), name="seen"), Note(tuple(not_tested(found)), name="untested")
    return Document(
        f"{found.joint.file.name} for {found.format}",
        export_statement(found),
        (Note(_usage(found), "lead"), *remarks(export_remarks(found))),
        (
            *sections,
            Section("Constants", (catalogue.table("export.constants", rows),)),
            Section("Conditions in the data, and what was not tested", conditions),
        ),
    )


def _usage(found: Export) -> str:
    """Use of the format's files, as a paragraph."""
    return catalogue.text(f"export.use-{found.format}", found.joint.name, rotor_inertia(found))


def _fitted(found: Export) -> list[tuple[str, float, float]]:
    """Parameters of the format: name, translated and refitted value."""
    return [(n, found.comparison.translated[n], v) for n, v in found.comparison.refitted.items()]


def _errors(found: Export) -> Table:
    errors = found.comparison.errors
    names = list(next(iter(errors.values())))
    heads = (f"{channels.find_channel(n).label} [%] | .3g" for n in names)
    rows = [(label, *map(percent.get, names)) for label, percent in errors.items()]
    return catalogue.table("export.error-table", rows, *heads, title=errors_title(found))


#: Readings that a controller compares with its setpoint, their units, and the last term of its duty.
GOALS = {
    "goal_angle": ("angle", "rad", "- K_d ω"),
    "goal_speed": ("ω", "rad/s", "+ K_f goal"),
    "goal_current": ("I", "A", "+ K_f goal"),
}
NOT_TESTED = (
    "Voltages, loads and temperatures outside the runs above.",
    "Fast changes: only settled runs are compared.",
)
BACKWARD = "Runs in which the load drives the motor."


def export_statement(found: Export) -> str:
    """One sentence: the exported drive, and its error compared with the native model."""
    compared = found.comparison
    exported, native = compared.errors[EXPORTED], compared.errors[NATIVE]
    channels_shown = ", ".join(
        f"{channels.find_channel(n).label} {three_digits(exported[n])} %"
        + (f" (native {three_digits(native[n])} %)" if compared.situation.is_measured else "")
        for n in exported
    )
    drive = found.joint
    return (
        f"The drive of {drive.file.name}, {drive.configuration}, as {FORMATS[found.format]}: its error against "
        f"{compared.reference} over {count_noun(len(compared.situation.command), 'run')} is "
        f"{channels_shown or 'unknown: these runs have neither current nor speed'}."
    )


def errors_title(found: Export) -> str:
    """Title of the table of errors."""
    compared = found.comparison
    return f"error against {compared.reference}, rms over rms"


def export_remarks(found: Export) -> list[str]:
    """Remarks on the reference of the errors, and on what is not exported."""
    compared, drive = found.comparison, found.joint
    answer = ["the reference is the native model. Give measured runs with --data"]
    if compared.situation.is_measured:
        answer = [
            "the refit used no measurements. Errors are hold-out errors unless the robot was fitted to these runs"
        ]
    if dropped := [f.name for f in compared.fates if f.verdict == DROPPED]:
        answer.append(f"dropped: {', '.join(dropped)}")
    if drive.idle:
        answer.append(f"{', '.join(drive.idle)}: not exported: no effect in {drive.configuration}")
    if found.posterior is None and drive.file.source.endswith(".toml"):
        answer.append("no posterior.nc next to the robot's file: intervals come from the priors")
    return answer


def conditions_seen(found: Export) -> list[str]:
    """Ranges of the compared runs, one line for each."""
    runs = found.comparison.situation
    lines = [
        f"{count_noun(len(runs.command), 'settled run')} of {runs.source}",
        f"voltage at the driver's output {_span(runs.command)} V",
        f"torque at the joint {_span(runs.load)} N·m",
        f"speed of the joint {_span(runs.inside.speed)} rad/s",
        f"current of one motor {_span(runs.inside.current)} A",
    ]
    if found.joint.robot.has_ground:
        lines.append(f"slope {_span(np.degrees(np.asarray(runs.signals.slope)))} deg")
        lines.append(f"normal load of one side {_span(np.asarray(runs.signals.normal))} N")
    return lines


def _span(values: np.ndarray) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.4g}" if np.isclose(low, high) else f"{low:.4g} to {high:.4g}"


def not_tested(found: Export) -> list[str]:
    """Limits of the comparison, one sentence for each."""
    runs = found.comparison.situation
    backward = bool(np.any(runs.load * runs.inside.speed < 0))
    return [*NOT_TESTED, *([] if backward else [BACKWARD])]


def rotor_inertia(found: Export) -> float:
    """Inertia of the rotor at the joint [kg·m²], or armature of an exported law."""
    robot = found.joint.robot
    if found.format == "onnx":
        law = module_from_source(jax_source(found.joint, found.constants))
        return float(law.armature(law.PARAMS))
    value = float(robot.motor.inertia) * float(robot.gearbox.ratio) ** 2 * float(robot.gearbox.efficiency_load)
    return value + sum(float(e.amplitude) for e in found.joint.inside if e.balance == "inertia")


def escape_markdown(text: str) -> str:
    """User's name escaped for Markdown, so that it ends no line, cell or code, and begins no HTML."""
    words = " ".join(printable(text).split())
    return words.replace("`", "'").replace("|", "\\|").replace("<", "&lt;")


def law_text(found: Export) -> str:
    """Text of LAW.md."""
    drive, compared = found.joint, found.comparison
    verdicts = {HELD: "held by", APPROXIMATED: "approximated by", DROPPED: "dropped:"}
    shares = {f.name: f"{100 * f.kept:.0f} %" if np.isfinite(f.kept) else "" for f in compared.fates}
    sections = {"supply": "winding", "electrical": "winding", "inductance": "winding", "motor": "motor",
                "gearbox": "gearbox", "track": "output", "inertia": "armature"}  # fmt: skip
    effects = [p for p in drive.parts if p.effect and p.balance in INSIDE]
    places = {sections[p.balance] for p in effects}
    return filled_template(
        "LAW.md",
        origin=escape_markdown(f"{drive.file.name}, {drive.configuration}"),
        version=__version__,
        format=FORMATS[found.format],
        use=_usage(found),
        format_name=found.format,
        joint=drive,
        ground=drive.robot.has_ground,
        sections=sections,
        effects=effects,
        less=lambda place: f" - {place} effects" if place in places else "",
        controller=drive.controller,
        imposed=drive.robot.rig.imposed,
        goal=None if drive.controller is None else GOALS[drive.robot.rig.imposed],
        ratio=float(drive.robot.gearbox.ratio),
        mesh_frequency=MESH_FREQUENCY,
        mesh_damping=MESH_DAMPING,
        constants=[(c, escape_markdown(c.name), escape_markdown(c.source)) for c in found.constants],
        cited=any(re.search(r"\beqs?\.|\bTables? [A\d]", f"{c.meaning} {c.source}") for c in found.constants),
        refitted=_fitted(found),
        fates=[(f.name, verdicts[f.verdict], f.how, shares[f.name]) for f in compared.fates],
        errors_title=errors_title(found).capitalize(),
        channels=[f"{channels.find_channel(n).label} [%]" for n in compared.errors[NATIVE]],
        errors=[(label, [f"{x:.3g}" for x in percent.values()]) for label, percent in compared.errors.items()],
        seen=[escape_markdown(line) for line in conditions_seen(found)],
        untested=not_tested(found),
    )
