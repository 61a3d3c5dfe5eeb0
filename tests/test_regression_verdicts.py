"""Answers of the regression alone, on generated logs of one motor with six faults. Plain NumPy laws, no simulation."""

import dataclasses
import functools

import numpy as np
import pytest

from calibration.data import robot_file
from calibration.data.runs import Runs
from calibration.discovery import (
    active_set,
    candidates,
    discover,
    findings,
    log_stages,
    loop_input,
    score_tests,
    search,
    standing,
    verdict,
)
from calibration.discovery.projection import Projection
from calibration.discovery.settings import settings_for
from calibration.inference import weak_form
from calibration.inference.bases import family_names
from calibration.inference.observers import Histories, linear_rows
from calibration.words import loop_words
from mmrjax.effects import BY_NAME
from tests.commands import motor_on_bench

STEP, EVERY, ROWS, RPM = 2e-4, 0.01, 200, np.pi / 30
RIG = motor_on_bench("0.042 ± 0.5 %", "0.9 ± 1 %")
NAMES = (
    "encoder_scale", "supply_sag", "brush_drop", "directional_friction", "torque_offset", "torque_constant_saturation",
    "stick_slip", "stribeck_track", "churning",
)  # fmt: skip
SD = np.array([8 * RPM, 0.03])  # of speed and current [SI]
SETTINGS = settings_for(Histories, 333)


def motor_log(volts, loss, rng, sd=SD, late=0, resistance=0.9, saturates=0.0, scale=1.0):
    """U = k ω + R I + L dI/dt, J dω/dt = k I (1 - s I) - M of four runs, with noise. `loss`: M of a row and ω."""
    rows = volts.shape[1]
    acts = np.concatenate([np.zeros((4, late)), volts], 1)
    current, speed, shown = np.zeros(4), np.zeros(4), []
    for n in range(rows):
        shown.append((current, speed))
        for _ in range(round(EVERY / STEP)):
            settled = (acts[:, n] - 0.042 * speed) / resistance
            # exact for the winding, whose time constant is two steps long
            current = settled + (current - settled) * np.exp(-STEP * resistance / 4e-4)
            torque = 0.042 * current * (1 - saturates * np.abs(current)) - loss(n, speed)
            speed = speed + STEP * torque / 2.4e-4
    current, speed = (np.array(x).T for x in zip(*shown, strict=True))
    return {
        "run_id": np.repeat(["a", "b", "c", "d"], rows),
        "configuration": np.repeat(["bench"], 4 * rows),
        "time_s": np.tile(np.arange(rows) * EVERY, 4),
        "supply_voltage_V": volts.ravel(),
        "motor_speed_rpm": (scale * speed + sd[0] * rng.standard_normal(speed.shape)).ravel() / RPM,
        "motor_current_A": (current + sd[1] * rng.standard_normal(current.shape)).ravel(),
        "slope_deg": np.zeros(4 * rows),
        "payload_kg": np.zeros(4 * rows),
    }


def log(
    seed=1, late=0, scale=1.0, sag=0.0, forward=0.0, saturates=0.0, sticks=0.0, rough=0.0, swings=False, slow=0.0,
    cold=0.0,
):  # fmt: skip
    """A log of four runs under stairs of voltage. `sag`: of the supply [ohm].

    Args:
        late: rows by which the voltage acts later than its column says.
        forward: friction is larger by this share forward, smaller backward. sticks: larger by it at rest, and falls over 60 rad/s.
        rough: friction of the third run alone is larger by this share.
        swings: the voltage swings, and is held from row to row.
        slow: sd of a torque that nobody knows and that changes every 0.4 s [N·m].
        cold: friction is larger by it at the start of each run, and falls within 0.5 s.
    """
    rng = np.random.default_rng(seed)
    levels = np.where(np.arange(5) % 2, rng.uniform(1.2, 4.0, (4, 5)), rng.uniform(4.0, 24.0, (4, 5)))
    volts = np.repeat(levels * rng.choice([-1.0, 1.0], (4, 5)), ROWS // 5, axis=1)
    if swings:
        volts = 13 * np.sin(np.arange(ROWS) * EVERY * np.array([[7.0], [9.0], [11.0], [5.0]])) + 4
    unknown = np.repeat(slow * np.random.default_rng(seed + 99).standard_normal((4, 5)), ROWS // 5, axis=1)

    def loss(n, speed):
        dry = 1 + rough * (np.arange(4) == 2) + forward * np.sign(speed) + sticks * np.exp(-np.abs(speed) / 60)
        return (
            0.02 * dry * (1 + cold * np.exp(-n * EVERY / 0.5)) * np.tanh(speed / 0.05) + 3e-5 * speed - unknown[:, n]
        )

    return motor_log(volts, loss, rng, late=late, resistance=0.9 + sag, saturates=saturates, scale=scale)


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """Function from the faults of a log to its ranking."""
    file = tmp_path_factory.mktemp("motor") / "rig.toml"
    file.write_text(RIG, encoding="utf-8")
    robot, library = robot_file.read_robot(file), {n: BY_NAME[n] for n in NAMES}

    def input_of(**faults):
        runs = Runs("log.csv", log(**faults)).of(robot)
        noise = (
            f"motor_speed={SD[0] / RPM}rpm,{next(c.name for c in runs.channels if c.name != 'motor_speed')}={SD[1]}A"
        )
        return loop_input.prepare_loop(runs, robot, noise=noise, library=library, replicates=SETTINGS.replicates)

    @functools.cache
    def space_of(**faults):
        runs = Runs("log.csv", log(**faults)).of(robot)
        sd = np.broadcast_to(SD[[0 if c.name == "motor_speed" else 1 for c in runs.channels]], runs.measured().shape)
        return loop_input.build_candidate_space(runs, robot, sd, SETTINGS, {}, library)

    def of(**faults):
        space = space_of(**faults)
        return findings.rank_effects_by_weak_form(space, search.screen_by_weak_form(space))

    @functools.cache
    def windows_of(**faults):
        """The candidate space of a log, its fit in weak form, and the problem of its windows with their rows."""
        space = space_of(**faults)
        fit = weak_form.fit_weak_form(space.bare, space.library.scored)
        return (
            space,
            fit,
            *linear_rows.problem_of_windows(space.bare, fit, space.library.scored, lambda rows: {}, SETTINGS.width),
        )

    of.windows_of, of.input_of = windows_of, input_of
    return of


@pytest.mark.quick(2)
@pytest.mark.parametrize("fault, family", [
    ({}, ""),
    ({"forward": 0.3}, "loss torque that changes with direction"),
    ({"scale": 0.95}, "reading of motor speed that is the same share everywhere"),
    ({"sag": 0.1}, "voltage drop that changes with current"),
    ({"saturates": 0.01}, "loss torque that changes with load"),
    ({"sticks": 2.0}, "loss torque that changes with speed"),
])  # fmt: skip
def test_the_mechanism_of_a_fault_leads(answered, fault, family):
    found = answered(**fault)
    assert found.missing == bool(fault)
    assert not fault or found.effects[0].family == family
    assert family in loop_words.regression_verdict(found)


def test_a_delay_of_ten_rows_is_a_parameter_and_nothing_is_missing(answered):
    found = answered(late=10)
    value, _ = found.parameters["rig.delay"]
    assert not found.missing and value == pytest.approx(0.1, abs=EVERY)


def test_a_held_voltage_that_swings_a_row_late_biases_nothing(answered):
    """A delay of one row had no derivative, and a reading before a step of the voltage shows the current before."""
    space, fit, *_ = answered.windows_of(late=1, swings=True)
    coordinates = space.coordinates.base
    sd = np.sqrt(np.diag(np.linalg.inv(fit.jacobian.T @ fit.jacobian)))
    value, sds = coordinates.value(fit.z), np.asarray(coordinates.spread) * sd
    for name, truth in (("rig.delay", EVERY), ("motor.resistance", 0.9)):
        k = coordinates.names.index(name)
        assert abs(value[k] - truth) < 3 * max(sds[k], 0.002 * truth) and sd[k] < 0.5
    assert abs(np.sum(fit.residual**2) - len(fit.signatures)) < 5 * np.sqrt(2 * len(fit.signatures))


def test_windows_fit_effects_as_least_squares_do(answered):
    """A log is a table of equations: residuals, slopes and signatures of its regression, and shapes between them."""
    space, fit, posed, rows = answered.windows_of(forward=0.3)
    observe, names = posed.observe, space.library.names
    table = active_set.candidate_space(posed, space.library.effects, {n: BY_NAME[n] for n in NAMES}, SETTINGS)
    slots = ("directional_friction", "supply_sag", "", "")
    (found,) = candidates.fit_candidates(table, [(slots, np.zeros(table.free + 8))])
    linear, size = observe.linear, table.free
    counts = np.asarray(posed.data.weight).ravel() > 0
    e, j, g = (
        np.asarray(x)[: linear.readings][counts] for x in (linear.residual, linear.jacobian, linear.signatures)
    )
    chosen = [list(space.library.of).index(names.index(n)) for n in slots[:2]]  # without a shape
    columns = np.concatenate([j, SETTINGS.width * g[:, chosen]], 1)
    prior = np.concatenate([np.asarray(fit.origin) - fit.centre, np.zeros(2)])
    move = -np.linalg.lstsq(np.concatenate([columns, np.eye(size + 2)]), np.concatenate([e, prior]), rcond=None)[0]
    expected = np.concatenate([fit.origin + move[:size], move[size:]])
    assert np.max(np.abs(found.z[: size + 2] - expected) / found.sd[: size + 2]) < 0.05  # the end of a search
    assert move[size] > 5 * found.sd[size] and len(rows) == len(posed.data.weight)


@pytest.mark.parametrize("fault", [{"rough": 0.3}, {"forward": 0.3}])
def test_a_constant_that_differs_in_one_run_explains_more_than_an_effect_that_imitates_it(answered, fault):
    space, _, posed, _ = answered.windows_of(**fault)
    linear = posed.observe.linear
    space = dataclasses.replace(
        space, bare=posed, equipped=dataclasses.replace(space.equipped, observe=posed.observe)
    )
    fit = Projection.of(linear)
    run, changed, root = standing.changed_run(space, linear, (), fit)
    effects = fit.roots(np.asarray(linear.signatures)).max()
    if "rough" in fault:
        assert (run, changed) == (3, "motor.friction_coulomb") and root > 1.2 * effects
        inside = np.repeat(np.isin(np.arange(linear.rows), linear.runs()[2]), linear.readings // linear.rows)
        slopes = np.asarray(linear.jacobian)[: linear.readings, space.coordinates.base.names.index(changed)]
        assert root == pytest.approx(fit.roots((slopes * inside)[:, None])[0], rel=1e-9)
    else:
        assert root < 0.8 * effects


def test_an_error_of_a_balance_everywhere_changes_windows_as_its_effect(answered):
    space, _, posed, _ = answered.windows_of(forward=0.3)
    linear = posed.observe.linear
    way = np.asarray(linear.signals.direction)
    column = np.asarray(linear.columns(linear.probed.index("track"), way[:, None] ** 2))[:, 0]
    offset = np.asarray(linear.signatures)[
        :, list(space.library.of).index(space.library.names.index("torque_offset"))
    ]
    assert abs(column @ offset) > 0.999 * np.linalg.norm(column) * np.linalg.norm(offset) > 0


def test_a_torque_that_changes_slowly_does_not_look_like_an_effect(answered):
    """As white noise of its windows, it gave an effect 3.0 sds."""
    posed = answered.windows_of(seed=5, slow=0.01)[2]
    scores = np.abs(score_tests.score_tests(posed.observe.linear, ()).single)
    assert 0 < scores.max() < 2.0


def test_a_friction_that_falls_within_each_run_is_a_curve_over_time(answered, monkeypatch):
    """Stairs of voltage tell most of the time, but not all of it."""
    monkeypatch.setattr(log_stages, "LONG", 0)
    given = log_stages.windows_of_log(answered.input_of(cold=1.0))
    observe = given.equations.bare.observe
    bases = observe.bases({}, np.ones(len(given.runs), bool), given.robot)
    scores = np.asarray(score_tests.score_tests(observe.linear, bases).curve)
    assert family_names(bases)[np.argmax(scores)] == ("track", "time")


@pytest.mark.slow
@pytest.mark.parametrize("fault, family", [({"forward": 0.3}, "loss torque that changes with direction"), ({}, "")])
def test_the_windows_of_a_log_decide_and_one_simulation_confirms(answered, monkeypatch, fault, family):
    monkeypatch.setattr(log_stages, "LONG", 0)
    traced = discover.trace_windows(answered.input_of(**fault))
    assert isinstance(traced, verdict.LoopStages if fault else candidates.Candidate)
    assert not fault or (family in traced.families and traced.run.gained > 0.5 * traced.run.promised > 0)
