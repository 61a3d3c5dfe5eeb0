"""The laws that every effect of the library obeys, and mutants that each law must reject."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import pkgutil
import re
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mmrjax import balances, effects, nominal, params
from mmrjax.conditions import Conditions
from mmrjax.effects import ALL, BY_NAME, Effect
from mmrjax.fidelities.drive import drive
from mmrjax.fidelities.steady import steady, steady_batch
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals, State

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
    "V": "voltage voltage_back voltage_drop voltage_left",
    "C": "discharge",
    "kg": "mass payload",
    "N": "normal resistance gravity demand traction adhesion_limit",
    "m/s": "speed speed_theoretical speed_slip_terms speed_sliding",
    "m/s^2": "acceleration",
    "1/s": "speed_motor speed_wheel",
    "1/s^2": "acceleration_wheel",
    "N·m": "torque_electromagnetic torque_motor_loss torque_motor torque_track_loss torque_load torque_idle "
    "torque_input torque_gear torque_net",
    "H": "inductance",
    "kg·m^2": "inertia_added",
    "-": "wheeled battery slope adhesion direction direction_travel efficiency_load",
}
UNIT_OF = {name: unit for unit, fields in SIGNAL_UNITS.items() for name in fields.split()}
SENSOR_UNITS = {"total_current": "A", "motor_speed": "1/s", "speed": "m/s"}


def dimensions(unit: str) -> Counter:
    """Exponents of the base units of a product such as `N·m·s^2` or `V/C^2`."""
    total: Counter = Counter()
    for sign, symbol, power in re.findall(r"([·/]?)([^·/^]+)(?:\^(\d+))?", unit):
        exponent = int(power or 1) * (-1 if sign == "/" else 1)
        if symbol in BASE:
            total[symbol] += exponent
        elif symbol in DERIVED:
            for base, count in dimensions(DERIVED[symbol]).items():
                total[base] += exponent * count
        elif symbol not in NEUTRAL and symbol != "1":
            raise ValueError(f"unknown unit {symbol!r} in {unit!r}")
    return total


def factor(unit: str, change: dict[str, float]) -> float:
    """What a number in `unit` is multiplied by when each base unit's numbers are."""
    return float(np.prod([change[base] ** count for base, count in dimensions(unit).items()]))


def balance_unit(effect: type[Effect]) -> str:
    return SENSOR_UNITS[effect.channel] if effect.balance == "sensor" else balances.BALANCES[effect.balance][0]


# --- what the laws are tried on -----------------------------------------------------------------------

AMPLITUDES = (0.37, 1.9)  # of the prior's standard deviation
#: Speed or current that a balance's term multiplies to a power.
CONJUGATE = {
    "supply": "total_current",
    "electrical": "current",
    "motor": "speed_motor",
    "gearbox": "speed_wheel",
    "track": "speed_wheel",
    "ground": "speed",
    "slip": "traction",
}
CONDITIONS = Conditions(
    voltage=[33.0, 15.0, 24.0, 24.0, 24.0],
    slope_deg=np.degrees([0.09, 0.0, 0.05, -0.1, 0.12]),
    payload=[8.0, 0.0, 3.0, 0.0, 5.0],
    configuration=[0.0, 1.0, 0.0, 1.0, 1.0],
    battery=[0.0, 0.0, 1.0, 0.0, 1.0],
    discharge=[0.0, 0.0, 3000.0, 0.0, 100.0],
)


def random_states(n=400):
    """Signals of the nominal robot at random states: either direction, either configuration, spinning."""
    rng = np.random.default_rng(12)
    low, high = (-20, -1200, -1.2, 0, 15, -0.3, 0, 0.5), (20, 1200, 1.2, 7000, 33, 0.3, 8, 2)
    current, motor, speed, charge, voltage, slope, payload, adhesion = rng.uniform(low, high, (n, 8)).T
    memory = {e.name: jnp.asarray(e.memory_size * rng.uniform(0, 1, n)) for e in ALL if e.memory_size is not None}
    motor[:40] *= 1e-4  # through rest
    run = Conditions(voltage, slope, payload, rng.integers(0, 2, n), rng.integers(0, 2, n), charge, adhesion)
    moving = jax.jit(jax.vmap(balances.moving, in_axes=(None, 0, 0)))
    return moving(nominal.nominal(), run, State(*map(jnp.asarray, (current, motor, speed, charge)), memory))


STATES = random_states()


def size(effect: type[Effect]) -> float:
    spec = next(p for p in params.walk(effect()) if p.name == "amplitude").spec
    return spec.prior_sd(0.0)


def fitted(effect: type[Effect], amplitude: float) -> Effect:
    return params.replace(effect(), {"amplitude": jnp.asarray(amplitude)})


def terms(effect: Effect, robot=None, signals: Signals = STATES) -> np.ndarray:
    robot = robot or nominal.nominal()
    shape = np.shape(signals.current)
    return np.broadcast_to(jax.vmap(lambda s: effect.term(robot, s) + 0.0 * s.current)(signals), shape)


def floats(tree) -> jax.Array:
    return jnp.stack([x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)])


def outputs_steady(robot):
    """Numbers of `steady`."""
    return jax.vmap(lambda c: floats(steady(robot, c)))(CONDITIONS)


def outputs_start(robot):
    """Readings through a start: for what settled travel does not show."""
    times = jnp.asarray([0.0, 0.002, 0.01, 0.1, 0.4])
    signals = jax.vmap(lambda c: drive(robot, c, times).signals)(CONDITIONS)
    readings = jnp.stack(jax.tree.leaves(balances.sensor(robot, signals)), -1)[:, 1:]
    return readings.reshape(-1, 3)


@functools.cache
def compiled(outputs, those: tuple[type[Effect], ...]):
    """Outputs, and their derivatives, as functions of the amplitudes of effects."""

    def numbers(amplitudes):
        there = tuple(fitted(e, a) for e, a in zip(those, amplitudes, strict=True))
        return outputs(dataclasses.replace(nominal.nominal(), effects=there))

    return jax.jit(numbers), jax.jit(jax.jacfwd(numbers))


@functools.cache
def at_zero(outputs, those: tuple[type[Effect], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Outputs and their slopes where all amplitudes are zero."""
    return tuple(np.asarray(f(jnp.zeros(len(those)))) for f in compiled(outputs, those))


def company(effect: type[Effect]) -> tuple[type[Effect], ...]:
    """Effects with which one is compiled: the whole library at once; a mutant by itself."""
    return ALL if effect in ALL else (effect,)


# --- the laws: each takes an effect class and raises AssertionError ------------------------------------


def law_declared(effect: type[Effect]) -> None:
    """It states its equation's source, its balance, its amplitude, and for a sensor its channel."""
    assert "Source:" in (effect.__doc__ or ""), "docstring states no source"
    assert effect.balance in balances.BALANCES
    assert bool(effect.channel) == (effect.balance == "sensor")
    assert not effect.channel or effect.channel in {f.name for f in dataclasses.fields(Reading)}
    declared = {p.name: p for p in params.walk(effect())}
    assert [n for n, p in declared.items() if p.spec.amplitude] == ["amplitude"]
    amplitude = declared["amplitude"]
    assert float(amplitude.value) == 0.0
    assert amplitude.spec.bounds[0] <= 0.0 < amplitude.spec.bounds[1]
    for p in declared.values():
        dimensions(p.spec.unit)


def law_absent_at_zero(effect: type[Effect]) -> None:
    """Zero amplitude changes no number of the steady state, to the last bits."""
    bare = compiled(outputs_steady, ())[0](jnp.zeros(0))
    np.testing.assert_allclose(at_zero(outputs_steady, company(effect))[0], bare, rtol=1e-13, atol=1e-13)
    assert (terms(effect()) == 0).all()


def law_alive_at_zero(effect: type[Effect]) -> None:
    """The derivative at zero is finite everywhere and not zero where the effect acts."""
    there = company(effect)
    values, slopes = at_zero(outputs_start if effect.transient else outputs_steady, there)
    slopes = slopes[..., there.index(effect)]
    assert np.isfinite(values).all() and np.isfinite(slopes).all()
    moved = np.abs(slopes[:, :3]) * size(effect) / np.abs(values[:, :3])  # the readings
    assert moved.max() > 1e-6, "dead gradient"


def law_linear(effect: type[Effect]) -> None:
    """The term is the amplitude times something that does not know the amplitude."""
    one = terms(fitted(effect, size(effect)))
    assert np.abs(one).max() > 0, "no term at all"
    for amplitude in (*AMPLITUDES, -0.5):
        many = terms(fitted(effect, amplitude * size(effect)))
        np.testing.assert_allclose(many, amplitude * one, rtol=1e-12, atol=1e-12 * np.abs(one).max())


def law_unit(effect: type[Effect]) -> None:
    """Under other units of mass, length, time and current the term turns as the unit of its balance."""
    rng = np.random.default_rng(7)
    start = fitted(effect, 0.8 * size(effect))
    before = terms(start)
    for _ in range(3):
        change = dict(zip(BASE, np.exp(rng.uniform(-1.5, 1.5, len(BASE))), strict=True))

        def rescaled(component, change=change):
            values = {p.name: p.value * factor(p.spec.unit, change) for p in params.walk(component)}
            return params.replace(component, values)

        signals = dataclasses.replace(
            STATES, **{name: getattr(STATES, name) * factor(unit, change) for name, unit in UNIT_OF.items()}
        )
        kept = {n: v * factor(BY_NAME[n].memory_unit, change) for n, v in STATES.memory.items()}
        signals = dataclasses.replace(signals, memory=kept)
        after = terms(rescaled(start), rescaled(nominal.nominal()), signals)
        expected = before * factor(balance_unit(effect), change)
        np.testing.assert_allclose(after, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def law_dissipative(effect: type[Effect]) -> None:
    """At positive amplitude a dissipative term takes power from every state, or none."""
    if not effect.dissipative:
        return
    assert effect.balance in CONJUGATE, "a mass or a reading dissipates nothing"
    for amplitude in AMPLITUDES:
        power = terms(fitted(effect, amplitude * size(effect))) * getattr(STATES, CONJUGATE[effect.balance])
        assert power.min() >= 0, f"adds power in {(power < 0).mean():.0%} of states"


LAWS = (law_declared, law_absent_at_zero, law_alive_at_zero, law_linear, law_unit, law_dissipative)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__[4:])
@pytest.mark.parametrize("effect", ALL, ids=lambda effect: effect.name)
def test_effect_obeys(effect, law):
    law(effect)


# --- mutants: each breaks one law ---------------------------------------------------------------------


def amplitude(unit="ohm", sd=0.5, **keywords):
    keywords = {"bounds": (-1.0, 5.0), "meaning": "m", "source": "s", "amplitude": True} | keywords
    return parameter(0.0, unit=unit, sd=sd, **keywords)


class Good(Effect):
    """ΔU = a I. Source: none, the control of the mutants."""

    name, balance, dissipative = "good", "electrical", True
    amplitude: Scalar = amplitude()

    def term(self, robot, signals):
        return self.amplitude * signals.current


class Squared(Good):
    """ΔU = a² I. Source: mutant."""

    def term(self, robot, signals):
        return self.amplitude**2 * signals.current


class Softplus(Good):
    """ΔU = (log(1 + e^a) - log 2) I: not linear, though alive. Source: mutant."""

    def term(self, robot, signals):
        return (jnp.logaddexp(0.0, self.amplitude) - jnp.log(2.0)) * signals.current


class Present(Good):
    """ΔU = (a + 0.01) I: there at zero. Source: mutant."""

    def term(self, robot, signals):
        return (self.amplitude + 0.01) * signals.current


class Dead(Good):
    """ΔU = a I where a > 0: a gradient of zero at zero. Source: mutant."""

    def term(self, robot, signals):
        return jnp.where(self.amplitude > 0, self.amplitude, 0.0) * signals.current


class NotFinite(Good):
    """ΔU = a I √(a - a) / ...: a derivative that is no number at zero. Source: mutant."""

    def term(self, robot, signals):
        return self.amplitude * signals.current + jnp.sqrt(self.amplitude * self.amplitude) * 0.0


class WrongUnit(Good):
    """ΔU = a I²: ohms where V/A² belongs. Source: mutant."""

    dissipative = False

    def term(self, robot, signals):
        return self.amplitude * signals.current**2


class HiddenConstant(Good):
    """ΔU = a I for currents above 2 A: a constant with a unit that nobody declared. Source: mutant."""

    def term(self, robot, signals):
        return self.amplitude * jnp.where(jnp.abs(signals.current) > 2.0, signals.current, 0.0)


class WrongBalance(Good):
    """Volts in the balance of the motor's torque. Source: mutant."""

    balance = "motor"


class AddsPower(Good):
    """ΔU = a |I|: drives a negative current. Source: mutant."""

    def term(self, robot, signals):
        return self.amplitude * jnp.abs(signals.current)


class DissipativeMass(Good):
    """A mass that claims to dissipate. Source: mutant."""

    balance = "mass"
    amplitude: Scalar = amplitude(unit="kg")

    def term(self, robot, signals):
        return self.amplitude * signals.wheeled


class NoSource(Good):
    """ΔU = a I."""


class UnknownBalance(Good):
    """Source: mutant."""

    balance = "heat"


class SensorWithoutChannel(Good):
    """Source: mutant."""

    balance = "sensor"


class NotAnAmplitude(Good):
    """Source: mutant."""

    amplitude: Scalar = amplitude(**{"amplitude": False})


class UnknownUnit(Good):
    """Source: mutant."""

    amplitude: Scalar = amplitude(unit="furlong")


MUTANTS = {
    law_absent_at_zero: (Present,),
    law_alive_at_zero: (Squared, Dead, NotFinite),
    law_linear: (Squared, Softplus, Present, Dead),
    law_unit: (WrongUnit, HiddenConstant, WrongBalance),
    law_dissipative: (AddsPower, DissipativeMass),
    law_declared: (NoSource, UnknownBalance, SensorWithoutChannel, NotAnAmplitude, UnknownUnit),
}


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__[4:])
def test_control_of_the_mutants_obeys(law):
    law(Good)


@pytest.mark.parametrize(
    ("law", "mutant"),
    [(law, mutant) for law, mutants in MUTANTS.items() for mutant in mutants],
    ids=lambda x: x.__name__.removeprefix("law_"),
)
def test_law_rejects_mutant(law, mutant):
    with pytest.raises((AssertionError, ValueError)):
        law(mutant)


# --- the library is complete ----------------------------------------------------------------------------


def found_effects() -> dict[str, type[Effect]]:
    """Every subclass that a file of the package defines, by file."""
    found = {}
    for module in pkgutil.iter_modules(effects.__path__, "mmrjax.effects."):
        content = importlib.import_module(module.name)
        for _, cls in inspect.getmembers(content, inspect.isclass):
            if issubclass(cls, Effect) and cls is not Effect and cls.__module__ == module.name:
                found[f"{module.name.rpartition('.')[2]}:{cls.__name__}"] = cls
    return found


def test_all_lists_every_effect_file_once():
    found = found_effects()
    assert set(found.values()) == set(ALL) and len(ALL) == len(set(ALL))
    files = [key.partition(":")[0] for key in found]
    assert len(files) == len(set(files)), "one effect a file"


def test_effect_names_are_unique_and_those_of_their_files():
    assert len(BY_NAME) == len(ALL)
    for key, effect in found_effects().items():
        assert effect.name == key.partition(":")[0] and BY_NAME[effect.name] is effect


def test_units_of_signals_are_all_known():
    assert {*UNIT_OF, "memory"} == {f.name for f in dataclasses.fields(Signals)}  # each memory states its own


def test_units_of_parameters_and_balances_are_all_known(free):
    for p in free:
        dimensions(p.spec.unit)
    for unit, _ in balances.BALANCES.values():
        dimensions(unit)


def test_dimensions_of_products():
    assert dimensions("V/A") == dimensions("ohm")
    assert dimensions("N·m/s") == dimensions("W") == dimensions("V·A")
    assert dimensions("V·s") == dimensions("N·m/A")
    with pytest.raises(ValueError, match="furlong"):
        dimensions("furlong/s")


# --- both fidelities feel every effect ------------------------------------------------------------------


#: Instants at which `drive` is read [s]: what acts at a crawl shows at the first, what warms up at the last.
DRIVEN = (0.0, 0.003, 0.1, 1.0, 4.0)


@pytest.fixture(scope="module")
def drive_readings():
    """Readings of `drive` from 3 ms to 4 s in all conditions, for a vector of amplitudes of ALL."""
    times = jnp.asarray(DRIVEN)

    @jax.jit
    def run(amplitudes):
        robot = dataclasses.replace(
            nominal.nominal(), effects=tuple(fitted(e, a) for e, a in zip(ALL, amplitudes, strict=True))
        )

        def one(c):
            answer = drive(robot, c, times, tolerance=1e-11, max_steps=65_536)
            s = jax.vmap(lambda s: jnp.stack(jax.tree.leaves(balances.sensor(robot, s))))(answer.signals)
            return s[1:]

        return jax.vmap(one)(CONDITIONS)

    return run


def test_drive_without_amplitudes_is_drive_without_effects(drive_readings):
    bare = nominal.nominal()
    plain = jax.jit(jax.vmap(lambda c: drive(bare, c, jnp.asarray(DRIVEN), tolerance=1e-11)))(CONDITIONS)
    s = plain.signals
    expected = jnp.stack([s.total_current, s.speed_motor, s.speed], -1)[:, 1:]
    np.testing.assert_allclose(drive_readings(jnp.zeros(len(ALL))), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("k", range(len(ALL)), ids=[e.name for e in ALL])
def test_drive_and_steady_both_feel(k, drive_readings):
    """At a tenth of the prior's standard deviation a reading moves by more than 1e-5, in both fidelities.

    What settled travel does not show is looked for in `drive` alone, at the whole of it.
    """
    share = (1.0 if ALL[k].transient else 0.1) * size(ALL[k])
    base, moved = drive_readings(jnp.zeros(len(ALL))), drive_readings(jnp.zeros(len(ALL)).at[k].set(share))
    assert np.isfinite(moved).all()
    assert (np.abs(moved - base) / np.abs(base)).max() > (1e-6 if ALL[k].transient else 1e-5)
    if ALL[k].transient:
        return
    of_steady = compiled(outputs_steady, ALL)[0]
    base, moved = of_steady(jnp.zeros(len(ALL))), of_steady(jnp.zeros(len(ALL)).at[k].set(share))
    assert (np.abs(moved - base)[:, :3] / np.abs(base[:, :3])).max() > 1e-5


# --- what single effects amount to ----------------------------------------------------------------------


def _steady_with(changes=None, **amplitudes):
    robot = params.replace(nominal.nominal(), changes or {})
    added = tuple(fitted(BY_NAME[name], value) for name, value in amplitudes.items())
    return steady_batch(dataclasses.replace(robot, effects=added), CONDITIONS)


def _same(a, b, channels=("total_current", "motor_speed", "speed")):
    for channel in channels:
        np.testing.assert_allclose(getattr(a.reading, channel), getattr(b.reading, channel), rtol=1e-9)


def test_series_resistance_is_winding_resistance():
    _same(_steady_with(series_resistance=0.4), _steady_with({"motor.resistance": 0.611 + 0.4}))


def test_mass_offset_is_mass_of_the_wheeled_robot():
    _same(_steady_with(mass_offset=1.6), _steady_with({"4W2T.mass": 11.5 + 1.6}))


def test_winding_heating_is_resistance_at_the_settled_temperature():
    with_it = _steady_with(winding_heating=1.0)
    for k in range(CONDITIONS.voltage.size):
        current = float(with_it.reading.total_current[k]) / 2
        rise = 7.7 * 0.611 * current**2
        hot = _steady_with({"motor.resistance": 0.611 * (1 + 0.00393 * rise)})
        np.testing.assert_allclose(with_it.reading.motor_speed[k], hot.reading.motor_speed[k], rtol=1e-9)


def test_churning_is_viscous_loss_that_grows_with_speed():
    with_it = _steady_with(churning=3e-4)
    for k in range(CONDITIONS.voltage.size):
        turn = 3e-4 * float(with_it.reading.motor_speed[k]) / 48.0
        viscous = {"6T2A.track.loss_viscous": 0.016 + turn, "4W2T.track.loss_viscous": 0.003 + turn}
        more = _steady_with(viscous)
        np.testing.assert_allclose(with_it.reading.total_current[k], more.reading.total_current[k], rtol=1e-9)


def test_rolling_radius_changes_the_distance_and_no_torque():
    with_it, without = _steady_with(rolling_radius=0.03), _steady_with()
    _same(with_it, without, ("total_current", "motor_speed"))
    gained = np.asarray(with_it.reading.speed) - np.asarray(without.reading.speed)
    np.testing.assert_allclose(gained, 0.03 * np.asarray(without.theoretical_speed), rtol=1e-9)
