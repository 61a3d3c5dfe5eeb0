"""Robots as TOML files: written and read back the same, and refused in one sentence."""

import equinox as eqx
import pytest

from calibration.data import robot_file
from calibration.data.input_errors import BadConfiguration
from mmrjax import effects
from mmrjax.model import paper_robots, params
from tests.commands import read_rig, text_file


def values(robot):
    return {p.name: float(p.value) for p in params.walk_parameters(robot)}


@pytest.mark.parametrize("name", paper_robots.ROBOTS)
def test_robot_written_and_read_is_the_same(tmp_path, name):
    robot = robot_file.add_effects(robot_file.load_robot(name), tuple(effects.BY_NAME))
    robot = robot_file.change_robot(robot, {"effects.churning.amplitude": 1e-4}, where="test")
    robot_file.write_robot(robot, tmp_path / "robot.toml", note="a note")
    assert values(robot_file.load_robot(str(tmp_path / "robot.toml"))) == values(robot)


def test_file_states_only_what_differs(tmp_path):
    text = 'base = "sm1"\n[motor]\nresistance = 0.9\n[effects.series_resistance]\namplitude = 0.3\n'
    robot, base = values(read_rig(tmp_path, text)), values(paper_robots.sm1())
    assert robot.pop("motor.resistance") == 0.9 and robot.pop("effects.series_resistance.amplitude") == 0.3
    assert base.pop("motor.resistance") == 0.611 and robot == base


ROVER = """
sides = 4
configurations = ["rover", "6T2A"]
[battery]
cells = 4
[rover]
like = "4W2T"
mass = 6.0
[rover.ground.friction]
static = 0.6
[effects.churning]
amplitude = 1e-4
configurations = ["rover"]
[effects.bending_loss]
amplitude = 0.02
"""

CRAWLER = """
configurations = ["crawler-2"]
[crawler-2]
movers = "tracks"
mass = 4.0
radius = 0.03
inertia = 1e-4
[crawler-2.track]
loss_coulomb = 0.1
loss_viscous = 0.01
guide_share = 0.2
[crawler-2.ground]
rolling_resistance = 0.05
[crawler-2.ground.friction]
static = 0.7
dynamic = 0.5
"""


@pytest.mark.parametrize("text", [ROVER, CRAWLER], ids=["rover", "crawler"])
def test_a_robot_of_another_build_is_written_and_read_the_same(tmp_path, text):
    robot = read_rig(tmp_path, text)
    robot_file.write_robot(robot, tmp_path / "again.toml")
    again = robot_file.read_robot(tmp_path / "again.toml")
    assert eqx.tree_equal(robot, again)
    assert [(e.name, e.configurations) for e in again.effects] == [(e.name, e.configurations) for e in robot.effects]


def test_like_starts_from_that_configuration(tmp_path):
    robot, base = read_rig(tmp_path, ROVER), paper_robots.nominal()
    assert robot.configurations.names == ("rover", "6T2A") and robot.sides == 4 and robot.battery.cells == 4
    rover, wheeled = robot.configurations["rover"], base.configurations["4W2T"]
    assert rover.mass == 6.0 and rover.ground.friction.static == 0.6
    assert rover.on_tracks == 0.0 and rover.radius == wheeled.radius
    assert [e.configurations for e in robot.effects] == [("rover",), ()]


def test_movers_start_from_the_defaults_of_the_fields(tmp_path):
    crawler = read_rig(tmp_path, CRAWLER).configurations["crawler-2"]
    assert crawler.on_tracks == 1.0
    assert crawler.track.guide_friction == 0.20 and crawler.ground.friction.speed_static == 0.02


def test_ratings_are_stated_written_and_checked(tmp_path):
    robot = read_rig(
        tmp_path, "[motor]\nvoltage_limit = 14.4\nspeed_limit = 900.0\n[gearbox]\nspeed_limit = 600\n", "mine.toml"
    )
    assert (robot.motor.voltage_limit, robot.motor.speed_limit, robot.gearbox.speed_limit) == (14.4, 900.0, 600.0)
    assert paper_robots.nominal().motor.voltage_limit is None  # the bench went to 33 V with a motor of 24 V
    robot_file.write_robot(robot, tmp_path / "again.toml")
    assert robot_file.read_robot(tmp_path / "again.toml").motor == robot.motor
    robot_file.write_robot(paper_robots.nominal(), tmp_path / "nominal.toml")
    assert "voltage_limit" not in (tmp_path / "nominal.toml").read_text()


def test_robot_file_knows_what_it_states(tmp_path):
    path = tmp_path / "rig.toml"
    found = robot_file.parse_robot_file(
        text_file(
            path,
            'base = "none"\nchannels = ["total_current"]\n[motor]\nresistance = "1.0 ± 5 %"\ntorque_constant = 0.05\n'
            "[gearbox]\nratio = 10\nefficiency_load = 0.8  # example: yours\n"
            '[screw]\nload = "linear"\nmass_kg = 2\nlead_mm = 5\n[twice]\nlike = "screw"\nmass_kg = 4\n',
        )
    )
    assert found.name == "rig.toml" and found.text == path.read_text()
    assert found.linear == {"screw", "twice"}  # what another table states of it is stated
    assert {"motor.resistance", "gearbox.ratio", "screw.inertia", "twice.inertia"} <= found.stated
    assert not found.stated & {"motor.inertia", "screw.mass_kg", "base", "channels"}
    assert values(found.robot) == values(robot_file.load_robot(str(path)))
    packaged = robot_file.find_robot_file("sm1")
    assert not packaged.stated and packaged.name == "sm1" and values(packaged.robot) == values(paper_robots.sm1())


def test_a_stated_curve_is_that_of_the_capacity_beside_it(tmp_path):
    """So what a file with a capacity and a curve of its own means is eq. (13). A capacity alone keeps the paper's."""
    path, again = tmp_path / "mine.toml", tmp_path / "again.toml"
    for text, of in (
        ("capacity = 18000.0\ncurvature = 1e-9\nslope = -4e-5", 18_000.0),
        ("capacity = 18000.0\ncurvature = 1e-9\nslope = -4e-5\ncapacity_curve = 9000.0", 9000.0),
        ("capacity = 18000.0", 7920.0),
        ("slope = -1e-4", 7920.0),
    ):
        battery = robot_file.read_robot(text_file(path, f"[battery]\n{text}\n")).battery
        assert battery.capacity_curve == of
        robot_file.write_robot(robot_file.read_robot(path), again)
        assert robot_file.read_robot(again).battery == battery
        start = 'base = "none"\nchannels = ["total_current"]\n[motor]\nresistance = 1.0\ntorque_constant = 0.05\n'
        load = '[gearbox]\nratio = 10\nefficiency_load = 0.8\n[arm]\nload = "shaft"\ninertia = 1e-3\nloss_coulomb = 0.01\n'
        robot_file.write_robot(robot_file.read_robot(text_file(path, f"{start}{load}[battery]\n{text}\n")), again)
        assert robot_file.read_robot(again).battery == robot_file.read_robot(path).battery
        assert robot_file.read_robot(again).battery.capacity_curve == of


def test_a_curve_that_turns_up_is_said_where_a_file_states_it(tmp_path):
    path = text_file(tmp_path / "up.toml", "[battery]\ncurvature = 1e-8\n")
    assert robot_file.parse_robot_file(path).remarks == (
        "up.toml, battery.curvature: with this curvature and slope a cell's voltage rises after 87.7 % of its "
        "capacity is taken (capacity_curve: 7920 C)",
    )
    values = {"battery.capacity": 30_670.0}
    robot = robot_file.change_robot(paper_robots.nominal(), values, where="--set")
    assert not robot_file.battery_remarks(robot, values, "--set")
    assert robot.battery.voltage_empty == paper_robots.nominal().battery.voltage_empty


def test_all_that_is_wrong_with_a_file_is_said_at_once(tmp_path):
    with pytest.raises(BadConfiguration) as error:
        read_rig(tmp_path, "[motor]\nresistance = -1\nresistence = 0.6\n[gearbox]\nratio = 'x'\n", "bad.toml")
    said = str(error.value)
    assert said.startswith("bad.toml, motor.resistance: got -1; expected 0.001 to 1000 ohm")
    assert "; also motor.resistence: no such parameter" in said and "; also gearbox.ratio: got 'x'; expected" in said
