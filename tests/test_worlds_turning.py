"""The two-sided world of `worlds.turning` against closed forms (issue 28), symmetries and its own energy."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from worlds import paper, turning
from worlds.turning import LENGTH, STATES, WIDTH, Inputs, paper_robot, straight


def ideal(wheeled=False, surface="wood", coulomb=False, **changes):
    """The paper's robot without rolling resistance. `coulomb`: friction without creep and without fall."""
    role = "4W2T" if wheeled else "6T2A"
    own = {f"{role}.ground.rolling_resistance": 0.0}
    robot = paper_robot(wheeled, surface, left=own, right=own, **changes)
    if coulomb:
        for side in robot.sides:
            side.V_s, side.V_d, side.mu_d = 1e-9, 2e-9, side.mu_s
        robot.__post_init__()
    return robot


def spot_ratio(robot, omega):
    """v_w/(ω B/2) at which the ground's yaw moment vanishes on the spot."""
    edge, W = omega * robot.width / 2, robot.mass * paper.G

    def moment(ratio):
        return turning.ground(robot, 0.0, 0.0, omega, (-ratio * edge, ratio * edge), W).moment

    return brentq(moment, 1.0, 20.0, xtol=1e-13)


@pytest.mark.parametrize("wheeled", [False, True])
@pytest.mark.parametrize("equal", [False, True])
@pytest.mark.parametrize("rule", [1.0, 2.0])
def test_spot_turn_in_creep_follows_its_closed_form(wheeled, equal, rule):
    robot = ideal(wheeled, rule=rule, **({"ratio": 1.0} if equal else {}))
    expected = turning.spot_creep(LENGTH, WIDTH, robot.ratio**rule, wheeled)
    creeping = 1e-3 * robot.sides[0].V_s / LENGTH  # [rad/s]
    if rule == 1:
        assert spot_ratio(robot, creeping) == pytest.approx(expected, rel=1e-6)
    elif wheeled:  # alike contacts: whatever their size, the direction decides
        assert spot_ratio(robot, creeping) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("payload", [0.0, 8.0])
@pytest.mark.parametrize("omega", [1e-6, 0.01, 1.0])
def test_wheels_turn_on_the_spot_alike_at_any_speed_and_weight(payload, omega):
    robot = ideal(True, ratio=1.0, payload=payload)
    assert spot_ratio(robot, omega) == pytest.approx(1 + (LENGTH / WIDTH) ** 2, rel=1e-10)


@pytest.mark.parametrize("ratio, rule", [(1.0, 1.0), (1.2, 1.0), (1.2, 2.0), (0.5, 2.0)])
def test_spot_turn_under_coulomb_friction_follows_its_quadrature(ratio, rule):
    robot = ideal(coulomb=True, ratio=ratio, rule=rule, nodes=96)
    assert spot_ratio(robot, 1.0) == pytest.approx(turning.spot_coulomb(LENGTH, WIDTH, ratio, rule=rule), rel=1e-8)
    if ratio == 1.0:
        a, b = LENGTH / 2, WIDTH / 2
        u = b * (spot_ratio(robot, 1.0) - 1)
        assert (2 * b * u + u * u) * math.asinh(a / u) == pytest.approx(a * math.hypot(a, u), rel=1e-8)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5])
def test_lateral_sliding_has_the_moment_of_its_closed_form(share):
    robot = ideal(coulomb=True, scheme="uniform", nodes=1000)
    W, phi_y, omega = robot.mass * paper.G, robot.sides[0].mu_s * robot.ratio, 1.0
    ahead = share * LENGTH / 2  # L a_y / (2 g φ_y)
    rolled = -omega * robot.y  # no sliding along
    on = turning.ground(robot, 0.0, -omega * ahead, omega, rolled, W)
    assert on.F_y.sum() == pytest.approx(share * phi_y * W, rel=1e-6, abs=1e-9)
    expected = turning.moment_lateral(W, LENGTH, phi_y, False, share)
    assert -on.moment == pytest.approx(expected, rel=1e-6)
    if share == 0:
        axles = ideal(True, coulomb=True)
        on = turning.ground(axles, 0.0, 0.0, omega, -omega * axles.y, W)
        expected = turning.moment_lateral(W, LENGTH, axles.sides[0].mu_s * axles.ratio, True)
        assert -on.moment == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("wheeled", [False, True])
def test_side_slope_creeps_below_and_slides_above_its_lateral_adhesion(wheeled):
    robot = ideal(wheeled)
    phi_y = robot.sides[0].mu_s * robot.ratio
    for share in (0.3, 0.9, 0.999):
        slope = math.atan(share * phi_y)
        found = straight(robot, 0.5, slope, math.pi / 2, "speed")
        expected = robot.sides[0].creep(share * robot.sides[0].mu_s)
        assert found.v_y == pytest.approx(expected, rel=1e-6)
        assert found.v_x == pytest.approx(0.5, abs=1e-9)
    assert straight(robot, 0.5, math.atan(1.001 * phi_y), math.pi / 2, "speed") is None
    rolls = paper_robot(wheeled)  # on the ellipse: its resistance leaves less for the slope
    limit = phi_y * math.sqrt(1 - (rolls.sides[0].f / rolls.sides[0].mu_s) ** 2)
    assert straight(rolls, 0.5, math.atan(0.999 * limit), math.pi / 2, "speed") is not None
    assert straight(rolls, 0.5, math.atan(1.001 * limit), math.pi / 2, "speed") is None


def test_slope_drives_where_the_heading_says():
    robot = paper_robot()
    pull = robot.mass * paper.G * math.sin(0.1)
    for heading, (along, across) in (
        (0.0, (-1, 0)),
        (math.pi / 2, (0, 1)),
        (math.pi, (1, 0)),
        (-math.pi / 2, (0, -1)),
    ):
        state = np.zeros(len(STATES))
        state[2] = heading
        d = turning.rates(robot, Inputs(0.0, 0.0, slope=0.1), 0.0, state)
        assert_allclose(robot.mass * d[3:5], (pull * along, pull * across), atol=1e-9)


@pytest.mark.parametrize("wheeled", [False, True])
@pytest.mark.parametrize("heading", [0.3, 1.0, -2.5])
def test_equal_speeds_hold_any_heading_on_a_slope(wheeled, heading):
    """The forces of pure translation act at the loads' centre, right below the centre of mass: no yaw moment."""
    found = straight(paper_robot(wheeled), 0.5, 0.2, heading, "speed")
    assert found.steer == pytest.approx(0.0, abs=1e-12)
    assert found.v_y * math.sin(heading) > 0  # downhill
    volts = straight(paper_robot(wheeled), 15.0, 0.2, math.pi / 2)
    assert volts.steer < -1e-3  # the lower, left side loses more, and gets more
    assert volts.I[0] > volts.I[1]
