"""One sentence for each kind of note, of a table, a fit, the loop or a study."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from calibration.discovery import notes as of_loop
from calibration.inference import notes as of_fit
from calibration.inference.notes import Note
from calibration.sensitivity import notes as of_study
from calibration.words import fits, loop, sensitivity, steps, tables

#: What is said of each kind of note; what is not among them has a `statement` of its own.
SAID: dict[type, Callable[[Any], str]] = {
    of_fit.Step: steps.step,
    of_fit.HeldByPrior: fits.held_by_prior,
    of_fit.FarFromPrior: fits.far_from_prior,
    of_fit.NoiseOff: fits.noise_off,
    of_fit.Fact: fits.fact,
    of_fit.Unmeasured: tables.unmeasured,
    of_fit.Constant: tables.constant,
    of_fit.EndsEarly: tables.ends_early,
    of_fit.NeverGrips: tables.never_grips,
    of_fit.CoarseSteps: tables.coarse_steps,
    of_fit.ManyChanges: tables.many_changes,
    of_fit.StopsOnSlope: tables.stops_on_slope,
    of_fit.InheritedPriors: tables.inherited_priors,
    of_fit.OffBy: tables.off_by,
    of_fit.SlopesIn: tables.slopes_in,
    of_fit.EstimatedNoise: fits.estimated_noise,
    of_fit.BesideSteady: fits.beside_steady,
    of_fit.OfRows: fits.of_rows,
    of_fit.AtBound: fits.at_bound,
    of_fit.ProductAlone: fits.product_alone,
    of_fit.PriorOfProduct: fits.prior_of_product,
    of_fit.NoPrediction: fits.no_prediction,
    of_fit.SamePredictions: fits.same_predictions,
    of_fit.BlockNotConverged: fits.block_not_converged,
    of_fit.Agreement: fits.agreement,
    of_fit.Elsewhere: fits.elsewhere,
    of_fit.InPieces: fits.in_pieces,
    of_fit.Generations: fits.generations,
    of_fit.LostRows: fits.lost_rows,
    of_fit.MembersJump: fits.members_jump,
    of_fit.EndedAtEdge: fits.ended_at_edge,
    of_fit.ReadFromMembers: fits.read_from_members,
    of_loop.AssumedNoise: loop.assumed_noise,
    of_loop.NoiseFromSeries: loop.noise_from_series,
    of_loop.Copies: loop.copies,
    of_loop.KeptOut: loop.kept_out,
    of_loop.PhasesDiffer: loop.phases_differ,
    of_loop.StillLacks: loop.still_lacks,
    of_loop.Late: loop.late,
    of_loop.Led: loop.led,
    of_loop.LostReplicates: loop.lost_replicates,
    of_loop.Outstanding: loop.outstanding,
    of_loop.TooFewReplicates: loop.too_few_replicates,
    of_loop.RestsOn: loop.rests_on,
    of_loop.Unwritten: loop.unwritten,
    of_study.Sampling: sensitivity.sampling,
    of_study.PointsLeftOut: sensitivity.points_left_out,
    of_study.SampleLeftOut: sensitivity.sample_left_out,
    of_study.Inert: sensitivity.inert,
    of_study.Tied: sensitivity.tied,
}


def sentence(note: Note | str) -> str:
    """A note in words."""
    if isinstance(note, str):
        return note
    said = SAID.get(type(note))
    return str(note.statement) if said is None else said(note)


def sentences(notes: Iterable[Note | str]) -> tuple[str, ...]:
    """Each note in words, in order."""
    return tuple(map(sentence, notes))


def in_words(tell: Callable[[str], None]) -> Callable[[Note | str], None]:
    """What is told in sentences, as a computation tells it in notes."""
    return lambda note: tell(sentence(note))
