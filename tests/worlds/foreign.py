"""Foreign laws: effects of a drive that no library here holds, written to test whoever has to notice them.

`FOREIGN` shows in settled runs, `FOREIGN_SERIES` in histories from standstill. Signs are those of `laws`:
a positive term takes away (voltage, torque, force, speed), a sensor's adds to its reading. Every law stays
finite at rest, off the ground (N = P = 0) and downhill. Sizes and bounds of shapes are judgements for a robot
of 12 to 21 kg with small motors, not measurements. Sources are cited from memory. None was looked up again.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from worlds.laws import Law
from worlds.paper import SIDES, G


def _soft_kink(x: np.ndarray, width: float) -> np.ndarray:
    """0 far below zero, x far above."""
    return width * np.logaddexp(0.0, x / width)


def _step(x: np.ndarray, width: float) -> np.ndarray:
    """From 0 to 1 about zero."""
    return 0.5 * (1 + np.tanh(x / width))


def _resonance(x: np.ndarray, damping: float) -> np.ndarray:
    """Share of the peak power that a damped mass on a spring takes at x times its own frequency."""
    return (2 * damping * x) ** 2 / ((1 - x**2) ** 2 + (2 * damping * x) ** 2)


def _whirl(x: np.ndarray) -> np.ndarray:
    """Drag of an unbalanced rotor at x times its critical speed, 1 there."""
    return x**3 * _resonance(x, 0.15)


#: Laws that settled runs can show.
FOREIGN: dict[str, Law] = {
    # Resistance ahead of a step-down converter, seen from its output: the square of the duty ratio times it.
    # Erickson and Maksimović, Fundamentals of Power Electronics (2001), ch. 3 (the converter as a transformer).
    "buck_source": Law("", "supply", lambda s, q: (s.U / 33) ** 2 * s.line, 0.2),
    # A linear supply drops out: its raw rail sinks with the load until the regulator has no headroom left.
    # Horowitz and Hill, The Art of Electronics (2015), ch. 9.
    "rail_dropout": Law("", "supply", lambda s, q: _soft_kink(s.U + 0.5 * s.line - q["rail"], 0.4), 0.3, {"rail": (33.8, 35.0)}),
    # A resettable polymer fuse, one a motor, warms to the foot of its resistance step.
    # Doljack, PolySwitch PTC devices, IEEE Trans. CHMT 4 (1981) 372.
    "polyfuse": Law("", "electrical", lambda s, q: s.I * _step(abs(s.I) - q["at"], 0.25), 0.3, {"at": (1.2, 2.0)}),
    # Each commutated coil takes its energy ½ L I² into the spark, segment by segment: an apparent resistance
    # in proportion to speed. Kenjo and Nagamori, Permanent-Magnet and Brushless DC Motors (1985).
    "commutation_spark": Law("", "electrical", lambda s, q: s.I * abs(s.w) / 1000, 0.1),
    # Coils reverse late by an angle ω τ, and the share 1 - cos(ω τ) of the torque is lost (delay of commutation;
    # Fitzgerald, Kingsley and Umans, Electric Machinery, 2003, ch. 7, for commutation). Driving, it is a loss.
    "commutation_lag": Law("", "motor", lambda s, q: s.C * s.I * (s.w / 1000) ** 2, 0.02),
    # Bearing drag (ν n)^(2/3), its grease thinned by the heat of the winding beside it.
    # Palmgren, Ball and Roller Bearing Engineering (1959), M_0; Reynolds' exponential law of viscosity (1886).
    "grease_thinning": Law("", "motor", lambda s, q: (abs(s.w) / 1000) ** (2 / 3) * np.exp(-((s.I / q["hot"]) ** 2)), 1e-3, {"hot": (1.2, 2.4)}),
    # The unbalanced rotor whirls through a critical speed of its ball bearings, whose damping takes c ω X²/2; load
    # stiffens them as F^(1/3) (Hertz, 1882). Jeffcott, Phil. Mag. 37 (1919) 304; Den Hartog, Mechanical Vibrations (1956).
    "rotor_whirl": Law("", "motor", lambda s, q: _whirl(abs(s.w) / (q["at"] * (0.1 + abs(s.I)) ** (1 / 6))), 1e-3, {"at": (650.0, 1050.0)}),
    # Helical teeth push the shaft against a stiff thrust washer once its wave spring is flat: a kink in the load.
    # Niemann and Winter, Maschinenelemente II (2003), axial forces.
    "thrust_washer": Law("", "gearbox", lambda s, q: np.maximum(abs(s.B) - q["from"], 0), 0.1, {"from": (0.8, 1.6)}),
    # Mixed lubrication of the mesh: the part of the tooth load that asperities carry fades as the film builds up.
    # Stribeck (1902) with load; Castro and Seabra, Proc. IMechE J 221 (2007), friction of gears in mixed film.
    "mixed_mesh": Law("", "gearbox", lambda s, q: abs(s.B) * np.exp(-abs(s.w) / q["fade"]), 0.2, {"fade": (250.0, 600.0)}),
    # A strand of the belt flutters where its own frequency, tuned by the tension that traction adds, meets that of
    # the pulley. Mote, Dynamic stability of axially moving materials (1972); Abrate, Mech. Mach. Theory 27 (1992).
    "belt_flutter": Law("", "track", lambda s, q: 1 / (1 + ((s.w_k - q["at"] * np.sqrt(np.maximum(1 + s.P / 20, 0.1))) / 1.5) ** 2), 0.1, {"at": (10.0, 15.0)}),
    # Rubber under tension is bent at each pulley: viscous loss of the stretched strand, tension times rate.
    # Gerbert, Traction Belt Mechanics (1999); Ferry (1980) for loss in proportion to rate.
    "tight_side_flexing": Law("", "track", lambda s, q: s.r * abs(s.P) * s.w_k / 20, 0.1),
    # Guide teeth under the weight (on tracks alone) draw a film between themselves and the wheels as they go faster.
    # Stribeck (1902); Bowden and Tabor, The Friction and Lubrication of Solids (1950).
    "guide_glide": Law("", "track", lambda s, q: s.r * s.N * np.exp(-abs(s.w_k) / q["fade"]) * (1 - s.wheeled), 0.05, {"fade": (6.0, 16.0)}),
    # The slope loads the rear contacts, whose rubber loses in proportion to depth times rate of indentation.
    # Greenwood and Tabor, Proc. Phys. Soc. 71 (1958) 989; Wong, Theory of Ground Vehicles (2008), load transfer.
    "rear_hysteresis": Law("", "ground", lambda s, q: s.N * abs(np.tan(s.slope)) * abs(s.V), 0.05),
    # A payload that sits high tips its weight on the rear axle, whose bushes and treads then drag.
    # Wong (2008), ch. 1: load transfer h/L tan α, here of the payload alone.
    "top_heavy": Law("", "ground", lambda s, q: s.payload * G / SIDES * abs(np.tan(s.slope)), 0.05),
    # Treads excite the robot's heave on its rubber; its frequency sinks as the mass grows.
    # Den Hartog (1956), damped oscillator driven through its support.
    "heave_resonance": Law("", "ground", lambda s, q: s.N * _resonance(s.V * np.sqrt(s.M / 13) / q["at"], 0.15), 0.01, {"at": (0.6, 1.1)}),
    # Teeth of the belt climb on the pulley and give way above a traction, when the slack strand has no tension left.
    # Gerbert et al., Load distribution in timing belts, J. Mech. Design 100 (1978) 208.
    "ratcheting": Law("", "slip", lambda s, q: s.V_teor * _soft_kink(s.D - q["from"], 1.5), 2e-3, {"from": (12.0, 22.0)}),
    # Bouncing treads are off the ground for a share of time that grows as speed and falls as load.
    # Pacejka, Tire and Vehicle Dynamics (2012), loss of grip on uneven roads, to first order.
    "hop": Law("", "slip", lambda s, q: s.V_teor**2 * 50 / np.maximum(s.N, 1.0), 0.02),
    # The contact warms with the power it passes, and softer rubber creeps the more.
    # Persson, Rubber friction: role of the flash temperature, J. Phys. Condens. Matter 18 (2006) 7789.
    "tread_heating": Law("", "slip", lambda s, q: s.D * s.V_teor**2, 5e-4),
    # The multimeter changes its range, and with it the shunt: another gain above a current.
    # Keithley, Low Level Measurements Handbook (2013), errors by range.
    "range_switch": Law("", "total_current", lambda s, q: s.line * _step(s.line - q["at"], 0.05), 0.02, {"at": (2.2, 3.8)}, either=True),
    # The counter misses pulses above the bandwidth of the encoder's optics: a kink in the reading.
    "lost_counts": Law("", "motor_speed", lambda s, q: -np.maximum(s.w - q["from"], 0), 0.02, {"from": (750.0, 1050.0)}),
}  # fmt: skip

#: Those of a positive size that take power out wherever the motor drives forward.
DISSIPATIVE = (
    "buck_source", "rail_dropout", "polyfuse", "commutation_spark", "grease_thinning", "rotor_whirl",
    "thrust_washer", "mixed_mesh", "belt_flutter", "tight_side_flexing", "guide_glide", "rear_hysteresis",
    "top_heavy", "heave_resonance",
)  # fmt: skip

AXLES = 0.3  # from one axle to the other [m]
TOOTH = 0.005  # pitch of the belt [m]
PLANETS = 3 / (576 / 25)  # passages of a planet a radian of the motor


def _way(s: SimpleNamespace) -> np.ndarray:
    """Way rolled by a mover [m]."""
    return s.r * s.theta / s.i


def _crest(x: np.ndarray, width: float) -> np.ndarray:
    """Slope of a rounded crest at x = 0 on the way up and down, 1 at its steepest."""
    u = x / width
    return -u * np.exp(0.5 * (1 - u**2))


#: Laws that act over time, way or heat.
FOREIGN_SERIES: dict[str, Law] = {
    # The supply's control loop rings after the inrush. Middlebrook, IEEE IAS Annual Meeting (1976), filters and loops.
    "supply_ringing": Law("", "supply", lambda s, q: np.exp(-s.time / 0.3) * np.sin(2 * np.pi * s.time / q["period"]), 1.0, {"period": (0.15, 0.4)}),
    # Another consumer switches on for 150 ms: a dip of the voltage (IEC 61000-4-29, dips of d.c. supplies).
    "brownout": Law("", "supply", lambda s, q: _step(s.time - q["at"], 0.01) - _step(s.time - q["at"] - 0.15, 0.01), 1.0, {"at": (0.3, 0.9)}),
    # An oxide film on the contacts breaks through as charge passes (fritting). Holm, Electric Contacts (1967).
    "oxide_fritting": Law("", "electrical", lambda s, q: s.I * np.exp(-abs(s.q) / q["charge"]), 0.2, {"charge": (0.1, 0.3)}),
    # The winding grows with its heat until it rubs on the housing. Newkirk, Shaft rubbing, Mech. Eng. 48 (1926) 830.
    "rotor_rub": Law("", "motor", lambda s, q: np.maximum(s.T - q["from"], 0) * s.d, 2e-3, {"from": (0.2, 0.6)}),
    # Unequal planets: the mesh loss swings with the load as each of three passes.
    # Kahraman, Mech. Mach. Theory 29 (1994) 1151, load sharing of planets.
    "planet_passing": Law("", "gearbox", lambda s, q: s.I * np.sin(PLANETS * s.theta + q["phase"]), 0.02, {"phase": (-3.0, 3.0)}),
    # Grease that has set at rest is sheared down again, second order in its structure.
    # Mewis and Wagner, Thixotropy, Adv. Colloid Interface Sci. 147 (2009) 214.
    "thixotropy": Law("", "track", lambda s, q: s.w_k / (1 + abs(s.theta / s.i) / q["angle"]), 0.01, {"angle": (2.0, 8.0)}),
    # A seam of the floor is climbed and left by the front axle, then by the rear one; no energy over a crossing.
    "floor_seam": Law("", "ground", lambda s, q: _crest(_way(s) - q["at"], 0.02) + _crest(_way(s) - q["at"] - AXLES, 0.02), 3.0, {"at": (0.08, 0.25)}),
    # The measuring cable comes taut and drags on the floor, the longer the farther.
    "tether_drag": Law("", "ground", lambda s, q: np.maximum(_way(s) - q["from"], 0) * s.d, 1.0, {"from": (0.1, 0.4)}),
    # The belt jumps teeth once, at one angle of the pulley; the amplitude counts them.
    # Belt makers' design manuals warn of it at low tension (no single source at hand).
    "tooth_jump": Law("", "slip", lambda s, q: s.w_k * TOOTH * np.exp(-(((s.theta / s.i - q["at"]) / 0.3) ** 2) / 2) / (0.3 * np.sqrt(2 * np.pi)), 1.0, {"at": (3.0, 9.0)}),
    # Sand in hollow rims lies still until it is centrifuged, ω² r > g, and then turns along.
    # Critical speed of a ball mill (Davis, Trans. AIME 61, 1919).
    "loose_fill": Law("", "inertia", lambda s, q: _step(abs(s.w_k) - q["at"], 1.5), 1e-3, {"at": (10.0, 15.0)}),
}  # fmt: skip

#: Those of them that only take power out. `loose_fill` takes energy from the spin-up and returns it on the way down.
DISSIPATIVE_SERIES = ("oxide_fritting", "rotor_rub", "thixotropy", "tether_drag")
