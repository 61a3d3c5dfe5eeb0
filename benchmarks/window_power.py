"""Scores of the true effect in the windows of generated logs, before any simulation. A probe, not kept."""

import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))


def one(task):
    kind, seed = task
    try:
        import campaign as C
        import numpy as np
        import rig_logs as R
        from campaign import Task

        C.ready()
        from calibration.discovery.discover import build_candidate_space
        from calibration.discovery.screening import screen_by_weak_form

        began = time.perf_counter()
        case = R.attempt(kind, seed, "varied")
        if isinstance(case, str):
            return f"{kind} {seed} skip {case}"
        g = C.begun(case, Task(kind, seed, 500, stratum="varied", brief=True))
        space = build_candidate_space(g.runs, g.robot, g.noise.sd, g.settings, g.stated, g.library)
        r = screen_by_weak_form(space, g.settings)
        label = {k: case.label.get(k) for k in ("imposed", "every", "alone", "coarse", "stated")}
        sigmas = [round(e["sigmas"], 1) for e in case.label["effects"]]
        truth = [e["class"] for e in case.label["effects"]]
        if r is None:
            return f"{kind} {seed} {label} none {truth} {sigmas}"
        score = np.abs(np.asarray(r.scores.single))
        best = space.library.largest(score)
        order, names = np.argsort(-best), space.library.names
        ranks = [
            (n, int(np.flatnonzero(order == names.index(n))[0]), round(float(best[names.index(n)]), 2))
            for n in truth
            if n in names
        ]
        top = [(names[k], round(float(best[k]), 1)) for k in order[:3]]
        threshold = round(float(np.quantile(r.null, 0.95)), 2)
        spent = round(time.perf_counter() - began)
        return f"{kind} {seed} {label} sigmas {sigmas} truth {ranks} top {top} threshold {threshold} equations {r.windows} {spent} s"
    except Exception as error:
        return f"{kind} {seed} error {type(error).__name__} {error}"


if __name__ == "__main__":
    import campaign as C

    os.environ.update({k: v for k, v in C.ALONE.items() if k not in os.environ})
    import multiprocessing

    tasks = [(kind, s) for s in range(700, 760) for kind in sys.argv[1].split(",")]
    with multiprocessing.get_context("spawn").Pool(int(sys.argv[2]), maxtasksperchild=4) as pool:
        for line in pool.imap_unordered(one, tasks):
            print(line, flush=True)
