"""Settled motion in plain NumPy: the balances of drives and what they move, shared by robots and rigs, nothing of mmrjax.

Equation numbers are the paper's, symbols too. Friction at the ground is Fig. 7's law, loads on a shaft are Newton's law.
Newton's method goes over all rows at once. Here too are the paper's robot as its analyst knows it, the conditions of its
tables, and what a refit of constants leaves of an effect.
"""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from worlds import laws
from worlds.laws import CHANNELS, Term
from worlds.paper import NOMINAL, SIDES, G

# --- numbers and files --------------------------------------------------------------------------------

SUPPLIES = (6.0, 7.4, 12.0, 18.0, 24.0, 36.0, 48.0)  # that robots and rigs have [V]


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two, uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def typed(x: float, digits: int = 3) -> float:
    """A number as a person types it."""
    return float(f"{x:.{digits}g}")


def write_table(table: Mapping[str, np.ndarray], path: Path) -> Path:
    """A table as the file that a user has, missing readings as empty cells."""
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(table)
        for row in zip(*table.values(), strict=True):
            out.writerow(["" if isinstance(x, float) and np.isnan(x) else x for x in row])
    return path


def robot_toml(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """A robot's file as its owner writes it: of each table keys and values. The first is of the top."""

    def written(x: Any) -> str:
        if isinstance(x, bool):
            return str(x).lower()
        if isinstance(x, list | tuple):
            return f"[{', '.join(map(written, x))}]"
        return f'"{x}"' if isinstance(x, str) else repr(x)

    heads = [f"[{name}]\n" if name else "" for name in tables]
    bodies = ["\n".join(f"{k} = {written(x)}" for k, x in table.items()) for table in tables.values()]
    return "\n\n".join(head + body for head, body in zip(heads, bodies, strict=True)) + "\n"


@dataclasses.dataclass(frozen=True)
class Sealed:
    """A table, what an analyst gets of it, and its label.

    Attributes:
        table: columns of a CSV, NaN where a reading is missing.
        label: truth, for the scorer alone.
        toml: the robot's file, None for the paper's.
    """

    table: dict[str, np.ndarray]
    label: dict[str, Any]
    toml: str | None

    def write(self, folder: Path) -> None:
        """`table.csv`, `label.json` and, of another robot than the paper's, `rig.toml` in a folder, which is made."""
        folder.mkdir(parents=True, exist_ok=True)
        write_table(self.table, folder / "table.csv")
        (folder / "label.json").write_text(json.dumps(self.label, indent=1), encoding="utf-8")
        if self.toml is not None:
            (folder / "rig.toml").write_text(self.toml, encoding="utf-8")


# --- what is known of the robot ---------------------------------------------------------------------

#: Constants of a robot that climbs 20 degrees: `reference.NOMINAL` on a surface that holds.
CLIMBING: dict[str, float] = dict(NOMINAL)
for _c in ("6T2A", "4W2T"):
    CLIMBING |= {f"{_c}.ground.friction.static": 0.60, f"{_c}.ground.friction.dynamic": 0.48}

#: Relative standard deviation within which a constant is known (guide share: of its nominal 0.3).
TOLERANCES: dict[str, float] = {
    "motor.resistance": 0.05,
    "motor.torque_constant": 0.02,
    "motor.friction_coulomb": 0.15,
    "motor.friction_viscous": 0.15,
    "gearbox.efficiency_load": 0.03,
    "gearbox.friction_coulomb": 0.15,
    "gearbox.friction_viscous": 0.15,
    "6T2A.track.guide_share": 0.3,
    **{
        f"{c}.{name}": sd
        for c in ("6T2A", "4W2T")
        for name, sd in {
            "track.loss_coulomb": 0.15,
            "track.loss_viscous": 0.15,
            "ground.rolling_resistance": 0.15,
            "ground.friction.static": 0.15,
            "ground.friction.speed_static": 0.3,
            "radius": 0.005,
        }.items()
    },
}
#: The subset that bears on friction and slip; the makers' constants stay at their sheets.
FRICTION = tuple(n for n in TOLERANCES if ".track." in n or ".ground." in n)


def perturbed(rng: np.random.Generator, names: Sequence[str] = tuple(TOLERANCES), scale: float = 1.0) -> dict:
    """Constants drawn from normals of `scale` tolerances, cut at two of them."""
    p = dict(CLIMBING)
    for name in names:
        p[name] *= 1 + scale * TOLERANCES[name] * float(np.clip(rng.standard_normal(), -2, 2))
    for c in ("6T2A", "4W2T"):
        p[f"{c}.ground.friction.dynamic"] = 0.8 * p[f"{c}.ground.friction.static"]
    return p


# --- conditions -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Conditions:
    """One array a column, shape (rows,): wheeled 0/1, U [V], slope [rad], payload [kg], stated mass [kg], and the
    position in which the row was measured, from 0 on."""

    wheeled: np.ndarray
    U: np.ndarray
    slope: np.ndarray
    payload: np.ndarray
    mass: np.ndarray
    row: np.ndarray

    def at(self, rows: np.ndarray) -> Conditions:
        """These rows, measured in this order."""
        kept = [getattr(self, f.name)[rows] for f in dataclasses.fields(self)[:-1]]
        return Conditions(*kept, np.arange(len(rows), dtype=float))


def conditions(wheeled, U, slope_deg, payload, p: Mapping[str, float] = CLIMBING) -> Conditions:
    """Conditions with the mass as weighed, to 10 g."""
    w, u, s, m = (np.asarray(x, float) for x in np.broadcast_arrays(wheeled, U, slope_deg, payload))
    own = np.where(w > 0.5, p["4W2T.mass"], p["6T2A.mass"])
    return Conditions(w, u, np.radians(s), m, np.round(own + m, 2), np.arange(w.size, dtype=float).reshape(w.shape))


def table8(
    p: Mapping[str, float] = CLIMBING,
    payloads: Sequence[float] = (0.0, 3.0, 8.0),
    slopes: Sequence[float] = (0.0, 5.0, 10.0, 15.0, 20.0),
    voltages: Sequence[float] = (15.0, 24.0, 33.0),
    configurations: Sequence[int] = (0, 1),
) -> Conditions:
    """A grid like Table 8. By default 90 rows, with six payloads 180."""
    axes = np.meshgrid(configurations, slopes, payloads, voltages, indexing="ij")
    w, s, m, u = (a.ravel() for a in axes)
    return conditions(w, u, s, m, p)


# --- the balances -----------------------------------------------------------------------------------


def instant(
    x: np.ndarray, given: SimpleNamespace, p: Mapping[str, Any], terms: Sequence[Term], channels: Sequence[str]
) -> SimpleNamespace:
    """Every quantity of settled motion at x = (I [A], ω [rad/s], V [m/s]), shape (3, rows).

    Args:
        given: of each row: sides. Supply [V] and duty, or motor_speed [rad/s] where that is imposed, else None,
            direction d. Slope [rad], payload [kg]. Mass [kg] of what travels on the ground, None for a load on a shaft,
            which may have a load_torque [N·m] of a brake.
        p: constants, of the load without its configuration, a number or one a row.
        channels: whose readings are shown.
    """

    def extra(balance: str) -> Any:
        return laws.total(terms, balance, s)

    s = SimpleNamespace(**vars(given), I=x[0], w=x[1], V=x[2], U=given.supply)
    s.ratio, s.R, s.C = p["gearbox.ratio"], p["motor.resistance"], p["motor.torque_constant"]
    s.w_k = s.w / s.ratio
    s.r = p.get("radius", 1.0)
    s.V_teor = s.r * s.w_k
    way = np.sign(s.duty)
    s.duty = way * np.clip(way * (s.duty - extra("duty")), 0, 1)
    s.line = s.sides * s.I * s.duty  # of all motors, from the supply (10)
    if s.mass is not None:
        s.M_own, s.M = p["mass"], s.mass
        s.M = s.M + extra("mass")
        m = s.M / s.sides
        s.N = m * G * np.cos(s.slope)
    drop = s.R * s.I + extra("electrical")  # (15)
    imposed = s.motor_speed is not None
    s.volts = s.C * s.w + drop if imposed else s.duty * (s.supply - extra("supply"))
    s.volts_left = s.w - s.motor_speed if imposed else s.volts - s.C * s.w - drop
    if s.mass is not None:
        s.D = s.d * p["ground.rolling_resistance"] * s.N + extra("ground") + m * G * np.sin(s.slope)  # (1), (5)
        s.P = s.D
        s.D_max = p["ground.friction.static"] * s.N  # (6)
        share = s.D / s.D_max
        s.slides = np.abs(share) >= 1
        creep = 2 * p["ground.friction.speed_static"] * np.sin(np.arcsin(np.clip(share, -1, 1)) / 3)  # Fig. 7
        s.M_t0 = p["track.loss_coulomb"]
        guide = s.r * p["track.guide_friction"] * p["track.guide_share"] * s.N  # (26)
        friction = s.d * (s.M_t0 + guide) + p["track.loss_viscous"] * s.w_k  # (24)
        s.pull = s.r * s.D
    else:
        s.slides = np.zeros(s.I.shape, bool)
        creep = 0.0
        friction = s.d * p["loss_coulomb"] + p["loss_viscous"] * s.w_k
        s.pull = (p.get("torque_constant", 0.0) + vars(given).get("load_torque", 0.0)) * np.ones_like(s.I)
    s.speed_left = s.V_teor - s.V - creep - extra("slip")
    s.B = friction + extra("track") + s.pull
    load = s.B + extra("gearbox")
    loss = s.d * p["motor.friction_coulomb"] + p["motor.friction_viscous"] * s.w + extra("motor")  # (14)
    idle = s.d * p["gearbox.friction_coulomb"] + p["gearbox.friction_viscous"] * s.w  # (20)
    eta = p["gearbox.efficiency_load"]
    s.torque_left = s.ratio * np.where(load * s.d >= 0, eta, 1 / eta) * (s.C * s.I - loss - idle) - load  # (19)-(23)
    true = {
        "total_current": s.line, "motor_speed": s.w, "speed": s.V, "motor_current": s.I, "output_speed": s.w_k,
        "motor_voltage": s.volts, "output_torque": s.B,
    }  # fmt: skip
    s.shown = np.stack([true[n] + extra(n) + 0 * s.I for n in channels])
    return s


def differences(residual: Callable[[np.ndarray], np.ndarray], x: np.ndarray, f: np.ndarray, size: np.ndarray) -> Any:
    """Derivatives of what is left by the unknowns over their sizes, shape (rows, residuals, unknowns)."""
    columns = []
    for k in range(len(x)):
        there = x.copy()
        there[k] += 1e-6 * size[k]
        columns.append((residual(there) - f) / 1e-6)
    return np.stack(columns, 1).transpose(2, 0, 1)


def newton(
    residual: Callable[[np.ndarray], np.ndarray], x: np.ndarray, size: np.ndarray, tries: int = 25, most: float = 50.0,
    close: float = 1e-12,
) -> np.ndarray:  # fmt: skip
    """Unknowns of all rows, shape (unknowns, rows), by Newton's method with steps of at most so many sizes."""
    with np.errstate(all="ignore"):
        for _ in range(tries):
            f = residual(x)
            try:
                move = np.linalg.solve(differences(residual, x, f, size), f.T[..., None])[..., 0].T
            except np.linalg.LinAlgError:
                break
            move = np.clip(np.nan_to_num(move), -most, most)
            x = x - move * size
            if np.abs(move).max() < close:
                break
    return x


# --- a robot of two configurations --------------------------------------------------------------------

_SCALE = np.array([1.0, 100.0, 0.1])[:, None]  # of I, w, V
_LEFT = np.array([1.0, 10.0, 10.0])[:, None]


def of_rows(c: Conditions, p: Mapping[str, Any]) -> dict[str, Any]:
    """Constants, those of a configuration under their own name with a value for each row."""
    names = [n.removeprefix("6T2A.") for n in p if n.startswith("6T2A.")]
    return dict(p) | {n: np.where(c.wheeled > 0.5, p[f"4W2T.{n}"], p[f"6T2A.{n}"]) for n in names}


def balances(
    c: Conditions, p: Mapping[str, Any], terms: Sequence[Term] = ()
) -> Callable[[np.ndarray], SimpleNamespace]:
    """Unknowns → every quantity of forward travel (see `instant`)."""
    last = max(float(np.max(c.row, initial=0.0)), 1.0)
    given = SimpleNamespace(
        sides=SIDES, supply=c.U, duty=1.0, motor_speed=None, d=1.0, slope=c.slope, payload=c.payload, mass=c.mass,
        wheeled=c.wheeled, row=c.row, order=c.row / last, r_pulley=p["6T2A.radius"],
    )  # fmt: skip
    constants = of_rows(c, p)
    return lambda x: instant(x, given, constants, terms, CHANNELS)


def _left(s: SimpleNamespace) -> np.ndarray:
    return _LEFT * np.stack([s.volts_left, s.torque_left, s.speed_left])


def solve(c: Conditions, p: Mapping[str, Any], terms: Sequence[Term] = ()) -> tuple[SimpleNamespace, np.ndarray]:
    """Every quantity of all rows at their operating points, these as `x` of shape (3, rows), and which are sound."""
    at = balances(c, p, terms)
    no_load = 0.9 * c.U / p["motor.torque_constant"]
    radius = np.where(c.wheeled > 0.5, p["4W2T.radius"], p["6T2A.radius"])
    x = np.stack([0.1 * c.U / p["motor.resistance"], no_load, radius * no_load / p["gearbox.ratio"]])
    x = newton(lambda x: _left(at(x)), x, _SCALE)
    with np.errstate(all="ignore"):
        s = at(x)
        s.x, f = x, _left(s)
    return s, np.isfinite(f).all(0) & (np.abs(f).max(0) < 1e-7) & ~s.slides & (s.w > 0)


def readings(c: Conditions, p: Mapping[str, Any], terms: Sequence[Term] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Total current [A], motor speed [rad/s], speed [m/s], shape (3, rows), without noise, and sound rows."""
    s, sound = solve(c, p, terms)
    return s.shown, sound


# --- signatures -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Instruments:
    """Standard deviation and step of the display of each channel: A, rpm, mm/s."""

    sd: tuple[float, float, float] = (0.02, 5.0, 3.0)
    step: tuple[float, float, float] = (0.01, 1.0, 1.0)

    @property
    def stated(self) -> np.ndarray:
        """Standard deviation of a reading, rounding included [A, rpm, mm/s]."""
        return np.sqrt(np.square(self.sd) + np.square(self.step) / 12)


SHOWN = np.array([1.0, 30 / np.pi, 1000.0])[:, None]  # A, rad/s, m/s → A, rpm, mm/s


def base_slopes(
    c: Conditions,
    p: Mapping[str, Any],
    instruments: Instruments,
    names: Sequence[str] = tuple(TOLERANCES),
    sds: Mapping[str, float] | None = None,
) -> np.ndarray:
    """Whitened change of the readings for one sd of each constant, shape (3 rows, names). `sds`: else tolerances."""
    x = solve(c, p)[0].x
    f0 = _left(balances(c, p)(x))
    inverse = np.linalg.inv(differences(lambda x: _left(balances(c, p)(x)), x, f0, _SCALE))
    columns = []
    for name in names:
        sd = TOLERANCES[name] * CLIMBING[name] if sds is None else sds[name]
        h = 1e-6 * max(p[name], sd)
        df = (_left(balances(c, dict(p) | {name: p[name] + h})(x)) - f0) / h
        dx = -np.einsum("nij,jn->in", inverse, df) * _SCALE
        dy = dx * np.array([SIDES, 1.0, 1.0])[:, None] * sd
        columns.append((dy * SHOWN / instruments.stated[:, None]).ravel())
    return np.stack(columns, 1)


def remainder(signature: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """What of a whitened signature is left after a refit of the constants with their tolerances as priors."""
    n = slopes.shape[1]
    wide = np.concatenate([slopes, np.eye(n)])
    long = np.concatenate([signature, np.zeros(n)])
    fit = np.linalg.lstsq(wide, long, rcond=None)[0]
    return long - wide @ fit


def signature(
    c: Conditions, p: Mapping[str, Any], terms: Sequence[Term], instruments: Instruments, others: Sequence[Term] = ()
) -> np.ndarray:
    """Whitened change of all readings by the terms over others of them, shape (3 rows,), NaN where a row is lost."""
    with_them, a = readings(c, p, terms)
    without, b = readings(c, p, others)
    change = np.where(a & b, (with_them - without) * SHOWN / instruments.stated[:, None], np.nan)
    return change.ravel()


# --- further experiments ----------------------------------------------------------------------------

#: How a run of the menu is carried out (see `_free`), by the name of its setup.
HOW = {
    "on_ground": "travel", "facing_backward": "reverse", "lifted": "lifted", "uncoupled": "motor", "braked": "brake",
    "locked": "stall",
}  # fmt: skip
#: Channel whose instrument a calibration act reads; `weigh` reads the scales.
_SHOWS = {"shunt": 0, "zero current": 0, "strobe": 1, "timing": 2}


def _act(name: str, at: np.ndarray, p: Mapping[str, float], terms: Sequence[Term]) -> np.ndarray:
    """What an instrument shows of true values `at`. Of the scales' mass the stated one is taken away."""
    if name == "weigh":  # configuration and payload
        c = conditions(at[:, 0], 0.0, 0.0, at[:, 1], p)
        s = SimpleNamespace(M=c.mass, wheeled=c.wheeled)
        return 0 * c.mass + laws.total(terms, "mass", s)
    true = at[:, 0]
    s = SimpleNamespace(I=true / SIDES, line=true, w=true, V=true)
    return true + laws.total(terms, CHANNELS[_SHOWS[name]], s)


def _free(
    how: str, U: np.ndarray, wheeled: int, motors: int, p: Mapping[str, float], terms: Sequence[Term], brake: float
) -> tuple[np.ndarray, np.ndarray]:
    """Current [A] and speed [rad/s] shown where nothing touches the ground, shape (2, rows).

    `how` is `lifted`, `motor` (nothing on its shaft), `brake` (one of a torque [N·m] on it) or `stall` (shaft held).
    """
    chassis = ("6T2A.", "4W2T.")[wheeled]
    R, C, zero = p["motor.resistance"], p["motor.torque_constant"], np.zeros_like(U)

    def left(x: np.ndarray, shown: bool = False) -> np.ndarray:
        i, w = x
        s = SimpleNamespace(
            I=i, w=w, w_k=w / p["gearbox.ratio"], U=U, R=R, C=C, r=p[chassis + "radius"], r_pulley=p["6T2A.radius"],
            M_t0=p[chassis + "track.loss_coulomb"], M=zero, N=zero, D=zero, P=zero, payload=zero, slope=zero,
            wheeled=zero + wheeled, V=zero, row=zero, order=zero, pull=zero, d=1.0, line=motors * i,
        )  # fmt: skip

        def extra(balance: str) -> Any:
            return laws.total(terms, balance, s)

        if shown:
            return np.stack([motors * i + extra("total_current"), w + extra("motor_speed")])
        volts = U - extra("supply") - C * w - R * i - extra("electrical")
        if how == "stall":
            return np.stack([volts, w])
        torque = C * i - p["motor.friction_coulomb"] - p["motor.friction_viscous"] * w - extra("motor")
        if how in ("motor", "brake"):
            return np.stack([volts, 1000 * (torque - brake * (how == "brake"))])
        torque = torque - p["gearbox.friction_coulomb"] - p["gearbox.friction_viscous"] * w
        s.B = s.M_t0 + p[chassis + "track.loss_viscous"] * s.w_k + extra("track")
        return np.stack([volts, p["gearbox.ratio"] * p["gearbox.efficiency_load"] * torque - s.B - extra("gearbox")])

    x = np.stack([U if how == "stall" else 0.1 * U, 0.0 * U if how == "stall" else 0.9 * U / C])
    x = newton(left, x, np.array([[1.0], [100.0]]), 40)
    return left(x, shown=True), np.abs(left(x)).max(0) < 1e-7


def carried_out(experiment: Any, p: Mapping[str, float], terms: Sequence[Term] = ()) -> tuple[np.ndarray, np.ndarray]:
    """What an experiment shows without noise [SI], row by row and in each row channel by channel, and what is sound.

    Args:
        experiment: of the menu, an act or a run with its conditions. Nothing but these is read of it.
    """
    if hasattr(experiment, "at"):
        y = _act(experiment.name, np.array(experiment.at, float), p, terms)
        return y, np.ones(y.shape, bool)
    how, wheeled = HOW[experiment.setup.__name__], experiment.configuration
    U, slope, payload = (np.array(x, float) for x in (experiment.voltage, experiment.slope, experiment.payload))
    if how in ("lifted", "motor", "brake", "stall"):
        y, sound = _free(how, U, wheeled, experiment.sides or SIDES, p, terms, experiment.brake)
        y = y[:1] if how == "stall" else y
    else:
        if how == "reverse":  # an angle that is too small now drives
            terms = [
                dataclasses.replace(t, amplitude=-t.amplitude) if t.law.cls == "slope_bias" else t for t in terms
            ]
        y, sound = readings(conditions(wheeled, U, slope, payload, p), p, terms)
    return y.T.ravel(), np.repeat(sound, len(y))
