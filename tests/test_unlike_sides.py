"""Robots whose sides differ: what travels straight is said to, and by how much it would turn."""

import dataclasses
import types
import warnings

import pytest
from numpy.testing import assert_allclose

import mmrjax as mm
from calibration.data import effect_file
from calibration.data.input_errors import BadConfiguration
from mmrjax import effects
from mmrjax.derived import turning_figures
from mmrjax.effects.base import THE_SIDE
from sweeps import config, inputs
from sweeps.report import page_renderer
from sweeps.report.document import Document, Section
from tests.commands import refused
from tests.test_turn_effects import OF_SIDES, amplitude, with_amplitudes

OWN = '''
from mmrjax.effects import Effect, amplitude
class Own(Effect):
    """Δ = a x.

    Source: a test.
    """
    balance = "{balance}"
    {more}
    amplitude: float = amplitude(unit="-", meaning="size", bounds=(-10.0, 10.0), sd=1e-3, source="a test")

    def term(self, robot, signals):
        return self.amplitude * {term}
'''


def of_file(tmp_path, text, **options):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    return inputs.load_robot(config.RobotPart(robot=str(path), **options))


def test_effects_of_the_side_make_sides_unlike(robot):
    assert robot.unlike == with_amplitudes(robot, dict.fromkeys(OF_SIDES, 0.0)).unlike == ()
    assert with_amplitudes(robot, {name: amplitude(name) for name in effects.OF_TURNS}).unlike == OF_SIDES
    curve = effects.CURVES_ROUND["curve_track_side"](amplitude=0.1)
    assert dataclasses.replace(robot, effects=(curve,)).unlike == ("curve_track_side",)
    unnamed = {name for name, kind in effects.UNNAMED.items() if kind.driver == THE_SIDE}
    assert unnamed == {name for name in effects.UNNAMED if name.endswith("_side")}


@pytest.mark.parametrize("conditions", [{}, {"duty": -0.5}])
def test_straight_travel_of_unlike_sides_is_said_to_be_that(conditions, robot):
    unlike = with_amplitudes(robot, {"side_friction": 0.001})
    with pytest.warns(UserWarning, match=r"^side_friction: the robot's sides differ, .* duty_left=1, duty_right=1"):
        mm.simulate(unlike, mm.Conditions(**conditions))
    with warnings.catch_warnings():  # which are errors
        mm.simulate(unlike, mm.Conditions(duty_left=1.0, duty_right=1.0))  # computed when it is asked for
        mm.simulate(with_amplitudes(robot, {"side_friction": 0.0}), mm.Conditions(**conditions))


SIDE_RADIUS = 'base = "nominal"\n[effects.side_radius]\namplitude = 0.01\nconfigurations = ["4W2T"]\n'


def test_a_file_of_unlike_sides_is_said_to_turn_and_by_how_much(tmp_path, capsys, monkeypatch):
    found = types.SimpleNamespace(reading={"yaw_rate": [1e-18, -0.0175], "speed": [0.99, 1.31]}, status=[0, 0])
    monkeypatch.setattr(inputs, "turns_under_equal_commands", lambda robot, imposed: found)
    file = of_file(tmp_path, SIDE_RADIUS)
    (remark,) = file.remarks
    assert remark.startswith("robot.toml: the robot's sides differ, ") and "(side_radius)" in remark
    assert remark in capsys.readouterr().err.replace("\n", " ")
    turning = (
        "33 V on both sides on level ground, the robot does not travel straight: 4W2T turns to the right at 0.0175"
    )
    assert f"{turning} rad/s and 1.31 m/s (--left" in remark
    assert "6T2A" not in remark  # whose sides are alike
    assert [w.text for w in page_renderer.robot_warnings(file)] == [". ".join(file.remarks)]
    assert inputs.load_robot(config.Simulate(robot=file.source, left_V=9.0, right_V=9.0)).remarks == ()
    assert of_file(tmp_path, SIDE_RADIUS.replace("0.01", "0.0")).remarks == ()
    (narrow,) = of_file(tmp_path, SIDE_RADIUS, set={"4W2T.turning.width": 0.0}).remarks
    assert narrow.endswith("turning cannot be computed: the robot's file lacks 4W2T.turning.width [m], needed for "
                           "a turn")  # fmt: skip
    document = Document("a", "b.", (), (Section("c", ()),))
    warned = page_renderer.write_report_page(tmp_path, document, file).read_text("utf-8")
    assert 'id="robot-warning"' in warned and turning in warned
    found.reading["yaw_rate"] = [0.0, 0.0]
    assert of_file(tmp_path, SIDE_RADIUS).remarks == ()


@pytest.mark.slow
def test_unlike_sides_turn_as_those_that_are_driven_alike(tmp_path):
    """At the limit that its file states, each configuration's own."""
    file = of_file(tmp_path, SIDE_RADIUS)
    asked = mm.Conditions(["6T2A", "4W2T"], voltage=33.0, duty_left=1.0, duty_right=1.0)
    rates = mm.simulate(file.robot, asked).reading["yaw_rate"]
    assert_allclose(
        turning_figures.turns_under_equal_commands(file.robot, 33.0).reading["yaw_rate"], rates, rtol=1e-9, atol=1e-12
    )
    assert abs(rates[0]) < 1e-9 and rates[1] > 0.01  # the left side's radius is the smaller
    assert f"4W2T turns to the left at {rates[1]:.3g} rad/s" in file.remarks[0]


def test_effects_of_a_file_say_that_they_are_of_one_side(tmp_path):
    path = tmp_path / "own.py"

    def read(balance, term, more=""):
        path.write_text(OWN.format(balance=balance, term=term, more=more))
        return effect_file.read_effect_file(path)

    of_side = 'driver = "the side"'
    for balance, term in (("ground", "signals.side"), ("yaw", "signals.normal"), ("lateral", "signals.normal")):
        with refused(r"Own, driver: got '' for a term .* expected .the side.", BadConfiguration):
            read(balance, term)
        (own,) = read(balance, term, of_side)
        assert own(amplitude=1.0).unlike
    for term in ("signals.normal * signals.yaw_rate", "signals.side * signals.normal"):
        (own,) = read("yaw", term)
        assert not own(amplitude=1.0).unlike
    read("ground", "signals.side * signals.yaw_rate")
