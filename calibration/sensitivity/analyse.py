"""Sensitivity study: important inputs at each operating point."""

from __future__ import annotations

import numpy as np

from calibration.data.input_errors import BadConfiguration
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.inference.identifiability import Z95
from calibration.sensitivity.local import LocalDerivatives, correlated_directions, inert_inputs, local_derivatives
from calibration.sensitivity.methods import PartialResult, morris_screening, sobol_indices
from calibration.sensitivity.result import METHODS, InputSummary, OutputStudy, SensitivityResult
from calibration.sensitivity.study import Study
from calibration.sensitivity.uncertain_inputs import UncertainInputs
from mmrjax import derived, fidelities
from mmrjax.model.quantities import Quantity

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
