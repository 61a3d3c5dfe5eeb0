"""Power balance of fits: an effect may be negative if its whole balance still dissipates."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Names
from calibration.discovery.active_set import CandidateSpace
from calibration.inference.observers import Observer
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.model.energy import sink_powers
from mmrjax.model.robot import Robot

#: The sink of `energy.SINKS` that contains the whole power of a balance.
SINK = {
    "supply": "driver", "electrical": "winding", "motor": "motor", "gearbox": "gearbox", "track": "track",
    "ground": "rolling", "slip": "sliding",
}  # fmt: skip
#: Rounding error of a power, as a share of the largest in its balance.
ROUNDING = 1e-9


def supplying_effects(space: CandidateSpace, active: Sequence[str], amplitude: np.ndarray, z: np.ndarray) -> Names:
    """Dissipative effects of negative amplitude with a balance that would supply power in an included row.

    An effect corrects the law of its balance. A negative one means that the law takes too much. Histories and turns
    have no operating point for each row and are judged only by the sign of the term.

    Args:
        active: name of the effect in each slot.
        amplitude: of each.
        z: coordinates of the fit.
    """
    negative = [n for n, a in zip(active, amplitude, strict=True) if n and a <= 0 and space.library[n].dissipative]
    if not negative or space.bare.observe.long:
        return tuple(negative)
    power = _dissipated_power(space.bare.observe, space.problem(active).robot(jnp.asarray(z)))
    if power is None:
        return tuple(negative)
    power_by_balance = dict(zip(SINK, np.asarray(power)[:, space.included], strict=True))
    return tuple(n for n in negative if not _dissipates(power_by_balance.get(space.library[n].balance)))


def _dissipates(power: np.ndarray | None) -> bool:
    """True if a balance takes power in every row with a known power, and there is at least one."""
    if power is None or not np.isfinite(power).any():
        return False
    return bool(np.nanmin(power) >= -ROUNDING * np.nanmax(np.abs(power)))


@functools.partial(compiled, options=SELDOM)
def _dissipated_power(observe: Observer, robot: Robot) -> Float[Array, "balances rows"] | None:
    """Power that each balance of `SINK` takes in each row [W], None if rows have no operating point."""
    signals = observe.operating(robot)
    if signals is None:
        return None
    power = jax.vmap(lambda run, at: sink_powers(robot, run, at))(observe.conditions, signals)
    return jnp.stack([jnp.asarray(power[name], float) for name in SINK.values()])
