"""Friction of contacts that shake: the averaged law, and the slip of track-model runs that follows from their ripple."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data.runs import Runs
from calibration.discovery.discover import discover
from mmrjax.effects.travel_effects import VibrationSlip
from mmrjax.fidelities.track import track_batch
from mmrjax.model import channels, paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import CONVERGED, NOT_SETTLED, Signals
from tests.commands import ROOT


@pytest.mark.parametrize(
    "place", ["docs/explanation/vibration.md", "docs/reference/effects.md", "mmrjax/effects/travel_effects.py"]
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
