"""The closed loop on synthetic tables: false findings, right classes, unnamed discrepancies, next experiments.

    python benchmarks/loop.py --clean 1000 --library 400 --variants 200 --outside 300 --pairs 200 --jobs 2

Tables come from `tests/generator.py`, which shares nothing with the simulator; labels are read by the
scorer alone. Every table is one line of `--out`, and a run that is started again goes on where it ended.
"""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import generator as g

KINDS = ("clean", "library", "variants", "outside", "pairs", "compensating")
#: Balances that act on the same of the three equations that current, motor speed and speed close.
EQUATION = {
    **dict.fromkeys(("supply", "electrical"), "electrical"),
    **dict.fromkeys(("motor", "gearbox", "track", "ground", "mass"), "torque"),
    "slip": "slip",
    "sensor": "sensor",
}
#: Sigmas that the best library effect has to leave of a foreign one for it not to be a mimic.
MIMIC = 5.0
#: Amplitudes of more than so many ordinary sizes are left out: no library should believe them.
SIZES = 3.0
#: Proposals that are carried out, one after the other, to resolve a class.
EXPERIMENTS = 3
#: The analyst's prior on the surface, which Table 5 does not know.
STATED = {f"{c}.ground.friction.static": (0.6, 0.09) for c in ("6T2A", "4W2T")}


def make(kind: str, seed: int) -> g.Case | None:
    """The case of a kind and a seed; None where the effect cannot be made so strong."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    if kind == "clean":
        return g.case(seed=seed)
    if kind in ("pairs", "compensating"):
        names, low, high = list(rng.choice(list(g.LIBRARY), 2, replace=False)), 8.0, 15.0
    else:
        pool = {"library": g.LIBRARY, "variants": g.VARIANTS, "outside": g.OUTSIDE}[kind]
        names = [list(pool)[seed % len(pool)]]
        low, high = (8.0, 15.0) if kind == "outside" else (5.0, 15.0)
    with np.errstate(all="ignore"):
        case = g.case(names, float(rng.uniform(low, high)), seed=seed, compensating=kind == "compensating")
    label = case.label
    reached = kind == "compensating" or all(e["sigmas"] > 0.9 * low for e in label["effects"])
    sized = all(e["sizes"] < SIZES for e in label["effects"])
    return case if reached and sized and label["rows_lost"] == 0 else None


def remainders(case: g.Case) -> dict[str, list[np.ndarray]]:
    """What a refit of the constants leaves of every library effect, unit norm, over a grid of its shape."""
    c, p, show = case.conditions, case.constants, case.instruments
    slopes = g.base_slopes(c, p, show)
    found: dict[str, list[np.ndarray]] = {}
    for name, form in g.LIBRARY.items():
        grid = [{}]
        for shape, (low, high) in form.shapes.items():
            grid = [{shape: v} for v in np.geomspace(low, high, 5)]
        for shapes in grid:
            sign = g.signature(c, p, [g.Term(name, 0.02 * form.size, shapes)], show)
            left = g.remainder(np.nan_to_num(sign), slopes)
            norm = np.linalg.norm(left)
            if norm > 1e-9:
                found.setdefault(name, []).append(left / norm)
    return found


def oracle(case: g.Case) -> list[dict]:
    """For each effect of a case: library effects that noise-free data could not tell from it, and what the best
    one in its place would leave [σ]."""
    units = remainders(case)
    c, p, show = case.conditions, case.constants, case.instruments
    slopes = g.base_slopes(c, p, show)
    answers = []
    for term in case.terms:
        left = g.remainder(np.nan_to_num(g.signature(c, p, [term], show)), slopes)
        size = np.linalg.norm(left)
        apart = {}
        for name, form in g.LIBRARY.items():
            along = [float(left @ u) for u in units.get(name, []) if form.either or left @ u >= 0]
            apart[name] = min((float(np.sqrt(max(size**2 - x**2, 0.0))) for x in along), default=float(size))
        same = [n for n, d in apart.items() if d < 2.0 or d < np.sqrt(1 - 0.95**2) * size]
        others = {n: d for n, d in apart.items() if n != term.form.cls}
        answers.append(
            {"class_oracle": same, "best_other": min(others.values()), "mimic": min(others, key=others.get)}
        )
    return answers


def one(robot, kind: str, seed: int, replicates: int) -> dict:
    """A case made, looped over and scored against its label."""
    from calibration.data import runs as records
    from calibration.discovery.discover import trace
    from calibration.discovery.settings import settings_for
    from calibration.inference import noise, observers

    case = make(kind, seed)
    if case is None:
        return {"kind": kind, "seed": seed, "skipped": True}
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "runs.csv"
        case.write(table, Path(folder) / "label.json")
        runs = records.read(table)
    began = time.perf_counter()
    observer = observers.kind(runs)
    settings = settings_for(observer, replicates, seed)
    found = trace(runs, robot, noise.of(runs, observer.sizes(runs)), settings, STATED)
    seconds = time.perf_counter() - began
    return {"kind": kind, "seed": seed, "seconds": seconds, **judged(case, runs, found, settings)}


def judged(case: g.Case, runs, found, settings) -> dict:
    """Verdict and label side by side.

    Args:
        found: what the stages of the loop found, a `Traced`.
    """
    base = found.screened.base.candidate
    return {
        "truth": [
            {**{k: e[k] for k in ("name", "class", "balance", "sigmas", "sizes")}, **o}
            for e, o in zip(case.label["effects"], oracle(case), strict=True)
        ],
        "sigmas_together": case.label["sigmas_together"],
        "verdict": found.verdict,
        "classes": [list(members) for members in found.members],
        "unnamed": located(found),
        "p_value": found.left.test.p_value,
        "outliers": list(found.screened.outliers),
        "chi2": [2 * base.cost, 2 * found.best.cost],
        "experiments": carried_out(case, found, settings) if found.verdict == "class" else [],
        **(after(case, runs, found) if found.verdict in ("named", "class") else {}),
    }


def located(found) -> tuple | None:
    """(balance, variable, balances that act alike) of what has no name, or remains."""
    return None if found.where is None else (found.where.balance, found.where.variable, found.where.alike)


def after(case: g.Case, runs, found) -> dict:
    """Errors held out by slope before and after, over the noise's sd, and the bias of the base parameters."""
    from calibration.inference import blocks
    from calibration.inference.held_out import held_out

    masks, rows = list(blocks.blocks(runs, "slope").values()), len(runs)
    space, both = found.screened.base.space, (found.screened.base.candidate, found.best)
    included, sd = space.included[:rows], np.asarray(space.bare.data.sd)[:rows]

    def rms(candidate) -> float:
        indices = space.library.indices(candidate.active)
        seen = held_out(space.equipped, candidate.z, masks, indices).reading
        return float(np.sqrt(np.nanmean((((seen - runs.measured()) / sd)[included]) ** 2)))

    c = space.coordinates.base
    value = np.array([case.constants[n] for n in c.names])
    truth = (np.where(c.scale, np.log(value), value) - np.asarray(c.location)) / np.asarray(c.spread)
    bias = [((x.z[: len(c)] - truth) / x.sd[: len(c)]).tolist() for x in both]
    return {"held_out": [rms(x) for x in both], "bias": bias}


def carried_out(case: g.Case, found, settings) -> list[dict]:
    """Experiments proposed and carried out one after the other, until one alternative or nothing to do is left."""
    from calibration.discovery import experiments

    left = experiments.alternatives(found.best, found.alike)
    seen = whole = experiments.prospect(found.screened.base.space, left, settings)
    done: dict[str, dict] = {}
    said: list[dict] = []
    while len(seen.names) > 1 and len(said) < EXPERIMENTS:
        proposal = experiments.choose(seen)
        new = [name for name in proposal.experiments if name not in (experiments.NONE, *done)]
        if not new:
            said.append({"experiments": [experiments.NONE], "left": seen.names})
            break
        for name in new:
            done[name] = case.carry_out(name, seed=1000 * len(done) + case.label["seed"])
        says = experiments.supported(whole, done)
        what = {k: getattr(proposal, k) for k in ("experiments", "expected_sigma", "settles", "separates")}
        said.append(what | {"chi2": says.chi2, "best": says.best, "left": says.left})
        seen = whole.among(says.left)
    return said


@functools.cache
def robot_of(name: str):
    """The robot of a worker; what its loops compile is kept on disk for the other one."""
    import jax

    from sweeps import compilation_cache

    compilation_cache.enable()
    jax.config.update("jax_enable_x64", True)
    from mmrjax import robots

    return robots.ROBOTS[name]()


def work(task: tuple) -> dict:
    """One case in a worker."""
    kind, seed, replicates, robot = task
    return one(robot_of(robot), kind, seed, replicates)


def _guarded(work, task: tuple) -> dict:
    """What came of a case, or the error that it ended with."""
    kind, seed, *_ = task
    try:
        return work(task)
    except Exception as error:
        return {"kind": kind, "seed": seed, "error": f"{type(error).__name__}: {error}"}


def interval(hits: int, n: int) -> str:
    """A share with its 95 % interval (Wilson)."""
    if n == 0:
        return "none"
    z, p = 1.96, hits / n
    middle, half = (
        (p + z * z / (2 * n)) / (1 + z * z / n),
        z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n),
    )
    return f"{100 * p:5.1f} %  [{100 * (middle - half):.1f}, {100 * (middle + half):.1f}]  of {n}"


def summary(lines: list[dict]) -> list[str]:
    """The figures of a campaign."""
    out = []

    def say(what: str, those: list[dict], hit) -> None:
        out.append(f"{what:72s} {interval(sum(map(bool, map(hit, those))), len(those))}")

    def of(kind: str) -> list[dict]:
        return [x for x in lines if x["kind"] == kind and "verdict" in x]

    def contains(x: dict) -> bool:
        return len(x["classes"]) == 1 and x["truth"][0]["class"] in x["classes"][0]

    def placed(x: dict) -> bool:
        return x["verdict"] == "unnamed" and EQUATION[x["unnamed"][0]] == EQUATION[x["truth"][0]["balance"]]

    def among(x: dict) -> bool:
        return x["verdict"] == "unnamed" and x["truth"][0]["balance"] in x["unnamed"][2]

    say("clean: a false finding", of("clean"), lambda x: x["verdict"] != "none")
    library = of("library")
    say("library >= 5 sigma: something found", library, lambda x: x["verdict"] != "none")
    say("library >= 5 sigma: the class holds the truth", library, contains)
    alone = [x for x in library if x["truth"][0]["class"] and len(x["truth"][0]["class_oracle"]) == 1]
    say(
        "  single name right, where noise-free data leave one",
        alone,
        lambda x: contains(x) and len(x["classes"][0]) == 1,
    )
    one_name = [x for x in library if x["verdict"] == "named" and len(x["classes"]) == 1]
    say("  single name right, where one is named", one_name, contains)
    say("  unnamed", library, lambda x: x["verdict"] == "unnamed")
    say("  two or more effects named", library, lambda x: len(x["classes"]) > 1)
    if library:
        sizes = [len(x["classes"][0]) for x in library if contains(x)]
        ideal = [len(x["truth"][0]["class_oracle"]) for x in library]
        out.append(f"  members of the class: mean {np.mean(sizes):.2f} (noise-free {np.mean(ideal):.2f})")
    asked = [x for x in library if x["verdict"] == "class" and len(x["classes"]) == 1 and contains(x)]

    def left(x: dict, first: bool = False) -> list[str]:
        return list((x["experiments"][:1] if first else x["experiments"])[-1]["left"])

    def nearest(x: dict) -> bool:
        return [e for e in x["experiments"] if "best" in e][-1]["best"] == x["truth"][0]["class"]

    proposed = [x for x in asked if "expected_sigma" in (x["experiments"] or [{}])[0]]
    say("class: an experiment is proposed", asked, lambda x: x in proposed)
    two = [x for x in proposed if len(x["experiments"][0].get("experiments", ())) > 1]
    say("  the first proposal is of two experiments", proposed, lambda x: x in two)
    say("  the first leaves the truth alone", proposed, lambda x: left(x, True) == [x["truth"][0]["class"]])
    say(
        f"  up to {EXPERIMENTS} proposals leave the truth alone",
        proposed,
        lambda x: left(x) == [x["truth"][0]["class"]],
    )
    say("  the truth is refuted", proposed, lambda x: x["truth"][0]["class"] not in left(x))
    say("  nearest is the truth", proposed, nearest)
    done = [x for x in library if "held_out" in x and contains(x)]
    if done:
        out.append("  held-out rms over the noise's sd: before {:.2f}, after {:.2f} (median), {:.2f} (95 %)".format(
            *(np.median([x["held_out"][k] for x in done]) for k in (0, 1)),
            np.quantile([x["held_out"][1] for x in done], 0.95)))  # fmt: skip
        say("  held-out rms after <= 1.15 of the noise's sd", done, lambda x: x["held_out"][1] <= 1.15)
        for k, when in enumerate(("before", "after")):
            biases = np.array([x["bias"][k] for x in done])
            out.append(f"  bias of base parameters {when}: rms {np.sqrt(np.mean(biases**2)):.2f} sd, "
                       f"beyond 2 sd {100 * np.mean(np.abs(biases) > 2):.1f} %, mean of each at most "
                       f"{np.abs(biases.mean(0)).max():.2f} sd")  # fmt: skip
    variants = of("variants")
    say("another form >= 5 sigma: class holds the cause", variants, contains)
    say("  or unnamed in the right equation", variants, lambda x: contains(x) or placed(x))
    say("  a wrong single name", variants, lambda x: x["verdict"] == "named" and not contains(x))
    outside = of("outside")
    free = [x for x in outside if x["truth"][0]["best_other"] >= MIMIC]
    mimics = [x for x in outside if x["truth"][0]["best_other"] < MIMIC]
    say(
        "outside >= 8 sigma: a wrong single name",
        outside,
        lambda x: x["verdict"] == "named" and len(x["classes"]) == 1,
    )
    say(
        f"outside, no mimic (best leaves >= {MIMIC:g}): wrong single name",
        free,
        lambda x: x["verdict"] == "named" and len(x["classes"]) == 1,
    )
    say("  a class of one effect", free, lambda x: x["verdict"] == "class" and len(x["classes"]) == 1)
    say("  two or more library effects", free, lambda x: len(x["classes"]) > 1)
    say("  unnamed in the right equation", free, placed)
    say(
        "  unnamed in the very balance",
        free,
        lambda x: x["verdict"] == "unnamed" and x["unnamed"][0] == x["truth"][0]["balance"],
    )
    say("  the very balance among those said to act alike", free, among)
    listed = [len(x["unnamed"][2]) for x in free if x["verdict"] == "unnamed"]
    if listed:
        out.append(f"  balances said to act alike: mean {np.mean(listed):.1f}")
    say("outside, with a mimic: fooled (one name or class)", mimics, lambda x: len(x["classes"]) == 1)
    say("  unnamed in the right equation", mimics, placed)

    def both(x: dict) -> bool:
        a, b = (t["class"] for t in x["truth"])
        return len(x["classes"]) == 2 and any(a in x["classes"][i] and b in x["classes"][1 - i] for i in (0, 1))

    for kind in ("pairs", "compensating"):
        say(f"{kind} >= 8 sigma each: both classes", of(kind), both)
        say("  something found", of(kind), lambda x: x["verdict"] != "none")
    out.append(f"errors {sum('error' in x for x in lines)}, skipped {sum('skipped' in x for x in lines)}")
    spent = [x["seconds"] for x in lines if "seconds" in x]
    if spent:
        out.append(f"seconds a table: median {np.median(spent):.2f}, mean {np.mean(spent):.2f}")
    return out


def campaign(doc: str | None, kinds: tuple[str, ...], work, summary, out: str) -> None:
    """The command of a campaign: so many tables of each kind, one line of a file each, resumable.

    `work((kind, seed, replicates, robot))`, a function of a module, makes and judges a case in a process of its own;
    `summary(lines)` says the figures.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for kind in kinds:
        parser.add_argument(f"--{kind}", type=int, default=0, help="tables")
    parser.add_argument("--replicates", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--robot", default="nominal")
    parser.add_argument("--out", type=Path, default=Path(out))
    parser.add_argument("--limit", type=float, default=np.inf, help="seconds after which no table is begun")
    given = parser.parse_args()
    given.out.parent.mkdir(parents=True, exist_ok=True)
    lines = [json.loads(x) for x in given.out.read_text().splitlines()] if given.out.exists() else []
    lines = [x for x in lines if "error" not in x]  # they are tried again
    done = {(x["kind"], x["seed"]) for x in lines}
    tasks = [
        (kind, seed, given.replicates, given.robot)
        for kind in kinds
        for seed in range(given.first, given.first + getattr(given, kind))
        if (kind, seed) not in done
    ]
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    tasks.sort(key=lambda t: (t[1] - given.first) / getattr(given, t[0]))  # kinds go on side by side
    began = time.monotonic()
    with multiprocessing.get_context("spawn").Pool(given.jobs) as pool, given.out.open("a") as file:
        for k, line in enumerate(pool.imap_unordered(functools.partial(_guarded, work), tasks)):
            lines.append(line)
            file.write(json.dumps(line, default=float) + "\n")
            file.flush()
            if k % 50 == 0:
                print(f"{k}/{len(tasks)} tables, {time.monotonic() - began:.0f} s", flush=True)
            if time.monotonic() - began > given.limit:
                pool.terminate()
                break
    print("\n".join(summary(lines)))
    print(f"{len(tasks)} tables in {time.monotonic() - began:.0f} s with {given.jobs} processes")


if __name__ == "__main__":
    campaign(__doc__, KINDS, work, summary, "runs/campaign.jsonl")
