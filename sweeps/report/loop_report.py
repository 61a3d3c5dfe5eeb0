"""Report of the loop: the answer, the effects found and their certainty, errors, and what to do next."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Columns, Names
from calibration.data.columns import Layout
from calibration.described import as_paragraph, describe
from calibration.discovery.experiments import NONE
from calibration.discovery.result import DiscoveryResult
from calibration.discovery.settings import WITHOUT_NAME
from calibration.inference import blocks
from calibration.inference.details import TimeStatistics
from calibration.inference.fit_notes import Determination, remarks_with_codes
from calibration.words import loop_words
from mmrjax.effects import BY_NAME
from mmrjax.errors import count_noun
from mmrjax.model import params
from sweeps.pages import words
from sweeps.report import catalogue, fit_tables, run_tables
from sweeps.report.document import Block, Cell, Document, Figure, Note, Section, Table, remarks
from sweeps.report.fit_tables import Change

#: Smallest change of an rms error that is marked [%].
NOTABLE = 0.05
#: Distance of a fitted parameter from its stated value that the first screen states [prior sds].
MOVED = 2.0


def loop_document(found: DiscoveryResult, robot_name: str, changes: Mapping[str, Change]) -> Document:
    """Report of a loop.

    Args:
        robot_name: name or file of the initial robot.
        changes: changes of settled runs by each effect.
    """
    missing, table = found.verdict not in ("none", "undescribed"), rows_for_figures(found)
    shifts, added = list(moved_parameters(found)), list(_effect_findings(found, changes))
    rise = loop_words.rising_errors_sentence(found.held_out_worse, found.predicted)
    return Document(
        f"Is the {words.displayed_robot_name(Path(robot_name).name)} model complete?",
        found.statement,
        (
            *remarks(shifts, "moved"),
            *_first_figure(found, table, changes),
            _errors(found),
            *([Note(rise, name="worse", terminal=True)] if rise else []),
            _advice(found),
            *remarks(added, "found"),
            *run_tables.curve_warning(found.robot),
        ),
        tuple(_sections(found, table, changes, missing)),
        brief=loop_words.brief_answer(found, shifts, _next_step(found, "")),
    )


def _first_figure(found: DiscoveryResult, table: Columns, changes: Mapping[str, Change]) -> Iterable[Block]:
    """Figure of the law that was found, on its readings. For logs or without a law: measured and simulated values."""
    if isinstance(found.detail, TimeStatistics):
        lines = _simulated_lines(found)
        yield catalogue.figure("fit.overlay", table, found.channels, lines, finding=found.statement)
    elif changes:
        name, change = next(iter(changes.items()))
        effect = next(e for e in found.effects if e.name == name)
        law = ", or ".join(effect.families), name, loop_words.effect_amplitude(effect)
        yield catalogue.figure("loop.law", found, table, {name: change}, words=law)
    elif found.unnamed is not None:
        yield _curve(found)
    else:
        yield catalogue.figure("loop.before_after", table, found.channels, "none", words=("",))


def _simulated_lines(found: DiscoveryResult) -> dict[str, str]:
    """Prefixes of the simulated readings in figures over time, with their names. The proposal is first."""
    return {"after_": "simulated"} if found.refit_alone else {"after_": "with the effects found", "before_": "before"}


def rows_for_figures(found: DiscoveryResult) -> Columns:
    """Rows of the result for figures and page. For a rig, each surface is a separate configuration."""
    table = found.rows_table()
    if Layout.of(found.robot).crosses_zero:
        table["configuration"] = found.runs.configurations_named(found.robot)
    return table


def _rows_are(found: DiscoveryResult) -> str:
    return "samples" if isinstance(found.detail, TimeStatistics) else "runs"


def _effect_findings(found: DiscoveryResult, changes: Mapping[str, Change]) -> Iterable[str]:
    """Section on the effects of the model: meaning, size, certainty and alternatives."""
    for e in found.effects:
        size, other = loop_words.effect_amplitude(e), loop_words.indistinguishable_effects(found, e)
        if e.name in changes:
            size += f", which changes the {changes[e.name].channel.label} by {changes[e.name].rms:.2g} %"
        or_else = f" Or {other}." if other else ""
        kinds = ", or ".join(e.families)
        opening = _noise_alone(found)
        sure = f"{opening}{'it' if opening else 'It'} is {loop_words.standing_of_effect(found, e)}"
        yield f"**{kinds}** (`{e.name}`): {size}. {sure}.{or_else}"


def _noise_alone(found: DiscoveryResult) -> str:
    """Beginning of a claim that does not hold at every tried noise level, otherwise ""."""
    return "" if found.headline.level == found.verdict else "Only at 1 times the noise: "


def moved_parameters(found: DiscoveryResult) -> Iterable[str]:
    """Parameters of the written robot that moved by more than `MOVED` prior sds, largest shift first."""
    by_name = {
        name: (p.after, p.shift_after) if found.written else (p.before, p.shift_before)
        for name, p in found.base_shift.items()
    }
    for name, (value, shift) in sorted(by_name.items(), key=lambda item: -abs(item[1][1])):
        if abs(shift) >= MOVED:
            base_shift = found.base_shift[name]
            yield loop_words.moved_parameter(name, value, base_shift.prior, base_shift.unit, shift)


def _arrow_cell(text: str, change: float) -> Cell:
    """Cell with errors, and an arrow if they change."""
    if not abs(change) >= NOTABLE:
        return Cell(text)
    return Cell(f"{text} ↓", "good") if change < 0 else Cell(f"{text} ↑", "bad")


def _errors(found: DiscoveryResult) -> Table:
    """Errors as given, of the refit and with the effects found, on fitted and on held-out rows."""
    total, many = len(found.runs), not found.refit_alone

    def reached(errors: Mapping[str, Mapping[str, Any]]) -> str:
        return f"{max((int(e['rows']) for e in errors.values()), default=0)} of {total}"

    given = found.errors_as_stated
    rows: list[tuple[Any, ...]] = [
        ("robot file as given", *map(loop_words.percent_text, given.values()), reached(given))
    ]
    for kind, error_pair in {"": found.errors, **found.errors_held_out}.items():
        worse = {w.channel for w in found.held_out_worse if w.kind == kind}
        cells = []
        for c in error_pair[0]:
            texts = [loop_words.percent_text(e[c]) for e in error_pair[: 1 + many]]
            change = error_pair[1][c]["rms_percent"] - error_pair[0][c]["rms_percent"] if many else 0.0
            change_shown = np.inf if c in worse else change if not kind or change < 0 else 0.0
            cells.append(_arrow_cell(" → ".join(texts), change_shown))
        row_label = f"unseen: another {blocks.kind_in_words(kind)}" if kind else "seen by the fit"
        rows.append((row_label, *cells, reached(error_pair[0])))
    for kind in found.held_out_unpredictable:
        if kind not in found.errors_held_out:
            row_label = f"unseen: another {blocks.kind_in_words(kind)}"
            rows.append((row_label, *["-"] * len(found.channels), "not predictable from the others"))
    return catalogue.table("loop.errors", rows, *(f"{c.label} |" for c in found.channels))


def _next_step(found: DiscoveryResult, more: str) -> str:
    """What to do next. `more`: text after the name and description of an experiment."""
    after = found.next_experiment
    different = remarks_with_codes(found.remarks, "run_differs")
    if different and found.headline.level not in ("named", "class"):
        return as_paragraph(map(describe, different))
    if after is not None and after.name == NONE:
        return f"{after.description}."
    if after is not None:
        return f"**{after.name}**: {after.description}.{more}"
    level, texts = found.headline.level, {"none", "undescribed", "named", "open"}
    return catalogue.text(f"loop.next-{level if level in texts else 'other'}")


def _advice(found: DiscoveryResult) -> Table:
    after, more = found.next_experiment, ""
    if after is not None and after.separates:
        more = f" It distinguishes {', '.join(after.separates)}. Expected separation: {after.expected_sigma:.1f} σ."
    if after is not None and found.headline.level == "class" and not after.settles:
        more += " Some pairs remain undecided."
    far = [
        describe(note)
        for note in remarks_with_codes(found.remarks, "after_steps", "shifted", "far_from_prior", "repeats", "copied")
    ]
    against = [note for note in found.remarks if isinstance(note, str)]
    to_check = [loop_words.largest_share(found), *far, *against[:1]]
    rows = [
        ("May I use it for …", " ".join(loop_words.errors_of_written_robot(found)) or "No runs could be held out."),
        ("What to check first", as_paragraph(to_check) or "Nothing unusual."),
        ("What to do next", _next_step(found, more)),
    ]
    return catalogue.table("loop.advice", rows)


def _certainty_sections(found: DiscoveryResult, missing: bool) -> Iterable[Section]:
    """Sections on the certainty of the answer and its limits."""
    standing = loop_words.support_sentence(found)
    also = [] if found.unnamed is None else [loop_words.proposed_formula(found.unnamed)]
    noise = loop_words.at_other_noise(found.sensitivity) if found.sensitivity else ""
    noises = {name: (n["median_percent"], n["source"]) for name, n in found.noise.items()}
    notes = [*found.notes, noise, fit_tables.noise_sentence(noises, found.channels)]
    (before, after), unusable_count = found.chi2_of_readings, len(found.unusable)
    chi = f"{before:.0f} → {after:.0f}" if missing else f"{before:.0f}"
    verb = "are consistent with" if found.after.adequate else "exceed"
    aside = f" ({unusable_count} without a result of the fitted model, {len(found.outliers)} set aside as outliers)"
    blocks = [
        Note(f"{_noise_alone(found)}{found.verdict_statement}", name="statement", terminal=True),
        *([Note(loop_words.cluster_sentence(found.cluster), name="cluster")] if found.cluster else []),
        *([Note(standing, name="standing", terminal=True)] if standing else []),
        *remarks(also, "also"),
        Note(
            f"The residuals {verb} the noise (χ² of {found.readings} readings {chi} σ², {found.replicates} bootstrap "
            f"tables). {int(found.included.sum())} of {len(found.runs)} {_rows_are(found)} are used"
            f"{aside * bool(unusable_count or len(found.outliers))}.",
            name="adequacy",
            terminal=True,
        ),
    ]
    yield Section("How certain the verdict is", tuple(blocks))
    yield Section("Before you use it", remarks(filter(None, notes)))


def _sections(
    found: DiscoveryResult, table: Columns, changes: Mapping[str, Change], missing: bool
) -> Iterable[Section]:
    looked_for = Section("Effects that were tested", tuple(_looked_for(found)))
    yield Section("Measured and simulated, run by run", tuple(_run_by_run(found, table, changes)))
    yield from [] if missing else [looked_for]
    heading = "Where the missing term acts" if missing else "What each equation lacks"
    yield Section(heading, tuple(_blocks_of_missing_terms(found, table, changes)))
    yield from fit_tables.clusters_section(found.residual_clusters)
    fits = {
        when: rms_by_channel
        for when, rms_by_channel in found.rms.items()
        if not (found.refit_alone and "after" in when)
    }
    sized = Layout.of(found.robot).crosses_zero
    in_units = [fit_tables.rms_table(fits, found.channels)] if sized else []
    yield Section("Errors", (catalogue.note("loop.fitted_again"), *in_units))
    yield from _certainty_sections(found, missing)
    candidates = tuple(_candidates(found))
    yield from [Section("Candidates", candidates)] if candidates else []
    yield from [looked_for] if missing else []
    rows = [
        (
            f"`{name}`", p.prior, p.before, p.after, p.sd_after, p.unit, fit_tables.shift_cell(p.shift_before),
            fit_tables.shift_cell(p.shift_after),
            describe(Determination.from_pairs(name, p.held_by_prior, found.together)),
            p.at_bound or "", p.meaning,
        )
        for name, p in found.base_shift.items()
    ]  # fmt: skip
    yield Section("Parameters before and after", (catalogue.table("loop.base", rows),))
    first = {"row": table["row"]}
    if isinstance(found.detail, TimeStatistics):
        first |= {"run": table.get("run_id", table["row"]), "t [s]": table["time_s"]}
    kinds = {"": "measured", "before_": "before", "after_": "after"}
    yield fit_tables.rows_section(table, found.channels, kinds, False, first=first, last={"use": table["use"]})
    yield Section("Words", (catalogue.table("loop.words", list(words.GLOSSARY.items())),))


def _run_by_run(found: DiscoveryResult, table: Columns, changes: Mapping[str, Change]) -> Iterable[Block]:
    verdict, detail = "none" if found.refit_alone else found.verdict, found.detail
    if isinstance(detail, TimeStatistics):
        lines = _simulated_lines(found)
        yield fit_tables.fits_of_runs(table, found.channels, lines)
        runs = dataclasses.replace(found.runs, columns={**found.runs.columns, **table})
        yield from fit_tables.frequency_response(runs, found.channels, lines)
    elif changes or found.unnamed is not None:  # otherwise it is the first figure
        yield catalogue.figure("loop.before_after", table, found.channels, verdict, words=("",))


def _blocks_of_missing_terms(
    found: DiscoveryResult, table: Columns, changes: Mapping[str, Change]
) -> Iterable[Block]:
    verdict, sized = "none" if found.refit_alone else found.verdict, Layout.of(found.robot).crosses_zero
    if len(changes) > 1:
        yield catalogue.figure("loop.laws", found, table, changes)
    if isinstance(detail := found.detail, TimeStatistics):
        memory = detail.before.memory
        numbers = memory.deviate, detail.after.memory.deviate, memory.threshold, (2 * detail.runs) ** 0.5
        names = ", ".join(detail.orders_unresolved)
        more = catalogue.text("loop.unresolved", names) if names else ""
        yield catalogue.figure("loop.series", detail, found.channels, verdict, words=numbers, more=more)
    else:
        if run_tables.lost_by_load(found.robot) and found.robot.rig.imposed == "voltage":
            yield catalogue.figure("run.measured_drive_plane", found.robot, found.runs)
        closed = _closed(found, table) if sized else catalogue.text("loop.three")
        yield catalogue.figure("loop.defects", table, verdict, sized, words=(closed,))
    if found.unnamed is not None and (changes or isinstance(detail, TimeStatistics)):  # otherwise the first figure
        yield _curve(found)


def _curve(found: DiscoveryResult) -> Figure:
    """Figure of the smooth curve for an unnamed discrepancy."""
    assert found.unnamed is not None
    if isinstance(found.detail, TimeStatistics):
        key = "log"
    else:
        key = "tentative" if found.effects else "written" if found.written else "left"
    return catalogue.figure(
        "loop.curve", found.unnamed, words=(catalogue.text(f"loop.curve-{key}", found.unnamed.effect),)
    )


def _closed(found: DiscoveryResult, table: Columns) -> str:
    """Note on the equations whose errors the channels determine."""
    from sweeps.pages import loop_figures

    sides = max(1, len(loop_figures.defects_by_side(table, "before", "track")))
    closed, of_sides = loop_figures.closed_equations(table), " of each side" if sides > 1 else ""
    if len(found.channels) < len(closed) * sides:
        return catalogue.text("loop.fewer", " of both sides" if sides > 1 else "")
    names = ", ".join(n.replace("electrical", "voltage").replace("track", "torque") for n in closed)
    return catalogue.text("loop.closes", count_noun(len(closed), "equation"), of_sides, names)


def _candidates(found: DiscoveryResult) -> Iterable[Block]:
    """Section with alternatives that explain the data."""
    several = [(_named(a.effects), a.rise_chi2) for a in found.alternatives]
    curves = "; none of them is adequate, or curves explain the data better"
    sizes = [(_named(a.effects), _named(a.sizes), a.rise_chi2, a.why) for a in found.implausible]
    hidden = [
        (
            h.name, f"{h.amplitude:.3g} {h.unit}".removesuffix(" -"), h.sigmas,
            f"{h.experiment} (expected {h.separation:.1f} σ)" if h.experiment else "",
        )
        for h in found.hidden
    ]  # fmt: skip
    tables: dict[str, tuple[Sequence[Any], Names]] = {
        "alternatives": (several, (curves if found.verdict in WITHOUT_NAME else "",)),
        "hidden": (hidden, ()),
        "implausible": (sizes, ()),
    }
    if any(rows for rows, _ in tables.values()):
        yield catalogue.note("loop.definitions")
    for name, (rows, values) in tables.items():
        if rows:
            yield catalogue.note(f"loop.{name}-above", *values)
            yield catalogue.table(f"loop.{name}", rows)


def _named(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items())


def _looked_for(found: DiscoveryResult) -> Iterable[Block]:
    yield catalogue.note("loop.seen-above")
    level, rows = found.before.kinds["single"].threshold, []
    for s in found.scores:
        if s.name in BY_NAME and s.sigmas_per_prior_sd > 0:
            spec = next(p.spec for p in params.walk_parameters(BY_NAME[s.name]()) if p.spec.amplitude)
            times = level / s.sigmas_per_prior_sd
            size = f"{times * spec.prior_sd(0.0):.2g} {spec.unit}"
            rows.append((f"`{s.name}`", BY_NAME[s.name].family(), size, times))
    yield catalogue.table("loop.would_be_seen", sorted(rows, key=lambda row: row[-1]))
    unseen = {
        "cannot_see": found.cannot_see, "needs_series": found.needs_histories, "needs_reverse": found.needs_reverse
    }  # fmt: skip
    texts = (catalogue.text(f"loop.{key}", ", ".join(names)) for key, names in unseen.items() if names)
    yield Note("".join(texts), name="unseen")
