"""Settled runs: one row a run, read when steady."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Columns, Names
from calibration.data.columns import CURRENT
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.runs import Runs
from calibration.described import describe
from calibration.inference import bases as bases_room
from calibration.inference.bases import Bases
from calibration.inference.details import EquationErrors
from calibration.inference.fit_notes import Remark
from calibration.inference.linearization import (
    Linearization,
    ScoredEffect,
    balance_probe,
    finite_or_zero,
    with_probes,
)
from calibration.inference.noise import Noise, rows_of_same_conditions
from calibration.inference.observers.base import Observer, SearchPolicy
from calibration.inference.optimizers import (
    Numbers,
    Optimum,
    SearchMember,
    adhesion_penalty_slice,
    search_refilling,
    zero_inactive_residuals,
)
from calibration.inference.problem import Observation, Problem
from calibration.inference.simulation_errors import root_mean_square
from mmrjax import fidelities
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.effects import Effect
from mmrjax.effects.curve import WAYS, direction_signal
from mmrjax.fidelities.base import ImplicitSolution
from mmrjax.fidelities.rest import travel_direction
from mmrjax.fidelities.steady import SIZES, operating_signals
from mmrjax.model import balances, channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import FAILED, SLIDES, TIPS, Result, Signals

#: Column that a brake or a weight may impose, so that a reading is a condition.
LOAD = "output_torque_Nm"
#: Replicates that differ by more than this many sds of their difference contradict each other.
CONTRADICTION = 6.0
#: The same for replicates with unknown sd, as a share of their mean.
CONTRADICTION_SHARE = 0.25
#: Searches that run together on a core: for a robot without effects, and with effects. Rows of the latter, because
#: searches wait for the slowest.
MANY, FEW, FEW_ROWS = 16, 4, 1024
#: Least spread of a fitted speed or current, over its largest value, for curves over it [-].
VARIES = 0.05
#: Least size of the torque at the output as a share of the motors' torque [-].
LOST = 0.1
#: Balances to which the defect of a row is attributed, one for each equation that the channels close, with the signal
#: that is the size of each equation.
EQUATIONS = {"electrical": "voltage", "track": "torque_output", "slip": "speed_theoretical"}


class SettledLinearization(Linearization):
    """Linearization of settled rows.

    `defects` has shape (balances, rows, channels), with an independent defect in each row, or (balances, sides, rows,
    channels) for independently driven sides.
    """

    def columns(self, balance: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
        errors_of_sides = shapes.reshape(-1, self.rows, shapes.shape[1])
        changes = self.of_sides(balance)[:, :, :, None] * errors_of_sides[:, :, None, :]
        return changes.sum(0).reshape(-1, shapes.shape[1])

    def of_sides(self, balance: Scalar | int) -> Float[Array, "sides rows channels"]:
        """Change of the readings by a defect of a balance on each side. Identical sides are one."""
        return self.defects[balance].reshape(-1, *self.scale.shape)

    def along_of_sides(self, balance: str) -> np.ndarray:
        """Change of the readings by a defect along the travel, shape (sides, rows, channels)."""
        direction = self.variable(direction_signal(balance)).reshape(-1, self.rows)
        return np.asarray(self.of_sides(self.probed.index(balance))) * direction[:, :, None]

    def revealing_rows(self) -> np.ndarray:
        return np.arange(self.rows)


def side_shares(channel: str, sides: int) -> np.ndarray:
    """Weights of the sides in a channel's reading [-]: one side, or the mean of all."""
    side = channels.find_channel(channel).side
    return np.full(sides, 1 / sides) if side is None or sides == 1 else np.eye(sides)[side]


class SettledRuns(Observer):
    """Observer of settled rows: one run a row.

    Attributes:
        fidelity: name of the fidelity that simulates them.
    """

    word: ClassVar[str] = "run"
    fewest: ClassVar[int] = 6
    sizes_padded: ClassVar[tuple[int, ...]] = SIZES
    blocks: ClassVar[Names] = (
        "slope", "voltage_configuration", "voltage", "duty", "speed", "current", "payload", "load_torque",
        "configuration",
    )  # fmt: skip
    policy: ClassVar[SearchPolicy] = SearchPolicy()
    one_row_reveals: ClassVar[bool] = True
    evidence: ClassVar[Names] = ("single", "curve", "pair", "chi2")
    linearization: ClassVar[type[SettledLinearization]] = SettledLinearization
    shape_sides: ClassVar[tuple[int, ...]] = ()  # of values that differ between sides

    conditions: Conditions
    fidelity: str = eqx.field(static=True)

    @classmethod
    def accepts_table(cls, runs: Runs) -> bool:
        return not runs.has("time_s")

    @classmethod
    def of(cls, runs: Runs, robot: Robot, fidelity: str | None = None) -> SettledRuns:
        simulation = fidelities.get_fidelity(fidelity or "steady")
        conditions = runs.conditions(robot)
        if conditions.held is not None and simulation.name != "steady":
            raise BadConfiguration(
                f"{runs.source}, held: got model {simulation.name}; expected steady, which has a clamp"
            )
        if not simulation.facts.rollout:
            try:
                simulation.check(robot, conditions, simulation.facts.resolved())
            except ValueError as error:
                raise BadConfiguration(f"{runs.source}, settled runs: {error}") from error
        return cls(conditions, simulation.name)

    @classmethod
    def sizes(cls, runs: Runs) -> np.ndarray:
        """The readings, or a hundredth of the channel's largest if that is larger."""
        measured = np.abs(runs.measured())
        return np.maximum(measured, 0.01 * np.max(np.nan_to_num(measured), 0))

    @classmethod
    def least(cls, runs: Runs) -> np.ndarray:
        """Least sizes for comparisons of repeated readings [SI], shape (rows, channels)."""
        return np.zeros(runs.measured().shape)

    @classmethod
    def check(cls, runs: Runs, noise: Noise) -> list[Remark | str]:
        """Rejects a table of one condition with readings that differ. Notes the repeats that differ most."""
        measured = runs.measured()
        groups = rows_of_same_conditions(runs)
        least = cls.least(runs)
        conflicts = list[tuple[int, int, int, str]]()
        is_from_series = np.array([source == "series" for source in noise.source])
        usual_shares = np.array([c.sd_share for c in runs.channels])
        for rows in groups:
            repeats, sds = measured[rows], noise.sd[rows]
            distance = np.abs(repeats[:, None] - repeats)
            mean = np.maximum(np.abs(repeats[:, None] + repeats) / 2, least[rows])
            sd = np.hypot(sds[:, None], sds)
            allowed = np.where(noise.estimated, CONTRADICTION_SHARE * mean, CONTRADICTION * sd)
            # An estimate of the noise from the scatter of these readings cannot test that scatter.
            allowed = np.where(
                is_from_series, np.minimum(allowed, CONTRADICTION * np.sqrt(2) * usual_shares * mean), allowed
            )
            for one, other, k in np.argwhere(distance > allowed)[:1].tolist():
                place = (one, other, k)
                as_share = noise.estimated[k] or is_from_series[k]
                distance_words = (
                    f"{distance[place] / mean[place]:.0%}" if as_share else f"{distance[place] / sd[place]:.0f} sd"
                )
                conflicts.append((int(rows[one]), int(rows[other]), k, distance_words))
        remarks: list[Remark | str] = []
        if runs.whole is not runs:
            remarks.append(Remark("thinned_table", source=runs.source, rows=len(runs.whole), kept=len(runs)))
        for first, second, k, distance_words in conflicts[:1]:
            column = runs.channels[k].column
            columns = {**runs.extras, **runs.columns}
            others = [c for c, x in runs.extras.items() if x.dtype.kind == "f"]
            others += [c for c in (LOAD,) if c != column and runs.has(c)]
            others = [c for c in others if columns[c][first] != columns[c][second]]
            remark = Remark(
                "repeats",
                source=runs.source,
                rows=(first + 1, second + 1),
                column=column,
                values=(float(runs[column][first]), float(runs[column][second])),
                apart=distance_words,
                unused=tuple(others),
                near=runs.layout.nearest(others[0], runs.columns) if others else "",
                more=len(conflicts) - 1,
            )
            if len(groups) == 1:
                raise BadData(f"{describe(remark)}; no condition varies")
            remarks.append(remark)
        return remarks

    @classmethod
    def settled(cls, runs: Runs, steady: bool = False) -> tuple[Runs, np.ndarray, np.ndarray]:
        return runs, runs.measured(), np.full(len(runs), np.inf)

    @classmethod
    def identity(cls, runs: Runs) -> Names:
        order_column = () if "order" in runs.headings else ("order",)  # the order of the rows in the file
        return tuple(c for c in runs.columns if c not in order_column)

    @classmethod
    def shows(cls, effect: type[Effect]) -> bool:
        return not (effect.needs_battery or effect.transient or effect.settles_to)

    def __call__(self, robot: Robot) -> Observation:
        return self._simulated_readings(robot, fidelities.get_fidelity(self.fidelity).settled(robot, self.conditions))

    def _simulated_readings(self, robot: Robot, result: Result) -> Observation:
        reading = jnp.stack([result.reading[name] for name in channels.channel_names(robot.channels)], -1)
        return Observation(reading, jnp.asarray(result.adhesion_used), result.status, jnp.asarray(result.flags))

    @property
    def _implicit(self) -> ImplicitSolution | None:
        return fidelities.get_fidelity(self.fidelity).implicit

    def solve(self, robot: Robot) -> tuple[Array, Array] | None:
        implicit = self._implicit
        return None if implicit is None else jax.vmap(lambda c: implicit.solve(robot, c))(self.conditions)

    def observation_at_unknowns(
        self, robot: Robot, unknowns: Array, is_solved: Array
    ) -> tuple[Observation, Signals, Array]:
        assert self._implicit is not None
        results_at_unknowns = functools.partial(self._implicit.results_at, robot)
        result, signals, residual = jax.vmap(results_at_unknowns)(self.conditions, unknowns, is_solved)
        return self._simulated_readings(robot, result), signals, residual

    def operating_points(self, robot: Robot) -> Signals | None:
        if self.long or self.conditions.turns:
            return None
        return jax.vmap(functools.partial(operating_signals, robot))(self.conditions)

    @property
    def long(self) -> bool:
        return fidelities.fidelity_facts(self.fidelity).rollout

    def unreachable(self, status: np.ndarray) -> np.ndarray:
        return np.isin(status, (SLIDES, FAILED, TIPS))

    def cautions(self, robot: Robot) -> list[str]:
        return fidelities.get_fidelity(self.fidelity).cautions(robot, self.conditions)

    def linearise(self, problem: Problem, z: Array, effects: tuple[ScoredEffect, ...]) -> Linearization:
        """Linearization as in the protocol.

        A signature is the sensitivity of the readings to a defect of the effect's balance, times the effect's term.
        This is exact, because an effect enters one balance and is linear in its amplitude.
        """
        linearization = self.linearization
        data = problem.data
        probes = tuple(balance_probe(b) for b in linearization.probed)
        robot = problem.robot(z)
        size = z.size
        channel_names = channels.channel_names(problem.channels)

        def probed(x: Array) -> Robot:
            delta = x[size:].reshape(len(probes), *self.shape_sides)
            return with_probes(problem.robot(x[:size]), probes, delta)

        z_and_probes = jnp.concatenate([z, jnp.zeros(len(probes) * math.prod(self.shape_sides))])
        residual_of_readings, slopes_of_readings, _, signals = problem.linearised(probed, z_and_probes)
        residual_of_readings, slopes_of_readings = zero_inactive_residuals(
            residual_of_readings, slopes_of_readings, adhesion_penalty_slice(data)
        )
        jacobian = jnp.concatenate([slopes_of_readings, jnp.eye(size, z_and_probes.size)])
        residual = jnp.concatenate([residual_of_readings, z - data.centre])
        rows, count = data.measured.shape
        defects = jacobian[: rows * count, size:].reshape(rows, count, len(probes), -1).transpose(2, 3, 0, 1)
        if signals is None:
            signals = jax.vmap(lambda c: operating_signals(robot, c))(self.conditions)
        flat_signals = jax.tree.map(lambda x: x.reshape(-1), signals)
        scale = data.weight / data.sd

        def signature(effect: Effect) -> Array:
            robot_with_effect = dataclasses.replace(robot, effects=(effect,))
            term = jax.vmap(lambda s: balances.effects_sum(robot_with_effect, s, effect.balance, effect.channel))(
                flat_signals
            )
            term = jnp.broadcast_to(term, flat_signals.speed.shape).reshape(rows, -1)
            if effect.balance == "sensor":
                term = term @ side_shares(effect.channel, term.shape[1])
                change = term[:, None] * (jnp.arange(count) == channel_names.index(effect.channel)) * scale
            elif effect.balance in linearization.probed:
                change = (term.T[:, :, None] * defects[linearization.probed.index(effect.balance)]).sum(0)
            else:
                change = jnp.zeros((rows, count))
            return change.ravel()

        signatures = jnp.concatenate([e.each(signature) for e in effects]).T
        defects = defects.reshape(len(probes), *self.shape_sides, rows, count)
        return linearization(
            residual, jacobian[:, :size], finite_or_zero(signatures), defects, scale, signals, channels=channel_names,
            magnitudes=robot.rig.magnitudes,
        )  # fmt: skip

    def draws(
        self, problem: Problem, z: Array, linear: Linearization, keys: Array, factors: np.ndarray
    ) -> tuple[Array, Array, Array]:
        """Draws as in the protocol: readings and priors of each table, and its fit.

        Readings are drawn with their sds, and bench values too, because a prior is an earlier measurement. Each refit
        is the search that found the fit, from the true coordinates.
        """
        data = problem.data
        count = len(keys)
        clean = data.measured + data.sd * linear.by_row()  # for included readings
        measured, centre = jax.device_get(_draw_tables(clean, data.sd, z, keys, jnp.asarray(factors)))
        start, weight = (np.repeat(np.asarray(x)[None], count, 0) for x in (z, data.weight))
        members = SearchMember(start, weight, measured, centre)
        refits, _ = search_refilling(problem, members, self.policy.steps, self.searches_per_core(problem))
        return measured, centre, refits.z

    def fit_replicate(
        self,
        problem: Problem,
        effects: tuple[ScoredEffect, ...],
        linear: Linearization,
        drawn: tuple[Array, Array, Array],
    ) -> Linearization:
        measured, centre, refit = drawn
        return self.linearise(problem.with_data(measured=measured, centre=centre), refit, effects)

    def search(
        self,
        problem: Problem,
        starts: Numbers,
        weights: Numbers,
        active: Numbers | None = None,
        *,
        rivals: bool = False,
        most: int | None = None,
    ) -> tuple[Optimum, Observation]:
        data = problem.data
        count = len(starts)
        measured, centre = (np.repeat(np.asarray(x)[None], count, 0) for x in (data.measured, data.centre))
        search_inputs = np.asarray(starts), np.asarray(weights), measured, centre
        members = SearchMember(*search_inputs, active=None if active is None else np.asarray(active))
        steps = self.policy.steps if most is None else most
        return search_refilling(problem, members, steps, self.searches_per_core(problem))

    def searches_per_core(self, problem: Problem) -> int:
        """Number of searches that run together on a core.

        Fewer if effects make the model costly, so that few searches wait for the slowest.
        """
        return max(1, min(FEW, FEW_ROWS // len(problem.data.measured))) if problem.base.effects else MANY

    def bases(self, columns: Columns, included: np.ndarray, robot: Robot) -> Bases:
        weight = included.astype(float)
        if "duty" in columns:  # the motors' mean voltage
            columns = {**columns, "supply_voltage_V": columns["supply_voltage_V"] * columns["duty"]}
        if CURRENT in columns and CURRENT in bases_room.axes_of(robot):  # imposed: no channel measures it
            columns = {**columns, bases_room.VARIABLES["current"]: columns[CURRENT]}
        columns = {**_unmeasured(self, robot, columns), **columns}
        ways = dict.fromkeys(WAYS, np.asarray(_run_directions(self, robot)))
        return bases_room.families_of_table(columns, weight, ways, bases_room.CurveScope.of(robot, columns))

    def detail(self, bases: Bases, included: np.ndarray, before: Any, after: Any) -> EquationErrors:
        """Defects of `electrical`, `track` and `slip` that together make each row's residual.

        Residuals are simulated less measured. Sides have defects of their own if they are driven independently.
        """
        return EquationErrors(_row_defects(before.linear, included), _row_defects(after.linear, included))


def _unmeasured(observe: SettledRuns, robot: Robot, columns: Columns) -> dict[str, Float[np.ndarray, " rows"]]:
    """Fitted motor speed [rad/s] and motor current [A], by column, if no channel measures them (rigs may show only
    the output)."""
    unmeasured = [v for v in ("speed_motor", "current") if bases_room.VARIABLES[v] not in columns]
    if bases_room.VARIABLES["speed"] in columns:
        unmeasured = [v for v in unmeasured if v != "speed_motor"]
    if not unmeasured or observe.long:
        return {}
    fitted = {
        v: np.asarray(x, float) for v, x in zip(unmeasured, _signals(observe, robot, tuple(unmeasured)), strict=True)
    }
    # A current that only friction needs varies less.
    return {
        bases_room.VARIABLES[v]: x
        for v, x in fitted.items()
        if np.isfinite(x).all() and np.ptp(np.abs(x)) > VARIES * np.max(np.abs(x))
    }


@functools.partial(compiled, options=SELDOM)
def _signals(observe: SettledRuns, robot: Robot, names: Names) -> tuple[Float[Array, " rows"], ...]:
    """Signals of a fit at each row's operating point."""
    signals = jax.vmap(functools.partial(operating_signals, robot))(observe.conditions)
    rows = jnp.shape(observe.conditions.slope_deg)
    return tuple(jnp.broadcast_to(getattr(signals, name), rows) for name in names)


def _row_defects(linear: Linearization, included: np.ndarray) -> Columns:
    """Defects along the travel that make the residual r of each row, of each side if sides are driven independently.

    They are the most probable δ of r = -S δ + noise of one sd: δ = -D Sᵀ (S D Sᵀ + 1)⁻¹ r. Their prior sds D^½ are
    the size of each equation (rms over the table). A defect that barely changes the readings of a row is therefore
    near zero, never a residual over a vanishing slope. Defects that act on the same readings share the residual. The
    size of the torque is at least a share of the motors' torque, as a free shaft may have a defect too.
    """
    assert isinstance(linear, SettledLinearization)
    rows = np.flatnonzero(included)
    sensitivities = np.stack([np.asarray(linear.along_of_sides(b))[:, rows] for b in EQUATIONS])
    signals_of_equations = [np.asarray(getattr(linear.signals, name))[rows] for name in EQUATIONS.values()]
    sides = sensitivities.shape[1]
    sizes = np.array([root_mean_square(x) for x in signals_of_equations])
    motor_torque, motor_speed, output_speed = (
        root_mean_square(np.asarray(getattr(linear.signals, name))[rows])
        for name in ("torque_electromagnetic", "speed_motor", "speed_output")
    )
    track = [*EQUATIONS].index("track")
    sizes[track] = max(sizes[track], LOST * motor_torque * motor_speed / max(output_speed, 1e-12))
    sensitivities = (
        (sensitivities * sizes[:, None, None, None]).reshape(-1, *sensitivities.shape[2:]).transpose(1, 2, 0)
    )
    gram_matrix = sensitivities @ sensitivities.transpose(0, 2, 1) + np.eye(sensitivities.shape[1])
    scaled_defects = -sensitivities.transpose(0, 2, 1) @ np.linalg.solve(
        gram_matrix, np.asarray(linear.by_row())[rows, :, None]
    )
    defects = np.full((len(EQUATIONS) * sides, len(included)), np.nan)
    defects[:, rows] = np.repeat(sizes, sides)[:, None] * scaled_defects[:, :, 0].T
    names = [f"{b}_{side}" for b in EQUATIONS for side in channels.SIDES] if sides > 1 else EQUATIONS
    return dict(zip(names, defects, strict=True))


@functools.partial(compiled, options=SELDOM)
def _run_directions(observe: SettledRuns, robot: Robot) -> Float[Array, " rows"]:
    """Direction of each run, 1 or -1."""
    return jax.vmap(lambda c: travel_direction(robot, c))(observe.conditions)


@functools.partial(compiled, options=SELDOM)
def _draw_tables(clean: Array, sd: Array, z: Array, keys: Array, factors: Array) -> tuple[Array, Array]:
    """Readings and bench values of a table for each key, with its sds times its factors."""

    def draw(key: Array, factors: Array) -> tuple[Array, Array]:
        reading_key, prior_key = jax.random.split(jax.random.wrap_key_data(key))
        return clean + sd * factors * jax.random.normal(reading_key, clean.shape), z + jax.random.normal(
            prior_key, z.shape
        )

    return jax.vmap(draw)(keys, factors)
