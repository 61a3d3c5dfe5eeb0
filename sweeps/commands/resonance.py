"""The command `resonance`: ripple over speed and payload, and the speeds to avoid."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from calibration.data import Columns, Json
from calibration.data.input_errors import BadConfiguration
from mmrjax.errors import count_noun
from mmrjax.fidelities.track import track_batch
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES
from mmrjax.undercarriage.modes import Mode, modes
from mmrjax.undercarriage.ripple_peaks import (
    SIGNALS,
    PassingParts,
    RipplePeak,
    drop_unconfirmed_modes,
    find_crossings,
    passing_parts,
    peaks_over_speed,
    vibrations_of_runs,
)
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.config import GridPart
from sweeps.console import progress_bar
from sweeps.inputs import check_configurations, load_robot
from sweeps.pages import words
from sweeps.points import run, scale
from sweeps.points.grid import grid_conditions
from sweeps.report import resonance_report
from sweeps.report.resonance_report import TOO_SLOW, ResonanceResult
from sweeps.store import RunFolder, finish_run_folder, open_folder, print_report

CHUNK = 96  # runs per call
FEWEST_VOLTAGES = 5  # fewest voltages for finding a peak
SHORTEST_RUN = 0.5  # duration of a run [s]


def execute(config: configuration.Resonance, invocation: configuration.FolderPart) -> int:
    """Maps the ripple of a robot and writes a run folder. Returns the exit code: 0 if done, 3 if some runs did not
    settle, or slid, tipped or failed.
    """
    file = load_robot(config)
    robot = file.robot
    capabilities.check_on_ground(robot, "resonance")
    name = config.configuration or robot.configurations.names[0]
    check_configurations(robot, (name,), "--configuration")
    config = config.model_copy(
        update={
            "configuration": name,
            "voltages_V": tuple(sorted(set(config.voltages_V))),
            "payloads_kg": tuple(sorted(set(config.payloads_kg))),
        }
    )
    voltages = config.voltages_V
    duration = config.options["duration"]
    if voltages[0] <= 0:
        raise BadConfiguration(f"--voltages: got {voltages[0]:g}; expected above 0 and up to 100, forward")
    if len(voltages) < FEWEST_VOLTAGES:
        values = count_noun(len(voltages), "value")
        raise BadConfiguration(
            f"--voltages: got {values}; expected at least {FEWEST_VOLTAGES}, to find peaks over speed"
        )
    if duration < SHORTEST_RUN:
        raise BadConfiguration(
            f"--duration: got {duration:g} s; expected at least {SHORTEST_RUN:g} s, so that grousers pass"
        )
    runs = grid_conditions(_speed_grid(config, config.voltages_V), robot)
    conditions = run.conditions_of_runs(robot, runs, config)
    run.check_fidelity_options(robot, conditions, config)
    with open_folder("resonance", config, robot, invocation, runs) as folder:
        passing = passing_parts(robot, robot.configurations.names.index(name))
        columns = _ripple_columns(folder, robot, conditions, config, passing)
        table = {**run.condition_table(robot, runs), **columns}
        result = _modes_and_peaks(config, robot, passing, table)
        folder.write_table("points.csv", table)
        rows = [{"payload_kg": peak, **mode._asdict()} for peak, modes in result.modes.items() for mode in modes]
        folder.write_table("modes.csv", _tuple_columns(rows, Mode))
        folder.write_table("peaks.csv", _tuple_columns([peak._asdict() for peak in result.peaks], RipplePeak))
        folder.write_json("result.json", result.to_json())
        page = print_report(resonance_report.resonance_document(result, file), file)
        manifest = {"seed": None, "statuses": result.statuses}
        solved = words.every_run_solved(result.statuses)
        return finish_run_folder(folder, manifest, page, solved)


def _speed_grid(config: configuration.Resonance, voltages: tuple[float, ...]) -> GridPart:
    assert config.configuration is not None
    return GridPart(
        configurations=(config.configuration,),
        voltages_V=voltages,
        payloads_kg=config.payloads_kg,
        slopes_deg=(config.slope_deg,),
        surface=config.surface,
    )


def _ripple_columns(
    folder: RunFolder, robot: Robot, conditions: Conditions, config: configuration.Resonance, passing: PassingParts
) -> Columns:
    """Ripple columns, computed in chunks. Chunks stored by an interrupted run are not simulated again."""
    run_count = conditions.shape[0]
    parts = []
    size = min(CHUNK, run_count)
    with progress_bar(run_count, quiet=False) as advance:
        for first in range(0, run_count, size):
            rows = np.minimum(np.arange(first, first + size), run_count - 1)
            count = min(size, run_count - first)
            name = f"chunk-{first // size:06d}"
            part = folder.chunk(name)
            if part is None:
                report_share = scale.share_counter(advance, count)
                chunk_conditions = jax.tree.map(lambda x, rows=rows: x[rows], conditions)
                options = {key: config.options[key] for key in ("duration", "step")}
                track_runs = track_batch(robot, chunk_conditions, rolling=True, progress=report_share, **options)
                part = {key: x[:count] for key, x in _ripple_of_batch(robot, track_runs, passing).items()}
                folder.keep_chunk(name, part)
                report_share(1.0)
            else:
                advance(count)
            parts.append(part)
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _ripple_of_batch(robot: Robot, track_runs: Any, passing: PassingParts) -> Columns:
    """Ripple of a batch of runs, in the units of the table."""
    vibrations = vibrations_of_runs(robot, track_runs, passing.pitch)
    status = np.array(STATUSES)[vibrations.status]
    is_too_slow = ~vibrations.read & np.isin(status, ("converged", "not_settled"))
    columns = {
        "status": np.where(is_too_slow, TOO_SLOW, status),
        "passing_Hz": vibrations.passing,
    }
    for name, signal in SIGNALS.items():
        columns |= {
            f"{name}_mean_{signal.unit}": vibrations.mean[name] / signal.factor,
            f"{name}_ripple_percent": 100 * vibrations.deviation[name],
            f"{name}_frequency_Hz": vibrations.frequency[name],
        }
    return columns


def _modes_and_peaks(
    config: configuration.Resonance, robot: Robot, passing: PassingParts, table: Columns
) -> ResonanceResult:
    """Natural frequencies at the middle voltage, and peaks and crossings at each payload."""
    assert config.configuration is not None
    middle_grid = _speed_grid(config, (config.voltages_V[len(config.voltages_V) // 2],))
    modes_of_payloads = modes(robot, run.conditions_of_runs(robot, grid_conditions(middle_grid, robot), config))
    by_payload = dict(zip(config.payloads_kg, modes_of_payloads, strict=True))
    ripple_peaks: list[RipplePeak] = []
    speed_range_of_payload: dict[float, tuple[float, float]] = {}
    for payload, modes_here in by_payload.items():
        rows = np.flatnonzero((table["payload_kg"] == payload) & (table["status"] == "converged"))
        rows = rows[np.argsort(table["speed_mean_mm_s"][rows])]
        if not len(rows):
            continue
        speed = table["speed_mean_mm_s"][rows] * MM
        for name in SIGNALS:
            ripple = table[f"{name}_ripple_percent"][rows] / 100
            frequency = table[f"{name}_frequency_Hz"][rows]
            ripple_peaks += peaks_over_speed(
                name, payload, speed, table["passing_Hz"][rows], ripple, frequency, modes_here
            )
        speed_range_of_payload[payload] = float(speed[0]), float(speed[-1])
    ripple_peaks = drop_unconfirmed_modes(ripple_peaks, by_payload)
    crossings = [
        c
        for payload_here, modes_here in speed_range_of_payload.items()
        for c in find_crossings(by_payload[payload_here], payload_here, passing.travel, *modes_here, ripple_peaks)
    ]
    return ResonanceResult(
        config.configuration,
        config.slope_deg,
        config.surface,
        passing,
        robot,
        table,
        by_payload,
        ripple_peaks,
        crossings,
    )


_COLUMNS = {
    "frequency": "frequency_Hz", "low": "low", "natural": "natural_Hz", "payload": "payload_kg", "speed": "speed_m_s",
}  # fmt: skip


def _tuple_columns(rows: list[Json], kind: type) -> Columns:
    """Columns, with units in their names, of a list of named tuples."""
    unit = "Hz" if kind is Mode else "m_s"
    keys = list(rows[0]) if rows else list(kind.__annotations__)
    names = _COLUMNS | {"low": f"low_{unit}", "high": f"high_{unit}"}
    return {names.get(key, key): np.array([row[key] for row in rows]) for key in keys}
