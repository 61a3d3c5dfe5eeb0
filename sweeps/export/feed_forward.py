"""A drive as tables of voltage, current, losses and efficiency over speed and torque of the joint, in CSV and C."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Columns, Json, Names
from calibration.data.writing import table_text
from mmrjax import __version__
from mmrjax.errors import printable
from mmrjax.numerics.elementary import value_and_slope
from sweeps.export import jax_actuator, mujoco
from sweeps.export.comparison import APPROXIMATED, DROPPED, HELD, ComparisonRuns, EffectFate
from sweeps.export.joint import DriveJoint
from sweeps.export.law_source import LawConstant, filled_template, jax_source, module_from_source

#: Points of an axis on each side of rest. Ratio of the axes to the range of the runs.
POINTS, BEYOND = 20, 1.2
#: Newton steps for the voltage that gives a torque.
STEPS = 30
#: Columns of the table, with their units.
COLUMNS = {
    "voltage": "voltage_V", "current": "motor_current_A", "power": "power_W", "lost_winding": "lost_winding_W",
    "lost_motor": "lost_motor_W", "lost_gearbox": "lost_gearbox_W", "lost_output": "lost_output_W",
}  # fmt: skip


class SteadyMap(eqx.Module):
    """Steady states of a drive over a grid of speed and torque.

    Attributes:
        speed, torque: values of the axes [rad/s], [N·m].
        values: quantity → values, shape (speeds, torques).
    """

    speed: np.ndarray
    torque: np.ndarray
    values: Columns

    @property
    def efficiency(self) -> np.ndarray:
        """Output power over input power [-]. For a driven joint, the inverse."""
        out, input_power = np.outer(self.speed, self.torque), self.values["power"]
        share = np.where(
            out > 0,
            out / np.where(input_power > 0, input_power, np.inf),
            input_power / np.where(out < 0, out, -np.inf),
        )
        return np.clip(share, 0.0, 1.0)


def symmetric_axis(largest: float) -> np.ndarray:
    """Values from -`largest` to `largest`, with both neighbours of 0 close to it, because friction changes sign
    there."""
    half = np.linspace(0.0, largest, POINTS + 1)[1:]
    near = np.array([1e-3 * largest])
    return np.concatenate([-half[::-1], -near, [0.0], near, half])


class TableLaw(eqx.Module):
    """The tables, with linear interpolation between points. Attributes: as in `comparison.FormatLaw`."""

    speed: jax.Array
    torque: jax.Array
    voltage: jax.Array
    current: jax.Array
    names: Names = eqx.field(static=True, default=())
    start: jax.Array = eqx.field(default_factory=lambda: jnp.zeros(0))

    def __call__(self, theta: Any, command: Any, load: Any, way: Any) -> tuple[Any, Any]:
        # Voltage rises with speed at each torque: a bisection finds the speed.
        low = jnp.where(way > 0, 0.0, self.speed[0]) + 0 * command
        high = jnp.where(way > 0, self.speed[-1], 0.0) + 0 * command
        for _ in range(50):
            middle = 0.5 * (low + high)
            needs_more = self._read(self.voltage, middle, load) < command
            low, high = jnp.where(needs_more, middle, low), jnp.where(needs_more, high, middle)
        speed = 0.5 * (low + high)
        return self._read(self.current, speed, load), speed

    def _read(self, values: jax.Array, speed: Any, torque: Any) -> Any:
        places = [
            jnp.interp(x, axis, jnp.arange(len(axis))) for x, axis in ((speed, self.speed), (torque, self.torque))
        ]
        return jax.scipy.ndimage.map_coordinates(values, places, order=1, mode="nearest")


def map_of_drive(
    situation: ComparisonRuns, constants: Sequence[LawConstant], amplitudes: Mapping[str, float] | None = None
) -> SteadyMap:
    """Steady states of a drive, over the range of the runs and slightly beyond."""
    module = module_from_source(jax_source(situation.joint, constants))
    given = jax_actuator.steady_params(situation.joint, constants, amplitudes or {})
    speed = symmetric_axis(float(np.max(np.abs(situation.inside.speed))) * BEYOND)
    torque = symmetric_axis(max(float(np.max(np.abs(situation.load))), 1e-6) * BEYOND)
    speeds, torques = (jnp.asarray(x.ravel()) for x in np.meshgrid(speed, torque, indexing="ij"))

    @jax.jit
    def solved(params: Any) -> Json:
        def lacking(voltage: Any) -> Any:
            return jax_actuator.settled_actuator(module, params, voltage, speeds)[0] - torques

        def again(voltage: Any, _: None) -> tuple[Any, None]:
            residual, rise = value_and_slope(lacking, voltage)
            return voltage - residual / jnp.where(rise > 1e-12, rise, 1e-12), None

        turns = params["motor.torque_constant"] * params["gearbox.ratio"]
        start = turns * speeds + float(situation.joint.robot.motor.resistance) * torques / turns
        voltage = jax.lax.scan(again, start, None, STEPS)[0]
        return jax_actuator.settled_actuator(module, params, voltage, speeds)[1]

    solution = solved({name: jnp.asarray(value, float) for name, value in given.items()})
    values = {name: np.asarray(solution[name]).reshape(len(speed), len(torque)) for name in COLUMNS}
    return SteadyMap(speed, torque, values)


def table_law_function(situation: ComparisonRuns, constants: Sequence[LawConstant]) -> Any:
    """Function of a joint and amplitudes that returns the law of its tables."""

    def law(joint: DriveJoint, amplitudes: Mapping[str, float]) -> TableLaw:
        table = map_of_drive(situation, constants, amplitudes)
        voltage, current = (jnp.asarray(table.values[name]) for name in ("voltage", "current"))
        return TableLaw(jnp.asarray(table.speed), jnp.asarray(table.torque), voltage, current)

    return law


def fates_in_tables(joint: DriveJoint, constants: Sequence[LawConstant]) -> list[EffectFate]:
    """Fates of the base's terms, and of effects outside the joint."""
    fates = [f for f in jax_actuator.fates_in_actuator(joint) if f.name not in (mujoco.ROTOR, mujoco.LIMIT)]
    means = {c.name: c.value for c in constants}
    changed = []
    for fate in fates:
        if fate.name == jax_actuator.SURROUNDINGS:
            values = ", ".join(f"{n.removeprefix('surroundings.')} = {means[n]:.4g}" for n in joint.surroundings())
            changed.append(EffectFate(fate.name, APPROXIMATED, f"their mean over the runs: {values}"))
        elif fate.name == mujoco.PLAY:
            play, twist = float(joint.load.backlash), float(joint.load.twist(1.0))
            how = f"tables have no state, so {play:.3g} rad of play and {twist:.3g} rad/(N·m) of twist are ignored"
            changed.append(EffectFate(fate.name, DROPPED, how))
        elif fate.name == mujoco.CONTROLLER:
            changed.append(EffectFate(fate.name, DROPPED, "the tables give its voltage"))
        else:
            changed.append(
                EffectFate(fate.name, fate.verdict, fate.how.replace("functions of the law", "the tables"))
            )
    how = "add armature · acceleration to the torque"
    lines = EffectFate("steady states", HELD, "linear interpolation between points")
    return [*changed, EffectFate(mujoco.ROTOR, APPROXIMATED, how), lines]


def table_files(joint: DriveJoint, found: SteadyMap, notes: Sequence[str]) -> dict[str, str | bytes]:
    """The tables as CSV and as a C header that reads them."""
    grid = np.meshgrid(found.speed, found.torque, indexing="ij")
    columns = {"joint_speed_rad_s": grid[0].ravel(), "joint_torque_Nm": grid[1].ravel()}
    columns |= {column: found.values[name].ravel() for name, column in COLUMNS.items()}
    columns["efficiency"] = found.efficiency.ravel()
    return {"feed_forward.csv": table_text(columns), "feed_forward.h": c_header(joint, found, notes)}


def _c_array(values: np.ndarray) -> str:
    return ", ".join(f"{x:.7g}f" if "." in f"{x:.7g}" or "e" in f"{x:.7g}" else f"{x:.7g}.0f" for x in values)


def c_header(joint: DriveJoint, found: SteadyMap, notes: Sequence[str]) -> str:
    """Text of a C header: axes, tables, and a function that reads each of them."""
    tables = {"voltage": found.values["voltage"], "current": found.values["current"], "efficiency": found.efficiency}
    origin = f"Feed-forward of {joint.file.name}, {joint.configuration}. Written by mmrjax {__version__}."
    # Names come from users, so nothing in them can end the comment.
    words = (" ".join(printable(text).split()) for text in (origin, *notes))
    return filled_template(
        "feed_forward.h", name=joint.name, speed=_c_array(found.speed), speeds=len(found.speed),
        torque=_c_array(found.torque), torques=len(found.torque),
        comment=[text.replace("*/", "* /").replace("/*", "/ *") for text in words],
        tables={key: [_c_array(row) for row in values] for key, values in tables.items()},
    )  # fmt: skip
