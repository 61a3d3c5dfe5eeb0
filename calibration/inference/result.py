"""Result of a calibration, by name, and its form in files."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calibration.data import Columns, Json, Names, writing
from calibration.data import posterior_file as posterior
from calibration.data.posterior_file import Posterior
from calibration.described import describe, sentences
from calibration.inference.fit_notes import DependentPair, Notes, Remark, determination
from calibration.inference.identifiability import Identifiability, determined_together, undetermined_names
from calibration.inference.lack_of_fit import Adequacy
from calibration.inference.multistart import StartOutcomes
from calibration.inference.population import PopulationSearch
from calibration.inference.residual_clusters import ResidualCluster
from calibration.inference.simulation_errors import OF_SIZE
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES

SCHEMA = "mmrjax.calibrate/1"
METHOD = "Levenberg-Marquardt"

Interval = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class PriorSummary:
    """Prior of a parameter.

    Attributes:
        family: `normal` or `log-normal`.
        median: median [SI].
        interval: 95 % interval [SI].
        source: source as stated in the field, or a row of `fit_words.PRIORS`, or `stated`.
    """

    family: str
    median: float
    interval: Interval
    source: str

    def to_json(self) -> Json:
        """Entry of result.json."""
        return {**dataclasses.asdict(self), "source": describe(self)}


@dataclasses.dataclass(frozen=True)
class SteadyEstimate:
    """Value of a parameter at the optimum of the same problem with `steady`.

    Attributes:
        value: the value [SI].
        apart_in_sd: distance of the estimate from this value [posterior sd].
    """

    value: float
    apart_in_sd: float


#: Entries of an estimate in result.json that are its fields.
ENTRIES = (
    "value", "sd", "interval", "interval_linear", "interval_open", "unit", "meaning", "prior", "variance_ratio",
    "held_by_prior", "at_bound", "measured_by_data", "shift_in_prior_sd=shift",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Estimate of one free parameter.

    Attributes:
        value: value at the optimum.
        sd: posterior standard deviation from the linear analysis [unit].
        interval: 95 % interval, from the profile likelihood if there is one [unit].
        interval_linear: 95 % interval from the sd only [unit].
        interval_open: True for each end that lies beyond the last point of the profile.
        unit, meaning: unit and meaning of the parameter.
        prior: prior of the parameter.
        shift: distance of the value from the prior median [prior sds].
        variance_ratio: posterior variance over prior variance [-].
        held_by_prior: True if the data do not determine it, see `identifiability.held_by_prior`.
        at_bound: bound at which it is, `lower`, `upper` or None.
        measured_by_data: True if at least one reading depends on it.
        profiled: True if the interval is from a profile likelihood.
        with_steady: estimate with `steady`, None unless the search started there.
    """

    value: float
    sd: float
    interval: Interval
    interval_linear: Interval
    interval_open: tuple[bool, bool]
    unit: str
    meaning: str
    prior: PriorSummary
    shift: float
    variance_ratio: float
    held_by_prior: bool
    at_bound: str | None
    measured_by_data: bool
    profiled: bool = False
    with_steady: SteadyEstimate | None = None

    def to_json(self) -> Json:
        """Entry of `parameters` in result.json."""
        return writing.entries_of(self, *ENTRIES, *["with_steady"] * (self.with_steady is not None))


@dataclasses.dataclass(frozen=True)
class ChannelNoise:
    """Standard deviation of a channel's noise.

    Attributes:
        source: `stated`, `columns`, `estimated` (from the misfit), or `no readings`.
        median_percent: median of sd over reading [%].
        estimated_percent: estimated sd relative to the channel's size (`Observer.sizes`) [%]. None unless estimated.
    """

    source: str
    median_percent: float
    estimated_percent: float | None


@dataclasses.dataclass(frozen=True)
class ChannelErrors:
    """Errors of one channel over the rows that have both a simulated and a measured value.

    Attributes:
        rows: number of rows.
        rms_percent, max_percent: rms error and largest error, in percent of the channel's measured rms.
        rms_sigma: rms error in sds of the noise.
        rms: rms error in the channel's unit.
    """

    rows: int
    rms_percent: float
    max_percent: float
    rms_sigma: float
    rms: float

    def __getitem__(self, name: str) -> float:
        """Number by its name, as in the errors of `discover`."""
        if name not in self.__dataclass_fields__:
            raise KeyError(name)
        number: float = getattr(self, name)
        return number


#: Errors by the name of the channel.
Errors = dict[str, ChannelErrors]


@dataclasses.dataclass(frozen=True)
class BlockErrors:
    """Hold-out errors of one block.

    Attributes:
        errors: errors of its rows.
        unreachable_rows: numbers of the block's rows without a prediction, counted from 1.
        converged: True if the fit without it converged.
    """

    errors: Errors
    unreachable_rows: tuple[int, ...]
    converged: bool

    def to_json(self) -> Json:
        """Entry of `held_out_by` in result.json."""
        return {**self.errors, **writing.entries_of(self, "unreachable_rows", "converged")}


@dataclasses.dataclass(frozen=True)
class HeldOutErrors:
    """Hold-out predictions of all rows, each by a fit without its block, for one kind of block.

    Attributes:
        errors: errors of all rows.
        unreachable_rows: numbers of the rows without a prediction, counted from 1.
        blocks: errors of each block, by label.
        reading: predicted readings by channel [SI], NaN if the fitted robot does not reach the row, shape (rows,).
    """

    JSON = ("all=errors", "unreachable_rows", "blocks")
    errors: Errors
    unreachable_rows: tuple[int, ...]
    blocks: dict[str, BlockErrors]
    reading: Columns


@dataclasses.dataclass(frozen=True)
class ChannelReadings:
    """Readings of one channel. All arrays have shape (rows,).

    Attributes:
        measured: measured [SI], NaN if missing.
        sd: standard deviation of each reading [SI].
        before, after: simulated by the robot as given, and as calibrated [SI], NaN if it does not reach the row.
        percent, sigma: errors after calibration [%] and [σ].
    """

    measured: np.ndarray
    sd: np.ndarray
    before: np.ndarray
    after: np.ndarray
    percent: np.ndarray
    sigma: np.ndarray


@dataclasses.dataclass(frozen=True)
class ChiSquare:
    """χ² of the readings [σ²], and the degrees of freedom that the fit leaves.

    Attributes:
        tests_adequacy: False if noise was estimated from the misfit, so that χ² tests nothing.
    """

    value: float
    degrees_of_freedom: float
    tests_adequacy: bool


@dataclasses.dataclass(frozen=True)
class CalibrationResult:
    """Result of `calibrate`, the source of all files and figures.

    Attributes:
        robot: calibrated robot.
        source: file of the runs.
        channels: channels of the readings, in order.
        model: name of the fidelity.
        seed: random seed of the starts.
        parameters: estimate of each free parameter, by name.
        tied: parameters tied to free ones, by name: the free one, and the ratio to it.
        noise: noise of each channel, by name.
        axis: column that orders the rows of a run.
        errors_before, errors_after: errors of the robot as given and as calibrated, by channel.
        held_out: hold-out errors by kind of block, the most informative kind first.
        conditions: columns with the conditions of the runs.
        readings: readings by channel.
        status_before, status: status of each row before and after calibration, as a word, shape (rows,).
        adhesion_used: used share of the adhesion, calibrated robot [-], shape (rows,).
        objective: objective at the optimum [½σ²].
        converged: True if the search converged.
        starts: outcome of all searches.
        searched: population of the search by generations before them, None without one.
        chi_square: χ² of the finite readings.
        adequacy: tests of whether the residuals are consistent with noise.
        residual_clusters: columns that the model does not use that the residuals depend on.
        identifiability: linear analysis at the optimum.
        posterior: posterior of the free parameters.
        remarks: remarks to read before the result is used.
    """

    robot: Robot
    source: str
    channels: tuple[Channel, ...]
    model: str
    seed: int
    parameters: dict[str, Estimate]
    tied: dict[str, tuple[str, float]]
    noise: dict[str, ChannelNoise]
    axis: str
    errors_before: Errors
    errors_after: Errors
    held_out: dict[str, HeldOutErrors]
    conditions: Columns
    readings: dict[str, ChannelReadings]
    status_before: np.ndarray
    status: np.ndarray
    adhesion_used: np.ndarray
    objective: float
    converged: bool
    starts: StartOutcomes
    searched: PopulationSearch | None
    chi_square: ChiSquare
    adequacy: Adequacy
    residual_clusters: tuple[ResidualCluster, ...]
    identifiability: Identifiability
    posterior: Posterior
    remarks: Notes

    def __len__(self) -> int:
        """Number of rows of the table."""
        return len(self.status)

    @property
    def notes(self) -> Names:
        """Remarks as sentences."""
        return sentences(self.remarks)

    @property
    def profiled(self) -> bool:
        """True if profile likelihoods were computed."""
        return any(p.profiled for p in self.parameters.values())

    @property
    def held_by_prior(self) -> Names:
        """Names of the parameters that the data do not determine, so that their priors do."""
        return tuple(name for name, p in self.parameters.items() if p.held_by_prior)

    @property
    def together(self) -> tuple[DependentPair, ...]:
        """Pairs of parameters that the data determine only in combination."""
        return determined_together(self.posterior, self.held_by_prior)

    @property
    def undetermined(self) -> Names:
        """Names of the parameters that only their priors determine, except those of a pair in `together`."""
        return undetermined_names(self.held_by_prior, self.together)

    def determined(self, name: str) -> str:
        """Determination of a parameter by the data: `yes`, `no`, or the parameters with which only a combination is
        determined.
        """
        return describe(determination(name, self.parameters[name].held_by_prior, self.together))

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows with each status, for the calibrated robot."""
        return _status_counts(self.status)

    @property
    def held_out_alike(self) -> dict[str, Names]:
        """Distinct kinds of block, each with later kinds whose predictions are the same (to 1 % of a reading's
        sd).
        """
        groups: dict[str, Names] = {}
        for kind, block_errors in self.held_out.items():
            same_kind = next((k for k in groups if self._same(self.held_out[k], block_errors)), None)
            groups |= {kind: ()} if same_kind is None else {same_kind: (*groups[same_kind], kind)}
        return groups

    def _same(self, one: HeldOutErrors, other: HeldOutErrors) -> bool:
        return all(
            np.allclose(one.reading[name] / r.sd, other.reading[name] / r.sd, rtol=0, atol=0.01, equal_nan=True)
            for name, r in self.readings.items()
        )

    @property
    def main_blocks(self) -> HeldOutErrors | None:
        """Hold-out errors of the most informative kind of block, or None."""
        return next(iter(self.held_out.values()), None)

    @property
    def rms(self) -> dict[str, dict[str, float]]:
        """rms errors of each fit (before, after, held out) and channel [unit of the channel]."""
        fits = {"before": self.errors_before, "after": self.errors_after}
        if self.main_blocks is not None:
            fits["held_out"] = self.main_blocks.errors
        return {
            fit: {name: e.rms for name, e in errors_by_channel.items() if e.rows}
            for fit, errors_by_channel in fits.items()
        }

    def to_json(self) -> Json:
        """Content of result.json, as described in docs/schemas/calibrate.schema.json."""
        analysis = self.identifiability
        main = self.main_blocks
        entries = functools.partial(writing.entries_of, self)
        return writing.json_value(
            {
                "schema": SCHEMA,
                "model": self.model,
                "rows": len(self),
                "parameters": {
                    name: {**p.to_json(), "determined": self.determined(name)} for name, p in self.parameters.items()
                },
                "tied": {name: f"{ratio:.4g} x {leader}" for name, (leader, ratio) in self.tied.items()},
                "noise": self.noise,
                "percent_of": OF_SIZE,
                "errors": {
                    # no fit precedes, so both are the same
                    "before": entries("fitted=errors_before", "held_out=errors_before"),
                    "after": {
                        "fitted": self.errors_after,
                        "held_out": None if main is None else main.errors,
                    },
                },
                "held_out_by": self.held_out,
                "optimizer": {
                    "method": METHOD,
                    "status": "converged" if self.converged else "not_converged",
                    "objective": self.objective,
                    "starts": len(self.starts.cost),
                    **entries("starts_infeasible=starts.infeasible", "starts_at_best=starts.agree"),
                    **entries("agreement=starts.statement", "seed", "population=searched"),
                },
                **entries("chi2=chi_square", "adequate=adequacy", "residual_clusters"),
                "identifiability": {
                    **entries("singular_values=identifiability.singular_values", "rank=identifiability.rank"),
                    "directions_better_known_from_data": int(np.sum(analysis.singular_values > 1)),
                    "weak_directions": [
                        {"singular_value": s, "components": main} for s, main in analysis.weak_directions()
                    ],
                    "correlated": [{"a": a, "b": b, "correlation": r} for a, b, r in analysis.correlated()],
                    "together": self.together,
                },
                "statuses_before": _status_counts(self.status_before),
                **entries("statuses=counts", "notes"),
            }
        )

    def rows(self) -> Columns:
        """Table with one line for each row: conditions, readings (before, after, held out), errors in percent and in
        σ.
        """
        return {**self.conditions, **dict(self._readings()), "status": self.status}

    def rows_table(self) -> Columns:
        """Result of `rows`, under the name that all results have."""
        return self.rows()

    def _readings(self) -> Iterator[tuple[str, np.ndarray]]:
        main = self.main_blocks
        for channel in self.channels:
            r = self.readings[channel.name]
            column = channel.column
            yield column, r.measured / channel.factor
            yield channel.sd_column, r.sd / channel.factor
            yield f"before_{column}", r.before / channel.factor
            yield f"after_{column}", r.after / channel.factor
            if main is not None:
                yield f"held_out_{column}", main.reading[channel.name] / channel.factor
            yield f"error_{channel.name}_percent", r.percent
            yield f"error_{channel.name}_sigma", r.sigma

    def save(self, folder: Path | str, robot_name: str = "a robot", tables: str = "csv") -> None:
        """Writes robot.toml, posterior.nc, result.json and rows.csv into a folder, which is created if missing.

        Args:
            robot_name: name of the initial robot, for the first lines of robot.toml.
            tables: formats, as in `write_table`.
        """
        from calibration.data import robot_file

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        notes = [describe(Remark("held_by_prior", names=self.undetermined))] if self.undetermined else []
        note = "\n".join([describe(self, "header", robot_name), *notes])
        robot_file.write_robot(self.robot, folder / "robot.toml", note=note)
        writing.write_json(folder / "result.json", self.to_json())
        writing.write_table(folder / "rows.csv", self.rows(), tables)
        posterior.write_posterior(self.posterior, folder / posterior.FILE)


def _status_counts(status: np.ndarray) -> dict[str, int]:
    return {name: int(np.sum(status == name)) for name in STATUSES}
