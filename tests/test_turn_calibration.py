"""Calibration of a robot whose sides are driven apart: tables of settled turns whose truth is known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_turning import of_world as robot_of_world
from worlds import turning as world
from worlds import turns
from worlds.turns import NOISE, SDS, SHOWN

import mmrjax as mm
from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration
from calibration.described import describe
from calibration.inference import blocks, identifiability, observers, priors
from calibration.inference import optimizers as fit
from calibration.inference.calibration import calibrate
from calibration.inference.observers.turns import SettledTurns
from calibration.inference.preparation import rows_to_fit
from mmrjax.model import channels
from tests.commands import csv_text, ends, refused, text_file, with_columns

#: Duties of left and right side.
DUTIES = (
    (1.0, 1.0), (1.0, 0.7), (1.0, 0.3), (1.0, 0.0), (1.0, -0.5), (1.0, -1.0), (0.6, 0.5), (0.3, 0.7), (0.1, 0.8),
    (-0.4, 0.9), (-0.6, 0.6), (0.5, -0.2),
)  # fmt: skip
LATERAL, WIDTH = "turning.lateral", "turning.width"


def written(path, configuration, mass, readings):
    """A table of those duties at 33 V with noisy readings by channel [SI]."""
    random = np.random.default_rng(3)
    columns = {"configuration": [configuration] * len(DUTIES), "supply_voltage_V": [33] * len(DUTIES)}
    columns |= {
        "total_mass_kg": [mass] * len(DUTIES),
        "payload_kg": [0] * len(DUTIES),
        "slope_deg": [0] * len(DUTIES),
    }
    columns |= {f"duty_{side}": [d[k] for d in DUTIES] for k, side in enumerate(("left", "right"))}
    for name, values in readings.items():
        channel = channels.find_channel(name)
        columns[channel.column] = np.asarray(values) / channel.factor + SDS[name] * random.normal(size=len(DUTIES))
    return text_file(path, csv_text(columns))


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return mm.read_robot(
        text_file(
            tmp_path_factory.mktemp("robot") / "robot.toml",
            f'base = "nominal"\nchannels = [{", ".join(map(repr, SHOWN))}]\n',
        )
    )


@pytest.fixture(scope="module")
def of_world(robot, tmp_path_factory):
    """Runs of the second implementation, narrower and with more lateral friction than the nominal robot."""
    other = robot_of_world(robot, "6T2A", ratio=TRUE[LATERAL], width=TRUE[WIDTH], inertia=0.23)
    found = [world.circling(other, world.Inputs(*duty, kind="duty", supply=33.0)) for duty in DUTIES]
    seen = np.array([[*f.I, *f.w, f.omega] for f in found]).T
    path = written(
        tmp_path_factory.mktemp("world") / "turns.csv", "6T2A", other.mass, dict(zip(SHOWN, seen, strict=True))
    )
    return records.read_runs(path, robot=robot)


TRUE = {LATERAL: 1.45, WIDTH: 0.236}


def posed_turns(robot, runs):
    names = tuple(f"6T2A.{n}" for n in (LATERAL, WIDTH, "ground.friction.static"))
    sd = np.broadcast_to([channels.find_channel(n).factor * SDS[n] for n in SHOWN], runs.measured().shape)
    return observers.pose_problem(runs, robot, priors.parameter_coordinates(robot, names), sd)


@pytest.mark.slow
def test_a_step_of_a_fit_whose_roots_are_known_searches_for_none(robot, of_world):
    """The search for turns is most of what there is to compile: one program of it serves every fit."""
    posed = posed_turns(robot, of_world)
    rows = len(of_world)
    roots = jax.ShapeDtypeStruct((rows, 9), float), jax.ShapeDtypeStruct((rows,), bool)

    def step(z, roots):
        return dataclasses.replace(posed, roots=roots).linearised(posed.robot, z)[1]

    known = str(jax.make_jaxpr(step)(jnp.zeros(3), roots))
    assert posed.observe.solves_separately and "custom_jvp_call" in known
    assert "while[" not in known


@pytest.mark.slow
def test_one_evaluation_of_turns_has_the_derivatives_of_the_root(robot, of_world):
    posed = posed_turns(robot, of_world)

    def through(z):
        return (posed.signed(posed.observation(z)),) * 2

    z = jnp.asarray([0.3, -0.4, 0.2])
    apart = fit.with_solved_rows(posed, z)
    r, jacobian = jax.jit(lambda z: apart.linearised(apart.robot, z)[:2])(z)
    wanted, value = jax.jit(jax.jacfwd(through, has_aux=True))(z)
    assert_allclose(r, value, rtol=1e-6, atol=1e-6)
    assert_allclose(jacobian, wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max())


def test_turns_free_what_turns_show(robot):
    straight = priors.default_names(["6T2A"], robot)
    turns = priors.default_names(["6T2A"], robot, turns=True)
    assert set(turns) - set(straight) == {f"6T2A.{LATERAL}", f"6T2A.{WIDTH}"}


def test_turns_are_held_out_by_how_sharp_they_are(of_world):
    found = blocks.blocks_of_kind(of_world, blocks.TURN)
    assert list(found) == ["-1 to -0.5", "-0.44 to 0", "0.12 to 0.43", "0.7 to 1"]
    assert np.sum(list(found.values()), 0).tolist() == [1] * len(DUTIES)


@pytest.mark.parametrize("model", ["drive", "track"])
def test_settled_turns_are_fitted_by_steady_alone(robot, of_world, model):
    with refused("settled turns are fitted with --model steady", BadConfiguration):
        SettledTurns.of(of_world, robot, model)


@pytest.fixture(scope="module")
def log(robot, tmp_path_factory):
    """A log of nine turns whose left side rubs more, and the turns."""
    path, _ = turns.write(tmp_path_factory.mktemp("log"), "friction", 9, form=turns.log)
    return records.read_runs(path, robot=robot), turns.rows("friction", 9, noise=0.0)


def test_a_log_of_two_sides_is_fitted_at_its_settled_turns(log, robot):
    """Their means are those that the readings approach."""
    runs, truth = log
    table, (note,) = rows_to_fit(runs, robot, 4000)
    assert observers.observer_kind(table) is SettledTurns and len(table) == 9
    for column in ("duty_left", "duty_right", "supply_voltage_V"):
        assert_allclose(table[column], truth[column], rtol=1e-6)
    for channel in table.channels:
        z = (table[channel.column] - truth[channel.column]) / table[channel.sd_column]
        assert np.abs(z).max() < 5
        assert table[channel.sd_column].max() < 0.02 * np.abs(table[channel.column]).max()
    assert describe(note).startswith(f"{runs.source}: a log of two sides is not fitted over time, so the fit uses")
    assert note.runs == 9 and f"settled runs (9, {note.lasts:.3g} s in all)" in describe(note)
    assert 0.5 < note.lasts / (9 * turns.HOLD * turns.EVERY) < 1
    rpm = 30 / np.pi  # a ratio of the sides' speeds that is also one of units
    runs = with_columns(runs, motor_speed_right_rpm=runs["motor_speed_left_rpm"] / rpm)
    assert len(rows_to_fit(runs, robot, 4000)[0]) == 9


def test_a_log_with_too_few_turns_is_refused_with_what_to_record(log, robot, tmp_path, mmrjax):
    """Levels that are held again are no further operating points."""
    runs, _ = log
    few = runs.where(np.repeat([1, 1, 1, 0, 0, 0, 0, 0, 0], turns.HOLD) > 0)
    again = {name: np.tile(x, 4) for name, x in few.columns.items()}
    again["time_s"] = np.arange(len(again["time_s"])) * turns.EVERY
    with refused(r"settled runs \(12, .* s in all\) have only 3 operating points. Hold 6 or"):
        rows_to_fit(dataclasses.replace(few, columns=again), robot, 4000)
    short = runs.where(np.arange(len(runs)) % turns.HOLD < 8)
    with refused(r"held too briefly.*; hold it longer, or give one command for straight travel"):
        rows_to_fit(short, robot, 4000)
    table, file = turns.write(tmp_path, "clean", 3, form=turns.log)
    for command in ("loop", "calibrate"):
        run = mmrjax(command, str(table), "--robot", str(file), "--out", str(tmp_path / "out"))
        ends(run, "have only 3 operating points. Hold 6 or more levels until all readings", code=4)
        assert not [*tmp_path.glob("out*")]


@pytest.mark.nightly
def test_truth_of_a_second_implementation_is_found(robot, of_world):
    found = calibrate(of_world, robot, noise=NOISE)
    assert found.converged and found.adequacy.p_value > 0.01
    for name, true in TRUE.items():
        estimate = found.parameters[f"6T2A.{name}"]
        assert abs(estimate.value - true) < 3 * estimate.sd and not estimate.held_by_prior
    held = found.held_out["turn"].errors
    assert all(0 < held[name].rms_sigma < 2 for name in SHOWN)
    assert held["yaw_rate"].rms_percent < 2 < found.errors_before["yaw_rate"].rms_percent


MOTION = ("motor_speed_left", "motor_speed_right", "yaw_rate")


@pytest.mark.slow
def test_wheels_that_creep_tell_the_effective_width_alone(tmp_path):
    """Without currents only B + φ_y/φ_x L²/B shows, which the correlation of both says."""
    robot = mm.read_robot(
        text_file(tmp_path / "robot.toml", f'base = "nominal"\nchannels = [{", ".join(map(repr, MOTION))}]\n')
    )
    duties = dict(zip(("duty_left", "duty_right"), np.array(DUTIES).T, strict=True))
    seen = mm.simulate(robot, mm.Conditions(["4W2T"] * len(DUTIES), voltage=33.0, **duties)).reading
    mass = float(robot.configurations["4W2T"].mass)
    table = written(tmp_path / "turns.csv", "4W2T", mass, {name: seen[name] for name in MOTION})
    runs = records.read_runs(table, robot=robot)
    names = tuple(f"4W2T.{n}" for n in (LATERAL, WIDTH))
    sd = np.broadcast_to([channels.find_channel(n).factor * SDS[n] for n in MOTION], runs.measured().shape)
    about = identifiability.analyse_identifiability(
        observers.pose_problem(runs, robot, priors.parameter_coordinates(robot, names), sd), jnp.zeros(len(names))
    )
    ((one, other, correlation),) = about.correlated()
    assert {one, other} == set(names)
    length, width, ratio = 0.3, 0.243, float(robot.configurations["4W2T"].turning.lateral)
    # At a given effective width: d(ratio)/dB = -(1 - ratio (L/B)²) (B/L)², so here both grow together.
    slope = -(1 - ratio * (length / width) ** 2) * (width / length) ** 2
    assert np.sign(correlation) == np.sign(slope)
