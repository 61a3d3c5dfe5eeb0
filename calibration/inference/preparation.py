"""What is done to a table and a robot before anything is fitted, in one order for all that fits or foresees.

`calibrate`, `discover` (so `loop` and its campaigns) and `foresee` (so `rig check`) take a table and a robot by this
one function: instruments and surfaces of which the table tells, priors by their names then, the mass that the table
states, the noise, the beginnings of histories, and the checks of all that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from calibration.data import instruments, own_mass, rig_facts, surfaces
from calibration.data.runs import Runs
from calibration.inference import checks, observers, repeats
from calibration.inference import noise as noise_room
from calibration.inference.fit_notes import Notes
from calibration.inference.foreign import inherited_priors
from calibration.inference.noise import Noise
from calibration.inference.observers import Observer
from mmrjax.model.robot import Robot


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A table and its robot, ready for a problem to be posed.

    Attributes:
        robot: with the instruments, the configurations and the mass that the table shows, and its runs' beginnings.
        observe: the kind of the data; noise: of the readings.
        stated: priors by name of parameter, (mean, sd) [SI].
        names: free parameters that were chosen, see `prepare`.
        foreign: remarks on priors of another robot; checked: on the table; begins: on the beginnings of its runs;
            weighed: on the masses that it states; doubted: on units that may be others.
    """

    robot: Robot
    observe: type[Observer]
    noise: Noise
    stated: dict[str, tuple[float, float]]
    names: tuple[str, ...]
    foreign: Notes
    checked: Notes
    begins: Notes
    weighed: Notes
    doubted: Notes = ()


def prepare(
    runs: Runs,
    robot: Robot,
    noise: str | None = None,
    stated: Mapping[str, tuple[float, float]] | None = None,
    *,
    assume: bool = True,
    choose: Callable[[Prepared], Sequence[str]] = lambda prepared: (),
) -> Prepared:
    """A table and a robot as every fit takes them.

    Args:
        noise: as `noise.parse`; stated: parameter → (mean, sd) [SI], by the names that the user knows.
        assume: whether a channel without an sd has a usual one, instead of one that the fit estimates.
        choose: names of the free parameters, of what else is prepared.

    Raises:
        BadData: a table that contradicts itself, its robot or its model, see `checks.check`.
        BadConfiguration: a noise or a prior that is none, what `choose` raises.
    """
    observe = observers.kind(runs)
    robot = surfaces.with_surface_configurations(instruments.with_inferred_instruments(robot, runs), runs)
    priors = surfaces.of_surfaces(stated or {}, robot, runs)
    own_mass.check_priors(priors, robot, runs)
    as_stated, weighed = robot, own_mass.remarks(robot, runs)
    robot = own_mass.with_table_mass(robot, runs)
    known = (noise_room.inferred if assume else noise_room.from_table)(runs, observe.sizes(runs), noise)
    known, larger = repeats.enlarged(known, runs)
    robot = observe.with_initial_states(robot, runs, known)
    found = Prepared(robot, observe, known, priors, (), (), (), (), tuple(weighed))
    names = tuple(choose(found))
    # Its masses are compared with those of the file, which the table's have not yet replaced there.
    checked = checks.check(runs, as_stated, names, known)
    begins = observe.check_start(runs, known, robot)
    return dataclasses.replace(
        found,
        names=names,
        foreign=tuple(inherited_priors(robot, priors)),
        checked=(*larger, *checked),
        begins=tuple(begins),
        doubted=rig_facts.doubts(runs, as_stated),
    )
