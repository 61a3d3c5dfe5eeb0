"""What any robot would show in the experiments of a menu, all in one batch."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from calibration.discovery import setups
from calibration.discovery.menu import Act, Experiment, Run
from calibration.discovery.setups import Setup
from mmrjax import channels
from mmrjax.conditions import Conditions
from mmrjax.fidelities.steady import operating_point
from mmrjax.robot import Robot
from mmrjax.signals import STALLED, done

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
    if run.imposed != "voltage":
        level = {run.imposed: run.voltage}
        return Conditions(run.configuration, 0.0, run.slope, run.payload, total_mass=mass, **level)
    return Conditions(run.configuration, run.voltage, run.slope, run.payload, total_mass=mass)


def readings(robot: Robot, experiments: Batch) -> Predicted:
    """What the robot shows in every experiment."""
    shown = [(value := act(robot, at), jnp.ones(value.shape, bool)) for act, at in zip(
        experiments.acts, experiments.at, strict=True
    )]  # fmt: skip
    conditions, which = experiments.conditions, np.asarray(experiments.which)
    own = jax.vmap(lambda k: robot.chassis(k).mass)(conditions.configuration) + conditions.payload
    stated = jnp.asarray(conditions.total_mass)
    conditions = dataclasses.replace(conditions, total_mass=jnp.where(jnp.isnan(stated), own, stated))
    braked = jnp.max(experiments.brake, initial=0.0)
    set_up = [
        dataclasses.replace(setup(robot, braked), sides=robot.sides if sides is None else sides)
        for setup, sides in experiments.set_up
    ]
    robots = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x])[which], *set_up)
    result = jax.vmap(lambda r, c: operating_point(r, c)[0])(robots, conditions)
    every = jnp.stack([result.reading[c] for c in channels.names(robot.channels)], -1)
    held = np.array([setup is setups.blocked for setup, _ in experiments.set_up])[which]
    does = jnp.where(jnp.asarray(held), result.status == STALLED, done(result.status))
    first = 0
    for read, runs in experiments.read:
        rows = slice(first, first := first + runs)
        value = every[rows][:, list(read)]
        shown.append((value.ravel(), jnp.broadcast_to(does[rows, None], value.shape).ravel()))
    values, exists = zip(*(shown[k] for k in experiments.order), strict=True)
    speed = jnp.where(jnp.asarray(held), 0.0, result.reading["motor_speed"])
    return Predicted(
        jnp.concatenate(values), jnp.concatenate(exists), does, jnp.asarray(result.adhesion_used),
        jnp.asarray(result.winding_settled), speed,
    )  # fmt: skip


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
    """Sd of every reading [SI], repeats averaged; runs are read with the instruments of the table.

    Args:
        of_channels: sds of its channels [SI], by name.
    """
    found = [np.zeros(0)]
    for e in experiments:
        one = (
            [e.sd] * len(e.at)
            if isinstance(e, Act)
            else np.tile([of_channels[c] for c in e.channels], len(e.voltage))
        )
        found.append(np.asarray(one, float) / math.sqrt(e.repeats))
    return np.concatenate(found)
