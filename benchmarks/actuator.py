"""Speed of an exported actuator: environments in parallel, gradients, and a step against MJX's own `<motor>`.

    python benchmarks/actuator.py                              # 4096 environments, 1000 steps
    python benchmarks/actuator.py --law drive/actuator.py      # of an export, where only JAX is installed
    python benchmarks/actuator.py --shelf runs/neo             # page of a run of `mmrjax loop` for docs/actuators

Times are the best of several, compilation apart, in single precision. Prints a line of JSON.
"""

from __future__ import annotations

import argparse
import json
import re
import runpy
import time
import tomllib
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

#: Page of the actuator that a run of the loop identified. XL330's is by `gears.py`.
SHELF = """# {name}

Identified by `mmrjax loop` from a public record. `python benchmarks/actuator.py --shelf RUN` wrote this page from its
result. {source}

* Unseen error, blocks held out: {errors}.
* Verdict: {verdict}
* Conditions seen: {conditions}.
* 95 % intervals, as far as the laws of robot.toml hold: {intervals}.
* Would decide: {open}

## robot.toml

```toml
{robot}```

## drive.xml

```xml
{drive}```

{law}"""
#: One joint whose motor is MJX's own, and the same for an actuator from outside.
MODEL = """<mujoco><option timestep="0.001"/><worldbody><body><joint name="drive" axis="0 1 0" armature="0.006"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody>{actuator}</mujoco>"""
DT, REPEATS = 1e-3, 5


def law(file: str | None) -> Any:
    """Module of an exported actuator, of the packaged robot's if there is no file."""
    if file is not None:
        return types.SimpleNamespace(**runpy.run_path(file))
    from calibration.data import robot_file
    from sweeps.export.joint import joint_of_robot
    from sweeps.export.law_source import LawConstant, jax_source, module_from_source

    drive = joint_of_robot(robot_file.find_robot_file("nominal"))
    known = [LawConstant(n, float(p.value), "", "", "") for n, p in drive.parameters().items()]
    known += [LawConstant(n, 30.0, "N", "", "") for n in drive.surroundings()]
    return module_from_source(jax_source(drive, known))


def best(function: Callable[..., Any], *given: Any) -> tuple[float, float]:
    """Least time of a compiled call [s], and the time of the first with its compilation [s]."""
    begin = time.perf_counter()
    jax.block_until_ready(function(*given))
    first, found = time.perf_counter() - begin, []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(function(*given))
        found.append(time.perf_counter() - begin)
    return min(found), first


def in_parallel(module: Any, environments: int, steps: int) -> dict[str, float]:
    """Times of actuators that each turn an inertia, and of the gradient by every voltage [s]."""
    params = {n: jnp.full(environments, v, jnp.float32) for n, v in module.PARAMS.items()}
    volts = jnp.linspace(5.0, 24.0, environments, dtype=jnp.float32)

    def turned(volts: jax.Array) -> jax.Array:
        def step(carry: Any, _: None) -> tuple[Any, None]:
            angle, speed, state = carry
            torque, state, _ = module.actuator(params, state, volts, angle, speed, DT)
            speed = speed + DT * torque / 0.016
            return (angle + DT * speed, speed, state), None

        still = jnp.zeros_like(volts)
        return jax.lax.scan(step, (still, still, module.initial_state(volts.shape)), None, steps)[0][0]

    forward, compiled = best(jax.jit(turned), volts)
    backward, compiled_backward = best(jax.jit(jax.grad(lambda v: jnp.sum(turned(v)))), volts)
    times = {"forward": (forward, compiled), "gradient": (backward, compiled_backward)}
    return {
        f"{name}{which}_s": x for name, pair in times.items() for which, x in zip(("", "_first"), pair, strict=True)
    }


def against_motor(module: Any, environments: int, steps: int) -> dict[str, float]:
    """Times of a joint in MJX with its own `<motor>`, and with the exported actuator [s], none without MJX."""
    try:
        import mujoco
        from mujoco import mjx
    except ImportError:
        return {}
    motor = '<actuator><motor joint="drive"/></actuator>'
    own = mjx.put_model(mujoco.MjModel.from_xml_string(MODEL.format(actuator=motor)))
    bare = mjx.put_model(mujoco.MjModel.from_xml_string(MODEL.format(actuator="")))
    start_own, start_bare = mjx.make_data(own), mjx.make_data(bare)
    params = {n: jnp.float32(v) for n, v in module.PARAMS.items()}
    command = jnp.linspace(0.1, 1.0, environments, dtype=jnp.float32)

    def with_motor(torque: jax.Array) -> jax.Array:
        def step(state: Any, _: None) -> tuple[Any, None]:
            return mjx.step(own, state.replace(ctrl=torque[None])), None

        return jax.lax.scan(step, start_own, None, steps)[0].qvel[0]

    def with_actuator(share: jax.Array) -> jax.Array:
        def step(carry: Any, _: None) -> tuple[Any, None]:
            state, actuator = carry
            given = 24 * share, state.qpos[0], state.qvel[0]
            torque, actuator, _ = module.actuator(params, actuator, *given, DT)
            return (mjx.step(bare, state.replace(qfrc_applied=torque[None])), actuator), None

        return jax.lax.scan(step, (start_bare, module.initial_state()), None, steps)[0][0].qvel[0]

    mine, theirs = (best(jax.jit(jax.vmap(f)), command)[0] for f in (with_actuator, with_motor))
    return {"mjx_motor_s": theirs, "mjx_with_actuator_s": mine, "over_motor": mine / theirs}


def shelf_page(run: Path) -> str:
    """Page of a run of the loop: its robot under its last load, which exports, and what the result states."""
    import gears

    found = json.loads((run / "result.json").read_text(encoding="utf-8"))
    text = (run / "robot.toml").read_text(encoding="utf-8")
    settings = tomllib.loads((run / "config.resolved.toml").read_text(encoding="utf-8"))
    source = Path(settings["robot"])  # with its table beside it
    rows = np.genfromtxt(source.with_suffix(".csv"), delimiter=",", names=True)
    ranges = {n: rows[n] for n in rows.dtype.names or () if np.isfinite(rows[n]).all()}
    last = tomllib.loads(text)["configurations"][-1]
    head, *tables = re.sub(r"  # .*", "", text).split("\n[")
    kept = [f"[{x.strip()}" for x in tables if x.startswith(("motor", "gearbox", "driver", "effects", f"{last}]"))]
    top = [x for x in head.splitlines() if x.strip() and not x.startswith(("#", "configurations"))]
    robot = "\n".join([*top, *kept]) + "\n"
    if "voltage_limit" not in robot:  # the range of operating points of the law
        robot = robot.replace("[motor]\n", f"[motor]\nvoltage_limit = {np.abs(ranges['supply_voltage_V']).max()}\n")
    drive, law = gears.actuator(robot)
    after = found["errors"]["after"]["held_out"]
    return SHELF.format(
        name=run.name.replace("_", " ").capitalize(), robot=robot, drive=drive, law=law,
        source=source.read_text(encoding="utf-8").split("\nbase")[0].replace("# ", "").replace("\n", " "),
        errors=", ".join(f"{n.replace('_', ' ')} {x['rms_percent']:.2g} % (rms)" for n, x in after.items()),
        verdict=found["verdict_statement"], open=found["next_experiment"]["description"],
        intervals=", ".join(
            f"{n} {x['after'] - 1.96 * x['sd_after']:.4g} to {x['after'] + 1.96 * x['sd_after']:.4g} {x['unit']}"
            for n, x in found["base_shift"].items()
        ),
        conditions=", ".join(
            [f"{len(rows)} rows", *(f"{n} {x.min():.4g} to {x.max():.4g}" for n, x in ranges.items())]
        ),
    )  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--law", help="actuator.py of an export; else the packaged robot's drive")
    parser.add_argument("--environments", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--joints", type=int, default=64, help="Environments of the comparison with <motor>")
    parser.add_argument("--shelf", type=Path, help="folder of a run of the loop; its name is that of the page")
    told = parser.parse_args()
    if told.shelf is not None:
        Path(f"docs/actuators/{told.shelf.name}.md").write_text(shelf_page(told.shelf), encoding="utf-8")
        return
    module = law(told.law)
    found = {
        "device": str(jax.devices()[0].device_kind), "environments": told.environments, "steps": told.steps,
        **in_parallel(module, told.environments, told.steps), "joints": told.joints,
        **against_motor(module, told.joints, min(told.steps, 200)),
    }  # fmt: skip
    print(json.dumps({k: round(v, 5) if isinstance(v, float) else v for k, v in found.items()}))


if __name__ == "__main__":
    main()
