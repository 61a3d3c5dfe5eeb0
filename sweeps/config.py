"""What a command is told: options and TOML files, checked into one frozen record of the parts that apply."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import PydanticCustomError

from calibration.data.columns import CONDITIONS
from calibration.data.errors import BadConfiguration, choices, toml_content, toml_text
from mmrjax import channels, fidelities
from mmrjax.tables import BENCH, PAYLOADS_KG, SURFACES

_VOLTAGE, _PAYLOAD, _SLOPE = (CONDITIONS[c] for c in ("supply_voltage_V", "payload_kg", "slope_deg"))
Slope = Annotated[float, Field(ge=_SLOPE[0], le=_SLOPE[1], allow_inf_nan=False)]
Payload = Annotated[float, Field(ge=_PAYLOAD[0], le=_PAYLOAD[1], allow_inf_nan=False)]
_SPEED = channels.of("motor_speed").range
MotorSpeed = Annotated[float, Field(ge=_SPEED[0], le=_SPEED[1], allow_inf_nan=False)]
Voltage = Annotated[float, Field(ge=_VOLTAGE[0], le=_VOLTAGE[1], allow_inf_nan=False)]
#: The fidelity that follows profiles.
PROFILED = "drive"
#: Longest run of `simulate` where none is stated [s]: short enough that the start is seen.
SHOWN = 5.0
Seed = Annotated[int, Field(ge=0, le=2**32 - 1)]


class Part(BaseModel):
    """A part of a command's configuration; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class RobotPart(Part):
    """Which robot.

    Attributes:
        robot: name of a robot, or path of its TOML file.
        set: parameters to change, by dotted name, in SI units.
        effects: Python files with effects of the user's own, see `calibration.data.effect_file`.
    """

    robot: str = "nominal"
    set: dict[str, bool | float] = {}
    effects: tuple[str, ...] = ()


class ModelPart(Part):
    """Which fidelity, one of `mmrjax.fidelities`."""

    model: str = fidelities.NAMES[0]

    @field_validator("model")
    @classmethod
    def _known(cls, model: str) -> str:
        if model not in fidelities.TABLE:
            raise PydanticCustomError("unknown", f"input should be {_either(map(repr, fidelities.TABLE))}")
        return model


def _either(names: Iterable[str]) -> str:
    """«a, b or c»."""
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


def _having(option: str) -> dict[str, fidelities.Option]:
    """The fidelities that have an option, with their kind of it."""
    return {name: o for name, facts in fidelities.TABLE.items() for o in facts.options if o.name == option}


def _most(option: str) -> float:
    return max(o.most for o in _having(option).values())


class FidelityPart(ModelPart):
    """Which fidelity simulates, and its options.

    Attributes:
        duration_s: length of a run [s]; step_s: integration step [s]; None takes the fidelity's default.
    """

    duration_s: Annotated[float, Field(gt=0, le=_most("duration"), allow_inf_nan=False)] | None = None
    step_s: Annotated[float, Field(gt=0, le=_most("step"), allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _acts(self) -> Self:
        for name in ("duration", "step"):
            value, having = getattr(self, f"{name}_s"), _having(name)
            usual = {option.default for option in having.values()}
            if value is not None and self.model not in having and value not in usual:
                raise PydanticCustomError("idle", f"{name}_s acts with model {_either(having)} only")
            if value is not None and self.model in having and value > having[self.model].most:
                most = having[self.model]
                raise PydanticCustomError(
                    "idle", f"{name}_s: got {value:g}; model {self.model} takes at most {most.most:g} {most.unit}"
                )
        return self

    @property
    def options(self) -> dict[str, float]:
        """Every option of the fidelity, as stated or by default."""
        facts = fidelities.facts(self.model)
        return facts.resolved(**{option.name: getattr(self, f"{option.name}_s") for option in facts.options})

    @property
    def runs_at_once(self) -> int:
        """Runs in one vmapped call."""
        return fidelities.facts(self.model).chunk


class BatchPart(FidelityPart):
    """How many runs at once.

    Attributes:
        chunk: runs in one vmapped call; None takes the fidelity's.
    """

    chunk: Annotated[int, Field(ge=1, le=1_000_000_000)] | None = None

    @property
    def runs_at_once(self) -> int:
        """Runs in one vmapped call."""
        return self.chunk or super().runs_at_once


class SupplyPart(Part):
    """What feeds the motors.

    Attributes:
        battery: run on the on-board battery instead of the external supply.
        discharge_mAh: charge already taken from the battery.
    """

    battery: bool = False
    discharge_mAh: Annotated[float, Field(ge=0, le=100_000)] = 0.0

    @model_validator(mode="after")
    def _feeds(self) -> Self:
        if self.discharge_mAh and not self.battery:
            raise PydanticCustomError("idle", "discharge_mAh acts with battery only")
        if self.battery and getattr(self, "voltages_V", None) is not None:
            raise PydanticCustomError(
                "idle", "voltages_V acts without battery only, whose voltage is that of its charge"
            )
        return self


class GridPart(Part):
    """The axes of a grid; None leaves them to `sweeps.points.grid.resolved`: Table 8 for the packaged robot.

    Attributes:
        configurations: of the robot, by name; None takes all that it has.
        voltages_V: of the supply, motor_speeds_rpm: imposed; a robot has one of the two, on the battery none.
        payloads_kg, slopes_deg, surface: of a vehicle.
    """

    configurations: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    voltages_V: Annotated[tuple[Voltage, ...], Field(min_length=1)] | None = None
    motor_speeds_rpm: Annotated[tuple[MotorSpeed, ...], Field(min_length=1)] | None = None
    payloads_kg: Annotated[tuple[Payload, ...], Field(min_length=1)] | None = None
    slopes_deg: Annotated[tuple[Slope, ...], Field(min_length=1)] | None = None
    surface: str | None = None


class InferencePart(Part):
    """What is known before the data speak.

    Attributes:
        prior: `name=value±sd` in SI units, in place of the fields' priors.
        noise: `current=2%,motor_speed=0.5%,speed=1%`; empty takes the file's sd columns, else an assumption or an
            estimate, which is said.
        seed: of everything random.
    """

    prior: tuple[str, ...] = ()
    noise: str = ""
    seed: Seed = 0


class PosteriorPart(Part):
    """Whether results come with the uncertainty of a calibrated robot.

    Attributes:
        posterior: robots to draw from the posterior.nc beside the robot's file; None for none.
    """

    posterior: Annotated[int, Field(ge=10, le=100_000)] | None = None


class OutputPart(Part):
    """What is written beside the numbers.

    Attributes:
        report: whether to write report.html.
    """

    report: bool = True


class ProfilePart(FidelityPart):
    """Which mission the runs follow.

    Attributes:
        profile: name of a packaged profile, or path of a CSV file; None for none.
    """

    profile: Annotated[str, Field(min_length=1)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _follows(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("profile") is not None:
            return {"model": PROFILED, **values}
        return values

    @model_validator(mode="after")
    def _profiled(self) -> Self:
        if self.profile is None:
            return self
        if self.model != PROFILED:
            raise PydanticCustomError(
                "idle", f"profile acts with model {PROFILED} only, which follows one; got model {self.model}"
            )
        if self.duration_s is not None:
            raise PydanticCustomError("idle", "duration_s acts without profile only, whose last row ends the run")
        return self

    @property
    def options(self) -> dict[str, float]:
        """Every option of the fidelity; over a profile it has none."""
        return super().options if self.profile is None else {}


class Simulate(RobotPart, ProfilePart, SupplyPart, PosteriorPart, OutputPart):
    """A few given runs; those over time from standstill, or over a profile."""

    @model_validator(mode="after")
    def _certain(self) -> Self:
        if self.profile is not None and self.posterior is not None:
            raise PydanticCustomError("idle", "posterior acts without profile only")
        return self

    @property
    def options(self) -> dict[str, float]:
        """Every option of the fidelity; a run is short where its length is not stated."""
        options = super().options
        if self.duration_s is None and "duration" in options:
            options["duration"] = min(options["duration"], SHOWN)
        return options


class Sweep(RobotPart, BatchPart, SupplyPart, GridPart, PosteriorPart, OutputPart):
    """A grid of runs: every combination of the axes."""


class Compare(RobotPart, FidelityPart, PosteriorPart, OutputPart):
    """The runs of a measured table."""


class Render(RobotPart, FidelityPart, SupplyPart):
    """One run of the fidelity that pictures are made from."""

    model: Literal["track"] = "track"


class Resonance(RobotPart, FidelityPart, OutputPart):
    """A map of ripple over speed and payload, of the fidelity that resolves the running gear.

    Attributes:
        configuration: of the robot, by name; None takes its first.
        voltages_V, payloads_kg: axes of the map; slope_deg, surface: of all of it.
    """

    model: Literal["track"] = "track"
    configuration: str | None = None
    voltages_V: Annotated[tuple[Voltage, ...], Field(min_length=1)] = tuple(10.0 + k for k in range(31))
    payloads_kg: Annotated[tuple[Payload, ...], Field(min_length=1)] = PAYLOADS_KG
    slope_deg: Slope = 0.0
    surface: Literal[tuple(SURFACES)] = BENCH  # type: ignore[valid-type]  # names of a table


class Reproduce(RobotPart, ModelPart):
    """The paper's figures and tables."""


class Calibrate(RobotPart, ModelPart, InferencePart, OutputPart):
    """A calibration beside its data.

    Attributes:
        free, fix: parameters to free (`default` stands for the default set) and to hold, by dotted name.
        starts: searches; population: members of each generation of a search without gradients
            before those of a rollout; generations: at most.
        profiles: whether to profile every parameter.
        hold_out: whether to fit again without each block. None leaves these three to the fidelity.
    """

    free: tuple[str, ...] = ()
    fix: tuple[str, ...] = ()
    starts: Annotated[int, Field(ge=1, le=100_000)] | None = None
    population: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    generations: Annotated[int, Field(ge=1, le=10_000)] | None = None
    profiles: bool | None = None
    hold_out: bool | None = None


class Loop(RobotPart, InferencePart, OutputPart):
    """The closed loop beside its data.

    Attributes:
        replicates: of the bootstrap.
        prefer: whether the fit to all rows or errors held out choose the leader of a class.
        forbid: kinds of experiments, and configurations, that are not to be proposed.
        resolve: whether the track model is asked about what remains; population, generations: of its search.
    """

    replicates: Annotated[int, Field(ge=250, le=100_000)] = 500
    prefer: Literal["fit", "held-out"] = "fit"
    forbid: tuple[str, ...] = ()
    resolve: bool = False
    population: Annotated[int, Field(ge=4, le=1_000_000)] | None = None
    generations: Annotated[int, Field(ge=1, le=10_000)] | None = None


class Check(RobotPart, OutputPart):
    """A robot held against requirements.

    Attributes:
        requirements: their TOML file, or `paper`: the paper's aims.
        changes: whether to look for what would meet the missed ones.
    """

    requirements: str = "paper"
    changes: bool = True


class Size(RobotPart, OutputPart):
    """A search for a robot that meets requirements.

    Attributes:
        requirements: their TOML file, or `paper`: the paper's aims.
        objective: what is made small; pareto: two of them instead, for a front.
        motors: names of those to choose from; empty: all.
        starts: searches in one batch; seed: of them.
    """

    requirements: str = "paper"
    objective: str = "mass"
    pareto: tuple[str, ...] = ()
    motors: tuple[str, ...] = ()
    starts: Annotated[int, Field(ge=1, le=100_000)] = 256
    seed: Seed = 0


class Sensitivity(RobotPart, FidelityPart, SupplyPart, OutputPart):
    """A sensitivity study.

    Attributes:
        method: `local`, `sobol`, `morris`, `derivative` or `shapley`.
        configurations, voltages_V, motor_speeds_rpm, payloads_kg, slopes_deg, surface: operating points, as of a
            grid; None leaves them to the method: Table 8 where gradients do, its corners and middle where a sample is
            drawn; of a rig see `sweeps.points.grid.resolved`.
        parameters: uncertain, by dotted name, with their priors; empty takes all that have one.
        vary: conditions that are uncertain, `name=low:high`.
        outputs: by name; empty takes the usual ones.
        evaluations: of the model at least, in all; None takes the default.
        posterior: whether the inputs are the posterior of a calibrated robot.
        candidates: CSV of runs that could be made next; empty takes Table 8, of a rig the operating points.
        runs: how many of them to propose; noise: of their readings, as of `calibrate`.
    """

    method: str = "sobol"
    configurations: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    voltages_V: Annotated[tuple[Voltage, ...], Field(min_length=1)] | None = None
    motor_speeds_rpm: Annotated[tuple[MotorSpeed, ...], Field(min_length=1)] | None = None
    payloads_kg: Annotated[tuple[Payload, ...], Field(min_length=1)] | None = None
    slopes_deg: Annotated[tuple[Slope, ...], Field(min_length=1)] | None = None
    surface: str | None = None
    parameters: tuple[str, ...] = ()
    vary: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    evaluations: Annotated[int, Field(ge=1, le=1_000_000_000)] | None = None
    seed: Seed = 0
    posterior: bool = False
    candidates: str = ""
    runs: Annotated[int, Field(ge=1, le=100)] = 5
    noise: str = ""


C = TypeVar("C", bound=Part)


def read_toml(file: Path) -> dict[str, Any]:
    """The keys of a TOML file.

    Raises:
        BadConfiguration: the file cannot be read.
    """
    return toml_content(toml_text(file, file), file)


def resolve(kind: type[C], file: Path | None, options: dict[str, Any]) -> C:
    """The configuration of a command: defaults, then the file's keys, then the options given (not None).

    Raises:
        BadConfiguration: unreadable file, unknown key, or a value out of range; one sentence.
    """
    values: dict[str, Any] = {} if file is None else read_toml(file)
    given = {k: v for k, v in options.items() if v is not None}
    if "set" in given:
        stated = values.get("set", {})
        # A file whose table is none is refused below, whatever the options say.
        given["set"] = {**stated, **given["set"]} if isinstance(stated, dict) else stated
    try:
        return kind.model_validate({**values, **given})
    except ValidationError as error:
        raise BadConfiguration(_sentence(kind, error, file, given)) from None


def _sentence(kind: type[Part], error: ValidationError, file: Path | None, given: dict[str, Any]) -> str:
    first = error.errors()[0]
    if first["type"] == "idle":
        return f"{file.name if file is not None else 'options'}: {first['msg']}"
    key = str(first["loc"][0])
    place = ".".join(str(part) for part in first["loc"])
    where = f"{file.name}, {place}" if file is not None and key not in given else f"option {place}"
    if first["type"] == "extra_forbidden":
        return f"{where}: no such key; {choices(key, kind.model_fields)}"
    limits = {
        name: first["ctx"][name] for name in ("gt", "ge", "lt", "le", "expected") if name in first.get("ctx", {})
    }
    wanted = first["msg"][0].lower() + first["msg"][1:]
    ranges = {
        "slopes_deg": _SLOPE,
        "slope_deg": _SLOPE,
        "payloads_kg": _PAYLOAD,
        "voltages_V": _VOLTAGE,
        "motor_speeds_rpm": _SPEED,
    }
    allowed = ranges.get(key)
    if allowed is not None and limits:
        wanted = f"expected {allowed[0]:g} to {allowed[1]:g}"
    return f"{where}: got {first['input']!r}; {wanted}"


def settings(options: list[str] | None) -> dict[str, bool | float] | None:
    """The `--set NAME=VALUE` options as a table.

    Raises:
        BadConfiguration: no equals sign, or a value that is neither a number nor true or false.
    """
    if not options:
        return None
    table: dict[str, bool | float] = {}
    for option in options:
        name, equals, value = option.partition("=")
        try:
            word = value.strip()
            table[name.strip()] = word == "true" if word in ("true", "false") else float(word)
        except ValueError:
            raise BadConfiguration(
                f"--set: got {option}; expected NAME=VALUE with a number, such as motor.resistance=0.9"
            ) from None
        if not equals:
            raise BadConfiguration(f"--set: got {option}; expected NAME=VALUE, such as motor.resistance=0.9")
    return table


def words(options: list[str] | None) -> tuple[str, ...] | None:
    """Repeated, comma-separated options as one tuple."""
    return tuple(w.strip() for o in options for w in o.split(",") if w.strip()) if options else None


def axis(option: str, text: str | None) -> tuple[float, ...] | None:
    """An axis of a grid: `0,5,10`, or `0:20:0.5` for first, last and step, or both mixed.

    Raises:
        BadConfiguration: something that is neither.
    """
    if text is None:
        return None
    values: list[float] = []
    for part in text.split(","):
        try:
            numbers = [float(n) for n in part.split(":")]
            if len(numbers) == 1:
                values += numbers
                continue
            first, last, step = numbers
            if (last - first) * step < 0:
                raise BadConfiguration(
                    f"{option}: got {part}, which ends before it begins; expected first:last:step as 0:20:0.5"
                )
            count = (last - first) / step
            if not 0 <= count < 1e6:
                raise ValueError
            values += [first + k * step for k in range(round(count - 0.5 + 1e-9) + 1)]
        except (ValueError, ZeroDivisionError, OverflowError):
            raise BadConfiguration(
                f"{option}: got {part or 'nothing'}; expected numbers as 0,5,10 or first:last:step as 0:20:0.5"
            ) from None
    return tuple(values)


def as_toml(config: Part) -> str:
    """The resolved configuration; `--config` accepts it."""
    lines = []
    values = config.model_dump()
    values["set"] = values.pop("set")  # tables come last
    if isinstance(config, FidelityPart):
        values |= {"duration_s": None, "step_s": None} | {f"{name}_s": v for name, v in config.options.items()}
    tables = {key: value for key, value in values.items() if isinstance(value, dict)}
    for key, value in values.items():
        if value is None or key in tables:  # None is left to the fidelity or the robot
            continue
        lines.append(f"{key} = {_toml(value)}")
    for key, table in tables.items():
        lines += ["", f"[{key}]", *(f'"{name}" = {_toml(value)}' for name, value in table.items())]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(name)} = {_toml(v)}" for name, v in value.items()) + "}"
    return repr(value)
