"""A calibration as plain data: parameters, errors before and after, what holds what, for `result.json`."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from calibration.data.runs import CHANNELS, CONDITIONS, MEASURED, MM, RPM
from calibration.inference import priors
from calibration.inference.calibrate import Calibration
from calibration.inference.errors import channel_errors, relative_error
from calibration.inference.identifiability import Z95
from calibration.inference.problem import MARGIN
from mmrjax.signals import STATUSES

SCHEMA = "mmrjax.calibrate/1"
#: Kind of block whose errors `errors.*.held_out` gives, the first that the data have.
MAIN_BLOCKS = ("slope", "voltage_configuration", "run")


def document(c: Calibration) -> dict[str, Any]:
    """Everything that a calibration found, as JSON-able data."""
    about = c.identifiability
    return {
        "schema": SCHEMA,
        "model": c.model,
        "rows": len(c.runs),
        "parameters": parameters(c),
        "tied": {f: f"{ratio:.4g} x {about.names[k]}" for f, k, ratio in c.problem.coordinates.tied},
        "noise": noise(c),
        "errors": errors(c),
        "held_out_by": {kind: held_out_errors(c, kind) for kind in c.held_out},
        "optimizer": {
            "method": "optimistix.LevenbergMarquardt",
            "status": "converged" if c.converged else "not_converged",
            "objective": c.cost,
            "starts": len(c.starts.cost),
            "starts_infeasible": c.starts.infeasible,
            "starts_at_best": c.starts.agree,
            "agreement": c.starts.statement(),
            "seed": c.seed,
        },
        "chi2": chi2(c),
        "identifiability": {
            "singular_values": about.singular_values.tolist(),
            "rank": about.rank,
            "directions_better_known_from_data": int(np.sum(about.singular_values > 1)),
            "weak_directions": [{"singular_value": s, "components": v} for s, v in about.weak_directions()],
            "correlated": [{"a": a, "b": b, "correlation": r} for a, b, r in about.correlated()],
        },
        "statuses_before": _counts(c.status_before),
        "statuses": _counts(c.status_after),
        "notes": [*c.notes, *remarks(c)],
    }


def _counts(status: np.ndarray) -> dict[str, int]:
    return {name: int(np.sum(status == k)) for k, name in enumerate(STATUSES)}


def parameters(c: Calibration) -> dict[str, dict[str, Any]]:
    """Every free parameter: value, sd and 95 % interval [SI], prior, and what holds it.

    The sd is the linear one; the interval is that of the profile where there is one.
    """
    coordinates, about, z = c.problem.coordinates, c.identifiability, jnp.asarray(c.z)
    value, slope = np.asarray(coordinates.value(z)), np.asarray(coordinates.slope(z))
    linear = [np.asarray(coordinates.value(z + sign * Z95 * jnp.asarray(about.sd))) for sign in (-1, 1)]
    median = np.asarray(coordinates.value(jnp.zeros_like(z)))
    wide = [np.asarray(coordinates.value(jnp.full_like(z, sign * Z95))) for sign in (-1, 1)]
    beyond = coordinates.beyond(c.z)
    fields = priors.known(c.base)
    found: dict[str, dict[str, Any]] = {}
    for k, name in enumerate(about.names):
        profile = c.profile
        found[name] = {
            "value": value[k],
            "sd": about.sd[k] * slope[k],
            "interval": [linear[0][k], linear[1][k]] if profile is None else [profile.low[k], profile.high[k]],
            "interval_linear": [linear[0][k], linear[1][k]],
            "interval_open": [False, False] if profile is None else profile.open[k].tolist(),
            "unit": coordinates.units[k],
            "meaning": fields[name].spec.meaning,
            "prior": {
                "family": "log-normal" if coordinates.scale[k] else "normal",
                "median": median[k],
                "interval": [wide[0][k], wide[1][k]],
                "source": _source(c, name, fields[name].spec.source),
            },
            "shift_in_prior_sd": c.z[k],
            "variance_ratio": about.sd[k] ** 2,
            "held_by_prior": bool(about.held_by_prior[k]),
            "at_bound": {-1: "lower", 0: None, 1: "upper"}[int(beyond[k])],
            "measured_by_data": bool(about.sensitivity[k] > 1e-6),
        }
        if c.beside is not None:
            found[name]["with_steady"] = {
                "value": float(coordinates.value(jnp.asarray(c.beside))[k]),
                "apart_in_sd": float((c.z[k] - c.beside[k]) / about.sd[k]),
            }
    return found


def _source(c: Calibration, name: str, field: str) -> str:
    if name in c.problem.coordinates.stated:
        return "stated"
    if c.model == "track" and name == priors.GUIDE_FRICTION:
        return "its product with the share of the guides, as in the other fidelities"
    return field


def noise(c: Calibration) -> dict[str, Any]:
    """Where each channel's sd comes from, and its size."""
    share = c.sd / np.maximum(np.abs(c.runs.measured()), 1e-12)
    return {
        channel: {
            "source": c.noise.source[k],
            "median_percent": 100 * float(np.median(share[:, k])),
            "estimated_percent": 100 * c.shares[k] if c.noise.estimated[k] else None,
        }
        for k, channel in enumerate(CHANNELS)
    }


def _errors(simulated: np.ndarray, c: Calibration) -> dict[str, dict[str, Any]]:
    return channel_errors(simulated, c.runs.measured(), c.sd)


def main_kind(c: Calibration) -> str | None:
    """The kind of blocks that stands for `held_out`."""
    return next((kind for kind in MAIN_BLOCKS if kind in c.held_out), None)


def errors(c: Calibration) -> dict[str, dict[str, Any]]:
    """Errors (35) and in σ, before and after, fitted and held out, by channel.

    Before, nothing is fitted, so both are the same. `rows` counts the rows that the model reaches: a robot
    that slides where the real one climbed has no reading there, which `held_out_by` and the statuses say.
    """
    kind = main_kind(c)
    before = _errors(c.before, c)
    return {
        "before": {"fitted": before, "held_out": before},
        "after": {
            "fitted": _errors(c.after, c),
            "held_out": None if kind is None else _errors(c.held_out[kind].reading, c),
        },
    }


def held_out_errors(c: Calibration, kind: str) -> dict[str, Any]:
    """Errors on blocks that the fit had not seen, in all and block by block."""
    held = c.held_out[kind]
    lost = c.problem.unreachable(held.status)
    each = {}
    for k, label in enumerate(held.labels):
        inside = held.block == k
        each[label] = {
            **_errors(np.where(inside[:, None], held.reading, np.nan), c),
            "unreachable_rows": (np.flatnonzero(inside & lost) + 1).tolist(),
            "converged": bool(held.converged[k]),
        }
    return {"all": _errors(held.reading, c), "unreachable_rows": (np.flatnonzero(lost) + 1).tolist(), "blocks": each}


def chi2(c: Calibration) -> dict[str, Any]:
    """Misfit of the readings, and the degrees of freedom that the fit leaves them."""
    value = float(np.sum(((c.after - c.runs.measured()) / c.sd) ** 2))
    freedom = float(c.sd.size - c.identifiability.leverage.sum())
    return {
        "value": value,
        "degrees_of_freedom": freedom,
        "tests_adequacy": not bool(c.noise.estimated.any()),
    }


def remarks(c: Calibration) -> list[str]:
    """What a careful engineer would say of this calibration, one sentence each."""
    about, said = c.identifiability, []
    names = np.asarray(about.names)
    estimated = [
        f"{ch.replace('_', ' ')} {100 * s:.1f} %" for ch, s in zip(CHANNELS, c.shares, strict=True) if s == s
    ]
    if estimated:
        said.append(
            f"no noise was stated for {', '.join(estimated)}: estimated from the misfit, so it holds model error too "
            "and cannot test whether the model is adequate"
        )
    if not c.converged:
        said.append("the search did not converge; values and intervals are not to be trusted")
    said += _beside(c)
    if c.profile is None:
        said.append("no profiles were made: the intervals are linear, and too symmetric where the model is curved")
    if c.starts.agree < len(c.starts.cost):
        said.append(c.starts.statement())
    for status in np.unique(c.status_after[c.status_after != 0]):
        rows = ", ".join(str(k + 1) for k in np.flatnonzero(c.status_after == status))
        said.append(f"rows {rows}: {STATUSES[status]} with the calibrated robot")
    held = names[about.held_by_prior]
    if held.size:
        said.append(f"the prior says more than the data of: {', '.join(held)}")
    for name, z in zip(names, c.z, strict=True):
        if abs(z) > 3:
            said.append(f"{name} lies {abs(z):.1f} prior sds from its prior: the prior or the model is wrong")
    for name, side in zip(names, c.problem.coordinates.beyond(c.z), strict=True):
        if side:
            said.append(f"{name} is at its {'lower' if side < 0 else 'upper'} bound")
    limited = np.flatnonzero(c.adhesion_used > 1 - MARGIN)
    if limited.size:
        said.append(
            f"rows {', '.join(str(k + 1) for k in limited)} use all the adhesion but the margin of {MARGIN:.0%}: the "
            "limit holds their static friction from below, and the slip that they show is not all explained"
        )
    for chassis in ("tracked", "wheeled"):
        pair = [f"{chassis}.track.guide_friction", f"{chassis}.track.guide_share"]
        if all(p in names for p in pair):
            said.append(f"only the product {pair[0]} x {pair[1]} acts; the priors alone divide it")
        elif pair[1] in names:
            said.append(f"{pair[1]} is found with {pair[0]} held: only their product acts")
    lost = {kind: int(c.problem.unreachable(h.status).sum()) for kind, h in c.held_out.items()}
    said += [
        f"held out by {kind.replace('_', ' and ')}: {n} of {len(c.runs)} rows have no prediction, because the robot "
        "fitted without them slides there; the errors leave them out"
        for kind, n in lost.items()
        if n
    ]
    said += [
        f"a search without a block of {kind} did not converge"
        for kind, h in c.held_out.items()
        if not h.converged.all()
    ]
    return said


def _beside(c: Calibration) -> list[str]:
    """How a calibration with rollouts compares with that of `steady`."""
    if c.beside is None:
        return []
    about, said = c.identifiability, []
    apart = np.abs(c.z - c.beside) / about.sd
    worst = int(apart.argmax())
    inside = int(np.sum(apart < Z95))
    said.append(
        f"{inside} of {len(apart)} parameters lie within their 95 % intervals of the same problem's optimum with "
        f"steady; furthest apart is {about.names[worst]}, {apart[worst]:.2f} sd"
    )
    return said


def rows_table(c: Calibration) -> dict[str, np.ndarray]:
    """Conditions, measured, simulated before and after and held out, errors (35) and in σ, row by row."""
    unit = np.array([1.0, RPM, MM])
    table = {k: c.runs[k] for k in ("run_id", "time_s", "configuration", *CONDITIONS) if c.runs.has(k)}
    kind = main_kind(c)
    for k, (channel, column) in enumerate(zip(CHANNELS, MEASURED, strict=True)):
        table[column] = c.runs[column]
        table[f"sd_{column}"] = c.sd[:, k] / unit[k]
        table[f"before_{column}"] = c.before[:, k] / unit[k]
        table[f"after_{column}"] = c.after[:, k] / unit[k]
        if kind is not None:
            table[f"held_out_{column}"] = c.held_out[kind].reading[:, k] / unit[k]
        with np.errstate(divide="ignore", invalid="ignore"):
            table[f"error_{channel}_percent"] = relative_error(c.after[:, k], c.runs.measured()[:, k])
        table[f"error_{channel}_sigma"] = (c.after[:, k] - c.runs.measured()[:, k]) / c.sd[:, k]
    table["status"] = np.array(STATUSES)[c.status_after]
    return table
