"""Reports of sweeps: statuses, exceeded limits and channels of a grid, and the points of a store."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calibration.data import Columns, Json
from calibration.data.robot_file import RobotFile
from mmrjax.climbing.climb_simulation import OVER
from mmrjax.errors import count_noun
from mmrjax.fidelities.variation import STATUS
from mmrjax.model import signals
from sweeps import capabilities
from sweeps.pages import words
from sweeps.points import zarr_store
from sweeps.points.tasks import LARGEST, SIZE, VERDICT
from sweeps.report import catalogue, run_tables
from sweeps.report.climb_report import VERDICTS
from sweeps.report.document import Block, Column, Document, Figure, Note, Section, Table, remarks
from sweeps.report.run_tables import imposed_column, quantity_column


class VariedQuantity(NamedTuple):
    """A quantity that varies: its values at the drawn points, its label with unit, and words for the values if it has
    any.
    """

    values: np.ndarray
    label: str
    words: tuple[str, ...] = ()


def sweep_document(file: RobotFile, model: str, runs: Columns, notes: Sequence[str] = ()) -> Document:
    """Report of a finished sweep."""
    applicable_runs = capabilities.drop_inapplicable_columns(file.robot, runs)
    statuses = Counter(map(str, runs["status"]))
    is_flagged = runs["flags"] != ""
    flagged_by_status = {status: int(((runs["status"] == status) & is_flagged).sum()) for status in statuses}
    ranges_by_status = {
        status: "" if status in words.SETTLED else _ranges_of_runs(runs, runs["status"] == status)
        for status in statuses
    }
    maps = [
        catalogue.figure(
            "sweep.sweep",
            runs,
            channel,
            finding=f"{channel.label} over the grid",
            words=(channel.label.capitalize(), channel.unit),
            suffix=channel.name,
        )
        for channel in file.robot.channels
    ]
    axes = "; ".join(_levels(runs, name) for name in _axes(runs))
    extreme_columns = (*(channel.column for channel in file.robot.channels), "slip", "winding_settled_C")
    flag_sets, flag_index = np.unique(runs["flags"], return_inverse=True)
    rows = []
    for flag, meaning in words.FLAGS.items():
        is_raised = np.array([flag in str(f).split(";") for f in flag_sets])[flag_index]
        if is_raised.any():
            rows.append((f"{meaning} (`{flag}`)", int(is_raised.sum()), _ranges_of_runs(runs, is_raised)))
    return Document(
        f"Sweep of {count_noun(len(runs['status']), 'run')}",
        sweep_answer(runs),
        (
            run_tables.note_on_robot(file, model, f"Varied: {axes}."),
            run_tables.endings_table(statuses, beyond_a_limit=flagged_by_status, where=ranges_by_status),
            catalogue.table("sweep.limits", rows),
            _extremes(applicable_runs, extreme_columns),
            *remarks(notes),
        ),
        (Section("Over the grid", (catalogue.note("sweep.maps"), *maps), "maps"),),
    )


def sweep_answer(runs: Columns) -> str:
    """One sentence: number of runs with an operating point, and of those within all limits."""
    total = len(runs["status"])
    settled = np.isin(runs["status"], words.SETTLED)
    flags = runs["flags"][settled & (runs["flags"] != "")]
    verb = "has" if 1 in (total, settled.sum()) else "have"
    first_part = f"{settled.sum()} of {count_noun(total, 'run')} {verb} an operating point"
    if not len(flags):
        return f"{first_part}, all within every limit." if settled.any() else f"{first_part}."
    ((most_frequent, count),) = Counter(flag for f in flags for flag in str(f).split(";")).most_common(1)
    return (
        f"{first_part}. {len(flags)} of them {'exceeds' if len(flags) == 1 else 'exceed'} a limit. Most often, "
        f"{words.FLAGS.get(most_frequent, most_frequent)} ({count_noun(count, 'run')})."
    )


def _axes(runs: Columns) -> list[str]:
    """Columns of the grid's axes: on the battery without voltage, and without readings."""
    axes = ("configuration", imposed_column(runs), "payload_kg", "slope_deg", "load_torque_Nm")
    return [c for c in axes if c in runs and (runs[c].dtype.kind not in "fiu" or not np.isnan(runs[c]).all())]


def _levels(runs: Columns, name: str, rows: np.ndarray | slice = slice(None), max_listed: int = 8) -> str:
    """Values of an axis for the selected runs, in words: `slope 0, 10°`."""
    values = runs[name][rows]
    column = quantity_column(name)
    levels = np.unique(values)
    if levels.dtype.kind not in "fiu":
        return ", ".join(dict.fromkeys(map(str, values)))
    unit = column.unit if column.unit == "°" else f" {column.unit}"
    if levels.size > max_listed:
        return f"{column.heading} {levels[0]:.3g} to {levels[-1]:.3g}{unit} ({levels.size} values)"
    return f"{column.heading} {', '.join(f'{v:.4g}' for v in levels)}{unit}"


def _ranges_of_runs(runs: Columns, rows: np.ndarray) -> str:
    """Ranges of slope and imposed quantity for the selected runs, by configuration, in words."""
    parts = []
    for configuration in dict.fromkeys(map(str, runs["configuration"][rows])):
        rows_here = rows & (runs["configuration"] == configuration)
        names = [
            c for c in ("slope_deg", imposed_column(runs)) if c in runs and not np.isnan(runs[c][rows_here]).all()
        ]
        ranges = "; ".join(_levels(runs, c, rows_here, 4) for c in names)
        parts.append(f"{int(rows_here.sum())} of {configuration} ({ranges})")
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


#: Most outputs that are drawn.
DRAWN = 6


def campaign_document(file: RobotFile, layout: zarr_store.StoreLayout, result: Json, store: Path) -> Document:
    """Report of a complete store.

    Args:
        result: `result.json`.
        store: folder of the store.
    """
    counts, model, total = result["statuses"], result["model"], result["points"]
    solved_points = sum(counts.get(s, 0) for s in words.SETTLED)
    verdict_phrase = words.VERDICTS.get((model, "converged"), "have an operating point")
    return Document(
        f"Sweep of {count_noun(total, 'point')}",
        f"{count_noun(total, 'point')}: {solved_points:,} {verdict_phrase}.",
        (
            run_tables.note_on_robot(file, model, f"All points are in `{zarr_store.STORE}`."),
            run_tables.endings_table(counts, "points", model),
        ),
        page_sections=lambda: _sections(store, layout, result["outputs"]),
    )


def _sections(store: Path, layout: zarr_store.StoreLayout, extremes: Json) -> Iterable[Section]:
    values, points = zarr_store.sample_store(store, layout)
    varied = {
        name: VariedQuantity(column, Column(name, _unit(layout, name)).title, layout.labels.get(name, ()))
        for name, column in values.items()
    }
    yield Section("What varies", (_varied_rows(layout, varied),), "varied")
    if VERDICT in points:
        codes = points[VERDICT].astype(int)
        axes = layout.design.axes
        meanings = layout.variables[VERDICT][1]["flag_meanings"].split()
        rows = [(f"`{meanings[k]}`", int((codes == k).sum()), *VERDICTS[meanings[k]]) for k in np.unique(codes)]
        blocks: list[Block] = [
            Note(_largest_obstacle(varied, points), "answer", "largest"),
            catalogue.table("campaign.endings", rows),
        ]
        first_axis = next(
            (name for name in layout.design.names if name != SIZE and name in axes and len(axes[name]) > 1), None
        )
        if first_axis is not None and SIZE in axes:
            others = (
                q.values == axes.get(name, q.values)[0]
                for name, q in varied.items()
                if name not in (SIZE, first_axis)
            )
            is_drawn = np.all([np.ones(len(codes), bool), *others], axis=0)
            drawn_quantities = (_at_points(varied, is_drawn)[name] for name in (first_axis, SIZE))
            blocks.append(catalogue.figure("campaign.endings", codes[is_drawn], meanings, *drawn_quantities))
        yield Section("How the climbs ended", tuple(blocks), "verdicts")
    yield Section("What came out", tuple(_outputs(varied, points, layout, extremes)), "outputs")


def _at_points(varied: Mapping[str, VariedQuantity], rows: np.ndarray) -> dict[str, VariedQuantity]:
    return {name: quantity._replace(values=quantity.values[rows]) for name, quantity in varied.items()}


def _outputs(
    varied: Mapping[str, VariedQuantity], points: Columns, layout: zarr_store.StoreLayout, extremes: Json
) -> Iterable[Block]:
    """Section on the outputs, with extremes and quantiles. The first ones are drawn."""
    settled = np.isin(points[STATUS], signals.DONE)
    rows = list[tuple[Any, ...]]()
    figures = list[Figure]()
    for name, (_, attributes) in layout.variables.items():
        if "units" not in attributes:
            continue
        label = attributes["long_name"]
        unit = attributes["units"].removeprefix("1")
        is_usable = settled & np.isfinite(points[name])
        numbers = points[name][is_usable].astype(float)
        quantiles = np.quantile(numbers, (0.05, 0.5, 0.95)) if len(numbers) else [None] * 3
        rows.append((label, unit, extremes[name]["least"], *quantiles, extremes[name]["greatest"]))
        if len(numbers) and len(figures) < DRAWN:
            drawing = numbers, Column(label, unit).title, _at_points(varied, is_usable)
            figures.append(
                catalogue.figure(
                    "campaign.spread", *drawing, finding=f"{label} against the inputs", words=(label.capitalize(),),
                    suffix=name,
                )
            )  # fmt: skip
    suffix = "" if len(settled) == layout.design.points else " drawn at random"
    yield catalogue.note("campaign.thinned", len(settled), suffix)
    yield catalogue.table("campaign.ranges", rows)
    yield from figures


def _largest_obstacle(varied: Mapping[str, VariedQuantity], points: Columns) -> str:
    """Largest obstacle climbed and its first point, in words."""
    sizes = points[LARGEST] if LARGEST in points else varied[SIZE].values * (points[VERDICT] == OVER)
    k = int(np.argmax(sizes))
    if sizes[k] <= 0:
        return "The robot gets over no obstacle."
    conditions = []
    for name, quantity in varied.items():
        if name != SIZE:
            value = quantity.values[k]
            unit = quantity.label.removeprefix(name).strip(" []")
            value_text = quantity.words[int(value)] if quantity.words else f"{value:.4g} {unit}".strip()
            conditions.append(f"{name} {value_text}")
    place_text = f", at {', '.join(conditions)}" if conditions else ""
    return f"The largest obstacle that the robot gets over: {sizes[k]:.4g} mm{place_text}."


def _unit(layout: zarr_store.StoreLayout, name: str) -> str:
    """Unit of a varied quantity, empty for a number without one."""
    return str(layout.coordinates[name].get("units", "").removeprefix("1"))


def _varied_rows(layout: zarr_store.StoreLayout, varied: Mapping[str, VariedQuantity]) -> Table:
    """Varied names in words, one row for each."""
    rows = []
    for name, quantity in varied.items():
        axis = layout.design.axes.get(name)
        if axis is None:
            low, high = quantity.values.min(), quantity.values.max()
            text = f"{layout.design.shape[-1]:,} samples, {low:.4g} to {high:.4g}"
        elif quantity.words:
            text = ", ".join(quantity.words[int(v)] for v in axis)
        elif len(axis) <= 8:
            text = ", ".join(f"{v:.4g}" for v in axis)
        else:
            text = f"{axis.min():.4g} to {axis.max():.4g}, {len(axis):,} values"
        rows.append((f"`{name}`", layout.coordinates[name]["long_name"], _unit(layout, name), text))
    return catalogue.table("campaign.names", rows)
