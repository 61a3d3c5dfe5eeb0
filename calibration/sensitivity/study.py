"""Subject of a sensitivity study: one robot, its uncertain inputs, operating points and outputs."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Columns
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.sensitivity.model import Model, ModelOutputs, count_statuses
from calibration.sensitivity.result import OperatingPoints
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
        self.told = time.perf_counter()
        self.sampled: Columns = {}

    def at(self, k: int) -> Conditions:
        """Conditions at one point."""
        return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[k]), self.conditions)

    def acting(self, k: int) -> np.ndarray:
        """Indices of the inputs that act at a point: all except those of other configurations."""
        return self.inputs.acting(str(self.points.configuration[k]), self.robot.configurations.names)

    def values_at(self, scores: np.ndarray) -> np.ndarray:
        """Values of the model's columns for scores of all inputs."""
        return np.asarray(self.inputs.values(scores))

    def sample(self, values: np.ndarray, points: Sequence[int]) -> Iterator[tuple[int, Columns]]:
        """Yields the outputs at each point for the same sampled inputs. Evaluations are counted and timed.

        A source is not computed again if only conditions that it ignores differ.
        """
        sampled: dict[tuple[str, tuple[float, ...]], ModelOutputs] = {}
        for k in points:
            began = time.perf_counter()
            conditions = self.at(k)
            parts = {}
            for source in self.model.sources:
                ignored = self.model.ignores(source)
                fields = {f.name: getattr(conditions, f.name) for f in dataclasses.fields(conditions)}
                mark = tuple(float(x) for name, x in fields.items() if x is not None and name not in ignored)
                if (source, mark) not in sampled:
                    if not ignored:  # so no other point can reuse it
                        parts[source] = self.model.of_source(source, values, conditions)
                        continue
                    sampled[source, mark] = self.model.of_source(source, values, conditions)
                parts[source] = sampled[source, mark]
            answer = self.model.joined(parts)
            self._count_evaluations(answer, len(values), began)
            if time.perf_counter() - self.told > SILENCE:
                self.told = time.perf_counter()
                rate = self.evaluations / max(self.seconds, 1e-9)
                self.tell(progress_remark("evaluations", self.evaluations, rate))
            yield k, answer.values

    def _count_evaluations(self, answer: ModelOutputs, rows: int, began: float) -> None:
        self.seconds += time.perf_counter() - began
        self.evaluations += rows
        for source, codes in answer.statuses.items():
            self.sampled[source] = self.sampled.get(source, 0) + np.bincount(codes, minlength=len(STATUSES))

    def statuses(self) -> dict[str, dict[str, int]]:
        """Source → status → number of evaluations in the sample."""
        return {
            source_words(source): count_statuses(np.repeat(np.arange(len(source_outputs)), source_outputs))
            for source, source_outputs in self.sampled.items()
        }


def source_words(source: str) -> str:
    """Name of a source of outputs in words: the fidelity, or the module of derived outputs."""
    return source.rpartition(".")[2].replace("_", " ") if "." in source else source
