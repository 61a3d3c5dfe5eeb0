"""The command `climb`: a robot climbs an obstacle, or the largest obstacle that it can climb is found."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from calibration.data import terrains
from calibration.data.contradictions import reason_without_levers
from calibration.data.input_errors import BadConfiguration
from mmrjax.climbing import climb_simulation, terrain
from mmrjax.climbing.climb_derivatives import ClimbDerivatives, ClimbInputs, climb_derivatives
from mmrjax.climbing.climb_simulation import ClimbRuns, LeverSequence, climb_batch
from mmrjax.climbing.terrain import Terrain
from mmrjax.errors import similar_words
from mmrjax.fidelities.variation import Variation
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import adhesion_ratio
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.config_campaign import SIZE
from sweeps.inputs import check_configurations, load_robot
from sweeps.points import scale
from sweeps.points.tasks import NEAR, SLOW, SOUGHT, climb_refusal
from sweeps.report import climb_report
from sweeps.report.climb_report import Along, ClimbResult
from sweeps.store import finish_run_folder, open_folder, print_report

#: Size of an obstacle [mm], None if it has none or is searched, its terrain by size, and its description.
Obstacle = tuple[float | None, Callable[[Scalar], Terrain], str]
#: Number of runs in a round of a search.
ROUND = 12
#: Widths over which slopes are fitted, in the units of the axes. Other variables: share of their value.
WIDTHS, WIDTH = {"payload": 0.2, "levers_front_deg": 1.0, "levers_rear_deg": 1.0, SIZE: 1.0}, 0.02


def execute(config: configuration.Climb, beside: configuration.FolderPart) -> int:
    """Simulates a climb and writes a run folder. Returns the exit code: 0 for any verdict, 3 if numbers are not
    finite.
    """
    file = load_robot(config)
    robot = file.robot
    if (why := climb_refusal(robot)) is not None:
        raise BadConfiguration(f"climb: {why}")
    name = config.configuration or robot.configurations.names[0]
    check_configurations(robot, (name,), "--configuration")
    if config.battery:
        capabilities.check_battery(robot)
    voltage = SLOW if config.supply_voltage_V is None else config.supply_voltage_V
    config = config.model_copy(
        update={"configuration": name, "supply_voltage_V": None if config.battery else voltage}
    )
    sequence = _lever_sequence(config, robot, name)
    obstacle = _obstacle(config)
    conditions = Conditions(
        name, voltage, payload=config.payload_kg, battery=config.battery, discharge=3.6 * config.discharge_mAh,
        adhesion=adhesion_ratio(config.surface, bool(np.asarray(robot.configurations[name].on_tracks) > 0.5)),
    ).resolved(robot)  # fmt: skip
    derivative_variables = _derivative_variables(config, robot, conditions, sequence, obstacle)
    with open_folder("climb", config, robot, beside) as folder:
        climbed = _climb_of_configuration(config, robot, obstacle, conditions, sequence, derivative_variables)
        folder.write_table("history.csv", climbed.table)
        if rows := climbed.slopes:
            folder.write_table("derivatives.csv", {name: np.array([row[name] for row in rows]) for name in rows[0]})
        folder.write_json("result.json", climbed.to_json())
        document = print_report(climb_report.climb_document(climbed, file), file)
        manifest = {"seed": None, "verdict": climbed.verdict}
        return finish_run_folder(folder, manifest, document, climbed.verdict != "failed")


def _climb_of_configuration(
    config: configuration.Climb,
    robot: Robot,
    obstacle: Obstacle,
    conditions: Conditions,
    sequence: LeverSequence,
    along: Along | None,
) -> ClimbResult:
    """The climb of a configuration: over one obstacle, a search for the largest one, or with derivatives."""

    def run(sizes: np.ndarray) -> tuple[Terrain, ClimbRuns]:
        grounds = jax.tree.map(lambda *x: jnp.stack(x), *(make(float(size)) for size in sizes))
        alike = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * len(sizes)), (conditions, sequence))
        with scale.share_progress() as told:
            return grounds, climb_batch(robot, alike[0], grounds, alike[1], progress=told, **integration)

    size, make, words = obstacle
    integration: Any = {"duration": config.duration_s, "step": config.time_step_s}
    shown_index, largest = 0, None
    tried: tuple[tuple[float, str], ...] = ()
    derivatives: ClimbDerivatives | None = None
    if config.find is not None:
        grounds, all_climbs, shown_index, tried, largest = _search_largest(config.find, run)
    elif along is None:
        grounds, all_climbs = run(np.array([size], float))  # NaN for a terrain
    else:
        with scale.share_progress() as told:
            derivatives = climb_derivatives(along.given, along.values, along.widths, progress=told, **integration)
        all_climbs = derivatives.climb
        grounds = jax.tree.map(lambda x: x[None], along.given(along.values).terrain)
    one = jax.tree.map(lambda x: x[shown_index : shown_index + 1], all_climbs)
    return ClimbResult(
        robot, str(config.configuration), words, jax.tree.map(lambda x: x[shown_index], grounds), one, tried, largest,
        {"step": "step", "stairs": "rise of such stairs", "gap": "gap", None: ""}[config.find],
        along, derivatives,
    )  # fmt: skip


def _derivative_variables(
    config: configuration.Climb, robot: Robot, conditions: Conditions, sequence: LeverSequence, obstacle: Obstacle
) -> Along | None:
    """Variables with respect to which derivatives are computed. None: no derivatives.

    Raises:
        BadConfiguration: a name is unknown or has no effect on this climb.
    """
    names = config.derivatives
    if not names:
        return None
    size, make, _ = obstacle
    levers = {"levers_front_deg": "front", "levers_rear_deg": "rear"}
    variables = ["adhesion", "payload", "discharge" if config.battery else "voltage"]
    levers_move = sequence.begins is None and not reason_without_levers(robot, config.configuration or "")
    variables += [*(levers if levers_move else ()), *([SIZE] if size is not None else [])]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise BadConfiguration(f"--derivatives: got {name} twice; expected each once")
        if name not in variables and name not in (parameter_names := [p.name for p in params.walk_parameters(robot)]):
            meant = " or ".join(similar_words(name, (*variables, *parameter_names), 2))
            raise BadConfiguration(
                f"--derivatives: got {name}; expected {', '.join(variables)} or a parameter of the robot"
                + (f"; did you mean {meant}?" if meant else "")
            )
    of_run = tuple(name for name in names if name not in (*levers, SIZE))
    variation = Variation(robot, of_run)
    axes = variation.axes
    usual = {name: float(np.asarray(getattr(conditions, name))) for name in of_run if hasattr(conditions, name)}
    usual |= {name: a.value for name, a in axes.items() if name not in usual and a.value is not None}
    usual |= {name: float(np.degrees(np.asarray(getattr(sequence, end))[0])) for name, end in levers.items()}
    usual |= {SIZE: size} if size is not None else {}
    units = {name: a.unit for name, a in axes.items()} | dict.fromkeys(levers, "deg") | {SIZE: "mm"}

    def given(values: Array) -> ClimbInputs:
        value_of = dict(zip(names, values, strict=True))
        changed_robot, run = variation.at(
            jnp.stack([value_of[name] for name in of_run] or [jnp.zeros(())]), conditions
        )
        levers_move = {
            end: getattr(sequence, end) + jnp.radians(value_of[name] - usual[name])
            for name, end in levers.items()
            if name in value_of
        }
        ground = make(value_of.get(SIZE, size or 0.0))
        return ClimbInputs(changed_robot, run, ground, dataclasses.replace(sequence, **levers_move))

    values = [usual[name] for name in names]
    widths = [WIDTHS.get(name, WIDTH * abs(value) or 1.0) for name, value in zip(names, values, strict=True)]
    return Along(names, tuple(units[name] for name in names), jnp.array(values), jnp.array(widths), given)


def _search_largest(
    what: str, run: Callable[[np.ndarray], tuple[Terrain, ClimbRuns]]
) -> tuple[Terrain, ClimbRuns, int, tuple[tuple[float, str], ...], float | None]:
    """Largest size of an obstacle that is climbed [mm], by rounds of sizes in parallel.

    Each round divides the interval above the largest size up to which all were climbed. The run of the largest
    climbed size, or of the smallest size tried, is reported.
    """
    low, high = SOUGHT[what]
    sizes = np.linspace(low, high, ROUND)
    verdict_of_size: dict[float, str] = {}
    largest_climbed: tuple[Terrain, ClimbRuns, int] | None = None
    while True:
        grounds, climb_runs = run(sizes)
        verdict_of_size |= {float(s): v for s, v in zip(sizes, climb_runs.names, strict=True)}
        order = sorted(verdict_of_size)
        missed = next((k for k, s in enumerate(order) if verdict_of_size[s] != "over"), len(order))
        best, larger = order[missed - 1] if missed else None, order[missed:]
        if largest_climbed is None or best in sizes:
            largest_climbed = grounds, climb_runs, int(np.flatnonzero(sizes == best)[0]) if best in sizes else 0
        if best is None or not larger or larger[0] - best <= NEAR:
            return *largest_climbed, tuple(sorted(verdict_of_size.items())), best
        inner = np.linspace(best, larger[0], ROUND + 2)[1:-1]
        sizes = np.unique(np.round(inner, 1))


def _obstacle(config: configuration.Climb) -> Obstacle:
    """Obstacle of a configuration."""
    nose = config.nose_mm / 1000
    if config.terrain is not None:
        ground = terrains.read_terrain(config.terrain)
        return None, lambda _: ground, f"the terrain of {config.terrain.name}"
    if config.stairs is not None:
        rise, tread, count = terrains.parse_stairs(config.stairs)
        if nose >= min(rise, tread) / 2:
            raise BadConfiguration(
                f"--nose: got {config.nose_mm:g} mm; expected less than half of rise and tread, "
                f"{500 * min(rise, tread):g} mm"
            )
        size = f"{1e3 * tread:g} mm tread" if config.find else f"{1e3 * rise:g} x {1e3 * tread:g} mm"
        return 1e3 * rise, lambda s: terrain.stairs(s / 1000, tread, count, nose), f"{count} stairs of {size}"
    is_gap = config.gap_mm is not None or config.find == "gap"
    size_mm, words = (config.gap_mm, "a gap") if is_gap else (config.step_mm, "a step")
    make = lambda s: terrain.gap(s / 1000) if is_gap else terrain.single_step(s / 1000, nose)  # noqa: E731
    return size_mm, make, words if size_mm is None else f"{words} of {size_mm:g} mm"


def _lever_sequence(config: configuration.Climb, robot: Robot, name: str) -> LeverSequence:
    """Motion of the levers.

    Raises:
        BadConfiguration: the configuration has no levers, an angle is beyond their range, or a lever begins below the
            ground.
    """
    lever_options = config.sequence, config.levers_front_deg, config.levers_rear_deg
    gear = robot.running_gear
    tracked = bool(np.asarray(robot.configurations[name].on_tracks) > 0.5)
    if not tracked and lever_options != (None, None, None):
        raise BadConfiguration(f"--levers-front, --levers-rear, --sequence: {reason_without_levers(robot, name)}")
    usual = np.degrees(np.asarray(gear.lever_front)), 180 - np.degrees(np.asarray(gear.lever_rear))
    angles = []
    for option, stated, angle in zip(("--levers-front", "--levers-rear"), lever_options[1:], usual, strict=True):
        if stated is not None and (why := terrains.lever_angle_refusal(robot, stated)):
            raise BadConfiguration(f"{option}: {why}")
        angles.append(float(np.radians(angle if stated is None else stated)))
    if config.sequence is None:
        sequence = climb_simulation.constant_angles(*angles)
    else:
        sequence = terrains.read_sequence(config.sequence, robot, (angles[0], angles[1]))
        if sequence.begins is None and lever_options[1:] != (None, None):
            raise BadConfiguration(
                f"--levers-front, --levers-rear: {config.sequence.name} gives all angles; use these options only "
                "with front_V, rear_V"
            )
    if config.levers_voltage_V is not None:
        sequence = dataclasses.replace(sequence, supply=jnp.asarray(config.levers_voltage_V))
    if tracked:
        first_angles = sequence.first[0], np.pi - sequence.first[1]
        for end, angle in zip(("front", "rear"), first_angles, strict=True):
            if why := terrains.lever_start_refusal(robot, float(np.degrees(angle))):
                raise BadConfiguration(f"levers {end}: {why}")
    return sequence
