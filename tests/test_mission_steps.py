"""Pieces of a mission's steps, each by itself: rows of its profile, peaks within a step, the delay of the cut-off."""

import dataclasses

import jax.numpy as jnp
import pytest

from mmrjax.missions import mission_straight, mission_turning
from mmrjax.missions.mission_steps import _peak_between, _stayed_below
from mmrjax.missions.profile import profile
from mmrjax.model import params


def test_a_row_holds_until_the_next_or_ramps_to_it():
    rows = dict(demand=[0.0, 0.4, 0.2], slope_deg=[0.0, 5.0, 5.0])
    held, ramped = (profile([0.0, 2.0, 6.0], "speed", linear=x, cycles=3, **rows) for x in (False, True))
    assert held.duration == ramped.duration == 18.0
    assert (float(held.row(1).at(1.0).demand), float(ramped.row(1).at(1.0).demand)) == pytest.approx((0.4, 0.35))
    assert (float(held.row(0).at(0.5).slope_deg), float(ramped.row(0).at(0.5).slope_deg)) == (0.0, 1.25)
    assert ramped.row(0).at(0.5).payload is None


@pytest.mark.parametrize(
    "curve, top",
    [
        (lambda t: 1 + 4 * t - 4 * t**2, 2.0),  # a parabola, highest in the middle
        (lambda t: -(1 + 4 * t - 4 * t**2), 2.0),  # its size counts
        (lambda t: t**3 - 3 * t**2 + 1.5 * t + 1, 1.2071067811865475),  # at t = 1 - √½
        (lambda t: 2 * t, 2.0),  # no top within the step: its end
        (lambda t: 3 - t, 3.0),
    ],
)
def test_the_largest_within_a_step_is_that_of_the_cubic(curve, top):
    h = 1e-6
    ends = [jnp.asarray(float(x)) for x in (curve(0.0), curve(1.0))]
    slopes = [jnp.asarray((curve(t + h) - curve(t - h)) / (2 * h)) for t in (0.0, 1.0)]
    assert _peak_between(*ends, *slopes) == pytest.approx(top, rel=1e-6)


def test_a_current_within_a_step_counts_up_to_the_drivers_limit(robot):
    """A cubic overshoots where the limit begins to act: it gave 7.6 A for 3.4 A."""
    limited = params.replace(robot, {"driver.current_limit": 1.5})
    for law in (mission_straight, mission_turning):
        at_most, free = (law.peaks_within(r, jnp.zeros(20), jnp.full(20, 5.0)) for r in (limited, robot))
        assert float(at_most["current"]) == pytest.approx(1.5 * robot.sides) and float(free["current"]) > 9
        assert float(at_most["temperature"]) == float(free["temperature"])


def test_cells_are_cut_off_once_they_stayed_below_for_the_delay(robot):
    robot = dataclasses.replace(robot, battery=dataclasses.replace(robot.battery, delay_cutoff=0.7))
    below, low = jnp.asarray([True, True, True, False]), jnp.asarray([0.0, 0.69, 0.7, 0.9])
    assert _stayed_below(robot, below, low).tolist() == [False, False, True, False]
