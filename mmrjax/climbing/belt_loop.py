"""A belt around two pulleys of different radius: positions on it, tilt of its grousers, contact with corners.

The frame has its origin on the first pulley's axle and its first axis towards the second pulley. The belt runs
clockwise: along the lower run to the first pulley, up, along the upper run to the second, down. The coordinate of a
point is its distance along the path from the middle of the lower run.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.model.params import Scalar


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

    def normal(self, turned: Array) -> Float[Array, "n 2"]:
        """Outward normal where the belt has turned by this angle since its lower run [rad]."""
        return jnp.stack([-jnp.sin(turned - self.taper), -jnp.cos(turned - self.taper)], axis=-1)

    def turned(self, place: Array) -> Array:
        """Turning angle of the belt since its lower run [rad], at `place` [m]. Also defined beyond an
        end.
        """
        a, b, c, d = self.marks
        return jnp.clip(place - a, 0.0, b - a) / self.first + jnp.clip(place - c, 0.0, d - c) / self.second

    def tilt(self, place: Array) -> tuple[Array, Array]:
        """Tilt of a grouser on its rigid base [rad], the mean over the path below it, and its derivative [rad/m]."""
        half = self.grouser_length / 2

        def integral(s: Array) -> Array:
            total = jnp.zeros_like(s)
            for begin, end, radius in zip(self.marks[::2], self.marks[1::2], (self.first, self.second), strict=True):
                length_inside = jnp.clip(s - begin, 0.0, end - begin)
                total = total + (length_inside**2 / 2 + (end - begin) * jnp.maximum(s - end, 0.0)) / radius
            return total

        mean = (integral(place + half) - integral(place - half)) / self.grouser_length
        return mean, (self.turned(place + half) - self.turned(place - half)) / self.grouser_length

    def point(self, place: Array) -> Float[Array, "n 2"]:
        """Points of the pitch line [m], at positions `place` from 0 to the length of the belt."""
        a, b, c, d = self.marks
        normal = self.normal(self.turned(place))
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

    def places(self, drawn: Scalar) -> Float[Array, " grousers"]:
        """Positions of the grousers after the belt has moved by `drawn` [m]."""
        return jnp.mod(jnp.arange(self.grousers) * self.pitch + drawn, self.length)

    def project(self, at: Float[Array, "n 2"]) -> tuple[Array, Array]:
        """Height of points above the pitch line [m], negative inside the belt, and the position on the path below
        them [m].
        """
        a, b, c, _ = self.marks
        sin, cos = jnp.sin(self.taper), jnp.cos(self.taper)
        upper = at[..., 1] > 0
        beside = jnp.abs(at[..., 1])
        along = at[..., 0] * cos - beside * sin
        from_second = at - jnp.stack([self.distance, jnp.zeros_like(self.distance)])
        on_first, on_second = along < 0, along > self.run
        height = jnp.where(
            on_first,
            _norm(at) - self.first,
            jnp.where(on_second, _norm(from_second) - self.second, at[..., 0] * sin + beside * cos - self.first),
        )
        straight = jnp.where(upper, b + along, jnp.mod(a - along, self.length))
        place = jnp.where(
            on_first,
            a + self.first * self._angle_of_normal(at),
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

    Both have the shape (n, 2). Their rigid bases: see `belt.tips_on_path`.
    """
    tilt, rise = loop.tilt(place)
    normal = loop.normal(tilt)
    height = loop.grouser_height
    run = running_direction(loop.normal(loop.turned(place)))
    return loop.point(place) + height * normal, run + height * rise[:, None] * running_direction(normal)


def gaps_to_belt(loop: BeltLoop, at: Float[Array, "n 2"]) -> tuple[Array, Array, Array, Array]:
    """Gaps between points, such as corners of the ground, and the belt between its grousers.

    Returns:
        Distance from the belt [m], its outward normal, shape (n, 2), displacement of its material per displacement of
        the belt, shape (n, 2), and position on the path [m].
    """
    height, place = loop.project(at)
    normal = loop.normal(loop.turned(place))
    return height, normal, running_direction(normal), place


def gaps_to_grousers(loop: BeltLoop, drawn: Scalar, at: Float[Array, "n 2"]) -> tuple[Array, Array, Array, Array]:
    """As `gaps_to_belt`, to the nearest grouser, a rigid tooth with flanks perpendicular to its base."""
    under = loop.project(at)[1]
    grouser_offset = jnp.mod(under - drawn + loop.pitch / 2, loop.pitch) - loop.pitch / 2
    place = jnp.mod(under - grouser_offset, loop.length)
    tilt, rise = loop.tilt(place)
    normal = loop.normal(tilt)
    along = running_direction(normal)
    arm = at - loop.point(place)
    u, w = jnp.sum(arm * along, axis=-1), jnp.sum(arm * normal, axis=-1)
    flank, top = jnp.abs(u) - loop.grouser_length / 2, w - loop.grouser_height
    outward = jnp.where((flank > top)[:, None], jnp.sign(u)[:, None] * along, normal)
    run = running_direction(loop.normal(loop.turned(place)))
    rate = run + rise[:, None] * (w[:, None] * along - u[:, None] * normal)
    return jnp.maximum(flank, top), outward, rate, place


def running_direction(normal: Array) -> Array:
    """Direction in which the belt runs where its outward normal is `normal`."""
    return jnp.stack([normal[..., 1], -normal[..., 0]], axis=-1)


def _norm(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + 1e-300)
