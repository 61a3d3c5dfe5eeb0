"""Tables of rigs: which columns a robot's file asks for, other units, surfaces, directions, and their refusals."""

import functools
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import configuration_tables, inferred_facts, robot_file
from calibration.data import runs as records
from calibration.inference import bases, blocks, checks, noise, observers, priors
from calibration.inference.calibration import calibrate
from calibration.inference.fit_notes import Remark
from calibration.inference.ranges import check_ranges
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import paper_robots, params, quantities
from mmrjax.model.chassis import Chassis
from mmrjax.model.conditions import Conditions
from mmrjax.model.contact import Friction, Ground, Track
from mmrjax.model.quantities import RPM
from mmrjax.model.rig import Instrument, Rig
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import STALLED
from tests.commands import csv_text, read_rig, read_table, refused, text_file, with_columns

DRIVE = {
    "motor.resistance": 2.0,
    "motor.torque_constant": 0.05,
    "motor.friction_coulomb": 0.004,
    "gearbox.ratio": 16.0,
}


def rig(load, *, sides=1.0, **stated):
    """A rig from nothing with one load, with its channels."""
    robot = paper_robots.blank_robot(Configurations({"rig": load}), sides, Rig(**stated))
    return params.replace(robot, DRIVE)


def bench(imposed="motor_speed", shown=("total_current",), sides=1.0, load=None, **stated):
    usual = {"inertia": 1e-3, "loss_coulomb": 0.05, "loss_viscous": 0.004}
    return rig(Shaft(**{**usual, **(load or {})}), sides=sides, imposed=imposed, channels=shown, **stated)


def vehicle(mass=10.0, **stated):
    stated = {"imposed": "motor_speed", "channels": ("total_current", "speed"), **stated}
    track = Track(loss_coulomb=0.02, loss_viscous=0.0, guide_share=0.0)
    ground = Ground(Friction(static=0.5, dynamic=0.4), rolling_resistance=0.05)
    return rig(Chassis(track=track, ground=ground, on_tracks=0.0, mass=mass, radius=0.05, inertia=1e-3), **stated)


read = functools.partial(read_table, name="runs.csv")


def measured(tmp_path, robot, conditions, columns, true=None, *, share=0.01, seed=0):
    """A table of what a robot with other parameters shows."""
    found = steady_batch(params.replace(robot, true or {}), conditions)
    rng = np.random.default_rng(seed)
    columns = dict(columns)
    for c in robot.channels:
        x = np.asarray(found.reading[c.name]) / c.factor
        columns[c.column] = [f"{v:.6g}" for v in x * (1 + share * rng.standard_normal(x.shape))]
    return read(tmp_path, csv_text(columns), robot)


# --- which columns


def test_a_bench_needs_what_is_imposed_and_a_channel_alone(tmp_path):
    robot = bench()
    runs = read(tmp_path, "motor_speed_rpm,total_current_A\n1000,0.4\n2000,0.5\n", robot)
    conditions = runs.conditions(robot)
    assert runs.axes == ("motor_speed_rpm",) and conditions.motor_speed == pytest.approx(
        [1000 * np.pi / 30] * 1 + [2000 * np.pi / 30]
    )
    assert runs["configuration"].tolist() == ["rig", "rig"] and conditions.total_mass is None
    assert runs.measured().tolist() == [[0.4], [0.5]]


def test_a_vehicle_takes_its_mass_from_its_file_and_the_flat_without_payload(tmp_path):
    robot = vehicle(imposed="voltage", channels=("total_current",))
    runs = read(tmp_path, "supply_voltage_V,total_current_A\n12,1.5\n", robot)
    conditions = runs.conditions(robot)
    assert conditions.total_mass is None and conditions.slope_deg == 0 == conditions.payload
    assert runs.axes == ("supply_voltage_V", "payload_kg", "slope_deg")


def test_conditions_and_sds_are_read_in_other_units(tmp_path):
    robot = vehicle(imposed="voltage")
    text = "supply_voltage_mV,payload_g,slope_percent,speed_m_s,speed_sd_m_s\n12000,1500,10,0.5,0.01\n"
    runs = read(tmp_path, text, robot)
    assert runs["supply_voltage_V"] == pytest.approx([12.0]) and runs["payload_kg"] == pytest.approx([1.5])
    assert runs["slope_deg"] == pytest.approx([np.degrees(np.arctan(0.1))])
    assert runs["speed_mm_s"] == pytest.approx([500.0]) and runs["speed_sd_mm_s"] == pytest.approx([10.0])


def test_columns_of_other_names_are_those_that_the_robots_file_says(tmp_path):
    robot = bench(columns=(("total_current_A", "I_mean", 1.0), ("motor_speed_rpm", "ticks_s", 60 / 2048)))
    runs = read(tmp_path, "ticks_s,I_mean,note\n20480,0.4,x\n", robot)
    assert runs["motor_speed_rpm"] == pytest.approx([600.0]) and runs["total_current_A"] == [0.4]
    assert runs.unknown == ("note",)
    unread = bench(columns=(("speed_m_s", "v", 1.0),))
    assert read(tmp_path, "motor_speed_rpm,total_current_A,v\n900,0.4,1\n", unread).unknown == ("v",)


BENCH = "motor_speed_rpm,total_current_A\n"


@pytest.mark.parametrize(
    "column, cells",
    [
        ("time_s", ("1764072000.25", "1764072000.5", "1764072001.5")),
        ("time_ms", ("1764072000250", "1764072000500", "1764072001500")),
        ("time_s", ("2026-11-25 12:00:00.25", "2026-11-25 12:00:00.5", "2026-11-25 12:00:01.5")),
        ("time_ms", ("2026-11-25T12:00:00.250Z", "2026-11-25T13:00:00.5+01:00", "2026-11-25T12:00:01.500Z")),
        ("time_s", ("11:59:59.75", "12:00:00", "12:00:01")),
        ("time_s", ("23:59:59.75", "00:00:00", "00:00:01")),
        ("time_s", ("25.11.2026 23:59:59.75", "26.11.2026 00:00:00", "26.11.2026 00:00:01")),
    ],
)
def test_times_of_day_count_from_the_first_of_each_run(tmp_path, column, cells):
    later = [cell.replace("1764072", "1764079").replace("2026-11-25", "2026-11-27") for cell in cells]
    rows = "".join(f"{run},{cell},12,0.4\n" for run, each in (("a", cells), ("b", later)) for cell in each)
    robot = bench("voltage")
    runs = read(tmp_path, f"run_id,{column},supply_voltage_V,total_current_A\n{rows}", robot)
    assert runs["time_s"] == pytest.approx([0, 0.25, 1.25] * 2, abs=1e-6)
    assert any(f"{column} is a time of day, counted from the first row of each run" in note for note in runs.notes)
    usual = read(tmp_path, "time_s,supply_voltage_V,total_current_A\n0,12,0.4\n6,12,0.4\n7,12,0.4\n", robot)
    assert usual["time_s"] == pytest.approx([0, 6, 7]) and usual.notes == ()
    with refused(r"row 2, time_s: got 25\.11\.2026 12:00; .*expected a number"):
        read(tmp_path, "time_s,supply_voltage_V,total_current_A\n5,12,0.4\n25.11.2026 12:00,12,0.4\n", robot)


def test_a_run_begins_at_its_first_row_whatever_its_clock_shows(tmp_path):
    """Each run by its own first row, wherever that stands in the file, in any unit. A row without readings too."""
    rows = "b,0,0.4\na,3600.25,\nb,0.5,0.4\na,3600.5,0.4\nc,12,0.4\n"
    rows = "".join(f"{run},{cell},12,{amps}\n" for run, cell, amps in (r.split(",") for r in rows.split()))
    runs = read(tmp_path, f"run_id,time_s,supply_voltage_V,total_current_A\n{rows}", bench("voltage"))
    assert runs["time_s"].tolist() == [0.0, 0.0, 0.5, 0.25, 0.0]
    assert any(
        n.startswith("runs.csv: time_s begins at 3600.25 in run a, and counts from the first row") for n in runs.notes
    )
    slow = "time_min,supply_voltage_V,total_current_A\n60,12,0.4\n60.5,12,0.4\n"
    runs = read(tmp_path, slow, bench("voltage"))
    assert runs["time_s"].tolist() == [0.0, 30.0] and any(
        "time_min begins at 60, and counts" in n for n in runs.notes
    )
    late = "time_s,supply_voltage_V,total_current_A\n60,12,0.4\n-1,12,0.4\n"
    with refused(r"row 2, time_s: got -1; expected 0 to 1e\+06"):
        read(tmp_path, late, bench("voltage"))


def test_a_load_that_drives_its_motors_takes_voltage_from_their_back_emf(tmp_path):
    """E is 4.71 V: a motor that brakes with 1.3 A of 2 ohm has 2.11 V left. One that takes -0.4 A has not."""
    winch = {"torque_constant": 0.5}
    robot = bench(shown=("motor_current", "motor_voltage"), load=winch)
    header = "motor_speed_rpm,motor_voltage_V,motor_current_A\n"
    runs = read(tmp_path, f"{header}-900,-2.11,1.3\n-100,0.7,0.6\n900,5.5,0.4\n", robot)
    assert runs["motor_voltage_V"] == pytest.approx([-2.11, 0.7, 5.5])
    with refused(r"row 1, motor_voltage_V: got -2.11 at .* of -900, too small"):
        read(tmp_path, f"{header}-900,-2.11,-0.4\n900,5.5,0.4\n", robot)
    unread = bench(shown=("output_torque", "motor_voltage"), load=winch)
    header = "motor_speed_rpm,motor_voltage_V,output_torque_Nm\n"
    assert len(read(tmp_path, f"{header}-900,-2.11,2\n900,5.5,2\n1800,11,2\n", unread)) == 3
    with refused(r"row 1, motor_voltage_V: got -2.11 at"):
        read(tmp_path, f"{header}-900,-2.11,2\n900,2,2\n1800,11,2\n", unread)


TORQUE = "motor_speed_rpm,output_torque_kNm\n900,0.004\n"


def of_torque(column="output_torque_Nm", shown="M", factor=1.0):
    return bench(shown=("output_torque",), columns=((column, shown, factor),))


def test_a_unit_in_a_columns_name_is_converted_or_refused(tmp_path):
    assert read(tmp_path, TORQUE, bench(shown=("output_torque",)))["output_torque_Nm"] == pytest.approx([4.0])
    for shown in ("torque_kNm", "Torque [kN·m]"):
        text = TORQUE.replace("output_torque_kNm", shown)
        for stated in (("output_torque_kNm", shown), ("output_torque_Nm", shown, 1e3)):
            assert read(tmp_path, text, of_torque(*stated))["output_torque_Nm"] == pytest.approx([4.0])
        with refused(r"states kNm in its name, and is read in Nm; state \[columns\] output_torque_kNm"):
            read(tmp_path, text, of_torque(shown=shown))


def test_a_row_of_units_below_the_header_is_read(tmp_path):
    robot = of_torque()
    runs = read(tmp_path, "motor_speed_rpm,M,note\n[rpm],N·m,\n900,4,x\n1800,5,y\n", robot)
    assert runs["output_torque_Nm"].tolist() == [4.0, 5.0] and "contains units" in runs.notes[0]


@pytest.mark.parametrize("above", ["# made by logger\n# on a bench, of 2 motors\n\n", "# made, by logger\n# "])
def test_comment_lines_above_the_header_are_passed_over(tmp_path, above):
    for text in ("motor_speed_rpm,total_current_A\n900,0.4\n", "motor_speed_rpm;total_current_A\n900;0,4\n"):
        assert read(tmp_path, above + text, bench())["total_current_A"].tolist() == [0.4]


def test_a_slope_of_nothing_on_a_bench_is_let_pass(tmp_path):
    assert len(read(tmp_path, "motor_speed_rpm,slope_deg,total_current_A\n1000,0,0.4\n", bench())) == 1


# --- directions and instruments


def test_an_instrument_that_shows_magnitude_alone_has_no_signs(tmp_path):
    robot = bench(instruments=(Instrument("total_current", signed=False),))
    assert len(read(tmp_path, f"{BENCH}900,0.4\n-900,0.4\n", robot)) == 2


def test_a_weight_may_drive_the_motors_either_way(tmp_path):
    assert len(read(tmp_path, f"{BENCH}900,0.9\n-900,0.4\n", bench(load={"torque_constant": 0.5}))) == 2


def test_the_step_of_an_instrument_is_in_its_noise(tmp_path):
    runs = read(
        tmp_path, f"{BENCH}900,0.4\n1900,0.5\n", bench(instruments=(Instrument("total_current", quantum=0.06),))
    )
    sizes = observers.observer_kind(runs).sizes(runs)
    known = noise.noise_from_table(runs, sizes, "current=0.01A")
    assert known.sd == pytest.approx(np.sqrt(0.01**2 + 0.06**2 / 12))
    assert noise.noise_from_table(runs, sizes).sd == pytest.approx(
        0.02 * runs.measured()
    )  # an estimate has it in it already


# --- surfaces

ON = "motor_speed_rpm,surface,total_current_A,speed_mm_s\n" + "".join(
    f"{n},{s},{0.5 + n / 4000},{n * 0.2}\n" for s in ("felt", "tiles") for n in (500, 900, 1500)
)


def test_each_surface_of_a_rig_is_a_configuration_with_a_ground_of_its_own(tmp_path):
    robot = vehicle(priors=(("rig.ground.friction.static", 0.6, 0.1), ("rig.radius", 0.05, 0.001)))
    runs = read(tmp_path, ON, robot)
    apart = configuration_tables.with_surface_configurations(robot, runs)
    assert apart.configurations.names == ("rig-felt", "rig-tiles")
    assert apart.rig.surfaces == (("rig-tiles", "rig-felt"),)
    assert runs.configurations(apart).tolist() == [0, 0, 0, 1, 1, 1]
    assert {n for n, *_ in apart.rig.priors} == {
        "rig-felt.ground.friction.static", "rig-tiles.ground.friction.static", "rig-felt.radius",
    }  # fmt: skip
    assert (
        configuration_tables.with_surface_configurations(apart, runs) == apart
        or configuration_tables.with_surface_configurations(apart, runs).rig.surfaces == apart.rig.surfaces
    )
    assert runs.conditions(apart).adhesion == pytest.approx(1.0)
    again = read(tmp_path, ON, apart)  # without a column configuration
    assert again.configurations(apart).tolist() == [0, 0, 0, 1, 1, 1]
    with refused("configuration is missing, and the robot has rig-felt, rig-tiles"):
        read(tmp_path, ON.replace("felt", "sand"), apart)


def test_what_is_not_the_ground_follows_the_first_surface(tmp_path):
    robot = vehicle()
    runs = read(tmp_path, ON, robot)
    apart = configuration_tables.with_surface_configurations(robot, runs)
    names = priors.loop_parameter_names(apart, runs.configurations_named(apart))
    assert "rig-felt.radius" in names and "rig-tiles.radius" not in names
    assert {"rig-felt.ground.rolling_resistance", "rig-tiles.ground.rolling_resistance"} <= set(names)
    coordinates = priors.parameter_coordinates(apart, names)
    z = np.linspace(-1, 1, len(names))
    there = coordinates.robot(apart, z)
    felt, tiles = there.configurations.members
    assert felt.radius == tiles.radius != apart.configurations["rig-felt"].radius
    assert felt.track.loss_coulomb == tiles.track.loss_coulomb
    assert felt.ground.rolling_resistance != tiles.ground.rolling_resistance
    held = priors.parameter_coordinates(apart, ["rig-tiles.ground.rolling_resistance"])
    assert held.robot(apart, np.ones(1)).configurations["rig-tiles"].radius == 0.05


def test_one_surface_alone_and_a_robot_without_the_others_stay_as_they_are(tmp_path):
    robot = vehicle()
    runs = read(tmp_path, ON, robot)
    assert configuration_tables.with_surface_configurations(robot, runs.where(np.arange(3))).configurations.names == (
        "rig",
    )
    assert runs.configurations(robot).tolist() == [0] * 6  # simulated as it is


def test_surfaces_of_table_5_scale_the_papers_robots_and_others_are_their_own(robot):
    runs = records.read_runs("measured").where(np.arange(4))
    runs = with_columns(runs, surface=np.array(["linoleum", "linoleum", "sand", "sand"]))
    apart = configuration_tables.with_surface_configurations(robot, runs)
    assert apart.configurations.names == ("6T2A", "4W2T", "6T2A-sand") and apart.rig.surfaces == (
        ("6T2A-sand", "6T2A"),
    )
    assert runs.conditions(apart).adhesion == pytest.approx([0.42 / 0.32] * 2 + [1.0] * 2)


def test_options_name_a_configuration_that_gave_way_to_its_surfaces(tmp_path):
    robot = vehicle()
    runs = read(tmp_path, ON, robot)
    apart = configuration_tables.with_surface_configurations(robot, runs)
    said = configuration_tables.names_of_surfaces(
        ["rig.radius", "rig.ground.friction.static", "motor.resistance"], apart, runs
    )
    assert said == [
        "rig-felt.radius", "rig-felt.ground.friction.static", "rig-tiles.ground.friction.static", "motor.resistance",
    ]  # fmt: skip


# --- what is fitted


def test_blocks_of_an_imposed_speed_are_its_levels(tmp_path):
    rows = "".join(f"{n},0.4\n" for n in (501, 498, 1003, 996, 2000, 2010))
    runs = read(tmp_path, BENCH + rows, bench())
    found = blocks.blocks_of_kind(runs, "speed")
    assert [m.tolist().count(True) for m in found.values()] == [2, 2, 2]
    assert blocks.blocks_of_kind(runs, "voltage") == {} == blocks.blocks_of_kind(runs, "slope")


def test_blocks_of_a_duty_hold_data_out_where_it_alone_varies(tmp_path):
    robot = bench("voltage", ("output_speed",))
    rows = "".join(f"12,{d},{50 * d}\n" for d in (0.3, 0.3, 0.6, 0.6, 0.9, 0.9))
    runs = read(tmp_path, f"supply_voltage_V,duty,output_speed_rad_s\n{rows}", robot)
    assert [m.tolist().count(True) for m in blocks.blocks_of_kind(runs, "duty").values()] == [2, 2, 2]
    assert "duty" in blocks.distinct_held_out_blocks(runs, observers.observer_kind(runs).blocks)


def test_curves_are_over_the_fitted_motor_speed_where_only_the_output_is_read(tmp_path):
    robot = bench("voltage", ("output_speed",))
    rows = "".join(f"{u},{2 * u}\n" for u in range(4, 12))
    runs = read(tmp_path, f"supply_voltage_V,output_speed_rad_s\n{rows}", robot)
    observe = observers.observer_kind(runs).of(runs, robot)
    found = observe.bases(dict(runs.columns), np.ones(len(runs), bool), robot)
    variables = {variable for _, variable in bases.family_names(found)}
    assert {"speed_motor", "current", "voltage"} <= variables


def test_what_is_said_of_constant_conditions_is_of_the_rig(tmp_path):
    robot = bench()
    runs = read(tmp_path, f"{BENCH}900,0.4\n900,0.41\n900,0.4\n900,0.41\n", robot)
    known = noise.noise_from_table(runs, observers.observer_kind(runs).sizes(runs), "current=5%")
    said = checks.check_data(runs, robot, (), known)
    assert [note for note in said if note.code == "constant"] == [
        Remark("constant", column="motor_speed_rpm", value=900.0, alike="speed")
    ]


@pytest.mark.slow
def test_a_gear_ratio_upside_down_is_said(tmp_path):
    robot = bench("voltage", ("output_speed",))
    runs = measured(tmp_path, robot, Conditions(np.zeros(4, int), voltage=np.array([6.0, 9, 12, 24])),
                    {"supply_voltage_V": [6, 9, 12, 24]})  # fmt: skip
    assert check_ranges(runs, robot) == []
    with refused(r"about 17 times for one turn of the output, but gearbox.ratio is 0.0625: is it ups"):
        check_ranges(runs, params.replace(robot, {"gearbox.ratio": 1 / 16.0}))


@pytest.mark.slow
def test_a_slow_speed_where_the_stated_friction_holds_the_robot_is_no_matter_of_units(tmp_path):
    # Between a robot that stands and one of a tenth of its friction any speed is possible, also a sixtieth of that
    # one's, which was refused: "are they in turns/s?".
    robot = bench("motor_current", ("motor_speed",), load={"loss_coulomb": 0.4, "loss_viscous": 0.04})
    columns = {"motor_current_A": np.array([0.2, 0.22, 0.24, 0.26])}
    conditions = Conditions(np.zeros(4, int), motor_current=columns["motor_current_A"])
    light = {"motor.friction_coulomb": 4e-4, "rig.loss_coulomb": 0.04, "rig.loss_viscous": 0.004}
    runs = measured(tmp_path, robot, conditions, columns, light)
    runs = with_columns(runs, motor_speed_rpm=runs["motor_speed_rpm"] / 60)
    assert np.all(steady_batch(robot, conditions).status == STALLED)
    assert check_ranges(runs, robot) == []


def test_curves_of_runs_both_ways_count_along_the_travel(tmp_path):
    """Runs in mirror image show a curve in mirror image."""
    robot = vehicle(imposed="voltage", channels=("total_current", "motor_speed", "speed"))
    ahead, slope = np.tile([8.0, 12.0, 16.0, 20.0, 24.0], 2), np.repeat([0.0, 6.0], 5)
    voltage, slope, n = np.concatenate([ahead, -ahead]), np.concatenate([slope, -slope]), len(ahead)
    conditions = Conditions(0, voltage=voltage, slope_deg=slope)
    columns = {"configuration": ["rig"] * 2 * n, "supply_voltage_V": voltage, "slope_deg": slope}
    runs = measured(tmp_path, robot, conditions, columns, share=0.0)
    observe = observers.observer_kind(runs).of(runs, robot)
    seen = {**runs.columns, "order": np.tile(np.arange(n), 2)}
    over = set()
    for basis in observe.bases(seen, np.ones(2 * n, bool), robot):
        for (place, variable), shapes in zip(basis.names, np.asarray(basis.columns), strict=True):
            assert_allclose(shapes[:n], -shapes[n:], atol=1e-9, err_msg=f"{place} over {variable}")
            over.add((bases.window_from_name(variable) and "window") or variable)
    assert {"voltage", "slope", "speed_motor", bases.CONDITIONS, "window"} <= over


# --- instruments of which the table tells --------------------------------------------------------------


@pytest.mark.parametrize(
    "readings, step",
    [
        (0.026 * np.array([1, 3, 8, 2, 11, 4, 17, 9, 9]), 0.026),
        (0.1 + 0.026 * np.array([1, 3, 8, 2, 11, 4, 17, 9]), 0.026),  # of a meter with an offset
        (0.05 * np.array([3, 5, 10, 16, 23, 29, 40, 47]), 0.05),  # no two neighbours
        (0.026 * np.array([1, 3, 8, 2, 11, 4, 17]), 0.0),  # too few
        ([np.nan, *[3.0] * 9], 0.0),
        ([], 0.0),
        (np.random.default_rng(1).uniform(0, 1, 40), 0.0),
        (3.0 * np.r_[-8:0, 1:9], 0.0),  # set by a person, as the currents of a clamped motor
        (3.0 * np.r_[-8:0, 1:9, 4], 3.0),  # an uneven count is a display's
    ],
)
def test_step_of_readings_is_their_common_divisor(readings, step):
    assert inferred_facts.common_step(np.array(readings)) == pytest.approx(step, rel=1e-9)


def test_step_of_an_encoder_is_found_in_a_log_that_is_printed_to_nine_digits():
    """648.632813 for 648.6328125: the step was not found, and its rounding was not in the noise."""
    angle = np.round(360 / 1024 * np.cumsum(np.random.default_rng(0).integers(1, 9, 400)), 6)
    assert angle.max() > 500 and inferred_facts.common_step(angle) == pytest.approx(360 / 1024, rel=1e-4)


def test_an_instrument_left_free_is_what_its_table_shows(tmp_path):
    """Both ways, magnitudes in steps of 0.03 A: as if the file had stated that. The noise grows by the step."""
    path = tmp_path / "t.csv"
    speeds = [-3000, -2500, -2000, -1000, 1000, 1500, 2000, 3000]
    shown = [0.51, 0.48, 0.42, 0.33, 0.36, 0.39, 0.45, 0.54]
    rows = [f"{n},{i},0.01" for n, i in zip(speeds, shown, strict=True)]
    path.write_text("\n".join(["motor_speed_rpm,total_current_A,total_current_sd_A", *rows]) + "\n", encoding="utf-8")
    free = bench(instruments=(Instrument("total_current", None, None),))
    stated = bench(instruments=(Instrument("total_current", False, 0.03),))
    runs = records.read_runs(path, robot=free)
    (found,) = runs.layout.instruments
    assert found.signed is False and found.quantum == pytest.approx(0.03, rel=1e-9)
    assert inferred_facts.with_inferred_instruments(free, runs).rig.instruments == runs.layout.instruments
    assert inferred_facts.with_inferred_instruments(stated, runs) is stated
    size = np.ones((8, 1))
    sds = [noise.noise_from_table(records.read_runs(path, robot=r), size).sd for r in (free, stated)]
    assert_allclose(sds[0], sds[1], rtol=1e-9)
    assert_allclose(sds[0], np.hypot(0.01, 0.03 / np.sqrt(12)), rtol=1e-9)
    with refused("negative in reverse; or signed = false"):
        records.read_runs(path, robot=bench())
    signed = re.sub(r"(-\d+),0", r"\1,-0", path.read_text(encoding="utf-8"))
    assert records.read_runs(text_file(path, signed), robot=free).layout.instruments[0].signed is True


# --- doubts that follow the robot's file ----------------------------------------------------------------------------

MOTOR = """
schema = "mmrjax.robot/2"
base = "none"
sides = 1
imposed = "voltage"
channels = ["motor_speed", "motor_current"]
[motor]
resistance = {resistance}
torque_constant = {constant}
friction_coulomb = {friction}
[gearbox]
ratio = 1
efficiency_load = 1
[brake]
load = "shaft"
inertia = 1e-4
loss_coulomb = 0.0
"""


def motor_table(resistance, constant, friction, voltages):
    """A motor without load, by hand: k I = friction, U = R I + k ω."""
    volts = np.asarray(voltages, float)
    current = np.sign(volts) * friction / constant
    return {
        "supply_voltage_V": volts, "motor_current_A": current,
        "motor_speed_rpm": (volts - resistance * current) / constant * 30 / np.pi,
    }  # fmt: skip


@pytest.mark.parametrize("numbers, voltages", [
    ((4.1, 0.83, 0.05), [150, 220, 310, -310]), ((0.14, 0.0021, 2e-4), [2, 6, 11.6]),
])  # fmt: skip
def test_motors_far_from_the_packaged_one_are_read_without_a_doubt(tmp_path, numbers, voltages):
    rig = read_rig(tmp_path, MOTOR.format(resistance=numbers[0], constant=numbers[1], friction=numbers[2]))
    runs = records.read_runs(motor_table(*numbers, voltages), rig)
    assert len(runs) == len(voltages) and not check_ranges(runs, rig)


@pytest.mark.parametrize("rows", [1, 2, 20])
def test_a_supply_in_millivolts_and_a_speed_in_rad_per_s_are_doubted(tmp_path, rows):
    rig = read_rig(tmp_path, MOTOR.format(resistance=0.4, constant=0.05, friction=0.01))
    table = motor_table(0.4, 0.05, 0.01, np.linspace(6, 9, rows))
    with refused(
        r"motor_speed_rpm: about 1000 times too small .* check the unit, rpm, supply_voltage_V and the robot"
    ):
        check_ranges(records.read_runs({**table, "supply_voltage_V": 1000 * table["supply_voltage_V"]}, rig), rig)
    with refused(r"motor_speed_rpm: .* are they in rad/s"):
        check_ranges(records.read_runs({**table, "motor_speed_rpm": RPM * table["motor_speed_rpm"]}, rig), rig)


def test_an_offset_of_an_ammeter_is_no_lost_sign(tmp_path):
    rig = read_rig(tmp_path, MOTOR.format(resistance=0.4, constant=0.05, friction=0.01))
    table = motor_table(0.4, 0.05, 0.01, [*range(3, 25, 3), *range(-3, -25, -3)])
    drag = table["motor_current_A"] + 4e-5 * table["motor_speed_rpm"]  # churning
    assert len(records.read_runs({**table, "motor_current_A": drag + 0.4}, rig)) == 16
    with refused("expected readings with their signs"):
        records.read_runs({**table, "motor_current_A": np.abs(drag)}, rig)


@pytest.mark.slow
def test_a_calibration_of_a_free_instrument_leaves_what_it_found(tmp_path):
    text = """
base = "none"
imposed = "motor_speed"
channels = ["total_current"]
[motor]
torque_constant = "0.05 ± 3 %"
friction_coulomb = "0.004 ± 20 %"
[gearbox]
ratio = 16
efficiency_load = 0.8
[brake]
load = "shaft"
inertia = 0.001
loss_coulomb = "0.1 ± 50 %"
loss_viscous = "0.002 ± 50 %"
[instruments.total_current]
signed = "free"
quantum = "free"
"""
    robot = read_rig(tmp_path, text)
    assert robot.rig.instruments == (Instrument("total_current", None, None),)
    robot_file.write_robot(robot, tmp_path / "again.toml", note="of a test")
    assert robot_file.read_robot(tmp_path / "again.toml").rig.instruments == robot.rig.instruments
    speeds = np.array([-4000, -3100, -2700, -1900, -1300, -1000, 1000, 1600, 2300, 2900, 3700, 4000.0])
    robot_there = params.replace(robot, {"brake.loss_coulomb": 0.15})
    truth = steady_batch(robot_there, Conditions(motor_speed=speeds * quantities.RPM)).reading["total_current"]
    assert truth[0] < 0  # without a table it is shown with its sign
    read = np.round(np.abs(truth) / 0.004) * 0.004
    path = tmp_path / "t.csv"
    rows = "".join(f"{n:g},{i:.3f},0.002\n" for n, i in zip(speeds, read, strict=True))
    found = calibrate(
        records.read_runs(
            text_file(path, "motor_speed_rpm,total_current_A,total_current_sd_A\n" + rows), robot=robot
        ),
        robot,
        starts=2,
        profiles=False,
        blocks=False,
    )
    (instrument,) = found.robot.rig.instruments
    assert instrument.signed is False and instrument.quantum == pytest.approx(0.004, rel=1e-6)
    loss = found.parameters["brake.loss_coulomb"]
    assert abs(loss.value - 0.15) < 3 * loss.sd
