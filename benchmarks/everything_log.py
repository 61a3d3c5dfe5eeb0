"""Pytest plugin of `benchmarks/everything.py`: logs each finished test and leaves out those of earlier calls.

The log is written by the process that distributes tests, as soon as a test ends.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from everything import note

LOG = Path(os.environ.get("EVERYTHING_LOG", os.devnull))
DISTRIBUTES = "PYTEST_XDIST_WORKER" not in os.environ
#: Outcome, seconds and text of tests in progress.
RUNNING: dict[str, dict[str, Any]] = {}


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Leaves out tests that earlier calls finished."""
    done = set(Path(os.environ["EVERYTHING_DONE"]).read_text(encoding="utf-8").splitlines())
    left_out = [item for item in items if item.nodeid in done]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item.nodeid not in done]


def pytest_collection_finish(session):
    if DISTRIBUTES and session.items:
        note(LOG, selected=len(session.items))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node, ids):
    note(LOG, selected=len(ids))


def pytest_collectreport(report):
    if DISTRIBUTES and report.failed:
        note(LOG, test=report.nodeid, outcome="failed", text=str(report.longrepr)[-4000:])


def pytest_runtest_logreport(report):
    """Logs a test at its teardown, or at the crash of its worker, with the worst outcome of its phases."""
    if not DISTRIBUTES:
        return
    test = RUNNING.setdefault(report.nodeid, {"outcome": "passed", "seconds": 0.0, "text": ""})
    test["seconds"] = round(test["seconds"] + report.duration, 3)
    if not report.passed and test["outcome"] != "failed":
        test |= {"outcome": report.outcome, "text": str(report.longrepr)[-4000:]}
    if report.when not in ("setup", "call"):
        note(LOG, test=report.nodeid, **RUNNING.pop(report.nodeid))
