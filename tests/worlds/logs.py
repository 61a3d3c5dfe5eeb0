"""Logs over time of random rigs with undeclared effects: one drive and a load on a shaft, from plain NumPy physics.

The voltage, the current or the speed of the motor is imposed. A speed is smooth: a cubic spline of its rows. Four runs
of 200 rows, or one or two of 4000 to 25 000. Shares nothing with mmrjax. Many
perturbed rigs go through the classical Runge-Kutta method at once, with steps of the winding's time constant. Windings
of long logs have none.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from worlds import laws
from worlds.histories import ROUNDS, runge_kutta, soft_sign, teeth
from worlds.laws import Term, shaped
from worlds.rigs import RPM
from worlds.settled import Sealed, between, remainder, robot_toml, typed
from worlds.tables import told_apart

IMPOSED = ("voltage", "motor_current", "motor_speed")
#: What a servo's log states: the goal of its output, which a proportional and derivative controller follows.
GOAL = "goal_angle"
#: Share of the supply that the controller of a servo gives at most.
LIMIT = 0.9
RUNS, ROWS = 4, 200
EVERY = (0.005, 0.01, 0.02)  # [s]
#: Sampling steps of long logs [s], duration of a run [s], fewest rows of a run and most of a log, longest step of its
#: integration [s], time constant that its file states for the winding [s], and sd of its angle [deg].
LONG_EVERY, LASTS, FEWEST, MOST = (0.001, 0.002, 0.005), (20.0, 60.0), 4100, 25_000
COARSEST, NONE, ANGLE = 2.5e-3, 1e-6, (0.02, 0.1)
#: Time after which the state of a long log counts as unknown [s]: what drives it further is never known exactly.
FORGETS = 2.0
#: Time constant of a winding [s], and of a servo's, which its file states. Steps are half as long: the method is stable
#: to 2.7 of them.
WINDING, SERVO_WINDING = 2e-4, 1e-3
REST = 0.01  # of the output, within which friction at an imposed speed is smoothed [rad/s]
RELATIVE = {
    "resistance": 0.05, "torque_constant": 0.03, "friction": 0.3, "viscous": 0.3, "efficiency": 0.04,
    "rotor": 0.1, "inertia": 0.2, "dry": 0.3, "damping": 0.3, "kp": 0.2, "kd": 0.2,
}  # fmt: skip
#: Names of the constants in the rig's file.
PUBLIC = {
    "resistance": "motor.resistance", "torque_constant": "motor.torque_constant", "friction": "motor.friction_coulomb",
    "viscous": "motor.friction_viscous", "rotor": "motor.inertia", "efficiency": "gearbox.efficiency_load",
    "inertia": "bench.inertia", "dry": "bench.loss_coulomb", "damping": "bench.loss_viscous",
    "kp": "controller.kp", "kd": "controller.kd",
}  # fmt: skip
#: Column, SI value of its unit, and noise of a channel as a share of its rms.
CHANNELS = {
    "total_current": ("total_current_A", 1.0, 0.02),
    "motor_speed": ("motor_speed_rpm", RPM, 0.01),
    "output_angle": ("output_angle_deg", np.pi / 180, 0.003),
}
#: Step of a coarse instrument: of a 10-bit encoder [deg], and of other channels in sds of their noise.
ENCODER, COARSE = 360 / 1024, 2.5


#: Amplitudes that are simulated to find the one that leaves a wanted strength [ordinary sizes].
LADDER = np.geomspace(0.003, 3.0, 13)
LONG_LADDER = np.geomspace(1e-4, 3.0, 8)
#: Change of a torque [of the rig's] at which the rounds that find the torque at the output end.
SETTLED = 1e-10
LAWS = laws.LOGS | laws.OUTSIDE_LOGS
#: Turn over which the contacts of `presliding` yield [rad], the library's own.
YIELDS = 0.02
#: Steps of one's own least squares, at most.
STEPS = 12
#: Of a sum of squares, what one more step of one's own least squares may still gain.
CONVERGED = 0.1


@dataclasses.dataclass(frozen=True)
class Rig:
    """A rig with its truth, what its file states, and what is imposed.

    Attributes:
        p: true constants [SI].
        stated: those of the file. Ratio, supply [V], rated [A], torque [N·m], w_k [rad/s]: sizes.
        every: sampling step [s].
        inputs: of each run at each row [SI], shape (runs, rows).
        delay: of the readings [s].
        sd: of each channel [unit of the column].
        load_torque: of a brake at each row, held until the next [N·m], shape (runs, rows). None: none.
        alone: True if the output's angle is the only reading (with a voltage or a current imposed).
        long: True for a log of thousands of rows a run, whose winding has no time constant.
        steps: of the readings of coarse instruments [unit of the column]. `sd` then includes their rounding.
    """

    imposed: str
    p: dict[str, float]
    stated: dict[str, float]
    ratio: float
    supply: float
    rated: float
    torque: float
    w_k: float
    every: float
    inputs: np.ndarray
    delay: float
    sd: dict[str, float]
    load_torque: np.ndarray | None = None
    alone: bool = False
    long: bool = False
    steps: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def channels(self) -> tuple[str, ...]:
        if self.alone or self.imposed == GOAL:
            return ("output_angle",)
        own = {"voltage": ("total_current", "motor_speed"), "motor_current": ("motor_speed", "output_angle")}
        return own.get(self.imposed, ("total_current",))

    def noise(self, name: str) -> float:
        """Sd of a channel without the rounding by its step, which is what a file with that step states."""
        return float(np.sqrt(self.sd[name] ** 2 - self.steps.get(name, 0.0) ** 2 / 12))

    @property
    def names(self) -> tuple[str, ...]:
        """Constants that act."""
        of_voltage = self.imposed in ("voltage", GOAL)
        return tuple(n for n in RELATIVE if n in self.p and (n != "resistance" or of_voltage))

    @property
    def winding(self) -> float:
        """Time constant of the winding [s]."""
        return NONE if self.long else SERVO_WINDING if self.imposed == GOAL else WINDING

    @property
    def per(self) -> int:
        """Steps between two rows."""
        return int(np.ceil(self.every / COARSEST)) if self.long else round(2 * self.every / self.winding)

    @property
    def pace(self) -> float:
        """Factor on the time of laws, whose scale is a short run's."""
        return 4 / (self.inputs.shape[1] * self.every) if self.long else 1.0

    @property
    def scale(self) -> SimpleNamespace:
        return SimpleNamespace(rated=self.rated, torque=self.torque, w_k=self.w_k, supply=self.supply, **self.p)


def rig(
    rng: np.random.Generator,
    imposed: str,
    every: float | None = None,
    *,
    alone: bool = False,
    coarse: bool = False,
    long: bool = False,
) -> Rig:
    """A random rig. Its readings' noise is set by what they show without effects.

    Args:
        every: sampling step [s]. None: a random one.
        alone: as of `Rig`, unless a speed is imposed.
        coarse: True for instruments with steps.
        long: as of `Rig`.
    """
    supply, fast = float(rng.choice([6.0, 12.0, 24.0, 48.0])), rng.uniform(300.0, 800.0)
    stall, ratio = between(rng, 3, 30), float(np.round(between(rng, 15, 60)))
    C, R, eta = supply / fast, supply / stall, rng.uniform(0.7, 0.92)
    rated = 0.3 * stall
    torque, w_k = ratio * eta * C * rated, fast / ratio
    whole = rng.uniform(0.1, 0.3) * ratio**2 * C**2 / R  # inertia at the output by the mechanical time constant
    share = rng.uniform(0.3, 0.7)
    slow = imposed not in ("voltage", GOAL)
    p = {
        "resistance": R, "torque_constant": C, "friction": C * stall * rng.uniform(0.005, 0.02),
        "viscous": C * stall * rng.uniform(0.003, 0.015) / fast, "efficiency": eta, "rotor": share * whole / ratio**2,
        "inertia": (1 - share) * whole, "dry": torque * rng.uniform(0.1, 0.3),
        "damping": torque * rng.uniform(*((0.5, 1.0) if slow else (0.1, 0.3))) / w_k,
    }  # fmt: skip
    if imposed == GOAL:  # damped, and at its limit for large steps
        p["kp"] = rng.uniform(3.0, 8.0)
        lag = whole * R / (ratio * C) ** 2
        p["kd"] = max((2 * rng.uniform(0.6, 1.0) * np.sqrt(p["kp"] * w_k * lag) - 1) / w_k, 0.01)
    stated = {n: typed(x * np.exp(RELATIVE[n] * rng.standard_normal()), 4) for n, x in p.items()}
    stated["efficiency"] = min(stated["efficiency"], 0.97)
    drawn = float(rng.choice(EVERY))
    every = drawn if every is None else every
    size = {"voltage": supply, GOAL: 1.5, "motor_speed": fast}.get(imposed, 1.2 * rated)
    if long:
        runs = int(rng.choice([1, 1, 2]))
        rows = int(np.clip(rng.uniform(*LASTS) / every, FEWEST, MOST / runs))
        inputs = np.stack([_profile(rng, imposed == "motor_speed", every, rows) for _ in range(runs)])
        inputs = np.round(size * inputs, 4)
    else:
        inputs = np.stack([_inputs(rng, imposed, every, size) for _ in range(RUNS)])
    late = float(rng.choice([0.0, rng.uniform(0.0, 2.0)]))
    made = Rig(imposed, p, stated, ratio, supply, rated, torque, w_k, every, inputs, 0.0, {}, long=long)
    step = every / made.per  # readings are those of a step
    # The current of an imposed speed jumps where its friction turns: late by whole rows it is not read in between.
    delay = every * round(late) if imposed == "motor_speed" else step * round(late * every / step)
    made = dataclasses.replace(made, delay=delay, alone=alone and imposed != "motor_speed")
    shown = histories(made, [p])[0]
    sd = {n: typed(CHANNELS[n][2] * np.sqrt(np.mean(shown[n] ** 2)), 2) for n in made.channels}
    if long:
        worse = between(rng, 1, 3)
        sd = {n: typed(between(rng, *ANGLE) if n == "output_angle" else worse * x, 2) for n, x in sd.items()}
    if not coarse:
        return dataclasses.replace(made, sd=sd)
    encoder = ENCODER / 4 if imposed == GOAL else ENCODER
    steps = {n: encoder if n == "output_angle" else typed(COARSE * x, 2) for n, x in sd.items()}
    sd = {n: typed(float(np.hypot(x, steps[n] / 12**0.5)), 3) for n, x in sd.items()}
    return dataclasses.replace(made, sd=sd, steps=steps)


def _profile(rng, smooth: bool, every: float, rows: int) -> np.ndarray:
    """What is imposed at each row of a long run, as a share of the largest: rests, steps, ramps, reversals, sweeps.

    Args:
        smooth: True without jumps.
    """
    parts, last = [np.zeros(round(0.5 / every))], 0.0
    while sum(map(len, parts)) < rows:
        count = round(rng.uniform(0.5, 4.0) / every)
        share, level = np.arange(1, count + 1) / count, rng.uniform(0.35, 1.0) * rng.choice([-1, 1])
        kind = rng.choice(["rest", "step", "ramp", "reversal", "sweep"], p=[0.1, 0.25, 0.25, 0.15, 0.25])
        waves = rng.uniform(0.3, 0.8) * share + rng.uniform(0.0, 1.5) * share**2
        part = {
            "rest": 0 * share, "step": level + 0 * share, "ramp": last + (level - last) * share,
            "reversal": -last + 0 * share, "sweep": level * np.sin(2 * np.pi * count * every * waves),
        }[kind]  # fmt: skip
        parts.append(part)
        last = float(part[-1])
    course = np.concatenate(parts)[:rows]
    if smooth:
        kernel = np.hanning(round(0.4 / every))
        course = np.convolve(np.r_[np.zeros(len(kernel) - 1), course], kernel / kernel.sum(), "valid")
    return course / np.abs(course).max()


def _inputs(rng, imposed, every, size) -> np.ndarray:
    """What is imposed at each row of a run: stairs both ways, of a speed sums of waves from rest."""
    t = np.arange(ROWS) * every
    if imposed == "motor_speed":
        waves = sum(
            rng.uniform(0.2, 1.0) * np.sin(k * 2 * np.pi * t / t[-1] * rng.uniform(0.8, 1.2)) for k in (1, 2, 4)
        )
        return np.round(rng.uniform(0.5, 0.9) * size * waves / np.abs(waves).max(), 4)
    levels = rng.uniform(0.35, 1.0, 8) * np.where(rng.random(8) < 0.5, -1, 1) * size
    at = np.sort(rng.choice(np.arange(10, ROWS - 5), 7, replace=False))
    return np.round(levels[np.searchsorted(at, np.arange(ROWS), side="right")], 4)


def histories(r: Rig, members: Sequence[Mapping[str, float]], terms: Sequence[Sequence[Term]] | None = None):
    """Readings of each channel for each member, a dictionary each of shape (runs, rows) [units of the columns].

    Args:
        members: constants of each, of which one may differ from run to run.
        terms: of each.
    """
    count, per, (runs, length) = len(members), r.per, r.inputs.shape
    p = {n: np.concatenate([np.broadcast_to(m[n], runs) for m in members]) for n in r.p}
    inputs = np.tile(r.inputs, (count, 1))
    every = _side_by_side(terms or (), runs)
    quasi_static, electric = r.long and r.imposed != "motor_speed", any(t.law.balance == "electrical" for t in every)
    J_w, J_d, C, R, i = p["inertia"], p["rotor"], p["torque_constant"], p["resistance"], r.ratio

    braked = np.zeros_like(inputs) if r.load_torque is None else np.tile(r.load_torque, (count, 1))

    def signals(time, y, given, slope, brake, way=None):
        s = SimpleNamespace(time=time * r.pace, C=C, fast=r.w_k, I=y[0], w=y[1], turn=y[2], b=y[3])
        if r.imposed == "motor_speed":
            s.w = given
        s.w_k = s.w / i
        s.d = soft_sign(s.w_k, REST) if way is None else way

        def extra(balance):
            return laws.total(every, balance, s)

        if quasi_static and r.imposed == "voltage":
            s.I = (given - C * s.w) / R
            for _ in range(5 * electric):
                s.I = (given - C * s.w - extra("electrical")) / R
        elif quasi_static:
            s.I = given
        load = p["dry"] * s.d + p["damping"] * s.w_k + brake + extra("track")
        s.B = load
        idle = p["friction"] * s.d + p["viscous"] * s.w
        if r.imposed == "motor_speed":
            turn = slope / i
            s.B = load + J_w * turn
            B = load + extra("gearbox")
            for _ in range(6):  # the current by which the motors accelerate so
                A = C * s.I - idle - extra("motor")
                eta = teeth(A * J_w + i * J_d * B, s.d, p["efficiency"])
                s.I = ((turn * (J_w + J_d * i**2 * eta) + B) / (i * eta) + idle + extra("motor")) / C
            s.rate = turn
        else:
            A = C * s.I - idle - extra("motor")
            earlier, last, share = s.B, None, 1.0
            for _ in range(1 + ROUNDS * any(t.law.balance == "gearbox" for t in every)):
                before, B = s.B, load + extra("gearbox")
                eta = teeth(A * J_w + i * J_d * B, s.d, p["efficiency"])
                s.rate = (i * eta * A - B) / (J_w + J_d * i**2 * eta)
                change = load + J_w * s.rate - before  # to what is transmitted to the output
                if last is not None:  # a secant
                    bend = last - change
                    share = np.where(bend == 0, 1.0, (before - earlier) / np.where(bend == 0, 1.0, bend))
                s.B = before + share * change
                if not (np.abs(change) > SETTLED * r.torque).any():  # NaN: no such run
                    break
                earlier, last = before, change
        if quasi_static:
            s.dI = 0.0 * s.I
        elif r.imposed == GOAL:
            duty = np.clip(p["kp"] * (given - s.turn) - p["kd"] * s.w_k, -LIMIT, LIMIT)
            s.dI = (duty * r.supply - C * s.w - R * s.I - extra("electrical")) / (r.winding * R)
        elif r.imposed == "voltage":
            s.dI = (given - C * s.w - R * s.I - extra("electrical")) / (r.winding * R)
        else:
            s.dI = (given - s.I) / r.winding
        return s

    def rates(time, y, given, slope, brake, way=None):
        s = signals(time, y, given, slope, brake, way)
        b = (s.w_k - s.w_k * s.d * s.b) / YIELDS * (not r.long)  # `yielded` takes longer steps
        return np.stack([s.dI, i * s.rate * (way != 0), s.w_k, b])

    def yielded(before, y):
        """Sets the contacts after a turn one way."""
        turn = y[2] - before[2]
        way = np.sign(turn)
        y[3] = way + (before[3] - way) * np.exp(-np.abs(turn) / YIELDS)

    way = np.zeros(count * runs)  # in which dry friction acts as of motion; 0 where it holds the shaft
    y = np.zeros((4, count * runs))
    h, late = r.every / per, round(r.delay / (r.every / per))
    order = {"total_current": 0, "motor_speed": 1, "output_angle": 2}
    if r.imposed == "motor_speed":  # no state but the contacts'
        curve, fine = CubicSpline(np.arange(length), inputs, axis=1), np.arange(per * (length - 1) + 1) / per
        states = [y, *(np.zeros_like(y) for _ in fine[1:])]
        for state, turn in zip(states, curve.antiderivative()(fine).T * r.every / i, strict=True):
            state[2] = turn
        for before, state in itertools.pairwise(states):
            yielded(before, state)
        every_row = np.stack(states[::per], 1)
        now, slope = (curve(np.arange(length), n).T / r.every**n for n in (0, 1))
        s = signals(np.arange(length)[:, None] * r.every, every_row, now, slope, braked.T)
        read = np.maximum(np.arange(length) - late // per, 0)
        return [{"total_current": x.T} for x in np.moveaxis(s.I[read].reshape(length, count, runs), 1, 0)]
    wanted = {max(row * per - late, 0) for row in range(length)}
    kept: dict[int, list[np.ndarray]] = {}
    for row in range(length):
        now = inputs[:, row]
        for n in range(per):
            t = (row + n / per) * r.every

            def at(way: Any, x: float, y: np.ndarray) -> Any:
                return rates(t + x * h, y, now, 0.0, braked[:, row], way)  # noqa: B023

            if row * per + n in wanted:
                s = SimpleNamespace(I=y[0], w=y[1])
                if quasi_static and r.imposed == "voltage":  # the current before a jump at this row
                    s.I = signals(t, y, now if n else inputs[:, max(row - 1, 0)], 0.0, 0.0, way).I
                kept[row * per + n] = [s.I, s.w, y[2]]
            before = y
            y, way = _step(at, y, way, h)
            if r.long:
                yielded(before, y)
    rows = np.array([kept[max(row * per - late, 0)] for row in range(length)])  # (rows, 3, columns)
    shown = np.moveaxis(rows, 0, -1).reshape(3, count, runs, length)
    return [{n: shown[order[n], k] / CHANNELS[n][1] for n in r.channels} for k in range(count)]


def _step(rates: Any, y: np.ndarray, way: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """A step with dry friction, which jumps at rest: a step on a line to that moment, and one of Euler's from it. What it
    holds begins to move when it holds no longer, with a torque that then rises on a line.

    Args:
        rates: (way, share of the step, y) → rates.
        y: its second row are speeds.
        way: in which friction acts as of motion, 0 where it holds.
    """

    def leaves(x: Any, y: np.ndarray) -> np.ndarray:
        forward, backward = (rates(d, x, y)[1] for d in (1.0, -1.0))
        return np.where(forward > 0, 1.0, np.where(backward < 0, -1.0, 0.0))

    held, new = way == 0, runge_kutta(functools.partial(rates, way), y, h)
    if held.any():
        then = leaves(1.0, new)
        first, last = (rates(then, x, z)[1] for x, z in ((0.0, y), (1.0, new)))
        rises = np.where(first * then > 0, first + last, last * last / np.where(then, last - first, 1.0))
        new[1] = np.where(held & (then != 0), rises * h / 2, new[1])
        way = np.where(held, then, way)
    rests = new[1] * way < 0
    if rests.any():
        share = np.where(rests, y[1] / np.where(rests, y[1] - new[1], 1.0), 0.0)
        still = y + share * (new - y)
        still[1] = 0.0
        then = leaves(share, still)
        new = np.where(rests, still + (1 - share) * h * rates(then, share, still), new)
        way = np.where(rests, then, way)
    return new, way


def _side_by_side(terms: Sequence[Sequence[Term]], runs: int) -> list[Term]:
    """Terms of each member as few that all have: one of a law, its amplitude and shapes as arrays over columns."""
    laws_of = {t.name: t.law for own in terms for t in own}
    every = []
    for name, law in laws_of.items():
        own = [next((t for t in x if t.name == name), None) for x in terms]
        some = next(t for t in own if t is not None)
        amplitude = np.repeat([0.0 if t is None else t.amplitude for t in own], runs)
        shapes = {k: np.repeat([(t or some).shapes[k] for t in own], runs) for k in law.shapes}
        every.append(Term(name, amplitude, shapes, law))
    return every


def whitened(r: Rig, shown: Mapping[str, np.ndarray]) -> np.ndarray:
    """Readings over their sds, shape (runs, readings)."""
    return np.concatenate([shown[n] / r.sd[n] for n in r.channels], -1)


def forgotten(r: Rig, change: np.ndarray) -> np.ndarray:
    """Change of a long log's whitened readings, beside the states that begin each `FORGETS` seconds.

    A different speed fades with the time constant of the motion. A different angle stays.
    """
    p, i, length = r.p, r.ratio, r.inputs.shape[1]
    torque = p["viscous"] + (p["torque_constant"] ** 2 / p["resistance"] if r.imposed == "voltage" else 0.0)
    eta = p["efficiency"]
    fades = (p["damping"] + i**2 * eta * torque) / (p["inertia"] + i**2 * eta * p["rotor"])
    by_channel = change.reshape(len(change), len(r.channels), length)
    if r.imposed == "motor_speed":
        return by_channel.ravel()
    left = []
    for begin in range(0, length, round(FORGETS / r.every)):
        part = by_channel[:, :, begin : begin + round(FORGETS / r.every)]
        t = np.arange(part.shape[2]) * r.every
        fading = {"motor_speed": np.exp(-fades * t), "output_angle": -np.expm1(-fades * t) / (fades * i)}
        fading["total_current"] = -p["torque_constant"] / p["resistance"] * fading["motor_speed"]
        angle = {"output_angle": 1 + 0 * t}
        states = [[x.get(n, 0 * t) / CHANNELS[n][1] / r.sd[n] for n in r.channels] for x in (fading, angle)]
        columns = np.stack([1e3 * np.ravel(x) for x in states if np.any(x)], 1)
        left.append(np.stack([remainder(x.ravel(), columns) for x in part]).ravel())
    return np.concatenate(left)


def moved(p: Mapping[str, float], name: str, z: float) -> dict[str, float]:
    """Constants with one so many sds of its tolerance larger."""
    return {**p, name: p[name] * float(np.exp(RELATIVE[name] * z))}


@dataclasses.dataclass(frozen=True)
class Case(Sealed):
    """A log with its label, its rig and effects, and its whitened readings, shape (runs, readings)."""

    rig: Rig
    terms: tuple[Term, ...]
    measured: np.ndarray


def slopes(r: Rig, p: Mapping[str, float], terms: Sequence[Term], also: Sequence[Sequence[Term]] = ()):
    """Whitened readings, their change by one sd of each constant and by each of `also`'s further terms. Each of shape
    (runs, readings)."""
    members = [p, *(moved(p, n, 1e-2) for n in r.names), *[p] * len(also)]
    every = [
        whitened(r, x) for x in histories(r, members, [terms] * (1 + len(r.names)) + [(*terms, *x) for x in also])
    ]
    n = len(r.names)
    return every[0], [(x - every[0]) / 1e-2 for x in every[1 : 1 + n]], [x - every[0] for x in every[1 + n :]]


def rivals(r: Rig) -> list[Term]:
    """Library effects that a log of a rig may have, each with the shapes of its grid."""
    able = {n: law.at(r.scale) for n, law in LAWS.items() if law.cls and law.needs(r.imposed)}
    return [
        Term(n, 0.02 * law.size, shapes, law) for n, law in able.items() for shapes in law.grid(3 if r.long else 9)
    ]


def oracle(term: Term, left: np.ndarray, tried: Sequence[Term], units: Sequence[np.ndarray]) -> dict[str, Any]:
    """Library effects that readings without noise could not tell from a term, and what the best other one would leave
    [σ], each with the amplitude and, of a few, the shapes that explain most of it.

    Args:
        left, units: what a refit of the constants leaves of the term, and of each one `tried` [σ].
    """
    size, apart = float(np.linalg.norm(left)), {}
    for t, unit in zip(tried, units, strict=True):
        along = float(left @ unit) / max(float(np.linalg.norm(unit)), 1e-9)
        if t.law.either or along > 0:
            apart[t.name] = min(apart.get(t.name, size), float(np.sqrt(max(size**2 - along**2, 0.0))))
    return told_apart(apart, size, term.law.cls)


def case(r: Rig, name: str, sigmas: float, seed: int, *, stated: bool = True, run: int | None = None) -> Case:
    """A case. `name` empty is a clean one. Effects are sized so that a linear refit of the constants leaves `sigmas`.
    The label says how many a refit really leaves.

    Args:
        run: number of a run in which the constant `name` differs, so that a refit leaves `sigmas`. None: `name` is an
            effect.
        stated: True for a table with the sds of its readings, without the rounding by the stated steps.
    """
    rng = np.random.default_rng([98, seed])
    terms: tuple[Term, ...] = ()
    constants, effects = r.p, []
    if run is not None:
        _, base, _ = slopes(r, r.p, ())
        inside = np.arange(len(r.inputs)) == run
        change = (base[r.names.index(name)] * inside[:, None]).ravel()
        left = np.linalg.norm(remainder(change, np.stack([b.ravel() for b in base], 1)))
        constants = {**r.p, name: np.where(inside, moved(r.p, name, sigmas / left)[name], r.p[name])}
        effects.append({"name": name, "class": "", "balance": "", "sigmas": sigmas, "run": run})
    elif name:
        term, tried = shaped(name, rng, LAWS[name].at(r.scale)), [] if r.long else rivals(r)
        ladder = LONG_LADDER if r.long else LADDER
        rungs = [dataclasses.replace(term, amplitude=x * term.law.size) for x in ladder]
        y, base, changes = slopes(r, r.p, (), [[t] for t in (*rungs, *tried)])
        forget = functools.partial(forgotten, r) if r.long else np.ravel
        columns = np.stack([forget(b) for b in base], 1)

        def left_of(change: np.ndarray) -> np.ndarray:
            return remainder(forget(np.nan_to_num(change, nan=1e3)), columns)

        left = [left_of(x) for x in changes]
        sizes = np.maximum.accumulate([np.linalg.norm(x) for x in left[: len(rungs)]])
        share = np.exp(np.interp(np.log(sigmas), np.log(sizes), np.log(ladder)))
        terms = (dataclasses.replace(term, amplitude=float(share) * term.law.size),)
    shown = histories(r, [constants], [terms])[0]
    if terms:
        change = whitened(r, shown) - y
        apart = oracle(terms[0], left_of(change), tried, left[len(rungs) :])
        sigmas = float(np.linalg.norm(left_of(change))) if r.long else left_over(r, y + change)
        effects.append(terms[0].label | {"sigmas": sigmas} | apart)
    measured = {n: _read(r, n, x, rng) for n, x in shown.items()}
    column = {
        "voltage": "supply_voltage_V",
        "motor_current": "motor_current_A",
        "motor_speed": "motor_speed_rpm",
        GOAL: "goal_angle_deg",
    }
    runs, length = r.inputs.shape
    t = np.round(np.arange(length) * r.every, 6)
    table: dict[str, np.ndarray] = {
        "run_id": np.repeat([f"run{k}" for k in range(runs)], length),
        "time_s": np.tile(t, runs),
        column[r.imposed]: (r.inputs / {"motor_speed": RPM, GOAL: np.pi / 180}.get(r.imposed, 1.0)).ravel(),
    }
    if r.load_torque is not None:
        table["load_torque_Nm"] = r.load_torque.ravel()
    for n in r.channels:
        head, _, unit = CHANNELS[n][0].rpartition("_")
        table[CHANNELS[n][0]] = np.array([typed(x, 9) for x in measured[n].ravel()])
        if stated:
            table[f"{head}_sd_{unit}"] = np.full(runs * length, r.noise(n))
    label = {
        "kind": "clean" if not name else "fault" if run is not None else "library" if LAWS[name].cls else "outside", "seed": seed, "stratum": r.imposed, "imposed": r.imposed,
        "every": r.every, "delay": r.delay, "effects": effects, "constants": r.p, "alone": r.alone,
        "coarse": bool(r.steps), "stated": stated,
        "sound": bool(all(np.isfinite(x).all() for x in shown.values())),
    }  # fmt: skip
    return Case(table, label, toml(r), r, terms, whitened(r, measured))


def _read(r: Rig, name: str, shown: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Readings of a channel: with noise, and rounded by a coarse instrument."""
    step = r.steps.get(name, 0.0)
    noisy = shown + r.noise(name) * rng.standard_normal(shown.shape)
    return step * np.round(noisy / step) if step else noisy


def left_over(r: Rig, shown: np.ndarray) -> float:
    """How many sigmas of whitened readings a refit of the constants leaves, with their tolerances as priors. What a
    constant takes up that moves the readings in the same way, as a winding does a resistor, is taken up however large
    it is."""
    everything = np.ones(RUNS, bool)
    (fit,) = _fits(r, r.p, np.nan_to_num(shown, nan=1e3), {(): (everything, ())}).values()
    return float(np.sqrt(fit.cost))


def least_squares(c: Case) -> tuple[float, float]:
    """Rms of the whitened error of runs held out, one after the other, by least squares of one's own without and with
    the true term, which then is one more unknown, from what the file states, whose tolerances are priors. The delay is
    known to it."""
    kinds = (False, True) if c.terms else (False,)
    jobs = {
        (with_term, out): (np.arange(RUNS) != out, c.terms if with_term else ())
        for with_term in kinds for out in range(RUNS)
    }  # fmt: skip
    fits = _fits(c.rig, c.rig.stated, c.measured, jobs)
    found = [
        float(np.sqrt(np.mean(np.concatenate([fits[with_term, out].off[out] for out in range(RUNS)]) ** 2)))
        for with_term in kinds
    ]
    return found[0], found[-1]


@dataclasses.dataclass(frozen=True)
class Fit:
    """The best that a search has found.

    Attributes:
        at: constants in their sds, then the term's amplitude in a tenth of its size.
        cost: what is left of readings inside and priors, squared.
        left: the same one by one, slopes: by the unknowns.
        off: of all readings.
    """

    at: np.ndarray
    cost: float
    left: np.ndarray
    slopes: np.ndarray
    off: np.ndarray


def _fits(
    r: Rig, start: Mapping[str, float], measured: np.ndarray, jobs: Mapping[Any, tuple[np.ndarray, Sequence[Term]]]
) -> dict[Any, Fit]:
    """Fits by Levenberg and Marquardt, which go through the simulation together.

    Args:
        start: constants from which they begin, means of their priors.
        measured: whitened, shape (runs, readings).
        jobs: of each fit the runs that it sees, and the terms (one at most) whose amplitude is one more unknown.
    """
    count = len(r.names)

    def constants(at: np.ndarray) -> dict[str, float]:
        p = dict(start)
        for name, x in zip(r.names, at, strict=True):
            p = moved(p, name, x)
        return {**p, "efficiency": min(p["efficiency"], 1.0)}

    def sized(terms: Sequence[Term], size: float) -> tuple[Term, ...]:
        return tuple(dataclasses.replace(t, amplitude=0.1 * t.law.size * size) for t in terms)

    at = {job: np.zeros(count + len(terms)) for job, (_, terms) in jobs.items()}
    best: dict[Any, Fit] = {}
    damping, going = dict.fromkeys(jobs, 1e-3), list(jobs)
    for _ in range(STEPS):
        if not going:
            break
        members: list[Mapping[str, float]] = []
        theirs: list[Sequence[Term]] = []
        for job in going:
            own, x = jobs[job][1], at[job]
            p, size = constants(x[:count]), float(x[count]) if own else 0.0
            members += [p, *(moved(p, n, 1e-2) for n in r.names), *[p] * len(own)]
            theirs += [sized(own, size)] * (1 + count) + [sized(own, size + 1.0)] * len(own)
        shown = [whitened(r, x) for x in histories(r, members, theirs)]
        for job in tuple(going):
            inside, x = jobs[job][0], at[job]
            own, shown = shown[: 1 + len(x)], shown[1 + len(x) :]
            off = measured - own[0]
            left = np.concatenate([off[inside].ravel(), -x[:count]])
            cost = float(left @ left) if np.isfinite(left).all() else np.inf
            gained = best[job].cost - cost if job in best else np.inf
            if gained > 0:
                slope = [(y - own[0])[inside].ravel() for y in own[1:]]
                columns = np.stack([*(1e2 * y for y in slope[:count]), *slope[count:]], 1)
                best[job] = Fit(x, cost, left, np.concatenate([columns, np.eye(len(x))[:count]]), off)
                damping[job] *= 0.2
            else:
                damping[job] *= 10.0
            if abs(gained) < CONVERGED:
                going.remove(job)
            fit = best[job]
            normal = fit.slopes.T @ fit.slopes
            move = np.linalg.solve(normal + damping[job] * np.diag(np.diag(normal)), fit.slopes.T @ fit.left)
            at[job] = fit.at + np.clip(move, -3, 3)
    return best


def toml(r: Rig) -> str:
    """The rig's file as its owner writes it."""
    top = {"schema": "mmrjax.robot/2", "base": "none", "imposed": r.imposed}
    top |= {"start": "measured" if r.imposed == "motor_speed" else "rest", "channels": r.channels}
    tables: dict[str, dict[str, Any]] = {
        "": top, "motor": {}, "gearbox": {"ratio": f"{r.ratio} ± 0"}, "bench": {"load": "shaft"},
    }  # fmt: skip
    if r.imposed == GOAL:
        tables["controller"] = {"limit": LIMIT, "supply_voltage": r.supply}
    if r.imposed == GOAL or (r.long and r.imposed == "voltage"):
        tables["motor"] = {"inductance": f"{r.winding * r.p['resistance']!r} ± 0"}
    for name in r.names:
        table, _, key = PUBLIC[name].partition(".")
        tables[table][key] = f"{r.stated[name]!r} ± {100 * RELATIVE[name]:g} %"
    tables |= {f"instruments.{name}": {"quantum": "free"} for name in r.steps}
    return robot_toml(tables)
