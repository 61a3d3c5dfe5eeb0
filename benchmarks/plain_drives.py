"""Drives of the comparison in plain NumPy: settled runs by `tests/worlds/settled.py`, logs by exact steps.

Only names and values of constants come from the simulator: physics, solvers and integration are independent.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from worlds.laws import Law, Term
from worlds.paper import G
from worlds.rigs import CHANNELS
from worlds.settled import instant, newton

#: Longest step of a log [s].
LONGEST = 0.005
#: Voltage added by a driver in fast decay: between pulses the winding is at its back-EMF.
COASTS = Term("coasts", 1.0, {}, Law("", "electrical", lambda s, q: -(1 - np.abs(s.duty)) * s.C * s.w, 1.0))


class Unable(Exception):
    """Raised with the reason if a method cannot treat a record."""


@dataclasses.dataclass(frozen=True)
class Drive:
    """A table's rig.

    Attributes:
        runs: the table.
        robot: with its constants.
        coordinates: of the free ones, `priors.Coordinates`.
        known: name → value of every constant [SI].
        term: an additional term of the rig, its amplitude one more unknown.
        given: of each row: configuration, sides, supply [V], duty, motor_speed [rad/s], slope [rad], mass [kg],
            direction d.
    """

    runs: Any
    robot: Any
    coordinates: Any
    known: Mapping[str, float]
    given: SimpleNamespace
    term: Term | None = None

    @property
    def constants(self) -> int:
        """Number of free constants."""
        return len(self.coordinates.names)

    def start(self) -> np.ndarray:
        """Unknowns at the means of their priors. For the term a tenth of its ordinary size."""
        return np.concatenate([np.zeros(self.constants), np.zeros(0) if self.term is None else [0.1]])

    def values(self, z: np.ndarray) -> dict[str, float]:
        """Every constant [SI] at coordinates z, shape (constants,)."""
        theta = self.coordinates.value(np.asarray(z, float)[: self.constants])
        tied = {name: ratio * theta[k] for name, k, ratio in self.coordinates.tied}
        return {**self.known, **dict(zip(self.coordinates.names, theta, strict=True)), **tied}

    def of_rows(self, values: Mapping[str, float]) -> dict[str, Any]:
        """Constants by their names without the configuration. Those of a load have a value for each row."""
        names, which = list(self.robot.configurations.names), self.given.configuration
        found: dict[str, Any] = {}
        for name, value in values.items():
            first, _, rest = name.partition(".")
            if first in names:
                found.setdefault(rest, np.zeros(len(which)))[which == names.index(first)] = value
            else:
                found[name] = value
        return found

    def terms(self, members: np.ndarray) -> list[Term]:
        """Additional terms of the rig, with the last unknown of each point as amplitude.

        Args:
            members: unknowns, shape (points, unknowns).
        """
        own = [COASTS] if self.robot.driver.decay == "fast" else []
        if self.term is not None:
            size = self.term.law.size * np.sign(self.term.amplitude)
            own.append(dataclasses.replace(self.term, amplitude=members[:, self.constants] * size))
        return own

    def readings(self, members: np.ndarray) -> np.ndarray:
        """Readings of every channel [SI] for each member's unknowns, shape (members, rows, channels).

        NaN for a row that is not reached.
        """
        shown = self._followed(members) if self.runs.sampled else self._settled(members)
        unsigned = [k for k, c in enumerate(self.runs.channels) if c.name in self.robot.rig.magnitudes]
        shown[..., unsigned] = np.abs(shown[..., unsigned])
        return shown

    # --- settled runs -----------------------------------------------------------------------------------

    def _settled(self, members: np.ndarray) -> np.ndarray:
        """Operating points of all members' rows at once, by Newton's method."""
        count, rows = len(members), len(self.runs)
        each = [self.of_rows(self.values(z)) for z in members]
        p = {n: np.concatenate([np.broadcast_to(x[n], rows) for x in each]) for n in each[0]}
        given = SimpleNamespace(**{n: _tiled(x, count, rows) for n, x in vars(self.given).items()})
        terms, names = self.terms(np.repeat(members, rows, 0)), [channel.name for channel in self.runs.channels]
        current, no_load = given.most / p["motor.resistance"] / 12, given.most / p["motor.torque_constant"]
        radius, wide = p.get("radius", 1.0), given.motor_speed is not None
        size = np.stack([current, no_load, radius * no_load / p["gearbox.ratio"]])
        torque = p["gearbox.ratio"] * p["motor.torque_constant"] * current
        left = np.stack([no_load if wide else given.most * np.ones(count * rows), torque, size[2]])

        def residual(x: np.ndarray) -> np.ndarray:
            s = instant(x, given, p, terms, names)
            return np.stack([s.volts_left, s.torque_left, s.speed_left]) / left

        speed = given.motor_speed if wide else 0.9 * given.duty * given.supply / p["motor.torque_constant"]
        x = np.stack([size[0] * given.d, speed, radius * speed / p["gearbox.ratio"]])
        x = newton(residual, x, size, 40, 3.0, 1e-12)
        s, f = instant(x, given, p, terms, names), residual(x)
        sound = np.isfinite(f).all(0) & (np.abs(f).max(0) < 1e-7) & ~s.slides
        shown = np.where(sound, s.shown, np.nan)
        if not wide:  # friction holds the robot at rest, unless a weight could reverse it
            held = (s.w * given.d <= 0) & (given.slope == 0) & (given.load_torque == 0) & (s.pull == 0)
            volts = given.duty * given.supply
            current = volts / p["motor.resistance"]
            rest = {
                "motor_current": current,
                "total_current": given.sides * current * given.duty,
                "motor_voltage": volts,
            }
            still = np.stack([rest.get(n, np.zeros_like(volts)) for n in names])
            shown = np.where(held & ("output_torque" not in names), still, shown)
        return np.moveaxis(shown.reshape(len(names), count, rows), 0, 2)

    # --- logs -------------------------------------------------------------------------------------------

    def _followed(self, members: np.ndarray) -> np.ndarray:
        """Readings of logs with a voltage imposed, shape (members, rows, channels)."""
        if self.given.motor_speed is not None or self.given.load_torque.any():
            raise Unable("an imposed speed, or a brake, over time")
        if set(c.name for c in self.runs.channels) - {
            "motor_speed",
            "output_speed",
            "speed",
            "total_current",
            "motor_current",
        }:
            raise Unable("a channel that needs more than one instant")
        whole = self.runs.whole
        shown = np.full((len(members), len(self.runs), len(self.runs.channels)), np.nan)
        for name in dict.fromkeys(self.runs.run_names.tolist()):
            kept, every = self.runs.in_order(name), whole.in_order(name)
            time = whole["time_s"][every] - whole["time_s"][every[0]]
            at = np.searchsorted(time, self.runs["time_s"][kept] - whole["time_s"][every[0]] - 1e-9)
            shown[:, kept] = self._run(members, time, every, np.minimum(at, len(time) - 1))
        return shown

    def _run(self, members: np.ndarray, time: np.ndarray, every: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Readings of the rows `kept` of one run, shape (members, rows, channels).

        Args:
            time: of every sample since the start [s].
            every: indices of the samples in the whole table.
        """
        values = [self.values(z) for z in members]
        whole = conditions_of(self.runs.whole, self.robot)
        name = self.robot.configurations.names[int(whole.configuration[every[0]])]
        shaft = Shaft(
            {n.removeprefix(f"{name}."): np.array([v[n] for v in values]) for n in self.known},
            whole.sides, whole.mass is not None, self.robot.driver.decay == "fast",
        )  # fmt: skip
        volts, duty = (whole.supply * whole.duty)[every], np.abs(whole.duty)[every]
        grid, followed = shaft.follow(time, volts, duty, first_speed(self, every[0]))
        late = shaft.p.get("rig.delay", np.zeros(len(members)))
        names = [channel.name for channel in self.runs.channels]
        each = [shaft.at(time[kept] - x, m, grid, followed) for m, x in enumerate(late)]
        return np.stack([np.stack([shown[n] for n in names], 1) for shown in each])


@dataclasses.dataclass(frozen=True)
class Shaft:
    """A motor, its gear and a load on level ground, over time.

    Attributes:
        p: constants without their configuration, of each member.
        sides: motors.
        vehicle: True for a load that travels.
        fast: True for a driver that lets motors coast between pulses.
    """

    p: Mapping[str, np.ndarray]
    sides: int
    vehicle: bool
    fast: bool

    @property
    def radius(self) -> np.ndarray:
        """Travel per radian of the output [m/rad], 1 for a shaft."""
        return self.p.get("radius", np.ones_like(self.p["motor.resistance"]))

    @property
    def mass(self) -> np.ndarray:
        """Mass that one side moves [kg], 0 for a shaft."""
        return self.p["mass"] / self.sides if self.vehicle else np.zeros_like(self.radius)

    def follow(
        self, time: np.ndarray, volts: np.ndarray, duty: np.ndarray, start: float
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Returns instants [s] and the state of the motors at them, each of shape (members, instants).

        The state is the speed `w` [rad/s] and current `I` [A], and for the step from there its acceleration `rate`
        [rad/s²] and the settled currents `from` and `to` of its voltage at both ends [A].

        In each step the voltage is constant, the winding's lag exact, and the shaft's equation linear with an exact
        solution. A shaft that would reverse stops.

        Args:
            time: of the samples [s].
            volts: mean voltage of the pulses [V], duty: their share, of each sample.
            start: speed [rad/s].
        """
        p, i = self.p, self.p["gearbox.ratio"]
        C, R, eta, J = (
            p[f"{n}"]
            for n in ("motor.torque_constant", "motor.resistance", "gearbox.efficiency_load", "motor.inertia")
        )
        lag = np.maximum(p["motor.inductance"] / R, 1e-9)
        dry = p["motor.friction_coulomb"] + p["gearbox.friction_coulomb"]
        viscous = p["motor.friction_viscous"] + p["gearbox.friction_viscous"]
        of = "track." if self.vehicle else ""
        load, damping, pull = (
            p[f"{of}loss_coulomb"],
            p[f"{of}loss_viscous"],
            p.get("torque_constant", np.zeros_like(C)),
        )
        if self.vehicle:
            rubs = p["track.guide_friction"] * p["track.guide_share"] + p["ground.rolling_resistance"]
            load, pull = load + self.radius * rubs * self.mass * G, np.zeros_like(C)
        behind = p["inertia"] + self.mass * self.radius**2
        w, current = np.full_like(C, start), np.zeros_like(C)
        grid, steps_of = [0.0], list[tuple[np.ndarray, ...]]()
        for k in range(len(time) - 1):
            steps = max(int(np.ceil((time[k + 1] - time[k]) / LONGEST)), 1)
            h = (time[k + 1] - time[k]) / steps
            U, D = volts[k], duty[k] if self.fast else 1.0
            fade = np.exp(-h / lag)
            for _ in range(steps):
                settles = (U - D * C * w) / R
                late = (current - settles) * lag * (1 - fade) / h
                drive = C * (U / R + late)  # torque at standstill
                push = i * eta * (drive - (C * C * D / R + viscous) * w) - damping * w / i - pull
                way = np.where(w == 0, np.sign(push), np.sign(w))
                flow = (C * (settles + late) - dry * way - viscous * w) * behind
                flow = flow + i * J * (load * way + damping * w / i + pull)
                passed = np.where(flow * way >= 0, eta, 1 / eta)
                inertia = behind / i + i * J * passed
                slope = (i * passed * (C * C * D / R + viscous) + damping / i) / inertia
                force, rub = (i * passed * drive - pull) / inertia, (i * passed * dry + load) / inertia
                slope = np.maximum(slope, 1e-9)
                ends = (force - rub * way) / slope
                new = ends + (w - ends) * np.exp(-slope * h)
                # A shaft that reaches rest stays there, or reverses for the rest of the step.
                stops = (w != 0) & (new * way < 0)
                rest = np.where(stops, np.log1p(np.where(stops, -w / np.where(stops, ends, 1.0), 0.0)) / slope, 0.0)
                onward = np.where(np.abs(force) > rub, (force - rub * np.sign(force)) / slope, 0.0)
                new = np.where(stops, onward * -np.expm1(-slope * (h - rest)), new)
                new = np.where((w == 0) & (np.abs(force) <= rub), 0.0, new)
                then = (U - D * C * new) / R
                steps_of.append((w, current, (new - w) / h, settles, then))
                grid.append(grid[-1] + h)
                ramp = (then - settles) / h * lag
                w, current = new, then - ramp + (current - settles + ramp) * fade
        steps_of.append((w, current, np.zeros_like(w), current, current))
        names = ("w", "I", "rate", "from", "to")
        return np.array(grid), {n: np.stack(x, 1) for n, x in zip(names, zip(*steps_of, strict=True), strict=True)}

    def at(
        self, when: np.ndarray, m: int, grid: np.ndarray, followed: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Channel → its values [SI] of one member.

        Args:
            when: instants [s].
            m: index of the member.
            grid, followed: as for `follow`.
        """
        p = {n: x[m] for n, x in self.p.items()}
        k = np.clip(np.searchsorted(grid, when, side="right") - 1, 0, len(grid) - 1)
        # A row at the end of a step is read before the next voltage acts.
        k = np.where((k > 0) & (when - grid[k] < 1e-9), k - 1, k)
        since, h = np.maximum(when - grid[k], 0.0), np.diff(grid, append=grid[-1] + 1.0)[k]
        of = {n: x[m, k] for n, x in followed.items()}
        w = np.interp(when, grid, followed["w"][m])
        lag = max(p["motor.inductance"] / p["motor.resistance"], 1e-9)
        ramp = (of["to"] - of["from"]) / h
        settles = of["from"] + ramp * (since - lag)
        current = settles + (of["I"] - of["from"] + ramp * lag) * np.exp(-since / lag)
        ratio, radius = p["gearbox.ratio"], float(self.radius[m])
        found = {"motor_speed": w, "output_speed": w / ratio, "motor_current": current,
                 "total_current": self.sides * current, "speed": radius / ratio * w}  # fmt: skip
        if self.vehicle:
            weight = float(self.mass[m]) * G
            demand = weight / G * radius / ratio * of["rate"] + weight * p["ground.rolling_resistance"] * np.sign(w)
            used = np.clip(demand / (p["ground.friction.static"] * weight), -1, 1)
            creep = 2 * p["ground.friction.speed_static"] * np.sin(np.arcsin(used) / 3)  # Fig. 7
            found["speed"] = found["speed"] - np.where(w == 0, 0.0, creep)
        return found


def _tiled(x: Any, count: int, rows: int) -> Any:
    """A column of rows repeated `count` times. Other values are returned unchanged."""
    return np.tile(x, count) if isinstance(x, np.ndarray) and x.shape == (rows,) else x


def first_speed(drive: Drive, row: int) -> float:
    """Speed of the motors at the start of a run [rad/s]: at rest, or the reading of its first row."""
    names = [c.name for c in drive.runs.channels]
    ratio = {"motor_speed": 1.0, "output_speed": drive.known["gearbox.ratio"]}
    shown = next((n for n in ratio if n in names), None)
    if drive.robot.rig.start == "rest" or shown is None:
        return 0.0
    return ratio[shown] * float(np.nan_to_num(drive.runs.whole.measured()[row, names.index(shown)]))


def conditions_of(runs: Any, robot: Any) -> SimpleNamespace:
    """Conditions of every row."""
    conditions = runs.conditions(robot)
    rows = len(runs)

    def column(x: Any) -> np.ndarray:
        return np.broadcast_to(np.asarray(x, float), (rows,)).copy()

    which = np.broadcast_to(np.asarray(conditions.configuration), (rows,))
    vehicle = "ground.friction.static" in {n.partition(".")[2] for n in _names(robot)}
    supply, duty = column(conditions.voltage), column(conditions.duty)
    speed = None if conditions.motor_speed is None else column(conditions.motor_speed)
    own = [float(c.mass) if vehicle else np.nan for c in robot.configurations.members]
    payload = column(conditions.payload)
    mass = np.array(own)[which] + payload if conditions.total_mass is None else column(conditions.total_mass)
    driven = supply * duty if speed is None else speed
    brake = getattr(conditions, "load_torque", None)
    most = float(np.max(np.abs(supply))) if speed is None else float(np.max(np.abs(speed)))
    return SimpleNamespace(
        configuration=which, sides=int(robot.sides), supply=None if speed is not None else supply,
        duty=np.ones(rows) if speed is not None else duty, motor_speed=speed,
        slope=np.radians(column(conditions.slope_deg)), payload=payload, mass=mass if vehicle else None,
        load_torque=column(0.0 if brake is None else brake), most=most,
        d=np.where(driven < 0, -1.0, 1.0), order=np.arange(rows) / max(rows - 1, 1),
    )  # fmt: skip


def _names(robot: Any) -> list[str]:
    from mmrjax.model import params

    return list(params.parameters_by_name(robot))


def drive(runs: Any, robot: Any, coordinates: Any, term: Term | None = None) -> Drive:
    """The rig of a table in these equations.

    Args:
        robot: of the problem.
        coordinates: of its free constants.
        term: of a synthetic rig.

    Raises:
        Unable: a kind of data or channel that they do not support.
    """
    from mmrjax.model import params

    if robot.rig.imposed not in ("voltage", "motor_speed"):
        raise Unable(f"{robot.rig.imposed} is imposed")
    if runs.turns:
        raise Unable("turns")
    strange = [c.name for c in runs.channels if c.name not in CHANNELS]
    if strange:
        raise Unable(f"channel {strange[0]}")
    known = {name: float(field.value) for name, field in params.parameters_by_name(robot).items()}
    given = conditions_of(runs, robot)
    if given.motor_speed is not None:
        given.most *= known["motor.torque_constant"]
    return Drive(runs, robot, coordinates, known, given, term)
