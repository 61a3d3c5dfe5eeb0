"""A drive as an actuator in JAX or ONNX: readable source, serialised programs, and its law in steady travel."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Json, Names
from calibration.data.input_errors import BadConfiguration
from mmrjax.numerics.elementary import value_and_slope
from sweeps.export.comparison import HELD, ComparisonRuns, EffectFate
from sweeps.export.joint import DriveJoint
from sweeps.export.law_source import LawConstant, jax_source, module_from_source
from sweeps.export.mujoco import CONTROLLER, GROUND, LIMIT, PLAY, ROTOR, fates_outside_joint

#: Steps to the steady state, and their length [s]. An implicit step of this length is a step of Newton's method.
SETTLING, LONG = 10, 1e9
#: Newton steps for the speed at a load.
STEPS = 25
#: Name of a base term.
SURROUNDINGS = "friction from the joint's surroundings"
#: Platforms for which the serialised program is lowered.
PLATFORMS = ("cpu", "cuda")
#: Setting of JAX: frames of the call stack that a lowered program keeps for each operation.
PLACES = "jax_traceback_in_locations_limit"


class ActuatorLaw(eqx.Module):
    """The generated actuator in steady travel, without a refit. Its attributes are those of `comparison.FormatLaw`.

    params: parameters of the actuator, of shape (runs,) if they differ.
    guess: speed of the joint near the solution [rad/s].
    """

    module: ModuleType = eqx.field(static=True)
    params: dict[str, jax.Array]
    guess: jax.Array
    names: Names = eqx.field(static=True, default=())
    start: jax.Array = eqx.field(default_factory=lambda: jnp.zeros(0))

    def __call__(self, theta: Any, command: Any, load: Any, way: Any) -> tuple[Any, Any]:
        def torque(speed: Any) -> Any:
            return settled_actuator(self.module, self.params, command, speed)[0] - load

        def nearer(speed: Any, _: None) -> tuple[Any, None]:
            residual, rise = value_and_slope(torque, speed)
            stride = jnp.where(rise != 0, -residual / jnp.where(rise != 0, rise, 1.0), 0.0)
            # Never across rest, where friction changes its sign.
            return jnp.where(way * (speed + stride) > 0, speed + stride, 0.5 * speed), None

        speed = jax.lax.scan(nearer, self.guess, None, STEPS)[0]
        return settled_actuator(self.module, self.params, command, speed)[1]["current"], speed


def settled_actuator(module: ModuleType, params: Json, command: Any, speed: Any) -> tuple[Any, Json]:
    """Torque [N·m] and internal quantities of an actuator at a constant voltage [V] and joint speed [rad/s]."""
    state = module.initial_state(jnp.shape(speed))

    def again(state: Any, _: None) -> tuple[Any, None]:
        return module.actuator(params, state, command, jnp.zeros_like(speed), speed, LONG)[1], None

    state = jax.lax.scan(again, state, None, SETTLING)[0]
    torque, _, info = module.actuator(params, state, command, jnp.zeros_like(speed), speed, LONG)
    return torque, info


def steady_params(joint: DriveJoint, constants: Sequence[LawConstant], amplitudes: Mapping[str, float]) -> Json:
    """Parameters of the actuator in steady travel, without terms that repeat with an angle, whose mean is 0."""
    params = {c.name: c.value for c in constants}
    # The memory of a wave is its phase, which grows without limit.
    waves = {
        p.name: 0.0 for p in joint.parts if p.rate is not None and p.rate_slope.is_const and not p.rate_slope.value
    }
    for name, value in {**amplitudes, **waves}.items():
        if f"effects.{name}.amplitude" in params:
            params[f"effects.{name}.amplitude"] = value
    return params


def actuator_law_function(situation: ComparisonRuns, constants: Sequence[LawConstant]) -> Any:
    """Function of a joint and amplitudes that returns the law of its actuator in these runs."""
    module = module_from_source(jax_source(situation.joint, constants))

    def law(joint: DriveJoint, amplitudes: Mapping[str, float]) -> ActuatorLaw:
        params = steady_params(joint, constants, amplitudes)
        for name in joint.surroundings():
            value = np.asarray(getattr(situation.signals, name.removeprefix("surroundings.")), float)
            params[name] = np.where(np.isfinite(value), value, params[name])
        arrays = {n: jnp.asarray(v, float) for n, v in params.items()}
        return ActuatorLaw(module, arrays, jnp.asarray(situation.inside.speed))

    return law


def fates_in_actuator(joint: DriveJoint) -> list[EffectFate]:
    """Fates of the base's terms, and of effects outside the joint."""
    robot = joint.robot
    fates = [
        EffectFate("motor, winding and gearbox", HELD, "functions of the law"),
        EffectFate(ROTOR, HELD, "`armature(params)`, to be set as the joint's own armature"),
    ]
    if joint.surroundings():
        names = ", ".join(joint.surroundings())
        fates.append(EffectFate(SURROUNDINGS, HELD, f"parameters {names}, free to change"))
    if robot.has_ground:
        fates.append(GROUND)
    if joint.loose:
        fates.append(EffectFate(PLAY, HELD, "states of the law: gap, and speed of the motor's side"))
    if joint.controller is not None:
        fates.append(EffectFate(CONTROLLER, HELD, "functions of the law. The command is its goal"))
    if joint.limit is not None:
        fates.append(EffectFate(LIMIT, HELD, "a bound of the current"))
    return [*fates, *fates_outside_joint(joint)]


def jax_files(joint: DriveJoint, constants: Sequence[LawConstant], notes: Sequence[str]) -> dict[str, str | bytes]:
    """The actuator's source, and its program serialised by `jax.export`."""
    source = jax_source(joint, constants, notes)
    return {"actuator.py": source, "actuator.jaxexport": serialise_actuator(module_from_source(source))}


def serialise_actuator(module: ModuleType) -> bytes:
    """The actuator in single precision, of any number of joints, with first derivatives.

    `jax.export.deserialize(bytes).call(params, state, command, joint_position, joint_velocity, dt)`.
    """
    from jax import export

    with jax.enable_x64(False), _without_source_paths():
        (many,) = export.symbolic_shape("n")
        single, batch_shape = jax.ShapeDtypeStruct((), jnp.float32), jax.ShapeDtypeStruct((many,), jnp.float32)
        params = dict.fromkeys(module.PARAMS, single)
        state = dict.fromkeys(module.initial_state(), batch_shape)
        exported = export.export(jax.jit(module.actuator), platforms=PLATFORMS)(
            params, state, batch_shape, batch_shape, batch_shape, single
        )
        return bytes(exported.serialize(vjp_order=1))


@contextlib.contextmanager
def _without_source_paths() -> Iterator[None]:
    """Context in which lowered programs have no paths of source files: equal programs have equal bytes."""
    previous_setting = getattr(jax.config, PLACES)
    jax.config.update(PLACES, 0)
    try:
        yield
    finally:
        jax.config.update(PLACES, previous_setting)


#: Version of the operators, supported by onnxruntime since 1.14.
OPSET = 18
#: Number of random states for the comparison with JAX, and their seed.
STATES, SEED = 10_000, 0
EXTRA = 'pip install "mmrjax[export]"'


def _import_library(name: str) -> Any:
    try:
        return __import__(name)
    except ImportError as error:
        raise BadConfiguration(f"--to onnx: {name} is not installed; {EXTRA}") from error


@contextlib.contextmanager
def _single_precision() -> Iterator[None]:
    """Context of single precision, without JAX's warnings about doubles that become single."""
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Explicitly requested dtype", UserWarning)
        yield


def step_function(joint: DriveJoint, constants: Sequence[LawConstant]) -> tuple[Any, list[str], list[str]]:
    """The step as a function of arrays, and the names of its inputs and outputs.

    Inputs are the state, the command, position and velocity of the joint, each of shape (joints,), and the time step,
    of shape (1,). Outputs are torque, state and power.
    """
    module = module_from_source(jax_source(joint, constants))
    states = joint.states

    def step(*given: Any) -> tuple[Any, ...]:
        state, inputs = dict(zip(states, given, strict=False)), given[len(states) :]
        command, position, velocity, dt = inputs
        params = {name: jnp.asarray(value, velocity.dtype) for name, value in module.PARAMS.items()}
        torque, after, info = module.actuator(params, state, command, position, velocity, dt)
        return (torque, *(after[s] for s in states), info["power"])

    inputs = [*states, "command", "joint_position", "joint_velocity", "dt"]
    return step, inputs, ["torque", *(f"next_{s}" for s in states), "power"]


def onnx_files(joint: DriveJoint, constants: Sequence[LawConstant]) -> dict[str, str | bytes]:
    """The model as a file, checked by ONNX.

    Raises:
        BadConfiguration: the libraries are not installed.
    """
    jax2onnx, onnx = _import_library("jax2onnx"), _import_library("onnx")
    step, inputs, outputs = step_function(joint, constants)
    shapes: list[tuple[int | str, ...]] = [("joints",)] * (len(inputs) - 1) + [(1,)]
    with _single_precision():
        model = jax2onnx.to_onnx(
            step, shapes, model_name=joint.name, opset=OPSET, input_names=inputs, output_names=outputs
        )
    onnx.checker.check_model(model)
    return {"actuator.onnx": model.SerializeToString()}


def difference_from_jax(joint: DriveJoint, constants: Sequence[LawConstant], model: Any) -> float:
    """Largest difference of the model's outputs from JAX's over random states, relative to each output's rms."""
    runtime = _import_library("onnxruntime")
    step, inputs, _ = step_function(joint, constants)
    states = random_states(joint, len(inputs))
    with _single_precision():
        expected = [np.asarray(x) for x in jax.jit(step)(*states)]
    session = runtime.InferenceSession(model, providers=["CPUExecutionProvider"])
    outputs = session.run(None, dict(zip(inputs, states, strict=True)))
    sizes = [float(np.sqrt(np.mean(np.square(x)))) or 1.0 for x in expected]
    return max(float(np.max(np.abs(a - b))) / s for a, b, s in zip(outputs, expected, sizes, strict=True))


def random_states(joint: DriveJoint, inputs: int) -> list[np.ndarray]:
    """Random inputs of the step: currents, memories, voltages and speeds in both directions."""
    rng = np.random.default_rng(SEED)
    motor, ratio = joint.robot.motor, float(joint.robot.gearbox.ratio)
    volts = float(motor.voltage_limit or 24.0)
    fastest = volts / float(motor.torque_constant) / ratio
    scales = [2.0, *(1.0 for _ in joint.states[1:]), volts, 3.0, fastest]
    assert len(scales) == inputs - 1
    states = [(s * rng.uniform(-1, 1, STATES)).astype(np.float32) for s in scales]
    return [*states, np.full(1, 1e-3, np.float32)]
