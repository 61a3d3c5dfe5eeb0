"""Configurations of commands: options and TOML files, checked and merged into one frozen record."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import PydanticCustomError

from calibration.data import Json, Names, presets_file
from calibration.data.columns import ROWS
from calibration.data.input_errors import SEEDS, BadConfiguration, allowed_words
from calibration.data.input_files import toml_content, toml_text
from mmrjax import fidelities
from mmrjax.model import channels
from mmrjax.model.paper_tables import BENCH, PAYLOADS_KG, SLOPES_DEG, SURFACES, VOLTAGES_V
from mmrjax.model.quantities import CONDITIONS
from sweeps.options import options_of_fields, schema_facts


def number_between(low: float, high: float) -> Any:
    """Bounds of a finite number."""
    return Field(ge=low, le=high, allow_inf_nan=False)


def positive_number(high: float) -> Any:
    """Bounds of a finite number above 0."""
    return Field(gt=0, le=high, allow_inf_nan=False)


T = TypeVar("T")
NonEmpty = Annotated[tuple[T, ...], Field(min_length=1)]
Slope = Annotated[float, number_between(*CONDITIONS["slope_deg"].range)]
Payload = Annotated[float, number_between(*CONDITIONS["payload"].range)]
LoadTorque = Annotated[float, number_between(*CONDITIONS["load_torque"].range)]
Voltage = Annotated[float, number_between(*CONDITIONS["voltage"].range)]
Duty = Annotated[float, number_between(*CONDITIONS["duty_left"].range)]
Heading = Annotated[float, number_between(*CONDITIONS["heading_deg"].range)]
MotorCurrent = Annotated[float, number_between(*channels.find_channel("motor_current").range)]
MotorSpeed = Annotated[float, number_between(*channels.find_channel("motor_speed").range)]
#: The fidelity that follows profiles.
PROFILE_MODEL = "drive"
#: Longest default duration of `simulate` [s], short enough for a figure to show the start.
SHORT_RUN = 5.0
PaperSurface = Literal[tuple(SURFACES)]  # type: ignore[valid-type]  # names of a table
Seed = Annotated[int, Field(ge=0, le=SEEDS)]


def option_field(default: Any, description: str, **extra: Any) -> Any:
    """Field with its description. `sweeps.options` makes options, their help and the schema from it.

    Args:
        default: value if not stated.
        description: meaning without the unit (the name ends with the unit).
        extra: further properties. `usual`: meaning of the default None, in words. `flag`: option, if it differs from
            the name. `verbatim`: True if texts of a list may contain commas. `metavar`: name of an argument in help.
            `format`: such as path. `minimum`: bound of the command, if it is above that of the field. `executes`:
            True if the value names code to run, which a file may do only with `--trust`. `argument`: True for an
            argument, False for an option.
    """
    return Field(default=default, description=description, json_schema_extra=extra or None)


Rules = tuple[tuple[str, ...], ...]


class Part(BaseModel):
    """A part of a command's configuration. Unknown keys are rejected."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    #: Two fields that cannot be combined, and the end of the message.
    exclusive: ClassVar[Rules] = ()
    #: A field, another one that it needs, and the end of the message.
    needed: ClassVar[Rules] = ()

    def states(self, name: str) -> bool:
        """True if a field is present and has another value than its default."""
        fields = type(self).model_fields
        return name in fields and getattr(self, name) != fields[name].default

    @model_validator(mode="after")
    def _combined(self) -> Self:
        parts = [vars(part) for part in type(self).__mro__]
        for field, other_field, text in (rule for part in parts for rule in part.get("needed", ())):
            if self.states(field) and not self.states(other_field):
                raise combination_error(f"`{field}` {text}")
        for field, other_field, *more in (rule for part in parts for rule in part.get("exclusive", ())):
            if self.states(field) and self.states(other_field):
                raise combination_error(f"`{field}` cannot be combined with `{other_field}`{''.join(more)}")
        return self


def combination_error(message: str) -> PydanticCustomError:
    """Error on the combination of several fields, whose names are between backticks."""
    return PydanticCustomError("idle", message)


class RobotPart(Part):
    """Robot."""

    robot: str = option_field("nominal", "nominal, sm1, sm2, or the TOML file of a robot")
    set: dict[str, bool | float] = option_field(
        {}, "Change a parameter (SI units). Repeatable: 6T2A.ground.friction.static=0.6"
    )
    effects: Names = option_field(
        (), "Python file with effects, which is run. Repeatable", verbatim=True, executes=True
    )


class FolderPart(Part):
    """Run folder of a command. It does not affect results."""

    out: Path | None = option_field(None, "The run folder", usual="runs/COMMAND-TIME")
    force: bool = option_field(False, "Replace an existing run folder")


class VerbosePart(FolderPart):
    """Amount of text that a command prints. It does not affect results."""

    verbose: bool = option_field(False, "Print every table and remark")


class Measured(FolderPart):
    """Measured data of a command."""

    data: str = option_field("measured", "Runs or logs in any format, or measured (packaged)", argument=True)


class ComparedRuns(Measured):
    """Data of `compare`."""

    data: str = option_field("measured", "Runs in any format, measured, or simulated_by_paper", argument=True)
    own_mass: bool = option_field(False, "Use the robot's mass and the payload, not total_mass_kg")


class SettledLog(FolderPart):
    """Data of `settle`."""

    data: str = option_field(
        ...,
        "Log with time_s, the imposed quantity and channels",
        argument=True,
        metavar="LOG",
    )


class DataPart(Part):
    """Names of the columns of a table or log, if they differ from those of mmrjax."""

    columns: str | None = option_field(
        None,
        f"Column names: a preset ({', '.join(presets_file.PACKAGED)}, with numbers: vesc,pole_pairs=7) or its file",
        usual="[columns] of the robot's file",
    )


class ModelPart(Part):
    """Fidelity, one of `mmrjax.fidelities`."""

    model: str = option_field(fidelities.NAMES[0], f"Fidelity: {', '.join(fidelities.NAMES)}")

    @field_validator("model")
    @classmethod
    def _known(cls, model: str) -> str:
        return _check_fidelity(model)


def _check_fidelity(model: str) -> str:
    """The name of a fidelity. Unknown names are rejected."""
    if model not in fidelities.TABLE:
        raise PydanticCustomError("unknown", f"input should be {_join_with_or(map(repr, fidelities.TABLE))}")
    return model


def _join_with_or(names: Iterable[str]) -> str:
    """«a, b or c»."""
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


def _fidelities_with_option(option: str) -> dict[str, fidelities.Option]:
    """Fidelities that have an option, each with its own version of it."""
    return {name: o for name, facts in fidelities.TABLE.items() for o in facts.options if o.name == option}


def _largest_value(option: str) -> float:
    return max(o.most for o in _fidelities_with_option(option).values())


def _default_text(option: str, longest: float = math.inf) -> str:
    """Default of an option for each fidelity. `simulate` uses at most `longest`."""
    defaults = {name: o.default for name, o in _fidelities_with_option(option).items()}
    capped = {name: f"{v:g}" + (f", simulate {longest:g}" if v > longest else "") for name, v in defaults.items()}
    return "; ".join([f"{name} {text}" for name, text in capped.items()] if len(defaults) > 1 else capped.values())


Duration = Annotated[float, positive_number(_largest_value("duration"))]


class FidelityPart(ModelPart):
    """Fidelity of the simulation and its options. None: the fidelity's default."""

    duration_s: Duration | None = option_field(None, "Length of a run", usual=_default_text("duration", SHORT_RUN))
    step_s: Annotated[float, positive_number(_largest_value("step"))] | None = option_field(
        None, "Integration step", usual=_default_text("step")
    )

    @model_validator(mode="after")
    def _acts(self) -> Self:
        for name in ("duration", "step"):
            value = getattr(self, f"{name}_s")
            fidelities_with_it = _fidelities_with_option(name)
            if value is None:
                continue
            if self.model not in fidelities_with_it and value not in {
                option.default for option in fidelities_with_it.values()
            }:
                raise combination_error(
                    f"`{name}_s` has an effect only with `model` {_join_with_or(fidelities_with_it)}"
                )
            if self.model in fidelities_with_it and value > fidelities_with_it[self.model].most:
                limit = f"{fidelities_with_it[self.model].most:g} {fidelities_with_it[self.model].unit}"
                raise combination_error(f"`{name}_s`: got {value:g}; `model` {self.model} allows at most {limit}")
        return self

    @property
    def options(self) -> dict[str, float]:
        """Every option of the fidelity, as stated or by default."""
        facts = fidelities.fidelity_facts(self.model)
        return facts.resolved(**{option.name: getattr(self, f"{option.name}_s") for option in facts.options})


class BatchPart(FidelityPart):
    """Number of runs in one batch. None: the fidelity's default."""

    chunk: Annotated[int, Field(ge=1, le=1_000_000_000)] | None = option_field(
        None,
        "Runs simulated together",
        usual=", ".join(f"{name} {facts.at_once(accelerator=False)}" for name, facts in fidelities.TABLE.items())
        + " on processors",
    )


class SupplyPart(Part):
    """Supply of the motors."""

    battery: bool = option_field(False, "Use the robot's battery")
    discharge_mAh: Annotated[float, Field(ge=0, le=100_000)] = option_field(
        0.0, "Charge taken from the battery before"
    )

    exclusive: ClassVar[Rules] = (("voltages_V", "battery", ", whose charge sets the voltage"),)
    needed: ClassVar[Rules] = (("discharge_mAh", "battery", "has an effect only with `battery`"),)


SURFACE = "Surface of Table 5, or one of the rig's"
FRONT = "Angle of the front levers (0: extended, positive: up, 180: folded)"
REAR = "Angle of the rear levers, likewise"


def _values_text(values: Iterable[float]) -> str:
    return ",".join(f"{v:g}" for v in values)


class OneRun(Part):
    """Conditions of one run, by the columns of tables of runs. None: the robot's default.

    `inputs.one_run` checks the values like those of a row of a table.
    """

    configuration: str | None = option_field(None, "Configuration, such as 6T2A or 4W2T", usual="its first")
    supply_voltage_V: float | None = option_field(
        None,
        "Supply voltage (V), negative in reverse",
        usual="33; for a rig its limit; none with --battery",
        flag="--voltage",
    )
    motor_speed_rpm: float | None = option_field(None, "Imposed motor speed (rpm), negative in reverse")
    motor_current_A: float | None = option_field(None, "Imposed current per motor (A), negative in reverse")
    payload_kg: float | None = option_field(None, "Additional load mass", usual="0")
    slope_deg: float | None = option_field(None, "Slope, positive uphill", usual="0")
    surface: str | None = option_field(None, SURFACE, usual=f"{BENCH}; for a rig none")
    total_mass_kg: float | None = option_field(
        None, "Total mass", usual="the robot's mass and the payload", flag="--mass"
    )
    levers_front_deg: float | None = option_field(None, FRONT, usual="the robot's")
    levers_rear_deg: float | None = option_field(None, REAR, usual="the robot's")
    load_torque_Nm: float | None = option_field(
        None, "Brake torque at each output (N·m), for a shaft",
        usual="none"
    )  # fmt: skip

    @property
    def stated(self) -> Json:
        """Conditions that options state, by column."""
        return {name: value for name in OneRun.model_fields if (value := getattr(self, name)) is not None}


class GivenRuns(OneRun, FolderPart):
    """Runs of `simulate`: one run from options, or those in a file."""

    runs: Path | None = option_field(None, "CSV of runs to simulate")

    @model_validator(mode="after")
    def _once(self) -> Self:
        if self.runs is not None and self.stated:
            names = ", ".join(f"`{name}`" for name in self.stated)
            raise combination_error(f"{names}: not allowed with `runs`; give it as a column there")
        return self


class Picture(OneRun):
    """File of `render`, and the run that it shows."""

    file: Path = option_field(..., "Output file, ending in .png", argument=True)
    time: float = option_field(0.8, "Time of the picture (s)")
    force: bool = option_field(False, "Replace an existing file")


class AxesPart(Part):
    """Axes of a grid. The default of an axis is from `sweeps.points.grid.resolve_grid`: Table 8 for the packaged
    robot.

    The drive axis is voltage or motor speed, whichever the robot imposes. It is absent on the battery. Payload,
    slope and surface apply to vehicles only.
    """

    configurations: NonEmpty[str] | None = option_field(
        None, "Configurations, comma-separated", usual="all configurations"
    )
    voltages_V: NonEmpty[Voltage] | None = option_field(
        None,
        "Supply voltages (V). Default of a rig: thirds of voltage_limit",
        usual=_values_text(VOLTAGES_V),
    )
    motor_speeds_rpm: NonEmpty[MotorSpeed] | None = option_field(
        None, "Imposed motor speeds (rpm)", usual="thirds of speed_limit"
    )
    payloads_kg: NonEmpty[Payload] | None = option_field(
        None, "Additional load masses (kg)", usual=_values_text(PAYLOADS_KG)
    )
    slopes_deg: NonEmpty[Slope] | None = option_field(
        None, "Slopes (deg), positive uphill. Default of a rig: 0", usual=_values_text(SLOPES_DEG)
    )
    surface: str | None = option_field(None, SURFACE, usual=f"{BENCH}; for a rig none")


class GridPart(AxesPart):
    """Axes of a grid, including those of shafts and imposed currents."""

    motor_currents_A: NonEmpty[MotorCurrent] | None = option_field(None, "Imposed currents per motor (A)")
    load_torques_Nm: NonEmpty[LoadTorque] | None = option_field(
        None, "Brake torques at each output (N·m), for a shaft", usual="none"
    )


class InferencePart(Part):
    """Prior knowledge and data of a fit."""

    prior: Names = option_field(
        (), "A prior in SI units. Repeatable: 6T2A.ground.friction.static=0.45±0.05", verbatim=True
    )
    noise: str = option_field(
        "",
        "Standard deviations: current=2%,motor_speed=10rpm,speed=5mm/s",
        usual="from columns, else estimated. Settled rows without series in the loop: 2, 0.5, 1 %",
    )
    rows: Annotated[int, Field(ge=100, le=1_000_000)] = option_field(
        ROWS, "Most rows used. Larger data are thinned evenly"
    )
    seed: Seed = option_field(0, "Random seed")


class FittedRuns(Measured, VerbosePart):
    """Data and output of `calibrate`."""


class LoopBeside(FittedRuns):
    """Data, output and time limit of `loop`."""

    within: Annotated[str, Field(pattern=r"^\d+(\.\d+)?(s|min|h)?$")] = option_field(
        "10min", "Wall-clock limit, such as 90s, 5min or 1h"
    )

    @property
    def seconds(self) -> float:
        """The time [s]."""
        number = self.within.rstrip("sminh")
        return float(number) * {"min": 60.0, "h": 3600.0}.get(self.within.removeprefix(number), 1.0)


class TurnPart(Part):
    """Separate commands for the left and right sides of the robot. None: both sides get the same command."""

    left_V: Voltage | None = option_field(None, "Voltage of the left motor (V), with --right")
    right_V: Voltage | None = option_field(None, "Voltage of the right motor (V)")
    duty_left: Duty | None = option_field(None, "Duty of the left motor")
    duty_right: Duty | None = option_field(None, "Duty of the right motor")
    heading_deg: Heading | None = option_field(None, "Heading at the start, from uphill to the left")

    @property
    def turns(self) -> bool:
        """True if the robot is free to turn."""
        return any(getattr(self, name) is not None for name in TurnPart.model_fields)

    exclusive: ClassVar[Rules] = (("left_V", "duty_left", "; give one pair"),)
    needed: ClassVar[Rules] = tuple(
        (one, other, f"needs `{other}`; give both")
        for pair in (("left_V", "right_V"), ("duty_left", "duty_right"))
        for one, other in (pair, pair[::-1])
    )


class PosteriorPart(Part):
    """Uncertainty of results from the posterior of a calibrated robot."""

    posterior: Annotated[int, Field(ge=10, le=100_000)] | None = option_field(
        None, "Report ± from this many draws of --robot's posterior.nc"
    )


class OutputPart(Part):
    """Files written in addition to the numbers."""

    report: bool = option_field(True, "Write report.html")
    table: Literal["csv", "parquet"] = option_field("csv", "Format of tables: CSV, or Parquet as well")


class ProfilePart(FidelityPart):
    """Mission that the runs follow."""

    profile: Annotated[str, Field(min_length=1)] | None = option_field(
        None,
        "Mission: CSV with time_s and any of speed_mm_s, motor_speed_rpm, duty, mode, supply_voltage_V, "
        "slope_deg, payload_kg, load_torque_Nm, surface, current_other_A. For turns: duty_left, duty_right, "
        "voltage_left_V, voltage_right_V, or yaw_rate_rad_s. Or stair, stop_and_go, "
        "shuttle, patrol (docs/reference/profiles.md)",
    )

    @model_validator(mode="before")
    @classmethod
    def _follows(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("profile") is not None:
            return {"model": PROFILE_MODEL, **values}
        return values

    exclusive: ClassVar[Rules] = (("duration_s", "profile", ", which sets the duration"),)

    @model_validator(mode="after")
    def _profiled(self) -> Self:
        if self.profile is not None and self.model != PROFILE_MODEL:
            raise combination_error(f"`profile` has an effect only with `model` {PROFILE_MODEL}; got {self.model}")
        return self

    @property
    def options(self) -> dict[str, float]:
        """Options of the fidelity. None with a profile."""
        return super().options if self.profile is None else {}


class Simulate(RobotPart, DataPart, ProfilePart, SupplyPart, TurnPart, PosteriorPart, OutputPart):
    """A few given runs. Runs over time begin at standstill, or follow a profile."""

    exclusive: ClassVar[Rules] = (
        *itertools.product(TurnPart.model_fields, ("profile", "posterior")),
        ("left_V", "battery", "; give `duty_left` and `duty_right`"),
        ("posterior", "profile"),
    )

    @property
    def options(self) -> dict[str, float]:
        """Every option of the fidelity. The default duration is at most `SHORT_RUN`."""
        options = super().options
        if self.duration_s is None and "duration" in options:
            options["duration"] = min(options["duration"], SHORT_RUN)
        return options


class Sweep(RobotPart, BatchPart, SupplyPart, GridPart, PosteriorPart, OutputPart):
    """A grid of runs: every combination of the axes."""


class Compare(RobotPart, DataPart, FidelityPart, PosteriorPart, OutputPart):
    """The runs of a measured table."""

    against: str | None = option_field(None, "Second robot on the same rows", metavar="ROBOT.toml", format="path")


class Render(RobotPart, FidelityPart, SupplyPart):
    """One run, for a picture."""

    model: Literal["track"] = "track"


class ConfigurationPart(Part):
    """One configuration of a robot."""

    configuration: str | None = option_field(None, "Configuration of the robot", usual="its first")


class Resonance(RobotPart, ConfigurationPart, FidelityPart, OutputPart):
    """A map of ripple over speed and payload, from the fidelity that resolves the running gear."""

    model: Literal["track"] = "track"
    duration_s: Duration | None = option_field(
        None, "Length of a run (s), whose second half is evaluated", usual="1.5", minimum=0.5
    )
    voltages_V: NonEmpty[Voltage] = option_field(
        tuple(10.0 + k for k in range(31)),
        "Supply voltages (V), at least 5",
        usual="10:40:1, that is 31",
        minimum=0,
    )
    payloads_kg: NonEmpty[Payload] = option_field(PAYLOADS_KG, "Additional load masses")
    slope_deg: Slope = option_field(0.0, "Slope, positive uphill")
    surface: PaperSurface = option_field(BENCH, "Surface of Table 5")  # type: ignore[valid-type]


Angle = Annotated[float, number_between(-360, 360)]
Height = Annotated[float, positive_number(5000)]


class ClimbPart(Part):
    """Edges of an obstacle, lever angles during a climb, and its integration."""

    nose_mm: Annotated[float, number_between(0, 500)] = option_field(0.0, "Edge radius of steps and stairs")
    sequence: Path | None = option_field(
        None, "CSV of lever angles: x_mm (middle of the robot from the obstacle) or time_s, front_deg, rear_deg. "
            "Or front_V, rear_V of the lever motors",
        format="path",
    )  # fmt: skip
    levers_voltage_V: Annotated[float, positive_number(1e6)] | None = option_field(
        None, "Highest voltage of the levers' motors (V)", usual="that of the supply"
    )
    duration_s: Annotated[float, positive_number(600)] = option_field(20.0, "Longest run")
    time_step_s: Annotated[float, positive_number(1e-3)] = option_field(1e-4, "Integration step")


class Climb(RobotPart, ConfigurationPart, ClimbPart, SupplyPart, OutputPart):
    """One robot over an obstacle, or a search for the largest obstacle that it can climb."""

    step_mm: Height | None = option_field(None, "Height of a step")
    stairs: str | None = option_field(None, "RISExTREADxCOUNT in mm, such as 170x290x3")
    gap_mm: Height | None = option_field(None, "Width of a trench")
    terrain: Path | None = option_field(
        None, "CSV of the ground with columns x_m and z_m, or x_mm and z_mm", format="path"
    )
    levers_front_deg: Angle | None = option_field(None, FRONT, usual="the robot's")
    levers_rear_deg: Angle | None = option_field(None, REAR, usual="the robot's")
    supply_voltage_V: Voltage | None = option_field(None, "Supply voltage (V)", usual="12", flag="--voltage")
    payload_kg: Payload = option_field(0.0, "Additional load mass")
    surface: PaperSurface = option_field(BENCH, "Surface of Table 5")  # type: ignore[valid-type]
    find: Literal["step", "stairs", "gap"] | None = option_field(
        None,
        "Find the largest obstacle. For stairs: the rise at the tread of --stairs",
    )
    derivatives: Names = option_field(
        (),
        "Compute derivatives by these, comma-separated: any parameter, adhesion, payload, voltage (with "
        "--battery: discharge), levers_front_deg, levers_rear_deg, obstacle_mm",
    )

    exclusive: ClassVar[Rules] = (
        *itertools.combinations(("step_mm", "stairs", "gap_mm", "terrain"), 2),
        ("supply_voltage_V", "battery"),
        ("derivatives", "find"),
    )

    @model_validator(mode="after")
    def _one_obstacle(self) -> Self:
        stated = next((name for name in ("step_mm", "stairs", "gap_mm", "terrain") if self.states(name)), None)
        if stated is None and self.find is None:
            raise combination_error(
                "no obstacle is given; give `step_mm`, `stairs`, `gap_mm` or `terrain`, or `find`"
            )
        if self.find == "stairs" and stated is None:
            raise combination_error("`find` stairs needs `stairs`, which sets tread and count")
        if self.find is not None and stated is not None and not stated.startswith(self.find):
            raise combination_error(f"`find` {self.find} cannot be combined with `{stated}`")
        if self.nose_mm and (stated in ("gap_mm", "terrain") or self.find == "gap"):
            raise combination_error("`nose_mm` has an effect only with steps and stairs")
        return self


class Reproduce(RobotPart, ModelPart):
    """The paper's figures and tables."""

    model: str = option_field(fidelities.NAMES[0], "steady; or track, which adds Figs. 23-27")


class FeedforwardPart(Part):
    """Fit of the constants kS, kV, kA instead of a robot's parameters."""

    feedforward: Literal["simple", "elevator", "arm"] | None = option_field(
        None,
        "Fit kS, kV, kA (and kG) of this mechanism, with gains (docs/howto/wpilib.md)",
        usual="no",
    )
    unit: Literal["rotation", "rad", "degree", "m"] | None = option_field(
        None, "Unit of position in kV and kA", usual="rotation; for a travel m"
    )
    position_error: Annotated[float, positive_number(1e6)] = option_field(1.0, "Acceptable position error [unit]")
    velocity_error: Annotated[float, positive_number(1e6)] = option_field(1.5, "Acceptable velocity error [unit/s]")
    effort_V: Annotated[float, positive_number(1e4)] = option_field(7.0, "Largest voltage of the feedback (V)")
    period_s: Annotated[float, positive_number(10)] = option_field(0.02, "Period of the controller (s)")
    measurement_delay_s: Annotated[float, number_between(0, 10)] | None = option_field(
        None, "Delay of the measurement (s)", usual="from the log"
    )


class Calibrate(RobotPart, DataPart, InferencePart, FeedforwardPart, OutputPart):
    """Options of a calibration. None: the default depends on the fidelity or the data."""

    model: Annotated[str, AfterValidator(_check_fidelity)] | None = option_field(
        None, f"Fidelity: {', '.join(fidelities.NAMES)}", usual="drive for a log over time, else steady"
    )
    free: Names = option_field((), "Parameters to fit, comma-separated, or a group such as motor.*")
    fix: Names = option_field((), "Parameters to keep fixed, comma-separated")
    starts: Annotated[int, Field(ge=1, le=100_000)] | None = option_field(
        None, "Number of searches", usual="64; histories 8; settled turns 4; rows with drive or track 1"
    )
    population: Annotated[int, Field(ge=0, le=1_000_000)] | None = option_field(
        None,
        "Members of a gradient-free search",
        usual="256 if the running gear is fitted, else 0",
    )
    generations: Annotated[int, Field(ge=1, le=10_000)] | None = option_field(
        None, "Most generations of the population", usual="30"
    )
    profiles: bool | None = option_field(None, "Compute profile likelihoods", usual="for steady, except turns")
    hold_out: bool | None = option_field(None, "Refit with each block of runs left out", usual="steady only")


class Settle(RobotPart, DataPart, OutputPart):
    """Options for extracting settled runs from a log over time."""

    shortest_s: Annotated[float, positive_number(3600)] | None = option_field(
        None, "Shortest settled stretch", usual="0.3, and at least 20 samples"
    )
    drift: Annotated[float, Field(gt=0, le=0.5)] = option_field(
        0.02, "Largest change of a mean within a stretch, as a fraction"
    )


class Export(RobotPart, ConfigurationPart, OutputPart):
    """A drive in the format of another simulator."""

    robot: str = option_field(
        "nominal",
        "nominal, sm1, sm2, or the TOML file of a robot",
        metavar="[ROBOT.toml]",
        format="path",
        argument=True,
    )
    to: Literal["mujoco", "jax", "onnx", "mjlab", "table", "randomization"] = option_field(
        "mujoco", "Format (docs/howto/export.md)"
    )
    data: str | None = option_field(None, "Runs or log to compare with", usual="a grid without readings")
    joint: str = option_field("drive", "Name of the joint, for mujoco")
    draws: Annotated[int, Field(ge=1, le=100_000)] = option_field(
        1000, "Samples from the posterior, for randomization"
    )
    seed: Seed = option_field(0, "Random seed of the samples")


class Loop(RobotPart, DataPart, InferencePart, OutputPart):
    """Options of the closed loop."""

    replicates: Annotated[int, Field(ge=250, le=100_000)] = option_field(
        500, "Bootstrap tables. Time histories use at least 333"
    )
    forbid: Names = option_field((), "Experiment to avoid, repeatable: stall, lifted, 'one motor', a configuration")
    model: Path | None = option_field(
        None,
        "MuJoCo model of several joints",
    )
    joints: Names = option_field((), "Joints of --model, comma-separated, or all")

    needed: ClassVar[Rules] = (
        ("model", "joints", "and `joints` must be given together"),
        ("joints", "model", "needs `model`; give both"),
    )


class RequirementsPart(Part):
    """Requirements on a robot."""

    requirements: str = option_field(
        "paper",
        "TOML file (docs/reference/requirements.md)",
        usual="the aims of the paper",
        metavar="[REQUIREMENTS.toml]",
        format="path",
        argument=True,
    )


class Check(RequirementsPart, RobotPart, OutputPart):
    """A check of a robot against requirements."""

    changes: bool = option_field(True, "Find changes that meet missed requirements")


class Size(RequirementsPart, RobotPart, OutputPart):
    """A search for a robot that meets requirements."""

    objective: str = option_field("mass", "Quantity to minimise: mass (kg), energy (Wh/m) or cost (EUR)")
    pareto: Names = option_field((), "Two objectives, comma-separated, for a Pareto front")
    motors: Names = option_field((), "Motors to choose from, comma-separated", usual="all in the catalogue")
    seed: Seed = option_field(0, "Random seed of the first designs")


class Sensitivity(RobotPart, FidelityPart, SupplyPart, AxesPart, OutputPart):
    """A sensitivity study.

    Methods that draw a sample use only the ends of axes that are not stated, and for slopes also the middle.
    """

    method: str = option_field(
        "sobol",
        "local, sobol or morris",
        usual="sobol; with --posterior local",
    )
    parameters: Names = option_field(
        (), "Uncertain parameters, comma-separated, or a group such as motor.*", usual="all that have a prior"
    )
    vary: Names = option_field((), "Also vary an operating condition. Repeatable: voltage=22:26, slope_deg=0:5")
    outputs: Names = option_field(
        (),
        "Outputs, comma-separated: of a run, steepest_slope, highest_step, best_step, or start (three outputs)",
        usual="current, speeds, slip, power, efficiency, steepest slope",
    )
    evaluations: Annotated[int, Field(ge=1, le=1_000_000_000)] | None = option_field(
        None, "Least number of model evaluations", usual="1000000; for runs over time 100000"
    )
    seed: Seed = option_field(0, "Random seed of the sample")
    posterior: bool = option_field(False, "Use the posterior.nc of the calibrated --robot as inputs")

    @model_validator(mode="before")
    @classmethod
    def _of_a_posterior(cls, values: Any) -> Any:
        """Makes `local` the default with a posterior, because the other methods need independent inputs."""
        if isinstance(values, dict) and values.get("posterior") and values.get("method") is None:
            return {**values, "method": "local"}
        return values


C = TypeVar("C", bound=Part)


def read_toml(file: Path) -> Json:
    """The keys of a TOML file.

    Raises:
        BadConfiguration: the file cannot be read.
    """
    return toml_content(toml_text(file, file), file)


def resolve_configuration(kind: type[C], file: Path | None, options: Json, trust: bool = False) -> C:
    """The configuration of a command: defaults, then the file's keys, then the options given (not None).

    Args:
        trust: True if the file may name code to run. Otherwise only options may.

    Raises:
        BadConfiguration: the file cannot be read or names code to run without `trust`, a key is unknown, or a value
            is out of range.
    """
    values = {} if file is None else read_toml(file)
    option_values = {k: v for k, v in options.items() if v is not None}
    for name in (name for name, schema in schema_facts(kind).items() if schema.get("executes")):
        if file is not None and values.get(name) and name not in option_values and not trust:
            option = options_of_fields(kind)[name]
            raise BadConfiguration(
                f"{file.name}, {name}: would run code, which a file may not request; give {option} on the command "
                "line, or --trust"
            )
    if "set" in option_values:
        set_values = values.get("set", {})
        # If the file's `set` is not a table, the validation below rejects it regardless of the options.
        option_values["set"] = {**set_values, **option_values["set"]} if isinstance(set_values, dict) else set_values
    try:
        return kind.model_validate({**values, **option_values})
    except ValidationError as error:
        raise BadConfiguration(_error_sentence(kind, error, file, option_values)) from None


def _error_sentence(kind: type[Part], error: ValidationError, file: Path | None, option_values: Json) -> str:
    first_error = error.errors()[0]
    options = options_of_fields(kind)

    def displayed_name(name: str) -> str:
        """Name of a field for messages: its option, or its key in the file that contains it."""
        return options.get(name, name) if file is None or name in option_values else name

    if first_error["type"] == "idle":  # its message has names of fields between backticks
        message = re.sub(r"`(\w+)`", lambda match: displayed_name(match[1]), first_error["msg"])
        return message if file is None else f"{file.name}: {message}"
    key = str(first_error["loc"][0])
    key_path = ".".join(str(part) for part in first_error["loc"])
    option_place = (
        f"{file.name}, {key_path}" if file is not None and key not in option_values else displayed_name(key)
    )
    if first_error["type"] == "extra_forbidden":
        return f"{option_place}: no such key; {allowed_words(key, kind.model_fields)}"
    expectation = first_error["msg"][0].lower() + first_error["msg"][1:]
    schema = schema_facts(kind).get(key, {})
    limits = {**schema.get("items", {}), **schema}
    if first_error["type"] == "literal_error":
        expectation = f"expected {first_error['ctx']['expected']}"
    if {"minimum", "maximum"} <= limits.keys() and {"ge", "le"} & first_error.get("ctx", {}).keys():
        expectation = f"expected {limits['minimum']:.10g} to {limits['maximum']:.10g}"
    return f"{option_place}: got {first_error['input']!r}; {expectation}"


def as_toml(config: Part) -> str:
    """The resolved configuration, which `--config` accepts."""
    from calibration.data.writing import toml_value  # imports NumPy, which --help does not need

    lines = []
    values = config.model_dump()
    values["set"] = values.pop("set")  # tables come last
    if isinstance(config, FidelityPart):
        values |= {"duration_s": None, "step_s": None} | {f"{name}_s": v for name, v in config.options.items()}
    tables = {key: value for key, value in values.items() if isinstance(value, dict)}
    for key, value in values.items():
        if value is None or key in tables:  # None is left to the fidelity or the robot
            continue
        lines.append(f"{key} = {toml_value(value)}")
    for key, table in tables.items():
        lines += ["", f"[{key}]", *(f"{toml_value(name)} = {toml_value(value)}" for name, value in table.items())]
    return "\n".join(lines) + "\n"
