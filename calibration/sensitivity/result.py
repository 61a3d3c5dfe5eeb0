"""Result of a sensitivity study, from which JSON, tables, terminal output and reports are made."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import stats

from calibration.data import Columns, Json, Names
from calibration.data.runs import Runs
from calibration.data.writing import entries_of, json_value
from calibration.described import describe, sentences
from calibration.inference.fit_notes import Remark
from calibration.sensitivity.sampled_indices import LEVEL, REPLICATES, IntervalEstimate
from mmrjax.model.quantities import Quantity

SCHEMA = "mmrjax.sensitivity/2"
#: Methods.
METHODS = ("local", "sobol", "morris")
#: An input is negligible if its share of the variance is smaller for all outputs and points [-].
NEGLIGIBLE = 0.01


@dataclasses.dataclass(frozen=True)
class OperatingPoints:
    """Operating points of a study. Arrays of shape (points,). On a battery, the voltage is NaN.

    Attributes:
        motor_speed: imposed motor speed [rpm], None if the voltage is imposed. The voltage is 0 if the speed is
            imposed.
        has_ground: True if payload and slope act. Otherwise they are 0.
    """

    configuration: np.ndarray
    voltage: np.ndarray
    payload: np.ndarray
    slope_deg: np.ndarray
    motor_speed: np.ndarray | None = None
    has_ground: bool = True

    def __len__(self) -> int:
        return len(self.voltage)

    @classmethod
    def of(cls, runs: Runs) -> OperatingPoints:
        """Operating points of a table of runs."""
        layout, nothing = runs.layout, np.zeros(len(runs))
        payload, slope = (runs[c] if c in runs.axes else nothing for c in ("payload_kg", "slope_deg"))
        imposed = runs[layout.imposed_column]
        imposes_speed = layout.imposed == "motor_speed"
        return cls(
            runs["configuration"],
            nothing if imposes_speed else imposed,
            payload,
            slope,
            imposed if imposes_speed else None,
            layout.has_ground,
        )

    def at(self, rows: np.ndarray) -> OperatingPoints:
        """Points selected by a mask or an index."""
        speed = None if self.motor_speed is None else self.motor_speed[rows]
        voltage, payload, slope = (x[rows] for x in (self.voltage, self.payload, self.slope_deg))
        return OperatingPoints(self.configuration[rows], voltage, payload, slope, speed, self.has_ground)

    @property
    def imposed(self) -> tuple[str, np.ndarray, str]:
        """Quantity imposed on the motors: name, values, unit."""
        if self.motor_speed is None:
            return "voltage", self.voltage, "V"
        return "motor speed", self.motor_speed, "rpm"

    @property
    def ground(self) -> tuple[tuple[str, np.ndarray, str], ...]:
        """Ground conditions: column, values and unit of each. Empty without a ground."""
        quantities = ("payload_kg", self.payload, " kg"), ("slope_deg", self.slope_deg, "°")
        return quantities if self.has_ground else ()

    def label(self, k: int) -> str:
        """Name of a point, such as `6T2A, 12 V, 2 kg, 10°`."""
        _, imposed, unit = self.imposed
        supply = "battery" if np.isnan(imposed[k]) else f"{imposed[k]:g} {unit}"
        return ", ".join((f"{self.configuration[k]}, {supply}", *(f"{x[k]:g}{unit}" for _, x, unit in self.ground)))

    def columns(self) -> Columns:
        """Columns of the points, as in tables of runs."""
        further = (
            {"supply_voltage_V": self.voltage} if self.motor_speed is None else {"motor_speed_rpm": self.motor_speed}
        )
        return {"configuration": self.configuration, **further, **{column: x for column, x, _ in self.ground}}


@dataclasses.dataclass(frozen=True)
class InputSummary:
    """An uncertain input of a study.

    Attributes:
        unit, meaning: unit and meaning of the input.
        distribution: log-normal, normal, uniform or posterior.
        median: median [unit].
        interval: 95 % interval [unit].
        sd: standard deviation, to first order [unit].
        inert: True if the derivatives of all outputs with respect to it were exactly zero. It is then not sampled.
    """

    unit: str
    meaning: str
    distribution: str
    median: float
    interval: tuple[float, float]
    sd: float
    inert: bool


@dataclasses.dataclass(frozen=True)
class OutputStudy:
    """Results for one output. Arrays of shape (points, inputs), NaN at points without a value.

    Attributes:
        row: name, unit and label of the output.
        value: value at the medians of the inputs [SI], shape (points,).
        derivative: derivative with respect to each input [SI per unit of the input].
        elasticity: (x / y) ∂y/∂x [-].
        swing: output with one input at the lower or upper end of its 95 % interval [SI], shape (2, points, inputs).
        sd: standard deviation of the output due to all inputs [SI], shape (points,). From the sample if there is one,
            otherwise to first order.
        share: share of the variance that involves an input, as defined by the method [-].
        overall: indices of each input over all points: name → estimates of shape (inputs,).
        at_points: indices at each point: name → estimates of shape (points, inputs).
        second: second-order indices over all points, shape (inputs, inputs). None if not computed.
        lost: share of base points without a value, at each point, shape (points,).
        studied: True for points that could be studied.
    """

    JSON = ("label=row.label", "unit=row.unit_shown", "factor=row.factor", "value", "sd", "share", "studied", "lost")
    row: Quantity
    value: np.ndarray
    derivative: np.ndarray
    elasticity: np.ndarray
    swing: np.ndarray
    sd: np.ndarray
    share: np.ndarray
    overall: dict[str, IntervalEstimate]
    at_points: dict[str, IntervalEstimate]
    second: IntervalEstimate | None
    lost: np.ndarray
    studied: np.ndarray

    @property
    def overall_share(self) -> np.ndarray:
        """Share of the variance over all points, shape (inputs,): from the method or, if it gives none, the mean over
        the points.
        """
        if "total" in self.overall and np.isfinite(self.overall["total"].value).any():
            return np.clip(np.nan_to_num(self.overall["total"].value), 0.0, 1.0)
        finite = np.isfinite(self.share).any(1)
        weight = np.where(finite, np.nan_to_num(self.sd) ** 2, 0.0)
        if not weight.sum() > 0:
            return np.zeros(self.share.shape[1])
        return np.einsum("p,pk->k", weight, np.nan_to_num(self.share)) / weight.sum()


@dataclasses.dataclass(frozen=True)
class Interaction:
    """Interaction of two inputs: share of the variance in addition to that of each alone.

    Attributes:
        second: second-order index.
        interval: 95 % interval of the index.
        sure: True if the index is above zero even with an interval for all tested pairs at once.
    """

    JSON = ("pair", "second", "second_interval=interval", "sure")
    pair: tuple[str, str]
    second: float
    interval: tuple[float, float]
    sure: bool


@dataclasses.dataclass(frozen=True)
class SensitivityResult:
    """Result of a sensitivity study.

    Attributes:
        method: one of `METHODS`.
        model: name of the fidelity.
        seed: random seed.
        inputs: inputs by name, in order.
        correlated: True if the inputs come from a posterior, so that they are correlated.
        points: operating points.
        outputs: results by output name.
        statuses: source → status → number of points, at the medians.
        sampled: source → status → number of points, in the sample.
        evaluations: number of model evaluations.
        seconds: duration of the evaluations [s], including compilation.
        remarks: notes on the result.
    """

    method: str
    model: str
    seed: int
    inputs: dict[str, InputSummary]
    correlated: bool
    points: OperatingPoints
    outputs: dict[str, OutputStudy]
    statuses: dict[str, dict[str, int]]
    sampled: dict[str, dict[str, int]]
    evaluations: int
    seconds: float
    remarks: tuple[Remark, ...]

    @property
    def names(self) -> Names:
        """Names of the inputs."""
        return tuple(self.inputs)

    def importance(self) -> np.ndarray:
        """Largest share of the variance that each input causes, over all outputs and points, shape (inputs,). Shares
        at single points count with the upper ends of their intervals."""
        largest_share = np.zeros(len(self.inputs))
        for study in self.outputs.values():
            ends = [study.overall_share]
            if study.at_points:
                main = study.at_points.get("total")
                if main is not None:
                    ends.append(np.nanmax(np.where(np.isfinite(main.high), main.high, 0.0), axis=0))
            shares = np.where(np.isfinite(study.share), study.share, 0.0)
            ends.append(shares.max(0, initial=0.0))
            largest_share = np.maximum(largest_share, np.max(np.stack(ends), 0))
        return np.clip(largest_share, 0.0, 1.0)

    @property
    def negligible(self) -> Names:
        """Inputs that cause less than `NEGLIGIBLE` of the variance of every output at every point."""
        return tuple(n for n, x in zip(self.names, self.importance(), strict=True) if x < NEGLIGIBLE)

    @property
    def solved(self) -> bool:
        """True if the solver found a solution at each point."""
        return not any(counts.get("failed") for counts in self.statuses.values())

    def leaders(self) -> dict[str, list[tuple[str, float]]]:
        """Input → label and share [-] of each output for which it is the most important input."""
        leading: dict[str, list[tuple[str, float]]] = {}
        for study in self.outputs.values():
            share = study.overall_share
            if share.max(initial=0.0) > 0:
                k = int(np.argmax(share))
                leading.setdefault(self.names[k], []).append((study.row.label, float(share[k])))
        return leading

    def statement(self) -> str:
        """The inputs that matter most, in one sentence."""
        return describe(self)

    @property
    def notes(self) -> Names:
        """Remarks as sentences."""
        return sentences(self.remarks)

    def to_json(self) -> Json:
        """Content of result.json, as described in docs/schemas/sensitivity.schema.json."""
        names = self.names
        return json_value(
            {
                "schema": SCHEMA,
                **entries_of(self, "method", "model", "seed", "statement", "inputs", "correlated"),
                "points": [
                    {key: column[k].item() for key, column in self.points.columns().items()}
                    for k in range(len(self.points))
                ],
                "outputs": self.outputs,
                "indices": {name: self._indices(study) for name, study in self.outputs.items()},
                "interactions": {
                    name: interactions(study, names)
                    for name, study in self.outputs.items()
                    if study.second is not None
                },
                **entries_of(self, "negligible", "statuses", "statuses_sampled=sampled"),
                **entries_of(self, "evaluations", "seconds", "notes"),
            }
        )

    def _indices(self, study: OutputStudy) -> Json:
        if self.method == "local":
            return {
                name: {"derivative": study.derivative[:, k], "elasticity": study.elasticity[:, k]}
                for k, name in enumerate(self.names)
            }
        return {
            name: {
                key: value
                for word, e in study.overall.items()
                for key, value in (
                    (word, float(e.value[k])),
                    (f"{word}_interval", [float(e.low[k]), float(e.high[k])]),
                )
            }
            for k, name in enumerate(self.names)
        }

    def tables(self) -> dict[str, Columns]:
        """CSV tables by file name: derivatives and swings at each point, indices over all points and at each
        point.
        """
        names = np.array(self.names)
        tables_by_file: dict[str, list[Columns]] = {"points.csv": [], "indices.csv": []}
        for name, study in self.outputs.items():
            points, size = study.derivative.shape
            point_columns = {key: np.repeat(x, size) for key, x in self.points.columns().items()}
            table = {
                "output": np.full(points * size, name),
                "unit": np.full(points * size, study.row.unit_shown),
                **point_columns,
                "input": np.tile(names, points),
                "value": np.repeat(study.value, size) / study.row.factor,
                "derivative": study.derivative.ravel() / study.row.factor,
                "elasticity": study.elasticity.ravel(),
                "at_low": study.swing[0].ravel() / study.row.factor,
                "at_high": study.swing[1].ravel() / study.row.factor,
                "share": study.share.ravel(),
            }
            for key, estimate in study.at_points.items():
                table |= {key: estimate.value.ravel()}
                table |= {f"{key}_low": estimate.low.ravel(), f"{key}_high": estimate.high.ravel()}
            tables_by_file["points.csv"].append(table)
            if study.overall:
                overall = {"output": np.full(size, name), "input": names}
                for key, estimate in study.overall.items():
                    overall |= {key: estimate.value, f"{key}_low": estimate.low, f"{key}_high": estimate.high}
                tables_by_file["indices.csv"].append(overall)
        return {
            file: {key: np.concatenate([t[key] for t in tables]) for key in tables[0]}
            for file, tables in tables_by_file.items()
            if tables
        }


def interactions(study: OutputStudy, names: Names) -> list[Interaction]:
    """Interactions of the relevant inputs of an output, the strongest first."""
    second = study.second
    if second is None:
        return []
    part = np.flatnonzero(np.nan_to_num(study.overall["total"].value) >= NEGLIGIBLE / 10)
    pairs = [(int(i), int(j)) for n, i in enumerate(part) for j in part[n + 1 :]]
    wider = 1.0
    if pairs:  # in 95 of 100 studies no pair is sure by chance (Bonferroni)
        single_quantile, all_ = (stats.t.ppf(1 - (1 - LEVEL) / 2 / n, REPLICATES - 1) for n in (1, len(pairs)))
        wider = float(all_ / single_quantile)
    pairs_found = []
    for i, j in pairs:
        value, low, high = float(second.value[i, j]), float(second.low[i, j]), float(second.high[i, j])
        pairs_found.append(Interaction((names[i], names[j]), value, (low, high), value - wider * (value - low) > 0))
    return sorted(pairs_found, key=lambda pair: -pair.second)
