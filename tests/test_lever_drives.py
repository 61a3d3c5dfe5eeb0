"""Drives of levers: closed forms of one lever under load, and the law of both pairs at random states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng

from mmrjax.climbing.levers import lever_drive, step_levers
from mmrjax.model import params
from mmrjax.model.paper_robots import nominal

ROBOT = nominal()
INERTIA, STEP = 0.3, 1e-4  # of a pair with what it carries [kg·m²]; [s]


def with_worm(efficiency, **levers):
    values = {"worm_efficiency": efficiency, **levers}
    return params.replace(ROBOT, {f"running_gear.levers.{name}": x for name, x in values.items()})


def turned(robot, load, least, most, asked=0.0, time=0.05, begins=0.0):
    """One pair that carries a `load` down [N·m], after `time`: its rate and what the drive did in the last step."""
    drive, n = lever_drive(robot), round(time / STEP)
    yields = jnp.eye(2) * STEP / INERTIA

    def one(rate, _):
        free = rate - STEP * jnp.array([load, 0.0]) / INERTIA
        done = step_levers(
            drive, STEP, rate, free, yields, asked + jnp.zeros(2), least + jnp.zeros(2), most + jnp.zeros(2)
        )
        return done.rate, done

    rates, done = jax.lax.scan(one, jnp.array([begins, 0.0]), None, length=n)
    return float(rates[0]), jax.tree.map(lambda x: np.asarray(x)[-1, 0], done)


def closed(load, volts, efficiency, share, time=0.05):
    """Rate of that pair by hand, moving one way from rest: (c M + J i²) ω' = i C_m (U - i C_m ω) / R - i M_f - c G."""
    ratio, c_m, r = 30 * 23.04, 25.9e-3, 0.611
    way = np.sign(volts)
    drag = (ratio * c_m) ** 2 / r + ratio**2 * 5.5e-7
    inertia = 33.5e-7 * ratio**2 + share * INERTIA
    end = (ratio * c_m * volts / r - way * ratio * 2.7e-3 - share * load) / drag
    return end * (1 - np.exp(-time * drag / inertia))


LIFT, LOWER = 1 / (0.5 * 0.75), 0.0  # c of a worm of 1/2 behind a planetary gear of 3/4
TABLE = {
    "lifts": (12.0, 20.0, 0.5, LIFT),
    "lowers, its load borne by the worm": (-12.0, 20.0, 0.5, LOWER),
    "lifts through a better worm": (12.0, 20.0, 0.8, 1 / 0.6),
    "lowers through it, its load driving": (-12.0, 20.0, 0.8, (2 - 1 / 0.8) * (2 - 1 / 0.75)),
    "lowers through a worse worm, the motor helping": (-12.0, 20.0, 0.4, (2 - 1 / 0.4) / 0.75),
}


@pytest.mark.parametrize("case", TABLE)
def test_lever_under_load_at_a_voltage_moves_as_in_closed_form(case):
    volts, load, efficiency, share = TABLE[case]
    # a lever that is lowered is pushed at first
    for time in (2e-3, 0.05) if volts > 0 else (0.05,):
        rate, _ = turned(with_worm(efficiency), load, volts, volts, time=time)
        assert rate == pytest.approx(closed(load, volts, efficiency, share, time), rel=0.01)


def test_worm_up_to_one_half_holds_and_a_better_one_lets_the_lever_sink():
    rate, done = turned(with_worm(0.5), 60.0, 0.0, 0.0)
    assert rate == 0 and done.holds and done.torque == pytest.approx(60.0) and done.current == 0
    rate, done = turned(with_worm(0.8), 60.0, 0.0, 0.0)
    assert rate < -0.05 and not done.holds
    # asked to stand it takes a current, the least that does: what its load drives less the friction of its motor
    rate, done = turned(with_worm(0.8), 60.0, -12.0, 12.0)
    back = (2 - 1 / 0.8) * (2 - 1 / 0.75)
    assert rate == 0 and not done.holds
    assert done.current == pytest.approx((back * 60.0 / (30 * 23.04) - 2.7e-3) / 25.9e-3)


@pytest.mark.slow
def test_rate_that_is_asked_for_is_had_until_the_voltage_or_the_current_ends():
    def asked(rate, load=20.0, robot=ROBOT, time=0.1):
        return turned(robot, load, -12.0, 12.0, asked=rate, time=time)

    rate, done = asked(0.3)
    assert rate == pytest.approx(0.3) and 0 < done.voltage < 12
    rate, done = asked(1.0)
    assert done.voltage == 12 and rate == pytest.approx(closed(20.0, 12.0, 0.5, LIFT, 1.0), rel=1e-3)
    rate, done = asked(1.0, load=150.0, time=0.05)
    assert rate == 0 and done.voltage == 12 and done.current == pytest.approx(12 / 0.611)
    limited = with_worm(0.5, current_limit=4.0)
    assert asked(0.3, robot=limited)[0] == pytest.approx(0.3)
    rate, done = asked(0.3, load=40.0, robot=limited, time=0.05)
    assert rate == 0 and done.current == pytest.approx(4.0)


def test_both_pairs_obey_their_law_together_at_random_states():
    """What carries them and what drives them agree. A pair that moves has its friction against it, one that stands
    what friction can hold, and a voltage is at its end where a rate is not what is asked for."""
    random, n = default_rng(3), 400
    drives = [lever_drive(with_worm(efficiency)) for efficiency in (0.5, 0.7)]
    whole = random.normal(size=(n, 2, 2))
    yields = STEP * np.linalg.inv(whole @ whole.transpose(0, 2, 1) + 0.05 * np.eye(2)) / 2
    rate = 0.5 * random.normal(size=(n, 2)) * (random.random((n, 2)) < 0.7)
    free = rate + np.einsum("nij,nj->ni", yields, 60 * random.normal(size=(n, 2)))
    asked = np.where(random.random((n, 2)) < 0.7, rate + 2e-3 * random.normal(size=(n, 2)), 0.0)
    volts = np.where(random.random((n, 1)) < 0.5, 12.0, 4.0) + np.zeros((n, 2))
    for k in drives:
        done = jax.vmap(lambda *x, k=k: step_levers(k, STEP, *x))(rate, free, yields, asked, -volts, volts)
        torque, after, voltage, current = (np.asarray(x) for x in done[:4])
        assert after == pytest.approx(free + np.einsum("nij,nj->ni", yields, torque), abs=1e-9)
        assert current == pytest.approx(np.asarray((voltage - k.constant * after) / k.resistance), abs=1e-9)
        # on the motor's side of the gears, without its friction
        left = k.constant * current - k.inertia * (after - rate) / STEP - k.viscous * after
        up = np.where(torque > 0, k.ahead, k.back) * torque + k.dry
        down = np.where(torque < 0, k.ahead, k.back) * torque - k.dry
        scale = 1e-6 * (1 + np.abs(torque))
        assert (left > np.where(after > 1e-12, up, down) - scale).all()
        assert (left < np.where(after < -1e-12, down, up) + scale).all()
        got = np.abs(after - asked) < 1e-6
        ends = np.where(asked > after, voltage > volts - 1e-9, voltage < 1e-9 - volts)
        assert (got | ends).all(), (got | ends).mean()
        assert 0.1 < got.mean() < 0.9 and (after == 0).any() and done.holds.any()
