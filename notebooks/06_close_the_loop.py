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
# # Close the loop
#
# Twenty runs were measured. Which effects does the model lack, how certain are they, and does the improved robot
# predict runs that it has not seen? The command `mmrjax loop measured` does the same.

# %%
import matplotlib.pyplot as plt
import numpy as np

import mmrjax as mm

mm.keep_programs()  # compiled once, for later sessions too
robot, runs = mm.nominal(), mm.read_runs("measured")
found = mm.discover(runs, robot)
print(found.statement)

# %% [markdown]
# ## What was found
# Each effect has an equation and a size. It is either *established*, or *tentative* with a reason.

# %%
for effect in found.effects:
    size = effect.parameters["amplitude"]
    print(f"{effect.name}: {size.value:.3g} ± {size.sd:.2g} {size.unit}")
    print(f"    {effect.equation}")
for note in found.notes:
    print("-", note)

# %% [markdown]
# ## Before and after, run by run
# The figure shows simulated minus measured values, in standard deviations of the instruments.

# %%
table = found.rows_table()
fig, grid = plt.subplots(len(found.channels), 1, figsize=(9, 6), sharex=True, layout="constrained")
for axes, channel in zip(grid, found.channels, strict=True):
    axes.axhspan(-2, 2, color="#eeeeee")
    for when, look in (("before", {"mfc": "none", "color": "#d55e00"}), ("after", {"color": "#0072b2"})):
        axes.plot(table["row"], table[f"residual_{when}_{channel.name}_sigma"], "o", label=when, **look)
    axes.set_ylabel(f"{channel.label} [σ]")
grid[-1].set_xlabel("row of the table")
grid[0].legend(ncols=2)
assert all(np.isfinite(line.get_ydata()).any() for panel in plt.gcf().axes for line in panel.lines)
plt.show()

# %% [markdown]
# ## Does the robot predict unseen runs?
# Each slope is left out in turn and predicted by a fit to the other slopes. Errors are in percent of the rms of the
# readings.

# %%
before, after = found.errors_held_out["slope"]
for name in before:
    print(f"{name:15s} {before[name]['rms_percent']:5.1f} % -> {after[name]['rms_percent']:5.1f} %")

# %% [markdown]
# ## Use the improved robot
# `found.robot` can be used like any other robot.

# %%
slopes = np.linspace(0.0, 20.0, 81)
fig, axes = plt.subplots(figsize=(8, 3.5), layout="constrained")
for label, one in (("as stated", robot), ("with what was found", found.robot)):
    climb = mm.simulate(one, mm.Conditions("6T2A", voltage=33.0, slope_deg=slopes, payload=8.0))
    axes.plot(slopes, 1e3 * np.where(climb.status == "converged", climb.speed, np.nan), label=label)
measured = (table["configuration"] == "6T2A") & (table["supply_voltage_V"] == 33.0)
axes.plot(table["slope_deg"][measured], table["speed_mm_s"][measured], "ko", label="measured")
axes.set(xlabel="slope [deg]", ylabel="speed [mm/s]", title="6T2A, 33 V, 8 kg")
axes.legend()
assert all(np.isfinite(line.get_ydata()).any() for panel in plt.gcf().axes for line in panel.lines)
plt.show()

# %% [markdown]
# ## What to measure next

# %%
print(found.next_experiment.name)
print(found.next_experiment.description)
assert found.verdict in ("named", "class", "mechanism", "place") and after["total_current"]["rms_percent"] < 5
