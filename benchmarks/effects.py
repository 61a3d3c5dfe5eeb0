"""Writes docs/reference/effects.md: each effect, its size by one prior standard deviation, which look alike.

python benchmarks/effects.py           write the page
python benchmarks/effects.py --check   compare the page with the library
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from calibration.words import experiment_words as words
from mmrjax.effects import ALL, OF_CHANNELS, OF_TURNS, Effect
from mmrjax.fidelities.drive import drive
from mmrjax.fidelities.steady import steady
from mmrjax.model import balances, channels, paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import TRACKED, WHEELED
from mmrjax.model.robot import Robot

jax.config.update("jax_enable_x64", True)

PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "effects.md"
#: Adhesion that lets all of Table 8 climb, also from standstill; Table 5's does not hold 20 degrees.
ADHESION = {
    f"{c}.ground.friction.{k}": v for c in (TRACKED, WHEELED) for k, v in (("static", 0.6), ("dynamic", 0.48))
}
#: In the units of the channels' columns; only the ratios of display resolutions matter for look-alikes.
SHOWN = 1 / np.array([c.factor for c in channels.usual_channels()])
NOISE = np.array([0.02, 5.0, 3.0])
#: Base parameters that every fit frees; they are projected out.
FREED = (
    *(f"{TRACKED}.{n}" for n in ("track.loss_coulomb", "track.loss_viscous", "track.guide_share")),
    *(f"{WHEELED}.{n}" for n in ("track.loss_coulomb", "track.loss_viscous")),
    *(
        f"{c}.ground.{n}"
        for c in (TRACKED, WHEELED)
        for n in ("rolling_resistance", "friction.static", "friction.speed_static")
    ),
)
ALIKE = 0.95
#: Share of a signature below which it counts as 0.
ABSORBED = 1e-9
STARTS = np.concatenate([[0.0], np.geomspace(1e-4, 0.05, 40), np.linspace(0.06, 2.0, 98)])  # [s]

EVERY = (*ALL, *OF_TURNS.values(), *OF_CHANNELS.values())
SETTLED = tuple(e for e in ALL if not e.transient and not e.needs_battery and not e.needs_duty)
PASSING = tuple(e for e in ALL if e not in SETTLED and not e.needs_duty)


def robot(effects: tuple[type[Effect], ...]) -> Robot:
    base = params.replace(paper_robots.nominal(), ADHESION)
    return dataclasses.replace(base, effects=tuple(effect() for effect in effects))


def amplitude(effect: type[Effect]) -> params.Spec:
    return next(p.spec for p in params.walk_parameters(effect()) if p.spec.amplitude)


def _shown(reading: dict[str, jax.Array]) -> jax.Array:
    return jnp.stack([reading[name] for name in channels.USUAL], -1)


def examples(battery: float = 0.0) -> Conditions:
    """6T2A, unladen, at 15 V on the level and at 33 V on 20 degrees."""
    return Conditions(voltage=[15.0, 33.0], slope_deg=[0.0, 20.0], battery=battery)


def table8() -> Conditions:
    axes = (0, 1), paper_robots.SLOPES_DEG, paper_robots.PAYLOADS_KG, paper_robots.VOLTAGES_V
    configuration, slope, payload, voltage = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 4).T
    return Conditions(configuration, voltage, slope, payload)


def sensitivities() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three arrays of changes of the shown readings.

    By one prior sd of each settled effect at `examples`, shape (2, 3, effects). The same whitened over Table 8, shape
    (540, effects), and whitened changes by the freed parameters, shape (540, parameters).
    """
    full = robot(SETTLED)
    names = [f"effects.{e.name}.amplitude" for e in SETTLED] + list(FREED)
    values = {p.name: p.value for p in params.walk_parameters(full)}
    start = jnp.stack([values[n] for n in names])
    runs = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), examples(), table8())

    def readings(theta):
        member = params.replace(full, {n: theta[k] for k, n in enumerate(names)})
        return _shown(jax.vmap(steady, in_axes=(None, 0))(member, runs).reading)

    jacobian = np.asarray(jax.jit(jax.jacfwd(readings))(start)) * SHOWN[:, None]
    sizes = [amplitude(e).prior_sd(0.0) for e in SETTLED] + [1.0] * len(FREED)
    jacobian = jacobian * np.array(sizes)
    grid = (jacobian[2:] / NOISE[:, None]).reshape(-1, len(names))
    n = len(SETTLED)
    return jacobian[:2, :, :n], grid[:, :n], grid[:, n:]


def look_alikes(effects: np.ndarray, base: np.ndarray) -> tuple[list[list[str]], np.ndarray]:
    """For each settled effect the others with |cos| above ALIKE after projecting out the base.

    Also returns the share of its signature that the projection leaves.
    """
    q, _ = np.linalg.qr(base / np.linalg.norm(base, axis=0))
    left = effects - q @ (q.T @ effects)
    whole, beside = np.linalg.norm(effects, axis=0), np.linalg.norm(left, axis=0)
    share = np.where(whole > 0, beside / np.where(whole > 0, whole, 1.0), np.nan)
    seen = share > ABSORBED
    unit = left / np.where(seen, beside, np.inf)
    cosine = np.abs(unit.T @ unit)
    return [
        [SETTLED[j].name for j in np.argsort(-cosine[k]) if j != k and cosine[k, j] > ALIKE]
        for k in range(len(SETTLED))
    ], share


def passing() -> np.ndarray:
    """Largest change of each reading in 2 s from standstill by one prior sd of each effect that only histories show.

    At `examples`, on the battery if an effect needs one, shape (effects, 2, 3).
    """
    full = robot(PASSING)
    names = [f"effects.{e.name}.amplitude" for e in PASSING]

    @jax.jit
    def history(theta, battery):
        member = params.replace(full, {n: theta[k] for k, n in enumerate(names)})

        def one(c):
            s = drive(member, c, jnp.asarray(STARTS), tolerance=1e-8, max_steps=16384).signals
            return _shown(balances.sensor(member, s))

        runs = examples()
        return jax.vmap(one)(dataclasses.replace(runs, battery=jnp.full(2, battery)))

    changes = []
    for k, effect in enumerate(PASSING):
        battery = float(effect.needs_battery)
        there = history(jnp.zeros(len(PASSING)).at[k].set(amplitude(effect).prior_sd(0.0)), battery)
        change = np.abs(np.asarray(there - history(jnp.zeros(len(PASSING)), battery)))
        changes.append(change.max(1) * SHOWN)
    return np.stack(changes)


def _number(value: float) -> str:
    return "0" if abs(value) < 5e-4 else f"{value:+.2g}" if abs(value) < 10 else f"{value:+.0f}"


def _about(effect: type[Effect]) -> tuple[str, ...]:
    """Equation, description and source, as cells of a table."""
    return tuple(text.replace("|", "∣") for text in words.effect_summary(effect))


def _section(effect: type[Effect]) -> str:
    """Section of one effect: equation, meaning, source and what it declares."""
    spec = amplitude(effect)
    shapes = [
        f"{p.name} {float(p.value):g} {p.spec.unit}" for p in params.walk_parameters(effect()) if not p.spec.amplitude
    ]
    where = effect.balance + (f": {effect.channel}" if effect.channel else "")
    low, high = spec.bounds
    equation, meaning, source = _about(effect)
    declared = list(words.effect_declarations(effect))
    lines = [
        f"### `{effect.name}`", "", equation, "", f"{meaning} {source[:1].upper()}{source[1:]}".strip(), "",
        f"- Balance `{where}`. Family: {effect.family()}.",
        f"- Amplitude [{spec.unit}]: prior standard deviation {spec.prior_sd(0.0):g}, bounds {low:g} to {high:g}.",
        *[f"- Shape: {'; '.join(shapes)}."] * bool(shapes),
        *[f"- Properties: {', '.join(declared)}."] * bool(declared),
    ]  # fmt: skip
    return "\n".join([*lines, ""])


INTRODUCTION = """# Effects

Terms that a model may lack. Each enters one balance with an amplitude, which is zero if the effect is absent. A
positive amplitude takes away: a voltage drop, a loss torque, a resisting force, a loss of speed. In `mass`,
`inertia`, `inductance` and `sensor` it adds.

*`python benchmarks/effects.py` writes this page from the library; a test compares the two.*

Effects of one equation with the same driver are a *family*. If the data cannot distinguish them, the loop reports
the family. It looks for effects of turns in tables of turns, and for the errors of an instrument (`CHANNEL_gain`,
`CHANNEL_offset`) on rigs that have it. The error is added to the reading; an instrument with `signed = false` adds it
to the magnitude. Instruments that count (speed, angle, position) have no zero error.

In a robot file, `[effects.churning] configurations = ["4W2T"]` limits an effect to some configurations.
`calibrate --free effects.NAME.amplitude` frees the amplitude of an effect that the file states.

## One standard deviation, and indistinguishable effects

The columns give the change of current [A], motor speed [rpm] and speed [mm/s] by one prior standard deviation, for
the unladen 6T2A robot in settled travel. The last column lists the effects that the 180 runs of Table 8 (μ_s = 0.6)
cannot distinguish from it: the signatures have |cos| > 0.95. Signatures are in units of 0.02 A, 5 rpm and 3 mm/s.
The eleven friction parameters that every fit frees are projected out. `left` is the share of the signature that
remains after this projection.

* `nothing`: the effect equals a change of a free parameter.
* `not seen`: these runs climb at full duty. They show no effect that acts only when the load drives the motor.

| effect | 15 V, 0°: A | rpm | mm/s | 33 V, 20°: A | rpm | mm/s | left | indistinguishable |
|---|---|---|---|---|---|---|---|---|"""

HISTORIES = """
## Effects that need a history

Largest change of each reading in the first 2 s from standstill, by one prior standard deviation. For `battery_sag` a
full battery replaces both voltages. `cogging` is below the resolution of any display once the shaft turns. The
influence of `armature_inductance` ends within a millisecond.

| effect | 15 V, 0°: A | rpm | mm/s | 33 V, 20°: A | rpm | mm/s |
|---|---|---|---|---|---|---|"""


def page() -> str:
    """Text of the page."""
    example, grid, base = sensitivities()
    alike, share = look_alikes(grid, base)
    start = passing()
    lines = [INTRODUCTION]
    for k, effect in enumerate(SETTLED):
        numbers = " | ".join(_number(x) for x in example[:, :, k].ravel())
        names = ", ".join(f"`{n}`" for n in sorted(alike[k])) or "none"
        left = "not seen" if np.isnan(share[k]) else "nothing" if share[k] <= ABSORBED else f"{share[k]:.2f}"
        lines.append(f"| `{effect.name}` | {numbers} | {left} | {names} |")
    lines.append(HISTORIES)
    for k, effect in enumerate(PASSING):
        lines.append(f"| `{effect.name}` | " + " | ".join(_number(x).lstrip("+") for x in start[k].ravel()) + " |")
    lines += ["", "## Each effect", ""]
    lines += [_section(effect) for effect in EVERY]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare with the page without writing")
    check = parser.parse_args().check
    text = page()
    if check:
        same = PAGE.read_text(encoding="utf-8") == text
        print(f"{PAGE.name} is " + ("right" if same else "out of date: run python benchmarks/effects.py"))
        sys.exit(not same)
    PAGE.write_text(text, encoding="utf-8")
    print(PAGE)
