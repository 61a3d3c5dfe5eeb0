"""Levers: the belt around two pulleys of different radius, and the drives of a pair of levers, Fig. 5b.

The frame has its origin on the first pulley's axle and its first axis towards the second pulley. The belt runs
clockwise: along the lower run to the first pulley, up, along the upper run to the second, down. The coordinate of a
point is its distance along the path from the middle of the lower run.

Each pair of levers has a motor, a planetary gear and a worm. All quantities refer to the levers' shaft: torques are
multiplied by the ratio i = i_p i_w of both gears, speeds are divided by it.
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


class BeltLoop(eqx.Module):
    """A closed belt with grousers.

    Attributes:
        first, second: pitch radii of the pulleys [m], first >= second.
        distance: distance between the axles [m].
        grouser_height, grouser_length: size of a grouser above the pitch line and along it [m].
        grousers: number of grousers.
    """

    first: Scalar
    second: Scalar
    distance: Scalar
    grouser_height: Scalar
    grouser_length: Scalar
    grousers: int = eqx.field(static=True)

    @property
    def taper(self) -> Scalar:
        """Angle between a straight run and the line through the axles [rad]."""
        return jnp.arcsin((self.first - self.second) / self.distance)

    @property
    def run(self) -> Scalar:
        """Length of a straight run [m]."""
        return self.distance * jnp.cos(self.taper)

    @property
    def marks(self) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """Start and end of the first arc, and of the second arc [m along the path]."""
        begin = self.run / 2
        end = begin + self.first * (jnp.pi + 2 * self.taper)
        return begin, end, end + self.run, end + self.run + self.second * (jnp.pi - 2 * self.taper)

    @property
    def length(self) -> Scalar:
        """Length of the belt [m]."""
        return self.marks[3] + self.run / 2

    @property
    def pitch(self) -> Scalar:
        """Pitch of the grousers [m]."""
        return self.length / self.grousers

    def normal(self, angle: Array) -> Float[Array, "n 2"]:
        """Outward normal where the belt has turned by this angle since its lower run [rad]."""
        return jnp.stack([-jnp.sin(angle - self.taper), -jnp.cos(angle - self.taper)], axis=-1)

    def turning_angle(self, place: Array) -> Array:
        """Turning angle of the belt since its lower run [rad], at `place` [m]. Also defined beyond an
        end.
        """
        a, b, c, d = self.marks
        return jnp.clip(place - a, 0.0, b - a) / self.first + jnp.clip(place - c, 0.0, d - c) / self.second

    def tilt(self, place: Array) -> tuple[Array, Array]:
        """Tilt of a grouser on its rigid base [rad], the mean over the path below it, and its derivative [rad/m]."""
        half_base = self.grouser_length / 2

        def integral(s: Array) -> Array:
            turning_integral = jnp.zeros_like(s)
            for begin, end, radius in zip(self.marks[::2], self.marks[1::2], (self.first, self.second), strict=True):
                length_inside = jnp.clip(s - begin, 0.0, end - begin)
                turning_integral = (
                    turning_integral + (length_inside**2 / 2 + (end - begin) * jnp.maximum(s - end, 0.0)) / radius
                )
            return turning_integral

        mean = (integral(place + half_base) - integral(place - half_base)) / self.grouser_length
        return mean, (
            self.turning_angle(place + half_base) - self.turning_angle(place - half_base)
        ) / self.grouser_length

    def point(self, place: Array) -> Float[Array, "n 2"]:
        """Points of the pitch line [m], at positions `place` from 0 to the length of the belt."""
        a, b, c, d = self.marks
        normal = self.normal(self.turning_angle(place))
        on_first_pulley = place < (b + c) / 2
        on_first_pulley = on_first_pulley & (place > -self.run)
        along = jnp.where(
            on_first_pulley,
            jnp.minimum(place - a, 0.0) + jnp.maximum(place - b, 0.0),
            jnp.minimum(place - c, 0.0) + jnp.maximum(place - d, 0.0),
        )
        radius = jnp.where(on_first_pulley, self.first, self.second)
        centre = jnp.stack([jnp.where(on_first_pulley, 0.0, self.distance), jnp.zeros_like(place)], axis=-1)
        return centre + radius[..., None] * normal + along[..., None] * running_direction(normal)

    def places(self, belt_travel: Scalar) -> Float[Array, " grousers"]:
        """Positions of the grousers after the belt has moved by `belt_travel` [m]."""
        return jnp.mod(jnp.arange(self.grousers) * self.pitch + belt_travel, self.length)

    def project(self, points: Float[Array, "n 2"]) -> tuple[Array, Array]:
        """Height of points above the pitch line [m], negative inside the belt, and the position on the path below
        them [m].
        """
        a, b, c, _ = self.marks
        sin, cos = jnp.sin(self.taper), jnp.cos(self.taper)
        upper = points[..., 1] > 0
        axis_distance = jnp.abs(points[..., 1])
        along = points[..., 0] * cos - axis_distance * sin
        from_second = points - jnp.stack([self.distance, jnp.zeros_like(self.distance)])
        on_first, on_second = along < 0, along > self.run
        height = jnp.where(
            on_first,
            _norm(points) - self.first,
            jnp.where(
                on_second, _norm(from_second) - self.second, points[..., 0] * sin + axis_distance * cos - self.first
            ),
        )
        straight = jnp.where(upper, b + along, jnp.mod(a - along, self.length))
        place = jnp.where(
            on_first,
            a + self.first * self._angle_of_normal(points),
            jnp.where(
                on_second, c + self.second * (self._angle_of_normal(from_second) - jnp.pi - 2 * self.taper), straight
            ),
        )
        return height, place

    def _angle_of_normal(self, arm: Array) -> Array:
        """Turning angle of the belt since its lower run where its normal points along `arm` [rad]."""
        return jnp.mod(jnp.arctan2(-arm[..., 0], -arm[..., 1]) + self.taper, 2 * jnp.pi)


def grouser_tips(loop: BeltLoop, place: Float[Array, " n"]) -> tuple[Array, Array]:
    """Tips of the grousers at `place` [m along the path], and their displacement per displacement of the belt [-].

    Both have the shape (n, 2). Their rigid bases: see `running_gear.tips_on_path`.
    """
    tilt, rise = loop.tilt(place)
    normal = loop.normal(tilt)
    height = loop.grouser_height
    run = running_direction(loop.normal(loop.turning_angle(place)))
    return loop.point(place) + height * normal, run + height * rise[:, None] * running_direction(normal)


def gaps_to_belt(loop: BeltLoop, points: Float[Array, "n 2"]) -> tuple[Array, Array, Array, Array]:
    """Gaps between points, such as corners of the ground, and the belt between its grousers.

    Returns:
        Distance from the belt [m], its outward normal, shape (n, 2), displacement of its material per displacement of
        the belt, shape (n, 2), and position on the path [m].
    """
    height, place = loop.project(points)
    normal = loop.normal(loop.turning_angle(place))
    return height, normal, running_direction(normal), place


def gaps_to_grousers(
    loop: BeltLoop, belt_travel: Scalar, points: Float[Array, "n 2"]
) -> tuple[Array, Array, Array, Array]:
    """As `gaps_to_belt`, to the nearest grouser, a rigid tooth with flanks perpendicular to its base."""
    place_below = loop.project(points)[1]
    grouser_offset = jnp.mod(place_below - belt_travel + loop.pitch / 2, loop.pitch) - loop.pitch / 2
    place = jnp.mod(place_below - grouser_offset, loop.length)
    tilt, rise = loop.tilt(place)
    normal = loop.normal(tilt)
    along = running_direction(normal)
    arm = points - loop.point(place)
    u, w = jnp.sum(arm * along, axis=-1), jnp.sum(arm * normal, axis=-1)
    flank, top = jnp.abs(u) - loop.grouser_length / 2, w - loop.grouser_height
    outward = jnp.where((flank > top)[:, None], jnp.sign(u)[:, None] * along, normal)
    run = running_direction(loop.normal(loop.turning_angle(place)))
    rate = run + rise[:, None] * (w[:, None] * along - u[:, None] * normal)
    return jnp.maximum(flank, top), outward, rate, place


def running_direction(normal: Array) -> Array:
    """Direction in which the belt runs where its outward normal is `normal`."""
    return jnp.stack([normal[..., 1], -normal[..., 0]], axis=-1)


def _norm(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + 1e-300)


#: Pieces of a drive's law. First column: the voltage is at its minimum (-1), its maximum (1), or follows from the
#: demanded rate (0). Second: direction of motion of the levers, 0 at rest. Third: sign of T in motion.
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

    def motor_side_torque(self, torque: Scalar, direction: float) -> Scalar:
        """Torque c T [N·m] that the motor side must supply for a torque T on levers that move up (`direction` 1) or
        down (-1).
        """
        return jnp.where(torque * direction > 0, self.ahead, self.back) * torque


def lever_drive(robot: Robot) -> LeverDrive:
    """Drive of a pair of levers: the motor with both gears."""
    levers = robot.running_gear.levers
    motor = robot.motor
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
    rate_per_torque: Float[Array, "2 2"],
    demanded: Pair,
    least: Pair,
    most: Pair,
) -> LeverStep:
    """One time step of both lever pairs: the demanded rates if the voltages suffice, otherwise the rates that the
    voltages give.

    The levers' mechanics give ω = free + rate_per_torque · T after the step. The voltage is chosen between `least`
    and `most` so that ω is the demanded rate. For a lever that has to stand, it is the smallest voltage that holds
    it. Each drive's law has straight pieces (`_PIECES`). Of all pairs of pieces the one with the smallest deviation
    is used, 0 if the solution is on both. This is exact and has no iterations. A root finder cannot replace it: if a
    lever stands, its law allows a range of torques and is no function.

    Args:
        step: time step [s].
        rate: angular speed before the step [rad/s].
        free: angular speed after the step without drive torque [rad/s].
        rate_per_torque: change of the angular speed per drive torque [rad/(N·m·s)].
        demanded: demanded angular speeds after the step [rad/s].
        least, most: limits of the motor voltages [V].
    """
    current_limits = drive.constant * rate + drive.resistance * drive.current_limit * jnp.array([[-1.0], [1.0]])
    least, most = jnp.maximum(least, current_limits[0]), jnp.minimum(most, current_limits[1])
    inertia_rate = drive.inertia * (1 / step)
    torque_per_rate = inertia_rate + drive.constant**2 / drive.resistance + drive.viscous

    end, direction, sign = _PIECES.T
    is_moving, is_following = direction != 0, end == 0
    stall_torque = drive.constant / drive.resistance * jnp.where(end > 0, most[:, None], least[:, None])
    # α T + β ω = γ on a piece, (pairs, pieces)
    alpha = jnp.where(is_moving, jnp.where(sign * direction > 0, drive.ahead, drive.back), 0.0) + 0 * stall_torque
    beta = jnp.where(is_moving, torque_per_rate, 1.0) + 0 * stall_torque
    gamma = jnp.where(
        is_moving,
        stall_torque + inertia_rate * rate[:, None] - direction * drive.dry,
        is_following * demanded[:, None],
    )

    (a, b), (c, d) = beta[:, None] * rate_per_torque[:, :, None]
    a, d = (a + alpha[0])[:, None], (d + alpha[1])[None]
    b, c = b[:, None], c[None]
    r, s = ((gamma - beta * free[:, None])[k] for k in range(2))
    r, s = r[:, None], s[None]
    determinant = a * d - b * c
    torque = jnp.stack([(d * r - b * s) / determinant, (a * s - c * r) / determinant])
    lever_rates = free[:, None, None] + jnp.einsum("ij,jkl->ikl", rate_per_torque, torque)

    def candidate_solutions(k: int, axes: tuple[slice | None, ...]) -> tuple[Array, Array, Array, Array]:
        """Distance of each candidate solution from its piece of the law of lever pair `k` (0: on it) [N·m]. Then i
        C_m I of the motor within the voltage limits [N·m], load torque [N·m] and speed [rad/s]."""
        force, speed = torque[k], lever_rates[k]
        acceleration_torque = inertia_rate * (speed - rate[k]) + drive.viscous * speed
        up, down = (
            drive.motor_side_torque(force, 1.0) + drive.dry + acceleration_torque,
            drive.motor_side_torque(force, -1.0) - drive.dry + acceleration_torque,
        )
        low, high = jnp.where(demanded[k] > 0, up, down), jnp.where(demanded[k] < 0, down, up)
        torque_least, torque_most = (
            drive.constant / drive.resistance * (x[k] - drive.constant * speed) for x in (least, most)
        )
        stall = stall_torque[k][axes]
        rate_excess = end[axes] * (speed - demanded[k]) * torque_per_rate
        standing_excess = jnp.maximum(stall - up, down - stall)
        motion_error = jnp.maximum(-direction[axes] * speed * torque_per_rate, -sign[axes] * force)
        deviation = jnp.where(
            is_following[axes],
            jnp.maximum(low - torque_most, torque_least - high),
            jnp.maximum(jnp.where(is_moving[axes], motion_error, standing_excess), rate_excess),
        )
        return (
            jnp.maximum(deviation, 0.0),
            jnp.clip(jnp.clip(0.0, low, high), torque_least, torque_most),
            force,
            speed,
        )

    candidates = candidate_solutions(0, (slice(None), None)), candidate_solutions(1, (None, slice(None)))
    deviation = jnp.nan_to_num(jnp.maximum(candidates[0][0], candidates[1][0]), nan=jnp.inf, posinf=jnp.inf)
    best = jnp.unravel_index(jnp.argmin(deviation), deviation.shape)
    best_pair = jnp.stack(best)
    motor_torques = jnp.stack([pair[1][best] for pair in candidates])
    torque, rate_after = torque[:, *best], lever_rates[:, *best]
    limit_voltage = jnp.where(jnp.asarray(end)[best_pair] > 0, most, least)
    is_standing = jnp.where(jnp.asarray(is_following)[best_pair], demanded == 0, ~jnp.asarray(is_moving)[best_pair])
    rate_after = jnp.where(is_standing, 0.0, rate_after)
    voltage = jnp.where(
        jnp.asarray(is_following)[best_pair],
        drive.resistance / drive.constant * motor_torques + drive.constant * rate_after,
        limit_voltage,
    )
    current = (voltage - drive.constant * rate_after) / drive.resistance
    return LeverStep(torque, rate_after, voltage, current, is_standing & (jnp.abs(current) < _NONE))
