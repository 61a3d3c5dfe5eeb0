"""Report of `simulate` with a profile: the mission over time, uses of its energy, segments and limits."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from calibration.data import Columns, Json, profiles
from calibration.data.profiles import CONTROLLED, YAW_RATE, ProfileTable
from calibration.data.robot_file import RobotFile
from mmrjax.errors import count_noun
from mmrjax.missions import mission_batch
from mmrjax.missions.profile import PAIRS
from mmrjax.model import channels
from mmrjax.model.energy import SINKS
from mmrjax.model.quantities import RPM, TABLE, WARMING
from mmrjax.model.robot import Robot
from mmrjax.model.signals import FLAGS
from sweeps import capabilities
from sweeps.pages import words
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Column, Document, Note, Section, Table, remarks
from sweeps.report.runs_report import run_headings


@dataclasses.dataclass(frozen=True)
class Missions:
    """Runs over one profile, as tables.

    Attributes:
        table: one row for each run, `runs.csv`.
        segments: one row for each segment, `segments.csv`.
        course: one row for each stored step, `history.csv`.
        source: name of the profile.
        whole: True if the history of every run reaches its end.
    """

    table: Columns
    segments: Columns
    course: Columns
    source: ProfileTable
    whole: bool

    def to_json(self) -> Json:
        """Content of `result.json`: for one run its numbers by name, for several a list of them."""
        missions = [self._run_as_json(k) for k in range(len(self.table["status"]))]
        profile = {
            "name": self.source.source, "sha256": self.source.digest, "duration_s": self.source.duration,
            "segments": self.source.segment_count, "cycles": self.source.cycles,
            "between_rows": profiles.BETWEEN[self.source.linear],
        }  # fmt: skip
        return {"profile": profile, **(missions[0] if len(missions) == 1 else {"missions": missions})}

    def _run_as_json(self, row: int) -> Json:
        column_of_sink = {name: f"energy_to_{name}_Wh" for name in SINKS}
        columns = [c for c in mission_batch.mission_columns(self.source.turns) if c not in column_of_sink.values()]
        flags = str(self.table["flags"][row])
        return {
            **{c: float(self.table[c][row]) for c in columns},
            "energy_by_where_Wh": {name: float(self.table[column][row]) for name, column in column_of_sink.items()},
            "status": str(self.table["status"][row]),
            "flags_raised": flags.split(";") if flags else [],
        }


#: Quantities of each run, in the order of the table.
_RUNS = (
    "energy_Wh", "energy_per_metre_Wh", "distance_m", "duration_s", "rms_current_A", "peak_current_A",
    "rms_torque_Nm", "winding_peak_C", "housing_end_C", "state_of_charge", "endurance_s", "range_m",
    *(output.column for output in TABLE["mission of sides"]), "status", "flags",
)  # fmt: skip
#: Quantities of each segment.
_OF_SEGMENTS = (
    "energy_Wh", "distance_m", "rms_current_A", "peak_current_A", "winding_peak_C", "status", "flags",
)  # fmt: skip


def missions_document(file: RobotFile, missions: Missions) -> Document:
    """Report of finished missions. The first run is shown in detail."""
    table, source = missions.table, missions.source
    applicable = capabilities.drop_inapplicable_columns(file.robot, table)
    first_run = {key: value[0] for key, value in table.items()}
    names = _names(table)
    has_several_runs = len(names) > 1
    answer = mission_answer({key: value[0] for key, value in applicable.items()}, file.robot.has_ground)
    cycles, per_cycle = (f", {source.cycles} cycles", " each") if source.cycles > 1 else ("", "")
    lead = (
        f"Profile **{source.source}**: {source.duration:g} s{cycles}, {count_noun(source.segment_count, 'segment')}"
        f"{per_cycle}, values {'linear' if source.linear else 'held'} between rows. The robot runs on "
        f"{'its battery' if _on_battery(first_run) else 'the supply'}."
    )
    detail_sentence = f"Details are of the first of {len(names)} runs: **{names[0]}**." * has_several_runs
    runs = run_tables.quantity_table(
        "runs", applicable, _RUNS, first=[(Column("run"), names)], file="runs.csv", sideways=True
    )
    endings = [] if not has_several_runs and first_run["status"] == "converged" else [
        run_tables.endings_table(Counter(map(str, table["status"])))
    ]  # fmt: skip
    return Document(
        f"Mission {source.source}" + ("" if has_several_runs else f" of {names[0]}"),
        answer,
        (
            run_tables.note_on_robot(file, more=detail_sentence),
            Note(lead, terminal=True),
            *remarks(_exceeded_limits(missions), "flags"),
            runs,
            *endings,
            *remarks(_charge_left(table)),
        ),
        page_sections=lambda: _sections(file.robot, missions, first_run),
    )


def _on_battery(run: Json) -> bool:
    return bool(np.isfinite(run["state_of_charge"]))


def _sections(robot: Robot, missions: Missions, first: Json) -> Iterable[Section]:
    """Sections on the first run: over time, from above, energy and segments."""
    source = missions.source
    name = missions.segments["run_id"][0]
    inapplicable = capabilities.inapplicable_columns(robot)
    run_rows = missions.course["run_id"] == name
    rows = {key: value[run_rows] for key, value in missions.course.items() if key not in inapplicable}
    cycle = float(source.time[-1] - source.time[0]) if source.cycles > 1 else None
    course = catalogue.figure(
        "mission.course", rows, cycle, float(robot.motor.temperature_limit), source.linear, float(robot.sides),
        words=(len(rows["time_s"]),), more="" if missions.whole else catalogue.text("mission.cut"),
    )  # fmt: skip
    limits = run_tables.limits_table(mission_limits(robot, first), "this mission")
    yield Section("Over time", (course, limits, catalogue.note("run.warming")), "course-section")
    if source.turns:
        x_y_yaw = rows["x_mm"] / 1e3, rows["y_mm"] / 1e3, np.radians(rows["yaw_deg"])
        currents, winding_peaks = ([first[form.format(side)] for side in channels.SIDES]
                           for form in ("rms_current_{}_A", "winding_peak_{}_C"))  # fmt: skip
        heat_text = catalogue.text("mission.heat", *winding_peaks) if robot.knows(WARMING) else ""
        path = catalogue.figure("mission.path", robot, first, *x_y_yaw, words=(first["turned_deg"],))
        sides = catalogue.figure("mission.sides", rows, words=currents, more=heat_text)
        yield Section("From above", (path, sides), "path-section")
    yield Section("Where the energy goes", _energy(robot, first), "energy-section")
    segments = _segments(missions, name, inapplicable), catalogue.note("mission.settles")
    yield Section("Segments", segments, "segments-section")


def _energy(robot: Robot, run: Json) -> tuple[Table, Note]:
    """Uses of the energy that a mission draws."""
    energy_drawn, energy_returned = float(run["energy_drawn_Wh"]), float(run["energy_returned_Wh"])
    returned_sentence = "No energy returned to the source."
    if energy_returned > 1e-6 * energy_drawn:
        returned_sentence = f"{energy_returned:.3g} Wh returned to the source."
    elif _on_battery(run):
        returned_sentence += " Driven motors first supply other consumers."
    uses = {label: run[f"energy_to_{name}_Wh"] for name, label in words.sink_labels(robot.has_ground).items()}
    uses |= {"kinetic energy at the end": run["energy_stored_Wh"], "returned to the source": energy_returned}
    energy_drawn = max(energy_drawn, 1e-12)
    shares = [
        (label, energy, 100 * energy / energy_drawn)
        for label, energy in uses.items()
        if abs(energy) > 1e-5 * energy_drawn
    ]
    source = "battery's charge" if _on_battery(run) else "supply"
    note = catalogue.note("mission.energy", source, returned_sentence, abs(run["unaccounted_share"]))
    return catalogue.table("mission.energy", shares), note


def _names(runs: Columns) -> list[str]:
    """Headings of runs, without the conditions that the profile states."""
    parts = (label.split(", ") for label in run_headings(runs))
    return [", ".join([head, *(p for p in rest if not p.startswith("nan"))]) for head, *rest in parts]


def mission_answer(run: Json, on_ground: bool = True) -> str:
    """One sentence: energy of the mission, its largest shares, and how long the battery lasts."""
    energy = float(run["energy_drawn_Wh"])
    text = f"The mission takes {float(run['energy_Wh']):.3g} Wh"
    if np.isfinite(run.get("distance_m", np.nan)) and run["distance_m"] > 0:
        text += f" over {run['distance_m']:.0f} m"
    if energy > 0:
        labels = words.sink_labels(on_ground)
        shares = {labels[name]: float(run[f"energy_to_{name}_Wh"]) / energy for name in SINKS}
        largest = sorted(shares, key=lambda label: -shares[label])[:2]
        parts = [f"{label} {100 * shares[label]:.0f} %" for label in largest if shares[label] > 0]
        text += f" ({', '.join(parts)})"
    if np.isfinite(run["endurance_s"]):
        text += f". A full battery lasts {run['endurance_s'] / 60:.0f} min"
    status = str(run["status"])
    return text + ("." if status == "converged" else f". It ends early: {words.status_meaning(status)}.")


def mission_limits(robot: Robot, run: Json) -> list[Json]:
    """Use of each limit by a mission."""
    motor = robot.motor
    gearbox = robot.gearbox
    speed = run["peak_motor_speed_rpm"]
    nan_if_unknown = 0.0 if robot.knows(WARMING) else np.nan
    limits = [
        ("hottest winding", run["winding_peak_C"] + nan_if_unknown, motor.temperature_limit, "{:.0f} °C"),
        ("motor speed", speed, float(motor.speed_limit) / RPM, "{:.0f} rpm"),
        ("gearbox input speed", speed, float(gearbox.speed_limit) / RPM, "{:.0f} rpm"),
        ("rms current, one motor", run["rms_current_A"] / float(robot.sides) + nan_if_unknown,
         robot.current_continuous, "{:.2f} A"),
        ("rms torque, one gearbox", run["rms_torque_Nm"], gearbox.torque_limit or np.nan, "{:.2f} N·m"),
    ]  # fmt: skip
    limit_use = run_tables.use_of_limits(limits, float(motor.temperature_ambient))
    lowest_voltage = float(run["cell_low_V"])
    cutoff = float(robot.battery.voltage_cutoff)
    if np.isfinite(lowest_voltage):
        cell_limit = {
            "words": "lowest cell (not below)",
            "value": f"{lowest_voltage:.2f} V",
            "limit": f"{cutoff:.2f} V",
        }
        limit_use.append(cell_limit | {"percent": 100 * cutoff / lowest_voltage})
    return limit_use


def _exceeded_limits(missions: Missions) -> Iterable[str]:
    """Limits that were exceeded, in words, with the numbers of runs and segments."""
    segment_flags = [str(flags).split(";") for flags in missions.segments["flags"]]
    run_flags = [str(flags).split(";") for flags in missions.table["flags"]]
    for flag in FLAGS:
        count = sum(flag in flags for flags in run_flags)
        if count:
            of_runs = f"{count} of {len(run_flags)} runs, " * (len(run_flags) > 1)
            segments = sum(flag in flags for flags in segment_flags)
            yield f"`{flag}`: {words.FLAGS[flag]} ({of_runs}{segments} of {len(segment_flags)} segments)"


def _charge_left(table: Columns) -> Iterable[str]:
    """Sentence on the charge at cut-off, if a mission was cut off."""
    charge_left = 100 * table["state_of_charge"][table["status"] == "cut_off"]
    if len(charge_left):
        span = " to ".join(f"{x:.1f}" for x in (charge_left.min(), charge_left.max())[: len(charge_left)])
        yield f"cut off: ended with {span} % of the charge left"


def _segments(missions: Missions, name: str, inapplicable: set[str]) -> Table:
    """Table of the segments of a run, in the order of time."""
    source = missions.source
    run_rows = missions.segments["run_id"] == name
    rows = {key: value[run_rows] for key, value in missions.segments.items() if key not in inapplicable}
    segment_indices = rows["segment"] - 1
    first = [
        (Column("segment", form="{:d}"), rows["segment"]),
        (Column("from", "s", "{:g}"), rows["time_s"]),
        (Column("mode"), [source.modes[k].replace("_", " ") for k in segment_indices]),
        (Column("demanded"), [_demand_in_words(source, k) for k in segment_indices]),
    ]
    return run_tables.quantity_table("segments", rows, _OF_SEGMENTS, first, file="segments.csv", wide=True)


def _demand_in_words(source: ProfileTable, k: int) -> str:
    """Demand of the profile in a segment, in words."""

    def span(values: np.ndarray, unit: str, factor: float = 1.0) -> str:
        begin, end = values[k] / factor, values[k + 1 if source.linear else k] / factor
        unit = unit if unit == "°" else f"\u00a0{unit}"
        return f"{begin:g}{unit}" if abs(begin - end) < 1e-9 else f"{begin:g} to {end:g}{unit}"

    def spans(units: Mapping[str, str], factor: float = 1.0) -> list[str]:
        return [span(source.values[name], unit, factor) for name, unit in units.items() if name in source.values]

    mode = source.modes[k]
    phrases = list[str]()
    if mode in CONTROLLED:
        channel = channels.find_channel(mode)
        phrases.append(span(source.demand, channel.unit, channel.factor))
        phrases += spans({YAW_RATE: channels.find_channel(YAW_RATE).unit}) if mode == "speed" else []
    elif mode == "voltage":
        duties = spans(dict.fromkeys(("duty", *PAIRS[0]), "% duty"), 0.01)
        phrases.append(" and ".join([*duties, *spans(dict.fromkeys(PAIRS[1], "V"))]) or "100 % duty")
    phrases += spans({"voltage": "V", "slope_deg": "°", "payload": "kg", "load_torque": "N·m", "current_other": "A"})
    return ", ".join([*phrases, *([source.surface[k]] if source.surface else [])])
