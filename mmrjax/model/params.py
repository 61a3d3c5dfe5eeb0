"""Parameter fields: a number with its unit, prior, bounds and source, and the walk that collects them."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Iterator
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mmrjax.compile.precision import as_array
from mmrjax.errors import near

#: A number, or an array of numbers: one of a batch, or a tracer.
Scalar = Float[Array, "..."] | float
#: An index, or an array of indices.
Index = Int[Array, "..."] | np.ndarray | int


@dataclasses.dataclass(frozen=True)
class Spec:
    """What a parameter field declares about its number.

    `relative_sd` is the prior's standard deviation as a share of the prior mean, `sd` the absolute one
    in the field's unit; one of the two is set. The prior mean is the nominal robot's value.
    `bounds` are what a file may state and what a fit may reach, never what a constructor checks.
    `scanned` is set where the misfit over it may be a staircase or have several basins (a dead time, a phase, a gap):
    the half width of a basin, at least [the field's unit]. A fit of histories whose prior reaches further looks at
    the misfit over all of its range, and not at its gradient alone.
    """

    unit: str
    meaning: str
    bounds: tuple[float, float]
    source: str
    relative_sd: float | None = None
    sd: float | None = None
    amplitude: bool = False
    scanned: float | None = None

    def prior_sd(self, mean: float) -> float:
        """Standard deviation of the prior [the field's unit] around `mean`."""
        return self.sd if self.sd is not None else abs(mean) * (self.relative_sd or 0.0)


def parameter(
    default: float | None = None,
    *,
    unit: str,
    meaning: str,
    bounds: tuple[float, float],
    source: str,
    relative_sd: float | None = None,
    sd: float | None = None,
    amplitude: bool = False,
    scanned: float | None = None,
) -> Any:
    """Declare a differentiable scalar of a component; see `Spec` for the arguments."""
    if (relative_sd is None) == (sd is None):
        raise ValueError("a parameter states either relative_sd or sd")
    spec = Spec(unit, meaning, bounds, source, relative_sd, sd, amplitude, scanned)
    keywords: dict[str, Any] = {} if default is None else {"default": default}
    return eqx.field(converter=as_float, metadata={"spec": spec}, kw_only=True, **keywords)


def as_float(value: Any) -> Any:
    """A number as a float array (`precision.as_array`); an array passes, without a weak type."""
    if isinstance(value, int | float):
        return as_array(value)
    # A weakly typed array, as of `jnp.asarray(0.5)`, would be another program to compile of every function. A tracer
    # or a placeholder of a tree transformation passes.
    weak = isinstance(value, jax.Array) and not isinstance(value, jax.core.Tracer) and value.weak_type
    return jnp.asarray(value, value.dtype) if weak else value


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One parameter of a robot: dotted name, its value now, its specification."""

    name: str
    value: Any
    spec: Spec


#: Numbers of equations and tables of the paper, in what is said of a parameter.
_OF_PAPER = re.compile(r",? (?:of )?(?:(?:eqs?\. )?\(\d+\)(?:-\(\d+\))?|Tables? \w+(?:-\w+)?)")
#: Words by which a source is of the paper's robot.
_PAPERS = re.compile(r"Table|eq\.|paper|Section|Fig\.|lacquered|sheet|M_t0|GP32|RE30")
#: Sources of a rig's parameters.
STATED, DEFAULT = "stated in the robot's file", "default"


@functools.cache
def own_spec(spec: Spec, stated: bool) -> Spec:
    """What a field says of a rig's parameter: its meaning without the paper's numbers, its own source.

    Args:
        stated: whether the rig's file states its prior.
    """
    source = STATED if stated else DEFAULT if not spec.amplitude or _PAPERS.search(spec.source) else spec.source
    return dataclasses.replace(spec, meaning=_OF_PAPER.sub("", spec.meaning), source=source)


def walk(component: eqx.Module, prefix: str = "") -> Iterator[Parameter]:
    """Yield every parameter below `component`, depth first, by dotted name; those of a rig that starts from nothing
    say nothing of the paper's robot (`own_spec`).

    A tuple of modules (the effects) is walked by each member's `name`; a collection of modules by name (the
    configurations) by those names alone: `6T2A.mass`.
    """
    rig = getattr(component, "rig", None)
    if rig is None or rig.inherits:
        yield from _walk(component, prefix)
        return
    stated = {name for name, _, _ in rig.priors}
    for parameter in _walk(component, prefix):
        spec = own_spec(parameter.spec, parameter.name in stated)
        yield dataclasses.replace(parameter, spec=spec)


def _walk(component: eqx.Module, prefix: str) -> Iterator[Parameter]:
    for field in dataclasses.fields(component):
        value = getattr(component, field.name)
        name = f"{prefix}{field.name}"
        if "spec" in field.metadata:
            yield Parameter(name, value, field.metadata["spec"])
        elif hasattr(value, "items"):
            for key, member in value.items():
                yield from _walk(member, f"{prefix}{key}.")
        elif isinstance(value, eqx.Module):
            yield from _walk(value, f"{name}.")
        elif isinstance(value, tuple):
            members: list[Any] = [m for m in value if isinstance(m, eqx.Module)]
            for member in members:
                yield from _walk(member, f"{name}.{member.name}.")


def table(component: eqx.Module) -> str:
    """Every parameter with value and unit, a line for each part; of a batch or a tracer its shape."""
    parts: dict[str, list[str]] = {}
    for p in walk(component):
        part, _, key = p.name.rpartition(".")
        unit = "" if p.spec.unit == "-" else f" {p.spec.unit}"
        parts.setdefault(part, []).append(f"{key} {shown(p.value)}{unit}")
    return "\n".join(f"  {part}: {', '.join(lines)}" for part, lines in parts.items())


def shown(value: Any) -> str:
    """A number to six digits; of an array its shape."""
    if isinstance(value, jax.core.Tracer) or not isinstance(value, jax.Array | np.ndarray | np.number | float | int):
        return str(value)
    return f"{float(value):.6g}" if np.ndim(value) == 0 else f"array{list(np.shape(value))}"


M = TypeVar("M", bound=eqx.Module)


def replace(component: M, values: dict[str, Any]) -> M:
    """Return `component` with the named parameters replaced, of a rig known from then on; values may be tracers or
    batches.

    Args:
        component: a robot or a part of one.
        values: dotted names, such as `motor.resistance`, and their values [SI].

    Returns:
        Another component of the same kind.

    Raises:
        KeyError: a name is no parameter of `component`; the message says what is near it.
    """
    known = [p.name for p in walk(component)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        meant = [near(name, known, 3) for name in unknown]
        hints = [f"{n} (did you mean {', '.join(m)}?)" if m else n for n, m in zip(unknown, meant, strict=True)]
        raise KeyError(f"no such parameter: {', '.join(hints)}")
    replaced = _replace(component, values, "")
    rig: Any = getattr(replaced, "rig", None)
    if rig is None or values.keys().isdisjoint(rig.unknown):
        return replaced
    known = dataclasses.replace(rig, unknown=tuple(name for name in rig.unknown if name not in values))
    changes: dict[str, Any] = {"rig": known}
    return dataclasses.replace(replaced, **changes)


def _replace(component: Any, values: dict[str, Any], prefix: str) -> Any:
    changes: dict[str, Any] = {}
    for field in dataclasses.fields(component):
        value = getattr(component, field.name)
        name = f"{prefix}{field.name}"
        if hasattr(value, "items"):
            changes[field.name] = type(value)({k: _replace(m, values, f"{prefix}{k}.") for k, m in value.items()})
            continue
        if not any(key == name or key.startswith(f"{name}.") for key in values):
            continue
        if "spec" in field.metadata:
            changes[field.name] = values[name]
        elif isinstance(value, tuple):
            changes[field.name] = tuple(_replace(m, values, f"{name}.{m.name}.") for m in value)
        else:
            changes[field.name] = _replace(value, values, f"{name}.")
    return dataclasses.replace(component, **changes) if changes else component


def one_by_one(numbers: Float[Array, " n"]) -> tuple[Array, ...]:
    """The numbers of an array, each by itself."""
    return tuple(x.reshape(()) for x in jax.lax.split(numbers, [1] * len(numbers))) if len(numbers) else ()


def strong(robot: M) -> M:
    """`robot` without weakly typed numbers: each of those is another program to compile of the same function."""
    return jax.tree.map(lambda x: jnp.asarray(x, x.dtype) if isinstance(x, jax.Array) else x, robot)
