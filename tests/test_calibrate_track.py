"""Calibration through the rollouts of the track model: exact derivatives, a recovered truth, agreement with steady."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import runs as records
from calibration.inference import priors
from calibration.inference.calibration import calibrate
from calibration.inference.fit_notes import remarks_with_codes
from calibration.inference.priors import GUIDED
from calibration.words import table_words
from mmrjax import fidelities
from mmrjax.fidelities.steady import steady_batch
from mmrjax.fidelities.track import track
from mmrjax.model import channels, paper_robots, params

GUIDE_FRICTION, GUIDE_SHARE = f"6T2A.{priors.GUIDE_FRICTION}", f"6T2A.{priors.GUIDE_SHARE}"
STATIC = "6T2A.ground.friction.static"
CREEP = "6T2A.ground.friction.speed_static"
STATED = "current=1%,motor_speed=0.5%,speed=1%"
TRUTH = 0.12


@pytest.fixture(scope="module")
def base():
    """Nominal, with adhesion for the slopes of the tests, and a friction law that is no stiffer for it."""
    return params.replace(paper_robots.nominal(), {STATIC: 0.6, CREEP: 0.1})


@pytest.fixture(scope="module")
def seen(base):
    """Two runs of a robot whose guides rub with 0.12: longer ones than the fit makes."""
    conditions = records.read_runs("measured").where(np.array([5, 7]))
    robot = params.replace(base, {GUIDE_FRICTION: jnp.asarray(TRUTH), GUIDE_SHARE: jnp.asarray(GUIDED)})
    run = jax.jit(jax.vmap(lambda c: track(robot, c, duration=1.0, rolling=True)))
    return conditions, run(conditions.conditions(robot))


@pytest.fixture(scope="module")
def made(seen):
    """The table of those runs."""
    conditions, runs = seen
    columns = {c.column: np.asarray(runs.result.reading[c.name]) / c.factor for c in channels.usual_channels()}
    return dataclasses.replace(conditions, source="made", columns={**conditions.columns, **columns})


@pytest.mark.slow
def test_the_share_of_the_guides_is_what_the_track_model_puts_out(seen):
    assert_allclose(seen[1].steady.guide_share, GUIDED, atol=0.01)


def test_in_track_the_guide_friction_stands_for_the_product(base):
    names = priors.default_names(["6T2A", "4W2T"], base, computed=fidelities.fidelity_facts("track").computes)
    assert GUIDE_FRICTION in names and GUIDE_SHARE not in names and len(names) == 11
    turned, known = priors.with_guide_share(base, "6T2A")
    fields, mean = params.parameters_by_name(turned), known[GUIDE_FRICTION][0]
    assert float(fields[GUIDE_SHARE].value) == GUIDED
    assert mean * GUIDED == pytest.approx(0.2 * 0.3)  # of the nominal robot in the other fidelities
    assert params.parameters_by_name(base)[GUIDE_SHARE].value == 0.3
    assert "in track, fit guide_friction" in table_words.would_measure(GUIDE_SHARE)


@pytest.fixture(scope="module")
def told():
    return []


@pytest.fixture(scope="module")
def found(base, made, told):
    free = [GUIDE_FRICTION, STATIC]
    return calibrate(made, base, model="track", free=free, noise=STATED, starts=2, tell=told.append)


@pytest.mark.nightly
def test_track_calibration_recovers_the_guide_friction(found, made, told):
    answer = found.parameters[GUIDE_FRICTION]
    assert found.converged and found.starts.agree == 2 and (found.status == "converged").all()
    assert answer.value == pytest.approx(TRUTH, rel=0.01)
    assert answer.interval[0] < TRUTH < answer.interval[1]
    assert abs(answer.with_steady.apart_in_sd) < 1.96
    assert answer.prior.source == "product"
    assert not found.profiled and not found.held_out  # minutes each, so only when asked for
    assert any("round 1" in t for t in told) and any("start 2 of 2" in t for t in told)
    (product,) = remarks_with_codes(found.remarks, "prior_of_product")
    assert f"{product.share:.0%}" == "98%"


@pytest.mark.slow
def test_calibrated_robot_gives_the_same_readings_in_other_fidelities(found, made):
    current = steady_batch(found.robot, made.conditions(found.robot)).total_current
    assert_allclose(current, made["total_current_A"], rtol=5e-3)


@pytest.mark.slow
def test_a_belt_too_stiff_for_the_step_is_reported(base, made):
    """Friction and contacts are implicit in a step, the springs of the belt are not."""
    stiff = params.replace(base, {"running_gear.span_stiffness": 1e8})
    (said,) = fidelities.get_fidelity("track").cautions(stiff, made.conditions(stiff))
    assert said.startswith("rows 1, 2")
    assert "the step of 0.0001 s is above the largest stable one" in said
