"""The generator of rigs' logs against the simulator's histories, and its labels."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import rig_logs
from worlds import laws, logs
from worlds.settled import remainder

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.inference import bases, noise, observers, ranges
from calibration.inference.observers import run_grids
from calibration.inference.observers.run_grids import _common_length
from calibration.inference.ranges import check_ranges
from mmrjax.effects import BY_NAME
from mmrjax.model import params

#: Of the sds of the readings, rms: both methods' own errors, and the windings', of which the file says nothing.
ERROR = 0.3


def shown(tmp_path, case, terms=()):
    """Readings of the simulator with the truth of a case, in sds as the generator's: without effects, then with each of
    `terms` alone, each of shape (runs, readings)."""
    case.write(tmp_path)
    robot = robot_file.read_robot(tmp_path / "rig.toml")
    runs = records.read_runs(tmp_path / "table.csv", robot=robot)
    robot = dataclasses.replace(robot, effects=tuple(BY_NAME[t.name]() for t in terms))
    truth = {logs.PUBLIC[n]: x for n, x in case.rig.p.items() if n in case.rig.names} | {"rig.delay": case.rig.delay}
    sizes = {f"effects.{t.name}.amplitude": t.amplitude for t in terms}
    for t in terms:
        own = {"speed_fade": t.shapes["fade"] * case.rig.w_k} if "fade" in t.shapes else t.shapes
        truth |= {f"effects.{t.name}.{k}": x for k, x in own.items()}
    kind = observers.observer_kind(runs)
    robot = run_grids.measure_initial_states(robot, runs, noise.noise_from_table(runs, kind.sizes(runs)))
    made = kind.of(runs, robot)
    names = [c.name for c in robot.channels]
    factors = np.array([c.factor for c in robot.channels])

    def with_one(name):
        at = truth | {n: x if n == name else 0.0 for n, x in sizes.items()}
        true = params.replace(robot, {n: jnp.asarray(float(x)) for n, x in at.items()})
        reading = np.asarray(made(true).reading) / factors
        by_run = reading.T.reshape(len(names), logs.RUNS, logs.ROWS)
        return np.concatenate([by_run[names.index(n)] / case.rig.sd[n] for n in case.rig.channels], -1)

    return [with_one(n) for n in ("", *sizes)]


@pytest.mark.nightly
@pytest.mark.parametrize("imposed", logs.IMPOSED)
def test_logs_are_those_of_the_simulator_with_the_same_truth(tmp_path, imposed):
    rig = logs.rig(np.random.default_rng([3, logs.IMPOSED.index(imposed)]), imposed)
    rng = np.random.default_rng(1)
    terms = [laws.shaped(n, rng, law.at(rig.scale)) for n, law in laws.LOGS.items() if law.needs(imposed)]
    terms = [dataclasses.replace(t, amplitude=0.05 * t.law.size) for t in terms]
    _, base, changes = logs.slopes(rig, rig.p, (), [[t] for t in terms])
    columns = np.stack([b.ravel() for b in base], 1)
    left = [np.linalg.norm(remainder(c.ravel(), columns)) for c in changes]
    # Of 10 sds beside the constants, as far as what is left grows as the amplitude.
    terms = [
        dataclasses.replace(t, amplitude=t.amplitude * np.clip(10 / x, 0.1, 30))
        for t, x in zip(terms, left, strict=True)
    ]
    theirs = logs.histories(rig, [rig.p] * (1 + len(terms)), [[], *([t] for t in terms)])
    case = logs.case(rig, "", 0.0, 1)
    assert case.label["sound"] and len(terms) >= 8
    ours = shown(tmp_path, case, terms)
    for name, mine, x in zip(("none", *(t.name for t in terms)), ours, theirs, strict=True):
        clean = logs.whitened(rig, x)
        assert np.sqrt(np.mean((mine - clean) ** 2)) < ERROR, name
        if name != "none":  # and what it does is no less than what the two may differ by
            assert np.sqrt(np.mean((mine - ours[0]) ** 2)) > np.sqrt(np.mean((mine - clean) ** 2)), name


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed, imposed, every, share",
    [
        ([3, 2], "motor_speed", 0.02, 2),  # smooth between its rows: slopes of lines were off by 2.5 times the noise
        ([41, 0, 1], "motor_current", 0.005, 3),  # with reversals: steps of 2.5 ms were off by 0.49 of the noise
    ],
)
def test_motion_between_the_rows_of_a_log_is_followed_within_its_noise(tmp_path, seed, imposed, every, share):
    case = logs.case(logs.rig(np.random.default_rng(seed), imposed, every), "", 0.0, 1)
    clean = logs.whitened(case.rig, logs.histories(case.rig, [case.rig.p])[0])
    assert np.sqrt(np.mean((shown(tmp_path, case)[0] - clean) ** 2)) < ERROR / share


def test_a_speed_that_still_rises_is_no_matter_of_units(tmp_path, monkeypatch):
    # Levels of an imposed current that end long before steady travel; refused before as "are they in turns/s?".
    case = rig_logs.attempt("clean", 4)
    case.write(tmp_path)
    robot = robot_file.read_robot(tmp_path / "rig.toml")
    runs = records.read_runs(tmp_path / "table.csv", robot=robot)
    # None of its rows has settled, so nothing is compared.
    monkeypatch.setattr(ranges, "_check_masses", lambda *_: pytest.fail("rows that still rise are compared"))
    assert check_ranges(runs, robot) == []
    kind = observers.observer_kind(runs)
    assert len(kind.settled(runs)[0]) > len(kind.settled(runs, steady=True)[0]) == 0


def test_logs_of_about_one_length_share_what_is_compiled():
    lengths = [_common_length(n) for n in range(1, 5000)]
    assert all(n <= long <= 1.125 * n for n, long in enumerate(lengths, 1))
    assert len({long for long in lengths if 2048 <= long < 4096}) == 8
    rows = np.arange(200)[None]
    slow, fast = (
        bases.wave_families(np.zeros(200, bool), np.linspace(0, 2 * np.pi * n, 200), rows, rows, bases.BALANCES)
        for n in (30.0, 60.0)
    )
    resolved = [set(v for _, v in bases.family_names(b)) for b in (slow, fast)]
    assert resolved[1] < resolved[0] and slow[0].columns.shape == fast[0].columns.shape
