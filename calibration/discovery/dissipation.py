"""Power that a fit's balances take: an effect may be negative where its whole balance still dissipates."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.discovery.active_set import CandidateSpace
from calibration.inference.observers import Observer
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.model.energy import sinks
from mmrjax.model.robot import Robot

#: The sink of `energy.SINKS` that holds all that a balance takes.
SINK = {
    "supply": "driver", "electrical": "winding", "motor": "motor", "gearbox": "gearbox", "track": "track",
    "ground": "rolling", "slip": "sliding",
}  # fmt: skip
#: Share of the largest power of a balance that rounding may make of none.
ROUNDING = 1e-9


def supplying(space: CandidateSpace, active: Sequence[str], amplitude: np.ndarray, z: np.ndarray) -> tuple[str, ...]:
    """Dissipative effects of negative amplitude whose balance would supply power in a row that counts.

    An effect corrects the law of its balance: below zero it says that the law takes too much. Histories and turns,
    which have no operating point for each row, are judged by the sign of the term alone.

    Args:
        active: name of the effect in each slot; amplitude: of each; z: coordinates of the fit.
    """
    negative = [n for n, a in zip(active, amplitude, strict=True) if n and a <= 0 and space.library[n].dissipative]
    if not negative or space.bare.observe.long:
        return tuple(negative)
    power = _taken(space.bare.observe, space.problem(active).robot(jnp.asarray(z)))
    if power is None:
        return tuple(negative)
    taken = dict(zip(SINK, np.asarray(power)[:, space.included], strict=True))
    return tuple(n for n in negative if not _dissipates(taken.get(space.library[n].balance)))


def _dissipates(power: np.ndarray | None) -> bool:
    """True where a balance takes power in every row in which that is known, and is known in one."""
    if power is None or not np.isfinite(power).any():
        return False
    return bool(np.nanmin(power) >= -ROUNDING * np.nanmax(np.abs(power)))


@functools.partial(compiled, options=SELDOM)
def _taken(observe: Observer, robot: Robot) -> Float[Array, "balances rows"] | None:
    """Power that each balance of `SINK` takes in every row [W]; None where rows have no operating point."""
    signals = observe.operating(robot)
    if signals is None:
        return None
    found = jax.vmap(lambda run, at: sinks(robot, run, at))(observe.conditions, signals)
    return jnp.stack([jnp.asarray(found[name], float) for name in SINK.values()])
