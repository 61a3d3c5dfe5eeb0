"""Numbers of an exported law, each with its unit, source and interval."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.data import posterior_file
from calibration.data.posterior_file import Posterior
from mmrjax.model import quantities
from mmrjax.model.params import Parameter
from mmrjax.model.signals import Signals
from sweeps.export.joint import Joint, mean_surroundings
from sweeps.export.law_source import Constant

#: Draws of the posterior by which intervals are found, and the shares of them below their ends.
DRAWS, ENDS = 4000, (0.025, 0.975)
OF_POSTERIOR, OF_PRIOR = "95 % interval", "prior, two sds either side: no posterior is known"


def posterior_of(joint: Joint) -> Posterior | None:
    """Returns the posterior next to the robot's file; None if there is no such file.

    Raises:
        BadData: it cannot be read, or is of another robot.
    """
    source = Path(joint.file.source)
    path = source.with_name(posterior_file.FILE)
    if source.suffix != ".toml" or not path.is_file():
        return None
    found = posterior_file.read_posterior(path)
    found.check(joint.file.robot, str(path))
    return found


def constants_of(joint: Joint, signals: Signals, posterior: Posterior | None) -> tuple[Constant, ...]:
    """Returns the numbers of the law: parameters of the robot, and means of the joint's surroundings over runs.

    Args:
        signals: of the runs.
    """
    ends = _intervals(posterior)
    found = []
    for name, parameter in joint.parameters().items():
        low, high, kind = _interval(joint, name, parameter, ends, posterior is not None)
        spec = parameter.spec
        source = f"fitted; prior: {spec.source}" if kind == OF_POSTERIOR else spec.source
        value = float(parameter.value)
        found.append(Constant(name, value, spec.unit, spec.meaning, source, low, high, kind))
    for name, mean in mean_surroundings(signals, joint.surroundings()).items():
        word = name.removeprefix("surroundings.")
        known = quantities.CONDITIONS.get(word)
        unit = {"normal": "N", "mass": "kg", "slope": "rad", "payload": "kg"}.get(word, "SI")
        meaning = {"normal": "normal load of one side"}.get(word, known.label if known else word.replace("_", " "))
        found.append(Constant(name, mean, unit, meaning, "mean over the compared runs"))
    return tuple(found)


def _intervals(posterior: Posterior | None) -> dict[str, tuple[float, float]]:
    if posterior is None:
        return {}
    drawn = np.quantile(posterior.draw(DRAWS, 0), ENDS, axis=0)
    return {name: (float(a), float(b)) for name, a, b in zip(posterior.names, *drawn, strict=True)}


def _interval(
    joint: Joint, name: str, parameter: Parameter, ends: dict[str, tuple[float, float]], fitted: bool
) -> tuple[float | None, float | None, str]:
    if name in ends:
        return *ends[name], OF_POSTERIOR
    stated = {n: (mean, sd) for n, mean, sd in joint.file.robot.rig.priors}
    value = float(parameter.value)
    sd = stated[name][1] if name in stated else parameter.spec.prior_sd(value)
    if not sd:
        return None, None, ""
    kind = "prior, two sds either side: not fitted" if fitted else OF_PRIOR
    low, high = parameter.spec.bounds
    return max(value - 2 * sd, low), min(value + 2 * sd, high), kind
