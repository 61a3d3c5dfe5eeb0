"""Effects of users: classes in a Python file, checked against the rules of `effects.Effect` and added to the
library.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.machinery
import importlib.util
import inspect
import math
import os
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp

from calibration.data import Json
from calibration.data.input_errors import BadConfiguration, allowed_words, is_number, stated_word
from mmrjax import effects
from mmrjax.effects.base import THE_SIDE, Effect
from mmrjax.model import balances, channels, paper_robots, params
from mmrjax.model.balances import BALANCES, ROUND, effects_sum, moving_signals
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals, State


def _effect_that_records_signals(balance_name: str, channel_name: str, recorded: list[Signals]) -> Effect:
    """Effect without influence that records the signals which its balance passes to it."""

    class Witness(Effect):
        balance = balance_name
        channel = channel_name
        amplitude: Scalar = 0.0

        def term(self, robot: Robot, signals: Signals) -> Scalar:
            recorded.append(signals)
            return 0.0

    return Witness()


def readable_signals(
    robot: Robot, conditions: Conditions, state: State, balance: str, channel: str, *, settled: bool = False
) -> Signals:
    """Signals that an effect of this balance may read, namely those computed before it. Others are `UNSET`.

    Args:
        conditions, state: one run at one instant, scalars, not traced.
        settled: True for steady forward travel (`balances.settled_signals`), False for motion
            (`balances.moving_signals`).
    """
    signals_read: list[Signals] = []
    watched_robot = replace(robot, effects=(_effect_that_records_signals(balance, channel, signals_read),))
    compute_signals = balances.settled_signals if settled else balances.moving_signals
    signals = compute_signals(watched_robot, conditions, state)
    balances.sensor(watched_robot, signals[0] if isinstance(signals, tuple) else signals)
    return signals_read[-1]  # at the torque that a gearbox really transmits, which is iterated


#: Effects by name, as in robot files and on the command line.
Library = Mapping[str, type[Effect]]

#: Beginning of the module name of a user's effect file. A hash of its path follows.
OWN_MODULE = "mmrjax_user_effects_"

#: Kind of every class attribute that an effect states or inherits.
_STATED = {
    "name": str,
    "balance": str,
    "dissipative": bool,
    "channel": str,
    "transient": bool,
    "settles_to": str,
    "needs_battery": bool,
    "needs_reverse": bool,
    "needs_duty": bool,
    "odd_in_travel": bool,
    "movers": str,
    "memory_unit": str,
    "driver": str,
}
_MOVERS = ("tracks", "wheels")
#: Signals of the left side in a turn that are zero in straight travel; they change sign in the mirror image.
TURN: Json = {
    "side": 1.0,
    "yaw_rate": 0.8,
    "speed_lateral": 0.1,
    "direction_turn": 1.0,
    "moment_lateral": -2.0,
}


def effect_library(paths: Sequence[Path | str]) -> Library:
    """Packaged effects together with the effects of the files, by name.

    Raises:
        BadConfiguration: for the same reasons as `read_effect_file`, a repeated name, or an effect that settles to an
            unknown effect.
    """
    library = dict(effects.BY_NAME)
    user_effects = [(path, effect) for path in map(Path, paths) for effect in read_effect_file(path)]
    for path, effect in user_effects:
        if effect.name in {**effects.BESIDE, **library}:
            raise BadConfiguration(
                f"{_effect_place(path, effect)}, name: {effect.name} is already used; choose another"
            )
        library[effect.name] = effect
    for path, effect in user_effects:
        other_names = [name for name in library if name != effect.name]
        if effect.settles_to:
            stated_word(effect.settles_to, other_names, f"{_effect_place(path, effect)}, settles_to")
    return library


class _SourceLoader(importlib.machinery.SourceFileLoader):
    """Loader that runs the source file itself. Compiled files next to it may differ from it. They are neither read
    nor written.
    """

    def get_code(self, fullname: str) -> types.CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


def read_effect_file(path: Path) -> tuple[type[Effect], ...]:
    """Effect classes that a Python file defines, in its order. The code of the file is run.

    Raises:
        BadConfiguration: there is no such file, its code fails, it has no effect, or an effect breaks the rules of
            `effects.Effect`. The message has file, class, attribute, value and expected value.
    """
    if not path.is_file():
        raise BadConfiguration(f"--effects: got {path}, no such file; expected a Python file with Effect classes")
    # A unique name: two files may have the same name, and no file may hide a module of the package.
    name = OWN_MODULE + hashlib.sha256(os.fsencode(path.resolve())).hexdigest()[:16]
    spec = importlib.util.spec_from_file_location(name, path, loader=_SourceLoader(name, str(path)))
    if path.suffix != ".py" or spec is None or spec.loader is None:
        raise BadConfiguration(f"--effects: got {path.name}; expected a file whose name ends in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise BadConfiguration(f"{path.name}: its code fails ({type(error).__name__}: {error})") from error
    concrete = effects.effects_of_module(module)
    if not concrete:
        classes = [v for v in vars(module).values() if inspect.isclass(v) and v.__module__ == name]
        partial = [v.__name__ for v in classes if issubclass(v, Effect)]
        missing = f"; {partial[0]} defines no term" if partial else ""
        raise BadConfiguration(
            f"{path.name}: contains no effect; expected a class derived from mmrjax.effects.Effect{missing}"
        )
    for effect in concrete:
        _check_effect(path, effect)
    return concrete


def _effect_place(path: Path, effect: type[Effect]) -> str:
    return f"{path.name}, {effect.__name__}"


def _check_effect(path: Path, effect: type[Effect]) -> None:
    effect_place = _effect_place(path, effect)

    def refuse(what: str) -> BadConfiguration:
        return BadConfiguration(f"{effect_place}{what}")

    for attribute, kind in _STATED.items():
        value = getattr(effect, attribute, None)
        if not isinstance(value, kind):
            raise refuse(f", {attribute}: got {value}; expected a {kind.__name__} as class attribute")
    if not effect.name.isidentifier():
        raise refuse(f", name: got {effect.name!r}; expected lower-case words joined by underscores")
    if effect.balance not in BALANCES:
        raise refuse(f", balance: got {effect.balance}; {allowed_words(effect.balance, BALANCES)}")
    channel_names = channels.channel_names(channels.EVERY)
    if (effect.balance == "sensor") != bool(effect.channel):
        raise refuse(
            f", channel: got {effect.channel!r}; expected one of {', '.join(channel_names)} for sensor, else none"
        )
    if effect.channel and effect.channel not in channel_names:
        raise refuse(f", channel: got {effect.channel}; {allowed_words(effect.channel, channel_names)}")
    if effect.movers and effect.movers not in _MOVERS:
        raise refuse(f", movers: got {effect.movers}; {allowed_words(effect.movers, _MOVERS)}, or none for both")
    size = effect.memory_size
    if size is not None and not (is_number(size) and size > 0):
        raise refuse(f", memory_size: got {size}; expected a positive number, or None for no memory")
    if "Source:" not in (effect.__doc__ or ""):
        raise refuse(": its docstring must give the equation and its «Source:»")
    try:
        default = effect()
    except (Exception, SystemExit) as error:
        raise refuse(f": cannot be created without arguments ({error}); give every field a default") from error
    default_configurations, configurations = default.configurations, effect.configurations
    if (
        default_configurations != configurations
        or not isinstance(default_configurations, tuple)
        or not all(isinstance(c, str) for c in default_configurations)
    ):
        raise refuse(f', configurations: got {configurations!r}; expected a tuple of names such as ("4W2T",)')
    declared = params.parameters_by_name(default)
    amplitudes = [name for name, p in declared.items() if p.spec.amplitude]
    if amplitudes != ["amplitude"]:
        raise refuse(
            f": its amplitudes are {', '.join(amplitudes) or 'none'}; expected one field, "
            "amplitude: Scalar = amplitude(unit=..., meaning=..., bounds=..., sd=..., source=...)"
        )
    if float(declared["amplitude"].value) != 0.0:
        raise refuse(f", amplitude: got default {float(declared['amplitude'].value):g}; expected 0 (effect off)")
    if not declared["amplitude"].spec.prior_sd(0.0) > 0:
        raise refuse(
            ", amplitude: expected a prior with sd > 0; give sd, since relative_sd is relative to the "
            "default, which is 0"
        )
    _check_term(refuse, effect, declared["amplitude"].spec.prior_sd(0.0))


@functools.cache
def _test_points(balance: str, channel: str, configuration: int) -> tuple[Signals, Signals, Signals]:
    """Signals of the nominal robot on its battery, for the test of the terms of effects.

    Returns:
        Signals that a term of the left side may read while the robot climbs and turns left. All signals at that
        point. Signals that a term may read at rest.
    """
    robot = paper_robots.nominal()
    run = Conditions(configuration, slope_deg=6.0, payload=2.0, battery=1.0, discharge=100.0)
    zero = jnp.zeros(())
    climbing = State(jnp.asarray(1.5), jnp.asarray(800.0), jnp.asarray(0.6), jnp.asarray(100.0))
    at_rest = State(zero, zero, zero, zero)
    # Sums for the turn are computed after both sides' slip and resistance.
    read_balance = "slip" if balance in ROUND else balance
    readable = readable_signals(robot, run, climbing, read_balance, channel)
    all_signals = moving_signals(robot, run, climbing)
    readable_at_rest = readable_signals(robot, run, at_rest, read_balance, channel)
    return replace(readable, **TURN), replace(all_signals, **TURN), readable_at_rest


def _check_term(refuse: Callable[[str], BadConfiguration], effect: type[Effect], size: float) -> None:
    robot = paper_robots.nominal()
    memory = {} if effect.memory_size is None else {effect.name: jnp.asarray(0.3 * effect.memory_size)}

    def term(amplitude: jax.Array, signals: Signals) -> jax.Array:
        # The robot file checks configurations that the nominal robot does not have.
        effect_of_amplitude = replace(params.replace(effect(), {"amplitude": amplitude}), configurations=())
        robot_with_effect = replace(robot, effects=(effect_of_amplitude,))
        return jnp.asarray(effects_sum(robot_with_effect, signals, effect.balance, effect.channel), float)

    for configuration in range(len(robot.configurations)):
        readable, all_signals, signals_at_rest = (
            replace(s, memory=memory) for s in _test_points(effect.balance, effect.channel, configuration)
        )
        mirrored = replace(readable, **{name: -value for name, value in TURN.items()})
        on_external_supply = replace(readable, battery=jnp.zeros(()))
        try:
            term_at_zero, term_at_size, term_at_double = (
                term(jnp.asarray(k * size), readable) for k in (0.0, 1.0, 2.0)
            )
            term_of_all, external_term = (term(jnp.asarray(size), s) for s in (all_signals, on_external_supply))
            mirrored_term = term(jnp.asarray(size), mirrored) * (-1 if effect.balance in ROUND else 1)
            slope = jax.grad(lambda a, s=readable: jnp.sum(term(a, s)))(jnp.asarray(0.0))
            gradient_at_rest = eqx.filter_grad(lambda s: jnp.sum(term(jnp.asarray(size), s)))(signals_at_rest)
            memory_rates = []
            if effect.memory_size is not None:
                memory_rates = [effect().rate(robot, all_signals), effect().settled(robot, readable)]
        except (Exception, SystemExit) as error:
            raise refuse(f": its term cannot be computed ({type(error).__name__}: {error})") from error
        if term_at_size.shape != ():
            raise refuse(f": its term has shape {term_at_size.shape}; expected a scalar for scalar signals")
        if not jnp.array_equal(term_at_size, term_of_all, equal_nan=True):
            raise refuse(": its term reads a signal that is computed after its balance; see balances.moving_signals")
        if float(term_at_zero) != 0.0:
            raise refuse(f": its term is {float(term_at_zero):g} at amplitude 0; expected 0")
        if not math.isfinite(float(slope)):
            raise refuse(f": the derivative of its term at amplitude 0 is {float(slope)}; expected a finite one")
        is_nonlinear = abs(float(term_at_double) - 2 * float(term_at_size)) > 1e-6 * abs(float(term_at_double))
        if is_nonlinear or (float(slope) == 0) != (float(term_at_size) == 0):
            raise refuse(
                ": its term is not proportional to its amplitude; expected amplitude times a function of signals"
            )
        if not all(math.isfinite(float(jnp.sum(x))) for x in memory_rates):
            raise refuse(": the rate or settled value of its memory is not finite")
        if not all(jnp.isfinite(x).all() for x in jax.tree.leaves(gradient_at_rest)):
            raise refuse(": derivatives of its term are not finite at rest, where drive and track start")
        is_symmetric = effect.balance == "sensor" or jnp.allclose(term_at_size, mirrored_term, rtol=1e-9, atol=0.0)
        if not is_symmetric and effect.driver != THE_SIDE:
            raise refuse(
                f", driver: got {effect.driver!r} for a term that differs between the sides; expected "
                f'"{THE_SIDE}", since the robot turns unless it is steered'
            )
        if effect.needs_battery and float(external_term) != 0.0:
            raise refuse(f", needs_battery: its term is {float(external_term):g} on an external supply; expected 0")
