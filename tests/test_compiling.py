"""Programs are shared by what equations cannot tell apart, and by nothing else."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from worlds import rigs

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.discovery import candidates, loop_input, scales
from calibration.discovery.candidates import Candidate
from calibration.discovery.settings import settings_for
from calibration.inference import noise, observers
from calibration.inference.linearization import amplitude_of
from mmrjax.compile.compiling import compiled, for_equations
from mmrjax.effects import BY_NAME
from mmrjax.effects.base import scaled_effect
from mmrjax.fidelities.steady import steady
from mmrjax.model import paper_robots
from mmrjax.model.conditions import Conditions
from mmrjax.model.rig import Instrument, Rig


def space_of(world, folder):
    """The space of candidates of a clean case, as the loop makes it."""
    rigs.case(world).write(folder)
    robot = robot_file.read_robot(folder / "rig.toml")
    runs = records.read_runs(folder / "table.csv", robot=robot)
    observer = observers.observer_kind(runs)
    library = scales.scale_library(robot, runs.conditions(robot), BY_NAME)
    sd = noise.noise_from_table(runs, observer.sizes(runs)).sd
    return loop_input.build_candidate_space(runs, robot, sd, settings_for(observer), library=library)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["wheeled", "bench", "linear"])
def test_two_rigs_of_one_structure_share_their_programs(tmp_path, kind):
    rng = default_rng([5, len(kind)])
    one = rigs.world(rng, kind, rows=(33, 48))
    other = rigs.world(rng, like=one.rig, rows=(33, 48))
    spaces = [space_of(w, tmp_path / str(k)) for k, w in enumerate((one, other))]
    assert spaces[0].bare.base.rig != spaces[1].bare.base.rig  # priors, at least
    seen = [for_equations((s.equipped, s.bare, s.library.scored)) for s in spaces]
    assert jax.tree.structure(seen[0]) == jax.tree.structure(seen[1])
    assert [x.shape for x in jax.tree.leaves(seen[0])] == [x.shape for x in jax.tree.leaves(seen[1])]
    sizes = [[float(prior_sd(e)) for e in s.library.effects] for s in spaces]
    assert not np.allclose(*sizes)  # while effects are of another size in each


def prior_sd(effect):
    return amplitude_of(effect).spec.prior_sd(0.0)


@pytest.mark.slow
def test_what_equations_read_keeps_programs_apart():
    bare = paper_robots.nominal()
    alike = replace(bare, rig=Rig(priors=(("motor.resistance", 0.6, 0.01),), columns=(("a", "b", 2.0),)))
    unsigned = replace(bare, rig=Rig(instruments=(Instrument("total_current", False, 0.1),)))
    held = replace(bare, rig=Rig(instruments=(Instrument("total_current", True, 0.1),)))
    speed = replace(bare, rig=Rig(imposed="motor_speed"))
    shapes = [jax.tree.structure(for_equations(r)) for r in (bare, alike, held, unsigned, speed)]
    assert shapes[0] == shapes[1] == shapes[2] and len(set(shapes)) == 3
    assert for_equations(bare) is bare

    traced = []

    @compiled
    def current(robot, conditions):
        traced.append(robot.rig)
        return steady(robot, conditions).reading["total_current"]

    run = Conditions(voltage=-24.0)
    shown = [float(current(r, run)) for r in (bare, alike, held, unsigned)]
    assert len(traced) == 2 and not traced[0].priors
    assert shown[0] == shown[1] == shown[2] == -shown[3] < 0


def test_an_effect_of_another_size_is_the_same_to_equations():
    kind = BY_NAME["churning"]
    wide = scaled_effect(kind, (3.0, 1.0, 3.0))
    one = wide(amplitude=jnp.asarray(2e-4))
    assert prior_sd(one) == pytest.approx(3 * prior_sd(kind()))
    plain = for_equations(one)
    assert type(plain) is kind and float(plain.amplitude) == 2e-4 and for_equations(plain) is plain


def candidate(active, cost):
    zero = np.zeros(2)
    return Candidate(active, zero, zero, cost, zero, zero, True, True, True)


def test_a_fit_that_ends_above_the_one_it_builds_on_starts_again_there(monkeypatch):
    """A start where no solution exists keeps no effect from being found. Nor does a base in another valley, which what it
    lacks led there: the lowest is fitted from the prior mean too."""
    asked = []
    # By an effect, a coordinate of the base and an amplitude: from a large one the second is lost beyond a fold.
    costs = {("a", 1, 9): 10.0, ("b", 1, 9): 5000.0, ("b", 1, 0): 30.0}

    def fit(space, proposals):
        asked.append([(*names, *map(float, z)) for names, z in proposals])
        ends = [costs[*names, *z] for names, z in proposals]
        return [replace(candidate(p[0], c), z=np.array([1.0, 7.0])) for p, c in zip(proposals, ends, strict=True)]

    def start(space, at, names, scores=None):
        return np.array([1.0, 9.0 if scores else 0.0])

    monkeypatch.setattr(candidates, "fit_candidates", fit)
    monkeypatch.setattr(candidates, "start_of_fit", start)
    base, space = candidate((), 20.0), SimpleNamespace(free=1)
    for lowest, kept in ((3.0, 3.0), (11.0, 10.0)):
        costs["a", 0, 7] = lowest
        found = candidates.fit_in_addition(space, [(("a",), base, "scores"), (("b",), base, "scores")])
        assert [c.cost for c in found] == [kept, 30.0]
        assert asked.pop() == [("b", 1, 0), ("a", 0, 7)] and asked.pop() == [("a", 1, 9), ("b", 1, 9)]
    assert candidates.fit_in_addition(space, []) == []


def test_two_threads_never_trace_at_once():
    """Not one function, for arguments that are alike or not, and not one that another traces."""
    now, most = [], []

    def body(x):
        now.append(x.shape)
        most.append(len(now))
        time.sleep(0.1)
        now.remove(x.shape)
        return 2 * x

    inner = compiled(body)
    calls = inner, compiled(lambda x: inner(x)), jax.jit(lambda x: inner(x))
    given = [jnp.ones(n) for n in (2, 3)]
    with ThreadPoolExecutor(6) as pool:
        tasks = [pool.submit(call, x) for call in calls for x in given]
        assert [float(t.result()[0]) for t in tasks] == [2.0] * 6
    assert max(most) == 1 and len(most) >= 2
