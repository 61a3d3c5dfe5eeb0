"""Report of a sweep into a store: status of the points, outputs, and what they depend on."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Columns, Json
from calibration.data.robot_file import RobotFile
from mmrjax.climbing.climb_simulation import OVER
from mmrjax.errors import count_noun
from mmrjax.fidelities.variation import STATUS
from mmrjax.model import signals
from sweeps.pages import words
from sweeps.points.climbs import LARGEST, SIZE, VERDICT
from sweeps.points.zarr_store import STORE, StoreLayout
from sweeps.report import catalogue, run_tables
from sweeps.report.climb_report import VERDICTS
from sweeps.report.document import Block, Column, Document, Figure, Note, Section, Table

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
