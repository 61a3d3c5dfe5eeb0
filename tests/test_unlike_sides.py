"""Robots whose sides differ: what travels straight is said to, and by how much it would turn."""

import dataclasses
import warnings

import pytest

import mmrjax as mm
from calibration.data import effect_file
from calibration.data.input_errors import BadConfiguration
from mmrjax import effects
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


def test_a_file_of_unlike_sides_has_a_remark(tmp_path, capsys):
    file = of_file(tmp_path, SIDE_RADIUS)
    (remark,) = file.remarks
    assert remark.startswith("robot.toml: the robot's sides differ, ") and "(side_radius)" in remark
    assert remark.endswith("equal --left and --right show the turn")
    assert remark in capsys.readouterr().err.replace("\n", " ")
    assert [w.text for w in page_renderer.robot_warnings(file)] == [remark]
    assert inputs.load_robot(config.Simulate(robot=file.source, left_V=9.0, right_V=9.0)).remarks == ()
    assert of_file(tmp_path, SIDE_RADIUS.replace("0.01", "0.0")).remarks == ()
    (narrow,) = of_file(tmp_path, SIDE_RADIUS, set={"4W2T.turning.width": 0.0}).remarks
    assert narrow.endswith("turning cannot be computed: the robot's file lacks 4W2T.turning.width [m], needed for "
                           "a turn")  # fmt: skip
    document = Document("a", "b.", (), (Section("c", ()),))
    warned = page_renderer.write_report_page(tmp_path, document, file).read_text("utf-8")
    assert 'id="robot-warning"' in warned and "show the turn" in warned


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
