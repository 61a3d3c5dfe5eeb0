"""Natural frequencies of half a robot: against NumPy, against a vibration that rings, and their names."""

import dataclasses
from itertools import pairwise

import jax
import numpy as np
import pytest
from scipy.optimize import fsolve

from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import GRAVITY
from mmrjax.undercarriage.half_robot import advance, build_system, roll
from mmrjax.undercarriage.modes import POSITIONS, Mode, _linearised_steps, _run_modes, modes

PAYLOADS = [0.0, 8.0]


def conditions(robot, name):
    return Conditions([name] * 2, voltage=[24.0] * 2, payload=PAYLOADS).resolved(robot)


@pytest.fixture(scope="module")
def wheeled(robot):
    return modes(robot, conditions(robot, "4W2T"))


@pytest.fixture(scope="module")
def tracked(robot):
    return modes(robot, conditions(robot, "6T2A"))


def named(of, name):
    (mode,) = (m for m in of if m.name == name)
    return mode


@pytest.mark.slow
@pytest.mark.parametrize("k", [0, 1])
def test_bounce_on_wheels_is_that_of_a_mass_on_two_springs(robot, wheeled, k):
    """k = 1.5 c δ^0.5 at the load F = c δ^1.5 of each wheel. f = sqrt(2 k / m) / 2π."""
    mass = (float(robot.chassis(1).mass) + PAYLOADS[k]) / 2
    depth = (mass * GRAVITY / 2 / 3e7) ** (2 / 3)
    expected = np.sqrt(2 * 1.5 * 3e7 * depth**0.5 / mass) / (2 * np.pi)
    assert named(wheeled[k], "bounce").natural == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
def test_a_small_vibration_rings_at_the_damped_frequency(robot, wheeled):
    """4W2T rolls, 2 µm up, and its height against that of the same run undisturbed."""
    run = build_system(robot, jax.tree.map(lambda x: x[0], conditions(robot, "4W2T")), 1e-4)
    start = roll(run)
    lifted = dataclasses.replace(start, q=start.q.at[1].add(2e-6))

    @jax.jit
    def height(motion):
        def step(motion, _):
            after, _, _ = advance(run, motion)
            return after, after.q[1]

        return jax.lax.scan(step, motion, None, length=600)[1]

    apart = np.asarray(height(lifted) - height(start))
    crosses = np.flatnonzero(apart[:-1] * apart[1:] < 0)
    at = crosses + apart[crosses] / (apart[crosses] - apart[crosses + 1])
    bounce = named(wheeled[0], "bounce")
    assert 1 / (2 * 1e-4 * np.diff(at[:5]).mean()) == pytest.approx(bounce.frequency, rel=0.02)
    peaks = np.abs([apart[a:b].min() if apart[a + 1] < 0 else apart[a:b].max() for a, b in pairwise(crosses)])
    decay = np.log(peaks[0] / peaks[2]) / (2 * np.pi)
    assert decay / np.hypot(1, decay) == pytest.approx(bounce.damping, abs=0.02)


@pytest.mark.slow
def test_modes_of_the_tracked_robot_have_names_and_bands(tracked):
    """Heavier: bounce falls towards pitch. Each holds most of its energy in its own coordinate. The drive is too damped."""
    light, heavy = tracked
    assert [m.name for m in light] == ["pitch", "drive", "bounce"]
    assert named(light, "pitch").frequency == pytest.approx(66, abs=2)
    assert named(light, "bounce").frequency == pytest.approx(93, abs=2)
    assert named(heavy, "bounce").frequency == pytest.approx(79, abs=2)
    for of in tracked:
        pitch, drive, bounce = (named(of, name) for name in ("pitch", "drive", "bounce"))
        assert pitch.resonant and bounce.resonant and not drive.resonant
        assert pitch.low < pitch.frequency < pitch.high and pitch.frequency < bounce.low
    assert named(light, "pitch").share > 0.8 and named(light, "bounce").share > 0.8
    # with 8 kg bounce comes near to pitch, and they share more of their energy
    assert named(heavy, "pitch").share > 0.6 and named(heavy, "bounce").share > 0.7


def test_mode_over_an_octave_is_no_frequency_to_meet():
    mode = Mode("pitch", 59.0, 11.0, 106.0, 60.0, 0.17, 0.7, 1.0)
    assert mode.amplifies and not mode.resonant
    assert mode._replace(low=60.0).resonant


@pytest.mark.slow
def test_bounce_on_tracks_is_that_of_a_mass_on_its_grousers(robot):
    """Nine grousers half a pitch from the arcs. Towards the ends the belt yields as a string of 100 N."""
    rates, masses = jax.device_get(
        _linearised_steps(params.without_weak_types(robot), conditions(robot, "6T2A"), POSITIONS)
    )
    middle = POSITIONS // 2
    found = named(_run_modes(rates[0, middle : middle + 1], masses[0, middle : middle + 1]), "bounce")
    along = 0.0175 + 0.035 * np.arange(9)
    lever = 0.15 - along
    nearer = np.clip(np.minimum(along, 0.3 - along), 0, 0.02) / 0.02
    yields = nearer * (1 - nearer) * 0.02 / 100.0

    def force(depth):
        depth = np.maximum(depth, 1e-12)
        return 3e7 * depth**1.5 / (1 + yields * 3e7 * depth**0.5)

    weight = 13.1 / 2 * GRAVITY
    z, turn = fsolve(
        lambda y: [(force(y[0] + y[1] * lever).sum() / weight - 1), (force(y[0] + y[1] * lever) @ lever) / weight],
        [5e-5, 0.0],
    )
    depth = z + turn * lever
    stiffness = ((force(depth + 1e-9) - force(depth - 1e-9)) / 2e-9).sum()
    assert found.natural == pytest.approx(np.sqrt(stiffness / (13.1 / 2)) / (2 * np.pi), rel=0.03)
