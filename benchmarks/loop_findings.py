"""Record of the findings of a table in a campaign: each effect, its tests in numbers, and the model that predicts.

Numbers are raw, so that the constants of the tests can be chosen again from the lines of a campaign.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibration.inference import bases

#: Further parts that a result may have, in addition to its verdict.
FURTHER = ("families", "mechanism", "implausible", "hidden", "stands_for")


def plain(x: Any) -> Any:
    """Any value of a result in a form that JSON can hold."""
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        return {f.name: plain(getattr(x, f.name)) for f in dataclasses.fields(x)}
    if isinstance(x, Mapping):
        return {str(k): plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple | set | frozenset):
        return [plain(v) for v in x]
    if isinstance(x, np.ndarray) or hasattr(x, "__array__"):
        return np.asarray(x).tolist()
    return x if isinstance(x, str | int | float | bool | type(None)) else str(x)


def verdict(found) -> dict:
    """The verdict of a `LoopStages`."""
    base, factors = found.screened.base.candidate, found.sds.factors
    further = {name: plain(getattr(found, name)) for name in FURTHER if getattr(found, name, None) is not None}
    return {
        "verdict": found.verdict,
        "classes": [list(members) for members in found.members],
        "where": located(found),
        "variables_alike": () if found.where is None else found.where.variables_alike,
        "p_value": found.left.test.p_value,
        "outliers": [int(k) for k in found.screened.outliers],
        "chi2": [2 * base.cost, 2 * found.best.cost],
        "readings": int(np.sum(found.screened.base.space.weight > 0)),
        **further,
        "events": [] if found.where is None else events(found, found.where.variable),
        "events_alike": [] if found.where is None else [
            event for variable in found.where.variables_alike for event in events(found, variable)
        ],
        **({"noise_factor": float(np.exp(np.mean(np.log(list(factors.values())))))} if factors else {}),
    }  # fmt: skip


def events(found, variable: str) -> list[dict[str, Any]]:
    """A temporary change with its axis, its window and the numbers of the rows in it. Empty for other variables."""
    happens = bases.window_from_name(variable)
    if happens is None:
        return []
    linear = found.left.linear
    x, _ = linear.curve_variable(found.where.place, happens.axis)
    inside = found.screened.base.space.included & linear.of_rows(happens.holds(x))
    rows = [int(k) + 1 for k in np.flatnonzero(inside)]
    return [{"axis": happens.axis, "window": [happens.low, happens.high], "rows": rows}]


def located(found) -> tuple | None:
    """(balance, variable, indistinguishable balances) of an unnamed or remaining discrepancy."""
    return None if found.where is None else (found.where.place, found.where.variable, list(found.where.alike))


def findings(given: Any, found: Any) -> dict[str, Any]:
    """Effects of the model, tests of each, the noise, and the written model.

    Args:
        given: result of `prepare_loop`.
        found: the `LoopStages` of it.
    """
    alike, best, base = found.alike, found.best, found.screened.base.candidate
    members = () if alike is None else alike.members
    stated = () if alike is None else alike.stated
    stood = found.standing
    named = [m[0] for m in found.members]
    line: dict[str, Any] = {
        "effects": [
            {
                "name": m[0],
                "class": list(m),
                "families": list(families),
                "stated": [s.name for s in v],
                "standing": "established" if m[0] in named else "tentative",
                "size": float(best.size[best.active.index(m[0])]),
            }
            for m, v, families in zip(members, stated, () if alike is None else alike.families, strict=True)
        ],
        "standing": None if stood is None else [stood.stands, stood.why, list(stood.effects)],
        "tests": _tests(found),
        "noise": _noise(found.sds.noise),
        "missing": [found.left.test.p_value, found.left.test.rejected, found.left.test.rejected_with_margin],
        "ends": found.ends.test.rejected_with_margin,
    }
    if best is not base and found.run is None and not found.screened.base.space.bare.observe.long:
        line |= _held_out(given.runs, found)
    return line


def _tests(found: Any) -> list[dict[str, Any]]:
    """Tests of each effect that was tested separately, None for an infinite root without any one row."""
    tests = () if found.standing is None else found.standing.tests
    return [
        {f.name: getattr(t, f.name) for f in dataclasses.fields(t)}
        | {"fails": t.fails, "root_without": t.root_without if np.isfinite(t.root_without) else None}
        for t in tests
    ]


def _noise(noise: Any) -> dict[str, dict[str, Any]]:
    """Channel → source of its sd, its median [SI], and properties of an estimate."""
    series = {s.channel.name: s for s in noise.along_series}
    known = {}
    for k, channel in enumerate(noise.channels):
        found = series.get(channel.name)
        known[channel.name] = {"source": noise.source[k], "sd": float(np.median(noise.sd[:, k]))}
        if found is not None:
            known[channel.name] |= {"share": found.share, "freedom": found.freedom, "series": found.count}
    return known


# --- what predicts --------------------------------------------------------------------------------------


def _held_out(runs: Any, found: Any) -> dict[str, Any]:
    """Scores of the model and of smaller sets over the refit on held-out data, and errors by channel."""
    from calibration.discovery import prediction
    from calibration.discovery.search import best_of_each_size
    from calibration.inference import blocks as blocks_room
    from calibration.inference.blocks import hold_out_blocks

    space, base, best = found.screened.base.space, found.screened.base.candidate, found.best
    kinds = blocks_room.predictable_blocks(runs, space.bare)
    if not kinds:
        return {}
    data, rows = space.equipped.data, len(runs)
    measured, sd, counts = (np.asarray(x)[:rows] for x in (data.measured, data.sd, space.weight > 0))

    def reading(candidate: Any) -> dict[str, np.ndarray]:
        active = space.coordinates.indices(candidate.active)
        return {
            kind: hold_out_blocks(space.equipped, candidate.z, list(by.values()), active).reading
            for kind, by in kinds.items()
        }

    def score(seen: dict[str, np.ndarray]) -> Any:
        return prediction.score_readings(seen, measured, sd, counts, kinds)

    before, after = reading(base), reading(best)
    gain, refit = score(after).gain(score(before)), score(before)
    smaller = [c for c in best_of_each_size(found.searched) if c.key != best.key]
    gains = [(c.effects, score(reading(c)).gain(refit)) for c in smaller]
    names = [channel.name for channel in runs.channels]
    return {
        "gain": [gain.mean, gain.se],
        "written": bool(gain.mean >= -prediction.WORSE),
        "gains_of_smaller": [[list(effects), g.mean, g.se] for effects, g in gains],
        "rms_sigma": {
            kind: _rms(*((x[kind] - measured) / np.where(counts, sd, np.nan) for x in (before, after)), names)
            for kind in kinds
        },
    }


def elsewhere(given: Any, found: Any, runs: Any) -> dict[str, Any]:
    """Improvement of the model over the refit for runs at other conditions, and errors by channel.

    The blocks of `prediction` also choose the written model. These runs chose nothing. The score uses the same
    density of errors over the stated sds, empty if the model is the refit.

    Args:
        runs: further runs of the same robot, with an equal number, so that programs are shared.
    """
    from calibration.discovery import prediction
    from calibration.discovery.loop_input import build_candidate_space

    space, base, best = found.screened.base.space, found.screened.base.candidate, found.best
    if best is base:
        return {}
    measured, sd, rows = runs.measured(), runs.deviations(), len(runs)
    there = build_candidate_space(runs, given.robot, sd, given.settings, given.stated, given.library)
    if there.library.names != space.library.names or there.coordinates.base.names != space.coordinates.base.names:
        return {}
    off, score = [], []
    for candidate in (base, best):
        fitted = prediction.FittedProblem(there.equipped, candidate.z, there.coordinates.indices(candidate.active))
        seen = fitted.observation()
        lost = there.equipped.observe.unreachable(np.asarray(seen.status))[:rows, None]
        off.append(np.where(lost, np.nan, (np.asarray(seen.reading)[:rows] - measured) / sd))
        counted = np.where(np.isfinite(off[-1]), off[-1], prediction.UNREACHED)
        score.append(-(prediction.FREEDOM + 1) / 2 * np.log1p(counted**2 / prediction.FREEDOM))
    gain = (score[1] - score[0]).mean(1)
    return {
        "gain": [float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(rows))],
        "rms_sigma": _rms(*off, [channel.name for channel in runs.channels]),
    }


def _rms(before: np.ndarray, after: np.ndarray, names: Sequence[str]) -> dict[str, list[float]]:
    """Channel → rms errors of the refit and of the model [σ] over the rows that both predict, and rows of each."""
    both = np.isfinite(before) & np.isfinite(after)
    return {
        name: [
            *(
                float(np.sqrt(np.mean(x[both[:, k], k] ** 2))) if both[:, k].any() else float("nan")
                for x in (before, after)
            ),
            *(int(np.isfinite(x[:, k]).sum()) for x in (before, after)),
        ]
        for k, name in enumerate(names)
    }
