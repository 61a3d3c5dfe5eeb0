"""Logs of a servo on PWM and of a carriage on an amplifier, from plain NumPy laws, through the files of `rig new`."""

import numpy as np
import pytest
from numpy.random import default_rng

from calibration.data.robot_file import change_robot
from calibration.data.runs import read_runs
from calibration.data.settling import settle_log
from calibration.data.stated import EXAMPLE
from calibration.data.unused_readings import thin_rows
from calibration.inference import bases, observers
from calibration.inference.preparation import prepare_input
from sweeps.commands import rig_new
from sweeps.points import run as points
from tests.commands import read_rig

STEP = 1e-4  # of the simulation [s]


VOLTS = "supply_voltage_V"


def written(tmp_path, kind, columns):
    """A file of `rig new` and a log of these columns beside it. The template's numbers are those of the log."""
    np.savetxt(
        tmp_path / "log.csv", np.column_stack([*columns.values()]), "%.9g", ",", header=",".join(columns), comments=""
    )
    return read_rig(tmp_path, rig_new.rig_template(kind).replace(EXAMPLE, "measured"))


def sampled(rng, angle, imposed, rate, step):
    """Clock, what is imposed and the angle, as a logger sees them: at uneven times, rounded to `step`."""
    times = np.arange(0, len(angle) * STEP, 1 / rate)
    times[1:] += 0.1 / rate * np.clip(rng.standard_normal(len(times) - 1), -3, 3)
    at = np.minimum((times / STEP).astype(int), len(angle) - 1)
    return times, imposed[at], np.round(angle[at] / step) * step


def turned(imposed, inertia, torque):
    """Angle by explicit steps. `torque`: function of what is imposed, speed and its smoothed sign."""
    speed, angle = np.zeros((2, len(imposed)))
    for n in range(1, len(imposed)):
        last = speed[n - 1]
        sense = np.tanh(last / 0.01) if abs(last) > 1e-6 else np.sign(imposed[n])
        speed[n] = last + STEP * torque(imposed[n], last, sense) / inertia
        angle[n] = angle[n - 1] + STEP * speed[n]
    return angle


#: Supply [V], resistance, torque constant, friction of the motor, ratio, efficiency, viscous loss of the servo's template.
SERVO = 6.0, 4.0, 0.006, 2e-4, 200.0, 0.7, 0.005
#: Metres per radian of the carriage's screw, its dry [N] and viscous friction [N·s/m].
RADIUS, DRY, VISCOUS = 5e-3 / (2 * np.pi), 12.0, 400.0


def servo(rng, levels=(0.4, 0.7, 1.0, -0.6, -0.9), hold=1.2, dry=0.05):
    """U d = k ω_m + R I, J dω/dt = i η (k I - M_f) - M_0 - K ω, of the template's numbers, angle in degrees."""
    volts, r, k, friction, ratio, eta, viscous = SERVO
    duty = np.repeat(levels, round(hold / STEP))

    def torque(duty, speed, sense):
        driving = k * (volts * duty - k * ratio * speed) / r - friction * sense
        return ratio * eta * driving - dry * sense - viscous * speed

    angle = turned(duty, 0.0005 + eta * 1e-7 * ratio**2, torque)
    times, imposed, shown = sampled(rng, np.degrees(angle), duty, 100.0, 360 / 4096)
    return {"time_s": times, VOLTS: np.full(len(times), volts), "duty": imposed, "output_angle_deg": shown}


def carriage(rng, levels=(1.2, 1.6, 2.0, -1.4, -1.8), hold=1.5):
    """m x'' = i k / r - F_0 - b x', of the template's numbers with more that rises with speed, position in mm."""
    current = np.repeat(levels, round(hold / STEP))

    def torque(current, speed, sense):
        return 0.05 * current - (0.004 + DRY * RADIUS) * sense - VISCOUS * RADIUS**2 * speed

    angle = turned(current, 2.5 * RADIUS**2 + 1e-5, torque)
    times, imposed, shown = sampled(rng, 1e3 * RADIUS * angle, current, 200.0, 0.005)
    return {"time_s": times, "motor_current_A": imposed, "position_mm": shown}


def test_a_servos_log_of_pwm_and_angle_settles(tmp_path):
    robot = written(tmp_path, "servo", servo(default_rng(1)))
    found = settle_log(read_runs(tmp_path / "log.csv", robot=robot))
    volts, r, k, friction, ratio, eta, viscous = SERVO
    duty = np.array([0.4, 0.7, 1.0, -0.6, -0.9])
    torque = ratio * eta * (k * volts * np.abs(duty) / r - friction) - 0.05
    exact = np.sign(duty) * torque / (viscous + ratio * eta * k * k * ratio / r) * 30 / np.pi
    shown, sd = np.array([(s.mean["output_speed"], s.sd["output_speed"]) for s in found.kept]).T
    assert shown == pytest.approx(exact, rel=5e-3) and np.abs((shown - exact) / sd).max() < 5
    assert found.table()["duty"] == pytest.approx(duty) and "output_angle_deg" not in found.table()


def test_a_carriages_log_of_current_and_position_settles(tmp_path):
    robot = written(tmp_path, "carriage", carriage(default_rng(2)))
    found = settle_log(read_runs(tmp_path / "log.csv", robot=robot))
    current = np.array([1.2, 1.6, 2.0, -1.4, -1.8])
    exact = np.sign(current) * (0.05 * np.abs(current) - 0.004 - DRY * RADIUS) / (VISCOUS * RADIUS) * 1e3
    assert [s.mean["speed"] for s in found.kept] == pytest.approx(exact, rel=5e-3)
    assert found.table()["motor_current_A"] == pytest.approx(current)


@pytest.mark.slow
@pytest.mark.parametrize("kind, make, column, least", [
    ("servo", servo, "output_angle_deg", 0.05), ("carriage", carriage, "position_mm", 0.005),
])  # fmt: skip
def test_the_model_follows_such_a_log_with_the_numbers_that_it_was_made_of(tmp_path, kind, make, column, least):
    robot = written(tmp_path, kind, make(default_rng(3), hold=0.4))
    if kind == "carriage":
        robot = change_robot(robot, {"carriage.loss_viscous": VISCOUS * RADIUS**2}, "a test")
    runs = read_runs(tmp_path / "log.csv", robot=robot)
    ready = prepare_input(runs, robot)
    shown = points.simulate_histories(ready.robot, runs, None)
    error = np.std(shown[column] - runs[column])
    assert error < 0.01 * np.ptp(runs[column]) and error > 0.1 * least


@pytest.mark.slow
def test_curves_are_over_the_voltage_at_motors_whose_speed_no_channel_reads(tmp_path, monkeypatch):
    """Of a servo on PWM the duty's share of the supply. While the circuit is open, the back-EMF of the run itself."""
    log = {name: column[::2] for name, column in servo(default_rng(4), levels=(0.9,), hold=0.5).items()}
    driven = np.arange(len(log["time_s"])) < 15
    log["duty"] = np.where(driven, log["duty"], 0.0)
    robot = written(tmp_path, "servo", log)
    runs = read_runs({**log, "mode": np.where(driven, "voltage", "coast")}, robot=robot)
    observer = observers.Histories.of(runs, robot)
    seen = {}
    monkeypatch.setattr(bases, "curve_families", lambda columns, *_, **__: seen.update(columns) or ())
    observer.bases(dict(runs.columns), np.ones(len(runs), bool), robot)
    volts = seen[VOLTS]
    assert volts[driven] == pytest.approx(0.9 * 6.0)
    rolls_out = volts[~driven]
    assert 0 < rolls_out[0] < 0.9 * 6.0 and (np.diff(rolls_out) < 1e-3).all() and rolls_out[-1] < 0.5 * rolls_out[0]


def test_a_thinned_log_takes_the_mean_of_its_current_and_fewer_steps(tmp_path):
    """The current changes in each of 4000 rows. It moves the load by as much, and as far, at each reading that is kept."""
    rng, time = default_rng(4), np.arange(4000) * 1e-3
    current = 1.6 * np.sin(5 * time) + 0.4 * np.sin(40 * time) + 0.05 * rng.standard_normal(len(time))
    current[2500:] += 1.0  # a jump, whose row stays

    def travelled(times, amperes):
        """Charge [A·s] and its integral [A·s²] at each instant, of a current that is held from one to the next."""
        lasts = np.diff(times)
        charge = np.append(0.0, np.cumsum(amperes[:-1] * lasts))
        return charge, np.append(0.0, np.cumsum(charge[:-1] * lasts + amperes[:-1] * lasts**2 / 2))

    wanted = travelled(time, current)
    columns = {"time_s": time, "motor_current_A": current, "position_mm": 1e3 * wanted[1]}
    robot = written(tmp_path, "carriage", columns)
    runs = read_runs(tmp_path / "log.csv", robot=robot).of(robot)
    thinned = thin_rows(runs, 500)
    brief = observers.Histories.of(thinned, robot)
    times, amperes = np.asarray(brief.times[0]), np.asarray(brief.conditions.motor_current[0])
    assert len(times) < 0.6 * len(time) and 2.5 in times
    rows = np.searchsorted(time, thinned["time_s"] - 1e-9)
    for simulated, true, error in zip(travelled(times, amperes), wanted, (2e-4, 2e-6), strict=True):
        np.testing.assert_allclose(simulated[np.searchsorted(times, thinned["time_s"])], true[rows], atol=error)
