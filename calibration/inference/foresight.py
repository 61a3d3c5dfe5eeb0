"""Parameters that a table can determine, before any fit: ratio of posterior to prior sd at the prior mean."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np

from calibration.data import Names
from calibration.data.columns import ROWS
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.inference import identifiability, observers, optimizers, priors
from calibration.inference.fit_notes import DependentPair, Notes, remarks_with_codes
from calibration.inference.identifiability import Identifiability, determined_together, posterior_of_coordinates
from calibration.inference.preparation import prepare_input, rows_to_fit
from calibration.inference.problem import Problem
from mmrjax import fidelities
from mmrjax.model import params
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES

#: Notes that call for a look at the table before it is used.
DOUBTS = (
    "constant", "copied", "larger_noise", "lost_motion", "no_load_gives", "nothing_varies", "off_by", "repeats",
    "slopes_in", "stiff_supply", "turned", "unused",
)  # fmt: skip


#: Channels that a log of goal and angle may lack.
MORE = ("motor_current", "output_speed", "motor_voltage")


@dataclasses.dataclass(frozen=True)
class ParameterInformation:
    """Information on a free parameter in a table.

    Attributes:
        name: name of the parameter.
        value: prior mean [unit].
        prior_sd: prior standard deviation [unit].
        share: posterior sd over prior sd [-].
        held: True if the table does not determine it, so that its prior does.
    """

    name: str
    unit: str
    value: float
    prior_sd: float
    share: float
    held: bool


@dataclasses.dataclass(frozen=True)
class InformationForecast:
    """Information on a robot's parameters in a table, before any fit.

    Attributes:
        parameters: parameters that `loop` would fit.
        status: status of each row, with the values of the robot file.
        noise: source of each channel's sd.
        alike: strongly correlated pairs of parameters, with the correlation of their posterior.
        together: pairs of parameters that the data determine only in combination.
        robot: robot completed from the table, see `preparation.prepare_input`.
        doubts: remarks that should be checked before a fit.
        separating: for each pair in `alike`, columns that the log lacks and that would each separate the pair.
    """

    parameters: tuple[ParameterInformation, ...]
    status: Names
    noise: Names
    alike: tuple[tuple[str, str, float], ...]
    together: tuple[DependentPair, ...]
    robot: Robot
    doubts: Notes = ()
    separating: tuple[Names, ...] = ()


def predict_identifiability(runs: Runs, robot: Robot) -> InformationForecast:
    """Predicts which parameters of `robot` the runs can determine, from the linear analysis at the values of its
    file.

    Rows that the robot does not reach with these values are ignored. The noise is that of the sd columns of the file,
    or shares of the readings.

    Raises:
        BadData: data that cannot be used.
        BadConfiguration: no parameter of the robot can be fitted.
    """
    runs, row_remarks = rows_to_fit(runs, robot, ROWS)
    prepared = prepare_input(runs, robot)
    observe, robot, table_noise = prepared.observe, prepared.robot, prepared.noise
    present = {robot.configurations.names[k] for k in runs.configurations(robot)}
    names = priors.loop_parameter_names(robot, present, *observe.free(), () if observe.axis else priors.OVER_TIME)
    if not observe.axis:
        names = tuple(name for name in names if name not in fidelities.unread_parameters("steady", names, runs.turns))
    if not names:
        raise BadConfiguration("nothing to determine: every loss is zero; give yours with a ±")
    coordinates = priors.parameter_coordinates(robot, names, any_surface=robot.rig.inherits)
    problem = observers.pose_problem(runs, robot, coordinates, table_noise.sd)
    z = jnp.zeros(len(names))
    observation = optimizers.observe_at(problem, z)
    is_reached = np.isfinite(np.asarray(observation.reading)).all(1) & ~problem.observe.unreachable(
        np.asarray(observation.status)
    )
    weight = problem.data.weight * jnp.asarray(is_reached, float)[:, None]
    analysis = identifiability.analyse_identifiability(problem.with_data(weight=weight), z)
    is_held_by_prior = identifiability.held_by_prior(analysis.sd)
    parameters_by_name = params.parameters_by_name(robot)
    prior_sd = coordinates.prior_sd
    parameters = tuple(
        ParameterInformation(
            name,
            parameters_by_name[name].spec.unit,
            float(parameters_by_name[name].value),
            float(prior_sd[k]),
            float(analysis.sd[k]),
            bool(is_held_by_prior[k]),
        )
        for k, name in enumerate(names)
    )
    statuses = tuple(STATUSES[int(s)] for s in np.asarray(observation.status))
    doubts = (*row_remarks, *remarks_with_codes(prepared.table_remarks, *DOUBTS))
    held_names = [p.name for p in parameters if p.held]
    together = determined_together(
        posterior_of_coordinates(coordinates, np.asarray(z), analysis.covariance), held_names
    )
    correlated_pairs = tuple(analysis.correlated())
    separating = (
        tuple(_separating_columns(runs, problem, analysis, correlated_pairs))
        if robot.rig.follows_goal and correlated_pairs
        else ((),) * len(correlated_pairs)
    )
    return InformationForecast(
        parameters, statuses, table_noise.source, correlated_pairs, together, robot, doubts, separating
    )


def _separating_columns(
    runs: Runs, problem: Problem, analysis: Identifiability, correlated_pairs: Sequence[tuple[str, str, float]]
) -> Iterator[Names]:
    """For each pair, columns that would separate it: with their readings, it is neither correlated nor held by its
    priors.

    Each sample is assumed to have such a reading, and its sensitivity is simulated.
    """
    channels, rig = problem.base.channels, problem.base.rig
    robot_with_all_channels = dataclasses.replace(
        problem.base, rig=dataclasses.replace(rig, channels=(*rig.channels, *MORE))
    )
    columns = {**{c.column: np.zeros(len(runs)) for c in robot_with_all_channels.channels}, **runs.columns}
    layout = dataclasses.replace(runs.layout, channels=robot_with_all_channels.channels)
    table = dataclasses.replace(runs, columns=columns, layout=layout)
    sd = np.ones((len(runs), len(robot_with_all_channels.channels)))
    problem_with_all_channels = observers.pose_problem(table, robot_with_all_channels, problem.coordinates, sd)
    linearised = optimizers.linearise(problem_with_all_channels, jnp.zeros(len(problem.coordinates)))[:2]
    readings, slopes = (np.asarray(x)[: sd.size].reshape(*sd.shape, *x.shape[1:]) for x in linearised)
    covariances = {}
    for k, channel in enumerate(robot_with_all_channels.channels):
        reading_sd = channel.sd_share * np.sqrt(np.mean(readings[:, k] ** 2))
        if channel not in channels and reading_sd > 0:
            jacobian = np.concatenate([analysis.jacobian, slopes[:, k] / reading_sd, np.eye(len(analysis.sd))])
            covariances[channel.column] = np.linalg.inv(jacobian.T @ jacobian)
    for one, other, _ in correlated_pairs:
        pair = [analysis.names.index(one), analysis.names.index(other)]
        separating = []
        for column, covariance in covariances.items():
            sd = np.sqrt(np.diag(covariance)[pair])
            correlation = abs(covariance[pair[0], pair[1]]) / (sd[0] * sd[1])
            if correlation <= identifiability.CORRELATED and not identifiability.held_by_prior(sd).any():
                separating.append(column)
        yield tuple(separating)
