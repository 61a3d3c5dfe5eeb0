"""The closed loop on synthetic time histories: false findings, right names, unnamed discrepancies, events.

    python benchmarks/loop_series.py --clean-wide 300 --library 80 --outside 40 --event 40 --pairs 20 --jobs 2

Sets of starts from `tests/worlds/histories.py`, which shares no code with the simulator: any surface, several
durations and samplings, poor instruments, other robots (foreign laws only on the paper's). Only the scorer reads the
labels. Every set is one line of `--out`, and a restarted run continues where it ended. With
`--narrow`, six starts of 1.5 s of the paper's robot on one stated surface.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import loop_scores as scores
from campaign import SIZES, Task, campaign, looped, refused
from worlds import foreign, histories, settled

KINDS = ("clean", "library", "outside", "pairs", "clean_wide", "noise", "blind", "triples", "event")
#: Kinds with only the paper's robot on one stated surface.
NARROW = ("clean",)
#: Effects of narrow histories; `thermal_drift` and `battery_sag` need longer ones and a battery.
LIBRARY = (
    "pulley_eccentricity", "grouser_polygon", "rotating_inertia", "series_resistance", "churning",
    "armature_inductance", "cogging", "stick_slip",
)  # fmt: skip
#: Effects that rarely leave eight sigmas at a plausible size.
WEAK = ("cogging", "stick_slip")
OUTSIDE = ("pulley_ovality", "belt_splice", "supply_recovery", "oil_warming")
#: Strata of all kinds but `clean_wide`, which uses each equally often, and their shares; foreign laws and events have
#: the size of the paper's robot and no other robots.
SHARES = {"plain": 0.5, "durations": 0.2, "faults": 0.2, "robots": 0.1}
#: The analyst's priors on the one surface of narrow histories, which Table 5 does not contain.
STATED = {
    f"{c}.ground.friction.{name}": prior
    for c in ("6T2A", "4W2T")
    for name, prior in (("static", (0.6, 0.09)), ("dynamic", (0.48, 0.08)))
}


def attempt(kind: str, seed: int, narrow: bool = False, only: str = "") -> histories.SeriesCase | str:
    """The case of a kind and a seed, or the reason why it is invalid.

    Every constant with a prior differs from its nominal value, and is refitted for the size of an effect, as in the
    loop.
    """
    rng = np.random.default_rng([10 + KINDS.index(kind), seed])
    low = 5.0 if kind == "library" else 8.0
    if narrow or kind in NARROW:
        names = {
            "clean": [], "library": [LIBRARY[seed % len(LIBRARY)]], "outside": [OUTSIDE[seed % len(OUTSIDE)]],
            "pairs": [str(n) for n in rng.choice(LIBRARY[:5], 2, replace=False)],
        }[kind]  # fmt: skip
        case = histories.narrow(names, float(rng.uniform(low, 15.0)), seed=seed, free=tuple(settled.TOLERANCES))
        return refused(case.label, low) or case
    strata = tuple(histories.STRATA)
    stratum, variety = strata[seed % len(strata)], seed // len(strata)
    if kind != "clean_wide":
        usual = [s for s in strata if s != "robots" or kind in ("library", "pairs", "triples", "noise")]
        share = np.array([SHARES[s] for s in usual])
        stratum = str(rng.choice(usual, p=share / share.sum()))
    stratum = only or stratum
    w = histories.world(rng, stratum, variety, noise=(0.5, 2.0)[seed % 2] if kind == "noise" else 1.0)
    pool = {"library": w.pool, "outside": OUTSIDE, "blind": foreign.FOREIGN_SERIES, "event": histories.EVENTS}
    if kind in pool:
        choices = tuple(pool[kind])
        names = [choices[seed % len(choices)]]
    else:
        count = {"pairs": 2, "triples": 3}.get(kind, 0)
        strong = [n for n in w.pool if n not in WEAK]
        names = [str(n) for n in rng.choice(strong, count, replace=False)]
    wanted = [float(rng.uniform(low, 15.0)) for _ in names]
    case = histories.case(w, names, wanted, seed=seed)
    most = max((e["sizes"] for e in case.label["effects"]), default=0.0)
    weaker = [max(0.95 * x * SIZES / most, 1.01 * low) if most else x for x in wanted]
    if kind not in ("event", "blind") and most >= SIZES and min(weaker) > 0.5 * min(wanted):
        case = histories.case(w, names, weaker, seed=seed)  # as strong as is plausible
    return refused(case.label, low, sizes=kind not in ("event", "blind")) or case


def program(task: Task) -> tuple | dict:
    """Properties that sets with the same programs share, or the line of an invalid case.

    Making a set takes long. Sets of the plain stratum are equal without it.
    """
    if task.stratum == "plain":
        return ("plain",)
    case = attempt(task.kind, task.seed, task.narrow, task.stratum)
    if isinstance(case, str):
        return {"skipped": case}
    return len(case.table["time_s"]), *case.world.machine.names.values(), case.world.design


def work(task: Task) -> dict:
    """Runs one case in a worker."""
    case = attempt(task.kind, task.seed, task.narrow, task.stratum)
    if isinstance(case, str):
        return {"skipped": case}
    wide = not case.world.stated
    given, found, line = looped(case, task, {} if wide else STATED)
    line["truth"] = [e | _left(found, e) for e in line["truth"]]
    if task.kind in ("outside", "blind") and wide:
        line["truth"] = [{**t, **o} for t, o in zip(line["truth"], histories.oracle(case), strict=True)]
    return line | _amplitudes(found, given.settings)


def _left(found, effect: dict) -> dict:
    """Remainder of a library effect after the loop's own base, which frees its base parameters at its own fit."""
    from calibration.discovery.findings import effect_scores
    from calibration.inference.linearization import amplitude_unit

    if not effect["class"]:
        return {}
    space = found.screened.base.space
    left = {s.name: s.sigmas_per_prior_sd for s in effect_scores(space, found.left.scores)}
    if effect["class"] not in left:
        return {}
    sd = amplitude_unit(space.library[effect["class"]])
    return {"sigmas_left": left[effect["class"]] * abs(effect["amplitude"]) / sd}


def _amplitudes(found, settings) -> dict:
    """Amplitude of each named effect, and its sd [SI]."""
    from calibration.inference.linearization import amplitude_unit

    space, best = found.screened.base.space, found.best
    sd = {e.name: amplitude_unit(e) for e in space.library.effects}
    spread = settings.width * best.sd[space.free :]
    return {
        "amplitudes": {
            name: [float(best.amplitude[slot] * sd[name]), float(spread[slot] * sd[name])]
            for slot, name in enumerate(best.active)
            if name
        }
    }


def summary(lines: list[dict]) -> list[str]:
    """The figures of a campaign."""
    f = scores.Figures(lines)
    scores.findings(f)
    scores.mechanisms(f)
    scores.clean(f, ("clean", "clean_wide"))
    scores.noise(f)
    scores.library(f)
    for kind in ("outside", "blind"):
        scores.outside(f, kind)
    scores.several(f)
    scores.placed_kinds(f, ("event",))
    scores.ends(f)
    return f.out


if __name__ == "__main__":
    campaign(__doc__, KINDS, work, program, summary, "runs/campaign_series.jsonl")
