"""Friction laws of servo gears on public records: held-out error, parameters, and what a record separates.

    python benchmarks/gears.py --data DIR [--out docs/lab/gears.md] [--shelf docs/actuators]

`DIR` holds folders of JSON logs of a servo that swings a mass on an arm. `xl330` is bam/data.bak/raw of
github.com/Rhoban/bam (Apache-2.0, commit af226046). `sts3215` and `sts3250` are of github.com/kscalelabs/sysid (no
licence): data/feetech/STS_3215_12V_20250317/raw of commit 6b787370 and data/feetech/STS_3250/raw of d66b22c. The mass
of the arm is not in these logs. Mass and length give the torque T = m l² α + m g l sin θ at the output. The motor's
voltage is c U = T + k ω + J α + friction. The columns of friction are the terms of the program's own effects.
Coefficients follow by least squares with the signs that physics allows, shapes by a grid, both from training logs
alone. The voltage is predicted, because a loss by torque would contain the torque that it predicts.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
from scipy.optimize import lsq_linear
from scipy.signal import savgol_filter

#: Angle of a lost reading [rad].
LOST = -3.14
#: Window of the smoothed angle [s], and speed above which rows are compared [rad/s].
SMOOTHED, MOVES = 0.09, 0.1
#: Laws by their names in the tables: effects besides dry and viscous friction.
LAWS = {
    "Coulomb and viscous": (),
    "LuGre": ("presliding", "stribeck_exponent"),
    "load loss": ("gear_load_loss",),
    "load loss by direction": ("gear_load_loss", "backdriving_loss"),
    "bristle": ("presliding", "bristle_load_loss", "bristle_backdriving_loss"),
}
#: Shapes that are searched: angle over which bristles yield [rad], and speed at which friction has fallen [rad/s].
YIELDS, FADES = (0.005, 0.01, 0.02, 0.04), (0.1, 0.3, 1.0)
#: Title of each record, and the gain at which its logs are repeated [raw number]. 0: they are not.
RECORDS = {"xl330": ("Dynamixel XL330", 0), "sts3215": ("Feetech STS3215", 16), "sts3250": ("Feetech STS3250", 16)}
BASE = ("c", "k", "J", "M_0", "K")
UNITS = {"c": "N·m/V", "k": "N·m·s", "J": "kg·m²", "K": "N·m·s"}
UNITS |= dict.fromkeys(("M_0", "presliding", "stribeck_exponent"), "N·m")
#: Draws of logs for intervals.
DRAWS = 200
GRAVITY = 9.81


@dataclasses.dataclass(frozen=True)
class Log:
    """Rows of a log: columns of `BASE`, voltage [V], torque T [N·m], speed [rad/s], time [s]."""

    base: np.ndarray
    voltage: np.ndarray
    torque: np.ndarray
    speed: np.ndarray
    time: np.ndarray

    @property
    def moves(self) -> np.ndarray:
        """True for rows that are compared."""
        return np.abs(self.speed) > MOVES


def read_log(path: Path) -> Log:
    """A log of bam's pendulum, on an even clock."""
    text = json.loads(path.read_text(encoding="utf-8"))
    entries = [e for e in text["entries"] if e["position"] > LOST]
    raw = {k: np.array([e[k] for e in entries], float) for k in entries[0]}
    time = np.linspace(raw["timestamp"][0], raw["timestamp"][-1], len(raw["timestamp"]))
    at = {k: np.interp(time, raw["timestamp"], v) for k, v in raw.items() if k != "load"}
    if np.any(raw["load"]):  # an XL330 shows the share of its voltage, of 885, in 16 bits
        duty = np.interp(
            time, raw["timestamp"], np.where(raw["load"] > 2**15, raw["load"] - 2**16, raw["load"]) / 885
        )
    else:  # the law of an STS3250, as bam states it
        duty = np.clip(0.166 * text["kp"] * (at["goal_position"] - at["position"]), -0.97, 0.97)
    step = time[1] - time[0]
    window = max(2 * round(SMOOTHED / step / 2) + 1, 5)
    angle, speed, turning = (savgol_filter(at["position"], window, 3, deriv=k, delta=step) for k in range(3))
    on = (at["torque_enable"] > 0.5).astype(float)
    mass, length = text["mass"], text["length"]
    torque = mass * length**2 * turning + mass * GRAVITY * length * np.sin(angle)
    dry = np.tanh(speed / 0.02)
    base = np.stack([torque, on * speed, turning, dry, speed], 1)
    return Log(base, on * duty * at["input_volts"], torque, speed, time)


def selected(paths: list[Path], gain: int) -> list[Path]:
    """Logs of a record. If they are repeated, the first of each mass, arm and course at one gain, without steps."""
    if not gain:
        return paths
    texts = {path: json.loads(path.read_text(encoding="utf-8")) for path in reversed(paths)}
    first = {
        (text["mass"], text["length"], text["trajectory"]): path
        for path, text in texts.items()
        if text["kp"] == gain and text["trajectory"] != "brutal"
    }
    return sorted(first.values())


def columns(log: Log, law: str, yields: float, fade: float) -> np.ndarray:
    """Terms of the effects of a law at an amplitude of 1."""
    import jax
    import jax.numpy as jnp

    from mmrjax.effects import BESIDE, BY_NAME
    from mmrjax.model import paper_robots
    from mmrjax.model.signals import Signals

    robot, known = paper_robots.nominal(), {**BY_NAME, **BESIDE}
    step, direction = log.time[1] - log.time[0], np.tanh(log.speed / 0.02)
    bend = np.zeros(len(log.speed))
    for n, speed in enumerate(log.speed[:-1]):  # of Dahl's bristle, one implicit step for each row
        bend[n + 1] = (bend[n] + step * speed / yields) / (1 + step * abs(speed) / yields)
    shapes = {"angle_breakaway": yields, "speed_fade": fade}
    out = []
    for name in LAWS[law]:
        fields = {f.name for f in dataclasses.fields(known[name])}
        effect = known[name](amplitude=1.0, **{k: v for k, v in shapes.items() if k in fields})

        def term(torque, speed, way, bent, effect=effect):
            signals = Signals(
                configuration=0, on_tracks=0.0, torque_carried=torque, speed_wheel=speed, speed_output=speed,
                direction=way, direction_travel=way, memory={effect.name: bent},
            )  # fmt: skip
            return effect.term(robot, signals)

        out.append(np.asarray(jax.vmap(term)(*map(jnp.asarray, (log.torque, log.speed, direction, bend)))))
    return np.stack(out, 1) if out else np.zeros((len(log.speed), 0))


def condensed(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As few equations with the same sums of squares."""
    triangle = np.linalg.qr(np.column_stack([x, y]), "r")
    return triangle[:, :-1], triangle[:, -1]


def fit(parts: list[tuple[np.ndarray, np.ndarray]], names: tuple[str, ...]) -> np.ndarray:
    """Least squares of voltages on columns, (rows, columns) and (rows,) of each log, losses not negative."""
    x, y = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-12)
    signed = {"backdriving_loss", "bristle_backdriving_loss", "stribeck_exponent"}
    low = np.array([-np.inf if n in signed else 0.0 for n in names])
    return lsq_linear(x / size, y, (low * size, np.full(len(names), np.inf))).x / size


def rms(x: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(x**2)))


def moving(logs: list[Log], column: str) -> np.ndarray:
    """A column of the compared rows of all logs."""
    return np.concatenate([getattr(log, column)[log.moves] for log in logs])


def mean_and_error(x: np.ndarray) -> tuple[float, float]:
    """Mean over logs and its standard error."""
    return float(np.mean(x)), float(np.std(x, ddof=1) / np.sqrt(len(x)))


def study(logs: list[Log], law: str) -> dict:
    """Held-out errors of each log, parameters with intervals of drawn logs, and the shapes of the whole record."""
    names = (*BASE, *LAWS[law])
    yields = YIELDS if any(n in LAWS[law] for n in ("presliding", "bristle_load_loss")) else YIELDS[:1]
    grid = list(itertools.product(yields, FADES if "stribeck_exponent" in LAWS[law] else FADES[:1]))
    parts = {
        shape: [
            condensed(np.hstack([log.base, columns(log, law, *shape)])[log.moves], log.voltage[log.moves])
            for log in logs
        ]
        for shape in grid
    }

    def best(which: list[int]) -> tuple[tuple[float, float], np.ndarray]:
        fits = {s: fit([p[k] for k in which], names) for s, p in parts.items()}
        cost = {s: sum(np.sum((parts[s][k][1] - parts[s][k][0] @ fits[s]) ** 2) for k in which) for s in fits}
        shape = min(cost, key=cost.__getitem__)
        return shape, fits[shape]

    every = list(range(len(logs)))
    errors = []
    for out in every:
        shape, x = best([k for k in every if k != out])
        left = parts[shape][out][1] - parts[shape][out][0] @ x
        errors.append(float(np.sqrt(np.sum(left**2) / np.sum(logs[out].moves))))
    shape, x = best(every)
    random = np.random.default_rng(0)
    drawn = [fit([parts[shape][k] for k in random.choice(every, len(every))], names) for _ in range(DRAWS)]
    drawn = np.stack([physical(y) for y in drawn])
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    values = zip(physical(x), low, high, strict=True)
    return {
        "errors": np.array(errors),
        "shape": shape,
        "values": dict(zip(names, values, strict=True)),
        "drawn": drawn,
    }


def physical(x: np.ndarray) -> np.ndarray:
    """Parameters for coefficients of the voltage, of which the first is 1/c."""
    return np.append(1 / x[0], x[1:] / x[0])


def section(name: str, logs: list[Log]) -> str:
    """Section of the page for one record."""
    torque, speed, whole = moving(logs, "torque"), moving(logs, "speed"), rms(moving(logs, "voltage"))
    back = float(np.mean(torque * speed < 0))
    found = {law: study(logs, law) for law in LAWS}
    plain = found["Coulomb and viscous"]["errors"]
    lines = [
        f"## {name}\n",
        f"{len(logs)} logs, {len(torque)} rows that move. Voltage {whole:.3g} V (rms), "
        f"torque up to {np.abs(torque).max():.3g} N·m. "
        f"Speed up to {np.abs(speed).max():.3g} rad/s. The load drives in {100 * back:.0f} % of the rows.\n",
        "| law | held-out error [V] | [% of rms] | less than Coulomb and viscous [V] |",
        "|---|---|---|---|",
    ]
    for law, x in found.items():
        (gain, sd), mean = mean_and_error(plain - x["errors"]), rms(x["errors"])
        less = "" if law == "Coulomb and viscous" else f"{gain:.3f} ± {sd:.3f}"
        lines.append(f"| {law} | {mean:.3f} | {100 * mean / whole:.1f} | {less} |")
    lines += ["", "| law | parameter | value | 95 % interval | unit |", "|---|---|---|---|---|"]
    for law, x in found.items():
        for n, (value, low, high) in x["values"].items():
            if n in LAWS[law] or law == "Coulomb and viscous":
                lines.append(
                    f"| {law} | {n} | {short(value)} | {short(low)} to {short(high)} | {UNITS.get(n, '-')} |"
                )
    return "\n".join([*lines, "", separated(found), ""])


def short(x: float) -> str:
    """Four digits, 0 at a bound."""
    return f"{x:.4g}" if abs(x) > 1e-7 else "0"


def separated(found: dict) -> str:
    """Sentences for the pairs of laws that the record tells apart, by the errors of its logs."""
    names, words = list(LAWS), []
    for a, b in itertools.pairwise(names[1:]):
        gain, sd = mean_and_error(found[a]["errors"] - found[b]["errors"])
        answer = f"{b if gain > 0 else a} predicts better" if abs(gain) > 2 * sd else "not told apart"
        words.append(f"* {a}, {b}: {answer} ({gain:.3f} ± {sd:.3f} V).")
    return "\n".join(words)


ROBOT = """schema = "mmrjax.robot/2"
base = "none"
sides = 1
imposed = "voltage"
channels = ["output_angle"]
[motor]
resistance = {R:.4g}
torque_constant = {C:.4g}
inertia = {J:.4g}
voltage_limit = {limit:.3g}
[gearbox]
ratio = 1
efficiency_load = 1.0
[arm]
load = "shaft"
inertia = {inertia:.4g}
torque_gravity = {weight:.4g}
loss_coulomb = {M_0}
loss_viscous = {K}
[effects.gear_load_loss]
amplitude = {share:.4g}
"""
#: Page of an identified actuator.
SHELF = """# {name}

Identified from public logs of a servo that swings a mass, without its case being opened. `python benchmarks/gears.py
--data DIR --shelf docs/actuators` wrote this page.
[Load loss of gears](../lab/gears.md) has source, licence and method.

* Unseen error of the voltage: {error:.2g} V (rms), {percent:.1f} % of the rms, over logs left out one at a time.
* 95 % intervals: share lost by torque {share}, constant k/c {constant} N·m/A, c {c} N·m/V, inertia {inertia} kg·m².
* Conditions seen: {conditions}.
* Not told apart: the two directions of the load loss. Gear ratio and motor: all numbers are at the output, as
  of a motor with the ratio 1. Effects of temperature. Dry friction of 0: the load loss explains it in these rows.

## robot.toml

```toml
{robot}```

## drive.xml

```xml
{drive}```

{law}"""
TOP = """# Load loss of gears

`<dcmotor>` of MuJoCo has Coulomb, viscous and LuGre friction. google-deepmind/mujoco issue 3528 asks for a loss in
proportion to the torque. This page compares such losses on public records. `python benchmarks/gears.py --data DIR`
wrote it from logs of [bam](https://github.com/Rhoban/bam) (Duclusaud, Passault, Padois and Ly 2024, Apache-2.0) and
[kscalelabs/sysid](https://github.com/kscalelabs/sysid) (no licence).

A law is fitted to all logs of a record but one. It predicts that one's voltage from its motion, in rows above
0.1 rad/s. The intervals come from drawing whole logs. ± is one standard error over logs. Load loss is
`gear_load_loss`, by direction with `backdriving_loss`. Bristle is `bristle_load_loss` with
`bristle_backdriving_loss` and `presliding`. LuGre is `presliding` with `stribeck_exponent`.

These logs have no current, or one that is renewed each 0.9 s. So a share lost while the motor drives looks like a
smaller torque constant c, and rows that move show only the ratio of both directions: the two directions are not told
apart. The arm's mass is not stated. The voltage of the XL330 is read. That of the others is computed from goal, angle
and the law that bam states. Logs of MX-64 and MX-106 have no torque, and EMPS has no load. No data are copied here.
"""


def actuator(robot: str) -> tuple[str, str]:
    """The drive of a robot's text as MJCF without comments, and its law, with headings of a page below."""
    import tempfile

    from calibration.data import robot_file
    from mmrjax.compile.compiling import in_double
    from sweeps.export.formats import export_format
    from sweeps.report import export_report

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.toml"
        path.write_text(robot, encoding="utf-8")
        exported = in_double(lambda: export_format(robot_file.find_robot_file(str(path)), "mujoco"))()
    drive = str(exported.files["drive.xml"]).splitlines(keepends=True)
    law = export_report.law_text(exported).replace("\n## ", "\n### ").replace("# The law", "## LAW.md: the law", 1)
    return "".join(line for line in drive if "<!--" not in line), law


def shelf_page(name: str, logs: list[Log], paths: list[Path]) -> str:
    """Page of an actuator with its load loss."""
    found, text = study(logs, "load loss"), json.loads(paths[0].read_text(encoding="utf-8"))
    values = {n: x[0] for n, x in found["values"].items()}
    mass, length, (c, k) = text["mass"], text["length"], (values["c"], values["k"])
    robot = ROBOT.format(
        R=k / c**2, C=k / c, J=values["J"], M_0=short(values["M_0"]), K=short(values["K"]),
        share=values["gear_load_loss"], limit=text["vin"], inertia=mass * length**2, weight=mass * length * GRAVITY,
    )  # fmt: skip
    between = {n: f"{short(low)} to {short(high)}" for n, (_, low, high) in found["values"].items()}
    voltage, torque = moving(logs, "voltage"), moving(logs, "torque")
    error = rms(found["errors"])
    ratio = np.quantile(found["drawn"][:, 1] / found["drawn"][:, 0], [0.025, 0.975])
    drive, law = actuator(robot)
    return SHELF.format(
        name=name, error=error, percent=100 * error / rms(voltage), share=between["gear_load_loss"], c=between["c"],
        constant=f"{ratio[0]:.3g} to {ratio[1]:.3g}", inertia=between["J"], robot=robot, drive=drive, law=law,
        conditions=f"{len(logs)} logs, torque to {np.abs(torque).max():.3g} N·m, voltage to "
        f"{np.abs(voltage).max():.3g} V, mass {mass:g} kg on {length:g} m",
    )  # fmt: skip


def main() -> None:
    """Writes the pages."""
    wanted = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    wanted.add_argument("--data", type=Path, required=True)
    wanted.add_argument("--out", type=Path, default=Path("docs/lab/gears.md"))
    wanted.add_argument("--shelf", type=Path, help="folder of the pages of actuators")
    given = wanted.parse_args()
    texts = [TOP]
    for folder, (name, gain) in RECORDS.items():
        paths = selected(sorted((given.data / folder).glob("*.json")), gain)
        if paths:
            logs = [read_log(p) for p in paths]
            texts.append(section(name, logs))
            # The voltage of the other records is computed, no law predicts it well, and they have no licence.
            if given.shelf is not None and folder == "xl330":
                given.shelf.mkdir(exist_ok=True)
                (given.shelf / f"{folder}.md").write_text(shelf_page(name, logs, paths), encoding="utf-8")
    given.out.write_text("\n".join(texts).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
