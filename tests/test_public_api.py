"""The public API: five lines, one run or a batch, any fidelity. Transformations go through, wrong use is said."""

import dataclasses
import datetime
import os
import re
import subprocess
import sys
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import polars as pl
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mmrjax as mm
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.inference import priors
from mmrjax import fidelities
from mmrjax.effects import ALL
from mmrjax.errors import LONGEST
from mmrjax.fidelities import outputs
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import channels, paper_robots, params
from mmrjax.model.signals import Result
from tests.commands import ROOT, refused


def python(code, **environment):
    clean = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}  # JAX is single, as its users find it
    answer = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=ROOT, env={**clean, **environment}, capture_output=True,
        text=True, timeout=300, check=False,
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


# --- the package --------------------------------------------------------------------------------------


def test_import_loads_no_jax():
    assert python("import sys, mmrjax; print('jax' in sys.modules, 'numpy' in sys.modules)") == "False False\n"


def test_layers_above_are_imported_when_they_are_asked_for_and_not_before():
    """`mm.simulate` loads none of them. The names of `_ABOVE` are theirs."""
    loaded = "sorted({m.partition('.')[0] for m in sys.modules} & {'calibration', 'sweeps', 'pydantic'})"
    code = (
        f"import sys, mmrjax as mm; mm.simulate; dir(mm); print({loaded}); mm.calibrate; print({loaded}); mm.sweep; "
        f"print({loaded}, mm.calibrate.__module__, mm.sweep.__module__)"
    )
    first, second, third = python(code).splitlines()
    assert first == "[]" and second == "['calibration']" and third.startswith("['calibration', 'pydantic', 'sweeps']")
    assert third.endswith("calibration.inference.calibration sweeps.points.grid")
    assert set(mm._ABOVE) == set(mm.__all__) - set(mm._HOME) - {"__version__"}


def test_a_sweep_is_its_grid_simulated(robot):
    found = mm.sweep(robot, configurations="4W2T", voltages=[15, 24], payloads=2.0, slopes_deg=[0.0, 5.0])
    assert found.shape == (4,) and found.conditions.slope_deg.tolist() == [0.0, 5.0, 0.0, 5.0]
    alone = mm.simulate(robot, mm.Conditions("4W2T", voltage=24.0, payload=2.0, slope_deg=5.0))
    assert_allclose(found.total_current[3], alone.total_current, rtol=1e-12)
    assert mm.sweep(robot).shape == (180,)  # Table 8
    with refused("6T2B; the robot has no such configuration; did you mean 6T2A", BadConfiguration):
        mm.sweep(robot, configurations=["6T2B"])
    with pytest.raises(mm.UsageError, match=r"slope_deg\[1\]: got 95; expected -45 to 45"):
        mm.sweep(robot, configurations="6T2A", voltages=24.0, payloads=0.0, slopes_deg=[0, 95])


def test_a_robot_shows_values_and_units(robot):
    text = repr(dataclasses.replace(robot, effects=(ALL[0](amplitude=0.1),)))
    assert text.startswith("Robot: 6T2A, 4W2T; 2 motors with the same command, mass_error\n")
    assert (
        "  motor: resistance 0.611 ohm, inductance 0.000119 H" in text and "effects.mass_error: amplitude 0.1" in text
    )
    assert all(f"{p.name.rpartition('.')[2]} " in text for p in params.walk_parameters(robot))
    batch = mm.replace(robot, {"motor.resistance": jnp.ones(3)})
    assert "resistance array[3] ohm" in repr(batch)
    traced = []
    jax.jit(lambda r: traced.append(repr(mm.replace(robot, {"motor.resistance": r}))) or r)(0.5)
    assert "Tracer" in traced[0] or "JitTracer" in traced[0]


def test_package_states_its_names_version_and_types(robot):
    assert set(mm.__all__) <= set(dir(mm))
    assert {"motor", "gearbox", "battery"} <= set(dir(robot)) and "within" not in dir(robot)
    for name in mm.__all__:
        assert getattr(mm, name) is not None
    with pytest.raises(AttributeError, match="module 'mmrjax' has no attribute 'simulat'"):
        _ = mm.simulat
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert mm.__version__ == stated["project"]["version"]
    for package in ("mmrjax", "calibration", "sweeps"):
        assert (ROOT / package / "py.typed").exists()
        assert "py.typed" in stated["tool"]["setuptools"]["package-data"][package]
    assert "__init__.pyi" in stated["tool"]["setuptools"]["package-data"]["mmrjax"]
    # an editable install is then a path, which type checkers follow, and no import hook
    assert stated["tool"]["setuptools"]["package-dir"] == {"": "."}


def test_type_checkers_see_every_public_name():
    text = (ROOT / "mmrjax/__init__.pyi").read_text(encoding="utf-8")
    assert set(re.findall(r"import (\w+) as \1", text)) == set(mm.__all__) - {"__version__"}


# --- one run, a batch, any fidelity --------------------------------------------------------------------


def test_one_run_has_scalars(robot):
    one = mm.simulate(robot, mm.Conditions(configuration="4W2T", voltage=15.0))
    assert one.shape == () and one.total_current.shape == () and one.history is None
    assert str(one.configuration) == "4W2T" and str(one.statuses) == "converged"
    assert one.to_dict()["total_current_A"].shape == ()
    assert len(str(one).splitlines()) == 3 and repr(one).startswith("Results of steady, 1 run\n")


def test_fields_broadcast_configurations_among_them(robot):
    runs = mm.Conditions(configuration=["6T2A", "4W2T"], voltage=24.0, slope_deg=[[0.0], [5.0], [10.0]])
    many = mm.simulate(robot, runs)
    assert many.shape == (3, 2)
    assert many.configuration.tolist() == [["6T2A", "4W2T"]] * 3
    for row, slope in enumerate((0.0, 5.0, 10.0)):
        for column, name in enumerate(("6T2A", "4W2T")):
            alone = mm.simulate(robot, mm.Conditions(configuration=name, voltage=24.0, slope_deg=slope))
            assert_allclose(many.slip[row, column], alone.slip, rtol=1e-12)
    by_index = mm.simulate(robot, dataclasses.replace(runs, configuration=jnp.asarray([[0, 1]] * 3)))
    assert_array_equal(by_index.total_current, many.total_current)


def test_every_result_field_and_channel_is_an_attribute(robot):
    one = mm.simulate(robot, mm.Conditions())
    for field in dataclasses.fields(Result):
        assert getattr(one, field.name) is getattr(one.result, field.name)
    for name in channels.USUAL:
        assert getattr(one, name) is one.reading[name]
    with pytest.raises(AttributeError, match="Results has no torque"):
        _ = one.torque


def test_status_compares_with_its_words_and_refuses_others(robot):
    many = mm.simulate(robot, mm.Conditions(voltage=[24.0, 0.5, 24.0], slope_deg=[5.0, 5.0, 20.0]))
    for codes in (many.status, many.result.status, jax.tree.map(lambda x: x, many).status):
        assert (codes == "converged").tolist() == [True, False, False]
        assert (codes != "stalled").tolist() == [True, False, True]
        assert (codes == ["converged", "stalled", "converged"]).tolist() == [True, True, False]
        assert codes[1] == "stalled" and (codes[1:] == "slides").tolist() == [False, True]
        assert (codes == 0).tolist() == [True, False, False] and jnp.sum(codes) == np.sum(codes)
        with pytest.raises(mm.UsageError, match="status: got convergd; did you mean converged"):
            codes == "convergd"  # noqa: B015
    one = mm.simulate(robot, mm.Conditions(voltage=24.0))
    assert one.status == "converged" and f"{one.status}" == "0" and one.statuses == "converged"


def test_to_dict_has_the_columns_of_runs_csv(robot):
    runs = mm.Conditions(configuration=["6T2A", "4W2T"], voltage=24.0, payload=2.0)
    columns = mm.simulate(robot, runs).to_dict()
    conditions = ["configuration", "supply_voltage_V", "total_mass_kg", "payload_kg", "slope_deg"]
    assert list(columns) == [
        *conditions,
        *(output.column for output in outputs.output_table(channels.usual_channels())),
        "status",
        "flags",
    ]
    assert columns["total_mass_kg"].tolist() == [15.1, 13.5]
    assert columns["supply_voltage_V"].tolist() == [24.0, 24.0]
    assert columns["status"].tolist() == ["converged", "converged"] and columns["flags"][1] == "gearbox_overspeed"
    result = steady_batch(robot, runs.resolved(robot))
    assert_allclose(columns["motor_speed_rpm"], result.motor_speed * 30 / np.pi, rtol=1e-12)
    assert_allclose(columns["theoretical_speed_mm_s"], result.theoretical_speed * 1e3, rtol=1e-12)
    weighed = mm.simulate(robot, dataclasses.replace(runs, total_mass=jnp.asarray([16.0, 17.0])))
    assert weighed.to_dict()["total_mass_kg"].tolist() == [16.0, 17.0] == weighed.mass.tolist()
    on_battery = mm.simulate(robot, dataclasses.replace(runs, battery=jnp.asarray([0.0, 1.0])))
    assert_array_equal(on_battery.to_dict()["supply_voltage_V"], [24.0, np.nan])


def test_table_shows_units_and_as_many_rows_as_wanted(robot):
    many = mm.simulate(robot, mm.Conditions(voltage=np.linspace(10.0, 30.0, 50)))
    lines = many.table().splitlines()
    assert len(lines) == 43 and lines[-1] == "... and 10 more" and "[mm/s]" in lines[1]
    chosen = many.table(["supply_voltage_V", "efficiency_motor", "status"], rows=2).splitlines()
    assert chosen[0].split() == ["supply", "motor", "efficiency", "status"] and chosen[1].split() == ["[V]"]
    assert chosen[2].split()[::2] == ["10.00", "converged"]
    assert chosen[-1] == "... and 48 more"


@pytest.mark.slow
def test_drive_keeps_histories(robot):
    one = mm.simulate(robot, mm.Conditions(voltage=24.0), model="drive", duration=1.0)
    history = one.history
    assert history.time.shape == history.signals.speed.shape == history.reading["speed"].shape
    assert history.time.ndim == 1 and len(history.time) > 1000
    assert history.time[-1] == 1.0 and 0.5 < history.distance[-1] < 0.75
    assert_allclose(history.reading["total_current"][-1], one.total_current, rtol=1e-12)
    assert mm.simulate(robot, mm.Conditions(voltage=24.0), model="drive", duration=1.0, history=False).history is None


def in_fours(monkeypatch):
    """Runs in one call of `steady` four at a time. Returns the shapes of the calls that are made."""
    sizes = []
    whole = fidelities.get_fidelity("steady")

    def run(robot, conditions, options):
        sizes.append(("run", conditions.shape))
        return whole.run(robot, conditions, options)

    def some(robot, conditions, names):
        sizes.append((names, conditions.shape))
        return whole.outputs(robot, conditions, names)

    monkeypatch.setitem(
        fidelities.TABLE, "steady", dataclasses.replace(fidelities.fidelity_facts("steady"), chunk=(4, 4))
    )
    few = dataclasses.replace(whole, run=run, outputs=some)
    monkeypatch.setattr("mmrjax.fidelities.steady.FIDELITY", few)
    return sizes


@pytest.mark.slow
def test_large_batches_run_in_chunks(robot, monkeypatch):
    """Ten runs by four: the last call repeats two of the one before, which are left out."""
    runs = mm.Conditions(voltage=np.linspace(10.0, 30.0, 10))
    together = mm.simulate(robot, runs)
    sizes = in_fours(monkeypatch)
    by_fours = mm.simulate(robot, runs)
    assert sizes == []
    assert_allclose(by_fours.total_current, together.total_current, rtol=1e-13)
    assert sizes == [(("total_current", "motor_speed", "speed", "status"), (4,))] * 3
    assert_allclose(by_fours.slip, together.slip, rtol=1e-13)
    assert sizes[3:] == [("run", (4,))] * 3
    three = mm.simulate(robot, mm.Conditions(voltage=np.reshape(runs.voltage[:3], (3, 1)))).slip
    assert_allclose(three[:, 0], together.slip[:3], rtol=1e-13)
    assert sizes[6:] == [("run", (4,))]  # fewer are filled up to share the program


# --- transformations ------------------------------------------------------------------------------------


def current(resistance, robot, runs, **options):
    return mm.simulate(mm.replace(robot, {"motor.resistance": resistance}), runs, **options).total_current


def test_vmap_and_jit_go_through(robot):
    run = mm.Conditions(configuration="4W2T", voltage=24.0, slope_deg=5.0)
    values = jnp.asarray([0.5, 0.7, 0.9])
    wanted = [current(r, robot, run) for r in values]
    assert_allclose(jax.vmap(lambda r: current(r, robot, run))(values), wanted, rtol=1e-12)
    assert_allclose(jax.jit(lambda r: current(r, robot, run))(values[0]), wanted[0], rtol=1e-12)
    whole = jax.jit(lambda robot, volt: mm.simulate(robot, mm.Conditions(voltage=volt)))(
        robot, jnp.asarray([15.0, 24.0])
    )
    assert isinstance(whole, mm.Results) and whole.statuses.tolist() == ["converged"] * 2
    batch = jax.vmap(lambda volt: mm.simulate(robot, mm.Conditions(voltage=volt)))(jnp.asarray([15.0, 24.0]))
    assert_allclose(batch.total_current, whole.total_current, rtol=1e-12)
    assert len(batch.table().splitlines()) == 4


@pytest.mark.quick(1)
@pytest.mark.parametrize("model, transform", [("steady", jax.grad), ("drive", lambda f: f)])
def test_a_turn_passes_jit_though_its_default_duty_is_a_tracer_there(robot, model, transform):
    """Traced, not compiled."""
    options = {} if model == "steady" else dict(model="drive", duration=0.1, history=False)

    def yaw_rate(left):
        run = mm.Conditions("6T2A", voltage=24.0, duty_left=left, duty_right=1.0)
        return mm.simulate(robot, run, **options).result.reading["yaw_rate"]

    assert jax.eval_shape(jax.jit(transform(yaw_rate)), 0.5).dtype == float


def test_a_delay_is_known_under_jit_where_the_robot_is_no_argument(robot):
    """Or no history passes `jax.jit`."""
    assert jax.eval_shape(lambda x: x if robot.rig.prompt else (x, x), 1.0).shape == ()


@pytest.mark.slow
def test_derivative_by_conditions_and_through_bad_values_passes_the_door(robot):
    slope = jax.grad(lambda angle: mm.simulate(robot, mm.Conditions(slope_deg=angle)).total_current)(5.0)
    assert np.isfinite(slope) and slope > 0
    status = jax.jit(lambda volt: mm.simulate(robot, mm.Conditions(voltage=volt)).status)(jnp.nan)
    assert mm.STATUSES[int(status)] == "failed"


# --- wrong use --------------------------------------------------------------------------------------------


def test_every_packaged_robot_is_within_its_bounds(robot):
    for build in paper_robots.ROBOTS.values():
        mm.simulate(build(), mm.Conditions())
    mm.simulate(dataclasses.replace(robot, effects=tuple(effect() for effect in ALL)), mm.Conditions())


WRONG = {
    "slope_deg: got 95; expected -45 to 45 deg": dict(slope_deg=95),
    "slope_deg[1]: got -50; expected -45 to 45 deg": dict(slope_deg=[0.0, -50.0]),
    "slope_deg[0, 2]: got 60; expected -45 to 45 deg": dict(slope_deg=[[0.0, 1.0, 60.0]]),
    "payload: got -1; expected 0 to 300 kg": dict(payload=-1.0),
    "payload: got 301; expected 0 to 300 kg": dict(payload=301.0),
    "voltage: got -24000; expected -10000 to 10000 V": dict(voltage=-24000.0),
    "voltage: got nan; expected -10000 to 10000 V": dict(voltage=np.nan),
    "voltage[2]: got inf; expected -10000 to 10000 V": dict(voltage=[1.0, 2.0, np.inf]),
    "battery: got 2; expected 0 to 1": dict(battery=2.0),
    "discharge: got -5; expected 0 to 360000 C": dict(discharge=-5.0),
    "adhesion: got 0; expected 0.001 to 100": dict(adhesion=0.0),
    "total_mass: got 600; expected 0.1 to 500 kg": dict(total_mass=600.0),
    "total_mass: got 8 kg; expected more than the payload, 8 kg": dict(total_mass=8.0, payload=8.0),
    "total_mass[1]: got 8 kg; expected more than the payload, 9 kg": dict(total_mass=8.0, payload=[3.0, 9.0]),
    "configuration: got 6T2B; did you mean 6T2A? allowed: 6T2A, 4W2T": dict(configuration="6T2B"),
    "configuration: got legs; allowed: 6T2A, 4W2T": dict(configuration=["6T2A", "legs"]),
    "configuration: got 2; expected one of 0 (6T2A), 1 (4W2T)": dict(configuration=2),
    "configuration[1]: got -1; expected one of 0 (6T2A), 1 (4W2T)": dict(configuration=[0, -1]),
}
#: Value of a parameter → what is said.
WRONG_VALUE = {
    ("motor.resistance", -1.0): "got -1; expected 0.001 to 1000 ohm (terminal resistance R_rot, eq. (15))",
    ("motor.resistance", np.nan): "got nan; expected 0.001 to 1000 ohm (terminal resistance R_rot, eq. (15))",
    ("4W2T.mass", 0.0): "got 0; expected 0.01 to 10000 kg (mass of the robot without payload)",
}
WRONG_CALL = {
    "model: got fast; allowed: steady, drive, track": dict(model="fast"),
    "model: got stedy; did you mean steady? allowed: steady, drive, track": dict(model="stedy"),
    "model drive, patience: got 3; this fidelity has the options: duration": dict(model="drive", patience=3),
    "model drive, duration: got -1; expected more than 0, at most 86400 s": dict(model="drive", duration=-1.0),
    "model track, duration: got 0.0015 s; expected a whole number of samples of 0.001 s": dict(
        model="track", duration=0.0015
    ),
    "history: got 1001 runs; expected at most 1000; set history=False": dict(
        conditions=mm.Conditions(voltage=np.full(1001, 24.0)), model="drive"
    ),
    "conditions: got dict; expected mmrjax.Conditions(...)": dict(conditions={"voltage": 3.0}),
    "robot: got function; expected a Robot such as mmrjax.nominal()": dict(robot=mm.nominal),
}
WRONG_CALL |= {message: dict(conditions=mm.Conditions(**given)) for message, given in WRONG.items()}
WRONG_CALL |= {
    f"{name}: {said}": dict(robot=params.replace(paper_robots.nominal(), {name: value}))
    for (name, value), said in WRONG_VALUE.items()
}


@pytest.mark.parametrize("message", WRONG_CALL)
def test_simulate_refuses_a_wrong_call_with_place_value_and_limits(message, robot):
    with pytest.raises(mm.UsageError) as error:
        mm.simulate(**{"robot": robot, "conditions": mm.Conditions()} | WRONG_CALL[message])
    assert isinstance(error.value, ValueError) and str(error.value) == message


MASKED = np.ma.masked_array([24.0, 12.0], [False, True])
FREE = "motor.resistance"
MEASURED = ROOT / "calibration/data/measured.csv"


@pytest.fixture(scope="module")
def table():
    return pd.read_csv(MEASURED).head(6)


#: Functions of the robot and a sound table; the class of error and words of its sentence.
REFUSED = {
    **{
        f"configuration {value}": (lambda r, t, v=value: mm.simulate(r, mm.Conditions(v)), mm.UsageError, words)
        for value, words in ((1.5, "got 1.5; expected whole numbers, or names"), (True, "got True; expected whole"))
    },
    **{
        f"voltage {value!r}": (lambda r, t, v=value: mm.simulate(r, mm.Conditions(voltage=v)), mm.UsageError, words)
        for value, words in (
            (True, "got True; expected numbers"),
            ([True, False], "got [True, False]; expected numbers"),
            (datetime.timedelta(1), "got datetime.timedelta(days=1); expected numbers"),
            (np.timedelta64(24, "s"), "expected numbers"),
            ("abc", "got 'abc'; expected numbers"),
            (24 + 1j, "got (24+1j); expected numbers"),
            (MASKED, "got masked numbers; expected numbers"),
        )
    },
    **{
        f"{call} {value!r}": (
            lambda r, t, v=value, call=call: DOORS[call](params.replace(r, {"motor.resistance": v}), t), error, words
        )
        for call, error in (("simulate", mm.UsageError), ("calibrate", BadConfiguration))
        for value, words in (
            ("abc", "motor.resistance: got 'abc'; expected one number"),
            (datetime.timedelta(1), "got datetime.timedelta(days=1); expected one number"),
            (1j, "got 1j; expected one number"),
            (None, "got None; expected one number"),
            (np.ones(2), "got shape (2,); expected one number"),
            (jnp.ones(2), "got shape (2,); expected one number"),
            (MASKED, "got shape (2,); expected one number"),
        )
    },
    **{
        f"{name} {value}": (lambda r, t, n=name, v=value: DOORS["calibrate"](r, t, **{n: v}), BadConfiguration, words)
        for name, words, values in (
            ("starts", "expected a whole number from 1 to 100000", (10**12, 0, -1, True, 1.5)),
            ("seed", "expected a whole number from 0 to 4294967295", (-1, 2**70, 0.5)),
            ("noise", "expected a positive number", ("total_current=-1",)),
        )
        for value in values
    },
    **{
        f"prior's sd {sd}": (
            lambda r, t, sd=sd: priors.parameter_coordinates(r, [FREE], {FREE: (0.6, sd)}),
            BadConfiguration,
            f"{FREE}: got an sd of {sd}; expected more than 0",
        )
        for sd in (-0.1, 0, np.nan)
    },
    **{
        f"calibrate {type(runs).__name__}": (lambda r, t, x=runs: mm.calibrate(x, r), BadConfiguration, "expected Runs")
        for runs in (pd.DataFrame({"a": [1.0]}), MEASURED, str(MEASURED), None)
    },
    "empty path": (lambda r, t: mm.read_runs(""), BadData, "got an empty path; expected a path"),
    "no source": (lambda r, t: mm.read_runs(None), BadData, "got NoneType; expected a path"),
    "sd of a table": (
        lambda r, t: mm.read_runs(t.assign(total_current_sd_A=-1.0)), BadData, "total_current_sd_A: got -1; expected more"
    ),
    "one name twice": (
        lambda r, t: mm.read_runs(pd.concat([t, t["slope_deg"]], axis=1)), BadData, "slope_deg: has the same name as another"
    ),
    "complex readings": (
        lambda r, t: mm.read_runs(t.assign(total_current_A=1j)), BadData, "total_current_A: holds complex numbers"
    ),
}  # fmt: skip
DOORS = {
    "simulate": lambda robot, table: mm.simulate(robot, mm.Conditions()),
    "calibrate": lambda robot, table, **options: mm.calibrate(mm.read_runs(table), robot, **options),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_arguments_are_refused_in_a_sentence(case, robot, table):
    call, error, words = REFUSED[case]
    with pytest.raises(error) as refusal:
        call(robot, table)
    assert words in str(refusal.value) and len(str(refusal.value)) <= LONGEST


def test_lazy_and_masked_tables_are_read_as_others(table):
    """A lazy frame is collected. A masked reading is missing."""
    wanted = mm.read_runs(table).columns
    lazy = mm.read_runs(pl.from_pandas(table).lazy()).columns
    for name, values in wanted.items():
        assert_array_equal(lazy[name], values)
    current = np.ma.masked_array(table["total_current_A"], np.arange(len(table)) == 2)
    masked = mm.read_runs({name: table[name].tolist() for name in table} | {"total_current_A": current})
    assert np.isnan(masked["total_current_A"]).tolist() == [False, False, True, False, False, False]
    assert_array_equal(mm.Conditions(voltage=np.ma.masked_array([24.0, 12.0])).voltage, [24.0, 12.0])
