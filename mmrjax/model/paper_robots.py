"""The robots of the paper: the nominal one (Tables 1-7), the simplified models of Tables A3 and A4."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from mmrjax.model import params
from mmrjax.model.chassis import Chassis
from mmrjax.model.contact import Friction, Ground, Track
from mmrjax.model.gearmotor import UNLIMITED, Gearbox, Motor
from mmrjax.model.paper_tables import (
    BENCH,
    PAYLOADS_KG,
    RADIUS_PULLEY,
    SLOPES_DEG,
    SURFACES,
    TRACKED,
    VOLTAGES_V,
    WHEELED,
    adhesion_ratio,
)
from mmrjax.model.power import Battery
from mmrjax.model.rig import Rig
from mmrjax.model.robot import Configurations, Robot
from mmrjax.turning.two_sides import Turning

__all__ = [
    "BENCH",
    "PAYLOADS_KG",
    "ROBOTS",
    "SLOPES_DEG",
    "SURFACES",
    "VOLTAGES_V",
    "adhesion_ratio",
    "blank_robot",
    "nominal",
    "sm1",
    "sm2",
]

RADIUS_WHEEL = 50e-3  # D_w / 2, Table 6

DYNAMIC_SHARE = 0.8  # μ_d / μ_s, assumed; the paper prints none
GUIDE_SHARE = 0.3  # of the weight, between the limits that Table A1 simulated sets (docs/explanation/paper-notes.md)


def _friction(adhesion: float) -> Friction:
    return Friction(static=adhesion, dynamic=DYNAMIC_SHARE * adhesion)


def nominal() -> Robot:
    """The proposed model (PM) with the parameters of Tables 1-7 and the makers' sheets."""
    bench = SURFACES[BENCH]
    pulleys = 2 * (75e-6 + 140e-6)  # Table 7: two main and two additional pulleys a side
    belt = 40e-3 * RADIUS_PULLEY**2  # Table 7: main track 40 g
    belts_flippers = 2 * 25e-3 * RADIUS_PULLEY**2  # Table 7: additional tracks 25 g
    tracked = Chassis(
        track=Track(loss_coulomb=0.350, loss_viscous=0.016, guide_share=GUIDE_SHARE),
        ground=Ground(_friction(bench.tracked_x), rolling_resistance=0.06),
        on_tracks=1.0,
        mass=13.1,
        radius=RADIUS_PULLEY,
        inertia=pulleys + belt + belts_flippers,
        turning=Turning(lateral=bench.tracked_y / bench.tracked_x, inertia=0.23),
    )
    wheeled = Chassis(
        track=Track(loss_coulomb=0.070, loss_viscous=0.003, guide_share=0.0),
        ground=Ground(_friction(bench.wheeled_x), rolling_resistance=0.03),
        on_tracks=0.0,
        mass=11.5,
        radius=RADIUS_WHEEL,
        inertia=pulleys + belt + 2 * 152e-6,
        turning=Turning(lateral=bench.wheeled_y / bench.wheeled_x, inertia=0.19),
    )
    return Robot(Battery(), Motor(), Gearbox(), Configurations({TRACKED: tracked, WHEELED: wheeled}))


#: A drive of which only the stated parameters are known: no friction, no loss, no limits.
_NOTHING = {
    "motor.friction_coulomb": 0.0,
    "motor.friction_viscous": 0.0,
    "gearbox.friction_coulomb": 0.0,
    "gearbox.friction_viscous": 0.0,
    "gearbox.efficiency_load": 1.0,
    "gearbox.ratio": 1.0,
}


#: Parameters from makers and drawings, which have no substitute if nobody states them.
_OF_A_SHEET, _ASSUMED = ("battery.", "motor.", "running_gear."), ("motor.temperature_ambient",)


def blank_robot(configurations: Configurations, sides: float = 1.0, rig: Rig | None = None) -> Robot:
    """A robot with known loads only: no losses in its drive and no limits. A rig's file adds what it states.

    Args:
        configurations: its loads.
        sides: number of motors driven with the same input.
        rig: drive and measurement.
    """
    motor = replace(Motor(), speed_limit=UNLIMITED, temperature_limit=UNLIMITED)
    gearbox = replace(Gearbox(), speed_limit=UNLIMITED, torque_limit=None)
    robot = Robot(Battery(), motor, gearbox, configurations, sides=sides)
    unknown = tuple(
        p.name for p in params.walk_parameters(robot) if p.name.startswith(_OF_A_SHEET) and p.name not in _ASSUMED
    )
    rig = replace(rig or Rig(), inherits=False, unknown=unknown)
    return params.replace(replace(robot, rig=rig), _NOTHING)


def _simplified_robot(track_torque: float) -> Robot:
    """Constant losses as in Table A4. The table leaves out the wheeled chassis: its track loss is scaled by 70/350,
    the ratio of the Coulomb losses of the nominal robot."""
    constant = {
        "motor.friction_coulomb": 4.2e-3,
        "motor.friction_viscous": 0.0,
        "gearbox.friction_coulomb": 0.0,
        "gearbox.friction_viscous": 0.0,
        "gearbox.efficiency_load": 0.75,
        f"{TRACKED}.track.loss_coulomb": track_torque,
        f"{TRACKED}.track.loss_viscous": 0.0,
        f"{WHEELED}.track.loss_coulomb": track_torque * 70 / 350,
        f"{WHEELED}.track.loss_viscous": 0.0,
        "battery.voltage_full": 33.6 / 8,
        "battery.curvature": 0.0,
        "battery.slope": 0.0,
        "battery.resistance": 0.0,
        "battery.current_other": 0.0,
    }
    return params.replace(nominal(), constant)


def sm1() -> Robot:
    """Simplified model 1: constant losses, track torque about a third of M_t0 (Tables A3, A4)."""
    return _simplified_robot(0.108)


def sm2() -> Robot:
    """Simplified model 2: constant losses, track torque about M_t0 (Tables A3, A4)."""
    return _simplified_robot(0.300)


#: Robots by their name on the command line.
ROBOTS: dict[str, Callable[[], Robot]] = {"nominal": nominal, "sm1": sm1, "sm2": sm2}
