"""The closed loop on synthetic time histories: false findings, right names, discrepancies without one.

    python benchmarks/loop_series.py --clean 16 --library 30 --outside 16 --pairs 8 --jobs 2

Six starts of 1.5 s each from `tests/generator_series.py`, which shares nothing with the simulator; labels are read
by the scorer alone. Every table is one line of `--out`, and a run that is started again goes on where it ended.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import generator as g
import generator_series as gs
from loop import EQUATION, SIZES, campaign, interval, located, robot_of

KINDS = ("clean", "library", "outside", "pairs")
#: Effects of these histories; `thermal_drift` and `battery_sag` need longer ones and a battery.
LIBRARY = (
    "pulley_eccentricity", "grouser_polygon", "rotating_inertia", "series_resistance", "churning",
    "armature_inductance", "cogging", "stick_slip",
)  # fmt: skip
OUTSIDE = ("pulley_ovality", "belt_splice", "supply_recovery", "oil_warming")
#: The analyst's priors on the surface, which Table 5 does not know.
STATED = {
    f"{c}.ground.friction.{name}": prior
    for c in ("6T2A", "4W2T")
    for name, prior in (("static", (0.6, 0.09)), ("dynamic", (0.48, 0.08)))
}


def make(kind: str, seed: int) -> tuple[dict, dict] | None:
    """Table and label of a kind and a seed; None where the effect would have to be absurdly large.

    Every constant that has a tolerance is perturbed, and refitted when the effect is sized, as in the loop.
    """
    rng = np.random.default_rng([10 + KINDS.index(kind), seed])
    names = {
        "clean": [], "library": [LIBRARY[seed % len(LIBRARY)]], "outside": [OUTSIDE[seed % len(OUTSIDE)]],
        "pairs": list(rng.choice(LIBRARY[:5], 2, replace=False)),
    }[kind]  # fmt: skip
    low = 5.0 if kind == "library" else 8.0
    table, label = gs.case(names, float(rng.uniform(low, 15.0)), seed=seed, free=tuple(g.TOLERANCES))
    sized = all(e["sizes"] < SIZES and e["sigmas"] > 0.9 * low for e in label["effects"])
    return (table, label) if sized else None


def work(task: tuple) -> dict:
    """One case in a worker."""
    kind, seed, replicates, robot = task
    case = make(kind, seed)
    if case is None:
        return {"kind": kind, "seed": seed, "skipped": True}
    return {"kind": kind, "seed": seed, **judged(robot_of(robot), *case, seed, replicates)}


def judged(robot, table: dict, label: dict, seed: int, replicates: int) -> dict:
    """The loop over a case, verdict and label side by side."""
    from calibration.data.runs import Runs
    from calibration.discovery.discover import trace
    from calibration.discovery.findings import effect_scores, size_of
    from calibration.discovery.settings import settings_for
    from calibration.inference import noise, observers

    runs = Runs("synthetic", dict(table))
    began = time.perf_counter()
    observer = observers.kind(runs)
    settings = settings_for(observer, replicates, seed)
    found = trace(runs, robot, noise.of(runs, observer.sizes(runs)), settings, STATED)
    seconds = time.perf_counter() - began
    space, base, best = found.screened.base.space, found.screened.base.candidate, found.best
    left = {s.name: s.sigmas_per_prior_sd for s in effect_scores(space, found.left.scores)}
    sd = {e.name: size_of(e) for e in space.library.effects}
    truth = [
        {
            **{k: e[k] for k in ("name", "class", "balance", "amplitude", "sigmas")},
            # what the loop's own base, which frees more than the generator's, leaves of it
            "sigmas_left": left[e["class"]] * abs(e["amplitude"]) / sd[e["class"]] if e["class"] else None,
        }
        for e in label["effects"]
    ]
    spread = settings.width * best.sd[space.free :]
    return {
        "seconds": seconds, "truth": truth, "verdict": found.verdict,
        "classes": [list(members) for members in found.members], "unnamed": located(found),
        "p_value": found.left.test.p_value, "outliers": len(found.screened.outliers),
        "chi2": [2 * base.cost, 2 * best.cost], "readings": int(np.sum(space.weight > 0)),
        "amplitudes": {
            name: [float(best.amplitude[slot] * sd[name]), float(spread[slot] * sd[name])]
            for slot, name in enumerate(best.active) if name
        },
    }  # fmt: skip


def summary(lines: list[dict]) -> list[str]:
    """The figures of a campaign."""
    out = []

    def of(kind: str) -> list[dict]:
        return [x for x in lines if x["kind"] == kind and "verdict" in x]

    def say(what: str, those: list[dict], hit) -> None:
        out.append(f"{what:72s} {interval(sum(map(bool, map(hit, those))), len(those))}")

    def contains(x: dict) -> bool:
        return len(x["classes"]) == 1 and x["truth"][0]["class"] in x["classes"][0]

    def placed(x: dict) -> bool:
        return x["verdict"] == "unnamed" and EQUATION[x["unnamed"][0]] == EQUATION[x["truth"][0]["balance"]]

    say("clean: a false finding", of("clean"), lambda x: x["verdict"] != "none")
    strong = [x for x in of("library") if x["truth"][0]["sigmas_left"] >= 5]
    say("library, >= 5 sigma left: something found", strong, lambda x: x["verdict"] != "none")
    say("library, >= 5 sigma left: the class holds the truth", strong, contains)
    one = [x for x in strong if x["verdict"] == "named" and len(x["classes"]) == 1]
    say("  single name right, where one is named", one, contains)
    weak = [x for x in of("library") if x["truth"][0]["sigmas_left"] < 5]
    say("library, weaker: a wrong name or class", weak, lambda x: x["classes"] and not contains(x))
    say("outside: a wrong single name", of("outside"), lambda x: x["verdict"] == "named")
    say("outside: something found", of("outside"), lambda x: x["verdict"] != "none")
    say("outside: unnamed in the right equation", of("outside"), placed)
    found = [x for x in of("outside") if x["verdict"] != "none"]
    say("  of what is found", found, placed)

    def both(x: dict) -> bool:
        a, b = (t["class"] for t in x["truth"])
        return len(x["classes"]) == 2 and any(a in x["classes"][i] and b in x["classes"][1 - i] for i in (0, 1))

    pairs = [x for x in of("pairs") if all(t["sigmas_left"] >= 8 for t in x["truth"])]
    say("pairs, >= 8 sigma left of each: both classes", pairs, both)
    out.append(f"errors {sum('error' in x for x in lines)}, skipped {sum('skipped' in x for x in lines)}")
    spent = [x["seconds"] for x in lines if "seconds" in x]
    if spent:
        out.append(f"seconds a table: median {np.median(spent):.0f}, mean {np.mean(spent):.0f}")
    return out


if __name__ == "__main__":
    campaign(__doc__, KINDS, work, summary, "runs/campaign_series.jsonl")
