"""Writes log.csv for the tutorial about logs: the bench of `mmrjax rig new --kind bench`, with a fan on the motor shaft.

    python docs/start/bench/make.py

The numbers differ from those of the file within their tolerances. The file does not know the fan.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
RESISTANCE, CONSTANT, RATIO, EFFICIENCY = 2.05, 0.0252, 20.0, 0.77  # ohm, N·m/A
COULOMB, VISCOUS, FAN = 1.6e-3, 6e-7, 2.5e-9  # N·m, N·m·s, N·m·s²: on the motor shaft
LOAD_COULOMB, LOAD_VISCOUS = 0.045, 0.0009  # N·m, N·m·s: at the output
INERTIA = 2e-6 + 0.0021 / (RATIO**2 * EFFICIENCY)  # kg·m², at the motor shaft
LEVELS = (6, 10, 14, 18, 22, 24, 20, 16, 12, 8, -6, -10, -14, -18, -22, -24, -20, -16, -12, -8, 14, 22, -14, -22)  # V
STEP, EVERY, HOLD = 1e-3, 20, 1000  # s; steps between rows; steps of a level


def acceleration(voltage: float, speed: float) -> float:
    """Acceleration of the motor shaft [rad/s²]; friction acts against the rotation."""
    way = np.sign(speed) or np.sign(voltage)
    load = (LOAD_COULOMB * way + LOAD_VISCOUS * speed / RATIO) / (RATIO * EFFICIENCY)
    lost = COULOMB * way + VISCOUS * speed + FAN * speed * abs(speed) + load
    return (CONSTANT * (voltage - CONSTANT * speed) / RESISTANCE - lost) / INERTIA


def log() -> np.ndarray:
    """Rows of time [s], voltage [V], current [A] and motor speed [rpm], with noise and display steps."""
    rng, speed, rows = np.random.default_rng(1), 0.0, []
    for step in range(len(LEVELS) * HOLD):
        voltage = float(LEVELS[step // HOLD])
        if step % EVERY == 0:
            # A current does not jump with the voltage.
            before = float(LEVELS[(step - 1) // HOLD]) if step else 0.0
            current = (before - CONSTANT * speed) / RESISTANCE + 0.004 * rng.standard_normal()
            rows.append((step * STEP, voltage, current, speed * 30 / np.pi + 4 * rng.standard_normal()))
        middle = speed + 0.5 * STEP * acceleration(voltage, speed)
        speed += STEP * acceleration(voltage, middle)
    return np.array(rows)


if __name__ == "__main__":
    head = "time_s,supply_voltage_V,total_current_A,motor_speed_rpm"
    np.savetxt(HERE / "log.csv", log(), fmt=("%.2f", "%g", "%.3f", "%.0f"), delimiter=",", header=head, comments="")
