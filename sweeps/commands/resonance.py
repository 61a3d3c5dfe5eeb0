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
from sweeps.report.resonance_report import SLOW, ResonanceResult
from sweeps.store import RunFolder, finish_run_folder, open_folder, print_report

CHUNK = 96  # runs per call
FEWEST = 5  # fewest voltages for finding a peak
SHORTEST = 0.5  # duration of a run [s]


def execute(config: configuration.Resonance, beside: configuration.FolderPart) -> int:
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
    voltages, duration = config.voltages_V, config.options["duration"]
    if voltages[0] <= 0:
        raise BadConfiguration(f"--voltages: got {voltages[0]:g}; expected above 0 and up to 100, forward")
    if len(voltages) < FEWEST:
        values = count_noun(len(voltages), "value")
        raise BadConfiguration(f"--voltages: got {values}; expected at least {FEWEST}, to find peaks over speed")
    if duration < SHORTEST:
        raise BadConfiguration(
            f"--duration: got {duration:g} s; expected at least {SHORTEST:g} s, so that grousers pass"
        )
    runs = grid_conditions(_speed_grid(config, config.voltages_V), robot)
    conditions = run.conditions_of_runs(robot, runs, config)
    run.check_runs_bearable(robot, conditions, config)
    with open_folder("resonance", config, robot, beside, runs) as folder:
        parts_words = passing_parts(robot, robot.configurations.names.index(name))
        columns = _ripple_columns(folder, robot, conditions, config, parts_words)
        table = {**run.condition_table(robot, runs), **columns}
        result = _modes_and_peaks(config, robot, parts_words, table)
        folder.write_table("points.csv", table)
        rows = [{"payload_kg": p, **m._asdict()} for p, modes in result.modes.items() for m in modes]
        folder.write_table("modes.csv", _tuple_columns(rows, Mode))
        folder.write_table("peaks.csv", _tuple_columns([p._asdict() for p in result.peaks], RipplePeak))
        folder.write_json("result.json", result.to_json())
        document = print_report(resonance_report.resonance_document(result, file), file)
        manifest, solved = {"seed": None, "statuses": result.statuses}, words.every_run_solved(result.statuses)
        return finish_run_folder(folder, manifest, document, solved)


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
    folder: RunFolder, robot: Robot, conditions: Conditions, config: configuration.Resonance, what: PassingParts
) -> Columns:
    """Ripple columns, computed in chunks. Chunks stored by an interrupted run are not simulated again."""
    total, parts = conditions.shape[0], []
    size = min(CHUNK, total)
    with progress_bar(total, quiet=False) as advance:
        for first in range(0, total, size):
            rows = np.minimum(np.arange(first, first + size), total - 1)
            count, name = min(size, total - first), f"chunk-{first // size:06d}"
            part = folder.chunk(name)
            if part is None:
                counter = scale.share_counter(advance, count)
                rows_conditions = jax.tree.map(lambda x, rows=rows: x[rows], conditions)
                options = {key: config.options[key] for key in ("duration", "step")}
                track_runs = track_batch(robot, rows_conditions, rolling=True, progress=counter, **options)
                part = {key: x[:count] for key, x in _ripple_of_batch(robot, track_runs, what).items()}
                folder.keep_chunk(name, part)
                counter(1.0)
            else:
                advance(count)
            parts.append(part)
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _ripple_of_batch(robot: Robot, ended: Any, what: PassingParts) -> Columns:
    """Ripple of a batch of runs, in the units of the table."""
    vibrations = vibrations_of_runs(robot, ended, what.pitch)
    status = np.array(STATUSES)[vibrations.status]
    slow = ~vibrations.read & np.isin(status, ("converged", "not_settled"))
    columns = {
        "status": np.where(slow, SLOW, status),
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
    config: configuration.Resonance, robot: Robot, what: PassingParts, table: Columns
) -> ResonanceResult:
    """Natural frequencies at the middle voltage, and peaks and crossings at each payload."""
    assert config.configuration is not None
    middle = _speed_grid(config, (config.voltages_V[len(config.voltages_V) // 2],))
    linear = modes(robot, run.conditions_of_runs(robot, grid_conditions(middle, robot), config))
    by_payload = dict(zip(config.payloads_kg, linear, strict=True))
    tops: list[RipplePeak] = []
    ends: dict[float, tuple[float, float]] = {}
    for payload, peaks in by_payload.items():
        rows = np.flatnonzero((table["payload_kg"] == payload) & (table["status"] == "converged"))
        rows = rows[np.argsort(table["speed_mean_mm_s"][rows])]
        if not len(rows):
            continue
        speed = table["speed_mean_mm_s"][rows] * MM
        for name in SIGNALS:
            ripple, frequency = table[f"{name}_ripple_percent"][rows] / 100, table[f"{name}_frequency_Hz"][rows]
            tops += peaks_over_speed(name, payload, speed, table["passing_Hz"][rows], ripple, frequency, peaks)
        ends[payload] = float(speed[0]), float(speed[-1])
    tops = drop_unconfirmed_modes(tops, by_payload)
    meets = [c for p, peaks in ends.items() for c in find_crossings(by_payload[p], p, what.travel, *peaks, tops)]
    return ResonanceResult(
        config.configuration, config.slope_deg, config.surface, what, robot, table, by_payload, tops, meets
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
