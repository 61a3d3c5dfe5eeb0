"""Predicted readings of all experiments of a menu for one robot, in one batch."""

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

from calibration.data import Names
from calibration.discovery import menu
from calibration.discovery.menu import CalibrationAct, Experiment, ProposedRuns, Setup
from mmrjax.fidelities.steady import IMPLICIT
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STALLED, is_done

T = TypeVar("T")
#: Mass of a robot on stands [kg]: nearly zero, but its ratio to the load is defined.
UNLOADED = 1e-9


class ExperimentBatch(eqx.Module):
    """Experiments as one batch. The compiled program depends on their kinds and sizes, not on their conditions.

    Attributes:
        acts: reading function of each calibration.
        settings: settings of each calibration, see `CalibrationAct`.
        conditions: conditions of the runs of all experiments, in order, shape (runs,).
        brake: torque of the brake in each run [N·m].
        setups: distinct pairs of a setup and a number of motors that are on.
        setup_indices: index of each run's pair in `setups`.
        channel_indices: positions of the channels to read in each run experiment, and its number of runs.
    """

    acts: tuple[Callable[[Robot, Array], Array], ...] = eqx.field(static=True)
    settings: tuple[Array, ...]
    conditions: Conditions
    brake: Float[Array, " runs"]
    setups: tuple[tuple[Setup, int | None], ...] = eqx.field(static=True)
    setup_indices: tuple[int, ...] = eqx.field(static=True)
    channel_indices: tuple[tuple[tuple[int, ...], int], ...] = eqx.field(static=True)


class MenuPrediction(eqx.Module):
    """Predicted readings of a batch of experiments.

    Attributes:
        value: value of each reading [SI].
        exists: True if the robot gives that reading, False if it slides or stalls in the run, shape (readings,).
        feasible: True for each run that the robot can do.
        grip: used share of the adhesion in each run [-].
        temperature: winding temperature after a long time in each run [°C].
        speed: speed of the motor shaft in each run [rad/s], shape (runs,).
    """

    value: Float[Array, " readings"]
    exists: Bool[Array, " readings"]
    feasible: Bool[Array, " runs"]
    grip: Float[Array, " runs"]
    temperature: Float[Array, " runs"]
    speed: Float[Array, " runs"]


def batch_experiments(experiments: Sequence[Experiment], channel_names: Names) -> ExperimentBatch:
    """Collects experiments in one batch, for a robot with these channels. Calibrations come first."""
    acts = [e for e in experiments if isinstance(e, CalibrationAct)]
    runs = [e for e in experiments if isinstance(e, ProposedRuns)]
    setups = list(dict.fromkeys((r.setup, r.sides) for r in runs))
    run_counts = [(r, len(r.voltage)) for r in runs]
    run_conditions = [jax.tree.map(lambda x: np.atleast_1d(x), _conditions_of_runs(r)) for r in runs]
    return ExperimentBatch(
        acts=tuple(a.reading for a in acts),
        settings=tuple(jnp.asarray(a.at, float) for a in acts),
        conditions=jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *run_conditions),
        brake=jnp.asarray(np.concatenate([np.full(n, r.brake) for r, n in run_counts])),
        setups=tuple(setups),
        setup_indices=tuple(k for r, n in run_counts for k in [setups.index((r.setup, r.sides))] * n),
        channel_indices=tuple((tuple(channel_names.index(c) for c in r.channels), n) for r, n in run_counts),
    )


def _conditions_of_runs(run: ProposedRuns) -> Conditions:
    # None would mean the robot's own mass, which cannot be in a batch with other masses.
    mass = UNLOADED if run.setup in menu.WEIGHTLESS else math.nan
    torque = run.torque or None
    levels: dict[str, Any] = {"voltage": 0.0, run.reach.imposed: run.voltage}
    return Conditions(
        run.configuration, slope_deg=run.slope, payload=run.payload, total_mass=mass, load_torque=torque, **levels
    )


def map_over_runs(
    function: Callable[..., T], robot: Robot, experiments: ExperimentBatch, *values_of_runs: Array
) -> T:
    """Applies `function` to the robot as set up for each run, to its conditions and to further values of each run.
    The first axis of the result is the run.
    """
    conditions = experiments.conditions
    mass = jax.vmap(lambda k: robot.chassis(k).mass)(conditions.configuration) + conditions.payload
    total_mass = jnp.asarray(conditions.total_mass)
    conditions = dataclasses.replace(conditions, total_mass=jnp.where(jnp.isnan(total_mass), mass, total_mass))
    brake_torque = jnp.max(experiments.brake, initial=0.0)
    robots_of_setups = [
        dataclasses.replace(setup(robot, brake_torque), sides=robot.sides if sides is None else sides)
        for setup, sides in experiments.setups
    ]
    index = np.asarray(experiments.setup_indices)

    def all_identical(*x: Any) -> bool:  # in all setups
        return all(v is x[0] for v in x)

    robots = jax.tree.map(
        lambda *x: x[0] if all_identical(*x) else jnp.stack([jnp.asarray(v) for v in x])[index], *robots_of_setups
    )
    axes = jax.tree.map(lambda *x: None if all_identical(*x) else 0, *robots_of_setups)
    return jax.vmap(function, in_axes=(axes, 0, *[0] * len(values_of_runs)))(robots, conditions, *values_of_runs)


def predict_readings(
    robot: Robot, experiments: ExperimentBatch, unknowns: Float[Array, "runs unknowns"], solved: Bool[Array, " runs"]
) -> tuple[tuple[tuple[Array, ...], Array, Array], MenuPrediction]:
    """Predicted readings of a batch.

    Returns the readings of each calibration, the readings of each run, shape (runs, channels), the residuals of the
    equations, shape (runs, unknowns), and all predictions.

    Args:
        unknowns: solution of the equations of each run.
        solved: True if the solver converged.
    """
    acts = tuple(act(robot, settings) for act, settings in zip(experiments.acts, experiments.settings, strict=True))
    result, _, residual = map_over_runs(IMPLICIT.results_at, robot, experiments, unknowns, solved)
    all_readings = jnp.stack([result.reading[c] for c in channels.channel_names(robot.channels)], -1)
    is_locked = np.array([experiments.setups[k][0] is menu.locked for k in experiments.setup_indices])
    feasible = jnp.where(jnp.asarray(is_locked), result.status == STALLED, is_done(result.status))
    exists = arrange_readings(
        experiments, [jnp.ones(a.shape, bool) for a in acts], jnp.broadcast_to(feasible[:, None], all_readings.shape)
    )
    speed = jnp.where(jnp.asarray(is_locked), 0.0, result.reading["motor_speed"])
    prediction = MenuPrediction(
        arrange_readings(experiments, acts, all_readings), exists, feasible, jnp.asarray(result.adhesion_used),
        jnp.asarray(result.winding_settled), speed,
    )  # fmt: skip
    return (acts, all_readings, residual), prediction


def arrange_readings(
    experiments: ExperimentBatch, acts: Sequence[Array], readings: Float[Array, "runs channels ..."]
) -> Array:
    """Readings of calibrations and runs, in the order of the experiments."""
    arrays = list(acts)
    first = 0
    for indices, count in experiments.channel_indices:
        of_runs = readings[first : (first := first + count)][:, list(indices)]
        arrays.append(of_runs.reshape(-1, *readings.shape[2:]))
    return jnp.concatenate(arrays)


# --- positions --------------------------------------------------------------------------------------


def reading_count(experiment: Experiment) -> int:
    """Number of readings of an experiment. Repeated readings are averaged and count once."""
    if isinstance(experiment, CalibrationAct):
        return len(experiment.at)
    return len(experiment.voltage) * len(experiment.channels)


def reading_spans(experiments: Sequence[Experiment]) -> dict[str, slice]:
    """Slice of each experiment in the array of all readings."""
    ends = np.cumsum([reading_count(e) for e in experiments]).tolist()
    return {e.name: slice(end - reading_count(e), end) for e, end in zip(experiments, ends, strict=True)}


def reading_sds(experiments: Sequence[Experiment], channel_sds: Mapping[str, float]) -> np.ndarray:
    """Standard deviation of each reading after averaging its repeats [SI].

    Runs and zero readings use the instruments of the table.

    Args:
        channel_sds: standard deviation of each channel of the table [SI], by name.
    """
    sds = [np.zeros(0)]
    for e in experiments:
        if isinstance(e, ProposedRuns):
            single_sds = [channel_sds[c] for c in e.channels] * len(e.voltage)
        else:
            single_sds = [channel_sds[e.channel] if e.sd is None else e.sd] * len(e.at)
        sds.append(np.array(single_sds) / math.sqrt(e.repeats))
    return np.concatenate(sds)
