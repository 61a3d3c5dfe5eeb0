"""A drive that both can express, fitted by mmrjax and by the system-identification toolbox of MuJoCo.

python benchmarks/sysid.py            needs the toolbox's own requirements: pip install "mmrjax[bench]"

The tracked robot lifted off the ground, driven at two voltages from standstill: one shaft with the inertia of
rotor and pulley, viscous and dry losses, a motor whose torque decreases with speed. In mmrjax it is `drive` without
adhesion. In MuJoCo a hinge with armature, damping and frictionloss. The truth is the exact solution
ω = A/B (1 - exp(-B t / J)), with noise. Three parameters are fitted from starts that are wrong by a factor 1.5 to 2.
"""

from __future__ import annotations

import contextlib
import io
import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import measure  # noqa: E402
import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from mujoco import sysid  # noqa: E402

from calibration.inference import observers, priors, problem  # noqa: E402
from calibration.inference import optimizers as fit  # noqa: E402
from mmrjax.model import channels, paper_robots, params  # noqa: E402
from mmrjax.model.conditions import Conditions  # noqa: E402

VOLTAGES = (12.0, 24.0)
STEP, SAMPLES = 5e-4, 200  # [s]
NOISE = 0.01  # sd of the shaft's speed [rad/s], 0.05-0.1 % of its final value
NAMES = ("motor.inertia", "6T2A.track.loss_viscous", "6T2A.track.loss_coulomb")
OFF = (2.0, 0.5, 1.5)  # start over truth

MODEL = """
<mujoco>
  <compiler inertiafromgeom="false"/>
  <option timestep="{step}" integrator="RK4" gravity="0 0 0"><flag contact="disable"/></option>
  <worldbody>
    <body name="shaft">
      <inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/>
      <joint name="shaft" type="hinge" axis="0 1 0" armature="0.01" damping="1" frictionloss="1"/>
    </body>
  </worldbody>
  <actuator><motor name="torque" joint="shaft"/></actuator>
  <sensor><jointvel name="speed" joint="shaft"/></sensor>
</mujoco>
"""


def lifted() -> Any:
    """The nominal robot without load-proportional gearbox loss, with negligible inductance and no friction by weight.

    A hinge has none of these.
    """
    changes = {
        "gearbox.efficiency_load": 1.0, "motor.inductance": 1e-7, "6T2A.track.guide_share": 0.0,
        "6T2A.ground.rolling_resistance": 0.0,
    }  # fmt: skip
    return params.replace(paper_robots.nominal(), {k: jnp.asarray(v) for k, v in changes.items()})


def constants(robot: Any) -> dict[str, float]:
    """Known quantities of the shaft, at the pulley: all but the three parameters."""
    motor, gear = robot.motor, robot.gearbox
    ratio = float(gear.ratio)
    return {
        "ratio": ratio,
        "inertia": float(robot.configurations["6T2A"].inertia),
        "damping": ratio**2 * float(motor.torque_constant**2 / motor.resistance + motor.friction_viscous
                                    + gear.friction_viscous),
        "friction": ratio * float(motor.friction_coulomb + gear.friction_coulomb),
        "torque_per_volt": ratio * float(motor.torque_constant / motor.resistance),
    }  # fmt: skip


def exact(known: dict[str, float], theta: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Speed of the pulley [rad/s] at each voltage and time."""
    inertia = known["ratio"] ** 2 * theta[0] + known["inertia"]
    damping = known["damping"] + theta[1]
    left = known["torque_per_volt"] * np.asarray(VOLTAGES) - known["friction"] - theta[2]
    return left[:, None] / damping * -np.expm1(-damping / inertia * times)


def ours(robot: Any, start: np.ndarray, times: np.ndarray, ratio: float) -> Any:
    """A compiled fit, speeds (voltages, times) → Optimum, and the coordinates of its result."""
    coordinates = priors.parameter_coordinates(
        robot, NAMES, {n: (float(s), float(s)) for n, s in zip(NAMES, start, strict=True)}
    )
    count, samples = len(VOLTAGES), len(times)
    run, sample = np.repeat(np.arange(count), samples), np.tile(np.arange(1, samples + 1), count)
    clock = jnp.asarray(np.tile(np.r_[0.0, times], (count, 1)))
    rows_of = np.arange(count * samples).reshape(count, samples)
    observe = observers.Histories(
        Conditions(voltage=VOLTAGES, adhesion=0.0),
        *map(jnp.asarray, (clock, run, sample, rows_of, rows_of[:, [0, -1]])),
    )
    motor = channels.USUAL.index("motor_speed")
    only_speed = jnp.zeros(len(channels.usual_channels())).at[motor].set(1.0)
    rows = count * samples

    def fitted(speeds: Any) -> fit.Optimum:
        measured = jnp.zeros((rows, len(only_speed))).at[:, motor].set(ratio * speeds.ravel())
        data = problem.Data(
            measured, jnp.full(measured.shape, ratio * NOISE), jnp.tile(only_speed, (rows, 1)), jnp.zeros(len(NAMES)),
            jnp.asarray(problem.STIFFNESS),
        )  # fmt: skip
        posed = problem.Problem(robot, coordinates, observe, data)
        return fit.levenberg_marquardt(posed, jnp.zeros(len(NAMES)))[0]

    return eqx.filter_jit(fitted), coordinates


def toolbox(known: dict[str, float], start: np.ndarray, times: np.ndarray) -> Any:
    """A fit by the toolbox: speeds (voltages, times), optimizer → parameters."""
    spec = mujoco.MjSpec.from_string(MODEL.format(step=STEP, inertia=known["inertia"]))
    shaft = {"armature": known["ratio"] ** 2, "damping": 1.0, "frictionloss": 1.0}
    offset = {"armature": 0.0, "damping": known["damping"], "frictionloss": known["friction"]}

    def modify(field: str) -> Any:
        def change(spec: Any, parameter: Any) -> None:
            value = offset[field] + shaft[field] * float(parameter.value[0])
            setattr(spec.joint("shaft"), field, np.array([[value], [0], [0]]) if field == "damping" else value)

        return change

    def fitted(speeds: np.ndarray, optimizer: str) -> np.ndarray:
        free = sysid.ParameterDict()
        for field, name, at in zip(shaft, NAMES, start, strict=True):
            one = sysid.Parameter(name, nominal=at, min_value=0.0, max_value=10 * at, modifier=modify(field))
            free.add(one)
        runs = []
        model = spec.compile()
        data = mujoco.MjData(model)
        state = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
        clock = np.r_[0.0, times]
        for volts, seen in zip(VOLTAGES, speeds, strict=True):
            torque = np.full((len(clock), 1), known["torque_per_volt"] * volts)
            # Its sensor values are those before a step, labelled with the time after it.
            late = np.r_[0.0, seen[:-1]][:, None]
            sensor = sysid.TimeSeries.from_names(times, late, model)
            control = sysid.TimeSeries(clock, torque)
            runs.append(sysid.ModelSequences("shaft", spec, f"{volts:g} V", state, control, sensor))
        residual = sysid.build_residual_fn(models_sequences=runs)
        with contextlib.redirect_stdout(io.StringIO()):  # suppresses each optimizer's table of iterations
            found, _ = sysid.optimize(free, residual, optimizer=optimizer, verbose=False)
        return found.as_vector()

    return fitted


def main() -> None:
    """Runs both fits."""
    options = measure.parser(__doc__ or "", batches="1")
    options.add_argument("--draws", type=int, default=20, help="noise draws")
    chosen = options.parse_args()
    robot, times = lifted(), STEP * np.arange(1, SAMPLES + 1)
    fields, known = params.parameters_by_name(robot), constants(robot)
    truth = np.array([float(fields[n].value) for n in NAMES])
    start, clean = truth * OFF, exact(known, truth, times)
    rng = np.random.default_rng(0)
    draws = clean + NOISE * rng.standard_normal((chosen.draws, *clean.shape))

    fitted, coordinates = ours(robot, start, times, known["ratio"])
    value = jax.jit(lambda z: coordinates.value(z))
    record: dict[str, Any] = {"machine": measure.machine(), "truth": truth.tolist(), "start": start.tolist()}
    begun = time.perf_counter()
    jax.block_until_ready(fitted(jnp.asarray(draws[0])))
    compiling = time.perf_counter() - begun
    ways = {"mmrjax": lambda speeds: np.asarray(value(fitted(jnp.asarray(speeds)).z))}
    other = toolbox(known, start, times)
    for optimizer in ("mujoco", "scipy"):
        ways[f"mujoco.sysid, optimizer {optimizer}"] = lambda speeds, o=optimizer: other(speeds, o)
    print(f"{len(VOLTAGES)} runs of {SAMPLES} samples, {len(NAMES)} parameters; truth {truth}, start {start}")
    for way, call in ways.items():
        exactly = call(clean)
        took, ends = [], []
        for speeds in draws:
            begun = time.perf_counter()
            ends.append(call(speeds))
            took.append(time.perf_counter() - begun)
        error = np.sqrt(np.mean((np.array(ends) / truth - 1) ** 2, axis=0))
        record[way] = {"s": took, "clean": (exactly / truth - 1).tolist(), "rms": error.tolist()}
        print(f"  {way:<32} {1e3 * np.median(took):8.1f} ms a fit;  error without noise [%] "
              + " ".join(f"{100 * e:+.4f}" for e in exactly / truth - 1)
              + ";  rms with noise [%] " + " ".join(f"{100 * e:.2f}" for e in error))  # fmt: skip
    print(f"  mmrjax compiles once in {compiling:.1f} s; order of the parameters: {', '.join(NAMES)}")
    record["compile_s"] = compiling
    measure.finish(record, chosen.json)


if __name__ == "__main__":
    main()
