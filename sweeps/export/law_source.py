"""Source text of a joint's law: one readable file that needs only JAX, or only PyTorch."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import re
import textwrap
from collections.abc import Mapping, Sequence
from importlib import resources
from types import ModuleType
from typing import Any

import jinja2
import numpy as np

from calibration.data.input_errors import BadConfiguration
from calibration.data.posterior_file import Posterior
from mmrjax import __version__
from mmrjax.errors import printable
from mmrjax.model import quantities
from mmrjax.model.balances import TORQUE_STEPS
from mmrjax.model.shaft import FLANK_DAMPING, FLANK_STIFFNESS
from mmrjax.model.signals import Signals
from sweeps.export.expressions import JAX, TORCH, Dialect, Symbol, lines_of, names_in
from sweeps.export.joint import VARIABLES, DriveJoint, Part


def filled_template(file: str, /, **values: Any) -> str:
    """File of the folder `templates` with values filled in."""
    text = (resources.files("sweeps.export") / "templates" / file).read_text("utf-8")
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    return environment.from_string(text).render(**values)


#: Draws from the posterior for intervals, and quantiles of their ends.
DRAWS, ENDS = 4000, (0.025, 0.975)
OF_POSTERIOR, OF_PRIOR = "95 % interval", "from the prior (± two sds): no posterior available"


def law_constants(joint: DriveJoint, signals: Signals, posterior: Posterior | None) -> tuple[LawConstant, ...]:
    """Numbers of the law: parameters of the robot, and means of the joint's surroundings over the runs.

    Args:
        signals: signals of the runs.
    """
    ends, constants = {}, []
    if posterior is not None:
        quantiles = np.quantile(posterior.draw(DRAWS, 0), ENDS, axis=0)
        ends = {n: (float(a), float(b)) for n, a, b in zip(posterior.names, *quantiles, strict=True)}
    priors = {n: (mean, sd) for n, mean, sd in joint.file.robot.rig.priors}
    for name, parameter in joint.parameters().items():
        spec, value = parameter.spec, float(parameter.value)
        interval: tuple[float | None, float | None, str] = (None, None, "")
        sd = priors[name][1] if name in priors else spec.prior_sd(value)
        if name in ends:
            interval = *ends[name], OF_POSTERIOR
        elif sd:
            kind = OF_PRIOR if posterior is None else "from the prior (± two sds): not fitted"
            interval = max(value - 2 * sd, spec.bounds[0]), min(value + 2 * sd, spec.bounds[1]), kind
        source = f"fitted; prior: {spec.source}" if name in ends else spec.source
        constants.append(LawConstant(name, value, spec.unit, spec.meaning, source, *interval))
    for name in joint.surroundings():
        word = name.removeprefix("surroundings.")
        over_runs = np.asarray(getattr(signals, word), float)
        mean = float(np.nanmean(over_runs)) if np.isfinite(over_runs).any() else 0.0
        unit = {"normal": "N", "mass": "kg", "slope": "rad", "payload": "kg"}.get(word, "SI")
        meaning = word.replace("_", " ")
        if word == "normal":
            meaning = "normal load of one side"
        elif word in quantities.CONDITIONS:
            meaning = quantities.CONDITIONS[word].label
        constants.append(LawConstant(name, mean, unit, meaning, "mean over the compared runs"))
    if joint.controller is not None:
        volts = joint.controller.supply_voltage
        constants.append(LawConstant(SUPPLY, volts, "V", "supply of the driver", "given by the user of the actuator"))
    return tuple(constants)


#: Name of the constant with a controller's supply voltage.
SUPPLY = "controller.supply_voltage"
_ARGUMENTS = (*VARIABLES, "load", "pull")


@dataclasses.dataclass(frozen=True)
class LawConstant:
    """A number of the law.

    Attributes:
        name: dotted name.
        value: value [SI].
        unit, meaning, source: description in words.
        low, high: limits of its interval. None: not known.
        kind: kind of interval, in words.
    """

    name: str
    value: float
    unit: str
    meaning: str
    source: str
    low: float | None = None
    high: float | None = None
    kind: str = ""

    @property
    def interval(self) -> str:
        """Interval in words, empty if unknown."""
        return "" if self.low is None else f"{self.low:.4g} to {self.high:.4g} ({self.kind})"


def function_arguments(symbol: Symbol) -> list[str]:
    """Arguments of the function of an expression, in addition to its parameters."""
    symbol_names = names_in(symbol)
    used_arguments = [n for n in _ARGUMENTS if n in symbol_names]
    return [*used_arguments, "memory"] if any(n.startswith("memory.") for n in symbol_names) else used_arguments


def quoted(word: str) -> str:
    """Word as a Python literal."""
    return f'"{word}"' if re.fullmatch(r"[\w.-]+", word) else repr(word)


def _docstring(text: str) -> str:
    """Text as a docstring, escaped because names come from users and could end the literal."""
    return '"""' + printable(text).replace("\\", "\\\\").replace('"', '\\"') + '"""'


def _function_text(name: str, symbol: Symbol, document: str, dialect: Dialect) -> str:
    def spelled(word: str) -> str:
        if word in _ARGUMENTS:
            return word
        return "memory" if word.startswith("memory.") else f"p[{quoted(word)}]"

    head = f"def {name}({', '.join(['p', *function_arguments(symbol)])}):"
    lines = textwrap.wrap(document, 108)
    short = len(lines) == 1 and len(document) < 104
    body = textwrap.indent(_docstring(document if short else "\n".join(lines) + "\n"), "    ")
    return "\n".join([head, body, *lines_of(symbol, dialect, spelled)])


def call_text(part: Part, suffix: str = "", memory: str | None = None) -> str:
    """Text of the call of a part's function."""
    symbol = {"": part.value, "_slope": part.slope, "_rate": part.rate, "_rate_slope": part.rate_slope}[suffix]
    assert symbol is not None
    arguments = ["p", *(("state" + f'["{part.name}"]' if memory is None else memory) if a == "memory" else a
                    for a in function_arguments(symbol))]  # fmt: skip
    return f"{part.name}{suffix}({', '.join(arguments)})"


def _sum_text(parts: Sequence[Part], suffix: str = "", memory: Mapping[str, str] | None = None) -> str:
    memory = memory or {}
    terms = [call_text(p, suffix, memory.get(p.name)) for p in parts if suffix != "_slope" or p.by]
    return " + ".join(terms) or "0.0"


def functions_text(joint: DriveJoint, dialect: Dialect) -> str:
    """Text of the functions of all parts, with their derivatives and rates."""
    texts = []
    for part in joint.parts:
        unit = "" if part.unit == "-" else f" [{part.unit}]"
        meaning = part.meaning if part.meaning.endswith(".") else f"{part.meaning}." if part.meaning else ""
        document = f"{part.equation.rstrip('.')}{unit}. {meaning}".strip()
        texts.append(_function_text(part.name, part.value, document, dialect))
        if part.by:
            docstring = f"Derivative of `{part.name}` with respect to `{part.by}`."
            texts.append(_function_text(f"{part.name}_slope", part.slope, docstring, dialect))
        if part.rate is not None:
            texts.append(
                _function_text(f"{part.name}_rate", part.rate, f"Rate of the memory of `{part.name}`.", dialect)
            )
            docstring = f"Derivative of `{part.name}_rate` with respect to the memory of `{part.name}`."
            texts.append(_function_text(f"{part.name}_rate_slope", part.rate_slope, docstring, dialect))
    return "\n\n\n".join(texts)


#: Inertia of the rotor at the output: J i² η or J i² / η, depending on the direction of power. With their mean as the
#: joint's armature, the remaining torque lags by a step and is stable at any load.
ARMATURE = (
    'p["motor.inertia"] * p["gearbox.ratio"] ** 2 * 0.5 * '
    '(p["gearbox.efficiency_load"] + 1.0 / p["gearbox.efficiency_load"])'
)


def constants_text(constants: Sequence[LawConstant]) -> str:
    """Text of the table of the law's numbers, each with its unit, meaning, interval and source."""
    lines = ["PARAMS = {"]
    for c in constants:
        comment = f"{c.meaning} [{c.unit}]{f'; {c.interval}' * bool(c.interval)}; {c.source}"
        lines += [f"    # {text}" for text in textwrap.wrap(printable(comment), 106)]
        lines.append(f"    {quoted(c.name)}: {c.value!r},")
    return "\n".join([*lines, "}"])


def jax_source(joint: DriveJoint, constants: Sequence[LawConstant], notes: Sequence[str] = ()) -> str:
    """Source of the law in JAX."""
    return _module_text(joint, constants, JAX, notes, "import jax.numpy as jnp")


def torch_source(
    joint: DriveJoint, constants: Sequence[LawConstant], notes: Sequence[str] = (), imports: str = "import torch"
) -> str:
    """Source of the law in PyTorch."""
    return _module_text(joint, constants, TORCH, notes, imports)


def _module_text(
    joint: DriveJoint, constants: Sequence[LawConstant], dialect: Dialect, notes: Sequence[str], imports: str
) -> str:
    """The template `actuator.txt` with the parts of a joint's law."""
    goals = {"goal_angle": "angle [rad]", "goal_speed": "speed [rad/s]", "goal_current": "current [A]"}
    title = f"Actuator of {joint.file.name}, {joint.configuration}. Written by mmrjax {__version__}."
    wrapped_notes = "\n\n".join("\n".join(textwrap.wrap(n, 108)) for n in notes)
    early = [p for p in joint.remembering if not {"load", "pull"} & {*function_arguments(p.rate or p.value)}]
    return filled_template(
        "actuator.txt", joint=joint, jax=dialect is JAX, header=_docstring(f"{title}\n\n{wrapped_notes}\n"),
        imports=imports, constants=constants_text(constants), functions=functions_text(joint, dialect),
        controller=joint.controller, imposed=joint.robot.rig.imposed, goal=goals.get(joint.robot.rig.imposed),
        call=call_text, total=_sum_text, own=lambda name: f"p[{quoted(f'{joint.configuration}.{name}')}]",
        later={p.name: f'memory["{p.name}"]' for p in joint.remembering}, remembering_early=early,
        armature=ARMATURE, torque_steps=TORQUE_STEPS, flank_stiffness=FLANK_STIFFNESS, flank_damping=FLANK_DAMPING,
    )  # fmt: skip


def module_from_source(source: str) -> ModuleType:
    """Module of the source of a law.

    Raises:
        BadConfiguration: the source has more than an import, literals, and functions that call each other and the
            library.
    """
    tree = ast.parse(source)
    if not _states_a_law(tree):
        raise BadConfiguration("export: the generated source contains more than the drive law, so it is not executed")
    module = ModuleType("exported_law")
    exec(compile(tree, "<exported_law>", "exec"), module.__dict__)
    return module


def _states_a_law(tree: ast.Module) -> bool:
    """True if a source only imports one library, assigns literals, and defines functions that call nothing else."""
    defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)} | {"range"}
    for node in tree.body:
        if isinstance(node, ast.Assign):
            with contextlib.suppress(ValueError):
                ast.literal_eval(node.value)
                continue
            return False
        literal = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if not literal and not isinstance(node, ast.Import | ast.FunctionDef):
            return False
    called = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    imported = [name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names]
    return imported in (["jax.numpy"], ["numpy"], ["torch"]) and all(
        f.id in defined
        if isinstance(f, ast.Name)
        else isinstance(f, ast.Attribute) and isinstance(f.value, ast.Name) and f.value.id in ("jnp", "torch")
        for f in called
    )


# --- an actuator of mjlab -------------------------------------------------------------------------


_IMPORTS = """from dataclasses import dataclass, field

import torch
from mjlab.actuator.actuator import Actuator, ActuatorCfg"""


def mjlab_files(joint: DriveJoint, constants: Sequence[LawConstant], notes: Sequence[str]) -> dict[str, str | bytes]:
    """The source of the law in PyTorch with the classes of mjlab."""
    source = torch_source(joint, constants, notes, imports=_IMPORTS)
    return {"mjlab_actuator.py": f"{source}\n\n\n{filled_template('mjlab_actuator.txt')}"}
