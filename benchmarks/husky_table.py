"""Settled turns of the Husky's runs, and regressions on them.

    python benchmarks/husky_table.py husky_turning.csv    write docs/rigs/husky/husky.csv from the runs' samples
    python benchmarks/husky_table.py --regressions        errors of regressions on that table, each run held out
    python benchmarks/husky_table.py --result FOLDER      the same for a calibration, by surface

Means over windows of 2 s with a wheel faster than 50 mm/s. No wheel speed has a standard deviation above 16 mm/s, two
steps of its instrument. At most 12 windows of each run, spread over its yaw rates.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import turning_data as study

TABLE = Path(__file__).resolve().parents[1] / "docs" / "rigs" / "husky" / "husky.csv"
STEADY, MOVES, OF_RUN = 0.016, 0.05, 12  # [m/s], [m/s], most rows of a run


def settled(samples: study.Table) -> list[np.ndarray]:
    """Samples of each selected window."""
    speeds, _, yaw = study.sides(samples)
    found = []
    for run in np.unique(samples["run_id"]):
        mine = [rows for rows in study.windows(samples) if samples["run_id"][rows[0]] == run]
        steady = [
            rows
            for rows in mine
            if speeds[:, rows].std(1).max() < STEADY and np.abs(speeds[:, rows].mean(1)).max() > MOVES
        ]
        steady.sort(key=lambda rows: yaw[rows].mean())
        rates = np.array([yaw[rows].mean() for rows in steady])
        if len(steady) > OF_RUN:  # nearest to equally spaced rates
            picked = {int(np.argmin(np.abs(rates - r))) for r in np.linspace(rates[0], rates[-1], OF_RUN)}
            steady = [steady[k] for k in sorted(picked)]
        found += steady
    return found


def write(source: Path) -> None:
    samples = study.read(source)
    lines = ["surface,run_id,time_of_run_s," + ",".join(COLUMNS)]
    for rows in settled(samples):
        first = rows[0]
        means = [samples[c][rows].mean() for c in COLUMNS]
        labels = samples["surface"][first], samples["run_id"][first], f"{samples['time_s'][first]:.1f}"
        lines.append(",".join((*labels, *(f"{x:.4f}" for x in means))))
    TABLE.write_text("\n".join(lines) + "\n")
    print(f"{TABLE}: {len(lines) - 1} rows")


COLUMNS = (
    "current_left_A", "current_right_A", "wheel_speed_left_m_s", "wheel_speed_right_m_s", "yaw_rate_rad_s",
)  # fmt: skip


def regressions() -> None:
    table = study.read(TABLE)
    _, currents, _ = study.sides(table)
    for basis in ("linear", "tanh", "yaw", "wheels"):
        for ridge in (1e-3, 1e-2, 1e-1):
            error = study.regressed(table, basis, ridge) - currents
            print(json.dumps({"regression": basis, "ridge": ridge, "currents": by_surface(error, currents, table)}))


def by_surface(error: np.ndarray, size: np.ndarray, table: study.Table) -> list[float]:
    """Rms of the errors over rms of the readings [%], of each surface and of all."""
    return [*study.by_surface(error, size, table["surface"]), study.percent(error, size)]


def result(folder: Path) -> None:
    """Errors of the rows of a calibration, fitted and held out by run."""
    rows = study.read(folder / "rows.csv", words=("surface", "run_id", "configuration", "status"))
    pair = ("motor_current_left_A", "motor_current_right_A")
    currents = np.stack([rows[c] for c in pair])
    for word in ("after", "held_out"):
        error = np.stack([rows[f"{word}_{c}"] for c in pair]) - currents
        turned = rows[f"{word}_yaw_rate_rad_s"] - rows["yaw_rate_rad_s"]
        print(
            json.dumps(
                {
                    word: "balance",
                    "currents": by_surface(error, currents, rows),
                    "yaw": by_surface(turned, rows["yaw_rate_rad_s"], rows),
                }
            )
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("table", type=Path, nargs="?", help="samples of the runs, to write the table from")
    what.add_argument("--regressions", action="store_true", help="print errors of regressions on the table")
    what.add_argument("--result", type=Path, metavar="FOLDER", help="print figures of a run folder")
    given = parser.parse_args()
    if given.regressions:
        regressions()
    elif given.result:
        result(given.result)
    else:
        write(given.table)
