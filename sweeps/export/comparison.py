"""Comparison of an exported drive with the native model: refit of its parameters, fate of each effect, and errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from calibration.data import Names
from calibration.inference.simulation_errors import share_of_measured
from sweeps.export.joint import DriveJoint, channels_of
from sweeps.export.situation import ComparisonRuns, JointResult

#: Share of an effect's change of current and speed below which the format does not hold it.
LITTLE = 0.1
#: Share above which a format holds an effect within rounding.
NEARLY_ALL = 0.999
#: Weight that keeps undetermined parameters near their translation: a relative change of 1 in a parameter's root
#: counts as much as this relative error of every reading.
NEAR = 1e-3
#: Residual below which translated parameters are exact, and no refit changes them.
EXACT = 1e-7
HELD, APPROXIMATED, DROPPED = "held", "approximated", "dropped"


class FormatLaw(Protocol):
    """Law of a format in steady travel, with the parameters that a refit may change.

    Attributes:
        names: names of the parameters.
        start: their values by translation [SI], all positive or zero.
    """

    names: Names
    start: np.ndarray

    def __call__(self, theta: Any, command: Any, load: Any, way: Any) -> tuple[Any, Any]:
        """Current of one motor [A] and speed of the joint [rad/s], arrays of the shape of `command`."""
        ...


@dataclasses.dataclass(frozen=True)
class EffectFate:
    """Representation of an effect, or of a base term, in a format.

    Attributes:
        name: name of the effect or term.
        verdict: `HELD`, `APPROXIMATED` or `DROPPED`.
        how: explanation in words.
        kept: share of its change of current and speed that the exported drive reproduces [-]. NaN if it has none.
    """

    name: str
    verdict: str
    how: str
    kept: float = np.nan


@dataclasses.dataclass(frozen=True)
class ExportComparison:
    """An exported drive compared with the native model.

    Attributes:
        situation: the runs.
        translated, refitted: parameters of the format by name [SI], before and after the refit.
        fates: fates of base terms and effects.
        errors: rms error over rms [%] by channel, of native, exported, translated, and exported without the effects.
        reference: what errors are relative to, in words.
        readings: readings of the exported drive [SI], (runs, channels).
        exported: result of the exported drive at the joint.
    """

    situation: ComparisonRuns
    translated: Mapping[str, float]
    refitted: Mapping[str, float]
    fates: tuple[EffectFate, ...]
    errors: Mapping[str, Mapping[str, float]]
    reference: str
    readings: np.ndarray
    exported: JointResult


#: Labels of the models whose errors are stated.
NATIVE, EXPORTED, TRANSLATED, WITHOUT = "native", "exported", "exported, not refitted", "exported without the effects"


def compare_format(
    situation: ComparisonRuns,
    law_of: Callable[[DriveJoint, Mapping[str, float]], FormatLaw],
    fates: Sequence[EffectFate],
    held: Mapping[str, str],
    approximated: Callable[[str], str],
) -> ExportComparison:
    """Compares a format with the native model over runs.

    Args:
        law_of: function that returns the format's law of a joint, with given amplitudes of effects by name.
        fates: fates of terms that are not effects inside the joint.
        held: effects for which the format has its own term → words for that term.
        approximated: words for the terms that replace an effect of a balance.
    """
    joint = situation.joint
    law = law_of(joint, {})
    joint_result = situation.inside
    theta = refit_parameters(law, situation, joint_result)
    names = tuple(e.name for e in joint.inside)
    fates_found = list(fates)
    for effect in joint.inside:
        without_effect = situation.solve_without_effects((effect.name,))
        share = share_kept(law, law_of(joint, {effect.name: 0.0}), situation, joint_result, without_effect)
        verdict = HELD if effect.name in held else DROPPED if share < LITTLE else APPROXIMATED
        approximation = held.get(effect.name) or approximated(effect.balance)
        if not np.isfinite(share) and effect.name not in held:
            verdict, approximation = DROPPED, "no effect on these runs, and the format lacks it"
        fates_found.append(EffectFate(effect.name, verdict, approximation, share))
    exported = _law_at(law, theta, situation)
    models = {NATIVE: situation.native, EXPORTED: situation.readings(exported)}
    if law.names:
        models[TRANSLATED] = situation.readings(_law_at(law, law.start, situation))
    if names:
        law_without_effects = law_of(joint, dict.fromkeys(names, 0.0))
        refit_without_effects = refit_parameters(
            law_without_effects, situation, situation.solve_without_effects(names)
        )
        models[WITHOUT] = situation.readings(_law_at(law_without_effects, refit_without_effects, situation))
    reference = situation.measured if situation.is_measured else situation.native
    return ExportComparison(
        situation, dict(zip(law.names, map(float, law.start), strict=True)),
        dict(zip(law.names, map(float, theta), strict=True)), tuple(fates_found),
        {label: channel_errors(joint, readings, reference) for label, readings in models.items()},
        "the measured readings" if situation.is_measured else "the native model",
        models[EXPORTED], exported,
    )  # fmt: skip


def channel_errors(joint: DriveJoint, shown: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Rms of the difference over the rms of the reference [%], for each channel with readings."""
    shares = share_of_measured(shown, reference)
    return {c.name: 100 * float(s) for c, s in zip(channels_of(joint), shares, strict=True) if np.isfinite(s)}


def _law_at(law: FormatLaw, theta: Any, situation: ComparisonRuns) -> JointResult:
    current, speed = evaluate_law(law, jnp.asarray(theta), situation.command, situation.load, situation.way)
    return JointResult(np.asarray(current), np.asarray(speed))


@eqx.filter_jit
def evaluate_law(law: FormatLaw, theta: Any, command: Any, load: Any, way: Any) -> tuple[Any, Any]:
    """Current of one motor [A] and speed of the joint [rad/s] by a format's law, compiled."""
    return law(theta, *map(jnp.asarray, (command, load, way)))


def refit_parameters(law: FormatLaw, situation: ComparisonRuns, native: JointResult) -> np.ndarray:
    """Least-squares fit of a format's parameters to the native model's currents and speeds.

    Residuals are relative to each quantity's rms. Parameters stay positive, because each is the square of an unknown.
    No readings are used, so errors against readings are comparable with those of the native model.
    """
    if not law.names:
        return np.zeros(0)
    inputs = (situation.command, situation.load, situation.way, native.current, native.speed)
    least = 1e-3 * float(np.max(np.abs(situation.load))) + 1e-9
    return np.asarray(_refitted(law, jnp.asarray(least), *map(jnp.asarray, inputs)))


@eqx.filter_jit
def _refitted(law: FormatLaw, least: Any, command: Any, load: Any, way: Any, current: Any, speed: Any) -> Any:
    sizes = [jnp.sqrt(jnp.mean(x**2)) for x in (current, speed)]
    scale = jnp.sqrt(jnp.maximum(law.start, least))

    # The square has no slope at 0, so a parameter of 0 starts slightly above.
    start = jnp.maximum(jnp.sqrt(law.start) / scale, 1e-3)

    def residual(z: jax.Array, args: Any) -> jax.Array:
        solution = law((scale * z) ** 2, command, load, way)
        errors = [(a - b) / s for a, b, s in zip(solution, (current, speed), sizes, strict=True)]
        return jnp.concatenate([*errors, NEAR * jnp.sqrt(1.0 * len(command)) * (z - start)])

    solver: Any = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    solution: Any = optx.least_squares(residual, solver, start, max_steps=300, throw=False)
    misfit = lambda z: jnp.sqrt(jnp.mean(residual(z, None) ** 2))  # noqa: E731
    exact, better = misfit(jnp.sqrt(law.start) / scale) < EXACT, misfit(solution.value) <= misfit(start)
    return jnp.where(exact, law.start, (scale * jnp.where(better, solution.value, start)) ** 2)


def share_kept(
    law: FormatLaw, bare: FormatLaw, situation: ComparisonRuns, native: JointResult, native_bare: JointResult
) -> float:
    """Fraction of an effect's change of current and speed that a refitted format reproduces [-], at most 1.

    1 minus the rms change of the format's error by the effect, over the rms change of current and speed. NaN if the
    effect changes nothing.
    """
    errors = [
        _scaled_residuals(exact)
        - _scaled_residuals(_law_at(model, refit_parameters(model, situation, exact), situation))
        for model, exact in ((law, native), (bare, native_bare))
    ]
    change = (_scaled_residuals(native) - _scaled_residuals(native_bare)) / (
        sizes := np.sqrt(np.mean(_scaled_residuals(native) ** 2, 0))
    )
    size = float(np.sqrt(np.mean(change**2)))
    if size < 1e-9:
        return float("nan")
    return 1 - float(np.sqrt(np.mean(((errors[0] - errors[1]) / sizes) ** 2))) / size


def _scaled_residuals(found: JointResult) -> np.ndarray:
    return np.stack([found.current, found.speed], -1)
