"""What any robot would show in the experiments of a menu, all in one batch."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from calibration.discovery import setups
from calibration.discovery.menu import Act, Experiment, Run
from calibration.discovery.setups import Setup
from mmrjax.fidelities.steady import IMPLICIT
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STALLED, done

T = TypeVar("T")
#: Mass of a robot whose weight is carried by stands [kg]: none, but for the sake of ratios to its load.
UNLOADED = 1e-9


class Batch(eqx.Module):
    """Experiments as one batch: what is compiled depends on their kinds and sizes, not on their conditions.

    Attributes:
        acts: reading of each; at: what each sets, see `Act`.
        conditions: of every run, of all experiments in turn, shape (runs,).
        brake: torque of the brake, of every run [N·m].
        set_up: how the robot is set up and how many motors are on, each pair once; which: of every run.
        read: positions of the channels that are read of each experiment, and how many runs it has.
        order: position of each experiment among the acts, or behind them among the runs.
    """

    acts: tuple[Callable[[Robot, Array], Array], ...] = eqx.field(static=True)
    at: tuple[Array, ...]
    conditions: Conditions
    brake: Float[Array, " runs"]
    set_up: tuple[tuple[Setup, int | None], ...] = eqx.field(static=True)
    which: tuple[int, ...] = eqx.field(static=True)
    read: tuple[tuple[tuple[int, ...], int], ...] = eqx.field(static=True)
    order: tuple[int, ...] = eqx.field(static=True)


class Predicted(eqx.Module):
    """What a robot shows in a batch.

    Attributes:
        value: of every reading [SI]; exists: whether the robot shows it: one that slides or stands still where it
            should travel shows nothing; shape (readings,).
        does: the same of every run; grip: share of the adhesion that it uses [-]; temperature: of a winding after
            long running [°C]; speed: of the motor shaft [rad/s]; shape (runs,).
    """

    value: Float[Array, " readings"]
    exists: Bool[Array, " readings"]
    does: Bool[Array, " runs"]
    grip: Float[Array, " runs"]
    temperature: Float[Array, " runs"]
    speed: Float[Array, " runs"]


def batch(experiments: Sequence[Experiment], shown: tuple[str, ...]) -> Batch:
    """These experiments as one batch, of a robot with these channels."""
    acts = [e for e in experiments if isinstance(e, Act)]
    runs = [e for e in experiments if isinstance(e, Run)]
    set_up = list(dict.fromkeys((r.setup, r.sides) for r in runs))
    several = [(r, len(r.voltage)) for r in runs]
    each = [jax.tree.map(lambda x: np.atleast_1d(np.asarray(x)), _conditions(r)) for r in runs]
    return Batch(
        acts=tuple(a.reading for a in acts),
        at=tuple(jnp.asarray(a.at, float) for a in acts),
        conditions=jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *each),
        brake=jnp.asarray(np.concatenate([np.full(n, r.brake) for r, n in several])),
        set_up=tuple(set_up),
        which=tuple(k for r, n in several for k in [set_up.index((r.setup, r.sides))] * n),
        read=tuple((r.read(shown), n) for r, n in several),
        order=tuple(acts.index(e) if isinstance(e, Act) else len(acts) + runs.index(e) for e in experiments),
    )


def _conditions(run: Run) -> Conditions:
    # None would take the robot's own mass, which a batch with the others cannot.
    mass = UNLOADED if run.setup in setups.WEIGHTLESS else math.nan
    torque = run.torque or None
    if run.imposed != "voltage":
        level = {run.imposed: run.voltage}
        return Conditions(
            run.configuration, 0.0, run.slope, run.payload, total_mass=mass, load_torque=torque, **level
        )
    return Conditions(run.configuration, run.voltage, run.slope, run.payload, total_mass=mass, load_torque=torque)


def of_runs(function: Callable[..., T], robot: Robot, experiments: Batch, *own: Array) -> T:
    """`function` of the robot as it is set up for every run, under what conditions, and of what each run has of its
    own; a leading axis of runs."""
    conditions = experiments.conditions
    mass = jax.vmap(lambda k: robot.chassis(k).mass)(conditions.configuration) + conditions.payload
    stated = jnp.asarray(conditions.total_mass)
    conditions = dataclasses.replace(conditions, total_mass=jnp.where(jnp.isnan(stated), mass, stated))
    braked = jnp.max(experiments.brake, initial=0.0)
    each = [
        dataclasses.replace(setup(robot, braked), sides=robot.sides if sides is None else sides)
        for setup, sides in experiments.set_up
    ]
    which = np.asarray(experiments.which)

    def same(*x: Any) -> bool:  # whatever the setup
        return all(v is x[0] for v in x)

    robots = jax.tree.map(lambda *x: x[0] if same(*x) else jnp.stack([jnp.asarray(v) for v in x])[which], *each)
    axes = jax.tree.map(lambda *x: None if same(*x) else 0, *each)
    return jax.vmap(function, in_axes=(axes, 0, *[0] * len(own)))(robots, conditions, *own)


def readings(
    robot: Robot, experiments: Batch, unknowns: Float[Array, "runs unknowns"], found: Bool[Array, " runs"]
) -> tuple[tuple[tuple[Array, ...], Array, Array], Predicted]:
    """What the robot shows in every act, what in every run at some unknowns, shape (runs, channels), and what its
    equations leave there, (runs, unknowns); and all that it shows."""
    acts = tuple(act(robot, at) for act, at in zip(experiments.acts, experiments.at, strict=True))
    result, _, left = of_runs(IMPLICIT.shown, robot, experiments, unknowns, found)
    every = jnp.stack([result.reading[c] for c in channels.names(robot.channels)], -1)
    held = np.array([experiments.set_up[k][0] is setups.blocked for k in experiments.which])
    does = jnp.where(jnp.asarray(held), result.status == STALLED, done(result.status))
    exists = arranged(
        experiments, [jnp.ones(a.shape, bool) for a in acts], jnp.broadcast_to(does[:, None], every.shape)
    )
    speed = jnp.where(jnp.asarray(held), 0.0, result.reading["motor_speed"])
    shown = Predicted(
        arranged(experiments, acts, every), exists, does, jnp.asarray(result.adhesion_used),
        jnp.asarray(result.winding_settled), speed,
    )  # fmt: skip
    return (acts, every, left), shown


def arranged(experiments: Batch, acts: Sequence[Array], every: Float[Array, "runs channels ..."]) -> Array:
    """What is known of the readings of every act, and of every run by channel, in the order of the readings."""
    parts, first = list(acts), 0
    for read, runs in experiments.read:
        of_run = every[first : (first := first + runs)][:, list(read)]
        parts.append(of_run.reshape(-1, *every.shape[2:]))
    return jnp.concatenate([parts[k] for k in experiments.order])


# --- where they stand -------------------------------------------------------------------------------


def size(experiment: Experiment) -> int:
    """How many readings an experiment has, repeats averaged."""
    if isinstance(experiment, Act):
        return len(experiment.at)
    return len(experiment.voltage) * len(experiment.channels)


def spans(experiments: Sequence[Experiment]) -> dict[str, slice]:
    """Where the readings of each experiment stand in those of all."""
    ends = np.cumsum([size(e) for e in experiments]).tolist()
    return {e.name: slice(end - size(e), end) for e, end in zip(experiments, ends, strict=True)}


def sds(experiments: Sequence[Experiment], of_channels: Mapping[str, float]) -> np.ndarray:
    """Sd of every reading [SI], repeats averaged; runs, and zeros, are read with the instruments of the table.

    Args:
        of_channels: sds of its channels [SI], by name.
    """
    found = [np.zeros(0)]
    for e in experiments:
        one = (
            [of_channels[e.channel] if e.sd is None else e.sd] * len(e.at)
            if isinstance(e, Act)
            else np.tile([of_channels[c] for c in e.channels], len(e.voltage))
        )
        found.append(np.asarray(one, float) / math.sqrt(e.repeats))
    return np.concatenate(found)
