"""Logs over time of random rigs: levels held one after the other, from plain NumPy physics; shares nothing with mmrjax.

A level's settled readings are those of `generator_rigs`; between levels every channel follows a first-order lag (a
drive of one inertia about an operating point), read by instruments with noise, steps, a delay, and a clock that
jitters.
"""

from __future__ import annotations

import dataclasses

import generator_rigs as gr
import numpy as np


@dataclasses.dataclass(frozen=True)
class Log:
    """A log.

    Attributes:
        table: its columns; level: index of the level of each row; settled: readings of each level without noise [unit],
            shape (levels, channels); channels: names; sd: noise of a sample [unit], by channel.
    """

    table: dict[str, np.ndarray]
    level: np.ndarray
    settled: np.ndarray
    channels: tuple[str, ...]
    sd: dict[str, float]

    def write(self, path):
        """The log as a CSV file."""
        lines = [",".join(self.table)]
        lines += [",".join(f"{x:.9g}" for x in row) for row in zip(*self.table.values(), strict=True)]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def log(
    w: gr.World,
    rng: np.random.Generator,
    *,
    hold: float = 2.0,
    rate: float = 100.0,
    lag: float = 0.15,
    noise: float = 1.0,
    jitter: float = 0.1,
    delay: float = 0.0,
    step: float = 0.0,
    terms: tuple[gr.Term, ...] = (),
) -> Log:
    """A log that goes through the rows of a world's table.

    Args:
        hold: of each level [s]; rate: samples a second; lag: time constant of the transitions [s].
        noise: of a sample, over the sd that the world has of settled readings; jitter: sd of the clock, over a step.
        terms: effects that the rig's file does not state (`generator_rigs.case`).
        delay: of the readings against what is imposed [s]; step: of the instruments, over the sd of a sample.
    """
    shown, sound = w.readings(terms)
    assert sound.all()
    per = round(hold * rate)
    rows = per * len(w.conditions)
    level = np.repeat(np.arange(len(w.conditions)), per)
    time = np.arange(rows) / rate
    time[1:] += np.clip(jitter * rng.standard_normal(rows - 1), -0.4, 0.4) / rate
    table: dict[str, np.ndarray] = {"time_s": np.round(time, 6)}
    c, r = w.conditions, w.rig
    if r.imposed == "motor_speed":
        table["motor_speed_rpm"] = np.round(c.motor_speed[level] / gr.RPM, 6)
    else:
        table["supply_voltage_V"] = c.supply[level]
    if r.imposed == "duty":
        table["duty"] = c.duty[level]
    if r.vehicle:
        table |= {"slope_deg": np.round(np.degrees(c.slope[level]), 6), "payload_kg": c.payload[level]}
    sds = {}
    late = round(delay * rate)
    settled = np.stack([s if w.rig.signed[n] else np.abs(s) for n, s in zip(r.channels, shown, strict=True)], 1)
    decay = np.exp(-1 / (rate * lag))
    for k, name in enumerate(r.channels):
        target = settled[level, k]
        target = np.concatenate([np.full(late, target[0]), target[: rows - late]])
        x, at = np.empty(rows), target[0]
        for i in range(rows):
            at = target[i] + (at - target[i]) * decay
            x[i] = at
        sds[name] = noise * w.sd[name]
        x = x + sds[name] * rng.standard_normal(rows)
        if step:
            x = np.round(x / (step * sds[name])) * step * sds[name]
        table[gr.CHANNELS[name][0]] = x
    return Log(table, level, settled, r.channels, sds)
