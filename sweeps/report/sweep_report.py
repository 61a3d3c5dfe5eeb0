"""Reports of sweeps: statuses, exceeded limits and channels of a grid, and the points of a store."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Columns, Json
from calibration.data.robot_file import RobotFile
from mmrjax.climbing.climb_simulation import OVER
from mmrjax.errors import count_noun
from mmrjax.fidelities.variation import STATUS
from mmrjax.model import signals
from sweeps import capabilities
from sweeps.pages import words
from sweeps.points.tasks import LARGEST, SIZE, VERDICT
from sweeps.points.zarr_store import STORE, StoreLayout
from sweeps.report import catalogue, run_tables
from sweeps.report.climb_report import VERDICTS
from sweeps.report.document import Block, Column, Document, Figure, Note, Section, Table, remarks
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
    kinds, flag_index = np.unique(runs["flags"], return_inverse=True)
    rows = []
    for flag, meaning in words.FLAGS.items():
        is_flagged = np.array([flag in str(f).split(";") for f in kinds])[flag_index]
        if is_flagged.any():
            rows.append((f"{meaning} (`{flag}`)", int(is_flagged.sum()), _ranges_of_runs(runs, is_flagged)))
    return Document(
        f"Sweep of {count_noun(len(runs['status']), 'run')}",
        sweep_answer(runs),
        (
            run_tables.note_on_robot(file, model, f"Varied: {axes}."),
            run_tables.endings_table(
                {s: statuses[s] for s in statuses_known}, beyond_a_limit=flagged_by_status, where=ranges_by_status
            ),
            catalogue.table("sweep.limits", rows),
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
        levels_text = "; ".join(_levels(runs, axis, slice(k, k + 1)) for axis in _axes(runs))
        rows.append((f"largest {column.heading}", f"{column.text(value)} {column.unit}".strip(), levels_text))
    return catalogue.table("sweep.extremes", rows)


#: Most points for figures and quantiles, and most chunks to take them from. Most outputs that are drawn.
THINNED, CHUNKS, DRAWN = 200_000, 100, 6


def campaign_document(file: RobotFile, layout: StoreLayout, result: Json, store: Path) -> Document:
    """Report of a complete store.

    Args:
        result: `result.json`.
        store: folder of the store.
    """
    counts, model, total = result["statuses"], result["model"], result["points"]
    reached = sum(counts.get(s, 0) for s in words.SETTLED)
    verdict_words = words.VERDICTS.get((model, "converged"), "have an operating point")
    return Document(
        f"Sweep of {count_noun(total, 'point')}",
        f"{count_noun(total, 'point')}: {reached:,} {verdict_words}.",
        (
            run_tables.note_on_robot(file, model, f"All points are in `{STORE}`."),
            run_tables.endings_table(counts, "points", model),
        ),
        page_sections=lambda: _sections(store, layout, result["outputs"]),
    )


def _sections(store: Path, layout: StoreLayout, extremes: Json) -> Iterable[Section]:
    values, points = sample_points(store, layout)
    yield Section("What varies", (_varied_rows(layout, values),), "varied")
    if VERDICT in points:
        codes, design = points[VERDICT].astype(int), layout.design
        meanings = layout.variables[VERDICT][1]["flag_meanings"].split()
        rows = [(f"`{meanings[k]}`", int((codes == k).sum()), *VERDICTS[meanings[k]]) for k in np.unique(codes)]
        others = [n for n in design.axes if n != SIZE and len(design.axes[n]) > 1][:1]
        figure = catalogue.figure("campaign.endings", codes, meanings, values, layout, *others)  # fmt: skip
        figures = (figure,) * bool(others and SIZE in design.axes)
        yield Section(
            "How the climbs ended",
            (
                Note(_largest_obstacle(values, points, layout), "answer", "largest"),
                catalogue.table("campaign.endings", rows),
                *figures,
            ),
            "verdicts",
        )
    yield Section("What came out", tuple(_outputs(values, points, layout, extremes)), "outputs")


def _outputs(values: np.ndarray, found: Columns, layout: StoreLayout, extremes: Json) -> Iterable[Block]:
    """Section on the outputs, with extremes and quantiles. The first ones are drawn."""
    settled = np.isin(found[STATUS], signals.DONE)
    rows, figures = list[tuple[Any, ...]](), list[Figure]()
    for name, (_, attributes) in layout.variables.items():
        if "units" not in attributes:
            continue
        label, unit = attributes["long_name"], attributes["units"].removeprefix("1")
        usable = settled & np.isfinite(found[name])
        numbers = found[name][usable].astype(float)
        quantiles = np.quantile(numbers, (0.05, 0.5, 0.95)) if len(numbers) else [None] * 3
        rows.append((label, unit, extremes[name]["least"], *quantiles, extremes[name]["greatest"]))
        if len(numbers) and len(figures) < DRAWN:
            spread = catalogue.figure(
                "campaign.spread", numbers, Column(label, unit).title, values[usable], layout,
                finding=f"{label} against the inputs", words=(label.capitalize(),),
            )  # fmt: skip
            figures.append(dataclasses.replace(spread, name=f"spread_{name}"))
    suffix = "" if len(values) == layout.design.points else " drawn at random"
    yield catalogue.note("campaign.thinned", len(values), suffix)
    yield catalogue.table("campaign.ranges", rows)
    yield from figures


def _largest_obstacle(values: np.ndarray, found: Columns, layout: StoreLayout) -> str:
    """Largest obstacle climbed and its first point, in words."""
    names = layout.design.names
    sizes = found[LARGEST] if LARGEST in found else values[:, names.index(SIZE)] * (found[VERDICT] == OVER)
    k = int(np.argmax(sizes))
    if sizes[k] <= 0:
        return "The robot gets over no obstacle."
    places = []
    for name, value in zip(names, values[k], strict=True):
        labels, unit = layout.labels.get(name), layout.coordinates[name].get("units", "").removeprefix("1")
        places.append(f"{name} {labels[int(value)] if labels else f'{value:.4g} {unit}'.strip()}")
    rest = ", ".join(words for name, words in zip(names, places, strict=True) if name != SIZE)
    return f"The largest obstacle that the robot gets over: {sizes[k]:.4g} mm{', at ' if rest else ''}{rest}."


def sample_points(store: Path, layout: StoreLayout) -> tuple[np.ndarray, Columns]:
    """Random selection of the points, always the same.

    Returns:
        Varied values, shape (points, names), and outputs by name.
    """
    import zarr

    group: Any = zarr.open_group(store, mode="r")
    rng, blocks = np.random.default_rng(0), layout.blocks
    chunks = np.sort(rng.permutation(len(blocks))[:CHUNKS])
    points_per_chunk = -(-THINNED // len(chunks))
    values: list[np.ndarray] = []
    values_by_name: dict[str, list[np.ndarray]] = {name: [] for name in layout.variables}
    for chunk in map(int, chunks):
        box, count = blocks.box(chunk), blocks.count(chunk)
        rows = np.sort(rng.permutation(count)[:points_per_chunk]) if count > points_per_chunk else np.arange(count)
        values.append(layout.design.values_in_slices(box)[rows])
        for name, parts in values_by_name.items():
            parts.append(group[name][box].ravel()[rows])
    return np.concatenate(values), {name: np.concatenate(parts) for name, parts in values_by_name.items()}


def _varied_rows(layout: StoreLayout, values: np.ndarray) -> Table:
    """Varied names in words, one row for each."""
    rows = []
    for k, name in enumerate(layout.design.names):
        about = layout.coordinates[name]
        axis, labels = layout.design.axes.get(name), layout.labels.get(name)
        if axis is None:
            low, high = values[:, k].min(), values[:, k].max()
            text = f"{layout.design.shape[-1]:,} samples, {low:.4g} to {high:.4g}"
        elif labels is not None:
            text = ", ".join(labels[int(v)] for v in axis)
        elif len(axis) <= 8:
            text = ", ".join(f"{v:.4g}" for v in axis)
        else:
            text = f"{axis.min():.4g} to {axis.max():.4g}, {len(axis):,} values"
        rows.append((f"`{name}`", about["long_name"], about.get("units", "").removeprefix("1"), text))
    return catalogue.table("campaign.names", rows)
