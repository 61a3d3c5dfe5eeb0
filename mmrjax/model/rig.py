"""Rig: the inputs imposed on a robot's drives, and the instruments that measure the robot."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.model import channels
from mmrjax.model.params import Index, Scalar, Times, parameter
from mmrjax.model.quantities import GOALS, Names

#: Ways in which histories may begin.
STARTS = ("rest", "measured", "free")
#: Imposed quantity: the voltage of supply or battery (times the duty), the speed of the motor shafts, the current of
#: each motor from an amplifier, or the goal of a controller (`Robot.controller`).
IMPOSED = ("voltage", "motor_speed", "motor_current", *GOALS)
#: Imposed values between the rows of a history: those of the row before, or on a straight line to the next.
BETWEEN = ("held", "linear")


def interpolate(first: Array, second: Array, share: Array) -> Array:
    """Values at a share of the way from `first` to `second`, shape (*share.shape, ...).

    At a share of 0 the second value is ignored, because it may be NaN.
    """
    share = jnp.reshape(share, (*jnp.shape(share), *[1] * (first.ndim - jnp.ndim(share))))
    return first + share * (jnp.where((share < 1e-9) & jnp.isnan(second), first, second) - first)


@dataclasses.dataclass(frozen=True)
class Instrument:
    """Properties of the instrument of a channel.

    Attributes:
        channel: name of the channel.
        signed: True if it shows the sign, False if it shows the magnitude. None: to be found from its table.
        quantum: step of its readings [SI]. 0: none. None: to be found from its table.
    """

    channel: str
    signed: bool | None = True
    quantum: float | None = 0.0

    @property
    def free(self) -> bool:
        """True if a property has to be found from its table."""
        return self.signed is None or self.quantum is None

    def shows(self, value: Scalar) -> Scalar:
        """Reading for a value [SI]. The step counts as noise, see `variance`."""
        return jnp.abs(value) if self.signed is False else value

    @property
    def variance(self) -> float:
        """Error variance due to its step, Δ²/12 [SI²] (Bennett, Spectra of quantized signals, 1948), 0 if unknown."""
        return (self.quantum or 0.0) ** 2 / 12


class RunStart(eqx.Module):
    """Start of a run that does not begin at rest: its shafts turn, and its load rolls with them."""

    motor_speed: Scalar = parameter(
        0.0, "rad/s", "speed of the motor shafts at the first sample", (-1e5, 1e5), "the first samples of the run",
        sd=10.0,
    )  # fmt: skip
    angle: Scalar = parameter(
        0.0, "rad", "angle of the output at the first sample", (-1e5, 1e5), "the first samples of the run", sd=0.1
    )


class RunStarts(eqx.Module):
    """The beginnings of runs by name, in a fixed order. Conditions hold an index."""

    names: Names = eqx.field(static=True)
    members: tuple[RunStart, ...]

    def __init__(self, by_name: Mapping[str, RunStart]) -> None:
        self.names, self.members = tuple(by_name), tuple(by_name.values())

    def items(self) -> Iterator[tuple[str, RunStart]]:
        """Names and beginnings, in order."""
        return zip(self.names, self.members, strict=True)

    def of(self, index: Index) -> RunStart:
        """The beginning with this index, traceable."""
        stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v, float) for v in x]), *self.members)
        return jax.tree.map(lambda x: x[jnp.asarray(index)], stacked)


class Rig(eqx.Module):
    """Drive and measurement of a robot.

    Attributes:
        imposed: one of `IMPOSED`.
        channels: names of the channels that its instruments show, see `channels.EVERY`.
        instruments: known properties of the instruments of some channels.
        delay: dead time between a value in the column and its action [s].
        columns: columns of tables: (column name in this program, column name in the file, factor from its unit).
        priors: (parameter, mean, sd) [SI] stated in the file, which replace the parameters' own. Sd 0: exactly known.
        start: start of histories: `rest`, `measured` (by the first samples) or `free` (the same as prior means).
        begins: initial states of histories that do not begin at rest, once their table is known.
        between_rows: course of the imposed quantity between rows of histories, one of `BETWEEN`. An imposed speed
            is always interpolated linearly.
        surfaces: (configuration, another configuration that differs only by its ground).
        inherits: True if a packaged robot supplies what the file leaves open. False: nothing comes from another.
        unknown: parameters that nobody stated and that have no substitute. Their fields hold a packaged robot's value
            to keep the equations computable. Results that depend on them are not known (`Robot.knows`).
        loose: True if the load turns apart from the motor, by a backlash or an elastic joint. Histories follow their
            difference as a state.
    """

    delay: Scalar = parameter(
        0.0, "s", "dead time of the imposed quantity", (-10.0, 10.0),
        "stated by the owner of the rig", sd=0.02, scanned=0.0,
    )  # fmt: skip
    begins: RunStarts | None = None
    imposed: str = eqx.field(default=IMPOSED[0], static=True)
    channels: Names = eqx.field(default=channels.USUAL, static=True)
    instruments: tuple[Instrument, ...] = eqx.field(default=(), static=True)
    columns: tuple[tuple[str, str, float], ...] = eqx.field(default=(), static=True)
    priors: tuple[tuple[str, float, float], ...] = eqx.field(default=(), static=True)
    start: str = eqx.field(default="rest", static=True)
    between_rows: str = eqx.field(default=BETWEEN[0], static=True)
    surfaces: tuple[tuple[str, str], ...] = eqx.field(default=(), static=True)
    inherits: bool = eqx.field(default=True, static=True)
    unknown: Names = eqx.field(default=(), static=True)
    loose: bool = eqx.field(default=False, static=True)

    def for_equations(self) -> Rig:
        """Same rig without the fields that only files, priors and reports read."""
        is_usual = self.start == STARTS[0] and self.between_rows == BETWEEN[0]
        if is_usual and not (self.instruments or self.columns or self.priors or self.surfaces):
            return self
        rectified = tuple(Instrument(i.channel, signed=False) for i in self.instruments if i.signed is False)
        return replace(
            self, instruments=rectified, columns=(), priors=(), start=STARTS[0], between_rows=BETWEEN[0], surfaces=()
        )

    def before(self, times: Times, instants: Scalar | Float[Array, "..."]) -> tuple[Array, Array]:
        """Index of the last of `times` before each instant, and the share of the way to the next one [-].

        Both are held before the first and after the last. The imposed quantity acts `delay` later than its column
        states.

        Args:
            times: times since the imposed quantity acts [s], increasing.
            instants: instants of the tables' clock [s], any shape.
        """
        acting_instants = instants - self.delay
        k = jnp.clip(jnp.searchsorted(times, acting_instants, side="right") - 1, 0, times.shape[0] - 2)
        interval = times[k + 1] - times[k]
        return k, jnp.clip(
            jnp.where(interval > 0, (acting_instants - times[k]) / jnp.where(interval > 0, interval, 1.0), 0.0),
            0.0,
            1.0,
        )

    @staticmethod
    def between(values: Array, k: Array, share: Array) -> Array:
        """Values, shape (times, ...), at the index and share that `before` returns, with their shape in front.

        Linear between neighbouring instants. A quantity without values between rows keeps that of the row before.
        """
        if not jnp.issubdtype(values.dtype, jnp.inexact):
            return values[k]
        return interpolate(values[k], values[k + 1], share)

    def clock(self, times: Times) -> Array:
        """Instants of the tables' clock [s] for a run known at `times` since the imposed quantity acts.

        They are `delay` later and start at 0, with rest before the run. If the delay is traced, `times` are returned.
        """
        if isinstance(self.delay, jax.core.Tracer):
            return times
        return jnp.where(times <= 0, jnp.minimum(times, 0.0), jnp.maximum(times + self.delay, 0.0))

    @property
    def prompt(self) -> bool:
        """True if the imposed quantity is known to act when its column states."""
        return not isinstance(self.delay, jax.core.Tracer) and not np.any(np.asarray(self.delay) != 0)

    @property
    def turns(self) -> bool:
        """True if an instrument shows the motion of a robot that turns."""
        return not {c.name for c in channels.OF_TURNS}.isdisjoint(self.channels)

    @property
    def stated(self) -> frozenset[str]:
        """Parameters whose uncertainty the file states."""
        return frozenset(name for name, _, _ in self.priors)

    @property
    def exact(self) -> frozenset[str]:
        """Parameters that the file states as exactly known. No fit changes them."""
        return frozenset(name for name, _, sd in self.priors if sd == 0)

    @property
    def scales_adhesion(self) -> bool:
        """True if labels of Table 5 scale its adhesion to the bench's, else each surface is a ground of its own."""
        return self.inherits

    @property
    def follows_goal(self) -> bool:
        """True if a controller drives the motors towards an imposed goal."""
        return self.imposed in GOALS

    @property
    def shows_voltage(self) -> bool:
        """True if the motor voltage is imposed or measured. A controller gives it."""
        return self.imposed == "voltage" or self.follows_goal or "motor_voltage" in self.channels

    @property
    def magnitudes(self) -> frozenset[str]:
        """Channels whose instruments show only the magnitude."""
        return frozenset(i.channel for i in self.instruments if i.signed is False)

    def instrument(self, channel: str) -> Instrument:
        """The instrument of a channel."""
        return next((i for i in self.instruments if i.channel == channel), Instrument(channel))
