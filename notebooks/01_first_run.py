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
# # First run
#
# This notebook simulates one climb of a small robot, then a thousand climbs in one call. Then it computes the
# derivative of a current with respect to a friction coefficient. You do not need to know JAX: a *batch* is an array
# of conditions, and a *gradient* is computed by a function.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import mmrjax as mm

jax.config.update("jax_enable_x64", True)  # within jax.jit and jax.grad too

# %% [markdown]
# ## One operating point
# The robot is a tree of parameters, each with its unit and source. Conditions are the quantities that are set from
# outside, such as voltage and slope.

# %%
robot = mm.nominal()
one = mm.Conditions("6T2A", voltage=15.0, slope_deg=5.0, total_mass=13.1)
answer = mm.simulate(robot, one)

print(f"status       {answer.statuses}")
print(f"current      {answer.total_current:.2f} A    (measured: 2.75 A)")
print(f"motor speed  {answer.motor_speed * 30 / np.pi:.0f} rpm (measured: 4800 rpm)")
print(f"speed        {answer.speed * 1e3:.0f} mm/s  (measured: 400 mm/s)")

# %% [markdown]
# ## Every slope at once, and a status for each
# On lacquered wood, Table 5 of the paper gives the tracks an adhesion coefficient of 0.32. This is less than tan
# 20° = 0.36. So above some slope the robot cannot travel at a steady speed: its status is `slides`, and its outputs
# are NaN.

# %%
slopes = np.linspace(0.0, 25.0, 1001)
climbs = mm.simulate(robot, mm.Conditions("6T2A", voltage=15.0, slope_deg=slopes, total_mass=13.1))
slides = climbs.statuses == "slides"
print(f"steady up to {slopes[~slides].max():.1f} deg, slides from {slopes[slides].min():.1f} deg")

# %%
_, (left, right) = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
left.plot(slopes, climbs.total_current)
left.set(xlabel="slope [deg]", ylabel="total current [A]")
right.plot(slopes, 1e3 * climbs.speed)
right.set(xlabel="slope [deg]", ylabel="speed [mm/s]")
assert all(np.isfinite(line.get_ydata()).any() for panel in plt.gcf().axes for line in panel.lines)
plt.show()

# %% [markdown]
# ## A gradient
# By how much does the current rise if the coefficient of rolling resistance rises by 0.01? The derivative is exact:
# it is computed from the balance equations at the solution (implicit function theorem). As a check, the cell also
# simulates the robot with two neighbouring values.

# %%
name = "6T2A.ground.rolling_resistance"


def current(resistance):
    """Total current [A] at 5 degrees as a function of the rolling resistance coefficient."""
    return mm.simulate(mm.replace(robot, {name: resistance}), one).total_current


slope_of_current = float(jax.grad(current)(0.06))
twice = float(current(0.06 + 1e-6) - current(0.06 - 1e-6)) / 2e-6
print(f"dI/df = {slope_of_current:.4f} A (twice run: {twice:.4f}), so 0.01 more costs {slope_of_current / 100:.3f} A")

# %%
assert answer.statuses == "converged"
assert abs(answer.total_current - 2.75) / 2.75 < 0.10  # the paper's model, nothing fitted
assert 12 < slopes[slides].min() < 18
assert abs(slope_of_current - twice) < 1e-6 * abs(twice)
