"""Posteriors: the file, draws against the linear analysis, and what is refused."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import calibrated

from calibration.data import posterior_file as room
from calibration.data import robot_file
from calibration.data.posterior_file import ANGLE, LOG, NORMAL, Posterior
from calibration.data.runs import read_runs
from calibration.inference import priors
from calibration.inference.identifiability import posterior_of_coordinates
from mmrjax.model import params
from sweeps import config
from sweeps.points import run
from tests.commands import refused

NAMES = ("motor.resistance", "6T2A.track.guide_share", "6T2A.ground.friction.static", "motor.temperature_ambient")


@pytest.fixture
def coordinates(robot):
    return priors.parameter_coordinates(robot, NAMES)


@pytest.fixture
def posterior(coordinates):
    a = np.array([[0.3, 0, 0, 0], [-0.2, 0.25, 0, 0], [0.05, 0.02, 0.1, 0], [0, 0.1, 0, 0.9]])
    return posterior_of_coordinates(coordinates, np.array([0.4, 0.2, 1.2, 0.0]), a @ a.T)


@pytest.fixture
def fitted(robot, posterior):
    values = np.asarray(posterior.at(posterior.mean))
    return params.replace(robot, {n: jnp.asarray(v) for n, v in zip(posterior.names, values, strict=True)})


def test_coordinates_of_a_posterior_are_those_of_the_fit(coordinates, posterior):
    z = np.random.default_rng(0).normal(size=(20, 4)) * 2
    assert_allclose(posterior.at(z)[:, :4], coordinates.value(jnp.asarray(z)), rtol=1e-14)
    assert_allclose(posterior.at(z)[:, 4], 0.8 * posterior.at(z)[:, 2], rtol=1e-12)  # μ_d follows μ_s
    assert posterior.names[4:] == ("6T2A.ground.friction.dynamic", "6T2A.ground.friction.speed_dynamic")[:1]


def test_file_holds_all_of_a_posterior(posterior, tmp_path):
    room.write_posterior(posterior, tmp_path / room.FILE)
    again = room.read_posterior(tmp_path / room.FILE)
    for field in dataclasses.fields(Posterior):
        a, b = getattr(posterior, field.name), getattr(again, field.name)
        if isinstance(a, np.ndarray):
            assert_array_equal(a, b)
        else:
            assert a == b, field.name


def test_draws_have_mean_and_covariance_of_the_posterior(posterior):
    values = posterior.draw(20_000, 0)
    assert values.shape == (20_000, 5)
    z = np.log(values[:, 0] / 0.611) / posterior.spread[0]  # the first is a scale
    assert z.mean() == pytest.approx(0.4, abs=0.01) and z.std() == pytest.approx(0.3, rel=0.02)
    guide = (values[:, 1] - 0.3) / 0.2
    assert np.corrcoef(z, guide)[0, 1] == pytest.approx(-0.06 / (0.3 * 0.32), abs=0.02)
    assert_array_equal(values, posterior.draw(20_000, 0))


@pytest.mark.slow
def test_draws_that_do_not_travel_are_counted_and_leave_the_rest(robot):
    names = ("6T2A.ground.friction.static",)
    coordinates = priors.parameter_coordinates(robot, names)
    wide = posterior_of_coordinates(coordinates, np.zeros(1), np.eye(1))
    runs = read_runs("measured").where(np.array([0, 2]))  # flat, and 10°, where one in seven slides
    found = run.simulate_draws(robot, wide, runs, config.Compare(), 300)
    share = found[run.CONVERGED_SHARE]
    assert share[0] == 1 and 0.7 < share[1] < 0.95
    assert np.isfinite(found["speed_mm_s_sd"]).all()


def test_a_coordinate_that_does_not_vary_is_drawn_at_its_mean(posterior):
    fixed = posterior.covariance.copy()
    fixed[0], fixed[:, 0] = 0, 0
    values = dataclasses.replace(posterior, covariance=fixed).draw(50, 0)
    assert np.ptp(values[:, 0]) < 1e-12 and np.ptp(values[:, 1]) > 0


def test_an_angle_stays_within_half_a_turn():
    one = np.ones(1)
    angle = Posterior(
        ("x",), ("rad",), one * 3, np.eye(1), 0 * one, one, -np.inf * one, np.inf * one, 0 * one, (ANGLE,)
    )
    values = angle.draw(500, 0)
    assert np.all(np.abs(values) <= np.pi) and (values < 0).any() and (values > 0).any()


def test_cut_bounds_hold_and_soft_ones_are_not_cut_twice():
    one = np.ones(2)
    cut = Posterior(
        ("a", "b"), ("", ""), 0 * one, np.eye(2), 0 * one, one, 0 * one, 0.5 * one, 0 * one, (NORMAL, LOG)
    )
    values = cut.draw(500, 0)
    assert values[:, 0].min() == 0 and values[:, 0].max() == 0.5
    assert values[:, 1].min() == 1 and values[:, 1].max() == pytest.approx(np.exp(0.5))


# --- what is refused --------------------------------------------------------------------------------------------


def test_posterior_of_another_robot_is_refused(robot, posterior, fitted):
    posterior.check(fitted, "here")
    with refused(r"here: motor.resistance is 0.611 in the robot; expected 0.62\d+, the centre"):
        posterior.check(robot, "here")
    other = dataclasses.replace(posterior, coordinates=("8W8T.mass", *posterior.coordinates[1:]))
    with refused(r"here: this robot has no 8W8T.mass, so the posterior is another robot's.*6T2A.mass"):
        other.check(fitted, "here")


def test_missing_and_damaged_files_are_refused(posterior, tmp_path):
    path = tmp_path / room.FILE
    with refused(r"no such file; expected the posterior\.nc next to robot\.toml"):
        room.read_posterior(path)
    path.write_text("nothing of the kind")
    with refused("not a readable posterior"):
        room.read_posterior(path)
    skew = posterior.covariance.copy()
    skew[0, 1] = skew[1, 0] = 5.0  # more than their sds allow
    room.write_posterior(dataclasses.replace(posterior, covariance=skew), path)
    with refused("a number is missing, invalid"):
        room.read_posterior(path)


@pytest.mark.parametrize(
    "column, value",
    [
        ("tied_to", 4),
        ("tied_to", -1),
        *((name, np.nan) for name in ("tied_ratio", "location", "spread", "low", "high", "softness")),
    ],
)
def test_a_file_with_a_number_that_cannot_be_is_refused(posterior, tmp_path, column, value):
    path = tmp_path / room.FILE
    room.write_posterior(posterior, path)
    assert len(room.read_posterior(path)) == len(posterior)
    wrong = xarray.load_dataset(path, engine="scipy").copy(deep=True)
    wrong[column][0] = value
    wrong.to_netcdf(path, engine="scipy")
    with refused("a number is missing, invalid or out of range; write the file again"):
        room.read_posterior(path)


def test_file_without_bounds_is_read(posterior, tmp_path):
    room.write_posterior(
        dataclasses.replace(posterior, low=np.full(4, -np.inf), high=np.full(4, np.inf)), tmp_path / room.FILE
    )
    assert np.isinf(room.read_posterior(tmp_path / room.FILE).high).all()


def test_draws_of_which_some_never_settle_have_no_spread_and_warn_of_nothing():
    some = np.array([[np.inf] * 3, [40.0, np.inf, 50.0]])
    found = run._summary({"winding_settled_C": some}, np.ones((2, 3), bool))
    assert np.isnan(found["winding_settled_C_sd"]).all()


@pytest.mark.parametrize("value, sd, most, said", [
    (4.1932, 0.0612, 3, "4.193 ± 0.061"), (5243.2, 12.3, 1, "5243 ± 12"), (2.0, 0.0, 2, "2.00 ± 0.00"),
    (0.5, 0.000012, 3, "0.500 ± 0.000"), (-0.0001, 0.02, 3, "0.000 ± 0.020"), (-0.001, 0.0, 2, "0.00 ± 0.00"),
])  # fmt: skip
def test_a_value_is_said_to_two_digits_of_its_sd(value, sd, most, said):
    assert run.with_sd(value, sd, most) == said


@pytest.mark.slow
def test_saved_calibration_has_its_posterior(tmp_path):
    found = calibrated()
    found.save(tmp_path)
    again = room.read_posterior(tmp_path / room.FILE)
    again.check(robot_file.load_robot(str(tmp_path / "robot.toml")), "saved")
    for name, sd in zip(again.names, again.sd, strict=True):
        if name in found.parameters:
            assert sd == pytest.approx(found.parameters[name].sd, rel=1e-9)
    assert set(found.tied) == set(again.names[len(again) :])


@pytest.mark.slow
@pytest.mark.parametrize("names, verdict", [(["churning"], "named"), ([], "none")])
def test_posterior_of_the_loop_has_what_it_found(names, verdict):
    from synthetic import SETTLED, table
    from worlds import tables

    from mmrjax.effects import BY_NAME

    runs = table(tables.narrow(names, 10.0, seed=4) if names else tables.narrow(seed=2))
    traced = SETTLED.trace(runs)
    found = dataclasses.replace(SETTLED, library=BY_NAME).result(traced, runs)
    assert (found.verdict == "none") == (verdict == "none")
    found.posterior.check(found.robot, "the loop's")
    sd = dict(zip(found.posterior.names, found.posterior.sd, strict=True))
    for effect in found.effects:
        for word, estimate in effect.parameters.items():
            assert sd[f"effects.{effect.name}.{word}"] == pytest.approx(estimate.sd, rel=0.02)
    for name, shift in found.base_shift.items():
        assert sd[name] == pytest.approx(shift.sd_after, rel=0.02)
