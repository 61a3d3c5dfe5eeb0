"""Draws of a drive's posterior as parameters of the other formats, for domain randomization."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibration.data import Columns
from calibration.data.input_errors import BadConfiguration
from calibration.data.posterior_file import FILE, Posterior
from mmrjax.model import params
from sweeps.export import mujoco
from sweeps.export.joint import DriveJoint
from sweeps.export.law_source import LawConstant

#: Smallest and largest number of draws, typical numbers of environments in training.
MOST = 1_000_000


def draw_parameters(
    joint: DriveJoint,
    posterior: Posterior | None,
    constants: Sequence[LawConstant],
    refitted: Mapping[str, float],
    normal: float,
    draws: int,
    seed: int,
) -> Columns:
    """Draws by format and name, `mujoco/resistance` and `actuator/motor.resistance`, each of shape (draws,).

    All numbers of a draw belong together, with the correlation of the posterior. A parameter of MuJoCo is translated
    from the draw, and multiplied by the ratio of its refitted to its translated value at the posterior's centre.

    Raises:
        BadConfiguration: there is no posterior.
    """
    if posterior is None:
        raise BadConfiguration(
            f"--to randomization: no {FILE} next to {joint.file.source}; expected FOLDER/robot.toml of calibrate "
            "or loop"
        )
    values = posterior.draw(draws, seed)
    own_names = {p.name for p in params.walk_parameters(joint.robot)}
    columns = {name: values[:, k] for k, name in enumerate(posterior.names) if name in own_names}
    centre = mujoco.translate_law(joint, normal)
    factors = {
        n: refitted[n] / x if (x := float(v)) > 0 else 1.0 for n, v in zip(centre.names, centre.start, strict=True)
    }
    drawn_values: dict[str, list[float]] = {}
    for k in range(draws):
        robot = params.replace(joint.robot, {name: np.asarray(x[k]) for name, x in columns.items()})
        other = joint.with_robot(robot)
        law = mujoco.translate_law(other, normal)
        theta = {n: factors[n] * float(v) for n, v in zip(law.names, law.start, strict=True)}
        motor = mujoco.mjcf_motor(other, theta)
        numbers = {
            "gear": motor.ratio, "motorconst": theta[mujoco.CONSTANT], "resistance": theta[mujoco.RESISTANCE],
            "inductance": motor.inductance, "armature": motor.armature, "frictionloss": motor.friction,
            "damping": theta[mujoco.DAMPING], "current_over_act": theta[mujoco.SHARE],
        }  # fmt: skip
        for name, value in numbers.items():
            drawn_values.setdefault(f"mujoco/{name}", []).append(value)
    law_names = {c.name for c in constants}
    actuator = {f"actuator/{n}": x for n, x in columns.items() if n in law_names}
    return {name: np.asarray(x) for name, x in drawn_values.items()} | actuator


def randomization_files(found: Columns) -> dict[str, str | bytes]:
    """The draws as NumPy's archive."""
    stream = io.BytesIO()
    arrays: Any = dict(found)
    np.savez(stream, **arrays)
    return {"draws.npz": stream.getvalue()}
