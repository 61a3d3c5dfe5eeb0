"""How a calibration treats each fidelity (a stand-in until the registry of fidelities holds these facts)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from mmrjax.conditions import Conditions
from mmrjax.fidelities.drive import drive_batch
from mmrjax.robot import Robot
from mmrjax.signals import CONVERGED

#: Length of a run of `drive` from standstill after which it should have settled [s].
SETTLED = 4.0


class Effort(NamedTuple):
    """What a calibration does where it is not stated: searches, profiles, and fits without each block."""

    starts: int
    profiles: bool
    blocks: bool


def no_cautions(robot: Robot, conditions: Conditions) -> list[str]:
    """Nothing."""
    return []


def too_stiff(robot: Robot, conditions: Conditions) -> list[str]:
    """A sentence if the track model's step is too long for some row, so that its readings are not to be trusted."""
    from mmrjax.fidelities.stability import largest_step
    from mmrjax.fidelities.track import STEP

    limits = largest_step(robot, conditions)
    rows = ", ".join(str(k + 1) for k in np.flatnonzero(limits < STEP))
    if not rows:
        return []
    return [
        f"rows {rows}: the track model's step of {STEP:g} s is above the largest stable one of the calibrated robot, "
        f"{limits.min():.2g} s, so its readings there are not to be trusted; V_s is too small for μ_s"
    ]


def from_standstill(robot: Robot, conditions: Conditions) -> list[str]:
    """A sentence if `drive` settles on some row only because it was rolling."""
    run = drive_batch(robot, conditions, jnp.asarray([0.0, SETTLED]))
    rows = ", ".join(str(k + 1) for k in np.flatnonzero(np.asarray(run.result.status) != CONVERGED))
    if not rows:
        return []
    return [
        f"rows {rows}: read from a rolling start; from standstill the calibrated robot does not settle there within "
        f"{SETTLED:g} s, since it starts by sliding at μ_d"
    ]


@dataclasses.dataclass(frozen=True)
class Treatment:
    """How a calibration treats one fidelity.

    Attributes:
        effort: where the user states none. A profile is some twenty refits a parameter, and blocks are a dozen:
            seconds with `steady`, many minutes of rollouts.
        guides_are_output: whether the share of the weight that the guides carry is a result of the model, not a
            parameter of it.
        cautions: what to know before the readings of a calibrated robot are trusted, by (robot, conditions of
            settled rows).
    """

    effort: Effort
    guides_are_output: bool = False
    cautions: Callable[[Robot, Conditions], list[str]] = no_cautions


_TREATMENTS = {
    "steady": Treatment(Effort(64, True, True)),
    "drive": Treatment(Effort(1, False, False), cautions=from_standstill),
    "track": Treatment(Effort(1, False, False), guides_are_output=True, cautions=too_stiff),
}


def of(fidelity: str) -> Treatment:
    """The treatment of a fidelity, by its name."""
    return _TREATMENTS[fidelity]
