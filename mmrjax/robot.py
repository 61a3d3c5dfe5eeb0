"""The robot: its components and its effects, one pytree."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from mmrjax.chassis import Chassis
from mmrjax.effects import Effect
from mmrjax.gearbox import Gearbox
from mmrjax.motor import Motor
from mmrjax.params import Scalar
from mmrjax.power import Battery
from mmrjax.tables import CONFIGURATIONS

__all__ = ["CONFIGURATIONS", "Robot"]


class Robot(eqx.Module):
    """Battery, one motor and gearbox per side, a chassis for each configuration, and effects.

    Attributes:
        effects: terms beyond the paper's model; the empty tuple is the paper's model.
        sides: tractive drives; all per-side quantities are alike (assumption 3).
    """

    battery: Battery
    motor: Motor
    gearbox: Gearbox
    tracked: Chassis
    wheeled: Chassis
    effects: tuple[Effect, ...] = ()
    sides: int = eqx.field(default=2, static=True)

    def chassis(self, wheeled: Scalar) -> Chassis:
        """The chassis in use: `tracked` where `wheeled` is 0, else `wheeled`; traceable and batchable."""
        return jax.tree.map(lambda t, w: jnp.where(wheeled > 0.5, w, t), self.tracked, self.wheeled)

    @property
    def remembering(self) -> tuple[Effect, ...]:
        """Its effects whose term depends on the past of the run, in order."""
        return tuple(effect for effect in self.effects if effect.memory_size is not None)
