"""Result of a sensitivity study, from which JSON, tables, terminal output and reports are made."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from scipy.special import stdtrit

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
        layout = runs.layout
        zeros = np.zeros(len(runs))
        payload, slope = (runs[c] if c in runs.axes else zeros for c in ("payload_kg", "slope_deg"))
        imposed = runs[layout.imposed_column]
        imposes_speed = layout.imposed == "motor_speed"
        return cls(
            runs["configuration"],
            zeros if imposes_speed else imposed,
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
        imposed_column = (
            {"supply_voltage_V": self.voltage} if self.motor_speed is None else {"motor_speed_rpm": self.motor_speed}
        )
        return {"configuration": self.configuration, **imposed_column, **{column: x for column, x, _ in self.ground}}


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
        lost: share of base points without a value, at each point, shape (points,).
        studied: True for points that could be studied.
        overall: indices of each input over all points: name → estimates of shape (inputs,).
        at_points: indices at each point: name → estimates of shape (points, inputs).
        second: second-order indices over all points, shape (inputs, inputs). None if not computed.
    """

    JSON = ("label=row.label", "unit=row.unit_shown", "factor=row.factor", "value", "sd", "share", "studied", "lost")
    row: Quantity
    value: np.ndarray
    derivative: np.ndarray
    elasticity: np.ndarray
    swing: np.ndarray
    sd: np.ndarray
    share: np.ndarray
    lost: np.ndarray
    studied: np.ndarray
    overall: dict[str, IntervalEstimate] = dataclasses.field(default_factory=dict)
    at_points: dict[str, IntervalEstimate] = dataclasses.field(default_factory=dict)
    second: IntervalEstimate | None = None

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
        """Largest share of the variance that each input causes, over all outputs and points, shape (inputs,).

        At single points, the upper end of the confidence interval counts.
        """
        shares = [np.zeros((1, len(self.inputs)))]
        for study in self.outputs.values():
            total = study.at_points.get("total")
            shares += [study.overall_share[None], study.share, *([] if total is None else [total.high])]
        finite_shares = np.nan_to_num(np.concatenate(shares), posinf=0.0, neginf=0.0)
        return np.clip(finite_shares.max(0), 0.0, 1.0)

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
            tables_by_file["points.csv"].append(table | _estimate_columns(study.at_points))
            if study.overall:
                overall = {"output": np.full(size, name), "input": names}
                tables_by_file["indices.csv"].append(overall | _estimate_columns(study.overall))
        return {
            file: {key: np.concatenate([t[key] for t in tables]) for key in tables[0]}
            for file, tables in tables_by_file.items()
            if tables
        }


def _estimate_columns(estimates: dict[str, IntervalEstimate]) -> Columns:
    """Columns of estimates and the ends of their intervals."""
    return {
        f"{key}{end}": x.ravel()
        for key, estimate in estimates.items()
        for end, x in zip(("", "_low", "_high"), estimate, strict=True)
    }


def interactions(study: OutputStudy, names: Names) -> list[Json]:
    """Pairs of relevant inputs of an output with their shares of the variance in addition to those of each alone, the
    largest first.

    `sure`: True if the index is above zero even with an interval for all tested pairs at once.
    """
    second = study.second
    if second is None:
        return []
    relevant = np.flatnonzero(np.nan_to_num(study.overall["total"].value) >= NEGLIGIBLE / 10)
    pairs = list(itertools.combinations(relevant.tolist(), 2))
    # in 95 of 100 studies no pair is sure by chance (Bonferroni)
    quantiles = stdtrit(REPLICATES - 1, 1 - (1 - LEVEL) / 2 / np.array([1, max(len(pairs), 1)]))
    entries: list[Json] = []
    for pair in pairs:
        value, low, high = (float(x[pair]) for x in second)
        sure = value - float(quantiles[1] / quantiles[0]) * (value - low) > 0
        pair_names = [names[k] for k in pair]
        entries.append({"pair": pair_names, "second": value, "second_interval": [low, high], "sure": sure})
    return sorted(entries, key=lambda entry: -entry["second"])
