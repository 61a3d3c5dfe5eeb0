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


def loop_document(result: DiscoveryResult, robot_name: str, changes: Mapping[str, fit_tables.Change]) -> Document:
    """Report of a loop.

    Args:
        robot_name: name or file of the initial robot.
        changes: changes of settled runs by each effect.
    """
    table, shifts = rows_for_figures(result), list(moved_parameters(result))
    log = result.detail if isinstance(result.detail, TimeStatistics) else None
    figures = _run_figures(result, table, changes) if log is None else _log_figures(result, log, table)
    first, run_by_run, missing_term = figures
    rise = loop_words.rising_errors_sentence(result.held_out_worse, result.predicted)
    return Document(
        f"Is the {words.displayed_robot_name(Path(robot_name).name)} model complete?",
        result.statement,
        (
            *remarks(shifts, "moved"),
            first,
            _errors(result),
            *[Note(rise, name="worse", terminal=True)] * bool(rise),
            _advice(result),
            *remarks(_effect_findings(result, changes), "found"),
            *run_tables.curve_warning(result.robot),
        ),
        tuple(_sections(result, table, run_by_run, missing_term)),
        brief=loop_words.brief_answer(result, shifts, _next_step(result, "")),
    )


def _log_figures(result: DiscoveryResult, detail: TimeStatistics, table: Columns) -> _Figures:
    """Measured and simulated over time, the fits of every run, and the statistics that need histories."""
    lines = {"after_": "simulated"}
    if not result.refit_alone:
        lines = {"after_": "with the effects found", "before_": "before"}
    first = catalogue.figure("fit.overlay", table, result.channels, lines, finding=result.statement)
    runs = dataclasses.replace(result.runs, columns={**result.runs.columns, **table})
    run_by_run = fit_tables.fits_of_runs(table, result.channels, lines)
    before, after, unresolved = detail.before, detail.after, ", ".join(detail.orders_unresolved)
    numbers = before.deviate, after.deviate, before.threshold, (2 * detail.runs) ** 0.5
    more = catalogue.text("loop.unresolved", unresolved) if unresolved else ""
    verdict = "none" if result.refit_alone else result.verdict
    statistics = catalogue.figure("loop.series", detail, result.channels, verdict, words=numbers, more=more)
    responses = fit_tables.frequency_response(runs, result.channels, lines)
    return first, [run_by_run, *responses], [statistics, *_curve(result)]


def _run_figures(result: DiscoveryResult, table: Columns, changes: Mapping[str, fit_tables.Change]) -> _Figures:
    """The law of an added effect with the readings that it changes, or else the curve or the residuals. Then the
    residuals of every run, and the errors of the equations.
    """
    laws: list[Block] = []
    for name, change in changes.items():
        effect = next(e for e in result.effects if e.name == name)
        law = ", or ".join(effect.families), name, loop_words.effect_amplitude(effect)
        laws.append(catalogue.figure("loop.law", result, table, name, change, words=law, suffix=name if laws else ""))
    verdict, crosses_zero = "none" if result.refit_alone else result.verdict, Layout.of(result.robot).crosses_zero
    residuals, curve = catalogue.figure("loop.before_after", table, result.channels, verdict), _curve(result)
    closure_note = catalogue.text("loop.three")
    if crosses_zero:
        from sweeps.pages import loop_figures

        sides = max(1, len(loop_figures.defects_by_side(table, "before", "track")))
        equations, of_sides = loop_figures.closed_equations(table), " of each side" * (sides > 1)
        closure_note = catalogue.text("loop.fewer", " of both sides" * (sides > 1))
        if len(result.channels) >= len(equations) * sides:
            names = ", ".join(n.replace("electrical", "voltage").replace("track", "torque") for n in equations)
            closure_note = catalogue.text("loop.closes", count_noun(len(equations), "equation"), of_sides, names)
    defects = [catalogue.figure("loop.defects", table, verdict, crosses_zero, words=(closure_note,))]
    if drive_curves.lost_by_load(result.robot) and result.robot.rig.imposed == "voltage":
        plane = lambda: drive_curves.drive_plane(result.robot, result.runs)  # noqa: E731
        defects.insert(0, catalogue.figure("run.drive_plane", values=plane))
    if laws:
        return laws[0], [residuals], [*laws[1:], *defects, *curve]
    return (curve[0], [residuals], defects) if curve else (residuals, [], defects)


def _curve(result: DiscoveryResult) -> list[Block]:
    """Figure of the smooth curve for an unnamed discrepancy."""
    if result.unnamed is None:
        return []
    key = "tentative" if result.effects else "written" if result.written else "left"
    key = "log" if isinstance(result.detail, TimeStatistics) else key
    more = catalogue.text(f"loop.curve-{key}", result.unnamed.effect)
    return [catalogue.figure("loop.curve", result.unnamed, words=(more,))]


def rows_for_figures(result: DiscoveryResult) -> Columns:
    """Rows of the result for figures and page. For a rig, each surface is a separate configuration."""
    table = result.rows_table()
    if Layout.of(result.robot).crosses_zero:
        table["configuration"] = result.runs.configurations_named(result.robot)
    return table


def _effect_findings(result: DiscoveryResult, changes: Mapping[str, fit_tables.Change]) -> Iterable[str]:
    """Sentences on the effects found: meaning, size, certainty and alternatives."""
    for e in result.effects:
        size, other = loop_words.effect_amplitude(e), loop_words.indistinguishable_effects(result, e)
        if e.name in changes:
            size += f", which changes the {changes[e.name].channel.label} by {changes[e.name].rms:.2g} %"
        or_else = f" Or {other}." if other else ""
        kinds = ", or ".join(e.families)
        opening = _noise_alone(result)
        sure = f"{f'{opening}, it' if opening else 'It'} is {loop_words.standing_of_effect(result, e)}"
        yield f"**{kinds}** (`{e.name}`): {size}. {sure}.{or_else}"


def _noise_alone(result: DiscoveryResult) -> str:
    """First words of a claim that does not hold at every tried noise level, otherwise ""."""
    return "" if result.headline.level == result.verdict else "At the noise of the fit only"


def moved_parameters(result: DiscoveryResult) -> Iterable[str]:
    """Parameters of the written robot that moved by more than `MOVED` prior sds, largest shift first."""
    by_name = {
        name: (p.after, p.shift_after) if result.written else (p.before, p.shift_before)
        for name, p in result.base_shift.items()
    }
    for name, (value, shift) in sorted(by_name.items(), key=lambda item: -abs(item[1][1])):
        if abs(shift) >= MOVED:
            base_shift = result.base_shift[name]
            yield loop_words.moved_parameter(name, value, base_shift.prior, base_shift.unit, shift)


def _errors(result: DiscoveryResult) -> Table:
    """Errors of the robot file, of the refit and with the effects found, on fitted and on held-out rows."""

    def reached(errors: Mapping[str, Mapping[str, Any]]) -> str:
        return f"{max((int(e['rows']) for e in errors.values()), default=0)} of {len(result.runs)}"

    as_stated = result.errors_as_stated
    rows: list[tuple[Any, ...]] = [
        ("robot file as given", *map(loop_words.percent_text, as_stated.values()), reached(as_stated))
    ]
    for kind, pair in {"": result.errors, **result.errors_held_out}.items():
        worse = {w.channel for w in result.held_out_worse if w.kind == kind}
        refit, proposal = pair[0], pair[0 if result.refit_alone else 1]
        cells = []
        for c in refit:
            text = " → ".join(loop_words.percent_text(e[c]) for e in pair[: 1 if result.refit_alone else 2])
            change = proposal[c]["rms_percent"] - refit[c]["rms_percent"]
            rises = c in worse or (change >= NOTABLE and not kind)
            falls = change <= -NOTABLE and not rises
            mark, tone = (" ↑", "bad") if rises else (" ↓", "good") if falls else ("", "")
            cells.append(Cell(text + mark, tone))
        rows.append((_unseen(kind) if kind else "seen by the fit", *cells, reached(refit)))
    rows += [
        (_unseen(kind), *["-"] * len(result.channels), "not predictable from the others")
        for kind in result.held_out_unpredictable
        if kind not in result.errors_held_out
    ]
    return catalogue.table("loop.errors", rows, *(f"{c.label} |" for c in result.channels))


def _unseen(kind: str) -> str:
    return f"unseen: another {blocks.kind_in_words(kind)}"


def _next_step(result: DiscoveryResult, more: str) -> str:
    """What to do next. `more`: text after the name and description of an experiment."""
    experiment = result.next_experiment
    different_runs = remarks_with_codes(result.remarks, "run_differs")
    if different_runs and result.headline.level not in ("named", "class"):
        return as_paragraph(map(describe, different_runs))
    if experiment is not None and experiment.name == NONE:
        return f"{experiment.description}."
    if experiment is not None:
        return f"**{experiment.name}**: {experiment.description}.{more}"
    level, texts = result.headline.level, {"none", "undescribed", "named", "open"}
    return catalogue.text(f"loop.next-{level if level in texts else 'other'}")


def _advice(result: DiscoveryResult) -> Table:
    experiment, more = result.next_experiment, ""
    if experiment is not None and experiment.separates:
        sigma = experiment.expected_sigma
        more = f" It distinguishes {', '.join(experiment.separates)}. Expected separation: {sigma:.1f} σ."
    if experiment is not None and result.headline.level == "class" and not experiment.settles:
        more += " Some pairs remain undecided."
    unusual_notes = remarks_with_codes(
        result.remarks, "after_steps", "shifted", "far_from_prior", "repeats", "copied"
    )
    objections = [note for note in result.remarks if isinstance(note, str)][:1]
    to_check = [loop_words.largest_share(result), *map(describe, unusual_notes), *objections]
    rows = [
        ("May I use it for …", " ".join(loop_words.errors_of_written_robot(result)) or "No runs could be held out."),
        ("What to check first", as_paragraph(to_check) or "Nothing unusual."),
        ("What to do next", _next_step(result, more)),
    ]
    return catalogue.table("loop.advice", rows)


def _certainty_sections(result: DiscoveryResult) -> Iterable[Section]:
    """Sections on the certainty of the answer and its limits."""
    noises = {name: (n["median_percent"], n["source"]) for name, n in result.noise.items()}
    noise = loop_words.at_other_noise(result.sensitivity) if result.sensitivity else ""
    notes = [*result.notes, noise, fit_tables.noise_sentence(noises, result.channels)]
    chi2 = " → ".join(f"{x:.0f}" for x in result.chi2_of_readings[: 2 - result.refit_alone])
    verb = "are consistent with" if result.adequate_after else "exceed"
    used, left_out = int(result.included.sum()), (len(result.unusable), len(result.outliers))
    rows = "samples" if isinstance(result.detail, TimeStatistics) else "runs"
    left_out_words = " ({} without a result of the fitted model, {} set aside as outliers)".format(*left_out)
    adequacy = (
        f"The residuals {verb} the noise (χ² of {result.readings} readings {chi2} σ², {result.replicates} bootstrap "
        f"tables). {used} of {len(result.runs)} {rows} are used"
        f"{left_out_words * any(left_out)}."
    )
    verdict = ": ".join(filter(None, (_noise_alone(result), result.verdict_statement)))
    support = loop_words.support_sentence(result)
    cluster = loop_words.cluster_sentence(result.cluster) if result.cluster else ""
    sentences = (
        Note(verdict, name="statement", terminal=True),
        Note(cluster, name="cluster"),
        Note(support, name="standing", terminal=True),
        *remarks([] if result.unnamed is None else [loop_words.proposed_formula(result.unnamed)], "also"),
        Note(adequacy, name="adequacy", terminal=True),
    )
    yield Section("How certain the verdict is", tuple(note for note in sentences if note.text))
    yield Section("Before you use it", remarks(filter(None, notes)))


def _sections(
    result: DiscoveryResult, table: Columns, run_by_run: Sequence[Block], missing_term: Sequence[Block]
) -> Iterable[Section]:
    has_claim, crosses_zero = not result.refit_alone, Layout.of(result.robot).crosses_zero
    tested = Section("Effects that were tested", tuple(_tested_effects(result)))
    if run_by_run:
        yield Section("Measured and simulated, run by run", tuple(run_by_run))
    if not has_claim:
        yield tested
    yield Section("Where the missing term acts" if has_claim else "What each equation lacks", tuple(missing_term))
    yield from fit_tables.clusters_section(result.residual_clusters)
    fits = {when: rms for when, rms in result.rms.items() if not (result.refit_alone and "after" in when)}
    in_units = [fit_tables.rms_table(fits, result.channels)] * crosses_zero
    yield Section("Errors", (catalogue.note("loop.fitted_again"), *in_units))
    yield from _certainty_sections(result)
    candidates = tuple(_candidates(result))
    yield from [Section("Candidates", candidates)] * bool(candidates)
    yield from [tested] * has_claim
    rows = [
        (
            f"`{name}`", p.prior, p.before, p.after, p.sd_after, p.unit, fit_tables.shift_cell(p.shift_before),
            fit_tables.shift_cell(p.shift_after),
            describe(determination(name, p.held_by_prior, result.together)),
            p.at_bound or "", p.meaning,
        )
        for name, p in result.base_shift.items()
    ]  # fmt: skip
    yield Section("Parameters before and after", (catalogue.table("loop.base", rows),))
    first = {"row": table["row"]}
    if isinstance(result.detail, TimeStatistics):
        first |= {"run": table.get("run_id", table["row"]), "t [s]": table["time_s"]}
    kinds = {"": "measured", "before_": "before", "after_": "after"}
    yield fit_tables.rows_section(table, result.channels, kinds, False, first=first, last={"use": table["use"]})
    yield Section("Words", (catalogue.table("loop.words", list(words.GLOSSARY.items())),))


def _candidates(result: DiscoveryResult) -> Iterable[Block]:
    """Alternatives that explain the data, if there are any."""
    curves = "; none of them is adequate, or curves explain the data better" * (result.verdict in WITHOUT_NAME)
    tables: dict[str, list[tuple[Any, ...]]] = {
        "alternatives": [(_amounts(a.effects), a.rise_chi2) for a in result.alternatives],
        "hidden": [
            (h.name, f"{h.amplitude:.3g} {h.unit}".removesuffix(" -"), h.sigmas) for h in result.hidden
        ],
        "implausible": [(_amounts(a.effects), _amounts(a.sizes), a.rise_chi2, a.why) for a in result.implausible],
    }  # fmt: skip
    if any(tables.values()):
        yield catalogue.note("loop.definitions")
    for name, rows in tables.items():
        if rows:
            yield catalogue.note(f"loop.{name}-above", curves)
            yield catalogue.table(f"loop.{name}", rows)


def _amounts(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items())


def _tested_effects(result: DiscoveryResult) -> Iterable[Block]:
    yield catalogue.note("loop.seen-above")
    level, rows = result.before.threshold("single"), []
    for s in result.scores:
        if s.name in BY_NAME and s.sigmas_per_prior_sd > 0:
            spec = next(p.spec for p in params.walk_parameters(BY_NAME[s.name]()) if p.spec.amplitude)
            times = level / s.sigmas_per_prior_sd
            size = f"{times * spec.prior_sd(0.0):.2g} {spec.unit}"
            rows.append((f"`{s.name}`", BY_NAME[s.name].family(), size, times))
    yield catalogue.table("loop.would_be_seen", sorted(rows, key=lambda row: row[-1]))
    unseen = {
        "cannot_see": result.cannot_see, "needs_series": result.needs_histories, "needs_reverse": result.needs_reverse
    }  # fmt: skip
    texts = (catalogue.text(f"loop.{key}", ", ".join(names)) for key, names in unseen.items() if names)
    yield Note("".join(texts), name="unseen")
