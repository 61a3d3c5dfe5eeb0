"""The balances: the only place where terms are summed, in the order in which an instant is computed.

Each function takes a robot and the `Signals` so far and returns them with its own quantities filled in. All three
fidelities are compositions of these functions.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.climbing import resting_posture
from mmrjax.model import channels, contact, masses, power
from mmrjax.model import chassis as chassis_module
from mmrjax.model.chassis import Chassis
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar, Scalars
from mmrjax.model.robot import Load, Robot
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import GRAVITY, PlaneMotion, Signals, State
from mmrjax.numerics.elementary import at_least, clip, cosine, sine, value_and_slope
from mmrjax.turning.two_sides import SIDES, GroundForceInputs, GroundForces, Stance, sum_of_sides

#: Each balance with its unit and its equation.
BALANCES = {
    "mass": ("kg", "M = robot + payload"),
    "inertia": ("kg·m^2", "J_w of one side's parts that turn with the driving wheel, eq. (31)"),
    "inductance": ("H", "L of one armature circuit, eq. (15)"),
    "duty": ("-", "D of the bridge, of the duty that is demanded"),
    "supply": ("V", "U_e from battery or external source, eqs. (8)-(13)"),
    "electrical": ("V", "U_e = E + I R + L dI/dt, eq. (15)"),
    "motor": ("N·m", "C_m I - M_df = M_d, eqs. (14), (17), (18)"),
    "gearbox": ("N·m", "M_r at the output shaft, eqs. (19)-(23)"),
    "track": ("N·m", "loss at the pulley, eqs. (24), (26)"),
    "ground": ("N", "traction = resistance + gravity + m dV/dt, eqs. (1), (5)"),
    "slip": ("m/s", "V = r_k ω_k - slip speed, eqs. (32), (33)"),
    "lateral": ("N", "m (dv_y/dt + ω v_x) = sum of lateral forces, of a robot that turns"),
    "yaw": ("N·m", "J_ψ dω/dt = sum of x F_y - y F_x, of a robot that turns"),
    "sensor": ("", "readings of the instruments, each channel in its unit"),
}

#: The balances of the turn; the others act along the travel of one side.
ROUND = ("lateral", "yaw")


def absent_balances(robot: Robot) -> frozenset[str]:
    """Balances that a robot lacks or that its instruments cannot show.

    A load on a shaft lacks those of the ground. `duty` and `supply` need an imposed voltage,
    `electrical` and `inductance` an imposed or measured one, `lateral` and `yaw` instruments of a turn. A file that
    states an efficiency of exactly 1 describes a drive whose gearbox, if any, loses nothing.
    """
    supply = set() if robot.rig.imposed == "voltage" else {"duty", "supply"}
    winding = set() if robot.rig.shows_voltage else {"electrical", "inductance"}
    geared = "gearbox.efficiency_load" not in robot.rig.exact or float(robot.gearbox.efficiency_load) < 1
    turns = set() if robot.rig.turns else {*ROUND}
    return robot.lacks | supply | winding | turns | (set() if geared else {"gearbox"})


def effects_sum(robot: Robot, signals: Signals, balance: str, channel: str = "") -> Scalar:
    """Sum of the robot's effects in one balance, and for `sensor` in one channel, in its unit.

    An effect adds 0 in configurations that it does not apply to. All effects add 0 if the load lacks the balance.
    """
    if balance in robot.lacks:
        return 0.0
    effects = [e for e in robot.effects if e.balance == balance and e.channel == channel]
    terms = [
        e.term(robot, signals) if e.acts_everywhere else e.acts(robot, signals) * e.term(robot, signals)
        for e in effects
    ]
    return sum(terms) if terms else 0.0


def _fill_unset(signals: Signals, **values: Any) -> Signals:
    return replace(signals, **values)


#: Motion in the plane of the ground, which straight travel does not have.
IN_PLANE = ("speed_lateral", "yaw_rate", "heading", "place_x", "place_y")


def bridge_duty(robot: Robot, conditions: Conditions) -> Scalar:
    """Duty that the bridge gives for the demanded one [-], before its current limit, in the same direction."""
    if conditions.voltage_follows or not any(e.balance == "duty" for e in robot.effects):
        return conditions.duty
    signals = Signals(
        configuration=conditions.configuration,
        on_tracks=robot.chassis(conditions.configuration).on_tracks,
        battery=conditions.battery,
        order=conditions.order,
        command=conditions.duty,
    )
    sign = jnp.where(conditions.duty < 0, -1.0, 1.0)
    return sign * clip(sign * (conditions.duty - effects_sum(robot, signals, "duty")), 0.0, 1.0)


def controller_reading(robot: Robot, conditions: Conditions, state: State) -> tuple[Scalar, Scalar]:
    """Reading that a controller compares with its goal, as `Rig.imposed`, and the rate of an angle, else 0 [SI]."""
    if robot.rig.imposed == "goal_current":
        return state.current, jnp.zeros_like(state.current)
    radius = robot.chassis(conditions.configuration).radius
    speed = state.speed / radius if robot.loose else state.speed_motor * (1 / robot.gearbox.ratio)
    return (state.distance / radius, speed) if robot.rig.imposed == "goal_angle" else (speed, jnp.zeros_like(speed))


def with_controller_duty(robot: Robot, conditions: Conditions, state: State) -> Conditions:
    """Conditions in which the goal is replaced by the duty that the controller demands in a state."""
    if conditions.goal is None or robot.controller is None:
        return conditions
    duty = conditions.duty * (_controller_duty(robot, conditions, state) if state.command is None else state.command)
    return eqx.tree_at(lambda c: (c.duty, c.goal), conditions, (duty, None), is_leaf=lambda x: x is None)


def _controller_duty(robot: Robot, conditions: Conditions, state: State) -> Scalar:
    """Duty that a controller wants [-]."""
    assert robot.controller is not None and conditions.goal is not None
    reading, speed = controller_reading(robot, conditions, state)
    goal_feed_forward = 0.0 if robot.rig.imposed == "goal_angle" else conditions.goal
    integral = 0.0 if state.integral is None else state.integral
    return robot.controller.duty(conditions.goal - reading, integral, speed, goal_feed_forward)


def controller_rates(robot: Robot, conditions: Conditions, state: State) -> list[Scalar]:
    """Rates of change of the controller's states: its integral (the error, or 0 while it would drive the duty beyond
    its limit), and the lagged duty.
    """
    zero = jnp.zeros_like(state.speed)
    if conditions.goal is None or robot.controller is None:
        return [zero] * len(robot.controller_states)
    if state.clock is not None:
        return [*[zero] * (len(robot.controller_states) - 1), zero - 1.0]
    duty, integrated = _controller_actions(robot, conditions, state)
    return [integrated] if state.command is None else [integrated, (duty - state.command) / robot.controller.lag]


def _controller_actions(robot: Robot, conditions: Conditions, state: State) -> tuple[Scalar, Scalar]:
    """Duty that a controller wants [-], and the error that it integrates."""
    assert robot.controller is not None and conditions.goal is not None
    duty = _controller_duty(robot, conditions, state)
    error = conditions.goal - controller_reading(robot, conditions, state)[0]
    saturated = (jnp.abs(duty) >= robot.controller.limit) & (duty * error > 0)
    return duty, jnp.where(saturated | (conditions.open > 0.5), 0.0, error)


#: Share of a controller's period that may be left when a sample is due, for rounding.
DUE = 1e-6


def sampled_controller(robot: Robot, conditions: Conditions, state: State) -> State:
    """State after a controller with a rate has read it, if a sample is due. Of other controllers the same state."""
    controller = robot.controller
    if controller is None or conditions.goal is None or state.clock is None or state.integral is None:
        return state
    duty, error = _controller_actions(robot, conditions, state)
    command = duty if state.pending is None else state.pending
    values = {
        "integral": state.integral + error / controller.rate,
        "command": command,
        "clock": state.clock + 1 / controller.rate,
    }
    values |= {} if state.pending is None else {"pending": duty}
    due = state.clock <= DUE / controller.rate
    changed: Any = {name: jnp.where(due, value, getattr(state, name)) for name, value in values.items()}
    return replace(state, **changed)


def begin_signals(robot: Robot, conditions: Conditions, state: State, direction: Scalar | None = None) -> Signals:
    """Kinematics and mass of the instant. `direction` None takes it from the speeds, smooth through rest."""
    chassis = robot.chassis(conditions.configuration)
    speed_wheel = state.speed_motor * (1 / robot.gearbox.ratio)
    speed_theoretical = chassis.radius * speed_wheel
    speed_still = chassis.speed_still
    duty = robot.driver.duty_limited(bridge_duty(robot, conditions), state.current, conditions.polarity)
    zero_motion = dict.fromkeys(IN_PLANE, jnp.zeros_like(state.speed))
    signals = _fill_unset(
        Signals(),
        **zero_motion,
        configuration=conditions.configuration,
        on_tracks=chassis.on_tracks,
        slope=conditions.slope,
        payload=conditions.payload,
        adhesion=conditions.adhesion,
        battery=conditions.battery,
        discharge=state.discharge,
        order=conditions.order,
        load_torque=conditions.load_torque,
        memory=state.memory,
        current=state.current,
        speed_motor=state.speed_motor,
        speed=state.speed,
        direction=contact.smooth_sign(speed_theoretical, speed_still) if direction is None else direction,
        direction_travel=contact.smooth_sign(state.speed, speed_still) if direction is None else direction,
        speed_wheel=speed_wheel,
        speed_theoretical=speed_theoretical,
        speed_output=state.speed / chassis.radius if robot.loose else speed_wheel,
        angle=state.distance / chassis.radius,
        temperature=state.temperature,
        command=conditions.duty,
        duty=duty,
        pause=jnp.where(jnp.abs(jnp.asarray(conditions.open)) > 0.5, 0.0, 1 - jnp.abs(duty)),
        share_drawn=robot.driver.share_drawn(duty),
        total_current=robot.sides * state.current * robot.driver.share_drawn(duty),
    )
    if isinstance(chassis, Shaft):  # no ground carries it
        return _fill_unset(signals, mass=jnp.zeros_like(state.speed), normal=jnp.zeros_like(state.speed))
    total_mass = chassis.mass + conditions.payload if conditions.total_mass is None else conditions.total_mass
    mass = total_mass + effects_sum(robot, _fill_unset(signals, mass=total_mass), "mass")
    normal = chassis_module.normal_load(mass, conditions.slope, GRAVITY, robot.sides)
    return _fill_unset(signals, mass=mass, normal=normal)


def mass_with_effects(robot: Robot, conditions: Conditions) -> Scalar:
    """Total mass of robot and payload, with the effects that change it [kg]."""
    zero = jnp.zeros_like(conditions.voltage)
    return begin_signals(robot, conditions, State(zero, zero, zero, zero)).mass


def supply(robot: Robot, conditions: Conditions, signals: Signals) -> Signals:
    """Voltage at the motors [V]: the duty times the source voltage, less the drops on the way to the motors."""
    if conditions.voltage_follows:
        return signals
    source = power.voltage_source(
        robot.battery, conditions.voltage, conditions.battery, signals.total_current, signals.discharge
    )
    back_emf = robot.motor.voltage_back(signals.speed_motor)
    voltage = robot.driver.voltage(
        source - effects_sum(robot, signals, "supply"), signals.duty, signals.pause, back_emf
    )
    demanded_duty, limited_duty = (
        conditions.polarity * duty for duty in (bridge_duty(robot, conditions), signals.duty)
    )
    conducts = robot.driver.conducts(
        demanded_duty, limited_duty, signals.current, voltage - back_emf, conditions.open
    )
    voltage = jnp.where(conducts == 1, voltage, back_emf + conducts * (voltage - back_emf))
    return _fill_unset(signals, voltage_source=source, voltage=voltage)


def power_drawn(robot: Robot, signals: Signals) -> Scalar:
    """Power that all motors take [W], including the heat of the current ripple."""
    pulses = (robot.driver.ripple(signals.duty) - 1) * signals.voltage_drop
    return robot.sides * (signals.voltage + pulses) * signals.current


def charge_drawn(robot: Robot, conditions: Conditions, total_current: Scalar) -> Scalar:
    """Battery current [A], which reduces its charge, eq. (11), 0 on an external supply."""
    return robot.battery.current(total_current) * (conditions.battery > 0.5)


def electrical(robot: Robot, conditions: Conditions, signals: Signals) -> Signals:
    """Voltage available to change the current [V].

    With an imposed speed, the voltage that this speed needs. With an imposed current, the voltage of an amplifier
    that brings the current to its set value within the winding's time constant.
    """
    back_emf = robot.motor.voltage_back(signals.speed_motor)
    drop = robot.motor.voltage_winding(signals.current, signals.temperature) + effects_sum(
        robot, signals, "electrical"
    )
    if conditions.voltage_follows:
        current_imposed = signals.current if conditions.motor_current is None else conditions.motor_current
        voltage_needed = back_emf + drop + robot.motor.resistance * (current_imposed - signals.current)
        signals = _fill_unset(signals, voltage=voltage_needed, voltage_source=voltage_needed)
    return _fill_unset(
        signals,
        voltage_back=back_emf,
        voltage_drop=drop,
        voltage_left=signals.voltage - back_emf - drop,
        inductance=robot.motor.inductance + effects_sum(robot, signals, "inductance"),
    )


def motor(robot: Robot, signals: Signals) -> Signals:
    """Torque at the motor shaft [N·m]."""
    electromagnetic = robot.motor.torque_electromagnetic(signals.current)
    loss = robot.motor.torque_loss(signals.speed_motor, signals.direction)
    loss = loss + effects_sum(robot, signals, "motor")
    return _fill_unset(
        signals,
        torque_electromagnetic=electromagnetic,
        torque_motor_loss=loss,
        torque_motor=electromagnetic - loss,
    )


def opposing_torque(chassis: Shaft, signals: Signals) -> Scalar:
    """Torque that opposes forward rotation of a shaft in both directions: its own load and a brake's [N·m]."""
    load = chassis.torque_load(signals.angle)
    return load if signals.load_torque is None else load + signals.load_torque


def travel(robot: Robot, chassis: Load, signals: Signals) -> Signals:
    """Forces along the slope that traction has to overcome [N]. For a shaft, its load torque over the radius."""
    if isinstance(chassis, Shaft):
        demand = opposing_torque(chassis, signals) / chassis.radius
        zero = jnp.zeros_like(demand)
        return _fill_unset(signals, resistance=zero, gravity=demand, demand=demand, adhesion_limit=zero + jnp.inf)
    resistance = chassis.ground.force_resistance(signals.normal, signals.direction_travel)
    resistance = resistance + effects_sum(robot, signals, "ground")
    gravity = contact.force_gravity(signals.mass * (1 / robot.sides), signals.slope, GRAVITY)
    return _fill_unset(
        signals,
        resistance=resistance,
        gravity=gravity,
        demand=resistance + gravity,
        adhesion_limit=chassis.ground.force_adhesion(signals.normal, signals.adhesion),
    )


def slip(robot: Robot, signals: Signals) -> Signals:
    """Sliding speed of the contact patch over the ground [m/s]."""
    terms = effects_sum(robot, signals, "slip")
    return _fill_unset(
        signals, speed_slip_terms=terms, speed_sliding=signals.speed_theoretical - signals.speed - terms
    )


def track(robot: Robot, chassis: Load, signals: Signals, guide: Scalar | None = None) -> Signals:
    """Losses between pulley and ground, at the pulley. For a shaft the friction of its load [N·m].

    `guide` is the friction on the lower guide [N]. None applies (26) to the guides' stated share of the weight.
    """
    if isinstance(chassis, Shaft):
        loss = chassis.torque_loss(signals.speed_wheel, signals.direction) + effects_sum(robot, signals, "track")
        return _fill_unset(signals, torque_track_loss=loss)
    loss = chassis.track.torque_loss(signals.speed_wheel, signals.direction)
    guide = chassis.track.force_guide(signals.normal, signals.direction) if guide is None else guide
    loss = loss + guide * chassis.radius + effects_sum(robot, signals, "track")
    return _fill_unset(signals, torque_track_loss=loss)


#: Least inertia of the parts that turn with a wheel [kg·m²]: a rig's file may state none.
LEAST_INERTIA = 1e-12
#: Newton steps of the torque at the output, on which effects of the gearbox depend.
TORQUE_STEPS = 4


def gearbox(
    robot: Robot, chassis: Load, signals: Signals, mover_torque: Scalar | None = None, *, settled: bool = False
) -> Signals:
    """Torques at both shafts and the acceleration of the driving wheel, the armature taking its share.

    Effects of the gearbox depend on the torque B + J_w ω̇_k that it transmits to its output. J_w is the inertia that
    turns with the output, and B the load without their own loss. That torque depends on their loss, so Newton's
    method finds it.

    Args:
        mover_torque: the mover's torque on the shaft in addition to the track losses [N·m]. None: the traction.
        settled: True in steady travel: the torque at the output is B.
    """
    mover_torque = chassis.radius * signals.traction if mover_torque is None else mover_torque
    load_torque = signals.torque_track_loss + mover_torque

    def signals_at_torque(torque: Scalar) -> Signals:
        carrying_signals = _fill_unset(signals, torque_carried=torque)
        return _gearbox_signals(
            robot, chassis, carrying_signals, load_torque, effects_sum(robot, carrying_signals, "gearbox")
        )

    def transmitted_torque(output_signals: Signals) -> Scalar:
        return load_torque + (chassis.inertia + output_signals.inertia_added) * output_signals.acceleration_wheel

    def torque_error(torque: Scalar) -> Scalar:
        return torque - transmitted_torque(signals_at_torque(torque))

    torque = load_torque
    output_signals = signals_at_torque(load_torque)
    if settled:
        return output_signals
    if not any(e.balance == "gearbox" for e in robot.effects):
        return _fill_unset(output_signals, torque_carried=transmitted_torque(output_signals))
    for _ in range(TORQUE_STEPS):
        residual, slope = value_and_slope(torque_error, torque)
        torque = torque - residual / slope
    return signals_at_torque(torque)


def _gearbox_signals(
    robot: Robot, chassis: Load, signals: Signals, load_torque: Scalar, effect_loss: Scalar
) -> Signals:
    """Signals of a gearbox whose effects lose `effect_loss` under a load [N·m].

    Let A be the motor torque less the idle loss, and B the load at the output. The transmitted torque has the sign of
    A J_w + i J_d B at any efficiency. That sign decides the direction in which the load loss acts.
    """
    gear = robot.gearbox
    inertia_motor = robot.motor.inertia
    idle = gear.torque_idle(signals.speed_motor, signals.direction)
    load_torque = load_torque + effect_loss
    driving_torque = signals.torque_motor - idle
    inertia_added = effects_sum(robot, signals, "inertia")
    # Shafts without inertia get a very small one, which decides the direction of power and the torque transmitted.
    inertia_wheel = chassis.inertia + inertia_added
    small_inertia = LEAST_INERTIA + at_least(
        inertia_wheel, 0.0
    )  # keeps the derivative with respect to an added inertia
    inertia_wheel = jnp.where(inertia_wheel < LEAST_INERTIA, small_inertia, inertia_wheel)
    motor_inertia_times_ratio = gear.ratio * inertia_motor
    transmitted = (driving_torque * inertia_wheel + motor_inertia_times_ratio * load_torque) / (
        inertia_wheel + motor_inertia_times_ratio
    )
    efficiency = gear.efficiency_flow(transmitted, signals.direction)
    net = gear.ratio * efficiency * driving_torque - load_torque
    inertia = chassis_module.inertia_reduced(inertia_motor, gear.ratio, efficiency, inertia_wheel)
    acceleration = net / inertia
    torque_input = signals.torque_motor - inertia_motor * gear.ratio * acceleration
    torque_gear = gear.ratio * efficiency * (torque_input - idle)
    return _fill_unset(
        signals,
        torque_idle=idle,
        torque_load=load_torque,
        inertia_added=inertia_added,
        efficiency_load=efficiency,
        torque_net=net,
        acceleration_wheel=acceleration,
        torque_input=torque_input,
        torque_gear=torque_gear,
        torque_output=torque_gear - effect_loss,
    )


def _signals_up_to_slip(robot: Robot, conditions: Conditions, chassis: Load, signals: Signals) -> Signals:
    """Applies the balances between kinematics and traction, in their order."""
    signals = electrical(robot, conditions, supply(robot, conditions, signals))
    return slip(robot, travel(robot, chassis, motor(robot, signals)))


def _traction_and_net_force(robot: Robot, signals: Signals, traction: Scalar) -> Signals:
    """Traction [N] and the force left to accelerate the robot, eq. (1)."""
    acceleration = (traction - signals.demand) / (signals.mass / robot.sides)
    return _fill_unset(signals, traction=traction, acceleration=acceleration)


def moving_signals(robot: Robot, conditions: Conditions, state: State, direction: Scalar | None = None) -> Signals:
    """All signals of a robot in motion: traction follows from sliding by the friction law.

    With an imposed motor speed, the current follows from the torque.

    Args:
        direction: direction of motion that dry friction opposes, ±1 [-]. None or 0: from the speeds, smooth through
            rest.
    """
    conditions = with_controller_duty(robot, conditions, state)
    if conditions.motor_speed is not None:
        state = replace(state, current=_current_for_acceleration(robot, conditions, state, direction))
    return _signals_in_motion(robot, conditions, state, direction)


def rolling_signals(robot: Robot, conditions: Conditions, state: State, direction: Scalar | None) -> Signals:
    """All signals of a robot in motion whose load turns rigidly with its wheels.

    The load's inertia acts at the driving shaft, and traction is what the inertia and the demand need.

    Args: as in `moving_signals`.
    """
    robot = robot.within(conditions.configuration)
    chassis = robot.chassis(conditions.configuration)
    if isinstance(chassis, Shaft):
        return moving_signals(robot, conditions, state, direction)
    signals = _signals_up_to_slip(
        robot, conditions, chassis, _with_direction(begin_signals(robot, conditions, state), direction)
    )
    signals = track(robot, chassis, _fill_unset(signals, traction=signals.demand))
    side_mass = signals.mass * (1 / robot.sides)
    loaded_chassis = replace(chassis, inertia=chassis.inertia + side_mass * chassis.radius**2)
    signals = gearbox(robot, loaded_chassis, signals)
    acceleration = chassis.radius * signals.acceleration_wheel
    return _fill_unset(signals, acceleration=acceleration, traction=signals.demand + side_mass * acceleration)


def _with_direction(signals: Signals, direction: Scalar | None) -> Signals:
    """Signals with the direction that dry friction opposes, as in `moving_signals`."""
    if direction is None:
        return signals
    fields = "direction", "direction_travel"
    return _fill_unset(
        signals, **{field: jnp.where(direction == 0, getattr(signals, field), direction) for field in fields}
    )


#: Newton steps of the current at an imposed speed: torque is linear in it except for effects and the power direction.
CURRENT_STEPS = 4


def _current_for_acceleration(robot: Robot, conditions: Conditions, state: State, direction: Scalar | None) -> Scalar:
    """Motor current that gives the imposed acceleration [A]."""

    def signals_at(inputs: tuple[Robot, Conditions, State], current: Scalar) -> Signals:
        robot, conditions, state = inputs
        return _signals_in_motion(robot, conditions, replace(state, current=current), direction)

    return _solve_current(signals_at, (robot, conditions, state))


def _signals_at_imposed_speed(robot: Robot, conditions: Conditions, chassis: Chassis, signals: Signals) -> Signals:
    """Signals of a side whose motor speed is imposed and whose traction is known."""

    def signals_at(inputs: tuple[Robot, Conditions, Chassis, Signals], current: Scalar) -> Signals:
        robot, conditions, chassis, signals = inputs
        total_current = robot.sides * current * signals.share_drawn
        electrical_signals = electrical(
            robot, conditions, _fill_unset(signals, current=current, total_current=total_current)
        )
        return gearbox(robot, chassis, motor(robot, electrical_signals))

    inputs = robot, conditions, chassis, signals
    return signals_at(inputs, _solve_current(signals_at, inputs))


def _solve_current(signals_at: Callable[[Any, Scalar], Signals], inputs: tuple) -> Scalar:
    """Motor current that gives the imposed acceleration [A].

    Args:
        signals_at: function of `inputs` and a current [A].
        inputs: robot, conditions and further inputs. Only the last Newton step is differentiated with respect to
            them.
    """

    def acceleration_error(inputs: tuple, current: Scalar) -> Scalar:
        robot, conditions, *_ = inputs
        acceleration_imposed = 0.0 if conditions.motor_acceleration is None else conditions.motor_acceleration
        return signals_at(inputs, current).acceleration_wheel * robot.gearbox.ratio - acceleration_imposed

    constant_inputs = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x, inputs)
    current = jnp.zeros_like(jnp.asarray(constant_inputs[1].motor_speed))
    for step in range(CURRENT_STEPS):
        residual, slope = value_and_slope(lambda x: acceleration_error(constant_inputs, x), current)
        residual = acceleration_error(inputs, current) if step == CURRENT_STEPS - 1 else residual
        current = current - residual / slope
    return current


def _signals_in_motion(robot: Robot, conditions: Conditions, state: State, direction: Scalar | None) -> Signals:
    robot = robot.within(conditions.configuration)
    chassis = robot.chassis(conditions.configuration)
    signals = _signals_up_to_slip(
        robot, conditions, chassis, _with_direction(begin_signals(robot, conditions, state), direction)
    )
    if isinstance(chassis, Shaft):
        signals = _fill_unset(signals, traction=signals.demand)
        if state.gap is not None:
            return _joint_signals(robot, chassis, signals, state.gap)
        signals = gearbox(robot, chassis, track(robot, chassis, signals))
        return _fill_unset(signals, acceleration=chassis.radius * signals.acceleration_wheel)
    traction = chassis.ground.traction(signals.speed_sliding, signals.normal, signals.adhesion)
    signals = _traction_and_net_force(robot, signals, traction)
    return gearbox(robot, chassis, track(robot, chassis, signals))


def _joint_signals(robot: Robot, chassis: Shaft, signals: Signals, gap: Scalar) -> Signals:
    """Motor and load as two bodies, between which gear flanks or an elastic joint carry a torque [N·m]."""
    gear = robot.gearbox
    idle = gear.torque_idle(signals.speed_motor, signals.direction)
    loss = chassis.torque_loss(signals.speed_output, signals.direction_travel) + effects_sum(robot, signals, "track")
    inertia_added = effects_sum(robot, signals, "inertia")
    inertia_motor = robot.motor.inertia * gear.ratio**2
    mesh_torque = chassis.torque_joint(gap, signals.speed_wheel - signals.speed_output, inertia_motor)
    signals = _fill_unset(signals, torque_track_loss=loss, torque_carried=mesh_torque)
    added_loss = effects_sum(robot, signals, "gearbox")
    efficiency = gear.efficiency_flow(mesh_torque, signals.direction)
    driving_torque = signals.torque_motor - idle
    net = gear.ratio * driving_torque - mesh_torque / efficiency - added_loss
    acceleration = net / inertia_motor
    return _fill_unset(
        signals,
        torque_idle=idle,
        torque_load=mesh_torque + added_loss,
        inertia_added=inertia_added,
        efficiency_load=efficiency,
        torque_net=net,
        acceleration_wheel=acceleration,
        torque_input=signals.torque_motor - robot.motor.inertia * gear.ratio * acceleration,
        torque_gear=mesh_torque + added_loss,
        torque_output=mesh_torque,
        acceleration=chassis.radius
        * (mesh_torque - loss - opposing_torque(chassis, signals))
        / (chassis.inertia + inertia_added),
    )


class Mover(Protocol):
    """Movers whose contacts are computed one by one."""

    @property
    def normal(self) -> Scalar:
        """Normal load of one side [N]."""
        ...

    def pull(self, chassis: Chassis, signals: Signals) -> Any:
        """Contact forces: `traction` [N], `guide` [N], and `load` on the driving shaft [N·m]."""
        ...


def resolved_signals(
    robot: Robot, conditions: Conditions, state: State, mover: Mover, inertia: Scalar
) -> tuple[Signals, Any]:
    """All signals of a robot in motion whose normal load, traction and guide load come from its contacts.

    Args:
        mover: the contacts at this instant.
        inertia: inertia of all parts that turn rigidly with the driving shaft, in place of `chassis.inertia` [kg·m²].

    Returns:
        The signals, and the result of `mover.pull`.
    """
    robot = robot.within(conditions.configuration)
    chassis = replace(robot.chassis(conditions.configuration), inertia=inertia)
    signals = _fill_unset(begin_signals(robot, conditions, state), normal=mover.normal)
    signals = _signals_up_to_slip(robot, conditions, chassis, signals)
    forces = mover.pull(chassis, signals)
    return _side_signals(robot, chassis, signals, forces), forces


def _side_signals(robot: Robot, chassis: Chassis, signals: Signals, forces: Any) -> Signals:
    """Signals of one side whose sliding is known, with the forces of its contacts."""
    traction = forces.traction
    guide = jnp.sum(forces.guide)
    signals = track(robot, chassis, _traction_and_net_force(robot, signals, traction), guide)
    return gearbox(robot, chassis, signals, forces.load - guide * chassis.radius)


def resolved_sides(
    robot: Robot, conditions: Conditions, motion: PlaneMotion, mover: Mover, inertia: Scalar
) -> tuple[Signals, Any]:
    """Same as `resolved_signals` for a robot free to turn. Left and right side are a leading axis of 2.

    Signals, the normal loads of `mover` and its result have that axis.
    """
    robot = robot.within(conditions.configuration)
    chassis = replace(robot.chassis(conditions.configuration), inertia=inertia)
    side_conditions = conditions.of_sides()
    signals = _fill_unset(_begin_sides(robot, conditions, side_conditions, motion), normal=mover.normal)
    signals = jax.vmap(lambda c, s: _signals_up_to_slip(robot, c, chassis, s))(side_conditions, signals)
    forces = mover.pull(chassis, signals)
    return jax.vmap(lambda s, f: _side_signals(robot, chassis, s, f))(signals, forces), forces


def driven_signals(robot: Robot, conditions: Conditions, state: State, direction: Scalar | None) -> Signals:
    """Signals of an instant up to the voltage balance. `direction`: as in `begin_signals`."""
    robot, conditions = robot.within(conditions.configuration), with_controller_duty(robot, conditions, state)
    return electrical(
        robot, conditions, supply(robot, conditions, begin_signals(robot, conditions, state, direction))
    )


def demanded_signals(robot: Robot, conditions: Conditions, state: State, direction: Scalar) -> Signals:
    """Signals of an instant up to the demand on traction and the sliding of the contact."""
    robot = robot.within(conditions.configuration)
    return _signals_up_to_slip(
        robot, conditions, robot.chassis(conditions.configuration), begin_signals(robot, conditions, state, direction)
    )


def settled_signals(
    robot: Robot, conditions: Conditions, state: State, direction: Scalar = 1.0
) -> tuple[Signals, Scalar]:
    """All signals of steady travel: traction is the demand.

    Args:
        direction: direction of travel, 1 forward or -1 backward. Friction acts against it, also at rest.

    Returns:
        The signals, and the sliding speed that the friction law needs to carry the demand [m/s]. In steady travel
        `signals.speed_sliding` equals it.
    """
    robot = robot.within(conditions.configuration)
    chassis = robot.chassis(conditions.configuration)
    signals = demanded_signals(robot, conditions, state, direction * jnp.ones_like(state.speed_motor))
    # In steady travel nothing changes: the rates that other fidelities compute are zero.
    zero = jnp.zeros_like(signals.demand)
    signals = _fill_unset(signals, traction=signals.demand, acceleration=zero)
    if isinstance(chassis, Shaft):
        creep_speed = zero
    else:
        creep_speed = chassis.ground.speed_creep(signals.demand, signals.normal, signals.adhesion)
    return gearbox(robot, chassis, track(robot, chassis, signals), settled=True), creep_speed


class Travel(eqx.Module):
    """All signals of one instant of a robot that turns.

    Attributes:
        signals: signals of each side, a leading axis of 2: left, right. Both hold totals and motion of the whole
            robot.
        grip: forces of the ground on each side.
        acceleration, acceleration_lateral: dv_x/dt and dv_y/dt [m/s²].
        acceleration_yaw: dω/dt [rad/s²].
    """

    signals: Signals
    grip: GroundForces
    acceleration: Scalar
    acceleration_lateral: Scalar
    acceleration_yaw: Scalar


def stance(robot: Robot, conditions: Conditions, chassis: Chassis, mass: Scalar) -> Stance:
    """Stance of a robot with its payload, of this total mass [kg].

    The centre of mass includes all parts. Axles are one radius above the ground, on tracks a grouser height more.
    Levers with stated angles have the posture that they take on level ground.
    """
    length = robot.running_gear.wheelbase
    on_tracks = chassis.on_tracks
    if conditions.states_levers:
        posture = resting_posture.level_posture(robot, conditions, mass)
        length, on_tracks, height = posture.length, posture.line, posture.centre_height
        centre_offset = posture.centre_ahead - (posture.front + posture.rear) / 2
    else:
        centre_offset, centre_height = masses.masses_of_parts(robot, conditions, mass).centre
        height = chassis.radius + chassis.on_tracks * robot.running_gear.grouser_height + centre_height
    return Stance(
        length=length,
        width=chassis.turning.width,
        height=height,
        ahead=centre_offset,
        on_tracks=on_tracks,
        lateral=lateral_friction(conditions, chassis),
        rule=chassis.turning.rule,
        nodes=chassis.turning.nodes,
    )


def states_of_sides(robot: Robot, conditions: Conditions, motion: PlaneMotion) -> State:
    """States of left and right side, with a leading axis of 2. Each side travels at V_s = v_x - ω y_s."""
    speed = motion.speed - motion.yaw_rate * SIDES * robot.chassis(conditions.configuration).turning.width
    zero = jnp.zeros_like(speed)
    discharge = jnp.broadcast_to(motion.discharge, speed.shape)
    return State(
        motion.current, motion.speed_motor, speed, discharge, motion.memory, motion.temperature, distance=zero
    )


def lateral_friction(conditions: Conditions, chassis: Chassis) -> Scalar:
    """Lateral friction over longitudinal on this ground, λ [-]."""
    lateral = chassis.turning.lateral
    adhesion_lateral = conditions.adhesion_lateral
    return lateral if adhesion_lateral is None else lateral * adhesion_lateral / conditions.adhesion


def _both_sides(x: Scalar) -> Array:
    """The same value for left and right side."""
    return jnp.broadcast_to(x, SIDES.shape)


def _begin_sides(robot: Robot, conditions: Conditions, side_conditions: Conditions, motion: PlaneMotion) -> Signals:
    """`begin_signals` of left and right side, with motion in the plane."""
    chassis = robot.chassis(conditions.configuration)
    signals = jax.vmap(functools.partial(begin_signals, robot))(
        side_conditions, states_of_sides(robot, conditions, motion)
    )
    return _fill_unset(
        signals,
        total_current=_both_sides(sum_of_sides(signals.total_current) / 2),
        side=jnp.sign(SIDES),
        direction_turn=_both_sides(
            contact.smooth_sign(motion.yaw_rate * chassis.turning.width / 2, chassis.speed_still)
        ),
        slope=_both_sides(jnp.arcsin(sine(conditions.slope) * cosine(motion.heading))),
        **{name: _both_sides(getattr(motion, name)) for name in IN_PLANE},
    )


def lateral_and_yaw_effects(robot: Robot, signals: Signals) -> tuple[Scalar, Scalar]:
    """Sums of the robot's effects in the balances `lateral` [N] and `yaw` [N·m], over both sides."""

    def sum_in(balance: str) -> Scalar:
        effect_sums = _both_sides(jax.vmap(lambda s: effects_sum(robot, s, balance))(signals))
        return robot.sides / 2 * sum_of_sides(effect_sums)

    return sum_in("lateral"), sum_in("yaw")


def turning_signals(
    robot: Robot, conditions: Conditions, motion: PlaneMotion, loads: Float[Array, " 2"] | None = None
) -> Travel:
    """All signals of a robot free to turn: the balances of both sides, coupled by supply and ground.

    Each side has the component of the slope along its heading. Effects that lower the speed of a side are evaluated
    with the load divided equally between the sides.

    Args:
        loads: normal loads of both sides [N], see `GroundForceInputs.forces`.
    """
    robot = robot.within(conditions.configuration)
    chassis = robot.chassis(conditions.configuration)
    side_conditions = conditions.of_sides()
    y = SIDES * chassis.turning.width
    signals = _begin_sides(robot, conditions, side_conditions, motion)
    sine_slope = sine(conditions.slope)
    mass = jnp.maximum(*signals.mass)
    equally_loaded = jax.vmap(lambda c, s: _signals_up_to_slip(robot, c, chassis, s))(side_conditions, signals)
    rolling_coefficient = chassis.ground.force_resistance(1.0, equally_loaded.direction_travel)
    motors_per_side = robot.sides / 2
    robot_stance = stance(robot, conditions, chassis, mass)
    total_load = sum_of_sides(motors_per_side * equally_loaded.normal)
    sliding = equally_loaded.speed_sliding
    inputs = GroundForceInputs(
        robot_stance, chassis.ground.friction, conditions.adhesion, total_load, sliding, motion.speed_lateral,
        motion.yaw_rate, rolling_coefficient,
    )  # fmt: skip
    contact_forces = inputs.forces(loads)
    loaded = jax.vmap(lambda s: travel(robot, chassis, s))(
        _fill_unset(
            equally_loaded,
            normal=contact_forces.normal / motors_per_side,
            moment_lateral=contact_forces.moment / motors_per_side,
        )
    )
    lateral, yaw = lateral_and_yaw_effects(robot, loaded)
    net_forces = contact_forces.ahead - motors_per_side * loaded.resistance
    force_along = sum_of_sides(net_forces) - mass * GRAVITY * sine_slope * cosine(motion.heading)
    force_across = sum_of_sides(contact_forces.aside) + mass * GRAVITY * sine_slope * sine(motion.heading) - lateral
    acceleration_yaw = (sum_of_sides(contact_forces.moment - y * net_forces) - yaw) / chassis.turning.inertia
    acceleration = force_along / mass + motion.yaw_rate * motion.speed_lateral
    driven = _fill_unset(
        loaded, traction=contact_forces.ahead / motors_per_side, acceleration=acceleration - acceleration_yaw * y
    )
    driven = jax.vmap(lambda s: track(robot, chassis, s))(driven)
    if side_conditions.motor_speed is None:
        driven = jax.vmap(lambda s: gearbox(robot, chassis, s))(driven)
    else:
        driven = jax.vmap(lambda c, s: _signals_at_imposed_speed(robot, c, chassis, s))(side_conditions, driven)
        driven = _fill_unset(driven, total_current=_both_sides(sum_of_sides(driven.total_current) / 2))
    return Travel(
        driven,
        contact_forces,
        acceleration,
        force_across / mass - motion.yaw_rate * motion.speed,
        acceleration_yaw,
    )


def sensor(robot: Robot, signals: Signals) -> Scalars:
    """Ideal readings of every channel [SI], by channel name, NaN if a reading depends on an unknown parameter."""
    return {
        c.name: robot.rig.instrument(c.name).shows(c.read(robot, signals))
        + effects_sum(robot, signals, "sensor", c.name)
        if robot.knows(c.rests_on)
        else jnp.full_like(signals.speed, jnp.nan)
        for c in channels.EVERY
    }


def readings_of_sides(robot: Robot, signals: Signals) -> Scalars:
    """Same as `sensor` for signals with a last axis of left and right side.

    A channel of one side shows that side. The others show the mean.
    """
    readings = sensor(robot, signals)
    return {
        c.name: jnp.mean(readings[c.name], -1) if c.side is None else jnp.asarray(readings[c.name])[..., c.side]
        for c in channels.EVERY
    }


def mean_of_sides(signals: Signals) -> Signals:
    """Mean signals of both sides, as one motor's. Totals follow as for equal sides."""
    return jax.tree.map(lambda x: jnp.mean(x, axis=-1) if jnp.ndim(x) else x, signals)


def signals_of(instant: Signals | Travel) -> Signals:
    """Signals of an instant. For a robot that turns, of left and right side."""
    return instant.signals if isinstance(instant, Travel) else instant
