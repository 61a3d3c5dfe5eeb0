"""A motor under a position controller, in NumPy alone: generated logs of goal and angle."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

#: Values of the robot's file `RIG`, by short names.
TRUE = {
    "kp": 8.0, "ki": 0.0, "kd": 0.1, "limit": 0.9, "supply": 7.4, "resistance": 4.0, "inductance": 1e-3, "constant": 0.006,
    "rotor": 1e-7, "ratio": 200.0, "load": 5e-4, "coulomb": 0.02, "viscous": 0.005,
}  # fmt: skip
RIG = """
base = "none"
sides = 1
imposed = "goal_angle"
channels = ["output_angle"]
[controller]
kp = {kp}
ki = {ki}
kd = {kd}
limit = {limit}
supply_voltage = {supply}
[motor]
resistance = {resistance}
inductance = {inductance}
torque_constant = {constant}
inertia = {rotor}
[gearbox]
ratio = {ratio}
efficiency_load = 1.0
[horn]
load = "shaft"
inertia = {load}
loss_coulomb = {coulomb}
loss_viscous = {viscous}
"""
#: Speed of the output up to which dry friction grows to its value [rad/s].
REST = 1e-4


def simulate(goal, times, values=TRUE, tolerance=1e-10):
    """Angle of the output at `times` [rad], and the state (current, speed, angle, integral) there.

    Args:
        goal: (instants, values): held from each instant until the next.
    """
    v, states, y = values, [np.zeros(4)], np.zeros(4)
    inertia = v["load"] + v["ratio"] ** 2 * v["rotor"]

    def rates(aim, t, y):
        current, speed, angle, integral = y
        wanted = v["kp"] * (aim - angle) + v["ki"] * integral - v["kd"] * speed
        duty = min(max(wanted, -v["limit"]), v["limit"])
        back = v["constant"] * v["ratio"] * speed
        friction = v["coulomb"] * np.clip(speed / REST, -1, 1) + v["viscous"] * speed
        torque = v["ratio"] * v["constant"] * current - friction
        wound = abs(duty) >= v["limit"] and duty * (aim - angle) > 0
        return [
            (duty * v["supply"] - v["resistance"] * current - back) / v["inductance"],
            torque / inertia, speed, 0.0 if wound else aim - angle,
        ]  # fmt: skip

    instants = np.append(goal[0][1:], np.inf)
    k = int(np.searchsorted(goal[0], 0.0, side="right")) - 1
    now = 0.0
    for t in times[1:]:
        while now < t:
            until = min(t, instants[k])
            found = solve_ivp(
                lambda s, y, k=k: rates(goal[1][k], s, y), (now, until), y, "Radau", rtol=tolerance, atol=tolerance
            )
            y, now = found.y[:, -1], until
            k += until == instants[k]
        states.append(y)
    return np.array(states)[:, 2], np.array(states)
