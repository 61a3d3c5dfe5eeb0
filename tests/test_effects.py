"""The laws that every effect of the library obeys. Mutants that each law rejects are in tests/mutants.toml."""

from __future__ import annotations

import dataclasses
import functools
import pickle
import re
from collections import Counter
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from worlds import laws

from calibration.data.effect_file import readable_signals
from calibration.discovery import menu
from calibration.inference.linearization import PROBED, amplitude_of
from calibration.inference.observers.settled import SettledRuns
from mmrjax import effects
from mmrjax.effects import ALL, BY_NAME, base
from mmrjax.effects.base import Periodic, scaled_effect
from mmrjax.fidelities.drive import drive, drive_rates, drive_start, state_of_unknowns
from mmrjax.fidelities.steady import steady, steady_batch
from mmrjax.model import channels, params
from mmrjax.model.balances import BALANCES, effects_sum, moving_signals, sensor
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_robots import blank_robot, nominal
from mmrjax.model.rig import Instrument, RunStart, RunStarts
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import CONVERGED, STALLED, Signals, State
from mmrjax.undercarriage import half_robot

# --- units --------------------------------------------------------------------------------------------

BASE = ("kg", "m", "s", "A")
#: Derived units in the base units. Degrees and shares have none; temperature is not rescaled.
DERIVED = {
    "N": "kg·m/s^2",
    "V": "kg·m^2/s^3/A",
    "ohm": "kg·m^2/s^3/A^2",
    "H": "kg·m^2/s^2/A^2",
    "W": "kg·m^2/s^3",
    "C": "A·s",
    "J": "kg·m^2/s^2",
}
NEUTRAL = {"-", "", "K", "°C", "rad"}

#: Unit of every field of `Signals`.
SIGNAL_UNITS = {
    "A": "current total_current",
    "V": "voltage_source voltage voltage_back voltage_drop voltage_left",
    "C": "discharge",
    "kg": "mass payload",
    "N": "normal resistance gravity demand traction adhesion_limit",
    "m/s": "speed speed_theoretical speed_slip_terms speed_sliding speed_lateral",
    "m": "place_x place_y",
    "m/s^2": "acceleration",
    "1/s": "speed_motor speed_wheel speed_output yaw_rate",
    "1/s^2": "acceleration_wheel",
    "N·m": "torque_electromagnetic torque_motor_loss torque_motor torque_track_loss torque_load torque_idle "
    "torque_input torque_gear torque_output torque_carried torque_net moment_lateral",
    "H": "inductance",
    "kg·m^2": "inertia_added",
    "rad": "angle heading",
    "-": "side command duty pause share_drawn on_tracks battery slope adhesion order direction direction_travel direction_turn efficiency_load",
}
UNIT_OF = {name: unit for unit, fields in SIGNAL_UNITS.items() for name in fields.split()}
SENSOR_UNITS = {c.name: c.unit_si for c in channels.EVERY}


def dimensions(unit):
    """Exponents of the base units of a product such as `N·m·s^2` or `V/C^2`."""
    total = Counter()
    for sign, symbol, power in re.findall(r"([·/]?)([^·/^]+)(?:\^(\d+(?:\.\d+)?))?", unit):
        exponent = float(power or 1) * (-1 if sign == "/" else 1)
        if symbol in BASE:
            total[symbol] += exponent
        elif symbol in DERIVED:
            for base, count in dimensions(DERIVED[symbol]).items():
                total[base] += exponent * count
        elif symbol not in NEUTRAL and symbol != "1":
            raise ValueError(f"unknown unit {symbol!r} in {unit!r}")
    return total


def factor(unit, change):
    """What a number in `unit` is multiplied by when each base unit's numbers are."""
    return float(np.prod([change[base] ** count for base, count in dimensions(unit).items()]))


def balance_unit(effect):
    return SENSOR_UNITS[effect.channel] if effect.balance == "sensor" else BALANCES[effect.balance][0]


# --- what the laws are tried on -----------------------------------------------------------------------

NOMINAL = nominal()
AMPLITUDES = (0.37, 1.9)  # of the prior's standard deviation
#: Speed or current that a balance's term multiplies to a power.
CONJUGATE = {
    "supply": "total_current",
    "electrical": "current",
    "motor": "speed_motor",
    "gearbox": "speed_wheel",
    "track": "speed_wheel",
    "ground": "speed",
    "slip": "demand",  # the traction in steady travel
}
CONDITIONS = Conditions(
    voltage=[33.0, 15.0, 24.0, 24.0, 24.0],
    slope_deg=np.degrees([0.09, 0.0, 0.05, -0.1, 0.12]),
    payload=[8.0, 0.0, 3.0, 0.0, 5.0],
    configuration=["6T2A", "4W2T", "6T2A", "4W2T", "4W2T"],
    battery=[0.0, 0.0, 1.0, 0.0, 1.0],
    discharge=[0.0, 0.0, 3000.0, 0.0, 100.0],
    duty=[1.0, 0.8, 1.0, 1.0, 1.0],
).resolved(NOMINAL)


def random_states(n=400):
    """Signals of the nominal robot at random states: either direction, either configuration, spinning."""
    rng = default_rng(12)
    low, high = (-20, -1200, -1.2, 0, 15, -0.3, 0, 0.5), (20, 1200, 1.2, 7000, 33, 0.3, 8, 2)
    current, motor, speed, charge, voltage, slope, payload, adhesion = rng.uniform(low, high, (n, 8)).T
    memory = {e.name: jnp.asarray(e.memory_size * rng.uniform(0, 1, n)) for e in ALL if e.memory_size is not None}
    motor[:40] *= 1e-4  # through rest
    configuration, battery = rng.integers(0, 2, (2, n))
    run = Conditions(configuration, voltage, np.degrees(slope), payload, battery, charge, adhesion)
    moving = jax.jit(jax.vmap(moving_signals, in_axes=(None, 0, 0)))
    state = State(*map(jnp.asarray, (current, motor, speed, charge)), memory, distance=jnp.zeros(n))
    turn = rng.uniform(-4, 4, n)
    way = np.sign(turn)
    lateral = -way * rng.uniform(0, 5, n)  # against the turn
    pause, side, command = rng.uniform(0, 1, n), rng.choice((-1.0, 1.0), n), default_rng(13).uniform(-1, 1, n)
    return dataclasses.replace(
        moving(NOMINAL, run, state), pause=pause, command=command, side=side, yaw_rate=turn, direction_turn=way,
        moment_lateral=lateral,
    )  # fmt: skip


STATES = random_states()


def size(effect):
    return amplitude_of(effect()).spec.prior_sd(0.0)


def fitted(effect, amplitude):
    return params.replace(effect(), {"amplitude": jnp.asarray(amplitude)})


def with_effects(*present, robot=None):
    return dataclasses.replace(robot or NOMINAL, effects=present)


def terms(effect, robot=None, signals=STATES):
    """What it adds to its balance in each of the states."""
    robot = with_effects(effect, robot=robot)
    added = jax.vmap(lambda s: effects_sum(robot, s, effect.balance, effect.channel) + 0.0 * s.current)
    return np.asarray(added(signals))


def readings(robot, signals):
    """What the instruments show, channels last, in their order."""
    shown = sensor(robot, signals)
    return jnp.stack([shown[name] for name in channels.USUAL], -1)


def floats(tree):
    return jnp.stack([x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)])


def outputs_steady(robot):
    """Numbers of `steady`."""
    return jax.vmap(lambda c: floats(steady(robot, c)))(CONDITIONS)


def outputs_start(robot):
    """Readings through a start: for what settled travel does not show."""
    times = jnp.asarray([0.0, 0.002, 0.01, 0.1, 0.4])
    signals = jax.vmap(lambda c: drive(robot, c, times).signals)(CONDITIONS)
    return readings(robot, signals)[:, 1:].reshape(-1, len(channels.usual_channels()))


@functools.cache
def compiled(outputs, those):
    """Outputs, and their derivatives with them, as functions of the amplitudes of effects."""

    def numbers(amplitudes):
        there = tuple(fitted(e, a) for e, a in zip(those, amplitudes, strict=True))
        return outputs(with_effects(*there))

    def twice(amplitudes):
        return (numbers(amplitudes),) * 2

    return jax.jit(numbers), jax.jit(jax.jacfwd(twice, has_aux=True))


@functools.cache
def at_zero(outputs, those):
    """Outputs and their slopes where all amplitudes are zero."""
    slopes, values = compiled(outputs, those)[1](jnp.zeros(len(those)))
    return np.asarray(values), np.asarray(slopes)


TRANSIENT = tuple(effect for effect in ALL if effect.transient)


# --- the laws: each takes an effect class and raises AssertionError ------------------------------------


def law_declared(effect):
    """It states its equation's source, its balance, its amplitude, and for a sensor its channel."""
    assert "Source:" in (effect.__doc__ or ""), "docstring states no source"
    assert effect.name.isidentifier() and effect.name == effect.name.lower()
    assert effect.movers in ("", "tracks", "wheels")
    assert not effect.settles_to or (effect.settles_to in BY_NAME and effect.settles_to != effect.name)
    assert effect.balance in BALANCES
    assert bool(effect.channel) == (effect.balance == "sensor")
    assert not effect.channel or effect.channel in channels.channel_names(channels.EVERY)
    declared = {p.name: p for p in params.walk_parameters(effect())}
    assert [n for n, p in declared.items() if p.spec.amplitude] == ["amplitude"]
    amplitude = declared["amplitude"]
    assert float(amplitude.value) == 0.0
    assert amplitude.spec.bounds[0] <= 0.0 < amplitude.spec.bounds[1]
    for p in declared.values():
        dimensions(p.spec.unit)


#: What an effect's term may change with → the signals that make it.
DRIVERS = {
    "current": ("current", "total_current"),
    "speed": ("speed_motor", "speed_wheel", "speed_theoretical", "speed", "yaw_rate"),
    "load": (
        "current", "payload", "mass", "normal", "demand", "traction", "torque_load", "torque_track_loss",
        "torque_carried", "torque_electromagnetic",
    ),
    "demand": ("demand", "traction", "resistance"),
    "weight": ("normal", "mass"),
    "slope": ("slope",),
    "duty": ("pause", "command"),
    "configuration": ("configuration", "on_tracks"),
    "direction": ("direction",),
    "the side": ("side",),
    "angle": (),
    "position": (),
}  # fmt: skip
#: Of what a term without a driver is the same share everywhere, by its balance or channel; 1: the same everywhere.
SHARED = {
    "mass": ("mass",),
    "slip": ("speed_theoretical",),
    "total_current": ("total_current",),
    "motor_speed": ("speed_motor",),
    "speed": ("speed",),
}


def law_family(effect):
    """Its family is its equation and its driver. Its term changes with that driver, or is a share without one."""
    assert effect.family().startswith(base.EQUATION[effect.balance]) and effect.driver in ("", *DRIVERS)
    assert (effect.driver or "same share everywhere") in effect.family()
    assert all(name in {p.name for p in params.walk_parameters(NOMINAL)} for name in effect.rests_on)
    made = fitted(effect, size(effect))
    before = terms(made)
    if not effect.driver:
        of = [np.ones_like(before), *(getattr(STATES, n) for n in SHARED.get(effect.channel or effect.balance, ()))]
        of += [c.read(NOMINAL, STATES) for c in channels.EVERY if c.name == effect.channel]
        shares = [before / np.asarray(x) for x in of]
        assert any(np.ptp(x) < 1e-9 * np.abs(x).max() for x in shares), "varies, and says not with what"
        return
    if effect.driver == "angle" or effect.memory_size is not None:
        assert (effect.driver == "angle") == issubclass(effect, Periodic)
        return
    halved = {n: 0.5 * getattr(STATES, n) for n in DRIVERS[effect.driver]}
    turned = {n: 1 - getattr(STATES, n) for n in ("configuration", "on_tracks")}
    moved = turned if effect.driver == "configuration" else halved
    after = terms(made, signals=dataclasses.replace(STATES, **moved))
    assert np.abs(after - before).max() > 1e-3 * np.abs(before).max(), f"does not change with {effect.driver}"


def law_absent_at_zero(effect):
    """Zero amplitude changes no number of the steady state, to the last bits."""
    bare = compiled(outputs_steady, ())[0](jnp.zeros(0))
    assert_allclose(at_zero(outputs_steady, ALL)[0], bare, rtol=1e-13, atol=1e-13)
    assert (terms(effect()) == 0).all()


def law_linear(effect):
    """The term is the amplitude times something that does not know the amplitude."""
    one = terms(fitted(effect, size(effect)))
    assert np.abs(one).max() > 0, "no term at all"
    for amplitude in (*AMPLITUDES, -0.5):
        many = terms(fitted(effect, amplitude * size(effect)))
        assert_allclose(many, amplitude * one, rtol=1e-12, atol=1e-12 * np.abs(one).max())


def law_unit(effect):
    """Under other units of mass, length, time and current the term turns as the unit of its balance."""
    rng = default_rng(7)
    start = fitted(effect, 0.8 * size(effect))
    before = terms(start)
    for _ in range(3):
        change = dict(zip(BASE, np.exp(rng.uniform(-1.5, 1.5, len(BASE))), strict=True))

        def rescaled(component, change=change):
            values = {p.name: p.value * factor(p.spec.unit, change) for p in params.walk_parameters(component)}
            return params.replace(component, values)

        signals = dataclasses.replace(
            STATES, **{name: getattr(STATES, name) * factor(unit, change) for name, unit in UNIT_OF.items()}
        )
        kept = {n: v * factor(BY_NAME[n].memory_unit, change) for n, v in STATES.memory.items()}
        signals = dataclasses.replace(signals, memory=kept)
        after = terms(rescaled(start), rescaled(NOMINAL), signals)
        expected = before * factor(balance_unit(effect), change)
        assert_allclose(after, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def law_dissipative(effect):
    """At positive amplitude a dissipative term takes power from every state, or none."""
    if not effect.dissipative:
        return
    assert effect.balance in CONJUGATE, "a mass or a reading dissipates nothing"
    for amplitude in AMPLITUDES:
        power = terms(fitted(effect, amplitude * size(effect))) * getattr(STATES, CONJUGATE[effect.balance])
        assert power.min() >= 0, f"adds power in {(power < 0).mean():.0%} of states"


#: Instants at which a term may read: settled travel (None where it has none), motion, and standstill.
INSTANTS = {
    "settled": (2.0, 700.0, 0.5, 100.0), "climbing": (2.0, 700.0, 0.5, 100.0),
    "backwards": (-3.0, -500.0, -0.45, 100.0), "standstill": (0.0, 0.0, 0.0, 0.0),
}  # fmt: skip


@functools.cache
def known(balance, channel, instant):
    """What a term in this balance may read."""
    run, state = jax.tree.map(lambda x: x[2], CONDITIONS), State(*map(jnp.asarray, INSTANTS[instant]))
    return readable_signals(NOMINAL, run, state, balance, channel, settled=instant == "settled")


def law_readable(effect):
    """Term and derivatives are finite on the signals that are computed before its balance, at rest too."""
    robot = with_effects(fitted(effect, size(effect)))
    for instant in INSTANTS:
        signals = known(effect.balance, effect.channel, instant)
        if effect.memory_size is not None and instant != "settled":
            signals = dataclasses.replace(signals, memory={effect.name: jnp.asarray(0.3 * effect.memory_size)})
        term, slopes = eqx.filter_value_and_grad(
            lambda both, effect=effect: jnp.sum(effects_sum(*both, effect.balance, effect.channel))
        )((robot, signals))
        assert np.isfinite(term), f"no number: {instant}"
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(slopes)), f"no derivative: {instant}"


#: Signals that are the same in a run in mirror image (the robot turned about on the same slope).
EVEN = (
    *("configuration", "on_tracks", "payload", "adhesion", "battery", "discharge", "memory", "mass", "normal"),
    *("inductance", "inertia_added", "adhesion_limit", "efficiency_load", "temperature", "command", "duty", "pause"),
)


def mirrored(signals):
    """Signals of a run in mirror image. What is not followed stays so."""
    odd = (f.name for f in dataclasses.fields(Signals) if f.name not in EVEN)
    return dataclasses.replace(signals, **{n: -getattr(signals, n) for n in odd if getattr(signals, n) is not None})


def law_travel(effect):
    """In a run in mirror image a term is the mirror image, and in that of one `odd_in_travel` what it was."""
    if effect.balance not in CONJUGATE or issubclass(effect, Periodic):
        return  # masses and readings have no direction; a phase has its own
    start = fitted(effect, size(effect))
    there = dataclasses.replace(STATES, memory={})
    sign = 1 if effect.odd_in_travel else -1
    turned = terms(start, signals=mirrored(there))
    assert_allclose(turned, sign * terms(start, signals=there), rtol=1e-12, atol=1e-15)


LAWS = (
    *(law_declared, law_family, law_absent_at_zero, law_linear, law_unit, law_dissipative),
    *(law_readable, law_travel),
)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__[4:])
@pytest.mark.parametrize("effect", ALL, ids=lambda effect: effect.name)
def test_effect_obeys(effect, law):
    law(effect)


#: Channels of what the random states have.
SHOWN_BY_STATES = ("motor_current", "output_torque", "motor_voltage", "yaw_rate")


@pytest.mark.parametrize("law", (law_declared, law_family, law_linear, law_unit), ids=lambda law: law.__name__[4:])
@pytest.mark.parametrize(
    "effect",
    [*effects.OF_TURNS.values(), *(effects.OF_CHANNELS[f"{n}_{x}"] for n in SHOWN_BY_STATES for x in ("gain", "offset"))],
    ids=lambda effect: effect.name,
)  # fmt: skip
def test_effect_of_turns_and_of_channels_obeys(effect, law):
    law(effect)


#: Instruments that count or time, from a start that is 0, have no error of their zero.
COUNTED = re.compile(r"(motor|output|lateral)?_?speed(_left|_right)?|output_angle|position|yaw|place_[xy]")


def test_every_channel_has_an_error_of_its_scale_and_of_a_zero_that_it_may_miss():
    errors = [e for e in (*effects.OF_CHANNELS.values(), *effects.ALL) if e.channel]
    of_zero, of_scale = ({e.channel for e in errors if e.of_zero == zero} for zero in (True, False))
    assert of_scale == {c.name for c in channels.EVERY} - {"winding_temperature"}
    assert of_zero == {c.name for c in channels.EVERY if not COUNTED.fullmatch(c.name)}
    assert len(errors) == len(of_zero) + len(of_scale) and not set(effects.OF_CHANNELS) & set(BY_NAME)
    # Random numbers go by position: the errors of zeros stand behind those that were before.
    behind = [e.of_zero for e in effects.OF_CHANNELS.values() if e.channel != "winding_temperature"]
    assert behind == sorted(behind)
    signals = Signals(
        **{f.name: 0.5 for f in dataclasses.fields(Signals) if f.name not in ("memory", "configuration")}
    )
    for effect in effects.OF_CHANNELS.values():
        law_declared(effect)
        shown = float(channels.find_channel(effect.channel).read(NOMINAL, signals))
        error = float(effect(amplitude=0.02).term(NOMINAL, signals))
        assert shown and error == pytest.approx(0.02 if effect.of_zero else 0.02 * shown)


#: Readings of a motor current of 2 A both ways and at rest, of a meter 5 % and 0.18 A too high.
WITH_A_SIGN, MAGNITUDE = (2.28, -1.92, 0.18), (2.28, 2.28, 0.18)


def metered(signed, gain=0.05, offset=0.18):
    off = {"motor_current_gain": gain, "motor_current_offset": offset}
    rig = dataclasses.replace(NOMINAL.rig, instruments=(Instrument("motor_current", signed=signed),))
    return dataclasses.replace(with_effects(*(effects.OF_CHANNELS[n](amplitude=a) for n, a in off.items())), rig=rig)


@pytest.mark.parametrize("signed, expected", [(True, WITH_A_SIGN), (False, MAGNITUDE)])
def test_an_instruments_errors_are_added_to_what_it_shows(signed, expected):
    """So that what an effect changes of a reading is its term, to which the loop's scores hold."""
    robot, without = metered(signed), metered(signed, 0.0, 0.0)
    for current, shown in zip((2.0, -2.0, 0.0), expected, strict=True):
        signals = jax.tree.map(lambda x: x[0], dataclasses.replace(STATES, current=jnp.full(400, current)))
        read, ideal = (float(sensor(r, signals)["motor_current"]) for r in (robot, without))
        assert read == pytest.approx(shown, rel=1e-12)
        assert read - ideal == pytest.approx(float(effects_sum(robot, signals, "sensor", "motor_current")))


@pytest.mark.quick(1)
@pytest.mark.parametrize("signed", [True, False])
def test_a_run_backward_is_read_as_one_forward_of_the_robot_turned_about(signed):
    """A zero error keeps its sign in space. One of an instrument that shows magnitudes is the same both ways."""
    volts, slope = np.array([12.0, 24.0]), np.array([3.0, 8.0])
    back = steady_batch(metered(signed), Conditions(voltage=-volts, slope_deg=-slope))
    ahead = steady_batch(menu.facing_backward(metered(signed)), Conditions(voltage=volts, slope_deg=slope))
    read, as_forward = (np.asarray(r.reading["motor_current"]) for r in (back, ahead))
    assert (read * (-1 if signed else 1) > 0).all()
    assert_allclose(as_forward, np.abs(read), rtol=1e-9)


@pytest.mark.parametrize(
    "effect",
    # The derivative of a start is a program of its own; that such effects are felt, see below.
    [pytest.param(e, marks=pytest.mark.slow) if e.transient else e for e in ALL],
    ids=[e.name for e in ALL],
)
def test_effect_is_alive_at_zero(effect):
    """The derivative at zero is finite everywhere and not zero where the effect acts."""
    there = TRANSIENT if effect.transient else ALL
    values, slopes = at_zero(outputs_start if effect.transient else outputs_steady, there)
    slopes = slopes[..., there.index(effect)]
    assert np.isfinite(values).all() and np.isfinite(slopes).all()
    count = len(channels.EVERY)  # the readings
    moved = np.abs(slopes[:, :count]) * size(effect) / np.maximum(np.abs(values[:, :count]), 1e-9)
    assert moved.max() > 1e-6, "dead gradient"


# --- the library is complete ----------------------------------------------------------------------------

#: Positions in tables of scores and in the random numbers of a bootstrap.
ORDER = """
mass_error mass_offset rotating_inertia supply_sag battery_sag series_resistance brush_drop winding_heating
thermal_drift coast_decay armature_inductance windage stribeck_motor iron_loss torque_constant_saturation cogging gear_load_loss
gear_quadratic_loss stribeck_gear backdriving_loss bristle_load_loss bristle_backdriving_loss churning stribeck_track tension_friction centrifugal_tension
bending_loss stick_slip directional_friction stribeck_exponent directional_viscous torque_offset presliding
angle_friction position_friction directional_stribeck speed_rolling adhesive_drag weight_transfer sinkage slope_bias grouser_polygon rolling_radius belt_creep nonlinear_slip speed_slip load_slip pulley_eccentricity
vibration_slip ammeter_gain ammeter_offset encoder_scale speed_gain duty_exponent duty_dead_band duty_saturation
""".split()  # noqa: SIM905


def test_library_keeps_its_order():
    assert [effect.name for effect in ALL] == ORDER == list(BY_NAME)


def test_every_effect_is_pickled_as_stages_of_the_loop_are():
    """Those too whose classes are made by functions: of channels' instruments, curves and waves."""
    for effect in (BY_NAME | effects.BESIDE).values():
        assert pickle.loads(pickle.dumps(effect)) is effect
        for kind in (effect, scaled_effect(effect, (2.0, 1.0, 2.0))):
            assert type(pickle.loads(pickle.dumps(kind()))) is kind


def test_units_of_signals_are_all_known():
    fields = {f.name for f in dataclasses.fields(Signals)}
    # Each memory states its own unit, an index has none, and where effects are tried no temperature is followed and no
    # brake takes a torque.
    assert {*UNIT_OF, "memory", "configuration", "temperature", "load_torque"} == fields


def test_units_of_parameters_and_balances_are_all_known(free):
    for p in free:
        dimensions(p.spec.unit)
    for unit, _ in BALANCES.values():
        dimensions(unit)


# --- both fidelities feel every effect ------------------------------------------------------------------


@pytest.mark.slow
def test_drive_feels_every_effect():
    """That `steady` feels those that settled travel shows is a law above."""
    values, slopes = at_zero(outputs_start, ALL)
    sizes = np.array([size(effect) for effect in ALL])
    moved = np.abs(slopes * sizes / np.maximum(np.abs(values), 1e-9)[..., None]).max((0, 1))
    least = np.where([effect.transient for effect in ALL], 1e-6, 1e-4)
    assert np.isfinite(slopes).all() and [e.name for e, x in zip(ALL, moved < least, strict=True) if x] == []


# --- what single effects amount to ----------------------------------------------------------------------


@pytest.mark.parametrize("name", [
    "backdriving_loss", "directional_friction", "directional_stribeck", "presliding", "bristle_load_loss",
    "bristle_backdriving_loss", "angle_friction", "position_friction",
])  # fmt: skip
def test_term_at_random_states_is_the_law_of_the_worlds(name):
    """In both directions, at memories of both signs, and near rest."""
    law, kind, shapes = (laws.TRANSIENT | laws.RIGS)[name], BY_NAME[name], {"speed_fade": 5.0, "phase": 0.5}
    effect = kind(amplitude=0.2, **{n: x for n, x in shapes.items() if hasattr(kind, n)})
    memory = STATES.side * STATES.memory.get(name, 0.0)
    seen = SimpleNamespace(b=memory, turn=memory, B=STATES.torque_carried, d=STATES.direction, w_k=STATES.speed_wheel)
    computed = terms(effect, signals=dataclasses.replace(STATES, memory={name: memory}))
    assert_allclose(computed, 0.2 * law.of(seen, {"fade": 5.0, "phase": 0.5}), rtol=1e-12, atol=1e-15)


def test_bristles_bend_as_dahls_and_angles_are_integrals_of_speed():
    """θ_s z' = ω_k - |ω_k| z (Dahl 1968). A settled bristle of `presliding` changes nothing."""
    speed, way = STATES.speed_wheel, STATES.direction
    bristles = ("presliding", "bristle_load_loss", "bristle_backdriving_loss")
    rates = {name: speed * (1 - way * STATES.memory[name]) / 0.02 for name in bristles}
    rates |= {"position_friction": speed, "angle_friction": STATES.speed_motor / NOMINAL.gearbox.ratio}
    for name, rate in rates.items():
        assert_allclose(jax.vmap(BY_NAME[name]().rate, (None, 0))(NOMINAL, STATES), rate, rtol=1e-12)
    settled = fitted(BY_NAME["presliding"], 0.3)
    assert (terms(settled, signals=dataclasses.replace(STATES, memory={})) == 0).all()


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5, 4.0])
def test_stribeck_exponent_has_finite_derivatives_through_rest(exponent):
    def term(speed, fade, power):
        effect = params.replace(
            BY_NAME["stribeck_exponent"](), {"speed_fade": fade, "exponent": power, "amplitude": 1.0}
        )
        return effect.term(NOMINAL, Signals(speed_wheel=speed, direction=jnp.asarray(1.0)))

    slopes = jax.vmap(jax.grad(term, (0, 1, 2)), (0, None, None))
    speeds = jnp.asarray([-1e-3, -1e-12, 0.0, 1e-12, 1e-3, 1.0, 30.0])
    assert np.abs(np.stack(slopes(speeds, 8.0, exponent))).max() < 20


def test_friction_by_the_position_begins_where_a_history_does():
    names, angles = ("position_friction", "angle_friction", "presliding"), (1.5, -2.0)
    robot = blank_robot(Configurations({"bench": Shaft(inertia=1e-3, loss_coulomb=0.05, loss_viscous=1e-3)}))
    begins = RunStarts({f"begin_{k}": RunStart(angle=angle) for k, angle in enumerate(angles)})
    rig = dataclasses.replace(robot.rig, begins=begins, start="measured")
    robot = dataclasses.replace(with_effects(*(BY_NAME[n]() for n in names), robot=robot), rig=rig)
    for begin, angle in enumerate(angles):
        run = jax.tree.map(lambda x: x[0], Conditions([0], voltage=[0.0], begin=[begin]))
        memory = state_of_unknowns(robot, drive_start(robot, run)).memory
        assert [float(memory[n]) for n in names] == [angle, angle, 0.0]


# --- what effects declare, so that nobody needs their names ---------------------------------------------


def test_library_declares_what_the_loop_asks_for():
    both_ways = ["directional_friction", "directional_viscous", "torque_offset", "directional_stribeck"]
    for field, names in {
        "needs_battery": ["battery_sag"], "needs_reverse": both_ways, "odd_in_travel": [*both_ways, "slope_bias"],
        "needs_duty": ["coast_decay", "duty_exponent", "duty_dead_band", "duty_saturation"],
    }.items():  # fmt: skip
        assert [e.name for e in ALL if getattr(e, field)] == names
    assert {e.name: e.settles_to for e in ALL if e.settles_to} == {
        "thermal_drift": "winding_heating", "torque_offset": "directional_friction",
        "bristle_load_loss": "gear_load_loss", "bristle_backdriving_loss": "backdriving_loss",
    }  # fmt: skip
    # An effect of a balance without a probe would have a score of 0 in every table.
    assert {e.balance for e in ALL if SettledRuns.shows(e)} <= {*PROBED, "sensor"}
    assert {e.name: e.movers for e in ALL if e.movers} == {
        "mass_offset": "wheels", "grouser_polygon": "tracks", "vibration_slip": "tracks",
    }  # fmt: skip


def test_effect_that_needs_the_battery_shows_on_it_alone():
    _, slopes = at_zero(outputs_steady, ALL)
    moved = np.abs(slopes[..., [e.needs_battery for e in ALL]]).max((1, 2))
    on_battery = np.asarray(CONDITIONS.battery) > 0.5
    assert (moved[~on_battery] == 0).all() and (moved[on_battery] > 0).all()


def test_settled_travel_cannot_tell_an_effect_from_the_one_it_settles_to():
    _, slopes = at_zero(outputs_steady, ALL)
    for k, effect in enumerate(ALL):
        if effect.settles_to:
            one, other = (slopes[..., i].ravel() for i in (k, ORDER.index(effect.settles_to)))
            assert abs(one @ other) / np.linalg.norm(one) / np.linalg.norm(other) > 1 - 1e-9


@pytest.mark.parametrize(
    "name, configurations, acts",
    [
        ("churning", (), (1, 1)),
        ("churning", ("4W2T",), (0, 1)),
        ("churning", ("4W2T", "6T2A", "4W2T"), (1, 1)),
        ("mass_offset", (), (0, 1)),
        ("mass_offset", ("6T2A",), (1, 0)),
        ("mass_offset", ("6T2A", "4W2T"), (1, 1)),
        ("grouser_polygon", (), (1, 0)),
        ("bending_loss", (), (1, 1)),  # a loss of the belt, which the pulley drives in both
        ("centrifugal_tension", (), (1, 1)),
        ("churning", ("8W",), (0, 0)),  # of another robot
    ],
)
def test_effect_acts_on_the_configurations_that_it_names(name, configurations, acts):
    effect = dataclasses.replace(fitted(BY_NAME[name], size(BY_NAME[name])), configurations=configurations)
    moved = np.abs(terms(effect)) > 0
    assert [moved[np.asarray(STATES.configuration) == k].any() for k in (0, 1)] == [bool(a) for a in acts]


# --- derivatives by everything, with all effects at once ------------------------------------------------

#: A run that travels, one whose motors cannot turn the shafts, and one that is at rest.
RUNS = Conditions(
    configuration=["6T2A", "4W2T", "6T2A"],
    voltage=[24.0, 0.3, 0.0],
    slope_deg=[3.0, 5.0, 0.0],
    payload=[2.0, 0.0, 0.0],
    battery=[1.0, 0.0, 0.0],
).resolved(NOMINAL)
EVERY = {p.name: p.value for p in params.walk_parameters(with_effects(*(fitted(e, 0.02 * size(e)) for e in ALL)))}
THETA = jnp.stack([jnp.asarray(x) for x in EVERY.values()])


def _robot(theta):
    return params.replace(with_effects(*(e() for e in ALL)), dict(zip(EVERY, theta, strict=True)))


@pytest.mark.slow
def test_steady_with_all_effects_has_finite_derivatives_by_every_parameter():
    def numbers(theta, run):
        result = steady(_robot(theta), run)
        return floats(result), result.status

    slopes, status = jax.jit(jax.vmap(jax.jacrev(numbers, has_aux=True), in_axes=(None, 0)))(THETA, RUNS)
    assert list(status) == [CONVERGED, STALLED, STALLED]
    assert np.isfinite(slopes).all() and np.abs(slopes[0]).max() > 0


def _slopes(outputs):
    """Derivatives of outputs(robot, run) by every parameter, forward, in each of the runs."""
    jacobian = jax.jacfwd(lambda theta, run: outputs(_robot(theta), run))
    return jax.jit(jax.vmap(jacobian, in_axes=(None, 0)))(THETA, RUNS)


@pytest.mark.quick(1)
@pytest.mark.parametrize("share", [0.0, 1.0], ids=["standstill", "moving"])
def test_rates_with_all_effects_have_finite_derivatives_by_every_parameter(share):
    """What `drive` integrates, at standstill and on the way."""
    # Current, motor speed, speed, distance and discharge in the units of `drive`, then memories in theirs.
    unknowns = share * jnp.asarray([0.2, 0.7, 0.5, 1.0, 10.0, *[0.3 for e in ALL if e.memory_size is not None]])
    slopes = _slopes(lambda robot, run: drive_rates(robot, run, unknowns))
    assert np.isfinite(slopes).all() and np.abs(slopes[0]).max() > 0


@pytest.mark.slow
def test_instant_of_half_robot_with_all_effects_has_finite_derivatives_by_every_parameter():
    """What `track` integrates, at standstill."""

    def outputs(robot, run):
        system = half_robot.build_system(robot, run, 1e-4)
        signals, _, pulled = half_robot.instant(system, half_robot.stand(system))
        leaves = [jnp.asarray(x) for x in jax.tree.leaves((signals, pulled))]
        return jnp.concatenate([x.ravel() for x in leaves if x.dtype == THETA.dtype])

    slopes = _slopes(outputs)
    assert np.isfinite(slopes).all() and np.abs(slopes[0]).max() > 0


def _travel(voltage, slope_deg=0.0, changes=None, gearbox=None, **amplitudes):
    """Steady travel of both configurations under each voltage and slope, effects by their amplitudes."""
    robot = params.replace(NOMINAL, changes or {})
    robot = dataclasses.replace(robot, gearbox=dataclasses.replace(robot.gearbox, **(gearbox or {})))
    present = tuple(fitted(BY_NAME[name], value) for name, value in amplitudes.items())
    voltage, slope, configuration = (x.ravel() for x in np.meshgrid(voltage, slope_deg, [0, 1], indexing="ij"))
    runs = Conditions(configuration, voltage, slope)
    return runs, steady_batch(with_effects(*present, robot=robot), runs)


@pytest.mark.slow
def test_backdriving_loss_can_be_the_theory_of_the_mesh():
    down = dict(voltage=[24.0], slope_deg=[-20.0, -10.0], changes={"4W2T.ground.friction.static": 0.9})
    _, stated = _travel(**down, backdriving_loss=1 - (2 - 1 / 0.74) / 0.74)
    _, theory = _travel(**down, gearbox={"mesh_theory": True})
    for name in ("total_current", "motor_speed", "speed"):  # on wheels
        assert_allclose(getattr(stated, name)[1::2], getattr(theory, name)[1::2], rtol=1e-9)
    _, without = _travel(**down)
    assert (np.asarray(without.total_current) < np.asarray(stated.total_current) - 1e-3)[1::2].all()
