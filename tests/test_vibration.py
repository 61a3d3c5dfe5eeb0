"""Friction of contacts that shake: the averaged law, and the slip of track-model runs that follows from their ripple."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vibration
from numpy.testing import assert_allclose

from calibration.data.runs import Runs
from calibration.discovery.discover import discover
from mmrjax.effects.slip_effects import VibrationSlip
from mmrjax.fidelities.track import track_batch
from mmrjax.model import channels, paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.contact import Friction
from mmrjax.model.signals import CONVERGED, NOT_SETTLED, Signals
from tests.commands import ROOT

LAW = Friction(static=0.6, dynamic=0.5, speed_static=0.01, speed_dynamic=0.1)


def fig7(speed):
    """Fig. 7 written again in NumPy: cubic steps up to V_s, from there to V_d."""
    size = np.abs(speed)
    x = np.clip(size / 0.01, 0, 1)
    y = np.clip((size - 0.01) / 0.09, 0, 1)
    rising = 0.6 * x * (3 - x**2) / 2
    return np.sign(speed) * np.where(size < 0.01, rising, 0.6 - 0.1 * y**2 * (3 - 2 * y))


@pytest.mark.parametrize(
    "place", ["docs/explanation/vibration.md", "docs/reference/effects.md", "mmrjax/effects/slip_effects.py"]
)
def test_the_equation_that_is_written_is_the_one_that_runs(place, robot):
    """The equation of vibration_slip, read off the page and evaluated, up to the limit and beyond."""
    text = (ROOT / place).read_text("utf-8")
    (said,) = set(re.findall(r"ΔV = a (√.*?0\.05²\))", text))
    for written, python in (("∣", "|"), ("|u|", "abs(u)"), ("√", "sqrt"), ("²", "**2"), ("^p u", "**p * u")):
        said = said.replace(written, python)
    used = np.array([-0.95, -0.3, 0.0, 0.2, 0.5, 0.8, 0.95, 1.2])
    speed, exponent, first = 0.7, 2.3, 0.9
    known = {"u": used, "p": exponent, "V_teor": speed, "V_1": first, "sqrt": np.sqrt, "abs": np.abs}
    expected = 0.03 * eval(said, {"__builtins__": {}}, known)
    effect = VibrationSlip(amplitude=0.03, exponent=exponent, speed_reference=first)
    got = effect.term(robot, Signals(demand=20.0 * used, adhesion_limit=20.0, speed_theoretical=speed))
    assert_allclose(got, expected, rtol=1e-12)
    assert expected[6] / (0.03 * (speed / first) ** exponent * 19) < 0.72  # rounded off


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


@pytest.mark.nightly
def test_loop_finds_the_effect_in_what_the_track_model_made():
    """Seventy rows of a gear that shakes (set S of 2026-11-22), with noise. Nobody tells the loop of it."""
    gear = {
        "guide_recess": 3.327e-4, "guide_gap": 10.29e-3, "contact_stiffness": 4.261e7, "contact_damping": 806.9,
        "centre_offset": -1.54e-3, "payload_height": 67.5e-3,
    }  # fmt: skip
    ground = {"static": 0.5735, "dynamic": 0.5524, "speed_static": 0.01777, "speed_dynamic": 0.1777}
    values = {f"running_gear.{k}": v for k, v in gear.items()} | {"6T2A.track.guide_friction": 0.06}
    values |= {f"6T2A.ground.friction.{k}": v for k, v in ground.items()}
    values |= {"4W2T.ground.friction.static": 0.57, "4W2T.ground.friction.dynamic": 0.5}
    robot = params.replace(paper_robots.nominal(), {k: jnp.asarray(v) for k, v in values.items()})
    axes = np.meshgrid((0, 1), (15.0, 24.0, 33.0), (0.0, 5.0, 10.0, 15.0), (0.0, 4.0, 8.0), indexing="ij")
    kind, voltage, slope, payload = (x.ravel() for x in axes)
    conditions = Conditions(kind, voltage=voltage, slope_deg=slope, payload=payload)
    shown = track_batch(robot, conditions, duration=1.5, rolling=True).result
    rng, goes_on = np.random.default_rng(4), np.isin(np.asarray(shown.status), (CONVERGED, NOT_SETTLED))
    columns = {
        "configuration": np.where(kind == 0, "6T2A", "4W2T"), "supply_voltage_V": voltage, "payload_kg": payload,
        "slope_deg": slope, "total_mass_kg": np.where(kind == 0, 13.1, 11.5) + payload,
    }  # fmt: skip
    for channel, sd in zip(channels.usual_channels(), (0.01, 0.003, 0.003), strict=True):
        noise = 1 + sd * rng.standard_normal(len(kind))
        columns[channel.column] = np.asarray(shown.reading[channel.name]) / channel.factor * noise
    table = Runs("made by the track model", columns).where(goes_on)
    found = discover(table, paper_robots.nominal(), noise="current=1%,motor_speed=0.3%,speed=0.3%")
    assert found.verdict in ("named", "class") and [e.name for e in found.effects] == ["vibration_slip"]
    before, after = found.errors_held_out["voltage"]
    assert after["speed"]["rms_sigma"] < 0.5 * before["speed"]["rms_sigma"]  # sds are shares of each reading
