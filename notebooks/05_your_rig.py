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
# # Your own rig
#
# This notebook uses a robot that other people built and measured: Robotino, with three omni wheels, on four
# surfaces. Its motor speeds were controlled; its voltages were not recorded. (`docs/rigs/robotino/README.md` gives
# the source of the data.) mmrjax needs two files: a description of the rig, and the table as it is.
#
# The same on the command line: `mmrjax rig check robotino.toml settled.csv`, then `mmrjax loop settled.csv --robot
# robotino.toml --noise current=5%,speed=10%`.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import mmrjax as mm

DOCS = Path("docs") if Path("docs").is_dir() else Path(mm.__file__).parents[1] / "docs"
FOLDER = DOCS / "rigs" / "robotino"
rig = mm.read_robot(str(FOLDER / "robotino.toml"))
runs = mm.read_runs(str(FOLDER / "settled.csv"), robot=rig)
print(f"{len(runs)} runs on {', '.join(np.unique(runs['surface']))}; imposed: {rig.rig.imposed}")
print(f"channels: {', '.join(rig.rig.channels)}; columns not in use: {', '.join(runs.unknown)}")

# %% [markdown]
# ## The model without effects
# The friction of each surface is free: its adhesion, its slip speed and its rolling resistance. In this model the
# traction demand on a surface determines the sliding speed of a contact, no matter how fast the wheels turn. At 0.3
# m/s this is far from the measurements.


# %%
def ground_speed(robot):
    """Ground speed of every run [mm/s]."""
    return 1e3 * np.asarray(mm.simulate(robot, runs.conditions(robot)).speed)


def rms(robot, rows):
    """Root mean square error of the ground speed [mm/s] over some rows."""
    return float(np.sqrt(np.mean((ground_speed(robot) - runs["speed_mm_s"])[rows] ** 2)))


fast = runs.extras["set_speed_m_s"] > 0.25
every = np.ones(len(runs), bool)
options = {"noise": "current=5%,speed=8%", "starts": 4, "profiles": False, "blocks": False}
plain = mm.calibrate(runs, rig, **options)
plain_held = mm.calibrate(runs.where(~fast), rig, **options)
print(
    f"plain law: {rms(plain.robot, every):.1f} mm/s, fitted without 0.3 m/s and asked there: "
    f"{rms(plain_held.robot, fast):.1f} mm/s"
)

# %% [markdown]
# ## What the model lacks
# `mm.discover(runs, rig)` finds that slip grows with the speed: the effect `nonlinear_slip` is a share of the speed
# that depends on how much of the adhesion is used. The search takes a minute or two. To save time, this notebook
# adds the effect to the robot file and fits it. `scaled` widens the library's prior and limits, which were chosen
# for tracks on wood.

# %%
SLIP = """
[effects.nonlinear_slip]
amplitude = 0.5
scaled = [10, 1, 10]  # sd of the amplitude, shape and limits, each times the library's
"""
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "robotino_slip.toml"
    path.write_text((FOLDER / "robotino.toml").read_text() + SLIP)
    with_slip = mm.read_robot(str(path))
found = mm.calibrate(runs, with_slip, **options)
found_held = mm.calibrate(runs.where(~fast), with_slip, **options)
inside, outside = rms(found.robot, every), rms(found_held.robot, fast)
print(f"with slip that goes with speed: {inside:.1f} mm/s, held out at 0.3 m/s {outside:.1f} mm/s")

# %%
_, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
wheel = (
    1e3
    * np.pi
    / 30
    * runs["motor_speed_rpm"]
    / float(rig.gearbox.ratio)
    * float(rig.configurations["robotino"].radius)
)
measured = runs["speed_mm_s"]
for ax, (title, robot) in zip(axes, (("plain law", plain.robot), ("slip goes with speed", found.robot)), strict=True):
    shown = ground_speed(robot)
    for k, surface in enumerate(np.unique(runs["surface"])):
        mine = runs["surface"] == surface
        order = np.argsort(wheel[mine])
        ax.plot(wheel[mine], measured[mine], "o", ms=4, color=f"C{k}", label=f"{surface}, measured")
        ax.plot(wheel[mine][order], shown[mine][order], "-", color=f"C{k}")
    ax.set(title=title, xlabel="rolling speed of the wheels [mm/s]")
axes[0].set_ylabel("ground speed [mm/s]")
axes[0].legend(fontsize=7, frameon=False)
assert all(np.isfinite(line.get_ydata()).any() for panel in plt.gcf().axes for line in panel.lines)
plt.show()

# %% [markdown]
# ## What the remaining errors depend on
# The residuals depend on a column that the model does not use: which of the three wheels idles.

# %%
for cluster in found.residual_clusters:
    print(cluster.statement)

# %%
assert rms(plain_held.robot, fast) > 60
assert inside < 14 and outside < 21
assert any("idle_wheel" in (c.column, *c.alike, *(name for name, _ in c.coarser)) for c in found.residual_clusters)
