"""Interface of a fidelity: functions from a robot and conditions to results, and the observation that all return."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mmrjax import fidelities
from mmrjax.compile.compiling import compiled
from mmrjax.fidelities import FidelityFacts, outputs
from mmrjax.model import balances, channels, contact
from mmrjax.model.conditions import Conditions
from mmrjax.model.gearmotor import UNLIMITED
from mmrjax.model.params import Scalar, Scalars
from mmrjax.model.quantities import HEAT, VOLTAGE
from mmrjax.model.rig import Rig
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, FLAGS, REVERSES, ROLLS_BACK, Result, Signals, safe_quotient
from mmrjax.numerics.elementary import magnitude
from mmrjax.undercarriage.side_contacts import GearReactions

T = TypeVar("T")

#: Callback for progress; receives the finished share of the work, 0..1.
Progress = Callable[[float], None]


class History(eqx.Module):
    """Runs over time. Fields have shape (runs, samples).

    Attributes:
        time: time in the clock of tables [s]. The imposed quantity acts the rig's `delay` later than its column
            states.
        distance: distance travelled along the slope [m].
        signals: all signals.
        reading: readings [SI] by channel, of the channels that change in a history.
        reactions: loads inside the running gear of one side, if the fidelity computes them.
    """

    time: Float[Array, "runs samples"]
    distance: Float[Array, "runs samples"]
    signals: Signals
    reading: Scalars
    reactions: GearReactions | None = None

    @staticmethod
    def of(
        robot: Robot,
        time: Array,
        distance: Array,
        signals: Signals,
        reactions: GearReactions | None = None,
    ) -> History:
        """Runs over time with their readings. `time` counts from the action of the imposed quantity.

        Signals with a further axis of left and right side are averaged over it.
        """
        if jnp.ndim(signals.current) > jnp.ndim(time):
            reading = _channel_readings(robot, signals, of_sides=True)
            signals = balances.mean_of_sides(signals)
        else:
            reading = _channel_readings(robot, signals)
        if not robot.knows(VOLTAGE):
            nan = jnp.full_like(signals.current, jnp.nan)
            voltage_fields = ("voltage", "voltage_source", "voltage_drop", "voltage_left", "inductance")
            masked: dict[str, Any] = dict.fromkeys(voltage_fields, nan)
            signals = replace(signals, **masked)
        clock, (distance, signals, reading, reactions) = in_table_time(
            robot.rig, time, (distance, signals, reading, reactions)
        )
        return History(clock, distance, signals, reading, reactions)


def in_table_time(rig: Rig, time: Float[Array, "runs samples"], values: T) -> tuple[Float[Array, "runs samples"], T]:
    """Runs over time in the clock of tables, which the rig's `delay` shifts.

    Args:
        time: time since the imposed quantity acts [s].
        values: values at those instants, a tree of shape (runs, samples, ...).

    Returns:
        Instants of the tables' clock, and the values there (`Rig.clock`, `Rig.before`).
    """
    if rig.prompt:
        return time, values
    values = jax.tree.map(lambda x: jnp.broadcast_to(x, time.shape) if jnp.ndim(x) < 2 else jnp.asarray(x), values)
    clock = rig.clock(time)
    position = _before(rig, time, clock)
    return clock, jax.tree.map(lambda x: _between_for_batch(x, *position), values)


@compiled
def _channel_readings(robot: Robot, signals: Signals, of_sides: bool = False) -> Scalars:
    """Readings of the channels that change in a history. `of_sides`: signals have a left and a right side."""
    readings = balances.readings_of_sides(robot, signals) if of_sides else balances.sensor(robot, signals)
    return {c.name: readings[c.name] for c in channels.EVERY if c.over_time}


@compiled
def _before(rig: Rig, time: Array, clock: Array) -> tuple[Array, Array]:
    return jax.vmap(rig.before)(time, clock)


@compiled
def _between_for_batch(values: Array, k: Array, share: Array) -> Array:
    """`Rig.between` for a batch, compiled once for each shape."""
    return jax.vmap(Rig.between)(values, k, share)


class RunBatch(eqx.Module):
    """A simulated batch of runs.

    Attributes:
        result: result of each run, shape (runs,).
        columns: outputs that only this fidelity has: column of `runs.csv` → values in the unit of the column, shape
            (runs,).
        history: the runs over time, if requested.
    """

    result: Result
    columns: Scalars = eqx.field(default_factory=dict)
    history: History | None = None


#: Function that simulates a batch in one call, of a robot, conditions of shape (runs,), all options of the fidelity
#: from `FidelityFacts.resolved`, and a callback for progress. Raises ValueError if `Fidelity.check` refuses a run.
SimulateBatch = Callable[..., RunBatch]


@dataclasses.dataclass(frozen=True)
class ImplicitSolution:
    """Steady travel of one run in two parts, straight or turning. This lets a fit take all derivatives from one
    evaluation.

    Attributes:
        solve: function that returns the unknowns, shape (unknowns,), and True if they were found. Without
            derivatives.
        results_at: function that returns result and signals for given unknowns, and the residuals of the equations,
            shape (unknowns,). Differentiable in unknowns and robot. A demand above the ground's limit counts as
            sliding. No fit reaches it in any case.
    """

    solve: Callable[[Robot, Conditions], tuple[Array, Array]]
    results_at: Callable[[Robot, Conditions, Array, Array], tuple[Result, Signals, Array]]


def _accept_every_run(
    robot: Robot, conditions: Conditions, options: Mapping[str, float]
) -> None:  # results are pickled
    """Accepts every run."""


def _without_cautions(robot: Robot, conditions: Conditions) -> list[str]:
    return []


@dataclasses.dataclass(frozen=True)
class Fidelity:
    """One way to simulate a robot. Each module of a fidelity ends with one.

    Attributes:
        name: its line in `fidelities.TABLE`.
        settled: function from a batch of conditions to results. Pure and traceable, with finite numbers for every
            status if possible. Calibrations differentiate it in forward mode.
        implicit: the same in two parts. None if it is not the solution of equations.
        run: results of a batch, as in a sweep.
        outputs: function that computes only the named outputs of a batch [SI] and `status`, faster than `run`. None
            if it would not be faster. A fidelity with it has no options.
        columns: names of further columns of its runs (`RunBatch.columns`).
        histories: a batch from standstill over time, None for a fidelity without time.
        check: function that raises ValueError before the first simulation if some run of a batch cannot be computed.
        cautions: warnings about the steady readings of a calibrated robot, one sentence each.
    """

    name: str
    settled: Callable[[Robot, Conditions], Result]
    run: SimulateBatch
    outputs: Callable[[Robot, Conditions, tuple[str, ...]], dict[str, Array]] | None = None
    implicit: ImplicitSolution | None = None
    histories: SimulateBatch | None = None
    check: Callable[[Robot, Conditions, Mapping[str, float]], None] = _accept_every_run
    cautions: Callable[[Robot, Conditions], list[str]] = _without_cautions
    columns: tuple[str, ...] = ()

    @property
    def facts(self) -> FidelityFacts:
        """Properties that are known without importing the fidelity."""
        return fidelities.fidelity_facts(self.name)


#: Current into a supply that counts as 0 [A]: rounding and the remainder of a converged search.
CURRENT_SMALL = 1e-3


def result_of_signals(robot: Robot, signals: Signals, status: Int[Array, "..."]) -> Result:
    """Readings, power chain of Fig. 4 and warnings of one instant. Numbers with unknown parameters are NaN."""
    sides = robot.sides
    power_supply = balances.power_drawn(robot, signals)
    power_motor = sides * signals.torque_motor * signals.speed_motor
    power_gear = sides * signals.torque_gear * signals.speed_wheel
    power_ground = sides * signals.traction * signals.speed
    temperature = robot.motor.temperature_settled(signals.current * robot.driver.ripple(signals.duty) ** 0.5)
    limit = robot.motor.temperature_limit
    is_too_hot = (temperature > limit) & (limit < UNLIMITED) & robot.knows(HEAT)  # settled or not
    flags = flag_mask({**exceeded_limits(robot, signals), "winding_hot": is_too_hot})
    result = Result(
        reading=balances.sensor(robot, signals),
        theoretical_speed=signals.speed_theoretical,
        slip=contact.slip_ratio(signals.speed, signals.speed_theoretical),
        voltage=signals.voltage,
        mass=signals.mass,
        traction=sides * signals.traction,
        adhesion_used=magnitude(signals.demand, signals.direction_travel) / signals.adhesion_limit,
        power_supply=power_supply,
        power_motor=power_motor,
        power_gear=power_gear,
        power_ground=power_ground,
        power_lift=sides * signals.gravity * signals.speed,
        efficiency_motor=power_ratio(power_motor, power_supply),
        efficiency_gear=power_ratio(power_gear, power_motor),
        efficiency_chassis=power_ratio(power_ground, power_gear),
        winding_settled=temperature,
        voltage_cell=jnp.where(signals.battery > 0.5, signals.voltage_source / robot.battery.cells, 0.0),
        status=status,
        flags=flags,
    )
    return mask_unknown(robot, result)


def mask_unknown(robot: Robot, result: Result) -> Result:
    """Copy of `result` in which numbers that depend on unknown parameters of the robot are NaN."""
    unknown = [output.name for output in outputs.FURTHER if not robot.knows(output.rests_on)]
    nan: dict[str, Any] = {name: jnp.full_like(getattr(result, name), jnp.nan) for name in unknown}
    return replace(result, **nan)


def exceeded_limits(robot: Robot, signals: Signals) -> dict[str, Scalar]:
    """Limits exceeded at an instant, by the flag's name."""
    battery = robot.battery
    on_battery = signals.battery > 0.5
    cell_voltage = signals.voltage_source / battery.cells
    current = battery.current(signals.total_current)
    discharge_limit, charge_limit = battery.current_limit or jnp.inf, battery.current_charge or jnp.inf
    # A full cell at rest may have its charge voltage: only a current into it can exceed the limit.
    overcharged = (cell_voltage > battery.voltage_charge) & (current < 0)
    torque = jnp.abs(signals.torque_gear)
    return {
        "motor_overspeed": jnp.abs(signals.speed_motor) > robot.motor.speed_limit,
        "gearbox_overspeed": jnp.abs(signals.speed_motor) > robot.gearbox.speed_limit,
        "slips": movers_slip(robot, signals),
        "overvoltage": on_battery & (overcharged | (current < -charge_limit)),
        "cut_off": on_battery & (cell_voltage < battery.voltage_cutoff),
        "battery_overcurrent": on_battery & (current > discharge_limit),
        "current_limited": robot.driver.limits(signals.current),
        "gearbox_overload": torque > (robot.gearbox.torque_limit or jnp.inf),
        "voltage_rising": on_battery & battery.rises(signals.discharge),
        "current_returned": ~on_battery & (signals.total_current * jnp.sign(signals.voltage_source) < -CURRENT_SMALL),
    }


def flag_mask(exceeded: Mapping[str, Scalar]) -> Array:
    """Bit mask over `FLAGS`."""
    return jnp.asarray(
        sum(jnp.where(is_exceeded, 1 << FLAGS.index(name), 0) for name, is_exceeded in exceeded.items())
    )


def travel_status(speed: Scalar, voltage: Scalar) -> Array:
    """Status of steady travel at `speed` under a motor `voltage`, which distinguishes motion driven by the motors
    from motion driven by gravity.
    """
    backward = speed < 0
    follows_voltage = jnp.where(backward, voltage < 0, voltage >= 0)
    return jnp.where(follows_voltage, jnp.where(backward, REVERSES, CONVERGED), ROLLS_BACK)


def movers_slip(robot: Robot, signals: Signals) -> Array:
    """True if the movers slide over the ground faster than V_s."""
    return jnp.abs(signals.speed_sliding) > robot.chassis(signals.configuration).speed_grip


def power_ratio(out: Scalar, into: Scalar) -> Array:
    """Power out over power in [-], 0 at rest and if power flows the other way."""
    # Power returned on a descent has no efficiency of forward travel.
    forward = (out >= 0) & (into >= out)
    return jnp.where(forward, safe_quotient(out, into), 0.0)


def withhold_numbers(result: Result, valid: Array, sound: Array) -> Result:
    """Sets every number of `result` to NaN if `valid` is false. Keeps mass and adhesion used if `sound`.

    The flags of a withheld member are cleared. Its status says why it has no numbers.
    """
    blank = jax.tree.map(
        lambda x: jnp.where(valid, x, 0 if jnp.issubdtype(x.dtype, jnp.integer) else jnp.nan), result
    )
    kept = {name: jnp.where(sound, getattr(result, name), jnp.nan) for name in ("mass", "adhesion_used")}
    return replace(blank, **kept, status=result.status)
