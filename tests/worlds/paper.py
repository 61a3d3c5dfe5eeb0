# ruff: noqa: E741 (symbols as in the paper)
"""A second implementation, from the paper, in plain Python and SciPy: nothing here comes from mmrjax.

Scalars in, scalars out, symbols as in the paper, numbers typed from its tables (and, where it prints
none, from the stated assumptions of this project). Equation numbers are the paper's.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root

G = 9.80665  # [m/s²]
SIDES = 2
CELLS = 8  # Section 3.2.1
PULLEY = 48 * 0.005 / (2 * math.pi)  # 48 teeth of 5 mm [m]; 168 x 5 mm = 2 x 300 mm + π x 76.39 mm
WHEEL = 0.100 / 2  # Table 6 [m]

#: Nominal values in SI, by the dotted name that the package gives the parameter.
NOMINAL: dict[str, float] = {
    # Table 1, Table A4; 2200 mAh from the cell's type designation
    "battery.curvature": 7e-8 / (3.6 * 3.6),
    "battery.slope": -5e-4 / 3.6,
    "battery.voltage_full": 4.17,
    "battery.resistance": 0.049,
    "battery.current_other": 1.5,
    "battery.capacity": 7920.0,
    # Table 2 and the motor maker's sheet
    "motor.resistance": 0.611,
    "motor.inductance": 0.000119,
    "motor.torque_constant": 0.0259,
    "motor.friction_coulomb": 0.0027,
    "motor.friction_viscous": 5.5e-7,
    "motor.inertia": 3.35e-6,
    "motor.resistance_thermal_winding": 1.7,
    "motor.resistance_thermal_housing": 6.0,
    "motor.time_constant_winding": 16.3,
    "motor.time_constant_housing": 593.0,
    "motor.temperature_ambient": 25.0,
    # assumptions: no limit, and a controller that the paper does not have
    "driver.current_limit": 1000.0,
    "driver.gain": 4.0,
    "driver.time_reset": 0.05,
    "rig.delay": 0.0,
    # Table 2; ratio 576/25 x 25/12
    "gearbox.ratio": 576 / 25 * 25 / 12,
    "gearbox.efficiency_load": 0.74,
    "gearbox.friction_coulomb": 0.0003,
    "gearbox.friction_viscous": 1.4e-6,
    # 6T2A: Tables 3, 4, 5 (lacquered wood), 7; guide share, μ_d, V_s, V_d are assumptions
    "6T2A.track.loss_coulomb": 0.350,
    "6T2A.track.loss_viscous": 0.016,
    "6T2A.track.guide_friction": 0.20,
    "6T2A.track.guide_share": 0.3,
    "6T2A.ground.friction.static": 0.32,
    "6T2A.ground.friction.dynamic": 0.8 * 0.32,
    "6T2A.ground.friction.speed_static": 0.02,
    "6T2A.ground.friction.speed_dynamic": 0.2,
    "6T2A.ground.rolling_resistance": 0.06,
    "6T2A.mass": 13.1,
    "6T2A.radius": PULLEY,
    "6T2A.inertia": 2 * (75e-6 + 140e-6) + (0.040 + 2 * 0.025) * PULLEY**2,
    # 4W2T
    "4W2T.track.loss_coulomb": 0.070,
    "4W2T.track.loss_viscous": 0.003,
    "4W2T.track.guide_friction": 0.20,
    "4W2T.track.guide_share": 0.0,
    "4W2T.ground.friction.static": 0.38,
    "4W2T.ground.friction.dynamic": 0.8 * 0.38,
    "4W2T.ground.friction.speed_static": 0.02,
    "4W2T.ground.friction.speed_dynamic": 0.2,
    "4W2T.ground.rolling_resistance": 0.03,
    "4W2T.mass": 11.5,
    "4W2T.radius": WHEEL,
    "4W2T.inertia": 2 * (75e-6 + 140e-6) + 0.040 * PULLEY**2 + 2 * 152e-6,
}


# --- power source -----------------------------------------------------------------------------------


def battery_voltage(I_s, C_b, A, B, U0, R_b, I_p, C=1.0, C_n=1.0):
    """U_b [V], eqs. (9), (10), (12), (13), after the charge C_b [C] at motor current I_s [A].

    A and B are of a cell of capacity C_n. One of capacity C falls as far over its own.
    """
    I_b = I_s + I_p
    C_b = C_b / C * C_n
    return sum((A * C_b**2 + B * C_b + U0) - I_b * R_b for _ in range(CELLS))


def source_voltage(mode, U_s, U_b):
    """U_e [V], eq. (8): mode 1 the battery, mode 2 the external supply."""
    return {1: U_b, 2: U_s}[mode]


# --- motor and gearbox ------------------------------------------------------------------------------


def motor_loss(w, M_df0, K_fd, sign):
    """M_df [N·m], eq. (14)."""
    return M_df0 * sign + K_fd * w


def motor_back(w, C_E):
    """E [V], eq. (16)."""
    return C_E * w


def motor_current_rate(U_e, I_d, w, R_rot, L_d, C_E):
    """dI_d/dt [A/s], eq. (15)."""
    return (U_e - motor_back(w, C_E) - I_d * R_rot) / L_d


def motor_torque(I_d, w, C_m, M_df0, K_fd, sign):
    """M_d [N·m], eqs. (14), (17), (18)."""
    return C_m * I_d - motor_loss(w, M_df0, K_fd, sign)


def gear_idle(w, M_rf0, K_fr, sign):
    """M_rf_idle [N·m], eq. (20)."""
    return M_rf0 * sign + K_fr * w


def gear_efficiency(M_d, M_idle, eta_rm):
    """η_r [-], eq. (19)."""
    return (1 - M_idle / M_d) * eta_rm


def gear_loss(M_d, i_r, eta_r):
    """M_rf [N·m], eq. (21)."""
    return M_d * i_r * (1 - eta_r)


def gear_loss_split(M_d, M_idle, i_r, eta_rm):
    """M_rf [N·m], eq. (22)."""
    return M_d * i_r * (1 - eta_rm) + M_idle * i_r * eta_rm


def gear_output(M_d, M_rf, i_r):
    """M_r [N·m], eq. (23)."""
    return M_d * i_r - M_rf


# --- chassis and ground -----------------------------------------------------------------------------


def track_loss(w_k, M_t0, K_ft, sign):
    """M_t [N·m], eq. (24)."""
    return M_t0 * sign + K_ft * w_k


def guide_force(R_g, mu_t, sign):
    """F'_t [N], eq. (26), the load R_g [N] shared over any number of teeth."""
    return mu_t * R_g * sign


def rolling_force(m_i, alpha, f):
    """F_f [N], eq. (5)."""
    return f * m_i * G * math.cos(alpha)


def adhesion_force(m_i, alpha, phi):
    """Largest traction of one side [N], eqs. (6), (7)."""
    return phi * m_i * G * math.cos(alpha)


def cubic_step(x, x0, y0, x1, y1):
    """Fig. 9a: y0 before x0, y1 after x1, a cubic with flat ends between."""
    if x <= x0:
        return y0
    if x >= x1:
        return y1
    c = np.linalg.solve(  # the cubic by its four conditions
        [[1, x0, x0**2, x0**3], [1, x1, x1**2, x1**3], [0, 1, 2 * x0, 3 * x0**2], [0, 1, 2 * x1, 3 * x1**2]],
        [y0, y1, 0.0, 0.0],
    )
    return float(c[0] + c[1] * x + c[2] * x**2 + c[3] * x**3)


def friction(v, mu_s, mu_d, V_s, V_d):
    """μ [-] of Fig. 7 at sliding speed v [m/s]."""
    size = abs(v)
    if size < V_s:
        mu = mu_s * 0.5 * (3 * (size / V_s) - (size / V_s) ** 3)
    elif size < V_d:
        u = (size - V_s) / (V_d - V_s)
        mu = mu_s + (mu_d - mu_s) * (3 * u * u - 2 * u * u * u)
    else:
        mu = mu_d
    return math.copysign(mu, v) if v else 0.0


def friction_speed(mu, mu_s, V_s):
    """Sliding speed [m/s] below V_s at which Fig. 7 gives μ: the middle root of the cubic, by Newton."""
    share = abs(mu) / mu_s
    x = share * 2 / 3
    for _ in range(60):
        slope = 1.5 * (1 - x * x)
        if slope == 0:
            break
        x = min(x + (share - 0.5 * (3 * x - x**3)) / slope, 1.0)
    return math.copysign(x * V_s, mu)


def contact_force(q, q_rate, r_1, r_2, c, e, b_max, d):
    """F_c [N], eqs. (27)-(29), never pulling."""
    q_0 = r_1 + r_2
    if q >= q_0:
        return 0.0
    h = q_0 - q
    return max(0.0, c * h**e - b_max * q_rate * cubic_step(h, 0.0, 0.0, d, 1.0))


def slip(V, V_teor):
    """s [-], eq. (33)."""
    return 1 - V / V_teor


def theoretical_speed(w_k, r_k):
    """V_x_teor [m/s], eq. (32), for equal wheels."""
    return w_k * r_k


def equivalent_inertia(m_i, r_k, J_d, i_r, eta_r, J_k):
    """J'_eq [kg·m²], eq. (3)."""
    return m_i * r_k**2 + J_d * i_r**2 * eta_r + J_k


def mass_factor(m_i, r_k, J_eq):
    """δ [-], eq. (2)."""
    return J_eq / (m_i * r_k**2)


def rotating_inertia(J_d, i_r, eta_r, J_w):
    """J_S^d [kg·m²], eq. (31)."""
    return J_d * i_r**2 * eta_r + J_w


# --- the drive as a whole ---------------------------------------------------------------------------


def soft_sign(v, rest):
    """Sign of v, an odd cubic within ±rest (the project's choice: rest = V_s / 10)."""
    x = min(max(v / rest, -1.0), 1.0)
    return 0.5 * x * (3 - x * x)


class Side:
    """One run: nominal numbers (or `p`) of one configuration, the slope, the load, the source."""

    def __init__(self, voltage, slope=0.0, payload=0.0, wheeled=False, battery=False, discharge=0.0, p=NOMINAL):
        c = "4W2T." if wheeled else "6T2A."
        self.A, self.B, self.U0 = p["battery.curvature"], p["battery.slope"], p["battery.voltage_full"]
        self.R_b, self.I_p, self.full = p["battery.resistance"], p["battery.current_other"], p["battery.capacity"]
        self.R, self.L, self.C = p["motor.resistance"], p["motor.inductance"], p["motor.torque_constant"]
        self.M_df0, self.K_fd, self.J_d = p["motor.friction_coulomb"], p["motor.friction_viscous"], p["motor.inertia"]
        self.i, self.eta = p["gearbox.ratio"], p["gearbox.efficiency_load"]
        self.M_rf0, self.K_fr = p["gearbox.friction_coulomb"], p["gearbox.friction_viscous"]
        self.M_t0, self.K_ft = p[c + "track.loss_coulomb"], p[c + "track.loss_viscous"]
        self.mu_t, self.share = p[c + "track.guide_friction"], p[c + "track.guide_share"]
        self.mu_s, self.mu_d = p[c + "ground.friction.static"], p[c + "ground.friction.dynamic"]
        self.V_s, self.V_d = p[c + "ground.friction.speed_static"], p[c + "ground.friction.speed_dynamic"]
        self.f, self.r, self.J_w = p[c + "ground.rolling_resistance"], p[c + "radius"], p[c + "inertia"]
        self.U, self.battery, self.discharge = voltage, battery, discharge
        self.m = (p[c + "mass"] + payload) / SIDES
        self.N = self.m * G * math.cos(slope)
        self.roll = rolling_force(self.m, slope, self.f)
        self.pull = self.m * G * math.sin(slope)

    def supply(self, I, C_b):
        """U_e [V]."""
        if not self.battery:
            return self.U
        q = C_b / self.full * NOMINAL["battery.capacity"]
        return CELLS * (self.A * q * q + self.B * q + self.U0 - (SIDES * I + self.I_p) * self.R_b)

    def efficiency(self, A, B, sign):
        """η_rm driving, 1/η_rm driven, 1 at rest and in between, from motor torque less idle loss A and load B."""
        wheel = (self.i * self.eta * A - B) / (self.J_w + self.J_d * self.i**2 * self.eta)
        through = A - self.J_d * self.i * wheel  # torque that reaches the teeth
        if through * sign >= 0:
            return 1 - abs(sign) * (1 - self.eta)
        return 1 + abs(sign) * (1 / self.eta - 1)

    def steady_residual(self, x):
        """Volts and newton-metres left over, and speed, at [I, ω / 1000, V]."""
        I, w, V = x[0], 1000 * x[1], x[2]
        w_k = w / self.i
        demand = self.roll + self.pull
        A = self.C * I - (self.M_df0 + self.K_fd * w) - (self.M_rf0 + self.K_fr * w)
        B = self.M_t0 + self.K_ft * w_k + self.r * (self.mu_t * self.share * self.N + demand)
        eta = self.eta if A >= 0 else 1 / self.eta
        return [
            self.supply(I, self.discharge) - self.C * w - I * self.R,
            self.i * eta * A - B,
            self.r * w_k - V - self.creep(demand / self.N),
        ]

    def creep(self, mu):
        """Sliding speed [m/s] in closed form: the cubic's middle root by Viète."""
        return 2 * self.V_s * math.sin(math.asin(mu / self.mu_s) / 3)

    def start(self):
        """First guess [I, ω / 1000, V]: a tenth of stall, 0.9 of no load."""
        U = self.supply(0.0, self.discharge)
        w = 0.9 * U / self.C
        return [0.1 * U / self.R, w / 1000, self.r * w / self.i]

    def steady(self, tolerance=1e-13):
        """I [A], ω [rad/s], V [m/s] of steady travel, None where the movers slide."""
        if abs(self.roll + self.pull) > self.mu_s * self.N:
            return None
        found = root(self.steady_residual, self.start(), tol=tolerance)
        return found.x[0], 1000 * found.x[1], found.x[2]

    def rates(self, t, y):
        """d/dt of I [A], ω [rad/s], V [m/s], distance [m], C_b [C]."""
        I, w, V, _, C_b = y
        rest = 0.1 * self.V_s
        w_k = w / self.i
        rolled = self.r * w_k
        sign, sign_V = soft_sign(rolled, rest), soft_sign(V, rest)
        P = friction(rolled - V, self.mu_s, self.mu_d, self.V_s, self.V_d) * self.N
        A = self.C * I - (self.M_df0 * sign + self.K_fd * w) - (self.M_rf0 * sign + self.K_fr * w)
        B = self.M_t0 * sign + self.K_ft * w_k + self.r * (self.mu_t * self.share * self.N * sign + P)
        eta = self.efficiency(A, B, sign)
        wheel = (self.i * eta * A - B) / (self.J_w + self.J_d * self.i**2 * eta)
        return [
            (self.supply(I, C_b) - self.C * w - I * self.R) / self.L,
            self.i * wheel,
            (P - self.roll * sign_V - self.pull) / self.m,
            V,
            SIDES * I + self.I_p if self.battery else 0.0,
        ]

    def drive(self, times, method="Radau", rtol=1e-10, atol=1e-12):
        """States at `times` from standstill, shape (times, 5)."""
        y0 = [0.0, 0.0, 0.0, 0.0, self.discharge]
        scale = np.array([10.0, 1000.0, 1.0, 1.0, 10.0])
        run = solve_ivp(
            self.rates, (times[0], times[-1]), y0, method=method, t_eval=times, rtol=rtol, atol=atol * scale
        )
        assert run.success, run.message
        return run.y.T
