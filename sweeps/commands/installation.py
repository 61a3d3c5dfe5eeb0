"""Checks of this installation: versions, devices, a run with a known answer, a writable folder."""

from __future__ import annotations

import importlib.metadata
import math
import platform
import tempfile
import time
from collections.abc import Callable

from sweeps import compilation_cache
from sweeps.console import report_stage
from sweeps.store import PACKAGES


def check_installation() -> int:
    """Prints one line for each check. Returns 0 if all pass, otherwise 1."""
    import jax

    checks: dict[str, Callable[[], str]] = {
        "Python": lambda: f"{platform.python_version()} on {platform.machine()}",
        "packages": lambda: ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("mmrjax", *PACKAGES)),
        "devices": lambda: ", ".join(map(str, jax.devices())),
        "compilation cache": compilation_cache.describe_cache,
        "a solved run": _check_run,
        "derivatives": _check_derivative,
        "writing here": _check_folder,
    }
    all_pass = True
    for k, (name, check) in enumerate(checks.items(), 1):
        try:
            with report_stage(k, len(checks), name):
                line = f"{name}: {check()}"
        except Exception as error:
            line = f"{name} FAILED: {type(error).__name__}: {error}"
            all_pass = False
        print(line)
    return 0 if all_pass else 1


def _check_run() -> str:
    """Checks a known answer: on level ground, a drive without losses turns at U / C_E and draws no current."""
    import jax.numpy as jnp

    from mmrjax.fidelities.steady import steady_batch
    from mmrjax.model import paper_robots, params
    from mmrjax.model.conditions import Conditions

    robot = paper_robots.nominal()
    loss_words = ("friction_", "loss_", "rolling", "guide_share")
    losses = [p.name for p in params.walk_parameters(robot) if any(word in p.name for word in loss_words)]
    lossless = params.replace(robot, dict.fromkeys(losses, jnp.asarray(0.0)))
    start = time.perf_counter()
    result = steady_batch(lossless, Conditions(voltage=jnp.array([24.0])))
    motor_speed = float(result.motor_speed[0])
    no_load_speed = 24.0 / float(robot.motor.torque_constant)
    if not math.isclose(motor_speed, no_load_speed, rel_tol=1e-9):
        raise ArithmeticError(f"no-load speed {motor_speed} rad/s; known {no_load_speed} rad/s")
    return f"no-load speed {motor_speed:.3f} rad/s = 24 V / C_E ({time.perf_counter() - start:.1f} s with compiling)"


def _check_derivative() -> str:
    import jax

    from mmrjax.fidelities.steady import steady
    from mmrjax.model import paper_robots, params
    from mmrjax.model.conditions import Conditions

    robot = paper_robots.nominal()
    run = Conditions()

    def current(friction: params.Scalar) -> jax.Array:
        return steady(params.replace(robot, {"motor.friction_coulomb": friction}), run).total_current

    x, h = robot.motor.friction_coulomb, 1e-6
    by_gradient, by_difference = float(jax.grad(current)(x)), float((current(x + h) - current(x - h)) / (2 * h))
    if not math.isclose(by_gradient, by_difference, rel_tol=1e-5):
        raise ArithmeticError(f"implicit {by_gradient}; central difference {by_difference}")
    return f"d(current)/d(motor friction) = {by_gradient:.4f} A/(N·m), as by central difference"


def _check_folder() -> str:
    with tempfile.NamedTemporaryFile(dir=".") as file:
        file.write(b"mmrjax")
    return "the working folder is writable"
