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
# # A sweep, and which parameters matter
#
# How does a robot behave over a range of conditions, how certain is this prediction, and which parameters would
# have to be known better? The commands `mmrjax sweep` and `mmrjax sensitivity` answer this for all parameters, with
# confidence intervals. This notebook shows in a few lines what they compute.

# %%
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

import mmrjax as mm

jax.config.update("jax_enable_x64", True)  # within jax.jit and jax.grad too

robot = mm.nominal()

# %% [markdown]
# ## A sweep
# `mm.sweep` simulates a grid of conditions. To vary a parameter of the robot as well, change it by name with
# `mm.replace` and simulate all robots in one call with `jax.vmap`.

# %%
slopes, shares = np.linspace(0, 12, 25), np.linspace(0, 1, 21)


def climb(share):
    """Every slope, with a share of the weight on the track's guides."""
    return mm.simulate(
        mm.replace(robot, {"6T2A.track.guide_share": share}),
        mm.Conditions("6T2A", voltage=24.0, slope_deg=slopes),
    )


made = jax.jit(jax.vmap(climb))(jnp.asarray(shares))
current = np.where(made.statuses == "converged", made.total_current, np.nan).T  # a row for each slope
print(f"{current.size} points, {int(np.isfinite(current).sum())} of them travel")
print(f"current {np.nanmin(current):.2f} to {np.nanmax(current):.2f} A")

# %% [markdown]
# ## Its store
# The results are arrays with names and units. `mmrjax sweep CONFIG.toml` writes such a store in chunks, for any
# number of points.

# %%
store = xr.Dataset(
    {"total_current": (("slope_deg", "guide_share"), current, {"units": "A", "long_name": "total current"})},
    {"slope_deg": ("slope_deg", slopes, {"units": "deg"}), "guide_share": ("guide_share", shares, {"units": "-"})},
)
with tempfile.TemporaryDirectory() as folder:
    store.to_zarr(Path(folder) / "sweep.zarr", zarr_format=2)
    again = xr.open_zarr(Path(folder) / "sweep.zarr").load()
again["total_current"].sel(slope_deg=[0, 6, 12]).sel(guide_share=[0.0, 0.5, 1.0], method="nearest")

# %% [markdown]
# ## Which parameters matter, at the robot's own values
# Suppose that six parameters are known to the tolerances below. The *elasticity* of a reading is its change in
# percent for a change of 1 % in a parameter. Derivatives are exact, so one call computes all elasticities at four
# operating points.

# %%
known = {  # relative standard deviation
    "motor.torque_constant": 0.02,
    "motor.resistance": 0.05,
    "motor.inductance": 0.10,
    "gearbox.efficiency_load": 0.03,
    "6T2A.track.guide_share": 0.40,
    "6T2A.ground.rolling_resistance": 0.15,
}
motor, tracks = robot.motor, robot.configurations["6T2A"]
electrics = (motor.torque_constant, motor.resistance, motor.inductance)
mechanics = (robot.gearbox.efficiency_load, tracks.track.guide_share, tracks.ground.rolling_resistance)
nominal = np.array([*electrics, *mechanics])
points = mm.Conditions("6T2A", voltage=[15.0, 33.0, 15.0, 33.0], payload=3.0, slope_deg=[0.0, 0.0, 5.0, 5.0])


def readings(values):
    """Current [A] and speed [m/s] at the four points, and whether all of them travel."""
    runs = mm.simulate(mm.replace(robot, dict(zip(known, values, strict=True))), points)
    return jnp.stack([runs.total_current, runs.speed]), jnp.all(runs.status == mm.STATUSES.index("converged"))


(at_nominal, _), (slope, _) = readings(nominal), jax.jacfwd(readings, has_aux=True)(nominal)
elasticity = np.asarray(slope * nominal / at_nominal[..., None])  # reading, point, parameter
for k, name in enumerate(known):
    print(f"{name:<32} current {elasticity[0, 2, k]:+.3f}   speed {elasticity[1, 2, k]:+.3f}   (15 V, 5 deg)")

# %%
_, (left, right) = plt.subplots(1, 2, figsize=(9, 3), sharey=True, layout="constrained")
names, sds = list(known), np.array(list(known.values()))
for axes, values, title in ((left, elasticity[0, 2], "total current"), (right, elasticity[1, 2], "speed")):
    axes.barh(names, 100 * values * sds)
    axes.axvline(0, color="k", lw=0.7)
    axes.set(xlabel="change by one standard deviation [%]", title=f"{title}, 15 V, 5 deg")
assert all(np.isfinite(bar.get_width()) for panel in plt.gcf().axes for bar in panel.patches)
plt.show()

# %% [markdown]
# ## Over the whole range
# Derivatives describe small changes of one robot. *Sobol indices* describe all robots that the tolerances allow:
# they give the share of each parameter in the variance of a reading. The first-order index is the share of the
# parameter alone; the total index includes its interactions with other parameters. The method draws two independent
# sets of robots. Then it replaces one parameter at a time in the first set by its values from the second set
# (Saltelli 2010, Jansen 1999).

# %%
ROBOTS = 4096
rng = np.random.default_rng(0)
a, b = nominal * np.exp(sds * rng.standard_normal((2, ROBOTS, len(known))))  # log-normal: none is negative
run = jax.jit(jax.vmap(readings))
both = [a, b]
for k in range(len(known)):
    mixed = a.copy()
    mixed[:, k] = b[:, k]
    both.append(mixed)
values, travels = run(jnp.asarray(np.concatenate(both)))
values = np.asarray(values).reshape(len(both), ROBOTS, 2, 4)
whole = np.asarray(travels).reshape(len(both), ROBOTS).all(0)  # a robot that slides has no reading
values = values[:, whole]
print(f"{len(both) * ROBOTS * 4} runs; {whole.sum()} of {ROBOTS} robots travel at all points")

# %%
one, other, *with_one = values
variance = values[:2].var(axis=(0, 1))
first = np.array(
    [((other - other.mean(0)) * (x - one)).mean(0) / variance for x in with_one]
)  # parameter, reading, point
total = np.array([((x - one) ** 2).mean(0) / 2 / variance for x in with_one])
for name, s, t in zip(known, first, total, strict=True):
    print(f"{name:<32} current {s[0, 2]:5.2f} {t[0, 2]:5.2f}   speed {s[1, 2]:5.2f} {t[1, 2]:5.2f}")

# %%
_, axes = plt.subplots(figsize=(7, 3), layout="constrained")
place = np.arange(len(known))
for shift, reading, label in ((-0.2, 0, "total current"), (0.2, 1, "speed")):
    axes.barh(place + shift, total[:, reading, 2], 0.36, label=label)
axes.set(xlabel="total share of the variance, 15 V, 5 deg", yticks=place, yticklabels=names)
axes.legend()
assert all(np.isfinite(bar.get_width()) for panel in plt.gcf().axes for bar in panel.patches)
plt.show()

# %% [markdown]
# To predict the current better, one would have to know the share of the weight on the guides better. The torque
# constant determines the speed, because the no-load speed is voltage divided by torque constant. A settled run does
# not depend on the inductance at all. `mmrjax sensitivity --outputs total_current,speed,slip` does the same for
# every parameter that has a prior, and proposes the most informative runs to measure.

# %%
share, constant, inductance = (
    names.index(n) for n in ("6T2A.track.guide_share", "motor.torque_constant", "motor.inductance")
)
assert np.isfinite(current).all() and current[-1, -1] > current[0, 0]
assert float(again["total_current"].max()) == current.max()
assert total[:, 0, 2].argmax() == share and total[:, 1, 2].argmax() == constant
assert np.all(elasticity[..., inductance] == 0) and np.all(total[inductance] < 1e-12)
assert -1.1 < elasticity[1, 2, constant] < -0.9
assert np.all(np.abs(first.sum(0) - 1) < 0.15)  # hardly any interaction
