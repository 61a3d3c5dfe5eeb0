"""The averaged law of friction (vibration.py): limits, an independent sum, its inverse, and slip of the track model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vibration

from mmrjax.model import paper_robots, params
from mmrjax.model.contact import Friction

LAW = Friction(static=0.6, dynamic=0.5, speed_static=0.01, speed_dynamic=0.1)


def fig7(speed):
    """Fig. 7 written again in NumPy: cubic steps up to V_s, from there to V_d."""
    size = np.abs(speed)
    x = np.clip(size / 0.01, 0, 1)
    y = np.clip((size - 0.01) / 0.09, 0, 1)
    rising = 0.6 * x * (3 - x**2) / 2
    return np.sign(speed) * np.where(size < 0.01, rising, 0.6 - 0.1 * y**2 * (3 - 2 * y))


def averaged(speed, swing):
    """The mean over a million phases of a wave whose second harmonic is half of its first."""
    phase = np.linspace(0, 2 * np.pi, 1_000_000, endpoint=False)
    wave = np.cos(phase) + 0.5 * np.cos(2 * phase)
    return np.mean(fig7(speed + swing * wave / np.mean(np.abs(wave))))


def test_without_swing_it_is_the_law_of_fig_7():
    for demanded in (-0.4, 0.0, 0.1, 0.35, 0.58):
        creep = float(LAW.speed_creep(demanded))
        assert float(vibration.speed_sliding(LAW, jnp.asarray(demanded), 0.0)) == pytest.approx(creep, abs=1e-12)
        assert float(vibration.coefficient(LAW, creep, 0.0)) == pytest.approx(
            float(LAW.coefficient(creep)), abs=1e-12
        )


@pytest.mark.parametrize("swing", [0.002, 0.01, 0.05])
def test_average_is_that_of_an_independent_sum(swing):
    for speed in (-0.03, 0.0, 0.004, 0.02, 0.09):
        assert float(vibration.coefficient(LAW, speed, swing)) == pytest.approx(averaged(speed, swing), abs=6e-3)


@pytest.mark.slow
def test_inverse_carries_what_is_demanded_and_has_the_derivative_of_differences():
    for demanded, swing in ((0.1, 0.03), (0.3, 0.01), (0.45, 0.05), (0.2, 0.002)):

        def sliding(x):
            return vibration.speed_sliding(LAW, x[0], x[1])

        x = jnp.asarray([demanded, swing])
        assert float(vibration.coefficient(LAW, sliding(x), swing)) == pytest.approx(demanded, abs=1e-9)
        for k, step in enumerate((1e-4, 1e-5)):
            ahead, behind = sliding(x.at[k].add(step)), sliding(x.at[k].add(-step))
            slope = jax.jacfwd(sliding)(x)[k]
            assert float(slope) == pytest.approx(float(ahead - behind) / (2 * step), rel=0.1)


def test_shaking_contacts_slip_more_and_carry_no_more_than_the_law():
    slow, fast = (float(vibration.speed_sliding(LAW, jnp.asarray(0.3), s)) for s in (0.01, 0.04))
    assert float(LAW.speed_creep(0.3)) < slow < fast
    assert np.isnan(float(vibration.speed_sliding(LAW, jnp.asarray(0.61), 0.02)))


GEARS = {
    "recess 0.25 mm": ({"guide_recess": 2.5e-4, "contact_damping": 500.0}, (0.6, 0.55, 0.012)),
    "recess 0.35 mm, soft": ({"guide_recess": 3.5e-4, "contact_stiffness": 2e7, "contact_damping": 300.0}, (0.7, 0.6, 0.02)),
    "flush": ({}, (0.55, 0.5, 0.008)),
}  # fmt: skip


@pytest.fixture(scope="module")
def shaken():
    """Slip [%] of runs, and what follows from their ripple. Gears that the law was not derived from."""

    rows = (jnp.repeat(jnp.asarray([15.0, 33.0]), 3), jnp.tile(jnp.asarray([0.0, 6.0, 12.0]), 2), jnp.zeros(6))
    found = {}
    for name, (gear, (static, dynamic, speed)) in GEARS.items():
        values = {f"running_gear.{k}": v for k, v in gear.items()} | {
            "6T2A.ground.friction.static": static, "6T2A.ground.friction.dynamic": dynamic,
            "6T2A.ground.friction.speed_static": speed, "6T2A.ground.friction.speed_dynamic": 10 * speed,
            "6T2A.track.guide_friction": 0.06,
        }  # fmt: skip
        robot = params.replace(paper_robots.nominal(), {k: jnp.asarray(v) for k, v in values.items()})
        seen = vibration.compared(robot, *rows)
        found[name] = [np.asarray(seen[x]) for x in ("slip", "law", "without ripple", "normal")]
    return found


@pytest.mark.nightly
@pytest.mark.parametrize("gear", GEARS)
def test_slip_of_track_model_runs_follows_from_their_ripple(shaken, gear):
    slip, law, _, normal = shaken[gear]
    assert np.abs(law - slip).max() < 0.5
    assert (normal.max() > 0.3) == (gear != "flush")


@pytest.mark.nightly
def test_fig_7_alone_misses_the_slip_of_the_gear_that_shakes(shaken):
    slip, law, alone, _ = shaken["recess 0.35 mm, soft"]
    assert np.sqrt(np.mean((law - slip) ** 2)) < 0.5 * np.sqrt(np.mean((alone - slip) ** 2))
