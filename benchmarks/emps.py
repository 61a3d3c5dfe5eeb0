"""The EMPS benchmark: a carriage on a ball screw, from its training record to the free-run error on its test record.

    python benchmarks/emps.py --data DIR [--out docs/lab/emps.md]

`DIR` holds `train.csv` and `test.csv` (`time_s`, `force_N`, `position_m`, 24 841 rows at 1 kHz).
`docs/rigs/public/emps.toml` states what a user knows before any fit: the force acts on the carriage, and rough
magnitudes. `mmrjax inspect` and `mmrjax loop` see the training record alone. Then each robot file of the run folder
is simulated freely over the test record from its first 20 samples. The loop does not see the result.

Source: A. Janot, M. Gautier, M. Brunot, Data Set and Reference Models of EMPS, Workshop on Nonlinear System
Identification Benchmarks, Eindhoven, 2019.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

#: Samples that a free run may begin from.
FIRST = 20
#: Wall-clock limit of the loop. A loaded core needs more than its usual ten minutes.
LONGEST = "40min"
#: The robot's file.
ROBOT = Path(__file__).parents[1] / "docs" / "rigs" / "public" / "emps.toml"
#: Free-run errors of others on the same split [mm], and their sources.
PUBLISHED = (
    ("GRU, LSTM", "220, 74", "Champneys et al. 2024, IFAC-PapersOnLine 58-15"),
    ("linear state space, pNARX", "5.53, 5.17", "the same"),
    ("structure chosen by a language-model agent, 15 runs of half an hour", "4.10", "Piga and Forgione 2026"),
    ("dynoNet", "2.64", "Forgione and Piga 2021"),
    (
        "mass, Coulomb and viscous friction, offset, by least squares on the simulated position",
        "4.9 to 5.0",
        "independent fit",
    ),
    (
        "viscous friction by direction, by least squares on the simulated position; with an offset in addition",
        "6.6, 4.4",
        "independent fit",
    ),
)
COMMAND = "import sys; from sweeps.cli import main; sys.exit(main())"


def command(*arguments: str) -> tuple[str, float]:
    """Output of an mmrjax command, and its seconds."""
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", COMMAND, *arguments], capture_output=True, text=True, check=False)
    return done.stdout + done.stderr, time.perf_counter() - began


def free_run(robot_file: Path, record: Path) -> float:
    """Rms error of the position of a free run, after the samples that it begins from [mm]."""
    from calibration.data import robot_file as files
    from calibration.data import runs as records
    from calibration.inference.preparation import prepare_input
    from mmrjax.compile.compiling import in_double
    from sweeps.points.run import simulate_histories

    @in_double
    def error() -> float:
        robot = files.read_robot(robot_file)
        runs = records.read_runs(str(record), robot=robot)
        shown = simulate_histories(prepare_input(runs, robot).robot, runs, None)
        off = np.asarray(shown["position_mm"]) - np.asarray(runs["position_mm"])
        return float(np.sqrt(np.mean(off[FIRST:] ** 2)))

    return error()


def parameters(robot_file: Path) -> list[str]:
    """Lines of a robot's file that state its carriage, delay and effects, without zeros."""
    tables = robot_file.read_text(encoding="utf-8").split("\n[")
    fitted = [t for t in tables if t.startswith(("carriage", "rig", "effects"))]
    return [
        line for t in fitted for line in f"[{t}".splitlines() if line and not line.split(" = ")[-1].startswith("0.0 ")
    ]


def page(folder: Path, listing: str, seconds: float, record: Path) -> str:
    """The page of the lab."""
    found = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    files = sorted(p for p in folder.glob("*.toml") if not p.name.startswith("config"))
    scores = [(p.name, free_run(p, record)) for p in files]
    effects = [
        f"* `{e['name']}`{', ' + e['standing'] if 'standing' in e else ''}: {', or '.join(e['families'])}"
        for e in found["effects"]
    ]
    rows = [f"| `{name}` below | {error:.2f} | this run |" for name, error in scores]
    rows += [f"| {name} | {error} | {source} |" for name, error, source in PUBLISHED]
    fitted = [f"## `{p.name}`\n\n```toml\n" + "\n".join(parameters(p)) + "\n```\n" for p in files]
    return "\n".join(
        [
            "# EMPS: a public benchmark\n",
            "EMPS is a public record of a carriage on a ball screw: force and position, 24 841 rows at 1 kHz, with "
            "an official division into training and test data (Janot, Gautier and Brunot 2019). "
            "`python benchmarks/emps.py --data DIR` made this page. The loop does not see `test.csv`. "
            "Its windows leave out speeds below 2 % of the largest, a limit set on generated logs. With 1, 2, 3 and "
            "4 %, the error on `test.csv` is 8.7, 4.1, 6.9 and 6.8 mm. Errors of an earlier version (4.6, 3.7, 3.8 "
            "and 7.6 mm) were known when the limit was set.\n",
            f"**{found['headline']['statement']}** The command took {seconds:.0f} s. The model contains:\n",
            *effects,
            "",
            "| model | rms error of a free simulation of `test.csv` [mm] | source |",
            "|---|---|---|",
            *rows,
            "",
            *fitted,
            "Fits with friction by direction that are wrong by 1.6 to 1.9 mm on `train.csv` are wrong by 3.4 to 9.2 "
            "mm on `test.csv`. So most of the difference between such models is chance.\n",
            "## `mmrjax inspect train.csv`\n\n```\n" + listing.strip() + "\n```\n",
        ]
    )


def main() -> int:
    """Runs the benchmark. Returns the exit code of the loop."""
    wanted = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    wanted.add_argument("--data", type=Path, required=True)
    wanted.add_argument("--out", type=Path, default=Path("docs/lab/emps.md"))
    wanted.add_argument("--runs", type=Path, help="keeps the run folder here")
    given = wanted.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.runs or Path(scratch) / "loop"
        train = str(given.data / "train.csv")
        listing, _ = command("inspect", train)
        told, seconds = command(
            "loop", train, "--robot", str(ROBOT), "--out", str(folder), "--force", "--no-report", "--within", LONGEST
        )
        print(told)
        if not (folder / "result.json").exists():
            return 1
        given.out.write_text(page(folder, listing, seconds, given.data / "test.csv"), encoding="utf-8")
    print(given.out.read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
