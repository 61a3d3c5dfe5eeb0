"""Coordinates of the free parameters: prior, bounds, what is never flat, and names by which they are chosen."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.inference import priors
from calibration.inference.fit_notes import Remark
from calibration.inference.preparation import inherited_friction_remarks
from mmrjax.effects import ALL
from mmrjax.model import paper_robots, params
from tests.commands import read_rig

EVERY = [
    p.name
    for p in params.walk_parameters(dataclasses.replace(paper_robots.nominal(), effects=tuple(e() for e in ALL)))
]


@pytest.fixture(scope="module")
def every(robot_with_effects):
    """Coordinates of every parameter of the robot with all effects."""
    return priors.parameter_coordinates(robot_with_effects, EVERY)


def test_coordinates_start_at_the_nominal_robot(every, robot_with_effects):
    nominal = np.array([float(p.value) for p in params.walk_parameters(robot_with_effects)])
    value = np.asarray(every.value(jnp.zeros(len(every))))
    bounded = {"4W2T.track.guide_share", "running_gear.inertia_tracked", "running_gear.inertia_wheeled"}
    on_bound = np.array([p.name in bounded for p in params.walk_parameters(robot_with_effects)])
    sd = np.array([p.spec.prior_sd(float(p.value)) for p in params.walk_parameters(robot_with_effects)])
    assert np.all(np.abs(value - nominal)[~on_bound] <= 1e-5 * sd[~on_bound])  # nearest bound: half an sd
    assert np.all((value[on_bound] > 0) & (value[on_bound] < 0.01))  # their nominal value is their bound
    assert_allclose(every.stated, nominal, rtol=1e-12, atol=0)


def test_coordinates_never_leave_the_bounds_and_never_die(every, robot_with_effects):
    bounds = np.array([p.spec.bounds for p in params.walk_parameters(robot_with_effects)])
    for z in np.linspace(-40, 40, 33):
        value = np.asarray(every.value(jnp.full(len(every), z)))
        rounding = 1e-12 * (1 + np.abs(bounds))  # of exp(log(bound)); bounds reach 1e6
        assert np.all(value >= bounds[:, 0] - rounding[:, 0]) and np.all(value <= bounds[:, 1] + rounding[:, 1])
    slope = np.asarray(every.slope(jnp.zeros(len(every))))
    assert np.all(np.isfinite(slope)) and np.all(slope > 0)


def test_amplitudes_have_a_full_gradient_at_zero(every):
    slope, spread = np.asarray(every.slope(jnp.zeros(len(every)))), np.asarray(every.spread)
    amplitudes = [k for k, name in enumerate(every.names) if name.endswith(".amplitude")]
    assert len(amplitudes) == len(ALL)
    assert_allclose(slope[amplitudes], spread[amplitudes], rtol=1e-4)


def test_slope_on_a_bound_is_half(robot):
    c = priors.parameter_coordinates(robot, ["4W2T.track.guide_share"])
    assert_allclose(c.slope(jnp.zeros(1)) / c.spread, 0.5, rtol=1e-6)
    assert c.beyond(np.array([-1.0])) == -1 and c.beyond(np.array([1.0])) == 0 and c.beyond(np.array([9.0])) == 1


def test_slope_is_the_finite_difference(every):
    z = jnp.asarray(np.random.default_rng(0).standard_normal(len(every)))
    difference = (every.value(z + 1e-6) - every.value(z - 1e-6)) / 2e-6
    # Two values that agree to their last bits, over 2e-6: what the difference cannot see. Beyond a bound a value is
    # what is left of two numbers of the size of its way there.
    way = np.where(np.asarray(every.scale), 0.0, np.abs(np.asarray(every.spread) * np.asarray(z)))
    rounding = 4 * np.finfo(float).eps * (np.abs(every.value(z)) + way) / 2e-6
    assert np.all(np.abs(every.slope(z) - difference) <= 1e-6 * np.abs(difference) + 1e-12 + rounding)


def test_relative_prior_is_log_normal_with_that_spread(robot):
    c = priors.parameter_coordinates(robot, ["6T2A.ground.rolling_resistance", "6T2A.track.guide_share"])
    assert c.scale == (True, False)
    draws = np.asarray(jax.vmap(c.value)(jax.random.normal(jax.random.key(0), (200_000, 2))))
    assert_allclose(draws[:, 0].std() / 0.06, 0.15 * np.sqrt(1.0225), rtol=0.01)
    assert_allclose(np.median(draws, 0), [0.06, 0.3], rtol=0.01)


def test_friction_pairs_keep_their_ratio_unless_freed(robot):
    z = jnp.ones(1)
    moved = (
        priors.parameter_coordinates(robot, ["6T2A.ground.friction.static"])
        .robot(robot, z)
        .configurations["6T2A"]
        .ground.friction
    )
    assert_allclose(moved.dynamic / moved.static, 0.8)
    assert moved.static > 0.4
    both = ["6T2A.ground.friction.static", "6T2A.ground.friction.dynamic"]
    assert priors.parameter_coordinates(robot, both).tied == ()


def test_choose_takes_default_groups_and_fixes(robot):
    default = priors.default_names(("6T2A", "4W2T"), robot)
    assert len(default) == 11 and len(priors.default_names(("6T2A",), robot)) == 6
    assert priors.choose_free_names(robot, default) == default
    assert priors.choose_free_names(robot, default, ["default", "motor.resistance"]) == (*default, "motor.resistance")
    assert priors.choose_free_names(robot, default, ["motor.*"], ["motor.inertia"]) == tuple(
        n for n in EVERY if n.startswith("motor.") and n != "motor.inertia"
    )
    assert priors.choose_free_names(robot, default, fix=["6T2A.*"]) == tuple(
        n for n in default if n.startswith("4W2T.")
    )


def test_default_set_is_friction_of_what_has_rows_with_the_guides_share_on_tracks(robot):
    names = priors.default_names(["4W2T"], robot)
    assert names == tuple(f"4W2T.{n}" for n in priors.FRICTION)
    assert set(priors.friction_names(robot, "6T2A")) == {f"6T2A.{n}" for n in (*priors.FRICTION, priors.GUIDE_SHARE)}


def test_parse_prior_reads_all_forms():
    name = "6T2A.ground.friction.static"
    assert priors.parse_prior(f"{name}=0.45±0.05") == (name, 0.45, 0.05)
    assert priors.parse_prior(f"{name}=4.5e-1+-0.05") == (name, 0.45, 0.05)
    assert priors.parse_prior("crawler-2.mass=4±0.1") == ("crawler-2.mass", 4.0, 0.1)
    assert priors.parse_prior(f"{name} =0.45 ± 10%".replace(" =", "="))[2] == pytest.approx(0.045)


def test_stated_prior_moves_the_centre(robot):
    c = priors.parameter_coordinates(
        robot, ["6T2A.ground.friction.static"], {"6T2A.ground.friction.static": (0.5, 0.05)}
    )
    assert_allclose(c.value(jnp.zeros(1)), 0.5)
    assert_allclose(c.slope(jnp.zeros(1)), 0.05, rtol=0.01)


# --- priors of another robot ------------------------------------------------------------------------


def read(tmp_path, text):
    return read_rig(tmp_path, text, "mine.toml")


def test_friction_left_in_from_another_robot_is_said(tmp_path):
    text = 'configurations = ["rover"]\n[rover]\nlike = "4W2T"\nmass = 3.0\n[motor]\ntorque_constant = 0.012\n'
    motor, rover = inherited_friction_remarks(read(tmp_path, text))
    assert motor == Remark(
        "inherited_priors",
        part="motor",
        changed=(("torque_constant", 0.012, 0.0259),),
        kept=("motor.friction_coulomb", "motor.friction_viscous"),
    )
    assert (rover.part, rover.changed) == ("rover", (("mass", 3.0, 11.5),))
    assert rover.kept[0] == "rover.track.loss_coulomb" and not any("guide" in name for name in rover.kept)


def test_friction_that_the_file_or_a_prior_states_is_not_another_robots(tmp_path):
    stated = "[motor]\nresistance = 1.2\nfriction_coulomb = 1e-3\nfriction_viscous = 1e-6\n"
    assert inherited_friction_remarks(read(tmp_path, stated)) == []
    half = "[motor]\nresistance = 1.2\nfriction_coulomb = 1e-3\n"
    (said,) = inherited_friction_remarks(read(tmp_path, half))
    assert said.kept == ("motor.friction_viscous",)
    assert inherited_friction_remarks(read(tmp_path, half), ["motor.friction_viscous"]) == []


def test_robots_of_the_paper_and_small_changes_are_their_own(tmp_path):
    assert [inherited_friction_remarks(make()) for make in paper_robots.ROBOTS.values()] == [[], [], []]
    assert inherited_friction_remarks(read(tmp_path, "[motor]\nresistance = 0.7\n[4W2T]\nmass = 13.1\n")) == []


def test_heavier_robot_on_tracks_is_compared_with_the_tracks_it_is_like(tmp_path):
    (said,) = inherited_friction_remarks(read(tmp_path, "[6T2A]\nmass = 30.0\n"))
    assert (said.part, said.changed) == ("6T2A", (("mass", 30.0, 13.1),)) and "6T2A.track.guide_share" in said.kept


def test_the_loop_frees_a_mass_that_the_file_states_with_an_error(tmp_path):
    text = """
base = "none"
imposed = "voltage"
channels = ["total_current", "motor_speed"]
[motor]
resistance = "0.9 ± 5 %"
torque_constant = 0.028
inertia = "4e-6 ± 10 %"
[gearbox]
ratio = 30
efficiency_load = 1.0
[rover]
load = "vehicle"
movers = "wheels"
mass = {mass}
radius = "0.06 ± 1 %"
inertia = 1e-6
[rover.track]
[rover.ground]
rolling_resistance = 0.02
[rover.ground.friction]
static = 0.6
"""
    freed = []
    for mass in ('"10 ± 20 %"', "10"):
        freed.append(priors.loop_parameter_names(read_rig(tmp_path, text.format(mass=mass)), ["rover"]))
    assert set(freed[0]) - set(freed[1]) == {"rover.mass"}
    assert "motor.inertia" not in freed[0]  # settled runs do not show it
