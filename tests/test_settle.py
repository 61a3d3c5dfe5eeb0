"""Settled runs out of logs: they are those of the levels that were held, with sds that hold. What cannot be is said."""

import contextlib
import re
import time

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import rigs
from worlds.settled import write_table

from calibration.data import contradictions, rig_facts, robot_file, settling
from calibration.data import runs as records
from calibration.inference import checks, observers
from calibration.inference import noise as noises
from calibration.inference.foresight import InformationForecast
from calibration.words import table_words as words
from sweeps.commands import rig_check
from tests.commands import ROOT, csv_text, ends, read_json, read_rig, refused, rows, text_file


def made(tmp_path, seed=1, kind="bench", imposed="voltage", **options):
    """A log of a random rig, written beside its file: the log, its world, the robot."""
    rng = np.random.default_rng([27, seed])
    world = rigs.world(rng, kind, imposed, rows=(16, 60))
    rigs.case(world).write(tmp_path)
    log = rigs.log(world, rng, **options)
    log.write(tmp_path / "log.csv")
    return log, world, robot_file.read_robot(tmp_path / "rig.toml")


def settled(tmp_path, robot, **options):
    return settling.settle_log(records.read_runs(tmp_path / "log.csv", robot=robot), robot, **options)


def deviations(log, found):
    """How far each mean is from what its level settles at, in its sds, shape (stretches, channels)."""
    rows = [np.bincount(log.level[s.rows]).argmax() for s in found.kept]
    z = [
        [(s.mean[n] - log.settled[level, k]) / s.sd[n] for k, n in enumerate(log.channels)]
        for level, s in zip(rows, found.kept, strict=True)
    ]
    return np.array(z)


CASES = {
    "a bench": (1, "bench", "voltage", {}),
    "a duty, a vehicle": (2, "wheeled", "duty", {}),
    "an imposed speed": (3, "linear", "motor_speed", {}),
    "noise and a delay": (4, "winch", "voltage", {"noise": 5.0, "delay": 0.05}),
    "coarse steps": (5, "bench", "voltage", {"noise": 0.2, "step": 3.0}),
    "steps that hide the noise": (10, "linear", "voltage", {"rate": 50.0, "hold": 1.0, "step": 4.0, "lag": 0.02}),
    "a slow lag": (6, "tracked", "voltage", {"lag": 0.3}),
    "noise, steps and a jittering clock": (7, "wheeled", "voltage", {"noise": 4.0, "step": 2.0, "jitter": 0.3}),
    "few samples": (8, "winch", "voltage", {"rate": 25.0, "hold": 3.0}),
}


@pytest.mark.quick(2)
@pytest.mark.parametrize("case", CASES)
def test_means_are_those_of_the_levels_within_their_sds(tmp_path, case):
    seed, kind, imposed, options = CASES[case]
    log, world, robot = made(tmp_path, seed, kind, imposed, **options)
    found = settled(tmp_path, robot)
    assert len(found.kept) >= 0.8 * len(world.conditions)
    z = deviations(log, found)
    assert np.sqrt(np.mean(z**2, 0)) == pytest.approx(np.full(z.shape[1], 0.85), abs=0.55) and np.abs(z).max() < 5
    for s in found.kept:  # no stretch holds samples of two levels, but for alike ones
        assert np.ptp(log.settled[log.level[s.rows]], 0) == pytest.approx(np.zeros(z.shape[1]), abs=1e-9)


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_noise_does_not_cut_levels_short(tmp_path, noise):
    """Five levels of 2.9 s at 50 Hz without any start: each sample is settled."""
    shares = []
    for seed in range(6):
        rng, volts = np.random.default_rng(seed), np.repeat([6.0, 12.0, 18.0, 9.0, 15.0], 145)
        columns = {
            "time_s": np.arange(len(volts)) / 50,
            "supply_voltage_V": volts,
            "total_current_A": (0.5 + 0.05 * volts) * (1 + noise * rng.standard_normal(len(volts))),
            "motor_speed_rpm": 180 * volts * (1 + 0.25 * noise * rng.standard_normal(len(volts))),
        }
        found = settled(tmp_path, bench(tmp_path, columns))
        shares += [len(s.rows) / 145 for s in found.kept]
    assert len(shares) == 30 and min(shares) > 0.5 and np.mean(shares) > 0.9


def test_means_hold_where_starts_take_many_times_the_settled_current(tmp_path):
    """A motor's current after a step of voltage: I = I_∞ + (I_0 - I_∞) exp(-t / T), speed alike."""
    R, C, K, dry, lag, z = 1.2, 0.05, 1e-4, 0.02, 0.18, []
    rng = np.random.default_rng(5)
    for hold in (120, 150, 200):
        volts = np.repeat(rng.permutation(np.arange(3.0, 19.0)), hold)
        speeds = (volts - R * dry / C) / (C + R * K / C)
        shown = np.empty(len(volts))
        turns = 0.0
        for k, target in enumerate(speeds):
            shown[k] = turns
            turns = target + (turns - target) * np.exp(-0.01 / lag)
        columns = {
            "time_s": np.round(np.arange(len(volts)) / 100, 4),
            "supply_voltage_V": volts,
            "total_current_A": (volts - C * shown) / R + 0.01 * rng.standard_normal(len(volts)),
            "motor_speed_rpm": shown * 30 / np.pi + 3 * rng.standard_normal(len(volts)),
        }
        found = settled(tmp_path, bench(tmp_path, columns))
        assert len(found.kept) > (10 if hold > 120 else 4)
        truth = [(dry + K * speeds[s.rows[0]]) / C for s in found.kept]
        z += [(s.mean["total_current"] - x) / s.sd["total_current"] for s, x in zip(found.kept, truth, strict=True)]
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(0.9, abs=0.25) and np.abs(z).max() < 3.5


def test_the_autocorrelation_of_readings_widens_their_mean():
    rng = np.random.default_rng(3)
    white = rng.standard_normal(4000)
    slow = np.convolve(rng.standard_normal(4039), np.ones(40) / np.sqrt(40), "valid")
    assert settling._correlation_time(white) == pytest.approx(1.0, abs=0.2)
    assert settling._correlation_time(slow) == pytest.approx(40.0, rel=0.35)


def bench(tmp_path, columns, rig=""):
    """The robot of a bench with lines `rig` in its file, that shows what is in a table of these columns."""
    names = ("total_current", "motor_current", "motor_speed", "output_speed", "output_angle")
    shown = [name for name in names if any(column.startswith(name) for column in columns)]
    text = f"""
base = "none"
channels = {shown}
[motor]
resistance = 1.0
torque_constant = 0.05
[gearbox]
ratio = 10
efficiency_load = 0.9
[bench]
load = "shaft"
inertia = 0.002
loss_coulomb = 0.1
{rig}
"""
    text_file(tmp_path / "log.csv", csv_text(columns))
    return read_rig(tmp_path, text)


def stairs(levels=(6.0, 12.0, 18.0), hold=200, seed=0):
    """Columns of a log that goes up stairs, 100 samples a second."""
    rng = np.random.default_rng(seed)
    volts = np.repeat(levels, hold)
    since = np.tile(np.arange(hold), len(levels)) / 100
    share = 1 - np.exp(-since / 0.05)
    return {
        "time_s": np.round(np.arange(len(volts)) / 100, 4),
        "supply_voltage_V": volts,
        "total_current_A": 0.3 + 0.05 * volts + 0.002 * rng.standard_normal(len(volts)),
        "motor_speed_rpm": 180 * volts * share + 0.5 * rng.standard_normal(len(volts)),
    }


BAD = {
    "time backward": (
        lambda c: c | {"time_s": np.concatenate([c["time_s"][:300], c["time_s"][:300]])},
        r"row 301, time_s: goes back from 2\.99 to 0 s; give each recording its own run_id, or sort the rows",
    ),
    "time twice": (
        lambda c: c | {"time_s": np.r_[c["time_s"][0], c["time_s"][0], c["time_s"][2:]]},
        r"row 2, time_s: 0 s is repeated; give each sample its own time",
    ),
    "no time": (
        lambda c: {k: v for k, v in c.items() if k != "time_s"},
        r"column time_s is missing, so each row is already a settled run; use it with loop",
    ),
    "frozen": (
        lambda c: c | {"motor_speed_rpm": np.full(600, 812.0)},
        r"rows \d+ to \d+: no settled segment: motor_speed is saturated or frozen\. .*; check the instrument, or use the log",
    ),
    "never holds": (
        lambda c: c | {"supply_voltage_V": np.round(12 + 6 * np.sin(8 * c["time_s"]), 5)},
        r"rows \d+ to \d+: no settled segment: the imposed quantity always changes\. This level has 0\.\d+ s and \d "
        r"samples; expected at least 0\.3 s and 8 samples; hold each level for a while, or use the log itself with loop",
    ),
    "no sign of the duty, levels repeated": (
        lambda c: (
            stairs((6.0,) * 6)
            | {"supply_voltage_V": np.full(1200, 12.0), "duty": np.repeat([0.5, 0.6] * 3, 200)}
            | {"motor_speed_rpm": np.repeat([1, 1.2, -1, -1.2, 1, 1.2], 200) * (1000 + np.arange(1200) % 3)}
        ),
        r"motor_speed_rpm: shows -1001 rpm at 6 V; expected the sign of the imposed quantity; give duty the sign",
    ),
    "nothing imposed": (lambda c: c | {"supply_voltage_V": np.zeros(600)}, r"rows 1 to 600: no settled segment: nothing drives the motors\. .*; log driven motion, or use the log itself"),
    "never settles": (
        lambda c: (
            stairs((12.0,), 600) | {"motor_speed_rpm": 300 + 200 * c["time_s"]}
        ),
        r"rows 1 to 600: no settled segment: motor_speed still changes at the end of its level \(.* %\)\. .* raise --drift",
    ),
    "few samples": (lambda c: {name: x[:5] for name, x in c.items()}, r"5 samples in its longest run; at least 8 are needed"),
}  # fmt: skip


def both_ways(**changes):
    """A bench that goes up and down with an ammeter, a speed and an angle of its output."""
    columns = stairs(levels=(6.0, 12.0, -6.0, -12.0))
    sign = np.sign(columns["supply_voltage_V"])
    columns["total_current_A"] = sign * (0.3 + 0.05 * np.abs(columns["supply_voltage_V"])) + 0.002 * np.cos(
        np.arange(800.0)
    )
    columns["output_angle_deg"] = np.round(np.cumsum(columns["motor_speed_rpm"] / 10 * 6) / 100, 3)
    return columns | {name: change(columns[name]) for name, change in changes.items()}


WRONG = {
    "a current without sign": (
        lambda _: both_ways(total_current_A=np.abs),
        r"rows 4\d\d to 600, total_current_A: shows 0\.6 A at -6 V; expected readings with their signs, negative "
        r"in reverse; or set \[instruments\.total_current\] signed = false",
    ),
    "a speed turned round": (
        lambda _: both_ways(motor_speed_rpm=lambda x: -x),
        r"rows \d+ to 200, motor_speed_rpm: shows -1080 rpm at 6 V; expected the sign of the imposed quantity; state "
        r"\[columns\] motor_speed_rpm = \{column = \.\.\., factor = -1\}",
    ),
    "a current turned round": (
        lambda _: both_ways(total_current_A=lambda x: -x),
        r"rows \d+ to 200, total_current_A: shows -0\.6 A at 6 V; expected the sign of the imposed quantity; state "
        r"\[columns\] total_current_A = \{column = \.\.\., factor = -1\}",
    ),
    "a voltage without sign": (
        lambda _: both_ways(supply_voltage_V=np.abs),
        r"rows \d+ to 600, motor_speed_rpm: shows -1080 rpm at 6 V; expected the sign of the imposed quantity; give "
        "supply_voltage_V the sign of its direction",
    ),
    "a frozen angle": (
        lambda _: {name: 0 * x + 12.5 if "angle" in name else x for name, x in both_ways().items() if "speed" not in name},
        r"rows \d+ to \d+: no settled segment: output_speed is saturated or frozen\. .*; check the instrument",
    ),
    "an angle that changes its unit": (
        lambda _: both_ways(output_angle_deg=lambda x: np.where(np.arange(800) < 350, x, np.radians(x))),
        r"row 351, output_angle_deg: jumps by -30\d\d deg .* an angle that wraps or changes its unit",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD | WRONG)
def test_what_cannot_be_settled_is_said_with_row_and_remedy(tmp_path, case):
    change, said = (BAD | WRONG)[case]
    robot = bench(tmp_path, change(stairs()))
    with refused(said):
        settled(tmp_path, robot)


SIGNS = [case for case in WRONG if "sign" in case or "round" in case]


@pytest.mark.parametrize("case", ["as it is", *SIGNS])
def test_rig_check_says_of_a_log_that_signs_are_wrong(tmp_path, monkeypatch, case):
    change, said = WRONG.get(case, (lambda _: both_ways(), ""))
    bench(tmp_path, change(None))
    nothing = InformationForecast((), (), (), (), (), None)
    monkeypatch.setattr(rig_check.foresight, "predict_identifiability", lambda runs, robot: nothing)
    found = rig_check.examine_rig_file(tmp_path / "rig.toml", str(tmp_path / "log.csv"))
    if not said:
        assert found.doubts == ()
    else:
        (doubt,) = found.doubts
        assert re.search(said, doubt) and doubt in found.remarks()


def test_time_in_milliseconds_is_doubted_where_a_start_shows_it(tmp_path):
    robot = bench(tmp_path, stairs())
    step = 2 * rig_facts.time_constant(robot)
    seconds = np.arange(200) * step / 8
    start = {"supply_voltage_V": np.full(200, 6.0), "motor_speed_rpm": 1000 * (1 - np.exp(-seconds / step))}
    for unit, doubted in ((1.0, False), (1e3, True)):
        bench(tmp_path, {"time_s": unit * seconds, **start})
        said = rig_facts.doubtful_time(records.read_runs(tmp_path / "log.csv", robot=robot), robot)
        assert ("Is time_s in milliseconds? Then name it time_ms" in said) == doubted == bool(said)
    drifts = {"time_s": 1e3 * seconds, **start, "motor_speed_rpm": 1000 + 50 * (1 - np.exp(-seconds / step))}
    bench(tmp_path, drifts)
    assert rig_facts.doubtful_time(records.read_runs(tmp_path / "log.csv", robot=robot), robot) == ""


@pytest.mark.parametrize(
    "moves", [[8.50, 0.42, -0.1743, -9.796, -11.76, -17.17], [0, 190, 400, 620, 830, 1030], [3, 5000, 3, 4, 5, 6]]
)
def test_a_shaft_that_stands_for_long_may_be_quick_for_a_while(moves):
    """Through zero from a small angle to a large one, by more than half a turn a sample, and with a wrong reading."""
    angle = np.concatenate([np.full(50, float(moves[0])), moves, np.full(50, float(moves[-1]))])
    columns = {"output_angle_deg": angle, "time_s": 0.01 * np.arange(len(angle)), "run_id": np.full(len(angle), "a")}
    runs = records.Runs("log.csv", columns)
    assert contradictions.unwrap_angle(runs, "output_angle_deg") is runs


def test_signs_and_units_that_are_right_are_not_doubted(tmp_path):
    assert len(settled(tmp_path, bench(tmp_path, both_ways())).kept) == 4
    unsigned = bench(tmp_path, both_ways(total_current_A=np.abs), "[instruments.total_current]\nsigned = false")
    assert len(settled(tmp_path, unsigned).kept) == 4


@pytest.mark.parametrize("later", [1.0, 86400.0])
def test_missing_samples_divide_a_level_and_are_said(tmp_path, later):
    columns = stairs(levels=(12.0,), hold=600)
    columns["time_s"] += np.where(np.arange(600) < 300, 0.0, later)
    found = settled(tmp_path, bench(tmp_path, columns))
    assert found.gaps == (299,) and len(found.kept) == 2
    assert words.settle_remarks(found)[0].startswith("samples are missing after row 300")


def test_a_saturated_channel_leaves_its_stretch_out(tmp_path):
    columns = stairs()
    columns["total_current_A"] = np.minimum(columns["total_current_A"], 1.15)  # of 1.2 A at 18 V
    found = settled(tmp_path, bench(tmp_path, columns))
    assert [s.why for s in found.stretches] == ["", "", "stuck"] and found.stretches[2].channel == "total_current"
    assert "total_current is saturated or frozen" in words.omitted_stretches(found.stretches)[0]


GLITCHES = {  # share of the speed's readings, what they are multiplied by, glitches in the middle level
    "none": (0.0, 4.0, 0),
    "edges missed": (0.12, 4.0, 24),
    "dropouts": (0.2, 0.0, 40),
    "most of them": (0.4, 4.0, None),
}


@pytest.mark.parametrize("case", GLITCHES)
def test_glitches_leave_means_where_they_are_or_a_level_out(tmp_path, case):
    share, times, count = GLITCHES[case]
    columns, rng = stairs(), np.random.default_rng(8)
    off = 200 + rng.permutation(200)[: round(200 * share)]
    columns["motor_speed_rpm"][off] *= times
    found = settled(tmp_path, bench(tmp_path, columns))
    assert [s.why for s in found.stretches] == ["", "" if count is not None else "glitches", ""]
    if count is None:
        assert "motor_speed has many outliers (4" in words.omitted_stretches(found.stretches)[0][0]
        return
    middle, clean = found.kept[1], stairs()["motor_speed_rpm"][200:400]
    assert middle.glitches.get("motor_speed", 0) == np.isin(off, middle.rows).sum() >= 0.7 * count
    kept = np.setdiff1d(middle.rows, off) - 200
    assert middle.mean["motor_speed"] == pytest.approx(clean[kept].mean(), rel=1e-9)
    assert middle.sd["motor_speed"] < 3 * 0.5 / np.sqrt(len(kept)) + 1.0  # the start's lag included
    said = [x for x in words.settle_remarks(found) if "far from their neighbours" in x]
    assert len(said) == (count > 0)


def test_the_readings_of_a_start_are_no_glitches():
    """A delayed start of a current: the old level, then a peak that decays. A single reading later is a glitch."""
    rng, k = np.random.default_rng(0), np.arange(200)
    shown = np.where(k < 4, 2.0, 1.0 + 8.0 * np.exp(-(k - 4) / 4)) + 0.01 * rng.standard_normal(200)
    shown[150] = 5.0
    assert np.flatnonzero(settling.find_glitches(shown, [k], 31, 0.0, 0.02)).tolist() == [150]


def test_a_current_in_pulses_keeps_its_mean(tmp_path):
    columns = stairs()
    columns["total_current_A"] = np.where(np.arange(600) % 10 == 0, 5.0, 0.0) + 1e-3 * np.arange(600) % 7e-3
    found = settled(tmp_path, bench(tmp_path, columns))
    assert found.kept and all(s.mean["total_current"] == pytest.approx(0.5, abs=0.03) for s in found.kept)


def test_what_does_not_move_and_what_nothing_drives_is_left_out(tmp_path):
    columns = stairs(levels=(0.0, 1.0, 12.0))
    columns["motor_speed_rpm"] = np.where(columns["supply_voltage_V"] < 2, 0.0, columns["motor_speed_rpm"])
    found = settled(tmp_path, bench(tmp_path, columns))
    assert [s.why for s in found.stretches] == ["idle", "rest", ""]


def test_an_acceleration_that_takes_current_is_no_settled_run(tmp_path):
    columns = stairs(levels=(12.0,), hold=600)
    columns["motor_speed_rpm"] = 2000 + 2.0 * columns["time_s"]  # 0.6 % over the log
    robot = bench(tmp_path, columns)
    assert not settled(tmp_path, robot).stretches[0].why
    heavy = settling.acceleration_currents(robot)
    rate = 0.002 / 100 / 0.05 * np.pi / 30  # load's inertia at the motor over the torque constant, of an rpm a second
    assert heavy["bench"][2] == pytest.approx(rate + float(robot.motor.inertia) / 0.05 * np.pi / 30)
    slow = robot_file.change_robot(
        robot, {"bench.inertia": 0.02 / rate * float(robot.configurations["bench"].inertia)}, "a test"
    )
    with refused(r"no settled segment: motor_speed still accelerates at the end of its level \(4\.\d+ %\)"):
        settled(tmp_path, slow)


def test_levels_that_are_held_again_widen_sds_by_what_they_differ_by(tmp_path):
    columns = stairs(levels=(6.0, 12.0) * 6)
    shift = np.repeat(np.random.default_rng(4).standard_normal(12) * 0.02, 200)
    columns["total_current_A"] = columns["total_current_A"] + shift
    found = settled(tmp_path, bench(tmp_path, columns))
    assert found.scatter["total_current"] == pytest.approx(0.02, rel=0.5)
    assert all(s.sd["total_current"] > 0.9 * found.scatter["total_current"] for s in found.kept)


def test_a_log_is_divided_where_the_torque_of_a_brake_changes(tmp_path):
    """Levels of one voltage, read with noise, each twice: their readings are no scatter of repeats."""
    levels = np.tile([0.0, 0.5, 1.0, 2.0], 2)
    columns, torque = stairs(levels=(12.0,) * 8), np.repeat(levels, 200)
    since = np.tile(np.arange(200), 8) / 100
    columns["motor_speed_rpm"] += -300 * torque + 300 * np.repeat(np.diff(levels, prepend=0.0), 200) * np.exp(
        -since / 0.05
    )
    columns["total_current_A"] += 0.4 * torque
    columns["load_torque_Nm"] = torque + 0.005 * np.random.default_rng(1).standard_normal(len(torque))
    found = settled(tmp_path, bench(tmp_path, columns))
    table = found.table()
    assert len(found.kept) == 8 and found.scatter["motor_speed"] < 1.0
    assert_allclose(table["load_torque_Nm"], levels, atol=2e-3)
    assert_allclose(table["motor_speed_rpm"], 2160 - 300 * levels, atol=2.0)


def test_an_angle_shows_the_speed_of_its_shaft(tmp_path):
    columns = stairs()
    rate = columns.pop("motor_speed_rpm") / 10 * 6  # of the output, deg/s
    angle = np.cumsum(rate) / 100
    whole = bench(tmp_path, columns | {"output_angle_deg": np.round(angle, 2)})
    found = settled(tmp_path, whole)
    speeds = [s.mean["output_speed"] for s in found.kept]
    assert speeds == pytest.approx([108.0, 216.0, 324.0], rel=0.01)
    said = words.settle_remarks(found)
    assert (
        "output_speed_rpm is the rate of output_angle_deg. To get it, add output_speed to the rig's channels"
        in said[0]
    )
    named = bench(tmp_path, columns | {"output_angle_deg": angle, "output_speed_rpm": np.full(600, "")})
    assert words.settle_remarks(settled(tmp_path, named)) == []


def test_the_command_leaves_a_table_that_is_read_as_settled_runs(tmp_path, mmrjax):
    _, world, robot = made(tmp_path)
    _, out, _ = ends(mmrjax("settle log.csv --robot rig.toml --out found"), code=0)
    assert f"{len(world.conditions)} settled runs, " in " ".join(out.split())
    runs = records.read_runs(tmp_path / "found/settled.csv", robot=robot)
    assert not runs.sampled and len(runs) == len(world.conditions)
    assert np.isfinite(runs.deviations()).all() and not runs.unknown
    first, *_ = rows(tmp_path / "found/stretches.csv")
    assert first["first_row"] == "1" and float(first["motor_speed_change_rpm"]) < 10
    document = read_json(tmp_path / "found/result.json")
    assert document["settled"] == len(runs) and document["schema"] == "mmrjax.settle/1"
    assert "The log." in (tmp_path / "found/report.html").read_text(encoding="utf-8")
    assert (tmp_path / "found/figures/log.svg").is_file()


def test_a_column_without_a_role_may_be_empty_for_a_while(tmp_path):
    columns = stairs() | {"ambient_C": np.where(np.arange(600) < 250, "", "21.5")}
    robot = bench(tmp_path, columns)
    found = settled(tmp_path, robot).table()["ambient_C"]
    assert_array_equal(found, [np.nan, 21.5, 21.5])


def turning(tmp_path):
    """A log of a robot whose wheels are held at nine pairs of speeds. The yaw rate is that of their difference."""
    pairs = np.array([(1, 1), (1, 0.5), (1, -0.5), (0.5, 1), (-1, 1), (-1, -1), (0.5, 0.5), (-0.5, -1), (1, 0.5)])
    left, right = np.repeat(pairs, 40, 0).T
    noise = np.random.default_rng(4).standard_normal((3, len(left)))
    table = {
        "time_s": np.arange(len(left)) / 10,
        "wheel_speed_left_m_s": left,
        "wheel_speed_right_m_s": right,
        "current_left_A": 3 + 0.1 * noise[0],
        "current_right_A": 3 + 0.1 * noise[1],
        "yaw_rate_rad_s": (right - left) / 0.8 + 0.01 * noise[2],
    }
    write_table({n: [f"{x:.6g}" for x in column] for n, column in table.items()}, tmp_path / "log.csv")
    return pairs, robot_file.read_robot(ROOT / "docs/rigs/husky/husky.toml")


def test_levels_of_a_turn_are_those_of_both_sides_and_a_yaw_rate_has_its_own_sign(tmp_path):
    pairs, robot = turning(tmp_path)
    found = settled(tmp_path, robot)
    assert len(found.kept) == len(pairs) and {s.why for s in found.stretches} == {""}
    yaw = [s.mean["yaw_rate"] for s in found.kept]
    assert yaw == pytest.approx(np.diff(pairs, axis=1)[:, 0] / 0.8, abs=0.02)
    assert found.scatter["yaw_rate"] == 0  # the first and the last pair of equal speeds are one level, others are not
    write_table(found.table(), tmp_path / "settled.csv")
    runs = records.read_runs(tmp_path / "settled.csv", robot=robot)
    assert runs.of_sides[1] == pytest.approx(4555.3 * pairs[:, 1], rel=1e-4)


@pytest.mark.parametrize("every, kept", [(5, 3), (60, 0)])
def test_a_channel_that_is_read_in_few_rows_has_the_means_of_these_or_none(tmp_path, every, kept):
    columns = stairs()
    del columns["total_current_A"]
    speed = columns["motor_speed_rpm"]
    columns["motor_speed_rpm"] = np.where(np.arange(600) % every == 0, speed, np.nan)
    text = {n: ["" if np.isnan(v) else f"{v:.9g}" for v in x] for n, x in columns.items()}
    robot = bench(tmp_path, text)
    if not kept:
        with refused("no settled segment: no channel has enough readings"):
            settled(tmp_path, robot)
        return
    found = settled(tmp_path, robot)
    assert len(found.kept) == kept
    assert [s.mean["motor_speed"] for s in found.kept] == pytest.approx(
        [speed[s.rows].mean() for s in found.kept], rel=0.01
    )


@pytest.mark.parametrize("case, said", [
    ("even", ""),
    ("uneven rows", ""),
    ("missing rows", r"^log\.csv row 401, time_s: 90 s after the row before it, where 0\.01 s is usual. A fit keeps"),
    ("a clock that jitters", r"^log\.csv rows 1 to 600, time_s: the clock jitters by 0\.00\d+ s around even spacing\. .* 0\.01 s apart"),
])  # fmt: skip
def test_gaps_and_a_clock_that_jitters_are_said_with_rows_and_remedy(tmp_path, case, said):
    rng, columns = np.random.default_rng(12), stairs()
    off = {
        "even": np.zeros(600),
        "uneven rows": np.cumsum(rng.uniform(-0.005, 0.005, 600)),
        "missing rows": np.where(np.arange(600) < 400, 0.0, 89.99),
        "a clock that jitters": rng.uniform(-0.0049, 0.0049, 600),
    }[case]
    columns["time_s"] = columns["time_s"] + off - off[0]
    robot = bench(tmp_path, columns)
    runs = records.read_runs(tmp_path / "log.csv", robot=robot)
    (found,) = (*runs.notes, *rig_facts.log_doubts(runs, robot)) or ("",)
    assert re.search(said, found) and bool(found) == bool(said)


@pytest.mark.parametrize("volts, noise, said", [
    (0.0, None, r"rows 1 to 600, supply_voltage_V: nothing drives the motors and nothing moves; log driven motion"),
    (0.5, None, r"rows 1 to 600, motor_speed_rpm: readings are noise about zero \(\d\.\d rpm\), so nothing moves; .* --noise"),
    (0.5, "motor_speed=3rpm", ""),
    (12.0, None, ""),
])  # fmt: skip
def test_a_log_in_which_nothing_moves_is_refused_unless_a_shaft_is_locked(tmp_path, volts, noise, said):
    columns = stairs((volts,) * 3)
    columns["motor_speed_rpm"] = (
        3 * np.random.default_rng(13).standard_normal(600) + (volts == 12) * columns["motor_speed_rpm"]
    )
    robot = bench(tmp_path, columns)
    runs = records.read_runs(tmp_path / "log.csv", robot=robot)
    with refused(said) if said else contextlib.nullcontext():
        checks._check_motion(runs, noises.noise_from_table(runs, observers.observer_kind(runs).sizes(runs), noise))
    if volts == 0.5:  # nor is it a settled run
        with refused("no settled segment: the drive does not move"):
            settled(tmp_path, robot)


@pytest.mark.parametrize("limit, ammeter", [
    (12.0, "total_current"), (12.0, "motor_current"), (100.0, "total_current"),
])  # fmt: skip
def test_a_command_beyond_what_the_driver_gives_is_said_with_its_limit(tmp_path, limit, ammeter):
    time, rng = np.arange(1200) / 100, np.random.default_rng(14)
    command = np.round(36 * np.sin(2.2 * time) * np.sin(0.9 * time), 3)
    volts, speed = np.clip(command, -limit, limit), np.zeros(1200)  # of 0.05 N·m/A and 1 ohm, in rad/s
    for k in range(1, 1200):
        speed[k] = speed[k - 1] + 0.01 * (volts[k - 1] / 0.05 - speed[k - 1]) / 0.2
    columns = {
        "time_s": time,
        "supply_voltage_V": command,
        f"{ammeter}_A": volts - 0.05 * speed + 0.05 * rng.standard_normal(1200),
        "motor_speed_rpm": speed * 30 / np.pi + 3 * rng.standard_normal(1200),
    }
    robot = bench(tmp_path, columns)
    found = rig_facts.saturation_sentence(records.read_runs(tmp_path / "log.csv", robot=robot))
    if limit > 36:
        assert found == ""
        return
    row, shown = re.search(r"row (\d+), supply_voltage_V: commands .* show ([\d.]+) V at most", found).groups()
    assert abs(command[int(row) - 1]) > limit and float(shown) == pytest.approx(limit, rel=0.05)


@pytest.mark.nightly
def test_sds_hold_over_random_logs(tmp_path):
    """Holds of 1 to 4 s, lags up to 0.4 s, 50 to 250 Hz, noise, steps, delays and clocks that jitter."""
    z, levels, kept = [], 0, 0
    for seed in range(16):
        rng = np.random.default_rng([77, seed])
        world = rigs.world(rng, rows=(16, 60))
        rigs.case(world).write(tmp_path)
        log = rigs.log(
            world, rng, hold=rng.uniform(1, 4), rate=rng.choice([50, 100, 250]), lag=rng.uniform(0.02, 0.4),
            noise=rng.uniform(0.5, 6), jitter=rng.uniform(0, 0.3), delay=rng.choice([0, 0, 0.05]),
            step=rng.choice([0, 0, 1, 3]),
        )  # fmt: skip
        log.write(tmp_path / "log.csv")
        found = settled(tmp_path, robot_file.read_robot(tmp_path / "rig.toml"))
        z.append(np.abs(deviations(log, found)).ravel())
        levels, kept = levels + len(world.conditions), kept + len(found.kept)
    every = np.concatenate(z)
    assert 0.8 < np.sqrt(np.mean(every**2)) < 1.25 and np.mean(every > 3) < 0.03 and np.mean(every > 5) < 5e-3
    assert kept > 0.8 * levels


@pytest.mark.slow
def test_25_000_rows_are_settled_in_seconds(tmp_path):
    _, _, robot = made(tmp_path, 9, "bench", "voltage", rate=250.0)
    text = (tmp_path / "log.csv").read_text().splitlines()
    rows = min(len(text) - 1, 25_000)
    (tmp_path / "log.csv").write_text("\n".join(text[: rows + 1]) + "\n")
    began = time.process_time()
    assert rows > 15_000 and settled(tmp_path, robot).kept
    assert time.process_time() - began < 10 * rows / 25_000
