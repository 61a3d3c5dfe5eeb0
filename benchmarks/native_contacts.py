"""What a user would pick instead of this track model: MuJoCo's own contacts, same machine, same simulated time.

python benchmarks/native_contacts.py
python benchmarks/native_contacts.py --only chain,surface --duration 1.5

chain    C MuJoCo: a chain of 24 hinged links round two wheels (closed by an equality constraint), contacts and
         friction by the engine; both wheels turn at the given speed by velocity actuators.
surface  C MuJoCo: no belt, the body stands on one box whose surface moves (`surfacevel`).
mjx      the same chain in MJX, a small batch and few steps, extrapolated.
ours     the track model, `track_batch`.

One side of 6T2A (half the robot's mass) on the flat, in its plane, driven at the pulley speed of 33 V.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

# Without it a 24-link chain does not compile in minutes; set in a process of its own, the others keep the defaults.
MJX_FLAGS = "--xla_cpu_use_fusion_emitters=false"

LINKS, BASE, PITCH_RADIUS = 24, 0.300, 0.24 / (2 * math.pi)  # [m], Table 6
GROUSER, HALF = 5.5e-3, 3e-3  # grouser over the chain's line; half a link's thickness [m]
MASS, BELT_MASS, PULLEY_MASS, INERTIA = 6.55, 40e-3, 82e-3, 0.1255  # one side, Table 7
SPEED, ROLLING, GRAVITY = 25.66, 0.06, 9.81  # [rad/s] of the pulleys at 33 V; [-]; [m/s²]
PRELOAD, TENSIONER = 100.0, 5e3  # the driven wheel is pushed back by [N] on a spring [N/m]
ADHESION = 0.32  # Table 5, lacquered wood
STEP = 5e-4  # [s]; with pyramidal friction cones the belt slips on its wheels at 0.2 to 1 ms


def corners() -> list[tuple[float, float]]:
    """Joints of a closed chain on the belt's path: from under the front wheel backwards, and over the top."""
    arc, found = math.pi * PITCH_RADIUS, []
    for k in range(LINKS):
        s = k * (2 * BASE + 2 * arc) / LINKS
        if s < BASE:
            found.append((BASE / 2 - s, -PITCH_RADIUS))
        elif s < BASE + arc:
            a = (s - BASE) / PITCH_RADIUS
            found.append((-BASE / 2 - PITCH_RADIUS * math.sin(a), -PITCH_RADIUS * math.cos(a)))
        elif s < 2 * BASE + arc:
            found.append((s - 1.5 * BASE - arc, PITCH_RADIUS))
        else:
            a = (s - 2 * BASE - arc) / PITCH_RADIUS
            found.append((BASE / 2 + PITCH_RADIUS * math.sin(a), PITCH_RADIUS * math.cos(a)))
    return found


def chain_text(step: float) -> str:
    """MJCF of the hinged chain. Wheels hold it by friction in place of teeth, and the links lie on chords.

    24 links of 35 mm make 7 sides round a wheel, so its surface is a chord's sagitta and half a link inside.
    """
    at = corners()
    long = min(math.dist(at[k], at[(k + 1) % LINKS]) for k in range(LINKS))
    wheel = math.sqrt(PITCH_RADIUS**2 - long**2 / 4) - HALF
    links, heading, last = "", 0.0, 0.0
    for k, ((xa, za), (xb, zb)) in enumerate(zip(at, at[1:] + at[:1], strict=True)):
        length, angle = math.dist((xa, za), (xb, zb)), math.atan2(za - zb, xb - xa)  # about +y
        if k == 0:
            where, turn = f"{xa:.9g} 0 {za:.9g}", angle
            joints = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
            joints += '<joint type="hinge" axis="0 1 0"/>'
        else:
            where, turn = f"{last:.9g} 0 0", angle - heading
            joints = '<joint type="hinge" axis="0 1 0" damping="1e-4" armature="1e-5"/>'
        heading, last = angle, length
        links += f"""
<body name="l{k}" pos="{where}" euler="0 {math.degrees(turn):.9g} 0">{joints}
<geom class="plate" type="capsule" fromto="{HALF} 0 0 {length - HALF:.9g} 0 0" mass="{BELT_MASS / LINKS:.9g}"/>
<geom class="grouser" type="sphere" size=".002" pos="{length / 2:.9g} 0 {GROUSER - 0.002:.9g}" mass="1e-5"/>"""
    motor = '<joint name="{0}" type="hinge" axis="0 1 0" armature="1e-4"/><geom class="wheel" type="capsule" '
    motor += f'size="{wheel:.9g}" fromto="0 -.012 0 0 .012 0" mass="{PULLEY_MASS}"/></body>'
    slide = (
        f'<joint type="slide" axis="1 0 0" stiffness="{TENSIONER}" springref="{-PRELOAD / TENSIONER}" damping="20"/>'
    )
    bare = MASS - BELT_MASS - 2 * PULLEY_MASS
    guide = f'<geom class="guide" type="box" size="{BASE / 2 - 0.02} .012 .002" mass="0" pos="0 0 '
    face = PITCH_RADIUS - HALF - 0.002
    return f"""<mujoco model="hinged chain">
<option timestep="{step}" integrator="implicitfast" cone="elliptic" impratio="10"
 iterations="20" ls_iterations="20" gravity="0 0 {-GRAVITY}"/>
<default>
<geom solref=".004 1" solimp=".95 .99 .0005"/>
<default class="plate"><geom size="{HALF}" contype="2" conaffinity="0" friction="1 .005 .0001"/></default>
<default class="grouser"><geom contype="4" conaffinity="0" friction="{ADHESION} .005 .0001"/></default>
<default class="wheel"><geom contype="0" conaffinity="2" friction="1 .005 .0001"/></default>
<default class="guide"><geom contype="0" conaffinity="2" friction=".2 .005 .0001" priority="1"/></default>
</default>
<worldbody>
<geom name="ground" type="plane" size="20 2 .1" contype="0" conaffinity="4" friction="{ADHESION} .005 .0001"/>
<body name="chassis" pos="0 0 {PITCH_RADIUS + GROUSER:.9g}">
<inertial pos="0 0 .005" mass="{bare:.9g}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
<joint name="travel" type="slide" axis="1 0 0"/><joint name="height" type="slide" axis="0 0 1"/>
<joint name="pitch" type="hinge" axis="0 1 0"/>
{guide}{-face:.9g}"/>{guide}{face:.9g}"/>
<body name="driving" pos="{BASE / 2} 0 0">{motor.format("driving")}
<body name="driven" pos="{-BASE / 2} 0 0">{slide}{motor.format("driven")}
</body>
<body name="carrier" pos="0 0 {PITCH_RADIUS + GROUSER:.9g}">{links}{"</body>" * LINKS}</body>
</worldbody>
<equality><connect body1="l{LINKS - 1}" body2="l0" anchor="{last:.9g} 0 0" solref=".004 1"/></equality>
<actuator><velocity joint="driving" kv="2"/><velocity joint="driven" kv="2"/></actuator>
</mujoco>"""


def surface_text(step: float) -> str:
    """MJCF of a body on a box whose surface moves backwards: nothing turns, nothing lands."""
    height = PITCH_RADIUS + GROUSER
    return f"""<mujoco model="moving surface">
<option timestep="{step}" integrator="implicitfast" gravity="0 0 {-GRAVITY}"/>
<default><geom solref=".004 1" solimp=".95 .99 .0005" friction="{ADHESION} .005 .0001"/></default>
<worldbody><geom name="ground" type="plane" size="20 2 .1"/>
<body name="chassis" pos="0 0 {height}">
<inertial pos="0 0 .005" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
<joint name="travel" type="slide" axis="1 0 0"/><joint name="height" type="slide" axis="0 0 1"/>
<joint name="pitch" type="hinge" axis="0 1 0"/>
<geom type="box" size="{BASE / 2} .012 {height}" surfacevel="{-SPEED * PITCH_RADIUS} 0 0 0 0 0"/>
</body></worldbody></mujoco>"""


def reaction(normal, wall: float, steps: int, runs: int, simulated: float) -> dict:
    """Figures of one way: `normal` [N] over the part averaged."""
    import numpy as np

    return {
        "run_steps_per_s": runs * steps / wall,
        "s_per_simulated_s": wall / simulated / runs,
        "normal_mean_N": float(np.mean(normal)),
        "normal_std_over_mean": float(np.std(normal) / np.mean(normal)),
    }


def native(text: str, duration: float) -> dict:
    """C MuJoCo, one core: timed without reading anything, then run again to read the ground's reaction."""
    import mujoco
    import numpy as np

    model = mujoco.MjModel.from_xml_string(text)
    ground = model.geom("ground").id
    steps = round(duration / model.opt.timestep)

    def begin() -> mujoco.MjData:
        data = mujoco.MjData(model)
        data.ctrl[:] = SPEED
        data.qfrc_applied[0] = -ROLLING * MASS * GRAVITY  # motion resistance (5), on the chassis
        return data

    wall = math.inf
    for _ in range(5):  # the best: a short run on a shared machine is slowed tenfold by others
        data = begin()
        started = time.perf_counter()
        mujoco.mj_step(model, data, nstep=steps)
        wall = min(wall, time.perf_counter() - started)
    data, wrench = begin(), np.zeros(6)
    normal, travel, contacts = [], [], []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        total = 0.0
        for k in range(data.ncon):
            if ground in (data.contact[k].geom1, data.contact[k].geom2):
                mujoco.mj_contactForce(model, data, k, wrench)
                total += wrench[0]
        normal.append(total)
        travel.append(data.qpos[0])
        contacts.append(data.ncon)
    tail = round(0.6 * steps)
    found = reaction(normal[tail:], wall, steps, 1, duration)
    speed = (travel[-1] - travel[tail - 1]) / (duration - tail * model.opt.timestep)
    warnings = int(sum(w.number for w in data.warning))
    found |= {"speed_m_s": float(speed), "contacts": float(np.mean(contacts[tail:])), "warnings": warnings}
    return found | {"pitch_deg": float(np.degrees(data.qpos[2])), "weight_N": float(model.body_mass.sum() * GRAVITY)}


def in_mjx(text: str, batch: int, steps: int) -> dict:
    """The chain in MJX: few steps from standstill, extrapolated per run-step."""
    import jax
    import jax.numpy as jnp
    import mujoco
    from mujoco import mjx

    model = mujoco.MjModel.from_xml_string(text)
    on, data = mjx.put_model(model), mjx.make_data(model)
    push = data.qfrc_applied.at[0].set(-ROLLING * MASS * GRAVITY)
    data = data.replace(ctrl=jnp.full(model.nu, SPEED), qfrc_applied=push)
    mass = jnp.asarray(model.body_mass)

    @jax.jit
    def advance(batched):
        def one(data, _):
            after = mjx.step(on, data)
            return after, jnp.sum(mass * after.xipos[:, 2])

        return jax.vmap(lambda d: jax.lax.scan(one, d, None, length=steps))(batched)

    batched = jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *jnp.shape(x))), data)
    started = time.perf_counter()
    compiled = advance.lower(batched).compile()
    compile_s = time.perf_counter() - started
    started = time.perf_counter()
    _, moment = jax.block_until_ready(compiled(batched))
    wall = time.perf_counter() - started
    # the ground's reaction is the weight plus the rate of the whole's vertical momentum
    import numpy as np

    lifted = np.diff(np.asarray(moment)[0], 2) / model.opt.timestep**2 + float(mass.sum()) * GRAVITY
    found = reaction(lifted[len(lifted) // 2 :], wall, steps, batch, steps * model.opt.timestep)
    return found | {"compile_s": compile_s, "batch": batch, "steps": steps, "finite": bool(np.isfinite(moment).all())}


def ours(batch: int, duration: float) -> dict:
    """`track_batch` at 33 V on the flat: a batch of payloads, so that the runs differ; reaction of the first."""
    import jax
    import numpy as np

    from mmrjax.conditions import Conditions
    from mmrjax.fidelities.track import track_batch
    from mmrjax.robots import nominal

    runs = Conditions(voltage=np.full(batch, 33.0), payload=np.linspace(0.0, 8.0, batch))
    call = lambda: jax.block_until_ready(track_batch(nominal(), runs, duration=duration))  # noqa: E731
    started = time.perf_counter()
    call()
    first, started = time.perf_counter() - started, time.perf_counter()
    answer = call()
    wall, steps = time.perf_counter() - started, round(duration / 1e-4)
    normal = np.asarray(answer.signals.normal[0])
    found = reaction(normal[round(0.6 * len(normal)) :], wall, steps, batch, duration)
    # includes the door's check of the largest stable step, as a user pays it
    return found | {"compile_s": first - wall, "batch": batch, "speed_m_s": float(answer.result.reading.speed[0])}


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--only", default="chain,surface,mjx,ours", help="comma-separated")
    options.add_argument("--duration", type=float, default=1.5, help="simulated [s]; MJX runs its own --steps")
    options.add_argument("--batch", type=int, default=16, help="runs of ours and of MJX at once")
    options.add_argument("--steps", type=int, default=50, help="of MJX")
    options.add_argument("--json", type=Path)
    chosen = options.parse_args()
    names = chosen.only.split(",")
    found = {}
    if "mjx" in names and len(names) > 1:  # its flags must not touch the others: a process of its own
        names.remove("mjx")
        names.append("mjx")
    for name in names:
        if name == "mjx":
            if len(names) > 1:
                again = [sys.executable, __file__, "--only", "mjx", "--batch", str(chosen.batch)]
                again += ["--steps", str(chosen.steps)]
                try:
                    done = subprocess.run(again, capture_output=True, text=True, timeout=300, check=True)
                    found |= json.loads(done.stdout[done.stdout.index("{") :])
                except subprocess.TimeoutExpired:
                    found["mjx"] = "not compiled and run within 300 s"
                continue
            os.environ["XLA_FLAGS"] = MJX_FLAGS
        import jax

        jax.config.update("jax_enable_x64", True)
        calls = {
            "chain": lambda: native(chain_text(STEP), chosen.duration),
            "surface": lambda: native(surface_text(STEP), chosen.duration),
            "mjx": lambda: in_mjx(chain_text(STEP), chosen.batch, chosen.steps),
            "ours": lambda: ours(chosen.batch, chosen.duration),
        }
        found[name] = calls[name]()
    print(json.dumps(found, indent=1))
    if chosen.json:
        chosen.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
