"""Bases of curves: over what they go, windows in which something happens, and when row order says nothing new."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from calibration.inference import bases
from calibration.inference.bases import (
    BALANCES,
    COLLINEAR,
    CONDITIONS,
    FEWEST,
    LEVELS,
    ORDERS,
    VARIABLES,
    CurveScope,
    Window,
    family_names,
    wave_families,
    window_from_name,
)
from mmrjax.compile.compiling import for_equations
from mmrjax.effects.curve import WAYS
from mmrjax.model import channels, paper_robots

RNG = default_rng(0)
ROWS = 60
SCOPE = CurveScope.of(paper_robots.nominal(), {})


def curve_families(columns, weight, scope=SCOPE):
    """Of runs that always travel forward."""
    return bases.curve_families(columns, weight, dict.fromkeys(WAYS, np.ones(len(weight))), scope)


def window_families(columns, weight, scope=SCOPE):
    """Of runs that always travel forward."""
    return bases.window_families(columns, weight, dict.fromkeys(WAYS, np.ones(len(weight))), scope)


def order_collinearity(columns, weight, axes=SCOPE.axes):
    return bases.order_collinearity(columns, weight, axes, "order")


def table(rows=ROWS, **more):
    """A grid of three voltages, slopes and payloads for two configurations, in the order of its loops."""
    axes = (["4W2T", "6T2A"], [0.0, 8.0, 16.0, 20.0, 24.0], [0.0, 4.0, 8.0], [15.0, 24.0])
    word, slope, payload, voltage = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    take = np.arange(rows) % len(word)
    columns = {
        "configuration": word[take],
        "supply_voltage_V": voltage[take],
        "slope_deg": slope[take],
        "payload_kg": payload[take],
        "total_current_A": RNG.uniform(1, 5, rows),
        "motor_speed_rpm": RNG.uniform(3000, 9000, rows),
        "speed_mm_s": RNG.uniform(200, 900, rows),
        "order": np.arange(1.0, rows + 1),
    }
    return columns | more


def shuffled(columns, seed=1):
    """The same runs made in another order."""
    return columns | {"order": 1.0 + default_rng(seed).permutation(len(columns["order"]))}


COUNTS = np.ones(ROWS)

# --- drift from run to run ------------------------------------------------------------------------------


def test_order_of_a_grid_that_is_run_through_is_collinear_with_its_conditions():
    assert order_collinearity(table(), COUNTS) > 0.99 > COLLINEAR["order"]
    for seed in range(5):
        assert order_collinearity(shuffled(table(), seed), COUNTS) < 0.5
    # of rows that do not count nothing is known; one value of the order says nothing
    few = np.zeros(ROWS)
    few[:3] = 1
    assert order_collinearity(table(), few) == order_collinearity(table(order=np.ones(ROWS)), COUNTS) == 1.0


def test_order_of_levels_that_rise_one_way_and_then_the_other_is_that_of_the_levels():
    volts = np.array([5, 6.5, 8, 9.5, 11, 12.5, 14, 15.5, 17, 18.5, 20, 22, 24, -7, -11, -15, -19, -23])
    columns = {"configuration": np.full(18, "bench"), "supply_voltage_V": volts, "order": np.arange(18.0)}

    def told(columns):
        return order_collinearity(columns, np.ones(18), ("supply_voltage_V",))

    assert told(columns) > 0.999 and max(told(shuffled(columns, seed)) for seed in range(20)) < 0.7


@pytest.mark.parametrize("driven", ["supply_voltage_V", "duty"])
def test_order_of_a_sorted_table_is_no_driver(driven):
    """A propeller's rows by rising duty, the supply sagging. Steps are uneven."""
    level = np.cumsum(default_rng(3).uniform(0.05, 1, 30) ** 4)
    columns = {
        "configuration": np.full(30, "bench"), "supply_voltage_V": np.full(30, 24.0), "order": np.arange(30.0),
        "total_current_A": RNG.uniform(1, 5, 30), driven: level / level[-1],
    }  # fmt: skip
    scope = replace(SCOPE, balances=("electrical", "track"), axes=("supply_voltage_V",))
    assert "order" not in variables(curve_families(columns, np.ones(30), scope=scope))
    assert not [v for v in variables(window_families(columns, np.ones(30), scope=scope)) if v.startswith("order")]
    for seed in range(5):
        assert "order" in variables(curve_families(shuffled(columns, seed), np.ones(30), scope=scope))


TIME = np.arange(40.0)


@pytest.mark.parametrize("voltage, expected", [
    (TIME / 4, False), (np.full(40, 9.0), True), (np.abs(TIME - 19.5), True),
    (np.repeat(np.arange(4.0), 10), True),  # stairs tell 0.93 of the time
])  # fmt: skip
def test_time_of_a_single_ramp_is_no_driver(voltage, expected):
    columns = {"configuration": np.full(40, "bench"), "time_s": TIME, "total_current_A": RNG.uniform(1, 5, 40)}
    logged = columns | {"supply_voltage_V": voltage}, np.ones(40)
    scope = replace(SCOPE, balances=("electrical",), axes=("supply_voltage_V",))
    assert ("time" in variables(curve_families(*logged, scope=scope))) == expected
    assert any(v.startswith("time") for v in variables(window_families(*logged, scope=scope))) == expected


def variables(found):
    return [v for _, v in family_names(found)]


def test_curves_of_channels_are_over_their_reading_and_what_order_brings():
    for columns, over in ((table(), set()), (shuffled(table()), {"order"})):
        of = {c: {v for p, v in family_names(curve_families(columns, COUNTS)) if p == c} for c in channels.USUAL}
        assert of == {
            "total_current": {"current"} | over, "motor_speed": {"speed_motor"} | over, "speed": {"speed"} | over,
        }  # fmt: skip


# --- windows --------------------------------------------------------------------------------------------


def test_a_window_is_read_from_its_name():
    for of in (Window("time", 0.6, 0.75), Window("order", 12.0, 19.0), Window("time", 1e-05, 12345.0)):
        assert window_from_name(str(of)) == of
    for word in ("time", "order", CONDITIONS, "speed_motor", *ORDERS):
        assert window_from_name(word) is None


def test_windows_cover_the_order_and_overlap_by_half():
    basis, shown = window_families(shuffled(table()), COUNTS)
    assert [v for _, v in shown.names[:4]] == [v for _, v in basis.names[:4]]
    assert {n[0] for n in basis.names} == set(BALANCES) and {n[0] for n in shown.names} == set(channels.USUAL)
    assert basis.columns.shape[2] == 1 and set(np.unique(basis.columns)) == {0.0, 1.0}
    order, shapes = shuffled(table())["order"], []
    for of, inside in windows_of(basis, "track", "order"):
        assert_array_equal(inside, of.holds(order))
        assert FEWEST <= inside.sum() <= ROWS / 2
        shapes.append(inside)
    assert np.any(shapes, 0).all()
    # something that happens within half a window of the smallest share lies in one
    for first in range(1, ROWS - 3):
        assert any(s[(order >= first) & (order < first + 2)].all() for s in shapes)


def windows_of(basis, place, axis=None):
    """Windows of one balance over an axis, and the rows in each."""
    for (balance, name), column in zip(basis.names, np.asarray(basis.columns), strict=True):
        of = window_from_name(name)
        if balance == place and axis in (None, of.axis):
            yield of, column[:, 0] > 0


def over_order(columns):
    return [n for b in window_families(columns, COUNTS) for n in b.names if n[1].startswith("order")]


def test_windows_of_the_order_only_where_conditions_do_not_tell_it():
    """Some runs one after the other of a grid are those at some of its conditions."""
    assert over_order(shuffled(table())) and not over_order(table())


def test_order_is_told_by_combinations_of_conditions():
    """Voltages up with the one configuration and down with the other: no sum of their terms gives the order."""
    columns = table()
    wheeled = columns["configuration"] == "4W2T"
    key = np.where(wheeled, columns["supply_voltage_V"], -columns["supply_voltage_V"])
    sequence = np.lexsort((columns["slope_deg"], key, wheeled))
    order = np.empty(len(key))
    order[sequence] = np.arange(len(key))
    assert order_collinearity({**columns, "order": order}, COUNTS) > COLLINEAR["order"]
    assert not over_order({**columns, "order": order})


def test_windows_of_histories_are_in_time_at_the_same_instants_of_all_runs():
    time = np.tile(np.linspace(0, 1.5, 30), 2)
    columns = table(time_s=time, supply_voltage_V=np.full(ROWS, 24.0), slope_deg=np.zeros(ROWS))
    for basis in window_families(columns, COUNTS):
        over_time = [
            inside for place in {n[0] for n in basis.names} for _, inside in windows_of(basis, place, "time")
        ]
        assert over_time
        for inside in over_time:
            assert_array_equal(inside[:30], inside[30:])


def test_levels_of_conditions_are_windows():
    columns = table()
    basis = window_families({k: v for k, v in columns.items() if k != "order"}, COUNTS)[0]
    found, slopes = dict(windows_of(basis, "slip")), np.unique(columns["slope_deg"])
    mine = sorted((w for w in found if w.axis == "slope"), key=lambda w: w.low)
    assert_allclose([w.low for w in mine], np.radians(slopes), rtol=1e-4, atol=1e-6)
    for w, inside in found.items():
        assert_array_equal(inside, w.holds(columns[VARIABLES[w.axis]] * LEVELS[w.axis][0]))
    assert mine[-1].words == f"{slopes[-1]:g} deg of slope"


def test_rows_that_do_not_count_are_in_no_window():
    counts = COUNTS.copy()
    counts[[5, 20, 40]] = 0
    for basis in window_families(shuffled(table()), counts):
        assert not np.asarray(basis.columns)[:, [5, 20, 40]].any()


def test_a_table_without_order_or_levels_has_no_windows():
    rng = default_rng(3)
    measured = {c: rng.uniform(1, 9, ROWS) for c in ("supply_voltage_V", "slope_deg", "payload_kg")}
    assert window_families({k: v for k, v in (table() | measured).items() if k != "order"}, COUNTS) == ()


def test_an_order_that_the_only_condition_tells_has_no_curves():
    order = np.arange(1.0, ROWS + 1)
    columns = {"configuration": np.full(ROWS, "bench"), "motor_current_A": order, "order": order}
    alone = replace(SCOPE, balances=("electrical", "track"), axes=("motor_current_A",))
    assert {v for _, v in family_names(curve_families(columns, COUNTS, scope=alone))} == {CONDITIONS}


# --- sizes ----------------------------------------------------------------------------------------------


def shapes(columns, counts):
    whole = (*curve_families(columns, counts), *window_families(columns, counts))
    return jax.tree.structure(for_equations(whole)), [b.columns.shape for b in whole]


@pytest.mark.parametrize("seed", range(4))
def test_tables_of_one_size_have_families_of_one_size(seed):
    """Whatever their order, gaps and rows that do not count: else each table is compiled for itself."""
    rng = default_rng(seed)
    first = shapes(table(), COUNTS)
    counts = (rng.uniform(size=ROWS) < 0.6).astype(float)
    gaps = np.sort(rng.choice(np.arange(1.0, 500.0), ROWS, replace=False))
    short = np.where(np.arange(ROWS) < 40, 1.0, 0.0)
    for columns, weight in (
        (shuffled(table(), seed), COUNTS), (table(), counts), (table(order=gaps), counts), (table(), short),
        (table(order=rng.permutation(gaps)), short), (table(slope_deg=np.zeros(ROWS)), COUNTS),
    ):  # fmt: skip
        assert shapes(columns, weight) == first


# --- waves of a shaft -----------------------------------------------------------------------------------


def back_and_forth(turn, runs=3, samples=100):
    """Angles of runs that go ahead and come back, each somewhat further, and the rows of each."""
    rows = np.arange(runs * samples).reshape(runs, samples)
    way = np.sin(np.linspace(0.0, np.pi, samples))
    return np.concatenate([turn * (1 + 0.1 * k) * way for k in range(runs)]), rows


def waves_of(turn):
    """Order of the shaft → columns of its wave in one balance, of runs that turn so far [rad] and come back."""
    angle, rows = back_and_forth(turn)
    (basis,) = wave_families(np.zeros(angle.size, bool), angle, rows, rows, BALANCES)
    every = {n: np.asarray(c) for n, c in zip(basis.names, basis.columns, strict=True)}
    return angle, rows, {v: c for (place, v), c in every.items() if place == "track"}


def test_a_wave_is_of_the_runs_that_pass_two_of_it_wherever_they_end():
    """Runs that come back end where they began. Each has a phase of its own, in columns of its own."""
    angle, rows, found = waves_of(7.0)
    expected = np.zeros_like(found["order 2 of the driving shaft"])
    for k, mine in enumerate(rows):
        expected[mine, 2 * k : 2 * k + 2] = np.stack([np.cos(2 * angle[mine]), np.sin(2 * angle[mine])], -1)
    assert_allclose(found["order 2 of the driving shaft"], expected)


def test_pieces_of_a_wave_have_one_phase_in_all_runs():
    """A piece with a phase of its own is any level and trend of a run. No name is held against what can be anything."""
    angle, _, found = waves_of(1.2)
    assert set(found) == {f"order {k} of the driving shaft" for k in (1, 2, 3)}
    for k in (1, 2, 3):
        wave = found[f"order {k} of the driving shaft"]
        assert_allclose(wave[:, :2].T, [np.cos(k * angle), np.sin(k * angle)])
        assert not wave[:, 2:].any()
