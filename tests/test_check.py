"""Requirements: the paper's robot against the paper's aims, what would meet them, what is refused."""

import json
import math
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data.input_errors import BadConfiguration
from calibration.data.requirements_file import load_requirements, parse_requirements
from calibration.data.robot_file import change_robot
from calibration.sizing.sheet import check_requirements, fill_in_ratings, reject_impossible
from mmrjax.climbing import resting_posture
from mmrjax.derived.requirements import CUT_OFF, EnvelopePoint, evaluate_requirement, ratings, with_cells
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import CONVERGED, SLIDES, STALLED
from tests.commands import ROOT, command, read_json, schema_of

SCHEMA = schema_of("check")


def read(text):
    return parse_requirements(text, "r.toml")


def some_of_the_papers(*kept):
    """The paper's file with some of its aims, in the same envelope. Of the endurances that of standing still."""
    text = (ROOT / "calibration/data/aims/paper.toml").read_text("utf-8")
    head, envelope, tail = text.partition("[envelope]")
    lines = [line for line in head.splitlines() if line.partition(" ")[0] in ("schema", *kept)]
    if "standing" in kept:
        lines += ["endurance_min = [", *(line for line in head.splitlines() if 'duty = "standing"' in line), "]"]
    return "\n".join([*lines, envelope + tail])


@pytest.fixture(scope="module", params=["few", pytest.param("every", marks=pytest.mark.slow)])
def folder(request, tmp_path_factory):
    """What the command leaves of the paper's robot against the paper's aims, or few of them."""
    path = tmp_path_factory.mktemp("runs")
    (path / "few.toml").write_text(some_of_the_papers("speed_m_s", "mass_kg"), encoding="utf-8")
    assert command(["check", *([path / "few.toml"] if request.param == "few" else []), "--out", path / "check"]) == 0
    return path / "check"


@pytest.fixture(scope="module")
def values(folder):
    """The result of more aims. Where the folder lacks them, without what would change them."""
    found = read_json(folder / "result.json")
    if "winding_C" in {r["name"] for r in found["requirements"]}:
        return found
    path = folder.with_name("values")
    aims = some_of_the_papers("speed_m_s", "speed_end_of_charge_m_s", "mass_kg", "winding_C", "standing")
    path.with_suffix(".toml").write_text(aims, encoding="utf-8")
    assert command(["check", path.with_suffix(".toml"), "--no-changes", "--no-report", "--out", path]) == 0
    return read_json(path / "result.json")


@pytest.fixture(scope="module")
def result(folder):
    return read_json(folder / "result.json")


def row(result, name, k=0):
    return [r for r in result["requirements"] if r["name"] == name][k]


@pytest.mark.slow
def test_result_of_check_obeys_its_schema(result):
    jsonschema.validate(result, SCHEMA)
    assert result["met"] + result["missed"] == len(result["requirements"]) and result["missed"] > 0


@pytest.mark.slow
def test_papers_robot_misses_the_papers_aims(values):
    """0.95 m/s on a full battery, 2200 mAh with 1.5 A for other consumers last 88 minutes standing still."""
    speed, standing = row(values, "speed_m_s"), row(values, "endurance_min")
    assert not speed["met"] and speed["value"] == pytest.approx(0.95, abs=0.005)
    assert speed["at"] == {
        "configuration": "6T2A", "surface": "lacquered_wood", "payload_kg": 0.0, "slope_deg": 0.0,
        "state_of_charge": 1.0, "ambient_C": 25.0,
    }  # fmt: skip
    assert not standing["met"] and standing["value"] == pytest.approx(2.2 / 1.5 * 60, rel=1e-9)
    assert standing["margin"] == pytest.approx(88 - 180, rel=1e-9) and standing["at"]["duty"] == "standing"
    assert row(values, "mass_kg")["value"] == pytest.approx(13.1) and row(values, "mass_kg")["met"]
    for r in values["requirements"]:
        assert r["met"] == (r["margin"] is not None and r["margin"] >= 0)
        if r["value"] is not None:
            assert r["margin"] == pytest.approx((r["value"] - r["required"]) * (1 if r["sense"] == "least" else -1))


@pytest.mark.slow
def test_speed_is_that_of_steady(values, robot):
    for name, charge in (("speed_m_s", 1.0), ("speed_end_of_charge_m_s", 0.0)):
        discharge = float(robot.battery.capacity) * (1 - charge) * (1 - 1e-9)
        run = steady_batch(robot, Conditions(0, battery=1.0, discharge=[discharge]))
        assert row(values, name)["value"] == pytest.approx(float(run.speed[0]), rel=1e-7)


@pytest.mark.slow
def test_worst_corner_is_the_worst_of_a_finer_grid(values, robot):
    """The hottest winding of a grid four times finer is the sheet's."""
    found = row(values, "winding_C")
    capacity = float(robot.battery.capacity)
    axes = np.linspace(0, 8, 9), np.linspace(0, 10, 17), np.linspace(0, capacity * (1 - 1e-9), 17)
    payload, slope, discharge = (x.ravel() for x in np.meshgrid(*axes))
    runs = steady_batch(robot, Conditions(0, battery=1.0, payload=payload, slope_deg=slope, discharge=discharge))
    assert found["value"] == pytest.approx(float(np.max(runs.winding_settled)), rel=1e-7)
    assert found["at"]["payload_kg"] == 8 and found["at"]["slope_deg"] == 10


@pytest.mark.slow
def test_every_change_meets_its_requirement_and_breaks_what_it_says(folder, result, robot):
    """Each stated value, put into the robot as `--set` does, and checked anew, and half of the change does not."""
    asked, rows, tried = load_requirements(folder / "requirements.toml"), result["requirements"], 0

    def met(name, value, requirements=asked):
        changed = change_robot(robot, {name: value}, "test")
        return [o.met for o in check_requirements(changed, requirements, changes=False)]

    for k, r in enumerate(rows):
        assert bool(r["change"]) <= (not r["met"])
        for c in r["change"]:
            after = met(c["parameter"], c["to"])
            assert after[k], (r["name"], c)
            broken = {x["name"] for x, still in zip(rows, after, strict=True) if x["met"] and not still}
            assert broken == set(c["breaks"]), (r["name"], c)
            less = 1 if c["parameter"] == "battery.cells" else 0.002 * c["to"]
            near = c["to"] - math.copysign(less, c["to"] - c["from"])
            assert met(c["parameter"], near, replace(asked, each=(asked.each[k],))) == [False], (r["name"], c, near)
            tried += 1
    assert tried > (8 if len(rows) > 5 else 1)


def point(**given):
    usual = {
        "configuration": 0, "adhesion": 1.0, "adhesion_lateral": 1.0, "battery": 1.0, "charge": 1.0, "charge_end": 0.0, "share": 0.0,
        "slope_deg": 0.0, "payload": 0.0, "ambient": 25.0, "tread": 0.29,
    }  # fmt: skip
    return EnvelopePoint(
        **{k: jnp.asarray(v, int if k == "configuration" else float) for k, v in {**usual, **given}.items()}
    )


def test_a_robot_slides_or_tips_across_a_slope(robot):
    def side(robot, **given):
        return float(evaluate_requirement(robot, point(**given), ratings(robot), "side_slope_deg")[0])

    chassis = robot.configurations["6T2A"]
    friction, rolling = float(chassis.ground.friction.static), float(chassis.ground.rolling_resistance)
    across = friction * float(chassis.turning.lateral) * math.sqrt(1 - (rolling / friction) ** 2)
    assert side(robot) == pytest.approx(math.degrees(math.atan(across)), rel=1e-12)
    assert side(robot, adhesion_lateral=0.5) == pytest.approx(math.degrees(math.atan(across / 2)), rel=0.02)
    narrow = params.replace(robot, {"6T2A.turning.width": 0.03})
    tall = side(narrow, payload=8.0)
    assert tall < side(robot)  # it tips before it slides
    assert tall == pytest.approx(side(params.replace(narrow, {"6T2A.turning.lateral": 9.0}), payload=8.0))


@pytest.mark.slow
@pytest.mark.parametrize("name, left", [("turn_in_place_rad_s", -1.0), ("turning_radius_mm", 0.0)])
def test_turns_that_are_asked_for_are_those_that_settle(robot, name, left):
    value, outcome = evaluate_requirement(robot, point(battery=0.0, charge=24.0, payload=3.0), ratings(robot), name)
    runs = Conditions([0], voltage=24.0, payload=3.0, duty_left=left, duty_right=1.0).resolved(robot)
    reading = steady_batch(robot, runs).reading
    rate, *rolls = (float(reading[name][0]) for name in ("yaw_rate", "speed", "lateral_speed"))
    assert_allclose(value, rate if left else abs(math.hypot(*rolls) / rate), rtol=1e-6)
    assert int(outcome) == CONVERGED


def test_cells_as_a_number_are_the_batterys_cells(robot):
    other = replace(robot, battery=replace(robot.battery, cells=11))
    for current, discharge in ((0.0, 0.0), (5.0, 4000.0)):
        assert with_cells(robot, 11.0).battery.voltage(current, discharge) == pytest.approx(
            float(other.battery.voltage(current, discharge)), rel=1e-12
        )


@pytest.mark.slow
def test_endurance_is_the_integral_over_the_charge(robot):
    """Against the trapezoidal rule over 2000 operating points."""
    at = point(share=0.5)
    value, outcome = eqx.filter_jit(evaluate_requirement)(robot, at, ratings(robot), "endurance_min")
    charge = np.linspace(0, float(robot.battery.capacity) * (1 - 1e-9), 2001)
    runs = steady_batch(robot, Conditions(0, battery=1.0, discharge=charge))
    flowing = 0.5 * np.asarray(runs.total_current) + 1.5
    cell = np.asarray(robot.battery.voltage_cell(runs.total_current, jnp.asarray(charge)))
    use = cell >= robot.battery.voltage_cutoff
    assert_allclose(value, np.trapezoid(1 / flowing[use], charge[use]), rtol=1e-4)
    assert int(outcome) == CONVERGED


@pytest.mark.slow
def test_points_without_value_are_missed(robot, tmp_path):
    """What slides or stalls has no value: missed, with its status, and no NaN in the result."""
    _, outcome = evaluate_requirement(robot, point(slope_deg=16.0), ratings(robot), "speed_m_s")
    assert int(outcome) == SLIDES
    weak = params.replace(robot, {"gearbox.ratio": 2.0})
    assert int(evaluate_requirement(weak, point(slope_deg=10.0), ratings(weak), "speed_m_s")[1]) == STALLED
    low = replace(robot, battery=replace(robot.battery, voltage_cutoff=3.4))
    assert int(evaluate_requirement(low, point(charge=0.0), ratings(low), "speed_m_s")[1]) == CUT_OFF
    file = tmp_path / "steep.toml"
    file.write_text("speed_m_s = 0.5\nwinding_C = 100\n[envelope]\nslope_deg = [0, 16]\n")
    assert command(["check", file, "--out", tmp_path / "run", "--no-changes", "--no-report"]) == 0
    text = (tmp_path / "run/result.json").read_text()
    jsonschema.validate(found := json.loads(text), SCHEMA)
    for r in found["requirements"]:
        assert not r["met"] and r["value"] is None and r["status"] == "slides" and r["at"]["slope_deg"] == 16
    assert "NaN" not in text and "nan" not in (tmp_path / "run/requirements.csv").read_text()


REFUSED = {
    "": r"^r.toml: contains no requirement; expected one of speed_m_s, ",
    "[envelope]\npayload_kg = 3": r"^r.toml: contains no requirement",
    "speed = 1.0": r"^r.toml, speed: no such key; did you mean speed_m_s\?",
    "endurance_h = 3": r"^r.toml, endurance_h: no such key; did you mean endurance_min\?",
    "speed_km_h = 3.6": r"^r.toml, speed_km_h: no such key; did you mean speed_m_s\?",
    "speeed_m_s = 1": r"^r.toml, speeed_m_s: no such key; did you mean speed_m_s\? allowed: speed_m_s, ",
    "speed_m_s = nan": r"^r.toml, speed_m_s: got nan; expected 0 to 1e\+06 m/s$",
    "side_slope_deg = 95": r"^r.toml, side_slope_deg: got 95; expected 0 to 45 deg$",
    "slope_deg = 95": r"^r.toml, slope_deg: got 95; expected 0 to 45 deg$",
    "speed_m_s = -1": r"^r.toml, speed_m_s: got -1; expected 0 to 1e\+06 m/s$",
    'speed_m_s = "1 m/s"': r"^r.toml, speed_m_s: got '1 m/s'; expected a number \[m/s\]$",
    "speed_m_s = 'rated'": r"^r.toml, speed_m_s: got 'rated'; expected a number; only winding_C, ",
    "speed_m_s = true": r"^r.toml, speed_m_s: got True; expected a number \[m/s\]$",
    "speed_m_s = []": r"^r.toml, speed_m_s: got an empty list; expected ",
    "speed_m_s = {slope_deg = 3}": r"^r.toml, speed_m_s: expected least, most or both \[m/s\]$",
    "speed_m_s = {least = 1, slope = 3}": r"^r.toml, speed_m_s, slope: no such key; did you mean slope_deg\?",
    "speed_m_s = {least = 1, duty = 'driving'}": r"^r.toml, speed_m_s: duty and share can be used only with endurance_min$",
    "endurance_min = {least = 1, duty = 'dancing'}": r"^r.toml, endurance_min, duty: got 'dancing'; did you mean standing\? allowed: standing, driving$",
    "endurance_min = {least = 1, duty = 'standing', share = 0.2}": r"duty standing and a share of 0.2 contradict each other$",
    "speed_m_s = 1\n[envelope]\npayload_kg = [8, 0]": r"^r.toml, envelope.payload_kg: got \[8, 0\], an empty range; expected ",
    "speed_m_s = 1\n[envelope]\npayload_kg = []": r"^r.toml, envelope.payload_kg: got \[\]; expected a number or ",
    "speed_m_s = 1\n[envelope]\npayload = 3": r"^r.toml, envelope, payload: no such key; did you mean payload_kg\?",
    "speed_m_s = 1\n[envelope]\nslope_deg = 80": r"^r.toml, envelope.slope_deg: got 80; expected 0 to 45 deg$",
    "speed_m_s = 1\n[envelope]\nstate_of_charge = 50": r"^r.toml, envelope.state_of_charge: got 50; expected 0 to 1$",
    "speed_m_s = 1\n[envelope]\nambient_C = nan": r"^r.toml, envelope.ambient_C: got nan; expected -50 to 80 °C$",
    "speed_m_s = 1\n[envelope]\nsurface = 'ice'": r"^r.toml, envelope.surface: got 'ice'; allowed: linoleum, ",
    "speed_m_s = 1\n[envelope]\nbattery = 1": r"^r.toml, envelope.battery: got 1; expected true or false$",
    "speed_m_s = 1\n[envelope]\nbattery = false": r"^r.toml, envelope: battery = false needs supply_voltage_V, ",
    "speed_m_s = 1\n[envelope]\nbattery = true\nsupply_voltage_V = 24": r"^r.toml, envelope: battery and supply_voltage_V contradict ",
    "speed_m_s = 1\n[envelope]\nstate_of_charge = 1\nsupply_voltage_V = 24": r"^r.toml, envelope: state_of_charge and supply_voltage_V contradict",
    "endurance_min = 9\n[envelope]\nsupply_voltage_V = 24": r"^r.toml, endurance_min: endurance needs the battery, ",
    "speed_m_s = {least = 1.2, most = 1}": r"^r.toml: speed_m_s at least 1.2 m/s and speed_m_s at most 1 m/s contradict each other$",
    "speed_m_s = {most = 1}\nspeed_end_of_charge_m_s = 1.1\n[envelope]\nstate_of_charge = [0, 1]": r"^r.toml: speed_end_of_charge_m_s at least 1.1 m/s and speed_m_s at most 1 m/s contradict",
    "payload_kg = 5\n[envelope]\npayload_kg = [0, 8]": r"^r.toml: payload_kg of at least 5 contradicts the envelope, whose payload_kg goes up to 8$",
    "slope_deg = 5\n[envelope]\nslope_deg = [0, 8]": r"^r.toml: slope_deg of at least 5 contradicts the envelope, whose slope_deg goes up to 8$",
    "winding_C = 30\n[envelope]\nambient_C = [0, 40]": r"^r.toml: winding_C of at most 30 contradicts the envelope, whose ambient_C goes up to 40$",
    "envelope = 3\nspeed_m_s = 1": r"^r.toml, envelope: got 3; expected a table of configuration, ",
    "speed_m_s = ": r"^r.toml: not a readable TOML file \(",
    "stairs_rise_mm = 170": "stairs_rise_mm: stairs without a tread; expected a table such as",
    "step_mm = { least = 100, tread_mm = 290 }": "step_mm, tread_mm: no such key",
    "schema = 'mmrjax.requirements/9'": r"^r.toml, schema: got 'mmrjax.requirements/9'; expected mmrjax.requirements/1$",
}


@pytest.mark.parametrize("text", REFUSED)
def test_wrong_file_is_refused_in_a_sentence(text):
    with pytest.raises(BadConfiguration, match=REFUSED[text]) as error:
        read(text)
    assert "\n" not in str(error.value)


def test_a_surface_that_holds_the_robot_is_let_pass(robot):
    reject_impossible(robot, read('speed_m_s = 1\n[envelope]\nslope_deg = 20\nsurface = "concrete"'))


def test_rated_is_what_the_parts_permit(robot):
    asked = fill_in_ratings(robot, read("winding_C = 'rated'\nmotor_speed_rpm = { most = 'rated' }"))
    assert [r.limit for r in asked.each] == pytest.approx([125.0, 12000.0])
    robot = replace(robot, gearbox=replace(robot.gearbox, torque_limit=None))
    with pytest.raises(BadConfiguration, match=r"^r.toml, gearbox_Nm: the robot states no rating; state a number$"):
        fill_in_ratings(robot, read("gearbox_Nm = 'rated'"))


def test_contradictions_are_those_of_one_use():
    """Elsewhere in the envelope other limits may hold."""
    asked = read("speed_m_s = [{ least = 1, slope_deg = 0 }, { most = 0.8, slope_deg = 10 }]")
    assert [r.sense for r in asked.each] == ["least", "most"]
    asked = read("payload_kg = 8\nslope_deg = 8\n[envelope]\npayload_kg = [0, 8]\nslope_deg = [0, 8]")
    assert len(asked.each) == 2


OF_POSTURE = """
step_mm = 300
gap_mm = { least = 300, payload_kg = 0 }
length_mm = 400
height_mm = 100
[envelope]
payload_kg = [0, 8]
"""


@pytest.mark.slow
def test_steps_and_sizes_of_section_2_2(robot):
    """300 mm no posture allows, 400 and 100 mm hold."""
    asked = read(OF_POSTURE)
    found = {o.requirement.name: o for o in check_requirements(robot, asked, changes=False)}
    limits = {"step_mm": 245.6, "gap_mm": 352.7, "length_mm": 387.4, "height_mm": 87.4}
    assert {name: found[name].value for name in limits} == pytest.approx(limits, abs=0.1)
    assert [name for name, o in found.items() if not o.met] == ["step_mm"]
    assert found["step_mm"].at["payload_kg"] == 8


@pytest.mark.slow
def test_stairs_need_friction_reach_and_a_tread(robot):
    """A flat belt holds up to its friction. On asphalt its length decides."""

    def rise(surface):
        text = f'stairs_rise_mm = {{ least = 170, tread_mm = 290, surface = "{surface}" }}'
        (found,) = check_requirements(robot, read(text), changes=False)
        assert found.at["tread_mm"] == 290 and not found.met
        return found.value

    friction = float(robot.configurations["6T2A"].ground.friction.static)
    assert rise("lacquered_wood") == pytest.approx(290 * friction, rel=1e-6)
    rests = resting_posture.level_posture(robot, Conditions(0, levers_front_deg=-8.4707, levers_rear_deg=-8.4707))
    reach, high = float(rests.length) / 2, float(rests.centre_height)
    angle = math.atan(rise("asphalt") / 290)
    assert reach - high * math.tan(angle) == pytest.approx(0.29 / math.cos(angle), abs=1e-4)


def test_posture_of_a_robot_that_states_no_running_gear_is_not_known(robot):
    gear = tuple(p.name for p in params.walk_parameters(robot) if p.name.startswith("running_gear."))
    bare = replace(robot, rig=replace(robot.rig, unknown=gear))
    with pytest.raises(BadConfiguration, match="step_mm: the robot's file has no running_gear"):
        reject_impossible(bare, read("step_mm = 100"))
