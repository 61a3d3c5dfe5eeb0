"""What flows between the rooms: the command from outside, the state, and the signals of one instant."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mmrjax.params import Scalar

GRAVITY = 9.80665  # [m/s²], standard gravity

#: Outcomes of one member of a batch, in the order of their codes.
STATUSES = ("converged", "stalled", "slides", "not_settled", "battery_empty", "failed", "tips")
CONVERGED, STALLED, SLIDES, NOT_SETTLED, BATTERY_EMPTY, FAILED, TIPS = range(len(STATUSES))

#: Limits that a run may exceed; bit k of `Result.flags` is the k-th name.
FLAGS = ("motor_overspeed", "gearbox_overspeed", "winding_hot")


class Command(eqx.Module):
    """The conditions of one run.

    Attributes:
        voltage: voltage of the external supply [V]; not used with `battery`.
        slope: slope angle, positive uphill [rad].
        payload: additional load mass m_c [kg].
        wheeled: 0 for 6T2A, 1 for 4W2T.
        battery: 0 external supply (Source Mode 2), 1 on-board battery (Source Mode 1), eq. (8).
        discharge: charge C_b already taken from the battery [C].
        adhesion: adhesion of this surface as a ratio to the one that the robot's friction is stated for [-].
        total_mass: mass of robot and payload as weighed [kg]; None takes the robot's mass and the payload.
    """

    voltage: Scalar
    slope: Scalar
    payload: Scalar
    wheeled: Scalar
    battery: Scalar
    discharge: Scalar
    adhesion: Scalar
    total_mass: Scalar | None = None


def command(
    voltage: float | Array = 33.0,
    slope: float | Array = 0.0,
    payload: float | Array = 0.0,
    wheeled: float | Array = 0.0,
    battery: float | Array = 0.0,
    discharge: float | Array = 0.0,
    adhesion: float | Array = 1.0,
    total_mass: float | Array | None = None,
) -> Command:
    """Build a `Command` (SI units, see its attributes), every field broadcast to one shape."""
    fields = [jnp.asarray(v, float) for v in (voltage, slope, payload, wheeled, battery, discharge, adhesion)]
    mass = None if total_mass is None else jnp.asarray(total_mass, float)
    shape = jnp.broadcast_shapes(*(f.shape for f in fields), () if mass is None else mass.shape)
    fields = [jnp.broadcast_to(f, shape) for f in fields]
    return Command(*fields, total_mass=None if mass is None else jnp.broadcast_to(mass, shape))


class State(eqx.Module):
    """What a run remembers, per side of the chassis (the sides are alike, assumption 3).

    Attributes:
        current: current of one motor I_d [A].
        speed_motor: motor shaft speed [rad/s].
        speed: speed of the robot along the slope V [m/s].
        discharge: charge taken from the battery C_b [C].
        memory: of each effect that has one, by the effect's name, in its own unit; empty where none is kept.
    """

    current: Scalar
    speed_motor: Scalar
    speed: Scalar
    discharge: Scalar
    memory: dict[str, Scalar] = eqx.field(default_factory=dict)


class Signals(eqx.Module):
    """Every quantity of one instant, filled in order by `balances`; per side unless `total` is said.

    A field keeps its default 0 until the balance that computes it has run.
    """

    # conditions and state
    wheeled: Scalar = 0.0
    slope: Scalar = 0.0
    payload: Scalar = 0.0
    adhesion: Scalar = 1.0
    battery: Scalar = 0.0  # 1 where the on-board battery feeds the motors
    discharge: Scalar = 0.0
    memory: dict[str, Scalar] = eqx.field(default_factory=dict)  # of effects, by name; empty: settled
    current: Scalar = 0.0  # I_d of one motor [A]
    speed_motor: Scalar = 0.0  # [rad/s]
    speed: Scalar = 0.0  # V of the robot [m/s]
    # kinematics
    direction: Scalar = 0.0  # of the shafts, -1..1, 0 at rest [-]
    direction_travel: Scalar = 0.0  # of the robot, -1..1 [-]
    speed_wheel: Scalar = 0.0  # of driving wheel or pulley [rad/s]
    speed_theoretical: Scalar = 0.0  # r_k ω_k, eq. (32) [m/s]
    # mass
    mass: Scalar = 0.0  # total M [kg]; to effects of balance `mass`, the stated one
    normal: Scalar = 0.0  # normal load of one side [N]
    # supply and electrical
    total_current: Scalar = 0.0  # of all motors I_s, eq. (10) [A]
    voltage: Scalar = 0.0  # U_e at the motors [V]
    voltage_back: Scalar = 0.0  # E, eq. (16) [V]
    voltage_drop: Scalar = 0.0  # I R and every further drop [V]
    voltage_left: Scalar = 0.0  # drives L dI/dt, eq. (15) [V]
    inductance: Scalar = 0.0  # L_d of the armature circuit, eq. (15) [H]
    # motor
    torque_electromagnetic: Scalar = 0.0  # C_m I, eq. (17) [N·m]
    torque_motor_loss: Scalar = 0.0  # M_df, eq. (14) [N·m]
    torque_motor: Scalar = 0.0  # M_d, eq. (18), before the armature takes its share [N·m]
    # ground and slip
    resistance: Scalar = 0.0  # motion resistance F_f, eq. (5) [N]
    gravity: Scalar = 0.0  # m_i g sin(slope) [N]
    demand: Scalar = 0.0  # traction that holds the speed constant [N]
    speed_slip_terms: Scalar = 0.0  # slip that is not sliding (effects) [m/s]
    speed_sliding: Scalar = 0.0  # of the contact patch over the ground [m/s]
    traction: Scalar = 0.0  # P_t [N]
    adhesion_limit: Scalar = 0.0  # largest traction of the friction law [N]
    # track and gearbox
    torque_track_loss: Scalar = 0.0  # eq. (24), (26) at the pulley [N·m]
    inertia_added: Scalar = 0.0  # by effects, of one side at the driving wheel [kg·m²]
    torque_load: Scalar = 0.0  # all that the gearbox output carries, inertia apart [N·m]
    efficiency_load: Scalar = 1.0  # η_rm, or 1/η_rm where power flows back [-]
    torque_idle: Scalar = 0.0  # M_rf_idle at the gearbox input, eq. (20) [N·m]
    torque_input: Scalar = 0.0  # into the gearbox, the armature's share taken off [N·m]
    torque_gear: Scalar = 0.0  # M_r, eq. (23) [N·m]
    torque_net: Scalar = 0.0  # drives the rotating masses, at the pulley [N·m]
    # motion
    acceleration_wheel: Scalar = 0.0  # [rad/s²]
    acceleration: Scalar = 0.0  # of the robot [m/s²]


class Reading(eqx.Module):
    """What the instruments show.

    Attributes:
        total_current: of all tractive motors I_Σ [A].
        motor_speed: [rad/s].
        speed: linear speed of the robot [m/s].
    """

    total_current: Scalar
    motor_speed: Scalar
    speed: Scalar


class Result(eqx.Module):
    """One settled operating point (or the end of a run), with its status.

    Attributes:
        reading: what the instruments show.
        theoretical_speed: r_k ω_k, eq. (32) [m/s].
        slip: 1 - V / V_theoretical, eq. (33) [-]; 0 at rest.
        voltage: at the motors [V].
        mass: total [kg].
        traction: of both sides [N].
        adhesion_used: demand over the largest traction of the friction law [-]; above 1 the robot slides.
        power_supply: P_e taken by the motors [W].
        power_motor: N_d at the motor shafts [W].
        power_gear: N_r at the gearbox outputs [W].
        power_ground: N_t from the movers to the ground [W].
        power_lift: against gravity [W].
        efficiency_motor, efficiency_gear, efficiency_chassis: N_d/P_e, N_r/N_d, N_t/N_r [-]; 0 at rest
            and where power does not flow that way.
        temperature_winding: after long running at this current [°C].
        status: code into `STATUSES`.
        flags: bit mask over `FLAGS`.
    """

    reading: Reading
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
    temperature_winding: Scalar
    status: Int[Array, "..."]
    flags: Int[Array, "..."]


def quotient(part: Scalar, whole: Scalar) -> Float[Array, "..."]:
    """part / whole, and 0 with a finite derivative where `whole` is 0 (at rest)."""
    moving = jnp.abs(whole) > 1e-9
    return jnp.where(moving, part / jnp.where(moving, whole, 1.0), 0.0)
