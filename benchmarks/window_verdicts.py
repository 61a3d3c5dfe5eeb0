"""Verdicts from the windows of generated logs, without any simulation. A probe, not kept."""

import dataclasses
import json
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))


def one(task):
    kind, seed, rows, stratum = task
    line = {"kind": kind, "seed": seed, "rows": rows, "stratum": stratum}
    try:
        import campaign as C
        import loop_findings
        import numpy as np
        import rig_logs as R
        from campaign import Task
        from worlds import logs

        C.ready()
        from calibration.discovery import discover as D

        logs.ROWS = rows
        R.inputs = lambda seed, servo=False: (logs.IMPOSED[seed % 2], 0.02)
        D.LONG = 0
        began = time.perf_counter()
        case = R.attempt(kind, seed, stratum)
        line["made_seconds"] = round(time.perf_counter() - began)
        if isinstance(case, str):
            return line | {"skipped": case}
        began = time.perf_counter()
        given = C.begun(case, Task(kind, seed, 500, stratum=stratum, brief=True))
        line |= {k: case.label.get(k) for k in ("imposed", "every", "alone", "coarse", "stated", "delay")}
        line["truth"] = case.label["effects"]
        found = given.trace()
        line |= {"seconds": round(time.perf_counter() - began), **loop_findings.verdict(found)}
        if found.run is None:
            return line | {"none": True}
        line["run"] = [found.run.promised, found.run.gained, found.run.base.cost, found.run.best.cost]
        space, left = found.screened.base.space, found.left
        best = space.library.largest(np.abs(np.asarray(left.scores.single)))
        names = space.library.names
        line["threshold"] = left.test.threshold("single")
        line["top"] = [(names[k], float(best[k])) for k in np.argsort(-best)[:4]]
        line["true_score"] = [float(best[names.index(t["class"])]) for t in line["truth"] if t["class"] in names]
        line["tests"] = loop_findings._tests(found)
        return line
    except Exception as error:
        import traceback

        return line | {"error": f"{type(error).__name__} {error}", "trace": traceback.format_exc()[-600:]}


if __name__ == "__main__":
    import campaign as C
    import loop_findings

    os.environ.update({k: v for k, v in C.ALONE.items() if k not in os.environ})
    import multiprocessing

    jobs, out = int(sys.argv[1]), Path(sys.argv[2])
    tasks = [(kind, s, 600, "varied" if s % 2 else "") for s in range(700, 716) for kind in ("clean", "library", "outside")]
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=6) as pool, out.open("a") as file:
        for line in pool.imap_unordered(one, tasks):
            file.write(json.dumps(loop_findings.plain(line)) + "\n")
            file.flush()
            print(line["kind"], line["seed"], line["rows"], line.get("verdict", line.get("error", line.get("skipped", "no windows"))), flush=True)
