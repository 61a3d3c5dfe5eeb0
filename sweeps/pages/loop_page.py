"""The report of the loop: verdict, residual before and after, and the next experiment on one page; then the rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import mmrjax as mm
from calibration.data.columns import Layout
from calibration.described import describe
from calibration.discovery.result import DiscoveryResult
from calibration.inference import blocks
from calibration.inference.details import Detail, EquationDefects, TimeStatistics
from calibration.inference.fit_notes import Copied, Determination, FarFromPrior, Repeats
from calibration.inference.simulation_errors import root_mean_square
from calibration.words import loop_words
from mmrjax.effects import BY_NAME
from mmrjax.model import params
from mmrjax.model.robot import Robot
from sweeps.pages import cluster_figures, loop_figures
from sweeps.pages.page import Album, channel_columns, first_rows, render_page, unnamed_curves
from sweeps.pages.time_overlay import time_overlay
from sweeps.pages.words import GLOSSARY, words_shown
from sweeps.report.condition_columns import condition_formats

#: Change of an rms error that is marked [%].
NOTABLE = 0.05

Section = Callable[[Album, DiscoveryResult], None]


def rows_of(found: DiscoveryResult) -> dict[str, np.ndarray]:
    """Rows of the result as figures and page show them: of a rig each surface is a configuration of its own."""
    table = found.rows_table()
    if Layout.of(found.robot).crosses_zero:
        table["configuration"] = found.runs.configurations_named(found.robot)
    return table


def _drawn(found: DiscoveryResult) -> str:
    """The verdict as figures take it, which is `none` where they show the refit alone."""
    return "none" if found.refit_alone else found.verdict


def _run_by_run(album: Album, found: DiscoveryResult) -> None:
    table = rows_of(found)
    album.add("before_after", lambda: loop_figures.before_after(table, found.channels, _drawn(found)))
    album.add("defects", lambda: loop_figures.draw_defects(table, _drawn(found), Layout.of(found.robot).crosses_zero))


def _over_time(album: Album, found: DiscoveryResult) -> None:
    assert isinstance(found.detail, TimeStatistics)
    detail = found.detail
    simulated = {"after_": "with what was found", "before_": "before"}
    if _drawn(found) == "none":
        simulated = {"after_": "simulated"}
    album.add_overlay("overlay", time_overlay(rows_of(found), found.channels, simulated))
    album.add(
        "before_after", lambda: loop_figures.over_time(found.runs, rows_of(found), found.channels, _drawn(found))
    )
    album.add("series", lambda: loop_figures.time_statistics(detail, found.channels, _drawn(found)))


#: What a page shows of one kind of data, by the type of the result's detail.
SECTIONS: dict[type[Detail], Section] = {EquationDefects: _run_by_run, TimeStatistics: _over_time}


def indistinguishable_in_words(found: DiscoveryResult) -> list[str]:
    """Of each effect, and of a discrepancy without a name, what these data cannot tell from it, in words."""
    curve = [] if found.unnamed is None else [found.unnamed]
    without_name = [", ".join(b for b in c.balances_alike if b != c.balance) for c in curve]
    return [*(loop_words.indistinguishable_effects(found, e) for e in found.effects), *without_name]


def effect_findings(found: DiscoveryResult, changed: Mapping[str, loop_figures.Change]) -> list[dict[str, str]]:
    """Each effect of the model for the first screen: what it is, how large, how sure, what else it could be."""
    listed = []
    for e in found.effects:
        size = loop_words.effect_amplitude(e)
        if (change := changed.get(e.name)) is not None:
            size += f", which changes the {change.channel.label} by {change.rms:.2g} %"
        sure, other = loop_words.how_sure(found, e), loop_words.indistinguishable_effects(found, e)
        listed.append({"name": e.name, "what": ", or ".join(e.families), "size": size, "sure": sure, "alike": other})
    return listed


def changes_by_effect(found: DiscoveryResult) -> dict[str, loop_figures.Change]:
    """Change of settled runs by each effect; empty for histories and for effects that the written robot lacks."""
    added = [e.name for e in found.effects if e.name in {x.name for x in found.robot.effects}]
    if not isinstance(found.detail, EquationDefects) or not added:
        return {}
    conditions = found.runs.conditions(found.robot)

    def shown(robot: Robot) -> dict[str, np.ndarray]:
        results = mm.simulate(robot, conditions)
        return {c.name: np.asarray(getattr(results, c.name)) for c in found.channels}

    with_it, most, measured = shown(found.robot), {}, found.readings_of_rows.measured
    for name in added:
        without = shown(params.replace(found.robot, {f"effects.{name}.amplitude": params.as_float(0.0)}))
        moved = []
        for k, c in enumerate(found.channels):
            a, b = without[c.name], with_it[c.name]
            size = root_mean_square(measured[found.included, k])
            if np.isfinite(size) and size > 0:
                moved.append(loop_figures.Change(c, 100 * root_mean_square((b - a)[found.included]) / size, a, b))
        if moved:
            most[name] = max(moved, key=lambda change: change.rms)
    return most


def would_be_seen(found: DiscoveryResult) -> list[dict[str, Any]]:
    """From what size each effect of the library would have been noticed, the first in its typical sizes first."""
    level, listed = found.before.kinds["single"].threshold, []
    for s in found.scores:
        if s.name in BY_NAME and s.sigmas_per_prior_sd > 0:
            spec = next(p.spec for p in params.walk_parameters(BY_NAME[s.name]()) if p.spec.amplitude)
            times = level / s.sigmas_per_prior_sd
            size = f"{times * spec.prior_sd(0.0):.2g} {spec.unit}"
            listed.append({"name": s.name, "what": BY_NAME[s.name].family(), "size": size, "times": times})
    return sorted(listed, key=lambda one: one["times"])


def held_out_rows(found: DiscoveryResult) -> list[dict[str, Any]]:
    """Errors of the refit and with what was found, by kind of block held out, with the rows that each reaches; marked
    where they are better or worse."""
    total, many = len(found.runs), not found.refit_alone
    lines = []
    for kind, both in {"": found.errors, **found.errors_held_out}.items():
        worse = {w.channel for w in found.held_out_worse if w.kind == kind}
        cells = []
        for c in both[0]:
            texts = [f"{e[c]['rms_percent']:.1f}" if e[c]["rows"] else "-" for e in both[: 1 + many]]
            change = both[1][c]["rms_percent"] - both[0][c]["rms_percent"] if many else 0.0
            up = c in worse if kind else change > NOTABLE
            mark = "bad" if up else "good" if change < -NOTABLE else ""
            arrow = {"bad": " ↑", "good": " ↓", "": ""}[mark]
            cells.append({"text": " → ".join(texts) + arrow, "mark": mark})
        rows = max(int(e["rows"]) for e in both[0].values())
        what = f"unseen: another {blocks.kind_in_words(kind)}" if kind else "seen by the fit"
        lines.append({"what": what, "cells": cells, "reached": f"{rows} of {total}"})
    blank = [{"text": "-", "mark": ""} for _ in found.channels]
    for kind in found.held_out_unpredictable:
        if kind not in found.errors_held_out:
            what, why = f"unseen: another {blocks.kind_in_words(kind)}", "not predictable from the others"
            lines.append({"what": what, "cells": blank, "reached": why})
    return lines


def error_summary(found: DiscoveryResult) -> list[dict[str, Any]]:
    """Errors as stated, fitted again, and with what was found: seen, and unseen by the first kind of block.

    A change is marked if both lines are over the same number of rows.
    """
    unseen, total = next(iter(found.errors_held_out.values()), ({}, {})), len(found.runs)
    lines = [("as stated", found.errors_as_stated, {}), ("fitted again", found.errors[0], unseen[0])]
    if not found.refit_alone:
        lines.append(("with what was found", found.errors[1], unseen[1]))
    shown, before = [], dict[str, tuple[float, int]]()
    for what, seen, held in lines:
        cells = []
        for c, e in seen.items():
            other = f" ({held[c]['rms_percent']:.1f} %)" if c in held and held[c]["rows"] else ""
            last, rows = before.get(c, (e["rms_percent"], e["rows"]))
            change = e["rms_percent"] - last if rows == e["rows"] else 0.0
            arrow, mark = ("", "") if not abs(change) >= NOTABLE else (" ↓", "good") if change < 0 else (" ↑", "bad")
            cells.append({"text": f"{e['rms_percent']:.1f} %{other}{arrow}" if e["rows"] else "-", "mark": mark})
        before = {c: (float(e["rms_percent"]), int(e["rows"])) for c, e in seen.items()}
        reached, also = (max((int(e["rows"]) for e in by.values()), default=0) for by in (seen, held))
        n = f"{reached}/{total}" + (f" ({also}/{total})" if also else "")
        shown.append({"what": what, "cells": cells, "reached": n})
    return shown


def check_first(found: DiscoveryResult) -> list[str]:
    """Points to check before use: the reading with the largest weight, parameters that moved far, contradictions."""
    far = [describe(note) for note in found.remarks if isinstance(note, FarFromPrior | Repeats | Copied)]
    against = [note for note in found.remarks if isinstance(note, str)]
    said = [loop_words.largest_share(found), *far, *against[:1]]
    # a sentence begins with a capital, a parameter's name does not
    return [f"{text if '.' in text.split()[0] else text[0].upper() + text[1:]}." for text in said if text]


def write_loop_page(folder: Path, found: DiscoveryResult, *, robot_name: str) -> Path:
    """Write `report.html` and `figures/` for a pass of the loop.

    Args:
        folder: an existing run folder.
        robot_name: name or file of the robot that it began with.

    Returns:
        The path of the page.
    """
    album = Album(Path(folder))
    table, sized = rows_of(found), Layout.of(found.robot).crosses_zero
    SECTIONS[type(found.detail)](album, found)
    if found.residual_clusters:
        album.add("clusters", lambda: cluster_figures.draw_clusters(found.residual_clusters))
    album.add("errors", lambda: loop_figures.draw_errors(found))
    changed = changes_by_effect(found)
    if changed:
        album.add("laws", lambda: loop_figures.draw_effect_laws(found, table, changed))
    if found.unnamed is not None:
        curve = found.unnamed
        album.add("curve", lambda: loop_figures.draw_unnamed_curve(curve))
    album.add("ladder", lambda: loop_figures.draw_effect_scores(found))
    album.add("null", lambda: loop_figures.draw_bootstrap_statistics(found.before))
    album.add("look_alikes", lambda: loop_figures.look_alikes(found))
    album.add("base_shift", lambda: loop_figures.base_shift(found))
    return render_page(
        Path(folder),
        "loop.html.j2",
        album,
        of_channels=found.channels,
        title=f"Is the {words_shown(Path(robot_name).name)} model complete?",
        answer=loop_words.completeness_answer(found),
        findings=effect_findings(found, changed),
        summary=error_summary(found),
        unseen=held_out_rows(found),
        would_be_seen=would_be_seen(found),
        glossary=GLOSSARY,
        curves=unnamed_curves(found.robot),
        files={
            "robot.toml": f"the robot {'with what was found' if found.written and found.effects else 'refitted'}",
            "fitted.toml": "the robot refitted, with nothing added",
        },
        seen_by=next((blocks.kind_in_words(kind) for kind in found.errors_held_out), "nothing"),
        use_it=loop_words.use_it(found),
        check_first=check_first(found),
        document=found.to_json(),
        p=loop_words.p_value(found.before.p_value),
        cluster="" if found.cluster is None else loop_words.cluster_sentence(found.cluster),
        standing=loop_words.support_sentence(found),
        ruled_out=loop_words.ruled_out(found),
        alike=indistinguishable_in_words(found),
        doubts=[loop_words.tentative_reason(found, e) for e in found.effects] + [""] * (found.unnamed is not None),
        other_noise=loop_words.at_other_noise(found.sensitivity),
        worse=loop_words.rising_errors_sentence(found.held_out_worse, found.predicted),
        rows=first_rows(rows_of(found)),
        conditions=condition_formats(rows_of(found)),
        columns=channel_columns(found.channels),
        sized=sized,
        has_ground=found.robot.has_ground,
        sides=max(1, len(loop_figures.defects_of(table, "before", "track"))),
        closed=loop_figures.closed_equations(table) if sized and isinstance(found.detail, EquationDefects) else [],
        rms=found.rms,
        determined={
            n: describe(Determination.of(n, p.held_by_prior, found.together)) for n, p in found.base_shift.items()
        },
        shift=lambda z: "bad" if abs(z) > 3 else "fair" if abs(z) > 2 else "",
    )
