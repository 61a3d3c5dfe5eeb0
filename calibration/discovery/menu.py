"""The menu of experiments: what to do, what to read, and what any robot would show."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mmrjax import balances, channels, params
from mmrjax.channels import RPM
from mmrjax.conditions import Conditions
from mmrjax.fidelities.steady import operating_point
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.signals import CONVERGED, STALLED, Signals, State

#: Mass of a robot whose weight is carried by stands [kg]: none, but for the sake of ratios to its load.
UNLOADED = 1e-9
#: Friction of a shaft that is held in a vice, and of a brake on it [N·m].
BLOCKED, BRAKE = 1e3, 0.06


# --- how the robot is set up ------------------------------------------------------------------------


def _with(robot: Robot, values: Mapping[str, Scalar]) -> Robot:
    return params.replace(robot, {k: jnp.asarray(v, float) for k, v in values.items()})


def without(robot: Robot, *closed: str) -> Robot:
    """The robot without the effects that enter the balances `closed`."""
    return _with(robot, {f"effects.{e.name}.amplitude": 0.0 for e in robot.effects if e.balance in closed})


def on_ground(robot: Robot) -> Robot:
    """The robot as it is."""
    return robot


def reversed_(robot: Robot) -> Robot:
    """The robot turned about, so that its travel is forward again.

    With the negative of the slope in the command, friction, slip and what meters show stay as they are: they
    follow the travel. What is odd in travel flips: a slope that is steeper than stated stays so, and now drives.
    """
    biased = {f"effects.{e.name}.amplitude": -e.amplitude for e in robot.effects if e.odd_in_travel}
    return _with(robot, biased)


def lifted(robot: Robot) -> Robot:
    """The robot on stands, its movers in the air: no normal load, no ground."""
    rolling = {f"{c}.ground.rolling_resistance": 0.0 for c in robot.configurations}
    return _with(without(robot, "mass", "ground", "slip"), rolling)


def bare(robot: Robot) -> Robot:
    """The motors with their gearboxes uncoupled: of the balances, supply, electrical and motor are left."""
    losses = {f"{c}.track.loss_{kind}": 0.0 for c in robot.configurations for kind in ("coulomb", "viscous")}
    gear = {"gearbox.friction_coulomb": 0.0, "gearbox.friction_viscous": 0.0, "gearbox.efficiency_load": 1.0}
    return _with(without(lifted(robot), "gearbox", "track"), losses | gear)


def blocked(robot: Robot) -> Robot:
    """The motors with their shafts held: U_e = E + I R at speed 0."""
    return _with(lifted(robot), {"gearbox.friction_coulomb": BLOCKED})


def braked(robot: Robot) -> Robot:
    """The bare motors, each against a brake of constant torque."""
    return _with(bare(robot), {"gearbox.friction_coulomb": BRAKE})


# --- what is done -----------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Act:
    """A calibration act: something is read that does not depend on the run.

    Attributes:
        name, description: for an engineer, what to do and what to read.
        reading: of a robot [SI], shape (readings,); sd: of a single reading, by reading [SI].
        repeats: readings that are averaged.
    """

    name: str
    description: str
    reading: Callable[[Robot], Array]
    sd: tuple[float, ...]
    repeats: int = 10


@dataclasses.dataclass(frozen=True)
class Run:
    """Settled runs under conditions that the table does not hold.

    Attributes:
        name, description: for an engineer, what to do and what to read.
        setup: how the robot is set up.
        voltage [V], slope [deg], payload [kg]: conditions of each run, shape (runs,).
        configuration: index of the robot's.
        channels: names of what is read; none: all.
        sides: motors that are switched on; None: all.
        repeats: readings that are averaged.
    """

    name: str
    description: str
    setup: Callable[[Robot], Robot]
    voltage: tuple[float, ...]
    slope: tuple[float, ...]
    payload: tuple[float, ...]
    configuration: int = 0
    channels: tuple[str, ...] = ()
    sides: int | None = None
    repeats: int = 3

    @property
    def read(self) -> tuple[int, ...]:
        """Positions of the channels that are read."""
        return tuple(channels.index(c) for c in self.channels or channels.names())


Experiment = Act | Run


def _show(robot: Robot, channel: str, signals: Signals) -> Array:
    """What the instrument of a channel shows of signals that are known otherwise."""
    return jnp.asarray(balances.sensor(robot, signals)[channel])


#: Payload on the scales [kg].
WEIGHED = (0.0, 8.0)


def _weighed(robot: Robot) -> Array:
    """Mass beyond the stated one, so that it does not matter how that was come by."""
    still = State(*(jnp.zeros(()),) * 4)
    count = len(robot.configurations)
    loads = [Conditions(payload=m, configuration=k) for k in range(count) for m in WEIGHED]
    stated = without(robot, "mass")
    return jnp.stack([balances.begin(robot, c, still).mass - balances.begin(stated, c, still).mass for c in loads])


def _shunted(*currents: float) -> Callable[[Robot], Array]:
    shown = [Signals(total_current=jnp.asarray(i)) for i in currents]
    return lambda robot: jnp.stack([_show(robot, "total_current", s) for s in shown])


def _strobed(robot: Robot) -> Array:
    return jnp.stack([_show(robot, "motor_speed", Signals(speed_motor=jnp.asarray(w))) for w in (300.0, 800.0)])


def _timed(robot: Robot) -> Array:
    return jnp.stack([_show(robot, "speed", Signals(speed=jnp.asarray(v))) for v in (0.4, 0.9)])


def acts(configurations: tuple[str, ...]) -> tuple[Act, ...]:
    """The calibration acts of a robot with these configurations, the least effort first."""
    each = "in both configurations, " if len(configurations) == 2 else "in each configuration, "
    where = each if len(configurations) > 1 else ""
    return (
        Act(
            "weigh",
            f"Weigh the robot {where}unladen and with the payload of 8 kg, on scales that are good to "
            "20 g; read the total mass, and take the stated one from it",
            _weighed,
            (0.02,) * (len(WEIGHED) * len(configurations)),
            repeats=1,
        ),
        Act("zero current", "Switch the motors off; read the ammeter", _shunted(0.0), (0.02,)),
        Act(
            "shunt",
            "Put a precision shunt and a load in the place of the robot, set 1 A and 5 A by the shunt; read the "
            "ammeter",
            _shunted(1.0, 5.0),
            (0.02, 0.02),
        ),
        Act(
            "strobe",
            "Set the motor to 300 and to 800 rad/s by a stroboscope; read the tachometer",
            _strobed,
            (5 * RPM, 5 * RPM),
        ),
        Act(
            "timing",
            "Time the robot by light gates over a distance measured with a tape, at 0.4 and 0.9 m/s; read the speed "
            "that the bench shows",
            _timed,
            (3e-3, 3e-3),
        ),
    )


def _runs(
    name: str,
    description: str,
    setup: Callable[[Robot], Robot] = on_ground,
    *,
    voltages: tuple[float, ...],
    slopes: tuple[float, ...] = (0.0,),
    payloads: tuple[float, ...] = (0.0,),
    configuration: int = 0,
    read: tuple[str, ...] = (),
    sides: int | None = None,
) -> Run:
    each = zip(*itertools.product(slopes, payloads, voltages), strict=True)
    slope, payload, voltage = (tuple(x) for x in each)
    return Run(name, description, setup, voltage, slope, payload, configuration, read, sides)


#: What is read where nothing travels, and where nothing turns.
TURNING, STANDING = ("total_current", "motor_speed"), ("total_current",)


def _travels(configuration: str, index: int) -> tuple[Run, ...]:
    """Runs that are done with one configuration."""

    def runs(name: str, description: str, *args: Callable[[Robot], Robot], **rest: Any) -> Run:
        return _runs(
            f"{name}, {configuration}", f"{configuration}: {description}", *args, configuration=index, **rest
        )

    return (
        runs("reverse", "travel backwards, on the level and down the same slope of 10 deg, at 15 and 33 V; read all "
             "three channels", reversed_, voltages=(15.0, 33.0), slopes=(0.0, -10.0)),
        runs("downhill", "turn the slope to -5 and -10 deg by the same inclinometer and travel forwards at 15 and "
             "33 V; read all three channels", voltages=(15.0, 33.0), slopes=(-5.0, -10.0)),
        runs("lifted", "put it on stands, the movers in the air, and run at 8, 15, 24, 33 and 40 V; read current and "
             "motor speed", lifted, voltages=(8.0, 15.0, 24.0, 33.0, 40.0), read=TURNING),
        runs("one motor", "put it on stands, one motor disconnected, and run at 8, 15, 24, 33 and 40 V; read the "
             "supply's current and the motor speed", lifted, voltages=(8.0, 15.0, 24.0, 33.0, 40.0), sides=1,
             read=TURNING),
        runs("payload 12 kg", "travel with 12 kg at 0, 10 and 20 deg, at 15 and 33 V; read all three channels",
             voltages=(15.0, 33.0), slopes=(0.0, 10.0, 20.0), payloads=(12.0,)),
        runs("other voltages", "travel at 8, 19, 28 and, for a short while, 40 V, on the level and at 15 deg; read "
             "all three channels", voltages=(8.0, 19.0, 28.0, 40.0), slopes=(0.0, 15.0)),
        runs("steepest slope", "travel up 23 deg at 15, 24 and 33 V; read all three channels",
             voltages=(15.0, 24.0, 33.0), slopes=(23.0,)),
        runs("crawl", "travel on the level at 2, 3 and 4 V; read all three channels", voltages=(2.0, 3.0, 4.0)),
    )  # fmt: skip


_STALLING: dict[str, Any] = {"voltages": (1.0, 2.0), "read": STANDING}


@functools.cache
def menu(configurations: tuple[str, ...]) -> tuple[Experiment, ...]:
    """What can be done with a robot that has these configurations, in the order of the effort, the least first."""
    return (
        *acts(configurations),
        _runs("bare motor", "uncouple the gearboxes and run the motors alone at 6, 12, 24, 33 and 40 V; read current "
              "and motor speed", bare, voltages=(6.0, 12.0, 24.0, 33.0, 40.0), read=TURNING),
        _runs("stall", "hold both motor shafts in a vice and switch on 1 and 2 V for a moment; read the current",
              blocked, **_STALLING),
        _runs("stall, one motor",
              "hold one motor's shaft in a vice, the other motor disconnected, and switch on 1 and 2 V for a "
              "moment; read the current", blocked, sides=1, **_STALLING),
        _runs("braked motor", "uncouple the gearboxes and put a brake of 60 mN·m on each motor shaft, at 12, 24 and "
              "33 V; read current and motor speed", braked, voltages=(12.0, 24.0, 33.0), read=TURNING),
        *(r for k, name in enumerate(configurations) for r in _travels(name, k)),
    )  # fmt: skip


# --- what a robot shows -----------------------------------------------------------------------------


def size(experiment: Experiment) -> int:
    """How many readings an experiment has, repeats averaged."""
    if isinstance(experiment, Act):
        return len(experiment.sd)
    return len(experiment.voltage) * len(experiment.read)


def spans(experiments: Sequence[Experiment]) -> dict[str, slice]:
    """Where the readings of each experiment stand in those of all."""
    ends = np.cumsum([size(e) for e in experiments]).tolist()
    return {e.name: slice(end - size(e), end) for e, end in zip(experiments, ends, strict=True)}


def sds(experiments: Sequence[Experiment], of_channels: np.ndarray) -> np.ndarray:
    """Sd of every reading [SI], repeats averaged; runs are read with the instruments of the table.

    Args:
        of_channels: sds of its channels [SI], shape (channels,).
    """
    found = []
    for e in experiments:
        one = (
            np.asarray(e.sd) if isinstance(e, Act) else np.tile(np.asarray(of_channels)[list(e.read)], len(e.voltage))
        )
        found.append(np.asarray(one) / math.sqrt(e.repeats))
    return np.concatenate(found)


def _conditions(run: Run) -> Conditions:
    weightless = run.setup in (lifted, bare, blocked, braked)
    # None would take the robot's own mass, which a batch with the others cannot.
    mass = UNLOADED if weightless else math.nan
    return Conditions(run.configuration, run.voltage, run.slope, run.payload, total_mass=mass)


def readings(robot: Robot) -> tuple[Float[Array, " readings"], Bool[Array, " readings"]]:
    """What the robot shows in every experiment of its menu [SI], and which of it exists: a robot that slides or
    stands still where it should travel shows nothing."""
    experiments = menu(robot.configurations.names)
    shown: dict[str, tuple[Array, Array]] = {}
    for act in (e for e in experiments if isinstance(e, Act)):
        value = act.reading(robot)
        shown[act.name] = value, jnp.ones(value.shape, bool)
    shown |= _run(robot, [e for e in experiments if isinstance(e, Run)])
    values, theres = zip(*(shown[e.name] for e in experiments), strict=True)
    return jnp.concatenate(values), jnp.concatenate(theres)


def _run(robot: Robot, runs: list[Run]) -> dict[str, tuple[Array, Array]]:
    """What the robot shows in runs, all in one batch."""
    conditions = jax.tree.map(lambda *x: jnp.concatenate(x), *(_conditions(r) for r in runs))
    own = jax.vmap(lambda k: robot.chassis(k).mass)(conditions.configuration) + conditions.payload
    stated = jnp.asarray(conditions.total_mass)
    conditions = dataclasses.replace(conditions, total_mass=jnp.where(jnp.isnan(stated), own, stated))
    setups = list(dict.fromkeys((r.setup, r.sides) for r in runs))
    which = np.concatenate([np.full(len(r.voltage), setups.index((r.setup, r.sides))) for r in runs])
    set_up = [
        dataclasses.replace(setup(robot), sides=robot.sides if sides is None else sides) for setup, sides in setups
    ]
    robots = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x])[which], *set_up)
    result = jax.vmap(lambda r, c: operating_point(r, c)[0])(robots, conditions)
    every = jnp.stack([result.reading[c] for c in channels.names()], -1)
    held = np.array([setup is blocked for setup, _ in setups])[which]
    exists = result.status == jnp.where(jnp.asarray(held), STALLED, CONVERGED)
    shown, first = {}, 0
    for r in runs:
        rows = slice(first, first := first + len(r.voltage))
        value = every[rows][:, list(r.read)]
        shown[r.name] = value.ravel(), jnp.broadcast_to(exists[rows, None], value.shape).ravel()
    return shown
