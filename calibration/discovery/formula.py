"""A formula for a discrepancy: one term of a dictionary of dimensionless monomials."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from calibration.data import Names
from calibration.described import describe
from calibration.discovery.projection import Projection
from calibration.discovery.smooth import SmoothCurve
from calibration.inference.bases import place_signature
from calibration.inference.linearization import Linearization
from mmrjax.effects.curve import EVERY_VARIABLE, PLACES, READINGS
from mmrjax.model import channels

#: Left side of a formula, in the symbols of the paper.
SYMBOL = {"electrical": "ΔU", "track": "ΔM_t", "ground": "ΔF_f", "slip": "ΔV", "yaw": "ΔM_ψ"} | {
    c.name: f"Δ({c.label})" for c in channels.EVERY if c.name in READINGS
}
#: Variables of decays: symbol, and unit of the time constant.
DECAYS = {"time": ("t", " s"), "order": ("k", "")}
#: Exponents of a single factor, and in a product of two.
POWERS, POWERS_PRODUCT = (-1.0, 0.5, 1.0, 2.0, 3.0), (-1.0, 0.5, 1.0, 2.0)
#: Least share of the curve that a single term has to explain [-].
MOST = 0.9
#: Signals that settled travel ties to a ratio of the dictionary.
SAME_AS = {"speed": "speed_motor"}
#: Least ratio, over its largest, at which an inverse is safe.
SAFE = 0.1
#: A simpler formula is preferred up to this rise of the BIC: no evidence worth a mention (Kass and Raftery 1995).
NO_EVIDENCE = 2.0
#: Label of each formula.
MARK = "a proposal, not a finding"


@dataclasses.dataclass(frozen=True)
class Ratio:
    """A dimensionless variable: a signal divided by a reference value in the same unit."""

    symbol: str
    unit: str
    of: str
    over: float = 1.0

    @property
    def value(self) -> str:
        """Reference value with its unit, as text."""
        return f"{self.over:g} {self.unit}".rstrip()

    def scaled(self, x: np.ndarray) -> Ratio:
        """Ratio whose reference value is the largest of these values, rounded to one digit. Coefficients then have
        the size of the term.
        """
        most = float(np.max(np.abs(x), initial=0.0)) * self.over
        return dataclasses.replace(self, over=float(f"{most:.0e}")) if most > 0 else self

    def __call__(self, linear: Linearization, place: str) -> np.ndarray:
        x, _ = linear.curve_variable(place, self.of)
        return (np.sin(x) if self.of == "slope" else x) / self.over


#: Ratios of the dictionary; of formulas that are equally good, the first is proposed.
RATIOS = tuple(
    Ratio(variable.symbol, "" if name == "slope" else variable.unit, name)
    for name, variable in {name: EVERY_VARIABLE[name] for name in ("speed_motor", "current", *EVERY_VARIABLE)}.items()
    if variable.symbol
)
#: Rise of the BIC for each variable other than the curve's, because it is one of several tested.
FOREIGN = 2 * float(np.log(len(RATIOS)))


@dataclasses.dataclass(frozen=True)
class Monomial:
    """A product of powers of ratios. Each factor is (index into `ratios`, exponent)."""

    factors: tuple[tuple[int, float], ...]
    ratios: tuple[Ratio, ...] = RATIOS

    @property
    def complexity(self) -> float:
        """Penalty for the number of factors, and for exponents other than one."""
        return sum(1 + 0.1 * abs(p - 1) for _, p in self.factors)

    @property
    def variables(self) -> Names:
        """Signals of the monomial."""
        return tuple(self.ratios[k].of for k, _ in self.factors)

    def __str__(self) -> str:
        ratio_powers = ((self.ratios[k], p) for k, p in self.factors)
        return " ".join(f"({r.symbol}/{r.value})" + (f"^{p:g}" if p != 1 else "") for r, p in ratio_powers)


def monomial_dictionary(ratios: np.ndarray, kinds: tuple[Ratio, ...] = RATIOS) -> dict[Monomial, np.ndarray]:
    """Monomials that are defined for these ratios, with their value in each row.

    A root needs ratios that are never negative. An inverse needs ratios that stay away from zero. A ratio that does
    not vary is omitted, and of several proportional monomials only the first is kept.

    Args:
        ratios: values of the ratios, shape (rows, ratios).
        kinds: signal and reference value of each ratio.
    """
    low, high = ratios.min(0), ratios.max(0)
    varying = [k for k in range(ratios.shape[1]) if high[k] - low[k] > 1e-6 * max(abs(high[k]), abs(low[k]), 1e-9)]

    def is_defined(k: int, p: float) -> bool:
        if p < 0:
            return low[k] > SAFE * high[k]
        return low[k] >= 0 or p == int(p)

    single: list[tuple[tuple[int, float], ...]] = [((k, p),) for k in varying for p in POWERS if is_defined(k, p)]
    double: list[tuple[tuple[int, float], ...]] = [
        ((j, p), (k, q))
        for j, k in itertools.combinations(varying, 2)
        for p, q in itertools.product(POWERS_PRODUCT, repeat=2)
        if is_defined(j, p) and is_defined(k, q)
    ]
    monomials: dict[Monomial, np.ndarray] = {}
    directions: list[np.ndarray] = []
    for factors in sorted(single + double, key=lambda f: Monomial(f).complexity):
        value = np.prod([ratios[:, k] ** p for k, p in factors], 0)
        norm = np.linalg.norm(value)
        if norm > 0 and not any(abs(value @ d) > (1 - 1e-9) * norm for d in directions):
            monomials[Monomial(factors, kinds)] = value
            directions.append(value / norm)
    return monomials


@dataclasses.dataclass(frozen=True)
class Proposal:
    """A formula for a discrepancy: one term of a dictionary of dimensionless monomials.

    Attributes:
        expression: text such as `ΔU = 0.42 V (I/2 A)^2`, "" if no single term explains `MOST` of the curve.
        mark: label of the formula.
        terms: monomials of the formula.
        coefficients, sds: their coefficients and standard deviations [unit of the balance].
        variables: signals of the terms, without repeats.
        explained: decrease of χ² at the base fit.
        gain: BIC of the smooth curve minus BIC of the formula. A positive value favours the formula.
        tried: number of monomials tried. The more were tried, the less a good formula means.
    """

    JSON = ("formula", "mark", "coefficients", "sds", "bic_gain_over_curve=gain", "tried")
    expression: str = ""
    terms: tuple[Monomial, ...] = ()
    coefficients: tuple[float, ...] = ()
    sds: tuple[float, ...] = ()
    variables: Names = ()
    explained: float = 0.0
    gain: float = 0.0
    tried: int = 0
    mark: str = MARK

    @property
    def formula(self) -> str:
        """The expression, or a sentence that there is none."""
        return describe(self)


def propose_formula(
    linear: Linearization, balance: str, included: np.ndarray, curve: SmoothCurve, *, voltage: bool = True
) -> Proposal:
    """Term with the smallest BIC among those that explain `MOST` of the curve, or a simpler one with as much
    evidence.

    If no single term explains enough, the formula is empty and the curve is described by its values. Variables other
    than the one of the curve are penalised.

    Args:
        included: True for included rows, shape (rows,).
        curve: smooth curve that the formula is compared with.
        voltage: True for a rig with an imposed or measured voltage.
    """
    if curve.temporary:
        level = float(np.mean((curve.scale * curve.root @ curve.start)[1:-1]))
        formula = f"{SYMBOL[balance]} = {level:.2g} {PLACES[balance][0]} while {curve.variable}"
        axis = curve.variable.split()[0]
        return Proposal(formula, (), (level,), (float("nan"),), (axis,), curve.explained, tried=1)
    if curve.variable in DECAYS:
        return _decay_formula(linear, balance, included, curve)
    included = linear.at_points(included)
    usable = [r for r in RATIOS if voltage or r.of != "voltage"]
    scaled = tuple(r.scaled(r(linear, balance)[included]) for r in usable)
    ratios = np.stack([r(linear, balance) for r in scaled], 1)
    dictionary = monomial_dictionary(ratios[included], scaled)
    terms = list(dictionary)
    if not terms:  # all runs have the same conditions
        return Proposal()
    shapes = np.zeros((linear.points, len(terms)))
    _, way = linear.curve_variable(balance, curve.variable)
    shapes[included] = way[included, None] * np.stack(list(dictionary.values()), 1)
    columns = place_signature(linear, balance, shapes)
    norm2, products = Projection.of(linear).norms(columns)
    scale = np.sqrt(np.maximum(norm2, 0))
    visible = scale > 1e-3 * np.linalg.norm(columns, axis=0)
    scale = np.where(visible, scale, 1.0)
    b = np.where(visible, -products / scale, 0.0)
    penalty = np.log(3 * included.sum())
    explained = b**2
    curve_variables = {SAME_AS.get(curve.variable, curve.variable)}
    foreign = np.array([len({*term.variables} - curve_variables) for term in terms])
    penalised = np.where(visible & (explained >= MOST * curve.explained), FOREIGN * foreign - explained, np.inf)
    if not np.isfinite(penalised).any():
        return Proposal(tried=len(terms))
    nearly_best = np.flatnonzero(penalised < penalised.min() + NO_EVIDENCE)
    k = min(nearly_best.tolist(), key=lambda j: (terms[j].complexity, penalised[j]))
    coefficient, sd = float(b[k] / scale[k]), float(1 / scale[k])
    return Proposal(
        expression=f"{SYMBOL[balance]} = {coefficient:.2g} {PLACES[balance][0]} {terms[k]}",
        terms=(terms[k],),
        coefficients=(coefficient,),
        sds=(sd,),
        variables=tuple(dict.fromkeys(terms[k].variables)),
        explained=float(explained[k]),
        gain=float((curve.freedom - 1) * penalty - curve.explained + explained[k]),
        tried=len(terms),
    )


def _decay_formula(linear: Linearization, balance: str, included: np.ndarray, curve: SmoothCurve) -> Proposal:
    """Formula of an exponential decay with time, or from run to run, without an offset.

    The time constant is searched on a grid scaled to the length of the runs, or of the table. No offset is fitted,
    because the base parameters absorb it.
    """
    (t, way), included = linear.curve_variable(balance, curve.variable), linear.at_points(included)
    symbol, unit = DECAYS[curve.variable]
    time_constants = np.geomspace(0.02, 2.0, 40) * max(float(t[included].max()), 1e-9)
    shapes = way[:, None] * np.exp(-t[:, None] / time_constants) * included[:, None]
    norm2, products = Projection.of(linear).norms(place_signature(linear, balance, shapes))
    explained = np.where(norm2 > 0, products**2 / np.where(norm2 > 0, norm2, 1.0), -np.inf)
    k = int(np.argmax(explained))
    if not np.isfinite(explained[k]):
        return Proposal(tried=len(time_constants))
    coefficient, sd = float(-products[k] / norm2[k]), float(norm2[k] ** -0.5)
    expression = (
        f"{SYMBOL[balance]} = {coefficient:.2g} {PLACES[balance][0]} exp(-{symbol} / {time_constants[k]:.2g}{unit})"
    )
    gain = float((curve.freedom - 2) * np.log(3 * included.sum()) - curve.explained + explained[k])
    variables = (curve.variable,)
    return Proposal(expression, (), (coefficient,), (sd,), variables, float(explained[k]), gain, len(time_constants))
