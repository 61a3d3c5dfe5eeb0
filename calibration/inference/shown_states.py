"""States of a robot that a log shows, row by row, and windows of its runs for the equations.

No window contains a jump of an imposed quantity, a gap between rows, or rest. After a jump the current rises within a
fraction of the time between rows, and friction at rest is not a function of speed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.inference.priors import DELAY
from calibration.inference.problem import Problem
from mmrjax.model import balances
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import CURRENT, VOLTAGE
from mmrjax.model.signals import State

#: Length of a window in times between rows, and its limits [s]; its fewest rows; distance between the starts of
#: windows, as a share of their length.
LONG, LENGTHS, FEWEST, APART = 16, (0.15, 0.3), 9, 0.25
#: Jump of an imposed quantity as a share of its largest value, and the same for the acceleration of an imposed speed,
#: with which the current jumps; a time between rows that is a gap, over the usual one.
JUMP, KINK, GAP = 0.05, 0.3, 3.0
#: Speed below which a shaft may be at rest: in sds of its reading, and as a share of the largest.
REST_SD, REST = 5.0, 0.01
#: Range of an unknown delay within which a jump may act [prior sd].
DELAYED = 2.0
#: Length of a window [s] beyond which it does not show changes of the states.
LONGEST = 1.0


class Plan(eqx.Module):
    """States that a log shows, as indices of its channels.

    Attributes:
        current: index of the channel of the current, -1 if it follows from an imposed quantity.
        motion: index of the channel of the motion, -1 if it is imposed; angle: True if it is an angle, which enters
            integrated twice; travels: True for motion of the load, not of a shaft.
        others: channels that follow from the states.
        imposed: as in `Rig.imposed`.
    """

    current: int = eqx.field(static=True)
    motion: int = eqx.field(static=True)
    angle: bool = eqx.field(static=True)
    travels: bool = eqx.field(static=True)
    others: tuple[int, ...] = eqx.field(static=True)
    imposed: str = eqx.field(static=True)

    @property
    def electrical(self) -> bool:
        """True if the voltage balance is an equation of the log."""
        return self.imposed == "voltage" and self.current >= 0

    @property
    def mechanical(self) -> bool:
        """True if the balance of torques is an equation of the log."""
        return self.imposed != "motor_speed"


def plan_of(problem: Problem) -> Plan | None:
    """Returns the plan of a log; None if the log does not show the states."""
    robot, counts = problem.base, np.asarray(problem.data.weight).sum(0) > 0
    shown = {k: c for k, c in enumerate(problem.channels) if counts[k]}
    if robot.loose or robot.rig.turns or {c.name for c in shown.values()} & robot.rig.magnitudes:
        return None
    imposed = robot.rig.imposed
    pulsed = np.ptp(np.asarray(problem.observe.of_rows.duty)) > 0  # type: ignore[attr-defined]
    drawn = "total_current"  # proportional to the duty of pulses
    currents = {k: c.name == drawn for k, c in shown.items() if c.rests_on == CURRENT}
    speeds = [k for k, c in shown.items() if c.zero_at_rest and c.settled]
    angles = [k for k, c in shown.items() if c.zero_at_rest and not c.settled]
    if imposed == "motor_speed":
        others = (*currents, *_voltages(shown))
        return Plan(-1, -1, False, False, others, imposed) if others else None
    if not (speeds or angles):
        return None
    motion = (*speeds, *angles)[0]
    current = next(iter(sorted(currents, key=lambda k: currents[k])), -1) if imposed == "voltage" else -1
    current = -1 if current >= 0 and pulsed and currents[current] else current
    slips = [k for k in speeds[1:] if robot.has_ground and _travels(shown[k]) and not _travels(shown[motion])]
    others = (*slips, *(_voltages(shown) if imposed == "motor_current" else ()))
    return Plan(current, motion, not speeds, _travels(shown[motion]), others, imposed)


def _voltages(shown: dict[int, Channel]) -> list[int]:
    return [k for k, c in shown.items() if c.rests_on == VOLTAGE]


def _travels(channel: Channel) -> bool:
    """True if a channel shows the motion of the load, not of a shaft."""
    return channel.unit_si in ("m", "m/s")


class Rows(eqx.Module):
    """Conditions, readings and states of each row, shape (rows, ...).

    Attributes:
        conditions: from the row on; shown: readings [SI].
        rate: slope of the channel of the motion, if that is an angle [SI/s]; way: of travel, 0 if it may be at rest.
        angle: of the output since the run's first row [rad]; since: time since the row before [s], 0 for the first.
        memory: of the robot's effects that have one, by their names.
    """

    conditions: Conditions
    shown: Float[Array, "rows channels"]
    rate: Float[Array, " rows"]
    way: Float[Array, " rows"]
    angle: Float[Array, " rows"]
    since: Float[Array, " rows"]
    memory: Mapping[str, Float[Array, " rows"]] = eqx.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Windows:
    """Windows over the rows of one run: rows of the table, and Δt w, Δt w', Δt w'' there, shape (windows, rows)."""

    rows: np.ndarray
    weight: np.ndarray
    slope: np.ndarray
    bend: np.ndarray


def window_function(share: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """w = sin⁴ π s, w' and w'' of a window at shares s of its length [s]; 0 outside.

    The first three derivatives are 0 at its ends.
    """
    s, c = np.sin(np.pi * share), np.cos(np.pi * share)
    inside = (share > 0) & (share < 1)
    rise = np.pi / length
    derivatives = s**4, 4 * rise * s**3 * c, 4 * rise**2 * s**2 * (3 * c**2 - s**2)
    return tuple(np.where(inside, x, 0.0) for x in derivatives)  # type: ignore[return-value]


def windows_of_run(time: np.ndarray, usable: np.ndarray, broken: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns the windows of one run, each as (indices of its rows, their positions as shares of its length).

    Args:
        time: of the rows [s], increasing; usable: True for rows that may be in a window.
        broken: True for rows that may not be in a window together with the previous row.
    """
    if len(time) < 2:
        return []
    usual, windows = float(np.median(np.diff(time))), list[tuple[np.ndarray, np.ndarray]]()
    if (FEWEST - 1) * usual > LONGEST:
        return windows
    starts = usable & (np.r_[True, ~usable[:-1]] | broken)
    piece = np.cumsum(starts)
    for k in np.unique(piece[usable]):
        rows = np.flatnonzero((piece == k) & usable)
        if len(rows) < FEWEST:
            continue
        whole = time[rows[-1]] - time[rows[0]]
        length = min(max(float(np.clip(LONG * usual, *LENGTHS)), (FEWEST - 1) * usual), whole)
        count = int((whole - length) / (APART * length)) + 1
        for begin in time[rows[0]] + np.linspace(0.0, whole - length, count):
            inside = rows[(time[rows] >= begin - 1e-9) & (time[rows] <= begin + length + 1e-9)]
            if len(inside) >= FEWEST - 1:
                windows.append((inside, (time[inside] - begin) / length))
    return windows


def windows_of_log(problem: Problem, plan: Plan, rate: np.ndarray) -> list[Windows]:
    """Returns the windows of each run."""
    observe: Any = problem.observe
    time, weight = np.asarray(observe.time), np.asarray(problem.data.weight)
    measured, sd = np.asarray(problem.data.measured), np.asarray(problem.data.sd)
    states = [k for k in (plan.current, plan.motion if plan.mechanical else -1, *plan.others) if k >= 0]
    moves = travel_directions(problem, plan, measured, sd, rate)
    late = _longest_delay(problem)
    windows = []
    for r, every in enumerate(np.asarray(observe.rows_of)):
        rows = every[every >= 0]
        rows = rows[np.all(weight[rows][:, states] > 0, 1)]
        if len(rows) < FEWEST:
            continue
        times, usable = time[rows], moves[rows] != 0
        gap = np.r_[False, np.diff(times) > GAP * np.median(np.diff(times))]
        turned = np.r_[False, np.diff(moves[rows]) != 0]
        broken = gap | turned
        for jump in _jumps(observe, r):
            # A reading at the instant of a jump still shows the state before it.
            usable &= ~((times > jump + 1e-9) & (times <= jump + late + 1e-9))
            broken |= np.r_[False, (times[:-1] <= jump + 1e-9) & (times[1:] > jump + 1e-9)]
        made = windows_of_run(times, usable, broken)
        step = np.gradient(times)
        whole = np.zeros((3, len(made), len(rows)))
        for k, (inside, share) in enumerate(made):
            length = (times[inside[-1]] - times[inside[0]]) / max(share[-1] - share[0], 1e-12)
            whole[:, k, inside] = np.array(window_function(share, length)) * step[inside]
        if made:
            windows.append(Windows(rows, *whole))
    return windows


def _longest_delay(problem: Problem) -> float:
    """Longest delay between a jump and its effect [s]."""
    names, delay = problem.coordinates.names, abs(float(np.max(np.asarray(problem.base.rig.delay))))
    if DELAY not in names:
        return delay
    return delay + DELAYED * float(np.asarray(problem.coordinates.spread)[names.index(DELAY)])


def _jumps(observe: Any, run: int) -> np.ndarray:
    """Times of jumps of a run's imposed quantities [s]."""
    conditions, times = observe.conditions, np.asarray(observe.times[run])
    jumps = np.zeros(len(times) - 1, bool)
    imposed = "voltage", "motor_current", "duty", "open", "load_torque", "slope_deg", "payload", "total_mass"
    for name, share in (*((n, JUMP) for n in imposed), ("motor_acceleration", KINK)):
        x = getattr(conditions, name)
        if x is not None and np.ndim(x) > 1:
            x = np.asarray(x)
            jumps |= np.abs(np.diff(x[run])) > share * max(float(np.abs(x).max()), 1e-300)
    return times[1:][jumps]


def travel_directions(
    problem: Problem, plan: Plan, measured: np.ndarray, sd: np.ndarray, rate: np.ndarray
) -> np.ndarray:
    """Direction of travel at each row, 0 if the robot may be at rest."""
    if plan.imposed == "motor_speed":
        speed = np.asarray(problem.observe.of_rows.motor_speed)  # type: ignore[attr-defined]
        return np.where(np.abs(speed) > REST * np.abs(speed).max(initial=0.0), np.sign(speed), 0.0)
    speed = rate if plan.angle else measured[:, plan.motion]
    limit = REST * np.abs(speed).max(initial=0.0)
    limit = limit if plan.angle else np.maximum(limit, REST_SD * sd[:, plan.motion])
    return np.where(np.abs(speed) > limit, np.sign(speed), 0.0)


def motion_rates(problem: Problem, plan: Plan) -> np.ndarray:
    """Rate of the channel of the motion at each row: the slope of a cubic over a window [unit / s]."""
    observe: Any = problem.observe
    time, measured = np.asarray(observe.time), np.asarray(problem.data.measured)
    out = np.zeros(len(time))
    if not plan.angle:
        return out
    for every in np.asarray(observe.rows_of):
        rows = every[every >= 0]
        rows = rows[np.asarray(problem.data.weight)[rows, plan.motion] > 0]
        for k in range(len(rows)):
            low, high = max(0, k - FEWEST // 2), min(len(rows), k + FEWEST // 2 + 1)
            near = rows[low:high]
            if len(near) > 3:
                out[rows[k]] = np.polyfit(time[near] - time[rows[k]], measured[near, plan.motion], 3)[2]
    return out


def states_by_row(problem: Problem, plan: Plan, rate: np.ndarray) -> Rows:
    """Returns conditions, readings and states of each row."""
    observe: Any = problem.observe
    time, measured = np.asarray(observe.time), np.asarray(problem.data.measured)
    sd = np.asarray(problem.data.sd)
    conditions = observe.of_rows
    since, angle = np.zeros(len(time)), np.zeros(len(time))
    robot = problem.base
    for every in np.asarray(observe.rows_of):
        rows = every[every >= 0]
        since[rows[1:]] = np.diff(time[rows])
        if plan.imposed == "motor_speed":
            wheel = np.asarray(conditions.motor_speed)[rows] / float(robot.gearbox.ratio)
        else:
            wheel = (rate if plan.angle else measured[:, plan.motion])[rows] * _wheel_per_unit(problem, plan)
        steps = 0.5 * (wheel[1:] + wheel[:-1]) * np.diff(time[rows])
        angle[rows[1:]] = np.cumsum(steps)
    arrays = [
        jnp.asarray(x) for x in (measured, rate, travel_directions(problem, plan, measured, sd, rate), angle, since)
    ]
    return Rows(jax.tree.map(jnp.asarray, conditions), *arrays)


def _wheel_per_unit(problem: Problem, plan: Plan) -> float:
    """Speed or angle of the output for one unit of the channel of the motion [rad/unit]."""
    robot, none = problem.base, jnp.zeros(())
    chassis = robot.configurations.members[0]
    rolling = State(none, robot.gearbox.ratio, chassis.radius, none, distance=chassis.radius)
    return 1 / float(problem.channels[plan.motion].read(robot, balances.begin_signals(robot, Conditions(0), rolling)))
