"""What a table can determine of a rig before anything is fitted: posterior over prior sd, at the prior mean."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from calibration.data.columns import ROWS
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.data.thinning import thinned
from calibration.inference import identifiability, observers, optimizers, priors
from calibration.inference.fit_notes import (
    Copied,
    LargerNoise,
    NoLoadGives,
    Notes,
    NothingVaries,
    OffBy,
    Pair,
    Repeats,
    SlopesIn,
    StiffSupply,
    Turned,
    Unused,
)
from calibration.inference.fit_posterior import determined_together, of_coordinates
from calibration.inference.preparation import prepare
from mmrjax import fidelities
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES

#: What is to be looked at in a table before it is used.
DOUBTS = (
    Copied, LargerNoise, NoLoadGives, NothingVaries, OffBy, Repeats, SlopesIn, StiffSupply, Turned, Unused,
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Determined:
    """What a table says of a free parameter.

    Attributes:
        name: of the parameter; value: prior mean [unit]; prior_sd: of it [unit].
        share: posterior over prior sd [-]; held: whether its prior holds it.
    """

    name: str
    unit: str
    value: float
    prior_sd: float
    share: float
    held: bool


@dataclasses.dataclass(frozen=True)
class Foresight:
    """What a table can determine.

    Attributes:
        parameters: that `loop` would free.
        status: of each row with the numbers of the file.
        noise: of each channel: where its sd comes from.
        alike: pairs of parameters that these data hardly tell apart, with the correlation of their posterior.
        together: pairs of which they determine a combination alone.
        robot: with what the table shows of it, see `preparation.prepare`.
        doubts: what should be looked at in the table before a fit.
    """

    parameters: tuple[Determined, ...]
    status: tuple[str, ...]
    noise: tuple[str, ...]
    alike: tuple[tuple[str, str, float], ...]
    together: tuple[Pair, ...]
    robot: Robot
    doubts: Notes = ()


def foresee(runs: Runs, robot: Robot, noise: str | None = None, rows: int = ROWS) -> Foresight:
    """What `runs` can determine of `robot`, by the linear analysis at its own values.

    Rows that the robot does not reach with these values count for nothing.

    Args:
        noise: as `noise.parse`; None takes the file's sd columns, or shares of the readings.
        rows: of a log over time from which on readings are used of fewer.

    Raises:
        BadData: data that cannot be used.
        BadConfiguration: no parameter of the robot can be freed.
    """
    runs = thinned(runs.of(robot), rows)
    ready = prepare(runs, robot, noise)
    observe, robot, known = ready.observe, ready.robot, ready.noise
    present = {robot.configurations.names[k] for k in runs.configurations(robot)}
    names = priors.free_names(robot, present, *observe.free())
    if not observe.axis:
        names = tuple(n for n in names if n not in fidelities.unread("steady", names, runs.turns))
    if not names:
        raise BadConfiguration("nothing to determine: every loss is zero, so it is held; state yours with a ±")
    coordinates = priors.coordinates(robot, names, any_surface=robot.rig.inherits)
    posed = observers.pose(runs, robot, coordinates, known.sd)
    z = jnp.zeros(len(names))
    seen = optimizers.observation(posed, z)
    reached = np.isfinite(np.asarray(seen.reading)).all(1) & ~posed.observe.unreachable(np.asarray(seen.status))
    data = dataclasses.replace(posed.data, weight=posed.data.weight * jnp.asarray(reached, float)[:, None])
    about = identifiability.analyse(posed, z, data)
    held = identifiability.held_by_prior(about.sd)
    fields = priors.known(robot)
    width = coordinates.prior_sd
    found = tuple(
        Determined(n, fields[n].spec.unit, float(fields[n].value), float(width[k]), float(about.sd[k]), bool(held[k]))
        for k, n in enumerate(names)
    )
    statuses = tuple(STATUSES[int(s)] for s in np.asarray(seen.status))
    doubts = tuple(note for note in ready.checked if isinstance(note, DOUBTS))
    priors_hold = [p.name for p in found if p.held]
    together = determined_together(of_coordinates(coordinates, np.asarray(z), about.covariance), priors_hold)
    return Foresight(found, statuses, known.source, tuple(about.correlated()), together, robot, doubts)
