# ruff: noqa: E402 (double precision is set before anything is imported)
"""A free chain of 168 masses as an independent check of the belt model: guide share and ripple.

python benchmarks/free_chain.py            only the chain
python benchmarks/free_chain.py --track    compared with the track model, over the guide's recess
python benchmarks/free_chain.py --shaking --track    at set S of docs/explanation/vibration.md

One side of 6T2A on level ground without payload. The masses of the belt are free in the plane, joined by stiff
springs. Two 48-tooth pulleys hold them from inside by one-sided springs and drive them by tooth
springs. The guides are one-sided springs. Every seventh mass has a grouser, normal to the line of its
two neighbours, which meets the ground by (27)-(29) and Fig. 7, the library's own laws. The chassis is rigid
(travel, height, pitch), the driving pulley turns at a given speed, the driven one is free.

The chain shares no code with `belt` or `undercarriage`. It is chaotic: its averages and periods are meaningful,
its derivatives are not.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from shaking import shaking

from mmrjax.fidelities.track import _simulate_batch
from mmrjax.model import balances, masses, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.contact import cubic_step, force_contact
from mmrjax.model.paper_robots import nominal
from mmrjax.model.robot import Robot
from mmrjax.model.signals import GRAVITY, State
from mmrjax.undercarriage import mjcf
from mmrjax.undercarriage.ripple_peaks import measure_ripple, period_pitch
from mmrjax.undercarriage.running_gear import GROUSERS, TEETH_BELT, TEETH_PULLEY, RunningGear

# [s]; half of it changes the share by less than the scatter of two windows. Explicit: the damping of a grouser on the
# mass of its link allows 2 m / b_max = 1.6e-6 s at 300 N·s/m, 0.6e-6 s at 800; main() uses a third of it if smaller.
STEP = 1e-6
SAMPLE = 500  # steps
SPEED = 25.66  # [rad/s], of the driving pulley; 6T2A at 33 V on the flat

# Not in the track model, where pulley, guide and teeth are rigid. Stiff compared with a grouser (2e5 N/m under 8 N).
TEETH_STIFFNESS, TEETH_DAMPING = 2e6, 10.0  # [N/m], [N·s/m] of a mass on pulley, tooth or guide
# A run's own damping (10 N·s/m) would overdamp each of its 60 links and limit the step.
LINK_DAMPING = 20.0  # [N·s/m]

FIRST = jnp.arange(GROUSERS) * (TEETH_BELT // GROUSERS)  # the masses that carry grousers


class Motion(NamedTuple):
    """Masses of the belt and their velocities (168, 2). Chassis (x, z, pitch nose down), driven pulley."""

    place: jax.Array
    speed: jax.Array
    body: jax.Array
    rate: jax.Array
    driven: jax.Array
    driven_rate: jax.Array


class Sums(NamedTuple):
    """Sums of an instant [N]. `off`: distance of the outermost mass from the nominal path [m]."""

    normal: jax.Array
    guide: jax.Array
    pulleys: jax.Array
    tension_upper: jax.Array
    tension_lower: jax.Array
    off: jax.Array


class Chain(NamedTuple):
    """Constants of one side."""

    gear: RunningGear
    half: mjcf.HalfRobotMasses
    ground: object
    guide_friction: float
    radius: float  # of the pulley's polygon, at the masses
    link: float  # pitch of the belt [m]


def chain(gear: RunningGear, robot: Robot | None = None) -> Chain:
    """A robot's 6T2A on level ground (None: the nominal one's), with `gear`."""
    robot = dataclasses.replace(nominal() if robot is None else robot, running_gear=gear)
    run = Conditions(voltage=33.0)
    rest = State(*(jnp.zeros(()) for _ in range(4)))
    half = masses.masses_of_parts(robot, run, balances.begin_signals(robot, run, rest).mass)
    link = (2 * gear.wheelbase + 2 * jnp.pi * robot.configurations["6T2A"].radius) / TEETH_BELT
    radius = link / (2 * jnp.sin(jnp.pi / TEETH_PULLEY))
    return Chain(
        gear,
        half,
        robot.configurations["6T2A"].ground,
        robot.configurations["6T2A"].track.guide_friction,
        radius,
        link,
    )


def _turn(vector, angle):
    # Chassis frame to ground frame; pitch is nose down.
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, z = vector[..., 0], vector[..., 1]
    return jnp.stack([x * cos + z * sin, z * cos - x * sin], -1)


def start(c: Chain, speed: float) -> Motion:
    """The belt on its path, all parts at their final speed, the robot on the ground."""
    at = jnp.arange(TEETH_BELT) * c.link
    base, arc = c.gear.wheelbase, TEETH_PULLEY // 2 * c.link
    turned = jnp.where(at < base, 0.0, jnp.minimum((at - base) / arc, 1.0))
    turned = turned + jnp.clip((at - 2 * base - arc) / arc, 0.0, 1.0)
    x = base / 2 - jnp.clip(at, 0, base) + jnp.clip(at - base - arc, 0, base)
    angle = jnp.pi * turned  # from straight down, over the rear
    local = jnp.stack([x - c.radius * jnp.sin(angle), -c.radius * jnp.cos(angle)], -1)
    along = jnp.stack([-jnp.cos(angle), jnp.sin(angle)], -1)
    height = c.radius + c.gear.grouser_height - 4e-5
    pace = c.link * TEETH_PULLEY / (2 * jnp.pi) * speed
    return Motion(
        place=local + jnp.asarray([0.0, height]),
        speed=along * pace + jnp.asarray([pace, 0.0]),
        body=jnp.asarray([0.0, height, 0.0]),
        rate=jnp.asarray([pace, 0.0, 0.0]),
        driven=jnp.zeros(()),
        driven_rate=jnp.asarray(speed),
    )


def forces(c: Chain, m: Motion, turn, speed):
    """Forces on the masses, on the chassis (x, z, pitch), torque on the driven pulley, and the sums."""
    gear = c.gear
    ahead, behind = partial(jnp.roll, shift=-1, axis=0), partial(jnp.roll, shift=1, axis=0)
    # links
    span = ahead(m.place) - m.place
    long = jnp.sqrt(jnp.sum(span**2, -1))
    unit = span / long[:, None]
    links = gear.wheelbase / c.link  # of a run
    stiffness = gear.span_stiffness * links
    rest = c.link - gear.pretension / stiffness
    tension = stiffness * (long - rest) + LINK_DAMPING * jnp.sum((ahead(m.speed) - m.speed) * unit, -1)
    pull = jnp.maximum(tension, 0.0)[:, None] * unit
    total = pull - behind(pull) + jnp.asarray([0.0, -gear.belt_mass * GRAVITY / TEETH_BELT])
    # grousers: the tip is normal to the line of both neighbours; virtual work splits its force among the three
    line = (ahead(m.place) - behind(m.place))[FIRST]
    size = jnp.sqrt(jnp.sum(line**2, -1, keepdims=True))
    along = line / size
    out = jnp.stack([-along[:, 1], along[:, 0]], -1)  # backward running below: outward is down
    tip = m.place[FIRST] + gear.grouser_height * out
    swing = jnp.sum(out * (ahead(m.speed) - behind(m.speed))[FIRST], -1, keepdims=True) / size
    tip_speed = m.speed[FIRST] - gear.grouser_height * along * swing
    normal = force_contact(
        tip[:, 1],
        tip_speed[:, 1],
        0.0,
        gear.contact_stiffness,
        gear.contact_exponent,
        gear.contact_damping,
        gear.contact_depth,
    )
    rub = -c.ground.friction.coefficient(tip_speed[:, 0]) * normal
    on_tip = jnp.stack([rub, normal], -1)
    couple = -gear.grouser_height * jnp.sum(on_tip * along, -1, keepdims=True) / size * out
    total = total.at[FIRST].add(on_tip).at[FIRST + 1].add(couple).at[FIRST - 1].add(-couple)
    # into the frame of the chassis
    arm = m.place - m.body[:2]
    local = _turn(arm, -m.body[2])
    carried = jnp.stack([arm[:, 1], -arm[:, 0]], -1) * m.rate[2] + m.rate[:2]
    relative = _turn(m.speed - carried, -m.body[2])
    inside = jnp.zeros_like(local)
    torque = []
    for side, angle, rate in ((1.0, turn, speed), (-1.0, m.driven, m.driven_rate)):
        from_axle = local - jnp.asarray([side * gear.wheelbase / 2, 0.0])
        distance = jnp.sqrt(jnp.sum(from_axle**2, -1))
        outward = from_axle / distance[:, None]
        running = jnp.stack([outward[:, 1], -outward[:, 0]], -1)  # clockwise: forward running
        deep = c.radius - distance
        push = TEETH_STIFFNESS * deep - TEETH_DAMPING * jnp.sum(relative * outward, -1)
        push = jnp.where(deep > 0, jnp.maximum(push, 0.0), 0.0)
        pitch = 2 * jnp.pi / TEETH_PULLEY
        late = jnp.arctan2(outward[:, 0], outward[:, 1]) - angle  # clockwise from the top
        late = late - pitch * jnp.round(late / pitch)
        engaged = cubic_step(distance, c.radius + 5e-5, 1.0, c.radius + 3e-4, 0.0)
        drag = TEETH_STIFFNESS * c.radius * late
        drag = drag + TEETH_DAMPING * (jnp.sum(relative * running, -1) - c.radius * rate)
        hold = push[:, None] * outward - (engaged * drag)[:, None] * running
        inside = inside + hold
        torque.append(c.radius * jnp.sum(engaged * drag))
    flat = jnp.abs(local[:, 0]) < gear.wheelbase / 2 - gear.guide_gap
    for side, face in ((-1.0, c.radius - gear.guide_recess), (1.0, c.radius)):
        deep = face - side * local[:, 1]
        push = TEETH_STIFFNESS * deep - side * TEETH_DAMPING * relative[:, 1]
        push = jnp.where(flat & (deep > 0) & (deep < 5e-3), jnp.maximum(push, 0.0), 0.0)
        rubbed = c.guide_friction * push if side < 0 else 0.0 * push  # backwards below; (24) holds the upper
        inside = inside + jnp.stack([rubbed, side * push], -1)
        if side < 0:
            guided = jnp.sum(push)
    back = _turn(inside, m.body[2])
    total = total + back
    # chassis: the reactions, its weight, and the torque of the drive, whose stator it carries
    weight = c.half.chassis + 2 * c.half.pulley
    centre = _turn(jnp.stack([c.half.forward, c.half.up]) * c.half.chassis / weight, m.body[2])
    reaction = -jnp.sum(back, 0)
    moment = -jnp.sum(arm[:, 1] * back[:, 0] - arm[:, 0] * back[:, 1])
    moment = moment - (centre[1] * reaction[0] - centre[0] * reaction[1])  # about the centre of mass
    moment = moment - torque[1]  # its bearing is free: the driven pulley keeps its torque
    resistance = c.ground.rolling_resistance * jnp.sum(normal)  # (5), on the chassis at the ground
    moment = moment + resistance * (m.body[1] + centre[1])
    on_body = jnp.concatenate([reaction - jnp.stack([resistance, weight * GRAVITY]), moment[None]])
    upper = local[:, 1] > 0.9 * c.radius
    lower = local[:, 1] < -0.9 * c.radius
    flat_x = jnp.abs(local[:, 0]) < gear.wheelbase / 2
    beyond = jnp.maximum(jnp.abs(local[:, 0]) - gear.wheelbase / 2, 0.0)
    off = jnp.max(jnp.abs(jnp.sqrt(beyond**2 + local[:, 1] ** 2) - c.radius))
    mean = lambda chosen: jnp.sum(jnp.where(chosen, tension, 0.0)) / jnp.maximum(jnp.sum(chosen), 1)  # noqa: E731
    sums = Sums(jnp.sum(normal), guided, reaction[1] - guided, mean(upper & flat_x), mean(lower & flat_x), off)
    return total, on_body, torque[1], sums


@partial(jax.jit, static_argnames=("samples",))
def run(c: Chain, speed, step_s, samples: int):
    """Semi-implicit Euler. Means over every sample of SAMPLE µs."""
    weight = c.half.chassis + 2 * c.half.pulley
    offset = jnp.stack([c.half.forward, c.half.up]) * c.half.chassis / weight
    parts = c.half.chassis * jnp.sum((jnp.stack([c.half.forward, c.half.up]) - offset) ** 2)
    parts = parts + 2 * c.half.pulley * ((c.gear.wheelbase / 2) ** 2 + jnp.sum(offset**2))
    inertia = c.half.inertia + parts
    inner = SAMPLE

    def small(state, _):
        m, clock = state
        total, on_body, on_driven, sums = forces(c, m, speed * clock, speed)
        fast = m.speed + step_s * total / (c.gear.belt_mass / TEETH_BELT)
        alpha = on_body[2] / inertia
        # the centre of mass accelerates by the force; the middle of the wheelbase follows it
        arm = _turn(offset, m.body[2])
        middle = on_body[:2] / weight - alpha * jnp.stack([arm[1], -arm[0]]) + m.rate[2] ** 2 * arm
        rate = m.rate + step_s * jnp.concatenate([middle, alpha[None]])
        driven = m.driven_rate + step_s * on_driven / c.half.inertia_pulley
        after = Motion(
            m.place + step_s * fast, fast, m.body + step_s * rate, rate, m.driven + step_s * driven, driven
        )
        return (after, clock + step_s), sums

    def interval(state, _):
        def body(_, carry):
            at, added = carry
            at, sums = small(at, None)
            return at, jax.tree.map(jnp.add, added, sums)

        none = Sums(*(jnp.zeros(()) for _ in Sums._fields))
        state, added = jax.lax.fori_loop(0, inner, body, (state, none))
        return state, (jax.tree.map(lambda x: x / inner, added), state[0].body, state[0].rate)

    return jax.lax.scan(interval, (start(c, speed), jnp.zeros(())), None, length=samples)


def measure(
    gear: RunningGear,
    speed: float = SPEED,
    duration: float = 0.5,
    step_s: float = STEP,
    robot: Robot | None = None,
) -> dict:
    """Averages and ripple over the whole grouser periods in the last 60 % of `duration` [s]."""
    c = chain(gear, robot)
    sample = SAMPLE * step_s
    samples = round(duration / sample)
    radius = float(c.link) * TEETH_PULLEY / (2 * np.pi)
    period = period_pitch(TEETH_BELT / GROUSERS * float(c.link), speed, radius)
    periods = int(0.6 * duration / period)
    if periods < 2:
        raise ValueError(f"duration: {duration:g} s holds {periods} grouser periods to average; expected 2 or more")
    begun = time.perf_counter()
    (end, _), (sums, _, rate) = jax.block_until_ready(run(c, speed, step_s, samples))
    wall = time.perf_counter() - begun
    tail = slice(samples - round(periods * period / sample), None)
    mean = {name: float(np.mean(np.asarray(getattr(sums, name))[tail])) for name in Sums._fields}
    normal = np.asarray(sums.normal)[tail]
    clock, whole = sample * np.arange(len(normal)), max(round(1e-3 / sample), 1)
    coarse = normal[len(normal) % whole :].reshape(-1, whole).mean(1)
    _, amplitude, repetition = measure_ripple(clock, normal)
    weight = float(c.half.chassis + 2 * c.half.pulley + gear.belt_mass) * GRAVITY
    return {
        "guide_share": mean["guide"] / mean["normal"],
        "pulley_share": mean["pulleys"] / mean["normal"],
        "carried_over_weight": mean["normal"] / weight,
        "normal_std_over_mean": float(normal.std() / normal.mean()),
        "normal_std_over_mean_1_ms": float(coarse.std() / coarse.mean()),  # sampled as in the track model
        "ripple_amplitude": amplitude,
        "ripple_period_s": repetition,
        "period_34_s": period,
        "line_of_34": harmonics(normal, periods),
        "speed_m_s": float(np.mean(np.asarray(rate)[tail, 0])),
        "tension_upper_N": mean["tension_upper"],
        "tension_lower_N": mean["tension_lower"],
        "off_path_mm": 1e3 * float(np.max(np.asarray(sums.off)[tail])),
        "finite": bool(np.isfinite(np.asarray(end.place)).all()),
        "periods": periods,
        "wall_s": wall,
    }


def harmonics(values: np.ndarray, periods: int, count: int = 4) -> dict:
    """Share of the variance in the first harmonics of (34), and the strongest line over (34)'s frequency."""
    power = np.abs(np.fft.rfft(values - values.mean())) ** 2
    lines = [float(power[k * periods] / power[1:].sum()) for k in range(1, count + 1)]
    return {"share_of_variance": np.round(lines, 3).tolist(), "strongest": float(np.argmax(power) / periods)}


def beside(gears: list[RunningGear], robot: Robot | None = None) -> list[dict]:
    """Results of the track model at the same recesses, 33 V on level ground, for comparison with the chain."""
    runs = Conditions(voltage=np.full(1, 33.0))
    found = []
    for gear in gears:
        one = dataclasses.replace(nominal() if robot is None else robot, running_gear=gear)
        answer = _simulate_batch(one, runs, 0.8, 1e-4, 1e-3, True)
        normal, fast = np.asarray(answer.signals.normal[0, -300:]), float(answer.v[0, -300:, 3].mean())
        period = period_pitch(35e-3, fast, float(nominal().radius_pulley))
        periods = int(0.3 / period)
        found.append(
            {
                "guide_share": float(answer.steady.guide_share[0]),
                "normal_std_over_mean": float(normal.std() / normal.mean()),
                "ripple_amplitude": measure_ripple(np.asarray(answer.time[0, -300:]), normal)[1],
                "ripple_period_s": measure_ripple(np.asarray(answer.time[0, -300:]), normal)[2],
                "period_34_s": period,
                "line_of_34": harmonics(normal[-round(periods * period / 1e-3) :], periods),
                "speed_wheel": fast,
                "speed_m_s": float(answer.result.reading["speed"][0]),
            }
        )
    return found


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--recess", help="of the lower guide [mm], comma-separated; default the gear's own")
    options.add_argument("--duration", type=float, default=0.5)
    options.add_argument("--step", type=float, help="[s]; default 1e-6, or the limit of a stiff damper")
    options.add_argument("--speed", type=float, default=SPEED)
    options.add_argument("--track", action="store_true", help="run the track model too")
    options.add_argument("--shaking", action="store_true", help="friction and running gear of set S (shaking.py)")
    options.add_argument("--json", type=Path)
    chosen = options.parse_args()
    robot = shaking() if chosen.shaking else nominal()
    own = 1e3 * float(robot.running_gear.guide_recess)
    recesses = [float(r) * 1e-3 for r in (chosen.recess or f"{own:g}").split(",")]
    gears = [
        params.replace(robot.running_gear, {"guide_recess": jnp.asarray(r), "grouser_length": jnp.asarray(5e-3)})
        for r in recesses
    ]
    largest = 2 * float(robot.running_gear.belt_mass) / TEETH_BELT / float(robot.running_gear.contact_damping)
    step_s = chosen.step or min(STEP, float(f"{largest / 3:.1g}"))
    found = {f"recess {1e3 * r:g} mm": {} for r in recesses}
    for name, gear in zip(found, gears, strict=True):
        found[name]["chain"] = measure(gear, chosen.speed, chosen.duration, step_s, robot)
        print(name, json.dumps(found[name]), flush=True)
    if chosen.track:
        wide = [params.replace(g, {"grouser_length": jnp.asarray(10e-3)}) for g in gears]  # the chain's base
        for label, given in (("track", gears), ("track, grousers' base as the chain's", wide)):
            for name, one in zip(found, beside(given, robot), strict=True):
                found[name][label] = one
                print(name, label, json.dumps(one), flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
