"""Terrain in the plane of travel: a polyline with its distance from points, its normals and its convex corners.

All terrains are polylines that go forward (x never decreases), with points [m] and the ground on their right, so that
flat ground has its free side up. The obstacle begins at x = 0. Rounded noses are a level line of the distance to a
polyline that is deeper by their radius.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mmrjax.model.params import Scalar

#: Length of the ground before and after an obstacle [m].
FAR = 100.0
#: Depth of a gap [m]; no part of a robot reaches its floor.
DEEP = 5.0
#: Position of corners that a polyline does not have [m].
_NOWHERE = (0.0, -1e3)


class Terrain(eqx.Module):
    """Terrain as a polyline.

    Attributes:
        points: vertices of the polyline [m]. Repeated vertices count once.
        nose: radius of its convex corners [m].
        finish: x of the end of the obstacle [m].
    """

    points: Float[Array, "points 2"]
    nose: Scalar
    finish: Scalar

    @property
    def corners(self) -> Float[Array, "corners 2"]:
        """Convex corners: centres of their rounded noses [m]. Concave corners cannot be touched."""
        before, middle, after = self.points[:-2], self.points[1:-1], self.points[2:]
        turn = _cross_product(middle - before, after - middle)
        # A repeated vertex has no edge; its next different vertex gives the direction.
        return jnp.where((turn < -1e-15)[:, None], middle, jnp.asarray(_NOWHERE))

    def inside(self, positions: Float[Array, "n 2"]) -> Bool[Array, " n"]:
        """True for points below the polyline."""
        a, b = self.points[:-1], self.points[1:]
        is_above_edge = (positions[:, None, 0] >= a[:, 0]) & (positions[:, None, 0] < b[:, 0])
        return jnp.any(is_above_edge & (_cross_product(b - a, positions[:, None] - a) < 0), axis=1)

    def distance(self, positions: Float[Array, "n 2"]) -> tuple[Float[Array, " n"], Float[Array, "n 2"]]:
        """Distance of points from the ground [m], negative below it, and the normal of the ground at the nearest
        point.

        The normal is the gradient of the distance: that of the nearest edge, or away from the nearest corner.
        """
        a = self.points[:-1]
        edges = self.points[1:] - self.points[:-1]
        square = jnp.maximum(jnp.sum(edges**2, axis=1), 1e-30)  # 0 for a repeated vertex
        from_a = positions[:, None] - a
        share = jnp.clip(jnp.sum(from_a * edges, axis=-1) / square, 0.0, 1.0)
        offset = from_a - share[..., None] * edges
        squared = jnp.sum(offset**2, axis=-1)
        nearest = jnp.argmin(squared, axis=1)[:, None]
        offset, share, least_square = (
            _take_nearest(offset, nearest),
            _take_nearest(share, nearest),
            _take_nearest(squared, nearest),
        )
        length = jnp.sqrt(jnp.maximum(least_square, 1e-300))
        sign = jnp.where(self.inside(positions), -1.0, 1.0)
        edge_normal = edges / jnp.sqrt(square)[:, None]
        edge_normal = jnp.stack([-edge_normal[:, 1], edge_normal[:, 0]], axis=1)[nearest[:, 0]]
        is_inside = (share > 0) & (share < 1) | (least_square < 1e-24)
        normal = jnp.where(is_inside[:, None], edge_normal, (sign / length)[:, None] * offset)
        return jnp.where(is_inside, jnp.sum(edge_normal * offset, axis=1), sign * length) - self.nose, normal


def _cross_product(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _take_nearest(values: Array, nearest: Array) -> Array:
    index = nearest[..., None] if values.ndim == 3 else nearest
    return jnp.take_along_axis(values, index, axis=1)[:, 0]


def _terrain_of_points(
    points: Sequence[tuple[Scalar, Scalar]], finish: Scalar, nose: Scalar = 0.0, size: int = 0
) -> Terrain:
    """Terrain through points [m], with level ground before and after. Padded to `size` points."""
    zero = jnp.zeros(())
    rows = jnp.stack([jnp.stack([x + zero, z + zero]) for x, z in points])
    # Noses: the polyline is deeper by their radius; risers face backward.
    rows = rows + jnp.asarray([1.0, -1.0]) * nose
    rows = jnp.concatenate([rows, jnp.broadcast_to(rows[-1], (max(size - len(points), 0), 2))])
    return Terrain(rows, nose + zero, finish + zero)


def flat_ground(size: int = 0) -> Terrain:
    """Level ground."""
    return _terrain_of_points([(-FAR, 0.0), (FAR, 0.0)], 0.0, size=size)


def single_step(height: Scalar, nose: Scalar = 0.0, size: int = 0) -> Terrain:
    """A step up (or down) by `height` [m], its corner rounded by `nose` [m]."""
    return _terrain_of_points([(-FAR, 0.0), (0.0, 0.0), (0.0, height), (FAR, height)], 0.0, nose, size)


def stairs(rise: Scalar, tread: Scalar, count: int, nose: Scalar = 0.0, size: int = 0) -> Terrain:
    """`count` steps of `rise` and `tread` [m], with noses rounded by `nose` [m]."""
    points: list[tuple[Scalar, Scalar]] = [(-FAR, 0.0)]
    for k in range(count):
        points += [(k * tread, k * rise), (k * tread, (k + 1) * rise)]
    last_edge = (count - 1) * tread
    return _terrain_of_points([*points, (last_edge + FAR, count * rise)], last_edge, nose, size)


def gap(width: Scalar, size: int = 0) -> Terrain:
    """A trench of `width` [m] that is too deep for the robot to touch its floor."""
    points = [(-FAR, 0.0), (0.0, 0.0), (0.0, -DEEP), (width, -DEEP), (width, 0.0), (width + FAR, 0.0)]
    return _terrain_of_points(points, width, size=size)


def polyline(x: Sequence[float] | np.ndarray, z: Sequence[float] | np.ndarray, size: int = 0) -> Terrain:
    """Level ground up to the first point (x, z) [m], then the polyline, then level ground from the last point on.

    Raises:
        ValueError: fewer than two points, a value that is not finite, decreasing x, or a wall that doubles back.
    """
    x, z = np.asarray(x, float), np.asarray(z, float)
    if x.ndim != 1 or x.shape != z.shape or len(x) < 2:
        raise ValueError(f"terrain: got x of shape {x.shape} and z of {z.shape}; expected two points or more")
    if not (np.isfinite(x).all() and np.isfinite(z).all()):
        raise ValueError("terrain: got a point that is not a number; expected metres")
    if (falls := np.flatnonzero(np.diff(x) < 0)).size:
        k = int(falls[0])
        raise ValueError(
            f"terrain: x falls from {x[k]:g} to {x[k + 1]:g} m at point {k + 2}; expected ground without "
            "overhangs, x never falling"
        )
    keep = np.concatenate([[True], (np.diff(x) != 0) | (np.diff(z) != 0)])
    x, z = x[keep], z[keep]
    rise = np.where(np.diff(x) == 0, np.diff(z), 0.0)
    if (falls := np.flatnonzero(rise[1:] * rise[:-1] < 0)).size:
        k = int(falls[0]) + 1
        raise ValueError(
            f"terrain: z goes from {z[k]:g} back to {z[k + 1]:g} m at x = {x[k]:g} m; expected a wall up or down"
        )
    points = [(x[0] - FAR, z[0]), *zip(x, z, strict=True), (x[-1] + FAR, z[-1])]
    return _terrain_of_points(points, float(x[-1]), size=size)
