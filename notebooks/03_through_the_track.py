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
# The track model runs half a robot in MuJoCo MJX: 24 grousers strike the ground one after another, the belt
# rubs on its guides, two motors push. Thousands of small steps lead from a friction coefficient to a measured
# current. Can a *derivative* be taken through all of them, so that the coefficient is found from the current?
#
# It depends on how the belt is modelled. This notebook takes the derivative through two models of the same
# belt: one in which it is useless, and one in which it calibrates a friction coefficient in a few steps.

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
# ## A run, and its derivative beside it
# The robot: nominal, with enough adhesion to climb. The runs: four measured ones of the tracked robot at 33 V
# (Table A1 of the paper). The parameter: the friction coefficient $\mu_t$ of the belt's teeth on their guides.
#
# `jax.jvp` runs a function and, with each number it computes, carries along how fast that number changes when
# the input does. It needs no formula from us and no second run; each elementary operation knows its own
# derivative, and the chain rule does the rest, through 6000 steps of 0.1 ms as well as through one.

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
# Is the derivative right? Run the model twice, a little to each side, and compare.

# %%
h = 2e-5
either_side = [runs_and_slopes(jnp.asarray(0.20 + sign * h))[0].total_current for sign in (1, -1)]
twice = np.asarray(either_side[0] - either_side[1]) / (2 * h)
exact = np.asarray(slopes.total_current)
print("carried along:", exact.round(4))
print("run twice:    ", twice.round(4))

# %% [markdown]
# ## Why averages
# The first run again, from standstill and over time. Its current is not constant (left): each grouser that strikes
# the ground makes it rise. More friction slows the belt a little, so each strike is later than it was by a little
# more than the one before, and the derivative of the current *at an instant* swings more and more (middle). Nobody
# reads that off an ammeter. The reading is an average over whole grouser periods, and the derivative of such an
# average settles (right).

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
# The obvious model of a belt is a chain: 168 masses joined by stiff springs, each free to move. It is written
# down in `benchmarks/free_chain.py`, with the same contact laws, and its *averages* are good: the guides carry
# the share of the weight that the track model says.
#
# But such a chain is chaotic, like dice: start it twice with guide frictions that differ in the twelfth digit,
# and within a few hundredths of a second the two chains shake differently.

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
# The derivative that JAX carries through the chain is *exact*: it is the derivative of that run. It grows
# tenfold every two or three milliseconds, as the difference of the two runs does, but goes on where the
# difference ends, with two chains that differ as much as they ever will. It says, truly, that an infinitesimal
# change of friction changes how the chain shakes; it says nothing of how the average load changes. Following it
# would be following noise, and running twice gives another number for each step $h$.
#
# ## The belt on its path
# The track model therefore does not let the belt choose where to go. The belt runs on its path (two straight
# runs, two arcs): where each grouser is follows from the angles of the two pulleys, its tension from their
# difference, and every contact acts on the robot through that path. Five coordinates in place of 336 and more:
# a small disturbance dies out instead of growing. What is left in the derivative on the right is the timing of
# the strikes, which grows with time and no faster, and which averages over whole periods do not see.

# %% [markdown]
# ## A calibration by gradient
# Now the question can be turned round: which $\mu_t$ meets the four measured currents? With the derivative at
# hand, each step solves the problem as if the model were a straight line (Gauss-Newton), and four steps do.

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
# The steady fidelity, which has no grousers and solves three equations instead, gets the same from the same
# currents. In it only the *product* of friction and the guides' share of the weight acts; the track model puts
# out that share, 0.98, by itself.

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
# So $\mu_t$ is about a third of the 0.20 that Table 4 of the paper prints: with 0.20 on nearly all of the weight
# every measured current would be far exceeded (first cell of results). All friction coefficients at once, on
# all twenty rows, with priors and intervals: `mmrjax calibrate measured --model track`, some minutes.

# %%
assert np.allclose(exact, twice, rtol=0.01)  # through 6000 steps
assert chain_slope[-1] > 1e6 * track_slope.max() and apart[-10:].max() > 1e6 * apart[:4].max()
assert track_slope[-200:].max() < 10 * track_slope[600:800].max()  # strike after strike, no growth
assert abs(move) < 1e-5  # Gauss-Newton has arrived
assert abs(float(mu) * carried / (float(lumped) * 0.98) - 1) < 0.01
assert abs(carried - 0.98) < 0.01
