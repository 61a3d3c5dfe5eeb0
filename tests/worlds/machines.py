"""Robots that are not the paper's: drawn constants that fit together, the file that states them, a scale for laws.

Inside they bear the names of the paper's configurations, `6T2A` for tracks and `4W2T` for wheels. `Machine.names`
says what their files and tables call them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from worlds import settled
from worlds.laws import Law
from worlds.paper import NOMINAL, PULLEY, SIDES, G
from worlds.settled import SUPPLIES, TOLERANCES, Conditions, Instruments, between, conditions, robot_toml, typed

TRACKS, WHEELS = "6T2A", "4W2T"
ROLES = (TRACKS, WHEELS)
#: What robots of this generator call their configurations.
NAMES = {TRACKS: "crawler", WHEELS: "rover"}
STEEPEST = 20.0  # [deg]
#: Speeds at full voltage between which a robot is believable [m/s]; current of both motors at most load [A].
FASTEST, SLOWEST, CURRENT = 3.0, 0.3, (0.5, 60.0)
#: Largest share of the adhesion that a run demands: it must not slide.
DEMAND = 0.8


@dataclasses.dataclass(frozen=True)
class Machine:
    """A robot as its maker states it.

    Attributes:
        constants: nominal values by the generator's names.
        names: configurations that it has, and what its file calls them.
        supply: highest voltage [V].
        payload: heaviest [kg].
        instruments: that suit it.
        toml: its file, None for the paper's robot.
    """

    constants: Mapping[str, float]
    names: Mapping[str, str]
    supply: float
    payload: float
    instruments: Instruments
    toml: str | None = None

    @property
    def roles(self) -> tuple[int, ...]:
        """Indices of its configurations, 0 on tracks, 1 on wheels."""
        return tuple(k for k, role in enumerate(ROLES) if role in self.names)

    @property
    def free(self) -> tuple[str, ...]:
        """Constants that its analyst knows within tolerances."""
        lost = [role for role in ROLES if role not in self.names]
        return tuple(n for n in TOLERANCES if n.split(".")[0] not in lost)

    def public(self, name: str) -> str:
        """A constant as the robot's file calls it."""
        head, _, rest = name.partition(".")
        return f"{self.names[head]}.{rest}" if head in self.names else name

    @property
    def size(self) -> dict[str, float]:
        """What tells robots apart, for a campaign's strata."""
        p, first = self.constants, next(iter(self.names))
        return {
            "mass": p[f"{first}.mass"], "ratio": p["gearbox.ratio"], "radius": p[f"{first}.radius"],
            "supply": self.supply,
        }  # fmt: skip

    def label(self, p: Mapping[str, float]) -> dict[str, dict]:
        """What labels say of it and of the surface of true constants."""
        surface = {
            name: {"adhesion": p[f"{role}.ground.friction.static"], "V_s": p[f"{role}.ground.friction.speed_static"]}
            for role, name in self.names.items()
        }
        return {"surface": surface, "robot": self.size}


PAPER = Machine(NOMINAL, {TRACKS: TRACKS, WHEELS: WHEELS}, 33.0, 8.0, Instruments())


def _chassis(rng: np.random.Generator, role: str, mass: float, radius: float, speed_wheel: float) -> dict[str, float]:
    """A configuration. Losses are shares of the torque that carries its weight, m/2 g r_k."""
    tracks = role == TRACKS
    whole = mass / SIDES * G * radius
    found = {
        "mass": mass,
        "radius": radius,
        "inertia": rng.uniform(0.02, 0.05) * mass / SIDES * radius**2,
        "track.loss_coulomb": whole * rng.uniform(*((0.06, 0.18) if tracks else (0.015, 0.04))),
        "track.loss_viscous": whole * rng.uniform(*((0.06, 0.2) if tracks else (0.015, 0.04))) / speed_wheel,
        "track.guide_friction": 0.20,
        "track.guide_share": rng.uniform(0.15, 0.5) if tracks else 0.0,
        "ground.rolling_resistance": rng.uniform(*((0.03, 0.08) if tracks else (0.015, 0.05))),
        "ground.friction.static": rng.uniform(0.35, 0.7),
    }
    found = {name: typed(value) for name, value in found.items()}
    found["ground.friction.dynamic"] = typed(0.8 * found["ground.friction.static"])
    found |= {
        f"ground.friction.{n}": NOMINAL[f"{role}.ground.friction.{n}"] for n in ("speed_static", "speed_dynamic")
    }
    return {f"{role}.{name}": value for name, value in found.items()}


def _drawn(rng: np.random.Generator, roles: Sequence[str]) -> tuple[dict[str, float], float, float] | None:
    """Constants, supply and payload of a robot, None where they make no robot."""
    mass, ratio, radius = between(rng, 2, 60), between(rng, 10, 120), between(rng, 0.02, 0.15)
    supply, no_load = float(rng.choice(SUPPLIES)), between(rng, 300, 1250)
    if not SLOWEST < radius * no_load / ratio < FASTEST:
        return None
    p = dict(NOMINAL) | {"6T2A.radius": PULLEY}
    for role in roles:
        p |= _chassis(rng, role, mass, radius, no_load / ratio)
        mass, radius = mass * rng.uniform(0.85, 1.0), min(radius * rng.uniform(1.0, 1.4), 0.15)
    payload = typed(0.6 * p[f"{roles[0]}.mass"], 2)
    efficiency = rng.uniform(0.6, 0.88)
    demand = max(_torque(p, role, payload, no_load / ratio) for role in roles) / (ratio * efficiency)
    C = supply / no_load
    stall = demand * rng.uniform(8, 25)
    R = C * supply / stall
    dry = demand * rng.uniform(0.02, 0.06)
    p |= {
        "motor.resistance": R,
        "motor.torque_constant": C,
        "motor.inductance": R * rng.uniform(1.2e-4, 4e-4),
        "motor.inertia": C**2 / R * rng.uniform(3e-3, 8e-3),
        "motor.friction_coulomb": dry,
        "motor.friction_viscous": dry * rng.uniform(0.15, 0.35) / no_load,
        "gearbox.ratio": ratio,
        "gearbox.efficiency_load": efficiency,
        "gearbox.friction_coulomb": dry * rng.uniform(0.05, 0.2),
        "gearbox.friction_viscous": dry * rng.uniform(0.4, 0.9) / no_load,
    }
    p = {n: typed(v) if n.startswith(("motor.", "gearbox.")) else v for n, v in p.items()}
    whole = (
        0.02 < R < 15 and CURRENT[0] < SIDES * demand / C < CURRENT[1] and p["motor.inertia"] < 8e-4 and dry < 0.08
    )
    return (p, supply, payload) if whole else None


def _torque(p: Mapping[str, float], role: str, payload: float, speed_wheel: float) -> float:
    """Torque of one side's driving wheel on the steepest slope with the heaviest payload [N·m]."""
    weight = (p[f"{role}.mass"] + payload) / SIDES * G
    pull = np.sin(np.radians(STEEPEST)) + p[f"{role}.ground.rolling_resistance"]
    pull += p[f"{role}.track.guide_friction"] * p[f"{role}.track.guide_share"]
    loss = p[f"{role}.track.loss_coulomb"] + p[f"{role}.track.loss_viscous"] * speed_wheel
    return float(p[f"{role}.radius"] * weight * pull + loss)


def machine(rng: np.random.Generator, roles: Sequence[str]) -> Machine:
    """A robot with these configurations: 2 to 60 kg, ratio 10 to 120, radius 20 to 150 mm, 6 to 48 V."""
    made = None
    while made is None:
        made = _drawn(rng, roles)
    p, supply, payload = made
    names = {role: NAMES[role] for role in roles}
    bare = Machine(p, names, supply, payload, Instruments())
    reference = reference_run(bare)
    sd = [
        typed(x, 2)
        for x in (0.0067 * SIDES * reference.I[0], 0.0008 * reference.w[0] * 30 / np.pi, 4.6 * reference.V[0])
    ]
    step = (typed(sd[0] / 2, 1), typed(sd[1] / 5, 1), typed(sd[2] / 3, 1))
    return dataclasses.replace(bare, instruments=Instruments(tuple(sd), step), toml=toml(p, names))


def toml(p: Mapping[str, float], names: Mapping[str, str]) -> str:
    """The robot's file as its user writes it: every number that the maker states, V_s and V_d left at their defaults."""
    top = {"schema": "mmrjax.robot/2", "configurations": list(names.values())}
    tables: dict[str, dict[str, Any]] = {"": top, "motor": {}, "gearbox": {}}
    for name, value in p.items():
        head, _, rest = name.partition(".")
        if head in ("motor", "gearbox"):
            tables[head][rest] = value
    for role, public in names.items():
        tables[public] = {"movers": "tracks" if role == TRACKS else "wheels"}
        for name, value in p.items():
            head, _, rest = name.partition(".")
            if head != role or rest.endswith(("speed_static", "speed_dynamic")):
                continue
            table, _, key = rest.rpartition(".")
            tables.setdefault(f"{public}.{table}" if table else public, {})[key] = value
    return robot_toml(tables)


# --- conditions -------------------------------------------------------------------------------------


def steepest(p: Mapping[str, float], role: str) -> float:
    """The slope that a robot climbs without sliding [deg], at most STEEPEST."""
    hold = DEMAND * p[f"{role}.ground.friction.static"] - p[f"{role}.ground.rolling_resistance"]
    return min(STEEPEST, float(np.floor(10 * np.degrees(np.arctan(hold))) / 10))


def grid(m: Machine, p: Mapping[str, float], payloads: int = 3) -> Conditions:
    """A grid like Table 8, in what the robot can do: three voltages, five slopes, so many payloads."""
    rows = []
    for wheeled in m.roles:
        slopes = np.round(np.linspace(0, 1, 5) * steepest(p, ROLES[wheeled]), 1)
        heavy = np.unique(np.round(np.linspace(0, 1, payloads) * m.payload, 1))
        voltages = np.round(np.array([0.45, 0.73, 1.0]) * m.supply, 1)
        axes = np.meshgrid(slopes, heavy, voltages, indexing="ij")
        rows.append(np.stack([np.full(axes[0].size, wheeled), *(a.ravel() for a in axes)]))
    w, s, load, u = np.concatenate(rows, 1)
    return conditions(w, u, s, load, p)


# --- laws of another robot's size ---------------------------------------------------------------------

#: Signals by whose ratio a law is fitted to another robot's size, and the one that gives the unit of a balance.
SCALED = (
    "I",
    "line",
    "w",
    "V",
    "w_k",
    "V_teor",
    "B",
    "P",
    "D",
    "N",
    "D_max",
    "M",
    "U",
    "R",
    "C",
    "r",
    "M_t0",
    "M_own",
)
UNITS = {
    "mass": "M", "supply": "U", "electrical": "U", "motor": "torque", "gearbox": "B", "track": "B", "ground": "N",
    "slip": "V", "total_current": "I", "motor_speed": "w", "speed": "V",
}  # fmt: skip


def reference_run(m: Machine) -> SimpleNamespace:
    """Every signal of a robot's ordinary run: highest voltage, half of the payload, 5 degrees, its first configuration."""
    p = dict(m.constants)
    for role in m.names:
        p[f"{role}.ground.friction.static"] = 0.6
    c = conditions([m.roles[0]], m.supply, 5.0, 0.5 * m.payload, p)
    s, sound = settled.solve(c, p)
    if not sound.all():
        raise ValueError("the robot does not move")
    s.torque = s.C * s.I
    return s


def fitted_to(form: Law, m: Machine) -> Law:
    """A law of the paper's robot at another robot's size: signals in units of their ordinary values."""
    if m is PAPER:
        return form
    there, here = reference_run(PAPER), reference_run(m)
    ratio = {k: float(np.mean(getattr(there, k)) / np.mean(getattr(here, k))) for k in (*SCALED, "torque")}
    ratio |= {"payload": PAPER.payload / m.payload, "r_pulley": PULLEY / m.constants["6T2A.radius"]}
    unit = ratio[UNITS[form.balance]]

    def law(s: SimpleNamespace, q: Mapping[str, float]) -> np.ndarray:
        scaled = {k: v * ratio[k] if k in ratio else v for k, v in vars(s).items()}
        return form.of(SimpleNamespace(**scaled), q) / unit

    return dataclasses.replace(form, of=law)
