"""Library of a rig: the effects that its data can reveal, and the scale of their priors.

Priors are stated for the nominal robot and are scaled to the size of a rig.

A loss of 0.7 mN·m is a fifth of the friction of a motor of 60 W and negligible in one of 1 kW. The share of a term in
its balance carries over from rig to rig. So the prior sd of an amplitude is scaled. A term of one sd then has the
same share of its balance at the rig's operating points as on the nominal robot over Table 8. A shape parameter that
is a speed or a current is scaled with those of the rig. The limits of an amplitude hold up to the motors' rated
values. Otherwise a saturation visible at a tenth of the rated current would leave no torque constant at the rated
one.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data.columns import SIDES
from calibration.data.effect_file import Library
from calibration.data.runs import Runs
from calibration.discovery.reach import LOADED, RUNNING
from calibration.inference import observers
from calibration.inference.ranges import travel_of_rows
from mmrjax.effects import Effect
from mmrjax.effects.base import amplitude_of, free_shape_parameter, scaled_effect
from mmrjax.model import channels, paper_robots, params
from mmrjax.model.balances import BALANCES, absent_balances, effects_sum
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals

#: Signals of the nominal robot under the conditions of Table 8.
NOMINAL = resources.files("calibration") / "data" / "nominal_signals.csv"
#: Reference quantity of each balance; terms are shares of it.
WHOLE: dict[str, Callable[[Robot, Signals], object]] = {
    "duty": lambda robot, s: s.duty,
    "supply": lambda robot, s: s.voltage,
    "electrical": lambda robot, s: s.voltage,
    "motor": lambda robot, s: s.torque_electromagnetic,
    "gearbox": lambda robot, s: s.torque_load,
    "track": lambda robot, s: s.torque_load,
    "ground": lambda robot, s: s.demand,
    "slip": lambda robot, s: s.speed_theoretical,
    "lateral": lambda robot, s: s.normal,
    "yaw": lambda robot, s: robot.running_gear.wheelbase / 4 * s.normal,  # the moment of friction of one, sliding
    "mass": lambda robot, s: s.mass,
    "inertia": lambda robot, s: (
        robot.configurations.members[0].inertia + robot.motor.inertia * robot.gearbox.ratio**2
    ),
    "inductance": lambda robot, s: robot.motor.inductance,
}
#: Quantity that scales a shape parameter, by its unit; a speed in rad/s is scaled by the shaft of its balance.
SCALED_WITH: dict[str, Callable[[Signals], object]] = {
    "A": lambda s: s.current,
    "m/s": lambda s: s.speed_theoretical,
    "N": lambda s: s.demand,
    "V": lambda s: s.voltage,
}
#: Channels of the output's position.
PLACED = ("output_angle", "position")
AT_THE_OUTPUT = ("track", "ground", "slip")
#: Shares of slip are for tracks and tyres on the paper's grounds; small wheels on soft grounds slip by half.
SLIPPERY = 16.0
#: Factor on the sds for rigs known only by their file, because the library's are for one robot with known parts.
#: With 1, 5 of 26 random rigs with an effect of at most three ordinary sizes got no name because of its size
#: (benchmarks/rigs.py). The factor does not apply to mass, which is weighed.
UNKNOWN = 4.0
#: Largest error of an instrument, as a share of the channel's rms reading. A larger one would be noticed: 47 A on
#: readings of 114 A are no ammeter's offset.
MOST_OFF = 0.25
#: Least size of an instrument's readings for its errors, as a share of those at rated load and speed. A motor without
#: load draws little of its ammeter's range: 0.4 A on readings of 0.6 A is an offset of a meter for 20 A.
LEAST_SHOWN = 0.2
#: Signals that grow with the motors' current, and signals that grow with their speed.
LOADS = (
    "current",
    "total_current",
    "torque_electromagnetic",
    "torque_motor",
    "torque_load",
    "torque_track_loss",
    "traction",
)
SPEEDS = ("speed_motor", "speed_wheel", "speed_theoretical", "speed", "speed_output")


def scale_library(robot: Robot, conditions: Conditions, library: Library, turned: float = math.nan) -> Library:
    """The library with priors scaled to a rig. Unchanged for robots that are variants of the nominal one.

    Args:
        robot: robot of the rig.
        conditions: conditions of its runs, shape (runs,).
        turned: rms angle of its output [rad], see `output_rotation`. NaN: unknown.
    """
    if robot.rig.inherits:
        return library
    # of conditions that vary in time, those in the middle of each run
    steady = jax.tree.map(lambda x: x if jnp.ndim(x) < 2 else x[:, x.shape[1] // 2], conditions)
    signals = travel_of_rows(robot, steady)[1]
    nominal, nominal_signals = _nominal_signals()
    scaled = {}
    for name, kind in library.items():
        if not effect_applies(kind, robot):
            continue
        scaled[name] = _scale_effect(
            kind,
            (robot, _signals_at_angle(signals, kind, turned)),
            (nominal, _signals_at_angle(nominal_signals, kind)),
        )
    return scaled


def output_rotation(runs: Runs, robot: Robot) -> float:
    """rms angle of the output over a table [rad]. NaN if no channel measures it."""
    measured_values = runs.measured()
    for k, channel in enumerate(runs.channels):
        if channel.name in PLACED and math.isfinite(size := _rms_size(measured_values[:, k])):
            return size / (float(robot.configurations.members[0].radius) if channel.name == "position" else 1.0)
    return math.nan


def _signals_at_angle(signals: Signals, kind: type[Effect], angle: float | None = None) -> Signals:
    """Signals at which an effect that depends on position is evaluated, by default at its reference angle. Unchanged
    for other effects.
    """
    if kind.driver != "position" or kind.memory_size is None:
        return signals
    positions = jnp.full(jnp.shape(signals.speed_motor), kind.memory_size if angle is None else angle)
    return dataclasses.replace(signals, memory={**signals.memory, kind.name: positions})


def effect_applies(kind: type[Effect], robot: Robot) -> bool:
    """True if a rig has the balance that an effect enters, and the parts that the effect needs."""
    if kind.balance in absent_balances(robot) or (not robot.has_ground and (kind.movers or kind.needs_belt)):
        return False
    if kind.driver == "position" and not set(PLACED) & set(robot.rig.channels):
        return False
    return kind.balance != "sensor" or kind.channel in robot.rig.channels


@functools.cache
def _nominal_signals() -> tuple[Robot, Signals]:
    """The nominal robot and its signals under the conditions of Table 8, from a file: they are the same for all rigs.

    `tests/test_scaled_effects.py` compares the file with `results_of_rows`.
    """
    table = np.genfromtxt(NOMINAL.read_text("utf-8").splitlines(), delimiter=",", names=True)
    columns: dict[str, Any] = {name: jnp.asarray(table[name]) for name in table.dtype.names or ()}
    columns["configuration"] = columns["configuration"].astype(int)
    return params.without_weak_types(paper_robots.nominal()), dataclasses.replace(Signals(), **columns)


def _rms_size(x: object) -> float:
    """Root mean square of the finite nonzero values, however small. NaN if there are none."""
    sizes = np.abs(np.ravel(np.asarray(x, float)))
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    largest = np.max(sizes, initial=0.0)  # squares of less than 1e-162 are zero
    return float(largest * np.sqrt(np.mean((sizes / largest) ** 2))) if sizes.size else math.nan


def _size_ratio(size: float, reference: float) -> float:
    """Ratio of two sizes. 1 if one of them is NaN."""
    return size / reference if math.isfinite(size) and math.isfinite(reference) else 1.0


def _scale_effect(kind: type[Effect], rig: tuple[Robot, Signals], nominal: tuple[Robot, Signals]) -> type[Effect]:
    """Effect class with priors scaled from one robot to another."""
    effect = kind()
    shape, amplitude = free_shape_parameter(effect), amplitude_of(effect)
    stretch = 1.0
    if shape is not None:
        scaling_signal = SCALED_WITH.get(shape.spec.unit)
        if shape.spec.unit == "rad/s":
            output = kind.balance in AT_THE_OUTPUT
            scaling_signal = (lambda s: s.speed_wheel) if output else (lambda s: s.speed_motor)
        if scaling_signal is not None:
            stretch = _size_ratio(_rms_size(scaling_signal(rig[1])), _rms_size(scaling_signal(nominal[1])))
    stretched = effect if shape is None else params.replace(effect, {shape.name: jnp.asarray(stretch * shape.value)})
    factor, share = 1.0, _unit_share(stretched, *rig)
    if kind.balance == "sensor":
        share = min(share, _unit_share(stretched, rig[0], _scale_to_rated_load(*rig)) / LEAST_SHOWN)
    if amplitude.spec.unit == BALANCES[kind.balance][0]:  # even if the term is zero at the operating points
        full_scale = WHOLE[kind.balance]
        factor = _size_ratio(_rms_size(full_scale(*rig)), _rms_size(full_scale(*nominal)))
    elif amplitude.spec.unit != "-":
        factor = _size_ratio(_unit_share(effect, *nominal), share)
    is_slip_share = kind.balance == "slip" and amplitude.spec.unit == "-"
    factor *= SLIPPERY if is_slip_share else 1.0 if kind.balance == "mass" else UNKNOWN
    limits = factor
    if kind.balance != "sensor":
        rated = _unit_share(stretched, rig[0], _scale_to_rated_load(*rig))
        limits = factor * min(1.0, _size_ratio(share, rated))
    else:
        low, high = amplitude_of(stretched).spec.bounds
        limits = min(factor, MOST_OFF / (max(-low, high) * share))
    return scaled_effect(kind, (float(factor), float(stretch), float(limits)))


def _scale_to_rated_load(robot: Robot, signals: Signals) -> Signals:
    """Signals of a rig's operating points, scaled up to the largest load and speed of its motors.

    That load is at the continuous current, or at a share of the stall current if resistance and voltage are known.
    """
    motor, rig = robot.motor, robot.rig
    largest = lambda x: float(np.nanmax(np.abs(x), initial=0.0))  # noqa: E731
    current, speed, volts = largest(signals.current), largest(signals.speed_motor), largest(signals.voltage)
    if not (rig.shows_voltage and current and speed and volts and float(motor.resistance)):
        return signals
    volts = max(volts, motor.voltage_limit or 0.0)
    load_factor = min(float(robot.current_continuous), LOADED * volts / float(motor.resistance)) / current
    speed_factor = min(motor.speed_limit, RUNNING * volts / float(motor.torque_constant)) / speed
    scaled = {name: max(load_factor, 1.0) * getattr(signals, name) for name in LOADS}
    scaled |= {name: max(speed_factor, 1.0) * getattr(signals, name) for name in SPEEDS}
    return dataclasses.replace(signals, **scaled)


def _unit_share(effect: Effect, robot: Robot, signals: Signals) -> float:
    """Share of the balance that the effect's term has at amplitude one [1/unit of the amplitude]."""
    unit_effect = params.replace(effect, {amplitude_of(effect).name: jnp.asarray(1.0)})
    robot_with_effect = dataclasses.replace(robot, effects=(unit_effect,))

    def share(s: Signals) -> tuple[jax.Array, jax.Array]:
        reading = next((c.read(robot, s) for c in channels.EVERY if c.name == effect.channel), None)
        full_scale = WHOLE[effect.balance](robot, s) if reading is None else reading
        return jnp.asarray(effects_sum(robot_with_effect, s, effect.balance, effect.channel), float), jnp.asarray(
            full_scale, float
        )

    term, total = jax.vmap(share)(signals)
    return _rms_size(term) / _rms_size(total)


#: Share of the largest speed or voltage above which a value is not noise about rest [-].
EITHER_WAY = 0.05


def visible_effects(
    library: Library,
    robot: Robot,
    kind: type[observers.Observer],
    either_way: bool = True,
    at_duties: bool = False,
) -> tuple[Effect, ...]:
    """Effects of a library that this kind of data can reveal and that the robot does not have yet.

    Args:
        either_way: True if there are forward and backward runs, see `goes_both_ways`.
        at_duties: True if some runs have a duty below 1, see `has_partial_duty`.
    """
    existing = {e.name for e in robot.effects}
    return tuple(
        effect()
        for name, effect in library.items()
        if name not in existing
        and kind.shows(effect)
        and effect_applies(effect, robot)
        and (either_way or not effect.needs_reverse)
        and (at_duties or not effect.needs_duty)
    )


def has_partial_duty(runs: Runs) -> bool:
    """True if some runs have a duty below 1, so that the supply is pulsed."""
    duties = [runs[name] for name in ("duty", *SIDES) if runs.has(name)]
    return any((np.abs(x) < 1).any() for x in duties)


def goes_both_ways(runs: Runs) -> bool:
    """True if there are forward and backward runs, according to a measured speed or the command."""
    motion_columns = [c.column for c in channels.EVERY if c.zero_at_rest and c.directed]
    columns = [runs[name] for name in (*motion_columns, runs.layout.imposed_column, "duty") if runs.has(name)]
    finite_columns = [x[np.isfinite(x)] for x in columns]
    return any(min(x.max(), -x.min()) > EITHER_WAY * np.abs(x).max() for x in finite_columns if x.size)
