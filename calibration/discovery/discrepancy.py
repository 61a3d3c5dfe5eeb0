"""Discrepancy without a name: its location, its shape as a smooth curve fitted with the base, and a formula.

Defects and formulas are linear algebra at a fit, with every column projected against the free parameters. The curve
itself is fitted together with the base.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Names
from calibration.discovery import smooth
from calibration.discovery.active_set import ActiveSet, CandidateSpace, with_only
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate
from calibration.discovery.formula import Proposal, propose_formula
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.projection import Projection
from calibration.discovery.score_tests import diagnose_fit, family_columns
from calibration.discovery.settings import Settings
from calibration.inference import bases as bases_room
from calibration.inference.blocks import fit_from_each_start
from calibration.inference.linearization import Linearization
from calibration.inference.priors import Coordinates
from calibration.inference.problem import Problem
from mmrjax.compile.compiling import compiled
from mmrjax.effects import UNNAMED
from mmrjax.effects.curve import ORDINATES, PLACES
from mmrjax.model import params
from mmrjax.model.robot import Robot

#: Number of starts of the curve's fit, from the linear estimate to zero.
STARTS = 8
#: Extra evidence required of a curve over the supply's voltage, which acts only through currents and speeds [σ²].
INDIRECT = 6.0
#: Balances of torques and slip.
MECHANICAL = ("track", "ground", "slip")
#: Largest number of instants among which the ends of a window are chosen.
INSTANTS = 200
#: Difference of the scores of two balances' best curves up to which they cannot be separated [normal deviate].
ALIKE = 1.0
#: Cosine between the responses to errors of two places above which they cannot be separated.
PARALLEL = 0.98


# --- location -------------------------------------------------------------------------------------------


def locate_discrepancy(diagnosis: Diagnosis, bases: bases_room.Bases, included: np.ndarray) -> DiscrepancyLocation:
    """Location of a discrepancy: its balance or channel, its variable, and the places that explain the data as well.

    The place is that of the most significant smooth curve. The variable is that of the curve with most evidence
    there.

    Args:
        diagnosis: diagnosis of a fit.
        included: True for included rows, shape (rows,).
    """
    names = bases_room.family_names(bases)
    deviate, explained = np.asarray(diagnosis.scores.curve), np.asarray(diagnosis.scores.explained)
    is_window = np.array([bases_room.window_from_name(n[1]) is not None for n in names])
    # A smooth curve responds to a temporary change too, and a window to a smooth curve.
    is_temporary = bool(np.max(deviate[is_window], initial=-np.inf) > np.max(deviate[~is_window]) + ALIKE)
    same_kind = [j for j in range(len(names)) if is_window[j] == is_temporary]
    k = max(same_kind, key=deviate.__getitem__)
    # A balance takes precedence over an instrument with a similar score, which is listed as an alternative.
    near_balances = [
        j for j in same_kind if not bases_room.is_channel_place(names[j][0]) and deviate[j] > deviate[k] - ALIKE
    ]
    k = max(near_balances, key=deviate.__getitem__) if near_balances else k
    place = names[k][0]
    place_columns = [j for j in same_kind if names[j][0] == place and names[j][1] != bases_room.CONDITIONS]
    j = k if is_temporary else max(place_columns, key=deviate.__getitem__)
    if names[j][1] in bases_room.VARIABLES:
        curves = [i for i in place_columns if bases_room.window_from_name(names[i][1]) is None]
        # A voltage acts on torques and slip only through currents and speeds, so it may be listed but never leads.
        direct = [i for i in curves if place not in MECHANICAL or names[i][1] != "voltage"]
        evidence = {
            i: smooth.fit_smooth_curve(diagnosis.linear, *names[i], included).evidence for i in direct or curves
        }
        j = max(evidence, key=lambda i: evidence[i] - INDIRECT * (names[i][1] == "voltage"))
    places = dict.fromkeys(names[i][0] for i in same_kind)
    best = {b: max(deviate[i] for i in same_kind if names[i][0] == b) for b in places}
    variable, strength = names[j][1], float(explained[j])
    alike = _places_of_same_response(diagnosis.linear, [b for b, score in best.items() if score > deviate[k] - ALIKE])
    window = bases_room.window_from_name(variable)
    if window is not None and window.axis in bases_room.AXES:
        window, strength = refine_window(diagnosis.linear, place, window.axis, included)
        variable = str(window)
    strongest = max(strength, float(explained[k]))
    similar = similar_variables(names, deviate, place, variable)
    return DiscrepancyLocation(place, variable, alike, similar, strength, strongest)


def _places_of_same_response(linear: Linearization, similar: Sequence[str]) -> Names:
    """Places, each followed by the balances without own curves that the readings cannot distinguish from it.

    A gearbox loss is indistinguishable from a load loss unless a channel measures the output torque. With such a
    channel and an imposed speed, it is indistinguishable from an ammeter error.
    """
    without_curves, errors = tuple(itertools.chain(*bases_room.STANDS_FOR.values())), np.ones((linear.points, 1))
    responses = np.stack([bases_room.place_signature(linear, p, errors)[:, 0] for p in (*similar, *without_curves)])
    responses /= np.maximum(np.linalg.norm(responses, axis=1, keepdims=True), 1e-300)
    same_response = np.abs(responses[: len(similar)] @ responses[len(similar) :].T) > PARALLEL
    pairs = zip(similar, same_response, strict=True)
    return tuple(itertools.chain(*((p, *itertools.compress(without_curves, row)) for p, row in pairs)))


def similar_variables(names: Sequence[tuple[str, str]], deviate: np.ndarray, place: str, variable: str) -> Names:
    """Other variables whose curves in a place are of similar significance, the most significant first."""
    by_variable = {names[j][1]: deviate[j] for j in np.argsort(-deviate) if names[j][0] == place}
    by_variable.pop(bases_room.CONDITIONS, None)
    variable_of_axis: dict[str, str] = {_window_axis(variable): variable}
    for other, score in by_variable.items():
        if score > max(by_variable.values()) - ALIKE:
            variable_of_axis.setdefault(_window_axis(other), other)
    return tuple(other for other in variable_of_axis.values() if other != variable)


def _window_axis(variable: str) -> str:
    """Key shared by all windows of one axis. A smooth curve has a key of its own."""
    window = bases_room.window_from_name(variable)
    return variable if window is None else f"{window.axis} for a while"


def refine_window(
    linear: Linearization, place: str, axis: str, included: np.ndarray
) -> tuple[bases_room.Window, float]:
    """Window along an axis that explains most of the misfit, and its decrease of χ² [σ²].

    The window begins and ends at instants of the axis and holds at most half of the rows. The windows of the tests
    are coarser.

    Args:
        included: True for included rows, shape (rows,).
    """
    (x, way), included = linear.curve_variable(place, axis), linear.at_points(included)
    levels = np.unique(x[included])
    edges = levels[:: -(-len(levels) // INSTANTS)]
    index = np.searchsorted(edges, x, side="right") - 1
    shapes = (index[:, None] == np.arange(len(edges))) & included[:, None]
    a, b = Projection.of(linear)(bases_room.place_signature(linear, place, way[:, None] * shapes))
    sums, pull = np.pad(a.cumsum(0).cumsum(1), ((1, 0), (1, 0))), np.append(0.0, b.cumsum())
    rows = np.append(0, np.bincount(index[included], minlength=len(edges)).cumsum())
    first, last = np.triu_indices(len(edges) + 1, 1)
    norm2 = sums[last, last] - 2 * sums[first, last] + sums[first, first]
    rows_in_window = rows[last] - rows[first]
    allowed = (rows_in_window >= bases_room.FEWEST) & (rows_in_window <= 0.5 * rows[-1])
    allowed &= norm2 > 1e-9 * max(float(a.max()), 1e-300)
    gain = np.where(allowed, (pull[last] - pull[first]) ** 2 / np.where(allowed, norm2, 1.0), -np.inf)
    k = int(np.argmax(gain))
    inside = included & (index >= first[k]) & (index < last[k])
    return bases_room.Window(axis, float(x[inside].min()), float(x[inside].max())), float(gain[k])


def location_columns(linear: Linearization, bases: bases_room.Bases, where: DiscrepancyLocation) -> np.ndarray:
    """Sensitivity of the readings to a discrepancy in a location, shape (readings, terms).

    The terms are those of the location's family of curves. A temporary change is constant in its window, whose ends
    are refined, so no family has them.
    """
    window = bases_room.window_from_name(where.variable)
    if window is None:
        return family_columns(linear, bases, bases_room.family_names(bases).index((where.place, where.variable)))
    x, factor = linear.curve_variable(where.place, window.axis)
    return bases_room.place_signature(linear, where.place, (factor * window.holds(x))[:, None])


# --- the curve ------------------------------------------------------------------------------------------


class CurveCoordinates(eqx.Module):
    """Coordinates of a fit with a smooth curve: those of the base, then those of the curve's ordinates. y = L z, all
    standard normal.

    Attributes:
        base: coordinates of the base.
        root: L, shape (ordinates, ordinates).
        names: dotted names of the ordinates.
        fitted_once: True, because such coordinates serve few fits.
    """

    fitted_once: ClassVar[bool] = True
    base: Coordinates | ActiveSet
    root: Float[Array, "ordinates ordinates"]
    names: Names = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.base) + len(self.names)

    def robot(self, robot: Robot, z: Float[Array, " coordinates"]) -> Robot:
        """Returns the robot at coordinates z. `robot` must have the curve."""
        base, ordinates = _base_and_ordinates(self, z)
        return params.replace(self.base.robot(robot, base), dict(zip(self.names, ordinates, strict=True)))


@compiled
def _base_and_ordinates(shaped: CurveCoordinates, z: Array) -> tuple[Array, tuple[Array, ...]]:
    """Coordinates of the base, and values of the curve's ordinates."""
    y = shaped.root @ z[len(shaped.base) :]
    return z[: len(shaped.base)], tuple(y[k] for k in range(len(shaped.names)))


@dataclasses.dataclass(frozen=True)
class FittedCurve:
    """A smooth curve that is fitted together with the base.

    Attributes:
        robot: fitted robot with the curve.
        grid: values of the variable for the curve [SI].
        curve, sd: there [unit], shape (points,). The 95 % band is ±1.96 sd. The band includes the uncertainty of the
            base, so it is wide if base parameters can replace the curve.
        chi2: twice the objective without and with the curve [σ²], priors included.
        z, covariance: posterior of the coordinates of `problem`. The ordinates are last.
        problem: problem of the fit with the curve.
        reading: simulated reading of each row [SI], shape (rows, channels).
        converged: True if the fit is an optimum.
    """

    robot: Robot
    grid: np.ndarray
    curve: np.ndarray
    sd: np.ndarray
    chi2: tuple[float, float]
    z: np.ndarray
    covariance: np.ndarray
    problem: Problem
    reading: np.ndarray
    converged: bool


def fit_curve(space: CandidateSpace, base: Candidate, at_base: smooth.SmoothCurve) -> FittedCurve:
    """Fits a smooth curve together with the base.

    Args:
        base: fit without the curve.
        at_base: the curve to first order at that fit.
    """
    # A curve of this name from an earlier round is replaced, because its parameters have the same names.
    bare = space.problem(base.active) if base.effects else space.bare
    other_effects = tuple(e for e in bare.base.effects if e.name != at_base.effect)
    values = {"amplitude": at_base.scale, "low": at_base.low, "high": at_base.high}
    added = params.replace(UNNAMED[at_base.effect](), {n: jnp.asarray(v) for n, v in values.items()})
    names = tuple(f"effects.{at_base.effect}.{n}" for n in ORDINATES)
    shaped = CurveCoordinates(bare.coordinates, jnp.asarray(at_base.root), names)
    problem = dataclasses.replace(
        bare,
        base=dataclasses.replace(bare.base, effects=(*other_effects, added)),
        coordinates=shaped,
        data=dataclasses.replace(bare.data, centre=jnp.zeros(len(shaped))),
    )
    base_size = len(bare.coordinates)
    starts = np.zeros((STARTS, len(shaped)))
    starts[:, :base_size] = base.z[:base_size]
    starts[:, base_size:] = np.linspace(1.0, 0.0, STARTS)[:, None] * at_base.start
    optima, observations = fit_from_each_start(problem, list(starts), [space.weight] * STARTS)
    k = int(np.argmin(np.where(np.isfinite(optima.cost), optima.cost, np.inf)))
    z, covariance = np.asarray(optima.z[k]), np.asarray(optima.covariance[k])
    grid, curve, sd = at_base.drawn(z[base_size:], covariance[base_size:, base_size:])
    robot = problem.robot(jnp.asarray(z))  # also has the absent effects of the slots
    return FittedCurve(
        robot=with_only(robot, {*(e.name for e in space.bare.base.effects), *base.effects, at_base.effect}),
        grid=grid,
        curve=curve,
        sd=sd,
        chi2=(2 * base.cost, 2 * float(optima.cost[k])),
        z=z,
        covariance=covariance,
        problem=problem,
        reading=np.asarray(observations.reading[k]),
        converged=bool(optima.converged[k]),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class BaseCurve:
    """Smooth curve of the discrepancy of the base. Each of its results is computed when it is first needed, and once.

    Both the verdict and its result may need them.

    Attributes:
        space, base, left, bases: the fit of the base, its diagnosis, and the bases of smooth curves there.
    """

    space: CandidateSpace
    base: Candidate
    left: Diagnosis
    bases: bases_room.Bases

    @property
    def settings(self) -> Settings:
        """Settings of the tests."""
        return self.left.test.settings

    @functools.cached_property
    def where(self) -> DiscrepancyLocation:
        """Location of the discrepancy, from `locate_discrepancy`."""
        return locate_discrepancy(self.left, self.bases, self.space.included)

    @property
    def unit(self) -> str:
        """Unit of the balance of the discrepancy."""
        return PLACES[self.where.place][0]

    @functools.cached_property
    def at_base(self) -> smooth.SmoothCurve:
        """The curve to first order at the base fit."""
        return smooth.fit_smooth_curve(self.left.linear, self.where.place, self.where.variable, self.space.included)

    @functools.cached_property
    def proposal(self) -> Proposal:
        """A formula for the curve."""
        voltage = self.space.bare.base.rig.shows_voltage
        return propose_formula(self.left.linear, self.where.place, self.space.included, self.at_base, voltage=voltage)

    @functools.cached_property
    def fitted(self) -> FittedCurve:
        """The curve, fitted together with the base."""
        return fit_curve(self.space, self.base, self.at_base)

    @functools.cached_property
    def diagnosis(self) -> Diagnosis:
        """Diagnosis of the fit with the curve. Its critical values are those of the base."""
        problem, z = self.fitted.problem, jnp.asarray(self.fitted.z)
        linear, scores, strongest = diagnose_fit(problem, z, self.space.library.scored, self.bases)
        return Diagnosis(linear, scores, self.left.test.of(strongest))
