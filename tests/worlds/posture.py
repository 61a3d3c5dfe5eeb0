"""A robot from the side in NumPy, as polygons of many corners: where it comes to rest, and the step it stands on.

It rests where the centre of mass is lowest over pitch, found by looking, and no tangent is written down.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial import ConvexHull

WHEELBASE, LEVER, ROLLER, TRACK = 0.3, 0.205, 0.0135, 48 * 5e-3 / (2 * np.pi) + 5.5e-3  # [m], Table 6
MASS, LEVER_MASS, LEVER_CENTRE = 13.1, 0.495, 0.083  # [kg, m], Table 7
BODY = MASS - 4 * LEVER_MASS - 4 * (0.082 + 0.104) - 2 * 0.04
BODY_UP, PAYLOAD_UP = 5e-3, 73e-3


def centre(front: float, rear: float, payload: float = 0.0) -> np.ndarray:
    """Centre of mass from the middle of the wheelbase [m]. Angles of the levers outward [rad]."""
    masses = [BODY, payload, 2 * LEVER_MASS, 2 * LEVER_MASS]
    at = [
        (0.0, BODY_UP),
        (0.0, PAYLOAD_UP),
        (WHEELBASE / 2 + LEVER_CENTRE * np.cos(front), LEVER_CENTRE * np.sin(front)),
        (-WHEELBASE / 2 - LEVER_CENTRE * np.cos(rear), LEVER_CENTRE * np.sin(rear)),
    ]
    return np.sum([m * np.array(p) for m, p in zip(masses, at, strict=True)], 0) / (MASS + payload)


def _around(one: np.ndarray, radius: float, other: np.ndarray, its: float, corners: int) -> np.ndarray:
    """Corners of a belt around two circles."""
    turn = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    round_ = np.stack([np.cos(turn), np.sin(turn)], 1)
    points = np.concatenate([one + radius * round_, other + its * round_])
    return points[ConvexHull(points).vertices]


def belts(front: float, rear: float, corners: int = 4000) -> list[np.ndarray]:
    """The main belt and those of the levers, closed polygons."""
    nose, tail = np.array([WHEELBASE / 2, 0.0]), np.array([-WHEELBASE / 2, 0.0])
    tips = (
        nose + LEVER * np.array([np.cos(front), np.sin(front)]),
        tail + LEVER * np.array([-np.cos(rear), np.sin(rear)]),
    )
    pairs = [(tail, TRACK, nose, TRACK), (nose, TRACK, tips[0], ROLLER), (tail, TRACK, tips[1], ROLLER)]
    return [_around(*pair, corners) for pair in pairs]


def _turn(points: np.ndarray, pitch: float) -> np.ndarray:
    c, s = np.cos(pitch), np.sin(pitch)
    return points @ np.array([[c, s], [-s, c]])


def rest(front: float, rear: float, payload: float = 0.0, slope: float = 0.0) -> tuple[float, float, float]:
    """Pitch [rad], height of the centre of mass above the plane [m] and of the middle of the wheelbase, where it rests
    nearest to level."""
    points, mass = np.concatenate(belts(front, rear)), centre(front, rear, payload)

    def energy(pitch: float) -> float:  # along gravity's line, for a robot that neither rolls nor slides
        turned, at = _turn(points, pitch), _turn(mass, pitch)
        return float(at[1] - turned[:, 1].min())

    grid = np.radians(np.arange(-90.0, 90.01, 0.25))
    values = np.array([energy(x) for x in grid])
    low = [k for k in range(1, len(grid) - 1) if values[k] <= values[k - 1] and values[k] <= values[k + 1]]
    k = min(low, key=lambda k: abs(grid[k]))
    pitch = minimize_scalar(energy, bounds=(grid[k - 1], grid[k + 1]), method="bounded", options={"xatol": 1e-10}).x
    return float(pitch), energy(pitch), float(-_turn(points, pitch)[:, 1].min())


def step(front: float, rear: float, payload: float = 0.0, spacing: float = 2e-4) -> float:
    """The highest step [m] on which it stands with its centre of mass over the edge, by looking at every pitch."""
    points = []
    for corners in belts(front, rear):
        ends = np.roll(corners, -1, 0)
        for a, b in zip(corners, ends, strict=True):
            many = max(2, int(np.hypot(*(b - a)) / spacing))
            points.append(a + (b - a) * np.linspace(0, 1, many)[:, None])
    every, mass = np.concatenate(points), centre(front, rear, payload)
    best = -np.inf
    for pitch in np.radians(np.arange(0.0, 90.01, 0.1)):
        turned, at = _turn(every, pitch), _turn(mass, pitch)
        ahead = turned[:, 0] >= at[0]
        best = max(best, turned[ahead, 1].min() - turned[~ahead, 1].min())
    return best
