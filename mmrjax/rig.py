"""Rig: what is imposed on a robot's drives, and what its instruments show."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax.numpy as jnp

from mmrjax import channels
from mmrjax.params import Scalar, parameter

#: What may be imposed: the voltage of supply or battery (times the duty), or the speed of the motors' shafts.
IMPOSED = ("voltage", "motor_speed")


@dataclasses.dataclass(frozen=True)
class Instrument:
    """What is known of the instrument of a channel.

    Attributes:
        channel: its name.
        signed: whether it shows the sign; else the magnitude alone.
        quantum: step of its readings [SI]; 0: none.
    """

    channel: str
    signed: bool = True
    quantum: float = 0.0

    def shows(self, value: Scalar) -> Scalar:
        """What it shows of a value [SI]; its step is noise, see `variance`."""
        return value if self.signed else jnp.abs(value)

    @property
    def variance(self) -> float:
        """Of the error by its step, Δ²/12 [SI²] (Bennett, Spectra of quantized signals, 1948)."""
        return self.quantum**2 / 12


class Rig(eqx.Module):
    """How a robot is driven and measured.

    Attributes:
        imposed: one of `IMPOSED`.
        channels: names of those that its instruments show, see `channels.EVERY`.
        instruments: of channels, where more is known than that they are there.
        delay: by which what is imposed acts later than its column says [s].
        columns: of tables: (column as this program calls it, column of the file, factor from its unit).
        priors: (parameter, mean, sd) [SI] that the file states, in place of the parameters' own.
        start: of histories: `rest`, `measured` (by the first samples) or `free`.
        surfaces: (configuration, another from which it differs by its ground alone).
        blank: whether it starts from nothing, so that nothing in it is another robot's.
    """

    delay: Scalar = parameter(
        0.0,
        unit="s",
        meaning="delay by which what is imposed acts later than its column says",
        bounds=(-10.0, 10.0),
        sd=0.02,
        source="stated by whoever owns the rig",
    )
    imposed: str = eqx.field(default=IMPOSED[0], static=True)
    channels: tuple[str, ...] = eqx.field(default=channels.USUAL, static=True)
    instruments: tuple[Instrument, ...] = eqx.field(default=(), static=True)
    columns: tuple[tuple[str, str, float], ...] = eqx.field(default=(), static=True)
    priors: tuple[tuple[str, float, float], ...] = eqx.field(default=(), static=True)
    start: str = eqx.field(default="rest", static=True)
    surfaces: tuple[tuple[str, str], ...] = eqx.field(default=(), static=True)
    blank: bool = eqx.field(default=False, static=True)

    def instrument(self, channel: str) -> Instrument:
        """That of a channel."""
        return next((i for i in self.instruments if i.channel == channel), Instrument(channel))
