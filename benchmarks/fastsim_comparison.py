"""Missions compared with NREL's FASTSim: energy at the wheel and from the battery, for vehicles both can express.

    python benchmarks/fastsim_comparison.py                # needs fastsim in the same environment

A battery vehicle without aerodynamic drag follows a speed trace of ramps, a climb and a descent with regeneration.
Its only losses are rolling resistance and a constant efficiency of its transmission. No parameter is fitted.
Two sizes: this project's robot, and a car. A third result is the integral of rolling, climbing and acceleration.
Prints a line of JSON for each vehicle. Exit code 2: fastsim is not installed. 3: an energy misses the goals (0.5 % at
the wheel, 1 % in Wh/km, at either step of FASTSim).
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.metadata
import json
import sys
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import numpy as np  # noqa: E402
from measure import machine  # noqa: E402

from mmrjax.missions.mission import Mission, mission  # noqa: E402
from mmrjax.missions.profile import Profile, profile  # noqa: E402
from mmrjax.model import paper_robots, params  # noqa: E402
from mmrjax.model.conditions import Conditions  # noqa: E402
from mmrjax.model.paper_tables import WHEELED  # noqa: E402
from mmrjax.model.robot import Robot  # noqa: E402
from mmrjax.model.signals import CONVERGED, GRAVITY, STATUSES  # noqa: E402

INSTALL = "fastsim is not installed here: pip install fastsim==3.1.0 (Python 3.10 to 3.15), then run this again"
#: g of FASTSim 3.1.0 (`ACC_GRAV`, 9.8015 rounded to three figures) [m/s²].
GRAVITY_FASTSIM = 9.80
#: Largest number of recorded steps of a mission; it has to take fewer.
KEEP = 1000


@dataclasses.dataclass(frozen=True)
class Vehicle:
    """Parameters of the vehicle for both simulators, in SI units.

    Attributes:
        mass: [kg].
        rolling: coefficient of rolling resistance [-].
        radius: of the wheels [m].
        inertia: of all wheels together [kg·m²].
        efficiency: of the transmission, in both directions [-].
        cells: in series, of 4 V at any charge, without resistance.
        capacity: of one [C].
        ratio, torque_constant [N·m/A], resistance [Ω], inductance [H]: of gearbox and motors, which FASTSim lacks.
            The resistance is small enough for negligible losses.
    """

    name: str
    mass: float
    rolling: float
    radius: float
    inertia: float
    efficiency: float
    ratio: float
    torque_constant: float
    resistance: float
    inductance: float
    cells: int
    capacity: float


@dataclasses.dataclass(frozen=True)
class Trace:
    """Ground speed [m/s] and slope [deg] at `time` [s], linear in between. Corners are at whole seconds."""

    time: np.ndarray
    speed: np.ndarray
    slope_deg: np.ndarray

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Speed [m/s] and slope [rad] at these times."""
        return np.interp(time, self.time, self.speed), np.radians(np.interp(time, self.time, self.slope_deg))


ROBOT = Vehicle("robot of 15 kg", 15.0, 0.03, 0.05, 4e-3, 0.74, 40.0, 25.9e-3, 5e-3, 5e-7, 8, 7920.0)
CAR = Vehicle("car of 300 kg", 300.0, 0.012, 0.25, 0.8, 0.85, 10.0, 0.5, 2e-3, 2e-7, 80, 36000.0)


def trace(slow: float, fast: float, climb: float, descent: float) -> Trace:
    """A trace from rest to two speeds [m/s], up a `climb` and down a `descent` [deg], and back to rest."""
    rows = [
        (0, 0, 0), (10, slow, 0), (40, slow, 0), (50, fast, 0), (80, fast, 0), (81, fast, climb), (110, fast, climb),
        (111, fast, 0), (120, fast, 0), (130, slow, 0), (150, slow, 0), (151, slow, -descent), (180, slow, -descent),
        (181, slow, 0), (190, slow, 0), (200, 0, 0),
    ]  # fmt: skip
    time, speed, slope = np.asarray(rows, float).T
    return Trace(time, speed, slope)


def robot_of(vehicle: Vehicle) -> Robot:
    """The vehicle as a wheeled robot with negligible losses except rolling and the gearbox's efficiency."""
    values = {
        "motor.resistance": vehicle.resistance,
        "motor.inductance": vehicle.inductance,
        "motor.torque_constant": vehicle.torque_constant,
        "motor.friction_coulomb": 0.0,
        "motor.friction_viscous": 0.0,
        "motor.inertia": 0.0,
        "gearbox.ratio": vehicle.ratio,
        "gearbox.efficiency_load": vehicle.efficiency,
        "gearbox.friction_coulomb": 0.0,
        "gearbox.friction_viscous": 0.0,
        "battery.curvature": 0.0,
        "battery.slope": 0.0,
        "battery.voltage_full": 4.0,
        "battery.resistance": 0.0,
        "battery.current_other": 0.0,
        "battery.capacity": vehicle.capacity,
        f"{WHEELED}.mass": vehicle.mass,
        f"{WHEELED}.radius": vehicle.radius,
        f"{WHEELED}.inertia": vehicle.inertia / 2,  # of one side
        f"{WHEELED}.track.loss_coulomb": 0.0,
        f"{WHEELED}.track.loss_viscous": 0.0,
        f"{WHEELED}.track.guide_share": 0.0,
        f"{WHEELED}.ground.rolling_resistance": vehicle.rolling,
        f"{WHEELED}.ground.friction.static": 1.0,
        f"{WHEELED}.ground.friction.dynamic": 0.8,
        f"{WHEELED}.ground.friction.speed_static": 1e-3,
        "driver.current_limit": 1e4,
    }
    robot = params.replace(paper_robots.nominal(), values)
    battery = dataclasses.replace(robot.battery, cells=vehicle.cells)
    return params.without_weak_types(dataclasses.replace(robot, battery=battery))


@eqx.filter_jit
def followed(robot: Robot, conditions: Conditions, course: Profile) -> Mission:
    """The mission, compiled."""
    return mission(robot, conditions, course, keep=KEEP)


def energies(time: np.ndarray, wheel: np.ndarray) -> dict[str, float]:
    """Work of the power at the `wheel` [W] over `time` [s], by sign. The power is linear in between."""
    out, back = (np.trapezoid(np.maximum(sign * wheel, 0.0), time) for sign in (1, -1))
    return {"wheel_J": float(out), "wheel_back_J": float(back)}


def per_km(energy: float, distance: float) -> float:
    """Wh/km of an energy [J] over a distance [m]."""
    return energy / 3.6 / distance


def mmrjax_of(vehicle: Vehicle, asked: Trace) -> dict[str, Any]:
    """The mission of this project."""
    robot = robot_of(vehicle)
    course = profile(asked.time, "speed", demand=asked.speed, slope_deg=asked.slope_deg, linear=True)
    found = followed(robot, Conditions(configuration=WHEELED, battery=1.0).resolved(robot), course)
    assert found.course is not None
    steps = int(found.steps - found.rejected)
    if int(found.result.status) != CONVERGED or steps > KEEP:
        raise RuntimeError(f"{vehicle.name}: {STATUSES[int(found.result.status)]} after {steps} steps of {KEEP}")
    time, s = np.asarray(found.course.time)[:steps], found.course.signals
    wheel = float(robot.sides) * np.asarray(s.torque_gear * s.speed_wheel)[:steps]
    of = {name: float(x) for name, x in found.total.of.items()}
    wanted = asked.at(time)[0]
    return {
        **energies(time, wheel),
        "battery_J": of["drawn"] - of["returned"],
        "distance_m": of["distance"],
        "Wh_per_km": per_km(of["drawn"] - of["returned"], of["distance"]),
        "winding_J": of["winding"],
        "sliding_J": of["sliding"],
        "wheel_net_by_sinks_J": of["rolling"] + of["lift"] + of["sliding"] + of["track"] + float(found.total.stored),
        "unaccounted_J": float(found.total.unaccounted),
        "speed_off_rms": float(np.sqrt(np.trapezoid((np.asarray(s.speed)[:steps] - wanted) ** 2, time) / time[-1])),
        "steps": steps,
    }


def fastsim_of(vehicle: Vehicle, asked: Trace, step: float, *, sine: bool = False) -> dict[str, Any]:
    """FASTSim's run in steps of `step` [s].

    Its grade is rise over run, tan α. With `sine` it is given sin α instead.
    """
    import fastsim

    template = fastsim.Vehicle.from_resource("2022_Renault_Zoe_ZE50_R135.yaml").to_dict(data_fmt="yaml")
    template |= {"name": vehicle.name, "mass_kilograms": vehicle.mass, "pwr_aux_base_watts": 0.0, "save_interval": 1}
    template["chassis"] |= {
        "drag_coef": 0.0, "wheel_rr_coef": vehicle.rolling, "num_wheels": 4, "wheel_radius_meters": vehicle.radius,
        "wheel_inertia_kilogram_square_meters": vehicle.inertia / 4, "drive_type": "4WD", "wheel_fric_coef": 1.0,
        "drive_axle_weight_frac": 1.0, "glider_mass_kilograms": None, "cargo_mass_kilograms": None,
    }  # fmt: skip
    chain = template["pt_type"]["BEV"]
    chain["transmission"]["eff_interp"] = vehicle.efficiency
    chain["em"]["eff_interp_achieved"]["data"] = {"grid": [[0.0, 1.0]], "values": [1.0, 1.0]}
    chain["em"]["eff_interp_at_max_input"] = None
    chain["res"] |= {
        "eff_interp": {"Constant": 1.0},
        "energy_capacity_joules": 4.0 * vehicle.cells * vehicle.capacity,
    }
    count = round(asked.time[-1] / step)
    time = np.arange(count + 1) * step
    speed, _ = asked.at(time)
    # The grade of a step belongs to the interval before it.
    _, slope = asked.at(np.concatenate([time[:1], (time[1:] + time[:-1]) / 2]))
    grade = np.sin(slope) if sine else np.tan(slope)
    cycle = fastsim.Cycle.from_dict(
        {
            "name": "trace", "time_seconds": time.tolist(), "speed_meters_per_second": speed.tolist(),
            "grade": grade.tolist(),
        },
        data_fmt="yaml",
    )  # fmt: skip
    run = fastsim.SimDrive(fastsim.Vehicle.from_dict(template, data_fmt="yaml"), cycle)
    run.run()
    done = run.to_dict(data_fmt="yaml")["veh"]
    state, history = done["state"], done["history"]
    if not state["cyc_met_overall"]:
        raise RuntimeError(f"{vehicle.name}: FASTSim did not meet the trace")
    wheel = np.asarray(history["pwr_tractive_watts"])
    steps = np.diff(np.asarray(history["time_seconds"]), prepend=0.0)
    battery = done["pt_type"]["BEV"]["res"]["state"]["energy_out_chemical_joules"]
    return {
        "wheel_J": float(np.sum(np.maximum(wheel, 0.0) * steps)),
        "wheel_back_J": float(np.sum(np.maximum(-wheel, 0.0) * steps)),
        "battery_J": battery,
        "distance_m": state["dist_meters"],
        "Wh_per_km": per_km(battery, state["dist_meters"]),
    }


def integral_of(vehicle: Vehicle, asked: Trace, gravity: float = GRAVITY, *, tangent: bool = False) -> dict[str, Any]:
    """Rolling, climbing and acceleration integrated over the trace, with `gravity` [m/s²].

    With `tangent` the climb uses tan α instead of sin α, as FASTSim does.
    """
    mass = vehicle.mass + vehicle.inertia / vehicle.radius**2
    total = dict.fromkeys(("wheel_J", "wheel_back_J", "distance_m"), 0.0)
    for begin, end in zip(asked.time[:-1], asked.time[1:], strict=True):
        time = np.linspace(begin, end, 2001)
        speed, slope = asked.at(time)
        inertia = mass * (speed[-1] - speed[0]) / (end - begin)
        climb = np.tan(slope) if tangent else np.sin(slope)
        force = inertia + vehicle.mass * gravity * (vehicle.rolling * np.cos(slope) + climb)
        for name, value in energies(time, force * speed).items():
            total[name] += value
        total["distance_m"] += float(np.trapezoid(speed, time))
    battery = total["wheel_J"] / vehicle.efficiency - total["wheel_back_J"] * vehicle.efficiency
    return {**total, "battery_J": battery, "Wh_per_km": per_km(battery, total["distance_m"])}


def percent(a: dict[str, Any], b: dict[str, Any]) -> dict[str, float]:
    """Relative difference of `a` from `b` [%]."""
    names = ("wheel_J", "wheel_back_J", "distance_m", "Wh_per_km")
    return {name: round(100 * (a[name] / b[name] - 1), 4) for name in names}


def compared(vehicle: Vehicle, asked: Trace) -> dict[str, Any]:
    """Results of both simulators and the integral, and their differences."""
    ours, exact = mmrjax_of(vehicle, asked), integral_of(vehicle, asked)
    theirs, fine = (fastsim_of(vehicle, asked, step) for step in (1.0, 0.1))
    like_theirs = integral_of(vehicle, asked, GRAVITY_FASTSIM, tangent=True)
    rougher = dataclasses.replace(vehicle, rolling=1.02 * vehicle.rolling)
    apart = {"1 s": percent(ours, theirs), "0.1 s": percent(ours, fine)}
    return {
        "mmrjax": ours,
        "fastsim 1 s": theirs,
        "fastsim 0.1 s": fine,
        "integral": exact,
        "mmrjax over fastsim, %": apart,
        "mmrjax over integral, %": percent(ours, exact),
        "fastsim 0.1 s over integral with its g and tan, %": percent(fine, like_theirs),
        "fastsim 1 s over fastsim 0.1 s, %": percent(theirs, fine),
        "fastsim 0.1 s, tan over sin, %": percent(fine, fastsim_of(vehicle, asked, 0.1, sine=True)),
        "g, mmrjax over fastsim, %": round(100 * (GRAVITY / GRAVITY_FASTSIM - 1), 4),
        "mmrjax over fastsim 1 s with 2 % more rolling resistance, %": percent(ours, fastsim_of(rougher, asked, 1.0)),
        "met": all(abs(a["wheel_J"]) <= 0.5 and abs(a["Wh_per_km"]) <= 1.0 for a in apart.values()),
    }


#: Each vehicle with its trace.
CASES = ((ROBOT, trace(0.5, 1.0, 5.0, 4.0)), (CAR, trace(6.0, 12.0, 3.0, 2.0)))


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    try:
        version = importlib.metadata.version("fastsim")
    except importlib.metadata.PackageNotFoundError:
        print(INSTALL, file=sys.stderr)
        sys.exit(2)
    met = True
    for vehicle, asked in CASES:
        found = compared(vehicle, asked)
        line = {"benchmark": "missions beside FASTSim", "vehicle": vehicle.name, "fastsim": version, **found}
        print(json.dumps({**line, "machine": machine()}), flush=True)
        met = met and found["met"]
    sys.exit(0 if met else 3)


if __name__ == "__main__":
    main()
