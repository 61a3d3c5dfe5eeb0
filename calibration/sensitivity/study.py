"""What is studied: one robot, its uncertain inputs, operating points and outputs."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from calibration.sensitivity.inputs import Inputs
from calibration.sensitivity.model import Model, OutputRow, counted
from calibration.sensitivity.result import Points
from mmrjax import fidelities
from mmrjax.conditions import Conditions
from mmrjax.robot import Robot

Tell = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Supply:
    """What feeds the motors at every point: the battery (1) or not (0), charge taken [C], adhesion ratio at each."""

    battery: float = 0.0
    discharge: float = 0.0
    adhesion: np.ndarray | float = 1.0


class Study:
    """One robot, its uncertain inputs, operating points and outputs; methods are functions of it."""

    def __init__(
        self,
        robot: Robot,
        inputs: Inputs,
        points: Points,
        outputs: tuple[OutputRow, ...],
        model: str = "steady",
        options: Mapping[str, float] | None = None,
        supply: Supply | None = None,
        tell: Tell = lambda text: None,
    ) -> None:
        supply = Supply() if supply is None else supply
        self.robot, self.inputs, self.points, self.tell = robot, inputs, points, tell
        options = fidelities.facts(model).resolved() if options is None else options
        self.model = Model(robot, inputs.columns, model, options, outputs)
        names = robot.configurations.names
        self.conditions = Conditions(
            np.array([names.index(str(c)) for c in points.configuration]),
            points.voltage,
            points.slope_deg,
            points.payload,
            battery=supply.battery,
            discharge=supply.discharge,
            adhesion=supply.adhesion,
        )
        self.evaluations, self.seconds = 0, 0.0
        self.sampled: dict[str, np.ndarray] = {}

    def at(self, k: int) -> Conditions:
        """Conditions of one point."""
        return jax.tree.map(lambda x: x[k], self.conditions)

    def acting(self, k: int) -> np.ndarray:
        """Inputs that are not of another configuration than that of a point."""
        return self.inputs.acting(str(self.points.configuration[k]), self.robot.configurations.names)

    def values_at(self, scores: np.ndarray) -> np.ndarray:
        """Columns of the model at scores of all inputs."""
        return np.asarray(values_of(self.inputs, scores))

    def sample(self, scores: np.ndarray, k: int) -> dict[str, np.ndarray]:
        """Outputs at scores of all inputs, at one point; counted and timed."""
        return self.counted_outputs(self.values_at(scores), self.at(k))

    def counted_outputs(self, values: np.ndarray, conditions: Conditions) -> dict[str, np.ndarray]:
        began = time.perf_counter()
        answer = self.model(values, conditions)
        self.seconds += time.perf_counter() - began
        self.evaluations += len(values)
        for source, codes in answer.statuses.items():
            whole = np.bincount(codes, minlength=16)
            self.sampled[source] = self.sampled.get(source, 0) + whole
        return answer.values

    def statuses(self) -> dict[str, dict[str, int]]:
        """Source → status → how many of the sample."""
        return {
            source_words(source): counted(np.repeat(np.arange(len(whole)), whole))
            for source, whole in self.sampled.items()
        }

    def gradients(self, scores: np.ndarray, conditions: Conditions) -> tuple[dict[str, np.ndarray], ...]:
        """Outputs, and their derivatives by the scores of all inputs; each row has its own conditions, or all one."""
        values = self.values_at(scores)
        answer = self.model(values, conditions)
        by_columns = self.model.derivatives(values, conditions)
        inner = np.asarray(jacobian_of(self.inputs, scores))
        moved = {name: np.einsum("pc,pci->pi", x, inner) for name, x in by_columns.items()}
        there = {name: np.isfinite(x)[:, None] for name, x in answer.values.items()}
        return answer.values, {name: np.where(there[name], g, np.nan) for name, g in moved.items()}


def values_of(inputs: Inputs, scores: np.ndarray) -> jax.Array:
    return inputs.values(jnp.asarray(scores))


def jacobian_of(inputs: Inputs, scores: np.ndarray) -> jax.Array:
    """d columns / d scores of each row, shape (rows, columns, inputs)."""
    return jax.vmap(jax.jacfwd(inputs.values))(jnp.asarray(scores))


def source_words(source: str) -> str:
    """What computes outputs, in words: the fidelity, or the derived output's module."""
    return source.rpartition(".")[2].replace("_", " ") if "." in source else source
