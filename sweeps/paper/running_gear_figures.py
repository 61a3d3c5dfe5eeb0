"""The paper's Figures 23-27 from the track model: both configurations from standstill on the flat at 33 V."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from mmrjax.fidelities.track import STEP, Trajectory, track_batch
from mmrjax.model.paper_tables import TRACKED
from mmrjax.model.robot import Robot
from mmrjax.undercarriage.stability import largest_step
from sweeps.pages import gear_figures, words
from sweeps.paper import data
from sweeps.report import catalogue
from sweeps.report.document import Block
from sweeps.report.runs_report import ripple_table

SECONDS = 1.5  # of a run
SAMPLE = 5e-4  # of its record [s]


def simulate_gear_runs(robot: Robot) -> Trajectory:
    """The paper's configurations from standstill on the flat at 33 V without payload, in NumPy.

    A robot too stiff for the model's usual step is run with a smaller one.
    """
    import jax

    conditions = data.batch_conditions(robot, data.shown_configurations(robot), voltage=33.0)
    step = min(STEP, float(largest_step(robot, conditions).min()))
    step = SAMPLE / math.ceil(SAMPLE / step * (1 - 1e-9))
    return jax.device_get(track_batch(robot, conditions, duration=SECONDS, sample=SAMPLE, step=step))


def gear_blocks(robot: Robot) -> Iterator[Block]:
    """Figures and the table of ripple. If a run does not get under way, the statuses of all and no figures."""
    run, names = simulate_gear_runs(robot), data.shown_configurations(robot)
    which = [robot.configurations.index(c) for c in names]
    status, share = np.asarray(run.result.status), np.asarray(run.steady.guide_share)
    gears = gear_figures.members_with_gear(robot, run, status, share, which, names)
    yield catalogue.note("paper.gear")
    if not all(gear.rolls for gear in gears):
        ended = ", ".join(f"{g.name}: {words.short_status(g.status)}" for g in gears)
        yield catalogue.note("paper.gear-left-out", ended)
        return
    starts = data.starts_of(robot, run, run.result.status)
    yield catalogue.figure("paper.track_fig23_24_from_standstill", starts, data.FIG_23, data.FIG_24)
    yield catalogue.figure("paper.track_fig25_ripple", gears, "Fig. 25: {}")
    yield ripple_table(gears)
    if TRACKED in names:
        k = names.index(TRACKED)
        lumped = data.operating_points(robot, data.batch_conditions(robot, np.array([TRACKED]), voltage=33.0))
        track = robot.configurations[TRACKED].track
        currents = float(run.result.total_current[k]), float(lumped["total_current_A"][0])
        yield catalogue.note("paper.guide-share", float(track.guide_share), float(track.guide_friction), *currents)
        yield catalogue.figure("paper.track_fig26_touchdown", gears[k], "Fig. 26: grousers land (dotted)")
    yield catalogue.figure("paper.track_fig27_reactions", gears, "Fig. 27: {}, one side")
