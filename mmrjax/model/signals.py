"""Data that modules exchange: the state, the signals of one instant, and the result of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mmrjax.model.params import Index, Scalar

GRAVITY = 9.80665  # [m/s²], standard gravity

#: Outcomes of one member of a batch, in the order of their codes.
STATUSES = (
    "converged", "stalled", "slides", "not_settled", "battery_empty", "failed", "tips", "reverses", "rolls_back",
    "cut_off",
)  # fmt: skip
CONVERGED, STALLED, SLIDES, NOT_SETTLED, BATTERY_EMPTY, FAILED, TIPS, REVERSES, ROLLS_BACK, CUT_OFF = range(
    len(STATUSES)
)

#: Statuses of a run that ended as requested: `reverses` travels backward because its voltage is negative.
DONE = (CONVERGED, REVERSES)

#: Warnings of a run: limits exceeded, sliding on average in steady travel, loss of ground contact. Bit k of
#: `Result.flags` is the k-th name. `winding_hot` is after long running at this current, `too_hot` at the temperature
#: that a mission reaches.
FLAGS = (
    "motor_overspeed", "gearbox_overspeed", "winding_hot", "slips", "jumps", "overvoltage", "cut_off",
    "battery_overcurrent", "current_limited", "gearbox_overload", "too_hot", "demand_missed",
    "voltage_rising", "current_returned",
)  # fmt: skip


#: Values of a quantity that the balances have not computed yet, and of a motion that straight travel lacks.
UNSET: Any = math.nan
NONE: Any = 0.0


class State(eqx.Module):
    """State of a run, per side of the chassis (both sides have the same, assumption 3).

    Attributes:
        current: current of one motor I_d [A].
        speed_motor: motor shaft speed [rad/s].
        speed: speed of the robot along the slope V [m/s].
        discharge: charge taken from the battery C_b [C].
        memory: memory of each effect that has one, by effect name, in its own unit, empty if not followed.
        temperature: temperature of the winding [°C], which sets its resistance. None: not followed, resistance as
            stated.
        distance: travelled since the start of the run [m]. Used by loads that depend on their angle.
        gap: angle of the output's motor side ahead of the load, from the middle of a backlash [rad]. None: rigid.
        integral: integral of the controller's error over time, as in `Controller`. None: no controller.
        command: duty of a controller with a lag or a rate [-]. None: without.
        pending: duty of a controller with a rate that acts from its next sample on [-]. None: without delay.
        clock: time until the next sample of a controller with a rate [s]. None: without a rate.
    """

    current: Scalar
    speed_motor: Scalar
    speed: Scalar
    discharge: Scalar
    memory: Mapping[str, Scalar] = eqx.field(default_factory=dict)
    temperature: Scalar | None = None
    distance: Scalar = 0.0
    gap: Scalar | None = None
    integral: Scalar | None = None
    command: Scalar | None = None
    pending: Scalar | None = None
    clock: Scalar | None = None


class PlaneMotion(eqx.Module):
    """State of a run of a robot that turns: of each side, left and right, and of the robot in the plane.

    Attributes:
        current: current of one motor of each side [A], shape (2,).
        speed_motor: motor shaft speeds [rad/s], shape (2,).
        speed, speed_lateral: speed and lateral speed of the centre of mass, ahead and to the left [m/s].
        yaw_rate: to the left [rad/s].
        heading: heading from uphill, to the left [rad].
        place_x, place_y: uphill of the start, and to the left of it [m].
        discharge: charge taken from the battery C_b [C].
        memory: memory of each effect that has one, by effect name, shape (2,).
        temperature: temperature of the windings of each side [°C], shape (2,). None: not followed.
    """

    current: Array
    speed_motor: Array
    speed: Array
    speed_lateral: Array
    yaw_rate: Array
    heading: Array
    place_x: Array
    place_y: Array
    discharge: Array
    memory: Mapping[str, Scalar] = eqx.field(default_factory=dict)
    temperature: Array | None = None


class Signals(eqx.Module):
    """Every quantity of one instant, filled in order by `balances`. Per side unless its name has `total`.

    A field is `UNSET` until the balance that computes it has run.
    """

    # conditions and state
    configuration: Index = 0  # index
    on_tracks: Array = UNSET  # 1 on tracks, 0 on wheels
    slope: Array = UNSET
    payload: Array = UNSET
    adhesion: Array = UNSET
    battery: Array = UNSET  # 1 if the on-board battery feeds the motors
    discharge: Array = UNSET
    order: Array = UNSET  # place in the sequence of runs [-]
    load_torque: Array | None = None  # of a brake on the output, against forward rotation [N·m]
    memory: Mapping[str, Scalar] = eqx.field(default_factory=dict)  # of effects, by name; empty: settled
    current: Array = UNSET  # I_d of one motor [A]
    speed_motor: Array = UNSET  # [rad/s]
    speed: Array = UNSET  # V of the robot [m/s]
    temperature: Array | None = None  # of the winding, if it is followed [°C]
    # motion of the robot in the plane of the ground; 0 in straight travel
    side: Array = NONE  # 1 of the left side, -1 of the right one [-]
    speed_lateral: Array = NONE  # v_y to the left [m/s]
    yaw_rate: Array = NONE  # ω, positive to the left [rad/s]
    direction_turn: Array = NONE  # direction of the turn, -1..1, positive to the left [-]
    moment_lateral: Array = NONE  # of the lateral forces about the centre of mass, positive to the left [N·m]
    heading: Array = NONE  # ψ from uphill, positive to the left [rad]
    place_x: Array = NONE  # uphill of the start [m]
    place_y: Array = NONE  # to the left of the start [m]
    # kinematics
    direction: Array = UNSET  # of the shafts, -1..1, 0 at rest [-]
    direction_travel: Array = UNSET  # of the robot, -1..1 [-]
    speed_wheel: Array = UNSET  # of driving wheel or pulley [rad/s]
    speed_theoretical: Array = UNSET  # r_k ω_k, eq. (32) [m/s]
    speed_output: Array = UNSET  # of the load's side of the output, not the wheel's within a backlash [rad/s]
    angle: Array = UNSET  # of the output since the start of the run, of a load on a shaft [rad]
    # mass
    mass: Array = UNSET  # total M [kg]; effects of balance `mass` see the stated one
    normal: Array = UNSET  # normal load of one side [N]
    # supply and electrical
    command: Array = UNSET  # duty that is demanded of the driver [-]
    duty: Array = UNSET  # D that the driver gives, after its current limit [-]
    pause: Array = UNSET  # share of a period without pulses, 1 - |D|; 0 if the motors are open or shorted [-]
    share_drawn: Array = UNSET  # share of the motors' current that the supply gives [-]
    total_current: Array = UNSET  # D I of all motors, from the supply I_s, eq. (10) [A]
    voltage_source: Array = UNSET  # of battery or external supply, eq. (8) [V]
    voltage: Array = UNSET  # U_e at the motors [V]
    voltage_back: Array = UNSET  # E, eq. (16) [V]
    voltage_drop: Array = UNSET  # I R and all further drops [V]
    voltage_left: Array = UNSET  # drives L dI/dt, eq. (15) [V]
    inductance: Array = UNSET  # L_d of the armature circuit, eq. (15) [H]
    # motor
    torque_electromagnetic: Array = UNSET  # C_m I, eq. (17) [N·m]
    torque_motor_loss: Array = UNSET  # M_df, eq. (14) [N·m]
    torque_motor: Array = UNSET  # M_d, eq. (18), before the armature takes its share [N·m]
    # ground and slip
    resistance: Array = UNSET  # motion resistance F_f, eq. (5) [N]
    gravity: Array = UNSET  # m_i g sin(slope) [N]
    demand: Array = UNSET  # traction that holds the speed constant [N]
    speed_slip_terms: Array = UNSET  # slip that is not sliding (effects) [m/s]
    speed_sliding: Array = UNSET  # of the contact patch over the ground [m/s]
    traction: Array = UNSET  # P_t [N]
    adhesion_limit: Array = UNSET  # largest traction of the friction law [N]
    # track and gearbox
    torque_track_loss: Array = UNSET  # eq. (24), (26) at the pulley [N·m]
    torque_carried: Array = UNSET  # at the gearbox output, with what accelerates the load [N·m]
    inertia_added: Array = UNSET  # by effects, of one side at the driving wheel [kg·m²]
    torque_load: Array = UNSET  # all load of the gearbox output except inertia [N·m]
    efficiency_load: Array = UNSET  # η_rm, or 1/η_rm if power flows back [-]
    torque_idle: Array = UNSET  # M_rf_idle at the gearbox input, eq. (20) [N·m]
    torque_input: Array = UNSET  # into the gearbox, less the armature's share [N·m]
    torque_gear: Array = UNSET  # M_r, eq. (23) [N·m]
    torque_output: Array = UNSET  # M_r less the effects of the gearbox: reading of a torque meter at the output [N·m]
    torque_net: Array = UNSET  # drives the rotating masses, at the pulley [N·m]
    # motion
    acceleration_wheel: Array = UNSET  # [rad/s²]
    acceleration: Array = UNSET  # of the robot [m/s²]


class Result(eqx.Module):
    """One settled operating point (or the end of a run), with its status.

    Attributes:
        reading: reading of the instruments [SI], by channel name (`channels.EVERY`). Each is also an attribute:
            `result.total_current`.
        theoretical_speed: r_k ω_k, eq. (32) [m/s].
        slip: 1 - V / V_theoretical, eq. (33) [-], 0 at rest.
        voltage: voltage at the motors [V].
        mass: total [kg].
        traction: traction of both sides [N].
        adhesion_used: |demand| over the largest traction of the friction law [-]. Above 1 the robot slides.
        power_supply: P_e taken by the motors [W].
        power_motor: N_d at the motor shafts [W].
        power_gear: N_r at the gearbox outputs [W].
        power_ground: N_t from the movers to the ground [W].
        power_lift: against gravity [W].
        efficiency_motor, efficiency_gear, efficiency_chassis: N_d/P_e, N_r/N_d, N_t/N_r [-], 0 at rest
            and if power does not flow that way.
        winding_settled: winding temperature after long running at this current [°C], inf if it has no limit.
        voltage_cell: voltage of one cell of the battery [V], 0 on the external supply.
        status: code into `STATUSES`.
        flags: bit mask over `FLAGS`.
    """

    reading: Mapping[str, Scalar]
    theoretical_speed: Scalar
    slip: Scalar
    voltage: Scalar
    mass: Scalar
    traction: Scalar
    adhesion_used: Scalar
    power_supply: Scalar
    power_motor: Scalar
    power_gear: Scalar
    power_ground: Scalar
    power_lift: Scalar
    efficiency_motor: Scalar
    efficiency_gear: Scalar
    efficiency_chassis: Scalar
    winding_settled: Scalar
    voltage_cell: Scalar
    status: Int[Array, "..."]
    flags: Int[Array, "..."]

    def __getattr__(self, name: str) -> Any:
        reading = self.__dict__.get("reading")
        if isinstance(reading, dict) and name in reading:
            return reading[name]
        raise AttributeError(f"{type(self).__name__} has no {name}")


def is_done(status: Any) -> Any:
    """True for status codes of runs that ended as requested, with an operating point."""
    return (status == CONVERGED) | (status == REVERSES)


def safe_quotient(part: Scalar, whole: Scalar) -> Float[Array, "..."]:
    """part / whole, and 0 with a finite derivative where `whole` is 0 (at rest)."""
    moving = jnp.abs(whole) > 1e-9
    return jnp.where(moving, part / jnp.where(moving, whole, 1.0), 0.0)


#: Names of further columns of each point: code into `STATUSES`, bit mask over `FLAGS`.
CODES = ("status", "flags")
