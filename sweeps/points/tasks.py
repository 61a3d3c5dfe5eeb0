"""Task of every point of a sweep: a run of a fidelity, a run over a profile, or a climb."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping

from calibration.data import Columns, Json, Names
from mmrjax import fidelities
from mmrjax.fidelities import outputs
from mmrjax.fidelities.variation import FLAGS, Axis
from mmrjax.model import channels
from mmrjax.model.robot import Robot
from mmrjax.model.signals import FLAGS as LIMITS
from sweeps.config_campaign import SIZE, Campaign
from sweeps.points import climbs

Attributes = dict[str, Json]


@dataclasses.dataclass(frozen=True)
class Task:
    """Task of every point of a sweep.

    Attributes:
        model: name of the task.
        options: options of a fidelity.
        attributes: attributes of its outputs in a store, by name.
        usual: names of the default outputs.
        slow: True if a call takes long and reports progress.
        at_once: points per call, on processors and accelerators.
        axes: names that may vary and are neither a condition nor a parameter of the robot.
        further: function that returns conditions in addition to the varied and stated ones, and rejects impossible
            points.
        run: function that computes points, see `climbs.compute_climbs`. None: the program of the fidelity.
    """

    model: str
    options: Mapping[str, float]
    attributes: Attributes
    usual: Names
    slow: bool
    at_once: tuple[int, int]
    axes: Mapping[str, Axis] = dataclasses.field(default_factory=dict)
    further: Callable[[Columns, Robot, str], dict[str, float]] = lambda stated, robot, where: {}
    run: Callable[..., Json] | None = None


def task_of_configuration(config: Campaign, robot: Robot, turns: bool = False) -> Task:
    """Task of a configuration. `turns`: True if its profile drives the sides independently."""
    if config.obstacle is None:
        return run_task(config.model, config.options, robot, config.profile is not None, turns)
    obstacle, attributes = config.obstacle, climbs.climb_attributes(config.obstacle)
    own_options = (
        {SIZE: climbs.SIZES[obstacle.kind]},
        functools.partial(climbs.further_variation, obstacle),
        functools.partial(climbs.compute_climbs, obstacle),
    )
    return Task("climb", {}, attributes, tuple(attributes), True, climbs.AT_ONCE, *own_options)


def run_task(
    model: str, options: Mapping[str, float], robot: Robot, profiled: bool = False, turns: bool = False
) -> Task:
    """Task of a run. `profiled`: over a profile, with its totals as outputs. `turns`: with both sides."""
    facts, own_columns, usual = (
        fidelities.fidelity_facts(model),
        fidelities.get_fidelity(model).columns,
        channels.channel_names(robot.channels),
    )
    rows: dict[str, tuple[str, str]] = {r.name: (r.unit_shown, r.label) for r in outputs.output_table(robot.channels)}
    rows |= {name: ("", name.replace("_", " ")) for name in own_columns}
    if profiled:
        from mmrjax.missions import mission_batch  # imports an integrator

        output_names = (*mission_batch.OUTPUTS, *(mission_batch.OF_TURNS if turns else ()))
        rows, usual = {r.column: (r.unit, r.label) for r in output_names}, mission_batch.USUAL
    flags = {"flag_masks": [1 << k for k in range(len(LIMITS))], "flag_meanings": " ".join(LIMITS)}
    attributes: Attributes = {n: {"units": unit, "long_name": label} for n, (unit, label) in rows.items()}
    attributes[FLAGS] = {"long_name": "limits exceeded", **flags}
    at_once = facts.at_once(False), facts.at_once(True)
    return Task(model, options, attributes, usual, facts.slow and not profiled, at_once)
