"""Tables 5 and 8 and the names of the configurations: plain data, importable without jax."""

from __future__ import annotations

import math
from typing import NamedTuple

#: Configurations of the packaged robot: on tracks, and on wheels.
TRACKED, WHEELED = CONFIGURATIONS = ("6T2A", "4W2T")

#: Main track of one side: teeth of belt and pulley, grousers (Section 3.4.4); pitches [m] (Section 3.2.4).
TEETH_BELT, TEETH_PULLEY, GROUSERS = 168, 48, 24
#: Track of one lever (Section 3.4.4).
GROUSERS_LEVER = 16
PITCH_TOOTH, PITCH_GROUSER = 5e-3, 35e-3
RADIUS_PULLEY = TEETH_PULLEY * PITCH_TOOTH / (2 * math.pi)  # 38.2 mm
#: Height of the body [m], Table 6.
BODY_HEIGHT = 76e-3

#: One mAh, the unit of a maker's capacity, in coulombs.
COULOMB_PER_MAH = 3.6

#: Axes of Table 8.
SLOPES_DEG = (0.0, 5.0, 10.0, 15.0, 20.0)
PAYLOADS_KG = (0.0, 1.5, 3.0, 5.0, 6.5, 8.0)
VOLTAGES_V = (15.0, 24.0, 33.0)


class Surface(NamedTuple):
    """Adhesion coefficients of Table 5, longitudinal and lateral, for tracks and for wheels [-]."""

    tracked_x: float
    tracked_y: float
    wheeled_x: float
    wheeled_y: float


#: Table 5. The bench of the measurements is lacquered wood (type 3).
SURFACES = {
    "linoleum": Surface(0.42, 0.55, 0.52, 0.56),
    "smooth_concrete_floor": Surface(0.45, 0.55, 0.60, 0.62),
    "lacquered_wood": Surface(0.32, 0.38, 0.38, 0.43),
    "asphalt": Surface(0.68, 0.70, 0.60, 0.62),
    "concrete": Surface(0.76, 0.78, 0.72, 0.75),
}
BENCH = "lacquered_wood"


def adhesion_ratio(surface: str, on_tracks: bool) -> float:
    """Adhesion of `surface` over that of the bench [-], Table 5. Valid for friction stated on the bench's surface."""
    ground, bench = SURFACES[surface], SURFACES[BENCH]
    return ground.tracked_x / bench.tracked_x if on_tracks else ground.wheeled_x / bench.wheeled_x


def lateral_ratio(surface: str, on_tracks: bool) -> float:
    """Lateral adhesion of `surface` over that of the bench [-], Table 5."""
    ground, bench = SURFACES[surface], SURFACES[BENCH]
    return ground.tracked_y / bench.tracked_y if on_tracks else ground.wheeled_y / bench.wheeled_y
