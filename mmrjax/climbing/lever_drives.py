"""Lever drives, Fig. 5b: motor and gears of a pair of levers in one time step.

Each pair has a motor, a planetary gear and a worm. All quantities refer to the levers' shaft: torques are multiplied
by the ratio i = i_p i_w of both gears, speeds are divided by it.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mmrjax.model.gearmotor import Gearbox
from mmrjax.model.params import Pair, Scalar
from mmrjax.model.robot import Robot

#: Pieces of a drive's law: the voltage is at its minimum (-1), its maximum (1), or follows from the demanded rate
#: (0); direction of motion of the levers, 0 at rest; sign of T in motion.
_PIECES = np.array([
    (0, 0, 0),
    *((end, way, sign) for end in (-1, 1) for way, sign in ((0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))),
])  # fmt: skip
#: Current below which a motor counts as currentless [A].
_NONE = 1e-9


class LeverDrive(eqx.Module):
    """Drive of a pair of levers, with all quantities referred to the lever shaft.

    With the motor's torque e = i C_m I, its rotor's i² J_d and friction i M_df (14), and T on the levers,

        e - i² J_d ω' - i M_df = c T,

    c = 1 / (η_p η_w) if T acts with the motion, c = (2 - 1/η_w) (2 - 1/η_p) if it acts against it. The loss in a mesh
    is proportional to its force in both directions of power (`Gearbox.efficiency_backward`). A worm with η_w up to
    1/2 is self-locking: the motor has to help to lower the load, and drives its planetary gear: c = (2 - 1/η_w) /
    η_p. At rest e may have any value between the two.

    Attributes:
        constant: i C_m [N·m/A, V·s/rad].
        resistance: resistance of the winding [ohm].
        inertia: i² J_d [kg·m²].
        dry, viscous: Coulomb friction i M_df0 [N·m] and viscous friction i² K_fd [N·m·s].
        ahead, back: factor c for T with the motion, and against it [-].
        current_limit: current limit of the motor [A].
    """

    constant: Scalar
    resistance: Scalar
    inertia: Scalar
    dry: Scalar
    viscous: Scalar
    ahead: Scalar
    back: Scalar
    current_limit: Scalar

    def against(self, torque: Scalar, direction: float) -> Scalar:
        """Torque c T [N·m] that the motor side must supply for a torque T on levers that move up (`direction` 1) or
        down (-1).
        """
        return jnp.where(torque * direction > 0, self.ahead, self.back) * torque


def lever_drive(robot: Robot) -> LeverDrive:
    """Drive of a pair of levers: the motor with both gears."""
    levers, motor = robot.running_gear.levers, robot.motor
    ratio = levers.worm_ratio * levers.planetary_ratio
    planetary = Gearbox(efficiency_load=levers.planetary_efficiency, mesh_theory=True).efficiency_backward
    worm = 2 - 1 / levers.worm_efficiency
    return LeverDrive(
        constant=ratio * motor.torque_constant,
        resistance=motor.resistance,
        inertia=ratio**2 * motor.inertia,
        dry=ratio * motor.friction_coulomb,
        viscous=ratio**2 * motor.friction_viscous,
        ahead=1 / (levers.worm_efficiency * levers.planetary_efficiency),
        back=worm * jnp.where(worm > 0, planetary, 1 / levers.planetary_efficiency),
        current_limit=levers.current_limit,
    )


class LeverStep(NamedTuple):
    """Result of a time step of both lever drives, each of shape (2,).

    Attributes:
        torque: torque on the levers [N·m].
        rate: angular speed after the step [rad/s].
        voltage, current: voltage and current of their motors [V], [A].
        holds: True if a pair is held by its worm alone, without current.
    """

    torque: Array
    rate: Array
    voltage: Array
    current: Array
    holds: Bool[Array, " 2"]


def step_levers(
    drive: LeverDrive,
    step: Scalar,
    rate: Pair,
    free: Pair,
    yields: Float[Array, "2 2"],
    asked: Pair,
    least: Pair,
    most: Pair,
) -> LeverStep:
    """One time step of both lever pairs: the demanded rates if the voltages suffice, otherwise the rates that the
    voltages give.

    The levers' mechanics give ω = free + yields T after the step. The voltage is chosen between `least` and `most` so
    that ω is the demanded rate. For a lever that has to stand, the smallest voltage that holds it. Each drive's law
    has straight pieces (`_PIECES`). Of all pairs of pieces the one whose solution is on both is taken, or the one
    with the smallest deviation. This is exact and has no iterations. A root finder cannot replace it: where a lever
    stands, its law allows a range of torques and is no function.

    Args:
        step: time step [s].
        rate: angular speed before the step [rad/s].
        free: angular speed after the step without drive torque [rad/s].
        yields: change of the angular speed per drive torque [rad/(N·m·s)].
        asked: demanded angular speeds after the step [rad/s].
        least, most: limits of the motor voltages [V].
    """
    limits = drive.constant * rate + drive.resistance * drive.current_limit * jnp.array([[-1.0], [1.0]])
    least, most = jnp.maximum(least, limits[0]), jnp.minimum(most, limits[1])
    inertia_rate = drive.inertia * (1 / step)
    stiff = inertia_rate + drive.constant**2 / drive.resistance + drive.viscous

    end, way, sign = _PIECES.T
    moves, follows = way != 0, end == 0
    pushed = drive.constant / drive.resistance * jnp.where(end > 0, most[:, None], least[:, None])
    # α T + β ω = γ on a piece, (pairs, pieces)
    alpha = jnp.where(moves, jnp.where(sign * way > 0, drive.ahead, drive.back), 0.0) + 0 * pushed
    beta = jnp.where(moves, stiff, 1.0) + 0 * pushed
    gamma = jnp.where(moves, pushed + inertia_rate * rate[:, None] - way * drive.dry, follows * asked[:, None])

    (a, b), (c, d) = beta[:, None] * yields[:, :, None]
    a, d = (a + alpha[0])[:, None], (d + alpha[1])[None]
    b, c = b[:, None], c[None]
    r, s = ((gamma - beta * free[:, None])[k] for k in range(2))
    r, s = r[:, None], s[None]
    size = a * d - b * c
    torque = jnp.stack([(d * r - b * s) / size, (a * s - c * r) / size])
    lever_rates = free[:, None, None] + jnp.einsum("ij,jkl->ikl", yields, torque)

    def candidate_solutions(k: int, ways: tuple[slice | None, ...]) -> tuple[Array, Array, Array, Array]:
        """Distance of each candidate solution from its piece of the law of lever pair `k` (0: on it) [N·m]. Then i
        C_m I of the motor within the voltage limits [N·m], load torque [N·m] and speed [rad/s]."""
        force, speed = torque[k], lever_rates[k]
        turning = inertia_rate * (speed - rate[k]) + drive.viscous * speed
        up, down = drive.against(force, 1.0) + drive.dry + turning, drive.against(force, -1.0) - drive.dry + turning
        low, high = jnp.where(asked[k] > 0, up, down), jnp.where(asked[k] < 0, down, up)
        weak, strong = (drive.constant / drive.resistance * (x[k] - drive.constant * speed) for x in (least, most))
        on = pushed[k][ways]
        beyond = end[ways] * (speed - asked[k]) * stiff
        standing_excess = jnp.maximum(on - up, down - on)
        goes = jnp.maximum(-way[ways] * speed * stiff, -sign[ways] * force)
        off = jnp.where(
            follows[ways],
            jnp.maximum(low - strong, weak - high),
            jnp.maximum(jnp.where(moves[ways], goes, standing_excess), beyond),
        )
        return jnp.maximum(off, 0.0), jnp.clip(jnp.clip(0.0, low, high), weak, strong), force, speed

    candidates = candidate_solutions(0, (slice(None), None)), candidate_solutions(1, (None, slice(None)))
    off = jnp.nan_to_num(jnp.maximum(candidates[0][0], candidates[1][0]), nan=jnp.inf, posinf=jnp.inf)
    best = jnp.unravel_index(jnp.argmin(off), off.shape)
    best_pair, motor_torques = jnp.stack(best), jnp.stack([pair[1][best] for pair in candidates])
    torque, after = torque[:, *best], lever_rates[:, *best]
    fixed = jnp.where(jnp.asarray(end)[best_pair] > 0, most, least)
    stands = jnp.where(jnp.asarray(follows)[best_pair], asked == 0, ~jnp.asarray(moves)[best_pair])
    after = jnp.where(stands, 0.0, after)
    voltage = jnp.where(
        jnp.asarray(follows)[best_pair],
        drive.resistance / drive.constant * motor_torques + drive.constant * after,
        fixed,
    )
    current = (voltage - drive.constant * after) / drive.resistance
    return LeverStep(torque, after, voltage, current, stands & (jnp.abs(current) < _NONE))
