"""Effects for other sizes of rig: classes that differ from the library's only by priors and limits."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.model import params
from mmrjax.model.params import Parameter

#: Factors of a class: for the sd of its amplitude, its shape parameter, and the limits of its amplitude.
Factors = tuple[float, float, float]


def amplitude_of(effect: Effect) -> Parameter:
    """The amplitude of an effect."""
    return next(p for p in params.walk_parameters(effect) if p.spec.amplitude)


def free_shape_parameter(effect: Effect) -> Parameter | None:
    """The shape parameter that a fit frees: the first phase or scale after the amplitude, None without one."""
    for p in params.walk_parameters(effect):
        if not p.spec.amplitude and (p.name == "phase" or (p.spec.relative_sd and float(p.value) > 0)):
            return p
    return None


@functools.lru_cache(maxsize=4096)
def scaled_effect(kind: type[Effect], factors: Factors) -> type[Effect]:
    """A class of the same effect with the amplitude's sd and limits and the shape multiplied by factors.

    Equal factors return the same class.
    """
    sd, stretch, limits = factors
    effect = kind()
    fields = {amplitude_of(effect).name: _field(amplitude_of(effect), sd, limits)}
    if (shape := free_shape_parameter(effect)) is not None and stretch != 1.0:
        fields[shape.name] = _field(shape, stretch, stretch)
    body: Mapping[str, object] = {
        "__annotations__": {**dict.fromkeys(fields, "Scalar"), "factors": ClassVar[Factors]},
        "__module__": kind.__module__,
        "__doc__": kind.__doc__,
        "__reduce__": _reduced,
        "name": kind.name,
        "plain": kind,
        "factors": factors,
        **fields,
    }
    return type(kind.__name__, (kind,), dict(body))


def _field(parameter: Parameter, factor: float, limits: float) -> Any:
    spec = parameter.spec
    low, high = spec.bounds
    return params.parameter(
        factor * float(parameter.value), spec.unit, spec.meaning, (low * limits, high * limits), spec.source,
        relative_sd=spec.relative_sd, sd=None if spec.sd is None else spec.sd * factor, amplitude=spec.amplitude,
    )  # fmt: skip


def _reduced(effect: Effect) -> tuple[Any, ...]:
    values = {f.name: getattr(effect, f.name) for f in dataclasses.fields(effect) if f.init}
    kind = type(effect)
    return restore_effect, (kind.plain, kind.factors, values)


def restore_effect(kind: type[Effect], factors: Factors, values: Mapping[str, Any]) -> Effect:
    """Restores an effect from its pickled values, because its class cannot be found by name."""
    return scaled_effect(kind, factors)(**values)
