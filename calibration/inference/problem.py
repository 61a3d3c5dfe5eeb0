"""The calibration problem: what is observed, what the model says of it, and the whitened residuals of both."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from calibration.data.errors import BadConfiguration, choices
from calibration.data.runs import Runs
from calibration.inference.priors import Coordinates
from mmrjax import balances, params
from mmrjax.conditions import Conditions
from mmrjax.effects import Effect
from mmrjax.fidelities.drive import drive, rates, state_of
from mmrjax.fidelities.histories import grid, histories, respond, states
from mmrjax.fidelities.steady import operating_point
from mmrjax.robot import Robot
from mmrjax.signals import CONVERGED, FAILED, SLIDES, TIPS, Result, Signals

#: Share of the adhesion limit that a measured steady row is taken to leave unused [-].
MARGIN = 0.02
#: Demand above that which costs one sigma, as a share of the limit [-]; tightened where a row still slides.
STIFFNESS = 1e-3
#: Whitened residual of a reading that the model could not compute [σ].
MISSING = 1e3
#: Time after which `drive` is read as settled [s].
SETTLED = 4.0
#: Length of a run of `track` from a rolling start [s]. Its last 40 % hold two grouser periods (34) or more down
#: to 0.29 m/s, and averages over them are within 1e-4 of those of a run of 1.5 s.
ROLLED = 0.6

#: Most knots of a run's defect in time, and most of knots times steps of all runs: 2 GB while they are computed.
KNOTS, KNOT_STEPS = 256, 1e7

Simulate = Callable[[Robot, Conditions], Result]


def _steady(robot: Robot, commands: Conditions) -> Result:
    return jax.vmap(lambda c: operating_point(robot, c)[0])(commands)


def _drive(robot: Robot, commands: Conditions) -> Result:
    # A settled row does not say how its run was started. One from standstill starts by sliding at μ_d, and on
    # a slope between μ_d and μ_s it never grips, though it was measured there: so from a rolling start, as `track`.
    times = jnp.asarray([0.0, SETTLED])
    return jax.vmap(lambda c: drive(robot, c, times, rolling=True).result)(commands)


def _track(robot: Robot, commands: Conditions) -> Result:
    from mmrjax.fidelities.track import track  # brings mujoco, which the other fidelities do without

    return jax.vmap(lambda c: track(robot, c, duration=ROLLED, rolling=True).result)(commands)


#: Fidelities by name. Each maps a robot and a batch of commands to a batch of results, with numbers
#: wherever it can give some, whatever the status; forward derivatives suffice.
FIDELITIES: dict[str, Simulate] = {"steady": _steady, "drive": _drive, "track": _track}


def fidelity(name: str) -> Simulate:
    """A fidelity by its name.

    Raises:
        BadConfiguration: no such fidelity.
    """
    if name not in FIDELITIES:
        raise BadConfiguration(f"--model {name}: no such fidelity; {choices(name, FIDELITIES)}")
    return FIDELITIES[name]


class Observation(eqx.Module):
    """What the model says of every row.

    Attributes:
        reading: current [A], motor speed [rad/s], speed [m/s]; shape (rows, 3).
        adhesion_used: demand on adhesion over its limit [-], 0 where that is no matter; shape (rows,).
        status: of the row's run, shape (rows,).
    """

    reading: Float[Array, "rows 3"]
    adhesion_used: Float[Array, " rows"]
    status: Int[Array, " rows"]


def _stack(reading: Reading) -> Float[Array, "... 3"]:
    return jnp.stack([reading.total_current, reading.motor_speed, reading.speed], -1)


class Settled(eqx.Module):
    """Observer of steady rows: one run a row, read when settled."""

    commands: Conditions
    simulate: Simulate = eqx.field(static=True)

    def __call__(self, robot: Robot) -> Observation:
        result = self.simulate(robot, self.commands)
        return Observation(_stack(result.reading), result.adhesion_used, result.status)


class Series(eqx.Module):
    """Observer of time histories: one run of `drive` from standstill for each `run_id`, one row a sample.

    Sliding during a start is part of the run, so adhesion is not penalised.

    Attributes:
        commands: of each run, shape (runs,).
        times: the grid of each run from 0 on, its last instant repeated to one length, shape (runs, instants) [s].
        run: index of each row's run; instant: of its sample in `times`; shape (rows,).
        rows: indices of each run's rows in the order of time, -1 beyond its last, shape (runs, samples).
        knots: rows between which a defect is taken to be linear, a run's last repeated, shape (runs, knots).
    """

    commands: Conditions
    times: Float[Array, "runs instants"]
    run: Int[Array, " rows"]
    instant: Int[Array, " rows"]
    rows: Int[Array, "runs samples"]
    knots: Int[Array, "runs knots"]

    def defective(self, robot: Robot, probes: tuple[Effect, ...]) -> Float[Array, "probes runs knots samples 3"]:
        """Change of the readings by a defect of each probe's balance [its unit] that is 1 at a knot of a run and
        falls linearly to 0 at the next ones; an effect `probe` is its amplitude in its balance."""
        clock = self.times[jnp.arange(len(self.times))[:, None], self.instant[self.knots]]

        def one(command: Conditions, times: Array, clock: Array, instants: Array) -> Array:
            def probed(amplitude: Array) -> Robot:
                put = tuple(eqx.tree_at(lambda e: e.amplitude, p, a) for p, a in zip(probes, amplitude, strict=True))
                return dataclasses.replace(robot, effects=(*robot.effects, *put))

            none = jnp.zeros(len(probes))
            # A run that ended early repeats its last knot; only the first of them is one.
            real = jnp.concatenate([jnp.ones(1), (jnp.diff(clock) > 0).astype(clock.dtype)])
            before = jnp.concatenate([clock[:1], clock[:-1]])
            after = jnp.concatenate([clock[1:], clock[-1:] + 1.0])

            def source(t: Array, y: Array) -> Array:
                slope = jax.jacfwd(lambda a: rates(probed(a), command, y))(none)
                rising = ((t - before) / jnp.maximum(clock - before, 1e-12)).at[0].set(1.0)
                falling = jnp.where(after > clock, (after - t) / jnp.where(after > clock, after - clock, 1.0), 1.0)
                hat = real * jnp.clip(jnp.minimum(rising, falling), 0.0, 1.0)
                return slope[:, :, None] * hat

            def seen(y: Array, dy: Array) -> Array:
                def reading(y: Array) -> Array:
                    return _stack(balances.sensor(robot, balances.moving(robot, command, state_of(robot, y))))

                return jnp.tensordot(jax.jacfwd(reading)(y), dy, 1)

            changed = respond(robot, command, times, states(robot, command, times), source, seen)[1]
            whole = jnp.concatenate([jnp.zeros_like(changed[:1]), changed])
            return jnp.moveaxis(whole[instants], (0, 1), (2, 3))  # probes, knots, samples, 3

        instants = self.instant[jnp.where(self.rows < 0, 0, self.rows)]
        return jnp.moveaxis(jax.vmap(one)(self.commands, self.times, clock, instants), 0, 1)

    def whole(self, robot: Robot) -> Signals:
        """Every signal of every run at every instant, shape (runs, instants)."""
        found = jax.vmap(lambda c, t: histories(robot, c, t))(self.commands, self.times)
        return jax.tree.map(lambda x: jnp.broadcast_to(x, self.times.shape), found)

    def at_rows(self, whole: Signals) -> Signals:
        """Every signal at every row."""
        return jax.tree.map(lambda x: x[self.run, self.instant], whole)

    @property
    def time(self) -> Float[Array, " rows"]:
        """Time of every row since the start of its run [s]."""
        return self.times[self.run, self.instant]

    def angle(self, whole: Signals) -> Float[Array, " rows"]:
        """Angle of the driving shaft at every row, since the start of its run [rad]."""
        speed = whole.speed_wheel
        turned = 0.5 * (speed[:, 1:] + speed[:, :-1]) * jnp.diff(self.times)
        angle = jnp.concatenate([jnp.zeros((len(turned), 1)), jnp.cumsum(turned, 1)], 1)
        return angle[self.run, self.instant]

    def __call__(self, robot: Robot) -> Observation:
        reading = _stack(jax.vmap(lambda s: balances.sensor(robot, s))(self.at_rows(self.whole(robot))))
        followed = jnp.all(jnp.isfinite(reading), 1)
        return Observation(reading, jnp.zeros(self.run.shape), jnp.where(followed, CONVERGED, FAILED))


def is_series(runs: Runs) -> bool:
    """Whether the table holds time histories."""
    return runs.has("time_s")


def series(runs: Runs) -> Series:
    """Observer of a table with `time_s`; rows may come in any order, conditions are those of a run's first row."""
    identity = runs["run_id"] if runs.has("run_id") else np.zeros(len(runs), str)
    names, first, run = np.unique(identity, return_index=True, return_inverse=True)
    mine = [np.flatnonzero(run == k) for k in range(len(names))]
    mine = [m[np.argsort(runs["time_s"][m], kind="stable")] for m in mine]
    grids = [grid(runs["time_s"][m]) for m in mine]
    longest, samples = max(map(len, grids)), max(map(len, mine))
    times = np.stack([np.concatenate([g, np.repeat(g[-1], longest - len(g))]) for g in grids])
    instant = np.array([np.searchsorted(grids[r], t) for r, t in zip(run, runs["time_s"], strict=True)])
    rows = np.stack([np.concatenate([m, np.full(samples - len(m), -1)]) for m in mine])
    most = min(samples, KNOTS, max(8, int(KNOT_STEPS / times.size)))
    knots = np.stack([_knots(m, most) for m in mine])
    return Series(runs.where(first).command(), *map(jnp.asarray, (times, run, instant, rows, knots)))


def _knots(rows: np.ndarray, most: int) -> np.ndarray:
    """At most so many of a run's rows, evenly chosen, its first and last among them; the last again for the rest."""
    chosen = rows[np.unique(np.round(np.linspace(0, len(rows) - 1, most)).astype(int))]
    return np.concatenate([chosen, np.repeat(chosen[-1], most - len(chosen))])


class Data(eqx.Module):
    """Readings and how much each counts; the part of a problem that varies over refits.

    Attributes:
        measured, sd: current [A], motor speed [rad/s], speed [m/s], shape (rows, 3).
        weight: 1 where a reading is fitted, 0 where it is held out, shape (rows, 3).
        centre: what the priors say z is, shape (parameters,); 0 but in a bootstrap, where the bench
            values too are drawn anew.
        stiffness: of the penalty on adhesion, see `Problem`; shape ().
    """

    measured: Float[Array, "rows 3"]
    sd: Float[Array, "rows 3"]
    weight: Float[Array, "rows 3"]
    centre: Float[Array, " parameters"]
    stiffness: Float[Array, ""]


class Problem(eqx.Module):
    """Maximum a posteriori over z: minimise half the sum of squared residuals.

    Residuals: (simulated - measured) / sd for each reading; z - centre for each free parameter; and, for a
    settled row whose demand on adhesion exceeds 1 - MARGIN of its limit, the excess over `stiffness`.

    Steady travel does not exist beyond the limit (the model says `slides`), yet the robot was measured
    there, and at Table 5's adhesion six of the packaged rows slide. The balances can still be written down
    with the contact held at V_s, so the objective is finite and continuous everywhere, and the penalty
    turns the search back: its gradient in μ_s lives where that of the speed has died. The margin keeps it
    off the limit itself, where the inverse of Fig. 7 has an infinite slope. The penalty is zero, with zero
    gradient, wherever every row leaves the margin, so it does not move such an optimum; one that it does
    hold is reported as held by the adhesion limit.
    """

    base: Robot
    coordinates: Coordinates
    observe: Any  # Settled | Series
    data: Data

    @property
    def long(self) -> bool:
        """Whether the model is a rollout: searches then run one by one, and end sooner."""
        return not isinstance(self.observe, Settled) or self.observe.simulate is not _steady

    def observation(self, z: Float[Array, " parameters"]) -> Observation:
        """What the model says of every row at z."""
        return self.observe(self.coordinates.robot(self.base, z))

    def misfit(self, z: Float[Array, " parameters"], data: Data) -> Float[Array, " residuals"]:
        """Whitened residuals of the readings, then of adhesion; shape (4 rows,)."""
        return self.whitened(self.observation(z), data)

    def whitened(self, seen: Observation, data: Data) -> Float[Array, " residuals"]:
        """Residuals of what any robot shows: readings, then adhesion; shape (4 rows,)."""
        error = (seen.reading - data.measured) / data.sd
        error = data.weight * jnp.where(jnp.isfinite(error), error, MISSING)
        over = jax.nn.relu(seen.adhesion_used - (1 - MARGIN)) * jnp.max(data.weight, 1) / data.stiffness
        return jnp.concatenate([error.ravel(), jnp.where(jnp.isfinite(over), over, 0.0)])

    def robot(self, z: Float[Array, " parameters"]) -> Robot:
        """The robot at z."""
        return self.coordinates.robot(self.base, z)

    def unreachable(self, status: np.ndarray) -> np.ndarray:
        """Whether the model has no such operating point, by row."""
        return np.isin(status, (SLIDES, FAILED, TIPS) if isinstance(self.observe, Settled) else (FAILED,))


def build(runs: Runs, base: Robot, coordinates: Coordinates, sd: np.ndarray, model: str = "steady") -> Problem:
    """The problem of these runs: `drive` histories where the table has `time_s`, else settled rows.

    Raises:
        BadConfiguration: no such fidelity, or one that has no time histories.
    """
    simulate = fidelity(model)
    observe: Any = Settled(runs.command(), simulate)
    if is_series(runs):
        if model != "drive":
            raise BadConfiguration(f"--model {model}: {runs.source} holds time histories; they need --model drive")
        observe = series(runs)
    measured = jnp.asarray(runs.measured())
    data = Data(
        measured, jnp.asarray(sd), jnp.ones_like(measured), jnp.zeros(len(coordinates)), jnp.asarray(STIFFNESS)
    )
    return Problem(params.strong(base), coordinates, observe, data)


def reweighted(data: Data, **changes: Any) -> Data:
    """`data` with some fields replaced."""
    return dataclasses.replace(data, **changes)
