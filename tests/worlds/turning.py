# ruff: noqa: E741 (symbols as in the paper)
"""A robot of two sides that turns, a second implementation in NumPy and SciPy: nothing here comes from mmrjax.

Constants and the laws of one side are those of `paper` (the paper's). What is new is what two sides do together.
SI throughout. What is assumed:

Axes.  Robot's frame at the middle of the wheelbase, on the ground below the centre of mass: x forward, y to the LEFT,
z up. ω > 0 turns to the left (counter-clockwise from above). Sides are (left, right) at y_s = (+B/2, -B/2).
Ground: X up the slope, Y to the left of who looks up it. ψ from X, positive to the left. ψ = 0 heads uphill, π/2
across with the uphill side on the right, π downhill. Ẋ = v_x cos ψ - v_y sin ψ, Ẏ = v_x sin ψ + v_y cos ψ.
Gravity along the ground, in the robot's frame: m g sin α (-cos ψ, +sin ψ). W = m g cos α.

Motion.  m (v̇_x - ω v_y) = ΣF_x - ΣR_s - m g sin α cos ψ, m (v̇_y + ω v_x) = ΣF_y + m g sin α sin ψ,
J_ψ ω̇ = Σ(x F_y - y F_x) + Σ y_s R_s. J_ψ is the whole robot's about its centre. A payload adds none (it is over
the middle). The centre of mass is in the middle of the wheelbase and of the track. m is the mass of everything.

Rolling resistance  R_s = f N_s σ(v_s), against the motion of the chassis over that side, v_s = v_x - ω y_s (not of
the mover, as in straight travel). σ is `paper.soft_sign` within V_s/10. It acts at y_s, so it has a yaw moment
(on the spot: against the turn). It does not act sideways, and does not count toward the ellipse of friction.

Contact.  A contact at (x, y_s) slides over the ground by the reverse of u, u = (r ω_k,s - v_x + ω y_s, -v_y - ω x). The force
on the robot is  p μ̂(|u|) (φ_x^a u_x, φ_y^a u_y) / |(φ_x^(a-1) u_x, φ_y^(a-1) u_y)|, so always on the ellipse of
semi-axes p φ_x μ̂, p φ_y μ̂, and F·u ≥ 0. a = `rule`: 1 is the issue's (φ_x u_x, φ_y u_y)/|u|, 2 is maximum
dissipation. μ̂ is Fig. 7 with μ_s = 1, μ_d/μ_s of the surface, and of |u| for both rules (isotropic V_s, V_d).
Turning (spin) of a single wheel or grouser about the vertical has no moment: wheels are points.

Loads.  Quasi-static: no roll or pitch of the chassis, no inertia of it. All forces of the ground, resistances
included, act at height 0 and the centre of mass at h:  N_right = W/2 + h ΣF_y / B, N_left = W - N_right, each at least 0
(a side at 0: `tips`). ΣF_y = m (v̇_y + ω v_x) - m g sin α sin ψ is what the contacts give, so forces and loads are
solved together. x_p = -h (ΣF_x - ΣR_s) / W, the same on both sides (twisting of the chassis is not resolved).
Track of length L: p = (N_s/L)(1 + 12 x_p x/L²) while |x_p| ≤ L/6, beyond that a triangle over the length
3 (L/2 - |x_p|) at the loaded end. Nodes cover the loaded length, so sum and moment of the loads are exact.
Wheels: two points at ±L/2 with N_s (1/2 ± x_p/L), each at least 0. Nodes: `gauss` (Gauss-Legendre) or `uniform`
(middles of equal lengths, e.g. one a grouser).

Drive of a side.  Motor, gearbox and mover exactly as `paper.Side.rates`: σ_s of losses by r ω_k,s within V_s/10,
load efficiency by the direction of the torque that reaches the teeth, guide friction r μ_t s N_s σ_s with the side's own
load N_s. The shaft bears r ΣF_x of its own contacts. R_s acts on the chassis.
A side is driven by `voltage` [V, signed], `duty` (of one supply, -1 to 1: U_s = D_s U_e), `speed` (r ω_k,s imposed [m/s];
its current is what the balances then take), or `open` (no current: coasting, dead). Braked is voltage 0.
Supply: U_e external, or the battery's at I_Σ = Σ D_s I_s (signed; 'voltage' sides count as D_s = U_s/U_e only for the
external supply; a battery wants duty). I_Σ < 0 is taken back by the battery or supply here, and flagged (`returns`).

Energy.  In: ΣU_s I_s. Sinks: I² R. Motor and idle loss, teeth, track and guide, rolling. Friction ΣF·u over the contacts.
Stored: ½ m v² + ½ J_ψ ω² + Σ(½ J_w ω_k² + ½ J_d ω_d² + ½ L_d I²) + m g sin α X.

Steady.  `circling` is a zero of the same rates on level ground (with the same soft signs, so an inner side that hardly
turns has one answer). More than one may exist (creep, sliding): it is the one reached from rolling. On a slope `straight` holds the heading
(ω = 0) by a difference between the sides: alike voltages turn the robot across a slope, for its lower side bears more
and loses more. With that difference travel is steady at any heading, not only across and up.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root
from worlds.paper import NOMINAL, G, Side, soft_sign

LENGTH = 0.300  # wheelbase, and of the track on the ground [m], Table 6
WIDTH = 0.243  # between the middles of the movers: half of B_b 208 and B_T 278 mm [m], Table 6
REACH = 0.705  # of the track with its levers level [m], Table 6
#: J_ψ [kg·m²] of Table 7's parts (issue 28): wheels, tracks with folded and with outstretched levers.
INERTIA_YAW = {"4W2T": 0.19, "6T2A": 0.23, "outstretched": 0.33}
#: Height of the centre of mass above the ground without and of a payload's [m]: axles 43.7 and 50 mm.
HEIGHT = {"4W2T": (0.0545, 0.123), "6T2A": (0.0476, 0.1167)}
#: Table 5: φ_x, φ_y of tracks, φ_x, φ_y of wheels.
SURFACES = {
    "linoleum": (0.42, 0.55, 0.52, 0.56),
    "floor": (0.45, 0.55, 0.60, 0.62),
    "wood": (0.32, 0.38, 0.38, 0.43),
    "asphalt": (0.68, 0.70, 0.60, 0.62),
    "concrete": (0.76, 0.78, 0.72, 0.75),
}
#: The state, in this order; then the battery's charge taken [C].
STATES = ("x", "y", "heading", "v_x", "v_y", "omega", "I_left", "I_right", "w_left", "w_right", "charge")
SINKS = ("winding", "motor", "gear", "track", "rolling", "friction")


@dataclasses.dataclass
class Robot:
    """Two sides under one chassis.

    Attributes:
        sides: left and right, each with its own constants (`paper.Side`; its voltage and slope are not used).
        ratio: φ_y/φ_x.
        rule: a of the direction rule.
        width: B [m].
        length: L [m].
        height: h [m].
        inertia: J_ψ [kg·m²].
        wheels: points at ±L/2, else a track over L.
        nodes, scheme: of its quadrature.
        f: of the resistance. Mass: of everything [kg].
    """

    sides: tuple[Side, Side]
    ratio: float
    wheels: bool
    width: float = WIDTH
    length: float = LENGTH
    height: float = HEIGHT["6T2A"][0]
    inertia: float = INERTIA_YAW["6T2A"]
    rule: float = 1.0
    nodes: int = 32
    scheme: str = "gauss"

    def __post_init__(self) -> None:
        side = self.sides[0]
        self.mass, self.r, self.i = side.m + self.sides[1].m, side.r, side.i
        self.y = np.array([self.width / 2, -self.width / 2])
        both = [(s.mu_s, s.mu_d / s.mu_s, s.V_s, s.V_d) for s in self.sides]
        self.law = np.array(both).T[:, :, None]  # φ_x, μ_d/μ_s, V_s, V_d of left and right
        if self.scheme == "gauss":
            at, weight = np.polynomial.legendre.leggauss(self.nodes)
            self._grid = at / 2, weight / 2  # of a length of 1 about 0
        else:
            self._grid = (np.arange(self.nodes) + 0.5) / self.nodes - 0.5, np.full(self.nodes, 1 / self.nodes)


def paper_robot(
    wheeled: bool = False, surface: str = "wood", payload: float = 0.0, battery: bool = False,
    left: dict[str, float] | None = None, right: dict[str, float] | None = None, **changes,
) -> Robot:  # fmt: skip
    """The paper's robot on a surface of Table 5. `left`, `right`: constants of one side by their names."""
    role = "4W2T" if wheeled else "6T2A"
    phi_x, phi_y = SURFACES[surface][2:] if wheeled else SURFACES[surface][:2]
    ground = {f"{role}.ground.friction.static": phi_x, f"{role}.ground.friction.dynamic": 0.8 * phi_x}
    own = [NOMINAL | ground | (p or {}) for p in (left, right)]
    sides = tuple(Side(33.0, 0.0, payload, wheeled, battery, 0.0, p) for p in own)
    mass, (low, high) = own[0][f"{role}.mass"], HEIGHT[role]
    given = {
        "ratio": phi_y / phi_x,
        "height": (mass * low + payload * high) / (mass + payload),
        "inertia": INERTIA_YAW[role],
    }
    return Robot(sides, wheels=wheeled, **(given | changes))  # type: ignore[arg-type]


@dataclasses.dataclass
class Inputs:
    """What drives the sides, and the ground.

    Attributes:
        left, right: by `kind`, each a number or a function of time [s].
        kind: `voltage`, `duty`, `speed` or `open`, of both sides or (left, right).
        slope: α [rad].
        supply: U_e of the external supply, for duties [V].
    """

    left: float | Callable[[float], float]
    right: float | Callable[[float], float]
    kind: str | tuple[str, str] = "voltage"
    slope: float = 0.0
    supply: float = 33.0

    def at(self, t: float) -> tuple[float, float]:
        """Left and right at an instant."""
        return tuple(float(c(t)) if callable(c) else float(c) for c in (self.left, self.right))  # type: ignore[return-value]

    @property
    def kinds(self) -> tuple[str, str]:
        """Of left and right."""
        return (self.kind, self.kind) if isinstance(self.kind, str) else self.kind


# --- contacts ---------------------------------------------------------------------------------------


def adhesion_used(speed: np.ndarray, fall: np.ndarray, V_s: np.ndarray, V_d: np.ndarray) -> np.ndarray:
    """μ̂ of Fig. 7 with μ_s = 1 and μ_d = `fall` at sliding speeds [m/s] ≥ 0."""
    x = np.minimum(speed / V_s, 1.0)
    u = np.clip((speed - V_s) / (V_d - V_s), 0.0, 1.0)
    return np.where(speed < V_s, x * (3 - x * x) / 2, 1 + (fall - 1) * u * u * (3 - 2 * u))


def friction_share(robot: Robot, u_x: np.ndarray, u_y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F_x and F_y on the robot per load of contacts (left and right, ...) that slide by u [m/s]."""
    phi_x, fall, V_s, V_d = robot.law
    phi_y, a = phi_x * robot.ratio, robot.rule
    across = np.hypot(phi_x ** (a - 1) * u_x, phi_y ** (a - 1) * u_y)
    size = adhesion_used(np.hypot(u_x, u_y), fall, V_s, V_d) / np.where(across > 0, across, 1.0)
    return size * phi_x**a * u_x, size * phi_y**a * u_y


def places(robot: Robot, x_p: float) -> tuple[np.ndarray, np.ndarray]:
    """Places x of a side's contacts [m] and their shares of its load, with its centre at x_p [m]."""
    L = robot.length
    x_p = min(max(x_p, -L / 2 * (1 - 1e-9)), L / 2 * (1 - 1e-9))
    if robot.wheels:
        return np.array([L / 2, -L / 2]), np.array([0.5 + x_p / L, 0.5 - x_p / L])
    at, weight = robot._grid
    if abs(x_p) <= L / 6:
        return at * L, weight * (1 + 12 * x_p * at / L)
    loaded = 3 * (L / 2 - abs(x_p))
    end = math.copysign(1.0, x_p)
    return end * (L / 2 - loaded / 2 + at * loaded), weight * (1 + 2 * at)


@dataclasses.dataclass
class Ground:
    """What the ground does: per side (left, right) loads N, traction F_x, F_y, resistance R [N], friction power [W].

    `moment` is the yaw moment of all [N·m], x_p the load's centre [m], `tips` a side without load.
    """

    N: np.ndarray
    F_x: np.ndarray
    F_y: np.ndarray
    R: np.ndarray
    moment: float
    power: np.ndarray
    x_p: float
    tips: bool


def ground(robot: Robot, v_x: float, v_y: float, omega: float, rolled: Sequence[float], W: float) -> Ground:
    """Forces of the ground at velocities of the chassis and speeds r ω_k of the movers [m/s], weight W [N]."""
    rest = 0.1 * robot.sides[0].V_s
    drag = np.array([s.f * soft_sign(v_x - omega * y, rest) for s, y in zip(robot.sides, robot.y, strict=True)])
    push = robot.height / robot.width

    def at(x_p: float) -> Ground:
        """With the loads' centre at x_p. What it would have to be stands in the result."""
        x, share = places(robot, x_p)
        u_x = (np.asarray(rolled) - v_x + omega * robot.y)[:, None] + 0 * x
        u_y = np.broadcast_to(-v_y - omega * x, u_x.shape)
        F_x, F_y = friction_share(robot, u_x, u_y)
        c_x, c_y = F_x @ share, F_y @ share
        # N_right = W/2 + push F_y, F_y = N_left c_left + N_right c_right: linear in F_y.
        right = W / 2 + push * W / 2 * c_y.sum() / (1 - push * (c_y[1] - c_y[0]))
        tips = not 0 < right < W
        right = min(max(right, 0.0), W)
        N = np.array([W - right, right])
        moment = N @ (F_y @ (share * x) - robot.y * (c_x - drag))
        centre = -robot.height * float(N @ (c_x - drag)) / W
        return Ground(
            N, N * c_x, N * c_y, N * drag, float(moment), N * ((F_x * u_x + F_y * u_y) @ share), centre, tips
        )

    x_p, on = 0.0, at(0.0)
    if robot.height == 0:
        return on
    before, gap = x_p, on.x_p - x_p
    x_p = on.x_p
    for _ in range(60):  # secant steps to x_p = what the forces make of it
        on = at(x_p)
        now = on.x_p - x_p
        if abs(now) < 1e-15 or now == gap:
            break
        before, gap, x_p = x_p, now, x_p - now * (x_p - before) / (now - gap)
    return on


@dataclasses.dataclass
class Instant:
    """Everything at an instant: rates of the state, the ground, per side voltage and current, powers [W]."""

    rates: np.ndarray
    ground: Ground
    voltage: np.ndarray
    current: np.ndarray
    electric: float
    sinks: dict[str, float]
    returns: bool


def _losses(side: Side, w: float, N: float) -> tuple[float, float, float]:
    """σ, motor-side loss [N·m at the motor], mover-side loss [N·m at the wheel] at motor speed w."""
    w_k = w / side.i
    sign = soft_sign(side.r * w_k, 0.1 * side.V_s)
    idle = (side.M_df0 + side.M_rf0) * sign + (side.K_fd + side.K_fr) * w
    return sign, idle, side.M_t0 * sign + side.K_ft * w_k + side.r * side.mu_t * side.share * N * sign


def _imposed_current(side: Side, idle: float, load: float, sign: float) -> float:
    """Current at constant speed: i η A = B with η by the direction of the power."""
    eta = side.eta if load * sign >= 0 else 1 / side.eta
    eta = 1 + abs(sign) * (eta - 1)
    return (load / (side.i * eta) + idle) / side.C


def instant(robot: Robot, inputs: Inputs, t: float, state: Sequence[float]) -> Instant:
    """Rates and everything else at a state (`STATES`)."""
    _, _, psi, v_x, v_y, omega = state[:6]
    I, w, charge = np.array(state[6:8], dtype=float), np.array(state[8:10], dtype=float), state[10]
    value, kinds, m = inputs.at(t), inputs.kinds, robot.mass
    for k, side in enumerate(robot.sides):
        if kinds[k] == "speed":
            w[k] = value[k] * side.i / side.r
    rolled = [s.r * w[k] / s.i for k, s in enumerate(robot.sides)]
    W = m * G * math.cos(inputs.slope)
    on = ground(robot, v_x, v_y, omega, rolled, W)
    pull = m * G * math.sin(inputs.slope)
    acceleration = (
        (on.F_x.sum() - on.R.sum() - pull * math.cos(psi)) / m + omega * v_y,
        (on.F_y.sum() + pull * math.sin(psi)) / m - omega * v_x,
        on.moment / robot.inertia,
    )
    idle_loss, mover_loss, sign = np.zeros(2), np.zeros(2), np.zeros(2)
    for k, side in enumerate(robot.sides):
        sign[k], idle_loss[k], mover_loss[k] = _losses(side, w[k], on.N[k])
    load = mover_loss + np.array([s.r for s in robot.sides]) * on.F_x
    for k, side in enumerate(robot.sides):
        if kinds[k] == "speed":
            I[k] = _imposed_current(side, idle_loss[k], load[k], sign[k])
        elif kinds[k] == "open":
            I[k] = 0.0
    first = robot.sides[0]
    total = sum(value[k] * I[k] for k in range(2) if kinds[k] == "duty")
    U_e = inputs.supply
    if first.battery:
        # paper.Side.supply counts 2 I of alike sides: hand it half of the sum.
        U_e = first.supply(total / 2, charge)
    U, dI, dw, teeth = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    for k, side in enumerate(robot.sides):
        A = side.C * I[k] - idle_loss[k]
        if kinds[k] == "speed":
            U[k] = side.C * w[k] + I[k] * side.R
            teeth[k] = A * w[k] - load[k] * w[k] / side.i
            continue
        eta = side.efficiency(A, load[k], sign[k])
        wheel = (side.i * eta * A - load[k]) / (side.J_w + side.J_d * side.i**2 * eta)
        dw[k] = side.i * wheel
        teeth[k] = (1 - eta) * (A - side.J_d * dw[k]) * w[k]
        if kinds[k] == "open":
            U[k] = side.C * w[k]
            continue
        U[k] = value[k] * U_e if kinds[k] == "duty" else value[k]
        dI[k] = (U[k] - side.C * w[k] - I[k] * side.R) / side.L
    turning = w / np.array([s.i for s in robot.sides])
    sinks = {
        "winding": float(sum(s.R * c * c for s, c in zip(robot.sides, I, strict=True))),
        "motor": float(idle_loss @ w),
        "gear": float(teeth.sum()),
        "track": float(mover_loss @ turning),
        "rolling": float(on.R @ (v_x - omega * robot.y)),
        "friction": float(on.power.sum()),
    }
    rates = np.array(
        [
            v_x * math.cos(psi) - v_y * math.sin(psi),
            v_x * math.sin(psi) + v_y * math.cos(psi),
            omega,
            *acceleration,
            *dI,
            *dw,
            total + first.I_p if first.battery else 0.0,
        ]
    )
    drawn = float(U @ I)
    return Instant(rates, on, U, I, drawn, sinks, total < 0 or (total == 0 and drawn < 0))


def rates(robot: Robot, inputs: Inputs, t: float, state: Sequence[float]) -> np.ndarray:
    """d/dt of `STATES`."""
    return instant(robot, inputs, t, state).rates


def stored(robot: Robot, inputs: Inputs, state: Sequence[float]) -> float:
    """Kinetic, magnetic and potential energy [J]."""
    X, _, _, v_x, v_y, omega = state[:6]
    energy = robot.mass * (v_x**2 + v_y**2) / 2 + robot.inertia * omega**2 / 2
    energy += robot.mass * G * math.sin(inputs.slope) * X
    for side, I, w in zip(robot.sides, state[6:8], state[8:10], strict=True):
        energy += side.J_w * (w / side.i) ** 2 / 2 + side.J_d * w**2 / 2 + side.L * I**2 / 2
    return energy


@dataclasses.dataclass
class History:
    """A run: times [s], states (times, 11), energy in and by sink since the start (times,) [J]."""

    times: np.ndarray
    states: np.ndarray
    drawn: np.ndarray
    sinks: dict[str, np.ndarray]

    def __getitem__(self, name: str) -> np.ndarray:
        return self.states[:, STATES.index(name)]


SCALE = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 10.0, 10.0, 1000.0, 1000.0, 10.0])


def simulate(
    robot: Robot, inputs: Inputs, times: np.ndarray, start: Sequence[float] | None = None,
    method: str = "Radau", rtol: float = 1e-9, atol: float = 1e-11,
) -> History:  # fmt: skip
    """States at `times` from `start` (standstill, heading 0), energies integrated beside them."""
    y0 = np.zeros(len(STATES)) if start is None else np.asarray(start, dtype=float)
    for k, side in enumerate(robot.sides):
        if inputs.kinds[k] == "speed":
            y0[8 + k] = inputs.at(times[0])[k] * side.i / side.r
    n = len(y0)

    def right(t: float, y: np.ndarray) -> np.ndarray:
        now = instant(robot, inputs, t, y[:n])
        return np.concatenate([now.rates, [now.electric], [now.sinks[s] for s in SINKS]])

    scale = np.concatenate([SCALE, np.full(1 + len(SINKS), 10.0)])
    begin = np.concatenate([y0, np.zeros(1 + len(SINKS))])
    run = solve_ivp(right, (times[0], times[-1]), begin, method=method, t_eval=times, rtol=rtol, atol=atol * scale)
    assert run.success, run.message
    y = run.y.T
    return History(times, y[:, :n], y[:, n], {s: y[:, n + 1 + k] for k, s in enumerate(SINKS)})


def alone(side: Side, voltage: float, slope: float = 0.0, heading: float = 0.0) -> tuple[float, float, float]:
    """I [A], w [rad/s], V [m/s] of a side in straight travel, by `paper`: where searches begin."""
    own = copy.copy(side)
    own.U, own.battery = abs(voltage), False
    own.N, own.roll = side.m * G * math.cos(slope), side.f * side.m * G * math.cos(slope)
    own.pull = side.m * G * math.sin(slope) * math.cos(heading)
    I, w, V = (np.sign(voltage) * c for c in own.steady() or (0.0, 0.9 * own.U / own.C, 0.0))
    return I, w, V


@dataclasses.dataclass
class Circling:
    """Steady circling on level ground: v_x, v_y [m/s], ω [rad/s], per side I [A], motor speed w [rad/s].

    `residual` is the largest of the scaled balances. Radius and places of the instantaneous centre [m]. `width` is the effective
    track width (r ω_k,right - r ω_k,left)/ω [m].
    """

    v_x: float
    v_y: float
    omega: float
    I: np.ndarray
    w: np.ndarray
    rolled: np.ndarray
    instant: Instant
    residual: float

    @property
    def radius(self) -> float:
        return self.v_x / self.omega

    @property
    def centre(self) -> tuple[float, float]:
        """Instantaneous centre in the robot's frame."""
        return -self.v_y / self.omega, self.v_x / self.omega

    @property
    def width(self) -> float:
        return float(self.rolled[1] - self.rolled[0]) / self.omega


def circling(robot: Robot, inputs: Inputs, guess: Sequence[float] | None = None) -> Circling | None:
    """Steady circling, None where no root is found.

    Args:
        guess: v_x, v_y, ω, else several from rolling, with the effective width 1, 1.5, 2.5 and 5 times the true one.
    """
    assert inputs.slope == 0, "on a slope the heading turns"
    value, kinds = inputs.at(0.0), inputs.kinds
    free = [k for k in range(2) if kinds[k] != "speed"]
    first = robot.sides[0]

    def state(z: np.ndarray) -> np.ndarray:
        y = np.zeros(len(STATES))
        y[3:6] = z[:3]
        y[10] = first.discharge
        for n, k in enumerate(free):
            y[6 + k], y[8 + k] = 10 * z[3 + 2 * n], 1000 * z[4 + 2 * n]
        for k, side in enumerate(robot.sides):
            if kinds[k] == "speed":
                y[8 + k] = value[k] * side.i / side.r
        return y

    def residual(z: np.ndarray) -> np.ndarray:
        d = rates(robot, inputs, 0.0, state(z))
        rest = [[d[6 + k] * robot.sides[k].L / 10, d[8 + k] * robot.sides[k].J_d * 10] for k in free]
        for n, k in enumerate(free):
            if kinds[k] == "open":
                rest[n][0] = z[3 + 2 * n]
        return np.concatenate([d[3:5] / G, [d[5] * robot.inertia], np.ravel(rest)])

    supply = first.supply(0.0, first.discharge) if first.battery else inputs.supply
    rolled, drive = np.zeros(2), []
    for k, side in enumerate(robot.sides):
        U = {"voltage": value[k], "duty": value[k] * supply, "speed": 0.0, "open": 0.0}[kinds[k]]
        I, w, _ = (0.0, value[k] * side.i / side.r, 0.0) if kinds[k] == "speed" else alone(side, U)
        rolled[k] = side.r * w / side.i
        if k in free:
            drive += [I / 10, w / 1000]
    if "open" in kinds:
        k = kinds.index("open")
        rolled[k] = 0.3 * rolled[1 - k]
        drive[2 * free.index(k) + 1] = rolled[k] * robot.i / robot.r / 1000
    guesses = [guess] if guess is not None else [
        (rolled.mean(), 0.0, (rolled[1] - rolled[0]) / robot.width / wide) for wide in (1.5, 1.05, 2.5, 5.0)
    ]  # fmt: skip
    for g in guesses:
        for method in ("hybr", "lm"):
            found = root(residual, np.concatenate([g, drive]), method=method, tol=1e-14)
            left = float(np.abs(residual(found.x)).max())
            if left < 1e-10:
                y = state(found.x)
                now = instant(robot, inputs, 0.0, y)
                turned = np.array([s.r * y[8 + k] / s.i for k, s in enumerate(robot.sides)])
                return Circling(*y[3:6], now.current, y[8:10], turned, now, left)
    return None


@dataclasses.dataclass
class Straight:
    """Straight travel at a constant heading: v_x, v_y [m/s], I [A], w [rad/s]. `steer` is what the right side gets
    more and the left side less than the mean that was asked for [V, or m/s], else the robot would turn."""

    v_x: float
    v_y: float
    steer: float
    I: np.ndarray
    w: np.ndarray
    instant: Instant
    residual: float


def straight(robot: Robot, mean: float, slope: float, heading: float, kind: str = "voltage") -> Straight | None:
    """Steady straight travel on a slope, None where no root is found (it slides, or has no such travel)."""
    speed = kind == "speed"
    side = robot.sides[0]

    def inputs(steer: float) -> Inputs:
        return Inputs(mean - steer, mean + steer, kind, slope)

    def state(z: np.ndarray) -> np.ndarray:
        y = np.zeros(len(STATES))
        y[2], y[3], y[4] = heading, z[0], z[1]
        if not speed:
            y[6:8], y[8:10] = 10 * z[3:5], 1000 * z[5:7]
        return y

    def residual(z: np.ndarray) -> np.ndarray:
        d = rates(robot, inputs(z[2]), 0.0, state(z))
        rest = [] if speed else [*(d[6:8] * side.L / 10), *(d[8:10] * side.J_d * 10)]
        return np.array([d[3] / G, d[4] / G, d[5] * robot.inertia, *rest])

    I, w, V = (0.0, mean * side.i / side.r, 0.99 * mean) if speed else alone(side, mean, slope, heading)
    rest = [] if speed else [I / 10] * 2 + [w / 1000] * 2
    drift = 0.5 * side.V_s * math.sin(slope) * math.sin(heading)
    found = root(residual, np.array([V, drift, 0.0, *rest]), tol=1e-14)
    left = float(np.abs(residual(found.x)).max())
    if left > 1e-10:
        return None
    y, now = state(found.x), instant(robot, inputs(found.x[2]), 0.0, state(found.x))
    w_both = np.full(2, w) + np.array([-1, 1]) * (found.x[2] * side.i / side.r) if speed else y[8:10]
    return Straight(*found.x[:3], now.current, w_both, now, left)


# --- closed forms ----------------------------------------------------------------------------------------


def spot_creep(L: float, B: float, ratio: float, wheels: bool) -> float:
    """v_w/(ω B/2) on the spot without resistance in the creep regime, rule 1 (rule 2: the ratio squared)."""
    return 1 + ratio * (L / B) ** 2 / (1 if wheels else 3)


def spot_coulomb(L: float, B: float, ratio: float = 1.0, drag: float = 0.0, rule: float = 1.0) -> float | None:
    """v_w/(ω B/2) of a uniform track on the spot under Coulomb friction. Drag is f/(μ φ_x). None: it cannot turn.

    Rule 1: moments per μ φ_x N of a side, with u = v_w/ω - b: b u ∫dx/√(u²+x²) - ratio ∫x²dx/√(u²+x²) = 2 a b drag.
    """
    a, b = L / 2, B / 2
    stretch = ratio ** (rule - 1)  # the denominator is √(u² + (stretch x)²)

    def surplus(u: float) -> float:
        v = u / stretch
        one = 2 * math.asinh(a / v) / stretch
        two = (a * math.hypot(a, v) - v * v * math.asinh(a / v)) / stretch
        return b * u * one - ratio**rule * two - 2 * a * b * drag

    if drag >= 1:
        return None
    return 1 + brentq(surplus, 1e-9, 1e6, xtol=1e-15, rtol=1e-14) / b


def moment_lateral(W: float, L: float, phi_y: float, wheels: bool, share: float = 0.0) -> float:
    """Moment against turning of lateral sliding alone [N·m], at a_y/(g φ_y) = share (tracks)."""
    return phi_y * W * L / 2 if wheels else phi_y * W * L / 4 * (1 - share**2)
