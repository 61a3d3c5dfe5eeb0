"""The registry of fidelities: every one keeps the contract, broken ones do not, and a new one is a file and a line."""

import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mmrjax import fidelities
from mmrjax.fidelities import FidelityFacts, Option
from mmrjax.fidelities.base import Fidelity, History, RunBatch
from mmrjax.fidelities.steady import operating_point, steady_batch
from mmrjax.model import channels, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import STATUSES, Result
from tests.commands import ROOT

RUNS = Conditions(configuration=[0, 1], voltage=24.0, slope_deg=[5.0, 0.0])
SHORT = 0.03  # [s]


def short(fidelity):
    has = {option.name for option in fidelity.facts.options}
    return fidelity.facts.resolved(**({"duration": SHORT} if "duration" in has else {}))


# --- the contract -----------------------------------------------------------------------------------


def knows_itself(fidelity, robot):
    facts = fidelity.facts
    assert fidelity.name in fidelities.TABLE and facts.description and facts.at_once(False) >= 1 and facts.starts >= 1
    assert all(0 < option.default <= option.most and option.meaning and option.unit for option in facts.options)
    assert fidelity.facts.resolved() == {option.name: option.default for option in facts.options}
    assert (fidelity.histories is not None) == facts.histories
    parameters = {p.name for p in params.walk_parameters(robot.configurations.members[0])}
    assert set(facts.computes) <= parameters


def settles_traceably(fidelity, robot):
    def readings(resistance):
        result = fidelity.settled(params.replace(robot, {"motor.resistance": resistance}), RUNS)
        assert isinstance(result, Result)
        return jnp.stack([result.reading[name] for name in channels.USUAL]), result

    (slopes, result) = jax.eval_shape(jax.jacfwd(readings, has_aux=True), jnp.asarray(0.611))
    assert slopes.shape == (len(channels.usual_channels()), 2)
    assert all(x.shape == (2,) for x in jax.tree.leaves(result))


def runs_batches(fidelity, robot):
    done = fidelity.run(robot, RUNS, short(fidelity))
    assert isinstance(done, RunBatch) and done.history is None
    assert all(x.shape == (2,) for x in jax.tree.leaves(done))
    assert set(np.asarray(done.result.status)) <= set(range(len(STATUSES)))
    assert set(done.result.reading) == {c.name for c in channels.EVERY}


def keeps_histories(fidelity, robot):
    if fidelity.histories is None:
        return
    told = []
    kept = fidelity.histories(robot, RUNS, short(fidelity), told.append)
    history = kept.history
    assert isinstance(history, History)
    assert history.time.shape == history.distance.shape and len(history.time) == 2
    assert (np.diff(history.time) > 0).all() and abs(history.time[0, -1] - SHORT) < 1e-9
    assert set(history.reading) == {c.name for c in channels.EVERY if c.over_time}
    for name, reading in history.reading.items():
        assert reading.shape == history.time.shape and np.isfinite(reading).all(), name
    assert (np.abs(history.distance[:, 0]) < 1e-3).all() and (history.reading["total_current"][:, -1] > 0).all()
    assert told == sorted(told) and all(0 <= share <= 1 for share in told)
    assert kept.result.status.shape == (2,)


def checks_and_cautions(fidelity, robot):
    assert fidelity.check(robot, RUNS, short(fidelity)) is None


CONTRACT = (knows_itself, settles_traceably, runs_batches, keeps_histories, checks_and_cautions)


@pytest.mark.quick(3)
@pytest.mark.parametrize(
    "name, law",
    [
        pytest.param(n, law, marks=pytest.mark.slow)
        # a program of its own; what drive keeps is looked at by test_drive, test_start and test_cli
        if fidelities.fidelity_facts(n).slow or (n == "drive" and law is keeps_histories)
        else (n, law)
        for n in fidelities.NAMES
        for law in CONTRACT
    ],
    ids=[f"{n}-{law.__name__}" for n in fidelities.NAMES for law in CONTRACT],
)
def test_fidelity_keeps_the_contract(name, law, robot):
    fidelity = fidelities.get_fidelity(name)
    assert fidelity.name == name
    law(fidelity, robot)


# --- a new one --------------------------------------------------------------------------------------


@pytest.fixture
def toy(monkeypatch):
    """A fidelity in a file of its own, by a line of the table: the steady one, in another unit of effort."""

    def run(robot, conditions, options, progress=None):
        return RunBatch(
            steady_batch(robot, conditions), {"patience": options["patience"] * jnp.ones(conditions.shape)}
        )

    def settled(robot, conditions):
        return jax.vmap(lambda c: operating_point(robot, c)[0])(conditions)

    module = types.ModuleType("toy_fidelity")
    module.FIDELITY = Fidelity("toy", settled=settled, run=run)
    monkeypatch.setitem(sys.modules, "toy_fidelity", module)
    line = FidelityFacts(
        "toy_fidelity", "steady, and patient", chunk=8, starts=2, profiles=True,
        options=(Option("patience", "s", 3.0, 10.0, "time that it takes"),),
    )  # fmt: skip
    monkeypatch.setitem(fidelities.TABLE, "toy", line)
    return "toy"


def test_new_fidelity_is_a_file_and_a_line(toy, robot):
    fidelity = fidelities.get_fidelity(toy)
    for law in CONTRACT:
        law(fidelity, robot)
    assert fidelity.run(robot, RUNS, fidelity.facts.resolved(patience=4)).columns["patience"].tolist() == [4.0, 4.0]


# --- before anything is imported ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "code, absent",
    [
        (
            "from mmrjax import fidelities; fidelities.NAMES, fidelities.fidelity_facts('track').resolved()",
            "jax mujoco",
        ),
        (
            "from mmrjax import fidelities; fidelities.get_fidelity('steady'); fidelities.get_fidelity('drive')",
            "mujoco",
        ),
    ],
)
def test_facts_need_no_jax_and_steady_no_mujoco(code, absent):
    code += "; import sys; assert not set(sys.argv[1:]) & set(sys.modules), set(sys.modules)"
    subprocess.run([sys.executable, "-c", code, *absent.split()], cwd=ROOT, check=True, timeout=120)
