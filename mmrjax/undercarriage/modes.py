"""Natural vibrations of half a robot on its contacts: bounce, pitch, and oscillations of the drive."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linear_sum_assignment

from mmrjax.compile.compiling import compiled
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.undercarriage.half_robot import build_system, mass_matrix, roll, stand
from mmrjax.undercarriage.stability import PROBE, step_derivative

POSITIONS = 12  # of the belt within a pitch of the grousers
#: A mode is named after the coordinate with most of its kinetic energy.
NAMES = ("surge", "bounce", "pitch", "drive", "driven pulley")
#: Damping ratio below which a mode amplifies at its own frequency: 1 / 2ζ above 1.
RESONANT = 0.5
_SWINGS = 0.95  # damping ratio above which a motion does not count as an oscillation


class Mode(NamedTuple):
    """A natural vibration, over the positions of the belt within a pitch.

    Attributes:
        name: one of `NAMES`, chosen by the kinetic energy in its eigenvector.
        frequency: damped natural frequency, averaged over the positions that have the mode [Hz].
        low, high: range of the frequency over the positions [Hz].
        natural: undamped natural frequency |λ| / 2π, averaged [Hz].
        damping: damping ratio ζ = -Re λ / |λ|, averaged [-]. Negative: unstable.
        share: share of its kinetic energy in the coordinate of its name, averaged [-].
        positions: share of the positions that have the mode [-].
    """

    name: str
    frequency: float
    low: float
    high: float
    natural: float
    damping: float
    share: float
    positions: float

    @property
    def amplifies(self) -> bool:
        """True if it is lightly damped at most positions of the belt."""
        return self.damping < RESONANT and self.positions > 0.5

    @property
    def resonant(self) -> bool:
        """True if it amplifies and its frequency changes by less than an octave with the position of the belt.

        Some harmonic always lies within an octave, so a peak there would confirm nothing.
        """
        return self.amplifies and self.high < 2 * self.low

    @property
    def band(self) -> tuple[float, float]:
        """Band of resonance [Hz]: its range or its half-power width f ± ζ f, whichever is wider."""
        width = abs(self.damping) * self.frequency
        return min(self.low, self.frequency - width), max(self.high, self.frequency + width)


def modes(robot: Robot, conditions: Conditions, positions: int = POSITIONS) -> list[list[Mode]]:
    """Oscillatory modes of each run of a batch, the lowest first.

    The robot rolls at the speed of the steady fidelity, with height and pitch in equilibrium. The derivative J of a
    step h with respect to the state gives dy/dt = (J - 1) y / h and its eigenvalues λ. J is also used for the largest
    stable step. It includes friction, belt, motor and winding.

    Args:
        robot, conditions: a batch of runs.
        positions: positions of the belt, evenly over a pitch of the grousers.
    """
    rates, masses = jax.device_get(_linearised_steps(params.without_weak_types(robot), conditions, positions))
    return [_run_modes(rate, mass) for rate, mass in zip(rates, masses, strict=True)]


@compiled
def _linearised_steps(
    robot: Robot, conditions: Conditions, positions: int
) -> tuple[Float[Array, "runs positions 11 11"], Float[Array, "runs positions 5 5"]]:
    def one(conditions: Conditions) -> tuple[Array, Array]:
        run = build_system(robot, conditions, PROBE)
        rolling = roll(run)

        def at(turned: Array) -> tuple[Array, Array]:
            motion = eqx.tree_at(lambda m: m.q, rolling, stand(run, turned).q)
            return (step_derivative(run, motion) - jnp.eye(11)) / PROBE, mass_matrix(run, motion)

        return jax.vmap(at)(jnp.arange(positions) / positions * run.path.pitch / run.path.radius)

    return jax.vmap(one)(conditions)


def _run_modes(rates: Float[np.ndarray, "positions 11 11"], masses: Float[np.ndarray, "positions 5 5"]) -> list[Mode]:
    """The modes of one run, from its linearisation at each position."""
    modes_by_name: dict[str, list[tuple[complex, float]]] = {}
    for rate, mass in zip(rates, masses, strict=True):
        if not np.isfinite(rate).all():
            continue
        values, vectors = np.linalg.eig(rate)
        swings = (values.imag > 0) & (-values.real < _SWINGS * np.abs(values))
        velocity = vectors[5:10, swings]
        energy = np.abs(np.real(velocity.conj() * (mass @ velocity)))
        shares = (energy / energy.sum(axis=0)).T
        for k, name in zip(*linear_sum_assignment(-shares), strict=True):
            modes_by_name.setdefault(NAMES[name], []).append((values[swings][k], shares[k, name]))
    answer = []
    for name, members in modes_by_name.items():
        value, share = np.array([m[0] for m in members]), np.array([m[1] for m in members])
        damped, size = value.imag / (2 * np.pi), np.abs(value)
        numbers = (damped.mean(), damped.min(), damped.max(), (size / (2 * np.pi)).mean())
        ratios = ((-value.real / size).mean(), share.mean(), len(members) / len(rates))
        answer.append(Mode(name, *map(float, numbers), *map(float, ratios)))
    return sorted(answer, key=lambda mode: mode.frequency)
