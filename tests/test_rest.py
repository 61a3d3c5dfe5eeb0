"""One test of rest: whether a robot stands, slides or travels is alike in `steady`, `drive` and missions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import paper

from mmrjax.effects import BY_NAME
from mmrjax.fidelities.drive import drive
from mmrjax.fidelities.steady import steady, steady_batch
from mmrjax.missions.mission import mission
from mmrjax.missions.profile import profile
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import STALLED, STATUSES

WORDS = np.array(STATUSES)
KINDS = ("6T2A", "4W2T")
LOST = ("motor.", "gearbox.", *(f"{k}." for k in KINDS))
HEAT = ("thermal", "temperature", "time_constant")
EFFECTS = {"directional_friction": 0.06, "backdriving_loss": 0.3, "nonlinear_slip": 0.05}


def draw(count, seed):
    """Parameters of random robots by name, and a run of each: both movers, both signs, many that hardly move."""
    rng = np.random.default_rng(seed)
    names = [n for n in paper.NOMINAL if n.startswith(LOST) and not any(h in n for h in HEAT)]
    values = {n: paper.NOMINAL[n] * np.exp(rng.uniform(-0.4, 0.4, count)) for n in names}
    values["gearbox.efficiency_load"] = rng.uniform(0.5, 0.95, count)
    for kind in KINDS:
        static = values[f"{kind}.ground.friction.static"]
        values[f"{kind}.ground.friction.dynamic"] = static * rng.uniform(0.6, 0.95, count)
        values[f"{kind}.ground.friction.speed_dynamic"] = 10 * values[f"{kind}.ground.friction.speed_static"]
    voltage = rng.choice([1.0, 2.0, 6.0, 20.0], count) * rng.uniform(0.02, 1, count) * rng.choice([-1, 1], count)
    runs = Conditions(rng.integers(2, size=count), voltage, rng.uniform(-30, 30, count), rng.uniform(0, 8, count))
    return values, runs


def of_kind(values, runs, name):
    """A parameter of the configuration of each run."""
    return np.where(runs.configuration == 1, values[f"4W2T.{name}"], values[f"6T2A.{name}"])


def asked(values, runs):
    """Weight on the ground, pull of gravity, rolling resistance, and the demand of travel as the shafts would go [N]."""
    mass = (of_kind(values, runs, "mass") + np.asarray(runs.payload)) / 2
    slope = np.radians(np.asarray(runs.slope_deg))
    normal, pull = mass * paper.G * np.cos(slope), mass * paper.G * np.sin(slope)
    rolling = of_kind(values, runs, "ground.rolling_resistance") * normal
    stall = values["motor.torque_constant"] * np.asarray(runs.voltage) / values["motor.resistance"]
    sense = np.where(values["gearbox.ratio"] * stall >= pull * of_kind(values, runs, "radius"), 1, -1)
    return normal, pull, rolling, sense


def simulated(effects=()):
    """`steady` of every run with a robot of its own."""
    base = dataclasses.replace(paper_robots.nominal(), effects=effects)
    return jax.jit(jax.vmap(lambda v, c: steady(params.replace(base, v), c)))


@pytest.fixture(scope="module")
def by_steady():
    return simulated()


@pytest.mark.slow
def test_where_travel_asks_for_too_much_steady_says_what_an_independent_sum_says(by_steady):
    """Of gravity less rolling resistance against adhesion, and of the motors' torque where movers slide at V_s."""
    values, runs = draw(4000, 1)
    found = WORDS[np.asarray(by_steady(values, runs).status)]
    normal, pull, rolling, sense = asked(values, runs)
    limit = of_kind(values, runs, "ground.friction.static") * normal
    beyond = np.abs(pull + sense * rolling) > limit
    falls = np.abs(pull) - rolling > limit
    radius, ratio = of_kind(values, runs, "radius"), values["gearbox.ratio"]
    wheel = of_kind(values, runs, "ground.friction.speed_static") / radius
    motor = wheel * ratio
    current = (sense * np.asarray(runs.voltage) - values["motor.torque_constant"] * motor) / values[
        "motor.resistance"
    ]
    dry = values["motor.friction_coulomb"] + values["gearbox.friction_coulomb"]
    viscous = values["motor.friction_viscous"] + values["gearbox.friction_viscous"]
    torque = values["motor.torque_constant"] * current - dry - viscous * motor
    guide = of_kind(values, runs, "track.guide_friction") * of_kind(values, runs, "track.guide_share") * normal
    belt = of_kind(values, runs, "track.loss_coulomb") + of_kind(values, runs, "track.loss_viscous") * wheel
    spins = ratio * values["gearbox.efficiency_load"] * torque > belt + radius * (guide + limit)
    expected = np.where(falls | spins, "slides", "stalled")
    assert_array_equal(found[beyond], expected[beyond])
    assert "slides" not in found[~beyond] and "failed" not in found
    held = beyond & ~falls
    assert min((held & spins).sum(), (held & ~spins).sum(), falls.sum()) > 100


#: Voltage, slope [deg] and payload [kg] of a 6T2A that stands: parked on level ground and on slopes either way, with
#: rolling resistance in part, stalled, its motors too weak forward and backward.
STANDING = [
    (0.0, 0.0, 0.0), (0.0, 5.0, 60.0), (0.0, -5.0, 60.0), (0.0, 8.0, 60.0), (0.5, 5.0, 0.0), (0.5, 17.0, 0.0),
    (-0.02, 10.0, 0.0), (0.3, -2.0, 0.0), (-0.3, 0.0, 0.0),
]  # fmt: skip


def test_a_robot_that_stands_is_in_static_equilibrium(robot):
    """By formulas of their own: traction holds gravity along the slope as far as shafts and ground do, and the output
    carries what friction between it and the cause does not."""
    voltage, slope, payload = np.array(STANDING).T
    runs = Conditions(np.zeros(len(voltage), int), voltage, slope, payload)
    found = steady_batch(robot, runs)
    assert (found.status == STALLED).all()
    normal, pull = ((13.1 + payload) / 2 * paper.G * f(np.radians(slope)) for f in (np.cos, np.sin))
    radius = 48 * 5e-3 / (2 * np.pi)
    belt, current = 0.35 + 0.2 * 0.3 * radius * normal, voltage / 0.611
    drive = [0.0259 * current - way * (2.7e-3 + 0.3e-3) for way in (1, -1)]
    given = [48 * d * np.where(d * way > 0, 0.74, 1 / 0.74) for d, way in zip(drive, (1, -1), strict=True)]
    traction = np.clip(pull, (given[0] - belt) / radius, (given[1] + belt) / radius)
    traction = np.clip(traction, -0.32 * normal, 0.32 * normal)
    least, most = np.maximum(radius * traction - belt, given[0]), np.minimum(radius * traction + belt, given[1])
    torque = np.clip(0.0, least, most)
    assert (np.abs(traction - pull) > 1).sum() == 1 and (torque == 0).sum() == 2  # each part of the formula counts
    scale = dict(rtol=1e-9, atol=1e-12)
    assert_allclose(found.traction, 2 * traction, **scale)
    assert_allclose(found.adhesion_used, np.abs(traction) / (0.32 * normal), **scale)
    assert_allclose(found.output_torque, torque, **scale)
    assert_allclose(found.power_supply, 2 * 0.611 * current**2, rtol=1e-9, atol=1e-12)
    for name in ("power_motor", "power_gear", "power_ground", "power_lift", "slip", "speed", "efficiency_motor"):
        assert_array_equal(getattr(found, name), 0.0)


def agree(values, runs, effects, seconds=12.0):
    """Statuses by `steady`, by `drive` and at the end of a mission, and the speeds of the last two [m/s]."""
    base = dataclasses.replace(paper_robots.nominal(), effects=effects)
    cold = {f"motor.resistance_thermal_{part}": 1e-9 for part in ("winding", "housing")}  # windings do not heat
    base, over = params.replace(base, cold), profile([0.0, seconds], duty=1.0)

    def one(values, run):
        robot = params.replace(base, values)
        driven, done = drive(robot, run, jnp.asarray([0.0, seconds])).result, mission(robot, run, over)
        return driven.status, done.status[0, 0], driven.speed, done.result.speed

    found = jax.jit(jax.vmap(one))(values, runs)
    still = simulated(effects)(values, runs).status
    return [WORDS[np.asarray(s)] for s in (still, *found[:2])], [np.asarray(x) for x in found[2:]]


@pytest.mark.nightly
@pytest.mark.parametrize("effects", [{}, EFFECTS], ids=["plain", "effects"])
def test_statuses_agree_over_random_robots_slopes_and_voltages(effects):
    terms = tuple(params.replace(BY_NAME[name](), {"amplitude": a}) for name, a in effects.items())
    values, runs = draw(300, 5)
    (still, driven, done), (speed, covered) = agree(values, runs, terms)
    assert_array_equal(driven, done)
    moves = ~np.isin(driven, ("stalled", "slides"))
    assert_allclose(covered[moves], speed[moves], rtol=2e-3, atol=2e-4)
    normal, pull, rolling, sense = asked(values, runs)
    share = np.abs(pull + sense * rolling) / normal
    static, dynamic = (of_kind(values, runs, f"ground.friction.{k}") for k in ("static", "dynamic"))
    # Between μ_d and μ_s steady travel exists, to which a start that slides does not find.
    either = (share > 0.97 * dynamic) & (share < 1.03 * static) & np.isin(still, ("converged", "reverses"))
    assert set(driven[either]) <= {"slides", "not_settled", "converged", "reverses"}
    assert_array_equal(still[~either], driven[~either])
    counted = {
        word: int((still == word).sum()) for word in ("stalled", "slides", "converged", "reverses", "rolls_back")
    }
    assert min(counted.values()) >= 1 and sorted(counted.values())[1] > 40 and either.sum() < 60
