"""The two-sided world of `worlds.turning` against closed forms (issue 28), symmetries and its own energy."""

import copy
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from worlds import paper, turning
from worlds.turning import LENGTH, REACH, STATES, SURFACES, WIDTH, Inputs, circling, paper_robot, simulate, straight


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


def test_spot_turn_figures_of_the_issue():
    assert turning.spot_creep(LENGTH, WIDTH, 1.0, False) == pytest.approx(1.51, abs=0.005)
    assert turning.spot_creep(LENGTH, WIDTH, 1.0, True) == pytest.approx(2.52, abs=0.005)
    assert turning.spot_coulomb(LENGTH, WIDTH) == pytest.approx(1.336, abs=5e-4)
    assert turning.moment_lateral(13.1 * paper.G, LENGTH, 0.38, False) == pytest.approx(3.66, abs=0.005)


def test_flush_levers_turn_by_spinning_faster():
    spins = {s: turning.spot_coulomb(REACH, WIDTH, p[1] / p[0], 0.06 / p[0]) for s, p in SURFACES.items()}
    assert spins["concrete"] == pytest.approx(3.9, abs=0.05)
    assert spins["linoleum"] == pytest.approx(5.1, abs=0.05)
    assert turning.spot_coulomb(REACH, WIDTH, drag=1.0) is None
    for p in SURFACES.values():  # lateral sliding alone: the conservative form
        holds = turning.moment_lateral(1.0, REACH, p[1], False)
        assert (p[0] - 0.06) * WIDTH / 2 < holds
        assert (p[0] - 0.06) * WIDTH / 2 > turning.moment_lateral(1.0, LENGTH, p[1], False)


@pytest.mark.parametrize("wheeled", [False, True])
@pytest.mark.parametrize("voltage, slope", [(15.0, 0.0), (33.0, 0.1), (33.0, -0.05)])
def test_equal_voltages_travel_straight(wheeled, voltage, slope):
    robot = paper_robot(wheeled)
    current, w, speed = paper.Side(voltage, slope, 0.0, wheeled).steady()
    found = straight(robot, voltage, slope, 0.0)
    assert found.steer == pytest.approx(0.0, abs=1e-9)
    assert found.v_y == pytest.approx(0.0, abs=1e-12)
    assert_allclose(found.I, current, rtol=1e-9)
    assert_allclose(found.w, w, rtol=1e-9)
    assert found.v_x == pytest.approx(speed, rel=1e-9)


@pytest.mark.slow
def test_run_of_equal_voltages_is_the_half_robots():
    times = np.linspace(0.0, 0.3, 4)
    history = simulate(paper_robot(True), Inputs(15.0, 15.0, slope=0.05), times, rtol=1e-8, atol=1e-10)
    half = paper.Side(15.0, 0.05, 0.0, True).drive(times, rtol=1e-8, atol=1e-10)
    assert_allclose(history["I_left"][1:], half[1:, 0], rtol=1e-5)
    assert_allclose(history["w_right"][1:], half[1:, 1], rtol=1e-5)
    assert_allclose(history["x"][1:], half[1:, 3], rtol=1e-5)
    assert_allclose(history["omega"], 0.0, atol=1e-12)


@pytest.mark.slow
def test_circling_is_what_a_run_settles_on():
    robot, inputs = paper_robot(True), Inputs(15.0, 12.0)
    end = simulate(robot, inputs, np.array([0.0, 4.0]), method="LSODA", rtol=1e-8, atol=1e-10)
    found = circling(robot, inputs)
    for name, expected in (("v_x", found.v_x), ("v_y", found.v_y), ("omega", found.omega), ("I_left", found.I[0])):
        assert end[name][-1] == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("rule", [1.0, 1.5, 2.0])
def test_force_is_on_the_ellipse_and_takes_power(rule):
    robot = paper_robot(surface="linoleum", rule=rule)
    rng = np.random.default_rng(3)
    u = rng.normal(size=(2, 2, 200))
    F_x, F_y = turning.friction_share(robot, *u)
    phi_x, fall, V_s, V_d = robot.law
    used = turning.adhesion_used(np.hypot(*u), fall, V_s, V_d)
    assert_allclose(np.hypot(F_x / phi_x, F_y / (phi_x * robot.ratio)), used, rtol=1e-12)
    assert np.all(F_x * u[0] + F_y * u[1] > 0)
    along = turning.friction_share(robot, u[0], 0 * u[1])[0]
    expected = [
        [paper.friction(v, s.mu_s, s.mu_d, s.V_s, s.V_d) for v in row]
        for s, row in zip(robot.sides, u[0], strict=True)
    ]
    assert_allclose(along, expected, rtol=1e-12)
    if rule == 2:  # no force of the ellipse takes more
        angle = np.linspace(0, 2 * np.pi, 721)[:, None, None]
        taken = used * (phi_x * np.cos(angle) * u[0] + phi_x * robot.ratio * np.sin(angle) * u[1])
        assert np.all(taken.max(0) <= (F_x * u[0] + F_y * u[1]) * (1 + 1e-12))


@pytest.mark.parametrize("wheeled", [False, True])
@pytest.mark.parametrize("x_p", [0.0, 0.02, -0.05, 0.08, -0.13])
def test_loads_have_their_sum_and_centre(wheeled, x_p):
    robot = paper_robot(wheeled)
    x, share = turning.places(robot, x_p)
    assert share.sum() == pytest.approx(1.0, rel=1e-12)
    assert share @ x == pytest.approx(x_p, abs=1e-12)
    assert np.all(share >= 0) and np.all(np.abs(x) <= LENGTH / 2)


def test_loads_balance_the_forces():
    robot = paper_robot(surface="concrete", payload=8.0)
    W = robot.mass * paper.G
    on = turning.ground(robot, 0.3, 0.1, 2.0, (0.9, -0.2), W)
    assert on.N.sum() == pytest.approx(W, rel=1e-12)
    assert (on.N[1] - on.N[0]) * robot.width / 2 == pytest.approx(robot.height * on.F_y.sum(), rel=1e-12)
    assert on.x_p * W == pytest.approx(-robot.height * (on.F_x - on.R).sum(), rel=1e-9)
    tall = paper_robot(surface="concrete", height=0.4)
    on = turning.ground(tall, 0.0, 1.0, 0.0, (0.0, 0.0), W)  # dragged to the left: the left bears all
    assert on.tips and on.N[1] == 0.0


def test_one_weak_side_turns_in_straight_runs():
    robot = paper_robot(left={"6T2A.track.loss_coulomb": 0.5})
    found = circling(robot, Inputs(15.0, 15.0))
    assert found.omega > 1e-3  # to the side that loses more
    assert found.I[0] > found.I[1]


def test_quadratures_agree():
    fine, grousers = (
        circling(paper_robot(), Inputs(33.0, 15.0)),
        circling(paper_robot(nodes=12, scheme="uniform"), Inputs(33.0, 15.0)),
    )
    assert grousers.omega == pytest.approx(float(fine.omega), rel=0.02)
    assert circling(paper_robot(nodes=64), Inputs(33.0, 15.0)).omega == pytest.approx(float(fine.omega), rel=1e-4)


def test_sides_are_their_own():
    robot = paper_robot(right={"6T2A.ground.friction.static": 0.2})
    alike = copy.deepcopy(paper_robot())
    assert circling(robot, Inputs(33.0, 15.0)).omega != pytest.approx(
        float(circling(alike, Inputs(33.0, 15.0)).omega), rel=1e-6
    )
