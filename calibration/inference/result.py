"""Result of a calibration, by name, and its plain-data forms for files."""

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
from calibration.inference.fit_notes import DependentPair, Determination, Notes, Remark
from calibration.inference.identifiability import Identifiability, determined_together, undetermined_names
from calibration.inference.lack_of_fit import Adequacy
from calibration.inference.multistart import StartOutcomes
from calibration.inference.population import Searched
from calibration.inference.residual_clusters import ResidualCluster
from calibration.inference.simulation_errors import OF_SIZE
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES

SCHEMA = "mmrjax.calibrate/1"
METHOD = "Levenberg-Marquardt"

Interval = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Prior:
    """Prior of a parameter.

    Attributes:
        family: `normal` or `log-normal`.
        median: [SI].
        interval: interval that holds 95 % [SI].
        source: source of a field, in words, else a row of `fit_words.PRIORS`, or `stated`.
    """

    family: str
    median: float
    interval: Interval
    source: str

    def to_json(self) -> Json:
        """As in result.json."""
        return {**dataclasses.asdict(self), "source": describe(self)}


@dataclasses.dataclass(frozen=True)
class ProfileCurve:
    """Profile likelihood of one parameter: the objective minimised over all others.

    Attributes:
        value: value of the parameter, increasing [SI], shape (points,).
        rise: twice the objective's rise above the optimum [σ²], shape (points,).
    """

    value: np.ndarray
    rise: np.ndarray


@dataclasses.dataclass(frozen=True)
class SteadyEstimate:
    """A parameter at the optimum of the same problem with `steady`.

    Attributes:
        value: there [SI].
        apart_in_sd: distance of the estimate from it [posterior sd].
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
        sd: posterior, linear, both [unit].
        interval: interval of 95 %, from the profile if there is one.
        interval_linear: from the sd only [unit].
        interval_open: True if an end is beyond the last point of the profile.
        interval_shift: the ends of `interval` in prior sds from the prior's median.
        unit, meaning: unit and meaning of its field.
        prior: prior before the fit.
        shift: shift of the value from the prior's median [prior sd].
        variance_ratio: posterior over prior variance [-].
        held_by_prior: True if it is, see `identifiability.held_by_prior`.
        at_bound: `lower`, `upper` or None.
        measured_by_data: True if any reading depends on it.
        profile: None without profiles.
        with_steady: None unless the search began at the optimum of `steady`.
    """

    value: float
    sd: float
    interval: Interval
    interval_linear: Interval
    interval_open: tuple[bool, bool]
    interval_shift: Interval
    unit: str
    meaning: str
    prior: Prior
    shift: float
    variance_ratio: float
    held_by_prior: bool
    at_bound: str | None
    measured_by_data: bool
    profile: ProfileCurve | None = None
    with_steady: SteadyEstimate | None = None

    def to_json(self) -> Json:
        """Entry of `parameters` in result.json."""
        return writing.entries_of(self, *ENTRIES, *["with_steady"] * (self.with_steady is not None))


@dataclasses.dataclass(frozen=True)
class ChannelNoise:
    """The sd of a channel.

    Attributes:
        source: `stated`, `columns`, `estimated` (from the misfit), or `no readings`.
        median_percent: median over the readings of sd over reading.
        estimated_percent: as a share of the channel's size, see `Observer.sizes`, None unless estimated.
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
        """A number by its name, as in the errors of `discover`."""
        if name not in self.__dataclass_fields__:
            raise KeyError(name)
        number: float = getattr(self, name)
        return number


#: Errors by the name of the channel.
Errors = dict[str, ChannelErrors]


@dataclasses.dataclass(frozen=True)
class Block:
    """One held-out block.

    Attributes:
        errors: errors of its rows.
        unreachable_rows: those that the fit without it does not reach, counted from 1.
        converged: True if that fit converged.
    """

    errors: Errors
    unreachable_rows: tuple[int, ...]
    converged: bool

    def to_json(self) -> Json:
        """Entry of `held_out_by` in result.json."""
        return {**self.errors, **writing.entries_of(self, "unreachable_rows", "converged")}


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """Hold-out predictions of all rows by fits without their block, for one kind of blocks.

    Attributes:
        errors: errors of all rows.
        unreachable_rows: those without a prediction, counted from 1.
        blocks: by label.
        reading: by channel [SI], NaN if the fit's robot does not reach the row, shape (rows,).
    """

    JSON = ("all=errors", "unreachable_rows", "blocks")
    errors: Errors
    unreachable_rows: tuple[int, ...]
    blocks: dict[str, Block]
    reading: Columns


@dataclasses.dataclass(frozen=True)
class ChannelReadings:
    """Readings of one channel, all arrays of shape (rows,).

    Attributes:
        measured: [SI], NaN if missing.
        sd: standard deviation of each.
        before, after: simulated by the robot as given and as calibrated [SI], NaN if it does not reach the row.
        percent, sigma: errors after calibration, in % and in σ.
    """

    measured: np.ndarray
    sd: np.ndarray
    before: np.ndarray
    after: np.ndarray
    percent: np.ndarray
    sigma: np.ndarray


@dataclasses.dataclass(frozen=True)
class ChiSquare:
    """Misfit of the readings [σ²], and the degrees of freedom left by the fit.

    Attributes:
        tests_adequacy: False if noise was estimated from the misfit.
    """

    value: float
    degrees_of_freedom: float
    tests_adequacy: bool


@dataclasses.dataclass(frozen=True)
class CalibrationResult:
    """Result of `calibrate`. All files and figures are made from it.

    Attributes:
        robot: calibrated.
        source: file of the runs.
        channels: channels of the readings, in order.
        model: the fidelity.
        seed: seed of the starts.
        parameters: the free ones, by name.
        tied: those tied to them, by name: the free one, and the ratio that they keep to it.
        noise: by channel.
        axis: column that orders the rows of a run.
        errors_before, errors_after: errors of the robot as given and as calibrated, by channel.
        held_out: by kind of block, the most informative first.
        conditions: columns of the runs, as in their table.
        readings: by channel.
        status_before, status: word of each row, shape (rows,).
        adhesion_used: by the calibrated robot [-], shape (rows,).
        objective: objective at the optimum [½σ²].
        converged: True if the search converged.
        starts: outcome of all searches.
        searched: the population before them, None without.
        chi_square: χ² of the finite readings.
        adequacy: tests whether the residuals are consistent with noise.
        residual_clusters: clusters of the residuals by columns without a role.
        identifiability: the linear analysis.
        posterior: posterior of the free parameters.
        remarks: notes to read before the result is used.
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
    held_out: dict[str, HeldOut]
    conditions: Columns
    readings: dict[str, ChannelReadings]
    status_before: np.ndarray
    status: np.ndarray
    adhesion_used: np.ndarray
    objective: float
    converged: bool
    starts: StartOutcomes
    searched: Searched | None
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
        """True if profiles were computed."""
        return any(p.profile is not None for p in self.parameters.values())

    @property
    def held_by_prior(self) -> Names:
        """Names of the parameters held by their priors."""
        return tuple(name for name, p in self.parameters.items() if p.held_by_prior)

    @property
    def together(self) -> tuple[DependentPair, ...]:
        """Pairs of parameters that these data determine only in combination."""
        return determined_together(self.posterior, self.held_by_prior)

    @property
    def undetermined(self) -> Names:
        """Names of the parameters that only their priors determine, without those of a pair in `together`."""
        return undetermined_names(self.held_by_prior, self.together)

    def determined(self, name: str) -> str:
        """`yes`, `no`, or with which parameters together these data determine one."""
        return describe(Determination.from_pairs(name, self.parameters[name].held_by_prior, self.together))

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows with each status, for the calibrated robot."""
        return _counts(self.status)

    @property
    def held_out_alike(self) -> dict[str, Names]:
        """Distinct kinds of blocks, each with the later kinds that predict every row in the same way (to 1 % of a
        reading's sd)."""
        groups: dict[str, Names] = {}
        for kind, held in self.held_out.items():
            like = next((k for k in groups if self._same(self.held_out[k], held)), None)
            groups |= {kind: ()} if like is None else {like: (*groups[like], kind)}
        return groups

    def _same(self, one: HeldOut, other: HeldOut) -> bool:
        return all(
            np.allclose(one.reading[name] / r.sd, other.reading[name] / r.sd, rtol=0, atol=0.01, equal_nan=True)
            for name, r in self.readings.items()
        )

    @property
    def main_blocks(self) -> HeldOut | None:
        """The most informative kind of held-out blocks."""
        return next(iter(self.held_out.values()), None)

    @property
    def rms(self) -> dict[str, dict[str, float]]:
        """rms errors before, after and held out, by fit and channel with readings [unit of the channel]."""
        fits = {"before": self.errors_before, "after": self.errors_after}
        if self.main_blocks is not None:
            fits["held_out"] = self.main_blocks.errors
        return {fit: {name: e.rms for name, e in by.items() if e.rows} for fit, by in fits.items()}

    def to_json(self) -> Json:
        """Entries of result.json, docs/schemas/calibrate.schema.json."""
        about, main, entries = self.identifiability, self.main_blocks, functools.partial(writing.entries_of, self)
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
                    "directions_better_known_from_data": int(np.sum(about.singular_values > 1)),
                    "weak_directions": [
                        {"singular_value": s, "components": main} for s, main in about.weak_directions()
                    ],
                    "correlated": [{"a": a, "b": b, "correlation": r} for a, b, r in about.correlated()],
                    "together": self.together,
                },
                "statuses_before": _counts(self.status_before),
                **entries("statuses=counts", "notes"),
            }
        )

    def rows(self) -> Columns:
        """Table of the rows: conditions, readings before, after and held out, errors in percent and in σ."""
        return {**self.conditions, **dict(self._readings()), "status": self.status}

    def rows_table(self) -> Columns:
        """Result of `rows`, under the name that all results have."""
        return self.rows()

    def _readings(self) -> Iterator[tuple[str, np.ndarray]]:
        main = self.main_blocks
        for channel in self.channels:
            r, column = self.readings[channel.name], channel.column
            yield column, r.measured / channel.factor
            yield channel.sd_column, r.sd / channel.factor
            yield f"before_{column}", r.before / channel.factor
            yield f"after_{column}", r.after / channel.factor
            if main is not None:
                yield f"held_out_{column}", main.reading[channel.name] / channel.factor
            yield f"error_{channel.name}_percent", r.percent
            yield f"error_{channel.name}_sigma", r.sigma

    def save(self, folder: Path | str, robot_name: str = "a robot", tables: str = "csv") -> None:
        """Write robot.toml, posterior.nc, result.json and rows.csv into a folder, which is created if missing.

        Args:
            robot_name: name of the initial robot, for the head of robot.toml.
            tables: as for `write_table`.
        """
        from calibration.data import robot_file

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        held = [describe(Remark("held_by_prior", names=self.undetermined))] if self.undetermined else []
        note = "\n".join([describe(self, "header", robot_name), *held])
        robot_file.write_robot(self.robot, folder / "robot.toml", note=note)
        writing.write_json(folder / "result.json", self.to_json())
        writing.write_table(folder / "rows.csv", self.rows(), tables)
        posterior.write_posterior(self.posterior, folder / posterior.FILE)


def _counts(status: np.ndarray) -> dict[str, int]:
    return {name: int(np.sum(status == name)) for name in STATUSES}
