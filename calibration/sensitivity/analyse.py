"""Sensitivity study: important inputs at each operating point, by each method."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from calibration.data.input_errors import BadConfiguration
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.inference.identifiability import Z95
from calibration.sensitivity import sampled_indices
from calibration.sensitivity.result import InputSummary, OutputStudy, SensitivityResult
from calibration.sensitivity.sampled_indices import IntervalEstimate
from calibration.sensitivity.study import (
    Study,
    inert_inputs,
    interval_ends,
    local_studies,
)
from calibration.sensitivity.uncertain_inputs import UncertainInputs
from mmrjax import derived, fidelities

#: Largest share of base points without a value at an operating point that is studied.
MOST_LOST = 0.5


#: Analysis of an output at one point: the result, None for too few values, and the share of base points without one.
Analyse = Callable[[np.ndarray], tuple[Any, float]]


def _sampled_scores(study: Study, unit: np.ndarray, indices: Sequence[int]) -> np.ndarray:
    """Scores of all inputs, for points in the unit cube of some inputs. The other inputs are at their medians."""
    unit_points = np.full((len(unit), len(study.inputs)), 0.5)
    unit_points[:, indices] = unit
    return study.inputs.scores(unit_points)


def _results_at_points(
    study: Study,
    studies: dict[str, OutputStudy],
    is_sampled: np.ndarray,
    design: Callable[[tuple[int, ...]], tuple[np.ndarray, Analyse]],
) -> Iterator[tuple[str, OutputStudy, dict[int, Any]]]:
    """Yields for each output its name, the study without results of the sample, and the result at each point.

    Args:
        studies: local study of each output.
        is_sampled: True for inputs that are sampled, shape (inputs,).
        design: function that returns sampled scores for some inputs, and the analysis of their outputs.
    """
    points = len(study.points)
    results: dict[str, dict[int, Any]] = {name: {} for name in studies}
    lost = {name: np.zeros(points) for name in studies}
    groups: dict[tuple[int, ...], list[int]] = {}  # of points with the same inputs
    for k in range(points):
        groups.setdefault(tuple(i for i in study.acting(k) if is_sampled[i]), []).append(k)
    groups.pop((), None)
    for input_set, group in groups.items():
        scores, analyse = design(input_set)
        for k, outputs in study.sample(study.inputs.values(scores), group):
            for name in studies:
                result, lost[name][k] = analyse(outputs[name])
                if result is not None and lost[name][k] <= MOST_LOST:
                    results[name][k] = result
    for name, local_study in studies.items():
        studied = np.isin(np.arange(points), list(results[name]))
        share = np.full_like(local_study.share, np.nan)
        yield name, dataclasses.replace(local_study, share=share, lost=lost[name], studied=studied), results[name]


def _estimates_at_points(
    study: Study, by_point: Mapping[int, Mapping[str, IntervalEstimate]], names: Iterable[str]
) -> dict[str, IntervalEstimate]:
    """Estimates at each point, by name, shape (points, inputs), NaN at points without one."""
    arrays = {name: np.full((3, len(study.points), len(study.inputs)), np.nan) for name in names}
    for name, estimates in arrays.items():
        for k, point_estimates in by_point.items():
            estimates[:, k] = point_estimates[name]
    return {name: IntervalEstimate(*estimates) for name, estimates in arrays.items()}


def sobol_study(
    study: Study, studies: dict[str, OutputStudy], is_sampled: np.ndarray, evaluations: int, seed: int
) -> dict[str, OutputStudy]:
    """First-order, total and second-order Sobol indices at each point and over all points."""

    def design(input_set: tuple[int, ...]) -> tuple[np.ndarray, Analyse]:
        size = sampled_indices.base_point_count(evaluations / len(study.points), len(input_set))
        unit = sampled_indices.sobol_design(len(input_set), size, seed)

        def analyse(values: np.ndarray) -> tuple[Any, float]:
            terms = sampled_indices.sobol_terms(unit, values)
            if terms is None:
                return None, 1.0
            return terms.widened(input_set, len(study.inputs)), terms.lost / (size * sampled_indices.REPLICATES)

        return _sampled_scores(study, unit, input_set), analyse

    studies_by_name = {}
    for name, output, terms in _results_at_points(study, studies, is_sampled, design):
        if terms:
            indices = {k: sampled_indices.sobol_indices(point_terms) for k, point_terms in terms.items()}
            overall = sampled_indices.sobol_indices(functools.reduce(operator.add, terms.values()))
            second = overall.pop("second")
            at_points = _estimates_at_points(study, indices, overall)
            sd = np.full(len(study.points), np.nan)
            sd[list(terms)] = np.sqrt([point_terms.variance.mean() for point_terms in terms.values()])
            output = dataclasses.replace(
                output, overall=overall, at_points=at_points, share=np.clip(at_points["total"].value, 0.0, 1.0),
                sd=sd, second=second,
            )  # fmt: skip
        studies_by_name[name] = output
    return studies_by_name


def morris_study(
    study: Study, studies: dict[str, OutputStudy], is_sampled: np.ndarray, evaluations: int, seed: int
) -> dict[str, OutputStudy]:
    """Elementary effects (Morris) over the 95 % range of each input, at each point."""

    def design(input_set: tuple[int, ...]) -> tuple[np.ndarray, Analyse]:
        count = max(int(np.ceil(evaluations / len(study.points) / (len(input_set) + 1))), 10)
        unit = sampled_indices.morris_design(len(input_set), count, seed)
        scores = np.array(_sampled_scores(study, 0.025 + 0.95 * unit, input_set))
        # Trajectories have equal steps in the scores, between the ends of the 95 % interval.
        for j, i in enumerate(input_set):
            if not study.inputs.uniform[i]:
                scores[:, i] = Z95 * (2 * unit[:, j] - 1)

        def analyse(values: np.ndarray) -> tuple[Any, float]:
            statistics = sampled_indices.elementary_effects(unit, values)
            if statistics is None:
                return None, 1.0
            effects, omitted = statistics
            widened = {}
            for key, estimate in effects.items():
                padded = np.zeros((3, len(study.inputs)))
                padded[:, input_set] = estimate
                widened[key] = IntervalEstimate(*padded)
            return widened, omitted / count

        return scores, analyse

    studies_by_name = {}
    for name, output, effects in _results_at_points(study, studies, is_sampled, design):
        if effects:
            at_points = _estimates_at_points(study, effects, next(iter(effects.values())))
            square = at_points["mean_absolute_effect"].value ** 2
            total = square.sum(1, keepdims=True)
            output = dataclasses.replace(
                output,
                overall={
                    key: IntervalEstimate(*(x[output.studied].mean(0) for x in estimate))
                    for key, estimate in at_points.items()
                },
                at_points=at_points,
                share=square / np.where(total > 0, total, 1.0),
            )
        studies_by_name[name] = output
    return studies_by_name


#: Default number of model evaluations: without and with outputs of a run over time.
EVALUATIONS, EVALUATIONS_LONG = 1_000_000, 100_000
#: Smallest number of evaluations.
LEAST = 1_000


def analyse_sensitivity(study: Study, method: str, evaluations: int | None, seed: int = 0) -> SensitivityResult:
    """Runs a sensitivity study and returns its result.

    Args:
        method: one of `METHODS`.
        evaluations: smallest total number of model evaluations. None: the default.
        seed: random seed.

    Raises:
        BadConfiguration: a method that needs independent inputs, too few evaluations, inputs that change no output,
            or no point that can be studied.
    """
    inputs, model = study.inputs, study.model
    if inputs.is_posterior and method != "local":
        raise BadConfiguration(f"--method {method}: needs independent inputs, unlike a posterior's; expected local")
    is_rollout = fidelities.fidelity_facts(model.fidelity).rollout or any(
        o in derived.OF_START for o in model.outputs
    )
    default_evaluations = EVALUATIONS_LONG if is_rollout else EVALUATIONS
    evaluations = default_evaluations if evaluations is None else evaluations
    if evaluations < LEAST:
        raise BadConfiguration(f"--evaluations: got {evaluations}; expected {LEAST} or more")
    study.tell(progress_remark("points"))
    outputs, statuses = local_studies(study)
    if not any(np.isfinite(o.value).any() for o in outputs.values()):
        raise BadConfiguration(_no_point_message(statuses))
    inert = inert_inputs(study, outputs, seed)
    if inert.all():
        raise BadConfiguration("--parameters: every derivative is zero; choose others, or change --outputs")
    if method != "local":
        study.tell(Remark("sampling", method=method, points=len(study.points)))
        run_method = sobol_study if method == "sobol" else morris_study
        outputs = run_method(study, outputs, ~inert, evaluations, seed)
        if not any(s.studied.any() for s in outputs.values()):
            raise BadConfiguration(_no_point_message(study.statuses()))
    return SensitivityResult(
        method=method,
        model=model.fidelity,
        seed=seed,
        inputs=_describe_inputs(inputs, inert),
        correlated=inputs.is_posterior,
        points=study.points,
        outputs=outputs,
        statuses=statuses,
        sampled=study.statuses(),
        evaluations=study.evaluations,
        seconds=round(study.seconds, 3),
        remarks=_study_remarks(study, method, outputs, inert),
    )


def _describe_inputs(inputs: UncertainInputs, inert: np.ndarray) -> dict[str, InputSummary]:
    slope = inputs.slope[inputs.column_indices]
    sd = np.where(inputs.uniform, np.abs(slope).sum(1) / np.sqrt(12), np.sqrt(np.sum(slope**2, 1)))
    low, high = (np.diag(inputs.values(ends)[:, inputs.column_indices]) for ends in interval_ends(inputs))
    median = inputs.values(inputs.centre)[inputs.column_indices]
    summaries = {}
    for k, (name, uniform) in enumerate(zip(inputs.names, inputs.uniform, strict=True)):
        kind = "uniform" if uniform else "posterior" if inputs.is_posterior else inputs.parameters.kinds[k]
        axis = inputs.axes[name]
        interval = (float(low[k]), float(high[k]))
        summaries[name] = InputSummary(
            axis.unit, axis.meaning, kind, float(median[k]), interval, float(sd[k]), bool(inert[k])
        )
    return summaries


def _no_point_message(statuses: dict[str, dict[str, int]]) -> str:
    status_words = "; ".join(
        f"{s}: " + ", ".join(f"{n} {w}" for w, n in counts.items()) for s, counts in statuses.items()
    )
    return (
        f"too many robots do not travel at any operating point ({status_words}). Choose smaller --slopes, "
        "another --voltages, or calibrate the adhesion"
    )


def _study_remarks(
    study: Study, method: str, outputs: dict[str, OutputStudy], inert: np.ndarray
) -> tuple[Remark, ...]:
    remarks: list[Remark] = []
    groups: dict[tuple[bytes, bytes], list[OutputStudy]] = {}
    for o in outputs.values():
        groups.setdefault((o.studied.tobytes(), o.lost.tobytes()), []).append(o)
    for group in groups.values():
        o = group[0]
        names = tuple(x.row.label for x in group)
        left_out = int(np.sum(~o.studied))
        total = len(o.studied)
        if left_out:
            sampled = method != "local"
            remarks.append(Remark("points_left_out", points=left_out, total=total, sampled=sampled, outputs=names))
        lost_shares = o.lost[o.studied & (o.lost >= 1e-3)]
        if lost_shares.size:
            remarks.append(
                Remark("sample_left_out", points=lost_shares.size, share=float(lost_shares.max()), outputs=names)
            )
    if inert.any():
        remarks.append(Remark("inert", inputs=tuple(np.array(study.inputs.names)[inert].tolist())))
    if study.inputs.parameters.tied:
        remarks.append(Remark("tied", inputs=tuple(f for f, _, _ in study.inputs.parameters.tied)))
    return tuple(remarks)
