"""Feedforward constants of WPILib: against an independent least squares, and with seeded faults."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pages import drawn
from scipy.optimize import approx_fprime

from calibration.data import runs as records
from calibration.described import sentences
from calibration.inference.feedforward import DriveLog, Tolerances, feedback_gains, fit_feedforward
from sweeps.commands.calibrate import voltage_fit
from sweeps.report import calibration_report
from tests.commands import csv_text, ends, read_json, text_file

TESTS = ("quasistatic-forward", "quasistatic-reverse", "dynamic-forward", "dynamic-reverse")
STEP, FINE = 0.02, 5


def simulated(seed, fault="", tests=TESTS, kG=0.0, arm=False):
    """A log of a drive by explicit steps of 1 ms. Returns it with kS, kV, kA."""
    rng = default_rng(seed)
    kS, kV, kA = rng.uniform(0.1, 0.4), rng.uniform(0.1, 0.2), rng.uniform(0.04, 0.08)
    rows, scale, dt = [], 60 if fault == "unit" else 1, STEP / FINE
    for test in tests:
        sign = 1 if test.endswith("forward") else -1
        x = v = 0.0
        places, speeds, past = [0.0] * 200, [0.0] * 200, []
        for k in range(int((6 if test[0] == "q" else 2) / STEP)):
            u = sign * (min(1.0 * k * STEP, 7.0) if test[0] == "q" else 7.0)
            shown = np.mean(past or 0.0) if fault == "filter" else v
            x_read, shown = (places[-20], speeds[-20]) if fault == "delay" else (x, scale * shown)
            reading = x_read + rng.normal(0, 2e-4), shown + scale * rng.normal(0, 0.02)
            past = [*past[-4:], v]
            for _ in range(FINE):
                supply = 12.5 - 0.4 * abs(u - kV * v) if fault == "sag" else 12.5
                middle = v
                for part in (dt / 2, dt):  # the midpoint rule
                    net = u * supply / 12.5 - kV * middle - kG * (np.cos(np.pi / 180 * x) if arm else 1)
                    net -= kS * np.sign(v) if v else np.clip(net, -kS, kS)
                    beyond = net - np.clip(net, -3.0, 3.0)
                    net += {"limit": -1.0, "skid": 1.5}.get(fault, 0.0) * beyond
                    middle, before = v + net / kA * part, middle
                x, v = x + before * dt, middle
                places, speeds = [*places[1:], x], [*speeds[1:], v]
            rows.append([test, k * STEP, -u if fault == "sign" else u, *reading, supply])
    *columns, battery = map(np.array, zip(*rows, strict=True))
    return DriveLog(*columns, battery=battery if fault == "sag" else None), (kS, kV, kA)


def least_squares(log):
    """Next speed on speed, voltage and direction: the exact law of a held voltage. Returns constants and sds."""
    v, following = log.velocity[:-1], log.velocity[1:]
    moves = (log.run[:-1] == log.run[1:]) & (np.abs(v) > 1.0) & (np.abs(following) > 1.0)
    y, x = following[moves], np.stack([v, log.voltage[:-1], np.sign(v)], -1)[moves]
    solved, cost, *_ = np.linalg.lstsq(x, y, rcond=None)

    def constants(b):
        kV = (1 - b[0]) / b[1]
        return np.array([-b[2] / b[1], kV, -kV * STEP / np.log(b[0])])

    jacobian = approx_fprime(solved, constants, 1e-7)
    spread = cost / (len(y) - 3) * np.linalg.inv(x.T @ x)
    return constants(solved), np.sqrt(np.diag(jacobian @ spread @ jacobian.T))


@pytest.mark.parametrize("seed", range(10))
def test_constants_are_those_of_an_independent_least_squares(seed):
    log, true = simulated(seed)
    found = fit_feedforward(log)
    values, sds = np.array([*found.constants.values()]), np.array([*found.sds.values()])
    other, spread = least_squares(log)
    assert (np.abs(values - other) < spread).all()
    assert (np.abs(values - true) < 4 * sds).all()
    assert not found.remarks


@pytest.mark.parametrize("fault", ["sign", "unit", "sag", "limit", "delay", "skid", "filter", "missing"])
@pytest.mark.parametrize("seed", [1, 2])
def test_seeded_faults_are_named(seed, fault):
    log, true = simulated(seed, fault, TESTS[:2] if fault == "missing" else TESTS)
    found = fit_feedforward(log)
    codes = [r.code for r in found.remarks if fault != "missing" or r.code != "feedforward_no_kA"]
    assert codes == [f"feedforward_{fault}"] + ["feedforward_gains_delayed"] * (fault in ("delay", "filter"))
    if fault not in ("sag", "missing"):
        assert_allclose([*found.constants.values()], true, rtol=0.08, atol=0.02)
    assert all(sentences(found.remarks))


@pytest.mark.parametrize("mechanism, arm", [("elevator", False), ("arm", True)])
def test_weight_of_a_lift_and_of_an_arm(mechanism, arm):
    log, true = simulated(3, kG=0.5, arm=arm)
    found = fit_feedforward(replace(log, unit="degree"), mechanism)
    assert_allclose([*found.constants.values()], [*true, 0.5], rtol=0.03)


def test_friction_that_differs_by_direction_is_named():
    log, (kS, *_) = simulated(3, kG=0.05)
    (remark,) = fit_feedforward(log).remarks
    assert remark.code == "feedforward_direction"
    assert_allclose([remark.forward, remark.backward], [kS + 0.05, kS - 0.05], atol=0.01)


def test_constant_of_acceleration_that_is_not_determined_gives_no_gains():
    log, _ = simulated(1, tests=TESTS[:2])
    noise = default_rng(0).normal(0, 0.5, len(log.time))
    found = fit_feedforward(replace(log, velocity=log.velocity + noise))
    assert "feedforward_no_kA" in [r.code for r in found.remarks] and not found.gains


def test_gains_solve_the_riccati_equation_by_iteration():
    kV, kA, dt, q, r = 2.0, 0.4, 0.02, 1.5, 7.0
    a, b = np.exp(-kV / kA * dt), (1 - np.exp(-kV / kA * dt)) / kV
    p = 0.0
    for _ in range(2000):
        k = a * b * p / (1 / r**2 + b * b * p)
        p = 1 / q**2 + a * a * p - a * b * p * k
    assert_allclose(feedback_gains(kV, kA, Tolerances())["velocity_kP"], k, rtol=1e-9)
    late = feedback_gains(kV, kA, Tolerances(delay=0.05))["velocity_kP"]
    assert_allclose(late, k * (a - b * k) ** 2.5, rtol=1e-9)


def test_a_log_of_voltage_and_speed_has_two_plots_on_any_page():
    """With the constants of the same fit as of `--feedforward`. Settled runs and a log at rest have none."""
    log, _ = simulated(1)
    columns = {"run_id": log.run, "time_s": log.time, "supply_voltage_V": log.voltage}
    runs = records.Runs("log.csv", columns | {"output_speed_rpm": 60.0 * log.velocity})
    found = voltage_fit(runs)
    direct = fit_feedforward(replace(log, position=None))
    assert found.constants == pytest.approx(direct.constants, rel=1e-6)
    quasistatic, dynamic, constants = calibration_report.voltage_section(found).blocks
    assert (quasistatic.name, dynamic.name) == ("quasistatic", "dynamic")
    assert [row[1] for row in constants.rows] == list(found.constants.values())
    rest = records.Runs("rest.csv", columns | {"output_speed_rpm": 0.0 * log.velocity})
    assert voltage_fit(rest) is voltage_fit(records.read_runs("measured")) is None


def test_command_writes_constants_of_a_log(tmp_path, mmrjax):
    log, true = simulated(4)
    columns = {"run_id": log.run, "time_s": log.time, "supply_voltage_V": log.voltage}
    columns |= {"output_angle_turns": log.position, "output_speed_turns_s": log.velocity}
    text_file(tmp_path / "log.csv", csv_text(columns))
    ends(mmrjax("calibrate log.csv --feedforward simple --out fit"), "kS = ", code=0)
    found = read_json(tmp_path / "fit/feedforward.json")
    values = [found["feedforward"][name]["value"] for name in ("kS", "kV", "kA")]
    assert_allclose(values, true, rtol=0.02)
    assert found["feedforward"]["kV"]["unit"] == "V·s/rotation" and found["feedback"]["velocity_kP"]["value"] > 0
    assert {"quasistatic", "dynamic"} <= drawn((tmp_path / "fit/report.html").read_text("utf-8"))
