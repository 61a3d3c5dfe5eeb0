"""The closed loop on synthetic tables: false findings, right classes, unnamed discrepancies, next experiments.

    python benchmarks/loop.py --clean-wide 1000 --library 500 --variants 300 --outside 300 --pairs 200 --jobs 2
    python benchmarks/loop.py --clean-unstated 300 --clean-heavy 100 --clean-uneven 100 --clean-rounded 100 --jobs 2

Tables come from `tests/worlds/tables.py`, which shares no code with the simulator. Only the scorer reads the
labels. Every table is one line of `--out`, and a restarted run continues where it ended.
Surfaces are wide (adhesion 0.2 to 1, V_s 2 to 60 mm/s, known only by the fields' priors), and some tables come from
other robots or poor instruments. With `--narrow` all come from the paper's robot on one stated surface.
Kinds with a special noise (`NOISES`) have no sds in the table, or heavy-tailed, uneven or coarsely rounded readings.
Of these every other table states sds.
"""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import loop_findings
import loop_scores as scores
from campaign import SIZES, Task, begun, campaign, looped, refused
from worlds import foreign, tables
from worlds.laws import LIBRARY, OUTSIDE, VARIANTS
from worlds.tables import Case

KINDS = (
    "clean", "clean_wide", "noise", "library", "variants", "outside", "blind", "pairs", "compensating", "triples",
    "drift", "cluster", "coverage", "clean_unstated", "clean_heavy", "clean_uneven", "clean_rounded",
    "library_unstated", "outside_unstated", "pairs_unstated",
)  # fmt: skip
#: Kinds with a special noise: kind of its effects, its law, and whether sds are stated (None: in every other table).
NOISES: dict[str, tuple[str, str, bool | None]] = {
    "clean_unstated": ("clean_wide", "normal", False), "clean_heavy": ("clean_wide", "heavy", None),
    "clean_uneven": ("clean_wide", "uneven", None), "clean_rounded": ("clean_wide", "normal", None),
    "library_unstated": ("library", "normal", False), "outside_unstated": ("outside", "normal", False),
    "pairs_unstated": ("pairs", "normal", False),
}  # fmt: skip
#: Kinds with only the paper's robot on one stated surface.
NARROW = ("clean", "compensating")
#: Least and greatest sigmas of each effect.
SIGMAS = {
    "library": (5.0, 15.0), "variants": (5.0, 15.0), "outside": (8.0, 15.0), "blind": (8.0, 15.0),
    "pairs": (8.0, 15.0), "compensating": (8.0, 15.0), "triples": (8.0, 15.0), "drift": (8.0, 15.0),
    "cluster": (8.0, 15.0), "coverage": (8.0, 15.0),
}  # fmt: skip
#: Worlds of all kinds but `clean_wide`, which uses each equally often, and their shares.
SHARES = {
    "plain": 0.52, "quantised": 0.08, "outliers": 0.08, "missing": 0.08, "long": 0.08, "short": 0.04, "tracks": 0.04,
    "wheels": 0.04, "both": 0.04,
}  # fmt: skip
#: The same for kinds with a special noise: tables with series, and tables like A1 and A2.
SERIES = {"plain": 0.5, "few": 0.3, "missing": 0.1, "both": 0.1}
#: Draws of names until effects of the wanted strength are plausible together.
TRIES = {"pairs": 6, "triples": 12}
#: Number of proposals carried out in sequence to resolve a class.
EXPERIMENTS = 3
#: The analyst's prior on the one surface of narrow tables, which Table 5 does not contain.
STATED = {f"{c}.ground.friction.static": (0.6, 0.09) for c in ("6T2A", "4W2T")}


# --- cases ------------------------------------------------------------------------------------------


def attempt(kind: str, seed: int, narrow: bool = False, only: str = "") -> Case | str:
    """The case of a kind and a seed, or the reason why it is invalid. `only`: of one stratum."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    own, rounded = kind in NOISES, kind == "clean_rounded"
    kind, law, stated = NOISES.get(kind, (kind, "normal", True))
    low, high = SIGMAS.get(kind, (0.0, 0.0))
    if narrow or kind in NARROW:
        names = _names(kind, seed, rng, tuple(LIBRARY))
        with np.errstate(all="ignore"):
            sigmas = float(rng.uniform(low, high)) if names else 0.0
            case = tables.narrow(names, sigmas, seed=seed, compensating=kind == "compensating")
        return _refused(case, kind, low) or case
    stratum, shares = tables.STRATA[seed % len(tables.STRATA)], SERIES if own else SHARES
    if own or kind != "clean_wide":
        usual = [s for s in shares if kind not in ("noise", "coverage") or s in ("plain", "both", "tracks", "wheels")]
        share = np.array([shares[s] for s in usual])
        stratum = str(rng.choice(usual, p=share / share.sum()))
    stratum = only or ("quantised" if rounded else stratum)
    world = tables.world(
        rng, stratum, noise=(0.5, 2.0)[seed % 2] if kind == "noise" else 1.0,
        shuffled=True if kind in ("drift", "cluster") else None, from_priors=kind == "coverage",
        law=law, stated=seed % 2 == 0 if stated is None else stated,
    )  # fmt: skip
    whys: Counter[str] = Counter()
    for _ in range(TRIES.get(kind, 1)):
        names = _names(kind, seed, rng, world.pool)
        wanted = [float(rng.uniform(low, high)) for _ in names]
        case, why = _weakened(world, kind, names, wanted, seed)
        if not why:
            case.label["refused"] = dict(whys)
            return case
        whys[why] += 1
    return max(whys, key=whys.__getitem__)


def _weakened(world: tables.World, kind: str, names: list[str], wanted: list[float], seed: int) -> tuple[Case, str]:
    """A case, and the reason if it is invalid.

    Effects that would be implausibly large at the wanted sigmas are as strong as is plausible.
    """
    low = SIGMAS.get(kind, (0.0, 0.0))[0]
    case = tables.case(world, names, wanted, seed=seed)
    why = _refused(case, kind, low)
    if why.startswith("needs") and wanted:
        most = max(e["sizes"] for e in case.label["effects"])
        weaker = [max(0.95 * x * SIZES / most, 1.01 * low) for x in wanted]
        case = tables.case(world, names, weaker, seed=seed)
        why = _refused(case, kind, low)
    return case, why


def _names(kind: str, seed: int, rng: np.random.Generator, library: tuple[str, ...]) -> list[str]:
    """Names of the effects of a case."""
    if kind in ("clean", "clean_wide", "noise"):
        return []
    if kind in ("pairs", "compensating", "triples"):
        return [str(n) for n in rng.choice(library, 3 if kind == "triples" else 2, replace=False)]
    if kind == "coverage":
        return [] if seed % 2 == 0 else [str(rng.choice(library))]
    pools = {
        "library": library, "variants": VARIANTS, "outside": OUTSIDE, "blind": foreign.FOREIGN,
        "drift": tables.DRIFTS, "cluster": tables.CLUSTERS,
    }  # fmt: skip
    pool = tuple(pools[kind])
    return [pool[seed % len(pool)]]


def _refused(case: Case, kind: str, low: float) -> str:
    """Reason why a case of a kind is invalid, empty for a valid one."""
    return refused(case.label, low, kind not in ("drift", "cluster", "blind"), kind != "compensating")


# --- verdicts -----------------------------------------------------------------------------------------


def work(task: Task) -> dict:
    """Makes a case, runs the loop on it and scores it against its label, in a worker."""
    case = attempt(task.kind, task.seed, task.narrow, task.stratum)
    if isinstance(case, str):
        return {"skipped": case}
    kind, placed = task.kind, task.kind in ("drift", "cluster")
    given, found, line = looped(case, task, STATED if case.world is None else {})
    if not placed:
        line["truth"] = [{**e, **o} for e, o in zip(line["truth"], tables.oracle(case), strict=True)]
    if kind == "library" and found.verdict in ("named", "class") and not task.brief:
        line |= after(case, given.runs, found)
    if kind == "library" and found.verdict == "class" and case.toml is None and not task.brief:
        try:
            line["experiments"] = carried_out(case, found)
        except Exception as error:  # an unknown menu loses a figure, not the table
            line["experiments"], line["experiments_error"] = [], f"{type(error).__name__}: {error}"
    if kind == "coverage":
        line |= deviates(case, found, given.settings)
    if case.world is not None and not placed:
        further = begun(dataclasses.replace(case, table=case.elsewhere(task.seed)), task)
        line["elsewhere"] = loop_findings.elsewhere(given, found, further.runs)
    return line


def deviates(case: Case, found, settings) -> dict:
    """Distances of the fit from the truth in its own sds: of each base parameter, and of the amplitude.

    Empty if the found class does not contain the truth, or if there is a wrong finding.
    """
    from calibration.inference.linearization import amplitude_unit

    truths = [e["class"] for e in case.label["effects"]]
    space, best = found.screened.base.space, found.best
    if not truths and found.verdict != "none":
        return {}
    if truths:
        if len(found.members) != 1 or truths[0] not in found.members[0]:
            return {}
        if best.effects != (truths[0],):
            ladder = [c for c in getattr(found.alike, "ladder", ()) if c.effects == (truths[0],)]
            if not ladder:
                return {}
            best = min(ladder, key=lambda c: c.cost)
    coordinates, z = space.coordinates.base, case.label["z"]
    names, free = coordinates.names, space.free
    # Truths are drawn from the fields' priors; the loop uses wider ones for the ground's friction.
    wider = {n: tables.spread(n) / float(coordinates.spread[k]) for k, n in enumerate(names) if coordinates.scale[k]}
    line = {
        "deviates": {
            n: float((best.z[k] - z[n] * wider.get(n, 1.0)) / best.sd[k]) for k, n in enumerate(names) if n in z
        },
        "leader": not truths or found.best.effects == (truths[0],),
        "amplitude_deviate": None,
    }
    if truths:
        slot = best.active.index(truths[0])
        sd = settings.width * best.sd[free + slot]
        truth = case.label["effects"][0]["amplitude"] / amplitude_unit(space.library[truths[0]])
        line["amplitude_deviate"] = float((best.amplitude[slot] - truth) / sd)
    return line


def after(case: Case, runs, found) -> dict:
    """Hold-out errors by slope before and after, over the noise's sd, and the bias of the base parameters."""
    from calibration.inference import blocks
    from calibration.inference.blocks import hold_out_blocks

    masks, rows = list(blocks.blocks_of_kind(runs, "slope").values()), len(runs)
    space, both = found.screened.base.space, (found.screened.base.candidate, found.best)
    included, sd = space.included[:rows], np.asarray(space.bare.data.sd)[:rows]

    def rms(candidate) -> float:
        indices = space.coordinates.indices(candidate.active)
        seen = hold_out_blocks(space.equipped, candidate.z, masks, indices).reading
        return float(np.sqrt(np.nanmean((((seen - runs.measured()) / sd)[included]) ** 2)))

    c = space.coordinates.base
    value = np.array([case.label["constants"][n] for n in c.names])
    truth = (np.where(c.scale, np.log(np.maximum(value, 1e-12)), value) - np.asarray(c.location)) / np.asarray(
        c.spread
    )
    bias = [((x.z[: len(c)] - truth) / x.sd[: len(c)]).tolist() for x in both]
    return {"held_out": [rms(x) for x in both], "bias": bias}


def carried_out(case: Case, found) -> list[dict]:
    """Proposed experiments carried out in sequence, until one alternative or no proposal is left."""
    import loop_experiments

    from calibration.discovery import experiments

    left = experiments.alternatives_of_class(found.best, found.alike)
    seen = whole = experiments.predict_menu(found.screened.base.space, left)
    done: dict[str, dict] = {}
    said: list[dict] = []
    while len(seen.names) > 1 and len(said) < EXPERIMENTS:
        proposal = experiments.choose_experiment(seen)
        new = [name for name in proposal.experiments if name not in (experiments.NONE, *done)]
        if not new:
            said.append({"experiments": [experiments.NONE], "left": seen.names})
            break
        for name in new:
            done[name] = case.carry_out(
                next(e for e in whole.experiments if e.name == name), seed=1000 * len(done) + case.label["seed"]
            )
        says = loop_experiments.supported(whole, done)
        what = {k: getattr(proposal, k) for k in ("experiments", "expected_sigma", "settles", "separates")}
        said.append(what | {"chi2": says.chi2, "best": says.best, "left": says.left})
        seen = loop_experiments.among(whole, says.left)
    return said


def program(task: Task) -> tuple | dict:
    """Properties that tables with the same programs share, or the line of an invalid case."""
    from calibration.inference.observers.settled import SettledRuns

    case = attempt(task.kind, task.seed, task.narrow, task.stratum)
    if isinstance(case, str):
        return {"skipped": case}
    names = () if case.world is None else case.world.machine.names.values()
    return len(SettledRuns.padded_rows(len(case.conditions.U))[0]), *names


def summary(lines: list[dict]) -> list[str]:
    """The figures of a campaign."""
    f = scores.Figures(lines)
    scores.findings(f)
    scores.mechanisms(f)
    scores.clean(f, ("clean", "clean_wide"))
    scores.noise(f)
    scores.library(f)
    _experiments(f)
    scores.variants(f)
    for kind in ("outside", "blind"):
        scores.outside(f, kind)
    scores.several(f)
    scores.placed_kinds(f, ("drift", "cluster"))
    scores.coverage(f)
    scores.ends(f)
    return f.out


def _experiments(f: scores.Figures) -> None:
    """Figures of the next experiments, and the change of hold-out errors and base parameters by an added effect."""
    library = f.of("library")
    asked = [x for x in library if x["verdict"] == "class" and scores.contains(x) and "experiments" in x]

    def left(x: dict, first: bool = False) -> list[str]:
        return list((x["experiments"][:1] if first else x["experiments"])[-1]["left"])

    proposed = [x for x in asked if "expected_sigma" in (x["experiments"] or [{}])[0]]
    f.say("class: an experiment is proposed", asked, lambda x: x in proposed)
    two = [x for x in proposed if len(x["experiments"][0].get("experiments", ())) > 1]
    f.say("  the first proposal is of two experiments", proposed, lambda x: x in two)
    f.say("  the first leaves the truth alone", proposed, lambda x: left(x, True) == [x["truth"][0]["class"]])
    f.say(
        f"  up to {EXPERIMENTS} proposals leave the truth alone",
        proposed,
        lambda x: left(x) == [x["truth"][0]["class"]],
    )
    f.say("  the truth is refuted", proposed, lambda x: x["truth"][0]["class"] not in left(x))
    done = [x for x in library if "held_out" in x and scores.contains(x)]
    if not done:
        return
    f.note("  held-out rms over the noise's sd: before {:.2f}, after {:.2f} (median), {:.2f} (95 %)".format(
        *(np.median([x["held_out"][k] for x in done]) for k in (0, 1)),
        np.quantile([x["held_out"][1] for x in done], 0.95)))  # fmt: skip
    f.say("  held-out rms after <= 1.15 of the noise's sd", done, lambda x: x["held_out"][1] <= 1.15)
    for k, when in enumerate(("before", "after")):
        biases = np.concatenate([x["bias"][k] for x in done])
        f.note(f"  bias of base parameters {when}: rms {np.sqrt(np.mean(biases**2)):.2f} sd, "
               f"beyond 2 sd {100 * np.mean(np.abs(biases) > 2):.1f} %")  # fmt: skip


if __name__ == "__main__":
    campaign(__doc__, KINDS, work, program, summary, "runs/campaign.jsonl")
