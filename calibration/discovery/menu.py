"""Menu of experiments: possible ones within reach of a table, with channels to read and risks to watch."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from calibration.data import Names
from calibration.data.input_errors import stated_word
from calibration.discovery.reach import SLOPE, Reach, UsedConditions
from calibration.inference.fit_notes import Remark
from mmrjax.model import balances, channels, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.quantities import RPM
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals, State

# --- setups of a robot ----------------------------------------------------------------------------


#: Signals that are zero for a robot at rest with its motors off.
STILL = ("current", "voltage", "torque_output")
#: Friction of a shaft that is held in a vice [N·m].
BLOCKED = 1e3
#: Function of the robot and the brake's torque on each motor shaft [N·m] that returns the robot as set up.
Setup = Callable[[Robot, Scalar], Robot]


def _with_values(robot: Robot, values: Mapping[str, Scalar]) -> Robot:
    return params.replace(robot, {k: jnp.asarray(v, float) for k, v in values.items()})


def without_effects_of(robot: Robot, *closed: str) -> Robot:
    """The robot with all effects of the balances `closed` set to zero."""
    return _with_values(robot, {f"effects.{e.name}.amplitude": 0.0 for e in robot.effects if e.balance in closed})


def on_ground(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The unchanged robot. Only the setup `braked` uses `brake`."""
    return robot


def facing_backward(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The robot turned around, so that a run backwards is a run forward.

    The run must have the negative slope. Friction, slip and instruments follow the direction of travel, so they do
    not change. Effects that are odd in travel change sign, for instance a slope error, or the zero error of a signed
    instrument.
    """
    odd = (e for e in robot.effects if e.odd_in_travel and e.channel not in robot.rig.magnitudes)
    biased = {f"effects.{e.name}.amplitude": -e.amplitude for e in odd}
    return _with_values(robot, biased)


def lifted(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The robot on stands: tracks or wheels turn freely, without normal load or ground."""
    rolling = {f"{c}.ground.rolling_resistance": 0.0 for c in robot.configurations}
    return _with_values(without_effects_of(robot, "mass", "ground", "slip"), rolling)


def uncoupled(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The motors without gearboxes and load. Only the supply, electrical and motor balances remain."""
    losses = {f"{c}.track.loss_{kind}": 0.0 for c in robot.configurations for kind in ("coulomb", "viscous")}
    gear = {"gearbox.friction_coulomb": 0.0, "gearbox.friction_viscous": 0.0, "gearbox.efficiency_load": 1.0}
    return _with_values(without_effects_of(lifted(robot), "gearbox", "track"), losses | gear)


def locked(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The motors with locked shafts: U_e = E + I R at speed 0."""
    return _with_values(lifted(robot), {"gearbox.friction_coulomb": BLOCKED})


def braked(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The uncoupled motors, each with a brake of constant torque [N·m]."""
    return _with_values(uncoupled(robot), {"gearbox.friction_coulomb": brake})


#: Setups that carry no weight.
WEIGHTLESS = (lifted, uncoupled, locked, braked)


# --- the menu -------------------------------------------------------------------------------------


#: Kinds of experiments that a user may forbid, in addition to configurations; an experiment may have several kinds.
KINDS = (
    "weigh", "zero current", "zero reading", "shunt", "strobe", "timing", "bare motor", "stall", "one motor",
    "braked motor", "reverse", "downhill", "lifted", "payload", "other voltages", "steepest slope", "crawl",
    "other torques",
)  # fmt: skip
#: Largest share of the adhesion for the fitted robot on a slope steeper than the table's [-].
GRIP = 0.95
#: Temperature of a winding from which its limit is unknown [°C].
UNLIMITED = 1e6
#: Distance from a limit at which a quantity is watched: of a winding [K], of a speed [-].
WARM, FAST = 25.0, 0.85


# --- experiments ------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class CalibrationAct:
    """A reading that calibrates an instrument or a mass without a run of the robot.

    Attributes:
        name: name of the calibration.
        kinds: kinds from `KINDS`.
        reading: function that returns the readings of a robot at these settings [SI], shape (readings,).
        at: settings of each reading [SI]. For `weigh`: index of the configuration, and payload.
        sd: standard deviation of a single reading [SI]. None: as in the table for `channel`.
        repeats: number of readings that are averaged.
        channel: channel of the instrument if its zero is read, "" otherwise.
    """

    name: str
    kinds: Names
    reading: Callable[[Robot, Array], Array]
    at: tuple[tuple[float, ...], ...]
    sd: float | None
    repeats: int = 10
    channel: str = ""


@dataclasses.dataclass(frozen=True)
class ProposedRuns:
    """Settled runs under conditions that are not in the table.

    Attributes:
        name: name of the runs.
        kinds: kinds from `KINDS`, and the configuration where there is one.
        doing: row of `experiment_words.DOING` that describes them.
        setup: setup of the robot. voltage [V], slope [deg], payload [kg]: conditions of each run, shape (runs,).
        channels: names of the channels to read.
        reach: reach of the table. Levels of the imposed quantity are in `voltage`: [V], [rad/s] for `motor_speed`,
            [A] for `motor_current`.
        used: conditions of the table with the configuration of the runs. None: any configuration.
        sides: number of motors that are on. None: all.
        brake: brake torque on each motor shaft [N·m].
        steepest: True if only the steepest slope that the robot can climb is informative.
        torque: torque of a brake on the output, positive against forward rotation [N·m]. Empty without a brake.
        watch: remarks on risks of damage.
        repeats: number of readings that are averaged.
    """

    name: str
    kinds: Names
    doing: str
    setup: Setup
    voltage: tuple[float, ...]
    slope: tuple[float, ...]
    payload: tuple[float, ...]
    channels: Names
    reach: Reach
    used: UsedConditions | None = None
    sides: int | None = None
    brake: float = 0.0
    steepest: bool = False
    torque: tuple[float, ...] = ()
    watch: tuple[Remark, ...] = ()
    repeats: int = 3

    @property
    def configuration(self) -> int:
        """Index of the configuration."""
        return 0 if self.used is None else self.used.index


Experiment = CalibrationAct | ProposedRuns


def round_significant(value: float, digits: int = 2) -> float:
    """The number, rounded to this many significant digits."""
    return float(f"{value:.{digits - 1}e}")


#: Least setting of a speed, current or voltage, as a share of the largest of a table.
LEAST_SETTING = 0.05
#: Usual steps of settings, times powers of ten.
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
#: Tolerance of a setting above the table's largest, because readings scatter [-].
SETTING_TOLERANCE = 0.01


def step_of_settings(span: float, count: int) -> float:
    """Step from `STEPS` that is nearest to an even division of a span into `count` parts. 0 for no span."""
    if span <= 0:
        return 0.0
    step = span / count
    power = 10.0 ** math.floor(math.log10(step))
    return round_significant(min((s * power for s in STEPS), key=lambda s: abs(math.log(s / step))))


def last_setting(most: float, step: float) -> float:
    """Largest multiple of a step up to `most`, with `SETTING_TOLERANCE`. `most` itself if the step is 0."""
    if step == 0:
        return most
    return float(f"{step * math.floor(most * (1 + SETTING_TOLERANCE) / step + 1e-9):.6g}")


def floor_significant(value: float) -> float:
    """Positive number, rounded down to two significant digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return round_significant(math.floor(value / step + 1e-9) * step)


def spaced_settings(least: float, most: float, count: int) -> tuple[float, ...]:
    """Evenly spaced settings, rounded to two digits, none above `most`."""
    top = floor_significant(most)
    return tuple(sorted({min(round_significant(v), top) for v in np.linspace(least, top, count).tolist() if v > 0}))


# --- acts -------------------------------------------------------------------------------------------


def _mass_difference(robot: Robot, settings: Array) -> Array:
    """Mass of the loaded robot minus the mass that its file states."""
    zero_state = State(*(jnp.zeros(()),) * 4)
    plain_robot = without_effects_of(robot, "mass")
    conditions = [Conditions(configuration=k.astype(int), payload=m) for k, m in settings]
    return jnp.stack(
        [
            balances.begin_signals(robot, c, zero_state).mass
            - balances.begin_signals(plain_robot, c, zero_state).mass
            for c in conditions
        ]
    )


@dataclasses.dataclass(frozen=True)
class _Instrument:
    """Function that returns the readings of an instrument at known values of these signals."""

    channel: str
    signals: Names

    def __call__(self, robot: Robot, settings: Array) -> Array:
        signals = [Signals(**dict.fromkeys(self.signals, x)) for (x,) in settings]
        return jnp.stack([jnp.asarray(balances.sensor(robot, s)[self.channel]) for s in signals])


def calibration_acts(reach: Reach) -> tuple[CalibrationAct, ...]:
    """Calibrations that are possible with the instruments of the table, those of least effort first."""
    payload = round_significant(max(u.payloads[-1] for u in reach.used))
    loads = (0.0, payload) if payload > 0 else (0.0,)
    total_current = reach.current * reach.motors
    shunt_currents = round_significant(0.15 * total_current, 1), round_significant(0.75 * total_current, 1)
    motor_speeds = round_significant(0.25 * reach.motor_speed), round_significant(0.65 * reach.motor_speed)
    speeds = round_significant(0.35 * reach.speed), round_significant(0.8 * reach.speed)
    settings = tuple((float(u.index), m) for u in reach.used for m in loads)

    def acts_with_channel(
        name: str, channel: str, signal: str, values: tuple[float, ...], sd: float
    ) -> list[CalibrationAct]:
        act = CalibrationAct(name, (name,), _Instrument(channel, (signal,)), tuple((v,) for v in values), sd)
        return [act] * (channel in reach.measured)

    acts = [CalibrationAct("weigh", ("weigh",), _mass_difference, settings, 0.02, repeats=1)] * reach.has_ground
    acts += acts_with_channel("zero current", "total_current", "total_current", (0.0,), 0.02)
    acts += acts_with_channel("shunt", "total_current", "total_current", shunt_currents, 0.02)
    for c in channels.channels_named(reach.measured):
        if c.misses_zero:
            zero = _Instrument(c.name, STILL)
            acts.append(
                CalibrationAct(f"zero of {c.label}", ("zero reading",), zero, ((0.0,),), None, channel=c.name)
            )
    acts += acts_with_channel("strobe", "motor_speed", "speed_motor", motor_speeds, 5 * RPM)
    acts += acts_with_channel("timing", "speed", "speed", speeds, 3e-3)
    return tuple(acts)


# --- runs -------------------------------------------------------------------------------------------

#: Channels to read if nothing travels, and if nothing turns.
TURNING, STANDING = ("total_current", "motor_speed"), ("total_current",)


def _combined_runs(
    reach: Reach,
    name: str,
    doing: str,
    setup: Setup = on_ground,
    *,
    voltages: Sequence[float],
    slopes: Sequence[float] = (0.0,),
    torques: Sequence[float] = (0.0,),
    payload: float = 0.0,
    kinds: Names = (),
    read: Names = (),
    used: UsedConditions | None = None,
    **further: Any,
) -> ProposedRuns:
    """Runs at every combination of slopes, voltages and brake torques. `further`: other fields of the runs."""
    combinations = list(itertools.product(dict.fromkeys(slopes), dict.fromkeys(voltages), dict.fromkeys(torques)))
    slope, voltage, torque = (tuple(x) for x in zip(*combinations, strict=True))
    fixed = () if used is None else (used.configuration,)
    return ProposedRuns(
        name=", ".join((name, *fixed)),
        kinds=(*(kinds or (name,)), *fixed),
        doing=doing,
        setup=setup,
        voltage=voltage,
        slope=slope,
        payload=(payload,) * len(combinations),
        channels=tuple(c for c in (read or reach.measured) if c in reach.measured),
        reach=reach,
        used=used,
        torque=torque if reach.torques else (),
        **further,
    )


def _in_widest_gaps(levels: Sequence[float], settings: list[float], count: int) -> tuple[float, ...]:
    """Settings with more of them in the widest gaps of some levels, up to this count, in order."""
    levels = sorted(set(levels))
    while len(settings) < count:
        low, high = max(itertools.pairwise(levels), key=lambda gap: round_significant(gap[1] - gap[0], 6))
        levels = sorted([*levels, 0.5 * (low + high)])
        settings = [*settings, round_significant(0.5 * (low + high))]
    return tuple(sorted(set(settings)))


def other_voltages(reach: Reach, used: tuple[float, ...]) -> tuple[float, ...]:
    """Four voltages that the table lacks: one below its range, one above it if the motors allow, and others in the
    widest gaps.
    """
    outer = [round_significant(0.55 * used[0]), *[floor_significant(reach.voltage)] * (reach.voltage > used[-1])]
    return _in_widest_gaps([0.55 * used[0], *used] if len(used) == 1 else used, outer, 4)


def _travel_runs(reach: Reach, used: UsedConditions) -> tuple[ProposedRuns, ...]:
    """Runs of the robot with one configuration."""

    volts = used.voltages
    end_voltages, three_voltages = (volts[0], volts[-1]), (volts[0], volts[len(volts) // 2], volts[-1])
    inclines = sorted({abs(s) for s in used.slopes if s}) or [0.0]
    median_slope, second_steepest, steepest = (
        inclines[(len(inclines) - 1) // 2],
        inclines[max(len(inclines) - 2, 0)],
        inclines[-1],
    )
    lifted_voltages, payload = spaced_settings(0.2 * reach.geared, reach.geared, 5), round_significant(used.payload)
    runs = functools.partial(_combined_runs, reach, used=used)
    experiments = [
        runs("reverse", "backwards", facing_backward, voltages=end_voltages, slopes=(0.0, -median_slope)),
        runs("downhill", "about", voltages=end_voltages, slopes=(-inclines[0], -median_slope)),
        runs("lifted", "lifted", lifted, voltages=lifted_voltages, read=TURNING),
        runs("one motor", "one lifted", lifted, kinds=("one motor", "lifted"), voltages=lifted_voltages, sides=1,
             read=TURNING),
        runs(f"payload {payload:g} kg", "laden", kinds=("payload",), voltages=end_voltages,
             slopes=(0.0, median_slope, steepest), payload=payload),
        runs("other voltages", "travel", voltages=other_voltages(reach, volts), slopes=(0.0, second_steepest)),
        runs("steepest slope", "travel", voltages=three_voltages, steepest=True,
             slopes=[round(2 * steepest * share) / 2 for share in (SLOPE, (1 + SLOPE) / 2)]),
        runs("crawl", "travel", voltages=[round_significant(share * volts[0]) for share in (0.15, 0.2, 0.27)]),
    ]  # fmt: skip
    impossible = {
        "downhill": steepest == 0, "steepest slope": steepest == 0, "payload": payload == 0,
        "one motor": reach.motors == 1,
    }  # fmt: skip
    return tuple(r for r in experiments if not impossible.get(r.kinds[0], False))


def _motor_runs(reach: Reach) -> tuple[ProposedRuns, ...]:
    """Runs of the motors without the robot."""
    no_load_voltages = spaced_settings(0.2 * reach.alone, reach.alone, 5)
    stall_voltages = spaced_settings(
        0.5 * reach.current * reach.resistance, min(reach.current * reach.resistance, reach.voltage), 2
    )
    brake_torque = round_significant(0.6 * reach.torque_constant * reach.current, 1)
    experiments = [
        _combined_runs(reach, "bare motor", "alone", uncoupled, voltages=no_load_voltages, read=TURNING),
        _combined_runs(reach, "stall", "held", locked, voltages=stall_voltages, read=STANDING),
        _combined_runs(reach, "stall, one motor", "one held", locked, kinds=("stall", "one motor"),
              voltages=stall_voltages, read=STANDING, sides=1),
        _combined_runs(reach, "braked motor", "braked", braked,
              voltages=spaced_settings(0.4 * reach.alone, reach.alone, 3), read=TURNING, brake=brake_torque),
    ]  # fmt: skip
    return tuple(r for r in experiments if reach.motors > 1 or r.sides is None)


def experiment_menu(reach: Reach) -> tuple[Experiment, ...]:
    """All experiments within reach of the table, those of least effort first.

    Some slopes or voltages may still be impossible for the robot. Only its predicted readings show this, see
    `possible_runs`.
    """
    on_load = reach.imposed == "voltage" and reach.has_ground
    runs_of = _travel_runs if on_load else _shaft_runs
    runs = [
        *(_motor_runs(reach) if on_load else ()),
        *(run for conditions in reach.used for run in runs_of(reach, conditions)),
    ]
    return (*calibration_acts(reach), *(r for r in runs if r.channels))


def _shaft_runs(reach: Reach, used: UsedConditions) -> tuple[ProposedRuns, ...]:
    """Proposed runs for a shaft load, or an imposed speed or current: other levels, torques and direction."""
    names_of_levels = {"voltage": "other voltages", "motor_speed": "other speeds", "motor_current": "other currents"}
    levels = used.voltages if reach.imposed == "voltage" else reach.levels
    largest = round_significant(max(map(abs, levels), default=0.0)) or 1.0
    magnitudes = tuple(
        sorted({x for v in levels if (x := round_significant(abs(v))) >= LEAST_SETTING * largest})
    ) or (largest,)
    lowest = max(0.4 * magnitudes[0], LEAST_SETTING * largest)
    limit = {"voltage": reach.voltage, "motor_speed": reach.geared}.get(reach.imposed, math.inf)
    highest = round_significant(1.3 * largest) if 1.3 * largest < limit else floor_significant(max(limit, largest))
    middle = 0.5 * (magnitudes[0] + largest) if highest > largest else 0.5 * (lowest + largest)
    other_levels = tuple(sorted({round_significant(lowest), round_significant(middle), highest}))
    reverse_sign = -1.0 if levels[-1] > 0 else 1.0  # also of a brake, which acts against the rotation
    reverse_levels = [reverse_sign * x for x in (magnitudes[0], magnitudes[-1])]
    runs = functools.partial(_combined_runs, reach, used=used)
    experiments = [runs(names_of_levels[reach.imposed], "run", kinds=("other voltages",), voltages=other_levels)]
    # torques that the table lacks, in the widest gaps above zero, and the largest one that it used
    largest_torque = max(reach.torques, default=0.0)
    torques = (
        _in_widest_gaps([0.0, *reach.torques], [floor_significant(largest_torque)], 4)
        if largest_torque > 0
        else (0.0,)
    )
    if not min(levels) < 0 < max(levels):
        reverse_torques = [0.0, *(reverse_sign * x for x in torques[1:2])]
        experiments.append(runs("reverse", "other way", voltages=reverse_levels, torques=reverse_torques))
    if largest_torque > 0:
        forward_levels = [-x for x in reverse_levels]
        experiments.append(
            runs("other torques", "run", voltages=forward_levels, torques=[-reverse_sign * x for x in torques])
        )
    return tuple(experiments)


def check_forbidden(forbidden: Sequence[str], robot: Robot) -> None:
    """Rejects names that are neither kinds of experiments nor configurations.

    Raises:
        BadConfiguration: a name is unknown. The message lists the allowed ones.
    """
    allowed = (*KINDS, *robot.configurations)
    for name in forbidden:
        stated_word(name, allowed, f"--forbid {name}", "no such experiment or configuration")


# --- possible experiments -----------------------------------------------------------------------------


def possible_runs(run: ProposedRuns, feasible: np.ndarray) -> np.ndarray:
    """True for runs to carry out: slopes, voltages and payloads that the robot can do in all combinations.

    Args:
        feasible: True for runs that the robot can do, shape (runs,).
    """
    possible = np.ones(len(feasible), bool)
    axes = [np.asarray(x) for x in (run.slope, run.voltage, run.payload, run.torque) if len(x)]
    while possible.any() and not feasible[possible].all():
        levels = [(axis, level) for axis in axes for level in np.unique(axis[possible])]
        axis, level = max(levels, key=lambda pair: float(np.mean(~feasible[possible & (pair[0] == pair[1])])))
        possible &= axis != level
    if run.steepest and possible.any():
        possible &= axes[0] == axes[0][possible].max()
    return possible


def restrict_run(run: ProposedRuns, kept: np.ndarray, temperature: np.ndarray, speed: np.ndarray) -> ProposedRuns:
    """Runs without impossible conditions, with remarks on risks of damage.

    Args:
        kept: mask from `possible_runs`.
        temperature: predicted winding temperature after a long time [°C], shape (runs,).
        speed: predicted speed of the motor shaft [rad/s], shape (runs,).
    """
    conditions = {name: getattr(run, name) for name in ("voltage", "slope", "payload", "torque")}
    kept_conditions: dict[str, Any] = {name: tuple(itertools.compress(x, kept)) for name, x in conditions.items()}
    reach = run.reach
    watch: list[Remark] = []
    hottest, fastest = float(temperature[kept].max()), float(np.abs(speed[kept]).max())
    highest = max(kept_conditions["voltage"])
    temperature_limit = reach.hot if reach.hot < UNLIMITED else None
    if run.setup is locked:
        watch.append(
            Remark("held_motor", temperature=hottest, allowed=temperature_limit, current=highest / reach.resistance)
        )
    elif run.setup is braked:
        watch.append(Remark("braked_motor", temperature=hottest, allowed=temperature_limit))
    elif hottest > reach.hot - WARM:
        watch.append(Remark("hot_motor", temperature=hottest, allowed=temperature_limit))
    limit = reach.limit_alone if run.setup in (uncoupled, braked) else reach.limit_geared
    if run.setup in (uncoupled, lifted) and fastest > FAST * limit:
        watch.append(Remark("overspeed", speed=fastest, limit=limit, voltage=highest))
    if reach.imposed == "voltage" and highest > reach.voltages[-1]:
        watch.append(Remark("overvoltage", voltage=highest, used=reach.voltages[-1]))
    return dataclasses.replace(run, watch=tuple(watch), **kept_conditions)
