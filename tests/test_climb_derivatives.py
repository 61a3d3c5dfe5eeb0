"""Margins of a climb and their derivatives along its simulation: against finite differences and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mmrjax.climbing import climb_derivatives as room
from mmrjax.climbing.climb_simulation import ClimbMotion, ClimbRecord, climb_batch, constant_angles
from mmrjax.climbing.terrain import single_step
from mmrjax.fidelities.variation import Variation
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_robots import nominal

ROBOT = params.without_weak_types(nominal())


def test_smoothed_least_is_between_least_and_mean_and_smooth():
    values = jnp.array([0.3, 0.32, 0.9])
    assert 0.3 < float(room.smooth_minimum(values)) < 0.36 < float(values.mean())
    assert float(room.smooth_minimum(jnp.full(7, -0.2))) == pytest.approx(-0.2)
    slopes = jax.grad(room.smooth_minimum)(values)
    assert float(slopes.sum()) == pytest.approx(1.0) and slopes[0] > slopes[1] > 1e-2 > slopes[2]


def passed(count, place, **other):
    """A record in closed form, samples of 0.5 s with the centre of mass at `place` [m]."""
    zero = jnp.zeros(count)
    of = {name: zero for name in ClimbRecord.__dataclass_fields__}
    of |= dict(time=0.5 * jnp.arange(count), voltage=zero + 12.0, current=zero + 2.0, centre=jnp.asarray(place))
    of |= dict(energy={"supply": 10.0 * jnp.arange(count), "levers": zero}, lever_current=jnp.zeros((count, 2)))
    of |= dict(motion=ClimbMotion(jnp.zeros((count, 6)), jnp.zeros((count, 6)), zero, zero, zero), grip=zero + 0.25)
    return ClimbRecord(**(of | other))


def test_margins_are_shares_and_the_crest_is_between_samples():
    ground, record = single_step(0.08), passed(4, [-0.2, -0.1, 0.3, 0.4])
    crest = room.crest_sample(ground, record, True)
    found = {name: float(x) for name, x in room.climb_outputs(ROBOT, ground, record, crest).items()}
    assert crest == 2 and list(found) == list(room.OUTPUTS)
    assert found["crest_time_s"] == pytest.approx(0.5 + 0.25 * 0.5)
    assert found["crest_energy_J"] == pytest.approx(10 + 0.25 * 10)
    assert found["margin_grip"] == pytest.approx(0.75) and found["margin_reach"] == 1
    torque = 1 - 2.0 * float(ROBOT.motor.resistance) / 12.0  # of two samples of three: the first is before the start
    assert torque < found["margin_torque"] < torque + 0.05
    assert 0.7 < found["margin_success"] < 0.85
    short = room.climb_outputs(ROBOT, ground, passed(4, [-0.2, -0.1, -0.06, -0.06]), None)
    assert float(short["margin_reach"]) == pytest.approx(-0.06 / 0.15) and float(short["margin_success"]) < -0.25
    assert float(short["crest_time_s"]) == 1.5


def given(values):
    """A climb by payload and height of the step [mm]."""
    base = jax.tree.map(jnp.asarray, Conditions(0, voltage=6.0, adhesion=2.0).resolved(ROBOT))
    robot, conditions = Variation(ROBOT, ("payload",)).at(values[:1], base)
    angles = (jnp.radians(jnp.asarray(x)) for x in (45.0, 180.0))
    return room.ClimbInputs(robot, conditions, single_step(values[1] / 1000, size=4), constant_angles(*angles))


@pytest.mark.nightly
def test_derivatives_are_the_limits_of_finite_differences_with_contacts_at_the_edge():
    """From standing onto the edge, whose grousers open and close: the same to four digits. Over a stretch slopes tell."""
    values = jnp.array([1.0, 60.0])
    options = dict(duration=2.4, step=4e-4, part=0.8)
    found = room.climb_derivatives(given, values, jnp.array([0.2, 1.0]), **options)
    pitch = found.climb.record.motion.q[0, :, 2]
    assert found.climb.names == ["unfinished"] and np.ptp(pitch) > 0.1  # it climbs
    moves = np.diag([1e-6, 1e-5])  # with ten times as much a grouser of the step's edge bears earlier
    rows = jnp.concatenate([values + moves, values - moves])
    # as many as the slopes take, whose program serves them too
    beside = jax.vmap(given)(jnp.resize(rows, (len(values) * room.BESIDE, len(values))))
    batch = climb_batch(*beside, **options)
    each = [jax.tree.map(lambda x, k=k: x[k], (beside.robot, beside.terrain)) for k in range(4)]
    ends = [room.outputs_of_run(*of, batch, k) for k, of in enumerate(each)]
    for name in ("margin_success", "margin_reach", "margin_upright", "crest_energy_J", "crest_current_rms_A"):
        up, down = (np.array([float(end[name]) for end in half]) for half in (ends[:2], ends[2:]))
        finite = (up - down) / (2 * np.diag(moves))
        rounded = 1e-11 * abs(found.outputs[name]) / np.diag(moves)  # what a run of 6000 steps is known to
        assert (np.abs(found.derivatives[name] - finite) < 1e-4 * np.abs(finite) + rounded).all(), name
        assert np.isfinite(found.slope[name]).all() and (found.slope_sd[name] >= 0).all()
    # a heavier robot takes more energy, by whichever
    by, slope, sd = (x["crest_energy_J"][0] for x in (found.derivatives, found.slope, found.slope_sd))
    assert by > 0 and abs(by - slope) < 5 * sd + 0.2 * slope
