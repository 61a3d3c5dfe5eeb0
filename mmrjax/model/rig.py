"""Rig: what is imposed on a robot's drives, and what its instruments show."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.model import channels
from mmrjax.model.params import Index, Scalar, parameter

#: How histories may begin.
STARTS = ("rest", "measured", "free")
#: What may be imposed: the voltage of supply or battery (times the duty), the speed of the motors' shafts, or the
#: current of each motor by an amplifier, whatever voltage these take.
IMPOSED = ("voltage", "motor_speed", "motor_current")
#: What is imposed between the rows of a history: as at the row before, or on a straight line to the next.
BETWEEN = ("held", "linear")


def on_line(first: Array, second: Array, share: Array) -> Array:
    """Values a share of the way from first ones to second ones, shape (*share.shape, ...).

    An instant itself takes nothing of the one after it, which may be no number.
    """
    share = jnp.reshape(share, (*jnp.shape(share), *[1] * (first.ndim - jnp.ndim(share))))
    return first + share * (jnp.where((share < 1e-9) & jnp.isnan(second), first, second) - first)


@dataclasses.dataclass(frozen=True)
class Instrument:
    """What is known of the instrument of a channel.

    Attributes:
        channel: its name.
        signed: whether it shows the sign; False: the magnitude alone; None: its table tells.
        quantum: step of its readings [SI]; 0: none; None: its table tells.
    """

    channel: str
    signed: bool | None = True
    quantum: float | None = 0.0

    @property
    def free(self) -> bool:
        """Whether its table has to tell something of it."""
        return self.signed is None or self.quantum is None

    def shows(self, value: Scalar) -> Scalar:
        """What it shows of a value [SI]; its step is noise, see `variance`."""
        return jnp.abs(value) if self.signed is False else value

    @property
    def variance(self) -> float:
        """Of the error by its step, Δ²/12 [SI²] (Bennett, Spectra of quantized signals, 1948); 0 where it is free."""
        return (self.quantum or 0.0) ** 2 / 12


class Begin(eqx.Module):
    """How a run begins that does not begin at rest: its shafts turn, and its load rolls with them."""

    motor_speed: Scalar = parameter(
        0.0,
        unit="rad/s",
        meaning="speed of the motor shafts at the first sample",
        bounds=(-1e5, 1e5),
        sd=10.0,
        source="the first samples of the run",
    )
    angle: Scalar = parameter(
        0.0,
        unit="rad",
        meaning="angle of the output at the first sample",
        bounds=(-1e5, 1e5),
        sd=0.1,
        source="the first samples of the run",
    )


class Begins(eqx.Module):
    """The beginnings of runs by their names, in a fixed order; conditions hold the index of one."""

    names: tuple[str, ...] = eqx.field(static=True)
    members: tuple[Begin, ...]

    def __init__(self, by_name: Mapping[str, Begin]) -> None:
        self.names, self.members = tuple(by_name), tuple(by_name.values())

    def items(self) -> Iterator[tuple[str, Begin]]:
        """Names with their beginnings, in order."""
        return zip(self.names, self.members, strict=True)

    def of(self, index: Index) -> Begin:
        """That of a run by its index; traceable."""
        stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v, float) for v in x]), *self.members)
        return jax.tree.map(lambda x: x[jnp.asarray(index)], stacked)


class Rig(eqx.Module):
    """How a robot is driven and measured.

    Attributes:
        imposed: one of `IMPOSED`.
        channels: names of those that its instruments show, see `channels.EVERY`.
        instruments: of channels, where more is known than that they are there.
        delay: by which what is imposed acts later than its column says [s].
        columns: of tables: (column as this program calls it, column of the file, factor from its unit).
        priors: (parameter, mean, sd) [SI] that the file states, in place of the parameters' own; of sd 0 it is exact.
        start: of histories: `rest`, `measured` (by the first samples) or `free`, which those are the prior of.
        begins: of histories that do not begin at rest, once their table is known.
        between_rows: of histories, one of `BETWEEN`; an imposed speed is on straight lines in any case.
        surfaces: (configuration, another from which it differs by its ground alone).
        inherits: whether what its file leaves open is a packaged robot's; if not, nothing in it is another robot's.
        unknown: parameters that nobody stated and for which nothing stands: what their fields hold is a packaged
            robot's, so that equations have numbers, and what rests on it is not known (`Robot.knows`).
        loose: whether the load on the shaft has backlash, which histories then follow as a state.
    """

    delay: Scalar = parameter(
        0.0,
        unit="s",
        meaning="delay by which what is imposed acts later than its column says",
        bounds=(-10.0, 10.0),
        sd=0.02,
        source="stated by whoever owns the rig",
        scanned=0.0,
    )
    begins: Begins | None = None
    imposed: str = eqx.field(default=IMPOSED[0], static=True)
    channels: tuple[str, ...] = eqx.field(default=channels.USUAL, static=True)
    instruments: tuple[Instrument, ...] = eqx.field(default=(), static=True)
    columns: tuple[tuple[str, str, float], ...] = eqx.field(default=(), static=True)
    priors: tuple[tuple[str, float, float], ...] = eqx.field(default=(), static=True)
    start: str = eqx.field(default="rest", static=True)
    between_rows: str = eqx.field(default=BETWEEN[0], static=True)
    surfaces: tuple[tuple[str, str], ...] = eqx.field(default=(), static=True)
    inherits: bool = eqx.field(default=True, static=True)
    unknown: tuple[str, ...] = eqx.field(default=(), static=True)
    loose: bool = eqx.field(default=False, static=True)

    def for_equations(self) -> Rig:
        """Without what only files, priors and reports read."""
        usual = self.start == STARTS[0] and self.between_rows == BETWEEN[0]
        if usual and not (self.instruments or self.columns or self.priors or self.surfaces):
            return self
        rectified = tuple(Instrument(i.channel, signed=False) for i in self.instruments if i.signed is False)
        return dataclasses.replace(
            self, instruments=rectified, columns=(), priors=(), start=STARTS[0], between_rows=BETWEEN[0], surfaces=()
        )

    def before(self, times: Float[Array, " times"], at: Scalar | Float[Array, "..."]) -> tuple[Array, Array]:
        """Which of `times` is the last before what happens at instants, and how far on the way to the next one that
        is [-], held before the first and after the last; what is imposed acts `delay` later than its column says.

        Args:
            times: since what is imposed acts [s], increasing; at: instants of the tables' clock [s], of any shape.
        """
        wanted = at - self.delay
        k = jnp.clip(jnp.searchsorted(times, wanted, side="right") - 1, 0, times.shape[0] - 2)
        gap = times[k + 1] - times[k]
        return k, jnp.clip(jnp.where(gap > 0, (wanted - times[k]) / jnp.where(gap > 0, gap, 1.0), 0.0), 0.0, 1.0)

    @staticmethod
    def between(values: Array, k: Array, share: Array) -> Array:
        """Values, shape (times, ...), where `before` says, of its shape first: on the straight line between the
        instants about it, of what has no values between its own those before."""
        if not jnp.issubdtype(values.dtype, jnp.inexact):
            return values[k]
        return on_line(values[k], values[k + 1], share)

    def clock(self, times: Float[Array, " times"]) -> Array:
        """Instants of the tables' clock [s] at which a run is shown that is known at `times` since what is imposed
        acts: `delay` later, from 0 on; the rest before the run begins at 0. The same where the delay is traced."""
        if isinstance(self.delay, jax.core.Tracer):
            return times
        return jnp.where(times <= 0, jnp.minimum(times, 0.0), jnp.maximum(times + self.delay, 0.0))

    @property
    def prompt(self) -> bool:
        """Whether it is known that what is imposed acts when its column says."""
        return not isinstance(self.delay, jax.core.Tracer) and not np.any(np.asarray(self.delay) != 0)

    @property
    def turns(self) -> bool:
        """Whether an instrument shows what a robot does that turns."""
        return not {c.name for c in channels.OF_TURNS}.isdisjoint(self.channels)

    @property
    def stated(self) -> frozenset[str]:
        """Parameters of which the file says how sure it is."""
        return frozenset(name for name, _, _ in self.priors)

    @property
    def exact(self) -> frozenset[str]:
        """Parameters that the file states as exactly known; no fit frees them."""
        return frozenset(name for name, _, sd in self.priors if sd == 0)

    @property
    def scales_adhesion(self) -> bool:
        """Whether labels of Table 5 scale its adhesion to the bench's; else each surface is a ground of its own."""
        return self.inherits

    @property
    def shows_voltage(self) -> bool:
        """Whether the motors' voltage is imposed or read."""
        return self.imposed == "voltage" or "motor_voltage" in self.channels

    @property
    def magnitudes(self) -> frozenset[str]:
        """Channels whose instruments show the magnitude alone."""
        return frozenset(i.channel for i in self.instruments if i.signed is False)

    def instrument(self, channel: str) -> Instrument:
        """That of a channel."""
        return next((i for i in self.instruments if i.channel == channel), Instrument(channel))
