"""Parameters that a table can determine, before any fit: posterior over prior sd, at the prior mean."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from calibration.data import Names
from calibration.data.columns import ROWS
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.data.thinning import used_rows
from calibration.inference import identifiability, observers, optimizers, priors
from calibration.inference.fit_notes import Notes, Pair, with_codes
from calibration.inference.identifiability import determined_together, posterior_of_coordinates
from calibration.inference.preparation import prepare
from mmrjax import fidelities
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES

#: Notes that call for a look at the table before it is used.
DOUBTS = (
    "copied", "larger_noise", "lost_motion", "no_load_gives", "nothing_varies", "off_by", "repeats", "slopes_in",
    "stiff_supply", "turned", "unused",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Determined:
    """Information that a table has on a free parameter.

    Attributes:
        name: of the parameter.
        value: prior mean [unit].
        prior_sd: of it [unit].
        share: posterior over prior sd [-].
        held: True if its prior holds it.
    """

    name: str
    unit: str
    value: float
    prior_sd: float
    share: float
    held: bool


@dataclasses.dataclass(frozen=True)
class Foresight:
    """Information that a table has on a robot.

    Attributes:
        parameters: that `loop` would free.
        status: of each row, for the values in the file.
        noise: source of each channel's sd.
        alike: strongly correlated pairs of parameters, with the correlation of their posterior.
        together: pairs of parameters that the data determine only in combination.
        robot: completed from the table, see `preparation.prepare`.
        doubts: notes to look at before a fit.
    """

    parameters: tuple[Determined, ...]
    status: Names
    noise: Names
    alike: tuple[tuple[str, str, float], ...]
    together: tuple[Pair, ...]
    robot: Robot
    doubts: Notes = ()


def predict_identifiability(runs: Runs, robot: Robot, noise: str | None = None, rows: int = ROWS) -> Foresight:
    """Returns which parameters of `robot` `runs` can determine, from the linear analysis at the robot's own values.

    Rows that the robot does not reach with these values are ignored.

    Args:
        noise: as `noise.parse_noise`. None takes the file's sd columns, or shares of the readings.
        rows: number of rows above which they are thinned.

    Raises:
        BadData: data that cannot be used.
        BadConfiguration: no parameter of the robot can be freed.
    """
    runs = used_rows(runs, robot, rows)
    ready = prepare(runs, robot, noise)
    observe, robot, table_noise = ready.observe, ready.robot, ready.noise
    present = {robot.configurations.names[k] for k in runs.configurations(robot)}
    names = priors.free_names(robot, present, *observe.free(), () if observe.axis else priors.OVER_TIME)
    if not observe.axis:
        names = tuple(n for n in names if n not in fidelities.unread_parameters("steady", names, runs.turns))
    if not names:
        raise BadConfiguration("nothing to determine: every loss is zero, so it is held; state yours with a ±")
    coordinates = priors.parameter_coordinates(robot, names, any_surface=robot.rig.inherits)
    posed = observers.pose_problem(runs, robot, coordinates, table_noise.sd)
    z = jnp.zeros(len(names))
    observation = optimizers.observe_at(posed, z)
    reached = np.isfinite(np.asarray(observation.reading)).all(1) & ~posed.observe.unreachable(
        np.asarray(observation.status)
    )
    data = dataclasses.replace(posed.data, weight=posed.data.weight * jnp.asarray(reached, float)[:, None])
    about = identifiability.analyse_identifiability(posed, z, data)
    held = identifiability.held_by_prior(about.sd)
    fields = priors.parameters_by_name(robot)
    width = coordinates.prior_sd
    estimates = tuple(
        Determined(n, fields[n].spec.unit, float(fields[n].value), float(width[k]), float(about.sd[k]), bool(held[k]))
        for k, n in enumerate(names)
    )
    statuses = tuple(STATUSES[int(s)] for s in np.asarray(observation.status))
    doubts = tuple(with_codes(ready.checked, *DOUBTS))
    priors_hold = [p.name for p in estimates if p.held]
    together = determined_together(
        posterior_of_coordinates(coordinates, np.asarray(z), about.covariance), priors_hold
    )
    return Foresight(estimates, statuses, table_noise.source, tuple(about.correlated()), together, robot, doubts)
