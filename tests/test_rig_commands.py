"""The front door of rigs: every command from a rig's file alone, and not a word of another robot in what it leaves."""

import re

import numpy as np
import pytest

from calibration.data import robot_file
from calibration.data.columns import Layout
from calibration.data.runs import Runs
from calibration.inference.simulation_errors import relative_error, sized_error
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import channels, params, quantities
from sweeps import capabilities
from sweeps.commands import rig_new
from sweeps.report import fit_tables
from tests.commands import csv_text, ends, read_json, text_file
from tests.commands import rows as rows_of

#: Words of the paper's robot, its parts, its tables and its surfaces; none is a rig's.
FORBIDDEN = (
    "paper", "nominal", "Table 1", "Table 2", "Table 3", "Table 4", "Table 5", "Table 6", "Table 7", "Table 8",
    "Tables A", "eq. (", "6T2A", "4W2T", "48:1", "RE30", "GP32", "310007", "SM-1", "linoleum", "lacquered", "±5 %",
    "foreign robot",
)  # fmt: skip
TEXTS = (".html", ".toml", ".json", ".csv", ".svg", ".txt")


def words_of_others(*texts):
    """Forbidden words in texts, each with what stands around it. Pictures within a page lie beside it too."""
    found = []
    for text in texts:
        bare = re.sub(r"data:image/[^\"]*", "", text)
        bare = re.sub(r'"(mmrjax|calibration|sweeps)/[^"]*"', "", bare)  # a file of the code, in a store's digests
        bare = re.sub(r"<style>.*?</style>", "", bare, flags=re.DOTALL)
        bare = re.sub(r"\dT\d\d:\d\d:\d\d", "", bare)  # a time of day, which may read as a ratio of gears
        for word in FORBIDDEN:
            at = bare.find(word)
            if at >= 0:
                found.append(f"{word}: {bare[max(0, at - 60) : at + 60]!r}")
    return found


def left_in(folder):
    """The texts of a run folder."""
    return [path.read_text(encoding="utf-8") for path in sorted(folder.rglob("*")) if path.suffix in TEXTS]


def of_kind(tmp_path, kind, speed=False):
    """A rig's file as `rig new` writes it, with the motors' speed imposed where asked."""
    text = rig_new.rig_template(kind)
    if speed:
        text = text.replace('imposed = "voltage"', 'imposed = "motor_speed"').replace(' "motor_speed"]', "]", 1)
        text = text.replace('"motor_speed", ', "").replace('"total_current",]', '"total_current"]')
    path = tmp_path / f"{kind}{'_speed' if speed else ''}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def table_of(rig, changed, levels, slopes=None):
    """A table of settled runs of a rig with changed parameters, beside its file. Every reading with its sd."""
    robot, drawn = robot_file.read_robot(rig), np.random.default_rng(5)
    layout, columns = Layout.of(robot), {}
    columns[layout.imposed_column] = np.asarray(levels, float)
    if slopes is not None:
        columns |= {"slope_deg": np.asarray(slopes, float), "payload_kg": np.zeros(len(levels))}
    robot = params.replace(robot, {name: np.asarray(value, float) for name, value in changed.items()})
    of_load = {"configuration": np.full(len(levels), robot.configurations.names[0])}
    reading = steady_batch(robot, Runs("a table", of_load | columns, layout=layout).conditions(robot)).reading
    for c in robot.channels:
        shown = np.asarray(reading[c.name]) / c.factor
        size = np.full(len(levels), 0.01 * np.abs(shown).mean())
        columns |= {c.column: shown + size * drawn.normal(size=len(levels)), c.sd_column: size}
    return text_file(rig.with_suffix(".csv"), csv_text(columns))


BOTH_WAYS = [800, 1600, 2400, 3200, 4000, 4800, -800, -1600, -2400, -3200, -4000, -4800]


@pytest.fixture
def bench(tmp_path):
    """A motor on a bench with numbers of its own, its speed imposed, its current alone read, both ways, and its table."""
    rig = of_kind(tmp_path, "bench", speed=True)
    stated = re.sub(r'"([\d.e-]+) ±', lambda number: f'"{1.04 * float(number[1]):.3g} ±', rig.read_text("utf-8"))
    rig.write_text(stated, "utf-8")
    return rig, table_of(rig, {"bench.loss_coulomb": 0.07}, BOTH_WAYS)


@pytest.fixture
def rover(tmp_path):
    """A wheeled robot whose motors' speed is imposed, on slopes, and its table."""
    rig = of_kind(tmp_path, "wheeled", speed=True)
    speeds, slopes = np.repeat([1000.0, 2000.0, 3000.0], 3), np.tile([0.0, 5.0, 10.0], 3)
    return rig, table_of(rig, {"rover.ground.rolling_resistance": 0.03}, speeds, slopes)


@pytest.fixture
def ran(mmrjax, tmp_path):
    """What a command prints, and the folder that it leaves. No word of another robot is in either."""

    def command(*words):
        _, out, err = ends(mmrjax(*words, "--out", "run"), code=0)
        assert words_of_others(out, err, *left_in(tmp_path / "run")) == []
        return out, tmp_path / "run"

    return command


# --- simulate -----------------------------------------------------------------------------------------------------

SIMULATED = {
    "bench": ("bench", False, ["--voltage", "12"], {"total_current_A", "motor_speed_rpm"}),
    "bench, speed": ("bench", True, ["--motor-speed", "-2000"], {"total_current_A"}),
    "linear": ("linear", False, ["--voltage", "12"], {"total_current_A", "speed_mm_s"}),
    "wheeled": ("wheeled", False, ["--voltage", "12", "--slope", "5"], {"total_current_A", "speed_mm_s"}),
    "tracked, speed": ("tracked", True, ["--motor-speed", "2000", "--payload", "1"], {"total_current_A"}),
}


@pytest.mark.quick("bench, speed")
@pytest.mark.parametrize("case", SIMULATED)
def test_simulate_takes_what_a_rig_imposes_and_shows_its_channels(ran, tmp_path, case):
    kind, speed, options, columns = SIMULATED[case]
    _, folder = ran("simulate --robot", of_kind(tmp_path, kind, speed), *options)
    (row,) = rows_of(folder / "runs.csv")
    assert columns <= set(row) and row["status"] in ("converged", "reverses")
    on_ground = {"slip", "adhesion_used", "slope_deg", "total_mass_kg", "power_ground_W"}
    assert on_ground <= set(row) if kind in ("wheeled", "tracked") else on_ground.isdisjoint(row)
    assert "winding_settled_C" not in row  # nobody has stated how heat leaves the windings


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bench", "pendulum", "wheeled"])
def test_simulate_over_time_draws_the_channels_of_the_rig(ran, tmp_path, kind):
    rig = of_kind(tmp_path, kind)
    _, folder = ran("simulate --voltage 3 --model drive --duration 0.5 --robot", rig)  # an arm still moves
    history = rows_of(folder / "history.csv")
    shafts = {"motor_speed_rpm", "output_angle_deg"}
    assert (shafts <= set(history[0])) == (kind != "wheeled") and len(history) > 100
    assert (folder / "figures" / ("history.svg" if kind == "wheeled" else "courses.svg")).is_file()


@pytest.mark.slow
def test_a_profile_turns_a_bench(ran, tmp_path):
    (tmp_path / "turn.csv").write_text("time_s,motor_speed_rpm,supply_voltage_V\n0,0,24\n1,2000,24\n2,2000,24\n")
    out, folder = ran("simulate --profile turn.csv --robot", of_kind(tmp_path, "bench"))
    (first, *_) = rows_of(folder / "history.csv")
    assert "demanded_motor_speed_rpm" in first and not {"slope_deg", "winding_temperature_C"} & set(first)
    # Energy of the windings is known, their temperature is not; a shaft has neither tracks nor a distance.
    assert not re.search(r"\d m\b|distance|°C|track", out) and "friction of the load" in out


# --- what is imposed where nothing is stated -----------------------------------------------------------------------


def test_levels_are_thirds_of_the_limit_to_two_digits(tmp_path):
    robot = robot_file.change_robot(
        robot_file.read_robot(of_kind(tmp_path, "bench", speed=True)), {"motor.speed_limit": 500.0}, "x"
    )
    notes = []
    top = 500.0 / quantities.RPM
    found = capabilities.imposed_levels(robot, "--motor-speeds", notes)
    assert all(
        0.9 * share * top < level <= share * top for level, share in zip(found, capabilities.SHARES, strict=True)
    )
    assert notes == [
        "--motor-speeds: not given. Thirds of the speed_limit in the robot's file are used: 1500,3100,4700"
    ]


# --- sweep --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_sweep_of_a_vehicle_with_imposed_speed_varies_its_slopes(ran, tmp_path):
    rig = of_kind(tmp_path, "wheeled", speed=True)
    _, folder = ran("sweep --motor-speeds 1000,-1000 --slopes 0,5 --robot", rig)
    assert [row["payload_kg"] for row in rows_of(folder / "runs.csv")] == ["0"] * 4


# --- measured tables ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_compare_and_calibrate_take_one_channel_both_ways(mmrjax, tmp_path, bench):
    rig, data = bench
    _, out, _ = ends(mmrjax("compare", data, "--robot", rig, "--out", "compared"), code=0)
    errors = read_json(tmp_path / "compared/result.json")["errors"]["all"]["total_current"]
    assert errors["unit"] == "A" and 0.01 < errors["rms"] < 0.1 and " A " in out
    _, said, err = ends(
        mmrjax("calibrate", data, "--robot", rig, "--starts", "2", "--no-profiles", "--out", "fitted"),
        code=0,
    )
    assert re.search(r"rms error before → after on .*: total current 16.0 → 0.8 %", said)
    assert "speed" not in said.splitlines()[0]
    fitted = robot_file.read_robot(tmp_path / "fitted/robot.toml")
    assert float(fitted.configurations["bench"].loss_coulomb) == pytest.approx(0.07, rel=0.05)
    priors = read_json(tmp_path / "fitted/result.json")["parameters"]
    assert {p["prior"]["source"] for p in priors.values()} <= {params.STATED, params.DEFAULT}
    for folder in ("compared", "fitted"):
        assert words_of_others(*left_in(tmp_path / folder)) == [], folder
    assert words_of_others(out, said, err) == []


# --- sensitivity --------------------------------------------------------------------------------------------------


# --- the pieces ---------------------------------------------------------------------------------------------------


def test_errors_of_a_channels_size_are_finite_where_readings_cross_zero():
    simulated, measured = np.array([[-1.0], [0.0], [1.0]]), np.array([[-1.1], [0.1], [1.0]])
    with np.errstate(divide="ignore", invalid="ignore"):
        assert not np.isfinite(relative_error(simulated, measured)).all()
    assert sized_error(simulated, measured) == pytest.approx(
        100 * np.array([[0.1], [-0.1], [0.0]]) / np.sqrt((1.21 + 0.01 + 1.0) / 3)
    )


def test_a_channel_without_readings_has_no_error_and_no_warning():
    """As an angle has none in settled runs of a rig whose logs have it."""
    nothing = np.full(2, np.nan)
    assert np.isnan(sized_error(np.stack([nothing, np.ones(2)], 1), np.ones((2, 2)))).tolist() == [[True, False]] * 2


def test_parameters_of_a_rig_are_those_that_its_file_states(tmp_path):
    wheeled, linear, bench = (
        {p[0] for p in capabilities.rig_parameters(robot_file.parse_robot_file(of_kind(tmp_path, kind)))}
        for kind in ("wheeled", "linear", "bench")
    )
    assert "motor.resistance" in wheeled and "battery.voltage_full" not in wheeled
    assert "carriage.inertia" in linear and "bench.radius" not in bench


def test_forbidden_words_are_seen():
    assert len(words_of_others("<p>the nominal robot of Table 8</p>")) == 2
    assert words_of_others('<img src="data:image/svg+xml;base64,paper">') == []


def test_a_report_shows_a_dash_for_a_channel_without_readings():
    """Of the row of errors by fit, which knows nothing of it."""
    shown = [channels.find_channel(name) for name in ("speed", "output_angle")]
    table = fit_tables.rms_table({"before": {"speed": 1.0}}, shown)
    (row,) = table.rows
    assert [column.text(cell) for column, cell in zip(table.columns, row, strict=True)] == ["before", "1", "–"]


MOTOR = """
schema = "mmrjax.robot/2"
base = "none"
sides = 1
imposed = "voltage"
channels = ["motor_current", "motor_speed"]
[motor]
resistance = "2.3 ± 5 %"
torque_constant = "0.021 ± 3 %"
friction_coulomb = "0.002 ± 20 %"
friction_viscous = "1e-6 ± 50 %"
inertia = 6e-6
[gearbox]
ratio = 1.0
efficiency_load = "1 ± 0"
[bench]
load = "shaft"
inertia = 1e-8
loss_coulomb = "0 ± 0"
loss_viscous = "0 ± 0"
[columns]
supply_voltage_V = "U [V]"
motor_current_A = {column = "Strom [mA]", factor = 1e-3}
motor_speed_rpm = "Drehzahl [1/min]"
"""


def precise_table(path):
    """Settled runs of a motor with a brake of air, 6 nN·m·s², read to a thousandth, as a logger far from here writes
    them. From the laws in NumPy."""
    volts = np.array([5, 6.5, 8, 9.5, 11, 12.5, 14, 15.5, 17, 18.5, 20, 22, 24, -7, -11, -15, -19, -23])
    r, k, dry, viscous, air = 2.3, 0.021, 0.0022, 1.1e-6, 6e-9
    # k (u - k w) / r = dry + viscous w + air w², of magnitudes
    size = np.abs(volts)
    b, c = viscous + k * k / r, dry - k * size / r
    speed = np.sign(volts) * (-b + np.sqrt(b * b - 4 * air * c)) / (2 * air)
    random = np.random.default_rng(5)
    current = 1e3 * ((volts - k * speed) / r + 5e-4 * random.normal(size=len(volts)))
    rpm = speed * 30 / np.pi + 0.6 * random.normal(size=len(volts))
    lines = ["U [V];Strom [mA];Drehzahl [1/min];motor_current_sd_mA;motor_speed_sd_rpm"]
    lines += [f"{u:g};{i:.3f};{n:.2f};0.5;0.6".replace(".", ",") for u, i, n in zip(volts, current, rpm, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="cp1252")
    return path


@pytest.mark.nightly
def test_what_explains_all_of_precise_readings_is_named(mmrjax, tmp_path):
    """170 σ of it: without the effect the fit is so far off that by its slopes another effect would explain more."""
    (tmp_path / "motor.toml").write_text(MOTOR, encoding="utf-8")
    data = precise_table(tmp_path / "runs.csv")
    _, told, _ = ends(mmrjax("loop", data, "--robot", "motor.toml", "--replicates", "250", "--out", "found"), code=0)
    found = read_json(tmp_path / "found/result.json")
    assert found["verdict"] in ("named", "class"), told
    (effect,) = found["effects"]
    amplitude = effect["parameters"]["amplitude"]
    assert effect["standing"] == "established" and effect["name"] in ("churning", "windage")
    assert abs(amplitude["value"] - 6e-9) < 3 * amplitude["sd"] < 1e-9
