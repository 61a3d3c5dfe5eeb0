"""The results of `simulate`: batches of runs, computed or pending, with their conditions as a table or arrays."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mmrjax.compile.compiling import compiled, computed_outside_trace, on_host
from mmrjax.compile.programs import has_tracer
from mmrjax.errors import UsageError, allowed_words, count_noun
from mmrjax.fidelities import outputs
from mmrjax.fidelities.base import Fidelity, History, RunBatch
from mmrjax.missions import mission_batch
from mmrjax.missions.mission import Mission
from mmrjax.model import channels
from mmrjax.model.channels import Channel, channel_names, usual_channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.quantities import Names
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CODES, STATUSES, Result

#: Most runs of one `simulate` with histories.
HISTORIES = 1000


@dataclasses.dataclass(frozen=True)
class PendingBatch:
    """A checked batch that is computed when a result is read.

    Attributes:
        robot: concrete.
        conditions: conditions of any shape, configurations resolved.
        fidelity: fidelity with `outputs`.
    """

    robot: Robot
    conditions: Conditions
    fidelity: Fidelity

    @computed_outside_trace
    def readings(self) -> dict[str, jax.Array]:
        """Readings of the robot's instruments by channel, and the status codes as `status`."""
        outputs = self.fidelity.outputs
        names = (*channels.channel_names(self.robot.channels), STATUS)
        assert outputs is not None
        return _map_in_chunks(self.fidelity, lambda runs: outputs(self.robot, runs, names), self.conditions)

    @computed_outside_trace
    def result(self) -> Result:
        """All numbers of the results."""
        return run_batch(self.fidelity, self.robot, self.conditions, {}, history=False).result

    @computed_outside_trace
    def total_mass(self) -> jax.Array:
        """Mass of robot and payload, stated or the robot's own [kg]."""
        return total_mass(self.robot, self.conditions)


def run_batch(
    fidelity: Fidelity, robot: Robot, conditions: Conditions, options: Mapping[str, float], history: bool
) -> RunBatch:
    """Simulates a batch of any shape."""
    runs = math.prod(conditions.shape)
    if history and runs > HISTORIES:
        raise UsageError(f"history: got {runs} runs; expected at most {HISTORIES}; set history=False")
    simulate = fidelity.histories if history else fidelity.run
    assert simulate is not None
    if has_tracer((robot, conditions)):
        return reshape_runs(simulate(robot, flatten_conditions(conditions), options), conditions.shape)
    return _map_in_chunks(fidelity, lambda runs: simulate(robot, runs, options), conditions)


T = TypeVar("T")


def _map_in_chunks(fidelity: Fidelity, function: Callable[[Conditions], T], conditions: Conditions) -> T:
    """Returns the values of a function of conditions of shape (runs,), in the shape of the conditions.

    Large batches are split into chunks of one size, which share a compilation. The last chunk ends with the last run.
    Small batches are padded (`FidelityFacts.filled`) by NumPy, which compiles nothing. Dispatching JAX
    operations leaf by leaf took twenty times as long as the equations at 262 144 runs.
    """
    size = fidelity.facts.at_once(jax.default_backend() != "cpu")
    runs = math.prod(conditions.shape)
    padded_size = min(fidelity.facts.filled(runs), size)
    if 0 < runs < padded_size:
        rows = np.minimum(np.arange(padded_size), runs - 1)  # padding repeats the last run
        part = function(jax.device_put(jax.tree.map(lambda x: np.ravel(x)[rows], conditions)))
        return jax.device_put(
            jax.tree.map(lambda x: np.asarray(x)[:runs].reshape((*conditions.shape, *x.shape[1:])), part)
        )
    flat_conditions = flatten_conditions(conditions)
    if runs <= size:
        return reshape_runs(function(flat_conditions), conditions.shape)
    parts = [function(_chunk_of_runs(flat_conditions, np.asarray(first), size)) for first in range(0, runs, size)]
    return reshape_runs(_join_chunks(parts, runs), conditions.shape)


def flatten_conditions(conditions: Conditions) -> Conditions:
    """Conditions of shape (runs,)."""
    return conditions if len(conditions.shape) == 1 else _flattened(conditions)


@compiled
def _flattened(conditions: Conditions) -> Conditions:
    return jax.tree.map(jnp.ravel, conditions)


def reshape_runs(tree: T, shape: tuple[int, ...]) -> T:
    """A tree with a leading axis of runs in its leaves, reshaped to the batch's own shape."""
    return tree if len(shape) == 1 else _reshape(tree, shape)


@compiled
def _reshape(tree: T, shape: tuple[int, ...]) -> T:
    return jax.tree.map(lambda x: jnp.reshape(x, shape + x.shape[1:]), tree)


@compiled
def _chunk_of_runs(conditions: Conditions, first: np.ndarray, size: int) -> Conditions:
    """`size` runs starting with `first`, or the last ones if fewer remain."""
    return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, size), conditions)


@compiled
def _join_chunks(parts: list[T], runs: int) -> T:
    """Joins chunks of one size. Drops the part of the last chunk that repeats the previous one."""
    return jax.tree.map(lambda *x: jnp.concatenate([*x[:-1], x[-1][(len(x) * len(x[-1]) - runs) :]]), *parts)


def total_mass(robot: Robot, conditions: Conditions) -> jax.Array:
    """Mass of robot and payload, stated or the robot's own [kg]."""
    if conditions.total_mass is not None:
        return conditions.total_mass
    masses = tuple(chassis.mass for chassis in robot.configurations.members)
    return _unstated_mass(masses, conditions.configuration, conditions.payload)


@compiled
def _unstated_mass(
    masses: tuple[Scalar, ...], configuration: jax.Array | np.ndarray, payload: jax.Array
) -> jax.Array:
    return jnp.stack([jnp.asarray(mass) for mass in masses])[configuration] + payload


#: Columns of a printed table in addition to conditions and channels.
_SHOWN = ("slip", "adhesion_used", "power_supply_W", "winding_settled_C")
#: Columns of conditions: heading, unit and digits after the point.
_CONDITIONS = {
    "configuration": ("configuration", "", 0),
    "supply_voltage_V": ("supply", "V", 2),
    "total_mass_kg": ("total mass", "kg", 2),
    "payload_kg": ("payload", "kg", 2),
    "slope_deg": ("slope", "deg", 2),
    "load_torque_Nm": ("load torque", "N·m", 4),
}
STATUS, _ = CODES
_WORDS = {"status": ("status", "", 0), "flags": ("flags", "", 0)}


class StatusCodes(np.ndarray):
    """Status codes that can be compared with the words of `STATUSES`: `results.status == "converged"`."""

    __hash__ = None  # as for every array

    def __eq__(self, other: Any) -> Any:
        return np.asarray(self) == _status_codes(other)

    def __ne__(self, other: Any) -> Any:
        return np.asarray(self) != _status_codes(other)

    def __getitem__(self, key: Any) -> Any:
        return np.asarray(np.asarray(self)[key]).view(StatusCodes)


def _status_codes(words: Any) -> Any:
    """Codes of words of `STATUSES`. Other values are returned unchanged.

    Raises:
        UsageError: an unknown word.
    """
    status_words = np.asarray(words)
    if status_words.dtype.kind != "U":
        return words
    if unknown := sorted(set(status_words.ravel().tolist()) - set(STATUSES)):
        raise UsageError(f"status: got {unknown[0]}; {allowed_words(unknown[0], STATUSES)}")
    return np.array([STATUSES.index(word) for word in status_words.ravel().tolist()], int).reshape(status_words.shape)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Results:
    """Results of one run or a batch, of one fidelity, as a pytree.

    For `steady`, numbers are computed at first use and kept. One program computes the readings and statuses, another
    all other numbers (and the results as a pytree). The two differ by rounding, about 1e-15 of a number. A number
    that has been read does not change.

    Every field of `Result`, every channel and every column that the fidelity adds is an attribute:
    `results.slip`, `results.total_current`, `results.guide_share`. All numbers have the shape of the conditions.
    `results.status == "converged"` compares codes with a word of `STATUSES`, outside a trace.

    Attributes:
        conditions: conditions with configurations as indices.
        total_mass: total mass of robot and payload [kg], stated or the robot's own.
        result: result in SI units.
        further: outputs that only this fidelity has, by column, in the column's unit.
        history: runs over time (`time`, `distance`, `signals`, `reading`), on their last axis, None if the fidelity
            has none or it was not requested.
        configurations: names of the robot's configurations, in the order of their indices.
        model: the fidelity.
        mission: for runs over a profile, totals, segments and time history, None without a profile.
        stated: conditions that the profile states, which replace those of the runs.
        channels: channels of the robot, in the order of columns.
    """

    conditions: Conditions
    total_mass: Scalar
    result: Result
    further: dict[str, Scalar]
    history: History | None
    configurations: Names
    model: str
    mission: Mission | None = None
    stated: Names = ()
    channels: tuple[Channel, ...] = dataclasses.field(default_factory=usual_channels)

    def __post_init__(self) -> None:
        result = self.result
        if isinstance(result, Result) and (coded := _comparable_codes(result.status)) is not result.status:
            object.__setattr__(self, "result", replace(result, status=coded))

    @staticmethod
    def pending(batch: PendingBatch, configurations: Names, model: str) -> Results:
        """Results that will be computed at first use."""
        results = object.__new__(Results)
        fields = {"conditions": batch.conditions, "further": {}, "history": None, "mission": None, "stated": ()}
        results.__dict__.update(
            fields, configurations=configurations, model=model, channels=batch.robot.channels, _pending=batch
        )
        return results

    def on_host(self) -> Results:
        """Same results with NumPy arrays. Numbers not computed yet remain so."""
        batch = self.__dict__.get("_pending")
        if batch is None or "result" in self.__dict__:
            return jax.tree.map(np.asanyarray, self)
        return Results.pending(on_host(batch), self.configurations, self.model)

    def _compute(self, name: str) -> None:
        """Computes the program that contains a name, unless it is already computed."""
        cache = self.__dict__
        batch = self.__dict__.get("_pending")
        if batch is None or name.startswith("_"):
            return
        if name == "total_mass":
            cache[name] = batch.total_mass()
        elif "result" not in cache and name in (*channel_names(batch.robot.channels), "status"):
            columns = cache.get("_shown") or batch.readings()
            cache["_shown"] = {**columns, STATUS: _comparable_codes(columns[STATUS])}
            cache.update(cache["_shown"])
        elif "result" not in cache:
            batch_result = batch.result()
            columns = cache.get("_shown", {})
            reading = {k: columns.get(k, x) for k, x in batch_result.reading.items()}
            status = columns.get(STATUS, _comparable_codes(batch_result.status))
            cache["result"] = replace(batch_result, reading=reading, status=status)

    def __getattr__(self, name: str) -> Any:
        self._compute(name)
        if name in self.__dict__:
            return self.__dict__[name]
        result, further = self.__dict__.get("result"), self.__dict__.get("further")
        if further is not None and name in further:
            return further[name]
        if result is not None and not name.startswith("__"):
            try:
                return getattr(result, name)
            except AttributeError:
                pass
        raise AttributeError(f"{type(self).__name__} has no {name}")

    def __dir__(self) -> list[str]:
        return sorted({*object.__dir__(self), *Result.__annotations__, *channel_names(self.channels), *self.further})

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the batch, () for one run."""
        return self.conditions.shape if "_pending" in self.__dict__ else self.result.status.shape

    @property
    def configuration(self) -> np.ndarray:
        """Names of the runs' configurations."""
        return np.array(self.configurations)[np.asarray(self.conditions.configuration)]

    @property
    def statuses(self) -> np.ndarray:
        """Statuses of the runs as words of `STATUSES`. `status` holds their codes."""
        return np.array(STATUSES)[np.asarray(self.status)]

    def rows_table(self) -> dict[str, np.ndarray]:
        """Same as `to_dict`, under the name that results of fits also have."""
        return self.to_dict()

    def to_dict(self) -> dict[str, np.ndarray]:
        """Conditions and outcomes by the columns of `runs.csv`, units in the names, arrays of the batch's shape.

        Over a profile the outcomes are those of the mission. Conditions that the profile states are NaN.
        """
        conditions = self.conditions
        nan = np.full(self.shape, np.nan)

        def column_of_run(name: str, values: Any) -> np.ndarray:
            return nan if name in self.stated else np.asarray(values)

        has_brake = "load_torque" in self.stated or conditions.load_torque is not None
        supply_voltage = np.where(np.asarray(conditions.battery) > 0.5, np.nan, conditions.voltage)
        outcomes = outputs.output_columns(self.result, self.channels, self.further)
        if self.mission is not None:
            outcomes = {
                name: outcomes[name]
                for name in (*mission_batch.mission_columns("turned" in self.mission.total.of), *CODES)
            }
        return {
            "configuration": self.configuration,
            "supply_voltage_V": column_of_run("voltage", supply_voltage),
            "total_mass_kg": column_of_run("payload", self.total_mass),
            "payload_kg": column_of_run("payload", conditions.payload),
            "slope_deg": column_of_run("slope_deg", conditions.slope_deg),
            **({"load_torque_Nm": column_of_run("load_torque", conditions.load_torque)} if has_brake else {}),
            **outcomes,
        }

    def table(self, columns: Sequence[str] | None = None, rows: int = 40) -> str:
        """Text table of the results, one line per run.

        Args:
            columns: columns of `to_dict`. None: the conditions, the readings and a few more.
            rows: largest number of lines.
        """
        content = {name: np.ravel(values) for name, values in self.to_dict().items()}
        quantities = (
            *outputs.output_table(self.channels), *mission_batch.OUTPUTS, *mission_batch.OF_TURNS,
        )  # fmt: skip
        column_facts = {
            **_CONDITIONS,
            **_WORDS,
            **{o.column: (o.label, o.unit_shown, o.resolution) for o in quantities},
        }
        if columns is None and self.mission is not None:
            columns = ["configuration", *mission_batch.USUAL, "status"]
        elif columns is None:
            readings = [
                output.column
                for output in outputs.output_table(self.channels)
                if output.column in _SHOWN or output.name in self.reading
            ]
            columns = [
                "configuration",
                "supply_voltage_V",
                "slope_deg",
                "payload_kg",
                *(["load_torque_Nm"] if "load_torque_Nm" in content else []),
                *readings,
                *self.further,
                "status",
            ]
        cells = []
        for name in columns:
            label, unit, digits = column_facts.get(name, (name.replace("_", " "), "", 3))
            values = content[name][:rows]
            is_text = values.dtype.kind == "U"
            body = [str(v) if is_text else f"{v:z.{digits}f}" for v in values]
            column = [label, f"[{unit}]" if unit not in ("", "-") else "", *body]
            width = max(map(len, column))
            cells.append([c.ljust(width) if is_text else c.rjust(width) for c in column])
        lines = ["  ".join(line).rstrip() for line in zip(*cells, strict=True)]
        omitted = len(content["status"]) - rows
        return "\n".join([*lines, f"... and {omitted} more"] if omitted > 0 else lines)

    def __str__(self) -> str:
        return self.table()

    def __repr__(self) -> str:
        if has_tracer(self):
            return f"Results of {self.model}, traced"
        return f"Results of {self.model}, {count_noun(max(self.status.size, 1), 'run')}\n{self.table()}"


def _comparable_codes(status: Any) -> Any:
    """Codes that compare with words. Tracers and values that are not arrays are returned unchanged."""
    is_array = isinstance(status, np.ndarray | jax.Array) and not isinstance(status, jax.core.Tracer)
    return np.asarray(status).view(StatusCodes) if is_array else status


jax.tree_util.register_dataclass(
    Results,
    data_fields=["conditions", "total_mass", "result", "further", "history", "mission"],
    meta_fields=["configurations", "model", "stated", "channels"],
)
