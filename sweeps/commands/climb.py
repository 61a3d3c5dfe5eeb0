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
from sweeps.points.tasks import DEFAULT_VOLTAGE, SEARCH_INTERVALS, SEARCH_TOLERANCE, climb_refusal
from sweeps.report import climb_report
from sweeps.report.climb_report import ClimbResult, DerivativeVariables
from sweeps.store import finish_run_folder, open_folder, print_report

#: Size of an obstacle [mm], None if it has none or is searched, its terrain by size, and its description.
Obstacle = tuple[float | None, Callable[[Scalar], Terrain], str]
#: Number of runs in a round of a search.
SIZES_PER_ROUND = 12
#: Widths over which slopes are fitted, in the units of the axes. Other variables: share of their value.
SLOPE_WIDTHS, RELATIVE_WIDTH = {"payload": 0.2, "levers_front_deg": 1.0, "levers_rear_deg": 1.0, SIZE: 1.0}, 0.02


def execute(config: configuration.Climb, invocation: configuration.FolderPart) -> int:
    """Simulates a climb and writes a run folder. Returns the exit code: 0 for any verdict, 3 if numbers are not
    finite.
    """
    file = load_robot(config)
    robot = file.robot
    if (reason := climb_refusal(robot)) is not None:
        raise BadConfiguration(f"climb: {reason}")
    name = config.configuration or robot.configurations.names[0]
    check_configurations(robot, (name,), "--configuration")
    if config.battery:
        capabilities.check_battery(robot)
    voltage = DEFAULT_VOLTAGE if config.supply_voltage_V is None else config.supply_voltage_V
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
    with open_folder("climb", config, robot, invocation) as folder:
        result = _climb_of_configuration(config, robot, obstacle, conditions, sequence, derivative_variables)
        folder.write_table("history.csv", result.table)
        if rows := result.slopes:
            folder.write_table("derivatives.csv", {name: np.array([row[name] for row in rows]) for name in rows[0]})
        folder.write_json("result.json", result.to_json())
        page = print_report(climb_report.climb_document(result, file), file)
        manifest = {"seed": None, "verdict": result.verdict}
        return finish_run_folder(folder, manifest, page, result.verdict != "failed")


def _climb_of_configuration(
    config: configuration.Climb,
    robot: Robot,
    obstacle: Obstacle,
    conditions: Conditions,
    sequence: LeverSequence,
    variables: DerivativeVariables | None,
) -> ClimbResult:
    """The climb of a configuration: over one obstacle, a search for the largest one, or with derivatives."""

    def run(sizes: np.ndarray) -> tuple[Terrain, ClimbRuns]:
        grounds = jax.tree.map(lambda *x: jnp.stack(x), *(terrain_of_size(float(size)) for size in sizes))
        repeated_inputs = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * len(sizes)), (conditions, sequence))
        with scale.share_progress() as report_share:
            return grounds, climb_batch(
                robot, repeated_inputs[0], grounds, repeated_inputs[1], progress=report_share, **integration
            )

    size, terrain_of_size, description = obstacle
    integration: Any = {"duration": config.duration_s, "step": config.time_step_s}
    shown_index, largest_climbed = 0, None
    tried: tuple[tuple[float, str], ...] = ()
    derivatives: ClimbDerivatives | None = None
    if config.find is not None:
        grounds, all_climbs, shown_index, tried, largest_climbed = _search_largest(config.find, run)
    elif variables is None:
        grounds, all_climbs = run(np.array([size], float))  # NaN for a terrain
    else:
        with scale.share_progress() as report_share:
            derivatives = climb_derivatives(
                variables.inputs, variables.values, variables.widths, progress=report_share, **integration
            )
        all_climbs = derivatives.climb
        grounds = jax.tree.map(lambda x: x[None], variables.inputs(variables.values).terrain)
    shown_climb = jax.tree.map(lambda x: x[shown_index : shown_index + 1], all_climbs)
    return ClimbResult(
        robot, str(config.configuration), description, jax.tree.map(lambda x: x[shown_index], grounds), shown_climb,
        tried, largest_climbed,
        {"step": "step", "stairs": "rise of such stairs", "gap": "gap", None: ""}[config.find],
        variables, derivatives,
    )  # fmt: skip


def _derivative_variables(
    config: configuration.Climb, robot: Robot, conditions: Conditions, sequence: LeverSequence, obstacle: Obstacle
) -> DerivativeVariables | None:
    """Variables with respect to which derivatives are computed. None: no derivatives.

    Raises:
        BadConfiguration: a name is unknown or has no effect on this climb.
    """
    names = config.derivatives
    if not names:
        return None
    size, terrain_of_size, _ = obstacle
    levers = {"levers_front_deg": "front", "levers_rear_deg": "rear"}
    allowed = ["adhesion", "payload", "discharge" if config.battery else "voltage"]
    has_angles = sequence.begins is None and not reason_without_levers(robot, config.configuration or "")
    allowed += [*(levers if has_angles else ()), *([SIZE] if size is not None else [])]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise BadConfiguration(f"--derivatives: got {name} twice; expected each once")
        if name not in allowed and name not in (parameter_names := [p.name for p in params.walk_parameters(robot)]):
            suggestions = " or ".join(similar_words(name, (*allowed, *parameter_names), 2))
            raise BadConfiguration(
                f"--derivatives: got {name}; expected {', '.join(allowed)} or a parameter of the robot"
                + (f"; did you mean {suggestions}?" if suggestions else "")
            )
    run_names = tuple(name for name in names if name not in (*levers, SIZE))
    variation = Variation(robot, run_names)
    axes = variation.axes
    values_now = {
        name: float(np.asarray(getattr(conditions, name))) for name in run_names if hasattr(conditions, name)
    }
    values_now |= {
        name: axis.value for name, axis in axes.items() if name not in values_now and axis.value is not None
    }
    values_now |= {name: float(np.degrees(np.asarray(getattr(sequence, pair))[0])) for name, pair in levers.items()}
    values_now |= {SIZE: size} if size is not None else {}
    units = {name: axis.unit for name, axis in axes.items()} | dict.fromkeys(levers, "deg") | {SIZE: "mm"}

    def inputs(values: Array) -> ClimbInputs:
        value_by_name = dict(zip(names, values, strict=True))
        changed_robot, run_conditions = variation.at(
            jnp.stack([value_by_name[name] for name in run_names] or [jnp.zeros(())]), conditions
        )
        moved_angles = {
            pair: getattr(sequence, pair) + jnp.radians(value_by_name[name] - values_now[name])
            for name, pair in levers.items()
            if name in value_by_name
        }
        ground = terrain_of_size(value_by_name.get(SIZE, size or 0.0))
        return ClimbInputs(changed_robot, run_conditions, ground, dataclasses.replace(sequence, **moved_angles))

    values = [values_now[name] for name in names]
    widths = [
        SLOPE_WIDTHS.get(name, RELATIVE_WIDTH * abs(value) or 1.0) for name, value in zip(names, values, strict=True)
    ]
    return DerivativeVariables(
        names, tuple(units[name] for name in names), jnp.array(values), jnp.array(widths), inputs
    )


def _search_largest(
    kind: str, run: Callable[[np.ndarray], tuple[Terrain, ClimbRuns]]
) -> tuple[Terrain, ClimbRuns, int, tuple[tuple[float, str], ...], float | None]:
    """Largest size of an obstacle that is climbed [mm], by rounds of sizes in parallel.

    Each round divides the interval above the largest size up to which all were climbed. The run of the largest
    climbed size, or of the smallest size tried, is reported.
    """
    low, high = SEARCH_INTERVALS[kind]
    sizes = np.linspace(low, high, SIZES_PER_ROUND)
    verdict_of_size: dict[float, str] = {}
    largest_climbed: tuple[Terrain, ClimbRuns, int] | None = None
    while True:
        grounds, climb_runs = run(sizes)
        verdict_of_size |= {float(s): v for s, v in zip(sizes, climb_runs.names, strict=True)}
        tried_sizes = sorted(verdict_of_size)
        first_missed = next((k for k, s in enumerate(tried_sizes) if verdict_of_size[s] != "over"), len(tried_sizes))
        largest_size = tried_sizes[first_missed - 1] if first_missed else None
        larger_sizes = tried_sizes[first_missed:]
        if largest_climbed is None or largest_size in sizes:
            largest_climbed = (
                grounds,
                climb_runs,
                int(np.flatnonzero(sizes == largest_size)[0]) if largest_size in sizes else 0,
            )
        if largest_size is None or not larger_sizes or larger_sizes[0] - largest_size <= SEARCH_TOLERANCE:
            return *largest_climbed, tuple(sorted(verdict_of_size.items())), largest_size
        sizes_between = np.linspace(largest_size, larger_sizes[0], SIZES_PER_ROUND + 2)[1:-1]
        sizes = np.unique(np.round(sizes_between, 1))


def _obstacle(config: configuration.Climb) -> Obstacle:
    """Obstacle of a configuration."""
    nose = config.nose_mm / 1000
    if config.terrain is not None:
        terrain_read = terrains.read_terrain(config.terrain)
        return None, lambda _: terrain_read, f"the terrain of {config.terrain.name}"
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
    size_mm, description = (config.gap_mm, "a gap") if is_gap else (config.step_mm, "a step")
    terrain_of_size = lambda s: terrain.gap(s / 1000) if is_gap else terrain.single_step(s / 1000, nose)  # noqa: E731
    return size_mm, terrain_of_size, description if size_mm is None else f"{description} of {size_mm:g} mm"


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
    default_angles = np.degrees(np.asarray(gear.lever_front)), 180 - np.degrees(np.asarray(gear.lever_rear))
    angles = []
    for option, requested, angle in zip(
        ("--levers-front", "--levers-rear"), lever_options[1:], default_angles, strict=True
    ):
        if requested is not None and (reason := terrains.lever_angle_refusal(robot, requested)):
            raise BadConfiguration(f"{option}: {reason}")
        angles.append(float(np.radians(angle if requested is None else requested)))
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
            if reason := terrains.lever_start_refusal(robot, float(np.degrees(angle))):
                raise BadConfiguration(f"levers {end}: {reason}")
    return sequence
