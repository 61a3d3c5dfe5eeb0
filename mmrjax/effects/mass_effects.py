"""Effects on the mass [kg] of robot and load, and on the inertia [kg·m²] at the driving wheel, eq. (31)."""

from __future__ import annotations

import jax.numpy as jnp

from mmrjax.effects.base import Effect, amplitude
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class MassEffect(Effect):
    """Difference of the true mass from the stated one [kg]."""

    balance = "mass"


class MassError(MassEffect):
    """ΔM = a M: the stated mass, payload included, times 1 + a.

    The true mass of robot and load differs from the stated mass by a constant percentage.

    Source: calibration error of the scales (OIML R 76 class IIII: a few tenths of a percent; a spring
    balance: percents). Weight, adhesion, guide load and inertia all follow from the mass, so it enters only
    there.
    """

    amplitude: Scalar = amplitude(
        "-", "relative error of the stated mass", (-0.3, 0.3), "spring balance, cables and mud: a few percent",
        sd=0.03,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.mass


class MassOffset(MassEffect):
    """M = stated mass + a in the wheeled configuration, and the stated mass in the tracked one.

    One configuration has additional mass. `configurations` may name others.

    Source: Table A2 prints 13.1 kg for the wheeled robot, Table 7 states 11.5 kg. Weight, adhesion,
    guide load and inertia all follow from the mass, so it enters only there.
    """

    driver = "configuration"
    movers = "wheels"

    amplitude: Scalar = amplitude(
        "kg", "mass of the wheeled robot beyond the stated mass", (-5.0, 5.0),
        "flippers weigh 4 x (470 + 25) g, wheels 4 x 86 g (Table 7)", sd=1.0,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.payload)


class RotatingInertia(Effect):
    """ΔJ_w = a in eq. (31), for one side.

    Parts that Table 7 does not list turn with the driving wheel.

    Source: Table 7 lists pulleys, wheels and belts. Teeth, grousers, shafts and the belt stage of the drive
    are not included. It has no influence on steady travel.
    """

    balance = "inertia"
    transient = True

    amplitude: Scalar = amplitude(
        "kg·m^2", "inertia of one side at the driving wheel beyond J_w", (-5e-4, 2e-2),
        "as much again as Table 7's pulleys", sd=5e-4,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.speed_motor)
