"""A pass of the loop as plain data: verdict, effects, errors before and after, for `result.json`."""

from __future__ import annotations

import dataclasses
import inspect
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data.runs import CHANNELS, CONDITIONS, MEASURED, MM, RPM
from calibration.discovery import active_set as slots
from calibration.discovery import bases as curve_room
from calibration.discovery import discrepancy as discover
from calibration.discovery import experiments as experiment
from calibration.discovery import score_tests as trace
from calibration.discovery.discrepancy import Discrepancy
from calibration.discovery.loop import Finding, Gate, Hypothesis, Loop, Round
from calibration.discovery.score_tests import PROBED, Linear
from calibration.inference import blocks as holdout
from calibration.inference import priors
from calibration.inference.errors import channel_errors, summary
from mmrjax.balances import BALANCES
from mmrjax.effects import Effect
from mmrjax.robot import Robot

SCHEMA = "mmrjax.loop/1"
#: Kinds of block whose held-out errors are reported, the first that the data have in `errors`.
KINDS = ("slope", "voltage_configuration", "voltage", "payload", "configuration")
#: The same for histories, whose fits take longer.
KINDS_SERIES = ("slope", "voltage", "run")
#: Rise of the objective [σ²] up to which a hypothesis is listed as an alternative.
ALTERNATIVE = 9.0


@dataclasses.dataclass(frozen=True)
class Readings:
    """What base and proposed robot say of every row [SI], fitted and held out; shape (rows, 3), NaN where nothing.

    Attributes:
        before, after: of the fits to all rows.
        held_out: kind of block → (before, after), each row by fits that have not seen its block.
        blocks: kind → label → mask of rows.
    """

    before: np.ndarray
    after: np.ndarray
    held_out: dict[str, tuple[np.ndarray, np.ndarray]]
    blocks: dict[str, dict[str, np.ndarray]]


def discrepancy(loop: Loop, found: Finding) -> Discrepancy | None:
    """The smooth curve of an `unnamed` verdict, fitted with the base; None for the others."""
    if found.verdict != "unnamed" or found.unnamed is None:
        return None
    return discover.discover(loop, found.base.hypothesis, found.base.linear, *found.unnamed[:2])


def readings(loop: Loop, found: Finding, curve: Discrepancy | None = None) -> Readings:
    """Fitted and held-out readings, for every kind of block; `curve` is what came after, if any."""
    rows = len(loop.runs)

    def fitted(h: Hypothesis) -> np.ndarray:
        seen = loop.engine.observe(loop.problem_of(h), jnp.asarray(h.z))
        lost = loop.problem.unreachable(np.asarray(seen.status))[:rows, None]
        return np.where(lost, np.nan, np.asarray(seen.reading)[:rows])

    base, after = found.base.hypothesis, found.after.hypothesis
    blocks: dict[str, dict[str, np.ndarray]] = {}
    for kind in KINDS_SERIES if loop.engine.series else KINDS:
        by = holdout.blocks(loop.runs, kind)
        if not any(_alike(by, other) for other in blocks.values()):
            blocks[kind] = by
    held = {}
    for kind, by in blocks.items():
        if by:
            masks = list(by.values())
            before = later = loop.held_out(base, masks)[0]
            if curve is not None:
                later = discover.held_out(loop, curve, masks)[0]
            elif after is not base:
                later = loop.held_out(after, masks)[0]
            held[kind] = (before, later)
    later = fitted(after) if curve is None else curve.reading
    return Readings(fitted(base), later, held, {k: b for k, b in blocks.items() if b})


def _alike(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    """Whether two kinds of block divide the rows alike."""
    return {m.tobytes() for m in a.values()} == {m.tobytes() for m in b.values()}


def robot(loop: Loop, found: Finding, curve: Discrepancy | None = None) -> Robot:
    """The robot that the loop proposes: its base fitted, with what was found and no other effect."""
    if curve is not None:
        return curve.robot
    h = found.after.hypothesis
    whole = loop.problem_of(h).robot(jnp.asarray(h.z))
    keep = {loop.engine.names[k] for k in h.effects} | {e.name for e in loop.engine.base.effects}
    return dataclasses.replace(whole, effects=tuple(e for e in whole.effects if e.name in keep))


def equation(effect: Effect) -> tuple[str, str]:
    """Equation and source of an effect, from its docstring."""
    head, _, source = (inspect.getdoc(type(effect)) or "").partition("Source:")
    return " ".join(head.split()), " ".join(source.split())


def document(loop: Loop, found: Finding, seen: Readings, curve: Discrepancy | None = None) -> dict[str, Any]:
    """Everything that the loop found, as JSON-able data."""
    counts = loop.counts[: len(loop.runs)]
    chi2 = (2 * found.base.hypothesis.cost, 2 * found.after.hypothesis.cost) if curve is None else curve.chi2
    after = found.after if curve is None else loop.round_of(curve.problem, curve.z, found.base)
    return {
        "schema": SCHEMA,
        "verdict": found.verdict,
        "statement": statement(loop, found),
        "rows": len(loop.runs),
        "rows_used": int(counts.sum()),
        "rows_unusable": [int(loop.numbers[k]) for k in found.unusable],
        "rows_outliers": [int(loop.numbers[k]) for k in found.outliers],
        "effects": effects_found(loop, found, curve),
        "next_experiment": next_experiment(loop, found),
        "remains": remains(found) if found.verdict in ("named", "class") else None,
        "cannot_see": [loop.engine.names[k] for k in found.invisible],
        "needs_series": needs_series(loop),
        "series": series(loop, found.base, after) if loop.engine.series else None,
        "alternatives": alternatives(loop, found),
        "implausible": alternatives(loop, found, plausible=False),
        "errors": errors(loop, seen, counts),
        "errors_percent_of": ("simulated reading, eq. (35)", "channel's root mean square")[loop.engine.series],
        "held_out_by": held_out_errors(loop, seen, counts),
        "adequate": {"before": not found.base.gate.open, "after": not after.gate.clear},
        "evidence": {"before": evidence(found.base.gate), "after": evidence(after.gate)},
        "chi2": {"before": float(chi2[0]), "after": float(chi2[1]), "readings": int(3 * counts.sum())},
        "base_shift": base_shift(loop, found, curve),
        "scores": scores(loop, found.base),
        "bootstrap": {
            "replicates": len(found.base.gate.null.single), "asked": loop.replicates, "seed": loop.seed,
            "family_wise_error": sum(loop.alpha.values()), "shares": loop.alpha,
        },
    }  # fmt: skip


def needs_series(loop: Loop) -> list[str]:
    """Effects of the library that settled runs cannot show."""
    return [] if loop.engine.series else sorted(n for n, e in loop.engine.library.items() if e.transient)


def statement(loop: Loop, found: Finding) -> str:
    """The verdict in one sentence."""
    p = found.base.gate.p_value
    if found.verdict == "none":
        return f"Nothing is missing: what the fitted model leaves is what noise leaves (family-wise p = {p:.2g})."
    if found.verdict == "unnamed":
        balance, variable, alike = found.unnamed  # type: ignore[misc]
        others = [b for b in alike if b != balance]
        also = f" (or {', '.join(others)}, which act alike in these data)" if others else ""
        return (
            f"Something is missing in the balance {balance}{also}, best shown over {variable.replace('_', ' ')}, "
            f"and no effect of the library explains it (family-wise p {said_p(p)})."
        )
    names = []
    for members in found.classes:
        words = [loop.engine.names[k] for k in members]
        unsure = f"one of {', '.join(words)} (these data cannot tell which)"
        names.append(words[0] if len(words) == 1 else unsure)
    left = "" if found.unnamed is None else f" Something remains in the balance {found.unnamed[0]}."
    return f"Missing: {'; '.join(names)} (family-wise p {said_p(p)}).{left}"


def said_p(p: float) -> str:
    """A p-value in words; a small one, of which the bootstrap knows little, as a bound rounded up."""
    if p > 0.01:
        return f"= {p:.2g}"
    step = 10.0 ** math.floor(math.log10(p))
    return f"≤ {math.ceil(p / step - 1e-9) * step:.1g}"


def next_experiment(loop: Loop, found: Finding) -> dict[str, Any] | None:
    """What to do next, with the whole menu; None where nothing is left to tell apart."""
    proposal = experiment.propose(loop, found)
    if proposal is None:
        return None
    return {
        "name": proposal.name, "experiments": list(proposal.experiments), "description": proposal.description,
        "separates": list(proposal.separates),
        "expected_sigma": proposal.expected_sigma, "settles": proposal.settles,
        "menu": [
            {
                "name": r.experiments[0], "smallest_sigma": r.smallest, "separates": list(r.separates),
                "chance_worst": float(r.chances.min()), "chance_mean": float(r.chances.mean()),
            }
            for r in proposal.table
        ],
    }  # fmt: skip


def effects_found(loop: Loop, found: Finding, curve: Discrepancy | None = None) -> list[dict[str, Any]]:
    """Each effect of the verdict, with its class, amplitude and evidence; for `unnamed` its balance."""
    if curve is not None:
        balance, variable, alike = found.unnamed  # type: ignore[misc]
        formula = curve.proposal
        return [
            {
                "name": "unnamed", "class": [], "balance": balance, "balances_alike": list(alike),
                "variable": variable, "unit": curve.unit, "equation": None, "parameters": {},
                "p_value": found.base.gate.p_value,
                "score": float(curve.chi2[0] - curve.chi2[1]), "effect": curve.effect,
                "score_free_in_each_run": free_in_each_run(loop, found),
                "curve": {
                    "at": curve.grid.tolist(), "value": curve.curve.tolist(), "sd": curve.sd.tolist(),
                    "unit": curve.unit,
                },
                "proposal": {
                    "formula": formula.formula, "mark": formula.mark, "coefficients": list(formula.coefficients),
                    "sds": list(formula.sds), "bic_gain_over_curve": formula.gain, "tried": formula.tried,
                },
            }
        ]  # fmt: skip
    after, size = found.after.hypothesis, loop.engine.size
    gains = without(loop, found) if found.classes else []
    null = np.asarray(found.base.gate.null.single) ** 2
    listed = []
    for slot, members in enumerate(found.classes):
        k = members[0]
        effect, p = loop.engine.effects[k], len(loop.coordinates.base)
        amplitude, unit = slots.amplitude_of(effect), slots.amplitude_of(effect).spec.prior_sd(0.0)
        value, sd = after.amplitude[slot] * unit, slots.WIDE * after.sd[p + slot] * unit
        values = {amplitude.name: {"value": float(value), "sd": float(sd), "unit": amplitude.spec.unit}}
        shape = slots.shape_of(effect)
        if shape is not None:
            of = lambda z: slots.shaped(slots.shape_scales(shape), z)  # noqa: B023, E731
            value, slope = jax.value_and_grad(of)(jnp.asarray(after.z[p + size + slot]))
            sd = float(slope) * after.sd[p + size + slot]
            values[shape.name] = {"value": float(value), "sd": float(sd), "unit": shape.spec.unit}
        words, source = equation(effect)
        listed.append(
            {
                "name": effect.name, "class": [loop.engine.names[j] for j in members], "balance": effect.balance,
                "unit": BALANCES[effect.balance][0], "equation": words, "source": source, "parameters": values,
                "p_value": (1 + int(np.sum(null >= gains[slot]))) / (1 + len(null)), "score": float(gains[slot]),
                "members": {loop.engine.names[j]: member(loop, found, slot, j) for j in members},
            }
        )  # fmt: skip
    return listed


def free_in_each_run(loop: Loop, found: Finding) -> float | None:
    """What the wave that was located explains with a phase of its own in each run [σ²]; None for other curves."""
    where, over, _ = found.unnamed  # type: ignore[misc]
    if over not in curve_room.ORDERS:
        return None
    return float(np.asarray(found.base.scores.explained)[curve_room.names(loop.curves).index((where, over))])


def member(loop: Loop, found: Finding, slot: int, j: int) -> dict[str, float]:
    """Amplitude that an effect of a class takes in the leader's place, and what the data say against it [σ²]."""
    after = found.after.hypothesis
    which = list(after.which)
    which[slot] = j
    h = next(x for x in (after, *found.ladder) if sorted(x.which) == sorted(which))
    unit = slots.amplitude_of(loop.engine.effects[j]).spec.prior_sd(0.0)
    return {"amplitude": float(h.amplitude[h.which.index(j)] * unit), "rise_chi2": float(2 * (h.cost - after.cost))}


def without(loop: Loop, found: Finding) -> list[float]:
    """What each effect explains that the others cannot: the rise of χ² when it is taken away and all is refitted."""
    after = found.after.hypothesis
    fewer = [tuple(-1 if s == slot else k for s, k in enumerate(after.which)) for slot in range(len(after.effects))]
    if len(fewer) == 1:
        return [2 * (found.base.hypothesis.cost - after.cost)]
    return [2 * (h.cost - after.cost) for h in loop.fit_all([(w, loop.start(after, w)) for w in fewer])]


def series(loop: Loop, before: Round, after: Round) -> dict[str, Any]:
    """What only histories tell: memory of the residual, waves in shaft angle, drift in time, before and after.

    A wave or a drift is given for the balance in which it explains most; `deviate` is its score as a normal
    deviate, `explained` the fall of χ² [σ²] in sines and cosines of each run, or a smooth curve over time.
    """
    rows = np.asarray(loop.problem.observe.rows)
    names = curve_room.names(loop.curves)
    words = [w for w in curve_room.ORDERS if any(n[1] == w for n in names)]

    def strongest(r: Round, variable: str) -> dict[str, Any]:
        mine = [k for k, n in enumerate(names) if n[1] == variable]
        k = max(mine, key=lambda j: np.asarray(r.scores.curve)[j])
        return {
            "balance": names[k][0], "deviate": float(r.scores.curve[k]), "explained": float(r.scores.explained[k])
        }  # fmt: skip

    def told(r: Round) -> dict[str, Any]:
        lags = min(trace.LAGS, rows.shape[1] // 4)
        return {
            "memory": {
                "deviate": float(r.gate.found.white), "threshold": r.gate.threshold("white"),
                "p": r.gate.p("white"), "lags": lags, "autocorrelation": autocorrelation(r.linear, lags),
            },
            "orders": [{"order": w, "a_turn": curve_room.ORDERS[w][0], **strongest(r, w)} for w in words],
            "drift": strongest(r, "time"),
        }  # fmt: skip

    return {
        "runs": len(rows), "samples": int((rows >= 0).sum()),
        "orders_unresolved": [w for w in curve_room.ORDERS if w not in words],
        "before": told(before), "after": told(after),
    }  # fmt: skip


def autocorrelation(linear: Linear, lags: int) -> dict[str, list[float]]:
    """Of each channel's residual over all runs, at lags 1 to `lags` samples."""
    rows = np.asarray(linear.series.rows)  # type: ignore[union-attr]
    x = np.where(rows[:, :, None] < 0, 0.0, np.asarray(linear.residual)[: 3 * linear.rows].reshape(-1, 3)[rows])
    power = np.maximum(np.sum(x**2, (0, 1)), 1e-12)
    of = np.reshape([np.sum(x[:, k:] * x[:, :-k], (0, 1)) / power for k in range(1, lags + 1)], (lags, 3))
    return {c: of[:, k].tolist() for k, c in enumerate(CHANNELS)}


def remains(found: Finding) -> dict[str, Any] | None:
    """What the effects leave beyond doubt: where it is and over what it shows best."""
    if found.unnamed is None:
        return None
    balance, variable, alike = found.unnamed
    return {"balance": balance, "balances_alike": list(alike), "variable": variable}


def alternatives(loop: Loop, found: Finding, plausible: bool = True) -> list[dict[str, Any]]:
    """Hypotheses that explain the data nearly as well as the one proposed, or would but for their size."""
    best = found.after.hypothesis
    if not best.effects:
        return []
    listed = []
    for h in sorted(found.ladder, key=lambda x: x.cost):
        rise = 2 * (h.cost - best.cost)
        if sorted(h.which) != sorted(best.which) and h.plausible == plausible and rise <= ALTERNATIVE:
            sizes = {loop.engine.names[k]: (k, float(a)) for k, a in zip(h.which, h.amplitude, strict=True) if k >= 0}
            units = {n: slots.amplitude_of(loop.engine.effects[k]).spec.prior_sd(0.0) for n, (k, _) in sizes.items()}
            listed.append(
                {
                    "effects": {n: a * units[n] for n, (_, a) in sizes.items()},
                    "prior_sds": {n: a for n, (_, a) in sizes.items()},
                    "rise_chi2": float(rise),
                }
            )
    return listed


def errors(loop: Loop, seen: Readings, counts: np.ndarray) -> dict[str, Any]:
    """Errors before and after, fitted and held out by the first kind of block, over the rows that count."""
    kind = next(iter(seen.held_out), None)
    answer = {}
    for k, when in enumerate(("before", "after")):
        fitted = (seen.before, seen.after)[k]
        held = None if kind is None else _errors(loop, seen.held_out[kind][k], counts)
        answer[when] = {"fitted": _errors(loop, fitted, counts), "held_out": held}
    return answer


def held_out_errors(loop: Loop, seen: Readings, counts: np.ndarray) -> dict[str, Any]:
    """Errors before and after on data held out, by kind of block."""
    return {
        kind: {
            "before": _errors(loop, before, counts), "after": _errors(loop, after, counts),
            "blocks": list(seen.blocks[kind]),
        }
        for kind, (before, after) in seen.held_out.items()
    }  # fmt: skip


def _errors(loop: Loop, simulated: np.ndarray, counts: np.ndarray) -> dict[str, Any]:
    rows = len(loop.runs)
    sd = np.asarray(loop.problem.data.sd)[:rows]
    simulated = np.where(counts[:, None], simulated, np.nan)
    found = channel_errors(simulated, loop.runs.measured(), sd)
    if loop.engine.series:  # eq. (35) divides by readings, which begin at rest
        size = np.sqrt(np.nanmean(simulated**2, 0))
        percent = 100 * (simulated - loop.runs.measured()) / size
        for k, channel in enumerate(CHANNELS):
            found[channel] |= summary(percent[:, k])
    return found


def evidence(gate: Gate) -> dict[str, Any]:
    """The strongest statistic of each kind, what it has to exceed, and its share among bootstrap tables."""
    kinds = {
        kind: {"found": float(getattr(gate.found, kind)), "threshold": gate.threshold(kind), "p": gate.p(kind)}
        for kind in gate.alpha
    }
    return {**kinds, "p_value": gate.p_value}


def base_shift(loop: Loop, found: Finding, curve: Discrepancy | None = None) -> dict[str, dict[str, Any]]:
    """Every base parameter before and after, in its unit and in prior sds."""
    coordinates = loop.coordinates.base
    p = len(coordinates)
    after = found.after.hypothesis
    z_after, sd = (after.z, after.sd) if curve is None else (curve.z, np.sqrt(np.diag(curve.covariance)))
    z = [np.asarray(x[:p]) for x in (found.base.hypothesis.z, z_after)]
    value = [np.asarray(coordinates.value(jnp.asarray(x))) for x in (np.zeros(p), *z)]
    slope = np.asarray(coordinates.slope(jnp.asarray(z[1])))
    fields = priors.known(loop.engine.base)
    return {
        name: {
            "prior": value[0][k], "before": value[1][k], "after": value[2][k], "unit": coordinates.units[k],
            "sd_after": float(slope[k] * sd[k]), "meaning": fields[name].spec.meaning,
            "shift_before": z[0][k], "shift_after": z[1][k],
        }
        for k, name in enumerate(coordinates.names)
    }  # fmt: skip


def scores(loop: Loop, base: Round) -> list[dict[str, Any]]:
    """The score ladder: every effect at its best shape, strongest first."""
    single, left = np.asarray(base.scores.single), np.asarray(base.scores.left)
    listed = []
    for k, name in enumerate(loop.engine.names):
        mine = np.flatnonzero(loop.engine.of == k)
        m = int(mine[np.abs(single[mine]).argmax()])
        unit = slots.amplitude_of(loop.engine.effects[k]).spec.prior_sd(0.0)
        listed.append(
            {
                "name": name, "balance": loop.engine.effects[k].balance, "score": float(single[m] ** 2),
                "amplitude": float(base.scores.amplitude[m] * unit), "sigmas_per_prior_sd": float(left[m]),
            }
        )  # fmt: skip
    return sorted(listed, key=lambda x: -x["score"])


def defects(loop: Loop, r: Round) -> dict[str, np.ndarray]:
    """Defect of each equation in every row [its balance's unit]: what closes the readings' residual there.

    The three channels close three equations; a row's residual (simulated less measured) is split among the
    defects of the balances `electrical`, `track` and `slip` that together make it.
    """
    rows = len(loop.runs)
    if loop.engine.series:
        return {}  # a reading of a history answers to defects of all the time before it
    chosen = ("electrical", "track", "slip")
    sensitivity = np.stack([np.asarray(r.linear.defects)[PROBED.index(b)][:rows] for b in chosen], 2)
    residual = np.asarray(r.linear.residual)[: 3 * len(loop.counts)].reshape(-1, 3)[:rows]
    found = np.full((rows, 3), np.nan)
    for k in np.flatnonzero(loop.counts[:rows]):
        found[k] = -np.linalg.lstsq(sensitivity[k], residual[k], rcond=None)[0]
    return dict(zip(chosen, found.T, strict=True))


def rows_table(loop: Loop, found: Finding, seen: Readings) -> dict[str, np.ndarray]:
    """Conditions, measured, simulated before and after and held out, and the defect of each equation, by row."""
    rows, unit = len(loop.runs), np.array([1.0, RPM, MM])
    table = {
        "row": loop.numbers,
        **{k: loop.runs[k] for k in ("run_id", "time_s", "configuration", *CONDITIONS) if loop.runs.has(k)},
    }
    sd = np.asarray(loop.problem.data.sd)[:rows]
    kind = next(iter(seen.held_out), None)
    for k, (channel, column) in enumerate(zip(CHANNELS, MEASURED, strict=True)):
        table[column], table[f"sd_{column}"] = loop.runs[column], sd[:, k] / unit[k]
        table[f"before_{column}"], table[f"after_{column}"] = seen.before[:, k] / unit[k], seen.after[:, k] / unit[k]
        if kind is not None:
            table[f"held_out_before_{column}"] = seen.held_out[kind][0][:, k] / unit[k]
            table[f"held_out_after_{column}"] = seen.held_out[kind][1][:, k] / unit[k]
        measured = loop.runs.measured()[:, k]
        table[f"residual_before_{channel}_sigma"] = (seen.before[:, k] - measured) / sd[:, k]
        table[f"residual_after_{channel}_sigma"] = (seen.after[:, k] - measured) / sd[:, k]
    for when, r in (("before", found.base), ("after", found.after)):
        for balance, values in defects(loop, r).items():
            table[f"defect_{when}_{balance}"] = values
    words = np.full(rows, "used", dtype="<U8")
    words[list(found.outliers)] = "outlier"
    words[list(found.unusable)] = "unusable"
    table["use"] = words
    return table
