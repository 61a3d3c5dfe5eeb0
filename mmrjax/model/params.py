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

from mmrjax.compile.compiling import as_array
from mmrjax.errors import similar_words

#: A number, or an array of numbers (a batch or a tracer).
Scalar = Float[Array, "..."] | float
#: Numbers by name.
Scalars = dict[str, Scalar]
#: Two numbers: of left and right, of two axes, or of two levers.
Pair = Float[Array, " 2"]
#: Instants of a run.
Times = Float[Array, " times"]
#: An index, or an array of indices.
Index = Int[Array, "..."] | np.ndarray | int


@dataclasses.dataclass(frozen=True)
class Spec:
    """Specification of a parameter field.

    `relative_sd` is the prior's standard deviation as a share of the prior mean, `sd` the absolute one
    in the field's unit. One of the two is set. The prior mean is the nominal robot's value.
    `bounds` are the values that a file may state and a fit may reach. Constructors never check them.
    `scanned` is set if the misfit over the parameter may be a staircase or have several basins (a dead time, a phase,
    a gap). It is the least half width of a basin [the field's unit]. A fit of histories with a wider prior scans the
    misfit over the whole range in addition to following its gradient.
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
    default: float | None,
    unit: str,
    meaning: str,
    bounds: tuple[float, float],
    source: str,
    *,
    relative_sd: float | None = None,
    sd: float | None = None,
    amplitude: bool = False,
    scanned: float | None = None,
) -> Any:
    """Declares a differentiable scalar of a component. See `Spec` for the arguments.

    Args:
        default: value if the component does not state one. None: the component has to state it.
    """
    if (relative_sd is None) == (sd is None):
        raise ValueError("a parameter states either relative_sd or sd")
    spec = Spec(unit, meaning, bounds, source, relative_sd, sd, amplitude, scanned)
    keywords: dict[str, Any] = {} if default is None else {"default": default}
    return eqx.field(converter=as_float, metadata={"spec": spec}, kw_only=True, **keywords)


def as_float(value: Any) -> Any:
    """A number as a float array (`compiling.as_array`). An array passes without its weak type."""
    if isinstance(value, int | float):
        return as_array(value)
    # A weakly typed array, as from `jnp.asarray(0.5)`, would make every function compile another program. A tracer
    # or a placeholder of a tree transformation passes.
    weak = isinstance(value, jax.Array) and not isinstance(value, jax.core.Tracer) and value.weak_type
    return jnp.asarray(value, value.dtype) if weak else value


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One parameter of a robot: dotted name, current value, specification."""

    name: str
    value: Any
    spec: Spec


#: Equation and table numbers of the paper in the text of a parameter.
_OF_PAPER = re.compile(r",? (?:of )?(?:(?:eqs?\. )?\(\d+\)(?:-\(\d+\))?|Tables? \w+(?:-\w+)?)")
#: Words that mark a source as the paper's robot.
_PAPERS = re.compile(r"Table|eq\.|paper|Section|Fig\.|lacquered|sheet|M_t0|GP32|RE30")
#: Sources of a rig's parameters.
STATED, DEFAULT = "stated in the robot's file", "default"


@functools.cache
def rig_spec(spec: Spec, stated: bool) -> Spec:
    """Specification of a rig's parameter: the meaning without the paper's numbers, and its own source.

    Args:
        stated: True if the rig's file states its prior.
    """
    source = STATED if stated else DEFAULT if not spec.amplitude or _PAPERS.search(spec.source) else spec.source
    return dataclasses.replace(spec, meaning=_OF_PAPER.sub("", spec.meaning), source=source)


def walk_parameters(component: eqx.Module) -> Iterator[Parameter]:
    """Yields every parameter below `component`, depth first, by dotted name.

    Parameters of a rig without a base robot do not mention the paper (`rig_spec`). A tuple of modules (the effects)
    is walked by each member's `name`. A mapping of modules (the configurations) by its keys only: `6T2A.mass`.
    """
    rig = getattr(component, "rig", None)
    if rig is None or rig.inherits:
        yield from _walk_component(component, "")
        return
    prior_names = {name for name, _, _ in rig.priors}
    for parameter in _walk_component(component, ""):
        spec = rig_spec(parameter.spec, parameter.name in prior_names)
        yield dataclasses.replace(parameter, spec=spec)


def _walk_component(component: eqx.Module, prefix: str) -> Iterator[Parameter]:
    for field in dataclasses.fields(component):
        value = getattr(component, field.name)
        name = f"{prefix}{field.name}"
        if "spec" in field.metadata:
            yield Parameter(name, value, field.metadata["spec"])
        elif hasattr(value, "items"):
            for key, member in value.items():
                yield from _walk_component(member, f"{prefix}{key}.")
        elif isinstance(value, eqx.Module):
            yield from _walk_component(value, f"{name}.")
        elif isinstance(value, tuple):
            members: list[Any] = [m for m in value if isinstance(m, eqx.Module)]
            for member in members:
                yield from _walk_component(member, f"{name}.{member.name}.")


def parameter_table(component: eqx.Module) -> str:
    """Every parameter with value and unit, one line for each part. For a batch or a tracer, its shape."""
    parts: dict[str, list[str]] = {}
    for p in walk_parameters(component):
        part, _, key = p.name.rpartition(".")
        unit = "" if p.spec.unit == "-" else f" {p.spec.unit}"
        parts.setdefault(part, []).append(f"{key} {number_text(p.value)}{unit}")
    return "\n".join(f"  {part}: {', '.join(lines)}" for part, lines in parts.items())


def parameters_by_name(component: eqx.Module) -> dict[str, Parameter]:
    """Parameters of a component by dotted name."""
    return {p.name: p for p in walk_parameters(component)}


def values_by_name(component: eqx.Module) -> dict[str, float]:
    """Values of a component's parameters by dotted name [SI]."""
    return {name: float(p.value) for name, p in parameters_by_name(component).items()}


def number_text(value: Any) -> str:
    """A number to six digits. For an array its shape."""
    if isinstance(value, jax.core.Tracer) or not isinstance(value, jax.Array | np.ndarray | np.number | float | int):
        return str(value)
    return f"{float(value):.6g}" if np.ndim(value) == 0 else f"array{list(np.shape(value))}"


M = TypeVar("M", bound=eqx.Module)


def replace(component: M, values: dict[str, Any]) -> M:
    """Returns `component` with the named parameters replaced. Values may be tracers or batches.

    Replaced parameters of a rig count as known.

    Args:
        component: a robot or a part of one.
        values: dotted names, such as `motor.resistance`, and their values [SI].

    Returns:
        A component of the same kind.

    Raises:
        KeyError: a name is no parameter of `component`. The message suggests similar names.
    """
    names = [p.name for p in walk_parameters(component)]
    unknown = sorted(set(values) - set(names))
    if unknown:
        suggestions = [similar_words(name, names, 3) for name in unknown]
        hints = [f"{n} (did you mean {', '.join(m)}?)" if m else n for n, m in zip(unknown, suggestions, strict=True)]
        raise KeyError(f"no such parameter: {', '.join(hints)}")
    replaced = _replace_below(component, values, "")
    rig: Any = getattr(replaced, "rig", None)
    if rig is None or values.keys().isdisjoint(rig.unknown):
        return replaced
    rig = dataclasses.replace(rig, unknown=tuple(name for name in rig.unknown if name not in values))
    changes: dict[str, Any] = {"rig": rig}
    return dataclasses.replace(replaced, **changes)


def _replace_below(component: Any, values: dict[str, Any], prefix: str) -> Any:
    changes: dict[str, Any] = {}
    for field in dataclasses.fields(component):
        value = getattr(component, field.name)
        name = f"{prefix}{field.name}"
        if hasattr(value, "items"):
            changes[field.name] = type(value)(
                {k: _replace_below(m, values, f"{prefix}{k}.") for k, m in value.items()}
            )
            continue
        if not any(key == name or key.startswith(f"{name}.") for key in values):
            continue
        if "spec" in field.metadata:
            changes[field.name] = values[name]
        elif isinstance(value, tuple):
            changes[field.name] = tuple(_replace_below(m, values, f"{name}.{m.name}.") for m in value)
        else:
            changes[field.name] = _replace_below(value, values, f"{name}.")
    return dataclasses.replace(component, **changes) if changes else component


def split_numbers(numbers: Float[Array, " n"]) -> tuple[Array, ...]:
    """Splits an array into its numbers."""
    return tuple(x.reshape(()) for x in jax.lax.split(numbers, [1] * len(numbers))) if len(numbers) else ()


def without_weak_types(robot: M) -> M:
    """Returns `robot` without weakly typed numbers, which would make a function compile another program."""
    return jax.tree.map(lambda x: jnp.asarray(x, x.dtype) if isinstance(x, jax.Array) else x, robot)
