"""Methods that predict unseen runs, all with the same folds: our fits, SciPy, MuJoCo, PySINDy, regressions.

Each method gets the same problem (`Posed`): a table, a robot whose constants have the tolerances of its file, and the
folds, which are the blocks of `blocks.predictable_blocks`. It returns readings of every fold by a fit without its
rows.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import loop_baselines
import numpy as np
import plain_drives
from plain_drives import Unable

#: Ridge: penalties, and number of earlier rows of a log among the features.
PENALTIES = np.geomspace(1e-2, 1e4, 25)
WINDOW = 8
#: Boosted trees: number, depth, learning rate, share of the rows of each.
TREES = {"n_estimators": 150, "max_depth": 2, "learning_rate": 0.08, "subsample": 0.8}


@dataclasses.dataclass(frozen=True)
class Fold:
    """A block of runs left out.

    Attributes:
        kind: of the block.
        out: mask of its rows, shape (rows,).
        z: our fit without it.
        reading: of that fit in every row [SI], NaN for rows it does not reach, shape (rows, channels).
    """

    kind: str
    out: np.ndarray
    z: np.ndarray
    reading: np.ndarray


@dataclasses.dataclass(frozen=True)
class Posed:
    """A record in the form that every method gets.

    Attributes:
        given: `prepare_loop`.
        fitted: our base fit, `candidates.BaseFit`.
        folds: the blocks left out.
        measured, sd: [SI], shape (rows, channels).
        counts: True for a fitted reading.
        case: see `Record`.
    """

    given: Any
    fitted: Any
    folds: tuple[Fold, ...]
    measured: np.ndarray
    sd: np.ndarray
    counts: np.ndarray
    case: Any = None
    seed: int = 0

    @property
    def space(self) -> Any:
        """The space of fits, `active_set.CandidateSpace`."""
        return self.fitted.space

    @property
    def channels(self) -> list[str]:
        """Names of the channels."""
        return [channel.name for channel in self.given.runs.channels]


@dataclasses.dataclass(frozen=True)
class Found:
    """Readings of a method.

    Attributes:
        unseen: readings of each fold's rows by a fit without them [SI], one array of shape (rows, channels) per fold.
            Rows of other folds are not read.
        level: the claim, a word for verdicts.
        claims: classes of effects.
        families: mechanisms, or the place.
        seconds: of the claim alone, if that is a part.
        note: to print next to the record.
    """

    unseen: list[np.ndarray]
    level: str = ""
    claims: list[list[str]] = dataclasses.field(default_factory=list)
    families: list[str] = dataclasses.field(default_factory=list)
    seconds: float | None = None
    note: str = ""


def posed(robot: str, table: Any, seed: int, replicates: int, case: Any = None) -> Posed:
    """A record prepared as in `mmrjax loop`, its base fitted to all rows and without each block.

    Args:
        robot: file, or name of a packaged robot.
        table: file of the runs.
        case: of a synthetic rig.

    Raises:
        Unable: a table with an unused column.
    """
    from campaign import ready

    ready()
    from calibration.data import robot_file
    from calibration.data import runs as records
    from calibration.discovery.loop_input import prepare_loop
    from calibration.inference import blocks
    from calibration.inference.blocks import fit_from_each_start

    rig = robot_file.load_robot(robot)
    runs = records.read_runs(table, robot=rig)
    if runs.unknown:
        raise Unable(f"column {runs.unknown[0]} of the record is not used")
    given = prepare_loop(runs, rig, replicates=replicates, seed=seed)
    fitted = loop_baselines.base_of(given)
    space, rows = fitted.space, len(given.runs)
    problem, weight = space.bare, space.weight
    masks = [(kind, m) for kind, by in blocks.predictable_blocks(given.runs, problem).items() for m in by.values()]
    folds: list[Fold] = []
    if masks:
        out = [np.concatenate([m, np.zeros(len(weight) - rows, bool)]) for _, m in masks]
        start = [np.asarray(fitted.candidate.z)[: space.free]] * len(masks)
        best, seen = fit_from_each_start(problem, start, [weight * ~m[:, None] for m in out])
        for k, (kind, mask) in enumerate(masks):
            lost = problem.observe.unreachable(np.asarray(seen.status[k]))[:rows, None]
            reading = np.where(lost, np.nan, np.asarray(seen.reading[k])[:rows])
            folds.append(Fold(kind, mask, np.asarray(best.z[k]), reading))
    data = problem.data
    measured, sd = (np.asarray(x)[:rows] for x in (data.measured, data.sd))
    return Posed(given, fitted, tuple(folds), measured, sd, weight[:rows] > 0, case, seed)


# --- ours -----------------------------------------------------------------------------------------------


def refit(p: Posed) -> Found:
    """Our model without additions, fitted again without each block."""
    return Found([fold.reading for fold in p.folds])


def verdict(p: Posed) -> Found:
    """Our loop: the robot that it writes, and the claim of its verdict."""
    from calibration.discovery.assembly import assemble_result
    from calibration.discovery.discover import trace_verdict

    began, given = time.perf_counter(), p.given
    stages = trace_verdict(given)
    spent = time.perf_counter() - began
    whole = assemble_result(given, stages)
    seen = whole.readings_of_rows.held_out
    at = {kind: after if whole.written else before for kind, (before, after) in seen.items()}
    families = list(stages.families)
    if not families and whole.unnamed is not None:
        families = list(whole.unnamed.families)
    effects = ", ".join(e.name for e in whole.effects)
    return Found(
        [at[fold.kind] for fold in p.folds], whole.verdict, [list(m) for m in stages.members], families, spent,
        f"in the model: {effects or ('a curve' if whole.unnamed is not None and whole.written else 'nothing')}",
    )  # fmt: skip


# --- least squares on the same base -----------------------------------------------------------------------


def scipy_fit(p: Posed) -> Found:
    """`scipy.optimize.least_squares` on independent NumPy physics. Tolerances of the file are residuals too."""
    return _least_squares(p, plain_drives.drive(p.given.runs, p.space.bare.base, p.space.bare.coordinates))


def true_fit(p: Posed) -> Found:
    """Same as `scipy_fit` with the true term of a synthetic rig, its amplitude one more unknown."""
    if p.case is None or not p.case.terms:
        raise Unable("the true term is not known")
    drive = plain_drives.drive(p.given.runs, p.space.bare.base, p.space.bare.coordinates, p.case.terms[0])
    return _least_squares(p, drive)


def _least_squares(p: Posed, drive: Any) -> Found:
    from scipy.optimize import least_squares

    def fitted(counts: np.ndarray, start: np.ndarray) -> np.ndarray:
        def residuals(members: np.ndarray) -> np.ndarray:
            off = (drive.readings(members) - p.measured) / p.sd
            off = np.nan_to_num(off, nan=1e3, posinf=1e3, neginf=-1e3)[:, counts]
            return np.concatenate([off, members[:, : drive.constants]], 1)

        def slopes(z: np.ndarray) -> np.ndarray:
            step = 1e-4
            shown = residuals(np.concatenate([z[None] + step * np.eye(len(z)), z[None] - step * np.eye(len(z))]))
            return ((shown[: len(z)] - shown[len(z) :]) / (2 * step)).T

        return least_squares(lambda z: residuals(z[None])[0], start, slopes, x_scale="jac", max_nfev=40).x

    start = fitted(p.counts, drive.start())
    return Found([drive.readings(fitted(p.counts & ~f.out[:, None], start)[None])[0] for f in p.folds])


def mujoco_fit(p: Posed) -> Found:
    """MuJoCo's identification toolbox on the same base: a hinge with damping, frictionloss and actuators."""
    from mujoco import sysid

    if not hasattr(sysid, "ParameterDict"):  # it imports even without its requirements
        raise Unable("not installed")
    import mujoco_rig

    rig = mujoco_rig.rig(p.given.runs, p.space.bare.base, p.space.bare.coordinates)
    start = rig.fitted(p.measured, p.sd, p.counts)
    unseen = []
    for fold in p.folds:
        theta = rig.fitted(p.measured, p.sd, p.counts & ~fold.out[:, None], start)
        unseen.append(rig.readings(theta))
    return Found(unseen)


# --- sparse regression --------------------------------------------------------------------------------------


def sindy(p: Posed) -> Found:
    """PySINDy on the defects: sparse selection over the library's terms, constants refitted, for each fold.

    Fits are linear at our base fit, by its Jacobian and the library's signatures.
    """
    try:
        import pysindy  # noqa: F401
    except ImportError:
        raise Unable("not installed") from None
    ladder = loop_baselines.Ladder(p.given.runs, p.fitted, p.given.settings)
    linear, scores = ladder.look(ladder.base)
    space = ladder.space
    base = _of_base(p)
    rows, channels = p.measured.shape
    jacobian = np.asarray(linear.jacobian)
    changes = np.asarray(linear.signatures)[:, loop_baselines.strongest(space, scores)]
    residual = np.asarray(linear.residual)
    unseen = []
    for fold in p.folds:
        sees = np.ones(len(residual), bool)
        sees[: rows * channels] = np.repeat(~fold.out, channels)
        kept = loop_baselines.sindy_refit(space, linear, scores, sees)
        columns = np.zeros((len(residual), len(kept)))
        columns[: linear.readings] = changes[:, [space.library.names.index(n) for n in kept]]
        whole = np.concatenate([jacobian, columns], 1)
        step = np.linalg.lstsq(whole[sees], -residual[sees], rcond=None)[0]
        moved = (whole @ step)[: rows * channels].reshape(rows, channels)
        unseen.append(base + moved * p.sd)
    names = loop_baselines.sindy_refit(space, linear, scores)
    families = sorted({space.library[n].family() for n in names})
    return Found(unseen, "named" if names else "none", [[n] for n in names], families)


def _of_base(p: Posed) -> np.ndarray:
    """Readings of our base fit [SI], shape (rows, channels)."""
    from calibration.discovery import prediction

    problem, z, active = p.space.fit_of(p.fitted.candidate.active, p.fitted.candidate.z)
    return np.asarray(prediction.FittedProblem(problem, z, active).observation().reading)[: len(p.measured)]


# --- regressions on what the refit leaves -----------------------------------------------------------------------


def ridge(p: Posed) -> Found:
    """Ridge regression on the refit's residuals: over a window of a log's rows, with squares of a table's."""
    return _regressed(p, _ridge)


def boosted(p: Posed) -> Found:
    """A small gradient-boosted regression on the refit's residuals."""
    try:
        from sklearn.ensemble import GradientBoostingRegressor
    except ImportError:
        raise Unable("not installed") from None

    def trees(x: np.ndarray, y: np.ndarray, there: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        return np.asarray(GradientBoostingRegressor(random_state=p.seed, **TREES).fit(x, y).predict(there))

    return _regressed(p, trees)


#: (Features seen, their target, features to predict, block of each row seen) → predictions.
Regression = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def _regressed(p: Posed, regression: Regression) -> Found:
    unseen = []
    for fold in p.folds:
        block = np.zeros(len(p.measured), int)
        for number, other in enumerate(p.folds, 1):
            if other.kind == fold.kind:
                block[other.out] = number
        x = _features(p, fold.reading)
        shown = fold.reading.copy()
        for k in range(p.measured.shape[1]):
            left = (p.measured[:, k] - fold.reading[:, k]) / p.sd[:, k]
            inside = p.counts[:, k] & ~fold.out & np.isfinite(left) & np.isfinite(x).all(1)
            there = fold.out & np.isfinite(x).all(1)
            if inside.sum() >= 4 and there.any():
                shown[there, k] += p.sd[there, k] * regression(x[inside], left[inside], x[there], block[inside])
        unseen.append(shown)
    return Found(unseen)


def _features(p: Posed, reading: np.ndarray) -> np.ndarray:
    """Features of every row, shape (rows, features), each within -1 and 1.

    Conditions, direction, position in the table and the base's readings. In a log also those of the rows before.
    """
    runs, conditions = p.given.runs, p.given.runs.conditions(p.given.robot)
    names = ("voltage", "slope_deg", "payload", "duty", "motor_speed", "motor_current", "total_mass")
    columns = [np.asarray(x, float) for n in names if (x := getattr(conditions, n)) is not None]
    columns = [x for x in columns if x.shape == (len(runs),)]
    columns += [reading[:, k] for k in range(reading.shape[1])]
    which = np.asarray(conditions.configuration)
    columns += [(which == k).astype(float) for k in np.unique(which)[1:]]
    if not runs.sampled:
        columns.append(np.arange(len(runs), dtype=float))
    here = [x for x in columns if np.ptp(x[np.isfinite(x)], axis=0) > 0] or [np.zeros(len(runs))]
    features = list(here)
    if runs.sampled:
        for back in range(1, WINDOW):
            features += [_before(runs, x, back) for x in here]
    else:
        features += [a * b for i, a in enumerate(_scaled(here)) for b in _scaled(here)[i:]]
        features += [np.sign(x) for x in here if (x < 0).any()]
    return np.stack(_scaled(features), 1)


def _scaled(columns: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [x / max(float(np.nanmax(np.abs(x))), 1e-300) for x in columns]


def _before(runs: Any, x: np.ndarray, back: int) -> np.ndarray:
    """A column shifted by `back` rows within the run of each row. Before that the run's first row."""
    found = np.empty_like(x)
    for rows in runs.rows_by_run().values():
        found[rows] = x[rows[np.maximum(np.arange(len(rows)) - back, 0)]]
    return found


def _ridge(x: np.ndarray, y: np.ndarray, there: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Ridge regression with the penalty that predicts blocks of the seen rows best, by leave-one-block-out.

    Predicts 0 if there is no gain.

    Features beyond the range of the seen rows are limited to it.
    """
    groups = [blocks == k for k in np.unique(blocks)]
    if len(groups) < 3:
        groups = [np.arange(len(y)) % 4 == k for k in range(4)]
    off = np.zeros(len(PENALTIES))
    for out in groups:
        off += np.sum((_ridges(x[~out], y[~out], x[out]) - y[out]) ** 2, 1)
    best = int(np.argmin(off))
    return _ridges(x, y, there)[best] if off[best] < float(y @ y) else np.zeros(len(there))


def _ridges(x: np.ndarray, y: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Predictions at every penalty, shape (penalties, rows)."""
    there = np.clip(there, x.min(0), x.max(0))
    middle, size = x.mean(0), x.std(0)
    use = size > 1e-9
    x, there = ((v[:, use] - middle[use]) / size[use] for v in (x, there))
    left, values, right = np.linalg.svd(x, full_matrices=False)
    about = left.T @ (y - y.mean())
    shrunk = values / (values**2 + PENALTIES[:, None]) * about
    return y.mean() + shrunk @ right @ there.T


#: Methods in their order: cheap ones first, so that a slow one does not block others.
METHODS: dict[str, Callable[[Posed], Found]] = {
    "refit": refit,
    "ridge": ridge,
    "boosted": boosted,
    "scipy": scipy_fit,
    "true": true_fit,
    "sindy": sindy,
    "verdict": verdict,
    "mujoco": mujoco_fit,
}


def quietly(method: Callable[[Posed], Found], p: Posed) -> Found:
    """Calls a method without its warnings."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        return method(p)
