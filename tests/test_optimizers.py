"""The fit: exact Jacobians, both optimizers, many starts, recovered truth, coverage, and what holds what."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.data import runs as records
from calibration.inference import blocks as holdout
from calibration.inference import identifiability, noise, observers, priors, problem
from calibration.inference import optimizers as fit
from calibration.inference.levenberg_marquardt import (
    NEAR,
    NEARLY_ALL,
    OneSidedLevenbergMarquardt,
    one_sided_step,
    zero_inactive_residuals,
)
from mmrjax.model import paper_robots
from mmrjax.model.signals import CONVERGED, SLIDES

solve = eqx.filter_jit(lambda *args, **options: fit.levenberg_marquardt(*args, **options)[0])
STATED = "current=2%,motor_speed=0.5%,speed=1%"


def pose(runs, robot, names=None, model="steady", stated=STATED):
    names = (
        priors.choose_free_names(robot, priors.default_names(runs["configuration"], robot))
        if names is None
        else names
    )
    return observers.pose_problem(runs, robot, priors.parameter_coordinates(robot, names), sds(runs, stated), model)


def sds(runs, stated):
    return noise.noise_from_table(runs, observers.observer_kind(runs).sizes(runs), stated).sd


@pytest.fixture(scope="module")
def measured():
    return records.read_runs("measured")


@pytest.fixture(scope="module")
def posed(measured):
    return pose(measured, paper_robots.nominal())


@pytest.fixture(scope="module")
def truth(posed):
    """A robot that reaches every row: adhesion 0.6, V_s 0.05 m/s, the others within an sd of nominal."""
    z = 0.7 * np.random.default_rng(3).standard_normal(len(posed.coordinates))
    at = {"static": 0.6, "speed_static": 0.05}
    for k, name in enumerate(posed.coordinates.names):
        value = at.get(name.rsplit(".", 1)[1])
        if value is not None:
            z[k] = (np.log(value) - float(posed.coordinates.location[k])) / float(posed.coordinates.spread[k])
    return jnp.asarray(z)


@pytest.fixture(scope="module")
def clean(posed, truth):
    """The same problem with readings of the true robot, without noise, and bench values that are right."""
    reading = posed.observation(truth).reading
    return posed.with_data(measured=reading, centre=truth)


def residuals(problem, z):
    return jnp.concatenate([problem.misfit(z), z - problem.data.centre])


class Bent(eqx.Module):
    """An observer of rows with residuals a function of four numbers: curved, and with a penalty beyond a line."""

    long: bool = eqx.field(static=True, default=False)
    solves_separately: bool = eqx.field(static=True, default=False)

    def solve(self, robot):
        return None

    def __call__(self, robot):
        x = jnp.linspace(0.0, 1.0, 6)
        first = robot[0] * jnp.exp(-3 * x * robot[1]) + robot[2]
        second = jnp.sin(2 * robot[3] * x) + robot[0] * robot[2]
        used = jnp.full(6, 0.975) + 0.01 * robot[3] * x
        codes = jnp.zeros(6, int)
        return problem.Observation(jnp.stack([first, second], 1), used, codes, codes)


class Plain(eqx.Module):
    """Coordinates that are the robot."""

    size: int = eqx.field(static=True, default=4)

    def __len__(self):
        return self.size

    def robot(self, base, z):
        return z


@eqx.filter_jit
def alone(posed, members, max_steps):
    """Each search by itself."""

    def one(member):
        return fit.levenberg_marquardt(member.problem(posed), member.start, max_steps=max_steps)

    return jax.vmap(one)(jax.tree.map(jnp.asarray, members))


@pytest.fixture(scope="module")
def bent():
    """A small problem, nine searches of it with data and starts of their own, and where each ends by itself."""
    rng = np.random.default_rng(1)
    data = problem.data_from_readings(rng.standard_normal((6, 2)), np.full((6, 2), 0.1), 4)
    measured = rng.standard_normal((9, 6, 2))
    weight = (rng.random((9, 6, 2)) > 0.1).astype(float)
    members = fit.SearchMember(rng.standard_normal((9, 4)), weight, measured, 0.1 * rng.standard_normal((9, 4)))
    posed = problem.Problem(None, Plain(), Bent(), data)
    return posed, members, alone(posed, members, 40)


@pytest.mark.slow
@pytest.mark.parametrize("places", [2, 16])
def test_searches_do_not_depend_on_those_beside_them(bent, places):
    """Whatever waits, ends and takes whose place, each search is what it is alone, steps included."""
    posed, members, (wanted, seen) = bent
    assert len({*np.asarray(wanted.steps).tolist()}) > 3  # they end at different times
    found, here = fit.search_refilling(posed, members, 40, places)
    assert_array_equal(found.steps, wanted.steps)
    assert_allclose(found.z, wanted.z, rtol=1e-9, atol=1e-9)
    assert_allclose(found.cost, wanted.cost, rtol=1e-9)
    assert_allclose(here.reading, seen.reading, rtol=1e-9, atol=1e-9)


def test_steps_are_those_of_another_implementation(bent):
    """Against `optimistix.LevenbergMarquardt`, evaluation by evaluation, accepted and rejected ones."""
    import lineax as lx

    posed, members, _ = bent
    solver = optx.LevenbergMarquardt(rtol=fit.TOLERANCE, atol=fit.TOLERANCE, linear_solver=lx.QR())
    shares = optx.ClassicalTrustRegion(high_cutoff=NEARLY_ALL)
    solver = eqx.tree_at(lambda s: s.search, solver, shares)
    ours = OneSidedLevenbergMarquardt(fit.TOLERANCE, near=0.0)  # it does not mix
    member = jax.tree.map(lambda x: jnp.asarray(x[2]), members)
    function = functools.partial(residuals, member.problem(posed))

    def theirs(z, _):
        return function(z), None

    def step(by, y, state):
        y, state, _ = by.step(theirs, y, None, {}, state, frozenset())
        return y, state, by.terminate(theirs, y, None, {}, state, frozenset())[0]

    @eqx.filter_jit
    def both(y, state, at):
        at = ours.step(at, function(at.ahead), jax.jacfwd(function)(at.ahead), None)
        return *step(solver, y, state), at

    y = 3 * member.start
    shape, rejected = jax.eval_shape(lambda: function(y)), 0
    state = solver.init(theirs, y, None, {}, shape, None, frozenset())
    at = ours.begin(y, shape.size, None)
    for _ in range(40):
        y, state, ended, at = both(y, state, at)
        assert_allclose(at.y, y, rtol=1e-7, atol=1e-9)
        assert_allclose(at.ahead, state.y_eval, rtol=1e-6, atol=1e-8)
        rejected += int(at.rejected > 0)
        assert bool(at.over) == bool(ended)
        if ended:
            break
    assert bool(at.over) and rejected > 0


def test_a_penalty_within_its_edge_is_no_residual(bent):
    posed, truth = bent[0], jnp.asarray([0.7, 0.4, -0.2, 0.3])
    assert (posed.adhesion_excess(posed.observation(truth)) < -1).all()
    r, jacobian, _ = fit._evaluate_residuals(posed, truth)
    r, jacobian = fit.clip_penalties(r, jacobian, posed.data)
    penalties = fit.adhesion_penalty_slice(posed.data)
    assert penalties.stop > penalties.start and not np.any(r[penalties]) and not np.any(jacobian[penalties])


def test_a_start_that_is_not_finite_is_no_optimum(bent):
    posed, members, (wanted, _) = bent
    found, _ = alone(posed, dataclasses.replace(members, start=np.r_[np.full((1, 4), np.nan), members.start[1:]]), 40)
    assert not found.converged[0] and not np.isfinite(found.cost[0])
    assert_array_equal(found.cost[1:], wanted.cost[1:])


@pytest.mark.slow
def test_search_has_its_model_in_one_place_of_its_program(posed):
    """What a search costs to compile is one evaluation of the model with its Jacobian, not one for each use of it."""

    rows = str(jax.core.ShapedArray((len(posed.data.measured),), float))

    def loops(jaxpr):
        """Searches for the operating point: innermost loops whose state has numbers of each row."""
        found = 0
        for e in jaxpr.eqns:
            inner = [v for x in e.params.values() for v in (x if isinstance(x, tuple) else (x,))]
            inner = [getattr(v, "jaxpr", v) for v in inner if hasattr(getattr(v, "jaxpr", v), "eqns")]
            within = sum(map(loops, inner))
            found += within or (e.primitive.name == "while" and rows in [str(x.aval) for x in e.outvars])
        return found

    start = jnp.zeros(len(posed.coordinates))
    one = jax.make_jaxpr(jax.jacfwd(lambda z: posed.misfit(z)))(start)
    search = jax.make_jaxpr(lambda z: fit.levenberg_marquardt(posed, z)[0].cost)(start)
    assert loops(search.jaxpr) == loops(one.jaxpr) == 1


def test_one_evaluation_has_the_derivatives_of_the_root(posed, truth):
    """Over coordinates and unknowns together, unknowns eliminated: as through the root itself, where runs slide too."""
    one = jax.jit(lambda z: posed.linearised(posed.robot, z)[:2])

    def signed(z):
        return (posed.signed(posed.observation(z)),) * 2

    root = jax.jit(jax.jacfwd(signed, has_aux=True))
    for z in (truth, jnp.zeros_like(truth)):
        (r, jacobian), (through, wanted) = one(z), root(z)
        assert_allclose(r, wanted, rtol=1e-9, atol=1e-9)
        assert_allclose(jacobian, through, rtol=1e-7, atol=1e-9 * np.abs(through).max())


@pytest.mark.slow
def test_the_objective_is_finite_where_the_robot_slides_and_leads_back(posed):
    nominal_z = jnp.zeros(len(posed.coordinates))
    seen = posed.observation(nominal_z)
    assert np.sum(seen.status == SLIDES) == 6  # Table 5's adhesion against 15 and 20 degrees
    assert np.all(np.isfinite(seen.reading))
    gradient = jax.grad(lambda z: 0.5 * jnp.sum(residuals(posed, z) ** 2))(nominal_z)
    for name, g in zip(posed.coordinates.names, np.asarray(gradient), strict=True):
        if name.endswith("friction.static"):
            assert g < 0  # more adhesion costs less
    found = solve(posed, nominal_z)
    assert found.converged
    assert np.all(posed.observation(found.z).status == CONVERGED)


@pytest.mark.slow
def test_a_penalty_that_holds_nothing_moves_nothing(clean, truth):
    found = solve(clean, truth + 0.3)
    again = solve(clean.with_data(stiffness=clean.data.stiffness * 100), truth + 0.3)
    assert_allclose(found.z, again.z, atol=1e-6)


BENDS = jnp.asarray([0.8, 0.02, 0.0])


def large_residuals(z, held):
    """z + 1 and b z² + z - 1 of each coordinate, least at z = 0, where a Gauss-Newton step leaves the share b of z
    (Dennis and Schnabel 1983, example 10.2.4), and a penalty below z₀ = 0.2 where `held`."""

    def function(z):
        edge = jnp.where(held, 300.0 * (0.2 - z[0]), -1.0)
        return jnp.concatenate([z + 1, BENDS * z**2 + z - 1, edge[None]])

    return function(z)


def to_the_end(start, held, near=NEAR):
    """The search of `large_residuals` from a start, of which steps below `near` are mixed."""
    solver, function = OneSidedLevenbergMarquardt(1e-9, 6, 7, near=near), lambda z: large_residuals(z, held)

    def step(at):
        return solver.step(at, function(at.ahead), jax.jacfwd(function)(at.ahead), None)

    begin = solver.begin(jnp.asarray(start), 7, None)
    return jax.lax.while_loop(lambda at: ~at.over & (at.steps < 400), step, begin)


STARTS = np.random.default_rng(3).uniform(0.3, 0.8, (6, 3))


def test_search_is_short_where_residuals_are_large():
    mixed = [to_the_end(z, False) for z in STARTS]
    plain = [to_the_end(z, False, near=0.0) for z in STARTS[:2]]
    for end in (*mixed, *plain):
        assert_allclose(end.y, 0.0, atol=1e-7)
    assert max(end.steps for end in mixed) < 30 < 60 < min(end.steps for end in plain)


def test_search_goes_along_the_edge_of_a_penalty():
    """From where nothing shows it. By steps that know only what is in force where they begin it took hundreds."""
    for start in STARTS:
        end = to_the_end(start, True)
        assert end.steps < 30
        assert_allclose(end.y[1:], 0.0, atol=1e-6)
        assert 0.1999 < end.y[0] < 0.2
        assert jnp.linalg.norm(one_sided_step(end.residual, end.jacobian, slice(6, 7), 0.0)) < 1e-6


def test_stride_is_the_optimum_beyond_and_along_the_edges_of_penalties():
    """Against SciPy's general minimiser, with penalties that begin on either side of their edge."""
    from scipy.optimize import minimize

    rng, crossed, held = np.random.default_rng(5), 0, slice(10, 16)
    stride = jax.jit(lambda r, jacobian: one_sided_step(r, jacobian, held, 0.3))
    for _ in range(20):
        jacobian, residual = rng.standard_normal((16, 4)), rng.standard_normal(16)
        jacobian[held] *= 30.0

        def objective(d, jacobian=jacobian, residual=residual):
            ahead = residual + jacobian @ d
            ahead[held] = np.maximum(ahead[held], 0.0)
            return 0.5 * np.sum(ahead**2) + 0.15 * np.sum(d**2)

        step = np.asarray(stride(residual, jacobian))
        best = minimize(objective, step, method="BFGS", options={"gtol": 1e-9})
        assert objective(step) == pytest.approx(best.fun, rel=1e-6)
        r, slope = zero_inactive_residuals(jnp.asarray(residual), jnp.asarray(jacobian), held)
        plain = -np.linalg.solve(slope.T @ slope + 0.3 * np.eye(4), slope.T @ r)
        crossed += objective(plain) > objective(np.zeros(4))
    assert crossed > 5  # where the Gauss-Newton step leads to a higher place


def test_directions_that_no_data_tell_apart_are_the_same_from_any_basis():
    random = np.random.default_rng(4)
    plane = np.linalg.qr(np.stack([np.eye(6)[2], [3.0, 4.0, 0, 0, 0, 0], [0, 0, 0, 1.0, -1.0, 2.0]], 1))[0].T
    turned = np.linalg.qr(random.standard_normal((3, 3)))[0] @ plane
    found = identifiability.separate_directions(turned)
    assert_allclose(found, identifiability.separate_directions(plane), atol=1e-12)
    assert_allclose(found.T @ found, plane.T @ plane, atol=1e-12)
    assert_allclose(found[:2], [np.eye(6)[2], np.array([0, 0, 0, 1.0, -1.0, 2.0]) / 6**0.5], atol=1e-12)
    assert identifiability.separate_directions(np.zeros((0, 6))).shape == (0, 6)


@pytest.mark.slow
def test_what_only_its_prior_holds_is_said(measured, robot):
    names = (
        *priors.default_names(measured["configuration"], robot),
        "motor.inductance",
        "6T2A.track.guide_friction",
    )
    posed = pose(measured, robot, names)
    z = solve(posed, jnp.zeros(len(names))).z
    about = identifiability.analyse_identifiability(posed, z)
    held = dict(zip(names, about.held_by_prior, strict=True))
    assert held["motor.inductance"] and about.sd[names.index("motor.inductance")] == pytest.approx(1.0)
    assert about.sensitivity[names.index("motor.inductance")] == 0
    assert about.rank == len(names) - 2  # inductance, and the product guide_friction x guide_share
    weakest = [v for s, v in about.weak_directions() if s < 1e-6 and "motor.inductance" not in v]
    assert set(weakest[0]) == {"6T2A.track.guide_friction", "6T2A.track.guide_share"}


@pytest.mark.slow
def test_profile_of_a_linear_problem_is_its_interval(clean, truth):
    """With little noise the model is linear over an interval, so profile and curvature agree."""
    small = clean.with_data(sd=clean.data.sd / 500)
    best = solve(small, truth)
    about = identifiability.analyse_identifiability(small, best.z)
    (low_end, high_end), is_open = (
        x.T for x in identifiability.profile_intervals(small, best.z, float(best.cost), about)
    )
    assert not is_open.any()
    sure = about.sd < 0.05  # the others still reach over a good part of a prior sd
    low = np.asarray(small.coordinates.value(best.z - 1.96 * about.sd))
    high = np.asarray(small.coordinates.value(best.z + 1.96 * about.sd))
    assert sure.sum() >= 4
    assert_allclose(low_end[sure], low[sure], rtol=0.02)
    assert_allclose(high_end[sure], high[sure], rtol=0.02)


@pytest.mark.slow
def test_profile_of_a_parameter_held_by_the_limit_is_one_sided(measured, robot):
    posed = pose(measured, robot, stated="current=9%,motor_speed=6%,speed=4%")
    best = solve(posed, jnp.zeros(len(posed.coordinates)))
    about = identifiability.analyse_identifiability(posed, best.z)
    low_end, high_end = identifiability.profile_intervals(posed, best.z, float(best.cost), about)[0].T
    k = posed.coordinates.names.index("4W2T.ground.friction.static")
    value = float(posed.coordinates.value(best.z)[k])
    assert value - low_end[k] < 0.2 * (high_end[k] - value)


@pytest.mark.slow
def test_blocks_left_out_are_not_seen(posed, measured, robot):
    masks = {"slope": holdout.blocks_of_kind(measured, "slope")}
    best = solve(posed, jnp.zeros(len(posed.coordinates))).z
    held = holdout.hold_out_by_kind(posed, best, masks)["slope"]
    assert held.labels == ("0.0", "5.0", "10.0", "15.0", "20.0") and held.converged.all()
    # the refit without slope 10, done alone, says the same of those rows
    rows = masks["slope"]["10.0"]
    alone = pose(measured.where(~rows), robot)
    z = solve(alone, best).z
    assert_allclose(held.reading[rows], np.asarray(posed.observation(z).reading)[rows], rtol=1e-4)
    # readings of a block do not change what is predicted for it
    shifted = posed.with_data(measured=posed.data.measured.at[rows].multiply(1.3))
    other = holdout.hold_out_by_kind(shifted, best, masks)["slope"]
    assert_allclose(other.reading[rows], held.reading[rows], rtol=1e-4)


def nothing_measured(readings, coordinates):
    """Data of one row, where a test has residuals of its own."""
    one = jnp.ones((1, readings))
    return problem.Data(0 * one, one, one, jnp.zeros(coordinates), jnp.asarray(1.0))


def test_blocks_of_what_does_not_vary_are_none(measured):
    flat = measured.where(measured["slope_deg"] == 0)
    assert (
        holdout.blocks_of_kind(flat, "slope") == {}
        and len(holdout.blocks_of_kind(flat, "voltage_configuration")) == 4
    )
    assert holdout.blocks_of_kind(flat, "run") == {}


@pytest.mark.slow
def test_rival_searches_end_where_three_agree_unless_one_is_lower():
    """Members 0-2 rest in a basin of 30, 3 and 4 descend a curved valley to 0, 5 creeps at a cost of 2000."""

    def residual(k, z):
        valley = jnp.stack([10 * (z[1] - z[0] ** 2), 1 - z[0]])
        basin = jnp.stack([z[0], jnp.sqrt(60.0)])
        creeps = jnp.stack([jnp.sqrt(4000.0), 0.5 * jnp.sqrt(1 + (z[0] - 50) ** 2)])
        return jnp.concatenate([jnp.where(k < 3, basin, jnp.where(k < 5, valley, creeps)), jnp.zeros(2), 1e-3 * z])

    def evaluate(z, members):
        evaluated.append(len(members))
        r, jacobian = jax.vmap(residual)(members, z), jax.vmap(jax.jacfwd(residual, 1))(members, z)
        return jax.device_get((r, jacobian, members))

    evaluated, data = [], nothing_measured(3, 2)
    begin = jnp.asarray([[0.1, 0.0], [0.2, 0.0], [0.3, 0.0], [-1.2, 1.0], [-1.9, 2.0], [0.0, 0.0]])
    weights = jnp.ones((6, 1, 3))
    found, _ = fit.search_rollouts(evaluate, begin, data, weights, 40, 2, within=fit.SAME)
    assert_allclose(found.cost[3:5], 0, atol=1e-3)
    assert found.converged[3:5].all() and found.steps[3] > found.steps[0]
    evaluated.clear()
    alone, _ = fit.search_rollouts(evaluate, begin, data, weights, 40, 2)
    assert max(evaluated) == 2 and sum(evaluated) == alone.steps.sum()  # what has ended leaves its place
    assert_allclose(alone.cost[:5], [30, 30, 30, 0, 0], atol=1e-3)
    # Nor does a search go on that cannot come down to where another one is.
    assert (found.steps[[0, 1, 2, 5]] < alone.steps[[0, 1, 2, 5]]).all()
    assert (found.cost[:3] < 31).all()
    same, _ = fit.search_rollouts(evaluate, begin[:3], data, weights[:3], 40, 2, within=fit.SAME)
    assert (same.steps <= alone.steps[:3]).all()


def test_a_rival_that_promises_much_and_brings_nothing_ends():
    """Member 0 is at its optimum of 2. The slopes of member 1 promise a fall from 2000 that does not come."""
    slopes = np.array([[[1.0], [0.0], [1e-3]], [[-40.0], [0.0], [1e-3]]])
    wall = lambda x: 4000**0.5 * (1 if x == 0 else 3)  # noqa: E731  # too high to correct the slope

    def evaluate(z, members):
        r = np.stack(
            [[z[k, 0], 2.0, 1e-3 * z[k, 0]] if m == 0 else [wall(z[k, 0]), 0, 0] for k, m in enumerate(members)]
        )
        return r, slopes[members], members

    data = nothing_measured(2, 1)
    found, alone = (
        fit.search_rollouts(evaluate, np.array([[0.5], [0.0]]), data, np.ones((2, 1, 2)), 40, 2, within=distance)[0]
        for distance in (3.0, np.inf)
    )
    assert_allclose(found.cost, [2, 2000], atol=1e-3)
    assert found.steps[1] <= fit.LATELY + 1 < alone.steps[1]


def test_a_search_that_hardly_lowers_its_objective_ends(monkeypatch):
    """As where a load sticks: each step brings a hundredth of a unit of 2000, and the slope promises many times more."""

    def evaluate(z, members):
        r = np.stack([[(4000 - 0.02 * abs(x)) ** 0.5, 0.0] for x in z[:, 0]])
        return r, np.tile([[-0.01], [0.0]], (len(members), 1, 1)), members

    data = nothing_measured(1, 1)
    search = lambda: fit.search_rollouts(evaluate, np.zeros((1, 1)), data, np.ones((1, 1, 1)), 40, 1)[0].steps[0]  # noqa: E731
    soon = search()
    monkeypatch.setattr(fit, "STALLED", -1.0)
    assert soon <= 2 * fit.LATELY + 1 < search()


def test_jacobian_of_steady_is_the_finite_difference(posed, truth):
    function = jax.jit(lambda z: posed.misfit(z))
    jacobian = np.asarray(jax.jit(jax.jacfwd(function))(truth))
    step = 1e-5
    columns = [
        (function(truth.at[k].add(step)) - function(truth.at[k].add(-step))) / (2 * step) for k in range(len(truth))
    ]
    assert_allclose(jacobian, np.stack(columns, 1), rtol=1e-5, atol=1e-5 * np.abs(jacobian).max())


@pytest.mark.nightly
def test_search_of_rollouts_ends_at_the_limit_of_adhesion_from_inside(measured, robot):
    """With the noise that is estimated of them the rows pull static friction down to the margin. From just inside of
    it nothing shows the penalty."""
    posed = pose(measured, robot, stated="current=10%,motor_speed=6%,speed=4%")
    limit = fit.search_starts(posed, jnp.zeros((1, len(posed.coordinates))))[0]
    assert np.any(posed.observation(limit.z[0]).adhesion_used > 1 - problem.MARGIN)
    inside = jnp.asarray(limit.z[0]).at[posed.coordinates.names.index("6T2A.ground.friction.static")].add(3e-4)
    r, jacobian, seen = fit.linearise(posed, inside)
    assert (seen.adhesion_used < 1 - problem.MARGIN)[:10].all()
    plain = np.linalg.lstsq(np.asarray(jacobian), np.asarray(r))[0]
    assert 0.5 * np.sum((jacobian @ plain) ** 2) > 3 * fit.DECREMENT  # a gain that is not there
    found, _, _ = fit.search_rollout(posed, inside)
    assert found.converged and found.decrement < fit.DECREMENT + fit.DECREMENT_SHARE * float(found.cost)
    assert found.cost == pytest.approx(float(limit.cost[0]), abs=2 * fit.DECREMENT)
