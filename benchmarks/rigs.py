"""The closed loop on random rigs: false findings, right classes, wrong names, and parameters held by their priors.

    python benchmarks/rigs.py --clean 500 --library 400 --outside 200 --jobs 16 --cache runs/cache

Rigs come from `tests/worlds/rigs.py`, which shares no code with the simulator: one to six drives on wheels, tracks,
a bench, a winch or a linear unit. Voltage, duty or motor speed imposed. One to three channels. The loop reads only
`rig.toml` and `table.csv`. Only the scorer reads the labels. Every rig is one line of `--out`, and a restarted
campaign continues where it ended.

    python benchmarks/rigs.py --confounded 200 --jobs 16 --cache runs/cache

Rows of `confounded` tables are in the order of what drives the motors, and a column of a temperature rises with them:
a fourth has nothing missing, a half an effect of the library, a fourth another effect.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import loop_scores as scores
from campaign import Task, campaign, looped, refused
from worlds import laws
from worlds import rigs as gr

KINDS = ("clean", "library", "outside", "confounded")
#: Effects of a `confounded` table, by the remainder of its seed.
CONFOUNDED = ("library", "clean", "library", "outside")
#: Least and greatest sigmas of each effect.
SIGMAS = {"library": (5.0, 15.0), "outside": (8.0, 15.0)}
#: Rigs drawn until one can have an effect of the wanted strength: first of one effect, then of any.
TRIES = (15, 30)
#: Posterior sd over the prior's above which a parameter has to be reported as held by its prior. The generator's own
#: figure is linear at the truth and uses only the file's tolerances; its threshold is therefore higher.
HELD, SURE = 0.9, 0.97
#: Number of consecutive rigs with the same equations, channels, directions and about the same number of rows, so
#: that their loops share programs: compiling takes a minute and judging a second.
ALIKE = 10


# --- cases ------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=2)
def shape(kind: str, number: int) -> tuple[gr.Rig, tuple[int, int]]:
    """Properties that `ALIKE` rigs share: those of a random one, and limits of the number of rows."""
    from calibration.inference.observers.settled import SettledRuns

    world = gr.world(np.random.default_rng([32, KINDS.index(kind), number]))
    sizes = SettledRuns.sizes_padded
    most = next(n for n in sizes if n >= len(world.conditions))
    fewest = max((n + 1 for n in sizes if n < most), default=0)
    return world.rig, (max(fewest, gr.ROWS[0]), min(most, gr.ROWS[1]))


@functools.lru_cache(maxsize=2)
def attempt(kind: str, seed: int) -> gr.Case | str:
    """The case of a kind and a seed, or the reason why it is invalid."""
    like, rows = shape(kind, seed // ALIKE)
    rng = np.random.default_rng([31, KINDS.index(kind), seed])
    if kind == "confounded":
        return _confounded(seed, like, rows, rng)
    if kind == "clean":
        return gr.case(gr.world(rng, like=like, rows=rows), seed=seed)
    pool = laws.RIGS if kind == "library" else laws.OUTSIDE_RIGS
    wanted = tuple(pool)[seed % len(pool)]
    whys: Counter[str] = Counter()
    for k in range(sum(TRIES)):
        world = gr.world(rng, like=like, rows=rows)
        able = world.applicable(pool)
        if k >= TRIES[0] and able:
            wanted = str(rng.choice(able))
        if wanted not in able:
            continue
        case = gr.case(world, wanted, float(rng.uniform(*SIGMAS[kind])), seed)
        if not (why := refused(case.label, SIGMAS[kind][0])):
            case.label["refused"] = dict(whys)
            return case
        whys[f"{wanted} {why}"] += 1
    return max(whys, key=whys.__getitem__, default="no rig can have it")


def _confounded(seed: int, like: gr.Rig, rows: tuple[int, int], rng: np.random.Generator) -> gr.Case | str:
    """A case with rows by rising drive and a temperature that rises with them. It says nothing of the readings."""
    kind = CONFOUNDED[seed % len(CONFOUNDED)]
    pool = {"clean": {"": None}, "library": laws.RIGS, "outside": laws.OUTSIDE_RIGS}[kind]
    whys: Counter[str] = Counter()
    for _ in range(sum(TRIES)):
        world = gr.rising(gr.world(rng, like=like, rows=rows))
        able = ("",) if kind == "clean" else world.applicable(pool)
        if not able:
            continue
        sigmas = 0.0 if kind == "clean" else float(rng.uniform(*SIGMAS[kind]))
        case = gr.case(world, str(rng.choice(able)), sigmas, seed)
        if why := refused(case.label, SIGMAS.get(kind, (0.0,))[0]):
            whys[why] += 1
            continue
        case.label["kind"] = "confounded"
        warm = 25 + 30 * (1 - np.exp(-2 * world.conditions.order)) + 0.2 * rng.standard_normal(len(world.conditions))
        return dataclasses.replace(case, table=case.table | {"case_temperature_C": np.round(warm, 1)})
    return max(whys, key=whys.__getitem__, default="no rig can have it")


# --- verdicts -----------------------------------------------------------------------------------------


def work(task: Task) -> dict:
    """Makes a rig, runs the loop on it and scores it against its label."""
    case = attempt(task.kind, task.seed)
    if isinstance(case, str):
        return {"skipped": case}
    _, found, line = looped(case, task)
    return line | {"parameters": identified(found, case)}


def identified(found, case: gr.Case) -> dict[str, dict]:
    """Identifiability of each free parameter.

    Posterior sd over the prior's, whether it is reported as held by its prior, and that ratio by the generator's own
    analysis of the rig without its effect.
    """
    from calibration.discovery import findings

    space, best = found.screened.base.space, found.screened.base.candidate
    shifts = findings.parameter_shifts(space, best.z, best.z, best.sd)
    own = case.label["sd_over_prior"]
    return {
        name: {"ratio": float(best.sd[k]), "held": shift.held_by_prior, "own": own.get(name)}
        for k, (name, shift) in enumerate(shifts.items())
    }


def program(task: Task) -> tuple[str, int]:
    """Properties that rigs with the same programs share, see `shape`."""
    return task.kind, task.seed // ALIKE


# --- figures ----------------------------------------------------------------------------------------


def summary(lines: list[dict]) -> list[str]:
    """The figures of a campaign."""
    confounded = scores.Figures([x for x in lines if x["kind"] == "confounded"])
    _of_confounded(confounded)
    f = scores.Figures([x for x in lines if x["kind"] != "confounded"])
    scores.findings(f)
    scores.mechanisms(f)
    _clean(f)
    _library(f)
    _outside(f)
    _identifiability(f)
    scores.ends(f)
    return confounded.out + f.out


#: Properties for a breakdown of clean rigs.
STRATA = {
    "load": lambda m: m["load"],
    "imposed": lambda m: m["imposed"],
    "channels": lambda m: str(len(m["channels"])),
    "motors": lambda m: "1" if m["sides"] == 1 else "2 to 6",
    "supply": lambda m: "to 12 V" if m["supply"] <= 12 else "above 12 V",
    "rows": lambda m: "to 32" if m["rows"] <= 32 else "above 32",
    "directions": lambda m: "both" if m["reverse"] else "forward",
    "instruments": lambda m: "magnitude" if m["unsigned"] else "coarse" if m["quantum"] else "signed, fine",
}


def _clean(f: scores.Figures) -> None:
    clean = f.of("clean")
    f.say("clean: a false finding (goal <= 5 %)", clean, scores.false_finding)
    f.say("  with a name", clean, lambda x: x["classes"])
    for name, key in STRATA.items():
        for value in sorted({key(x["made"]) for x in clean}):
            scores.stratum(f, f"{name} {value}", [x for x in clean if key(x["made"]) == value])


def _library(f: scores.Figures) -> None:
    strong = [x for x in f.of("library") if x["truth"][0]["sigmas"] >= 5]
    f.say("library, >= 5 sigma left: class right (goal >= 93 %)", strong, scores.contains)
    for low, high in ((5, 6), (6, 8), (8, 99)):
        some = [x for x in strong if low <= x["truth"][0]["sigmas"] < high]
        f.say(f"  {low} to {high} sigma" if high < 99 else f"  >= {low} sigma", some, scores.contains)
    f.say("  something found", strong, scores.false_finding)
    f.say("  a single name that is given is right", [x for x in strong if scores.single(x)], scores.contains)
    f.say("  unnamed", strong, lambda x: x["verdict"] in scores.WITHOUT_NAME)
    f.say("  two or more effects named", strong, lambda x: len(x["classes"]) > 1)
    alone = [x for x in strong if len(x["truth"][0]["class_oracle"]) == 1]
    f.say(
        "  single name right, where noise-free data leave one",
        alone,
        lambda x: scores.contains(x) and scores.single(x),
    )
    scores.by_name(f, strong, scores.contains)


def _outside(f: scores.Figures) -> None:
    those = f.of("outside")
    f.say("outside: wrong single name (goal <= 4 %)", those, scores.single)
    free = [x for x in those if x["truth"][0]["best_other"] >= scores.MIMIC]
    f.say("  where no library effect leaves less than 5 sigma: wrong single name", free, scores.single)
    f.say("  any library name", free, lambda x: x["classes"])
    f.say("  unnamed in the right equation", free, scores.placed)
    f.say("  nothing found", free, lambda x: x["verdict"] == "none")
    mimics = [x for x in those if x not in free]
    f.say("  with a mimic: a library name", mimics, lambda x: x["classes"])
    for name in sorted({x["truth"][0]["name"] for x in those}):
        named = Counter(str(x["classes"]) for x in those if x["truth"][0]["name"] == name and scores.single(x))
        if named:
            f.note(f"    {name}: {dict(named)}")


def _of_confounded(f: scores.Figures) -> None:
    those = f.of("confounded")
    f.say("confounded: a wrong mechanism established (goal <= 3 %)", those, scores.mechanism_wrong)
    f.say(
        "  counting indistinguishable balances and drivers as right", those, lambda x: scores.mechanism_wrong(x, True)
    )
    f.say("  led by the order, the time or a temperature", those, led_by_confounded)
    f.say("  nothing is missing, and something is found", [x for x in those if not x["truth"]], scores.false_finding)
    f.say("  an effect, and its mechanism is established", [x for x in those if x["truth"]], scores.mechanism_right)


def led_by_confounded(x: dict) -> bool:
    """True if the finding of a line changes with the order, the time or a temperature."""
    return bool(x["where"]) and str(x["where"][1]).split(" ")[0] in ("order", "time", "temperature")


def _identifiability(f: scores.Figures) -> None:
    judged = [x for x in f.lines if x.get("parameters")]
    f.say(
        "rigs whose parameters above 0.9 of their prior's sd are all reported as held",
        judged,
        lambda x: not missed(x),
    )
    clean = [x for x in judged if x["kind"] == "clean"]
    f.say(
        f"  clean ones: those above {SURE:g} by the generator's own analysis too", clean, lambda x: not missed_own(x)
    )
    every = [p for x in judged for p in x["parameters"].values()]
    if every:
        f.note(f"  parameters: {len(every)} free, {sum(bool(p['held']) for p in every)} reported as held")
    both = np.array([(p["ratio"], p["own"]) for x in clean for p in x["parameters"].values() if p["own"] is not None])
    if len(both):
        apart = np.abs(np.log(both[:, 0] / both[:, 1]))
        f.note(f"  posterior sds, loop against generator: apart by {100 * np.median(apart):.1f} % in the median, "
               f"{100 * np.quantile(apart, 0.95):.0f} % in one of twenty")  # fmt: skip


def missed(x: dict) -> list[str]:
    """Parameters of a line that its data do not determine and that are not reported as held by their priors."""
    return [n for n, p in x["parameters"].items() if p["ratio"] > HELD and not p["held"]]


def missed_own(x: dict) -> list[str]:
    """The same by the generator's own analysis."""
    return [n for n, p in x["parameters"].items() if p["own"] is not None and p["own"] > SURE and not p["held"]]


if __name__ == "__main__":
    campaign(__doc__, KINDS, work, program, summary, "runs/rigs.jsonl")
