"""A drive's step as an ONNX model in single precision."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data.input_errors import BadConfiguration
from sweeps.export.joint import DriveJoint
from sweeps.export.law_source import LawConstant, jax_source, module_from_source

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


def difference_from_jax(joint: DriveJoint, constants: Sequence[LawConstant], model: bytes) -> float:
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
