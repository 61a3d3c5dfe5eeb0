# ruff: noqa: E741 (symbols as in the paper)
"""The steady balances over whole arrays in plain NumPy: a closed form, and Newton's method with four effects.

What somebody who sweeps without this project would write. Nothing here comes from mmrjax. It holds where the robot
drives forward on an external supply, is not driven by its load and does not slide, and asks nothing of a point.
Symbols and numbers as in `reference`.
"""

from __future__ import annotations

import itertools

import numpy as np
from worlds.paper import NOMINAL, SIDES, G

ALPHA = 0.00393  # IEC 60028 [1/K]
LIMIT = 125.0  # of the winding [°C]
NAMES = ("total_current", "motor_speed", "speed")


def _tables(p):
    """Numbers that depend on the configuration, tracked first, each an array of two."""
    both = ("6T2A.", "4W2T.")
    names = ("mass", "radius", "track.loss_coulomb", "track.loss_viscous", "ground.rolling_resistance")
    names += ("ground.friction.static", "ground.friction.speed_static")
    tables = {name.rsplit(".", 1)[-1]: np.array([p[c + name] for c in both]) for name in names}
    guide = np.array([p[c + "track.guide_friction"] * p[c + "track.guide_share"] for c in both])
    return {**tables, "guide": guide}


class Loads:
    """What the slope and the load ask of one side. Every field an array over the points."""

    def __init__(self, wheeled, slope_deg, payload, p=NOMINAL):
        t = _tables(p)
        alpha = slope_deg * (np.pi / 180)
        weight = (t["mass"][wheeled] + payload) * (G / SIDES)
        self.normal = weight * np.cos(alpha)
        self.gravity = weight * np.sin(alpha)
        self.resistance = t["rolling_resistance"][wheeled] * self.normal
        self.demand = self.resistance + self.gravity
        self.r = t["radius"][wheeled]
        # torque at the pulley that does not depend on the speed, and per ω_k
        self.M_0 = t["loss_coulomb"][wheeled] + self.r * (t["guide"][wheeled] * self.normal + self.demand)
        self.K = t["loss_viscous"][wheeled]
        self.used = self.demand / (t["static"][wheeled] * self.normal)
        self.creep = 2 * t["speed_static"][wheeled] * np.sin(np.arcsin(self.used) / 3)


def _drive(p):
    """R, C, i, η_rm, and the dry and the viscous friction of motor and gearbox, both at the motor's shaft."""
    dry = p["motor.friction_coulomb"] + p["gearbox.friction_coulomb"]
    viscous = p["motor.friction_viscous"] + p["gearbox.friction_viscous"]
    names = ("motor.resistance", "motor.torque_constant", "gearbox.ratio", "gearbox.efficiency_load")
    return *(p[name] for name in names), dry, viscous


def closed_form(wheeled, voltage, slope_deg, payload, p=NOMINAL, loads=None):
    """Total current [A], motor speed [rad/s] and speed [m/s] without effects, each of shape (points,)."""
    load = loads or Loads(wheeled, slope_deg, payload, p)
    R, C, i, eta, M_f, K_f = _drive(p)
    w = (voltage - R / C * (M_f + load.M_0 / (i * eta))) / (C + R / C * (K_f + load.K / (i * i * eta)))
    I = (voltage - C * w) / R
    return SIDES * I, w, load.r * w / i - load.creep


def closed_form_all(wheeled, voltage, slope_deg, payload, p=NOMINAL):
    """Every output of `steady` but its codes, by its name [SI], each of shape (points,)."""
    load = Loads(wheeled, slope_deg, payload, p)
    I_s, w, V = closed_form(wheeled, voltage, slope_deg, payload, p, load)
    R, C, i, eta, _, _ = _drive(p)
    I = I_s / SIDES
    torque = C * I - p["motor.friction_coulomb"] - p["motor.friction_viscous"] * w
    idle = p["gearbox.friction_coulomb"] + p["gearbox.friction_viscous"] * w
    w_k = w / i
    powers = [voltage * I_s, SIDES * torque * w, SIDES * i * eta * (torque - idle) * w_k, SIDES * load.demand * V]
    efficiencies = [after / before for before, after in itertools.pairwise(powers)]
    return {
        "total_current": I_s,
        "motor_speed": w,
        "speed": V,
        "theoretical_speed": load.r * w_k,
        "slip": 1 - V / (load.r * w_k),
        "voltage": voltage.copy(),
        "adhesion_used": load.used,
        "traction": SIDES * load.demand,
        **dict(zip(("power_supply", "power_motor", "power_gear", "power_ground"), powers, strict=True)),
        "power_lift": SIDES * load.gravity * V,
        **dict(zip(("efficiency_motor", "efficiency_gear", "efficiency_chassis"), efficiencies, strict=True)),
        "winding_settled": _settled(p, R * I * I),
        "voltage_cell": np.zeros_like(V),
    }


def _thermal(p):
    return p["motor.resistance_thermal_winding"] + p["motor.resistance_thermal_housing"]


def _settled(p, cold):
    """Winding temperature after long running with `cold` watts at 25 °C, by turns of T -> T_a + R_th P (1 + α (T - 25))."""
    ambient = p["motor.temperature_ambient"]
    temperature = np.full_like(cold, ambient)
    for _ in range(4000):
        temperature = np.minimum(ambient + _thermal(p) * cold * (1 + ALPHA * (temperature - 25)), 1e9)
    return np.where(temperature < 1e6, temperature, np.inf)


def newton(
    wheeled, voltage, slope_deg, payload, series, churning, heating, slip, p=NOMINAL, tolerance=5e-14, most=40
):
    """The three numbers with `series_resistance`, `churning`, `winding_heating` and `nonlinear_slip` of these sizes.

    The torque gives the current, the slip the speed, both in closed form. What is left is one equation in the motor
    speed, the voltage, of which every point makes each step until the last is within `tolerance` times 10 V.
    """
    load = Loads(wheeled, slope_deg, payload, p)
    R, C, i, eta, M_f, K_f = _drive(p)
    # I = c0 + c1 ω + c2 ω²
    c0 = (M_f + load.M_0 / (i * eta)) / C
    c1 = (K_f + load.K / (i * i * eta)) / C
    c2 = churning / (i**3 * eta * C)
    warm, most_warm = _thermal(p) * R, LIMIT - p["motor.temperature_ambient"]
    w = 0.9 * voltage / C
    for _ in range(most):
        I = c0 + (c1 + c2 * w) * w
        rise = np.minimum(warm * I * I, most_warm)
        drop = (R + series + heating * ALPHA * R * rise) * I
        left = voltage - C * w - drop
        if np.max(np.abs(left)) < 10 * tolerance:
            break
        by_current = R + series + heating * ALPHA * R * np.where(rise < most_warm, 3 * rise, rise)
        w += left / (C + by_current * (c1 + 2 * c2 * w))
    return SIDES * I, w, load.r * w / i * (1 - slip * load.used**3) - load.creep
