"""Report of a climb: answer, silhouettes, loads on the way, and the outcome of each tried size."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array

from calibration.data import Columns, Json, Names
from calibration.data.robot_file import RobotFile
from mmrjax.climbing.climb_derivatives import OUTPUTS, ClimbDerivatives, ClimbInputs, outputs_of_run
from mmrjax.climbing.climb_simulation import LOSSES, NAMES, SOURCES, ClimbRuns
from mmrjax.climbing.footing import FRONT, PITCH, REAR, SHAFT
from mmrjax.climbing.terrain import Terrain
from mmrjax.model.robot import Robot
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Block, Document, Note, Section, Table

#: Verdicts in words.
VERDICTS: dict[str, tuple[str, str]] = {
    "over": ("gets over", "the rear axle is a wheel's radius past the obstacle"),
    "tips": ("tips over", "the robot pitched by more than 100 deg"),
    "stalls": ("stalls", "the tracks stop: the motors cannot turn them"),
    "slides": ("slides", "the robot stops while its tracks slip: too little grip"),
    "hangs": ("hangs", "the body rests on an edge, or fell into a gap"),
    "unfinished": ("is under way", "the robot was still moving at the end. Use a longer --duration"),
    "failed": ("failed", "the simulation broke down, or levers would start below the ground"),
}


def footing_coordinates(table: Columns) -> np.ndarray:
    """Coordinates of `mmrjax.climbing.footing` at every sample of a history, shape (samples, 6)."""
    columns = ("x_mm", "z_mm", "pitch_deg", "shaft_deg", "front_deg", "rear_deg")
    x, z, pitch, shaft, front, rear = (table[name] for name in columns)
    angles = np.radians([-pitch, shaft, front, 180 - rear])
    return np.stack([x / 1000, z / 1000, *angles], axis=1)


@dataclasses.dataclass(frozen=True)
class DerivativeVariables:
    """Variables with respect to which derivatives are computed.

    Attributes:
        names, units: names and units of the values.
        values, widths: values and widths in these units.
        inputs: function that returns the inputs of a run with such values.
    """

    names: Names
    units: Names
    values: Array
    widths: Array
    inputs: Callable[[Array], ClimbInputs]

    @property
    def rows(self) -> list[tuple[str, str, float, float]]:
        """Name, unit, value and width of each variable."""
        return list(zip(self.names, self.units, self.values.tolist(), self.widths.tolist(), strict=True))


#: Columns of a run whose largest size is reported, with their units.
_LARGEST = (
    ("traction_current", "A"), ("front_current", "A"), ("rear_current", "A"), ("front_torque", "Nm"),
    ("rear_torque", "Nm"), ("front_voltage", "V"), ("rear_voltage", "V"),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class ClimbResult:
    """Result of `climb`.

    Attributes:
        robot, configuration, obstacle: robot, configuration and obstacle of the run. The obstacle is in words.
        terrain: terrain of the run that is shown.
        climb: the simulated climb.
        radius: radius of the pulleys [m].
        tried: sizes [mm] and verdicts of a search.
        largest: largest climbed size [mm]. None: no search, or none was climbed.
        sought: name of the searched size. Empty: no search.
        variables, derivatives: None unless requested.
    """

    robot: Robot
    configuration: str
    obstacle: str
    terrain: Terrain
    climb: ClimbRuns
    tried: tuple[tuple[float, str], ...] = ()
    largest: float | None = None
    sought: str = ""
    variables: DerivativeVariables | None = None
    derivatives: ClimbDerivatives | None = None

    @property
    def verdict(self) -> str:
        """Outcome of the run shown."""
        return NAMES[int(self.climb.verdict[0])]

    @functools.cached_property
    def table(self) -> Columns:
        """Table of the run over time."""
        record: Any = self.climb.run(0)
        q, v = record.motion.q, record.motion.v
        energy = {f"{name}_J": record.energy[name] for name in (*SOURCES, *LOSSES)}
        sides = float(self.robot.sides)
        radius = float(self.robot.radius_pulley)
        return {
            "time_s": record.time,
            "x_mm": 1000 * q[:, 0],
            "z_mm": 1000 * q[:, 1],
            "pitch_deg": -np.degrees(q[:, PITCH]),
            "shaft_deg": np.degrees(q[:, SHAFT]),
            "front_deg": np.degrees(q[:, FRONT]),
            "rear_deg": 180 - np.degrees(q[:, REAR]),
            "speed_mm_s": 1000 * np.hypot(v[:, 0], v[:, 1]),
            "belt_mm_s": 1000 * radius * v[:, SHAFT],
            "traction_current_A": record.current,
            "front_current_A": record.lever_current[:, 0],
            "rear_current_A": record.lever_current[:, 1],
            "motors_current_A": record.total_current,
            "front_voltage_V": record.lever_voltage[:, 0],
            "rear_voltage_V": record.lever_voltage[:, 1],
            "front_holds": record.holds[:, 0],
            "rear_holds": record.holds[:, 1],
            "front_torque_Nm": record.torque[:, 0],
            "rear_torque_Nm": record.torque[:, 1],
            "margin_mm": 1000 * record.margin,
            "reaction_N": sides * record.normal,
            "body_share": record.body,
            **energy,
            "stored_J": record.stored - record.stored[0],
        }

    @property
    def margins(self) -> dict[str, float]:
        """Margins of the run as shares, by the names of `OUTPUTS`. None for a run without numbers."""
        if self.verdict == "failed":
            return {}
        run_outputs = outputs_of_run(self.robot, self.terrain, self.climb, 0)
        return {name: float(value) for name, value in run_outputs.items() if name.startswith("margin_")}

    @property
    def slopes(self) -> list[Json] | None:
        """Derivatives, one row for each output and variable. None unless requested."""
        variables, derivatives = self.variables, self.derivatives
        if variables is None or derivatives is None:
            return None
        return [
            {
                "output": name, "unit": unit, "value": derivatives.outputs[name], "by": by, "by_unit": by_unit,
                "by_value": value, "by_width": width, "derivative": float(derivatives.derivatives[name][k]),
                "slope": float(derivatives.slope[name][k]), "slope_sd": float(derivatives.slope_sd[name][k]),
            }
            for name, (unit, _) in OUTPUTS.items()
            for k, (by, by_unit, value, width) in enumerate(variables.rows)
        ]  # fmt: skip

    def statement(self) -> str:
        """The answer in one sentence."""
        if self.sought:
            if self.largest is None:
                smallest = min(size for size, _ in self.tried)
                return f"It cannot climb any {self.sought} that was tried. The smallest was {smallest:.0f} mm."
            larger_sizes = [(s, v) for s, v in self.tried if s > self.largest]
            next_larger = min(larger_sizes, default=None)
            next_larger_text = (
                "" if next_larger is None else f"; at {next_larger[0]:.0f} mm it {VERDICTS[next_larger[1]][0]}"
            )
            return f"The largest {self.sought} that it gets over is {self.largest:.0f} mm{next_larger_text}."
        phrase, meaning = VERDICTS[self.verdict]
        return f"The robot {phrase}: {self.obstacle}" + ("." if self.verdict == "over" else f"; {meaning}.")

    def numbers(self) -> dict[str, float]:
        """Largest and final numbers of the run that is shown."""
        table = self.table
        levers, tracks = (float(table[name][-1] - table[name][0]) for name in ("levers_J", "supply_J"))
        return {
            "time_s": float(table["time_s"][-1]),
            "furthest_mm": float(1000 * self.climb.furthest[0]),
            "pitch_most_deg": float(table["pitch_deg"].max()),
            "pitch_least_deg": float(table["pitch_deg"].min()),
            "margin_least_mm": float(np.fmin.reduce(table["margin_mm"])),
            **{f"{name}_most_{unit}": float(np.abs(table[f"{name}_{unit}"]).max()) for name, unit in _LARGEST},
            "energy_levers_J": levers,
            "energy_J": tracks + levers,
        }

    def to_json(self) -> Json:
        """`result.json`."""
        return {
            "schema": "mmrjax.climb/1",
            "statement": self.statement(),
            "configuration": self.configuration,
            "obstacle": self.obstacle,
            "terrain": {
                "points_mm": (1000 * np.asarray(self.terrain.points)).tolist(),
                "nose_mm": 1000 * float(self.terrain.nose),
                "finish_mm": 1000 * float(self.terrain.finish),
            },
            "verdict": self.verdict,
            "sought": self.sought or None,
            "largest_mm": self.largest,
            "tried": [{"size_mm": size, "verdict": verdict} for size, verdict in self.tried],
            "run": self.numbers(),
            "margins": self.margins,
            "derivatives": self.slopes,
        }


#: Outputs whose derivatives are shown on the terminal.
SHOWN = ("margin_success", "crest_time_s", "crest_energy_J", "crest_current_rms_A")


def climb_document(result: ClimbResult, file: RobotFile) -> Document:
    """Report of a climb."""
    lead = f"**{result.configuration}**, {result.obstacle}, approached at a right angle."
    tried = ", ".join(f"{size:g} mm {VERDICTS[verdict][0]}" for size, verdict in result.tried)
    blocks: tuple[Block, ...] = (
        run_tables.note_on_robot(file, more=lead),
        *[Note(f"{tried}.", terminal=True)] * bool(tried),
        catalogue.figure("climb.silhouettes", result),
        catalogue.figure("climb.course", result),
    )
    return Document("Over an obstacle", result.statement(), blocks, tuple(_sections(result)))


def _sections(result: ClimbResult) -> Iterable[Section]:
    numbers = []
    for name, value in result.numbers().items():
        label, _, unit = name.rpartition("_")
        label = label.replace("_most", ", largest").replace("_least", ", least").replace("_", " ")
        numbers.append((label, value, unit))
    run_table = catalogue.table("climb.run", numbers)
    yield Section("The run in numbers", (run_table, catalogue.note("climb.belts")), "numbers")
    if result.margins:
        rows = [(n.removeprefix("margin_"), 100 * value, OUTPUTS[n][1]) for n, value in result.margins.items()]
        margin_table = catalogue.table("climb.shares", rows)
        yield Section("Margins", (margin_table, catalogue.note("climb.least")), "margins")
    if result.variables is not None:
        derivatives = _derivatives(result.slopes or [], result.variables)
        yield Section("Derivatives", (derivatives, catalogue.note("climb.slopes")), "derivatives")


def _derivatives(slopes: Sequence[Json], variables: DerivativeVariables) -> Table:
    rows: dict[str, list[Any]] = {}
    for slope in slopes:
        label = slope["output"] if slope["unit"] == "-" else f"{slope['output']} [{slope['unit']}]"
        cells = rows.setdefault(slope["output"], [label, slope["value"]])
        cells.append(f"{slope['derivative']:.3g} ({slope['slope']:.3g} ± {slope['slope_sd']:.1g})")
    heads = (f"by {n} = {v:.4g} {u}, over ±{w:.2g} |".replace(" ,", ",") for n, u, v, w in variables.rows)
    brief = [k for k, name in enumerate(rows) if name in SHOWN]
    return catalogue.table("climb.slopes-table", list(rows.values()), *heads, brief=brief)
