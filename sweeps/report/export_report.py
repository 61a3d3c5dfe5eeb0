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


def export_document(export: Export) -> Document:
    """Report of an exported drive."""
    comparison = export.comparison
    fates = [
        (fate.name, Cell(fate.verdict, TONES[fate.verdict]), 100 * fate.kept, fate.how) for fate in comparison.fates
    ]
    rim_note = catalogue.note("export.rim", errors_title(export).capitalize())
    fate_blocks = catalogue.table("export.fates", fates), catalogue.note("export.kept")
    sections = [
        Section("What the format represents", fate_blocks, "holds"),
        Section("Errors", (_errors(export), rim_note), "errors"),
    ]
    if comparison.refitted:
        table = catalogue.table("export.fitted", _fitted(export))
        sections.append(Section("Parameters of the format", (table, catalogue.note("export.fitted"))))
    if export.checks:
        sections.append(Section("Checks of the files", (catalogue.table("export.checks", [*export.checks.items()]),)))
    rows = [(f"`{c.name}`", c.value, c.unit, c.interval or None, c.meaning, c.source) for c in export.constants]
    conditions = Note(tuple(conditions_seen(export)), name="seen"), Note(tuple(not_tested(export)), name="untested")
    return Document(
        f"{export.joint.file.name} for {export.format}",
        export_statement(export),
        (Note(_usage(export), "lead"), *remarks(export_remarks(export))),
        (
            *sections,
            Section("Constants", (catalogue.table("export.constants", rows),)),
            Section("Conditions in the data, and what was not tested", conditions),
        ),
    )


def _usage(export: Export) -> str:
    """Use of the format's files, as a paragraph."""
    return catalogue.text(f"export.use-{export.format}", export.joint.name, rotor_inertia(export))


def _fitted(export: Export) -> list[tuple[str, float, float]]:
    """Parameters of the format: name, translated and refitted value."""
    return [(n, export.comparison.translated[n], v) for n, v in export.comparison.refitted.items()]


def _errors(export: Export) -> Table:
    errors = export.comparison.errors
    names = list(next(iter(errors.values())))
    heads = (f"{channels.find_channel(n).label} [%] | .3g" for n in names)
    rows = [(label, *map(percent.get, names)) for label, percent in errors.items()]
    return catalogue.table("export.error-table", rows, *heads, title=errors_title(export))


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


def export_statement(export: Export) -> str:
    """One sentence: the exported drive, and its error compared with the native model."""
    comparison = export.comparison
    export_errors, native_errors = comparison.errors[EXPORTED], comparison.errors[NATIVE]
    errors_text = ", ".join(
        f"{channels.find_channel(name).label} {three_digits(export_errors[name])} %"
        + (f" (native {three_digits(native_errors[name])} %)" if comparison.situation.is_measured else "")
        for name in export_errors
    )
    joint = export.joint
    return (
        f"The drive of {joint.file.name}, {joint.configuration}, as {FORMATS[export.format]}: its error against "
        f"{comparison.reference} over {count_noun(len(comparison.situation.command), 'run')} is "
        f"{errors_text or 'unknown: these runs have neither current nor speed'}."
    )


def errors_title(export: Export) -> str:
    """Title of the table of errors."""
    comparison = export.comparison
    return f"error against {comparison.reference}, rms over rms"


def export_remarks(export: Export) -> list[str]:
    """Remarks on the reference of the errors, and on what is not exported."""
    comparison, joint = export.comparison, export.joint
    sentences = ["the reference is the native model. Give measured runs with --data"]
    if comparison.situation.is_measured:
        sentences = [
            "the refit used no measurements. Errors are hold-out errors unless the robot was fitted to these runs"
        ]
    if dropped := [fate.name for fate in comparison.fates if fate.verdict == DROPPED]:
        sentences.append(f"dropped: {', '.join(dropped)}")
    if joint.idle:
        sentences.append(f"{', '.join(joint.idle)}: not exported: no effect in {joint.configuration}")
    if export.posterior is None and joint.file.source.endswith(".toml"):
        sentences.append("no posterior.nc next to the robot's file: intervals come from the priors")
    return sentences


def conditions_seen(export: Export) -> list[str]:
    """Ranges of the compared runs, one line for each."""
    situation = export.comparison.situation
    lines = [
        f"{count_noun(len(situation.command), 'settled run')} of {situation.source}",
        f"voltage at the driver's output {_span(situation.command)} V",
        f"torque at the joint {_span(situation.load)} N·m",
        f"speed of the joint {_span(situation.inside.speed)} rad/s",
        f"current of one motor {_span(situation.inside.current)} A",
    ]
    if export.joint.robot.has_ground:
        lines.append(f"slope {_span(np.degrees(np.asarray(situation.signals.slope)))} deg")
        lines.append(f"normal load of one side {_span(np.asarray(situation.signals.normal))} N")
    return lines


def _span(values: np.ndarray) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.4g}" if np.isclose(low, high) else f"{low:.4g} to {high:.4g}"


def not_tested(export: Export) -> list[str]:
    """Limits of the comparison, one sentence for each."""
    situation = export.comparison.situation
    is_driven_by_load = bool(np.any(situation.load * situation.inside.speed < 0))
    return [*NOT_TESTED, *([] if is_driven_by_load else [BACKWARD])]


def rotor_inertia(export: Export) -> float:
    """Inertia of the rotor at the joint [kg·m²], or armature of an exported law."""
    robot = export.joint.robot
    if export.format == "onnx":
        law = module_from_source(jax_source(export.joint, export.constants))
        return float(law.armature(law.PARAMS))
    inertia = float(robot.motor.inertia) * float(robot.gearbox.ratio) ** 2 * float(robot.gearbox.efficiency_load)
    return inertia + sum(float(e.amplitude) for e in export.joint.inside if e.balance == "inertia")


def escape_markdown(text: str) -> str:
    """User's name escaped for Markdown, so that it ends no line, cell or code, and begins no HTML."""
    line = " ".join(printable(text).split())
    return line.replace("`", "'").replace("|", "\\|").replace("<", "&lt;")


def law_text(export: Export) -> str:
    """Text of LAW.md."""
    joint, comparison = export.joint, export.comparison
    verdicts = {HELD: "held by", APPROXIMATED: "approximated by", DROPPED: "dropped:"}
    shares = {fate.name: f"{100 * fate.kept:.0f} %" if np.isfinite(fate.kept) else "" for fate in comparison.fates}
    sections = {"supply": "winding", "electrical": "winding", "inductance": "winding", "motor": "motor",
                "gearbox": "gearbox", "track": "output", "inertia": "armature"}  # fmt: skip
    effects = [p for p in joint.parts if p.effect and p.balance in INSIDE]
    sections_with_effects = {sections[p.balance] for p in effects}
    return filled_template(
        "LAW.md",
        origin=escape_markdown(f"{joint.file.name}, {joint.configuration}"),
        version=__version__,
        format=FORMATS[export.format],
        use=_usage(export),
        format_name=export.format,
        joint=joint,
        ground=joint.robot.has_ground,
        sections=sections,
        effects=effects,
        less=lambda place: f" - {place} effects" if place in sections_with_effects else "",
        controller=joint.controller,
        imposed=joint.robot.rig.imposed,
        goal=None if joint.controller is None else GOALS[joint.robot.rig.imposed],
        ratio=float(joint.robot.gearbox.ratio),
        mesh_frequency=MESH_FREQUENCY,
        mesh_damping=MESH_DAMPING,
        constants=[(c, escape_markdown(c.name), escape_markdown(c.source)) for c in export.constants],
        cited=any(re.search(r"\beqs?\.|\bTables? [A\d]", f"{c.meaning} {c.source}") for c in export.constants),
        refitted=_fitted(export),
        fates=[(fate.name, verdicts[fate.verdict], fate.how, shares[fate.name]) for fate in comparison.fates],
        errors_title=errors_title(export).capitalize(),
        channels=[f"{channels.find_channel(n).label} [%]" for n in comparison.errors[NATIVE]],
        errors=[(label, [f"{x:.3g}" for x in percent.values()]) for label, percent in comparison.errors.items()],
        seen=[escape_markdown(line) for line in conditions_seen(export)],
        untested=not_tested(export),
    )
