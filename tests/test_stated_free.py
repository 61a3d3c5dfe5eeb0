"""What a rig's file states with ± is what a calibration frees, with the width that stands there."""

from types import SimpleNamespace

import numpy as np
import pytest
from worlds import rigs

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration
from calibration.inference import calibration as fits
from calibration.inference import foresight, priors
from calibration.inference.calibration import calibrate
from calibration.inference.observers import Histories, SettledRuns
from tests.commands import ends, read_rig, read_table, refused

#: Observers of logs and of settled runs, and the ends of names that these do not show.
KINDS = (Histories, ()), (SettledRuns, priors.OVER_TIME)

RIG = """
base = "none"
channels = ["total_current", "motor_speed"]
[motor]
resistance = "1.2 ± 5 %"
torque_constant = "0.05 ± 3 %"
inertia = "1e-5 ± 10 %"
friction_coulomb = "0.004 ± 0.002"
[gearbox]
ratio = 10
efficiency_load = 0.9
[bench]
load = "shaft"
inertia = "0.001 ± 20 %"
loss_coulomb = 0.1
"""


def bench(tmp_path, change=lambda text: text):
    return read_rig(tmp_path, change(RIG))


def test_everything_stated_with_a_width_is_freed_that_the_data_show(tmp_path):
    robot = bench(tmp_path)
    over_time = (
        "motor.resistance",
        "motor.torque_constant",
        "motor.inertia",
        "motor.friction_coulomb",
        "bench.inertia",
    )
    assert set(priors.names_to_fit(robot, ["bench"])) == set(over_time)
    settled = priors.names_to_fit(robot, ["bench"], priors.OVER_TIME)
    assert set(settled) == {n for n in over_time if not n.endswith(".inertia")}
    assert not [n for n in priors.names_to_fit(robot, ["other"]) if n.startswith("bench")]
    driven = bench(tmp_path, lambda text: text.replace(', "motor_speed"]', ']\nimposed = "motor_speed"'))
    assert "motor.resistance" not in priors.names_to_fit(driven, ["bench"])  # nothing shows it
    exact = bench(tmp_path, lambda text: text.replace("1.2 ± 5 %", "1.2 ± 0"))
    assert "motor.resistance" not in priors.names_to_fit(exact, ["bench"])


def test_a_log_shows_how_a_vehicle_grips_though_no_channel_shows_its_speed(tmp_path):
    """Each start does. With the grip held, a wrong mass was answered with `slip`."""
    vehicle = 'load = "vehicle"\nmass = "10 ± 20 %"\nradius = 0.06\n[bench.ground]\nrolling_resistance = 0.02\n'
    vehicle += '[bench.ground.friction]\nstatic = "0.6 ± 30 %"\n'
    robot = bench(tmp_path, lambda text: text.partition('load = "shaft"')[0] + vehicle)
    grip = {f"bench.{n}" for n in ("mass", "ground.friction.static")}
    log, settled = (priors.loop_parameter_names(robot, ["bench"], *kind.free(), idle) for kind, idle in KINDS)
    assert grip < set(log) and grip & set(settled) == {"bench.mass"}


def test_winding_that_nobody_stated_has_a_wide_prior(tmp_path):
    """A log of a motor without inductance moved the assumed 0.2 ms by 6 sds, and resistance and friction with it."""
    robot = bench(tmp_path)
    (sd,) = priors.parameter_coordinates(robot, ["motor.inductance"]).prior_sd
    assert sd == pytest.approx(float(robot.motor.inductance), rel=1e-6)
    stated = bench(tmp_path, lambda text: text.replace("[gearbox]", 'inductance = "1e-3 ± 10 %"\n[gearbox]'))
    assert priors.parameter_coordinates(stated, ["motor.inductance"]).prior_sd == pytest.approx([1e-4])


@pytest.mark.slow
def test_a_calibration_frees_what_its_rig_states(tmp_path, monkeypatch):
    world = rigs.world(np.random.default_rng(4), "bench", "voltage", rows=(16, 24))
    rigs.case(world).write(tmp_path)
    robot = robot_file.read_robot(tmp_path / "rig.toml")
    runs = records.read_runs(tmp_path / "table.csv", robot=robot)
    asked = []

    def chosen(robot, names, *others, **further):
        asked.extend(names)
        raise InterruptedError  # what follows is the search

    monkeypatch.setattr(priors, "parameter_coordinates", chosen)
    with pytest.raises(InterruptedError):
        calibrate(runs, robot)
    stated = {world.rig.public(name) for name in world.rig.tolerances}
    assert {"motor.resistance", "motor.torque_constant"} < stated <= set(asked)


@pytest.mark.slow
def test_a_prior_is_shown_as_it_is_stated(tmp_path):
    robot = bench(tmp_path)
    names = ("motor.friction_coulomb", "motor.resistance")
    sds = priors.parameter_coordinates(robot, names).prior_sd
    assert sds == pytest.approx([0.002, 0.06])  # the slope of the log-normal one is 0.0019
    seen = foresight.predict_identifiability(
        read_table(
            tmp_path,
            "supply_voltage_V,total_current_A,motor_speed_rpm\n12,2.0,1600\n24,2.1,3900\n",
            robot,
            "runs.csv",
        ),
        robot,
    )
    assert {p.name: p.prior_sd for p in seen.parameters}[names[0]] == pytest.approx(0.002)


def test_nothing_to_fit_is_not_put_down_to_an_option_that_nobody_gave(tmp_path):
    robot = bench(
        tmp_path, lambda text: text.replace('"1.2 ± 5 %"', "1.2").replace("loss_coulomb = 0.1", "loss_coulomb = 0.0")
    )
    with refused("^no parameter to fit: every loss ((?!--fix).)* give values a ±((?!--fix).)*$", BadConfiguration):
        priors.choose_free_names(robot, ())
    with refused("--fix leaves no parameter to fit", BadConfiguration):
        priors.choose_free_names(robot, ("motor.resistance",), fix=("motor.resistance",))


def test_a_width_of_the_programs_is_said(tmp_path, mmrjax):
    bench(tmp_path, lambda text: text.replace('"1.2 ± 5 %"', "1.2"))
    _, out, _ = ends(mmrjax("rig check rig.toml"), code=0)
    assert "No ± is given, so the default ± is used: motor.resistance (±5 %)" in " ".join(out.split())
    assert "bench.loss_coulomb (±50 %)" in " ".join(out.split())


def test_what_lies_far_from_its_prior_is_not_said_to_be_held_by_it():
    parameter = lambda shift: SimpleNamespace(shift=shift, at_bound="")  # noqa: E731
    found = SimpleNamespace(
        parameters={"near": parameter(0.5), "far": parameter(-6.5)}, held_by_prior=("near", "far"), searched=None,
        together=(), undetermined=("near", "far"),
    )  # fmt: skip
    said = list(fits._parameter_remarks(found))
    assert [n.names for n in said if n.code == "held_by_prior"] == [("near",)]
    assert [(n.name, n.sds) for n in said if n.code == "far_from_prior"] == [("far", 6.5)]
