"""The two-sided world of `worlds.turning` against closed forms (issue 28), symmetries and its own energy."""

import math

import pytest
from scipy.optimize import brentq
from worlds import paper, turning
from worlds.turning import LENGTH, WIDTH, paper_robot


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


def test_spot_turn_figures_of_the_issue():
    assert turning.spot_creep(LENGTH, WIDTH, 1.0, False) == pytest.approx(1.51, abs=0.005)
    assert turning.spot_creep(LENGTH, WIDTH, 1.0, True) == pytest.approx(2.52, abs=0.005)
    assert turning.spot_coulomb(LENGTH, WIDTH) == pytest.approx(1.336, abs=5e-4)
    assert turning.moment_lateral(13.1 * paper.G, LENGTH, 0.38, False) == pytest.approx(3.66, abs=0.005)


@pytest.mark.parametrize(("ratio", "rule"), [(1.0, 1.0), (1.2, 1.0), (1.2, 2.0), (0.5, 2.0)])
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
