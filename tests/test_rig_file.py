"""Rig files: the templates read, loads are converted, what is written reads back, and one sentence for each mistake."""

import dataclasses
import json
import math
import re

import equinox as eqx
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import configuration_tables, rig_facts, rig_file, robot_file, stated
from calibration.data.input_errors import BadConfiguration
from calibration.inference import priors
from calibration.sensitivity import uncertain_inputs
from mmrjax import effects
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.rig import Instrument
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import GRAVITY
from sweeps.commands import rig_check, rig_new
from sweeps.report.terminal_renderer import print_document
from tests.commands import ROOT, ends, read_rig, refused
from tests.pages import as_text, recorded, tokens

KINDS = tuple(rig_new.KINDS)


def again(tmp_path, robot):
    robot_file.write_robot(robot, tmp_path / "again.toml", note="of a test")
    return robot_file.read_robot(tmp_path / "again.toml")


def survives(tmp_path, robot):
    """Whether a robot is written and read again with its leaves, structure, names and rig."""
    return bool(eqx.tree_equal(again(tmp_path, robot), robot))


BENCH = """
base = "none"
imposed = "motor_speed"
channels = ["total_current"]
[motor]
torque_constant = "0.05 ± 4 %"
[gearbox]
ratio = 16
efficiency_load = "0.8 +- 0.03"
[bench]
load = "shaft"
inertia = 0.001
loss_coulomb = "0.1 ± 0.05"
"""

ROVER = """
base = "none"
sides = 2
[motor]
torque_constant = 0.05
resistance = 1.0
[gearbox]
ratio = 16
efficiency_load = 0.8
[rover]
load = "vehicle"
mass = 4.0
radius = 0.04
[rover.ground]
rolling_resistance = 0.02
[rover.ground.friction]
static = 0.5
"""

CARRIAGE = """
base = "none"
sides = {sides}
[motor]
torque_constant = 0.05
resistance = 1.0
[gearbox]
ratio = 4
efficiency_load = 0.8
[carriage]
load = "linear"
"""


@pytest.mark.parametrize("kind", KINDS)
def test_template_reads_as_written_and_back(tmp_path, kind):
    robot = read_rig(tmp_path, rig_new.rig_template(kind))
    assert not robot.rig.inherits and robot.rig.priors and robot.has_ground == (kind in ("tracked", "wheeled"))
    assert survives(tmp_path, robot)


@pytest.mark.quick(2)
@pytest.mark.parametrize("kind", KINDS)
def test_every_line_of_a_template_that_is_commented_out_reads(tmp_path, kind):
    """Each example line, and the table that it stands in, is valid where its comment sign is taken away."""
    lines = rig_new.rig_template(kind).splitlines()
    tables = {"# [columns]", "# [rig]", "# [driver]"}
    stance = (
        lines.index("# [rover.turning]") if "# [rover.turning]" in lines else len(lines)
    )  # to the end, as a whole
    read_rig(tmp_path, "\n".join(x.removeprefix("# ") if j >= stance else x for j, x in enumerate(lines)))
    for k, line in enumerate(lines):
        if not line.startswith("# ") or " = " not in line or "OURS" in line or k > stance:
            continue
        key = line[2:].split(" = ")[0]
        if not key.isidentifier() or key in ("drum_radius_mm",):
            continue
        open_ = [lines[j] for j in range(k) if lines[j] in tables or lines[j].startswith("# [instruments")]
        head = max((j for j in range(k) if lines[j] in open_), default=None)
        last = max((j for j in range(k) if lines[j].startswith("[")), default=-1)
        chosen = {k, *([head] if head is not None and head > last else [])}
        text = "\n".join(x[2:] if j in chosen else x for j, x in enumerate(lines))
        read_rig(tmp_path, text)


def test_bench_is_what_its_file_states(tmp_path):
    robot = read_rig(tmp_path, BENCH)
    assert (robot.rig.imposed, robot.rig.channels, float(robot.sides)) == ("motor_speed", ("total_current",), 1.0)
    assert robot.rig.priors == (
        ("motor.torque_constant", 0.05, 0.002),
        ("gearbox.efficiency_load", 0.8, 0.03),
        ("bench.loss_coulomb", 0.1, 0.05),
    )
    zero = ("motor.friction_coulomb", "motor.friction_viscous", "gearbox.friction_coulomb", "bench.loss_viscous")
    known = {p.name: float(p.value) for p in params.walk_parameters(robot)}
    assert [known[name] for name in zero] == [0.0] * 4 and known["bench.radius"] == 1.0
    assert robot.gearbox.torque_limit is None and robot.motor.speed_limit > 1e8


def test_rig_of_everything_is_written_and_read_the_same(tmp_path):
    robot = read_rig(
        tmp_path,
        BENCH.replace(
            'channels = ["total_current"]',
            'channels = ["total_current", "output_speed", "motor_voltage"]\nstart = "measured"',
        ).replace("[motor]", "[motor]\nresistance = 2.0\nspeed_limit = 500.0\nvoltage_limit = 24.0")
        + """
[slow]
load = "shaft"
inertia = 0.002
loss_coulomb = 0.3
torque_constant = -0.2
[rig]
delay = "0.01 ± 0.005"
[battery]
cells = 3
resistance = 0.02
[driver]
returns_current = false
[columns]
total_current_A = {column = "I", factor = 0.001}
surface = "floor"
motor_speed_rad_s = "w"
time_ms = "t"
[instruments.total_current]
signed = false
quantum = 0.026
[instruments.output_speed]
quantum = 0.5
[effects.churning]
amplitude = 1e-4
""",
    )  # fmt: skip
    assert robot.configurations.names == ("bench", "slow")
    assert robot.rig.columns == (
        ("total_current_A", "I", 0.001),
        ("surface", "floor", 1.0),
        ("motor_speed_rad_s", "w", 1.0),
        ("time_ms", "t", 1.0),
    )
    assert robot.rig.instruments == (
        Instrument("total_current", False, 0.026),
        Instrument("output_speed", True, 0.5 * math.pi / 30),
    )
    assert survives(tmp_path, robot)


def test_written_rig_keeps_the_prior_of_what_a_fit_left_alone(tmp_path):
    robot = params.replace(read_rig(tmp_path, BENCH), {"motor.torque_constant": params.as_float(0.052)})
    back = again(tmp_path, robot)
    assert back.motor.torque_constant == 0.052
    assert [name for name, _, _ in back.rig.priors] == ["gearbox.efficiency_load", "bench.loss_coulomb"]


def test_nominal_robot_with_a_rig_of_its_own_is_read_back(tmp_path):
    robot = read_rig(tmp_path, 'imposed = "motor_speed"\n[6T2A]\nmass = "12 ± 1 %"\n')
    assert robot.rig.channels == ("total_current", "speed") and robot.rig.inherits
    assert robot.rig.priors == (("6T2A.mass", 12.0, 0.12),)
    assert survives(tmp_path, robot)


def test_nominal_drive_on_a_bench(tmp_path):
    robot = read_rig(tmp_path, 'configurations = ["b"]\n[b]\nload = "shaft"\ninertia = 0.01\nloss_coulomb = 0.1\n')
    assert (
        not robot.has_ground
        and robot.motor.resistance == 0.611
        and robot.rig.channels == ("total_current", "motor_speed")
    )
    assert survives(tmp_path, robot)


@pytest.mark.parametrize("sides", [1, 2])
@pytest.mark.parametrize("travel, radius", [("lead_mm = 5.0", 5e-3 / (2 * math.pi)), ("drum_radius_mm = 20.0", 0.02)])
def test_linear_unit_is_a_shaft(tmp_path, travel, radius, sides):
    text = (
        CARRIAGE.format(sides=sides)
        + f"mass_kg = 2.5\n{travel}\nforce_coulomb_N = 12.0\nforce_viscous_N_s_m = 40.0\n"
    )
    robot = read_rig(tmp_path, text + "force_constant_N = 3.0\nincline_deg = 30.0\ninertia = 1e-5\n")
    load = robot.configurations["carriage"]
    found = [
        float(x) for x in (load.radius, load.inertia, load.loss_coulomb, load.loss_viscous, load.torque_constant)
    ]
    weight = 2.5 * GRAVITY * 0.5
    forces = [12.0 * radius / sides, 40.0 * radius**2 / sides, (3.0 + weight) * radius / sides]
    assert_allclose(found, [radius, 1e-5 + 2.5 * radius**2 / sides, *forces], rtol=1e-12)
    assert "speed" in robot.rig.channels
    assert survives(tmp_path, robot)


def test_sds_of_a_linear_unit_are_those_of_its_shaft(tmp_path):
    """J = m (p / 2π)²: relative variances add, that of the lead fourfold."""
    robot = read_rig(tmp_path, CARRIAGE.format(sides=1) + 'mass_kg = "2.5 ± 2 %"\nlead_mm = "5.0 ± 0.01 %"\n')
    priors = {name: (mean, sd) for name, mean, sd in robot.rig.priors}
    mean, sd = priors["carriage.inertia"]
    assert mean == pytest.approx(2.5 * (5e-3 / (2 * math.pi)) ** 2, rel=1e-12)
    assert sd / mean == pytest.approx(math.hypot(0.02, 0.0002), rel=1e-3)
    assert priors["carriage.radius"][1] / priors["carriage.radius"][0] == pytest.approx(1e-4, rel=1e-9)


def test_like_names_another_load_of_the_file(tmp_path):
    robot = read_rig(tmp_path, BENCH + '[heavy]\nlike = "bench"\ninertia = 0.01\n')
    assert robot.configurations.names == ("bench", "heavy")
    assert float(robot.configurations["heavy"].loss_coulomb) == 0.1
    assert float(robot.configurations["heavy"].inertia) == 0.01
    assert ("heavy.loss_coulomb", 0.1, 0.05) in robot.rig.priors


def test_changed_parameter_takes_its_prior_along(tmp_path):
    robot = robot_file.change_robot(read_rig(tmp_path, BENCH), {"motor.torque_constant": 0.06}, where="--set")
    assert robot.rig.priors[0] == ("motor.torque_constant", 0.06, 0.002)


def test_what_is_known_exactly_is_never_freed(tmp_path):
    lifted = BENCH.replace('["total_current"]', '["total_current", "speed"]') + 'radius = "0.02 ± 0"\n'
    robot = read_rig(tmp_path, lifted)
    assert robot.rig.exact == {"bench.radius"} and survives(tmp_path, robot)
    unsure = read_rig(tmp_path, lifted.replace("0.02 ± 0", "0.02 ± 1 %"))
    freed, held = (priors.loop_parameter_names(r, ["bench"]) for r in (unsure, robot))
    assert set(freed) - set(held) == {"bench.radius"}
    dry = read_rig(tmp_path, BENCH.replace("0.1 ± 0.05", "0.1 ± 0"))
    assert "bench.loss_coulomb" not in (
        *priors.default_names(["bench"], dry),
        *priors.loop_parameter_names(dry, ["bench"]),
    )
    assert "bench.radius" not in uncertain_inputs.default_input_names(robot, ["bench"], battery=False)
    with refused(r"--free bench\.radius: the robot's file states ± 0", BadConfiguration):
        priors.parameter_coordinates(robot, ["bench.radius"])
    assert len(priors.parameter_coordinates(robot, ["bench.radius"], {"bench.radius": (0.02, 0.001)})) == 1


def test_inductance_that_is_not_stated_follows_the_resistance(tmp_path):
    robot = read_rig(tmp_path, ROVER.replace("resistance = 1.0", "resistance = 3.0"))
    assert robot.motor.inductance == pytest.approx(6e-4, rel=1e-12)
    assert survives(tmp_path, robot)
    found = {o.name: o for o in rig_facts.number_origins(robot_file.parse_robot_file(tmp_path / "rig.toml"))}
    assert found["motor.inductance"].why == "not stated: assumed, 0.2 ms of the resistance"
    stated = read_rig(tmp_path, ROVER.replace("[gearbox]", "inductance = 1e-3\n[gearbox]"))
    assert stated.motor.inductance == 1e-3


def test_wheels_lose_nothing_that_is_not_stated_and_tracks_have_to_state_it(tmp_path):
    robot = read_rig(tmp_path, ROVER)
    track, friction = robot.configurations["rover"].track, robot.configurations["rover"].ground.friction
    assert [float(x) for x in (track.loss_coulomb, track.loss_viscous, track.guide_share)] == [0.0, 0.0, 0.0]
    assert friction.dynamic == pytest.approx(0.4)
    with refused(r"rover\.track\.loss_coulomb \[N·m\] is missing", BadConfiguration):
        read_rig(tmp_path, ROVER.replace('load = "vehicle"', 'movers = "tracks"'))


def test_wheels_whose_inertia_is_not_stated_are_disks_of_a_share_of_the_mass(tmp_path):
    """Over time a shaft without any would have no law, and runs of such a robot `failed`."""
    robot = read_rig(tmp_path, ROVER)
    assert float(robot.configurations["rover"].inertia) == pytest.approx(0.5 * 0.05 * 4.0 * 0.04**2 / 2, rel=1e-12)
    assert survives(tmp_path, robot)
    (tmp_path / "rover.toml").write_text(ROVER, encoding="utf-8")
    found = {o.name: o for o in rig_facts.number_origins(robot_file.parse_robot_file(tmp_path / "rover.toml"))}
    assert found["rover.inertia"].why == "not stated: assumed, disk wheels with 5 % of the mass"
    stated = read_rig(tmp_path, ROVER.replace("radius = 0.04", "radius = 0.04\ninertia = 0.003"))
    assert float(stated.configurations["rover"].inertia) == 0.003


def test_a_robot_that_turns_states_its_wheelbase_and_is_written_with_it(tmp_path):
    turns = f"{ROVER}[rover.turning]\nwidth = 0.3\ninertia = 0.2\n"
    with refused(r"running_gear\.wheelbase \[m\] is missing; a robot with base", BadConfiguration):
        read_rig(tmp_path, turns)
    usual = float(read_rig(tmp_path, ROVER).running_gear.wheelbase)  # an example's
    robot = read_rig(tmp_path, f"{turns}[running_gear]\nwheelbase = {usual}\n")
    assert survives(tmp_path, robot)
    (tmp_path / "turns.toml").write_text(f"{turns}[running_gear]\nwheelbase = 0.4\n", encoding="utf-8")
    (height,) = [
        o
        for o in rig_facts.number_origins(robot_file.parse_robot_file(tmp_path / "turns.toml"))
        if "centre_height" in o.name
    ]
    assert "an example value" in height.why


def without(text, *keys):
    return "\n".join(line for line in text.splitlines() if line.partition(" =")[0] not in keys)


def test_packaged_robot_is_as_it_was(tmp_path, robot):
    robot = robot_file.add_effects(robot, tuple(effects.BY_NAME))
    assert survives(tmp_path, robot) and "[rig]" not in (tmp_path / "again.toml").read_text()


# --- from the command line ------------------------------------------------------------------------------


def test_rig_new_keeps_a_file_unless_forced(mmrjax, tmp_path):
    (tmp_path / "my-rig.toml").write_text("mine")
    ends(mmrjax("rig new my-rig.toml"), "my-rig.toml: already exists; --force replaces it")
    assert (tmp_path / "my-rig.toml").read_text() == "mine"
    ends(mmrjax("rig new my-rig.toml --force --kind pendulum"), "mmrjax rig check my-rig.toml", code=0)
    robot = robot_file.load_robot(str(tmp_path / "my-rig.toml"))
    assert robot.configurations.names == ("arm",) and not robot.rig.inherits


@pytest.mark.parametrize("kind", KINDS)
def test_an_examples_number_is_wide_until_it_is_replaced(tmp_path, kind):
    """A template's number is of another robot: within ± 5 % of it, a fit of this one would need an effect."""
    text = rig_new.rig_template(kind)
    priors = {name: (mean, sd) for name, mean, sd in read_rig(tmp_path, text).rig.priors}
    wide = {name for name in stated.example_numbers(text) if priors.get(name, (0.0, 0.0))[1] > 0}
    assert "motor.torque_constant" in wide and not wide & {"gearbox.ratio"}
    assert all(sd >= 2.99 * mean and sd > 0 for mean, sd in (priors[name] for name in wide))
    line = next(x for x in text.splitlines() if x.startswith("torque_constant"))
    value, sd = re.search(r'"(.*) ± (\d+) %"', line).groups()
    replaced = read_rig(tmp_path, text.replace(line, line.replace(value, f"{float(value) * 1.1:.6g}"))).rig.priors
    mean, own = next((mean, sd) for name, mean, sd in replaced if name == "motor.torque_constant")
    assert own == pytest.approx(mean * float(sd) / 100)


def test_a_fit_says_which_numbers_are_a_templates(mmrjax, tmp_path):
    text = rig_new.rig_template("bench").replace('"2.0 ± 5 %"', '"2.2 ± 5 %"')
    (tmp_path / "rig.toml").write_text(text)
    _, _, err = ends(mmrjax("calibrate measured --robot rig.toml --out c"), code=4)
    assert "rig.toml: still example numbers of the template: motor.torque_constant, " in err
    assert "motor.resistance" not in err


@pytest.fixture
def bench(mmrjax, tmp_path):
    """A bench as its template has it, and a table of it with sds, in mA."""
    mmrjax("rig new my-rig.toml")
    robot = robot_file.load_robot(str(tmp_path / "my-rig.toml"))
    voltage = np.linspace(3.0, 24.0, 12)
    seen = steady_batch(robot, Conditions(voltage=voltage))
    rows = zip(voltage, np.asarray(seen.total_current) * 1e3, np.asarray(seen.motor_speed) * 30 / np.pi, strict=True)
    lines = ["supply_voltage_V,total_current_mA,motor_speed_rpm,output_torque_Nm,room"]
    lines += [f"{u:.6g},{i:.6g},{n:.6g},0,{k % 2}" for k, (u, i, n) in enumerate(rows)]
    (tmp_path / "runs.csv").write_text("\n".join(lines) + "\n")
    return robot


@pytest.mark.slow
def test_rig_check_says_what_a_table_can_determine(mmrjax, bench):
    """Friction of motor and load act alike on current and speed, as does the gear's loss. All have one wide prior."""
    _, out, _ = ends(mmrjax("rig check my-rig.toml runs.csv --json"), code=0)
    found = json.loads(out)
    assert found["schema"] == "mmrjax.rig_check/1" and found["data"]["rows"] == 12
    columns = {c["column"]: c for c in found["data"]["columns"]}
    assert columns["total_current_A"]["theirs"] == "total_current_mA"
    assert columns["supply_voltage_V"]["use"] == "imposed" and "slope_deg" not in columns
    assert columns["supply_voltage_V"]["least"] == 3.0 and columns["supply_voltage_V"]["greatest"] == 24.0
    assert [s.split(":")[0] for s in found["data"]["unused"]] == ["output_torque_Nm", "room"]
    shares = {p["name"]: p["share"] for p in found["data"]["parameters"]}
    held = {p["name"] for p in found["data"]["parameters"] if p["held"]}
    assert held == {"motor.friction_coulomb", "motor.friction_viscous"}
    assert shares.pop("motor.resistance") < 0.01 > shares.pop("motor.torque_constant")
    # Only the sums of the dry and of the viscous losses are determined, at the motor f + l / (i η).
    sums = np.array([[0.0015, 0, -1 / 300, 1 / 300, 0], [0, 5e-7, -1 / 3e5, 0, 1 / 3e5]])
    left = np.eye(5) - np.linalg.pinv(sums) @ sums
    assert_allclose([*shares.values()], np.sqrt(np.diag(left)), atol=0.01)
    assert "are not determined by these runs" in found["statement"]


def test_a_rig_check_reads_as_recorded(tmp_path, bench, capsys):
    """The document of a file alone, and that of a file and its data, whole and as a terminal shows it."""
    text = ""
    for data in (None, str(tmp_path / "runs.csv")):
        document = rig_check.check_document(rig_check.examine_rig_file(tmp_path / "my-rig.toml", data))
        print_document(document, brief=True)
        text += f"{as_text(document)}# TERMINAL\n{capsys.readouterr().out}"
    (words_now, numbers_now), (words_then, numbers_then) = tokens(text), tokens(recorded("rig_check", text))
    assert words_now == words_then and numbers_now == pytest.approx(numbers_then, rel=1e-2, abs=1e-2)


ODD = {
    "constant in mN·m/A": ("torque_constant = 0.05", "torque_constant = 5.0", "is torque_constant in N·m/A?"),
    "efficient stages": (
        "ratio = 16",
        "ratio = 300",
        "an efficiency of 0.9 is high for three or more stages",
    ),
    "nothing geared": (
        "ratio = 16\nefficiency_load = 0.9",
        "ratio = 1\nefficiency_load = 0.5",
        "Is the ratio missing?",
    ),
    "stuck": ("loss_coulomb = 0.1", "loss_coulomb = 40.0", "above the stall current 12 A at 12 V, so it cannot move"),
    "rotor in g·cm²": ("[gearbox]", "inertia = 0.02\n[gearbox]", "check motor.inertia (1 g·cm² is 1e-7 kg·m²)"),
    "voltage beyond the speed": (
        "voltage_limit = 12.0",
        "voltage_limit = 120.0",
        "more than twice motor.speed_limit",
    ),
}
SOUND = """
base = "none"
[motor]
torque_constant = 0.05
resistance = 1.0
friction_coulomb = 0.002
voltage_limit = 12.0
speed_limit = 500.0
[gearbox]
ratio = 16
efficiency_load = 0.9
[bench]
load = "shaft"
inertia = 0.001
loss_coulomb = 0.1
"""


@pytest.mark.parametrize("case", ODD)
def test_facts_say_which_number_to_look_at(tmp_path, case):
    stated, instead, sentence = ODD[case]
    assert not [f for f in rig_facts.derived_facts(read_rig(tmp_path, SOUND)) if f.odd] and stated in SOUND
    odd = [f.odd for f in rig_facts.derived_facts(read_rig(tmp_path, SOUND.replace(stated, instead))) if f.odd]
    assert any(sentence in text for text in odd)


def test_facts_of_an_arm_and_a_vehicle_by_hand(tmp_path):
    arm = read_rig(tmp_path, SOUND + "torque_gravity = 0.5\n")
    found = {f.what: f for f in rig_facts.derived_facts(arm)}
    assert found["bench: length of a pendulum with the same period"].value == f"{1e3 * 0.001 * GRAVITY / 0.5:.3g} mm"
    current = (0.6 / (16 * 0.9) + 0.002) / 0.05
    assert found["bench: current to hold and lift the arm"].value == f"{current:.3g} A per motor"
    rover = read_rig(tmp_path, ROVER.replace("[gearbox]", "voltage_limit = 12.0\n[gearbox]"))
    found = {f.what: f for f in rig_facts.derived_facts(rover)}
    assert found["rover: steepest slope without sliding"].value == "27°"
    assert found["rover: no-load speed at 12 V"].value == f"{12 / 0.05 / 16 * 0.04:.3g} m/s"
    assert found["rover: steepest slope that the stall torque holds at 12 V"].value == "any"


def test_surfaces_of_a_calibrated_rig_are_written_and_read(tmp_path):
    robot = read_rig(tmp_path, ROVER + '[grass]\nlike = "rover"\n[surfaces]\ngrass = "rover"\n')
    assert robot.rig.surfaces == (("grass", "rover"),)
    assert survives(tmp_path, robot)


ROBOT_FILES = ROOT / "docs/reference/robot-files.md"
PAGE = ROBOT_FILES.read_text(encoding="utf-8")
EXAMPLES = PAGE.split("```toml\n")[1:]


@pytest.mark.parametrize("text", [e.split("```")[0] for e in EXAMPLES], ids=lambda text: text[2:].split(":")[0])
def test_example_of_the_page_reads(tmp_path, text):
    robot = read_rig(tmp_path, text)
    assert not robot.rig.inherits and not [f for f in rig_facts.derived_facts(robot) if f.odd]
    assert survives(tmp_path, robot)


def test_every_key_of_robot_files_is_in_the_reference(robot):
    parameters = (ROBOT_FILES.parent / "parameters.md").read_text(encoding="utf-8")
    own = {p.name for p in params.walk_parameters(robot)}
    fixed = {*robot_file.SETTINGS}
    lacking = {name for name in own | fixed if f"`{name}`" not in parameters}
    shaft = {field.name for field in dataclasses.fields(Shaft) if "spec" in field.metadata}
    keys = {*rig_file.KEYS, *rig_file.LINEAR, *shaft, *configuration_tables._KINDS}
    keys |= {"base", "sides", "configurations", "schema"}
    keys |= {name.split(".")[1] for name in fixed if name.startswith(("driver.", "gearbox.mesh"))}
    lacking |= {key for key in keys if not re.search(rf"[`\[]{key}\b", PAGE)}
    assert not lacking


def test_a_linear_unit_of_exact_numbers_makes_an_exact_shaft(tmp_path):
    unit = """
base = "none"
imposed = "current"
channels = ["speed"]
[motor]
torque_constant = "1 ± 0"
[gearbox]
ratio = 1
efficiency_load = 1.0
[carriage]
load = "linear"
mass_kg = "2.5 ± 2 %"
drum_radius_mm = "1000 ± 0"
force_coulomb_N = "12 ± 50 %"
force_viscous_N_s_m = 40.0
"""
    robot = read_rig(tmp_path, unit)
    sds = {name: sd for name, _, sd in robot.rig.priors}
    assert sds["carriage.radius"] == 0.0 == sds["motor.torque_constant"]
    assert sds["carriage.inertia"] == pytest.approx(0.05) and sds["carriage.loss_coulomb"] == pytest.approx(6.0)
    assert "carriage.loss_viscous" not in sds  # which stands without ±
    assert "carriage.radius" not in priors.loop_parameter_names(robot, ["carriage"])
    freed = read_rig(tmp_path, unit.replace('"1000 ± 0"', "1000.0"))
    assert "carriage.radius" not in freed.rig.stated
