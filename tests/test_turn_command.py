"""The command `simulate` of a robot whose sides are driven apart."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pages import recorded

import mmrjax as mm
from calibration.data import runs as records
from calibration.data.input_errors import BadData
from mmrjax.derived import turning_figures as derived
from mmrjax.errors import UsageError
from mmrjax.missions.profile import profile
from mmrjax.model import paper_robots, params
from mmrjax.model.channels import SIDES
from mmrjax.model.quantities import HEAT
from sweeps.capabilities import UNLIMITED
from sweeps.commands import simulate
from sweeps.pages import mission_figures
from sweeps.points.job import robot_for_turns
from sweeps.report import run_tables, runs_report, turn_words
from tests.commands import ends, read_json, refused, rows, text_file


@pytest.mark.slow
def test_settled_turn_leaves_its_folder(tmp_path, mmrjax):
    ends(mmrjax("simulate --left 33 --right 15 --no-report --out", str(tmp_path / "run")), code=0)
    folder = tmp_path / "run"
    (row,) = rows(folder / "runs.csv")
    result = read_json(folder / "result.json")
    assert result["turn"]["turning_radius_mm"] == pytest.approx(float(row["turning_radius_mm"]))
    assert float(row["yaw_rate_rad_s"]) < 0 and abs(float(row["turning_radius_mm"])) == pytest.approx(442, abs=1)
    assert float(row["speed_mm_s"]) == pytest.approx(642, abs=1)
    left, right = (float(row[f"motor_voltage_{side}_V"]) for side in ("left", "right"))
    assert (left, right) == (pytest.approx(33.0), pytest.approx(15.0))
    power = sum(float(row[f"power_{side}_W"]) for side in ("left", "right"))
    assert power == pytest.approx(float(row["power_supply_W"]))
    turns = rows(folder / "turns.csv")
    rates = np.array([float(t["yaw_rate_rad_s"]) for t in turns[1:]])
    assert abs(rates[0]) < 1e-9 and (np.diff(np.abs(rates)) > 0).all()


@pytest.mark.slow
def test_the_track_model_turns_and_leaves_its_path(tmp_path, mmrjax):
    told = "--left", "24", "--right", "10", "--model", "track", "--duration", "0.2", "--no-report"
    assert mmrjax("simulate", *told, "--out", str(tmp_path / "run"))[0] == 0
    first, *_, last = rows(tmp_path / "run/history.csv")
    assert float(last["yaw_deg"]) < -0.2 < float(first["yaw_deg"]) < 0
    assert float(last["motor_current_left_A"]) > float(last["motor_current_right_A"]) > 0.5
    assert float(last["x_mm"]) > 20
    (row,) = rows(tmp_path / "run/runs.csv")
    assert 0.95 < float(row["guide_share"]) < 1


HEADER, SIDED = "configuration,supply_voltage_V,payload_kg,slope_deg,", "duty_left,duty_right"


def test_tables_take_the_duty_of_either_side(tmp_path):
    path = tmp_path / "turns.csv"
    runs = records.read_runs(text_file(path, f"{HEADER}duty_left,duty_right\n6T2A,33,0,0,1,-0.5\n"), measured=False)
    assert runs.turns
    assert runs.axes[-2:] == ("duty_left", "duty_right")
    with refused("column duty in addition to duty_left"):
        records.read_runs(text_file(path, f"{HEADER}duty_left,duty_right,duty\n6T2A,33,0,0,1,1,1\n"), measured=False)


def row(**changes):
    sides = {f"{name}_{side}_{unit}": 1.0 for name, unit in (("motor_voltage", "V"), ("motor_current", "A"),
                                                           ("motor_speed", "rpm")) for side in ("left", "right")}  # fmt: skip
    usual = {
        "configuration": "6T2A", "status": "converged", "yaw_rate_rad_s": 0.5, "turning_radius_mm": 400.0,
        "speed_mm_s": 200.0, "effective_width_mm": 365.0, "power_left_W": 5.0, "power_right_W": 5.0,
        "winding_left_C": 40.0, "winding_right_C": 40.0, "power_supply_W": 10.0, "slope_deg": 0.0, "flags": "",
    }  # fmt: skip
    return usual | sides | changes


def test_radius_is_that_of_the_circle_on_which_the_centre_of_mass_moves(robot):
    """Beside a braked side it moves aside by a third of how it moves ahead, so its circle is the larger one."""
    reading = {"yaw_rate": [-2.0, 2.0, 0.0], "speed": [0.3, -0.3, 0.3], "lateral_speed": [0.1, 0.1, 0.0]}
    reading |= {f"motor_{what}_{side}": np.ones(3) for what in ("speed", "current", "voltage") for side in SIDES}
    found = derived.turning_columns(robot, reading, np.full(3, 0.04))
    size = 1000 * np.hypot(0.3, 0.1) / 2
    assert_allclose(found["turning_radius_mm"], [-size, -size, np.inf], rtol=1e-12)
    away = np.hypot(found["centre_x_mm"][:2], found["centre_y_mm"][:2])
    assert_allclose(away, size, rtol=1e-12)


def test_runs_of_a_table_whose_sides_are_driven_apart_show_both_sides(tmp_path, mmrjax, monkeypatch):
    shown = []

    def simulated(folder, robot, *_):
        shown.extend(c.name for c in robot.channels)
        raise BadData("enough")

    monkeypatch.setattr(simulate, "_simulate_table", simulated)
    path = tmp_path / "turns.csv"
    for cells, turns in (("33,0,0", False), ("33,0,0,1,0.5", True)):
        path.write_text(f"{HEADER if turns else HEADER.strip(',')}{SIDED if turns else ''}\n6T2A,{cells}\n")
        assert mmrjax("simulate --runs", path)[0] == 4
        assert ({"yaw_rate", "motor_current_left", "motor_current_right"} <= set(shown)) == turns
    table = {"total_current_A": [1.8], "motor_current_left_A": [-1.8], "motor_current_right_A": [0.1]}
    assert simulate.motor_currents(paper_robots.nominal(), table) == pytest.approx([1.8])


def test_results_of_turns_show_both_sides():
    """Nothing is computed before it is asked for. Who travels straight has the columns of before."""
    robot, sides = paper_robots.nominal(), {"duty_left": 1.0, "duty_right": [0.5, -1.0]}
    turns, straight = (mm.simulate(robot, mm.Conditions("6T2A", voltage=33.0, **x)) for x in (sides, {}))
    assert {"yaw_rate", "motor_current_left", "motor_current_right"} <= {c.name for c in turns.channels}
    assert straight.channels == robot.channels


SLOPING = {"slope_deg": 10.0, "yaw_rate_rad_s": -0.04}
NOTHING = {name: float("nan") for name, value in row().items() if isinstance(value, float)}
ENDED = {"time_s": 2.0, "displacement_m": 0.3, "turned_deg": -90.0}
#: What is turned → changes of a usual turn.
TOLD = {
    "left": {}, "on the spot": {"yaw_rate_rad_s": -0.5, "speed_mm_s": 0.2},
    "straight": {"turning_radius_mm": float("inf"), "yaw_rate_rad_s": 0.0}, "on a slope": SLOPING,
    "straight on a slope": {"slope_deg": 10.0, "turning_radius_mm": float("inf"), "yaw_rate_rad_s": 0.0},
    "stalled": {"status": "stalled"}, "not settled": {"status": "not_settled"}, "no numbers": {"status": "not_settled", **NOTHING},
    "beyond limits": {"flags": "gearbox_overspeed;winding_hot"},
    "hot, a side that gives back": {"winding_left_C": float("inf"), "power_right_W": -0.01},
    "a side that stands": {"motor_speed_right_rpm": 0.2},
    "a side that is driven": {"motor_current_left_A": -0.4, "motor_speed_left_rpm": 900.0, "power_left_W": -3.0},
}  # fmt: skip


def told(robot, name, ended=None):
    """Lines of what is said of a turn, and of the table of its sides."""
    turn = row(**TOLD[name])
    yield f"{name}: {turn_words.turn_answer(turn, ended)}"
    yield from turn_words.turn_notes(robot, turn)
    yield from (" | ".join(map(str, side)) for side in runs_report.sides_table(robot, turn).rows)


def test_turns_are_told_as_recorded(robot):
    wide = params.replace(robot, {"6T2A.turning.width": 0.5})
    unknown = dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, unknown=HEAT[-1:]))
    lines = [line for name in TOLD for line in told(robot, name)]
    lines += [
        *told(robot, "not settled", ENDED),
        "# wide",
        *told(wide, "left"),
        "# heat is not known",
        *told(unknown, "left"),
    ]
    text = "\n".join(lines) + "\n"
    assert text == recorded("turns", text)
    assert not turn_words.has_motion(row(**TOLD["no numbers"]))


PLAN = '[conditions]\nconfiguration = "6T2A"\nvoltage = 24\nduty_right = 1\n[axes]\nduty_left = [-1, 1]\n'


def test_a_sweep_over_duties_of_sides_shows_both_and_one_of_straight_travel_as_before(robot):
    assert robot_for_turns(robot, {"voltage", "slope_deg"}) is robot
    shown = robot_for_turns(robot, {"voltage", "duty_left"}).channels
    assert {"yaw_rate", "motor_current_left", "speed"} <= {c.name for c in shown}


@pytest.mark.slow
def test_a_sweep_over_duties_leaves_yaw_rates(tmp_path, mmrjax):
    (tmp_path / "plan.toml").write_text(PLAN)
    told = "sweep", str(tmp_path / "plan.toml"), "--export", "csv", "--no-report", "--out", str(tmp_path / "run")
    assert mmrjax(*told)[0] == 0
    spot, straight = rows(tmp_path / "run/runs.csv")
    assert float(spot["yaw_rate_rad_s"]) > 3 and float(spot["speed_mm_s"]) == pytest.approx(0.0, abs=1e-6)
    assert float(straight["yaw_rate_rad_s"]) == pytest.approx(0.0, abs=1e-9)


def test_currents_of_a_turn_on_the_spot_do_not_cancel_on_the_page_of_a_mission():
    sides = {f"motor_current_{side}_A": np.array([sign * 1.6, 1.0]) for side, sign in (("left", -1), ("right", 1))}
    rows = {"motor_current_A": np.array([0.0, 1.0])}
    assert_allclose(mission_figures.mean_of_motors(rows | sides, "motor_current", "_A"), [1.6, 1.0])
    assert_allclose(mission_figures.mean_of_motors(rows, "motor_current", "_A"), [0.0, 1.0])


@pytest.mark.slow
def test_compare_sets_both_sides_and_the_yaw_rate_of_turns_beside_their_readings(tmp_path, mmrjax):
    path, read = tmp_path / "turns.csv", ("motor_current_left_A", "motor_current_right_A", "yaw_rate_rad_s")
    path.write_text(
        f"{HEADER}total_mass_kg,{SIDED},total_current_A,{','.join(read)}\n6T2A,24,0,0,25,0.6,1,2.3,0.4,1.9,0.7\n"
    )
    assert mmrjax("compare", path, "--out", tmp_path / "out")[0] == 0
    found = (tmp_path / "out/comparison.csv").read_text().splitlines()
    row = dict(zip(*(line.split(",") for line in found), strict=True))
    assert [float(row[name]) for name in read] == [0.4, 1.9, 0.7]
    left, right, yaw_rate = (float(row[f"simulated_{name}"]) for name in read)
    assert left < 0.5 < right and yaw_rate > 0.3  # to the left, the left track dragged along
    assert (row["duty_left"], row["duty_right"]) == ("0.6", "1")


@pytest.mark.parametrize("duty", [1, 1.0, 0.5, [1.0, 1.0]])
def test_a_duty_written_beside_both_sides_is_refused_whatever_it_is(duty):
    with pytest.raises(
        UsageError, match=r"^duty cannot be combined with duty_left and duty_right; give one of the two"
    ):
        mm.Conditions("6T2A", duty=duty, duty_left=1, duty_right=0.5)
    alone = mm.Conditions(0, duty=duty, duty_left=0.5)  # of the right side
    again = dataclasses.replace(alone, duty_right=jnp.asarray(0.5))
    assert np.all(again.of_sides().duty == 0.5) and np.all(alone.of_sides().duty[1] == np.asarray(duty))


TURNING = profile([0.0, 1.0], duty_left=[0.5, 0.5], duty_right=[1.0, 1.0])
ONE_SIDE = dataclasses.replace(paper_robots.nominal(), sides=jnp.asarray(1.0))


@pytest.mark.parametrize(
    "robot, told, says",
    [
        (ONE_SIDE, {"profile": TURNING}, "profile: got a robot of 1 side; expected sides = 2"),
        (mm.nominal(), {"profile": "patrol"}, "profile: got str; expected mmrjax.profile"),
        (mm.nominal(), {"profile": TURNING, "model": "steady"}, "model: got steady with a profile; expected drive"),
        (mm.nominal(), {"profile": TURNING, "duration": 3.0}, "duration: got 3.0 with a profile, whose last row"),
        (mm.nominal(), {"start": "rest"}, "start: got one without a profile"),
    ],
)
def test_profiles_in_python_are_refused_before_they_are_followed(robot, told, says):
    with pytest.raises(UsageError, match=says):
        mm.simulate(robot, mm.Conditions("6T2A"), **told)


def test_tables_have_no_negative_zero(robot):
    straight = mm.simulate(robot, mm.Conditions("6T2A", voltage=24, slope_deg=-1e-6))
    assert "-0" not in straight.table() and "0.00" in straight.table()
    table = {"slope_deg": np.array([-0.0]), "speed_mm_s": np.array([-0.01])}
    shown = run_tables.quantity_table("runs", table, table)
    assert [column.text(cell) for column, cell in zip(shown.columns, shown.rows[0], strict=True)] == ["0", "0.0"]


def test_a_path_between_places_that_turn_is_an_arc():
    """A quarter of a circle of 2 m, and a metre straight on, from three rows."""
    x, y, yaw = np.array([0.0, 2.0, 2.0]), np.array([0.0, 2.0, 3.0]), np.array([0.0, np.pi / 2, np.pi / 2])
    ahead, aside = mission_figures.path_arcs(x, y, yaw)
    assert_allclose(np.hypot(ahead[:-1], aside[:-1] - 2.0), 2.0, rtol=1e-12)
    assert np.max(np.diff(aside[:-1])) < 0.11 and (ahead[-1], aside[-1], len(ahead)) == (2.0, 3.0, 34)


@pytest.mark.parametrize("cycles", [3, 400])
def test_many_cycles_of_a_mission_are_drawn_as_their_envelope(cycles):
    """120 cycles made a solid block."""
    time = np.linspace(0.0, 60.0, 20_001)
    rows = {name: time for name in ("theoretical_speed_mm_s", "source_voltage_V", "motor_current_A", "duty")}
    swing = 2.0 + np.sin(2 * np.pi * cycles * time / 60)
    rows |= {"time_s": time, "slope_deg": 0 * time, "state_of_charge": np.nan * time, "motor_current_A": swing}
    fig = mission_figures.draw_mission_course(
        rows | {"demanded_speed_mm_s": time}, None, UNLIMITED, linear=False, sides=2.0
    )
    current = fig.axes[1]
    drawn_points = max(len(line.get_xdata()) for line in current.lines)
    assert (drawn_points == len(time)) == (cycles == 3) and bool(current.collections) == (cycles == 400)
    if cycles == 400:
        box = current.collections[0].get_paths()[0].get_extents()
        assert_allclose((box.y0, box.y1), (2.0, 6.0), rtol=0.02)  # of two motors, least to greatest
