"""Methods of sensitivity analysis over all operating points. Each returns part of the result of every output."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.inference.identifiability import Z95
from calibration.sensitivity import morris, sobol
from calibration.sensitivity.replicates import IntervalEstimate
from calibration.sensitivity.study import Study

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
    terms: dict[str, dict[int, sobol.VarianceTerms]] = {name: {} for name in names}
    lost_counts = {name: np.zeros(points) for name in names}
    for input_set, group in group_points(study, moving).items():
        size = sobol.base_point_count(evaluations / points, len(input_set))
        design = sobol.sobol_design(len(input_set), size, seed)
        scores = _sampled_scores(study, design.points, np.array(input_set))
        for k, outputs in study.sample(study.values_at(scores), group):
            for name in names:
                output_terms = sobol.sobol_terms(design, outputs[name])
                rows = design.size * design.replicates
                lost_counts[name][k] = 1.0 if output_terms is None else output_terms.lost / rows
                if output_terms is not None and lost_counts[name][k] <= MOST_LOST:
                    terms[name][k] = output_terms.widened(input_set, d)
    answer = {}
    for name in names:
        first, total, sd = _empty_estimate(points, d), _empty_estimate(points, d), np.full(points, np.nan)
        total_terms: sobol.VarianceTerms | None = None
        for k, output_terms in terms[name].items():
            indices = sobol.indices_of_terms(output_terms)
            _store_estimate(first, k, indices.first)
            _store_estimate(total, k, indices.total)
            sd[k] = np.sqrt(indices.variance)
            total_terms = output_terms if total_terms is None else total_terms + output_terms
        studied = np.array([k in terms[name] for k in range(points)])
        if total_terms is None:
            answer[name] = PartialResult({}, {}, None, None, None, lost_counts[name], studied)
            continue
        overall = sobol.indices_of_terms(total_terms)
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
    found: dict[str, dict[int, tuple[morris.ElementaryEffects, tuple[int, ...]]]] = {name: {} for name in names}
    lost_counts = {name: np.zeros(points) for name in names}
    for input_set, group in group_points(study, moving).items():
        count = max(int(np.ceil(evaluations / points / (len(input_set) + 1))), 10)
        unit = morris.morris_design(len(input_set), count, seed)
        scores = np.array(_sampled_scores(study, 0.025 + 0.95 * unit, np.array(input_set)))
        # Trajectories have equal steps in the scores, between the ends of the 95 % interval.
        normal = np.arange(d) < len(study.inputs.parameters)
        for j, i in enumerate(input_set):
            if normal[i]:
                scores[:, i] = Z95 * (2 * unit[:, j] - 1)
        for k, outputs in study.sample(study.values_at(scores), group):
            for name in names:
                effects = morris.elementary_effects(unit, outputs[name])
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
