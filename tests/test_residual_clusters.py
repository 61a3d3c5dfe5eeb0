"""What residuals cluster by: columns without a role that matter are found and said, and no others."""

import dataclasses
import json

import jsonschema
import numpy as np
import pytest
from pages import Tables
from synthetic import SETTLED
from test_lack_of_fit import SIGMA, toy

from calibration.data import runs as records
from calibration.data.runs import Runs
from calibration.inference.calibration import calibrate
from calibration.inference.lack_of_fit import Residuals
from calibration.inference.observers import Histories
from calibration.inference.residual_clusters import LEVEL, find_residual_clusters
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import paper_robots
from sweeps.report import calibration_report, page_renderer
from tests.commands import ROOT, read_json, text_file

SCHEMAS = ROOT / "docs/schemas"
ROWS = 90
CURRENT, MOTOR, SPEED = range(3)


def extras(rng, rows=ROWS):
    """Columns that matter to nothing: levels as numbers and as words, an angle, many numbers, wild ones."""
    return {
        "idle_wheel": rng.integers(1, 4, rows).astype(float),
        "who": rng.choice(["Ann", "Bo"], rows),
        "direction_deg": 60.0 * rng.integers(0, 6, rows),
        "room_degC": rng.standard_normal(rows),
        "yaw_rate_deg_s": rng.standard_cauchy(rows),
    }


def leaving(made, whitened, **columns):
    """The same fit to readings that leave these residuals [σ], with further columns of the table."""
    measured = made.simulated - whitened * SIGMA
    read = {"total_current_A": 1.0, "motor_speed_rpm": np.pi / 30, "speed_mm_s": 1e-3}
    columns = made.runs.columns | columns | {c: measured[:, k] / u for k, (c, u) in enumerate(read.items())}
    return dataclasses.replace(made, whitened=whitened, runs=dataclasses.replace(made.runs, columns=columns))


def left(seed, columns=None, shift=None, channel=SPEED):
    """A linear fit's residuals with columns without a role, and a shift of a channel's readings [σ] by row.

    The shift is what the fit leaves of it: the free parameters take up their part.
    """
    rng = np.random.default_rng(seed)
    made = toy(rng)
    columns = extras(rng) if columns is None else columns
    whitened = made.whitened
    if shift is not None:
        added = np.zeros((ROWS, 3))
        added[:, channel] = shift(made.runs, columns)
        free = np.eye(added.size) - (made.absorbed @ made.absorbed.T)[: added.size, : added.size]
        whitened = whitened - (free @ added.ravel()).reshape(ROWS, 3)
    made = dataclasses.replace(made, runs=dataclasses.replace(made.runs, extras=columns))
    return leaving(made, whitened)


@pytest.mark.nightly
def test_clean_residuals_cluster_no_more_often_than_stated():
    """Of 300 tables of five columns, three channels and tests over all rows and by configuration."""
    assert sum(bool(find_residual_clusters(left(s), seed=s)) for s in range(300)) <= 0.015 * 300


@pytest.mark.slow
def test_wild_residuals_make_no_cluster():
    """Of a t distribution of 2.5 degrees of freedom, whose outliers a variance ratio alone takes for levels."""

    def wild(seed):
        made, rng = left(seed), np.random.default_rng(seed)
        free = np.eye(3 * ROWS) - (made.absorbed @ made.absorbed.T)[: 3 * ROWS, : 3 * ROWS]
        noise = (free @ rng.standard_t(2.5, 3 * ROWS)).reshape(ROWS, 3)
        return leaving(made, noise)

    assert sum(bool(find_residual_clusters(wild(s), seed=s)) for s in range(200)) <= 0.015 * 200


def by_wheel(size):
    return lambda runs, columns: size * np.array([1.2, -0.3, -0.9])[columns["idle_wheel"].astype(int) - 1]


@pytest.mark.slow
@pytest.mark.parametrize("channel", [CURRENT, MOTOR, SPEED])
def test_a_hidden_column_is_found_in_its_channel(channel):
    name = ("total_current", "motor_speed", "speed")[channel]
    hits = [find_residual_clusters(left(s, shift=by_wheel(1.5), channel=channel)) for s in range(20)]
    assert sum(bool(f) and (f[0].column, f[0].channel, f[0].within) == ("idle_wheel", name, "") for f in hits) >= 19
    others = [c.column for f in hits for c in f if c.column != "idle_wheel"]
    assert len(others) <= 1  # what goes with it by chance is said beside it, not as a finding of its own


def test_levels_are_said_in_the_unit_of_the_channel():
    made = left(3, shift=by_wheel(4.0))
    (found,) = find_residual_clusters(made)
    mean = {m.level: m.mean for m in found.levels}
    assert list(mean) == ["1", "2", "3"] and sum(m.rows for m in found.levels) == ROWS and found.unit == "mm/s"
    # simulated less measured, 3 mm/s of noise each: -14.4, 3.6, 10.8 mm/s but for the mean that the fit takes up
    assert mean["3"] - mean["1"] == pytest.approx(25.2, abs=3.0) and found.p < 1e-8


def test_levels_that_differ_in_one_configuration_alone_are_found_within_it():
    """The means over all rows are zero: what a level adds in one configuration it takes in the other."""

    def shift(runs, columns):
        side = np.where(runs["configuration"] == "6T2A", 1.0, -1.0)
        return 2.0 * side * np.where(columns["who"] == "Ann", 1.0, -1.0)

    hits = [find_residual_clusters(left(s, shift=shift)) for s in range(10)]
    assert all((f[0].column, f[0].within) == ("who", "configuration") for f in hits)
    assert {m.within for m in hits[0][0].levels} == {"6T2A", "4W2T"}


@pytest.mark.slow
def test_levels_whose_sign_follows_the_travel_are_found():
    def both_ways(seed, size):
        made = left(seed)
        travel = np.where(np.random.default_rng(seed + 99).random(ROWS) < 0.5, 1.0, -1.0)
        added = size * travel * np.where(made.runs.extras["who"] == "Ann", 1.0, -1.0)
        made = dataclasses.replace(made, simulated=made.simulated * travel[:, None])
        return leaving(made, made.whitened + added[:, None] * [0, 0, 1])

    hits = [find_residual_clusters(both_ways(s, 1.5)) for s in range(10)]
    assert all(f[0].column == "who" and f[0].reversing and f[0].channel == "speed" for f in hits)
    assert sum(bool(find_residual_clusters(both_ways(s, 0.0))) for s in range(30)) <= 1


def test_a_column_of_many_numbers_is_found_by_ranks():
    shift = lambda runs, columns: 2.0 * np.tanh(columns["yaw_rate_deg_s"])  # noqa: E731
    hits = [find_residual_clusters(left(s, shift=shift)) for s in range(10)]
    assert all(f[0].column == "yaw_rate_deg_s" and not f[0].levels and f[0].correlation < -0.4 for f in hits)


def test_what_shows_through_another_column_is_said_beside_it():
    """The direction fixes which wheel idles: it shows what the wheel does, and no more."""
    rng = np.random.default_rng(1)
    direction = 60.0 * rng.integers(0, 6, ROWS)
    columns = {"idle_wheel": 1 + (direction / 60) % 3, "direction_deg": direction}
    (found,) = find_residual_clusters(left(1, columns, by_wheel(2.0)))
    assert found.column == "idle_wheel" and found.alike == ("direction_deg",)


#: Columns of which nothing is to be said, though residuals go with them, from the table and the hidden levels.
ALIASES = {
    "one-to-one with the configuration": lambda r, x: np.where(r["configuration"] == "6T2A", "tracks", "wheels"),
    "one-to-one with the voltage": lambda r, x: r["supply_voltage_V"] / 12,
    "steps of the voltage": lambda r, x: np.where(r["supply_voltage_V"] > 20, 2.0, 1.0),
    "a smooth function of the slope": lambda r, x: r["slope_deg"] ** 2 + 1e-6 * np.arange(ROWS),
    "an id of words": lambda r, x: np.array([f"run{k}" for k in np.argsort(np.argsort(x))]),
    "an id of numbers": lambda r, x: np.argsort(np.argsort(x)).astype(float),
    "a time by its name": lambda r, x: x,
    "dates": lambda r, x: np.array([f"2026-11-{10 + int(k):02d}" for k in x]),
    "one level": lambda r, x: np.full(ROWS, 7.0),
}


@pytest.mark.parametrize("case", ALIASES)
def test_columns_that_have_a_role_after_all_are_let_be(case):
    rng = np.random.default_rng(0)
    hidden = rng.integers(0, 3, ROWS) + (0.0 if "id" not in case.split() else 1e-3 * rng.random(ROWS))
    name = "start_time_h" if case == "a time by its name" else "other"
    made = left(0, {})
    column = ALIASES[case](made.runs, hidden)
    e = made.whitened + 5.0 * (hidden - 1)[:, None]
    assert find_residual_clusters(dataclasses.replace(made, whitened=e)) == ()
    runs = dataclasses.replace(made.runs, extras={name: column})
    assert find_residual_clusters(dataclasses.replace(made, whitened=e, runs=runs)) == ()
    if case in ("a time by its name", "dates"):  # the same residuals are no secret to a plain column
        runs = dataclasses.replace(made.runs, extras={"other": hidden})
        assert find_residual_clusters(dataclasses.replace(made, whitened=e, runs=runs))


def test_structure_over_the_conditions_is_not_taken_for_a_column():
    """A fit that lacks something over slope and voltage, and a column that goes roughly with them."""
    rng = np.random.default_rng(4)
    made = left(4, {})
    slope, volts = made.runs["slope_deg"], made.runs["supply_voltage_V"]
    e = made.whitened + (4 * (slope / 10 - 1) ** 2 + volts / 8)[:, None]
    column = np.round(volts / 12 + slope / 10 + 0.3 * rng.standard_normal(ROWS))
    runs = dataclasses.replace(made.runs, extras={"effort": column})
    assert find_residual_clusters(dataclasses.replace(made, whitened=e, runs=runs)) == ()


def test_empty_cells_and_missing_readings_are_let_be():
    columns = extras(np.random.default_rng(8))
    columns["idle_wheel"][:9] = np.nan
    made = left(8, columns, lambda r, c: np.nan_to_num(by_wheel(3.0)(r, {"idle_wheel": np.nan_to_num(c["idle_wheel"], nan=1.0)})))  # fmt: skip
    there = made.counts & (np.arange(ROWS) % 7 > 0)[:, None]
    found = find_residual_clusters(
        dataclasses.replace(made, counts=there, whitened=np.where(there, made.whitened, 0.0))
    )
    assert found[0].column == "idle_wheel" and "not stated" in {m.level for m in found[0].levels}
    assert sum(m.rows for m in found[0].levels) == there[:, SPEED].sum()
    nobody = dataclasses.replace(made, counts=np.zeros_like(there), whitened=np.zeros_like(made.whitened))
    assert find_residual_clusters(nobody) == ()


def test_histories_are_compared_by_the_means_of_their_runs():
    """Samples remember: residuals of one run share an offset, so that only runs are independent."""
    runs_of, samples = 24, 30

    def made(seed, size):
        rng = np.random.default_rng(seed)
        run = np.repeat(np.arange(runs_of), samples)
        wheel = rng.permutation(np.arange(runs_of) % 3)[run].astype(float)
        offset = rng.standard_normal((runs_of, 3))[run] + size * (wheel[:, None] - 1) * [0, 0, 1]
        e = offset + rng.standard_normal((len(run), 3))
        jacobian = rng.standard_normal((len(run) * 3, 2)) / 100
        columns = {
            "configuration": np.full(len(run), "6T2A"), "run_id": np.array([f"r{k}" for k in run]),
            "time_s": np.tile(np.arange(samples) / 10, runs_of), "supply_voltage_V": 12.0 + run % 4,
            "slope_deg": np.zeros(len(run)), "payload_kg": np.zeros(len(run)),
        }  # fmt: skip
        simulated = np.array([2.0, 314.0, 0.5]) * np.ones(e.shape)
        runs = Runs("toy", columns, extras={"wheel": wheel, "sample": np.tile(np.arange(samples) * 1.0, runs_of)})
        return leaving(Residuals(Histories, runs, simulated, e, np.ones(e.shape, bool), jacobian, np.zeros(2)), e)

    false = [find_residual_clusters(made(s, 0.0), seed=s) for s in range(100)]
    assert sum(map(bool, false)) <= 3
    found = find_residual_clusters(made(1, 4.0))
    assert [c.column for c in found] == ["wheel"] and sum(m.rows for m in found[0].levels) == runs_of


# --- tables ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shifted_runs():
    """Sixty runs of the packaged robot up to 10°, with noise, and two columns without a role. The speed is
    shown 8 mm/s too high where wheel 1 idles, and half of it too low elsewhere."""
    rng, robot = np.random.default_rng(0), paper_robots.nominal()
    volts, slope, load, name = np.meshgrid([15.0, 18.0, 24.0], [0.0, 5.0, 10.0], [0.0, 3.0, 8.0], ["6T2A", "4W2T"])
    wheel = rng.integers(1, 4, volts.size).astype(float)
    columns = {
        "configuration": name.ravel(), "supply_voltage_V": volts.ravel(), "slope_deg": slope.ravel(),
        "payload_kg": load.ravel(), "total_mass_kg": np.where(name.ravel() == "6T2A", 12.0, 11.5) + load.ravel(),
    }  # fmt: skip
    answer = steady_batch(robot, Runs("made", columns).conditions(robot))
    reading = np.stack([answer.total_current, answer.motor_speed * 30 / np.pi, answer.speed * 1e3], 1)
    size = np.array([0.01, 0.004, 0.004]) * np.abs(reading)
    reading = reading + size * rng.standard_normal(size.shape)
    reading[:, 2] += np.where(wheel == 1, 8.0, -4.0)
    for k, column in enumerate(("total_current_A", "motor_speed_rpm", "speed_mm_s")):
        columns |= {column: reading[:, k], column.replace("_A", "_sd_A").replace("_rpm", "_sd_rpm").replace("_mm_s", "_sd_mm_s"): size[:, k]}  # fmt: skip
    extras = {"idle_wheel": wheel, "who": rng.choice(["Ann", "Bo"], wheel.size)}
    return Runs("made", columns, tuple(extras), extras=extras)


@pytest.fixture(scope="module")
def shifted(shifted_runs):
    """The fit of these runs."""
    return calibrate(shifted_runs, paper_robots.nominal(), starts=2, profiles=False, blocks=())


@pytest.mark.slow
def test_calibration_says_what_its_residuals_cluster_by(shifted, tmp_path):
    (found,) = shifted.residual_clusters
    assert (found.column, found.channel, found.within) == ("idle_wheel", "speed", "")
    document = json.loads(json.dumps(shifted.to_json()))
    jsonschema.validate(document, read_json(SCHEMAS / "calibrate.schema.json"))
    assert document["residual_clusters"][0]["statement"] == found.statement and found.statement in document["notes"]
    document = calibration_report.calibration_document(shifted, "nominal")
    page = page_renderer.write_report_page(tmp_path, document).read_text("utf-8")
    assert found.statement in Tables(page).text


# --- reading --------------------------------------------------------------------------------------------


def test_columns_without_a_role_keep_their_cells(tmp_path):
    lines = [
        "configuration,supply_voltage_V,total_mass_kg,payload_kg,slope_deg,speed_mm_s,idle_wheel,who,note",
        "6T2A,12,12,0,0,300,1,Ann,", "6T2A,18,12,0,0,450,,Bo,", "6T2A,24,12,0,0,600,3,Ann,",
    ]  # fmt: skip
    runs = records.read_runs(text_file(tmp_path / "runs.csv", "\n".join(lines)))
    assert runs.unknown == ("idle_wheel", "who", "note") and not set(runs.unknown) & set(runs.columns)
    np.testing.assert_array_equal(runs.extras["idle_wheel"], [1.0, np.nan, 3.0])
    assert runs.extras["who"].tolist() == ["Ann", "Bo", "Ann"] and np.isnan(runs.extras["note"]).all()
    some = runs.where(np.array([False, True, True]))
    assert some.extras["who"].tolist() == ["Bo", "Ann"] and len(some) == 2
    assert records.read_runs("measured").extras.keys() == set(records.read_runs("measured").unknown)


@pytest.mark.slow
def test_the_loop_lists_columns_by_which_residuals_of_its_last_fit_cluster(shifted_runs):
    found = SETTLED.discover(shifted_runs)
    assert [(c.column, c.channel) for c in found.residual_clusters] == [("idle_wheel", "speed")]
    assert found.to_json()["residual_clusters"][0]["p"] < LEVEL
