"""Robots whose sides are driven apart: against a second implementation in NumPy and SciPy, and closed forms."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import turning as world

import mmrjax as mm
from mmrjax.model import balances, energy, paper_robots, params
from mmrjax.model.contact import Friction
from mmrjax.model.signals import STATUSES
from mmrjax.turning import circling as turning
from mmrjax.turning import two_sides as room
from mmrjax.turning.two_sides import Stance

grip = jax.jit(lambda *inputs: room.GroundForceInputs(*inputs).forces())
CONFIGURATIONS = ("6T2A", "4W2T")
#: Duties of left and right: one side slower, one held, on the spot, one driven backward by the turn, slow and backward,
#: straight.
DUTIES = ((1.0, 0.5), (0.0, 0.8), (-1.0, 1.0), (0.3, -0.1), (-0.25, -0.2), (0.7, 0.7))


def of_world(robot, configuration, payload=0.0, **changes):
    """The other implementation's robot, its stance that of ours."""
    run = mm.Conditions(configuration, payload=payload).resolved(robot)
    chassis = robot.configurations[configuration]
    stands = balances.stance(robot, run, chassis, chassis.mass + payload)
    own = {"height": float(stands.height), "inertia": float(chassis.turning.inertia)}
    return world.paper_robot(wheeled=configuration == "4W2T", payload=payload, nodes=16, **(own | changes))


@pytest.fixture(scope="module")
def turns(robot):
    """Settled turns at 33 V, as `DUTIES` say, of either configuration."""
    left, right = np.tile(DUTIES, (2, 1)).T
    which = np.repeat(CONFIGURATIONS, len(DUTIES))
    runs = mm.Conditions(which, voltage=33.0, duty_left=left, duty_right=right).resolved(robot)
    _, motion, status = jax.jit(jax.vmap(lambda c: turning.circling_signals(robot, c)))(runs)
    return jax.device_get(motion), np.array(STATUSES)[np.asarray(status)]


@pytest.mark.slow
def test_turns_are_found_past_kinks_of_friction_and_gears():
    """Of robots whose open side is dragged slowly: rates grow on the way to where the run settles. Drawn from 2000
    random ones, 37 of which were `not_settled`."""
    path = Path(__file__).parent / "data/turns_where_friction_turns_round.csv"
    table = np.genfromtxt(path, delimiter=",", names=True, deletechars="", dtype=float)
    conditions = ("configuration", "voltage", "payload", "adhesion", "open_left", "duty_left", "duty_right")
    values = {n: jnp.asarray(table[n]) for n in table.dtype.names if n not in conditions}

    @jax.jit
    def circled(values, stated):
        robot = params.replace(paper_robots.nominal(), values)
        run = mm.Conditions(**stated, open_right=0.0)
        unknowns, solved = turning._find_settled_unknowns(robot, run)
        travel, motion = turning._signals_and_motion(robot, run, unknowns)
        gains = travel.acceleration, travel.acceleration_lateral, travel.acceleration_yaw
        return motion.speed, jnp.stack(gains), solved

    stated = {n: jnp.asarray(table[n], int if n == "configuration" else float) for n in conditions}
    for k in range(len(table)):
        own = jax.tree.map(lambda x, k=k: x[k], (values, stated))
        speed, gains, solved = circled(*own)
        assert bool(solved) and abs(speed) > 1e-3
        assert_allclose(gains, 0.0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("k", [0, 1], ids=CONFIGURATIONS)
def test_circling_is_that_of_a_second_implementation(robot, turns, k):
    motion, other = turns[0], of_world(robot, CONFIGURATIONS[k])
    for n, (left, right) in enumerate(DUTIES, k * len(DUTIES)):
        found = world.circling(other, world.Inputs(left, right, kind="duty", supply=33.0))
        expected = (*found.I, *found.w, found.omega, found.v_x, found.v_y)
        plane = motion.yaw_rate[n], motion.speed[n], motion.speed_lateral[n]
        got = (*motion.current[n], *motion.speed_motor[n], *plane)
        assert_allclose(got, expected, rtol=1e-6, atol=1e-9, err_msg=str((left, right)))


@pytest.mark.slow
def test_every_turn_settles(turns):
    assert set(turns[1]) == {"converged"}


@pytest.mark.slow
def test_nothing_is_settled_on_a_slope_where_the_heading_changes(robot, monkeypatch):
    run = mm.Conditions("6T2A", voltage=33.0, duty_left=1.0, duty_right=0.5, slope_deg=5.0).resolved(robot)
    motion = turning.motion_of_unknowns(robot, turning.turning_start(robot, run).at[4].set(0.5))
    found = balances.turning_signals(robot, run, motion), motion, jnp.asarray(STATUSES.index("converged"))
    monkeypatch.setattr(turning, "circling_signals", lambda *_: found)
    assert STATUSES[int(turning.operating_point(robot, run)[0].status)] == "not_settled"


def flat(m):
    y = jnp.concatenate([m.current, m.speed_motor, jnp.stack([jnp.asarray(getattr(m, n)) for n in PLANE])])
    return y / jnp.asarray(turning._UNITS)


PLANE = ("speed", "speed_lateral", "yaw_rate", "heading", "place_x", "place_y", "discharge")


def powers(robot, run, motion):
    """Power that each sink takes [W]. With the growth of what is stored it is what the sources give."""

    def stored(m):
        return energy.stored_energy_turning(robot, balances.turning_signals(robot, run, m), m)

    @jax.jit
    def at(m):
        rate = turning.motion_of_unknowns(robot, turning.turning_rates(robot, run, flat(m)))
        # What is stored in shafts and windings changes with their rates; inductance and inertias do not.
        _, change = jax.jvp(stored, (m,), (rate,))
        travel = balances.turning_signals(robot, run, m)
        source = jnp.mean(jax.vmap(lambda c, s: energy.source_power(robot, c, s))(run.of_sides(), travel.signals))
        return source, energy.sink_powers_turning(robot, run, travel), change

    source, sinks, change = at(motion)
    assert (sum(sinks.values()) + change) == pytest.approx(float(source), rel=1e-9)
    return sinks


@pytest.mark.slow
@pytest.mark.parametrize("configuration", CONFIGURATIONS)
def test_energy_in_is_what_sinks_take_and_what_is_stored(robot, configuration):
    run = mm.Conditions(
        configuration, voltage=33.0, duty_left=0.9, duty_right=-0.2, slope_deg=12.0, heading_deg=40.0, payload=3.0
    ).resolved(robot)
    motion = turning.PlaneMotion(
        *(jnp.asarray(x) for x in ([2.0, -0.7], [900.0, -150.0], 0.3, 0.05, -1.1, 0.7, 0.0, 0.0, 0.0))
    )
    assert float(powers(robot, run, motion)["sliding"]) > 0


@pytest.mark.parametrize("configuration", CONFIGURATIONS)
def test_rates_are_those_of_a_second_implementation(robot, configuration):
    other = of_world(robot, configuration, payload=3.0)
    run = mm.Conditions(
        configuration, voltage=24.0, duty_left=0.9, duty_right=-0.3, slope_deg=11.0, payload=3.0
    ).resolved(robot)
    inputs = world.Inputs(0.9, -0.3, kind="duty", slope=np.radians(11.0), supply=24.0)
    law = jax.jit(lambda y: turning.turning_rates(robot, run, y))
    size, random = np.asarray(turning._UNITS), np.random.default_rng(5)
    for _ in range(12):
        y = random.normal(size=11) * np.array([0.2, 0.2, 0.8, 0.8, 0.4, 0.2, 0.15, 2.0, 1.0, 1.0, 0.0])
        mine = np.asarray(law(jnp.asarray(y))) * size
        place = [8, 9, 7, 4, 5, 6, 0, 1, 2, 3, 10]  # in the other's order
        theirs = world.rates(other, inputs, 0.0, (y * size)[place])
        assert_allclose(mine[place][:10], theirs[:10], rtol=1e-8, atol=1e-8)


def test_turning_numbers_are_those_of_the_paper(robot):
    for name, (x, y) in {"6T2A": world.SURFACES["wood"][:2], "4W2T": world.SURFACES["wood"][2:]}.items():
        own = robot.configurations[name].turning
        assert own.lateral == pytest.approx(y / x, rel=1e-12)
        assert own.inertia == world.INERTIA_YAW[name]
        assert own.width == world.WIDTH
        run = mm.Conditions(name, payload=8.0).resolved(robot)
        chassis = robot.configurations[name]
        height = float(balances.stance(robot, run, chassis, chassis.mass + 8.0).height)
        low, high = world.HEIGHT[name]
        mass = float(chassis.mass)
        assert height == pytest.approx((mass * low + 8 * high) / (mass + 8), abs=1e-3)


@pytest.mark.parametrize("rule", [1.0, 2.0])
def test_friction_is_on_its_ellipse_and_takes_power(rule):
    coulomb = Friction(static=0.3, dynamic=0.3, speed_static=1e-9, speed_dynamic=1e-8)
    stance = Stance(1e-6, 1.0, 0.0, 0.0, 0.0, 1.4, rule)
    for angle in np.linspace(0.0, 3.0, 7):
        u, v = np.cos(angle), np.sin(angle)
        held = grip(stance, coulomb, 1.0, 10.0, jnp.full(2, u), -v, 0.0, jnp.zeros(2))
        ahead, aside = float(jnp.sum(held.ahead)), float(jnp.sum(held.aside))
        assert (ahead / 3.0) ** 2 + (aside / 4.2) ** 2 == pytest.approx(1.0 if rule == 2 else u**2 + v**2, rel=1e-9)
        assert ahead * u + aside * v > 0
        assert jnp.sum(held.lateral_power) == pytest.approx(aside * v, abs=1e-12)


def test_load_moves_to_the_outer_side_and_to_the_rear_as_forces_say():
    stance = Stance(0.3, 0.243, 0.12, 0.01, 1.0, 1.2, 1.0)
    friction, rolling = Friction(static=0.6, dynamic=0.5), jnp.array([0.05, 0.05])
    held = jax.jit(lambda: grip(stance, friction, 1.0, 100.0, jnp.array([0.03, 0.05]), -0.05, 0.4, rolling))()
    along = float(jnp.sum(held.ahead - rolling * held.normal))
    assert held.load_transfer == pytest.approx(0.12 * float(jnp.sum(held.aside)) / 0.243, rel=1e-9)
    assert held.centre == pytest.approx(0.01 - 0.12 * along / 100.0, rel=1e-9)
    assert (held.normal[1] - held.normal[0]) == pytest.approx(2 * float(held.load_transfer), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("height, lifts", [(0.06, False), (0.2, True)])
@pytest.mark.parametrize("on_tracks", [0.0, 1.0])
def test_forces_and_their_derivatives_are_those_of_loads_in_balance(height, lifts, on_tracks):
    """Against sums over the nodes and differences, where all of a track bears and where its front has lifted off."""
    friction, load = Friction(static=0.9, dynamic=0.7), 100.0

    def held(x):
        stance = Stance(0.3, 0.5, height, 0.01, on_tracks, x[0], x[1])
        return grip(stance, friction, 1.0, load, x[2:4], x[4], x[5], jnp.array([0.05, 0.05]))

    x = jnp.asarray([1.2, 1.4, 0.015, 0.09, -0.03, 0.25])
    found = held(x)
    place, share = pressure(Stance(0.3, 0.5, height, 0.01, on_tracks, 1.2, 1.4), found.centre)
    along, across = x[2:4, None], -x[4] - x[5] * (place - 0.01)
    size = jnp.hypot(along, across)
    force = friction.coefficient(size) / jnp.hypot(along, 1.2**0.4 * across) * share * found.normal[:, None]
    assert_allclose(jnp.sum(force * along, 1), found.ahead, rtol=1e-9)
    assert_allclose(jnp.sum(1.2**1.4 * force * across, 1), found.aside, rtol=1e-9)
    assert_allclose(jnp.sum(1.2**1.4 * force * across * (place - 0.01), 1), found.moment, rtol=1e-9)
    assert bool((jnp.abs(found.centre) > 0.05) & (on_tracks > 0.5)) == (lifts and on_tracks > 0.5)
    assert found.load_transfer == pytest.approx(height * float(jnp.sum(found.aside)) / 0.5, rel=1e-9)
    exact, step = jax.jacfwd(held)(x), 1e-6
    for k in range(len(x)):
        ahead, behind = held(x.at[k].add(step)), held(x.at[k].add(-step))
        for name in ("normal", "ahead", "aside", "moment", "lateral_power", "load_transfer", "centre"):
            difference = (getattr(ahead, name) - getattr(behind, name)) / (2 * step)
            scale = 1e-6 * (1 + float(jnp.abs(difference).max()))
            assert_allclose(getattr(exact, name)[..., k], difference, rtol=1e-6, atol=scale, err_msg=name)


def pressure(stance, centre):
    """Nodes of a contact [m], from its middle, and the share of the load that each bears."""
    middle, half, tilt = room.loaded_part(stance, centre)
    line, weight = np.polynomial.legendre.leggauss(stance.nodes)
    place, share = (line, weight / 2) if stance.on_tracks else (np.array([-1, 1]), 0.5)
    return middle + place * half, share * (1 + tilt * place)
