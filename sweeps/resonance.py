"""The command `resonance`: ripple over speed and payload, and which speeds to avoid."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.table import Table

from calibration.data import robot_file
from calibration.data.errors import BadConfiguration
from calibration.data.runs import Runs
from mmrjax.channels import MM
from mmrjax.conditions import Conditions
from mmrjax.fidelities.modes import Mode, modes
from mmrjax.fidelities.resonance import (
    PERIODS,
    SIGNALS,
    Crossing,
    Passing,
    Peak,
    Resonance,
    confirmed,
    crossings,
    passing,
    peaks,
    resonances,
    strongest,
    vibrations,
)
from mmrjax.fidelities.track import track_batch
from mmrjax.robot import Robot
from mmrjax.signals import STATUSES
from mmrjax.tables import PAYLOADS_KG, VOLTAGES_V
from sweeps import config as configuration
from sweeps import imposed, run
from sweeps.config import GridPart
from sweeps.console import progress, say
from sweeps.grid import grid
from sweeps.inputs import check_configurations, load_robot
from sweeps.store import DONE, SOME_NOT_CONVERGED, RunFolder, open_folder

CHUNK = 96  # runs in one call
FEWEST = 5  # voltages over which a peak can be told
SHORTEST = 0.5  # [s], of a run
SAID = 3  # ranges to avoid in a sentence
#: Status of a run that is too slow for its ripple to be read.
SLOW = "too_slow"


@dataclasses.dataclass(frozen=True)
class ResonanceResult:
    """What the command found.

    Attributes:
        configuration, slope_deg, surface: of the map; passing: what shakes it; robot: that was simulated.
        table: a row a run, as in `points.csv`; the grid's first, then what Table 8 adds.
        modes: by payload [kg].
        peaks, crossings: at every payload.
    """

    configuration: str
    slope_deg: float
    surface: str
    passing: Passing
    robot: Robot
    table: dict[str, np.ndarray]
    modes: dict[float, list[Mode]]
    peaks: list[Peak]
    crossings: list[Crossing]

    @property
    def resonances(self) -> list[Resonance]:
        """Peaks over the payloads; those without a mode are confirmed by none."""
        return resonances(self.peaks)

    @property
    def read(self) -> np.ndarray:
        """Rows whose ripple is read."""
        return np.isfinite(self.table["reaction_ripple_percent"])

    @property
    def speeds(self) -> tuple[float, float]:
        """Least and greatest speed read [m/s]; NaN where none is."""
        speed = self.table["speed_mean_mm_s"][self.read] * MM
        return (float(speed.min()), float(speed.max())) if len(speed) else (float("nan"), float("nan"))

    @property
    def statuses(self) -> dict[str, int]:
        """How many runs ended in each status; every status is named."""
        return {s: int(np.sum(self.table["status"] == s)) for s in (*STATUSES, SLOW)}

    @property
    def avoid(self) -> list[tuple[float, float, list[Resonance]]]:
        """Ranges of speed to avoid [m/s], lowest first, each of one mode and order, with what shows it."""
        found: dict[tuple[str, int], list[Resonance]] = {}
        for r in strongest(self.resonances):
            found.setdefault((r.mode, r.order), []).append(r)
        ranges = [(min(r.avoid[0] for r in of), max(r.avoid[1] for r in of), of) for of in found.values()]
        return sorted(ranges, key=lambda x: x[0])

    @property
    def restless(self) -> list[tuple[float, float]]:
        """Ranges of speed in which some run did not settle [m/s], each half way to the next run that did."""
        ranges = []
        speed = self.travel * MM
        for payload in self.modes:
            of = np.flatnonzero((self.table["payload_kg"] == payload) & np.isfinite(speed))
            of = of[np.argsort(speed[of])]
            x = speed[of]
            edges = np.concatenate([x[:1], (x[1:] + x[:-1]) / 2, x[-1:]])
            bad = self.table["status"][of] != "converged"
            ranges += [(edges[k], edges[k + 1]) for k in np.flatnonzero(bad)]
        return _merged(ranges)

    @property
    def travel(self) -> np.ndarray:
        """Speed of every run [mm/s]; where it has none, as its voltage has it in the others (NaN: in none)."""
        speed, voltage = self.table["speed_mean_mm_s"], self.table["supply_voltage_V"]
        if self.read.sum() < 2:
            return speed
        line = np.polyfit(voltage[self.read], speed[self.read], 1)
        return np.where(self.read, speed, np.polyval(line, voltage))

    @property
    def quiet(self) -> list[tuple[float, float]]:
        """Ranges of speed without peaks to avoid, at any payload, where every run settles [m/s]."""
        low, high = self.speeds
        gaps = []
        for begin, end in _merged([*((a, b) for a, b, _ in self.avoid), *self.restless]):
            if begin > low:
                gaps.append((low, min(begin, high)))
            low = max(low, end)
        return [*gaps, (low, high)] if low < high else gaps

    def statement(self) -> str:
        """Which speeds to avoid."""
        return " ".join(self.sentences)

    @property
    def sentences(self) -> list[str]:
        """Which speeds to avoid, the most important first."""
        low, high = self.speeds
        if not np.isfinite(low):
            return [f"No run of {self.configuration} travels: there is no ripple to read (status says why)."]
        parts = []
        named, bare = ([r for r in self.avoid if bool(r[2][0].mode) is has] for has in (True, False))
        if named:
            parts.append(f"Avoid {_listed(named, self.passing.name)}.")
        elif not bare:
            largest = ", ".join(f"{s.label} {percent(self._largest(n))}" for n, s in SIGNALS.items())
            parts.append(
                f"No speed to avoid for its ripple between {_span(low, high)} mm/s: nothing peaks at a natural "
                f"frequency (largest ripple: {largest})."
            )
        if bare:
            also = "Ripple also peaks" if named else "Ripple peaks"
            parts.append(f"{also}, with no natural frequency to name, at {_listed(bare, self.passing.name)}.")
        for name, lowest, highest in self._spread():
            parts.append(
                f"{name.capitalize()} has no one frequency: {_span(lowest, highest, 1)} Hz over the belt's position."
            )
        if self.restless:
            spans = ", ".join(_span(*x) for x in self.restless)
            parts.append(f"Not every run settles at {spans} mm/s.")
        if self.avoid or self.restless:
            free = ", ".join(_span(*x) for x in self.quiet)
            parts.append(f"Free of all this: {free} mm/s." if free else "No speed is free of all this.")
        if self._table8():
            parts.append(self._table8())
        if self.passing.name == "teeth":
            parts.append(
                f"This configuration has no grousers on the ground; what passes are the belt's teeth, every "
                f"{self.passing.travel / MM:.2f} mm of travel."
            )
        return parts

    def _largest(self, signal: str) -> float:
        return float(np.nanmax(self.table[f"{signal}_ripple_percent"]))

    def _spread(self) -> list[tuple[str, float, float]]:
        """Modes that amplify but change by an octave with the position of the belt, with their range [Hz]."""
        every = [m for of in self.modes.values() for m in of if m.amplifies and not m.resonant]
        names = dict.fromkeys(m.name for m in every)
        return [
            (n, min(m.low for m in every if m.name == n), max(m.high for m in every if m.name == n)) for n in names
        ]

    def _table8(self) -> str:
        """Which points of Table 8 are in a range to avoid, by payload."""
        rows = np.flatnonzero(self.table["table8"] & self.read)
        inside = []
        for voltage in np.unique(self.table["supply_voltage_V"][rows]):
            of = rows[self.table["supply_voltage_V"][rows] == voltage]
            hit = [k for k in of if self.shaken(k)]
            if hit:
                loads = ", ".join(f"{self.table['payload_kg'][k]:g}" for k in hit)
                inside.append(f"{voltage:g} V with {'every payload' if len(hit) == len(of) else loads + ' kg'}")
        return f"Of Table 8 at {self.slope_deg:g}°, in such a peak: {'; '.join(inside)}." if inside else ""

    def shaken(self, row: int | np.integer[Any]) -> bool:
        """Whether a run is within one of the strongest peaks of its own payload."""
        speed, payload = self.table["speed_mean_mm_s"][row] * MM, self.table["payload_kg"][row]
        strong = {(r.mode, r.order, r.signal) for r in strongest(self.resonances)}
        return any(
            p.low <= speed <= p.high
            for p in self.peaks
            if p.payload == payload and (p.mode, p.order, p.signal) in strong
        )

    def to_json(self) -> dict[str, Any]:
        """`result.json`."""
        return {
            "schema": "mmrjax.resonance/1",
            "statement": self.statement(),
            "configuration": self.configuration,
            "slope_deg": self.slope_deg,
            "surface": self.surface,
            "passing": {"of": self.passing.name, "pitch_m": self.passing.pitch, "travel_m": self.passing.travel},
            "runs": len(self.table["status"]),
            "statuses": self.statuses,
            "speeds_m_s": self.speeds,
            "modes": [
                {"payload_kg": payload, **m._asdict(), "resonant": m.resonant}
                for payload, of in self.modes.items()
                for m in of
            ],
            "peaks": [p._asdict() for p in self.peaks],
            "crossings": [c._asdict() for c in self.crossings],
            "resonances": [r._asdict() for r in self.resonances],
            "avoid": [
                {"low_m_s": low, "high_m_s": high, "mode": of[0].mode, "order": of[0].order,
                 "ripple": {r.signal: r.ripple for r in of}, "rise": {r.signal: r.rise for r in of}}
                for low, high, of in self.avoid
            ],
            "quiet_m_s": self.quiet,
            "restless_m_s": self.restless,
            "table8": [
                {
                    "supply_voltage_V": self.table["supply_voltage_V"][k].item(),
                    "payload_kg": self.table["payload_kg"][k].item(),
                    "speed_mean_mm_s": self.table["speed_mean_mm_s"][k].item(),
                    "status": str(self.table["status"][k]),
                    "in_a_peak": self.shaken(k),
                }
                for k in np.flatnonzero(self.table["table8"])
            ],
        }  # fmt: skip


def _merged(ranges: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Ranges as few that do not overlap, lowest first."""
    found: list[tuple[float, float]] = []
    for low, high in sorted(ranges):
        if found and low <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], high)
        else:
            found.append((low, high))
    return found


def percent(value: float) -> str:
    """A ripple [%] as a sentence has it."""
    return "under 0.01 %" if value < 0.01 else f"{value:.0f} %" if value >= 10 else f"{value:.2g} %"


def _listed(ranges: list[tuple[float, float, list[Resonance]]], what: str) -> str:
    """Ranges to avoid, the lowest speed first; of many those that rise most."""
    most = sorted(ranges, key=lambda r: -max(x.rise for x in r[2]))[:SAID]
    texts = []
    for low, high, of in sorted(most, key=lambda r: r[0]):
        first, last = min(r.frequencies[0] for r in of), max(r.frequencies[1] for r in of)
        meets = f"{of[0].mode} at {_span(first, last, 1)} Hz meets " if of[0].mode else ""
        order = f"{of[0].order} × {what}" if of[0].order else f"{_span(first, last, 1)} Hz"
        how = ", ".join(f"{SIGNALS[r.signal].label} {percent(100 * r.ripple)}" for r in of)
        texts.append(f"{_span(low, high)} mm/s ({meets}{order}; ripple up to: {how})")
    more = f"; {len(ranges) - len(most)} more on the map" if len(ranges) > len(most) else ""
    return "; ".join(texts) + more


def _span(low: float, high: float, unit: float = MM) -> str:
    """`low-high` in a unit, or one number where they print alike."""
    ends = f"{low / unit:.0f}", f"{high / unit:.0f}"
    return ends[0] if ends[0] == ends[1] else f"{ends[0]}-{ends[1]}"


def resonance(config: configuration.Resonance, out: Path | None, force: bool) -> int:
    """Map the ripple of a robot and leave a run folder; returns the exit code.

    0 done; 3 done, but some runs did not settle, or slid, tipped or failed.
    """
    robot = load_robot(config)
    imposed.check_on_ground(robot, "resonance")
    name = config.configuration or robot.configurations.names[0]
    check_configurations(robot, (name,), "--configuration")
    config = config.model_copy(
        update={
            "configuration": name,
            "voltages_V": tuple(sorted(set(config.voltages_V))),
            "payloads_kg": tuple(sorted(set(config.payloads_kg))),
        }
    )
    if config.voltages_V[0] <= 0:
        raise BadConfiguration(f"--voltages: got {config.voltages_V[0]:g}; expected more than 0 to 100, forward")
    if len(config.voltages_V) < FEWEST:
        raise BadConfiguration(
            f"--voltages: got {len(config.voltages_V)} of them; expected at least {FEWEST}, or no peak over speed "
            "can be told"
        )
    if config.options["duration"] < SHORTEST:
        raise BadConfiguration(
            f"--duration: got {config.options['duration']:g} s; expected at least {SHORTEST:g} s, or no grousers pass"
        )
    runs, of_table8 = _points(config, robot)
    conditions = run.commanded(robot, runs, config)
    run.refuse(robot, conditions, config)
    with open_folder("resonance", config, robot, out, force, runs) as folder:
        what = passing(robot, robot.configurations.names.index(name))
        columns = _rippled(folder, robot, conditions, config, what)
        table = {**run.conditions(robot, runs), "table8": of_table8, **columns}
        found = _found(config, robot, what, table)
        _write(folder, config, found)
        print_resonance(found)
        if config.report:
            from sweeps import report_resonance

            report_resonance.write(folder.partial, found, robot_name=config.robot)
        path = folder.finish({"seed": None, "statuses": found.statuses}, runs)
        say(str(path))
        return DONE if found.statuses["converged"] == len(runs) else SOME_NOT_CONVERGED


def _grid(config: configuration.Resonance, voltages: tuple[float, ...], payloads: tuple[float, ...]) -> GridPart:
    assert config.configuration is not None
    return GridPart(
        configurations=(config.configuration,),
        voltages_V=voltages,
        payloads_kg=payloads,
        slopes_deg=(config.slope_deg,),
        surface=config.surface,
    )


def _points(config: configuration.Resonance, robot: Robot) -> tuple[Runs, np.ndarray]:
    """The grid, then those points of Table 8 that it lacks; and which rows are of Table 8."""
    parts = [
        grid(_grid(config, v, p), robot)
        for v, p in ((config.voltages_V, config.payloads_kg), (VOLTAGES_V, PAYLOADS_KG))
    ]
    pairs = [list(zip(part["supply_voltage_V"], part["payload_kg"], strict=True)) for part in parts]
    new = np.array([pair not in set(pairs[0]) for pair in pairs[1]])
    columns = {key: np.concatenate([parts[0][key], parts[1][key][new]]) for key in parts[0].columns}
    runs = Runs(source="the grid and Table 8", columns=columns)
    paper = set(pairs[1])
    of_table8 = [pair in paper for pair in zip(runs["supply_voltage_V"], runs["payload_kg"], strict=True)]
    return runs, np.array(of_table8)


def _rippled(
    folder: RunFolder, robot: Robot, conditions: Conditions, config: configuration.Resonance, what: Passing
) -> dict[str, np.ndarray]:
    """The columns of ripple, chunk by chunk; chunks that an interrupted run left are not simulated again."""
    total, parts = conditions.shape[0], []
    size = min(CHUNK, total)
    with progress(total, quiet=False) as advance:
        for first in range(0, total, size):
            rows = np.minimum(np.arange(first, first + size), total - 1)
            count, name = min(size, total - first), f"chunk-{first // size:06d}"
            part = folder.chunk(name)
            if part is None:
                told = run.shares(advance, count)
                chosen = jax.tree.map(lambda x, rows=rows: x[rows], conditions)
                options = {key: config.options[key] for key in ("duration", "step")}
                ended = track_batch(robot, chosen, rolling=True, progress=told, **options)
                part = {key: x[:count] for key, x in _columns(robot, ended, what).items()}
                folder.keep_chunk(name, part)
                told(1.0)
            else:
                advance(count)
            parts.append(part)
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _columns(robot: Robot, ended: Any, what: Passing) -> dict[str, np.ndarray]:
    """Ripple of a batch of runs, in the units of the table."""
    found = vibrations(robot, ended, what.pitch)
    status = np.array(STATUSES)[found.status]
    slow = ~found.read & np.isin(status, ("converged", "not_settled"))
    columns = {
        "status": np.where(slow, SLOW, status),
        "passing_Hz": found.passing,
    }
    for name, signal in SIGNALS.items():
        columns |= {
            f"{name}_mean_{signal.unit}": found.mean[name] / signal.factor,
            f"{name}_ripple_percent": 100 * found.deviation[name],
            f"{name}_frequency_Hz": found.frequency[name],
        }
    return columns


def _found(
    config: configuration.Resonance, robot: Robot, what: Passing, table: dict[str, np.ndarray]
) -> ResonanceResult:
    """Natural frequencies at the middle voltage, and peaks and crossings at each payload."""
    assert config.configuration is not None
    payloads, middle = config.payloads_kg, config.voltages_V[len(config.voltages_V) // 2]
    at = _grid(config, (middle,), payloads)
    linear = modes(robot, run.commanded(robot, grid(at, robot), config))
    by_payload = dict(zip(payloads, linear, strict=True))
    tops: list[Peak] = []
    ends: dict[float, tuple[float, float]] = {}
    for payload, of in by_payload.items():
        gridded = (table["payload_kg"] == payload) & np.isin(table["supply_voltage_V"], config.voltages_V)
        rows = np.flatnonzero(gridded & (table["status"] == "converged"))
        rows = rows[np.argsort(table["speed_mean_mm_s"][rows])]
        if not len(rows):
            continue
        speed = table["speed_mean_mm_s"][rows] * MM
        here = [
            peak
            for name in SIGNALS
            for peak in peaks(
                name, payload, speed, table["passing_Hz"][rows], table[f"{name}_ripple_percent"][rows] / 100,
                table[f"{name}_frequency_Hz"][rows], of,
            )
        ]  # fmt: skip
        tops += here
        ends[payload] = float(speed[0]), float(speed[-1])
    tops = confirmed(tops, by_payload)
    meets = [c for p, of in ends.items() for c in crossings(by_payload[p], p, what.travel, *of, tops)]
    return ResonanceResult(
        config.configuration, config.slope_deg, config.surface, what, robot, table, by_payload, tops, meets
    )


def _write(folder: RunFolder, config: configuration.Resonance, found: ResonanceResult) -> None:
    folder.write_table("points.csv", found.table)
    folder.write_table(
        "modes.csv", _rows([{"payload_kg": p, **m._asdict()} for p, of in found.modes.items() for m in of], Mode)
    )
    folder.write_table("peaks.csv", _rows([p._asdict() for p in found.peaks], Peak))
    folder.write_text("config.resolved.toml", configuration.as_toml(config))
    robot_file.write(found.robot, folder.partial / "robot.toml", note=f"the robot of this map, from {config.robot}")
    folder.write_json("result.json", found.to_json())


_COLUMNS = {
    "frequency": "frequency_Hz", "low": "low", "natural": "natural_Hz", "payload": "payload_kg", "speed": "speed_m_s",
}  # fmt: skip


def _rows(rows: Iterable[dict[str, Any]], kind: type) -> dict[str, np.ndarray]:
    """Rows of a named tuple as columns with units in their names; without rows the columns alone."""
    rows, unit = list(rows), "Hz" if kind is Mode else "m_s"
    keys = list(rows[0]) if rows else list(kind.__annotations__)
    names = _COLUMNS | {"low": f"low_{unit}", "high": f"high_{unit}"}
    return {names.get(key, key): np.array([row[key] for row in rows]) for key in keys}


def print_resonance(found: ResonanceResult) -> None:
    """Natural frequencies, and which speeds to avoid; for a person."""
    shown = Table(title="natural frequencies [Hz], mean (range over the belt's position), damping ratio", box=None)
    shown.title_justify = "left"
    names = list(dict.fromkeys(m.name for of in found.modes.values() for m in of))
    shown.add_column("payload [kg]")
    for name in names:
        shown.add_column(name)
    for payload, of in found.modes.items():
        cells = {m.name: f"{m.frequency:.0f} ({_span(m.low, m.high, 1)}), {m.damping:.2f}" for m in of}
        shown.add_row(f"{payload:g}", *(cells.get(name, "-") for name in names))
    say(shown)
    say(found.statement())
    others = {s: n for s, n in found.statuses.items() if n and s != STATUSES[0]}
    if others:
        say("of " + f"{len(found.table['status'])} runs: " + ", ".join(f"{n} {s}" for s, n in others.items()))
    if SLOW in others:
        say(f"{SLOW}: fewer than {PERIODS} {found.passing.name} passed in the second half of the run")
