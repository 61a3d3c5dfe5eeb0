"""Result of the closed loop as data by name. JSON and tables are written from it without further computation."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from calibration import described
from calibration.data import Json, Names, columns, posterior_file, writing
from calibration.data.robot_file import write_robot
from calibration.data.runs import Runs
from calibration.discovery import REFIT_FILE, findings, loop_notes, prediction
from calibration.discovery.adequacy import AdequacyTest
from calibration.discovery.experiments import Proposal
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.outliers import OutlierCluster
from calibration.discovery.settings import Settings
from calibration.inference import fit_notes
from calibration.inference.details import Detail
from calibration.inference.identifiability import determined_together
from calibration.inference.residual_clusters import ResidualCluster
from calibration.inference.simulation_errors import OF_SIZE
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot

SCHEMA = "mmrjax.loop/4"


Errors = dict[str, dict[str, float | int]]


@dataclasses.dataclass(frozen=True)
class WorseChannel:
    """A channel whose hold-out error is larger with the effects than without them.

    Attributes:
        kind: kind of block that was left out.
        channel: name of the channel.
        rows: number of rows that both fits predict.
        before, after: rms error over these rows, without and with the effects [%].
    """

    kind: str
    channel: str
    rows: int
    before: float
    after: float


@dataclasses.dataclass(frozen=True)
class DiscoveryResult:
    """Result of the closed loop.

    Attributes:
        verdict: `none`, `named`, `class`, `mechanism`, `place` or `undescribed`.
        summary: the verdict with all data from which its statement is written.
        robot: fitted robot with the proposal if `written`, as saved in `robot.toml`.
        refit: fitted robot without additions.
        written: True if `robot` includes the proposed effects.
        gains: each set of effects by its size, with its hold-out gain over the refit. The proposal is last. Empty if
            no block can be held out.
        converged: True if the fit of `robot` is an optimum.
        posterior: posterior of all fitted parameters.
        runs: the measured runs.
        numbers: row numbers as used in messages.
        included: True for included rows.
        outliers, unusable: row numbers of outliers, and of rows that the robot cannot reach.
        effects: effects added to the model, established or tentative.
        unnamed: discrepancy that no effect explains, if the verdict names none.
        remains: the discrepancy that the effects leave.
        next_experiment: most informative experiment. None if there are no alternatives to separate.
        cannot_see: effects that the data cannot reveal.
        needs_histories: effects that only time histories can reveal.
        needs_reverse: effects that only runs in both directions can show.
        alternatives, implausible: candidates that are nearly as good, and those of implausible size or sign.
        hidden: effects that the effects found would hide, the largest first.
        support: tests of the effects' names. None if no name was tested.
        cluster: property that the outliers share. They were then not excluded. None if there is none.
        residual_clusters: groups of rows with similar residuals, by columns that the model does not use.
        before, after: tests of the residuals without and with the proposal.
        chi2: twice the objective without and with the proposal [σ²].
        readings: number of included readings.
        base_shift: each base parameter without and with the proposal.
        scores: scores of the library at the base fit, strongest first.
        detail: further findings for this kind of data: errors of equations by run, or memory, orders and drift.
        readings_of_rows: measured and simulated readings of each row.
        errors_as_stated: rms error of each channel for the robot before any fit.
        errors, errors_held_out: rms by channel, before and after, over the rows that both predict. By kind of block.
        held_out_unpredictable: kinds of block with at least one block that the others cannot predict.
        held_out_worse: channels whose hold-out error rises.
        noise: channel → source of its sd, and its median relative size [%].
        settings: statistical constants of the loop.
        replicates: number of bootstrap tables whose refit converged.
        remarks: notes on the result.
        sensitivity: verdicts at other levels of the assumed noise.
    """

    verdict: str
    summary: loop_notes.VerdictSummary
    robot: Robot
    refit: Robot
    gains: tuple[tuple[Names, prediction.Gain], ...]
    written: bool
    converged: bool
    posterior: posterior_file.Posterior
    runs: Runs
    numbers: np.ndarray
    included: np.ndarray
    outliers: tuple[int, ...]
    unusable: tuple[int, ...]
    effects: tuple[findings.FoundEffect, ...]
    unnamed: findings.UnnamedDiscrepancy | None
    remains: DiscrepancyLocation | None
    next_experiment: Proposal | None
    cannot_see: Names
    needs_histories: Names
    needs_reverse: Names
    alternatives: tuple[findings.RejectedCandidate, ...]
    implausible: tuple[findings.RejectedCandidate, ...]
    hidden: tuple[findings.HiddenEffect, ...]
    support: loop_notes.NameSupport | None
    cluster: OutlierCluster | None
    residual_clusters: tuple[ResidualCluster, ...]
    before: AdequacyTest
    after: AdequacyTest
    chi2: tuple[float, float]
    readings: int
    base_shift: dict[str, findings.ParameterShift]
    scores: tuple[findings.EffectScore, ...]
    detail: Detail
    readings_of_rows: prediction.ReadingsOfRows
    errors_as_stated: Errors
    errors: tuple[Errors, ...]
    errors_held_out: dict[str, tuple[Errors, ...]]
    held_out_unpredictable: Names
    held_out_worse: tuple[WorseChannel, ...]
    noise: dict[str, Json]
    settings: Settings
    replicates: int
    remarks: fit_notes.Notes = ()
    sensitivity: tuple[NoiseVerdict, ...] = ()

    @property
    def statement(self) -> str:
        """The answer in a sentence or two. It begins with backlash or compliance that no effect of the library
        explains.
        """
        lost_motion = described.sentences(fit_notes.remarks_with_codes(self.remarks, "lost_motion"))
        return " ".join((*(f"{note}." for note in lost_motion), described.describe(self.headline)))

    @property
    def verdict_statement(self) -> str:
        """The verdict at the noise of the fit, with its evidence."""
        return described.describe(self.summary)

    @property
    def headline(self) -> loop_notes.Headline:
        """The claims that hold at every noise level tried."""
        return loop_notes.headline(self.summary, [(s.factor, s.summary) for s in self.sensitivity])

    @property
    def gain(self) -> prediction.Gain | None:
        """Hold-out gain of the proposal over the refit, None if no block can be held out."""
        return self.gains[-1][1] if self.gains else None

    @property
    def adequate_after(self) -> bool:
        """True if the residuals with the proposal do not exceed the noise by the margin of the test."""
        return not self.after.rejected_with_margin

    @property
    def refit_alone(self) -> bool:
        """True if the loop proposes no effect and no curve."""
        return self.verdict in loop_notes.WITHOUT_CLAIM

    @property
    def standing(self) -> str:
        """Reasons for or against the effects' names, as a sentence, "" for none."""
        return described.describe(self, "standing")

    @property
    def notes(self) -> Names:
        """Remarks as sentences."""
        return described.sentences(self.remarks)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels of the readings, in order."""
        return self.runs.channels

    @property
    def chi2_of_readings(self) -> tuple[float, float]:
        """Sum of squared residuals of the included readings, without and with the proposal [σ²].

        Unlike `chi2`, it excludes the distances of parameters from their priors, and penalties.
        """
        readings = self.readings_of_rows
        residuals = [(x - readings.measured) / readings.sd for x in (readings.before, readings.after)]
        before, after = (float(np.nansum(x[self.included] ** 2)) for x in residuals)
        return before, after

    @property
    def predicted(self) -> dict[str, tuple[int, int]]:
        """Kind of block → number of rows with hold-out predictions, without and with the proposal."""
        rows = {}
        for kind, held_out in self.readings_of_rows.held_out.items():
            before, after = (int(np.sum(np.isfinite(x[self.included]).any(1))) for x in held_out)
            rows[kind] = before, after
        return rows

    @property
    def rms(self) -> dict[str, dict[str, float]]:
        """rms error of each fit and channel [unit of the channel], over the rows of the percentage errors."""
        fits = *self.errors, *next(iter(self.errors_held_out.values()), ())
        names = ("before", "after", "held_out_before", "held_out_after")
        return {
            fit: {name: e["rms"] for name, e in by_channel.items() if e["rows"]}
            for fit, by_channel in zip(names, fits, strict=False)
        }

    @property
    def held_by_prior(self) -> Names:
        """Names of the fitted parameters that the data do not determine, so that their priors do."""
        return tuple(name for name, p in self._parameters.items() if p.held_by_prior)

    @property
    def _parameters(self) -> dict[str, findings.ParameterShift | findings.ParameterEstimate]:
        """Fitted parameters of the base and of the effects, by name."""
        of_effects = {f"effects.{e.name}.{name}": p for e in self.effects for name, p in e.parameters.items()}
        return {**self.base_shift, **of_effects}

    @property
    def together(self) -> tuple[fit_notes.DependentPair, ...]:
        """Pairs of parameters, of the base or of effects, that the data determine only in combination."""
        pairs = determined_together(self.posterior, self.held_by_prior)
        return tuple(pair for pair in pairs if self._parameters.keys() >= {pair.one, pair.other})

    def to_json(self) -> Json:
        """The whole result as JSON data, as described in docs/schemas/loop.schema.json."""
        mechanism, main = self.summary.mechanism, next(iter(self.errors_held_out.values()), (None, None))
        as_stated, course = self.errors_as_stated, "" if self.unnamed is None else described.describe(self.unnamed)
        unnamed = [] if self.unnamed is None else [self.unnamed.to_json()]
        return writing.json_value(
            {
                "schema": SCHEMA,
                **writing.entries_of(self, "statement", "verdict"),
                "mechanism": None
                if mechanism is None
                else {
                    **writing.entries_of(
                        mechanism, "families", "effects", "fails", "share", "gain", "again", "se", "errors"
                    ),
                    "established": not mechanism.fails,
                    "course": course,
                },
                "missed": [m._asdict() for m in self.summary.missed],
                "headline": {
                    **writing.entries_of(self.headline, "level", "claims", "factors", "shared"),
                    "statement": self.statement,
                },
                "verdict_statement": self.verdict_statement,
                "rows": len(self.runs),
                "rows_used": int(self.included.sum()),
                **writing.entries_of(self, "rows_unusable=unusable", "rows_outliers=outliers"),
                "effects": [*(e.to_json(self.support) for e in self.effects), *unnamed],
                **writing.entries_of(
                    self, "next_experiment", "remains", "cannot_see", "needs_series=needs_histories", "needs_reverse"
                ),
                **self.detail.to_json(),
                **writing.entries_of(
                    self, "alternatives", "implausible", "hidden", "standing", "cluster", "residual_clusters"
                ),
                "errors": {
                    # nothing is fitted as stated, so both are the same
                    "as_stated": {"fitted": as_stated, "held_out": as_stated},
                    "before": {"fitted": self.errors[0], "held_out": main[0]},
                    "after": {"fitted": self.errors[1], "held_out": main[1]},
                },
                "errors_percent_of": OF_SIZE,
                "held_out_by": {
                    kind: {"before": before, "after": after, "blocks": self.readings_of_rows.blocks[kind]}
                    for kind, (before, after) in self.errors_held_out.items()
                },
                **writing.entries_of(self, "held_out_unpredictable", "held_out_worse"),
                "prediction": {
                    "gain": self.gain and self.gain.mean,
                    "se": self.gain and self.gain.se,
                    "sets": [{"effects": names, "gain": g.mean, "se": g.se} for names, g in self.gains],
                    "unit": "nat a reading",
                    "written": "found" if self.written else "refit",
                },
                "adequate": {"before": not self.before.rejected, "after": self.adequate_after},
                "evidence": writing.entries_of(self, "before", "after"),
                "chi2": {
                    "before": self.chi2[0],
                    "after": self.chi2[1],
                    "readings": self.readings,
                    "of_readings": dict(zip(("before", "after"), self.chi2_of_readings, strict=True)),
                },
                **writing.entries_of(self, "base_shift", "together", "scores"),
                "bootstrap": {
                    "replicates": self.replicates,
                    **writing.entries_of(self.settings, "asked=replicates", "seed", "family_wise_error", "shares"),
                },
                **writing.entries_of(self, "settings", "noise", "noise_sensitivity=sensitivity", "notes"),
            }
        )

    def rows_table(self) -> dict[str, np.ndarray]:
        """Table with one line for each row: conditions, readings (measured, simulated without and with the proposal,
        held out), and errors of balances if known.
        """
        readings = self.readings_of_rows
        condition_columns = ("run_id", *columns.WHEN, "configuration", *self.runs.axes, *columns.DRIVING)
        table = {"row": self.numbers, **{k: self.runs[k] for k in condition_columns if self.runs.has(k)}}
        main = next(iter(readings.held_out.values()), None)
        for k, channel in enumerate(self.channels):
            column, unit = channel.column, channel.factor
            columns_of_channel = {column: readings.measured, channel.sd_column: readings.sd}
            columns_of_channel |= {f"before_{column}": readings.before, f"after_{column}": readings.after}
            if main is not None:
                columns_of_channel |= {f"held_out_before_{column}": main[0], f"held_out_after_{column}": main[1]}
            table |= {name: x[:, k] / unit for name, x in columns_of_channel.items()}
            for when, simulated in (("before", readings.before), ("after", readings.after)):
                errors = simulated[:, k] - readings.measured[:, k]
                table[f"residual_{when}_{channel.name}_sigma"] = errors / readings.sd[:, k]
        table |= self.detail.columns()
        use = np.full(len(self.runs), "used", dtype="<U8")
        use[np.isin(self.numbers, self.outliers)] = "outlier"
        use[np.isin(self.numbers, self.unusable)] = "unusable"
        table["use"] = use
        return table

    def save(self, folder: Path | str, robot_name: str = "", tables: str = "csv") -> None:
        """Writes `result.json`, `rows.csv`, `posterior.nc`, `robot.toml` and `fitted.toml` (the refit without
        additions).

        Args:
            folder: folder for the files, created if missing.
            robot_name: name of the initial robot.
            tables: formats, as in `write_table`.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        writing.write_json(folder / "result.json", self.to_json())
        writing.write_table(folder / "rows.csv", self.rows_table(), tables)
        note = described.describe(self, "header", robot_name)
        if self.held_by_prior:
            note += "\n" + described.describe(fit_notes.Remark("held_by_prior", names=self.held_by_prior))
        write_robot(self.robot, folder / "robot.toml", note=note)
        write_robot(self.refit, folder / REFIT_FILE, note=described.describe(self, "refit header", robot_name))
        posterior_file.write_posterior(self.posterior, folder / posterior_file.FILE)


@dataclasses.dataclass(frozen=True)
class NoiseVerdict:
    """Verdict at another noise level.

    Attributes:
        factor: factor on the assumed noise.
    """

    factor: float
    verdict: str
    summary: loop_notes.VerdictSummary
    classes: tuple[Names, ...]
    adequate_after: bool

    @property
    def statement(self) -> str:
        """The verdict as a sentence."""
        return described.describe(self.summary)

    def to_json(self) -> Json:
        """Entry of result.json."""
        return writing.entries_of(self, "factor", "verdict", "statement", "classes", "adequate_after")
