"""The paper's Figures 23-27 from the track model: both configurations from standstill on the flat at 33 V."""

from __future__ import annotations

import math

import numpy as np

from calibration.data import Json
from mmrjax.fidelities.track import STEP, Trajectory, track_batch
from mmrjax.model.paper_tables import TRACKED
from mmrjax.model.robot import Robot
from mmrjax.undercarriage.stability import largest_step
from sweeps.pages import gear_figures, history_figures, words
from sweeps.pages.page import Album
from sweeps.paper import data

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


def draw_running_gear(album: Album, robot: Robot) -> Json:
    """Draw the figures.

    Returns:
        `left_out` None, `rows` of the ripple table, and for the tracked configuration the guide `friction` and the
        robot's `share`. `currents` [A] are by `steady` at that share and with the share resolved, None without a
        tracked configuration. If runs did not settle: `left_out`, the statuses of all, and no figures.
    """
    run, names = simulate_gear_runs(robot), data.shown_configurations(robot)
    which = [robot.configurations.index(c) for c in names]
    status, share = np.asarray(run.result.status), np.asarray(run.steady.guide_share)
    gears = gear_figures.members_with_gear(robot, run, status, share, which, names)
    if not all(gear.rolls for gear in gears):
        return {"left_out": ", ".join(f"{g.name}: {words.short_status(g.status)}" for g in gears)}
    starts = data.starts_of(robot, run, run.result.status)
    album.add(
        "track_fig23_24_from_standstill",
        lambda: history_figures.from_standstill(starts, data.FIG_23, data.FIG_24),
    )
    facts = album.add("track_fig25_ripple", lambda: gear_figures.current_ripple(gears, "Fig. 25: {}"))
    album.add("track_fig27_reactions", lambda: gear_figures.draw_reactions(gears, "Fig. 27: {}, one side"))
    facts_so_far = {"left_out": None, "rows": facts, "currents": None}
    if TRACKED not in names:
        return facts_so_far
    k = names.index(TRACKED)
    album.add(
        "track_fig26_touchdown", lambda: gear_figures.draw_touchdowns(gears[k], "Fig. 26: grousers land (dotted)")
    )
    lumped = data.operating_points(robot, data.batch_conditions(robot, np.array([TRACKED]), voltage=33.0))
    track = robot.configurations[TRACKED].track
    return facts_so_far | {
        "share": float(track.guide_share),
        "friction": float(track.guide_friction),
        "currents": (float(lumped["total_current_A"][0]), float(run.result.total_current[k])),
    }
