"""The loop on tables of settled turns: what effects and defects of each side do to the readings, and what is found."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import turns as planted

import mmrjax as mm
from calibration.data import runs as records
from calibration.discovery.discover import discover
from calibration.discovery.loop_input import build_candidate_space, prepare_loop
from calibration.inference import bases as bases_room
from calibration.inference.fit_notes import remarks_with_codes
from calibration.inference.observers.turns import TurnLinearization
from mmrjax import effects
from mmrjax.effects.curve import ordinate_weights
from mmrjax.model import params

pytestmark = pytest.mark.slow

#: Of the library, one of each balance that a turn shows, beside those of turns.
SOME = ("supply_sag", "iron_loss")
COUNT = 8


@pytest.fixture(scope="module")
def posed(tmp_path_factory):
    """A small table of turns whose left side rubs more, as the loop poses it."""
    table, file = planted.write(tmp_path_factory.mktemp("turns"), "friction", COUNT)
    robot = mm.read_robot(str(file))
    library = {name: kind for name, kind in effects.BY_NAME.items() if name in SOME}
    ready = prepare_loop(records.read_runs(table, robot=robot), robot, noise=planted.NOISE, library=library)
    space = build_candidate_space(
        ready.runs, ready.robot, ready.noise.sd, ready.settings, ready.stated, ready.library
    )
    return space.bare, space


@pytest.fixture(scope="module")
def linear(posed):
    problem, space = posed
    z = jnp.zeros(space.free)
    found = jax.jit(lambda z: problem.observe.linearise(problem, z, space.library.scored))(z)
    return jax.device_get(found)


CURVES = ("curve_track_side", "curve_yaw_yaw_rate", "curve_slip_yaw_rate")


@pytest.fixture(scope="module")
def shown(posed):
    """Change of the whitened readings as an effect of a robot goes from nothing to an amplitude, by central
    difference. The others that are asked for here stand beside it without amplitude, so that one program serves."""
    problem, space = posed
    robot = problem.robot(jnp.zeros(space.free))
    kinds = [(effects.BY_NAME | effects.BESIDE)[name] for name in CURVES]
    absent = {kind: kind(amplitude=0.0) for kind in kinds}

    @jax.jit
    def of(present):
        there = dataclasses.replace(robot, effects=present)
        return problem.whitened(problem.observe(there))[: problem.data.measured.size]

    def at(effect, amplitude):
        own = eqx.tree_at(lambda e: e.amplitude, effect, amplitude)
        return of(jax.tree.map(lambda x: jnp.array(x, float), tuple((absent | {type(effect): own}).values())))

    return lambda effect, step: np.asarray(at(effect, step) - at(effect, -step)) / (2 * step)


def test_loop_looks_for_effects_of_turns_beside_the_library(posed):
    _, space = posed
    assert set(effects.OF_TURNS) < set(space.library.names) and set(SOME) & set(space.library.names)
    assert {"6T2A.turning.width", "6T2A.turning.lateral"} < set(space.coordinates.base.names)


@pytest.mark.parametrize("name", CURVES)
def test_column_of_a_curve_is_what_the_curve_does(linear, shown, name):
    """A curve that the loop fits is the one whose columns it scored."""
    _, balance, variable = name.split("_", 2)
    x, way = linear.curve_variable(balance, variable)
    assert x.shape == (linear.points,)
    ordinates = {"y0": 1.0, "y1": 0.4, "y2": 0.1, "y3": 0.0, "y4": -0.3, "y5": -0.2}
    ends = {"low": float(x.min()), "high": float(x.max())}
    effect = params.replace(effects.UNNAMED[name](), {n: jnp.asarray(v) for n, v in (ordinates | ends).items()})

    shapes = np.asarray(ordinate_weights(jnp.asarray(x), ends["low"], ends["high"]))
    columns = bases_room.place_signature(linear, balance, way[:, None] * shapes) @ np.array(list(ordinates.values()))
    size = 1e-4 * float(effect.amplitude or 1.0)
    wanted = shown(effect, size)
    assert np.abs(wanted).max() > 1.0
    assert_allclose(columns, wanted, rtol=2e-3, atol=1e-3 * np.abs(wanted).max())


def test_points_are_each_side_of_each_row(posed, linear):
    _, space = posed
    assert isinstance(linear, TurnLinearization) and linear.points == 2 * linear.rows
    mask = np.zeros(linear.points, bool)
    mask[linear.rows + 3] = True  # the right side of the fourth row
    assert np.flatnonzero(linear.of_rows(mask)).tolist() == [3]
    assert linear.at_points(space.included).sum() == 2 * COUNT
    side = linear.variable("side")
    assert (side[: linear.rows] == 1).all() and (side[linear.rows :] == -1).all()
    assert (linear.curve_variable("track", "speed_motor")[0] > 0).all()  # counted along the motion of its side


def test_what_a_channel_of_one_side_shows_is_off_by_that_side_alone(linear):
    shapes = np.ones((linear.points, 1))
    shapes[: linear.rows] = 0.0  # the right side alone
    by = [np.asarray(linear.channel_columns(k, shapes)).reshape(linear.rows, -1) for k in range(len(linear.channels))]
    moved = [float(np.abs(x).max()) for x in by]
    sides = {"left": 0.0, "right": 1.0}
    for k, name in enumerate(linear.channels):
        share = sides.get(name.rpartition("_")[2], 0.5)
        assert moved[k] == pytest.approx(share * float(linear.scale[:, k].max()))
        assert not np.delete(by[k], k, 1).any()


#: Table → the effect that has to be established; none: nothing is missing.
FOUND = {
    "clean": None, "friction": "side_friction", "voltage": "side_voltage", "moment": "turning_resistance",
    "grip": "lateral_grip",
}  # fmt: skip


@pytest.mark.parametrize("case, form", [
    ("clean", planted.rows), ("friction", planted.rows), ("voltage", planted.rows), ("moment", planted.rows), ("grip", planted.rows), ("friction", planted.log),
])  # fmt: skip
def test_what_a_second_implementation_planted_is_found(tmp_path, case, form):
    """In the whole library. Of a log, its settled turns are used."""
    table, file = planted.write(tmp_path, case, form=form)
    robot = mm.read_robot(str(file))
    found = discover(records.read_runs(table, robot=robot), robot, noise=planted.NOISE, replicates=250)
    members = {n for e in found.effects for n in e.members}
    if FOUND[case] is None:
        assert found.verdict == "none"
    else:
        assert found.verdict in ("named", "class") and FOUND[case] in members
    assert bool(remarks_with_codes(found.remarks, "settled_runs")) == (form is planted.log)
