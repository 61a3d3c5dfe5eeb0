"""Test for residuals of a fit that differ between levels of a column that the model does not use.

A column that the model does not read may still explain differences: the idle wheel, the operator, the
battery. For each channel a variance ratio (Seber and Lee, Linear Regression Analysis (2003), 4.3) compares the
residuals over the levels of each such column. It does so over all rows, within the levels of each label of the
conditions, and with opposite signs in the two directions of travel. Columns of many numbers enter by their ranks.
Free parameters, labels and smooth curves over the conditions are first projected out on both sides. The significance
is family-wise over all columns, channels and tests. It is limited by Bonferroni and by the strongest test of permuted
residuals (Freedman and Lane 1983), so that neither few rows nor outliers cause a finding.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Iterator, Sequence
from datetime import datetime

import numpy as np
from scipy.special import fdtrc

from calibration.data import Columns, Names
from calibration.data.runs import CONDITIONS, WHEN, Runs
from calibration.described import describe
from calibration.inference.lack_of_fit import CLEAR, Residuals

#: Family-wise probability of reporting a cluster if there is none.
LEVEL = 0.005
#: Most distinct numbers of a column for them to be levels.
LEVELS = 12
#: Fewest rows (of histories: runs) of a channel, and fewest degrees of freedom after a test.
FEWEST, LEAST = 8, 5
#: Number of permutations; most numbers in memory at once.
PERMUTATIONS, AT_ONCE = 1000, 4_000_000
#: Degree of the curves over the conditions that are projected out, and their largest number as a share of the rows.
DEGREE, SHARE = 2, 1 / 3
#: Share of a column (sine of its angle) that must remain after conditions and parameters for it to be tested.
OWN = 0.3
#: Names of columns with the time of a measurement.
TIMES = re.compile(r"(^|_)(time|date|datetime|timestamp|stamp|epoch|clock)(_|$)", re.IGNORECASE)
#: Share of the differences between levels from which a coarser column is reported to explain most of them [-].
MOSTLY = 0.5


@dataclasses.dataclass(frozen=True)
class LevelMean:
    """Mean residual of the rows at one level of a column.

    Attributes:
        level: level of the column.
        within: level of the label within which it was compared, "" for all rows.
        mean: mean of simulated minus measured [unit of the channel].
        rows: number of rows.
    """

    level: str
    within: str
    mean: float
    rows: int

    @property
    def name(self) -> str:
        """The level, with the label within which it was compared."""
        return f"{self.level} at {self.within}" if self.within else self.level


@dataclasses.dataclass(frozen=True)
class ResidualCluster:
    """Residuals of a channel that depend on a column that the model does not use.

    Attributes:
        column: name of the column.
        channel: channel of the residuals.
        unit: unit of the channel.
        within: label within whose levels the residuals depend on the column, "" for all rows.
        reversing: True if the residuals have opposite signs in the two directions of travel. Means are then of the
            residual times the sign of the reading.
        levels: mean for each level, empty for a numeric column with many values.
        correlation: rank correlation for such a column, otherwise None.
        p: family-wise p-value.
        alike: other columns that explain nothing further about these residuals once this one is known.
        coarser: columns whose levels this one subdivides, with the share of the differences between its levels that
            they explain, if at least `MOSTLY`.
    """

    column: str
    channel: str
    unit: str
    within: str
    reversing: bool
    levels: tuple[LevelMean, ...]
    correlation: float | None
    p: float
    alike: Names
    coarser: tuple[tuple[str, float], ...]

    @property
    def statement(self) -> str:
        """The finding in a sentence."""
        return describe(self)

    def to_json(self) -> dict[str, object]:
        """Entries of `find_residual_clusters` in result.json."""
        document = vars(self) | {"statement": self.statement}
        document |= {"coarser": [{"column": name, "share": share} for name, share in self.coarser]}
        return document


def find_residual_clusters(fit: Residuals, seed: int = 0) -> tuple[ResidualCluster, ...]:
    """Columns that the model does not use that affect the residuals of a fit, the most significant first.

    Args:
        fit: residuals of the fit. For histories, the mean of each run is tested.
        seed: random seed of the permutations.
    """
    residuals = _units_by_run(fit) if fit.runs.sampled else _units_by_row(fit)
    columns = _columns_to_test(residuals)
    if not columns:
        return ()
    tests_by_channel = {k: _tests_of_channel(residuals, k, columns) for k in range(fit.counts.shape[1])}
    tests_with_readings = {k: tests for k, tests in tests_by_channel.items() if tests is not None}
    count = sum(len(channel_tests.tests) for channel_tests in tests_with_readings.values())
    significant = {
        k: [
            (count * float(p[0]), test)
            for test, p in channel_tests.p_values(channel_tests.residuals[:, None])
            if count * p[0] < LEVEL
        ]
        for k, channel_tests in tests_with_readings.items()
    }
    if not any(significant.values()):
        return ()
    # Smallest p-value of all tests for each permutation of the residuals.
    random = np.random.default_rng(seed)
    longest = max(len(channel_tests.residuals) for channel_tests in tests_with_readings.values())
    permutations = max(PERMUTATIONS // 4, min(PERMUTATIONS, AT_ONCE // longest))
    strongest = np.ones(permutations)
    for channel_tests in tests_with_readings.values():
        permuted = random.permuted(np.repeat(channel_tests.residuals[:, None], permutations, 1), axis=0)
        for _, p_values in channel_tests.p_values(channel_tests.project_out(permuted)):
            strongest = np.minimum(strongest, p_values)
    floor = 1 / (1 + len(strongest))
    answer: list[ResidualCluster] = []
    for k, channel_tests in tests_with_readings.items():
        chances = [(p, test, floor * (1 + int(np.sum(strongest <= p / count)))) for p, test in significant[k]]
        candidates = sorted(((p if c <= floor else max(p, c)), test) for p, test, c in chances if c <= LEVEL)
        comparisons: list[tuple[float, _Comparison, list[str]]] = []
        for p, test in _coarse_first(candidates, columns):
            if any(test.column in (t.column, *names) for _, t, names in comparisons):
                continue
            explaining = next(
                (t for t in comparisons if channel_tests.p_value_after(test, t[1]) * count >= LEVEL), None
            )
            if explaining is None:
                comparisons.append((p, test, []))
            else:
                explaining[2].append(test.column)
        answer += [_report_cluster(residuals, k, test, p, tuple(names)) for p, test, names in comparisons]
    return tuple(sorted(answer, key=lambda c: c.p))


def _coarse_first(findings: list[tuple[float, _Comparison]], columns: Columns) -> list[tuple[float, _Comparison]]:
    """Findings by their p-values, but with each column before any finer subdivision of its levels."""
    words = {test.column: _column_as_words(columns[test.column]) for _, test in findings}
    level_columns = {name for name in words if not _is_numeric(columns[name])}
    ordered: list[tuple[float, _Comparison]] = []
    waiting = list(findings)
    while waiting:
        name = waiting[0][1].column
        coarser = [
            finding
            for finding in waiting
            if name in level_columns and _determines(words[name], words[finding[1].column])
        ]
        ordered.append((coarser or waiting)[0])
        waiting = [finding for finding in waiting if finding is not ordered[-1]]
    return ordered


def _determines(fine: np.ndarray, coarse: np.ndarray) -> bool:
    """True if each level of `fine` determines the level of `coarse`, which has fewer levels."""
    pairs, fine_levels, coarse_levels = _level_counts(fine, coarse)
    return coarse_levels < fine_levels == pairs


def _level_counts(one: np.ndarray, other: np.ndarray) -> tuple[int, int, int]:
    """Numbers of pairs of levels of two columns, and of levels of each."""
    return len(set(zip(one.tolist(), other.tolist(), strict=True))), len(np.unique(one)), len(np.unique(other))


# --- tests ----------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _ResidualUnits:
    """Units that are compared: settled rows, or runs of a history.

    Attributes:
        runs: table of the units.
        counts: True for included readings.
        whitened: residuals.
        jacobian: derivatives of the residuals with respect to the free parameters, shape (units, channels,
            parameters).
        residual, simulated: residuals and simulated readings [SI].
        covariance: covariance of z, (JᵀJ + 1)⁻¹.
    """

    runs: Runs
    counts: np.ndarray
    whitened: np.ndarray
    jacobian: np.ndarray
    residual: np.ndarray
    simulated: np.ndarray
    covariance: np.ndarray


def _units_by_row(fit: Residuals) -> _ResidualUnits:
    jacobian = np.where(fit.counts[..., None], fit.jacobian.reshape(*fit.counts.shape, -1), 0.0)
    flat = jacobian.reshape(fit.counts.size, -1)
    covariance = np.linalg.inv(flat.T @ flat + np.eye(flat.shape[1]))
    residual = np.where(fit.counts, fit.simulated - fit.runs.measured(), np.nan)
    return _ResidualUnits(fit.runs, fit.counts, fit.whitened, jacobian, residual, fit.simulated, covariance)


def _units_by_run(fit: Residuals) -> _ResidualUnits:
    """Mean of each run as a unit. Whitened means are multiplied by the square root of the number of samples, so that
    their noise has sd 1.
    """
    rows = _units_by_row(fit)
    run = fit.runs.run_names
    _, first, run_of = np.unique(run, return_index=True, return_inverse=True)
    member = run_of[:, None] == np.arange(len(first))  # (samples, runs)
    counts = member.T.astype(float) @ rows.counts
    weight = np.sqrt(np.maximum(counts, 1.0))

    def total(x: np.ndarray) -> np.ndarray:
        return np.einsum("sr,sc...->rc...", member.astype(float), np.nan_to_num(x))

    members_by_run = [member[:, r] for r in range(len(first))]
    columns_by_run = {
        c: v[first] for c, v in fit.runs.extras.items() if all(len(np.unique(v[m])) == 1 for m in members_by_run)
    }
    # A condition that changes within a run enters as its mean.
    columns = {
        c: np.array([v[m].mean() for m in members_by_run]) if v.dtype.kind == "f" else v[first]
        for c, v in fit.runs.columns.items()
    }
    mean = np.maximum(counts, 1.0)
    return _ResidualUnits(
        runs=dataclasses.replace(fit.runs, columns=columns, extras=columns_by_run),
        counts=counts > 0,
        whitened=total(rows.whitened) / weight,
        jacobian=total(rows.jacobian) / weight[..., None],
        residual=np.where(counts > 0, total(rows.residual) / mean, np.nan),
        simulated=np.where(counts > 0, total(np.where(rows.counts, rows.simulated, 0.0)) / mean, np.nan),
        covariance=rows.covariance,
    )


def _columns_to_test(units: _ResidualUnits) -> Columns:
    """Columns to test: those with more than one level that are no ids, times or copies of a condition."""
    runs = units.runs
    columns = {}
    # Simulated readings depend only on the conditions.
    conditions = [runs[c] for c in CONDITIONS if runs.has(c)] + list(units.simulated.T)
    for name, cells in runs.extras.items():
        words = _column_as_words(cells)
        levels = np.unique(words[words != ""])
        if len(levels) < 2 or _is_time(name, cells) or _is_id(cells, len(levels)):
            continue
        # An alias of a column has as many pairs of levels as levels.
        is_alias = any(len({*_level_counts(words, role)}) == 1 for role in _columns_with_role(runs))
        if not (is_alias or _are_steps_of_condition(cells, words, conditions)):
            columns[name] = cells
    return columns


def _column_as_words(cells: np.ndarray) -> np.ndarray:
    """Cells of a column as words, "" for empty cells."""
    if cells.dtype.kind == "f":
        return np.array(["" if np.isnan(x) else f"{x:g}" for x in cells])
    return cells.astype(str)


def _columns_with_role(runs: Runs) -> Iterator[np.ndarray]:
    """Columns with a role, except readings and their sds, and the combinations of the labels."""
    readings = {name for c in runs.channels for name in (c.column, c.sd_column)}
    word_columns = {name: v.astype(str) for name, v in runs.columns.items() if name not in readings}
    labels = [word_columns[name] for name in _condition_labels(runs)]
    yield from word_columns.values()
    if len(labels) > 1:
        yield np.array(["|".join(words) for words in zip(*labels, strict=True)])


def _condition_labels(runs: Runs) -> list[str]:
    """Columns of words that describe conditions and have more than one level."""
    return [
        name for name, v in runs.columns.items()
        if v.dtype.kind == "U" and name not in ("run_id", "mode") and len(np.unique(v)) > 1
    ]  # fmt: skip


def _are_steps_of_condition(cells: np.ndarray, words: np.ndarray, conditions: Sequence[np.ndarray]) -> bool:
    """True if the levels of a column divide the values of a condition into intervals that do not overlap."""
    if cells.dtype.kind != "f" or len(np.unique(words)) > LEVELS:
        return False
    for x in conditions:
        finite = np.isfinite(x) & np.isfinite(cells)
        levels = [x[finite & (words == w)] for w in np.unique(words[finite])]
        ends = sorted((level.min(), level.max()) for level in levels)
        if len(ends) > 1 and all(a[1] < b[0] for a, b in itertools.pairwise(ends)):
            return True
    return False


def _is_time(name: str, cells: np.ndarray) -> bool:
    """True if a column is a time, by its name, its words, or because its numbers only rise or only fall."""
    if TIMES.search(name):
        return True
    if cells.dtype.kind == "f":
        steps = np.diff(cells)
        return len(cells) > 2 and bool(np.all(steps > 0) or np.all(steps < 0))
    try:
        for cell in cells[cells != ""]:
            datetime.fromisoformat(str(cell))
    except ValueError:
        return False
    return True


def _is_id(cells: np.ndarray, levels: int) -> bool:
    """True if a column is only a row label: words or whole numbers with as many levels as rows."""
    if cells.dtype.kind == "f":
        return levels == len(cells) and bool(np.all(cells == np.round(cells)))
    return levels > len(cells) / 2


@dataclasses.dataclass(frozen=True, order=True)
class _Comparison:
    """One test of one channel: a column, within the levels of a label or over all rows, and reversed with the travel
    or not.
    """

    column: str
    within: str
    reversing: bool
    basis: np.ndarray = dataclasses.field(compare=False, repr=False)


@dataclasses.dataclass(frozen=True)
class _ChannelTests:
    """Residuals of a channel, transformed to independent values of equal variance, and their tests.

    Attributes:
        residuals: residuals after projecting out conditions and parameters, shape (units,).
        freedom: degrees of freedom of these residuals.
        explained_basis: orthonormal directions of conditions and parameters, shape (units, directions).
        tests: tests, each with an orthonormal basis after the same projection.
    """

    residuals: np.ndarray
    freedom: int
    explained_basis: np.ndarray
    tests: tuple[_Comparison, ...]

    def p_values(self, residuals: np.ndarray) -> list[tuple[_Comparison, np.ndarray]]:
        """p-values of each test for columns of residuals, shape (units, tables)."""
        total = np.sum(residuals**2, 0)
        return [(test, _variance_ratio_test(test.basis, residuals, total, self.freedom)) for test in self.tests]

    def project_out(self, residuals: np.ndarray) -> np.ndarray:
        """Residuals after projecting out conditions and parameters."""
        return residuals - self.explained_basis @ (self.explained_basis.T @ residuals)

    def p_value_after(self, test: _Comparison, other: _Comparison) -> float:
        """p-value of a test after another one is projected out too. 1 if nothing is left to test."""
        basis = _orthonormal_basis(test.basis - other.basis @ (other.basis.T @ test.basis))
        residual = self.residuals - other.basis @ (other.basis.T @ self.residuals)
        freedom = self.freedom - other.basis.shape[1]
        if basis.shape[1] == 0 or freedom - basis.shape[1] < LEAST:
            return 1.0
        return float(_variance_ratio_test(basis, residual[:, None], np.array([residual @ residual]), freedom)[0])


def _variance_ratio_test(basis: np.ndarray, residuals: np.ndarray, total: np.ndarray, freedom: int) -> np.ndarray:
    """p-value (F test) of the part of the residuals that an orthonormal basis explains."""
    terms = basis.shape[1]
    explained = np.sum((basis.T @ residuals) ** 2, 0)
    rest = np.maximum(total - explained, 1e-300) / (freedom - terms)
    return np.asarray(fdtrc(terms, freedom - terms, explained / terms / rest))


def _orthonormal_basis(columns: np.ndarray, least: float = CLEAR) -> np.ndarray:
    """Orthonormal basis of columns, without directions smaller than `least`."""
    if columns.shape[1] == 0:
        return columns
    directions, size, _ = np.linalg.svd(columns, full_matrices=False)
    return directions[:, size > least]


def _tests_of_channel(units: _ResidualUnits, k: int, columns: Columns) -> _ChannelTests | None:
    """Tests of a channel. None if it has too few readings."""
    counts = units.counts[:, k]
    if counts.sum() < FEWEST:
        return None
    runs = units.runs.where(counts)
    # The residuals' covariance is 1 - J (JᵀJ + 1)⁻¹ Jᵀ, which differs from 1 in only a few directions.
    jacobian = units.jacobian[counts, k]
    root = np.linalg.cholesky(units.covariance)
    directions, size, _ = np.linalg.svd(jacobian @ root, full_matrices=False)
    share = np.clip(size**2, 0.0, 1.0)
    is_free = share < 1 - CLEAR
    sd_of_direction = np.where(is_free, np.sqrt(1 - share), 0.0)
    inverse_sd = np.where(is_free, 1 / np.sqrt(np.maximum(1 - share, CLEAR)), 0.0)

    def scaled(x: np.ndarray, factors: np.ndarray) -> np.ndarray:
        return x + directions @ ((factors - 1)[:, None] * (directions.T @ x))

    travel = np.sign(units.simulated[counts, k])
    has_both_directions = min(np.sum(travel > 0), np.sum(travel < 0)) >= 2
    smooth = _condition_columns(runs, units.simulated[counts], travel if has_both_directions else None)
    explained_basis = _orthonormal_basis(
        np.concatenate([directions[:, ~is_free], _unit_columns(scaled(smooth, sd_of_direction))], 1)
    )
    whitened = scaled(units.whitened[counts, k][:, None], inverse_sd)[:, 0]
    projected = whitened - explained_basis @ (explained_basis.T @ whitened)
    freedom = len(projected) - explained_basis.shape[1]
    tests = []
    for name, cells in columns.items():
        for within in ("", *_condition_labels(runs)):
            for reversing in (False, True)[: 1 + has_both_directions]:
                regressors = _comparison_columns(cells[counts], runs[within] if within else None)
                basis = scaled(regressors * travel[:, None] if reversing else regressors, sd_of_direction)
                basis = _orthonormal_basis(_unit_columns(basis))
                basis = _orthonormal_basis(basis - explained_basis @ (explained_basis.T @ basis), OWN)
                if basis.shape[1] and freedom - basis.shape[1] >= LEAST:
                    tests.append(_Comparison(name, within, reversing, basis))
    return _ChannelTests(projected, freedom, explained_basis, tuple(tests)) if tests else None


def _unit_columns(columns: np.ndarray) -> np.ndarray:
    """Columns normalised to length 1, without zero columns."""
    size = np.linalg.norm(columns, axis=0)
    return columns[:, size > 1e-9] / size[size > 1e-9]


def _is_numeric(cells: np.ndarray) -> bool:
    """True if a column is compared by ranks."""
    return cells.dtype.kind == "f" and len(np.unique(cells[np.isfinite(cells)])) > LEVELS


def _centred_ranks(cells: np.ndarray) -> np.ndarray:
    """Ranks minus their mean, 0 for missing numbers."""
    finite = np.isfinite(cells)
    ranks = np.zeros(len(cells))
    if finite.any():
        from scipy.stats import rankdata  # takes a second to import, and is rarely needed

        ranks[finite] = rankdata(cells[finite]) - (finite.sum() + 1) / 2
    return ranks


def _comparison_columns(cells: np.ndarray, within: np.ndarray | None) -> np.ndarray:
    """Regressors of a column: a mean for each of its levels, or a slope over ranks, for each level of `within`."""
    label = np.zeros(len(cells), str) if within is None else within
    if _is_numeric(cells):
        ranks = [_centred_ranks(np.where(label == c, cells, np.nan)) for c in np.unique(label)]
        return np.stack(ranks, 1)
    words = _column_as_words(cells)
    masks = [(words == w) & (label == c) for w in np.unique(words) for c in np.unique(label)]
    return np.stack([b for b in masks if b.any()], 1).astype(float)


def _condition_columns(runs: Runs, simulated: np.ndarray, travel: np.ndarray | None) -> np.ndarray:
    """Regressors of the conditions, shape (units, columns).

    A mean for each set of labels and direction, then smooth curves over conditions and readings, as many as the
    number of rows allows.
    """
    labels = [np.zeros(len(runs), str), *(runs[name] for name in _condition_labels(runs))]
    labels += [] if travel is None else [travel.astype(str)]
    cells = np.array(["|".join(map(str, words)) for words in zip(*labels, strict=True)])
    indicators = np.stack([cells == c for c in np.unique(cells)], 1).astype(float)
    if indicators.shape[1] > SHARE * len(runs):
        indicators = np.ones((len(runs), 1))
    variables = [runs[name] for name in (*CONDITIONS, *WHEN) if runs.has(name)] + list(simulated.T)
    variables = [x for x in variables if np.isfinite(x).all() and np.ptp(x) > 1e-9 * np.abs(x).max()]
    for power in range(1, DEGREE + 1):
        for x in variables:
            scaled = 2 * (x - x.min()) / np.ptp(x) - 1
            added_columns = np.concatenate([indicators, scaled[:, None] ** power], 1)
            if np.linalg.matrix_rank(added_columns, 1e-6 * len(added_columns)) > SHARE * len(runs):
                return indicators
            indicators = added_columns
    return indicators


def _report_cluster(units: _ResidualUnits, k: int, test: _Comparison, p: float, alike: Names) -> ResidualCluster:
    """Finding in the units of its channel."""
    channel, counts = units.runs.channels[k], units.counts[:, k]
    cells = units.runs.extras[test.column][counts]
    residual = units.residual[counts, k] / channel.factor
    signed = residual * np.sign(units.simulated[counts, k]) if test.reversing else residual
    within = units.runs[test.within][counts] if test.within else np.zeros(int(counts.sum()), str)
    words = _column_as_words(cells)
    correlation = None
    words = np.where(words == "", "not stated", words)
    levels: tuple[LevelMean, ...] = ()
    if _is_numeric(cells):
        from scipy.stats import spearmanr

        finite = np.isfinite(cells)
        correlation = float(spearmanr(cells[finite], signed[finite]).statistic)
    else:
        keys = sorted(
            set(zip(within.tolist(), words.tolist(), strict=True)), key=lambda x: (x[0], _level_order(x[1]))
        )
        groups = [(w, c, signed[(within == c) & (words == w)]) for c, w in keys]
        levels = tuple(LevelMean(w, c, float(group.mean()), len(group)) for w, c, group in groups)
    coarser = () if _is_numeric(cells) else _coarser_columns(units, k, test.column, words, within, signed)
    return ResidualCluster(
        test.column, channel.name, channel.unit, test.within, test.reversing, levels, correlation, p, alike, coarser
    )


def _coarser_columns(
    units: _ResidualUnits, k: int, column: str, words: np.ndarray, within: np.ndarray, residual: np.ndarray
) -> tuple[tuple[str, float], ...]:
    """Columns that the column of a finding subdivides and that explain most of its differences."""

    def between(labels: np.ndarray) -> float:
        """Sum of squares between levels, within the levels of the label."""
        total = 0.0
        for c in np.unique(within):
            in_level = within == c
            for w in np.unique(labels[in_level]):
                in_cell = in_level & (labels == w)
                total += in_cell.sum() * (residual[in_cell].mean() - residual[in_level].mean()) ** 2
        return total

    shares = {}
    sum_between_levels = between(words)
    counts = units.counts[:, k]
    for name, cells in units.runs.extras.items():
        if name == column or _is_numeric(cells[counts]):
            continue
        coarse = _column_as_words(cells[counts])
        if len(np.unique(coarse)) > 1 and _determines(words, coarse) and sum_between_levels > 0:
            shares[name] = float(between(coarse) / sum_between_levels)
    return tuple(sorted(((n, x) for n, x in shares.items() if x >= MOSTLY), key=lambda entry: -entry[1]))


def _level_order(word: str) -> tuple[float, str]:
    """Sort key of levels: numbers by size, then words."""
    try:
        return float(word), ""
    except ValueError:
        return float("inf"), word
