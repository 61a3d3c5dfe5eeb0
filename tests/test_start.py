"""Runs from standstill as they are written: by the clock of the rig, with the slip over the stages of the start."""

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import paper

from mmrjax.derived import start_figures
from mmrjax.fidelities.base import History, in_table_time
from mmrjax.model.params import replace
from mmrjax.model.quantities import MM
from mmrjax.model.rig import Rig
from mmrjax.model.signals import Signals
from sweeps.commands import simulate
from tests.commands import columns_of, read_json, schema_of

VOLTAGE, V_S = 33.0, 0.02
SCHEMA = schema_of("simulate")


@pytest.fixture
def written(mmrjax, tmp_path):
    """Run folder of a start on the flat, with the rig's lines of the robot's file."""

    def left(rig=""):
        (tmp_path / "own.toml").write_text(f'schema = "mmrjax.robot/2"\nbase = "nominal"\n{rig}')
        asked = ("--model", "drive", "--robot", "own.toml", "--voltage", VOLTAGE, "--no-report", "--force")
        assert mmrjax("simulate", *asked, "--out", "d")[0] == 0
        return columns_of(tmp_path / "d/history.csv"), read_json(tmp_path / "d/result.json")

    return left


# --- slip over the stages of a start (33) -----------------------------------------------------------


def by_hand():
    """Stages and slip of the start, of an integration and sums that share nothing with the package."""
    t = np.concatenate([np.linspace(0, 0.04, 4001), np.linspace(0.04, 0.8, 4001)[1:]])
    side = paper.Side(VOLTAGE)
    state = side.drive(t, rtol=1e-6, atol=1e-7)
    rolled, gone = (np.append(x, x[-1]) for x in (side.r * state[:, 1] / side.i, state[:, 2]))
    t = np.append(t, 5.0)  # nothing changes any more
    first = t[np.argmax(rolled - gone)]
    second = t[np.flatnonzero(rolled - gone > V_S)[-1] + 1]
    under_way = t[np.flatnonzero(gone < 0.99 * gone[-1])[-1] + 1]

    def lost(a, b):
        own = (t >= a) & (t <= b)
        step = np.diff(t[own])
        way = [np.sum(step * (x[own][1:] + x[own][:-1]) / 2) for x in (gone, rolled)]
        return 1 - way[0] / way[1]

    return (first, second, under_way), (lost(0, first), lost(first, second), lost(second, 5.0), lost(0, under_way))


@pytest.mark.slow
def test_slip_over_the_stages_is_that_of_an_independent_integration(written):
    history, result = written()
    jsonschema.validate(result, SCHEMA)
    (start,) = result["starts"]
    assert [s["stage"] for s in start["stages"]] == ["starting", "acceleration with slipping", "uniform"]
    times, slips = by_hand()
    ends = [s["until_s"] for s in start["stages"]]
    assert ends[0] == pytest.approx(times[0], abs=5e-4) and ends[1] == pytest.approx(times[1], abs=6e-3)
    assert ends[2] == 5.0 and start["acceleration_time_s"] == pytest.approx(times[2], abs=6e-3)
    assert [s["from_s"] for s in start["stages"]] == [0.0, *ends[:2]]
    got = [s["slip"] for s in start["stages"]] + [start["slip_over_acceleration"]]
    assert got[:2] == pytest.approx(slips[:2], abs=6e-3) and got[3] == pytest.approx(slips[3], abs=6e-3)
    assert got[2] == pytest.approx(slips[2], abs=1e-4) and got[2] < 0.01 < 0.4 < got[1] < got[0]
    # V_x, V_x_teor and s of every sample, as Fig. 24 plots them.
    rolling = history["theoretical_speed_mm_s"] > 1e-3
    expected = 1 - history["speed_mm_s"][rolling] / history["theoretical_speed_mm_s"][rolling]
    assert_allclose(history["slip"][rolling], expected, rtol=1e-6, atol=1e-8)
    assert (history["slip"][~rolling] == 0).all() and history["slip"].max() > 0.9


def test_mean_slip_is_the_share_of_the_way_that_is_lost():
    t = np.linspace(0, 2, 201)
    assert start_figures.mean_slip(t, 0.8 * t, 1.0 * t, 0.0, 2.0) == pytest.approx(0.2)
    assert start_figures.mean_slip(t, t**2 / 4, np.ones_like(t), 0.005, 2.0) == pytest.approx(
        2 / 3, abs=2e-3
    )  # mean of 1 - t²/4
    assert start_figures.mean_slip(t, -0.8 * t, -1.0 * t, 0.35, 1.234) == pytest.approx(0.2)
    assert np.isnan(start_figures.mean_slip(t, t, t, 1.0, 1.0)) and np.isnan(
        start_figures.mean_slip(t, 0 * t, 0 * t, 0.0, 1.0)
    )


def test_stages_are_seen_through_the_ripple_of_a_running_gear():
    """A start of 0.5 s whose speeds then swing by 3 %, its slide beyond V_s in every pitch."""
    t = np.arange(1, 1501) * 1e-3
    rolled = 1 - np.exp(-t / 0.003)
    gone = np.minimum(2 * t, 0.99)
    swing = 0.03 * np.cos(2 * np.pi * t / 0.035)
    even = start_figures.stages_of_start(t, gone, rolled, rolled - gone, V_S, 0.035)
    uneven = start_figures.stages_of_start(t, gone + swing, rolled, rolled - gone - swing, V_S, 0.035)
    assert uneven.slipping == pytest.approx(even.slipping, abs=0.012) and 0.47 < uneven.slipping < 0.51
    assert uneven.settled == pytest.approx(even.settled, abs=0.02)
    assert uneven.slip == pytest.approx(even.slip, abs=0.01)
    blind = start_figures.stages_of_start(t, gone + swing, rolled, rolled - gone - swing, V_S)
    assert blind.slipping > 1.4 and blind.settled > 1.4


# --- the rig's delay --------------------------------------------------------------------------------


def test_a_delay_that_is_none_changes_no_number(robot):
    t = jnp.linspace(0, 1, 5)[None]
    signals = Signals(speed=t, speed_theoretical=2 * t, current=t, speed_motor=t, total_current=t)
    prompt = History.of(robot, t, t, signals)
    assert prompt.signals is signals and (prompt.time == t).all()
    late = History.of(replace(robot, {"rig.delay": 0.25}), t, t, signals)
    assert_allclose(late.time[0], [0, 0.5, 0.75, 1.0, 1.25])
    assert_allclose(late.reading["speed"][0], t[0])
    assert_allclose(late.signals.speed_theoretical[0], 2 * t[0])


def test_what_a_delay_moves_is_moved_by_one_program(compilations):
    t = jnp.asarray(np.linspace(0, 1, 6)[None])
    values = {str(k): t + k for k in range(30)}
    _, late = in_table_time(Rig(delay=0.1), t, values)
    assert len(compilations) < 10
    assert_allclose(late["7"][0, 2:], t[0, 2:] + 7)


def test_a_vehicle_whose_rig_shows_no_speed_has_that_of_the_robot_in_its_history(robot):
    t = jnp.linspace(0, 1, 4)[None]
    signals = Signals(
        speed=0.5 * t, speed_theoretical=t, current=t, speed_motor=t, total_current=t, voltage=t, traction=t,
        speed_sliding=0.5 * t, speed_output=t, angle=t,
    )  # fmt: skip
    history = History.of(robot, t, t, signals)

    class Runs:
        def has(self, name):
            return False

        def __len__(self):
            return 1

    shown = simulate.history_table(robot, history, Runs())
    assert_allclose(shown["speed_mm_s"], (0.5 * t[0]) / MM)
    assert_allclose(shown["slip"], [0, 0.5, 0.5, 0.5])


def test_the_delay_of_histories_is_the_one_of_fits():
    """What is between instants is the straight line between instants, held beyond them, also where a run ends in no numbers."""
    t, delay = np.array([0.0, 0.01, 0.03, 0.08]), 0.004
    x = np.stack([np.sin(40 * t), t**2], 1)

    def late(delay, values, at):
        return Rig.between(jnp.asarray(values), *Rig(delay=delay).before(jnp.asarray(t), at))

    at = np.array([0.0, 0.003, 0.004, 0.014, 0.02, 0.07, 0.2])
    ended = np.where(t > 0.02, np.nan, t)
    got, last = jax.jit(lambda: (late(delay, x, at), late(delay, ended, 0.01 + delay)))()
    assert_allclose(got, np.stack([np.interp(at - delay, t, c) for c in x.T], 1), rtol=1e-12, atol=1e-15)
    assert last == pytest.approx(0.01)
    slope = jax.jit(jax.grad(lambda d: late(d, x[:, 1], 0.05)))(delay)
    assert slope == pytest.approx(-(0.08**2 - 0.03**2) / 0.05)
