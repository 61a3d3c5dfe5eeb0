"""Report of a sweep: statuses of the runs, exceeded limits, and every channel over the grid."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from calibration.data import Columns
from calibration.data.robot_file import RobotFile
from mmrjax.errors import count_noun
from sweeps import capabilities
from sweeps.pages import words
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Document, Section, Table, remarks
from sweeps.report.run_tables import imposed_column, quantity_column


def sweep_document(file: RobotFile, model: str, runs: Columns, notes: Sequence[str] = ()) -> Document:
    """Report of a finished sweep."""
    shown_runs = capabilities.drop_inapplicable_columns(file.robot, runs)
    statuses = Counter(map(str, runs["status"]))
    statuses_known = [*words.STATUSES, *(statuses.keys() - words.STATUSES.keys())]
    flagged_by_status = {s: int(((runs["status"] == s) & (runs["flags"] != "")).sum()) for s in statuses_known}
    ranges_by_status = {
        s: "" if s in words.SETTLED else _ranges_of_runs(runs, runs["status"] == s) for s in statuses_known
    }
    maps = []
    for c in file.robot.channels:
        labels = c.label.capitalize(), c.unit
        figure = catalogue.figure("sweep.sweep", runs, c, finding=f"{c.label} over the grid", words=labels)
        maps.append(dataclasses.replace(figure, name=f"sweep_{c.name}"))
    axes = "; ".join(_levels(runs, c) for c in _axes(runs))
    extremes = (*(c.column for c in file.robot.channels), "slip", "winding_settled_C")
    return Document(
        f"Sweep of {count_noun(len(runs['status']), 'run')}",
        sweep_answer(runs),
        (
            run_tables.note_on_robot(file, model, f"Varied: {axes}."),
            run_tables.endings_table(
                {s: statuses[s] for s in statuses_known}, beyond_a_limit=flagged_by_status, where=ranges_by_status
            ),
            _limits(runs),
            _extremes(shown_runs, extremes),
            *remarks(notes),
        ),
        (Section("Over the grid", (catalogue.note("sweep.maps"), *maps), "maps"),),
    )


def sweep_answer(runs: Columns) -> str:
    """One sentence: number of runs with an operating point, and of those within all limits."""
    total = len(runs["status"])
    settled = np.isin(runs["status"], words.SETTLED)
    is_flagged = settled & (runs["flags"] != "")
    verb = "has" if 1 in (total, settled.sum()) else "have"
    first_words = f"{settled.sum()} of {count_noun(total, 'run')} {verb} an operating point"
    if not is_flagged.any():
        return f"{first_words}, all within every limit." if settled.any() else f"{first_words}."
    raised = Counter(flag for flags in runs["flags"][is_flagged] for flag in str(flags).split(";"))
    most_frequent, times = raised.most_common(1)[0]
    return (
        f"{first_words}. {is_flagged.sum()} of them {'exceeds' if is_flagged.sum() == 1 else 'exceed'} a limit. Most "
        f"often, {words.FLAGS.get(most_frequent, most_frequent)} ({count_noun(times, 'run')})."
    )


def _limits(runs: Columns) -> Table:
    """Table of limits that some runs exceed, with the number of runs and where they are."""
    kinds, flag_index = np.unique(runs["flags"], return_inverse=True)
    rows = []
    for flag, meaning in words.FLAGS.items():
        is_flagged = np.array([flag in str(f).split(";") for f in kinds])[flag_index]
        if is_flagged.any():
            rows.append((f"{meaning} (`{flag}`)", int(is_flagged.sum()), _ranges_of_runs(runs, is_flagged)))
    return catalogue.table("sweep.limits", rows)


def _axes(runs: Columns) -> list[str]:
    """Columns of the grid's axes: on the battery without voltage, and without readings."""
    axes = ("configuration", imposed_column(runs), "payload_kg", "slope_deg", "load_torque_Nm")
    return [c for c in axes if c in runs and (runs[c].dtype.kind not in "fiu" or not np.isnan(runs[c]).all())]


def _levels(runs: Columns, name: str, pick: np.ndarray | slice = slice(None), most: int = 8) -> str:
    """Values of an axis for the selected runs, in words: `slope 0, 10°`."""
    values, column = runs[name][pick], quantity_column(name)
    levels = np.unique(values)
    if levels.dtype.kind not in "fiu":
        return ", ".join(dict.fromkeys(map(str, values)))
    unit = column.unit if column.unit == "°" else f" {column.unit}"
    if levels.size > most:
        return f"{column.heading} {levels[0]:.3g} to {levels[-1]:.3g}{unit} ({levels.size} values)"
    return f"{column.heading} {', '.join(f'{v:.4g}' for v in levels)}{unit}"


def _ranges_of_runs(runs: Columns, pick: np.ndarray) -> str:
    """Ranges of slope and imposed quantity for the selected runs, by configuration, in words."""
    parts = []
    for kind in dict.fromkeys(map(str, runs["configuration"][pick])):
        of_kind = pick & (runs["configuration"] == kind)
        names = [c for c in ("slope_deg", imposed_column(runs)) if c in runs and not np.isnan(runs[c][of_kind]).all()]
        ranges = "; ".join(_levels(runs, c, of_kind, 4) for c in names)
        parts.append(f"{int(of_kind.sum())} of {kind} ({ranges})")
    return ", ".join(parts)


def _extremes(runs: Columns, names: Iterable[str]) -> Table:
    """Table of the settled runs with the largest readings, slip and winding temperature."""
    settled = np.nonzero(np.isin(runs["status"], words.SETTLED))[0]
    reached = [c for c in names if c in runs and not np.isnan(runs[c][settled]).all()]
    rows = []
    for c in reached:
        k = int(settled[np.nanargmax(np.abs(runs[c][settled]))])
        column = quantity_column(c)
        (value,) = run_tables.quantity_cells({c: runs[c][k : k + 1]}, c)
        place = "; ".join(_levels(runs, axis, slice(k, k + 1)) for axis in _axes(runs))
        rows.append((f"largest {column.heading}", f"{column.text(value)} {column.unit}".strip(), place))
    return catalogue.table("sweep.extremes", rows)
