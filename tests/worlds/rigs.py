"""Random rigs, one drive or six on wheels, tracks or a bench, with tables of settled runs, from plain NumPy physics.

Shares nothing with mmrjax. Equation numbers are the paper's, symbols too. Friction at the ground is Fig. 7's law, loads
on a shaft are Newton's law. A case is made in five steps: draw a rig as its owner states it, draw its true constants
from the tolerances that its file states, solve the balances, draw an effect that the file does not state and size it so
that it leaves the wanted number of sigmas after a refit of the constants, read the instruments. `Case.write` leaves
`rig.toml` and `table.csv`, what an analyst gets, and `label.json` for the scorer alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from worlds import laws
from worlds.laws import Law, Term
from worlds.paper import G
from worlds.settled import SUPPLIES, Sealed, between, instant, newton, remainder, robot_toml, typed, write_table
from worlds.tables import told_apart

RPM = np.pi / 30

KINDS = ("wheeled", "tracked", "bench", "winch", "linear")
VEHICLES = ("wheeled", "tracked")
IMPOSED = ("voltage", "duty", "motor_speed")
POWER, NO_LOAD, RATIO = (5.0, 200.0), (3000.0, 10_000.0), (5.0, 200.0)  # [W], [rpm], [-]
MOST_MOTORS = 6
ROWS = (16, 60)
STEEPEST, DEMAND = 20.0, 0.8  # [deg]; largest share of the adhesion that a run demands

#: Coarsest displays [sd of the noise], where every row has conditions of its own and where rows are repeats: from two
#: on, repeats round alike and no longer as noise of Δ²/12, which is what an analyst can state.
COARSE = (4.0, 2.0)

#: Channel: column, its unit in SI, sd as a share of the largest reading (least, most).
CHANNELS: dict[str, tuple[str, float, tuple[float, float]]] = {
    "total_current": ("total_current_A", 1.0, (0.004, 0.015)),
    "motor_speed": ("motor_speed_rpm", RPM, (0.0008, 0.004)),
    "speed": ("speed_mm_s", 1e-3, (0.0015, 0.006)),
    "motor_current": ("motor_current_A", 1.0, (0.004, 0.015)),
    "output_speed": ("output_speed_rpm", RPM, (0.0008, 0.004)),
    "motor_voltage": ("motor_voltage_V", 1.0, (0.001, 0.005)),
    "output_torque": ("output_torque_Nm", 1.0, (0.004, 0.015)),
}
#: What rigs have beside a current, by what is imposed; the first sets are the usual ones.
SUBSETS: dict[str, tuple[tuple[str, ...], ...]] = {
    "voltage": ((), ("motor_speed",), ("motor_speed", "speed"), ("speed",), ("output_speed",),
                ("motor_speed", "output_torque")),
    "duty": ((), ("motor_speed",), ("motor_speed", "speed"), ("speed",), ("output_speed", "motor_voltage"),
             ("motor_speed", "output_torque")),
    "motor_speed": ((), ("speed",), ("output_speed", "motor_voltage"), ("motor_voltage",), ("output_torque",)),
}  # fmt: skip

#: Relative sds within which owners know a constant, by the end of its name.
TOLERANCES: dict[str, float] = {
    "motor.resistance": 0.05, "motor.torque_constant": 0.02, "motor.friction_coulomb": 0.15,
    "motor.friction_viscous": 0.15, "gearbox.efficiency_load": 0.03, "gearbox.friction_coulomb": 0.15,
    "gearbox.friction_viscous": 0.15, "loss_coulomb": 0.5, "loss_viscous": 0.5, "torque_constant": 0.1,
    "track.loss_coulomb": 0.15, "track.loss_viscous": 0.15, "track.guide_share": 0.3,
    "ground.rolling_resistance": 0.15, "ground.friction.static": 0.3, "ground.friction.speed_static": 1.0,
    "radius": 0.005,
}  # fmt: skip
#: Those whose tolerance is a normal distribution's; of all others a log-normal one's, the stated value its median.
NORMAL = ("track.guide_share", "torque_constant")


# --- rigs -------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Rig:
    """A rig as its owner states it.

    Attributes:
        kind: of KINDS.
        imposed: of IMPOSED.
        channels: names, in the order of CHANNELS.
        name: of its configuration.
        sides: motors driven alike.
        supply: nominal voltage [V].
        no_load: speed there [rad/s].
        stated: constants by name, those of the load without its configuration.
        tolerances: relative sds of those that are not known exactly.
        written: what the file of a linear unit states in their place, by its keys.
        reverse: whether it has rows backward.
        downhill: whether slopes go down too.
        signed: of each channel, False where its instrument shows the magnitude alone.
        quantum: steps of readings [unit of the column], 0 for none.
    """

    kind: str
    imposed: str
    channels: tuple[str, ...]
    name: str
    sides: int
    supply: float
    no_load: float
    stated: Mapping[str, float]
    tolerances: Mapping[str, float]
    reverse: bool
    downhill: bool
    written: Mapping[str, float] = dataclasses.field(default_factory=dict)
    signed: Mapping[str, bool] = dataclasses.field(default_factory=dict)
    quantum: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def vehicle(self) -> bool:
        """Whether it travels on the ground."""
        return self.kind in VEHICLES

    @property
    def wide(self) -> bool:
        """Whether its imposed levels are a motor speed."""
        return self.imposed == "motor_speed"

    def public(self, name: str) -> str:
        """A constant as mmrjax calls it."""
        return name if name.startswith(("motor.", "gearbox.")) else f"{self.name}.{name}"


def _drive(rng: np.random.Generator, supply: float) -> dict[str, float]:
    """Motor and gearbox as makers' series have them: stall power 6 to 20 times, no-load current 2 to 6 % of nominal,
    two to five per cent lost in each stage of a planetary gear."""
    power, no_load, ratio = between(rng, *POWER), between(rng, *NO_LOAD) * RPM, between(rng, *RATIO)
    current = power / (0.8 * supply)  # nominal
    resistance = supply / (current * rng.uniform(6, 20))
    constant = supply / no_load
    dry = constant * current * rng.uniform(0.02, 0.06)
    viscous = dry * rng.uniform(0.1, 0.4) / no_load
    stages = 1 + int(ratio > 6) + int(ratio > 35) + int(ratio > 150)
    geared = bool(rng.random() < 0.7)  # else its idle loss is in the motor's
    return {
        "motor.resistance": resistance,
        "motor.torque_constant": constant,
        "motor.inductance": resistance * rng.uniform(1.2e-4, 4e-4),
        "motor.inertia": constant**2 / resistance * rng.uniform(3e-3, 8e-3),
        "motor.friction_coulomb": dry,
        "motor.friction_viscous": viscous,
        "gearbox.ratio": ratio,
        "gearbox.efficiency_load": rng.uniform(0.86, 0.95) ** stages,
        "gearbox.friction_coulomb": dry * rng.uniform(0.1, 0.5) * geared,
        "gearbox.friction_viscous": viscous * rng.uniform(0.4, 1.5) * geared,
    }


def _nominal(p: Mapping[str, float], supply: float) -> tuple[float, float, float]:
    """Torque at the output [N·m] at a twelfth of the stall current, no-load speeds of motor and output [rad/s]."""
    current = supply / p["motor.resistance"] / 12
    torque = p["gearbox.ratio"] * p["gearbox.efficiency_load"] * p["motor.torque_constant"] * current
    no_load = supply / p["motor.torque_constant"]
    return torque, no_load, no_load / p["gearbox.ratio"]


def _load(rng: np.random.Generator, kind: str, p: Mapping[str, float], supply: float, sides: int) -> dict[str, float]:
    """Constants of the load, such that about the nominal torque moves it."""
    torque, _, speed = _nominal(p, supply)
    if kind in VEHICLES:
        return _vehicle(rng, kind, torque, speed, sides)
    dry = torque * rng.uniform(0.1, 0.4)
    viscous = torque * rng.uniform(0.1, 0.5) / speed * bool(rng.random() < 0.8)
    inertia = p["motor.inertia"] * p["gearbox.ratio"] ** 2 * between(rng, 0.1, 3.0)
    found = {"inertia": inertia, "loss_coulomb": dry, "loss_viscous": viscous}
    if kind == "bench":
        return found
    # travel per radian at 0.03 to 1 m/s without load: a drum's radius, a screw's or a belt's lead / 2π
    radius = between(rng, 0.03, 1.0) / speed
    if kind == "winch":
        found |= {"loss_coulomb": 0.4 * dry, "torque_constant": torque * rng.uniform(0.3, 0.8)}
    return found | {"radius": radius}


def _vehicle(rng: np.random.Generator, kind: str, torque: float, speed: float, sides: int) -> dict[str, float]:
    tracks = kind == "tracked"
    radius = float(np.clip(between(rng, 0.2, 2.0) / speed, 0.015, 0.25))
    rolling = rng.uniform(*((0.03, 0.08) if tracks else (0.015, 0.05)))
    share = rng.uniform(0.15, 0.5) if tracks else 0.0
    low, high = (0.06, 0.18) if tracks else (0.015, 0.04)
    coulomb, viscous = rng.uniform(low, high), rng.uniform(low, high)
    # the nominal torque takes it, and some payload, up 12 degrees
    weight = torque / (radius * (np.sin(np.radians(12.0)) + rolling + 0.2 * share + coulomb + viscous))
    mass = sides * weight / G / 1.2
    whole = mass / sides * G * radius
    found = {
        "mass": mass,
        "radius": radius,
        "inertia": rng.uniform(0.02, 0.05) * mass / sides * radius**2,
        "track.loss_coulomb": whole * coulomb,
        "track.loss_viscous": whole * viscous / speed,
        "track.guide_friction": 0.2,
        "track.guide_share": share,
        "ground.rolling_resistance": rolling,
        "ground.friction.static": rng.uniform(0.35, 0.8),
        "ground.friction.speed_static": 0.02,
    }
    return found | {
        "ground.friction.dynamic": 0.8 * found["ground.friction.static"],
        "ground.friction.speed_dynamic": 0.2,
    }


#: Constants of a linear unit as its owner states them: key of the file, and the power of the radius r that makes of a
#: constant at the shaft the one in the file; of the radius itself, the lead 2π r in mm.
LINEAR: dict[str, tuple[str, float]] = {
    "radius": ("lead_mm", np.nan), "inertia": ("mass_kg", -2), "loss_coulomb": ("force_coulomb_N", -1),
    "loss_viscous": ("force_viscous_N_s_m", -2),
}  # fmt: skip


def _linear(radius: float, power: float) -> float:
    return 2e3 * np.pi if np.isnan(power) else radius**power


def rig(
    rng: np.random.Generator, kind: str | None = None, imposed: str | None = None, like: Rig | None = None
) -> Rig:
    """A rig, of a kind and with something imposed where these are given.

    Args:
        like: another one, which it has in common with that its equations, channels and their signs and directions are
            the same. Its constants are its own.
    """
    if like is None:
        return _any_rig(rng, kind, imposed)
    while True:
        own = _any_rig(rng, like.kind, like.imposed)
        without = [{n for n, x in r.stated.items() if x == 0} for r in (own, like)]
        if without[0] == without[1] and ("motor_current" not in like.channels or own.sides == 1):
            return dataclasses.replace(own, channels=like.channels, reverse=like.reverse, signed=like.signed)


def _any_rig(rng: np.random.Generator, kind: str | None, imposed: str | None) -> Rig:
    kind = kind or str(rng.choice(KINDS))
    imposed = imposed or str(rng.choice(IMPOSED))
    vehicle = kind in VEHICLES
    sides = int(rng.integers(1, MOST_MOTORS, endpoint=True)) if vehicle else int(rng.choice((1, 1, 1, 2, 3, 6)))
    sides = 1 if kind == "linear" else sides
    supply = float(rng.choice(SUPPLIES))
    while True:
        p = _drive(rng, supply)
        p |= _load(rng, kind, p, supply, sides)
        if not vehicle or (0.3 < p["mass"] < 200 and p["radius"] * _nominal(p, supply)[2] < 4):
            break
    p = {n: typed(v) for n, v in p.items()}
    written = {}
    if kind == "linear":
        written = {key: typed(p[n] * _linear(p["radius"], power)) for n, (key, power) in LINEAR.items()}
        radius = written["lead_mm"] / (2e3 * np.pi)
        p |= {n: written[key] / _linear(radius, power) for n, (key, power) in LINEAR.items()}
    if vehicle:
        p["ground.friction.dynamic"] = typed(0.8 * p["ground.friction.static"], 9)
    ends = {n: t for n, t in TOLERANCES.items() if p.get(n, 0.0) > 0}
    if not vehicle:
        ends.pop("radius", None)  # of a screw or a drum it is known, and so it is beside the speed alone
    which = SUBSETS[imposed]
    further = which[rng.integers(len(which))]
    if vehicle and rng.random() < 0.6:  # the usual instruments of a vehicle
        further = ("speed",) if imposed == "motor_speed" else ("motor_speed", "speed")
    if kind == "bench":  # does not travel
        further = tuple(n for n in further if n != "speed")
    current = "motor_current" if sides == 1 and rng.random() < 0.3 else "total_current"
    names = tuple(n for n in CHANNELS if n in (current, *further))
    reverse = bool(rng.random() < (0.5 if kind != "winch" else 0.7))
    return Rig(
        kind, imposed, names, {"wheeled": "rover", "tracked": "crawler", "linear": "carriage"}.get(kind, kind),
        sides, supply, _nominal(p, supply)[1], p, ends, reverse, vehicle and bool(rng.random() < 0.3), written,
        {n: not (reverse and n != "output_torque" and rng.random() < 0.25) for n in names},
    )  # fmt: skip


def truth(rng: np.random.Generator, r: Rig) -> tuple[dict[str, float], dict[str, float]]:
    """True constants drawn from the tolerances that the rig's file states, and where in them they are (standard
    normal, cut at 2.5)."""
    p, z = dict(r.stated), {}
    for name, share in r.tolerances.items():
        z[name] = float(np.clip(rng.standard_normal(), -2.5, 2.5))
        p[name] = moved(name, p[name], share * z[name] if name in NORMAL else np.sqrt(np.log1p(share**2)) * z[name])
    for follower, leader in (("dynamic", "static"), ("speed_dynamic", "speed_static")):
        if f"ground.friction.{leader}" in p:  # keep their stated ratio
            ratio = p[f"ground.friction.{leader}"] / r.stated[f"ground.friction.{leader}"]
            p[f"ground.friction.{follower}"] = r.stated[f"ground.friction.{follower}"] * ratio
    return p, z


def moved(name: str, value: float, by: float) -> float:
    """A constant moved by a share of its value, or of its logarithm. Within what efficiencies and shares can be."""
    u = value * (1 + by) if name in NORMAL else value * float(np.exp(by))
    return float(np.clip(u, 0.02, 0.98)) if name in ("gearbox.efficiency_load", "track.guide_share") else u


# --- conditions -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Conditions:
    """One array a column, shape (rows,), in the order of measuring: supply [V] and duty [-], or motor speed [rad/s].
    Slope [rad], payload [kg]. The direction of travel, 1 or -1, and torque of a brake on a shaft [N·m]."""

    supply: np.ndarray
    duty: np.ndarray
    motor_speed: np.ndarray
    slope: np.ndarray
    payload: np.ndarray
    direction: np.ndarray
    load_torque: np.ndarray

    def __len__(self) -> int:
        return len(self.supply)

    @property
    def order(self) -> np.ndarray:
        """Place in the sequence of rows, 0 to 1."""
        return np.arange(len(self)) / max(len(self) - 1, 1)


def conditions(rng: np.random.Generator, r: Rig, p: Mapping[str, float]) -> Conditions:
    """A grid over what is imposed, slopes and payloads where it is a vehicle, and directions, repeated to between 16
    and 60 rows, in the order of the grid or shuffled."""
    directions = (1.0, -1.0) if r.reverse else (1.0,)
    slopes, payloads = np.zeros(1), np.zeros(1)
    if r.vehicle:
        hold = DEMAND * p["ground.friction.static"] - p["ground.rolling_resistance"]
        steep = min(STEEPEST, float(np.degrees(np.arctan(max(hold, 0.02)))))
        slopes = np.floor(10 * steep * np.linspace(-1.0 if r.downhill else 0.0, 1.0, int(rng.integers(2, 5)))) / 10
        heavy = typed(0.4 * r.stated["mass"], 2)
        payloads = np.unique(np.round(np.linspace(0, heavy, int(rng.integers(1, 4))), 2))
    others = len(slopes) * len(payloads) * len(directions)
    levels = int(np.clip(rng.integers(4, 11), 2, max(ROWS[1] // others, 2)))
    low = rng.uniform(0.1, 0.3) if r.imposed == "motor_speed" else rng.uniform(0.3, 0.5)
    share = np.round(np.linspace(low, 1.0, levels), 3)
    grid = [a.ravel() for a in np.meshgrid(share, slopes, payloads, directions, indexing="ij")]
    count = len(grid[0])
    times = int(rng.integers(-(-ROWS[0] // count), max(ROWS[1] // count, -(-ROWS[0] // count)), endpoint=True))
    rows = np.tile(np.arange(count), min(times, 8))
    if rng.random() < 0.5:
        rows = rng.permutation(rows)
    share, slope, payload, direction = (a[rows] for a in grid)
    ones = np.ones(len(rows))
    speed = np.round(0.9 * r.no_load / RPM * share, 1) * RPM * direction
    supply = np.round(r.supply * share, 2) * direction if r.imposed == "voltage" else r.supply * ones
    duty = np.round(share, 3) * direction if r.imposed == "duty" else ones
    return Conditions(supply, duty, speed, np.radians(slope), payload, direction, 0 * ones)


# --- the balances -----------------------------------------------------------------------------------


def _scales(r: Rig, p: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Orders of size of the unknowns and of what is left in their balances, shape (3, 1) each."""
    torque, no_load, speed = _nominal(p, r.supply)
    x = np.array([r.supply / p["motor.resistance"] / 12, no_load, p.get("radius", 1.0) * speed])
    f = np.array([no_load if r.wide else r.supply, torque, x[2]])
    return x[:, None], f[:, None]


def solve(
    r: Rig, c: Conditions, p: Mapping[str, float], terms: Sequence[Term] = ()
) -> tuple[SimpleNamespace, np.ndarray]:
    """Every quantity of all rows at their operating points, by Newton's method, and which rows are sound: they move as
    they are driven, do not slide and travel more than a third of what they roll."""
    size, left = _scales(r, p)
    given = SimpleNamespace(
        sides=r.sides, supply=None if r.wide else c.supply, duty=np.ones(len(c)) if r.wide else c.duty, d=c.direction,
        motor_speed=c.motor_speed if r.wide else None, slope=c.slope, payload=c.payload, order=c.order,
        mass=p["mass"] + c.payload if r.vehicle else None, load_torque=c.load_torque,
    )  # fmt: skip

    def at(x: np.ndarray) -> SimpleNamespace:
        return instant(x, given, p, terms, r.channels)

    def residual(x: np.ndarray) -> np.ndarray:
        s = at(x)
        return np.stack([s.volts_left, s.torque_left, s.speed_left]) / left

    speed = c.motor_speed if r.wide else 0.9 * c.duty * c.supply / p["motor.torque_constant"]
    x = np.stack([size[0] * c.direction, speed, p.get("radius", 1.0) * speed / p["gearbox.ratio"]])
    x = newton(residual, x, size, 40, 3.0, 1e-13)
    with np.errstate(all="ignore"):
        s, f = at(x), residual(x)
    sound = np.isfinite(f).all(0) & (np.abs(f).max(0) < 1e-9) & ~s.slides & np.isfinite(s.shown).all(0)
    sound &= (s.w * c.direction > 0.02 * r.no_load) & (s.V * c.direction > 0.3 * np.abs(s.V_teor))
    return s, sound


# --- signatures -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class About:
    """What of a rig decides which effects it can have and show: whether it is a vehicle. What is imposed, its channels.
    Whether it has rows backward, and at least three rows whose load drives the motor. How many slopes and payloads."""

    vehicle: bool
    imposed: str
    channels: tuple[str, ...]
    reverse: bool
    driven: bool
    slopes: int
    payloads: int

    def has(self, *names: str) -> bool:
        """Whether it has any of these channels."""
        return bool(set(names) & set(self.channels))

    @property
    def electric(self) -> bool:
        """Whether anything shows the electrical balance: a voltage imposed or read, and beside it two more readings of
        three unknowns would leave its equation closed only by its constants."""
        return self.imposed != "motor_speed" or self.has("motor_voltage")

    @property
    def slips(self) -> bool:
        """Whether ground speed stands beside the speed of the shafts."""
        return self.vehicle and self.has("speed") and (self.imposed == "motor_speed" or self.has("motor_speed"))


@dataclasses.dataclass(frozen=True)
class World:
    """What a table is measured in: a rig, its true constants, where in the tolerances they are, conditions, and the sds
    of its channels' noise [unit of the column]."""

    rig: Rig
    constants: Mapping[str, float]
    z: Mapping[str, float]
    conditions: Conditions
    sd: Mapping[str, float]

    def readings(self, terms: Sequence[Term] = (), p: Mapping[str, float] | None = None) -> tuple[np.ndarray, Any]:
        """What the instruments show without noise [units of the columns], shape (channels, rows), and sound rows."""
        s, sound = solve(self.rig, self.conditions, p or self.constants, terms)
        return s.shown / self._units, sound

    @property
    def _units(self) -> np.ndarray:
        return np.array([CHANNELS[n][1] for n in self.rig.channels])[:, None]

    @property
    def stated(self) -> np.ndarray:
        """Sd of a reading, rounding included [units of the columns], shape (channels, 1)."""
        step = [self.rig.quantum.get(n, 0.0) for n in self.rig.channels]
        return np.hypot([self.sd[n] for n in self.rig.channels], np.array(step) / np.sqrt(12))[:, None]

    def moved(self, z: Mapping[str, float]) -> dict[str, float]:
        """The true constants, each so many sds of its tolerance further."""
        p = dict(self.constants)
        for name, x in z.items():
            share = self.rig.tolerances[name]
            sd = share * self.rig.stated[name] / p[name] if name in NORMAL else np.sqrt(np.log1p(share**2))
            p[name] = moved(name, p[name], sd * x)
        return p

    def slopes(self) -> np.ndarray:
        """Whitened change of the readings for one sd of each constant's tolerance, shape (readings, constants)."""
        base, _ = self.readings()
        columns = []
        for name in self.rig.tolerances:
            there, _ = self.readings(p=self.moved({name: 1e-4}))
            columns.append(((there - base) / 1e-4 / self.stated).ravel())
        return np.stack(columns, 1)

    def signature(self, terms: Sequence[Term]) -> np.ndarray:
        """Whitened change of all readings by the terms, shape (readings,), NaN where a row is lost."""
        (with_them, a), (without, b) = self.readings(terms), self.readings()
        return np.where(a & b, (with_them - without) / self.stated, np.nan).ravel()

    def scale(self) -> SimpleNamespace:
        """Largest size of each signal without any effect, for sizes and shapes of laws."""
        s, _ = solve(self.rig, self.conditions, self.constants)
        signals = {
            k: float(np.max(np.abs(v))) for k, v in vars(s).items() if isinstance(v, np.ndarray) and v.ndim == 1
        }
        torque, *_ = _nominal(self.constants, self.rig.supply)
        current = self.rig.supply / s.R / 12
        return SimpleNamespace(**signals | {"torque": max(signals["B"], 0.5 * torque), "sides": s.sides, "ratio": s.ratio,
                                            "current": max(signals["I"], 0.5 * current), "C": s.C, "supply": self.rig.supply,
                                            "rated": 0.3 * self.rig.supply / s.R})  # fmt: skip

    def posterior(self) -> dict[str, float]:
        """Posterior sd of each constant over its prior's, linear at the truth: of how much the table says of it."""
        slopes = self.slopes()
        covariance = np.linalg.inv(slopes.T @ slopes + np.eye(slopes.shape[1]))
        return dict(zip(self.rig.tolerances, np.sqrt(np.diag(covariance)).tolist(), strict=True))

    def applicable(self, forms: Mapping[str, Law]) -> tuple[str, ...]:
        """Names of those forms that this rig can have."""
        about = About(
            self.rig.vehicle, self.rig.imposed, self.rig.channels, self.rig.reverse, self._driven(),
            len(np.unique(self.conditions.slope)), len(np.unique(self.conditions.payload)),
        )  # fmt: skip
        return tuple(n for n, form in forms.items() if form.needs(about))

    def _driven(self) -> bool:
        s, _ = solve(self.rig, self.conditions, self.constants)
        return bool((s.B * self.conditions.direction < 0).sum() >= 3)


def world(
    rng: np.random.Generator,
    kind: str | None = None,
    imposed: str | None = None,
    like: Rig | None = None,
    rows: tuple[int, int] = ROWS,
) -> World:
    """A rig with its truth and conditions all of whose rows are sound. Instruments that suit its readings.

    Args:
        kind, imposed, like: see `rig`.
        rows: fewest and most.
    """
    for _ in range(2000):
        r = rig(rng, kind, imposed, like)
        p, z = truth(rng, r)
        c = conditions(rng, r, p)
        s, sound = solve(r, c, p)
        if not sound.all() or not rows[0] <= len(c) <= rows[1]:
            continue
        largest = np.abs(s.shown).max(1)
        sd, quantum = {}, {}
        coarse = rng.random() < 0.25
        repeated = int(
            np.unique(np.stack([getattr(c, f.name) for f in dataclasses.fields(c)]), axis=1).shape[1] < len(c)
        )
        for name, most in zip(r.channels, largest, strict=True):
            column_unit, share = CHANNELS[name][1], rng.uniform(*CHANNELS[name][2])
            sd[name] = typed(share * most / column_unit, 2)
            if coarse and rng.random() < 0.7:
                quantum[name] = typed(sd[name] * rng.uniform(1.0, COARSE[repeated]), 2)
        return World(dataclasses.replace(r, quantum=quantum), p, z, c, sd)
    raise ValueError("no such rig whose rows are all sound")


def rising(w: World) -> World:
    """The same world with rows in the order of rising drive, whatever its direction."""
    c = w.conditions
    drive = np.abs(c.motor_speed if w.rig.wide else c.supply * c.duty)
    rows = np.lexsort((c.payload, c.slope, c.direction, drive))
    kept = {f.name: getattr(c, f.name)[rows] for f in dataclasses.fields(c)}
    return dataclasses.replace(w, conditions=Conditions(**kept))


def left_over(w: World, terms: Sequence[Term], slopes: np.ndarray) -> float:
    """Root of what a fit of the constants leaves of readings without noise [σ], their tolerances around the truth:
    steps of Levenberg and Marquardt, the first ones on the slopes at the truth."""
    y, sound = w.readings(terms)
    if not sound.all():
        return np.nan
    names, at = list(w.rig.tolerances), np.zeros(slopes.shape[1])

    def objective(z: np.ndarray) -> np.ndarray:
        there, _ = w.readings(p=w.moved(dict(zip(names, z, strict=True))))
        left = np.concatenate([((y - there) / w.stated).ravel(), -z])
        return np.where(np.isfinite(left), left, 1e3)

    left, damping = objective(at), 1e-3
    columns = np.concatenate([-slopes, -np.eye(len(at))])
    for step in range(40):
        if step > 2:
            columns = np.stack([(objective(at + 1e-4 * e) - left) / 1e-4 for e in np.eye(len(at))], 1)
        move = np.linalg.solve(columns.T @ columns + damping * np.eye(len(at)), -columns.T @ left)
        there = objective(at + move)
        gained = float(left @ left - there @ there)
        if gained > 0:
            at, left, damping = at + move, there, 0.2 * damping
        else:
            damping *= 10.0
        if step > 3 and (0 <= gained < 1e-3 * float(left @ left) or damping > 1e6):
            break
    return float(np.linalg.norm(left))


def sized(w: World, term: Term, sigmas: float, slopes: np.ndarray) -> tuple[Term, float]:
    """The term with the amplitude at which `sigmas` are left after a refit of the constants, and how many really are.

    Secant steps from a hundredth of its ordinary size, at first by the linear remainder. Fewer sigmas come back where
    rows would be lost.
    """
    amplitude = 0.01 * term.law.size * np.sign(term.amplitude)
    best = (dataclasses.replace(term, amplitude=amplitude), 0.0)
    exact = False
    for _ in range(12):
        now = dataclasses.replace(term, amplitude=float(amplitude))
        sign = w.signature([now])
        if not np.isfinite(sign).all():
            amplitude = 0.5 * (amplitude + best[0].amplitude)
            continue
        left = left_over(w, [now], slopes) if exact else float(np.linalg.norm(remainder(sign, slopes)))
        best = (now, left) if left > 0 else best
        if left < 1e-9 or abs(amplitude) > 10 * term.law.size or (exact and abs(left - sigmas) < 0.03 * sigmas):
            break
        if abs(left - sigmas) < 0.03 * sigmas:
            exact = True
            continue
        amplitude *= np.clip(sigmas / left, 0.1, 30.0)
    return best[0], left_over(w, [best[0]], slopes)


def oracle(w: World, term: Term, slopes: np.ndarray) -> dict[str, Any]:
    """Library effects that noise-free data could not tell from a term, and what the best other one would leave [σ]."""
    left = remainder(np.nan_to_num(w.signature([term])), slopes)
    size, scale, apart = float(np.linalg.norm(left)), w.scale(), {}
    for name in w.applicable(laws.RIGS):
        law = laws.RIGS[name].at(scale)
        found = []
        for shapes in law.grid():
            unit = remainder(np.nan_to_num(w.signature([Term(name, 0.02 * law.size, shapes, law)])), slopes)
            norm = float(np.linalg.norm(unit))
            along = float(left @ unit) / norm if norm > 1e-9 else 0.0
            if law.either or along > 0:
                found.append(float(np.sqrt(max(size**2 - along**2, 0.0))))
        apart[name] = min(found, default=size)
    return told_apart(apart, size, term.law.cls)


#: Effects that a rig may have.
FORMS = laws.RIGS | laws.OUTSIDE_RIGS


# --- cases ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Case(Sealed):
    """A rig with its table and its label, and what it was made from."""

    world: World
    terms: tuple[Term, ...]


def case(w: World, name: str = "", sigmas: float = 8.0, seed: int = 0) -> Case:
    """A case of a world.

    Args:
        name: of an effect of FORMS that the rig's file does not state. Empty makes a clean table.
        sigmas: that it leaves after a refit of the constants with their tolerances.
        seed: of shapes, sign and noise.
    """
    rng = np.random.default_rng([99, seed])
    terms: tuple[Term, ...] = ()
    effects = []
    if name:
        with np.errstate(all="ignore"):
            slopes = w.slopes()
            term, left = sized(w, laws.draw(name, rng, FORMS[name].at(w.scale())), sigmas, slopes)
            alike = oracle(w, term, slopes)
        terms = (term,)
        effects.append(term.label | {"sigmas": left, **alike})
    y, sound = w.readings(terms)
    r = w.rig
    label = {
        "schema": "mmrjax.sealed-rig/1",
        "seed": seed,
        "kind": "clean" if not name else "library" if name in laws.RIGS else "outside",
        "stratum": r.kind, "load": r.kind, "imposed": r.imposed, "channels": list(r.channels), "sides": r.sides, "supply": r.supply,
        "reverse": r.reverse, "unsigned": [n for n, s in r.signed.items() if not s], "quantum": dict(r.quantum),
        "rows": len(w.conditions), "rows_lost": int((~sound).sum()), "effects": effects,
        "constants": {r.public(n): w.constants[n] for n in r.tolerances},
        "z": {r.public(n): z for n, z in w.z.items()},
        "sd_over_prior": {r.public(n): x for n, x in w.posterior().items()},
    }  # fmt: skip
    return Case(_table(w, y, sound, rng), label, toml(r), w, terms)


def settings(r: Rig, c: Conditions) -> dict[str, np.ndarray]:
    """Columns of what is imposed."""
    speed = {"motor_speed_rpm": np.round(c.motor_speed / RPM, 6)}
    kept = speed if r.wide else {"supply_voltage_V": c.supply}
    if r.imposed == "duty":
        kept["duty"] = c.duty
    if r.vehicle:
        kept |= {"slope_deg": np.round(np.degrees(c.slope), 6), "payload_kg": c.payload}
    return kept


def _table(w: World, y: np.ndarray, sound: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    r, c = w.rig, w.conditions
    kept = settings(r, c)
    noise = rng.standard_normal(y.shape)
    for k, name in enumerate(r.channels):
        shown = y[k] + w.sd[name] * noise[k]
        if step := r.quantum.get(name, 0.0):
            shown = np.round(shown / step) * step
        kept[CHANNELS[name][0]] = np.array([typed(x, 9) for x in (shown if r.signed[name] else np.abs(shown))])
    for name in r.channels:
        column, _, unit = CHANNELS[name][0].rpartition("_") if name != "speed" else ("speed", "", "mm_s")
        kept[f"{column}_sd_{unit}"] = np.full(len(c), w.sd[name])
    return {name: column[sound] for name, column in kept.items()}


def toml(r: Rig) -> str:
    """The rig's file as its owner writes it: nothing of another robot, numbers with their tolerances."""
    load = {"load": "vehicle" if r.vehicle else "linear" if r.kind == "linear" else "shaft"}
    if r.vehicle:
        load["movers"] = "tracks" if r.kind == "tracked" else "wheels"
    top = {"schema": "mmrjax.robot/2", "base": "none", "sides": r.sides}
    top |= {"imposed": "motor_speed" if r.wide else "voltage", "channels": r.channels, "configurations": [r.name]}
    tables: dict[str, dict[str, Any]] = {"": top, "motor": {}, "gearbox": {}, r.name: load}
    for name, value in r.stated.items():
        table, _, key = r.public(name).rpartition(".")
        if r.written and table == r.name:
            key = LINEAR[name][0]
            value = r.written[key]
        share = r.tolerances.get(name, 0.0 if name == "radius" and not r.vehicle else None)
        number = float(value)
        tables.setdefault(table, {})[key] = number if share is None else f"{number!r} ± {100 * share:g} %"
    for name in r.channels:
        known = {} if r.signed[name] else {"signed": False}
        if name in r.quantum:
            known["quantum"] = r.quantum[name]
        if known:
            tables[f"instruments.{name}"] = known
    return robot_toml(tables)


# --- logs ---------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Log:
    """A log.

    Attributes:
        table: its columns.
        level: index of the level of each row.
        settled: readings of each level without noise [unit], shape (levels, channels).
        channels: names.
        sd: noise of a sample [unit], by channel.
    """

    table: dict[str, np.ndarray]
    level: np.ndarray
    settled: np.ndarray
    channels: tuple[str, ...]
    sd: dict[str, float]

    def write(self, path):
        """The log as a CSV file."""
        write_table({n: [f"{x:.9g}" for x in column] for n, column in self.table.items()}, path)


def log(
    w: World,
    rng: np.random.Generator,
    *,
    hold: float = 2.0,
    rate: float = 100.0,
    lag: float = 0.15,
    noise: float = 1.0,
    jitter: float = 0.1,
    delay: float = 0.0,
    step: float = 0.0,
    terms: tuple[Term, ...] = (),
) -> Log:
    """A log that goes through the rows of a world's table.

    Args:
        hold: of each level [s].
        rate: samples a second.
        lag: time constant of the transitions [s].
        noise: of a sample, over the sd that the world has of settled readings.
        jitter: sd of the clock, over a step.
        terms: effects that the rig's file does not state (`case`).
        delay: of the readings against what is imposed [s].
        step: of the instruments, over the sd of a sample.
    """
    shown, sound = w.readings(terms)
    assert sound.all()
    per = round(hold * rate)
    rows = per * len(w.conditions)
    level = np.repeat(np.arange(len(w.conditions)), per)
    time = np.arange(rows) / rate
    time[1:] += np.clip(jitter * rng.standard_normal(rows - 1), -0.4, 0.4) / rate
    c, r = w.conditions, w.rig
    table = {"time_s": np.round(time, 6)} | {n: column[level] for n, column in settings(r, c).items()}
    sds = {}
    late = round(delay * rate)
    settled = np.stack([s if w.rig.signed[n] else np.abs(s) for n, s in zip(r.channels, shown, strict=True)], 1)
    decay = np.exp(-1 / (rate * lag))
    for k, name in enumerate(r.channels):
        target = settled[level, k]
        target = np.concatenate([np.full(late, target[0]), target[: rows - late]])
        x, at = np.empty(rows), target[0]
        for i in range(rows):
            at = target[i] + (at - target[i]) * decay
            x[i] = at
        sds[name] = noise * w.sd[name]
        x = x + sds[name] * rng.standard_normal(rows)
        if step:
            x = np.round(x / (step * sds[name])) * step * sds[name]
        table[CHANNELS[name][0]] = x
    return Log(table, level, settled, r.channels, sds)
