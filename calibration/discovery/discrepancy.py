"""A discrepancy without a name: where it is, its shape as a smooth curve, a formula proposed for it, a robot with it.

Defects and formulas are linear algebra at the base fit, every column projected against the free parameters as
in `trace`; the curve itself is fitted with the base anew, to all rows and without each block.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.discovery.active_set import Slots
from calibration.discovery.bases import ORDERS
from calibration.discovery.score_tests import PROBED, Linear
from calibration.inference import optimizers as fit
from calibration.inference.priors import Coordinates
from calibration.inference.problem import Observation, Problem
from mmrjax import params
from mmrjax.effects import UNNAMED
from mmrjax.effects.curve import BALANCES, ORDINATES, weights
from mmrjax.robot import Robot
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from calibration.discovery.loop import Hypothesis, Loop

#: Searches in one batch: all rows from several starts, or as many blocks left out.
BATCH = 8
#: Priors that are tried for the ordinates: correlation lengths [spacings], sizes [σ that an ordinate makes].
LENGTHS, SIZES = (1.0, 1.5, 2.5, 4.0), tuple(np.geomspace(0.3, 300.0, 25))
#: Prior sd of a curve's level and trend, over that of its shape.
WIDE = 3.0
#: Points of a curve that are shown.
POINTS = 61
#: What a formula is called, in the symbols of the paper.
SYMBOL = {"electrical": "ΔU", "track": "ΔM_t", "ground": "ΔF_f", "slip": "ΔV"}
#: Exponents of a factor alone, and in a product of two.
POWERS, POWERS_PRODUCT = (-1.0, 0.5, 1.0, 2.0, 3.0), (-1.0, 0.5, 1.0, 2.0)
#: Second terms that are tried beside each first one.
SECONDS = 40
#: Signals that settled travel ties to a ratio of the dictionary.
SAME_AS = {"speed": "speed_motor"}
#: Least ratio, over its largest, at which an inverse is safe.
SAFE = 0.1
#: A simpler formula is preferred up to this rise of the BIC: no evidence worth a mention (Kass and Raftery 1995).
NO_EVIDENCE = 2.0
#: How every formula is marked.
MARK = "a proposal, not a finding"


# --- the defect of a balance ----------------------------------------------------------------------------


class Projection:
    """What is left of any columns after the free parameters have been fitted again.

    Args:
        linear: at the base fit of settled rows; its prior rows are those of the free parameters.
    """

    def __init__(self, linear: Linear) -> None:
        jacobian, residual = np.asarray(linear.jacobian), np.asarray(linear.residual)
        self.readings = 3 * linear.rows
        half = np.linalg.solve(np.linalg.cholesky(jacobian.T @ jacobian), jacobian.T)
        self.half = half[:, : self.readings]
        self.left = (residual - half.T @ (half @ residual))[: self.readings]

    def __call__(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A = Cᵀ (I - P) C and b = -Cᵀ (I - P) e: coefficients a explain 2 bᵀa - aᵀA a of χ².

        Args:
            columns: whitened change of the readings per unit, shape (readings, columns).
        """
        inside = self.half @ columns
        return columns.T @ columns - inside.T @ inside, -columns.T @ self.left


@dataclasses.dataclass(frozen=True)
class Defect:
    """What a balance lacks in each row by itself, after what the free parameters absorb.

    Attributes:
        value, sd: [unit of the balance], shape (rows,); NaN where the readings do not show it.
    """

    value: np.ndarray
    sd: np.ndarray


def defect(linear: Linear, balance: str) -> Defect:
    """The defect of a balance in each row: least squares of the row's residual along its sensitivity.

    δ_i = -(r_i·e) / ‖r_i‖², sd 1/‖r_i‖, r_i = (I - P) g_i, g_i the change of all readings by a defect of row i
    (of histories: at that instant, falling to zero at the knots beside it; NaN between knots).
    """
    places = np.arange(linear.rows) if linear.series is None else np.unique(np.asarray(linear.series.knots))
    shapes = np.zeros((linear.rows, len(places)))
    shapes[places, np.arange(len(places))] = 1.0
    columns = _columns(linear, balance, shapes)
    a, b = Projection(linear)(columns)
    norm2, whole = np.diag(a), np.sum(columns**2, 0)
    seen = norm2 > 1e-6 * np.maximum(whole, 1e-300)
    norm2 = np.where(seen, norm2, np.nan)
    value, sd = np.full(linear.rows, np.nan), np.full(linear.rows, np.nan)
    value[places], sd[places] = b / norm2, 1 / np.sqrt(norm2)
    return Defect(value, sd)


def _columns(linear: Linear, balance: str, shapes: np.ndarray) -> np.ndarray:
    """Change of the readings by terms of a balance, shape (readings, terms), of shapes (rows, terms)."""
    return np.asarray(linear.columns(PROBED.index(balance), jnp.asarray(shapes)))


# --- the curve ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Smooth:
    """A smooth curve (or a wave) at the base fit, with the prior that these data find most likely.

    Attributes:
        effect, variable: name of the curve, and what it is over; low, high: ends of its range; scale: its amplitude.
        root: L of the prior covariance L Lᵀ of the ordinates, shape (ordinates, ordinates).
        start: ordinates in prior coordinates, y = L z, shape (ordinates,).
        explained: fall of χ²; freedom: how many parameters that took.
    """

    effect: str
    variable: str
    low: float
    high: float
    scale: float
    root: np.ndarray
    start: np.ndarray
    explained: float
    freedom: float

    @property
    def wave(self) -> bool:
        """Whether it repeats with the angle of a shaft."""
        return self.variable in ORDERS

    @property
    def ordinates(self) -> tuple[str, ...]:
        """Parameters of the effect that make its shape."""
        return ("y_sin", "y_cos") if self.wave else ORDINATES

    @property
    def values(self) -> dict[str, float]:
        """The other parameters of the effect."""
        if self.wave:
            return {"amplitude": self.scale, "order_shaft": ORDERS[self.variable][0]}
        return {"amplitude": self.scale, "low": self.low, "high": self.high}

    def basis(self, x: np.ndarray) -> np.ndarray:
        """What each ordinate counts at x, shape (points, ordinates)."""
        return _basis(self.variable, x, self.low, self.high)


def _basis(variable: str, x: np.ndarray, low: float, high: float) -> np.ndarray:
    if variable in ORDERS:
        return np.stack([np.sin(x), np.cos(x)], 1)
    return np.asarray(weights(jnp.asarray(x), low, high))  # type: ignore[arg-type]


def smooth(linear: Linear, balance: str, variable: str, counts: np.ndarray) -> Smooth:
    """The curve of a variable in a balance, linear at the base fit.

    The ordinates are a Gaussian process with covariance s² exp(-½ (Δ/l)²) over their distance Δ, and a level
    and a trend WIDE times as large, which base parameters can hide; size s and length l are those of the
    greatest evidence (Rasmussen and Williams 2006, eqs. (2.39), (5.8)). Of a wave sine and cosine are independent.

    Args:
        counts: whether a row counts, shape (rows,).
    """
    x = _seen(linear, variable)
    low, high = (0.0, 2 * np.pi) if variable in ORDERS else (float(x[counts].min()), float(x[counts].max()))
    if not high - low > 1e-9 * max(abs(high), abs(low), 1e-9):
        high = low + max(abs(low), 1.0)  # the variable stands still: an offset is all that can be seen
    basis = _basis(variable, x, low, high)
    a, b = Projection(linear)(_columns(linear, balance, basis))
    size = 1 / np.sqrt(max(np.diag(a).max(), 1e-300))
    roots = [np.eye(2)] if variable in ORDERS else [_smoothness(length) for length in LENGTHS]
    best: tuple[float, tuple] = (-np.inf, ())
    for root, sigmas in itertools.product(roots, SIZES):
        scale = sigmas * size
        inner, pull = scale**2 * root.T @ a @ root, scale * root.T @ b
        there = np.eye(len(root)) + inner
        z = np.linalg.solve(there, pull)
        evidence = 0.5 * pull @ z - 0.5 * np.linalg.slogdet(there)[1]
        if evidence > best[0]:
            explained = 2 * pull @ z - z @ inner @ z
            best = evidence, (scale, root, z, float(explained), float(np.trace(np.linalg.solve(there, inner))))
    name = f"wave_{balance}" if variable in ORDERS else f"curve_{balance}_{variable}"
    return Smooth(name, variable, low, high, *best[1])


def _smoothness(length: float) -> np.ndarray:
    """L of the prior covariance of the ordinates at a correlation length [spacings]."""
    distance = np.subtract.outer(np.arange(len(ORDINATES)), np.arange(len(ORDINATES)))
    across = np.linspace(-1.0, 1.0, len(ORDINATES))
    broad = WIDE**2 * (1 + np.outer(across, across)) + 1e-6 * np.eye(len(ORDINATES))
    return np.linalg.cholesky(np.exp(-0.5 * (distance / length) ** 2) + broad)


def _seen(linear: Linear, variable: str) -> np.ndarray:
    if variable in ORDERS:
        return ORDERS[variable][0] * np.asarray(linear.angle)
    x = linear.series.time if variable == "time" else getattr(linear.signals, variable)
    return np.broadcast_to(np.asarray(x, float), (linear.rows,))


class Shaped(eqx.Module):
    """Coordinates of a base fit, then those of a curve's ordinates: y = L z, all standard normal.

    Attributes:
        base: of the base; root: L, shape (ordinates, ordinates); names: dotted, of the ordinates.
    """

    base: Coordinates | Slots
    root: Float[Array, "ordinates ordinates"]
    names: tuple[str, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.base) + len(self.names)

    def robot(self, robot: Robot, z: Float[Array, " coordinates"]) -> Robot:
        """`robot`, which has the curve, at coordinates z."""
        there = self.base.robot(robot, z[: len(self.base)])
        y = self.root @ z[len(self.base) :]
        return params.replace(there, {n: y[k] for k, n in enumerate(self.names)})  # type: ignore[return-value]


@eqx.filter_jit
def _fits(problem: Problem, starts: Array, counts: Array) -> tuple[fit.Optimum, Observation, Array]:
    """Fits, each to its own readings; what each says of every row; and the curvature JᵀJ there."""

    def one(z: Array, weight: Array) -> tuple[fit.Optimum, Observation, Array]:
        data = dataclasses.replace(problem.data, weight=weight)
        found = fit.levenberg_marquardt(problem, z, data, max_steps=60)
        jacobian, seen = jax.jacfwd(lambda z: _informed(problem, z, data), has_aux=True)(found.z)
        return found, seen, jacobian.T @ jacobian

    return jax.vmap(one)(starts, counts)


def _informed(problem: Problem, z: Array, data: fit.Data) -> tuple[Array, Observation]:
    seen = problem.observation(z)
    both = jnp.concatenate([problem.whitened(seen, data), z - data.centre])
    return both[fit.informing(data)], seen


@dataclasses.dataclass(frozen=True)
class Discrepancy:
    """A discrepancy that was located, as a smooth curve fitted together with the base.

    Attributes:
        balance, variable, unit: where it is, over what, and the unit of the balance.
        effect: name of the curve among the effects of `robot`, the fitted robot that has it.
        defect: of the balance, by row of the table, at the base fit.
        grid: of the variable [SI]; curve, sd: there [unit], shape (points,); the 95 % band is ±1.96 sd. The
            band holds what these data and the priors leave open, so it is wide where base parameters can
            take the place of the curve.
        chi2: twice the objective before and after [σ²], priors included.
        z, covariance: posterior of the coordinates of `problem`, the ordinates last.
        problem: in which it was fitted.
        reading: what the robot says of every row of the table [SI], shape (rows, 3).
        converged: whether the fit is an optimum.
        proposal: a formula for it.
    """

    balance: str
    variable: str
    unit: str
    effect: str
    robot: Robot
    defect: Defect
    grid: np.ndarray
    curve: np.ndarray
    sd: np.ndarray
    chi2: tuple[float, float]
    z: np.ndarray
    covariance: np.ndarray
    problem: Problem
    reading: np.ndarray
    converged: bool
    proposal: Proposal


def discover(loop: Loop, base: Hypothesis, linear: Linear, balance: str, variable: str) -> Discrepancy:
    """The discrepancy of a balance over a variable: its defects, its curve, a formula.

    Args:
        loop: as it stands after the base fit, with rows that do not count set aside.
        base: the fit that leaves it; linear: the same linearised, from `loop.look`.
        balance: one of `curves.BALANCES`; variable: one of `curves.VARIABLES`, or of `curves.ORDERS`.
    """
    rows, counts = len(loop.runs), loop.counts
    at_base = smooth(linear, balance, variable, counts)
    problem, inner = _with_curve(loop, base, at_base)
    starts = np.zeros((BATCH, len(inner) + len(at_base.ordinates)))
    starts[:, : len(inner)] = base.z[: len(inner)]
    starts[:, len(inner) :] = np.linspace(1.0, 0.0, BATCH)[:, None] * at_base.start
    found, seen, curvature = jax.device_get(_fits(problem, starts, np.repeat(loop.weight[None], BATCH, 0)))
    k = int(np.argmin(np.where(np.isfinite(found.cost), found.cost, np.inf)))
    z, covariance = found.z[k], np.linalg.inv(curvature[k])
    grid = np.linspace(at_base.low, at_base.high, POINTS)
    shape = at_base.scale * at_base.basis(grid) @ at_base.root
    ordinates = covariance[len(inner) :, len(inner) :]
    # One by one the samples of a history say little, and there are thousands.
    nothing = np.full(rows, np.nan)
    lacking = Defect(nothing, nothing) if loop.engine.series else defect(linear, balance)
    return Discrepancy(
        balance=balance,
        variable=variable,
        unit=BALANCES[balance][0],
        effect=at_base.effect,
        robot=_present(problem.robot(jnp.asarray(z)), loop, base, at_base.effect),
        defect=Defect(lacking.value[:rows], lacking.sd[:rows]),
        grid=grid,
        curve=shape @ z[len(inner) :],
        sd=np.sqrt(np.einsum("ij,jk,ik->i", shape, ordinates, shape)),
        chi2=(2 * base.cost, 2 * float(found.cost[k])),
        z=z,
        covariance=covariance,
        problem=problem,
        reading=seen.reading[k][:rows],
        converged=bool(found.converged[k]),
        proposal=propose(linear, balance, counts, at_base),
    )


def held_out(loop: Loop, found: Discrepancy, blocks: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Readings of each block's rows by the fit with the curve that has not seen them; as `Loop.held_out`.

    Args:
        blocks: masks of rows, shape (rows of the table,) each.

    Returns:
        Readings [SI], NaN where no block holds the row or the fit cannot reach it, shape (rows, 3); and which
        blocks' fits converged.
    """
    rows = len(loop.runs)
    reading, converged = np.full((rows, 3), np.nan), []
    for first in range(0, len(blocks), BATCH):
        part = list(blocks[first : first + BATCH])
        fill = part + [part[0]] * (BATCH - len(part))
        out = np.stack([np.concatenate([m, np.zeros(len(loop.counts) - rows, bool)]) for m in fill])
        starts = np.repeat(found.z[None], BATCH, 0)
        best, seen, _ = jax.device_get(_fits(found.problem, starts, loop.weight * ~out[:, :, None]))
        converged += list(best.converged[: len(part)])
        for k, mask in enumerate(part):
            lost = found.problem.unreachable(seen.status[k])[:rows, None]
            reading[mask] = np.where(lost, np.nan, seen.reading[k][:rows])[mask]
    return reading, np.asarray(converged)


def _with_curve(loop: Loop, base: Hypothesis, curve: Smooth) -> tuple[Problem, Coordinates | Slots]:
    """The problem of the base and a curve, and the coordinates of the base in it."""
    problem = loop.problem_of(base) if base.effects else loop.problem
    # A robot that has this curve from an earlier round keeps one of them: the names are its parameters'.
    kept = tuple(e for e in problem.base.effects if e.name != curve.effect)
    added = UNNAMED[curve.effect](**{n: jnp.asarray(v) for n, v in curve.values.items()})
    robot = dataclasses.replace(problem.base, effects=(*kept, added))
    inner = problem.coordinates
    names = tuple(f"effects.{curve.effect}.{n}" for n in curve.ordinates)
    shaped = Shaped(inner, jnp.asarray(curve.root), names)  # type: ignore[arg-type]
    data = dataclasses.replace(problem.data, weight=jnp.asarray(loop.weight), centre=jnp.zeros(len(shaped)))
    return dataclasses.replace(problem, base=robot, coordinates=shaped, data=data), inner  # type: ignore[return-value]


def _present(robot: Robot, loop: Loop, base: Hypothesis, curve: str) -> Robot:
    """The robot with the effects that are in it: its own, those of the fit, the curve."""
    names = {e.name for e in loop.problem.base.effects} | {loop.engine.names[k] for k in base.effects} | {curve}
    return dataclasses.replace(robot, effects=tuple(e for e in robot.effects if e.name in names))


# --- a formula ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Ratio:
    """A signal over a fixed value of its unit: dimensionless. `unit` is that value as text."""

    symbol: str
    unit: str
    of: str
    over: float

    def __call__(self, signals: Signals, rows: int) -> np.ndarray:
        x = np.broadcast_to(np.asarray(getattr(signals, self.of), float), (rows,))
        return (np.sin(x) if self.of == "slope" else x) / self.over


RATIOS = (
    Ratio("ω_m", "700 rad/s", "speed_motor", 700.0),
    Ratio("I", "2 A", "current", 2.0),
    Ratio("U", "24 V", "voltage", 24.0),
    Ratio("sin α", "0.1", "slope", 0.1),
    Ratio("m_c", "5 kg", "payload", 5.0),
)
#: Rise of the BIC for each variable but the one that the curve is over: one of so many is looked for.
FOREIGN = 2 * float(np.log(len(RATIOS)))


@dataclasses.dataclass(frozen=True)
class Monomial:
    """A product of powers of ratios: (index into RATIOS, exponent) of each factor."""

    factors: tuple[tuple[int, float], ...]

    @property
    def complexity(self) -> float:
        """What makes it harder to believe: factors, and exponents other than one."""
        return sum(1 + 0.1 * abs(p - 1) for _, p in self.factors)

    @property
    def variables(self) -> tuple[str, ...]:
        """Signals that it depends on."""
        return tuple(RATIOS[k].of for k, _ in self.factors)

    def __str__(self) -> str:
        said = (f"({RATIOS[k].symbol}/{RATIOS[k].unit})" + (f"^{p:g}" if p != 1 else "") for k, p in self.factors)
        return " ".join(said)


def dictionary(ratios: np.ndarray) -> dict[Monomial, np.ndarray]:
    """Monomials that can be written down for these ratios, with their values by row.

    A root needs ratios that are never negative, an inverse ones that stay off zero; a ratio that does not vary
    is left out, as is all but the first of monomials that are proportional to each other here.

    Args:
        ratios: shape (rows, ratios).
    """
    low, high = ratios.min(0), ratios.max(0)
    lively = [k for k in range(ratios.shape[1]) if high[k] - low[k] > 1e-6 * max(abs(high[k]), abs(low[k]), 1e-9)]

    def safe(k: int, p: float) -> bool:
        if p < 0:
            return low[k] > SAFE * high[k]
        return low[k] >= 0 or p == int(p)

    single = [((k, p),) for k in lively for p in POWERS if safe(k, p)]
    double = [
        ((j, p), (k, q))
        for j, k in itertools.combinations(lively, 2)
        for p, q in itertools.product(POWERS_PRODUCT, repeat=2)
        if safe(j, p) and safe(k, q)
    ]
    found: dict[Monomial, np.ndarray] = {}
    directions: list[np.ndarray] = []
    for factors in sorted(single + double, key=lambda f: Monomial(f).complexity):
        value = np.prod([ratios[:, k] ** p for k, p in factors], 0)
        norm = np.linalg.norm(value)
        if norm > 0 and not any(abs(value @ d) > (1 - 1e-9) * norm for d in directions):
            found[Monomial(factors)] = value
            directions.append(value / norm)
    return found


@dataclasses.dataclass(frozen=True)
class Proposal:
    """A formula for a discrepancy, by sparse regression over a dictionary of dimensionless monomials.

    Attributes:
        formula: e.g. `ΔU = 0.42 V (I/2 A)^2 (U/24 V)`; mark: that it is a proposal.
        terms: its monomials; coefficients, sds: of each [unit of the balance].
        variables: signals that it depends on, without repeats.
        explained: fall of χ² at the base fit.
        gain: BIC of the smooth curve less that of the formula; positive speaks for the formula.
        tried: size of the dictionary: the more, the less a formula that stands out means.
    """

    formula: str
    terms: tuple[Monomial, ...]
    coefficients: tuple[float, ...]
    sds: tuple[float, ...]
    variables: tuple[str, ...]
    explained: float
    gain: float
    tried: int
    mark: str = MARK


def propose(linear: Linear, balance: str, counts: np.ndarray, curve: Smooth) -> Proposal:
    """The formula of at most two terms with the least BIC; a simpler one where that costs no evidence.

    Forward selection from every first term, with the seconds that help it most, so that a pair is not lost
    because neither of it is the best alone. A variable other than the curve's has to earn its place.

    Args:
        counts: whether a row counts, shape (rows,); curve: what the formula is weighed against.
    """
    if curve.wave:
        return _harmonic(balance, curve)
    if curve.variable == "time":
        return _decay(linear, balance, counts, curve)
    rows = len(counts)
    ratios = np.stack([r(linear.signals, rows) for r in RATIOS], 1)  # type: ignore[arg-type]
    known = dictionary(ratios[counts])
    terms = list(known)
    shapes = np.zeros((rows, len(terms)))
    for k, value in enumerate(known.values()):
        shapes[counts, k] = value
    a, b = Projection(linear)(_columns(linear, balance, shapes))
    scale = np.sqrt(np.maximum(np.diag(a), 0))
    visible = scale > 1e-3 * np.linalg.norm(_columns(linear, balance, shapes), axis=0)
    scale = np.where(visible, scale, 1.0)
    a, b = a / scale / scale[:, None], np.where(visible, b / scale, 0.0)
    cost = np.log(3 * counts.sum())
    one = b**2
    cosine = np.where(visible[:, None] & visible, a, 0.0)
    apart = 1 - cosine**2
    two = np.where(
        apart > 1e-2, (one[:, None] + one - 2 * cosine * b[:, None] * b) / np.maximum(apart, 1e-2), one[:, None]
    )
    ranked: list[tuple[tuple[int, ...], float]] = [((int(k),), cost - one[k]) for k in np.flatnonzero(visible)]
    for (k,), _ in tuple(ranked):
        second = [int(j) for j in np.argsort(-two[k])[:SECONDS] if j != k and two[k, j] > one[k]]
        ranked += [((k, j), 2 * cost - two[k, j]) for j in second]
    if not ranked:
        return Proposal("none: no term shows in these data", (), (), (), (), 0.0, 0.0, len(terms))
    located = {SAME_AS.get(curve.variable, curve.variable)}
    foreign = [len({v for k in chosen for v in terms[k].variables} - located) for chosen, _ in ranked]
    dear = [bic + FOREIGN * n for (_, bic), n in zip(ranked, foreign, strict=True)]
    near = [c for c, bic in zip(ranked, dear, strict=True) if bic < min(dear) + NO_EVIDENCE]
    chosen, bic = min(near, key=lambda c: (sum(terms[k].complexity for k in c[0]), c[1]))
    part = np.ix_(chosen, chosen)
    inverse = np.linalg.inv(a[part])
    value = inverse @ b[list(chosen)] / scale[list(chosen)]
    sd = np.sqrt(np.diag(inverse)) / scale[list(chosen)]
    unit = BALANCES[balance][0]
    picked = tuple(terms[k] for k in chosen)
    said = " ".join(
        f"{'-' if v < 0 else '+' if i else ''}{' ' if i else ''}{abs(v):.2g} {unit} {t}"
        for i, (v, t) in enumerate(zip(value, picked, strict=True))
    )
    return Proposal(
        formula=f"{SYMBOL[balance]} = {said}",
        terms=picked,
        coefficients=tuple(map(float, value)),
        sds=tuple(map(float, sd)),
        variables=tuple(dict.fromkeys(v for t in picked for v in t.variables)),
        explained=float(len(chosen) * cost - bic),
        gain=float(curve.freedom * cost - curve.explained - bic),
        tried=len(terms),
    )


def _harmonic(balance: str, curve: Smooth) -> Proposal:
    """A wave is its own formula."""
    sine, cosine = curve.scale * curve.root @ curve.start
    size, phase = float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
    order, unit = ORDERS[curve.variable][0], BALANCES[balance][0]
    formula = (
        f"{SYMBOL[balance]} = {size:.2g} {unit} sin({order:.3g} θ_k {'-' if phase < 0 else '+'} {abs(phase):.2g})"
    )
    return Proposal(formula, (), (size,), (float("nan"),), ("angle of the driving shaft",), curve.explained, 0.0, 1)


def _decay(linear: Linear, balance: str, counts: np.ndarray, curve: Smooth) -> Proposal:
    """What fades with the time since the start: an exponential, its time constant from a grid over the length of the
    runs. A level beside it is left to the base."""
    t = _seen(linear, "time")
    constants = np.geomspace(0.02, 2.0, 40) * max(float(t[counts].max()), 1e-9)
    best: tuple[float, tuple] = (np.inf, ())
    project, cost = Projection(linear), np.log(3 * counts.sum())
    for tau in constants:
        a, b = project(_columns(linear, balance, np.exp(-t / tau)[:, None] * counts[:, None]))
        if a[0, 0] > 0 and 2 * cost - b[0] ** 2 / a[0, 0] < best[0]:
            best = 2 * cost - b[0] ** 2 / a[0, 0], (tau, b[0] / a[0, 0], a[0, 0] ** -0.5)
    if not best[1]:
        return Proposal("none: no term shows in these data", (), (), (), (), 0.0, 0.0, len(constants))
    tau, value, sd = best[1]
    formula = f"{SYMBOL[balance]} = {value:.2g} {BALANCES[balance][0]} exp(-t / {tau:.2g} s)"
    gain = float(curve.freedom * cost - curve.explained - best[0])
    return Proposal(
        formula, (), (float(value),), (float(sd),), ("time",), float(2 * cost - best[0]), gain, len(constants)
    )
