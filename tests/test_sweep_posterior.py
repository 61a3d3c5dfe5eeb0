"""Sweeps over what a calibration left open."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import posterior_file as posteriors
from calibration.data.input_errors import InputError
from mmrjax.model import paper_robots, params
from sweeps.config_campaign import Campaign
from sweeps.points import axes

NAMES = ("motor.resistance", "motor.friction_coulomb")
UNIFORM = {"distribution": "uniform", "low": 0, "high": 8}


def correlated_posterior():
    """Of two parameters of the nominal robot."""
    value = {p.name: float(p.value) for p in params.walk_parameters(paper_robots.nominal())}
    centre, none = np.array([value[n] for n in NAMES]), np.zeros(2)
    return posteriors.Posterior(
        coordinates=NAMES, units=("ohm", "N·m"), mean=none, covariance=np.array([[1.0, 0.8], [0.8, 1.0]]), location=centre,
        spread=0.05 * centre, low=0.1 * centre, high=10 * centre, softness=none, kinds=(posteriors.NORMAL,) * 2,
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    posteriors.write_posterior(correlated_posterior(), tmp_path / posteriors.FILE)
    return tmp_path


def plan(folder, robot=None, **samples):
    stated = {"design": "sobol", "number": 8192, "seed": 2, "posterior": str(folder), **samples}
    return axes.plan_design(Campaign(samples=stated), paper_robots.nominal() if robot is None else robot, "plan.toml")


def test_posterior_is_sampled_with_its_correlation_whatever_the_chunk(folder):
    found = plan(folder, over={"payload": UNIFORM})
    samples = found.design.samples
    assert found.design.names == ("payload", *NAMES) and found.data == (str(folder / posteriors.FILE),)
    values = samples.values(0, 8192)
    centre = [found.axes[n].value for n in NAMES]
    assert_allclose(values[1:].mean(1), centre, rtol=2e-3)
    assert_allclose(values[1:].std(1) / centre, 0.05, rtol=2e-2)
    assert np.corrcoef(values)[1, 2] == pytest.approx(0.8, abs=0.01)
    assert abs(np.corrcoef(values)[0, 1]) < 0.02
    for first, count in ((0, 1), (4095, 2), (5000, 3000)):
        assert np.array_equal(samples.values(first, count), values[:, first : first + count])


def test_posterior_of_another_robot_and_a_folder_without_one_are_refused(folder, tmp_path, robot):
    with pytest.raises(InputError, match=r"plan\.toml, samples\.posterior: motor\.resistance is"):
        plan(folder, params.replace(robot, {"motor.resistance": 0.9}))
    with pytest.raises(InputError, match=r"no such file; expected the posterior\.nc"):
        plan(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"samples\.posterior: got 3; expected a run folder"):
        plan(folder, posterior=3)
    with pytest.raises(InputError, match=r"plan\.toml, motor\.resistance: given twice"):
        plan(folder, over={"motor.resistance": "prior"})
