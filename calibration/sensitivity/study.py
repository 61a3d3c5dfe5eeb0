"""Subject of a sensitivity study, with exact derivatives at the medians and inputs without influence."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

from calibration.data import Columns
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.inference.identifiability import Z95
from calibration.sensitivity.model import Model, ModelOutputs, named_counts
from calibration.sensitivity.result import OperatingPoints, OutputStudy
from calibration.sensitivity.uncertain_inputs import UncertainInputs
from mmrjax import fidelities
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import RPM, Quantity
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES

Tell = Callable[[Remark | str], None]
#: Longest time without a progress message [s].
SILENCE = 10.0


class Study:
    """One robot with its uncertain inputs, operating points and outputs. The methods are functions of a study.

    `battery` (1) or external supply (0), the charge drawn [C] and the adhesion ratio apply at each point.
    """

    def __init__(
        self,
        robot: Robot,
        inputs: UncertainInputs,
        points: OperatingPoints,
        outputs: tuple[Quantity, ...],
        model: str = "steady",
        options: Mapping[str, float] | None = None,
        tell: Tell = lambda note: None,
        *,
        battery: float = 0.0,
        discharge: float = 0.0,
        adhesion: np.ndarray | float = 1.0,
    ) -> None:
        self.robot, self.inputs, self.points, self.tell = robot, inputs, points, tell
        options = fidelities.fidelity_facts(model).resolved() if options is None else options
        self.model = Model(robot, inputs.columns, model, options, outputs)
        names = robot.configurations.names
        self.conditions = Conditions(
            np.array([names.index(str(c)) for c in points.configuration]),
            np.nan_to_num(points.voltage),
            points.slope_deg,
            points.payload,
            battery=battery,
            discharge=discharge,
            adhesion=adhesion,
            motor_speed=None if points.motor_speed is None else points.motor_speed * RPM,
        )
        self.evaluations, self.seconds = 0, 0.0
        self.last_report_time = time.perf_counter()
        self.sampled: Columns = {}

    def at(self, k: int) -> Conditions:
        """Conditions at one point."""
        return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[k]), self.conditions)

    def acting(self, k: int) -> np.ndarray:
        """Indices of the inputs that act at a point: all except those of other configurations."""
        return self.inputs.acting(str(self.points.configuration[k]), self.robot.configurations.names)

    def sample(self, values: np.ndarray, points: Sequence[int]) -> Iterator[tuple[int, Columns]]:
        """Yields the outputs at each point for the same sampled inputs. Evaluations are counted and timed.

        A source is not computed again if only conditions that it ignores differ.
        """
        outputs_by_conditions: dict[tuple[str, tuple[float, ...]], ModelOutputs] = {}
        for k in points:
            start_time = time.perf_counter()
            conditions = self.at(k)
            parts = {}
            for source in self.model.sources:
                ignored = self.model.ignores(source)
                fields = {f.name: getattr(conditions, f.name) for f in dataclasses.fields(conditions)}
                key = tuple(float(x) for name, x in fields.items() if x is not None and name not in ignored)
                parts[source] = outputs_by_conditions.get((source, key)) or self.model.of_source(
                    source, values, conditions
                )
                if ignored:  # otherwise no other point can reuse it
                    outputs_by_conditions[source, key] = parts[source]
            outputs = self.model.joined(parts)
            self.seconds += time.perf_counter() - start_time
            self.evaluations += len(values)
            for source, codes in outputs.statuses.items():
                self.sampled[source] = self.sampled.get(source, 0) + np.bincount(codes, minlength=len(STATUSES))
            if time.perf_counter() - self.last_report_time > SILENCE:
                self.last_report_time = time.perf_counter()
                rate = self.evaluations / max(self.seconds, 1e-9)
                self.tell(progress_remark("evaluations", self.evaluations, rate))
            yield k, outputs.values

    def statuses(self) -> dict[str, dict[str, int]]:
        """Source → status → number of evaluations in the sample."""
        return {source_words(source): named_counts(counts) for source, counts in self.sampled.items()}


def source_words(source: str) -> str:
    """Name of a source of outputs in words: the fidelity, or the module of derived outputs."""
    return source.rpartition(".")[2].replace("_", " ") if "." in source else source


#: Numbers of random robots and points at which an input must have zero derivatives to count as inert.
INERT_SAMPLES, INERT_POINTS = 4, 12


def correlated_directions(inputs: UncertainInputs) -> np.ndarray:
    """Directions in score space. Along each, one input moves by one sd and the others follow by their correlation.

    Each row has length 1. A condition moves along its own score.
    """
    count = len(inputs.parameters)
    directions = np.eye(len(inputs))
    root = inputs.parameters.root
    length = np.linalg.norm(root, axis=1, keepdims=True)
    directions[:count, :count] = root / np.where(length > 0, length, 1.0)
    return directions


def interval_ends(inputs: UncertainInputs) -> Float[np.ndarray, "2 inputs inputs"]:
    """Scores with one input at the lower or upper end of its 95 % interval, in a row for each input."""
    half_widths = np.where(inputs.uniform, 0.475, Z95)[:, None] * correlated_directions(inputs)
    return inputs.centre + np.stack([-half_widths, half_widths])


def local_studies(study: Study) -> tuple[dict[str, OutputStudy], dict[str, dict[str, int]]]:
    """Study of each output from its exact derivatives at the medians of the inputs, and the number of points with
    each status, by source.
    """
    inputs = study.inputs
    points = len(study.points)
    d = len(study.inputs)
    values = study.inputs.values(np.tile(inputs.centre, (points, 1)))
    at_medians = study.model(values, study.conditions)
    repeated_conditions = jax.tree.map(lambda x: np.repeat(np.asarray(x), d), study.conditions)
    ends = [
        study.model(study.inputs.values(np.tile(rows, (points, 1))), repeated_conditions).values
        for rows in interval_ends(inputs)
    ]
    # A condition's score is uniform in 0..1, with variance 1/12.
    score_variance = np.where(inputs.uniform, 1 / 12, 1.0)
    by_columns = study.model.derivatives(values, study.conditions)
    studies = {}
    for row in study.model.outputs:
        value, derivatives = at_medians.values[row.name], by_columns[row.name]
        finite = np.isfinite(value)
        input_slopes = np.where(finite[:, None], _derivatives_by_input(inputs, derivatives), np.nan)
        score_slopes = np.where(finite[:, None], derivatives @ inputs.slope, np.nan)
        slopes_along = score_slopes @ correlated_directions(inputs).T if inputs.is_posterior else score_slopes
        variance = np.sum(score_slopes**2 * score_variance, 1)
        share = slopes_along**2 * score_variance / np.where(variance > 0, variance, 1.0)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            elasticity = input_slopes * inputs.values(inputs.centre)[inputs.column_indices] / value[:, None]
        studies[row.name] = OutputStudy(
            row=row,
            value=value,
            derivative=input_slopes,
            elasticity=np.where(np.isfinite(elasticity), elasticity, np.nan),
            swing=np.stack([end[row.name].reshape(points, d) for end in ends]),
            sd=np.where(finite, np.sqrt(variance), np.nan),
            share=np.where(finite[:, None], share, np.nan),
            lost=np.zeros(points),
            studied=finite,
        )
    statuses = {
        source_words(source): named_counts(np.bincount(codes)) for source, codes in at_medians.statuses.items()
    }
    return studies, statuses


def _derivatives_by_input(inputs: UncertainInputs, by_columns: np.ndarray) -> np.ndarray:
    """Derivatives with respect to inputs, shape (points, inputs), from those with respect to columns. Tied parameters
    are added to their leader.
    """
    by_inputs = by_columns[:, inputs.column_indices].copy()
    for j, (_, leader, ratio) in enumerate(inputs.parameters.tied):
        by_inputs[:, leader] += ratio * by_columns[:, len(inputs.parameters) + j]
    return by_inputs


def inert_inputs(study: Study, outputs: Mapping[str, OutputStudy], seed: int) -> np.ndarray:
    """True for inputs whose derivatives of all outputs are exactly zero at all tested points, shape (inputs,)."""
    generators = np.random.default_rng(seed).spawn(INERT_SAMPLES)
    unit = np.concatenate([qmc.Sobol(len(study.inputs), scramble=True, rng=rng).random(1) for rng in generators])
    scores = study.inputs.scores(unit)
    has_effect = np.zeros(len(study.inputs), bool)
    for output in outputs.values():  # not scores, which mix the parameters of a posterior
        has_effect |= (np.nan_to_num(output.derivative) != 0).any(0)
    if has_effect.all():
        return ~has_effect
    points = np.unique(np.linspace(0, len(study.points) - 1, INERT_POINTS).astype(int))
    rows = np.repeat(scores, len(points), 0)
    conditions = jax.tree.map(lambda x: np.tile(np.asarray(x)[points], len(scores)), study.conditions)
    for derivatives in study.model.derivatives(study.inputs.values(rows), conditions).values():
        has_effect |= (np.nan_to_num(_derivatives_by_input(study.inputs, derivatives)) != 0).any(0)
    return ~has_effect
