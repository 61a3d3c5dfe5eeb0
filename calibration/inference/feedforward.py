"""Feedforward constants of a drive, V = kS·sgn(v) + kV·v + kA·a + kG, fitted to a log, and feedback gains.

The law is integrated over windows: Δv = (∫u - kS ∫sgn(v) - kV ∫v - kG T) / kA. No acceleration is computed from noisy
speeds, and the noise stands on the left side alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import scipy.linalg

from calibration.data import Columns, Json, Names
from calibration.data.input_errors import BadData
from calibration.data.writing import entries_of
from calibration.inference.fit_notes import Remark
from calibration.inference.identifiability import Z95

#: Units of position, with radians in one of them (of a length: 0).
UNITS = {"rotation": 2 * np.pi, "rad": 1.0, "degree": np.pi / 180, "m": 0.0}
#: Constants of the law. Only a lift and an arm have the last one.
CONSTANTS = "kS", "kV", "kA", "kG"
#: Names of the four tests, and what a log without them calls them.
TESTS = {
    "quasistatic-forward": "slow-forward", "quasistatic-reverse": "slow-backward",
    "dynamic-forward": "fast-forward", "dynamic-reverse": "fast-backward",
}  # fmt: skip
#: Length of a window [s], its fewest samples, and the fewest windows of a fit.
WINDOW, FEWEST, WINDOWS = 0.06, 3, 8
#: Longest delay that is looked for [s], and the gain of log likelihood that a finding needs.
LONGEST, CERTAIN = 0.25, 12.0
#: Delay that is reported [samples]: a shorter one is how the log pairs voltage and motion.
LATE = 0.75
#: Least speed of a window that counts [share of the largest].
MOVES = 0.03
#: Least misfit of a straight law that a bend removes [share of the change of speed].
LEAST = 0.05
#: Ratio of a speed in a wrong unit to the rate of the position.
WRONG_UNITS = (60.0, 1 / 60, 2 * np.pi, 1 / (2 * np.pi), 360.0, 1 / 360, 60 / (2 * np.pi), 1000.0, 100.0)


@dataclasses.dataclass(frozen=True)
class DriveLog:
    """Recorded signals of a drive. `velocity`, `position` and `current` may be missing (None).

    Attributes:
        run: name of the run in each row.
        time: time [s].
        voltage: motor voltage [V].
        position, velocity: position [unit] and velocity [unit/s].
        current: motor current [A].
        battery: battery voltage, at its own times [V].
        unit: one of `UNITS`.
    """

    run: np.ndarray
    time: np.ndarray
    voltage: np.ndarray
    position: np.ndarray | None
    velocity: np.ndarray | None
    current: np.ndarray | None = None
    battery: np.ndarray | None = None
    unit: str = "rotation"


@dataclasses.dataclass(frozen=True)
class Tolerances:
    """Tolerances that define the weights of the regulators (Bryson's rule), and their timing. Defaults as in SysId of
    WPILib.

    Attributes:
        position: tolerated error of position [unit].
        velocity: tolerated error of velocity [unit/s].
        effort: largest voltage [V].
        period: period of the control loop [s].
        delay: delay of the measurement [s].
    """

    position: float = 1.0
    velocity: float = 1.5
    effort: float = 7.0
    period: float = 0.02
    delay: float | None = None


@dataclasses.dataclass(frozen=True)
class Feedforward:
    """Feedforward constants of a drive with their standard deviations, and feedback gains.

    Attributes:
        constants, sds: constants kS, kV, kA and, where it applies, kG, and their standard deviations, by name.
        missing: SysId tests that the log lacks.
        delay: delay between voltage and motion, including a filter of the speed [s].
        gains: feedback gains by name.
        windows: for each time window: mean voltage, speed and acceleration, and True if the acceleration is small.
    """

    mechanism: str
    unit: str
    constants: dict[str, float]
    sds: dict[str, float]
    gains: dict[str, float]
    tolerances: Tolerances
    delay: float
    filter_lag: float
    missing: Names
    windows: Columns
    remarks: tuple[Remark, ...]

    def to_json(self) -> Json:
        """Content of `feedforward.json`. Intervals are 95 % intervals."""
        units = constant_units(self.unit)
        return {
            "schema": "mmrjax.feedforward/1",
            "mechanism": self.mechanism,
            "feedforward": {
                name: {
                    "value": x,
                    "sd": self.sds[name],
                    "interval": interval_95(x, self.sds[name]),
                    "unit": units[name],
                }
                for name, x in self.constants.items()
            },
            "feedback": {name: {"value": x, "unit": units[name.split("_")[-1]]} for name, x in self.gains.items()},
            **entries_of(self, "tolerances", "delay_s=delay", "filter_lag_s=filter_lag", "missing_tests=missing"),
            "remarks": [{"code": r.code, **r.values} for r in self.remarks],
        }


def interval_95(value: float, sd: float) -> list[float]:
    """95 % interval of a normal distribution."""
    return [value - Z95 * sd, value + Z95 * sd]


def constant_units(unit: str) -> dict[str, str]:
    """Unit of each constant and gain."""
    return {
        "kS": "V", "kG": "V", "kV": f"V·s/{unit}", "kA": f"V·s²/{unit}", "kP": f"V/{unit}", "kD": f"V·s/{unit}",
    }  # fmt: skip


def fit_feedforward(log: DriveLog, mechanism: str = "simple", tolerances: Tolerances | None = None) -> Feedforward:
    """Fits the constants of a drive and computes feedback gains, or gives reasons why some cannot be computed.

    Raises:
        BadData: there is too little motion. The message names the missing tests.
    """
    missing = missing_tests(log)
    log, lag, remarks = _speed_from_position(log)
    windows = _motion_windows(log, 0.0)
    if len(windows["u"]) < WINDOWS:
        missing_words = f"; missing: {', '.join(missing)}" if missing else ""
        raise BadData(
            f"the log has fewer than {WINDOWS} windows of {WINDOW:g} s in motion; expected SysId's four "
            f"tests{missing_words}"
        )
    if _fit_constants(windows, "simple")[0][1] < 0:
        remarks.append(Remark("feedforward_sign"))
        log = dataclasses.replace(log, voltage=-log.voltage)
    delay, windows, limit_level, bend = _fit_delay_and_slope_change(log, mechanism)
    if delay > LATE * _median_time_step(log):
        remarks.append(Remark("feedforward_delay", delay=delay))
    else:
        delay = 0.0
    if limit_level:
        largest_current = None if log.current is None else float(np.nanmax(np.abs(log.current)))
        limited = Remark("feedforward_limit", level=limit_level, current=largest_current)
        remarks.append(limited if bend < 0 else Remark("feedforward_skid", level=limit_level))
        windows = {key: x[windows["demand"] < limit_level] for key, x in windows.items()}
    values, covariance, _ = _fit_constants(windows, mechanism)
    sd_values = np.sqrt(np.diag(covariance))
    constants, sds = (dict(zip(CONSTANTS, x.tolist(), strict=False)) for x in (values, sd_values))
    if mechanism == "simple":
        # A constant voltage beside friction is half the difference of both directions.
        with_bias, variances, _ = _fit_constants(windows, "elevator")
        bias = with_bias[3]
        sd = np.sqrt(variances[3, 3])
        forward, backward = float(with_bias[0] + bias), float(with_bias[0] - bias)
        if {*np.sign(windows["s"])} == {1.0, -1.0} and abs(bias) > 4 * sd and abs(bias) > 0.05 * abs(with_bias[0]):
            remarks.append(Remark("feedforward_direction", forward=forward, backward=backward))
    if log.battery is not None and np.isfinite(log.battery).any():
        highest, lowest = float(np.nanmax(log.battery)), float(np.nanmin(log.battery))
        if lowest < 0.9 * highest:
            remarks.append(Remark("feedforward_sag", rest=highest, low=lowest))
    if missing:
        remarks.append(Remark("feedforward_missing", tests=missing))
    kA_interval_share = Z95 * sds["kA"] / constants["kA"]
    if not (determined := 0 < kA_interval_share < 0.5):
        missing_dynamic = [t for t in missing if t.startswith("dynamic")]
        remarks.append(Remark("feedforward_no_kA", share=abs(kA_interval_share), missing=missing_dynamic))
    tolerances_used = tolerances or Tolerances()
    if tolerances_used.delay is None:
        tolerances_used = dataclasses.replace(tolerances_used, delay=delay + lag)
    gains = {}
    if determined and constants["kV"] > 0:
        gains = feedback_gains(constants["kV"], constants["kA"], tolerances_used)
    if gains and tolerances_used.delay:
        prompt = feedback_gains(constants["kV"], constants["kA"], dataclasses.replace(tolerances_used, delay=0.0))
        remarks.append(Remark("feedforward_gains_delayed", delay=tolerances_used.delay, slow=gains["velocity_kP"],
                              prompt=prompt["velocity_kP"]))  # fmt: skip
    integrals = {"voltage_V": "u", "velocity": "x", "acceleration": "dv", "direction": "s"}
    means = {name: windows[key] / windows["T"] for name, key in integrals.items()}
    window_columns = {"run": windows["run"], **means, "quasistatic": windows["quasistatic"]}
    return Feedforward(
        mechanism, log.unit, constants, sds, gains, tolerances_used, delay, lag, missing, window_columns,
        tuple(remarks),
    )  # fmt: skip


def feedback_gains(kV: float, kA: float, tolerances: Tolerances) -> dict[str, float]:
    """Gains of the velocity and position regulators (LQR).

    As in WPILib: state cost 1/q², effort cost 1/r², voltage held over a period, and K (A - B K)^(delay / period) for
    a delay (`FeedbackAnalysis.cpp` and `LinearQuadraticRegulator::LatencyCompensate` of wpilibsuite/allwpilib).
    """
    velocity_gains = _lqr_gains(np.array([[-kV / kA]]), np.array([[1 / kA]]), [tolerances.velocity], tolerances)
    position_gains = _lqr_gains(
        np.array([[0, 1], [0, -kV / kA]]),
        np.array([[0], [1 / kA]]),
        [tolerances.position, tolerances.velocity],
        tolerances,
    )
    return {"velocity_kP": velocity_gains[0], "position_kP": position_gains[0], "position_kD": position_gains[1]}


def _lqr_gains(a: np.ndarray, b: np.ndarray, tolerated: list[float], tolerances: Tolerances) -> list[float]:
    n = len(a)
    discrete_system = scipy.linalg.expm(np.block([[a, b], [np.zeros((1, n + 1))]]) * tolerances.period)
    a, b = discrete_system[:n, :n], discrete_system[:n, n:]
    cost = np.diag(1 / np.square(tolerated))
    effort = np.array([[1 / tolerances.effort**2]])
    riccati = scipy.linalg.solve_discrete_are(a, b, cost, effort)
    gains = np.linalg.solve(effort + b.T @ riccati @ b, b.T @ riccati @ a)
    transition_over_delay = scipy.linalg.fractional_matrix_power(
        a - b @ gains, (tolerances.delay or 0.0) / tolerances.period
    )
    return [float(x) for x in np.real(gains @ transition_over_delay)[0]]


def missing_tests(log: DriveLog) -> Names:
    """SysId tests that a log lacks. Empty if the voltage is neither a ramp nor a step."""
    present = set()
    for name in dict.fromkeys(log.run.tolist()):
        test_name = next((t for t, log_name in TESTS.items() if t in name or log_name in name), None)
        u = _driven_voltages(log.voltage[log.run == name])
        if test_name is None and len(u) > WINDOWS:
            rises = np.mean(np.diff(np.abs(u)) >= 0) > 0.95
            kind = "dynamic" if not _is_ramp(u) else "quasistatic" if rises else ""
            if not kind or not (np.all(u > 0) or np.all(u < 0)):
                return ()
            test_name = f"{kind}-{'forward' if u[0] > 0 else 'reverse'}"
        present.add(test_name)
    return tuple(t for t in TESTS if t not in present)


def _median_time_step(log: DriveLog) -> float:
    steps = np.diff(log.time)[log.run[1:] == log.run[:-1]]
    return float(np.median(steps[steps > 0]))


def _speed_from_position(log: DriveLog) -> tuple[DriveLog, float, list[Remark]]:
    """Log whose speed is the derivative of its position, the lag of its recorded speed [s], and remarks."""
    if log.position is None:
        return log, 0.0, []
    step = _median_time_step(log)
    rate = np.zeros(len(log.time))
    for rows in _rows_of_runs(log):
        t, x = log.time[rows], log.position[rows]
        rate[rows] = np.nan  # at the ends
        rate[rows[1:-1]] = (x[2:] - x[:-2]) / np.maximum(t[2:] - t[:-2], 1e-9)
    if log.velocity is None:
        return dataclasses.replace(log, velocity=rate), 0.0, []
    remarks = []
    speed = log.velocity
    moving = np.abs(rate) > 0.2 * np.nanmax(np.abs(rate))
    ratio = float(np.median(speed[moving] / rate[moving])) if moving.any() else 1.0
    if ratio < 0:
        remarks.append(Remark("feedforward_speed_sign"))
    if abs(abs(ratio) - 1) > 0.05:
        nearest = min(WRONG_UNITS, key=lambda f: abs(np.log(abs(ratio) / f)))
        is_close = abs(np.log(abs(ratio) / nearest)) < 0.03
        remarks.append(Remark("feedforward_unit", ratio=abs(ratio), near=nearest if is_close else 0.0))
        speed = speed / abs(ratio)
    speed = speed * np.sign(ratio)
    lags = np.arange(0, LONGEST, step / 4)
    misfit = [
        sum(np.nansum((rate[r] - np.interp(log.time[r] + lag, log.time[r], speed[r]))[: -int(LONGEST / step)] ** 2)
            for r in _rows_of_runs(log) if len(r) > 2 * LONGEST / step)
        for lag in lags
    ]  # fmt: skip
    best = int(np.argmin(misfit))
    if lags[best] > step and 0.5 * len(rate) * np.log(misfit[0] / misfit[best]) > CERTAIN:
        remarks.append(Remark("feedforward_filter", lag=float(lags[best])))
        return dataclasses.replace(log, velocity=rate), float(lags[best]), remarks
    return dataclasses.replace(log, velocity=speed), 0.0, remarks


def _rows_of_runs(log: DriveLog) -> Iterator[np.ndarray]:
    for name in dict.fromkeys(log.run.tolist()):
        yield np.flatnonzero(log.run == name)


def _motion_windows(log: DriveLog, delay: float) -> Columns:
    """Integrals over time windows of motion in one direction: voltage u, path x, direction s, length T, change of
    speed dv.
    """
    windows = []
    step = _median_time_step(log)
    speeds = np.asarray(log.velocity)
    smallest_speed = MOVES * np.nanmax(np.abs(speeds))
    count = max(FEWEST, round(WINDOW / step))
    for rows in _rows_of_runs(log):
        t, u, v = log.time[rows], log.voltage[rows], speeds[rows]
        voltage_integral = np.r_[0, np.cumsum(u[:-1] * np.diff(t))]
        path = np.r_[0, np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(t))] if log.position is None else log.position[rows]
        drive_times = t - delay
        rests = not abs(v[0]) >= smallest_speed  # a test begins without voltage
        drive_integral = np.interp(drive_times, t, voltage_integral) + np.minimum(drive_times - t[0], 0) * (
            0.0 if rests else u[0]
        )
        drive_integral += np.maximum(drive_times - t[-1], 0) * u[-1]
        angle = np.zeros(len(t)) if log.position is None else log.position[rows] * UNITS[log.unit]
        ramp = _is_ramp(_driven_voltages(u))
        rows_of_windows = np.arange(len(t) - count)[:, None] + np.arange(count + 1)
        signs = np.sign(v[rows_of_windows])
        longest = max(3 * WINDOW, 2 * count * step)
        moves = (signs == signs[:, :1]).all(1) & (np.abs(v[rows_of_windows]).min(1) > smallest_speed)
        rows_of_windows = rows_of_windows[moves & (np.ptp(t[rows_of_windows], axis=1) <= longest)]
        u, x, dv, length = (
            signal[rows_of_windows[:, -1]] - signal[rows_of_windows[:, 0]] for signal in (drive_integral, path, v, t)
        )
        cosine, sine = (length * f(angle[rows_of_windows]).mean(1) for f in (np.cos, np.sin))
        labels = [np.full(len(u), value) for value in (log.run[rows[0]], count, ramp)]
        windows.append(
            (
                *labels,
                rows[rows_of_windows[:, 0]],
                u,
                x,
                dv,
                length,
                np.sign(v[rows_of_windows[:, 0]]) * length,
                cosine,
                sine,
            )
        )
    keys = "run", "count", "quasistatic", "row", "u", "x", "dv", "T", "s", "cos", "sin"
    return {key: np.concatenate(parts) for key, parts in zip(keys, zip(*windows, strict=True), strict=True)}


def _driven_voltages(voltage: np.ndarray) -> np.ndarray:
    """Voltages of a run while the motor is driven."""
    return voltage[np.abs(voltage) > 0.05 * np.abs(voltage).max()]


def _is_ramp(driven: np.ndarray) -> bool:
    """True if the driving voltages of a test change, False for a voltage step."""
    size = np.abs(driven)
    return bool(len(size) and size.std() > 0.1 * size.mean())


def _regression_matrix(w: Columns, mechanism: str) -> np.ndarray:
    more = {"simple": (), "elevator": (w["T"],), "arm": (w["cos"], w["sin"])}[mechanism]
    return np.stack([w["u"], -w["s"], -w["x"], *(-x for x in more)], axis=1)


def _fit_constants(w: Columns, mechanism: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Fits the constants kS, kV, kA (and kG). Returns them, their covariance and the sum of squares.

    Windows overlap, so the covariance allows for correlated residuals.
    """
    matrix = _regression_matrix(w, mechanism)
    coefficients, *_ = np.linalg.lstsq(matrix, w["dv"], rcond=None)
    speed_change_error = w["dv"] - matrix @ coefficients
    inverse = np.linalg.pinv(matrix.T @ matrix)
    leverage = np.einsum("ij,jk,ik->i", matrix, inverse, matrix)
    scores = matrix * (speed_change_error / np.maximum(1 - leverage, 0.05))[:, None]
    score_covariance = scores.T @ scores
    for lag in range(1, w["count"][0] + 1):  # weights of Newey and West (1987)
        is_neighbour = (w["row"][lag:] - w["row"][:-lag] == lag) & (w["run"][lag:] == w["run"][:-lag])
        lagged_product = (scores[lag:] * is_neighbour[:, None]).T @ scores[:-lag]
        score_covariance += (1 - lag / (w["count"][0] + 1)) * (lagged_product + lagged_product.T)
    coefficient_covariance = inverse @ score_covariance @ inverse

    def constants(x: np.ndarray) -> np.ndarray:
        gravity = x[3:] if mechanism != "arm" else [np.sqrt(x[3] ** 2 + x[4] ** 2)]
        return np.array([x[1], x[2], 1.0, *gravity]) / x[0]

    step = 1e-30  # in the imaginary direction, which gives exact derivatives (Squire and Trapp, SIAM Rev. 40 (1998))
    derivatives = np.stack(
        [constants(coefficients + 1j * step * unit).imag / step for unit in np.eye(len(coefficients))], 1
    )
    covariance = derivatives @ coefficient_covariance @ derivatives.T
    return constants(coefficients), covariance, float(speed_change_error @ speed_change_error)


def _fit_delay_and_slope_change(log: DriveLog, mechanism: str) -> tuple[float, Columns, float, float]:
    """Delay [s], the windows with it, the accelerating voltage above which the slope changes [V], and that change.

    Each is 0 unless the likelihood requires it. A current limit looks like a delay, so the better of both is fitted
    first.
    """
    step = _median_time_step(log)
    trials = []
    shifts = [*np.arange(-8, 8) / 8, *np.arange(2, 2 * LONGEST / step) / 2]
    for delay in step * np.array(sorted(shifts, key=abs)):
        windows = _motion_windows(log, float(delay))
        misfit = _fit_constants(windows, mechanism)[2]
        level, bend, cost = _slope_change(windows, mechanism)
        trials += [(misfit, float(delay), windows, 0.0, 0.0), (cost, float(delay), windows, level, bend)]
    count = 0.5 * len(trials[0][2]["u"]) / trials[0][2]["count"][0]

    def penalised(trial: tuple[float, float, Columns, float, float]) -> float:
        cost, delay, _, level, bend = trial
        if level and abs(bend) < 0.3:
            return np.inf
        penalty = CERTAIN if delay > LATE * step else 3.0 * (delay != 0)
        return float(count * np.log(cost) + penalty + 2 * CERTAIN * (level > 0))

    return min(trials, key=penalised)[1:]


def _slope_change(w: Columns, mechanism: str) -> tuple[float, float, float]:
    """Accelerating voltage above which the slope changes [V], that change, and the sum of squares.

    A negative change is less acceleration (a current limit), a positive one more (slipping wheels). Sets `demand`.
    """
    values, _, misfit = _fit_constants(w, mechanism)
    level = 0.0
    bend = 0.0
    cost = np.inf
    is_relevant = False
    for _ in range(3):
        accelerating_voltage = (w["u"] - values[0] * w["s"] - values[1] * w["x"]) / w["T"]
        w["demand"] = np.abs(accelerating_voltage)
        trials = []
        for share in np.linspace(0.15, 0.9, 16):
            limit = share * w["demand"].max()
            above_limit = w["demand"] > limit
            if above_limit.sum() >= 3 and (~above_limit).sum() >= WINDOWS:
                voltage_above_limit = np.sign(accelerating_voltage) * np.maximum(w["demand"] - limit, 0) * w["T"]
                matrix = np.column_stack([_regression_matrix(w, mechanism), voltage_above_limit])
                slope = np.linalg.lstsq(matrix, w["dv"], rcond=None)[0]
                trials.append((float(np.sum((w["dv"] - matrix @ slope) ** 2)), float(limit), slope))
        if not trials:
            break
        cost, level, slope = min(trials, key=lambda x: x[0])
        above_limit = w["demand"] > level
        is_relevant = misfit - cost > LEAST**2 * np.sum(w["dv"][above_limit] ** 2)
        bend = float(slope[-1] / slope[0])
        values = slope[1:] / slope[0]
    return level, bend, cost if is_relevant else np.inf
