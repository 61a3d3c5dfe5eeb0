"""One rule of what a parameter is held by: posterior sd above 0.9 of the prior's, for every parameter, everywhere."""

import functools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as effort
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pages import Tables
from synthetic import calibrated

from calibration.data import runs as records
from calibration.inference import identifiability
from calibration.inference.calibration import calibrate
from calibration.inference.fit_notes import remarks_with_codes
from calibration.inference.identifiability import HELD, held_by_prior
from mmrjax.model import paper_robots
from sweeps.report import calibration_report, page_renderer


def linear(jacobian):
    """The linear analysis of readings with this whitened Jacobian, priors of sd 1."""
    readings, parameters = jacobian.shape
    data = SimpleNamespace(measured=np.zeros((readings, 1)))
    posed = SimpleNamespace(coordinates=SimpleNamespace(names=tuple(f"p{k}" for k in range(parameters))), data=data)
    return identifiability.analyse_identifiability(posed, np.zeros(parameters), slope=jacobian)


def posterior_sd(jacobian):
    """A second way to it: 1 / sd² is 1 and what of a parameter's column the others, with their priors, leave."""
    whole = np.concatenate([jacobian, np.eye(jacobian.shape[1])])
    sd = []
    for k, column in enumerate(whole.T):
        others = np.delete(whole, k, 1)
        left = column - others @ np.linalg.lstsq(others, column, rcond=None)[0] if others.size else column
        sd.append(1 / np.linalg.norm(left))
    return np.array(sd)


@effort(max_examples=500, deadline=None, derandomize=True)
@given(
    st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 40), st.integers(0, 3), st.integers(0, 3),
    st.floats(-3, 3),
)  # fmt: skip
def test_what_the_data_do_not_narrow_is_held(seed, parameters, readings, dead, alike, strength):
    """500 random linear problems: parameters that nothing moves, copies of one another, columns of any size."""
    rng = default_rng(seed)
    jacobian = rng.standard_normal((readings, parameters)) * 10 ** rng.uniform(strength - 2, strength, parameters)
    jacobian[:, rng.integers(0, parameters, dead)] = 0.0
    for _ in range(alike):
        one, other = rng.integers(0, parameters, 2)
        jacobian[:, one] = rng.choice([-1.0, 1.0, 3.0]) * jacobian[:, other]
    about, expected = linear(jacobian), posterior_sd(jacobian)
    assert_allclose(about.sd, expected, rtol=1e-6)
    sure = np.abs(expected - HELD) > 1e-6
    assert_array_equal(about.held_by_prior[sure], (expected > HELD)[sure])
    assert about.held_by_prior[np.all(jacobian == 0, 0)].all()


def test_rule_is_a_ratio_of_sds_and_holds_what_is_not_known():
    assert HELD == 0.9
    assert_array_equal(held_by_prior(np.array([0.0, 0.71, 0.9, 0.90001, 1.0, np.nan, np.inf])), [0, 0, 0, 1, 1, 1, 1])  # fmt: skip


def stated(noise):
    return f"current={noise}%,motor_speed={noise}%,speed={noise}%"


#: Real data: as they come; with parameters that nothing moves, and at bounds; and with readings that tell nearly nothing.
CALIBRATIONS = {
    "packaged": {},
    "unmeasured": {
        "free": ["default", "motor.inductance", "6T2A.mass", "6T2A.track.guide_friction"], "noise": stated(9),
    },
    "at a bound": {"stated": {"6T2A.track.loss_coulomb": (3.0, 0.02)}, "noise": stated(2)},
    "noisy": {"noise": stated(300)},
}  # fmt: skip


@functools.cache
def found(case):
    if case == "packaged":
        return calibrated()
    runs = records.read_runs("measured")
    return calibrate(runs, paper_robots.nominal(), starts=2, profiles=False, blocks=(), **CALIBRATIONS[case])


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=[pytest.mark.slow] * (c != "packaged")) for c in CALIBRATIONS]
)
def test_result_page_and_robot_file_agree_on_parameters_held_by_their_prior(case, tmp_path):
    made = found(case)
    held = {name for name, p in made.parameters.items() if np.sqrt(p.variance_ratio) > HELD}
    sd = np.sqrt(np.diag(made.posterior.covariance))  # of coordinates whose prior sd is 1
    document = json.loads(json.dumps(made.to_json()))["parameters"]
    assert held == {name for name, x in zip(made.posterior.coordinates, sd, strict=True) if x > HELD}
    assert {n: p["held_by_prior"] for n, p in document.items()} == {n: n in held for n in made.parameters}
    listed = [name for note in remarks_with_codes(made.remarks, "held_by_prior") for name in note.names]
    far = {note.name for note in remarks_with_codes(made.remarks, "far_from_prior")}
    assert set(listed) == held - far and len(listed) == len(set(listed))
    shown = calibration_report.calibration_document(made, "nominal")
    page = Tables(page_renderer.write_report_page(tmp_path, shown).read_text("utf-8"))
    head, *rows = page.tables["parametertable"]
    assert {row[0] for row in rows if row[head.index("determined")].startswith("no")} == held
    made.save(tmp_path)
    first = (tmp_path / "robot.toml").read_text("utf-8").split("schema")[0]
    assert all(name in first.split("not determined")[-1] for name in held)
