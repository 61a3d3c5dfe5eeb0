"""Records of the comparison: the packaged table, public records of others, cases of a folder, synthetic rigs.

A record is a robot's file, a table and the known part of the answer. Public tables stay in the folder stated on the
command line. This module holds the data for a robot's file of each.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [p for p in (str(ROOT), str(ROOT / "tests")) if p not in sys.path]

#: Number of synthetic rigs, and four kinds of them in turn.
RIGS, TURN = 40, ("library", "outside", "library", "clean")
#: Number of seeds tried in sequence for a synthetic rig of a kind.
TRIES = 20


@dataclasses.dataclass(frozen=True)
class Answer:
    """The right verdict, as far as it is known.

    Attributes:
        kind: `clean`, `library`, `outside` or `unknown`, which is not judged.
        names: right effects of the library, including all that noise-free data cannot distinguish.
        families: right mechanisms, as beginnings of `Effect.family()`.
    """

    kind: str = "unknown"
    names: tuple[str, ...] = ()
    families: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Record:
    """A robot, a table and the answer.

    Attributes:
        name: of the record.
        robot: file of the robot, or name of a packaged one.
        table: file of the runs.
        case: of a synthetic rig the generator's `rigs.Case`, else None.
    """

    name: str
    robot: str
    table: Path
    answer: Answer
    case: Any = None


class NoRecord(Exception):
    """Raised with the reason if a record cannot be made."""


# --- others' records ----------------------------------------------------------------------------------

#: A micromouse: two cells, PWM of -255 to 255, wheel speeds by encoder, a geared motor of 12 V.
MICROMOUSE = """
base = "none"
channels = ["output_speed"]
{driver}
[columns]
supply_voltage_V = {{column = "batteryVoltage", factor = 0.001}}
duty = {{column = "motorCommand", factor = 0.003921568627}}
output_speed_rpm = "{side}SpeedRpm"
[motor]
resistance = "10 ± 30 %"
torque_constant = "0.006 ± 30 %"
friction_coulomb = "0.0003 ± 100 %"
friction_viscous = "1e-7 ± 100 %"
inertia = 1e-7
[gearbox]
ratio = 20.0
efficiency_load = "0.8 ± 10 %"
[wheel]
load = "shaft"
inertia = 1e-5
loss_coulomb = "0.002 ± 100 %"
"""
#: A model car, 1:18: throttle -1 to 1 of the battery, wheel odometer.
CAR = """
base = "none"
imposed = "voltage"
channels = ["speed"]
start = "rest"
[columns]
time_s = {column = "stamp_ns", factor = 1e-9}
supply_voltage_V = "battery_voltage"
duty = "motor_throttle"
speed_mm_s = {column = "speed", factor = 1000.0}
[rig]
delay = "0.0 ± 0.02"
[motor]
resistance = "1.0 ± 50 %"
torque_constant = "0.006 ± 50 %"
friction_coulomb = "0.001 ± 100 %"
friction_viscous = "1e-7 ± 100 %"
inertia = "1e-6 ± 100 %"
[gearbox]
ratio = 10.0
efficiency_load = "0.8 ± 10 %"
[car]
load = "vehicle"
movers = "wheels"
mass = "0.5 ± 5 %"
radius = "0.035 ± 3 %"
[car.ground]
rolling_resistance = "0.03 ± 100 %"
[car.ground.friction]
static = "0.8 ± 30 %"
"""
#: A robot's drive: two motors a side, six inch wheels, about 50 kg.
DRIVETRAIN = """
base = "none"
sides = 2
imposed = "voltage"
channels = ["speed"]
start = "rest"
[columns]
time_s = "timestamp"
supply_voltage_V = "l_voltage"
speed_mm_s = {column = "l_velocity", factor = 1000.0}
[motor]
resistance = "0.03 ± 50 %"
torque_constant = "0.02 ± 20 %"
inertia = 1e-4
[gearbox]
ratio = 8.45
efficiency_load = "0.9 ± 10 %"
[robot]
load = "vehicle"
movers = "wheels"
mass = "50 ± 20 %"
radius = "0.0776 ± 2 %"
[robot.track]
loss_coulomb = "0.5 ± 100 %"
loss_viscous = "0.01 ± 100 %"
[robot.ground]
rolling_resistance = "0.02 ± 100 %"
[robot.ground.friction]
static = "0.9 ± 30 %"
"""


#: A brushless motor on a brake, 12 V through a duty.
DYNO = """
base = "none"
channels = ["total_current", "motor_speed"]
[motor]
resistance = "0.067 ± 20 %"
torque_constant = "0.0195 ± 20 %"
friction_coulomb = "0.03 ± 100 %"
[gearbox]
ratio = 1
efficiency_load = "1 ± 0"
[brake]
load = "shaft"
inertia = 1e-4
loss_coulomb = "0.1 ± 100 %"
"""


@dataclasses.dataclass(frozen=True)
class Public:
    """A public record: its file in the folder, the columns to read, the robot's file and the answer."""

    file: str
    columns: tuple[str, ...]
    toml: str
    answer: Answer = Answer()

    def rows(self, public: Path) -> list[dict[str, str]]:
        """Rows of the record's file."""
        with (public / self.file).open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file, skipinitialspace=True))

    def write(self, public: Path, folder: Path) -> tuple[Path, Path]:
        """Writes the robot's file and the table, in the form of a user's files, into a folder.

        Raises:
            NoRecord: a file without one of the columns.
        """
        rows = self.rows(public)
        missing = [c for c in self.columns if not rows or c not in rows[0]]
        if missing:
            raise NoRecord(f"{public / self.file}: no column {missing[0]}; give the record's file as published")
        robot, table = folder / "rig.toml", folder / "runs.csv"
        robot.write_text(self.toml, encoding="utf-8")
        with table.open("w", newline="", encoding="utf-8") as file:
            out = csv.DictWriter(file, self.columns, extrasaction="ignore")
            out.writeheader()
            out.writerows(rows)
        return robot, table


class Braked(Public):
    """A dyno with the brake torque of each row in the file of its robot, by the row's configuration."""

    def rows(self, public: Path) -> list[dict[str, str]]:
        """Rows of the record's file, with the torque of the brake."""
        stated = tomllib.loads((public / self.file).with_suffix(".toml").read_text(encoding="utf-8"))
        torque = {name: one["torque_constant"].split()[0] for name, one in stated.items() if name[:1] == "t"}
        return [row | {"load_torque_Nm": torque[row["configuration"]]} for row in super().rows(public)]


def _mouse(side: str, driver: str = "", answer: Answer = Answer()) -> Public:
    columns = ("batteryVoltage", "motorCommand", f"{side}SpeedRpm")
    return Public("micromouse/log.csv", columns, MICROMOUSE.format(side=side, driver=driver), answer)


_COASTS = Answer("library", ("coast_decay",), ("voltage drop that changes with duty",))
#: Name → record; the sources and licences are in docs/lab/head-to-head.md.
PUBLIC: dict[str, Public] = {
    "micromouse-left": _mouse("left", answer=_COASTS),
    "micromouse-right": _mouse("right", answer=_COASTS),
    "micromouse-left-coasts": _mouse("left", '[driver]\ndecay = "fast"'),
    "micromouse-right-coasts": _mouse("right", '[driver]\ndecay = "fast"'),
    "car": Public("car/log_thin.csv", ("stamp_ns", "motor_throttle", "speed", "battery_voltage"), CAR),
    "neo-dyno": Braked(
        "neo_dyno/duty.csv",
        ("supply_voltage_V", "duty", "load_torque_Nm", "motor_speed_rpm", "total_current_A"),
        DYNO,
    ),
    "drivetrain": Public("drivetrain/log.csv", ("run_id", "timestamp", "l_voltage", "l_velocity"), DRIVETRAIN),
}

#: Prefixes of case folders with a robot's file and a table: short name, files, answer.
CASES: dict[str, tuple[str, str, str, Answer]] = {
    "real-01": ("real-01", "rig.toml", "runs.csv", Answer("outside", (), ("loss torque that changes with speed",))),
    "real-02": ("real-02", "rig.toml", "runs.csv", Answer("outside", (), ("loss torque that changes with speed",))),
    "03-": ("case-backdriving", "rig.toml", "table.csv", Answer("library", ("backdriving_loss",), ("loss torque",))),
    "05-": ("case-locked", "rig.toml", "table.csv", Answer("library", ("brush_drop",), ("voltage drop",))),
    "06-": ("case-outlier", "rig.toml", "table.csv", Answer("clean")),
    "log-F6": ("case-coasting", "rig.toml", "table.csv", _COASTS),
}


# --- records by name ----------------------------------------------------------------------------------


def names(public: Path | None, cases: Path | None, rigs: int = RIGS) -> dict[str, list[str]]:
    """Group → names of its records."""
    return {
        "packaged": ["packaged"],
        "public": list(PUBLIC) if public else [],
        "cases": [short for short, *_ in CASES.values()] if cases else [],
        "synthetic": [f"rig-{k:02d}" for k in range(rigs)],
    }


def record(name: str, folder: Path, public: Path | None, cases: Path | None, seed: int) -> Record:
    """A record by its name, with its files written into `folder`.

    Args:
        public: folder of the public records.
        cases: folder of cases.
        seed: of the synthetic rigs.

    Raises:
        NoRecord: a missing file, a folder that is not given, or a rig that cannot be drawn.
    """
    if name == "packaged":
        table = ROOT / "calibration" / "data" / "measured.csv"
        return Record(name, "nominal", table, Answer("library", (), ("voltage drop",)))
    if name in PUBLIC:
        if public is None or not (public / PUBLIC[name].file).exists():
            raise NoRecord(f"{name}: not in the folder of --public ({PUBLIC[name].file})")
        robot, table = PUBLIC[name].write(public, folder)
        return Record(name, str(robot), table, PUBLIC[name].answer)
    for begins, (short, robot_file, table_file, answer) in CASES.items():
        if short == name:
            found = sorted(cases.glob(f"{begins}*")) if cases else []
            if not found:
                raise NoRecord(f"{name}: not in the folder of --cases ({begins}*)")
            return Record(name, str(found[0] / robot_file), found[0] / table_file, answer)
    if name.startswith("rig-") and name[4:].isdigit():
        return _synthetic(int(name[4:]), name, folder, seed)
    raise NoRecord(f"{name}: no such record")


def _synthetic(number: int, name: str, folder: Path, seed: int) -> Record:
    """A synthetic rig of `tests/worlds/rigs.py`, drawn as in `benchmarks/rigs.py`."""
    import rigs

    kind = TURN[number % len(TURN)]
    for k in range(TRIES):
        case = rigs.attempt(kind, seed + TRIES * number + k)
        if not isinstance(case, str):
            case.write(folder)
            return Record(name, str(folder / "rig.toml"), folder / "table.csv", labelled(case.label), case)
    raise NoRecord(f"{name}: no {kind} rig in {TRIES} seeds")


def labelled(label: dict[str, Any]) -> Answer:
    """The answer stated in a synthetic case's label."""
    if not label["effects"]:
        return Answer("clean")
    from loop_scores import MIMIC

    (effect,) = label["effects"]
    names = tuple(dict.fromkeys(n for n in (effect["class"], *effect["class_oracle"]) if n))
    families = dict.fromkeys(_family(n) for n in names)
    if not effect["class"]:
        names = (*names, effect["mimic"]) if effect["best_other"] < MIMIC else names
        families = dict.fromkeys([_place(effect), *families])
    return Answer(label["kind"], names, tuple(families))


@functools.cache
def _family(name: str) -> str:
    from mmrjax.effects import BY_NAME, OF_CHANNELS

    every: dict[str, Any] = {**BY_NAME, **OF_CHANNELS}
    return str(every[name].family())


def _place(effect: dict[str, Any]) -> str:
    from mmrjax.effects.base import EQUATION

    what = EQUATION[effect["balance"]]
    return f"{what} of {effect['channel']}".replace("_", " ") if effect["channel"] else what


def judged(level: str, claims: list[list[str]], families: list[str], answer: Answer) -> bool | None:
    """True for a wrong claim, None if the answer is not known.

    Args:
        level: word of the verdict.
        claims: classes of established effects.
        families: mechanisms, or the place.
    """
    if answer.kind == "unknown":
        return None
    if level in ("none", "undescribed"):
        return False
    return answer.kind == "clean" or _off(level, claims, families, answer)


def _off(level: str, claims: list[list[str]], families: list[str], answer: Answer) -> bool:
    """True if a claim about a missing effect is wrong."""
    if level in ("named", "class") and answer.names:
        return not all(set(members) & set(answer.names) for members in claims)
    if level in ("named", "class") and answer.kind == "outside":
        return True
    if level in ("named", "class", "mechanism"):
        return not any(f.startswith(a) for f in families for a in answer.families)
    return not {_equation(f) for f in families} & {_equation(a) for a in answer.families}


def _equation(family: str) -> str:
    """The equation of a family in words. Losses, weights and inertias act on the same one."""
    what = family.partition(" that ")[0]
    return "torque" if what in ("loss torque", "resistance to travel", "mass", "inertia") else what
