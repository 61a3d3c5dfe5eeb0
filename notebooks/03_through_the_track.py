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
# # Through the track
#
# The track model simulates half a robot in MuJoCo MJX: 24 grousers strike the ground one after another, the belt
# rubs on its guides, and the motor pushes. Thousands of small time steps lie between a friction coefficient and a
# measured current. Can one compute a *derivative* through all these steps, and use it to find the coefficient from
# the current?
#
# The answer depends on how the belt is modelled. This notebook computes the derivative for two models of the same
# belt. With one model the derivative is useless; with the other it calibrates a friction coefficient in a few
# steps.

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mmrjax as mm

jax.config.update("jax_enable_x64", True)  # within jax.jit and jax.grad too

# %% [markdown]
# ## A run and its derivative
# The robot is the nominal one, with enough adhesion to climb. The runs are four measured runs of the tracked robot
# at 33 V (Table A1 of the paper). The parameter is the friction coefficient $\mu_t$ between the belt teeth and
# their guides.
#
# `jax.jvp` evaluates a function together with its derivative: each elementary operation knows its own derivative,
# and the chain rule combines them over all 6000 steps of 0.1 ms.

# %%
measured = mm.read_runs("measured")
rows = measured.where((measured["configuration"] == "6T2A") & (measured["supply_voltage_V"] == 33)
                      & (measured["slope_deg"] < 20))  # fmt: skip
friction, share = "6T2A.track.guide_friction", "6T2A.track.guide_share"
robot = mm.replace(mm.nominal(), {"6T2A.ground.friction.static": 0.6, share: 0.98})


def run(mu, some=rows, **options):
    """Some runs at once as a function of the guide friction."""
    return mm.simulate(mm.replace(robot, {friction: mu}), some.conditions(robot), model="track", **options)


@jax.jit
def runs_and_slopes(mu):
    """All four runs, rolling from the start, and the derivative of every number in them with respect to mu."""
    return jax.jvp(lambda m: run(m, duration=0.6, history=False), (mu,), (jnp.ones(()),))


values, slopes = runs_and_slopes(jnp.asarray(0.20))  # of Table 4
for k in range(len(rows)):
    print(
        f"{rows['slope_deg'][k]:4.0f} deg: {values.statuses[k]}, "
        f"{float(values.total_current[k]):.2f} A (measured {rows['total_current_A'][k]:.2f} A), "
        f"d current / d mu_t = {float(slopes.total_current[k]):.2f} A"
    )

# %% [markdown]
# Is the derivative right? The next cell compares it with a difference quotient of two runs.

# %%
h = 2e-5
either_side = [runs_and_slopes(jnp.asarray(0.20 + sign * h))[0].total_current for sign in (1, -1)]
twice = np.asarray(either_side[0] - either_side[1]) / (2 * h)
exact = np.asarray(slopes.total_current)
print("carried along:", exact.round(4))
print("run twice:    ", twice.round(4))

# %% [markdown]
# ## Why averages
# The first run again, from standstill and over time. The current ripples (left), because it rises whenever a
# grouser strikes the ground. With more friction the belt is a little slower, so each strike comes later, and the
# delay grows from strike to strike. Therefore the derivative of the current *at an instant* oscillates more and
# more (middle). An ammeter shows the average over whole grouser periods, and the derivative of this average settles
# (right).

# %%
flat = rows.where(rows["slope_deg"] == 0)
start, by_mu = jax.jit(
    lambda mu: jax.jvp(lambda m: run(m, flat, duration=1.2), (mu,), (jnp.ones(()),))
)(jnp.asarray(0.20))  # fmt: skip
time = np.asarray(start.history.time[0])
last = time > 1.05
_, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3), layout="constrained")
left.plot(1e3 * time[last], np.asarray(start.history.signals.total_current[0])[last])
left.set(xlabel="time [ms]", ylabel="total current [A]", title="the current ripples")
swing = np.asarray(by_mu.history.signals.total_current[0])
middle.plot(1e3 * time, swing, lw=0.7)
middle.set(xlabel="time [ms]", ylabel="d current / d mu_t [A]", title="derivative at an instant")
pitch = 35e-3 / float(start.speed[0])  # s, one grouser period
window = round(2 * pitch / 1e-3)
smooth = np.convolve(swing, np.ones(window) / window, "valid")
right.plot(1e3 * time[window - 1 :], smooth)
right.axhline(exact[0], color="k", lw=0.7, ls="--")
right.set(xlabel="time [ms]", ylabel="d current / d mu_t [A]", title="mean over two periods; dashed: run that rolls")
assert all(np.isfinite(line.get_ydata()).any() for panel in plt.gcf().axes for line in panel.lines)
plt.show()

# %% [markdown]
# ## The belt as a free chain: a derivative that is exact and useless
# The obvious model of a belt is a chain of 168 masses that are joined by stiff springs and free to move.
# `benchmarks/free_chain.py` implements it with the same contact laws. Its *averages* are good: the guides carry the
# same share of the weight as in the track model.
#
# But the motion of this chain is chaotic. If two chains have guide frictions that differ by 1e-12, their motions
# differ completely after a few hundredths of a second.

# %%
sys.path.insert(0, str(Path(mm.__file__).parents[1] / "benchmarks"))
import free_chain

belt = free_chain.chain(robot.running_gear)
SAMPLES = 80  # of 0.5 ms


def load(mu):
    """Load on the ground [N], every half millisecond, of the free chain."""
    (_, _), (sums, _, _) = free_chain.run(
        belt._replace(guide_friction=mu), free_chain.SPEED, free_chain.STEP, SAMPLES
    )
    return sums.normal


chain_load, chain_slope = jax.jvp(load, (jnp.asarray(0.20),), (jnp.ones(()),))
beside = load(jnp.asarray(0.20 + 1e-12))
apart = np.abs(np.asarray(beside - chain_load))
chain_slope = np.abs(np.asarray(chain_slope))
track_slope = np.abs(np.asarray(by_mu.history.signals.normal[0]))

# %%
chain_time = 0.5 * np.arange(1, SAMPLES + 1)
_, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
left.semilogy(chain_time, np.maximum(apart, 1e-14))
left.set(xlabel="time [ms]", ylabel="difference in load [N]", title="two chains, friction 1e-12 apart")
right.semilogy(chain_time, chain_slope, label="free chain")
right.semilogy(1e3 * time, np.maximum(track_slope, 1e-6), label="belt on its path")
right.set(xlabel="time [ms]", ylabel="|d load / d mu_t| [N]", title="derivative of the load")
right.legend()
assert all(np.isfinite(line.get_ydata()).any() for panel in plt.gcf().axes for line in panel.lines)
plt.show()

# %% [markdown]
# The derivative that JAX computes for the chain is *exact* for this run. Like the difference of the two runs, it
# grows tenfold every two or three milliseconds. The difference stops growing when the two chains differ as much as
# they can; the derivative keeps growing. It describes correctly how an infinitesimal change of friction changes the
# vibration of the chain, but it says nothing about the average load. So it cannot guide a calibration. A difference
# quotient does not help either: it gives another number for each step $h$.
#
# ## The belt on its path
# In the track model the belt therefore follows a fixed path of two straight sections and two arcs. The angles of
# the two pulleys determine the position of each grouser and the tension of the belt. The model has five coordinates
# instead of at least 336, and small disturbances decay instead of growing. The remaining oscillation of the
# derivative (right) comes from the timing of the strikes. It does not grow exponentially, and averages over whole
# periods do not contain it.

# %% [markdown]
# ## A calibration by gradient
# Which $\mu_t$ gives the four measured currents? With the derivative, each step solves a linearised problem
# (Gauss-Newton). Four steps are enough.

# %%
target, sd = rows["total_current_A"], 0.05 * rows["total_current_A"]
mu = jnp.asarray(0.20)
for step in range(5):
    value, slope = runs_and_slopes(mu)
    error = (np.asarray(value.total_current) - target) / sd
    change = np.asarray(slope.total_current) / sd
    print(f"step {step}: mu_t = {float(mu):.5f}, rms error {np.sqrt(np.mean(error**2)) * 5:.2f} %")
    move = float(error @ change / (change @ change))
    mu = mu - move

# %% [markdown]
# `steady` has no grousers and solves only three equations. It gives the same result for the same currents. In
# `steady` only the *product* of the friction and the share of the weight on the guides matters; the track model
# computes this share (0.98).

# %%
lumped = jnp.asarray(0.20)
current = jax.jit(lambda m: mm.simulate(mm.replace(robot, {friction: m}), rows.conditions(robot)).total_current)
for _ in range(5):
    error, change = (np.asarray(current(lumped)) - target) / sd, np.asarray(jax.jacfwd(current)(lumped)) / sd
    lumped = lumped - float(error @ change / (change @ change))
carried = float(np.mean(value.guide_share))
print(
    f"track model: mu_t = {float(mu):.4f}, guides carry {carried:.3f} of the weight, "
    f"product {float(mu) * carried:.4f}"
)
print(f"steady:      mu_t x share = {float(lumped) * 0.98:.4f}")

# %% [markdown]
# So $\mu_t$ is about a third of the 0.20 that Table 4 of the paper prints. With 0.20 and nearly all of the weight
# on the guides, the simulated currents are far above the measured ones (see the first output). `mmrjax calibrate
# measured --model track` fits all friction coefficients to all twenty rows, with priors and intervals, in some
# minutes.

# %%
assert np.allclose(exact, twice, rtol=0.01)  # through 6000 steps
assert chain_slope[-1] > 1e6 * track_slope.max() and apart[-10:].max() > 1e6 * apart[:4].max()
assert track_slope[-200:].max() < 10 * track_slope[600:800].max()  # strike after strike, no growth
assert abs(move) < 1e-5  # Gauss-Newton has arrived
assert abs(float(mu) * carried / (float(lumped) * 0.98) - 1) < 0.01
assert abs(carried - 0.98) < 0.01
