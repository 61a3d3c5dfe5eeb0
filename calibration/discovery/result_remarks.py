"""Remarks of the loop's result that help to judge it."""

from __future__ import annotations

import math

import numpy as np

from calibration.data.runs import Runs
from calibration.discovery.findings import ParameterShift
from calibration.discovery.loop_notes import NameTest
from calibration.discovery.prediction import ReadingsOfRows
from calibration.discovery.result import DiscoveryResult
from calibration.discovery.verdict import FAR, LoopStages, VerdictNoise
from calibration.inference import noise as noise_room
from calibration.inference import priors, series_noise
from calibration.inference.conduct import error_after_steps
from calibration.inference.fit_notes import Notes, Remark
from calibration.inference.identifiability import undetermined_names
from calibration.inference.lack_of_fit import Residuals, noise_remarks
from calibration.inference.noise import Noise
from calibration.inference.weak_form import TENTH

#: Size of a delay in its sds from which a note reports it, and as a share of the longest in the equations.
LATE, ENDS = 4.0, 0.9
#: Relative difference of two levels of a series, by its range, above which they are distinct [-].
LEVEL = 0.02
#: Ratio of the refit's error to the error of the robot as stated, above which a note reports it [-].
WORSE = 1.1


def worse_than_stated(readings: ReadingsOfRows, noise: Noise, included: np.ndarray) -> list[Remark]:
    """Remarks on channels that the refit describes worse than the robot file did, by more than the noise.

    Their assumed noise then gives some other readings too much weight. Channels with stated noise are not reported.

    Args:
        included: True for included rows, shape (rows,).
    """
    worse_channels = []
    for k, channel in enumerate(noise.channels):
        rows = included & np.isfinite(readings.measured[:, k] + readings.as_stated[:, k] + readings.before[:, k])
        if noise.source[k] not in noise_room.UNSTATED or not rows.any():
            continue
        stated_error, refit_error, size, noise_rms = (
            float(np.sqrt(np.mean(x[rows, k] ** 2)))
            for x in (
                readings.as_stated - readings.measured,
                readings.before - readings.measured,
                readings.measured,
                noise.sd,
            )
        )
        if refit_error > WORSE * stated_error and refit_error - stated_error > noise_rms:
            worse_channels.append(
                Remark(
                    "refit_worse",
                    channel=channel.name,
                    stated=stated_error / size,
                    refit=refit_error / size,
                    word=noise_room.UNSTATED[noise.source[k]],
                )
            )
    return worse_channels


def noise_remarks_before_verdict(sds: VerdictNoise, remaining: Residuals) -> tuple[Remark, ...]:
    """Remarks on wrong sds to report before the verdict: from the residuals of the final fit, or, if those agree with
    the sds, that the sds were changed.
    """
    remarks = tuple(noise_remarks(remaining, sds.noise.word)) if sds.remarks else ()
    if sds.factors:
        return () if remarks else sds.remarks
    return remarks


def loop_remarks(result: DiscoveryResult, traced: LoopStages, noise: Noise, remaining: Residuals) -> Notes:
    """Remarks on the result that help to judge it.

    Args:
        noise: noise of the readings.
        remaining: residuals of the final fit.
    """
    remarks, sds, run = list[Remark](), traced.sds, traced.run
    if run is not None and run.contradicts:
        remarks.append(Remark("contradicted", promised=run.promised, gained=run.gained))
    is_event = traced.where is not None and traced.where.window is not None
    if sds.factors or not is_event:  # a temporary change is not uniform
        remarks += noise_remarks_before_verdict(sds, remaining)
    remarks += worse_than_stated(result.readings_of_rows, noise, result.included)
    for rows, why in ((result.unusable, "unusable"), (result.outliers, "outliers")):
        if rows:
            remarks.append(Remark("kept_out", rows=rows, why=why))
    far = {name: abs(p.shift_after) for name, p in result.base_shift.items() if abs(p.shift_after) > FAR}
    remarks += [Remark("far_from_prior", name=name, sds=x, kind="loop") for name, x in far.items()]
    undetermined = tuple(
        name for name in undetermined_names(result.held_by_prior, result.together) if name not in far
    )
    remarks += [Remark("held_by_prior", names=undetermined)] * bool(undetermined)
    remarks += [Remark("only_together", pairs=result.together)] * bool(result.together)
    remarks += [Remark("residual_cluster", cluster=c) for c in result.residual_clusters]
    after = result.readings_of_rows.after if result.written else result.readings_of_rows.before
    errors = np.where(result.included[:, None], after - result.readings_of_rows.measured, np.nan)
    remarks += error_after_steps(result.runs, errors)
    delay = result.base_shift.get(priors.DELAY)
    remarks += delay_remarks(result.runs, delay, priors.DELAY in result.robot.rig.stated) if delay is not None else []
    if result.remains is not None:
        remarks.append(Remark("still_lacks", place=result.remains.place, variable=result.remains.variable))
    names = [e.name for e in result.effects]
    doubtful = [t for t in (result.support.tests if result.support else ()) if t.rests_on is not None]
    remarks += [_repeat_row_remark(result, t) for t in doubtful if t.effect in names and not t.changed]
    different = [t for t in doubtful if t.changed]
    if different:
        remarks.append(Remark("run_differs", test=max(different, key=lambda t: t.root_changed)))
    if not result.written and result.gain is not None:
        remarks.append(Remark("unwritten", curve=not result.effects, gain=result.gain.mean, se=result.gain.se))
    settled, replicates_asked = result.replicates, result.settings.replicates
    if settled < 0.9 * replicates_asked:
        remarks.append(Remark("lost_replicates", settled=settled, asked=replicates_asked))
    if 1 / (1 + settled) > min(result.settings.shares.values()):
        remarks.append(Remark("too_few_replicates", settled=settled))
    return tuple(remarks)


def delay_remarks(runs: Runs, delay: ParameterShift, stated: bool) -> list[Remark]:
    """Remark on a delay that the robot's file does not state, or that is as long as the search of the equations."""
    limit = TENTH * float(np.median([runs["time_s"][rows].max() for rows in runs.rows_by_run().values()]))
    ends = abs(delay.after) > ENDS * limit
    if abs(delay.after) <= LATE * delay.sd_after or (stated and not ends):
        return []
    return [Remark("late", delay=delay.after, sd=delay.sd_after, ends=ends)]


def _repeat_row_remark(result: DiscoveryResult, test: NameTest) -> Remark:
    """Remark that proposes an experiment if an effect depends on a single row: repeat the row, and add rows half a
    step away from it.
    """
    runs = result.runs
    row = int(np.flatnonzero(result.numbers == test.row)[0])
    columns = [c for c in ("configuration", *runs.axes) if runs.has(c)]
    conditions = {c: str(runs[c][row]) if runs[c].dtype.kind == "U" else float(runs[c][row]) for c in columns}
    for axis in sorted(runs.axes, key=lambda axis: axis != series_noise.FIRST):
        series = next((rows for rows in series_noise.series_along(runs, axis) if row in rows), None)
        x, value_of_row = runs[axis][row if series is None else series], float(runs[axis][row])
        neighbours = neighbouring_levels(np.asarray(x, float), value_of_row)
        if neighbours:
            return Remark("rests_on", test=test, conditions=conditions, axis=axis, beside=neighbours)
    return Remark("rests_on", test=test, conditions=conditions)


def neighbouring_levels(x: np.ndarray, run_level: float) -> tuple[float, ...]:
    """Levels half a step below and above one level of a series, rounded to practical values.

    Empty if all other levels are closer than `LEVEL` of the range of the series.

    Args:
        x: levels of the series.
        run_level: level of the run.
    """
    distances = np.abs(x - run_level)
    other_levels = distances[distances > LEVEL * np.ptp(x)]
    if not other_levels.size:
        return ()
    unit = 10.0 ** math.floor(math.log10(other_levels.min() / 2))
    step, level = round(other_levels.min() / 2 / unit) * unit, round(run_level / unit) * unit
    return tuple(float(f"{v:.6g}") for v in (level - step, level + step))
