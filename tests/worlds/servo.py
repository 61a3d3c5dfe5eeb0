"""A motor under a position controller, in NumPy alone: generated logs of goal and angle."""

from __future__ import annotations

import itertools

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
REST = 1e-5


def simulate(goal, times, values=TRUE, tolerance=1e-10, period=0.0, late=False):
    """Angle of the output at `times` [rad], and the state (current, speed, angle, integral, lagging duty) there.

    Args:
        goal: (instants, values): held from each instant until the next.
        period: of a sampled controller, which integrates and then holds its duty for so long [s]. 0: a continuous one.
        late: True if the duty acts one sample later.
    """
    v, states, y = values, [np.zeros(5)], np.zeros(5)
    lag, duties = v.get("lag", 0.0), [0.0, 0.0]  # the duty that acts, and the one that acts next
    inertia = v["load"] + v["ratio"] ** 2 * v["rotor"]

    def demand(aim, y):
        wanted = v["kp"] * (aim - y[2]) + v["ki"] * y[3] - v["kd"] * y[1]
        return min(max(wanted, -v["limit"]), v["limit"])

    def integrated(aim, y):
        wound = abs(demand(aim, y)) >= v["limit"] and demand(aim, y) * (aim - y[2]) > 0
        return 0.0 if wound else aim - y[2]

    def rates(aim, y):
        current, speed, _, _, lagging = y
        wanted = demand(aim, y)
        duty = duties[0] if period else lagging if lag else wanted
        back = v["constant"] * v["ratio"] * speed
        friction = v["coulomb"] * np.clip(speed / REST, -1, 1) + v["viscous"] * speed
        torque = v["ratio"] * v["constant"] * current - friction
        return [
            (duty * v["supply"] - v["resistance"] * current - back) / v["inductance"],
            torque / inertia, speed, 0.0 if period else integrated(aim, y), (wanted - lagging) / lag if lag else 0.0,
        ]  # fmt: skip

    samples = np.arange(0.0, times[-1], period) if period else []
    clock = np.unique(np.round(np.concatenate([goal[0], times, samples]), 12))
    for now, until in itertools.pairwise(clock):
        aim = goal[1][np.searchsorted(goal[0], now + 1e-9, side="right") - 1]
        if period and abs(now / period - round(now / period)) < 1e-6:
            duties[:] = (duties[1], demand(aim, y)) if late else (demand(aim, y), 0.0)
            y = y + period * integrated(aim, y) * np.eye(5)[3]
        law = lambda _, y, aim=aim: rates(aim, y)  # noqa: E731
        y = solve_ivp(law, (now, until), y, "Radau", rtol=tolerance, atol=tolerance).y[:, -1]
        if np.abs(times - until).min() < 1e-9:
            states.append(y)
    return np.array(states)[:, 2], np.array(states)
