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
# What does a robot do over a range of conditions, how sure is that, and which of its parameters would one have to
# know better? The same from the command line: `mmrjax sweep` and `mmrjax sensitivity`.

# %%
import jax

jax.config.update("jax_enable_x64", True)

import io
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import xarray as xr
from IPython.display import Image
from matplotlib.backends.backend_agg import FigureCanvasAgg

from calibration.sensitivity import inputs as uncertain
from calibration.sensitivity.analyse import analyse
from calibration.sensitivity.model import chosen_outputs
from calibration.sensitivity.result import Points
from calibration.sensitivity.study import Study
from mmrjax import nominal
from mmrjax.conditions import Conditions
from mmrjax.variation import Variation, evaluate

robot = nominal()

# %% [markdown]
# ## A sweep
# Anything may vary, conditions and parameters by their names. `Variation` says what; `evaluate` computes any outputs
# of all points in one compiled call.

# %%
variation = Variation(robot, ("slope_deg", "6T2A.track.guide_share"))
slopes, shares = np.linspace(0, 12, 25), np.linspace(0, 1, 21)
values = jnp.asarray(np.stack(np.meshgrid(slopes, shares, indexing="ij"), -1).reshape(-1, 2))
made = evaluate(variation, "steady", values, Conditions(0, voltage=24.0), {}, ("total_current", "speed"))
current = np.asarray(made["total_current"]).reshape(25, 21)
print(f"{len(values)} points, {int((np.asarray(made['status']) == 0).sum())} of them travel")
print(f"current {current.min():.2f} to {current.max():.2f} A")

# %% [markdown]
# ## Its store
# Arrays with names and units. `mmrjax sweep CONFIG.toml` writes such a store in chunks, for any number of points.

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
# ## Which parameters matter
# The guides' share is only one of some thirty parameters that are not known exactly. Each has a prior. *Sobol
# indices* say what share of an output's variance each is to blame for: alone (first order), and with all that it acts
# together with (total).

# %%
names = uncertain.default_names(robot, ("6T2A",), battery=False)
inputs = uncertain.of_priors(robot, names, {})
points = Points(
    np.full(4, "6T2A"), np.array([15.0, 33.0, 15.0, 33.0]), np.full(4, 3.0), np.array([0.0, 0.0, 5.0, 5.0])
)
study = Study(robot, inputs, points, chosen_outputs(("total_current", "speed", "slip", "steepest_slope"), robot))
found = analyse(study, "sobol", evaluations=100_000)
print(found.statement())
print(f"{found.evaluations} runs of the model")

# %%
for name, output in found.outputs.items():
    for k in np.argsort(-output.overall_share)[:3]:
        total = output.overall["total"][k]
        print(f"{name:<16}{found.names[k]:<36}{float(total.value):6.3f}  [{total.low:.3f}, {total.high:.3f}]")

# %%
from sweeps.pages import sensitivity_figures
from sweeps.pages.figure_style import style


def show(draw, *arguments):
    """A figure of the report as a picture in the notebook."""
    with style():
        figure = draw(*arguments)
        FigureCanvasAgg(figure)
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=72)
    return Image(data=picture.getvalue())


show(sensitivity_figures.indices, found.outputs["total_current"], found)

# %% [markdown]
# ## At the robot's own values
# Derivatives are exact, so that they cost hardly more than the runs: of every output by every parameter at every
# operating point, in one batch. The heat map is the share of each parameter in each output to first order.

# %%
local = analyse(study, "local")
show(sensitivity_figures.overview, local)

# %%
speed = local.outputs["speed"]
k = local.names.index("motor.torque_constant")
print(f"1 % more torque constant changes the speed at 15 V by {speed.elasticity[0, k]:+.2f} %")
show(sensitivity_figures.tornado, speed, local)

# %%
assert np.isfinite(current).all() and current[-1, -1] > current[0, 0]
assert float(again["total_current"].max()) == current.max()
assert found.outputs["total_current"].overall_share.argmax() == found.names.index("6T2A.track.guide_share")
assert found.outputs["speed"].overall_share.argmax() == k
assert "motor.inductance" in found.negligible
assert -1.1 < speed.elasticity[0, k] < -0.9  # the no-load speed is voltage over torque constant
