"""Job of a plan: the computation at each point, checked before the first one is simulated, and the layout of its
store.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Json, profiles
from calibration.data.input_errors import BadConfiguration, stated_word
from mmrjax import __version__, fidelities
from mmrjax.fidelities import outputs
from mmrjax.fidelities.variation import STATUS, Variation
from mmrjax.missions.profile import Profile
from mmrjax.model.conditions import OF_TURNS
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES
from sweeps import capabilities
from sweeps.config_campaign import Campaign
from sweeps.console import print_message
from sweeps.points import axes, scale
from sweeps.points.sampled_design import Blocks
from sweeps.points.tasks import Task, task_of_configuration
from sweeps.points.zarr_store import ABSENT, StoreLayout

#: Number of points that the fidelity checks before the first one is simulated.
CHECKED_POINTS = 48


def robot_for_turns(robot: Robot, conditions: Collection[str]) -> Robot:
    """Robot with instruments for both sides and yaw, if conditions of these names let it turn."""
    return robot if set(OF_TURNS).isdisjoint(conditions) else robot.showing_turns()


def prepare_job(config: Campaign, robot: Robot, plan: axes.SweepPlan, where: str) -> scale.Job:
    """Job of a resolved configuration.

    Raises:
        BadConfiguration: the fidelity lacks an output, or cannot simulate a point.
    """
    profile = None if config.profile is None else _profile(config.profile, robot, plan, where)
    task = task_of_configuration(config, robot, profile is not None and profile.turns)
    needed_parameters = {
        **{o.name: o.rests_on for o in outputs.output_table(robot.channels)},
        **capabilities.RESTS_ON,
    }
    for name in config.outputs:
        if config.outputs.count(name) > 1:
            raise BadConfiguration(f"{where}, outputs: got {name} twice; expected each once")
        if name in plan.design.names:
            raise BadConfiguration(f"{where}, outputs: got {name}, which is varied; expected outputs of a run")
        stated_word(name, task.attributes, f"{where}, outputs", most=3)
        if lacking := [n for n in robot.unknown(needed_parameters.get(name, ())) if n not in plan.design.names]:
            raise BadConfiguration(
                f"{where}, outputs: {name} cannot be computed, because the robot's file lacks {' and '.join(lacking)}"
            )
    assert config.chunk is not None
    blocks = Blocks.of(plan.design.shape, config.chunk)
    if profile is None and task.run is None:
        _check_with_fidelity(plan.varied(robot), task, plan)
    return scale.Job(robot, task, plan, config.outputs, config.storage, blocks, profile)


def _profile(name: str, robot: Robot, plan: axes.SweepPlan, where: str) -> Profile:
    """Profile that every point follows.

    Raises:
        BadData: for the same reasons as `profiles.read_profile`.
        BadConfiguration: it states a condition of the plan, surfaces, or a supply voltage although a point is on the
            battery.
    """
    source = profiles.read_profile(name)
    for note in source.notes:
        print_message(note)
    if source.surface is not None:
        raise BadConfiguration(
            f"{where}, profile: got {source.source}, which has a surface column; set it under conditions"
        )
    if source.begins:
        raise BadConfiguration(
            f"{where}, profile: got {source.source}, which has a start column; points start at rest"
        )
    for field in source.values:
        if field in (*plan.conditions, *plan.design.names):
            raise BadConfiguration(f"{where}, {field}: {source.source} contains it too; keep one of the two")
    on_battery = plan.conditions.get("battery", 0.0) or "battery" in plan.design.names
    source.check_supply(bool(on_battery))
    return source.profile(robot, plan.fixed())


def _check_with_fidelity(variation: Variation, task: Task, plan: axes.SweepPlan) -> None:
    """Lets the fidelity check points spread over the design, including its corners.

    Raises:
        BadConfiguration: the fidelity rejects a point.
    """
    fidelity = fidelities.get_fidelity(task.model)
    shape = plan.design.shape
    corner_starts = itertools.product(*({0, n - 1} for n in shape[:4]))
    corners = [(*start, *(0 for _ in shape[4:])) for start in corner_starts]
    evenly_spaced = np.linspace(0, plan.design.points - 1, CHECKED_POINTS).astype(np.int64)
    numbers = np.unique([*evenly_spaced, *(int(np.ravel_multi_index(c, shape)) for c in corners)])
    for values in plan.design.at(numbers):
        robot, conditions = variation.at(jnp.asarray(values), plan.fixed())
        try:
            fidelity.check(robot, jax.tree.map(lambda x: jnp.asarray(x)[None], conditions), task.options)
        except ValueError as error:
            point_text = ", ".join(f"{n} {v:g}" for n, v in zip(plan.design.names, values, strict=True))
            raise BadConfiguration(f"--model {task.model}: at {point_text}: {error}") from error


def store_layout(config: Campaign, job: scale.Job) -> StoreLayout:
    """Arrays in the store of a job, with units and long names."""
    attributes = job.task.attributes
    variables = {
        n: (scale.STORED_TYPES.get(n, config.storage), _store_attributes(attributes[n])) for n in job.outputs
    }
    flag_attributes = {
        "flag_values": [*range(len(STATUSES)), ABSENT],
        "flag_meanings": " ".join((*STATUSES, "absent")),
    }
    variables[STATUS] = scale.STORED_TYPES[STATUS], {"long_name": "status of the run", **flag_attributes}
    coordinates = {
        n: _store_attributes({"units": axis.unit, "long_name": axis.meaning}) for n, axis in job.plan.axes.items()
    }
    coordinates.get(axes.CONFIGURATION, {}).pop("units", None)
    labels = {axes.CONFIGURATION: job.robot.configurations.names}
    group_attributes = {"title": "sweep of a robot", "source": f"mmrjax {__version__}, {job.task.model}"}
    return StoreLayout(
        job.plan.design, job.blocks, variables, coordinates, labels, group_attributes, config.compression
    )


def _store_attributes(attributes: Json) -> Json:
    """Attributes as in a store, with unit 1 for quantities without unit."""
    return {**attributes, "units": "1"} if attributes.get("units") in ("-", "") else attributes
