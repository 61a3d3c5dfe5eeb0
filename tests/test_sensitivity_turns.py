"""Sensitivity of turns: which outputs and inputs they have, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mmrjax as mm
from calibration.sensitivity import uncertain_inputs
from calibration.sensitivity.model import chosen_outputs
from mmrjax.derived import turning_figures
from mmrjax.model import paper_robots, params
from sweeps import config
from sweeps.commands import sensitivity as room
from tests.commands import ends, rows

ROBOT = paper_robots.nominal()
TURNS = ROBOT.showing_turns()


def names(outputs):
    return [output.name for output in outputs]


def test_turns_have_outputs_of_both_sides_of_the_yaw_and_of_the_radius():
    usual = names(chosen_outputs((), TURNS, turns=True))
    assert {"yaw_rate", "lateral_speed", "motor_current_left", "motor_current_right", "turning_radius"} < {*usual}
    assert "steepest_slope" not in usual and "total_current" in usual
    assert "turning_radius" not in names(chosen_outputs((), ROBOT))


def test_turns_have_inputs_of_turns():
    straight, turns = (
        uncertain_inputs.default_input_names(ROBOT, ("6T2A",), False, turns=turns) for turns in (False, True)
    )
    assert {*turns} - {*straight} == {f"6T2A.turning.{n}" for n in ("width", "lateral", "rule", "inertia")}


def test_turns_are_on_level_ground():
    asked = config.Sensitivity(configurations=("6T2A",), vary=("duty_left=0.4:0.8",))
    for ranges, slopes in (({"duty_left": (0.4, 0.8)}, [0]), ({"voltage": (20.0, 24.0)}, [0, 10, 17])):
        points = room._operating_points(asked, ROBOT, ranges)
        assert np.unique(points["slope_deg"]).tolist()[:1] == slopes[:1]
        assert (len(np.unique(points["slope_deg"])) > 1) == (len(slopes) > 1)


def test_radius_is_that_of_the_centre_of_mass():
    ahead, aside, rate = np.array(
        [[0.3, 0.4, 1.0], [0.3, 0.0, -0.5], [-0.3, 0.0, 0.5], [0.0, 0.1, 2.0], [0.3, 0, 0]]
    ).T
    assert_allclose(turning_figures.turning_radius(ahead, aside, rate), [0.5, -0.6, -0.6, 0.05, np.inf])
    slope = jax.grad(lambda v: turning_figures.turning_radius(v, 0.0, 2.0))(0.3)
    assert slope == pytest.approx(0.5) and np.isfinite(
        jax.grad(lambda w: turning_figures.turning_radius(0.3, 0.0, w))(0.0)
    )


@pytest.mark.slow
def test_radius_of_a_run_and_its_derivative():
    asked = mm.Conditions(0, 24.0, duty_left=0.4, duty_right=1.0)

    def of(lateral):
        return turning_figures.compute(params.replace(ROBOT, {"6T2A.turning.lateral": lateral}), asked)[
            "turning_radius"
        ]

    found = mm.simulate(ROBOT, asked).reading
    moves = np.hypot(found["speed"], found["lateral_speed"])
    at = next(p.value for p in params.walk_parameters(ROBOT) if p.name == "6T2A.turning.lateral")
    assert of(jnp.asarray(at)) == pytest.approx(float(moves / found["yaw_rate"]), rel=1e-9)
    exact = jax.jit(jax.grad(of))(jnp.asarray(at))
    jitted = jax.jit(of)
    difference = (jitted(jnp.asarray(at + 1e-6)) - jitted(jnp.asarray(at - 1e-6))) / 2e-6
    assert exact == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.slow
def test_the_yaw_rate_of_a_turn_is_studied(mmrjax, tmp_path):
    told = "--configurations", "6T2A", "--voltages", "24", "--payloads", "0", "--vary", "duty_left=0.4:0.8"
    more = "--method", "local", "--outputs", "yaw_rate,turning_radius", "--no-report", "--out", str(tmp_path / "s")
    ends(mmrjax("sensitivity", *told, *more), "yaw rate", "turning radius", code=0)
    assert any(row["input"] == "6T2A.turning.lateral" for row in rows(tmp_path / "s/points.csv"))
