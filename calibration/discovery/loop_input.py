"""Input of the loop: runs without copies, robot, noise, priors and settings, and the candidate space of runs."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np

from calibration.data import Names, Priors, columns, inferred_facts
from calibration.data.effect_file import Library
from calibration.data.input_errors import BadData
from calibration.data.runs import Runs
from calibration.described import describe
from calibration.discovery import active_set, menu, scales
from calibration.discovery import settings as settings_room
from calibration.discovery.search import SearchResult
from calibration.discovery.verdict import LoopStages
from calibration.inference import fit_notes, observers, population, preparation, priors, shown_states
from calibration.inference.noise import Noise
from mmrjax import effects, fidelities
from mmrjax.errors import count_noun
from mmrjax.model.robot import Robot

#: Callback for progress notes.
Tell = Callable[[fit_notes.Remark | str], None]


@dataclasses.dataclass(frozen=True)
class LoopInput:
    """Input of the stages of the loop: runs, robot, settings and callbacks.

    Attributes:
        runs: runs without exact copies.
        numbers: row numbers as used in messages.
        robot: robot from `preparation.prepare_input`.
        noise: noise of the readings.
        stated: priors (mean, sd) that replace those of the fields [SI].
        settings: statistical settings.
        library: effects to test.
        notes: remarks on the input.
        at_first: remarks to report before the first fit.
        progress: callback for progress messages.
        keep: function that stores each stage when it ends. A stored stage contains the results of the stages before.
        known: results for the same table with other sds.
        settled: function that returns the input of settled runs that replace a log, None if these are too few.
        equations: candidate space of the windows or the linear readings of a log, whose rows are equations.
        confirm: function that chooses from the sets of a search in such equations by their simulation. Its
            arguments are base fit, its diagnosis, search and noise.
        others: exit stack of the threads that compile later programs. None if there is nothing to compile.
        later: functions that begin to compile these programs from the fit of the base.
        ranked: rankings of the library so far. Empty before the first one.
    """

    runs: Runs
    numbers: np.ndarray
    robot: Robot
    noise: Noise
    stated: Priors
    settings: settings_room.Settings
    library: Library
    notes: fit_notes.Notes = ()
    at_first: fit_notes.Notes = ()
    progress: Tell = lambda note: None
    keep: population.StoreStage = population.compute_without_storing
    known: LoopStages | None = None
    others: contextlib.ExitStack | None = None
    equations: active_set.CandidateSpace | None = None
    confirm: Callable[..., SearchResult] | None = None
    settled: Callable[[], LoopInput | None] = lambda: None
    later: list[Callable[..., None]] = dataclasses.field(default_factory=list)
    ranked: list[object] = dataclasses.field(default_factory=list)

    def kept_apart(self, word: str) -> population.StoreStage:
        """Storage of stages under names that begin with `word`. Only the ranking keeps its name."""
        return lambda name, make: self.keep(name if name == "ranking" else f"{word} {name}", make)

    @property
    def known_room(self) -> Names:
        """Effects in the simulation program of the known results. Another program takes half a minute to compile."""
        return () if self.known is None or self.known.searched is None else self.known.searched.room

    @functools.cached_property
    def space(self) -> active_set.CandidateSpace:
        """Candidate space of the runs."""
        return build_candidate_space(self.runs, self.robot, self.noise.sd, self.settings, self.stated, self.library)

    @property
    def shows_unmodelled_backlash(self) -> bool:
        """True if the log shows backlash but the robot has none."""
        return bool(fit_notes.remarks_with_codes(self.at_first, "lost_motion"))


def prepare_loop(
    runs: Runs,
    robot: Robot,
    *,
    noise: str | None = None,
    stated: Priors | None = None,
    library: Library = effects.BY_NAME,
    replicates: int = 500,
    seed: int = 0,
    forbidden: Sequence[str] = (),
    rows: int = columns.ROWS,
    settled: fit_notes.Notes = (),
) -> LoopInput:
    """Prepares the input of the stages from the arguments of `discover`, and raises its errors.

    A campaign that needs only verdicts continues with `discover.trace_verdict`, as the command does.
    `settled`: remark on settled runs that replace a log.
    """
    menu.check_forbidden(forbidden, robot)
    runs, of_sides = preparation.rows_to_fit(runs, robot, rows)
    distinct, numbers, notes = remove_copies(runs)
    kind = observers.observer_kind(distinct)
    if len(distinct) < kind.fewest:
        raise BadData(
            f"{runs.source}: {count_noun(len(distinct), kind.word)} cannot show what a model lacks; at least "
            f"{kind.fewest} are needed"
        )
    ready = preparation.prepare_input(distinct, robot, noise, stated, settled=(*settled, *of_sides))
    for note in fit_notes.remarks_with_codes(ready.table_remarks, "nothing_varies", "copied"):
        if note.code == "nothing_varies" or not note.tied:
            raise BadData(describe(note))
    missing_states = shown_states.missing_states_remarks(distinct, ready.robot)
    at_first = (
        *ready.inherited_remarks,
        *ready.log_remarks,
        *missing_states,
        *fit_notes.remarks_with_codes(ready.table_remarks, "lost_motion"),
    )
    notes_so_far: fit_notes.Notes = (
        *notes, *ready.table_remarks, *ready.start_remarks, *ready.mass_remarks, *ready.inherited_remarks,
        *ready.log_remarks, *missing_states
    )  # fmt: skip
    output_turn = scales.output_rotation(distinct, ready.robot)
    channel_effects = {name: e for name, e in effects.OF_CHANNELS.items() if e.channel in ready.robot.rig.channels}
    library = {**library, **kind.library, **channel_effects}
    library = scales.scale_library(ready.robot, distinct.conditions(ready.robot), library, output_turn)
    settings = dataclasses.replace(
        settings_room.settings_for(kind, replicates, seed),
        forbidden=tuple(forbidden),
        silent=tuple(c.name for c in ready.noise.silent),
    )
    return LoopInput(
        distinct, numbers, ready.robot, ready.noise, ready.stated, settings, library, notes_so_far, at_first
    )


def settled_input(log_input: LoopInput, prepare: Callable[..., LoopInput]) -> LoopInput | None:
    """Input of the settled runs of a log that no fit describes. None if these are too few.

    Args:
        prepare: `prepare_loop` with the options of the loop.
    """
    try:
        runs, remarks = preparation.settled_rows(log_input.runs.whole, log_input.robot, "unfitted")
    except BadData:
        return None
    return prepare(runs, settled=remarks)


def remove_copies(runs: Runs) -> tuple[Runs, np.ndarray, list[fit_notes.Remark]]:
    """Runs without exact copies, their row numbers, and remarks on the copies.

    Equal rows may be repeated measurements, for instance from a coarse display. They count as copies only if the
    whole table consists of the same sequence of rows, repeated.
    """
    cells = [*(runs[c] for c in observers.observer_kind(runs).identity(runs)), *runs.extras.values()]
    rows = list(zip(*(column.astype(str).tolist() for column in cells), strict=True))
    if runs.sampled or {"run_id", *columns.WHEN} & set(runs.headings):
        first = {row: k for k, row in reversed(list(enumerate(rows)))}
        keep = sorted(first.values())
    else:
        # rows after which the table repeats itself exactly, or all of its rows
        keep = list(range(next(n for n in range(1, len(rows) + 1) if len(rows) % n == 0 and rows[:-n] == rows[n:])))
    copies = np.setdiff1d(np.arange(len(runs)), keep)
    if not copies.size:
        return runs, np.arange(1, len(runs) + 1), []
    remark = fit_notes.Remark("copies", rows=tuple((copies + 1).tolist()))
    return runs.where(np.asarray(keep)), np.asarray(keep) + 1, [remark]


def build_candidate_space(
    runs: Runs,
    robot: Robot,
    sd: np.ndarray,
    settings: settings_room.Settings,
    stated: Priors | None = None,
    library: Library = effects.BY_NAME,
) -> active_set.CandidateSpace:
    """Base problem of a table, with slots for the effects that its data can reveal.

    Tables are padded with rows of weight 0 to one of a few sizes, so that tables of similar size share compiled
    programs. A mass in the table replaces the robot's mass. Ground friction without a stated prior gets a wide one
    for any surface, because the prior of a wrong surface would bias parameters that depend on slip.
    """
    robot = inferred_facts.with_table_mass(robot, runs)
    kind = observers.observer_kind(runs)
    index, real = kind.padded_rows(len(runs))
    idle = (
        *(() if kind.axis else priors.OVER_TIME),
        *(f"{n}.mass" for n in inferred_facts.stated_masses(robot, runs)),
    )
    names = priors.loop_parameter_names(robot, runs.configurations_named(robot), *kind.free(), idle)
    unread = fidelities.unread_parameters("drive" if kind.axis else "steady", names, runs.turns)
    names = tuple(n for n in names if n not in unread)
    coordinates = priors.parameter_coordinates(robot, names, dict(stated or {}), any_surface=True)
    bare = observers.pose_problem(runs.where(index), robot, coordinates, sd[index])
    visible = scales.visible_effects(library, robot, kind, scales.goes_both_ways(runs), scales.has_partial_duty(runs))
    space = active_set.candidate_space(bare, visible, library, settings)
    return space.without(~real)
