"""Plain selection on the tables of `loop.py`: stepwise by AICc and by BIC over the same library, and PySINDy.

    python benchmarks/loop_baselines.py --clean 40 --library 66 --outside 36 --pairs 30 --jobs 2

Tables, priors and fits are the loop's. Only the selection of effects is plain. PySINDy comes with the extra
`bench`. Every table is one line of `--out`, and a restarted run continues where it ended.
"""

from __future__ import annotations

import dataclasses
import time
import warnings

import loop
import numpy as np
from campaign import Task, begun, campaign
from loop_scores import MIMIC, interval
from worlds import tables

KINDS = ("clean", "library", "outside", "pairs")
#: Number of effects that are refitted for each fit, the same as in the loop.
BATCH = 16
#: Thresholds of a coefficient, for columns and target with an rms of 1.
THRESHOLDS = tuple(np.geomspace(0.02, 20.0, 40))
#: Share of a signature's norm below which an equation does not show an effect.
UNSEEN = 1e-3
METHODS = {
    "aicc": "stepwise AICc",
    "bic": "stepwise BIC",
    "sindy": "PySINDy on the defects",
    "sindy_refit": "PySINDy, constants refitted",
}


# --- stepwise -------------------------------------------------------------------------------------------


def aicc(chi2: float, k: int, n: int) -> float:
    """Akaike's criterion for small samples (Hurvich and Tsai 1989)."""
    return chi2 + 2 * k + 2 * k * (k + 1) / (n - k - 1)


def bic(chi2: float, k: int, n: int) -> float:
    """Schwarz's criterion (1978)."""
    return chi2 + k * np.log(n)


class Ladder:
    """Fits of sets of effects, each computed once.

    Args:
        runs: the table.
        fitted: its base fit.
        settings: of the loop.
    """

    def __init__(self, runs, fitted, settings) -> None:
        from calibration.discovery.outliers import bases_at_fit

        self.space, self.base, self.settings = fitted.space, fitted.candidate, settings
        self.bases = bases_at_fit(runs, fitted)
        self.fitted: dict = {self.base.key: self.base}
        self.looks: dict = {}

    def look(self, candidate) -> tuple:
        """A fit linearised, and the scores of the library at it."""
        import jax
        import jax.numpy as jnp

        from calibration.discovery.score_tests import diagnose_fit

        if candidate.key not in self.looks:
            problem, z = self.space.problem(candidate.active), jnp.asarray(candidate.z)
            seen = diagnose_fit(problem, z, self.space.library.scored, self.bases)
            self.looks[candidate.key] = jax.device_get(seen)[:2]
        return self.looks[candidate.key]

    def beside(self, candidate) -> list:
        """Fits with one effect more: the strongest by the score test, as many as the loop itself refits."""
        from calibration.discovery.candidates import fill_slots, fit_candidates, start_of_fit

        space, settings, scores = self.space, self.settings, self.look(candidate)[1]
        strength = space.library.largest(np.abs(np.asarray(scores.single)))
        strength[list(space.coordinates.indices(candidate.effects))] = -1.0
        names = [space.library.names[k] for k in np.argsort(-strength)[:BATCH]]
        wanted = [fill_slots([*candidate.effects, name], settings) for name in names]
        new = [w for w in wanted if frozenset(w) - {""} not in self.fitted]
        found = fit_candidates(space, [(w, start_of_fit(space, candidate, w, scores)) for w in new])
        self.fitted |= {c.key: c for c in found}
        return [self.fitted[frozenset(w) - {""}] for w in wanted]


def stepwise(ladder: Ladder, criterion) -> list[str]:
    """Adds effects one by one, each with the lowest criterion, while it falls and slots are left.

    Args:
        criterion: of χ² with priors, free parameters and readings. A free parameter is a constant of the base,
            an amplitude or a shape.
    """
    space = ladder.space
    n = int(np.sum(space.weight > 0))
    shaped = dict(zip(space.coordinates.names, map(bool, space.coordinates.shapes), strict=True))

    def value(candidate) -> float:
        k = space.free + sum(1 + shaped[name] for name in candidate.effects)
        return criterion(2 * candidate.cost, k, n)

    best = ladder.base
    while len(best.effects) < ladder.settings.slots:
        further = min(ladder.beside(best), key=value)
        if value(further) >= value(best):
            break
        best = further
    return list(best.effects)


# --- PySINDy --------------------------------------------------------------------------------------------


def sparse(theta: np.ndarray, target: np.ndarray, known: bool) -> np.ndarray:
    """Columns that STLSQ keeps at the threshold of the lowest BIC, possibly none.

    Args:
        theta: columns, shape (points, columns).
        target: shape (points,).
        known: True if the target's noise has an sd of 1, else BIC uses that of the residual.
    """
    n = len(target)

    import pysindy  # of the extra `bench`

    def value(support: np.ndarray) -> float:
        left = target
        if support.any():
            left = target - theta[:, support] @ np.linalg.lstsq(theta[:, support], target, rcond=None)[0]
        rss = float(left @ left)
        return (rss if known else n * np.log(rss / n)) + support.sum() * np.log(n)

    x = theta / np.sqrt(np.mean(theta**2, 0))
    y = target / np.sqrt(np.mean(target**2))
    supports = [np.zeros(theta.shape[1], bool)]
    for threshold in THRESHOLDS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of thresholds that leave no column
            found = pysindy.STLSQ(threshold=threshold).fit(x, y[:, None])
        supports.append(np.ravel(found.coef_) != 0)
    return min(supports, key=value)


def strongest(space, scores) -> list[int]:
    """Instance of every effect at the shape with the strongest score."""
    return [space.library.best_instance(name, scores.single) for name in space.library.names]


def sindy(space, linear, scores) -> list[str]:
    """STLSQ on the defect of each of the three equations, over the effects' unit terms.

    A term of another balance, or of an instrument, is replaced by the defects that change the readings equally.
    """
    from calibration.inference.linearization import PROBED
    from calibration.inference.observers.settled import EQUATIONS

    rows, at = space.included, strongest(space, scores)
    whole = np.asarray(linear.signatures)[:, at]
    signatures = whole.reshape(len(rows), -1, len(at))[rows]  # valid rows, channels, effects
    sensitivity = np.stack([np.asarray(linear.defects)[PROBED.index(b)][rows] for b in EQUATIONS], 2)
    terms = np.linalg.solve(sensitivity, signatures)  # rows, equations, effects
    lacks = -np.linalg.solve(sensitivity, np.asarray(linear.by_row())[rows][..., None])[..., 0]
    names: set[str] = set()
    size = np.sqrt(np.sum(signatures**2, (0, 1)))
    for k in range(len(EQUATIONS)):
        moved = np.sqrt(np.sum((sensitivity[:, :, k, None] * terms[:, None, k]) ** 2, (0, 1)))
        seen = np.flatnonzero(moved > UNSEEN * np.maximum(size, 1e-12))
        kept = sparse(terms[:, k, seen], lacks[:, k], known=False)
        names |= {space.library.names[j] for j in seen[kept]}
    return sorted(names)


def sindy_refit(space, linear, scores, sees=None) -> list[str]:
    """STLSQ on all three equations together, weighted by the readings' sds. The constants are refitted too.

    Both sides are the residuals of a linear refit of the constants (Frisch, Waugh and Lovell).

    Args:
        sees: mask of the residuals to use. None: all.
    """
    jacobian, residual = np.asarray(linear.jacobian), np.asarray(linear.residual)
    theta = np.zeros((len(residual), len(space.library)))
    theta[: linear.readings] = np.asarray(linear.signatures)[:, strongest(space, scores)]
    if sees is not None:
        jacobian, residual, theta = jacobian[sees], residual[sees], theta[sees]
    root = np.linalg.qr(jacobian)[0]
    left, target = theta - root @ (root.T @ theta), residual - root @ (root.T @ residual)
    seen = np.linalg.norm(left, axis=0) > UNSEEN * np.maximum(np.linalg.norm(theta, axis=0), 1e-12)
    counts = np.abs(target) + np.abs(left[:, seen]).sum(1) > 0  # padding rows are zero
    kept = sparse(left[counts][:, seen], -target[counts], known=True)
    return [space.library.names[j] for j in np.flatnonzero(seen)[kept]]


# --- the campaign ---------------------------------------------------------------------------------------


def base_of(given):
    """The base fit of the result of `prepare_loop`, with which the loop begins: `candidates.BaseFit`."""
    from calibration.discovery.candidates import fit_base
    from calibration.discovery.loop_input import build_candidate_space

    space = build_candidate_space(
        given.runs, given.robot, given.noise.sd, given.settings, given.stated, given.library
    )
    return fit_base(space, given.runs.source)


def work(task: Task) -> dict:
    """Makes a case and lists the names that each method finds, in a worker."""
    case = loop.attempt(task.kind, task.seed, narrow=True)
    if isinstance(case, str):
        return {"skipped": case}
    began = time.perf_counter()
    given = begun(case, task, loop.STATED)
    fitted = base_of(given)
    space, ladder = fitted.space, Ladder(given.runs, fitted, given.settings)
    linear, scores = ladder.look(ladder.base)
    named = {
        "aicc": stepwise(ladder, aicc), "bic": stepwise(ladder, bic),
        "sindy": sindy(space, linear, scores), "sindy_refit": sindy_refit(space, linear, scores),
    }  # fmt: skip
    truth = [
        {**{k: e[k] for k in ("name", "class", "balance", "sigmas", "sizes")}, **o}
        for e, o in zip(case.label["effects"], tables.oracle(case), strict=True)
    ]
    return {
        "seconds": time.perf_counter() - began, "truth": truth, "fits": len(ladder.fitted), "named": named,
    }  # fmt: skip


def alike(truth: dict) -> set[str]:
    """Effects that noise-free data could not distinguish from the truth, including itself."""
    return {truth["class"], *truth["class_oracle"]}


def summary(lines: list[dict]) -> list[str]:
    """The figures of every method."""
    out = []
    for method, words in METHODS.items():
        there = [x for x in lines if method in x.get("named", {})]
        if not there:
            continue
        out.append(f"--- {words}")

        def say(what: str, those: list[dict], hit) -> None:
            out.append(f"{what:64s} {interval(sum(map(bool, map(hit, those))), len(those))}")

        def of(kind: str, there=there) -> list[dict]:
            return [x for x in there if x["kind"] == kind]

        def names(x: dict, method=method) -> list[str]:
            return x["named"][method]

        def right(x: dict) -> bool:
            return len(names(x)) == 1 and names(x)[0] in alike(x["truth"][0])

        def both(x: dict) -> bool:
            (a, b), one = (alike(t) for t in x["truth"]), names(x)
            return len(one) == 2 and any(one[i] in a and one[1 - i] in b for i in (0, 1))

        def holds(x: dict) -> bool:
            return all(alike(t) & set(names(x)) for t in x["truth"])

        say("clean: a false finding", of("clean"), names)
        library, outside = of("library"), of("outside")
        say("library: one effect, and it is of the truth's noise-free class", library, right)
        sole = [x for x in library if len(x["truth"][0]["class_oracle"]) == 1]
        say("  the same, where that class is the truth alone", sole, right)
        say("  one of the class among those named", library, holds)
        say("  two or more effects named", library, lambda x: len(names(x)) > 1)
        say("  nothing named", library, lambda x: not names(x))
        free = [x for x in outside if x["truth"][0]["best_other"] >= MIMIC]
        say("outside: a wrong name named", outside, names)
        say("  the same without a mimic", free, names)
        say("  without a mimic: one wrong name", free, lambda x: len(names(x)) == 1)
        say("pairs: two effects, one of each class", of("pairs"), both)
        say("  both classes among those named", of("pairs"), holds)
        for kind in KINDS:
            if of(kind):
                out.append(f"{kind}: effects named, mean {np.mean([len(names(x)) for x in of(kind)]):.2f}")
    spent = [x["seconds"] for x in lines if "seconds" in x]
    done = {k: sum(x["kind"] == k and "named" in x for x in lines) for k in KINDS}
    out.append(
        f"tables {done}, skipped {sum('skipped' in x for x in lines)}, errors {sum('error' in x for x in lines)}"
    )
    if spent:
        out.append(f"seconds a table, all methods: median {np.median(spent):.2f}, mean {np.mean(spent):.2f}")
    return out


def program(task: Task) -> tuple | dict:
    """Properties that tables with the same programs share, as for the loop's narrow tables."""
    return loop.program(dataclasses.replace(task, narrow=True))


if __name__ == "__main__":
    campaign(__doc__, KINDS, work, program, summary, "runs/baselines.jsonl")
