"""Preparation of a table and a robot before any fit, in one order for all fits and predictions.

`calibrate`, `discover` (so `loop` and its campaigns) and `foresee` (so `rig check`) share this one function. It
completes the robot's instruments and surfaces from the table and renames priors accordingly. Then it takes the mass
from the table, the noise and the initial states of histories, and checks all these.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from calibration.data import Names, Priors, instruments, own_mass, rig_facts, surfaces
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.inference import checks, observers, repeats
from calibration.inference import noise as noise_room
from calibration.inference.fit_notes import Notes
from calibration.inference.foreign import inherited_friction_remarks
from calibration.inference.noise import Noise
from calibration.inference.observers import Observer
from mmrjax.errors import UsageError
from mmrjax.fidelities.simulation import check_robot
from mmrjax.model.robot import Robot


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A table and its robot, ready for a problem.

    Attributes:
        robot: robot with instruments, configurations and mass from the table, and the initial states of its runs.
        observe: the kind of the data.
        noise: noise of the readings.
        stated: priors by name of parameter, (mean, sd) [SI].
        names: free parameters that were chosen, see `prepare`.
        foreign: remarks on priors of another robot.
        checked: on the table.
        begins: on the beginnings of its runs.
        weighed: on the masses that it states.
        doubted: on units that may be others.
    """

    robot: Robot
    observe: type[Observer]
    noise: Noise
    stated: Priors
    names: Names
    foreign: Notes
    checked: Notes
    begins: Notes
    weighed: Notes
    doubted: Notes = ()


def prepare(
    runs: Runs,
    robot: Robot,
    noise: str | None = None,
    stated: Priors | None = None,
    *,
    assume: bool = True,
    choose: Callable[[Prepared], Sequence[str]] = lambda prepared: (),
) -> Prepared:
    """A table and a robot, prepared for any fit.

    Args:
        noise: as `noise.parse_noise`.
        stated: parameter → (mean, sd) [SI], by the names that the user knows.
        assume: True to take a usual sd for a channel without one, False to let the fit estimate it.
        choose: function from the preparation to the names of the free parameters.

    Raises:
        BadData: a table that contradicts itself, its robot or its model, see `checks.check_data`.
        BadConfiguration: parameters that are no single number within their bounds, an invalid noise or prior, or any
            raised by `choose`.
    """
    try:
        check_robot(robot)
    except UsageError as error:
        raise BadConfiguration(str(error)) from error
    observe = observers.observer_kind(runs)
    robot = surfaces.with_surface_configurations(instruments.with_inferred_instruments(robot, runs), runs)
    priors = surfaces.of_surfaces(stated or {}, robot, runs)
    own_mass.check_priors(priors, robot, runs)
    as_stated, weighed = robot, own_mass.mass_notes(robot, runs)
    robot = own_mass.with_table_mass(robot, runs)
    noise_sds = (noise_room.infer_noise if assume else noise_room.noise_from_table)(runs, observe.sizes(runs), noise)
    noise_sds, larger = repeats.enlarge_noise(noise_sds, runs)
    robot = observe.with_initial_states(robot, runs, noise_sds)
    result = Prepared(robot, observe, noise_sds, priors, (), (), (), (), tuple(weighed))
    names = tuple(choose(result))
    # The table's masses are compared with those of the file, which are not yet replaced there.
    checked = checks.check_data(runs, as_stated, names, noise_sds)
    begins = observe.check_start(runs, noise_sds, robot)
    return dataclasses.replace(
        result,
        names=names,
        foreign=tuple(inherited_friction_remarks(robot, priors)),
        checked=(*larger, *checked),
        begins=tuple(begins),
        doubted=rig_facts.log_doubts(runs, as_stated),
    )
