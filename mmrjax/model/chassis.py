"""Chassis of one configuration: masses, inertias, mass factor, eqs. (1)-(4), (31)."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx

from mmrjax.model.contact import Ground, Track, force_gravity
from mmrjax.model.params import Scalar, as_float, parameter
from mmrjax.model.signals import GRAVITY
from mmrjax.numerics.elementary import cosine
from mmrjax.turning.two_sides import Turning


class Chassis(eqx.Module):
    """The running gear and mass of one configuration.

    Attributes:
        on_tracks: 1 on tracks, 0 on wheels [-].
        turning: parameters of the chassis that matter only in turns.
        lacks: balances that it does not have.
        torque_constant, torque_gravity: torque constant and gravity torque of a `Shaft`, 0 here.
        has_two_bodies: False, motor and wheel turn together.
    """

    lacks: ClassVar[frozenset[str]] = frozenset()
    torque_constant: ClassVar[float] = 0.0
    torque_gravity: ClassVar[float] = 0.0
    has_two_bodies: ClassVar[bool] = False
    track: Track
    ground: Ground
    on_tracks: Scalar = eqx.field(converter=as_float)
    mass: Scalar = parameter(
        None, "kg", "mass of the robot without payload", (0.01, 1e4),
        "Table 7 (Table A2 prints 13.1 for 4W2T; see paper-notes)", relative_sd=0.02,
    )  # fmt: skip
    radius: Scalar = parameter(
        None, "m", "rolling radius of driving pulley or wheel r_k", (1e-3, 2.0),
        "48 teeth of 5 mm (6T2A); D_w/2, Table 6 (4W2T)",
        relative_sd=0.005,
    )  # fmt: skip
    inertia: Scalar = parameter(
        None, "kg·m^2", "inertia J_w of one side's parts that turn with the driving wheel, eq. (31)", (0.0, 100.0),
        "Table 7: pulleys, wheels, and the tracks' mass at r_k", relative_sd=0.1,
    )  # fmt: skip

    turning: Turning = eqx.field(default_factory=Turning, kw_only=True)

    @property
    def speed_still(self) -> Scalar:
        """Speed below which friction at rest is not resolved [m/s]."""
        return self.ground.friction.speed_rest

    @property
    def speed_grip(self) -> Scalar:
        """Sliding speed V_s below which the movers grip [m/s]."""
        return self.ground.friction.speed_static

    def torque_weight(self, mass: Scalar, slope: Scalar) -> Scalar:
        """Torque of gravity at rest against forward travel, at the driving wheel of one side [N·m]."""
        return force_gravity(mass, slope, GRAVITY) * self.radius


def inertia_reduced(inertia_motor: Scalar, ratio: Scalar, efficiency: Scalar, inertia_wheel: Scalar) -> Scalar:
    """Rotating masses of one side at the driving wheel J = J_d i² η + J_w [kg·m²], eq. (31)."""
    return inertia_motor * ratio**2 * efficiency + inertia_wheel


def normal_load(mass: Scalar, slope: Scalar, gravity: float, sides: Scalar) -> Scalar:
    """Normal load of one side m_i g cos α [N], eq. (5)."""
    return mass * (gravity / sides) * cosine(slope)
