"""Sizing: time of a search after compilation, and its optimum compared with a grid of designs of the same choices.

    python benchmarks/sizing.py --grid 1000000

The grid has every drive, cell and number of cells, with as many ratios, radii and parallel cells as fit.
"""

from __future__ import annotations

import argparse
import time

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from calibration.data import requirements_file  # noqa: E402
from calibration.sizing import design_search  # noqa: E402
from calibration.sizing.design import OBJECTIVES, build_sizing_task  # noqa: E402
from calibration.sizing.part_options import options_for_robot  # noqa: E402
from mmrjax.model import paper_robots  # noqa: E402


def grid(objective: str, points: int, kept: np.ndarray) -> tuple[float, int, float]:
    """The best feasible objective of a grid, its number of designs, and seconds."""
    robot, asked = paper_robots.nominal(), requirements_file.load_requirements(None)
    chosen = options_for_robot(robot)
    of = build_sizing_task(robot, asked, chosen)
    choice = design_search.enumerate_choices(robot, of, chosen)
    n = len(choice.drive)
    along = max(2, round((points / n) ** (1 / 3)))
    counts = (max(2, round(points / n / along**2)), along, along)
    box = np.stack(np.meshgrid(*(np.linspace(0, 1, k) for k in counts), indexing="ij"), -1).reshape(-1, 3)
    column, best, seen = list(OBJECTIVES).index(objective), np.inf, 0
    begin = time.perf_counter()
    for rows in np.array_split(np.arange(n), max(1, n // 200)):
        every = np.repeat(rows, len(box))
        x = choice.low[every] + (choice.high[every] - choice.low[every]) * np.tile(box, (len(rows), 1))
        f, g = design_search.evaluate_designs(of, choice, every, x)
        good = np.all(g[:, kept] >= 0, axis=1) & np.isfinite(f[:, column])
        best, seen = min(best, float(f[good, column].min(initial=np.inf))), seen + len(every)
    return best, seen, time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--grid", type=int, default=1_000_000)
    parser.add_argument("--objective", default="mass", choices=list(OBJECTIVES))
    given = parser.parse_args()
    robot, asked = paper_robots.nominal(), requirements_file.load_requirements(None)
    for words in ("with compilation", "once compiled"):
        begin, busy = time.perf_counter(), time.process_time()
        found = design_search.size_robot(robot, asked, (given.objective,))
        seconds, busy = time.perf_counter() - begin, time.process_time() - busy
        print(f"{found.evaluated} designs, {words}: {seconds:.1f} s, {busy:.1f} s of processors")
    assert found.ideal is not None and found.best is not None
    kept = np.array([label not in found.unmeetable for label in found.task.labels])
    best, seen, seconds = grid(given.objective, given.grid, kept)
    unit = OBJECTIVES[given.objective][0]
    ideal, real = (f.objectives[given.objective] for f in (found.ideal, found.best))
    print(f"grid of {seen} designs: {best:.5g} {unit} in {seconds:.1f} s; the search: {ideal:.5g} {unit}")
    print(f"with ratios of the sheets and whole cells: {real:.5g} {unit}")
    print("no worse than the grid" if ideal <= best else "WORSE than the grid")


if __name__ == "__main__":
    main()
