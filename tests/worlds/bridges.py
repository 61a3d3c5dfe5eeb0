"""Settled runs behind a driver with a current limit or a diode, by bisection in NumPy, nothing of mmrjax.

Equation numbers are the paper's. Of a vehicle or of a shaft on a bench, many runs at once: an outer bisection over
the motor speed and an inner one over the current, whose balances fall in their unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from worlds import paper

STEEP = 500.0  # by how much of the duty a driver lowers it for each share of current beyond its limit [-]
HALVINGS = 120
FASTEST = 2e5  # [rad/s]


def halved(falls: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The place at which a falling function changes its sign, also by a jump."""
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        above = falls(middle) > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return 0.5 * (low + high)


def vehicle(c: str, payload: np.ndarray, slope: np.ndarray, p: dict[str, float] = paper.NOMINAL) -> dict[str, Any]:
    """Loads of one side of the paper's robot: of either way, per speed, and with gravity [N·m], and its radius [m]."""
    normal = (p[f"{c}.mass"] + payload) / 2 * paper.G * np.cos(slope)
    roll, radius = p[f"{c}.ground.rolling_resistance"] * normal, p[f"{c}.radius"]
    guides = p[f"{c}.track.guide_friction"] * p[f"{c}.track.guide_share"] * normal
    pull = (p[f"{c}.mass"] + payload) / 2 * paper.G * np.sin(slope)
    return {
        "dry": p[f"{c}.track.loss_coulomb"] + radius * (guides + roll),
        "viscous": p[f"{c}.track.loss_viscous"],
        "constant": radius * pull,
        "demand": (np.abs(pull) + roll) / (p[f"{c}.ground.friction.static"] * normal),
    }


def current_at(
    motor: dict[str, Any],
    speed: np.ndarray,
    source: Callable[[np.ndarray], np.ndarray],
    way_supply: np.ndarray,
    duty: np.ndarray,
    limit: np.ndarray,
    one_way: np.ndarray,
    sides: float = 2.0,
) -> np.ndarray:
    """Current of a motor [A] at its speed [rad/s].

    Args:
        source: voltage of the supply at a current that all motors draw.
        way_supply: its sign.
    """
    R, back = motor["R"], motor["C"] * speed

    def left(I: np.ndarray) -> np.ndarray:  # noqa: E741
        over = np.maximum(np.abs(I) / limit - 1, 0)
        D = np.clip(duty - way_supply * np.sign(I) * STEEP * over, -1, 1)
        U = np.where(one_way & (D * way_supply * I < 0), back, D * source(sides * D * I))
        return U - back - R * I

    most = (np.abs(source(0.0 * limit)) + 50 + np.abs(back)) / R + limit
    return halved(left, -most, most)


def settled(
    motor: dict[str, Any],
    load: dict[str, Any],
    volts: np.ndarray,
    duty: np.ndarray,
    limit: np.ndarray,
    one_way: np.ndarray,
    battery: np.ndarray,
    sides: float = 2.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Current of a motor [A] and its speed [rad/s], 0 where friction holds it.

    Args:
        motor: R, C, K_f, M_f, i, eta: resistance, torque constant, viscous and dry friction with the gear's, ratio,
            efficiency.
        load: dry, viscous, constant: at the output.
        battery: True on the paper's full battery, else the supply of `volts`.
    """
    C, ratio, eta = motor["C"], motor["i"], motor["eta"]

    def source(drawn: np.ndarray) -> np.ndarray:
        p = paper.NOMINAL
        of_battery = paper.CELLS * (
            p["battery.voltage_full"] - (drawn + p["battery.current_other"]) * p["battery.resistance"]
        )
        return np.where(battery, of_battery, volts)

    way_supply = np.where(~battery & (volts < 0), -1.0, 1.0)

    def current(speed: np.ndarray) -> np.ndarray:
        return current_at(motor, speed, source, way_supply, duty, limit, one_way, sides)

    def torque(speed: np.ndarray, way: np.ndarray) -> np.ndarray:
        drive = C * current(speed) - way * motor["M_f"] - motor["K_f"] * speed
        gained = np.where(drive * way >= 0, eta, 1 / eta)
        return ratio * gained * drive - way * load["dry"] - load["viscous"] * speed / ratio - load["constant"]

    none = np.zeros_like(volts)
    way = np.where(torque(none, none + 1) > 0, 1.0, np.where(torque(none, none - 1) < 0, -1.0, 0.0))
    speed = way * halved(lambda x: way * torque(way * x, way), none, none + FASTEST)
    return current(speed), np.where(way == 0, 0.0, speed)


def started(
    motor: dict[str, float], volts: float, limit: float, times: np.ndarray, rest: float = 0.01
) -> tuple[np.ndarray, np.ndarray]:
    """Current [A] and motor speed [rad/s] of a dyno from rest at `times`, by Radau.

    Args:
        motor: as for `settled`, with L and the inertias J of the motor and J_l of the load, its friction dry
            and viscous.
        rest: speed of the load within which friction is smooth [rad/s].
    """
    i, eta = motor["i"], motor["eta"]

    def rates(_: float, y: np.ndarray) -> list[float]:
        duty = np.clip(1 - np.sign(y[0]) * STEEP * max(abs(y[0]) / limit - 1, 0), -1, 1)
        x = min(max(y[1] / i / rest, -1), 1)
        way = 0.5 * x * (3 - x * x)
        drive = motor["C"] * y[0] - motor["M_f"] * way - motor["K_f"] * y[1]
        load = motor["dry"] * way + motor["viscous"] * y[1] / i
        flow = way * (np.sign(drive * motor["J_l"] + i * motor["J"] * load) or np.sign(way))
        gained = 1 + flow * (eta - 1 if flow >= 0 else 1 - 1 / eta)
        turning = i * (i * gained * drive - load) / (motor["J"] * i**2 * gained + motor["J_l"])
        return [(duty * volts - motor["C"] * y[1] - motor["R"] * y[0]) / motor["L"], turning]

    run = solve_ivp(rates, times[[0, -1]], [0, 0], "Radau", times, rtol=1e-9, atol=[1e-10, 1e-7], max_step=2e-3)
    return run.y[0], run.y[1]
