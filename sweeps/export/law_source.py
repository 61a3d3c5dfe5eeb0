"""Source text of a joint's law: one readable file that needs only JAX, or only PyTorch."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import ModuleType
from typing import Any

import jinja2
import numpy as np

from calibration.data import posterior_file
from calibration.data.input_errors import BadConfiguration
from calibration.data.posterior_file import Posterior
from mmrjax import __version__
from mmrjax.errors import printable
from mmrjax.model import quantities
from mmrjax.model.balances import TORQUE_STEPS
from mmrjax.model.params import Parameter
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


def posterior_next_to(joint: DriveJoint) -> Posterior | None:
    """Posterior next to the robot's file. None if there is no such file.

    Raises:
        BadData: it cannot be read, or belongs to another robot.
    """
    source = Path(joint.file.source)
    path = source.with_name(posterior_file.FILE)
    if source.suffix != ".toml" or not path.is_file():
        return None
    posterior = posterior_file.read_posterior(path)
    posterior.check(joint.file.robot, str(path))
    return posterior


def law_constants(joint: DriveJoint, signals: Signals, posterior: Posterior | None) -> tuple[LawConstant, ...]:
    """Numbers of the law: parameters of the robot, and means of the joint's surroundings over the runs.

    Args:
        signals: signals of the runs.
    """
    ends, constants = {}, []
    if posterior is not None:
        quantiles = np.quantile(posterior.draw(DRAWS, 0), ENDS, axis=0)
        ends = {n: (float(a), float(b)) for n, a, b in zip(posterior.names, *quantiles, strict=True)}
    for name, parameter in joint.parameters().items():
        low, high, kind = _interval_of(joint, name, parameter, ends, posterior is not None)
        spec = parameter.spec
        source = f"fitted; prior: {spec.source}" if kind == OF_POSTERIOR else spec.source
        value = float(parameter.value)
        constants.append(LawConstant(name, value, spec.unit, spec.meaning, source, low, high, kind))
    for name in joint.surroundings():
        word = name.removeprefix("surroundings.")
        over_runs = np.asarray(getattr(signals, word), float)
        mean = float(np.nanmean(over_runs)) if np.isfinite(over_runs).any() else 0.0
        condition = quantities.CONDITIONS.get(word)
        unit = {"normal": "N", "mass": "kg", "slope": "rad", "payload": "kg"}.get(word, "SI")
        meaning = {"normal": "normal load of one side"}.get(
            word, condition.label if condition else word.replace("_", " ")
        )
        constants.append(LawConstant(name, mean, unit, meaning, "mean over the compared runs"))
    if joint.controller is not None:
        volts = joint.controller.supply_voltage
        constants.append(LawConstant(SUPPLY, volts, "V", "supply of the driver", "given by the user of the actuator"))
    return tuple(constants)


def _interval_of(
    joint: DriveJoint, name: str, parameter: Parameter, ends: dict[str, tuple[float, float]], fitted: bool
) -> tuple[float | None, float | None, str]:
    if name in ends:
        return *ends[name], OF_POSTERIOR
    priors = {n: (mean, sd) for n, mean, sd in joint.file.robot.rig.priors}
    value = float(parameter.value)
    sd = priors[name][1] if name in priors else parameter.spec.prior_sd(value)
    if not sd:
        return None, None, ""
    kind = "from the prior (± two sds): not fitted" if fitted else OF_PRIOR
    low, high = parameter.spec.bounds
    return max(value - 2 * sd, low), min(value + 2 * sd, high), kind


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


@dataclasses.dataclass(frozen=True)
class _ArrayLibrary:
    """Names that differ between array libraries."""

    dialect: Dialect
    imports: str
    positive: Callable[[str], str]
    clipped: Callable[[str, str], str]


_JAX = _ArrayLibrary(
    JAX, "import jax.numpy as jnp", lambda x: f"jnp.maximum({x}, 0.0)", lambda x, b: f"jnp.clip({x}, -{b}, {b})"
)
_TORCH = _ArrayLibrary(
    TORCH, "import torch", lambda x: f"torch.clamp({x}, min=0.0)", lambda x, b: f"torch.clamp({x}, -{b}, {b})"
)


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


def step_lines(joint: DriveJoint, library: _ArrayLibrary) -> list[str]:
    """Lines of one step of the law, from `state`, `command`, `joint_position`, `joint_velocity` and `dt`."""
    circuit = joint.of("supply") + joint.of("electrical")
    gear, track = joint.of("gearbox"), joint.of("track")
    later = {p.name: f'memory["{p.name}"]' for p in joint.remembering}
    inertia = _inertia_lines(joint) if joint.accelerates else []
    rigid = not joint.loose
    rotor, wheel = " - rotor" * (joint.accelerates and rigid), " - wheel" * joint.accelerates
    lines = [
        "p, angle, wheel_speed = params, joint_position, "
        + ('state["rotor_speed"]  # of the motor\'s side' if joint.loose else "joint_velocity"),
        *(["voltage = command"] if joint.controller is None else _controller_code(joint, library)),
        'motor_speed = p["gearbox.ratio"] * wheel_speed',
        f"way = {call_text(joint.of('way')[0])}",
        "# Current of the winding: L dI/dt = U - E - U_R - ..., one implicit Euler step, linear in the current.",
        'current = state["current"]',
        f"left = voltage - {call_text(joint.of('back')[0])} - ({_sum_text(circuit)})",
        f"slope = {library.positive(_sum_text(circuit, '_slope'))}",
        f"current = current + dt * left / ({_sum_text(joint.of('inductance'))} + dt * slope)",
    ]
    if joint.limit is not None:
        lines.append(
            f"current = {library.clipped('current', 'p[' + chr(34) + 'driver.current_limit' + chr(34) + ']')}"
        )
    lines.append('memory = {"current": current}')
    lines += [f'memory["{name}"] = {name}' for name in joint.controller_states]
    if joint.remembering:
        lines.append("# Memories: one implicit Euler step each.")
    lines += [
        f'memory["{p.name}"] = state["{p.name}"] + dt * {call_text(p, "_rate")} / (1.0 - dt * '
        f"{call_text(p, '_rate_slope')})"
        for p in joint.remembering
        if all(a not in ("load", "pull") for a in function_arguments(p.rate or p.value))
    ]
    lines += [
        f"lost = {_sum_text(circuit, '', later)}",
        "# Torques from the winding to the wheel.",
        f"made = {call_text(joint.of('torque')[0])}",
        *(() if joint.loose else inertia),
        f"at_shaft = made - ({_sum_text(joint.of('motor'), '', later)}){rotor}",
        f"load = at_shaft - {call_text(joint.of('idle')[0])}",
    ]
    if joint.loose:
        lines += [*_joint_torque_lines(joint, library, _sum_text(gear, "", later)), *inertia]
    else:
        lines.append(f'through = p["gearbox.ratio"] * {call_text(joint.of("efficiency")[0])} * load')
        lines += _fixed_point_lines("load", "through", gear, later)
    lines += [
        *_fixed_point_lines("pull", f"load{wheel}", track, later),
        'info = {"current": current, "voltage": voltage, "motor_speed": motor_speed, "power": voltage * current,',
        f'        "lost_winding": lost * current, "lost_motor": (made - at_shaft{rotor}) * motor_speed,',
        f'        "lost_gearbox": {"at_shaft * motor_speed - load * wheel_speed" if rigid else "lost_gearbox"},',
        f'        "lost_output": (load{wheel} - pull) * wheel_speed}}',
        f"return pull{' + wheel' * joint.accelerates}{f' + {ARMATURE} * acceleration' * bool(rotor)}, memory, info",
    ]
    return lines


_PENDING = 'state["pending"]'


def _controller_code(joint: DriveJoint, library: _ArrayLibrary) -> list[str]:
    """Lines of the controller: the voltage for a goal, and the states after the step."""
    imposed, controller, prefix = joint.robot.rig.imposed, joint.controller, library.dialect.prefix
    assert controller is not None
    shown = {"goal_angle": "angle", "goal_speed": "joint_velocity", "goal_current": 'state["current"]'}[imposed]
    last = (
        '- p["controller.kd"] * joint_velocity'
        if imposed == "goal_angle"
        else '+ p["controller.feed_forward"] * command'
    )
    limit = 'p["controller.limit"]'
    if rate := controller.rate:
        return [
            f"# Controller: acts every {1 / rate:g} s, in the nearest step, and holds its share of the supply.",
            f"error = command - {shown}",
            f'wanted = p["controller.kp"] * error + p["controller.ki"] * state["integral"] {last}',
            f"demanded = {library.clipped('wanted', limit)}",
            f'due, limited = state["clock"] < 0.5 * dt, ({prefix}.abs(demanded) >= {limit}) & (demanded * error > 0)',
            f'integral = state["integral"] + {prefix}.where(due & ~limited, error, 0.0 * error) / {rate!r}',
            f'duty = {prefix}.where(due, {_PENDING if controller.samples_late else "demanded"}, state["duty"])',
            *([f"pending = {prefix}.where(due, demanded, {_PENDING})"] if controller.samples_late else []),
            f'clock = {prefix}.where(due, state["clock"] + {1 / rate!r}, state["clock"]) - dt',
            f'voltage = p["{SUPPLY}"] * duty',
        ]
    return [
        "# Controller: share of the supply's voltage. At its limit, it integrates no error that drives it further.",
        f"error = command - {shown}",
        f'wanted = p["controller.kp"] * error + p["controller.ki"] * state["integral"] {last}',
        f"demanded = {library.clipped('wanted', limit)}",
        f'integral = state["integral"] + dt * {prefix}.where(({prefix}.abs(demanded) >= {limit}) & '
        f"(demanded * error > 0), 0.0 * error, error)",
        *(
            [
                'duty = state["duty"] + (demanded - state["duty"]) * dt / (p["controller.lag"] + dt)',
                f'voltage = p["{SUPPLY}"] * duty',
            ]
            if controller.lags
            else [f'voltage = p["{SUPPLY}"] * demanded']
        ),
    ]


def _joint_torque_lines(joint: DriveJoint, library: _ArrayLibrary, lost: str) -> list[str]:
    """Lines of the torque between motor and load (`Shaft.torque_joint`), one implicit Euler step of the motor's side.

    Args:
        lost: text of the losses by gearbox effects.
    """
    value = lambda name: f"p[{quoted(f'{joint.configuration}.{name}')}]"  # noqa: E731
    if joint.load.stiffness > 0:
        elastic = [f"stiffness, damping = {value('stiffness')}, {value('damping')}"]
    else:
        elastic = [
            f"reduced = inertia * {value('inertia')} / (inertia + {value('inertia')})",
            f"stiffness, damping = {FLANK_STIFFNESS!r} * reduced, {FLANK_DAMPING!r} * reduced  # of flanks",
        ]
    lines = [
        "# Motor and load are two bodies: the torque that flanks or an elastic joint carry between them.",
        f"inertia = {TURNING}",
        *elastic,
        "closing = wheel_speed - joint_velocity",
        'gap = state["gap"] + dt * closing  # which opened or closed it within the last step',
        "later = gap + dt * closing",
    ]
    carried = (
        "stiffness * beyond + damping * closing"
        if joint.load.backlash > 0
        else "stiffness * later + damping * closing"
    )
    if joint.load.backlash > 0:
        prefix = library.dialect.prefix
        lines += [
            f"half = 0.5 * {value('backlash')}",
            f"beyond = later - {library.clipped('later', 'half')}",
            # As in the model, damping starts over a tenth of the backlash, and flanks never pull.
            f"share = {library.clipped(f'{prefix}.abs(beyond) / (0.2 * half + 1e-4)', '1.0')}",
            f"stiffness, damping = {prefix}.where(beyond != 0, stiffness, 0.0 * stiffness), share * damping",
        ]
        carried = f"{prefix}.where(beyond > 0, {library.positive(carried)}, -{library.positive(f'-({carried})')})"
    ratio, idle = 'p["gearbox.ratio"]', call_text(joint.of("idle")[0])
    return [
        *lines,
        f"drive = {ratio} * load",
        f"load = {carried}",
        f"passed = {call_text(joint.of('efficiency')[0])}",
        f"lost_gear = {lost}",
        f"lost_gearbox = ({ratio} * {idle} + (1.0 / passed - 1.0) * load + lost_gear) * wheel_speed",
        "give = (dt * stiffness + damping) / passed",
        "turning = dt * (drive - load / passed - lost_gear) / (inertia + dt * give)",
        "load = load + passed * give * turning",
        'memory["gap"], memory["rotor_speed"] = gap, wheel_speed + turning',
        "wheel_speed = joint_velocity",
        f"way = {call_text(joint.of('way')[0])}",
    ]


def _inertia_lines(joint: DriveJoint) -> list[str]:
    """Lines for the torques that accelerate rotor and wheel. The joint contains their inertia, but losses by torque
    do not.

    As in the model, the gearbox transmits the torque that remains after the rotor. Its sign is the direction of
    power.
    """
    wheel = [f"p[{quoted(f'{joint.configuration}.inertia')}]", *map(call_text, joint.of("inertia"))]
    return [
        "# Torques that accelerate rotor and wheel, by the acceleration of the last step.",
        'acceleration = (wheel_speed - state["speed"]) / dt',
        'memory["speed"] = wheel_speed',
        *(() if joint.loose else ['rotor = p["motor.inertia"] * p["gearbox.ratio"] * acceleration']),
        f"wheel = ({' + '.join(wheel)}) * acceleration",
    ]


#: Inertia of the rotor at the output: J i² η or J i² / η, depending on the direction of power. With their mean as the
#: joint's armature, the remaining torque lags by a step and is stable at any load.
TURNING = 'p["motor.inertia"] * p["gearbox.ratio"] ** 2'
ARMATURE = f'{TURNING} * 0.5 * (p["gearbox.efficiency_load"] + 1.0 / p["gearbox.efficiency_load"])'


def _fixed_point_lines(name: str, given: str, parts: Sequence[Part], later: Mapping[str, str]) -> list[str]:
    """Lines that find x with x + losses(x) = given."""
    if not any(p.by for p in parts):
        return [f"{name} = {given} - ({_sum_text(parts, '', later)})" if parts else f"{name} = {given}"]
    residual_text = f"({name} + {_sum_text(parts, '', later)} - ({given}))"
    return [
        f"{name} = {given}",
        f"for _ in range({TORQUE_STEPS}):  # a loss that depends on the torque itself",
        f"    {name} = {name} - {residual_text} / (1.0 + {_sum_text(parts, '_slope', later)})",
    ]


def constants_text(constants: Sequence[LawConstant]) -> str:
    """Text of the table of the law's numbers, each with its unit, meaning, interval and source."""
    lines = ["PARAMS = {"]
    for c in constants:
        comment = f"{c.meaning} [{c.unit}]{f'; {c.interval}' * bool(c.interval)}; {c.source}"
        lines += [f"    # {text}" for text in textwrap.wrap(printable(comment), 106)]
        lines.append(f"    {quoted(c.name)}: {c.value!r},")
    return "\n".join([*lines, "}"])


_DOCUMENT = '''"""One step of the drive: torque at the joint, state after the step, and what happens inside.

    Args:
        params: `PARAMS`, or with other numbers; each may be an array of the joint's shape.
        state: from `initial_state` or the step before.
        command: {command}.
        joint_position: [rad]; joint_velocity: [rad/s], of the wheel or output shaft.
        dt: length of the step [s].

    Returns:
        Torque that acts on the joint [N·m], friction included; the state; a dictionary with current [A], voltage [V],
        motor_speed [rad/s], power taken [W] and power lost in winding, motor, gearbox and at the output [W]. Without
        its armature: give the joint `armature(params)`.
    """'''


def jax_source(joint: DriveJoint, constants: Sequence[LawConstant], notes: Sequence[str] = ()) -> str:
    """Source of the law in JAX."""
    return _module_text(joint, constants, _JAX, notes)


def torch_source(
    joint: DriveJoint, constants: Sequence[LawConstant], notes: Sequence[str] = (), imports: str = _TORCH.imports
) -> str:
    """Source of the law in PyTorch."""
    return _module_text(joint, constants, dataclasses.replace(_TORCH, imports=imports), notes)


def _module_text(
    joint: DriveJoint, constants: Sequence[LawConstant], library: _ArrayLibrary, notes: Sequence[str]
) -> str:
    states = ", ".join(f'"{n}": zero' for n in joint.states)
    moving = (
        "" if not joint.accelerates else ", and the joint's speed one step before [rad/s]: set it if the joint moves"
    )
    if joint.loose:
        moving = (
            ", gap between motor and load [rad] and speed of the motor's side [rad/s]: set this if the joint moves"
        )
    goals = {"goal_angle": "angle [rad]", "goal_speed": "speed [rad/s]", "goal_current": "current [A]"}
    goal = goals.get(joint.robot.rig.imposed)
    volts = "voltage at the driver's output [V]: its duty times the voltage of the supply"
    document = _DOCUMENT.replace("{command}", f"goal of the controller: {goal}" if goal else volts)
    rotor = '0.0 * p["motor.inertia"]' if joint.loose else ARMATURE
    armature_words = (
        "The motor turns apart" if joint.loose else "Inertia of the rotor at the joint, J i² (η + 1/η) / 2"
    )
    added = "".join(f" + {call_text(p)}" for p in joint.of("inertia"))
    body = textwrap.indent("\n".join(step_lines(joint, library)), "    ")
    zero = "jnp.zeros(shape)" if library.dialect is JAX else "torch.zeros(shape, device=device)"
    shape_arguments = "shape=()" if library.dialect is JAX else "shape=(), device=None"
    title = f"Actuator of {joint.file.name}, {joint.configuration}. Written by mmrjax {__version__}."
    wrapped_notes = "\n\n".join("\n".join(textwrap.wrap(n, 108)) for n in notes)
    header = _docstring(f"{title}\n\n{wrapped_notes}\n")
    return (
        f"{header}\n\n{library.imports}\n\n{constants_text(constants)}\n\n\n"
        f"{functions_text(joint, library.dialect)}\n\n\n"
        f"def armature(params):\n"
        f'    """{armature_words}, for the joint\'s own armature [kg·m²]."""\n'
        f"    p = params\n"
        f"    return {rotor}{added}\n\n\n"
        f"def initial_state({shape_arguments}):\n"
        f'    """State at rest: current [A], memories of effects{moving}."""\n'
        f"    zero = {zero}\n"
        f"    return {{{states}}}\n\n\n"
        f"def actuator(params, state, command, joint_position, joint_velocity, dt):\n"
        f"    {document}\n{body}\n"
    )


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
