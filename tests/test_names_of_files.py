"""One name is one quantity in every file that a command writes: tables of names, and the files of every command."""

import contextlib
import inspect
import itertools
import re
import tomllib

import numpy as np
import pytest
import test_settle
from numpy.testing import assert_allclose
from test_resonance_command import SMALL, runs_of

from calibration.data import columns
from mmrjax import derived
from mmrjax.climbing.climb_derivatives import OUTPUTS
from mmrjax.climbing.climb_simulation import LOSSES, SOURCES
from mmrjax.derived import requirements
from mmrjax.fidelities import outputs
from mmrjax.missions import mission_batch
from mmrjax.model import channels, quantities
from mmrjax.undercarriage.ripple_peaks import SIGNALS
from sweeps import capabilities, config
from sweeps.commands import sweep
from tests.commands import columns_of, command, read_json

#: Ends of names, and the unit of each.
UNITS = {
    "mm_s": "mm/s", "m_s": "m/s", "A": "A", "mAh": "mAh", "V": "V", "W": "W", "Wh": "Wh", "J": "J", "N": "N",
    "Nm": "N·m", "kg": "kg", "rpm": "rpm", "deg": "deg", "C": "°C", "Hz": "Hz", "s": "s", "ms": "ms", "min": "min",
    "h": "h", "m": "m", "mm": "mm", "percent": "%", "EUR": "EUR", "mNm": "mN·m", "mV": "mV", "mA": "mA", "g": "g",
    "rad_s": "rad/s",
}  # fmt: skip
#: An end that is a unit, the longest that fits.
END = re.compile(rf"_({'|'.join(sorted(UNITS, key=len, reverse=True))})$")
#: What is put before or after a name that is known: the same quantity of another robot, or its spread.
BEFORE = re.compile(r"^(simulated|before|after|held_out_before|held_out_after|held_out|paper|plain|raised|weighed)_")
AFTER = re.compile(r"_(sd|lower|upper)$")
#: Loads on each grouser and in each span of the belt.
NUMBERED = re.compile(r"(grouser|tension)_\d\d_N")

#: Names that no table has, and what they mean.
MORE = {
    # conditions and options
    "time_s": "time since the run began; of a segment when it begins",
    "ambient_C": "ambient temperature",
    "left_V": "at the left motor", "right_V": "at the right motor", "heading_deg": "from uphill, positive to the left",
    "discharge_mAh": "charge already taken from the battery",
    "load_torque_Nm": "of a brake on the output of each drive", "load_torques_Nm": "axis of load_torque_Nm",
    "levers_front_deg": "0 along the wheelbase outward, positive up", "levers_rear_deg": "the same of the rear ones",
    # posture and what geometry allows
    "contact_mm": "length of the contact", "load_front_percent": "of the load at the front",
    "centre_height_mm": "centre of mass above the ground", "margin_mm": "from gravity's line to the contact's end",
    "tips_back_deg": "slope on which it tips, uphill", "tips_forward_deg": "downhill", "tips_aside_deg": "across",
    "widest_gap_mm": "bridged by the contact",
    "tip_front_mm": "top of a lever's roller", "tip_rear_mm": "the same of the rear ones",
    "overall_length_mm": "overall", "overall_height_mm": "overall",
    "voltages_V": "axis of supply_voltage_V", "payloads_kg": "axis of payload_kg",
    "slopes_deg": "axis of slope_deg", "motor_speeds_rpm": "axis of motor_speed_rpm",
    "motor_currents_A": "axis of motor_current_A",
    "effort_V": "voltage that feedback gains may use", "period_s": "of a controller",
    "measurement_delay_s": "of a controller's readings",
    "step_s": "integration step", "shortest_s": "shortest stretch of a log that is taken for settled",
    # runs over time
    "time_end_s": "when a run ends", "permissible_time_s": "how long a current may flow from ambient temperature",
    "source_voltage_V": "terminals of battery or supply", "demanded_speed_mm_s": "speed that a profile demands",
    "demanded_motor_speed_rpm": "motor speed that a profile demands",
    "housing_temperature_C": "housing, at that time", "from_s": "begin of a stage", "until_s": "end of a stage",
    "acceleration_time_s": "t' of a start: within 1 % of its last speed",
    "guide_N": "load on the guides", "front_N": "load on the front pulley", "rear_N": "load on the rear pulley",
    "centrifugal_tension_N": "tension of the belt by its own speed",
    # maps of ripple
    "passing_Hz": "frequency at which grousers or teeth pass", "frequency_Hz": "natural frequency of a mode, or line",
    "natural_Hz": "natural frequency without damping", "low_Hz": "least over the belt's position",
    "high_Hz": "most over the belt's position", "low_m_s": "speed from which a peak is high",
    "high_m_s": "speed up to which a peak is high", "speeds_m_s": "range of speed", "quiet_m_s": "ranges of speed",
    "restless_m_s": "ranges of speed", "pitch_m": "of the belt", "travel_m": "from one passing to the next",
    # errors
    "rms_percent": "rms of errors", "max_percent": "largest error", "median_percent": "median sd of readings",
    "estimated_percent": "sd of readings as the fit has them",
    # missions
    "energy_by_where_Wh": "energy that goes to each sink",
    # climbs
    "largest_mm": "largest obstacle that a search got over",
    "z_mm": "middle of the robot above the ground before the obstacle",
    "nose_mm": "radius of rounded noses", "time_step_s": "step of a climb",
    "shaft_deg": "of the pulleys, relative to the body", "finish_mm": "where an obstacle ends", "points_mm": "of its ground",
    **{name: meaning for name, (_, meaning) in OUTPUTS.items()},
    "front_deg": "front levers", "rear_deg": "rear levers", "belt_mm_s": "of the main belt",
    "motors_current_A": "of all motors, from the supply", "front_voltage_V": "at the motor of the front levers",
    "rear_voltage_V": "at that of the rear ones", "front_holds": "1 where its worm alone holds a pair", "rear_holds": "the same",
    "traction_current_A": "of each traction motor", "front_current_A": "of the motor of the front levers",
    "rear_current_A": "of that of the rear ones", "front_torque_Nm": "of the pair", "rear_torque_Nm": "of the pair",
    "reaction_N": "of the ground, both sides", "stored_J": "in motion, height, contacts and windings",
    **{f"{name}_J": "since the run began" for name in (*SOURCES, *LOSSES)},
    "furthest_mm": "largest x", "pitch_most_deg": "nose up", "pitch_least_deg": "nose up",
    "margin_least_mm": "of the run", "traction_current_most_A": "of the run", "front_current_most_A": "of the run",
    "rear_current_most_A": "of the run", "front_voltage_most_V": "of the run", "rear_voltage_most_V": "of the run",
    "energy_levers_J": "from the supply, of their motors", "levers_voltage_V": "highest of the levers' motors",
    "front_torque_most_Nm": "of the run", "rear_torque_most_Nm": "of the run",
    "energy_J": "from the supply",
    # robots that are found
    "radius_m": "of the driving wheel",
}  # fmt: skip
#: Names of several tables on purpose: one quantity of a run, of a mission, or a limit on it.
SHARED = {
    "turning_radius_mm",
    "peak_current_A",
    "speed_m_s",
    "slope_deg",
    "payload_kg",
    "motor_speed_rpm",
    "energy_per_metre_Wh",
}
#: Keys of files below which keys are no names of ours: of parameters, users' settings, packages and hashes.
FOREIGN = {"parameters", "set", "versions", "hashes", "prior", "blocks", "statuses", "tied"}


def registries():
    """Unit and meaning of every name of the tables that writers use. Of each table in which it is."""
    found = {}
    for row in (*outputs.output_table(channels.EVERY), *mission_batch.OUTPUTS, *derived.TABLE):
        found.setdefault(row.column, []).append((row.unit_shown, row.label))
    for c in channels.EVERY:
        found.setdefault(c.sd_column, []).append((c.unit_shown, f"sd of a reading: {c.label}"))
    for q in quantities.TABLE["turn"]:
        found.setdefault(q.column, []).append((q.unit, q.label))
    for name in columns.CONDITIONS:
        found.setdefault(name, []).append((UNITS[END.search(name)[1]], f"condition {name}"))
    for q in requirements.QUANTITIES.values():
        found.setdefault(q.column, []).append((q.unit, f"required: {q.label}"))
    return found


def options():
    """Names of all options of all commands, as `config.resolved.toml` has them."""
    parts = [c for _, c in inspect.getmembers(config, inspect.isclass) if issubclass(c, config.Part)]
    return {name for part in parts for name in part.model_fields}


def known(name, names):
    """Whether a name is in a table, or is one that is, of something else."""
    if name in names or NUMBERED.fullmatch(name):
        return True
    if match := re.fullmatch(r"error_(.+)_percent", name):
        return match[1] in {c.name for c in channels.EVERY}
    if match := re.fullmatch(r"(.+?)_(mean_.+|ripple_percent|frequency_Hz)", name):
        kind = SIGNALS.get(match[1])
        return kind is not None and match[2] in (f"mean_{kind.unit}", "ripple_percent", "frequency_Hz")
    if "_change_" in name:
        return known(name.replace("_change_", "_"), names)
    if AFTER.search(name):
        return known(AFTER.sub("", name), names)
    return bool(BEFORE.match(name)) and known(BEFORE.sub("", name), names)


def keys(content, before=""):
    """Every key of JSON or TOML, and the path of keys to it."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield key, f"{before}.{key}"
            if key not in FOREIGN:
                yield from keys(value, f"{before}.{key}")
    elif isinstance(content, list):
        for value in content:
            yield from keys(value, f"{before}[]")


def walk(folder):
    """Every name in every file of a folder, with one place where it is."""
    found = {}
    for path in sorted(folder.rglob("*"), key=lambda path: (path.suffix == ".csv", path)):
        if path.suffix == ".csv":
            found |= dict.fromkeys(columns_of(path), str(path))
        elif path.suffix == ".json" and path.name not in ("zarr.json", "identity.json"):
            found |= {name: f"{path}{where}" for name, where in keys(read_json(path))}
        elif path.suffix == ".toml" and path.name != "robot.toml":  # names of parameters, in SI units
            found |= {name: f"{path}{where}" for name, where in keys(tomllib.loads(path.read_text()))}
    return found


def unknown(folder):
    """Names that end in a unit and are in no table, with a place of each."""
    names, asked = {*registries(), *MORE}, {*requirements.QUANTITIES} - SHARED
    return {
        name: where
        for name, where in walk(folder).items()
        if END.search(name)
        and not known(name, names - asked if ".csv" in where else names)  # of what is asked for there are no columns
    }


def numbers(path):
    """Columns of numbers of a table. An empty cell is NaN."""
    return {name: x for name, x in columns_of(path).items() if x.dtype.kind in "fi"}


#: Columns with the same numbers where nothing tells them apart, and why.
ALIKE = {
    frozenset(pair)
    for pair in (
        ("supply_voltage_V", "voltage_V"),  # at full duty, of an external supply
        ("source_voltage_V", "voltage_V"), ("source_voltage_V", "supply_voltage_V"),
        ("displacement_m", "distance_m"),  # forward
        ("energy_Wh", "energy_drawn_Wh"),  # nothing is returned
        ("duration_s", "time_end_s"), ("payload_kg", "slope_deg"),
    )
}  # fmt: skip


def twins(path):
    """Columns with one unit and the same numbers in at least two rows that differ: one quantity under two names."""
    found = {n: x for n, x in numbers(path).items() if END.search(n) and not NUMBERED.fullmatch(n)}
    pairs = itertools.combinations(found, 2)
    return [
        (a, b)
        for a, b in pairs
        if END.search(a)[1] == END.search(b)[1] != "Hz"  # of the strongest lines of two signals
        and frozenset((a, b)) not in ALIKE
        and np.unique(found[a][np.isfinite(found[a])]).size > 1
        and np.allclose(found[a], found[b], rtol=1e-6, atol=0.0, equal_nan=True)
    ]


def run(folder, *arguments):
    """Run a command in a folder."""
    with contextlib.chdir(folder):
        assert command(arguments) == 0


def sound(folder):
    """No name without a meaning, no quantity under two names, in all files of a folder."""
    assert unknown(folder) == {}
    assert {str(path): twins(path) for path in folder.rglob("*.csv") if twins(path)} == {}


def same(one, other, *, but=()):
    """Names that two tables of the same rows share. Their numbers are the same."""
    shared = (set(one) & set(other)) - set(but)
    for name in sorted(shared):
        assert_allclose(one[name], other[name], rtol=1e-6, atol=1e-12, err_msg=name)
    return shared


# --- tables of names ------------------------------------------------------------------------------------------------


def test_a_name_has_one_unit_in_all_tables_and_one_meaning():
    for name, said in registries().items():
        assert len({unit for unit, _ in said}) == 1, (name, said)
        meanings = {meaning for _, meaning in said}
        assert len(meanings) == 1 or name in SHARED, (name, said)
    assert set(registries()) & set(MORE) == set()


def test_a_meaning_has_one_name():
    """Words of reports too: no two columns have one label."""
    names = {}
    for name, said in registries().items():
        for _, meaning in said:
            names.setdefault(meaning, set()).add(name)
    assert {meaning: of for meaning, of in names.items() if len(of) > 1} == {}


def test_the_end_of_a_name_is_its_unit():
    """C is a degree, never a coulomb. Energy per metre alone leaves its metre to the words before its unit."""
    for name, said in registries().items():
        end = END.search(name)
        for unit, _ in said:
            if unit == "-":
                assert end is None, name
            elif "_per_metre_" in name:
                assert unit == f"{end[1]}/m", name
            else:
                assert end is not None and unit == UNITS[end[1]], (name, unit)


def test_options_are_called_as_what_they_state():
    of = {name for name in options() if END.search(name)}
    assert {"discharge_mAh", "duration_s", "voltages_V"} <= of
    assert {name for name in of if not known(name, {*registries(), *MORE})} == set()


def test_columns_that_a_rig_may_lack_and_those_of_exports_are_known():
    lists = {
        *capabilities.OF_GROUND,
        *capabilities.OF_TRAVEL,
        *capabilities.RESTS_ON,
        *(column for column, _ in sweep.COLUMNS.values()),
    }
    assert {n for n in lists if END.search(n) and not known(n, {*registries(), *MORE})} == set()
    of_heat = {
        n
        for n in registries()
        if re.match(r"(winding|housing)_", n) and n in (*mission_batch.mission_columns(), "winding_settled_C")
    }
    assert of_heat <= set(capabilities.RESTS_ON)


# --- files ----------------------------------------------------------------------------------------------------------

POINTS = "--voltages", "24", "--payloads", "0,2", "--slopes", "0,5", "--configurations", "6T2A", "--no-report"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where commands leave their folders."""
    return tmp_path_factory.mktemp("names")


@pytest.fixture(scope="module")
def made(folder):
    """A command's folder, made once."""
    done = {}

    def once(name, *arguments):
        if name not in done:
            run(folder, *arguments, "--out", name)
            done[name] = folder / name
        return done[name]

    return once


@pytest.fixture(scope="module")
def swept(made):
    return made("sweep", "sweep", *POINTS)


@pytest.mark.slow
def test_files_of_a_sweep_and_of_its_runs_simulated_hold_the_same_numbers(made, swept):
    sound(swept)
    simulated = made("simulate", "simulate", "--runs", swept / "runs.csv", "--no-report")
    sound(simulated)
    one, other = (numbers(f / "runs.csv") for f in (swept, simulated))
    assert len(same(one, other)) > 15


DRIVE = "simulate", "--model", "drive", "--duration", "2", "--voltage", "24", "--slope", "2", "--no-report"
WALK = "time_s,supply_voltage_V\n0,24\n2,24\n"


@pytest.mark.slow
def test_files_over_time_end_on_the_numbers_of_their_runs(made, folder):
    (folder / "walk.csv").write_text(WALK)
    mission = made("mission", "simulate", "--profile", "walk.csv", "--slope", "2", "--no-report")
    for made_folder in (made("drive", *DRIVE), mission):
        sound(made_folder)
        end, course = (numbers(made_folder / n) for n in ("runs.csv", "history.csv"))
        last = {n: x[-1:] for n, x in course.items()}
        assert same(last, end, but=("time_s",)) >= {"displacement_m"}
        result = read_json(made_folder / "result.json")
        stated = {n: np.array([x]) for n, x in result.items() if isinstance(x, float)}
        assert same(stated, end)
    rows = numbers(mission / "history.csv")
    assert rows["winding_temperature_C"][-1] == pytest.approx(numbers(mission / "runs.csv")["winding_end_C"][0])


#: The rest of the commands, on little.
OTHERS = {
    "compare": ("compare", "measured", "--no-report"),
    "calibrate": ("calibrate", "measured", "--starts", "2", "--no-profiles", "--no-report"),
    "charge": ("sweep", "charge.toml", "--export", "csv", "--no-report"),
    "check": ("check", "few.toml", "--no-report", "--no-changes"),
    "size": ("size", "few.toml", "--motors", "RE 30 24 V", "--no-report"),
    "sensitivity": (
        "sensitivity", "--method", "local", "--slopes", "0", "--voltages", "24", "--payloads", "0", "--configurations",
        "6T2A", "--outputs", "total_current,speed,start,steepest_slope", "--no-report",
    ),
    "reproduce": ("reproduce",),
    "loop": ("loop", "measured", "--replicates", "250", "--no-report"),
    "track": ("simulate", "--model", "track", "--duration", "0.5", "--voltage", "24", "--no-report"),
    "resonance": (*SMALL, "--no-report"),
    "climb": ("climb", "--gap", "60", "--voltage", "24", "--duration", "2", "--time-step", "4e-4", "--no-report"),
    "battery": ("simulate", "--profile", "patrol", "--battery", "--no-report"),
    "turn": ("simulate", "--left", "24", "--right", "12", "--model", "drive", "--duration", "1", "--no-report"),
    "settle": ("settle", "log.csv", "--robot", "rig.toml"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_files_of_every_other_command_have_known_names(made, folder, name):
    (folder / "charge.toml").write_text(
        '[conditions]\nbattery = 1\nconfiguration = "6T2A"\n[axes]\ndischarge = [0, 1800]\n'
    )
    (folder / "few.toml").write_text("speed_m_s = 0.3\nmass_kg = 30\n[envelope]\nslope_deg = [0, 5]\n")
    test_settle.bench(folder, test_settle.stairs())
    # In closed form: its files are the same.
    with runs_of("waves") if name == "resonance" else contextlib.nullcontext():
        sound(made(name, *OTHERS[name]))
