"""Sensitivity study: important inputs at each operating point, by each method."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data.input_errors import BadConfiguration
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.inference.identifiability import Z95
from calibration.sensitivity import sampled_indices
from calibration.sensitivity.result import METHODS, InputSummary, OutputStudy, SensitivityResult
from calibration.sensitivity.sampled_indices import IntervalEstimate
from calibration.sensitivity.study import (
    LocalDerivatives,
    Study,
    correlated_directions,
    inert_inputs,
    local_derivatives,
)
from calibration.sensitivity.uncertain_inputs import UncertainInputs
from mmrjax import derived, fidelities
from mmrjax.model.quantities import Quantity

#: Largest share of base points without a value at an operating point that is studied.
MOST_LOST = 0.5


@dataclasses.dataclass(frozen=True)
class PartialResult:
    """Result of a method for one output, as fields of `OutputStudy`."""

    overall: dict[str, IntervalEstimate]
    at_points: dict[str, IntervalEstimate]
    share: np.ndarray | None
    sd: np.ndarray | None
    second: IntervalEstimate | None
    lost: np.ndarray
    studied: np.ndarray


def _sampled_scores(study: Study, unit: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Scores of all inputs, for points in the unit cube of some inputs. The other inputs are at their medians."""
    unit_scores = np.full((len(unit), len(study.inputs)), 0.5)
    unit_scores[:, which] = unit
    return study.inputs.scores(unit_scores)


def group_points(study: Study, moving: np.ndarray) -> dict[tuple[int, ...], list[int]]:
    """Groups of operating points with the same inputs."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for k in range(len(study.points)):
        acting_inputs = tuple(i for i in study.acting(k) if moving[i])
        if acting_inputs:
            groups.setdefault(acting_inputs, []).append(k)
    return groups


def _empty_estimate(points: int, size: int) -> IntervalEstimate:
    return IntervalEstimate(*(np.full((points, size), np.nan) for _ in range(3)))


def _store_estimate(into: IntervalEstimate, k: int, found: IntervalEstimate) -> None:
    into.value[k], into.low[k], into.high[k] = found.value, found.low, found.high


def sobol_indices(study: Study, moving: np.ndarray, evaluations: int, seed: int) -> dict[str, PartialResult]:
    """First-order, total and second-order Sobol indices at each point and over all points."""
    points, d = len(study.points), len(study.inputs)
    names = [o.name for o in study.model.outputs]
    terms: dict[str, dict[int, sampled_indices.VarianceTerms]] = {name: {} for name in names}
    lost_counts = {name: np.zeros(points) for name in names}
    for input_set, group in group_points(study, moving).items():
        size = sampled_indices.base_point_count(evaluations / points, len(input_set))
        design = sampled_indices.sobol_design(len(input_set), size, seed)
        scores = _sampled_scores(study, design.points, np.array(input_set))
        for k, outputs in study.sample(study.values_at(scores), group):
            for name in names:
                output_terms = sampled_indices.sobol_terms(design, outputs[name])
                rows = design.size * design.replicates
                lost_counts[name][k] = 1.0 if output_terms is None else output_terms.lost / rows
                if output_terms is not None and lost_counts[name][k] <= MOST_LOST:
                    terms[name][k] = output_terms.widened(input_set, d)
    answer = {}
    for name in names:
        first, total, sd = _empty_estimate(points, d), _empty_estimate(points, d), np.full(points, np.nan)
        total_terms: sampled_indices.VarianceTerms | None = None
        for k, output_terms in terms[name].items():
            indices = sampled_indices.indices_of_terms(output_terms)
            _store_estimate(first, k, indices.first)
            _store_estimate(total, k, indices.total)
            sd[k] = np.sqrt(indices.variance)
            total_terms = output_terms if total_terms is None else total_terms + output_terms
        studied = np.array([k in terms[name] for k in range(points)])
        if total_terms is None:
            answer[name] = PartialResult({}, {}, None, None, None, lost_counts[name], studied)
            continue
        overall = sampled_indices.indices_of_terms(total_terms)
        answer[name] = PartialResult(
            {"first": overall.first, "total": overall.total},
            {"first": first, "total": total},
            np.where(np.isfinite(total.value), np.clip(total.value, 0.0, 1.0), np.nan),
            sd,
            overall.second,
            lost_counts[name],
            studied,
        )
    return answer


def morris_screening(study: Study, moving: np.ndarray, evaluations: int, seed: int) -> dict[str, PartialResult]:
    """Elementary effects (Morris) over the 95 % range of each input, at each point."""
    points, d = len(study.points), len(study.inputs)
    names = [o.name for o in study.model.outputs]
    found: dict[str, dict[int, tuple[sampled_indices.ElementaryEffects, tuple[int, ...]]]] = {
        name: {} for name in names
    }
    lost_counts = {name: np.zeros(points) for name in names}
    for input_set, group in group_points(study, moving).items():
        count = max(int(np.ceil(evaluations / points / (len(input_set) + 1))), 10)
        unit = sampled_indices.morris_design(len(input_set), count, seed)
        scores = np.array(_sampled_scores(study, 0.025 + 0.95 * unit, np.array(input_set)))
        # Trajectories have equal steps in the scores, between the ends of the 95 % interval.
        normal = np.arange(d) < len(study.inputs.parameters)
        for j, i in enumerate(input_set):
            if normal[i]:
                scores[:, i] = Z95 * (2 * unit[:, j] - 1)
        for k, outputs in study.sample(study.values_at(scores), group):
            for name in names:
                effects = sampled_indices.elementary_effects(unit, outputs[name])
                lost_counts[name][k] = 1.0 if effects is None else effects.lost / count
                if effects is not None and lost_counts[name][k] <= MOST_LOST:
                    found[name][k] = effects, input_set
    answer = {}
    for name in names:
        size, mean, spread = _empty_estimate(points, d), np.full((points, d), np.nan), np.full((points, d), np.nan)
        for k, (effects, input_set) in found[name].items():
            places = list(input_set)
            for whole, part in (
                (size.value, effects.size.value),
                (size.low, effects.size.low),
                (size.high, effects.size.high),
                (mean, effects.mean),
                (spread, effects.spread),
            ):
                whole[k] = 0.0
                whole[k, places] = part  # fmt: skip
        studied = np.array([k in found[name] for k in range(points)])
        if not studied.any():
            answer[name] = PartialResult({}, {}, None, None, None, lost_counts[name], studied)
            continue
        square = size.value**2
        share = square / np.where(square.sum(1, keepdims=True) > 0, square.sum(1, keepdims=True), 1.0)
        rows = np.flatnonzero(studied)
        overall = {
            "mean_absolute_effect": IntervalEstimate(*(x[rows].mean(0) for x in (size.value, size.low, size.high))),
            "mean_effect": IntervalEstimate(*(mean[rows].mean(0),) * 3),
            "sd_effect": IntervalEstimate(*(spread[rows].mean(0),) * 3),
        }
        at_points = {
            "mean_absolute_effect": size,
            "mean_effect": IntervalEstimate(mean, mean, mean),
            "sd_effect": IntervalEstimate(spread, spread, spread),
        }
        answer[name] = PartialResult(overall, at_points, share, None, None, lost_counts[name], studied)
    return answer


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
        BadConfiguration: an unknown method, a method that needs independent inputs, too few evaluations, inputs that
            change no output, or no point that can be studied.
    """
    inputs, model = study.inputs, study.model
    if method not in METHODS:
        raise BadConfiguration(f"--method: got {method}; expected one of {', '.join(METHODS)}")
    if inputs.is_posterior and method != "local":
        raise BadConfiguration(f"--method {method}: needs independent inputs, unlike a posterior's; expected local")
    long = fidelities.fidelity_facts(model.fidelity).rollout or any(o in derived.OF_START for o in model.outputs)
    usual = EVALUATIONS_LONG if long else EVALUATIONS
    evaluations = usual if evaluations is None else evaluations
    if evaluations < LEAST:
        raise BadConfiguration(f"--evaluations: got {evaluations}; expected {LEAST} or more")
    study.tell(progress_remark("points"))
    studies = local_derivatives(study)
    if not any(np.isfinite(x).any() for x in studies.value.values()):
        raise BadConfiguration(_no_point_message(study, studies.statuses))
    idle = inert_inputs(study, studies, seed)
    if idle.all():
        raise BadConfiguration("--parameters: every derivative is zero; choose others, or change --outputs")
    parts: dict[str, PartialResult] = {}
    if method != "local":
        study.tell(Remark("sampling", method=method, points=len(study.points)))
        by_method = sobol_indices if method == "sobol" else morris_screening
        parts = by_method(study, ~idle, evaluations, seed)
    outputs = {o.name: _study_of_output(o, study, studies, parts.get(o.name)) for o in model.outputs}
    if method != "local" and not any(s.studied.any() for s in outputs.values()):
        raise BadConfiguration(_no_point_message(study, study.statuses()))
    return SensitivityResult(
        method=method,
        model=model.fidelity,
        seed=seed,
        inputs=_describe_inputs(inputs, idle),
        correlated=inputs.is_posterior,
        points=study.points,
        outputs=outputs,
        statuses=studies.statuses,
        sampled=study.statuses(),
        evaluations=study.evaluations,
        seconds=round(study.seconds, 3),
        remarks=_study_remarks(study, method, outputs, idle),
    )


def _describe_inputs(inputs: UncertainInputs, idle: np.ndarray) -> dict[str, InputSummary]:
    slope = inputs.slope[inputs.places]
    uniform = np.arange(len(inputs)) >= len(inputs.parameters)
    sd = np.where(uniform, np.abs(slope).sum(1) / np.sqrt(12), np.sqrt(np.sum(slope**2, 1)))
    directions = correlated_directions(inputs)
    p = len(inputs.parameters)
    rows = {q: np.tile(inputs.centre, (len(inputs), 1)) for q in (-1, 0, 1)}
    for side in (-1, 1):
        rows[side][:, :p] += side * Z95 * directions[:, :p]
        for k in range(p, len(inputs)):
            rows[side][k] = inputs.centre
            rows[side][k, k] = 0.5 + side * 0.475
    settings = {
        q: inputs.values(x)[:, inputs.places][np.arange(len(inputs)), np.arange(len(inputs))] for q, x in rows.items()
    }
    described = {}
    for k, name in enumerate(inputs.names):
        kind = "uniform" if uniform[k] else "posterior" if inputs.is_posterior else inputs.parameters.kinds[k]
        axis = inputs.axes[name]
        interval = (float(settings[-1][k]), float(settings[1][k]))
        described[name] = InputSummary(
            axis.unit, axis.meaning, kind, float(settings[0][k]), interval, float(sd[k]), bool(idle[k])
        )
    return described


def _study_of_output(row: Quantity, study: Study, found: LocalDerivatives, part: PartialResult | None) -> OutputStudy:
    name, points = row.name, len(study.points)
    value, slopes, scores = found.value[name], found.derivative[name], found.by_score[name]
    median = study.inputs.values(study.inputs.centre)[study.inputs.places]
    with np.errstate(divide="ignore", invalid="ignore"):
        elasticity = slopes * median / value[:, None]
    elasticity = np.where(np.isfinite(elasticity), elasticity, np.nan)
    # A condition's score is uniform in 0..1, with variance 1/12.
    weight = np.where(np.arange(len(study.inputs)) < len(study.inputs.parameters), 1.0, 1 / 12)
    directions = correlated_directions(study.inputs)
    squared_changes = (scores @ directions.T) ** 2 * weight if study.inputs.is_posterior else scores**2 * weight
    variance = np.sum(scores**2 * weight, 1)
    linear = squared_changes / np.where(variance > 0, variance, 1.0)[:, None]
    finite = np.isfinite(value)
    share = np.where(finite[:, None], linear, np.nan)
    sd = np.where(finite, np.sqrt(variance), np.nan)
    if part is None:
        nothing = np.zeros(points)
        return OutputStudy(
            row, value, slopes, elasticity, found.swing[name], sd, share, {}, {}, None, nothing, finite
        )
    return OutputStudy(
        row,
        value,
        slopes,
        elasticity,
        found.swing[name],
        sd if part.sd is None else part.sd,
        np.full_like(share, np.nan) if part.share is None else part.share,
        part.overall,
        part.at_points,
        part.second,
        part.lost,
        part.studied,
    )


def _no_point_message(study: Study, statuses: dict[str, dict[str, int]]) -> str:
    status_words = "; ".join(f"{s}: " + ", ".join(f"{n} {w}" for w, n in by.items()) for s, by in statuses.items())
    return (
        f"too many robots do not travel at any operating point ({status_words}). Choose smaller --slopes, "
        "another --voltages, or calibrate the adhesion"
    )


def _study_remarks(
    study: Study, method: str, outputs: dict[str, OutputStudy], idle: np.ndarray
) -> tuple[Remark, ...]:
    remarks: list[Remark] = []
    alike: dict[tuple[bytes, bytes], list[OutputStudy]] = {}
    for o in outputs.values():
        alike.setdefault((o.studied.tobytes(), o.lost.tobytes()), []).append(o)
    for group in alike.values():
        o, names = group[0], tuple(x.row.label for x in group)
        if not o.studied.all():
            remarks.append(
                Remark(
                    "points_left_out",
                    points=int((~o.studied).sum()),
                    total=len(o.studied),
                    sampled=method != "local",
                    outputs=names,
                )
            )
        some = o.studied & (o.lost >= 1e-3)
        if some.any():
            remarks.append(
                Remark("sample_left_out", points=int(some.sum()), share=float(o.lost[some].max()), outputs=names)
            )
    names = tuple(n for k, n in enumerate(study.inputs.names) if idle[k])
    if names:
        remarks.append(Remark("inert", inputs=names))
    if study.inputs.parameters.tied:
        remarks.append(Remark("tied", inputs=tuple(f for f, _, _ in study.inputs.parameters.tied)))
    return tuple(remarks)
