"""The track model asked about what remains: when it is asked, of what robot, and what it finds (slow)."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration
from calibration.discovery import resolve as room
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.loop_notes import TrackModelQuestion
from mmrjax.effects import ALL, BY_NAME
from mmrjax.model import paper_robots


def found(unnamed=None, remains=None, effects=(), alternatives=(), scores=("vibration_slip", "series_resistance")):
    table = records.read_runs("measured")
    return SimpleNamespace(
        unnamed=unnamed, remains=remains, alternatives=alternatives, robot=paper_robots.nominal(), runs=table,
        effects=tuple(SimpleNamespace(name=n, balance=BY_NAME[n].balance) for n in effects),
        scores=tuple(SimpleNamespace(name=n, balance=BY_NAME[n].balance) for n in scores),
        included=np.ones(len(table), bool), noise={},
    )  # fmt: skip


def where(balance, alike=()):
    return DiscrepancyLocation(balance, "slope", alike, (), 9.0, 9.0)


@pytest.mark.parametrize(
    ("case", "asked"),
    [
        (dict(unnamed=where("slip")), TrackModelQuestion("missing", "slip", "slope")),
        (dict(unnamed=where("motor", ("gearbox", "track"))), TrackModelQuestion("missing", "track", "slope")),
        (dict(remains=where("ground")), TrackModelQuestion("missing", "ground", "slope")),
        (dict(effects=("nonlinear_slip",)), TrackModelQuestion("found", effects=("nonlinear_slip",))),
        (dict(alternatives=(SimpleNamespace(effects={"vibration_slip": 1.0}),)), TrackModelQuestion("near", effects=("vibration_slip",))),
        (dict(unnamed=where("electrical"), effects=("series_resistance",)), None),
        (dict(), None),
    ],
)  # fmt: skip
def test_it_is_asked_about_slip_track_and_ground_alone(case, asked):
    assert room.question_of_verdict(found(**case)) == asked


def test_nothing_is_run_where_it_has_no_say(monkeypatch):
    monkeypatch.setattr(room, "calibrate", lambda *a, **k: pytest.fail("it was asked"))
    assert room.fit_track_model(found()) is None
    wheels = found(unnamed=where("slip"))
    wheels.included = np.asarray(wheels.runs["configuration"] == "4W2T")
    assert room.fit_track_model(wheels) is None


def test_histories_are_refused():
    series = found(unnamed=where("slip"))
    series.runs = dataclasses.replace(
        series.runs, columns=series.runs.columns | {"time_s": np.zeros(len(series.runs))}
    )
    with pytest.raises(BadConfiguration, match="histories"):
        room.fit_track_model(series)


def test_what_the_track_model_has_by_itself_is_left_out_of_the_robot(monkeypatch):
    """Both fits are of the rows on tracks, with the same noise. What was found in slip, and what it resolves, is gone."""
    asked = found(effects=("nonlinear_slip",))
    held = ("vibration_slip", "nonlinear_slip", "series_resistance")
    asked.robot = dataclasses.replace(asked.robot, effects=tuple(BY_NAME[n]() for n in held))
    seen = []

    def fit(rows, robot, **options):
        seen.append((rows, robot, options))
        raise KeyboardInterrupt

    monkeypatch.setattr(room, "calibrate", fit)
    with pytest.raises(KeyboardInterrupt):
        room.fit_track_model(asked, noise="speed=1%")
    rows, robot, options = seen[0]
    assert [e.name for e in robot.effects] == ["series_resistance"] and set(rows["configuration"]) == {"6T2A"}
    assert options["model"] == "track" and options["noise"] == "speed=1%"
    assert [e.name for e in ALL if e.resolved] == ["vibration_slip"]
