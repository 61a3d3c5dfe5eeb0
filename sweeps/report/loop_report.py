"""Report of the loop: the answer, the effects found and their certainty, errors, and what to do next."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from calibration.data import Columns
from calibration.data.columns import Layout
from calibration.described import as_paragraph, describe
from calibration.discovery.experiments import NONE
from calibration.discovery.result import DiscoveryResult
from calibration.discovery.settings import WITHOUT_NAME
from calibration.inference import blocks
from calibration.inference.details import TimeStatistics
from calibration.inference.fit_notes import determination, remarks_with_codes
from calibration.words import loop_words
from mmrjax.effects import BY_NAME
from mmrjax.errors import count_noun
from mmrjax.model import params
from sweeps.pages import words
from sweeps.report import catalogue, drive_curves, fit_tables, run_tables
from sweeps.report.document import Block, Cell, Document, Note, Section, Table, remarks

#: Smallest change of an rms error that is marked [%].
NOTABLE = 0.05
#: Distance of a fitted parameter from its stated value that the first screen states [prior sds].
MOVED = 2.0
#: First figure of the page, blocks that show every run, and blocks that show the missing term.
_Figures = tuple[Block, Sequence[Block], Sequence[Block]]


def loop_document(found: DiscoveryResult, robot_name: str, changes: Mapping[str, fit_tables.Change]) -> Document:
    """Report of a loop.

    Args:
        robot_name: name or file of the initial robot.
        changes: changes of settled runs by each effect.
    """
    table, shifts = rows_for_figures(found), list(moved_parameters(found))
    log = found.detail if isinstance(found.detail, TimeStatistics) else None
    figures = _run_figures(found, table, changes) if log is None else _log_figures(found, log, table)
    first, run_by_run, missing_term = figures
    rise = loop_words.rising_errors_sentence(found.held_out_worse, found.predicted)
    return Document(
        f"Is the {words.displayed_robot_name(Path(robot_name).name)} model complete?",
        found.statement,
        (
            *remarks(shifts, "moved"),
            first,
            _errors(found),
            *[Note(rise, name="worse", terminal=True)] * bool(rise),
            _advice(found),
            *remarks(_effect_findings(found, changes), "found"),
            *run_tables.curve_warning(found.robot),
        ),
        tuple(_sections(found, table, run_by_run, missing_term)),
        brief=loop_words.brief_answer(found, shifts, _next_step(found, "")),
    )


def _log_figures(found: DiscoveryResult, detail: TimeStatistics, table: Columns) -> _Figures:
    """Measured and simulated over time, the fits of every run, and the statistics that need histories."""
    lines = {"after_": "simulated"}
    if not found.refit_alone:
        lines = {"after_": "with the effects found", "before_": "before"}
    first = catalogue.figure("fit.overlay", table, found.channels, lines, finding=found.statement)
    runs = dataclasses.replace(found.runs, columns={**found.runs.columns, **table})
    run_by_run = fit_tables.fits_of_runs(table, found.channels, lines)
    before, after, unresolved = detail.before, detail.after, ", ".join(detail.orders_unresolved)
    numbers = before.deviate, after.deviate, before.threshold, (2 * detail.runs) ** 0.5
    more = catalogue.text("loop.unresolved", unresolved) if unresolved else ""
    verdict = "none" if found.refit_alone else found.verdict
    statistics = catalogue.figure("loop.series", detail, found.channels, verdict, words=numbers, more=more)
    responses = fit_tables.frequency_response(runs, found.channels, lines)
    return first, [run_by_run, *responses], [statistics, *_curve(found)]


def _run_figures(found: DiscoveryResult, table: Columns, changes: Mapping[str, fit_tables.Change]) -> _Figures:
    """The law that was found on its readings, or else the curve or the residuals. Then the residuals of every run,
    and the errors of the equations.
    """
    laws: list[Block] = []
    for name, change in changes.items():
        effect = next(e for e in found.effects if e.name == name)
        law = ", or ".join(effect.families), name, loop_words.effect_amplitude(effect)
        laws.append(catalogue.figure("loop.law", found, table, name, change, words=law, suffix=name if laws else ""))
    verdict, sized = "none" if found.refit_alone else found.verdict, Layout.of(found.robot).crosses_zero
    residuals, curve = catalogue.figure("loop.before_after", table, found.channels, verdict), _curve(found)
    closed = _closed(found, table) if sized else catalogue.text("loop.three")
    defects = [catalogue.figure("loop.defects", table, verdict, sized, words=(closed,))]
    if drive_curves.lost_by_load(found.robot) and found.robot.rig.imposed == "voltage":
        plane = lambda: drive_curves.drive_plane(found.robot, found.runs)  # noqa: E731
        defects.insert(0, catalogue.figure("run.drive_plane", values=plane))
    if laws:
        return laws[0], [residuals], [*laws[1:], *defects, *curve]
    return (curve[0], [residuals], defects) if curve else (residuals, [], defects)


def _curve(found: DiscoveryResult) -> list[Block]:
    """Figure of the smooth curve for an unnamed discrepancy."""
    if found.unnamed is None:
        return []
    key = "tentative" if found.effects else "written" if found.written else "left"
    key = "log" if isinstance(found.detail, TimeStatistics) else key
    more = catalogue.text(f"loop.curve-{key}", found.unnamed.effect)
    return [catalogue.figure("loop.curve", found.unnamed, words=(more,))]


def rows_for_figures(found: DiscoveryResult) -> Columns:
    """Rows of the result for figures and page. For a rig, each surface is a separate configuration."""
    table = found.rows_table()
    if Layout.of(found.robot).crosses_zero:
        table["configuration"] = found.runs.configurations_named(found.robot)
    return table


def _effect_findings(found: DiscoveryResult, changes: Mapping[str, fit_tables.Change]) -> Iterable[str]:
    """Sentences on the effects found: meaning, size, certainty and alternatives."""
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


def _errors(found: DiscoveryResult) -> Table:
    """Errors as given, of the refit and with the effects found, on fitted and on held-out rows."""

    def reached(errors: Mapping[str, Mapping[str, Any]]) -> str:
        return f"{max((int(e['rows']) for e in errors.values()), default=0)} of {len(found.runs)}"

    given = found.errors_as_stated
    rows: list[tuple[Any, ...]] = [
        ("robot file as given", *map(loop_words.percent_text, given.values()), reached(given))
    ]
    for kind, pair in {"": found.errors, **found.errors_held_out}.items():
        worse = {w.channel for w in found.held_out_worse if w.kind == kind}
        refit, proposal = pair[0], pair[0 if found.refit_alone else 1]
        cells = []
        for c in refit:
            text = " → ".join(loop_words.percent_text(e[c]) for e in pair[: 1 if found.refit_alone else 2])
            change = proposal[c]["rms_percent"] - refit[c]["rms_percent"]
            rises = c in worse or (change >= NOTABLE and not kind)
            falls = change <= -NOTABLE and not rises
            mark, tone = (" ↑", "bad") if rises else (" ↓", "good") if falls else ("", "")
            cells.append(Cell(text + mark, tone))
        rows.append((_unseen(kind) if kind else "seen by the fit", *cells, reached(refit)))
    rows += [
        (_unseen(kind), *["-"] * len(found.channels), "not predictable from the others")
        for kind in found.held_out_unpredictable
        if kind not in found.errors_held_out
    ]
    return catalogue.table("loop.errors", rows, *(f"{c.label} |" for c in found.channels))


def _unseen(kind: str) -> str:
    return f"unseen: another {blocks.kind_in_words(kind)}"


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
    unusual = remarks_with_codes(found.remarks, "after_steps", "shifted", "far_from_prior", "repeats", "copied")
    against = [note for note in found.remarks if isinstance(note, str)][:1]
    to_check = [loop_words.largest_share(found), *map(describe, unusual), *against]
    rows = [
        ("May I use it for …", " ".join(loop_words.errors_of_written_robot(found)) or "No runs could be held out."),
        ("What to check first", as_paragraph(to_check) or "Nothing unusual."),
        ("What to do next", _next_step(found, more)),
    ]
    return catalogue.table("loop.advice", rows)


def _certainty_sections(found: DiscoveryResult) -> Iterable[Section]:
    """Sections on the certainty of the answer and its limits."""
    noises = {name: (n["median_percent"], n["source"]) for name, n in found.noise.items()}
    noise = loop_words.at_other_noise(found.sensitivity) if found.sensitivity else ""
    notes = [*found.notes, noise, fit_tables.noise_sentence(noises, found.channels)]
    chi = " → ".join(f"{x:.0f}" for x in found.chi2_of_readings[: 2 - found.refit_alone])
    verb = "are consistent with" if found.adequate_after else "exceed"
    used, left_out = int(found.included.sum()), (len(found.unusable), len(found.outliers))
    rows = "samples" if isinstance(found.detail, TimeStatistics) else "runs"
    aside = " ({} without a result of the fitted model, {} set aside as outliers)".format(*left_out)
    adequacy = (
        f"The residuals {verb} the noise (χ² of {found.readings} readings {chi} σ², {found.replicates} bootstrap "
        f"tables). {used} of {len(found.runs)} {rows} are used"
        f"{aside * any(left_out)}."
    )
    verdict, support = f"{_noise_alone(found)}{found.verdict_statement}", loop_words.support_sentence(found)
    cluster = loop_words.cluster_sentence(found.cluster) if found.cluster else ""
    sentences = (
        Note(verdict, name="statement", terminal=True),
        Note(cluster, name="cluster"),
        Note(support, name="standing", terminal=True),
        *remarks([] if found.unnamed is None else [loop_words.proposed_formula(found.unnamed)], "also"),
        Note(adequacy, name="adequacy", terminal=True),
    )
    yield Section("How certain the verdict is", tuple(note for note in sentences if note.text))
    yield Section("Before you use it", remarks(filter(None, notes)))


def _sections(
    found: DiscoveryResult, table: Columns, run_by_run: Sequence[Block], missing_term: Sequence[Block]
) -> Iterable[Section]:
    missing, sized = not found.refit_alone, Layout.of(found.robot).crosses_zero
    looked_for = Section("Effects that were tested", tuple(_looked_for(found)))
    if run_by_run:
        yield Section("Measured and simulated, run by run", tuple(run_by_run))
    if not missing:
        yield looked_for
    yield Section("Where the missing term acts" if missing else "What each equation lacks", tuple(missing_term))
    yield from fit_tables.clusters_section(found.residual_clusters)
    fits = {when: rms for when, rms in found.rms.items() if not (found.refit_alone and "after" in when)}
    in_units = [fit_tables.rms_table(fits, found.channels)] * sized
    yield Section("Errors", (catalogue.note("loop.fitted_again"), *in_units))
    yield from _certainty_sections(found)
    candidates = tuple(_candidates(found))
    yield from [Section("Candidates", candidates)] * bool(candidates)
    yield from [looked_for] * missing
    rows = [
        (
            f"`{name}`", p.prior, p.before, p.after, p.sd_after, p.unit, fit_tables.shift_cell(p.shift_before),
            fit_tables.shift_cell(p.shift_after),
            describe(determination(name, p.held_by_prior, found.together)),
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
    """Alternatives that explain the data, if there are any."""
    curves = "; none of them is adequate, or curves explain the data better" * (found.verdict in WITHOUT_NAME)
    tables: dict[str, list[tuple[Any, ...]]] = {
        "alternatives": [(_named(a.effects), a.rise_chi2) for a in found.alternatives],
        "hidden": [
            (h.name, f"{h.amplitude:.3g} {h.unit}".removesuffix(" -"), h.sigmas) for h in found.hidden
        ],
        "implausible": [(_named(a.effects), _named(a.sizes), a.rise_chi2, a.why) for a in found.implausible],
    }  # fmt: skip
    if any(tables.values()):
        yield catalogue.note("loop.definitions")
    for name, rows in tables.items():
        if rows:
            yield catalogue.note(f"loop.{name}-above", curves)
            yield catalogue.table(f"loop.{name}", rows)


def _named(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items())


def _looked_for(found: DiscoveryResult) -> Iterable[Block]:
    yield catalogue.note("loop.seen-above")
    level, rows = found.before.threshold("single"), []
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
