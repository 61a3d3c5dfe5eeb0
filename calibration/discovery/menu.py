"""The menu of experiments: what to do, what to read, and what any robot would show."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from calibration.data.runs import CHANNELS, RPM
from mmrjax import balances, params
from mmrjax.conditions import Conditions
from mmrjax.fidelities.steady import operating_point
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.signals import CONVERGED, STALLED, Signals, State
from mmrjax.tables import CONFIGURATIONS

CURRENT, MOTOR_SPEED, SPEED = range(len(CHANNELS))
#: Mass of a robot whose weight is carried by stands [kg]: none, but for the sake of ratios to its load.
UNLOADED = 1e-9
#: Friction of a shaft that is held in a vice, and of a brake on it [N·m].
BLOCKED, BRAKE = 1e3, 0.06


# --- how the robot is set up ------------------------------------------------------------------------


def _with(robot: Robot, values: dict[str, Scalar | float]) -> Robot:
    return params.replace(robot, {k: jnp.asarray(v, float) for k, v in values.items()})  # type: ignore[return-value]


def without(robot: Robot, *closed: str) -> Robot:
    """The robot without the effects that enter the balances `closed`."""
    return _with(robot, {f"effects.{e.name}.amplitude": 0.0 for e in robot.effects if e.balance in closed})


def on_ground(robot: Robot) -> Robot:
    """The robot as it is."""
    return robot


def reversed_(robot: Robot) -> Robot:
    """The robot turned about, so that its travel is forward again.

    With the negative of the slope in the command, friction, slip and what meters show stay as they are: they
    follow the travel. A slope that is steeper than stated stays so, and now drives: `slope_bias` flips.
    """
    biased = {f"effects.{e.name}.amplitude": -e.amplitude for e in robot.effects if e.name == "slope_bias"}
    return _with(robot, biased)


def lifted(robot: Robot) -> Robot:
    """The robot on stands, its movers in the air: no normal load, no ground."""
    rolling = {f"{c}.ground.rolling_resistance": 0.0 for c in ("tracked", "wheeled")}
    return _with(without(robot, "mass", "ground", "slip"), rolling)


def bare(robot: Robot) -> Robot:
    """The motors with their gearboxes uncoupled: of the balances, supply, electrical and motor are left."""
    losses = {f"{c}.track.loss_{kind}": 0.0 for c in ("tracked", "wheeled") for kind in ("coulomb", "viscous")}
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
        voltage [V], slope [deg], payload [kg], wheeled: conditions of each run, shape (runs,).
        channels: indices into `CHANNELS` of what is read.
        sides: motors that are switched on.
        repeats: readings that are averaged.
    """

    name: str
    description: str
    setup: Callable[[Robot], Robot]
    voltage: tuple[float, ...]
    slope: tuple[float, ...]
    payload: tuple[float, ...]
    wheeled: float
    channels: tuple[int, ...] = (CURRENT, MOTOR_SPEED, SPEED)
    sides: int = 2
    repeats: int = 3


Experiment = Act | Run


def _show(robot: Robot, **signals: float) -> Reading:
    """What the instruments show of signals that are known otherwise."""
    return balances.sensor(robot, Signals(**{k: jnp.asarray(v) for k, v in signals.items()}))


def _weighed(robot: Robot) -> Array:
    """Mass beyond the stated one, so that it does not matter how that was come by."""
    still = State(*(jnp.zeros(()),) * 4)
    loads = [Conditions(payload=m, configuration=w) for w in (0.0, 1.0) for m in (0.0, 8.0)]
    stated = without(robot, "mass")
    return jnp.stack([balances.begin(robot, c, still).mass - balances.begin(stated, c, still).mass for c in loads])


def _shunted(*currents: float) -> Callable[[Robot], Array]:
    return lambda robot: jnp.stack([_show(robot, total_current=i).total_current for i in currents])


def _strobed(robot: Robot) -> Array:
    return jnp.stack([_show(robot, speed_motor=w).motor_speed for w in (300.0, 800.0)])


def _timed(robot: Robot) -> Array:
    return jnp.stack([_show(robot, speed=v).speed for v in (0.4, 0.9)])


ACTS = (
    Act(
        "weigh",
        "Weigh the robot in both configurations, unladen and with the payload of 8 kg, on scales that are good to "
        "20 g; read the total mass, and take the stated one from it",
        _weighed,
        (0.02,) * 4,
        repeats=1,
    ),
    Act("zero current", "Switch the motors off; read the ammeter", _shunted(0.0), (0.02,)),
    Act(
        "shunt",
        "Put a precision shunt and a load in the place of the robot, set 1 A and 5 A by the shunt; read the ammeter",
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
        "Time the robot by light gates over a distance measured with a tape, at 0.4 and 0.9 m/s; read the speed that "
        "the bench shows",
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
    wheeled: float = 0.0,
    **rest: object,
) -> Run:
    each = zip(*itertools.product(slopes, payloads, voltages), strict=True)
    slope, payload, voltage = (tuple(x) for x in each)
    return Run(name, description, setup, voltage, slope, payload, wheeled, **rest)  # type: ignore[arg-type]


def _travels(configuration: str, wheeled: float) -> tuple[Run, ...]:
    """Runs that are done with one configuration; where the table does not have it, it is the other one."""

    def runs(name: str, description: str, *args: Callable[[Robot], Robot], **rest: object) -> Run:
        text = f"{configuration}: {description}"
        return _runs(f"{name}, {configuration}", text, *args, wheeled=wheeled, **rest)  # type: ignore[arg-type]

    air = {"channels": (CURRENT, MOTOR_SPEED)}
    return (
        runs("reverse", "travel backwards, on the level and down the same slope of 10 deg, at 15 and 33 V; read all "
             "three channels", reversed_, voltages=(15.0, 33.0), slopes=(0.0, -10.0)),
        runs("downhill", "turn the slope to -5 and -10 deg by the same inclinometer and travel forwards at 15 and "
             "33 V; read all three channels", voltages=(15.0, 33.0), slopes=(-5.0, -10.0)),
        runs("lifted", "put it on stands, the movers in the air, and run at 8, 15, 24, 33 and 40 V; read current and "
             "motor speed", lifted, voltages=(8.0, 15.0, 24.0, 33.0, 40.0), **air),
        runs("one motor", "put it on stands, one motor disconnected, and run at 8, 15, 24, 33 and 40 V; read the "
             "supply's current and the motor speed", lifted, voltages=(8.0, 15.0, 24.0, 33.0, 40.0), sides=1, **air),
        runs("payload 12 kg", "travel with 12 kg at 0, 10 and 20 deg, at 15 and 33 V; read all three channels",
             voltages=(15.0, 33.0), slopes=(0.0, 10.0, 20.0), payloads=(12.0,)),
        runs("other voltages", "travel at 8, 19, 28 and, for a short while, 40 V, on the level and at 15 deg; read "
             "all three channels", voltages=(8.0, 19.0, 28.0, 40.0), slopes=(0.0, 15.0)),
        runs("steepest slope", "travel up 23 deg at 15, 24 and 33 V; read all three channels",
             voltages=(15.0, 24.0, 33.0), slopes=(23.0,)),
        runs("crawl", "travel on the level at 2, 3 and 4 V; read all three channels", voltages=(2.0, 3.0, 4.0)),
    )  # fmt: skip


_STALL = {"voltages": (1.0, 2.0), "channels": (CURRENT,)}
#: In the order of the effort, the least first.
MENU: tuple[Experiment, ...] = (
    *ACTS,
    _runs("bare motor", "uncouple the gearboxes and run the motors alone at 6, 12, 24, 33 and 40 V; read current and "
          "motor speed", bare, voltages=(6.0, 12.0, 24.0, 33.0, 40.0), channels=(CURRENT, MOTOR_SPEED)),
    _runs("stall", "hold both motor shafts in a vice and switch on 1 and 2 V for a moment; read the current",
          blocked, **_STALL),  # type: ignore[arg-type]
    _runs("stall, one motor",
          "hold one motor's shaft in a vice, the other motor disconnected, and switch on 1 and 2 V for a "
          "moment; read the current", blocked, sides=1, **_STALL),  # type: ignore[arg-type]
    _runs("braked motor", "uncouple the gearboxes and put a brake of 60 mN·m on each motor shaft, at 12, 24 and "
          "33 V; read current and motor speed", braked, voltages=(12.0, 24.0, 33.0), channels=(CURRENT, MOTOR_SPEED)),
    *(r for w, c in enumerate(CONFIGURATIONS) for r in _travels(c, float(w))),
)  # fmt: skip


# --- what a robot shows -----------------------------------------------------------------------------


def size(experiment: Experiment) -> int:
    """How many readings an experiment has, repeats averaged."""
    if isinstance(experiment, Act):
        return len(experiment.sd)
    return len(experiment.voltage) * len(experiment.channels)


def spans() -> dict[str, slice]:
    """Where the readings of each experiment stand in those of the whole menu."""
    ends = np.cumsum([size(e) for e in MENU]).tolist()
    return {e.name: slice(end - size(e), end) for e, end in zip(MENU, ends, strict=True)}


def sds(of_channels: Float[Array, " 3"] | np.ndarray) -> np.ndarray:
    """Sd of every reading of the menu [SI], repeats averaged; runs are read with the instruments of the table."""
    found = []
    for e in MENU:
        one = (
            np.asarray(e.sd)
            if isinstance(e, Act)
            else np.tile(np.asarray(of_channels)[list(e.channels)], len(e.voltage))
        )
        found.append(np.asarray(one) / math.sqrt(e.repeats))
    return np.concatenate(found)


def _command(run: Run) -> Conditions:
    weightless = run.setup in (lifted, bare, blocked, braked)
    commanded = Conditions(run.voltage, np.radians(run.slope), run.payload, run.wheeled)
    shape = commanded.voltage.shape
    # None would take the robot's own mass, which a batch with the others cannot.
    return dataclasses.replace(
        commanded, total_mass=jnp.full(shape, UNLOADED) if weightless else jnp.full(shape, jnp.nan)
    )


def readings(robot: Robot) -> tuple[Float[Array, " readings"], Bool[Array, " readings"]]:
    """What the robot shows in every experiment of the menu [SI], and which of it exists: a robot that slides or
    stands still where it should travel shows nothing."""
    shown: dict[str, tuple[Array, Array]] = {}
    for act in ACTS:
        value = act.reading(robot)
        shown[act.name] = value, jnp.ones(value.shape, bool)
    runs = [e for e in MENU if isinstance(e, Run)]
    for sides in sorted({r.sides for r in runs}):
        shown |= _run(dataclasses.replace(robot, sides=sides), [r for r in runs if r.sides == sides])
    value, there = zip(*(shown[e.name] for e in MENU), strict=True)
    return jnp.concatenate(value), jnp.concatenate(there)


def _run(robot: Robot, runs: list[Run]) -> dict[str, tuple[Array, Array]]:
    """What the robot shows in runs with as many motors, all in one batch."""
    commands = jax.tree.map(lambda *x: jnp.concatenate(x), *(_command(r) for r in runs))
    own = jax.vmap(lambda w: robot.chassis(w).mass)(commands.wheeled) + commands.payload
    commands = dataclasses.replace(
        commands, total_mass=jnp.where(jnp.isnan(commands.total_mass), own, commands.total_mass)
    )
    setups = list(dict.fromkeys(r.setup for r in runs))
    which = np.concatenate([np.full(len(r.voltage), setups.index(r.setup)) for r in runs])
    robots = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x])[which], *(s(robot) for s in setups))
    result = jax.vmap(lambda r, c: operating_point(r, c)[0])(robots, commands)
    all_three = jnp.stack([getattr(result.reading, c) for c in CHANNELS], -1)
    held = np.array([s is blocked for s in setups])[which]
    exists = result.status == jnp.where(jnp.asarray(held), STALLED, CONVERGED)
    shown, first = {}, 0
    for r in runs:
        rows = slice(first, first := first + len(r.voltage))
        value = all_three[rows][:, list(r.channels)]
        shown[r.name] = value.ravel(), jnp.broadcast_to(exists[rows, None], value.shape).ravel()
    return shown
