"""The comparison with other ways: what is compared, how claims are judged, and the NumPy drives that it is fitted with."""

import dataclasses
import json
from pathlib import Path

import head_to_head
import numpy as np
import plain_drives
import public_records
import pytest
import rivals
from public_records import Answer, judged
from worlds import rigs

from tests.commands import text_file

SPEED = "loss torque that changes with speed"
LAW = Answer("library", ("windage", "churning"), (SPEED,))
OUTSIDE = Answer("outside", (), (SPEED,))


@pytest.mark.parametrize(
    "level, claims, families, answer, wrong",
    [
        ("none", [], [], Answer("clean"), False),
        ("place", [], [SPEED], Answer("clean"), True),
        ("class", [["churning", "iron_loss"]], [SPEED], LAW, False),
        ("named", [["iron_loss"]], [SPEED], LAW, True),
        ("class", [["churning"], ["supply_sag"]], [SPEED], LAW, True),
        ("mechanism", [], [SPEED], LAW, False),
        ("mechanism", [], ["loss torque that changes with load"], LAW, True),
        ("place", [], ["resistance to travel that changes with slope"], LAW, False),
        ("place", [], ["voltage drop that changes with current"], LAW, True),
        ("named", [["stribeck_gear"]], [SPEED], OUTSIDE, True),
        ("mechanism", [], [SPEED], OUTSIDE, False),
        ("named", [["stribeck_gear"]], [SPEED], Answer(), None),
    ],
)
def test_a_claim_is_wrong_where_its_level_does_not_hold(level, claims, families, answer, wrong):
    assert judged(level, claims, families, answer) is wrong


def line(method, errors, **more):
    """A line of a record with one channel: errors of two rows in each of two kinds of blocks."""
    off = {kind: [[x] for x in errors] for kind in ("speed", "slope")}
    return {"record": "r", "method": method, "truth": "library", "channels": ["speed"], "off": off, "note": "",
            "seconds": 1.0, **more}  # fmt: skip


def test_methods_are_compared_on_the_rows_of_all():
    claim = {"level": "named", "claims": [["windage"]], "families": [SPEED], "wrong": False}
    every = [
        line("refit", [8.0, 8.0, 99.0] + 17 * [8.0]),
        line("verdict", [5.0, -5.0, 5.0] + 17 * [5.0], **claim),
        line("scipy", [4.0, 4.0, None] + 17 * [4.0]),  # one row less: no method is compared on it
        line("sindy", [1.0] + 19 * [None], **claim | {"wrong": True}),  # predicts too little
        line("ridge", 20 * [4.0]),
        line("boosted", 20 * [6.0]),
        {"record": "r", "method": "mujoco", "failed": "not installed"},
        {"record": "other", "method": "refit", "failed": "no such record"},
    ]
    r, other = head_to_head.compared(every)
    assert r.rows == 38 and r.percent["refit"] == pytest.approx([8.0]) and "sindy" not in r.percent
    assert r.share == pytest.approx((8 - 5) / (8 - 4)) and r.better() == ["scipy"]
    assert other.percent == {} and np.isnan(other.share)
    text = "\n".join(head_to_head.table([r, other]))
    assert "| named: windage | no |" in text and "not installed" in text and "no such record" in text
    assert "error lower by a tenth on 1, higher on 0 of 1 records" in text  # SciPy's
    # terms that predict better than the regressions cover all of the way
    better = [line("verdict", 20 * [3.0], **claim) if x["method"] == "verdict" else x for x in every]
    assert head_to_head.compared(better)[0].share == pytest.approx(1.0)


def test_a_record_that_is_not_there_is_a_line_for_each_method_and_ends_nothing(tmp_path, capsys):
    out = tmp_path / "lines.jsonl"
    head_to_head.main(["--records", "car", "--public", str(tmp_path), "--methods", "refit,scipy", "--out", str(out)])
    lines = [json.loads(x) for x in out.read_text(encoding="utf-8").splitlines()]
    assert [(x["record"], x["method"]) for x in lines] == [("car", "refit"), ("car", "scipy")]
    assert all("failed" in x for x in lines) and "--public" in lines[0]["failed"]
    assert "2 without a verdict" not in capsys.readouterr().out
    with pytest.raises(SystemExit, match="expected some of refit"):
        head_to_head.main(["--methods", "refitt", "--out", str(out)])


def test_a_method_that_takes_too_long_costs_itself_alone():
    kept = []
    job = head_to_head.Job("r", ("scipy", "sindy", "verdict"), None, None, None, 0, 10)
    (left,) = head_to_head.ended(job, "scipy", "no result in 5 s", kept.append)
    assert left.methods == ("sindy", "verdict") and [x["method"] for x in kept] == ["scipy"]
    assert head_to_head.ended(left, "base", "no result in 5 s", kept.append) == [] and len(kept) == 3


def test_ridge_finds_a_line_beyond_noise_and_nothing_in_noise():
    rng = np.random.default_rng(0)
    x, blocks = rng.uniform(-1, 1, (60, 4)), np.arange(60) // 12
    there = rng.uniform(-0.9, 0.9, (30, 4))
    slope = np.array([3.0, 0.0, -2.0, 0.0])
    found = rivals._ridge(x, 1.0 + x @ slope + 0.1 * rng.standard_normal(60), there, blocks)
    assert np.abs(found - 1.0 - there @ slope).max() < 0.2
    noise = rng.standard_normal(60)
    assert np.abs(rivals._ridge(x, noise, there, blocks)).max() < 0.5


@pytest.mark.parametrize("kind, imposed, seed", [("tracked", "voltage", 1), ("winch", "motor_speed", 2)])
def test_plain_drives_read_a_file_as_its_generator_means_it(kind, imposed, seed, tmp_path):
    """By the robot's file and the table alone: readings at the stated constants, without noise."""
    from calibration.data import robot_file
    from calibration.data import runs as records
    from calibration.inference import priors

    case = rigs.case(rigs.world(np.random.default_rng(seed), kind, imposed), seed=seed)
    case.write(tmp_path)
    robot = robot_file.read_robot(tmp_path / "rig.toml")
    runs = records.read_runs(tmp_path / "table.csv", robot=robot)
    names = [case.world.rig.public(n) for n in case.world.rig.tolerances]
    drive = plain_drives.drive(runs, robot, priors.parameter_coordinates(robot, names))
    stated = dataclasses.replace(case.world, constants=case.world.rig.stated)
    shown = stated.readings()[0].T * np.array([rigs.CHANNELS[n][1] for n in case.world.rig.channels])
    order = [case.world.rig.channels.index(channel.name) for channel in runs.channels]
    shown = np.where([case.world.rig.signed[n] for n in case.world.rig.channels], shown, np.abs(shown))[:, order]
    found = drive.readings(np.stack([drive.start(), drive.start() + 0.5]))
    assert found[0] == pytest.approx(shown, rel=1e-9) and np.abs(found[1] / shown - 1).max() > 1e-3


def shaft(**changes):
    constants = {
        "motor.resistance": 1.0, "motor.torque_constant": 0.05, "motor.inductance": 1e-9, "motor.inertia": 1e-4,
        "motor.friction_coulomb": 0.01, "motor.friction_viscous": 1e-5, "gearbox.ratio": 10.0,
        "gearbox.efficiency_load": 0.8, "gearbox.friction_coulomb": 0.0, "gearbox.friction_viscous": 0.0,
        "inertia": 0.02, "loss_coulomb": 0.2, "loss_viscous": 0.01,
    }  # fmt: skip
    return plain_drives.Shaft({n: np.array([x]) for n, x in (constants | changes).items()}, 1, False, False)


def test_a_followed_shaft_is_the_exact_solution_and_turns_round_through_rest():
    one = shaft()
    time = np.array([0.0, 0.02, 0.1, 0.3, 0.6])
    grid, followed = one.follow(time, np.array([12.0, 12.0, 12.0, -12.0, -12.0]), np.ones(5), 0.0)
    inertia = 0.02 / 10 + 10 * 1e-4 * 0.8
    slope = (10 * 0.8 * (0.05**2 + 1e-5) + 0.01 / 10) / inertia
    ends = (10 * 0.8 * (0.05 * 12 - 0.01) - 0.2) / inertia / slope
    shown = one.at(time[:4], 0, grid, followed)
    assert shown["motor_speed"] == pytest.approx(ends * -np.expm1(-slope * time[:4]), rel=1e-6)
    assert shown["motor_current"][1:] == pytest.approx(12 - 0.05 * shown["motor_speed"][1:], rel=1e-6)
    # Twelve volts back: it stops and turns round in a step, as in finer steps.
    fine, start = np.linspace(0.3, 0.6, 1001), float(shown["motor_speed"][3])
    again = one.follow(fine, np.full(1001, -12.0), np.ones(1001), start)
    assert one.at(time[4:], 0, grid, followed)["motor_speed"] == pytest.approx(again[1]["w"][0, -1], rel=1e-3)
    assert again[1]["w"][0, -1] < -50 < 0 < start


def test_a_shaft_that_friction_holds_stays_at_rest():
    held = shaft(loss_coulomb=10.0)
    grid, followed = held.follow(np.array([0.0, 0.1]), np.array([12.0, 12.0]), np.ones(2), 0.0)
    assert np.all(followed["w"] == 0) and held.at(np.array([0.1]), 0, grid, followed)[
        "motor_current"
    ] == pytest.approx(12.0)


def test_records_of_others_are_read_from_their_folder(tmp_path):
    folder = tmp_path / "public" / "micromouse"
    folder.mkdir(parents=True)
    upstream = (
        "time, batteryVoltage, motorCommand, leftSpeedRpm, rightSpeedRpm\n17800, 7931, -254, -626.67, -648.33\n"
    )
    (folder / "log.csv").write_text(upstream, encoding="utf-8")
    record = public_records.record("micromouse-right", tmp_path, tmp_path / "public", None, 0)
    assert Path(record.table).read_text(encoding="utf-8").split() == [
        "batteryVoltage,motorCommand,rightSpeedRpm",
        "7931,-254,-648.33",
    ]
    from calibration.data import robot_file

    for name, one in public_records.PUBLIC.items():
        assert robot_file.read_robot(text_file(tmp_path / f"{name}.toml", one.toml)).rig.channels, name
    (folder / "log.csv").write_text("time,speed\n1,2\n", encoding="utf-8")
    with pytest.raises(public_records.NoRecord, match="no column batteryVoltage"):
        public_records.record("micromouse-left", tmp_path, tmp_path / "public", None, 0)
