# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Into MuJoCo
#
# This notebook takes a drive that the loop has improved into two other simulators: into MuJoCo as a `<dcmotor>`,
# and into MJX as an actuator function. How accurate is each format? On the command line: `mmrjax loop measured
# --out found`, then `mmrjax export found/robot.toml --to mujoco --configuration 4W2T --data measured`.

# %%
import importlib.util
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from mujoco import mjx

import mmrjax as mm

mm.keep_programs()  # compiled once, for later sessions too
runs = mm.read_runs("measured")
found = mm.discover(runs, mm.nominal())
print(found.statement)

# %% [markdown]
# ## Export, and its errors
# The parameters of `<dcmotor>` are refitted to the mmrjax model at the conditions of the measured runs on wheels.
# The errors are relative to the measured readings: for the mmrjax model, for the export, and for an export without
# the effects that the loop found.

# %%
folder = Path(tempfile.mkdtemp())
wheels = {"data": runs, "configuration": "4W2T", "posterior": found.posterior}
drive = mm.export(found.robot, "mujoco", out=folder, **wheels)
for fate in drive.comparison.fates:
    print(f"{fate.name}: {fate.verdict}, {fate.how}")
for error in drive.comparison.errors:
    print(f"{error.label:28s}", {name: round(value, 2) for name, value in error.percent.items()})
start = drive.files["drive.xml"].index("<dcmotor")
print(drive.files["drive.xml"][start:].splitlines()[0])

# %% [markdown]
# ## In MuJoCo C
# In the exported scene, one side of the robot rolls on its wheel. The actuator `load` applies the torque of slope
# and ground. The cell simulates runs of Table 8 on wheels until they settle, and compares them with `mm.simulate`.

# %%
model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
data = mujoco.MjData(model)
slopes, volts = np.meshgrid([0.0, 5.0, 10.0, 15.0], [15.0, 24.0, 33.0], indexing="ij")
conditions = mm.Conditions("4W2T", voltage=volts.ravel(), slope_deg=slopes.ravel())
native = mm.simulate(found.robot, conditions)
chassis, sides = found.robot.configurations["4W2T"], float(found.robot.sides)
load = np.asarray(native.traction) / sides * float(chassis.radius)  # torque that the wheel has to give
share = drive.comparison.refitted["current over act"]


def settled(voltage, torque, seconds=3.0):
    """Motor current [A] and speed of the wheel [rad/s] after some seconds in MuJoCo C."""
    mujoco.mj_resetData(model, data)
    data.ctrl[:] = voltage, torque
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return share * data.act[-1], data.qvel[0]


current, speed = np.array([settled(*given) for given in zip(volts.ravel(), load, strict=True)]).T
of_motor = np.asarray(native.motor_speed) / float(found.robot.gearbox.ratio)
errors_c = [np.max(np.abs(a / b - 1)) for a, b in ((sides * current, native.total_current), (speed, of_motor))]
print(f"largest difference from mm.simulate: current {100 * errors_c[0]:.2f} %, speed {100 * errors_c[1]:.2f} %")

# %% [markdown]
# ## In MJX, many at the same time
# MJX has no `<dcmotor>`. The export `jax` is a file of plain JAX; its torque is added to `qfrc_applied`. Each
# environment has a different voltage and load. The scene has no constraints, so derivatives are cheap.

# %%
mm.export(found.robot, "jax", out=folder / "jax", **wheels)
spec = importlib.util.spec_from_file_location("exported_actuator", folder / "jax" / "actuator.py")
law = importlib.util.module_from_spec(spec)
spec.loader.exec_module(law)
inertia = float(model.body_inertia[1, 1])
joint = mujoco.MjModel.from_xml_string(
    f'<mujoco><option timestep="0.002"/><worldbody><body><joint name="drive" axis="0 1 0" '
    f'armature="{float(law.armature(law.PARAMS))}"/><inertial pos="0 0 0" mass="1" '
    f'diaginertia="{inertia} {inertia} {inertia}"/></body></worldbody></mujoco>'
)
rig = mjx.put_model(joint)
# Every run has the normal load of its slope; other numbers are those of the file.
weight = np.asarray(native.mass) * 9.80665 * np.cos(np.radians(slopes.ravel())) / sides
params = {name: jnp.full(volts.size, value) for name, value in law.PARAMS.items()}
params |= {"surroundings.normal": jnp.asarray(weight, float)} if "surroundings.normal" in params else {}


def environment(params, voltage, torque):
    """Motor current and speed of the wheel over 3 s in MJX."""

    def step(carry, _):
        state, actuator = carry
        given, actuator, info = law.actuator(params, actuator, voltage, state.qpos[0], state.qvel[0], 0.002)
        state = mjx.step(rig, state.replace(qfrc_applied=jnp.array([given - torque])))
        return (state, actuator), (info["current"], state.qvel[0])

    return jax.lax.scan(step, (mjx.make_data(rig), law.initial_state()), None, 1500)[1]


currents, speeds = jax.jit(jax.vmap(environment))(params, jnp.asarray(volts.ravel()), jnp.asarray(load))
pairs = ((sides * currents[:, -1], native.total_current), (speeds[:, -1], of_motor))
errors_mjx = [np.max(np.abs(np.asarray(a) / b - 1)) for a, b in pairs]
print(f"largest difference from mm.simulate: current {100 * errors_mjx[0]:.3f} %, speed {100 * errors_mjx[1]:.3f} %")

# %%
fig, grid = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
for axes, (label, exact, of_c, of_mjx) in zip(
    grid,
    (
        ("total current [A]", native.total_current, sides * current, sides * currents[:, -1]),
        ("speed of the wheel [rad/s]", of_motor, speed, speeds[:, -1]),
    ),
    strict=True,
):
    axes.plot(exact, exact, color="#888888", lw=1)
    axes.plot(exact, of_c, "o", mfc="none", color="#d55e00", label="MuJoCo C")
    axes.plot(exact, of_mjx, ".", color="#0072b2", label="MJX")
    axes.set_xlabel(f"mm.simulate: {label}")
grid[0].legend()
assert all(np.isfinite(line.get_ydata()).any() for panel in plt.gcf().axes for line in panel.lines)
plt.show()

# %% [markdown]
# ## A move with little energy
# The robot has to travel half a metre in one second, from rest to rest, with the least energy. Gradients go through
# the actuator and the joint.

# %%
STEPS, DT, KNOTS, TARGET = 200, 0.005, 21, 0.5
one = {name: float(value) for name, value in law.PARAMS.items()}
turning = inertia + float(law.armature(one))


def move(knots):
    """Places [m], speeds [rad/s] and powers [W] of a move under voltages at some knots."""
    voltages = jnp.interp(jnp.linspace(0, KNOTS - 1, STEPS), jnp.arange(KNOTS), knots)

    def step(carry, voltage):
        angle, speed, actuator = carry
        torque, actuator, info = law.actuator(one, actuator, voltage, angle, speed, DT)
        speed = speed + DT * torque / turning
        angle = angle + DT * speed
        return (angle, speed, actuator), (angle * float(chassis.radius), speed, info["power"])

    return jax.lax.scan(step, (0.0, 0.0, law.initial_state()), voltages)[1]


def cost(knots):
    """Energy of a move, with penalties for not arriving at rest."""
    place, speed, power = move(knots)
    energy = DT * jnp.sum(jnp.maximum(power, 0.0))
    return energy + 1e4 * (place[-1] - TARGET) ** 2 + 1e2 * (float(chassis.radius) * speed[-1]) ** 2


@jax.jit
def descend(knots):
    """Adam's method over 400 steps."""

    def step(carry, k):
        knots, mean, square = carry
        slope = jax.grad(cost)(knots)
        mean, square = 0.9 * mean + 0.1 * slope, 0.99 * square + 0.01 * slope**2
        stride = 0.2 * (mean / (1 - 0.9 ** (k + 1))) / (jnp.sqrt(square / (1 - 0.99 ** (k + 1))) + 1e-8)
        return (knots - stride, mean, square), cost(knots)

    start = (knots, jnp.zeros(KNOTS), jnp.zeros(KNOTS))
    return jax.lax.scan(step, start, jnp.arange(400.0))


(best, _, _), costs = descend(jnp.full(KNOTS, 12.0))
place, speed, power = move(best)
print(f"arrives at {float(place[-1]):.3f} m with {1e3 * float(chassis.radius) * float(speed[-1]):.1f} mm/s")
print(f"cost {float(costs[0]):.1f} → {float(costs[-1]):.1f}")
fig, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
axes.plot(np.linspace(0, 1, KNOTS), best, "o-", color="#0072b2", label="voltage [V]")
axes.plot(np.linspace(0, 1, STEPS), 10 * place, color="#d55e00", label="place [dm]")
axes.set_xlabel("time [s]")
axes.legend()
assert all(np.isfinite(line.get_ydata()).any() for panel in plt.gcf().axes for line in panel.lines)
plt.show()

# %%
assert max(errors_mjx) < 0.005 and max(errors_c) < 0.1
assert abs(float(place[-1]) - TARGET) < 0.01 and float(costs[-1]) < 0.5 * float(costs[0])
