"""Drives through events by SciPy: stretches without an event, and between them its own root finder.

Plain physics of one motor, gear and load in SI, without a line of the simulator. Friction jumps at rest. A load that
friction holds stands until the motor turns it. Of a load behind a backlash friction goes over smoothly within 0.01
rad/s at the output, as the simulator states for loads whose moments of rest are apart.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.integrate import solve_ivp
from worlds import paper

RESTING = 0.01  # speed of a load within which its friction is smooth behind a backlash [rad/s]
STEEP = 500.0  # by how much of the duty a driver lowers it for each share of current beyond its limit [-]
ACCURATE = 1e-10


def _smooth(speed: float) -> float:
    x = min(1.0, max(-1.0, speed / RESTING))
    return x * (3 - x * x) / 2


@dataclasses.dataclass(frozen=True)
class Bench:
    """A motor with a winding, a gear with one efficiency both ways, and a load with dry and viscous friction."""

    resistance: float = 3.0
    inductance: float = 1e-3
    torque_constant: float = 0.05
    inertia_motor: float = 2e-6
    friction_motor: float = 2e-3
    ratio: float = 16.0
    efficiency: float = 0.8
    inertia: float = 0.02
    loss_coulomb: float = 0.2
    loss_viscous: float = 0.01
    current_limit: float = 1000.0
    backlash: float = 0.0
    frequency: float = 150.0  # of the flanks [Hz]
    damping: float = 0.4
    stiffness: float = 0.0  # of an elastic joint, if there is one [N·m/rad]
    damper: float = 0.0  # of an elastic joint [N·m·s/rad]

    def winding(self, current: float, motor: float, volts: float) -> float:
        over = max(abs(current) / self.current_limit - 1, 0.0)
        duty = min(1.0, max(-1.0, 1 - np.sign(current * volts) * STEEP * over))
        return (duty * volts - self.torque_constant * motor - self.resistance * current) / self.inductance

    def turning(self, current: float, motor: float, way: float) -> float:
        """Acceleration of the motor with friction of one way [rad/s²]."""
        drive = self.torque_constant * current - way * self.friction_motor
        load = way * self.loss_coulomb + self.loss_viscous * motor / self.ratio
        through = self.ratio * self.inertia_motor
        forward = (drive * self.inertia + through * load) / (self.inertia + through) * way >= 0
        eta = self.efficiency if forward else 1 / self.efficiency
        net = self.ratio * eta * drive - load
        return self.ratio * net / (self.inertia + eta * self.ratio**2 * self.inertia_motor)

    def rates(self, y: np.ndarray, volts: float, way: int) -> list[float]:
        return [self.winding(y[0], y[1], volts), self.turning(y[0], y[1], way) if way else 0.0]

    def flanks(self, gap: float, closing: float) -> float:
        """Torque between the two sides of a backlash or an elastic joint at the output [N·m]."""
        if self.stiffness and not self.backlash:
            return self.stiffness * gap + self.damper * closing
        motor, beyond = self.inertia_motor * self.ratio**2, abs(gap) - self.backlash / 2
        if beyond <= 0:
            return 0.0
        side, omega = np.sign(gap), 2 * np.pi * self.frequency
        inertia = motor * self.inertia / (motor + self.inertia)
        stiffness = self.stiffness or omega**2 * inertia
        damper = self.damper if self.stiffness else 2 * self.damping * omega * inertia
        damped = damper * side * closing * min(beyond / (0.1 * self.backlash + 1e-4), 1.0)
        return side * max(stiffness * beyond + damped, 0.0)

    def rates_loose(self, y: np.ndarray, volts: float) -> list[float]:
        """Of current, motor speed, speed of the load at the output, and angle between them."""
        current, motor, load, gap = y
        torque = self.flanks(gap, motor / self.ratio - load)
        way = _smooth(motor / self.ratio)
        flow = np.sign(torque) * way if abs(torque) > 1e-12 else abs(way)
        eta = 1 + flow * (self.efficiency - 1 if flow >= 0 else 1 - 1 / self.efficiency)
        drive = self.torque_constant * current - way * self.friction_motor
        lost = self.loss_coulomb * _smooth(load) + self.loss_viscous * load
        return [
            self.winding(current, motor, volts),
            (self.ratio * drive - torque / eta) / (self.inertia_motor * self.ratio),
            (torque - lost) / self.inertia,
            motor / self.ratio - load,
        ]


def _event(function, direction: float):
    function.terminal, function.direction = True, direction
    return function


def through(
    bench: Bench, volts: np.ndarray, changes: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, dict[float, str]]:
    """Current [A] and motor speed [rad/s] from rest at `times`, which begin at 0, and its events by their times.

    Args:
        volts: that act from `changes` on, the first of which is 0.
    """
    loose, way = bench.backlash > 0 or bench.stiffness > 0, 0
    y, t, found, happened = np.zeros(4 if loose else 2), 0.0, [], {}
    limited = _event(lambda _, y, *a: abs(y[0]) - bench.current_limit, 0.0)
    rests = _event(lambda _, y, v, way: way * y[1], -1.0)
    starts = [_event(lambda _, y, v, _way, s=s: s * bench.turning(y[0], 0.0, s), 1.0) for s in (1, -1)]
    meets = _event(lambda _, y, v, _way: abs(y[3]) - bench.backlash / 2, 0.0)
    for k, volt in enumerate(volts):
        end = changes[k + 1] if k + 1 < len(changes) else times[-1]
        while t < end:
            if not loose and y[1] == 0.0:  # at rest: is it turned, or held?
                way = next((s for s in (1, -1) if s * bench.turning(y[0], 0.0, s) > 1e-9), 0)
            events = (
                [limited, meets][: 1 + (bench.backlash > 0)]
                if loose
                else [limited, rests]
                if way
                else [limited, *starts]
            )
            rates = (lambda _, y, v, w: bench.rates_loose(y, v)) if loose else lambda _, y, v, w: bench.rates(y, v, w)
            scale = np.array([1.0, 100.0, 10.0, 0.01])[: len(y)]
            run = solve_ivp(
                rates, (t, end), y, "LSODA", events=events, args=(volt, way), dense_output=True, rtol=ACCURATE,
                atol=ACCURATE * scale, first_step=1e-9,
            )  # fmt: skip
            assert run.success, run.message
            inside = times[(times >= t) & (times < run.t[-1])]
            if len(inside):
                found.extend(run.sol(inside).T[:, :2])
            t, y = run.t[-1], run.y[:, -1]
            if run.status == 1:
                which = next(i for i, at in enumerate(run.t_events) if len(at))
                words = ["limit", "flank"] if loose else ["limit", "rest"] if way else ["limit", "start", "start"]
                happened[float(t)] = words[which]
                if words[which] == "rest":
                    y[1] = 0.0
                elif words[which] == "start":
                    way = 1 if which == 1 else -1
                    y[1] = 1e-12 * way
                else:  # across, or it would be found again
                    y, t = y + 1e-9 * np.asarray(rates(t, y, volt, way)), t + 1e-9
    found.append(y[:2])
    return np.array(found), happened


class Robot(paper.Side):
    """One side of a robot on its battery, whose driver gives a duty and limits the current, with heat and energy.

    The state is that of `paper.Side` [A, rad/s, m/s, m, C], the temperatures of winding and housing [°C], and the
    energy that the cells give [J].
    """

    def __init__(self, limit: float, p: dict[str, float], slope: float = 0.0):
        super().__init__(0.0, slope, battery=True, p=p)
        self.duty, self.limit, self.cold = 1.0, limit, self.R
        self.R_wh, self.R_ha = p["motor.resistance_thermal_winding"], p["motor.resistance_thermal_housing"]

    def given(self, current: float) -> float:
        """Duty that the driver gives at a current [A]."""
        over = max(abs(current) / self.limit - 1, 0.0)
        return min(1.0, max(-1.0, self.duty - np.sign(current) * STEEP * over))

    def supply(self, I: float, C_b: float) -> float:  # noqa: E741
        duty = self.given(I)
        return duty * super().supply(duty * I, C_b)

    def rates(self, t: float, y: np.ndarray) -> list[float]:
        winding, housing = y[5:7]
        self.R = self.cold * (1 + 0.00393 * (winding - 25))
        own, duty, flow = super().rates(t, y[:5]), self.given(y[0]), (winding - housing) / self.R_wh
        drawn = paper.SIDES * duty * y[0]
        heat = [
            (self.R * y[0] ** 2 - flow) * self.R_wh / 16.3,
            (flow - (housing - 25) / self.R_ha) * self.R_ha / 593.0,
        ]
        cells = super().supply(-self.I_p / paper.SIDES, y[4])  # without current
        return [*own[:4], drawn + self.I_p, *heat, cells * (drawn + self.I_p)]

    def over(self, duties: list[float], times: list[float]) -> np.ndarray:
        """State at `times`, the first of them 0, after each of the duties between them."""
        y, ends = np.array([0.0, 0, 0, 0, 0, 25, 25, 0]), []
        limited = _event(lambda _, y: abs(y[0]) - self.limit, 0.0)
        scale = np.array([10, 1000, 1, 1, 100, 50, 50, 100.0])
        for k, self.duty in enumerate(duties):
            t = times[k]
            while t < times[k + 1]:
                span = (t, times[k + 1])
                run = solve_ivp(self.rates, span, y, "LSODA", events=limited, rtol=1e-9, atol=1e-9 * scale)
                assert run.success, run.message
                t, y = run.t[-1], run.y[:, -1]
                if run.status == 1:  # across, or it would be found again
                    y, t = y + 1e-9 * np.asarray(self.rates(t, y)), t + 1e-9
            ends.append(y)
        return np.array(ends)
