"""Robots as TOML files: written and read back the same, and refused in one sentence."""

import pytest

from calibration.data import robot_file
from calibration.data.errors import BadConfiguration
from mmrjax import effects, nominal, params


def values(robot):
    return {p.name: float(p.value) for p in params.walk(robot)}


@pytest.mark.parametrize("name", nominal.ROBOTS)
def test_robot_written_and_read_is_the_same(tmp_path, name):
    robot = robot_file.with_effects(robot_file.load(name), tuple(effects.BY_NAME))
    robot = robot_file.change(robot, {"effects.churning.amplitude": 1e-4}, where="test")
    robot_file.write(robot, tmp_path / "robot.toml", note="a note")
    assert values(robot_file.load(str(tmp_path / "robot.toml"))) == values(robot)


def test_file_states_only_what_differs(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('base = "sm1"\n[motor]\nresistance = 0.9\n[effects.series_resistance]\namplitude = 0.3\n')
    robot, base = values(robot_file.read(path)), values(nominal.sm1())
    assert robot.pop("motor.resistance") == 0.9 and robot.pop("effects.series_resistance.amplitude") == 0.3
    assert base.pop("motor.resistance") == 0.611 and robot == base


REFUSED = {
    "misspelt table": (
        "[motr]\nresistance = 1",
        r"mine\.toml, motr\.resistance: no such parameter; did you mean motor\.resistance",
    ),
    "misspelt key": (
        "[motor]\nresistanc = 1",
        r"motor\.resistanc: no such parameter; did you mean motor\.resistance",
    ),
    "negative mass": ("[tracked]\nmass = -3", r"tracked\.mass: got -3; expected 0\.5 to 200 kg"),
    "NaN": ("[motor]\nresistance = nan", r"motor\.resistance: got nan"),
    "word": ("[motor]\nresistance = 'low'", r"motor\.resistance: got 'low'; expected a number"),
    "boolean": ("[motor]\nresistance = true", r"got True; expected a number"),
    "unknown effect": ("[effects.churn]\namplitude = 1", r"effects\.churn: no such effect; did you mean churning"),
    "effect is no table": ("effects = 3", r"effects: got 3; expected tables"),
    "effect stands as a number": ("[effects]\nchurning = 3", r"effects\.churning: no such parameter"),
    "unknown base": ("base = 'best'", r"base: got best; allowed: nominal, sm1, sm2"),
    "other schema": ("schema = 'x/9'", r"schema: got x/9; expected mmrjax\.robot/1"),
    "not TOML": ("motor = [", r"not a readable TOML file"),
    "friction speeds reversed": (
        "[6T2A.ground.friction]\nspeed_static = 0.5\nspeed_dynamic = 0.1",
        r"tracked\.ground\.friction\.speed_dynamic: got 0\.1; expected more than speed_static, 0\.5",
    ),
}


@pytest.mark.parametrize("case", REFUSED, ids=list(REFUSED))
def test_bad_robots_are_refused_in_one_sentence(tmp_path, case):
    text, sentence = REFUSED[case]
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(BadConfiguration, match=sentence) as refusal:
        robot_file.load(str(path))
    assert refusal.value.exit_code == 2


def test_unknown_name_lists_the_robots():
    with pytest.raises(
        BadConfiguration, match=r"--robot: got nominel, no such file and no known robot; did you mean nominal"
    ):
        robot_file.load("nominel")
