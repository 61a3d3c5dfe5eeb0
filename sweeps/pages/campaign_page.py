"""The page of a sweep into a store: how the points ended, what came out, and what it follows."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.robot_file import RobotFile
from mmrjax.climbing.climb_simulation import OVER
from mmrjax.errors import count_noun
from mmrjax.fidelities.variation import STATUS
from mmrjax.model import signals
from sweeps.pages import campaign_figures, words
from sweeps.pages.campaign_figures import Varied
from sweeps.pages.page import Album, render_page, robot_section
from sweeps.points.climbs import LARGEST, SIZE, VERDICT
from sweeps.points.zarr_store import STORE, Layout
from sweeps.results.climb_results import VERDICTS

#: Points, and chunks that they come from, that figures and quantiles are made of; outputs that are drawn.
THINNED, CHUNKS, DRAWN = 200_000, 100, 6


def write_campaign_page(folder: Path, file: RobotFile, layout: Layout, result: dict[str, Any]) -> Path:
    """Write `report.html` and `figures/` for a store whose every chunk is done.

    Args:
        folder: that holds the store; file: of the robot that was varied.
        result: `result.json`.
    """
    values, found = sample_points(folder / STORE, layout)
    album = Album(folder)
    total = result["points"]
    statuses = [
        {
            "name": s,
            "count": n,
            "percent": 100 * n / total,
            "meaning": words.VERDICTS.get((result["model"], s)) or words.status_meaning(s),
        }
        for s, n in result["statuses"].items()
        if n
    ]
    return render_page(
        folder,
        "campaign.html.j2",
        album,
        title=f"Sweep of {count_noun(total, 'point')}",
        model=result["model"],
        total=total,
        status=statuses,
        varied=_varied(layout, values),
        outputs=_outputs(album, values, found, layout, result["outputs"]),
        verdicts=_verdicts(album, values, found, layout),
        largest=_largest(values, found, layout),
        thinned=len(values),
        **robot_section(file),
    )


def _outputs(
    album: Album, values: np.ndarray, found: dict[str, np.ndarray], layout: Layout, extremes: dict[str, Any]
) -> list[dict[str, Any]]:
    """Rows of the table of outputs, each with its extremes and quantiles; the first of them are drawn."""
    known, settled = layout.coordinates, np.isin(found[STATUS], signals.DONE)
    rows = []
    for variable in (v for v in layout.variables if "units" in v.attributes):
        name, unit, label = variable.name, variable.attributes["units"], variable.attributes["long_name"]
        usable = settled & np.isfinite(found[name])
        numbers = found[name][usable].astype(float)
        quantiles = np.quantile(numbers, (0.05, 0.5, 0.95)) if len(numbers) else np.full(3, np.nan)
        ends = {k: np.nan if extremes[name][k] is None else extremes[name][k] for k in ("least", "greatest")}
        rows.append({"name": name, "label": label, "unit": unit, **ends, "quantiles": quantiles.tolist()})
        if len(numbers) and len(album.pictures) < DRAWN:
            varied = {
                n: Varied(values[usable, k], _label(n, known[n].get("units", "")), layout.labels.get(n, ()))
                for k, n in enumerate(layout.design.names)
            }
            album.add(
                f"spread_{name}", partial(campaign_figures.draw_output_spread, numbers, _label(label, unit), varied)
            )
    return rows


def _verdicts(album: Album, values: np.ndarray, found: dict[str, np.ndarray], layout: Layout) -> list[dict[str, Any]]:
    """Number of climbs by outcome, a row each; drawn over the obstacle's size and the first other axis."""
    if VERDICT not in found:
        return []
    codes, known, design = found[VERDICT].astype(int), layout.coordinates, layout.design
    meanings = next(v.attributes for v in layout.variables if v.name == VERDICT)["flag_meanings"].split()
    pair = [n for n in design.axes if n != SIZE and len(design.axes[n]) > 1][:1]
    if pair and SIZE in design.axes:
        # of what else varies the first values
        rest = [k for k, n in enumerate(design.names) if n not in (SIZE, *pair)]
        shown = np.all(values[:, rest] == [design.axes[design.names[k]][0] for k in rest], axis=1)
        across, up = (
            Varied(
                values[shown, design.names.index(n)],
                _label(known[n]["long_name"].split(",")[0], known[n].get("units", "")),
            )
            for n in (*pair, SIZE)
        )
        album.add("endings", partial(campaign_figures.draw_grid_statuses, codes[shown], meanings, across, up))
    rows = []
    for k in np.unique(codes):
        short, meaning = VERDICTS[meanings[k]]
        rows.append({"name": meanings[k], "count": int((codes == k).sum()), "short": short, "meaning": meaning})
    return rows


def _largest(values: np.ndarray, found: dict[str, np.ndarray], layout: Layout) -> str:
    """Largest obstacle climbed and its first point, in words; empty for other sweeps."""
    if VERDICT not in found:
        return ""
    names = layout.design.names
    sizes = found[LARGEST] if LARGEST in found else values[:, names.index(SIZE)] * (found[VERDICT] == OVER)
    k = int(np.argmax(sizes))
    if sizes[k] <= 0:
        return "No obstacle is got over."
    at = []
    for name, value in zip(names, values[k], strict=True):
        labels, unit = layout.labels.get(name), layout.coordinates[name].get("units", "").removeprefix("1")
        at.append(f"{name} {labels[int(value)] if labels else f'{value:.4g} {unit}'.strip()}")
    rest = ", ".join(words for name, words in zip(names, at, strict=True) if name != SIZE)
    return f"The largest obstacle that is got over: {sizes[k]:.4g} mm{', at ' if rest else ''}{rest}."


def _label(name: str, unit: str) -> str:
    return name if unit in ("", "1") else f"{name} [{unit}]"


def sample_points(store: Path, layout: Layout) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Some of the points, at random and always the same ones.

    Returns:
        Values of what varies, shape (points, names), and outputs by name.
    """
    import zarr

    group: Any = zarr.open_group(store, mode="r")
    rng, blocks = np.random.default_rng(0), layout.blocks
    chunks = np.sort(rng.permutation(len(blocks))[:CHUNKS])
    each = -(-THINNED // len(chunks))
    values: list[np.ndarray] = []
    found: dict[str, list[np.ndarray]] = {v.name: [] for v in layout.variables}
    for chunk in map(int, chunks):
        box, count = blocks.box(chunk), blocks.count(chunk)
        rows = np.sort(rng.permutation(count)[:each]) if count > each else np.arange(count)
        values.append(layout.design.block(box)[rows])
        for variable in layout.variables:
            found[variable.name].append(group[variable.name][box].ravel()[rows])
    return np.concatenate(values), {name: np.concatenate(parts) for name, parts in found.items()}


def _varied(layout: Layout, values: np.ndarray) -> list[dict[str, Any]]:
    """Varied names, in words, a row each."""
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
        rows.append({"name": name, "meaning": about["long_name"], "unit": about.get("units", ""), "values": text})
    return rows
