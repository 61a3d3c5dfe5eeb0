"""The robots of the paper: the nominal one (Tables 1-7), the simplified models of Tables A3 and A4."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from mmrjax import params
from mmrjax.chassis import Chassis
from mmrjax.contact import Friction
from mmrjax.gearbox import Gearbox
from mmrjax.ground import Ground
from mmrjax.motor import Motor
from mmrjax.power import Battery
from mmrjax.robot import Robot
from mmrjax.track import Track

TEETH_BELT, TEETH_PULLEY, PITCH_TOOTH = 168, 48, 5e-3  # Section 3.4.4; pitch [m], Section 3.2.4
PITCH_GROUSER = 35e-3  # [m], Section 3.2.4
RADIUS_PULLEY = TEETH_PULLEY * PITCH_TOOTH / (2 * math.pi)  # 38.2 mm
RADIUS_WHEEL = 50e-3  # D_w / 2, Table 6

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

DYNAMIC_SHARE = 0.8  # μ_d / μ_s, assumed; the paper prints none
GUIDE_SHARE = 0.3  # of the weight, between the brackets that Table A1 simulated sets (docs/paper-notes)


def adhesion_ratio(surface: str, wheeled: bool) -> float:
    """Adhesion of `surface` over that of the bench [-], Table 5."""
    here, bench = SURFACES[surface], SURFACES[BENCH]
    return here.wheeled_x / bench.wheeled_x if wheeled else here.tracked_x / bench.tracked_x


def _friction(adhesion: float) -> Friction:
    return Friction(static=adhesion, dynamic=DYNAMIC_SHARE * adhesion)


def nominal() -> Robot:
    """The proposed model (PM) with the parameters of Tables 1-7 and the makers' sheets."""
    bench = SURFACES[BENCH]
    belt = 40e-3 * RADIUS_PULLEY**2  # Table 7: main track 40 g
    belts_flippers = 2 * 25e-3 * RADIUS_PULLEY**2  # Table 7: additional tracks 25 g
    tracked = Chassis(
        track=Track(loss_coulomb=0.350, loss_viscous=0.016, guide_share=GUIDE_SHARE),
        ground=Ground(_friction(bench.tracked_x), rolling_resistance=0.06),
        mass=13.1,
        radius=RADIUS_PULLEY,
        inertia=75e-6 + 140e-6 + belt + belts_flippers,
    )
    wheeled = Chassis(
        track=Track(loss_coulomb=0.070, loss_viscous=0.003, guide_share=0.0),
        ground=Ground(_friction(bench.wheeled_x), rolling_resistance=0.03),
        mass=11.5,
        radius=RADIUS_WHEEL,
        inertia=75e-6 + 140e-6 + belt + 2 * 152e-6,
    )
    return Robot(Battery(), Motor(), Gearbox(), tracked, wheeled)


def _simplified(track_torque: float) -> Robot:
    """Constant losses as in Table A4; the wheeled chassis, of which it says nothing, in proportion."""
    constant = {
        "motor.friction_coulomb": 4.2e-3,
        "motor.friction_viscous": 0.0,
        "gearbox.friction_coulomb": 0.0,
        "gearbox.friction_viscous": 0.0,
        "gearbox.efficiency_load": 0.75,
        "tracked.track.loss_coulomb": track_torque,
        "tracked.track.loss_viscous": 0.0,
        "wheeled.track.loss_coulomb": track_torque * 70 / 350,
        "wheeled.track.loss_viscous": 0.0,
        "battery.voltage_full": 33.6 / 8,
        "battery.curvature": 0.0,
        "battery.slope": 0.0,
        "battery.resistance": 0.0,
        "battery.current_other": 0.0,
    }
    return params.replace(nominal(), constant)  # type: ignore[return-value]


def sm1() -> Robot:
    """Simplified model 1: constant losses, track torque about a third of M_t0 (Tables A3, A4)."""
    return _simplified(0.108)


def sm2() -> Robot:
    """Simplified model 2: constant losses, track torque about M_t0 (Tables A3, A4)."""
    return _simplified(0.300)


#: Robots by the name that the command line takes.
ROBOTS: dict[str, Callable[[], Robot]] = {"nominal": nominal, "sm1": sm1, "sm2": sm2}
