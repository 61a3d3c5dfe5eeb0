"""The paper's findings at a shaking running gear (set S of docs/explanation/vibration.md), and C MuJoCo.

    python benchmarks/shaking.py            # findings: twenty rows at two steps, a minute on two cores
    python benchmarks/shaking.py --native   # C MuJoCo stepped with the same forces, two points, two minutes

Findings: ripple of speed, current and reaction, repetition with eq. (34). Position of the maxima of current and
reaction within the pitch, from the landing of a grouser, Figs. 26, 27. Prints lines of JSON.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from measure import machine  # noqa: E402

from mmrjax.fidelities.track import STEP, track  # noqa: E402
from mmrjax.model import balances, paper_robots, params  # noqa: E402
from mmrjax.model.conditions import Conditions  # noqa: E402
from mmrjax.model.robot import Robot  # noqa: E402
from mmrjax.model.signals import STATUSES, State  # noqa: E402
from mmrjax.undercarriage import mjcf  # noqa: E402
from mmrjax.undercarriage.half_robot import (  # noqa: E402
    HalfRobotState,
    advance,
    build_system,
    damping_matrix,
    generalized_forces,
    instant,
    roll,
)
from mmrjax.undercarriage.ripple_peaks import period_pitch, touchdown_times  # noqa: E402
from mmrjax.undercarriage.running_gear import GROUSERS, TEETH_BELT  # noqa: E402

SET_S = {
    "6T2A.ground.friction.static": 0.6093, "6T2A.ground.friction.dynamic": 0.5331,
    "6T2A.ground.friction.speed_static": 0.00961, "6T2A.ground.friction.speed_dynamic": 0.0961,
    "6T2A.track.guide_friction": 0.06,
    "running_gear.guide_recess": 3.648e-4, "running_gear.guide_gap": 0.01066,
    "running_gear.contact_stiffness": 3.816e7, "running_gear.contact_damping": 649.2,
    "running_gear.centre_offset": 0.00011, "running_gear.payload_height": 0.0595,
}  # fmt: skip
#: Adhesion for the wheeled robot on 20 deg, Table 5: smooth concrete.
WHEELED = {"4W2T.ground.friction.static": 0.60, "4W2T.ground.friction.dynamic": 0.48}
DURATION, SAMPLE, LAST = 2.0, 2e-4, 0.8  # of a run, of its record, of the evaluated part [s]
#: 15 V without payload and 33 V with 8 kg, at 0 to 20 deg, on tracks and on wheels.
WHEELS = np.repeat([0.0, 1.0], 10)
VOLTAGE = np.tile(np.repeat([15.0, 33.0], 5), 2)
PAYLOAD = np.tile(np.repeat([0.0, 8.0], 5), 2)
SLOPE = np.tile([0.0, 5.0, 10.0, 15.0, 20.0], 4)
#: Operating points of the comparison: (voltage, slope, payload), and its length [steps].
POINTS, STEPS = ((15.0, 10.0, 0.0), (33.0, 5.0, 8.0)), 12_000


def shaking(changed: dict[str, float] | None = None) -> Robot:
    """Nominal robot with set S."""
    values = SET_S | WHEELED | (changed or {})
    return params.replace(paper_robots.nominal(), {name: jnp.asarray(value) for name, value in values.items()})


@eqx.filter_jit
def recorded(robot: Robot, step: float) -> dict[str, jax.Array]:
    """Every row from a rolling start: status, and records of its last part."""

    def one(*row: jax.Array) -> dict[str, jax.Array]:
        wheels, voltage, slope, payload = row
        conditions = Conditions(wheels, voltage=voltage, slope_deg=slope, payload=payload)
        run = track(robot, conditions, duration=DURATION, step=step, sample=SAMPLE, rolling=True)
        last = slice(-round(LAST / SAMPLE), None)
        found = {n: getattr(run.signals, n)[last] for n in ("speed", "total_current", "normal", "speed_theoretical")}
        grousers = {"grouser": run.reactions.grouser[last], "place": run.reactions.place[last]}
        return found | grousers | {"time": run.time[last], "status": run.result.status}

    return jax.vmap(one)(*map(jnp.asarray, (WHEELS, VOLTAGE, SLOPE, PAYLOAD)))


def repeats(time: np.ndarray, values: np.ndarray, period: float) -> dict[str, float]:
    """Autocorrelation of a record after a period, and the best lag near that period, over it [-]."""
    rest = values - np.polyval(np.polyfit(time, values, 1), time)
    step = time[1] - time[0]

    def agreement(lag: float) -> float:
        later = np.interp(time[0] + lag + step * np.arange(round((time[-1] - time[0] - lag) / step)), time, rest)
        return float(np.corrcoef(rest[: len(later)], later)[0, 1])

    lags = period * np.linspace(0.7, 1.3, 121)
    best = lags[np.argmax([agreement(lag) for lag in lags])]
    return {"agreement": round(agreement(period), 3), "best lag": round(float(best / period), 3)}


def passes(time: np.ndarray, grouser: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Times of first touchdown in front and of last contact at the rear of each grouser [s].

    Bounces in between do not count.
    """
    lands, lifts = [], []
    for k in range(grouser.shape[1]):
        bears = time[grouser[:, k] > 0]
        gaps = np.flatnonzero(np.diff(bears) > 4 * period)  # once round the pulleys and over the top
        lands += list(bears[gaps + 1])
        lifts += list(bears[gaps])
        # Grousers that are up at the start or end of the record.
        if len(bears) and bears[0] - time[0] > 4 * period:
            lands.append(bears[0])
        if len(bears) and time[-1] - bears[-1] > 4 * period:
            lifts.append(bears[-1])
    return np.sort(lands), np.sort(lifts)


def phases(times: np.ndarray, since: float, period: float) -> np.ndarray:
    """Position of times within the pitch, about their circular mean [of a pitch]."""
    turns = np.exp(2j * np.pi * (times - since) / period)
    mean = np.angle(turns.mean())
    return (np.angle(turns * np.exp(-1j * mean)) + mean) / (2 * np.pi)


def folded(time: np.ndarray, values: np.ndarray, since: float, period: float) -> np.ndarray:
    """Mean over each twentieth of the period, starting at `since`."""
    bins = ((((time - since) / period) % 1) * 20).astype(int)
    return np.array([values[bins == k].mean() for k in range(20)])


def peaks(mean: np.ndarray) -> list[float]:
    """Positions in the period of local maxima of a folded record above its mean."""
    higher = (mean > np.roll(mean, 1)) & (mean >= np.roll(mean, -1)) & (mean > mean.mean())
    return [int(k) / len(mean) for k in np.flatnonzero(higher)]


def findings(step: float) -> list[dict[str, Any]]:
    """Findings of each row."""
    robot, rows = shaking(), []
    record = jax.device_get(recorded(robot, step))
    pulley = float(robot.radius_pulley)
    for k in range(len(WHEELS)):
        run = {name: np.asarray(x[k], float) for name, x in record.items()}
        tracked, time = WHEELS[k] == 0, run["time"]
        radius = float(robot.configurations["6T2A" if tracked else "4W2T"].radius)
        wheel = run["speed_theoretical"].mean() / radius
        pitch = (TEETH_BELT / GROUSERS if tracked else 1.0) * 5e-3
        period = period_pitch(pitch, wheel, pulley)
        row: dict[str, Any] = {
            "tracks": bool(tracked), "voltage": VOLTAGE[k], "slope_deg": SLOPE[k],
            "status": STATUSES[int(record["status"][k])],
        }  # fmt: skip
        for name in ("speed", "total_current", "normal"):
            x = run[name]
            row[name] = {
                "std_percent": float(f"{100 * x.std() / x.mean():.3g}"),
                "amplitude_percent": float(f"{50 * np.ptp(x) / x.mean():.3g}"),
                **repeats(time, x, period),
            }
        if tracked:
            lands, lifts = passes(time, run["grouser"], period)
            row["touchdowns a grouser"] = round(
                len(touchdown_times(time, run["grouser"], run["place"])) / len(lands), 2
            )
            row["scatter of landings, of a pitch"] = round(float(np.std(phases(lands, lands[0], period))), 3)
            row["lifts after landing, of a pitch"] = round(float(np.mean(phases(lifts, lands[0], period)) % 1), 2)
            for name in ("total_current", "normal"):
                mean = folded(time, run[name], lands[0], period)
                row[name]["highest after landing, of a pitch"] = int(np.argmax(mean)) / len(mean)
                row[name]["peaks, of a pitch"] = peaks(mean)
            row["nothing bears, share of time"] = round(float(np.mean(run["grouser"].sum(1) == 0)), 3)
        rows.append(row)
    return rows


def native(voltage: float, slope: float, payload: float) -> dict[str, Any]:
    """C MuJoCo and MJX with the same forces, each on its own trajectory from one rolling start."""
    import mujoco

    robot, run = shaking(), Conditions(voltage=voltage, slope_deg=slope, payload=payload)
    rest = State(*(jnp.asarray(0.0) for _ in range(4)))
    mass = float(balances.begin_signals(robot, run, rest).mass)
    model = mujoco.MjModel.from_xml_string(mjcf.mjcf_text(robot, run, mass, STEP))
    data = mujoco.MjData(model)

    @jax.jit
    def forces(motion: HalfRobotState) -> tuple[Any, ...]:
        constants = build_system(robot, run, STEP)
        signals, at, pulled = instant(constants, motion)
        after, _, _ = advance(constants, motion)
        damping = damping_matrix(constants, motion, signals, at, pulled)
        return *generalized_forces(constants, signals, pulled), damping, after, at.normal

    @jax.jit
    def ours(motion: HalfRobotState) -> jax.Array:
        constants = build_system(robot, run, STEP)

        def small(m: HalfRobotState, _: None) -> tuple[HalfRobotState, tuple[jax.Array, jax.Array]]:
            return advance(constants, m)[0], (instant(constants, m)[1].normal, m.v[0])

        return jax.lax.scan(small, motion, None, length=STEPS)[1]

    motion = roll(build_system(robot, run, STEP))
    normal, speed = map(np.asarray, ours(motion))
    data.qpos[:], data.qvel[:] = motion.q, motion.v
    full, theirs, fast = np.zeros((model.nv, model.nv)), np.empty(STEPS), np.empty(STEPS)
    for k in range(STEPS):
        force, armature, damping, after, theirs[k] = forces(motion)
        fast[k] = data.qvel[0]
        model.dof_armature[:] = armature
        data.qfrc_applied[:] = force
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        data.qvel[:] += np.linalg.solve(full + STEP * np.asarray(damping), STEP * full @ data.qacc)
        mujoco.mj_integratePos(model, data.qpos, data.qvel, STEP)
        # Its current is ours: the next value depends only on this instant.
        motion = HalfRobotState(jnp.asarray(data.qpos), jnp.asarray(data.qvel), after.current, after.discharge)
    last = slice(STEPS // 2, None)
    apart = np.abs(theirs - normal) > 0.01 * normal.mean()
    return {
        "voltage": voltage, "slope_deg": slope, "payload": payload,
        "std over mean": {"C MuJoCo": theirs[last].std() / theirs[last].mean(),
                          "MJX": normal[last].std() / normal[last].mean()},
        "mean speed": {"C MuJoCo": fast[last].mean(), "MJX": speed[last].mean()},
        "reactions first apart by 1 % of their mean after_s": float(np.argmax(apart) * STEP) if apart.any() else None,
    }  # fmt: skip


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument(
        "--native", action="store_true", help="C MuJoCo with the same forces instead of the findings"
    )
    options.add_argument("--parts", type=int, nargs="+", default=[1, 2], help="of the step")
    arguments = options.parse_args()
    print(json.dumps({"benchmark": "shaking", "machine": machine()}), flush=True)
    if arguments.native:
        for point in POINTS:
            print(json.dumps(native(*point)), flush=True)
        return
    for parts in arguments.parts:
        for row in findings(STEP / parts):
            print(json.dumps({"step": STEP / parts} | row), flush=True)


if __name__ == "__main__":
    main()
