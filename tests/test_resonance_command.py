"""The command `resonance`: what it finds on 6T2A, what it leaves, and what it refuses."""

from contextlib import contextmanager
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.fidelities.track import track_batch
from mmrjax.model.signals import CONVERGED
from mmrjax.undercarriage.modes import Mode
from sweeps import config
from sweeps.commands import resonance as room
from sweeps.points import run
from tests.commands import command, read_json, rows, schema_of
from tests.pages import Tables, drawn, outside

SCHEMA = schema_of("resonance")
SMALL = ("resonance", "--voltages", "24:40:2", "--payloads", "8,0", "--duration", "1")


#: Damping ratio and, by payload [kg], frequency [Hz] of the oscillators of `waves`; by signal and payload, the one that
#: shows in it and the harmonic that drives it.
OSCILLATORS = {"bounce": (0.06, {0.0: 93.0, 8.0: 79.0}), "pitch": (0.06, {0.0: 52.0, 8.0: 51.0})}
ANSWERS = {
    "normal": {0.0: ("bounce", 3), 8.0: ("bounce", 3)},
    "total_current": {0.0: ("pitch", 2), 8.0: ("bounce", 3)},
}


def linear(robot, conditions):
    """The oscillators as modes, and on tracks a drive that is too damped to resonate."""
    found = []
    for payload, which in zip(np.asarray(conditions.payload), np.asarray(conditions.configuration), strict=True):
        of = [
            Mode(n, f[payload], f[payload], f[payload], f[payload], d, 1.0, 1.0) for n, (d, f) in OSCILLATORS.items()
        ]
        found.append([*of, *([] if which else [Mode("drive", 60.0, 60.0, 60.0, 80.0, 0.7, 1.0, 1.0)])])
    return found


def waves(robot, conditions, duration, step, **_):
    """Runs in closed form instead of the track model's: travel at U · 29 mm/s per V. On tracks a harmonic of what passes
    drives each oscillator, and the signal that shows it swings by 2 % times its amplification. On wheels by 0.5 %."""
    time = 1e-3 * np.arange(1, round(1e3 * duration) + 1)
    speed = 0.029 * np.asarray(conditions.voltage)
    still = {
        "normal": 60.0,
        "total_current": 2.0,
        "speed": speed,
        "speed_motor": 900.0,
        "speed_wheel": speed / robot.radius_pulley,
    }
    signals = {name: np.outer(np.broadcast_to(x, speed.shape), np.ones(len(time))) for name, x in still.items()}
    for name, by_payload in ANSWERS.items():
        for k, payload in enumerate(np.asarray(conditions.payload)):
            oscillator, order = by_payload[min(by_payload, key=lambda x: abs(x - payload))]
            damping, natural = OSCILLATORS[oscillator]
            driven = order * speed[k] / 0.035
            ratio = driven / np.interp(payload, list(natural), list(natural.values()))
            swing = 0.02 / np.hypot(1 - ratio**2, 2 * damping * ratio)
            if np.asarray(conditions.configuration)[k] == 1:
                swing = 0.005  # on wheels nothing meets an oscillator
            signals[name][k] *= 1 + swing * np.sin(2 * np.pi * driven * time)
    return SimpleNamespace(
        time=np.tile(time, (len(speed), 1)), signals=SimpleNamespace(**signals),
        result=SimpleNamespace(status=np.full(len(speed), CONVERGED)),
    )  # fmt: skip


@contextmanager
def runs_of(kind):
    """The track model's runs, or those of `waves`, whose peaks are known and for which nothing compiles."""
    with pytest.MonkeyPatch.context() as patch:
        if kind == "waves":
            patch.setattr(room, "track_batch", waves)
            patch.setattr(room, "modes", linear)
            patch.setattr(run, "check_fidelity_options", lambda *_: None)  # no step is too large for a closed form
        yield patch


KINDS = ["waves", pytest.param("model", marks=pytest.mark.slow)]


@pytest.fixture(scope="module", params=KINDS)
def tracked(request, tmp_path_factory):
    """Folder and ResonanceResult of a small map of 6T2A, as the command makes it."""
    folder, kept = tmp_path_factory.mktemp("runs") / "map", []
    with runs_of(request.param) as patch:
        made = room.resonance_report.resonance_document
        patch.setattr(
            room.resonance_report, "resonance_document", lambda *found: kept.append(found[0]) or made(*found)
        )
        assert command([*SMALL, "--out", folder]) == 0
    return folder, kept[0]


def test_ripple_peaks_where_harmonics_meet_natural_frequencies(tracked):
    """Reaction, and current with 8 kg, where the third harmonic of the grousers meets bounce. Current without payload
    where the second meets pitch, whose frequency changes most over the belt's position."""
    found = tracked[1]
    for payload, of in found.modes.items():
        natural = {m.name: m.frequency for m in of}
        current = ("current", "bounce", 3, 0.04) if payload else ("current", "pitch", 2, 0.06)
        for signal, mode, order, apart in (("reaction", "bounce", 3, 0.04), current):
            (peak,) = (
                p for p in found.peaks if (p.payload, p.signal, p.mode, p.order) == (payload, signal, mode, order)
            )
            assert peak.speed == pytest.approx(natural[mode] * found.passing.travel / order, rel=apart)
            assert peak.rise > 0.1 * peak.ripple
    light, heavy = (
        next(p for p in found.peaks if (p.payload, p.mode, p.order) == (x, "bounce", 3)) for x in (0.0, 8.0)
    )
    assert heavy.speed < 0.9 * light.speed


def test_command_leaves_result_tables_and_a_page_of_its_own(tracked):
    folder, found = tracked
    result = read_json(folder / "result.json")
    jsonschema.validate(result, SCHEMA)
    assert result["schema"] == "mmrjax.resonance/2" and result["statement"] == found.statement()
    assert result["statement"].startswith("Avoid ")
    assert {(a["mode"], a["order"]) for a in result["avoid"]} == {("bounce", 3), ("pitch", 2)}
    points = rows(folder / "points.csv")
    assert len(points) == result["runs"] == 18
    assert {m["name"] for m in rows(folder / "modes.csv")} == {"bounce", "pitch", "drive"}
    assert len(rows(folder / "peaks.csv")) == len(result["peaks"])
    page = (folder / "report.html").read_text()
    assert "map" in drawn(page) and outside(folder) == []
    tables = Tables(page).tables
    assert len(tables["frequencies"]) == 1 + 6
    assert {"config.resolved.toml", "robot.toml", "manifest.json"} <= {p.name for p in folder.iterdir()}
    assert not folder.with_name("map.partial").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_wheels_have_no_grousers_and_nothing_to_avoid(tmp_path, kind):
    out = tmp_path / "wheels"
    with runs_of(kind):
        assert command([*SMALL, "--configuration", "4W2T", "--out", out]) == 0
    result = read_json(out / "result.json")
    assert result["passing"]["of"] == "teeth" and result["avoid"] == []
    assert "Without grousers" in result["statement"]
    assert {m["name"] for m in result["modes"]} == {"bounce", "pitch"}


@pytest.mark.slow
def test_shaking_gear_says_what_does_not_settle(tmp_path):
    settings = {
        "running_gear.guide_recess": 3.5e-4, "running_gear.contact_damping": 840,
        "running_gear.contact_stiffness": 4.2e7, "running_gear.guide_gap": 0.012, "6T2A.ground.friction.static": 0.59,
        "6T2A.ground.friction.dynamic": 0.52, "6T2A.ground.friction.speed_static": 0.021,
        "6T2A.ground.friction.speed_dynamic": 0.21, "6T2A.track.guide_friction": 0.06,
    }  # fmt: skip
    changes = [part for name, value in settings.items() for part in ("--set", f"{name}={value:g}")]
    out = tmp_path / "shaking"
    assert command([*SMALL, *changes, "--out", out]) == 0
    result = read_json(out / "result.json")
    assert result["statuses"]["converged"] < result["runs"] and result["restless_m_s"]
    assert "Pitch has no single frequency" in result["statement"]


def test_resolved_configuration_is_read_again(tracked):
    text = (tracked[0] / "config.resolved.toml").read_text()
    assert 'model = "track"' in text and "voltages_V = [24.0, 26.0" in text
    again = config.resolve_configuration(config.Resonance, tracked[0] / "config.resolved.toml", {})
    assert again.payloads_kg == (0.0, 8.0) and again.options["duration"] == 1.0


@pytest.mark.parametrize("tracked", KINDS[1:], indirect=True)
def test_ripple_of_reaction_is_that_of_the_track_model(robot, tracked):
    """Of every point, from the runs themselves, their drift left in."""
    found = tracked[1]
    again = config.resolve_configuration(config.Resonance, tracked[0] / "config.resolved.toml", {})
    conditions = run.conditions_of_runs(
        robot, room.grid_conditions(room._speed_grid(again, again.voltages_V), robot), again
    )
    runs = track_batch(robot, conditions, duration=1.0, step=1e-4, rolling=True, progress=lambda share: None)
    normal = np.asarray(runs.signals.normal)[:, 500:]
    ripple = 100 * normal.std(axis=1) / normal.mean(axis=1)
    assert_allclose(found.table["reaction_ripple_percent"], ripple, rtol=0.02)
