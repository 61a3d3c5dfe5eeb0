"""Levers: parameters of their rollers, their tracks' losses and the gears of their drives, Fig. 5b."""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx

from mmrjax.model.params import Scalar, parameter
from mmrjax.model.track_friction import Track

_UNSTATED = "not stated in the paper"


class Levers(eqx.Module):
    """Roller at the tip of a lever, and drive of a pair: motor, planetary gear, worm (Fig. A1: 11-14).

    Length, mass, centre and inertia of a lever belong to the running gear, as does its angle if a run states none.
    Angles here: 0 along the wheelbase outward, positive up, π folded.
    """

    roller: Scalar = parameter(
        13.5e-3, "m", "radius of the roller at a lever's tip over the grousers of its track", (1e-3, 0.5),
        "Table 6, d/2; with the resulting pitch radius of 8 mm, the track of 112 teeth closes to 0.4 mm",
        relative_sd=0.05,
    )  # fmt: skip
    worm_ratio: Scalar = parameter(
        30.0, "-", "ratio of the worm gear of a pair of levers", (1.0, 1e3), "Fig. 5b", relative_sd=0.01
    )
    worm_efficiency: Scalar = parameter(
        0.5, "-", "efficiency of the worm gear, driven by its worm; self-locking up to 0.5", (0.05, 0.99),
        "Fig. 5b, without a table; a worm of one start: 0.4-0.6", sd=0.15,
    )  # fmt: skip
    planetary_ratio: Scalar = parameter(
        23.04, "-", "ratio of the planetary gear between motor and worm", (1.0, 1e4),
        f"that of the traction drive, Fig. A1: 12 next to 2; {_UNSTATED}", relative_sd=0.8,
    )  # fmt: skip
    planetary_efficiency: Scalar = parameter(
        0.75, "-", "efficiency of the planetary gear between motor and worm", (0.1, 1.0),
        f"catalogue of the traction drive's gear; {_UNSTATED}", sd=0.1,
    )  # fmt: skip
    rate: Scalar = parameter(
        1.0, "rad/s", "rate of a pair of levers with an imposed angle", (1e-3, 100.0),
        f"8810 rpm over the two gears' ratios: 1.3 rad/s without load; {_UNSTATED}", relative_sd=0.5,
    )  # fmt: skip
    angle_least: Scalar = parameter(
        -math.pi, "rad", "least angle of a lever, straight back under the belt", (-2 * math.pi, 0.0),
        f"no stop for a lever in Fig. A2; {_UNSTATED}", sd=0.5,
    )  # fmt: skip
    angle_most: Scalar = parameter(
        math.pi, "rad", "greatest angle of a lever, folded along the body", (0.0, 2 * math.pi),
        f"transport posture, Table 6; {_UNSTATED}", sd=0.5,
    )  # fmt: skip
    current_limit: Scalar = parameter(
        1000.0, "A", "largest current of a motor of the levers that its driver permits", (0.01, 1e4),
        "no limit on the bench: above any current", relative_sd=0.1,
    )  # fmt: skip
    share_coulomb: Scalar = parameter(
        0.4, "-", "share of a side's static loss torque of the tracks that each of its two levers' tracks has",
        (0.0, 0.5), "Table 3: (350 - 70) / 2 of 350 mN·m", sd=0.05,
    )  # fmt: skip
    share_viscous: Scalar = parameter(
        13 / 32, "-", "share of a side's pseudo-viscous loss of the tracks that each of its two levers' tracks has",
        (0.0, 0.5), "Table 3: (16 - 3) / 2 of 16 mN·m·s", sd=0.05,
    )  # fmt: skip

    def tracks(self, side: Track) -> tuple[Track, Track]:
        """Tracks of a side split into the main one and that of one lever."""

        def share(coulomb: Scalar, viscous: Scalar) -> Track:
            return dataclasses.replace(
                side, loss_coulomb=coulomb * side.loss_coulomb, loss_viscous=viscous * side.loss_viscous
            )

        own = share(self.share_coulomb, self.share_viscous)
        return share(1 - 2 * self.share_coulomb, 1 - 2 * self.share_viscous), own
