"""Preparation of a table and a robot before any fit or prediction, always in the same order.

`calibrate`, `discover` (so `loop` and its campaigns) and `foresee` (so `rig check`) share `prepare_input`. It
completes the robot's instruments and surfaces from the table and renames priors accordingly. Then it takes the mass
from the table, the noise and the initial states of histories, and checks all these.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Sequence

from calibration.data import Names, Priors, configuration_tables, inferred_facts, input_errors, rig_facts, settling
from calibration.data.runs import Runs
from calibration.data.unused_readings import used_rows
from calibration.described import describe
from calibration.inference import checks, observers
from calibration.inference import noise as noise_room
from calibration.inference.fit_notes import Notes, Remark
from calibration.inference.noise import Noise
from calibration.inference.observers import run_grids
from calibration.inference.priors import FRICTION, GUIDE_FRICTION, GUIDE_SHARE
from mmrjax.errors import UsageError
from mmrjax.fidelities.simulation import check_robot
from mmrjax.model import paper_robots
from mmrjax.model.params import values_by_name
from mmrjax.model.robot import Robot

#: Values of a part that makers and scales state, and values of its friction measured on the nominal robot.
DRIVE = {
    "motor": (("resistance", "torque_constant"), ("friction_coulomb", "friction_viscous")),
    "gearbox": (("ratio",), ("efficiency_load", "friction_coulomb", "friction_viscous")),
}
CHASSIS, GUIDES = (("mass", "radius"), FRICTION), (GUIDE_SHARE, GUIDE_FRICTION)
#: Relative difference above which a stated value belongs to another part [-].
DIFFERS = 0.2


def rows_to_fit(runs: Runs, robot: Robot, most: int) -> tuple[Runs, Notes]:
    """Rows that a fit uses, see `thinning.used_rows`. Of a log of two sides, its settled runs with a remark.

    Raises:
        BadData, BadConfiguration: as for `used_rows` and `settled_rows`.
    """
    runs = used_rows(runs, robot, most)
    return settled_rows(runs.whole, robot, "sides") if runs.sampled and runs.turns else (runs, ())


def settled_rows(log: Runs, robot: Robot, why: str) -> tuple[Runs, Notes]:
    """Settled runs of a log that is not fitted over time, and a remark on them.

    Args:
        why: reason, a key of `table_words.NOT_OVER_TIME`.

    Raises:
        BadData: they have fewer operating points than the loop needs rows, or as for `settling.settle_log`.
    """
    settled = settling.settle_log(log, robot)
    source = log.source
    runs = len(settled.kept)
    duration = sum(s.lasts for s in settled.kept)
    points = settled.points
    if points < (fewest := observers.SettledRuns.fewest):
        remark = Remark(
            "few_points",
            source=source,
            runs=runs,
            lasts=duration,
            points=points,
            needed=fewest,
            each=settled.shortest,
        )
        raise input_errors.BadData(describe(remark))
    return settled.settled_runs(), (Remark("settled_runs", source=source, why=why, runs=runs, lasts=duration),)


@dataclasses.dataclass(frozen=True)
class PreparedInput:
    """A table and its robot, completed and checked before a fit.

    Attributes:
        robot: robot with instruments, configurations and mass from the table, and the initial states of its runs.
        observe: observer class for the data.
        noise: noise of the readings.
        stated: priors, parameter → (mean, sd) [SI].
        names: names of the free parameters.
        inherited_remarks: remarks on friction inherited from another robot.
        table_remarks: remarks on the table.
        start_remarks: remarks on the beginnings of its runs.
        mass_remarks: remarks on the masses that it states.
        log_remarks: remarks on settled runs that replace a log, and on units that may be wrong.
    """

    robot: Robot
    observe: type[observers.Observer]
    noise: Noise
    stated: Priors
    names: Names
    inherited_remarks: Notes
    table_remarks: Notes
    start_remarks: Notes
    mass_remarks: Notes
    log_remarks: Notes = ()


def prepare_input(
    runs: Runs,
    robot: Robot,
    noise: str | None = None,
    stated: Priors | None = None,
    *,
    assume: bool = True,
    choose: Callable[[PreparedInput], Sequence[str]] = lambda prepared: (),
    settled: Notes = (),
) -> PreparedInput:
    """Completes the robot from the table and checks both, before any fit.

    Args:
        noise: standard deviations, in the format of `noise.parse_noise`.
        stated: parameter → (mean, sd) [SI], by the names that the user knows.
        assume: True to assume a usual sd for channels without one, False to let the fit estimate it.
        choose: function from the prepared input to the names of the free parameters.
        settled: remark of `rows_to_fit`.

    Raises:
        BadData: the table contradicts itself, its robot or its model, see `checks.check_data`.
        BadConfiguration: a parameter is out of bounds or not a single number, or the noise, a prior or the choice of
            parameters is invalid.
    """
    try:
        check_robot(robot)
    except UsageError as error:
        raise input_errors.BadConfiguration(str(error)) from error
    observe = observers.observer_kind(runs)
    robot = configuration_tables.with_surface_configurations(
        inferred_facts.with_inferred_instruments(robot, runs), runs
    )
    priors = configuration_tables.values_of_surface_configurations(stated or {}, robot, runs)
    inferred_facts.check_priors(priors, robot, runs)
    robot_as_stated = robot
    mass_remarks = inferred_facts.mass_notes(robot, runs)
    robot = inferred_facts.with_table_mass(robot, runs)
    table_noise = (noise_room.infer_noise if assume else noise_room.noise_from_table)(
        runs, observe.sizes(runs), noise
    )
    table_noise, noise_remarks = noise_room.enlarge_noise(table_noise, runs)
    robot = run_grids.measure_initial_states(robot, runs, table_noise)
    prepared = PreparedInput(robot, observe, table_noise, priors, (), (), (), (), tuple(mass_remarks))
    names = tuple(choose(prepared))
    # The table's masses are compared with those of the file, which are not yet replaced there.
    table_remarks = checks.check_data(runs, robot_as_stated, names, table_noise)
    start_remarks = observe.check_start(runs, table_noise, robot)
    return dataclasses.replace(
        prepared,
        names=names,
        inherited_remarks=tuple(inherited_friction_remarks(robot, priors)),
        table_remarks=(*noise_remarks, *table_remarks),
        start_remarks=tuple(start_remarks),
        log_remarks=(*settled, *rig_facts.log_doubts(runs, robot_as_stated)),
    )


def inherited_friction_remarks(robot: Robot, stated: Collection[str] = ()) -> list[Remark]:
    """Remarks on parts that differ from those of the nominal robot but have the same friction. Empty for a rig
    without inheritance.

    A configuration is compared with the one of the nominal robot that has the same friction.

    Args:
        stated: names of the parameters whose priors the user states.
    """
    if not robot.rig.inherits:
        return []
    values, nominal_values = map(values_by_name, (robot, paper_robots.nominal()))
    pairs = [(part, part, *DRIVE[part]) for part in DRIVE]
    pairs += [(c, other, *CHASSIS) for c in robot.configurations for other in paper_robots.nominal().configurations]
    inherited: dict[str, Remark] = {}
    for part, other, stated_fields, friction in pairs:
        on_tracks = part in robot.configurations and float(robot.configurations[part].on_tracks) > 0.5
        guides = GUIDES if on_tracks else ()
        inherited_names = tuple(
            f"{part}.{name}"
            for name in (*friction, *guides)
            if values[f"{part}.{name}"] == nominal_values[f"{other}.{name}"] != 0 and f"{part}.{name}" not in stated
        )
        changed = tuple(
            (name, values[f"{part}.{name}"], nominal_values[f"{other}.{name}"])
            for name in stated_fields
            if abs(values[f"{part}.{name}"] / nominal_values[f"{other}.{name}"] - 1) > DIFFERS
        )
        if len(inherited_names) > len(inherited[part].kept if part in inherited else ()):
            inherited[part] = Remark("inherited_priors", part=part, changed=changed, kept=inherited_names)
    return [note for note in inherited.values() if note.changed]
