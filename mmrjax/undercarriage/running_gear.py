"""Running gear of one side: further parameters that only the multibody model needs."""

from __future__ import annotations

import math

import equinox as eqx

from mmrjax.climbing.levers import Levers
from mmrjax.model.paper_tables import GROUSERS, TEETH_BELT, TEETH_PULLEY
from mmrjax.model.params import Scalar, parameter

__all__ = ["GROUSERS", "TEETH_BELT", "TEETH_PULLEY", "WHEELS", "RunningGear"]

WHEELS = 2  # of one side, 4W2T

_ASSUMED = "assumed; not stated in the paper"


class RunningGear(eqx.Module):
    """Geometry (Table 6), masses (Table 7), belt and contacts (27)-(29) of one side of the chassis.

    The robot holds the rolling radius, the moments of inertia of the rotating parts, friction, losses and its mass.
    The body's mass is the robot's less that of the parts below.
    """

    wheelbase: Scalar = parameter(
        0.300,
        unit="m",
        meaning="distance of the axles L_b, also the length of a straight run of the belt",
        bounds=(0.05, 3.0),
        relative_sd=0.005,
        source="Table 6",
    )
    grouser_height: Scalar = parameter(
        5.5e-3,
        unit="m",
        meaning="height of a grouser over the belt's pitch line",
        bounds=(0.0, 0.05),
        relative_sd=0.1,
        source="Table 6 over the grousers: 87.4/2 less the pitch radius 38.2 mm (bottom: clearance, Table 6)",
    )
    grouser_length: Scalar = parameter(
        5e-3,
        unit="m",
        meaning="length of a grouser's rigid base along the belt; the grouser turns into the arc over this length",
        bounds=(5e-4, 0.03),
        relative_sd=0.3,
        source="one tooth pitch: the rigid link that carries a grouser, Section 3.2.4",
    )
    guide_recess: Scalar = parameter(
        0.0,
        unit="m",
        meaning="height of the lower guide above the line that touches both pulleys",
        bounds=(-2e-3, 5e-3),
        sd=2e-4,
        source=f"flush; {_ASSUMED}. Decides the guides' share of the weight (docs/explanation/track-model.md)",
    )
    guide_gap: Scalar = parameter(
        20e-3,
        unit="m",
        meaning="free length of the belt between the end of an arc and the lower guide",
        bounds=(1e-3, 0.14),
        relative_sd=0.3,
        source="clearance of a guide 5 mm thick from a pulley of 38.2 mm: sqrt(38.2² - 33.2²) = 19 mm",
    )
    pretension: Scalar = parameter(
        100.0,
        unit="N",
        meaning="pre-tension of the belt at rest P_0",
        bounds=(1.0, 2000.0),
        relative_sd=0.3,
        source=f"twice the largest traction of one side (21.1 kg, 20 deg) keeps the slack run tight; {_ASSUMED}",
    )
    span_stiffness: Scalar = parameter(
        1e5,
        unit="N/m",
        meaning="tensile stiffness of one straight run of the belt",
        bounds=(1e3, 1e8),
        relative_sd=0.5,
        source=f"EA/L of 3e4 N for a reinforced polyurethane belt of 5 mm pitch, about 10 mm wide; {_ASSUMED}",
    )
    span_damping: Scalar = parameter(
        10.0,
        unit="N·s/m",
        meaning="tensile damping of one straight run of the belt",
        bounds=(0.0, 1e4),
        relative_sd=0.5,
        source=f"a tenth of critical for a pulley on two runs; {_ASSUMED}",
    )
    belt_mass: Scalar = parameter(
        40e-3,
        unit="kg",
        meaning="mass of one main track",
        bounds=(0.0, 2.0),
        relative_sd=0.05,
        source="Table 7",
    )
    contact_stiffness: Scalar = parameter(
        3e7,
        unit="N/m^1.5",
        meaning="stiffness c of a grouser or wheel on the ground, eq. (27) (unit at e = 1.5)",
        bounds=(1e4, 1e11),
        relative_sd=0.5,
        source=f"0.04 mm under 8 N, polyurethane on wood; {_ASSUMED}",
    )
    contact_exponent: Scalar = parameter(
        1.5,
        unit="-",
        meaning="exponent e of the contact force, eq. (27)",
        bounds=(1.0, 3.0),
        relative_sd=0.1,
        source="elastic bodies (Hertz 1881); the paper says e > 1 is hard contact",
    )
    contact_damping: Scalar = parameter(
        300.0,
        unit="N·s/m",
        meaning="damping b_max of a grouser or wheel on the ground, eq. (27)",
        bounds=(0.0, 1e5),
        relative_sd=0.5,
        source=f"a tenth to a half of critical for half a robot on its contacts; {_ASSUMED}",
    )
    contact_depth: Scalar = parameter(
        1e-4,
        unit="m",
        meaning="penetration depth d for full damping, Fig. 9a",
        bounds=(1e-6, 1e-2),
        relative_sd=0.5,
        source="default of the multibody package of ref. [48]: 0.1 mm",
    )
    centre_height: Scalar = parameter(
        5e-3,
        unit="m",
        meaning="centre of mass above the axles, without payload and levers",
        bounds=(-0.1, 0.3),
        sd=0.01,
        source="middle of the body (Table 6), half of its height of 76 mm over its underside (`clearance`)",
    )
    clearance: Scalar = parameter(
        10.7e-3,
        unit="m",
        meaning="ground clearance under the body on tracks",
        bounds=(0.0, 0.3),
        sd=1e-3,
        source="Table 6",
    )
    centre_offset: Scalar = parameter(
        0.0,
        unit="m",
        meaning="centre of mass ahead of the middle of the wheelbase, without levers",
        bounds=(-0.3, 0.3),
        sd=0.01,
        source=f"symmetric layout, Fig. A2; {_ASSUMED}",
    )
    payload_height: Scalar = parameter(
        73e-3,
        unit="m",
        meaning="centre of the payload above the axles",
        bounds=(0.0, 0.5),
        sd=0.02,
        source="platform 43 mm above the axles (Table 6) and half of a weight 60 mm tall, Fig. 19",
    )
    payload_offset: Scalar = parameter(
        0.0,
        unit="m",
        meaning="centre of the payload ahead of the middle of the wheelbase",
        bounds=(-0.5, 0.5),
        sd=0.02,
        source="Fig. 19",
    )
    body_gyration: Scalar = parameter(
        0.1075,
        unit="m",
        meaning="radius of gyration in pitch of the body: without payload, levers, pulleys, wheels and tracks",
        bounds=(1e-3, 3.0),
        relative_sd=0.05,
        source="Table 7: sqrt(1.19e5 kg·mm² / 10.3 kg)",
    )
    inertia_tracked: Scalar = parameter(
        0.0,
        unit="kg·m^2",
        meaning="moment of inertia in pitch on tracks, levers folded, no payload, if known as a whole; replaces "
        "body_gyration; 0: it follows from the parts",
        bounds=(0.0, 20.0),
        sd=5e-3,
        source="not stated: the sum of the parts (Table 7's 0.251 is that of the robot with its levers outstretched)",
    )
    inertia_wheeled: Scalar = parameter(
        0.0,
        unit="kg·m^2",
        meaning="moment of inertia in pitch on wheels, as a whole",
        bounds=(0.0, 20.0),
        sd=5e-3,
        source="not stated: the sum of the parts (0.146; Table 7: 0.145)",
    )
    lever_mass: Scalar = parameter(
        0.495,
        unit="kg",
        meaning="mass of one lever with its track, 6T2A",
        bounds=(0.0, 10.0),
        relative_sd=0.05,
        source="Table 7: 470 + 25 g",
    )
    lever_centre: Scalar = parameter(
        0.083,
        unit="m",
        meaning="centre of a lever with its track from its axle",
        bounds=(0.0, 1.0),
        sd=5e-3,
        source="with it the parts of the outstretched robot have Table 7's 0.251 kg·m²; middle of its track: 80 mm",
    )
    lever_inertia: Scalar = parameter(
        1.6e-3,
        unit="kg·m^2",
        meaning="moment of inertia of one lever with its track about its own centre",
        bounds=(0.0, 10.0),
        relative_sd=0.1,
        source="Table 7: 1470 kg·mm²; 170 of its track of 560 mm, less what turns with the pulley (40)",
    )
    lever_length: Scalar = parameter(
        0.205,
        unit="m",
        meaning="length of a lever from axle to tip l_p",
        bounds=(0.0, 2.0),
        relative_sd=0.01,
        source="Table 6",
    )
    lever_front: Scalar = parameter(
        math.pi,
        unit="rad",
        meaning="fixed angle of the front lever, 0 pointing forward, positive upward",
        bounds=(-math.pi, 2 * math.pi),
        sd=0.05,
        source="transport posture, folded along the body (overall length 390 mm, Table 6)",
    )
    lever_rear: Scalar = parameter(
        0.0,
        unit="rad",
        meaning="fixed angle of the rear lever, 0 pointing forward, positive upward",
        bounds=(-math.pi, 2 * math.pi),
        sd=0.05,
        source="transport posture, folded along the body",
    )
    pulley_mass: Scalar = parameter(
        82e-3,
        unit="kg",
        meaning="mass of one main pulley",
        bounds=(1e-3, 10.0),
        relative_sd=0.05,
        source="Table 7: two a side, as 13.1 and 11.5 kg need",
    )
    additional_pulley_mass: Scalar = parameter(
        104e-3,
        unit="kg",
        meaning="mass of the additional pulley on the axle, which drives the lever's track or carries the wheel",
        bounds=(0.0, 10.0),
        relative_sd=0.05,
        source="Table 7: two a side, as 13.1 and 11.5 kg need",
    )
    wheel_mass: Scalar = parameter(
        86e-3,
        unit="kg",
        meaning="mass of one wheel, 4W2T",
        bounds=(0.0, 10.0),
        relative_sd=0.05,
        source="Table 7",
    )
    levers: Levers = eqx.field(default_factory=Levers, kw_only=True)
