"""Effects of the user's own: classes in a Python file, checked against the contract and added to the library."""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp

from calibration.data.errors import BadConfiguration, choices
from mmrjax import effects, nominal, params
from mmrjax.balances import BALANCES, added, moving
from mmrjax.conditions import Conditions
from mmrjax.effects import Effect
from mmrjax.signals import Signals, State

#: Effects by name, as robot files and the command line know them.
Library = Mapping[str, type[Effect]]


def library(paths: Sequence[Path | str] = ()) -> Library:
    """The packaged effects and those of the files, by name.

    Raises:
        BadConfiguration: as `read`, or a name that stands twice.
    """
    known = dict(effects.BY_NAME)
    for path in map(Path, paths):
        for effect in read(path):
            if effect.name in known or effect.name in effects.UNNAMED:
                raise BadConfiguration(f"{_where(path, effect)}, name: {effect.name} is taken; choose another")
            known[effect.name] = effect
    return known


def read(path: Path) -> tuple[type[Effect], ...]:
    """The effect classes that a Python file defines, in its order. The file's code is run.

    Raises:
        BadConfiguration: no such file, code that fails, no effect in it, or one that breaks the contract of
            `effects.Effect`; one sentence with file, class, attribute, what came and what is expected.
    """
    if not path.is_file():
        raise BadConfiguration(f"--effects: got {path}, no such file; expected a Python file with Effect classes")
    # A name of its own: two files may be called alike, and none may hide a module of the package.
    name = f"mmrjax_user_effects_{abs(hash(path.resolve())):x}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise BadConfiguration(f"--effects: got {path.name}; expected a file whose name ends in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise BadConfiguration(f"{path.name}: its code fails ({type(error).__name__}: {error})") from error
    found = tuple(
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, Effect) and value.__module__ == name
    )
    concrete = tuple(effect for effect in found if not inspect.isabstract(effect))
    if not concrete:
        missing = f"; {found[0].__name__} defines no term" if found else ""
        raise BadConfiguration(
            f"{path.name}: holds no effect; expected a class derived from mmrjax.effects.Effect{missing}"
        )
    for effect in concrete:
        _check(path, effect)
    return concrete


def _where(path: Path, effect: type[Effect]) -> str:
    return f"{path.name}, {effect.__name__}"


def _check(path: Path, effect: type[Effect]) -> None:
    where = _where(path, effect)

    def refuse(what: str) -> BadConfiguration:
        return BadConfiguration(f"{where}{what}")

    for attribute, kind in (("name", str), ("balance", str), ("dissipative", bool)):
        value = getattr(effect, attribute, None)
        if not isinstance(value, kind):
            raise refuse(f", {attribute}: got {value}; expected a {kind.__name__} as class attribute")
    if not effect.name.isidentifier():
        raise refuse(f", name: got {effect.name!r}; expected lower-case words joined by underscores")
    if effect.balance not in BALANCES:
        raise refuse(f", balance: got {effect.balance}; {choices(effect.balance, BALANCES)}")
    channels = tuple(Reading.__dataclass_fields__)
    if (effect.balance == "sensor") != bool(effect.channel):
        raise refuse(
            f", channel: got {effect.channel!r}; expected one of {', '.join(channels)} for sensor, else none"
        )
    if effect.channel and effect.channel not in channels:
        raise refuse(f", channel: got {effect.channel}; {choices(effect.channel, channels)}")
    if "Source:" not in (effect.__doc__ or ""):
        raise refuse(": its docstring states no equation with its «Source:»")
    try:
        default = effect()
    except Exception as error:
        raise refuse(f": cannot be made without arguments ({error}); give every field a default") from error
    declared = {p.name: p for p in params.walk(default)}
    amplitudes = [name for name, p in declared.items() if p.spec.amplitude]
    if amplitudes != ["amplitude"]:
        raise refuse(
            f": its amplitudes are {', '.join(amplitudes) or 'none'}; expected one field "
            "amplitude = parameter(0.0, ..., amplitude=True)"
        )
    if float(declared["amplitude"].value) != 0.0:
        raise refuse(f", amplitude: got default {float(declared['amplitude'].value):g}; expected 0, which is absent")
    if not declared["amplitude"].spec.prior_sd(0.0) > 0:
        raise refuse(", amplitude: expected a prior with sd > 0; relative_sd is a share of zero")
    _check_term(refuse, effect, declared["amplitude"].spec.prior_sd(0.0))


def _check_term(refuse: Callable[[str], BadConfiguration], effect: type[Effect], size: float) -> None:
    robot = nominal.nominal()
    run = Conditions(voltage=24.0, slope_deg=np.degrees(0.1), payload=2.0)
    state = State(*map(jnp.asarray, (1.5, 800.0, 0.6, 0.0)))
    signals = moving(robot, run, state)
    memory = {} if effect.memory_size is None else {effect.name: jnp.asarray(0.3 * effect.memory_size)}
    signals = Signals(**{**vars(signals), "memory": memory})

    def term(amplitude: jax.Array) -> jax.Array:
        made = params.replace(effect(), {"amplitude": amplitude})
        with_it = dataclasses.replace(robot, effects=(made,))
        return jnp.asarray(added(with_it, signals, effect.balance, effect.channel), float)

    try:
        none, once, twice = (term(jnp.asarray(k * size)) for k in (0.0, 1.0, 2.0))
        slope = jax.grad(lambda a: jnp.sum(term(a)))(jnp.asarray(0.0))
        if effect.memory_size is not None:
            effect().rate(robot, signals)
            effect().settled(robot, signals)
    except Exception as error:
        raise refuse(f": its term cannot be computed ({type(error).__name__}: {error})") from error
    if once.shape != ():
        raise refuse(f": its term has shape {once.shape}; expected a scalar for scalar signals")
    if float(none) != 0.0:
        raise refuse(f": its term is {float(none):g} at amplitude 0; expected 0, which is absent")
    if not math.isfinite(float(slope)):
        raise refuse(f": the derivative of its term at amplitude 0 is {float(slope)}; expected a finite one")
    if abs(float(twice) - 2 * float(once)) > 1e-6 * abs(float(twice)) or (float(slope) == 0) != (float(once) == 0):
        raise refuse(": its term is not linear in its amplitude; expected amplitude times something")
