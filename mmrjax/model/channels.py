"""The table of channels, one row for each quantity that an instrument can show. No other module lists them.

Importable without jax. A new channel is a row of `EVERY`. The rig decides which channels exist: a robot
(`Robot.channels`), a table of its runs (`Runs.channels`) and each result carry them, in the order of `EVERY`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from mmrjax.model.quantities import DEG, MM, RPM, TRAVEL, TURN, Quantity

if TYPE_CHECKING:
    from mmrjax.model.robot import Robot
    from mmrjax.model.signals import Signals

#: Parameters of the robot that a reading may depend on: the current at an imposed speed, the voltage at an imposed
#: speed or current, the winding temperature after long running at a current, and the same over time.
CURRENT = ("motor.torque_constant",)
VOLTAGE = ("motor.resistance", *CURRENT)
HEAT = (*VOLTAGE, "motor.resistance_thermal_winding", "motor.resistance_thermal_housing")
WARMING = (*HEAT, "motor.time_constant_winding", "motor.time_constant_housing")


@dataclasses.dataclass(frozen=True)
class Channel(Quantity):
    """A quantity that an instrument can show.

    Attributes:
        word: short name that `--noise` takes.
        sd_largest: largest sd that a table may hold [unit].
        read: reading of an ideal instrument, from the signals [SI].
        sd_share: assumed standard deviation as a share of the reading, if no other is known [-].
        resolution: digits after the point in reports [unit].
        zero_at_rest: True if it shows 0 until the robot moves.
        sign: what turns it: the travel, or a turn; an angle counts on from its last value.
        settled, over_time: True if settled runs and histories can show it.
        zero_error: standard deviation of the instrument's zero [SI]; 0 for counters and clocks, which have none.
        side: 0 or 1 for a channel of the left or right side; None: a channel of both together.
        where: place of the measurement, if the label does not give it.
        rests_on: dotted names of the parameters that it depends on; it is unknown if one of them is.
    """

    word: str
    sd_largest: float
    read: Callable[[Robot, Signals], Any]
    sd_share: float
    resolution: int = 1
    zero_at_rest: bool = False
    sign: str = dataclasses.field(default=TRAVEL, kw_only=True)
    settled: bool = True
    over_time: bool = True
    zero_error: float = 0.0
    side: int | None = None
    where: str = ""
    rests_on: tuple[str, ...] = ()

    @property
    def directed(self) -> bool:
        """True if its sign is that of the motion."""
        return bool(self.sign)

    @property
    def deviation(self) -> Quantity:
        """Standard deviation of its readings, as a column of tables."""
        return Quantity(
            f"{self.stem or self.name}_sd", self.unit, self.factor, f"standard deviation of {self.label}",
            (0.0, self.sd_largest), other_units=self.other_units,
        )  # fmt: skip

    @property
    def sd_column(self) -> str:
        """Name of the column of its standard deviation."""
        return self.deviation.column

    @property
    def misses_zero(self) -> bool:
        """True if its instrument may have a zero error; the zero of a temperature is a convention."""
        return self.zero_error > 0 and self.directed

    def __reduce__(self) -> tuple[Callable[[str], Channel], tuple[str]]:
        """Pickles the channel by its name, so that tables and results can go to other processes."""
        return find_channel, (self.name,)


def _winding_temperature(robot: Robot, signals: Signals) -> Any:
    """Winding temperature [°C]: the present one if it is followed, else after long running at this current."""
    if signals.temperature is not None:
        return signals.temperature
    return robot.motor.temperature_settled(signals.current)


#: Sides of a robot that turns, in the order of every axis of 2.
SIDES = ("left", "right")


def _of_side(channel: Channel, side: int) -> Channel:
    """Channel of one side, made from a channel of both sides."""
    name = f"{channel.name}_{SIDES[side]}"
    return dataclasses.replace(
        channel,
        name=name,
        label=f"{channel.label}, {SIDES[side]}",
        word=name,
        side=side,
        in_profiles=False,
    )


#: Channels of straight travel and of turns.
_EITHER: tuple[Channel, ...] = (
    Channel(
        name="total_current",
        unit="A",
        factor=1.0,
        label="total current",
        word="current",
        range=(-2000.0, 2000.0),
        sd_largest=100.0,
        read=lambda robot, signals: signals.total_current,
        where="drawn from the supply by all motors; with a duty, that share of their current",
        rests_on=CURRENT,
        sd_share=0.02,
        resolution=3,
        other_units=(("mA", 1e-3),),
    ),
    Channel(
        name="motor_speed",
        unit="rpm",
        factor=RPM,
        label="motor speed",
        word="motor_speed",
        range=(-30_000.0, 30_000.0),
        sd_largest=10_000.0,
        read=lambda robot, signals: signals.speed_motor,
        in_profiles=True,
        sd_share=0.005,
        unit_si="rad/s",
        zero_at_rest=True,
        other_units=(("rad/s", 1.0), ("turns/s", 2 * math.pi), ("deg/s", DEG)),
    ),
    Channel(
        name="speed",
        unit="mm/s",
        factor=MM,
        label="speed",
        word="speed",
        range=(-10_000.0, 10_000.0),
        sd_largest=5_000.0,
        read=lambda robot, signals: signals.speed,
        in_profiles=True,
        sd_share=0.01,
        unit_si="m/s",
        zero_at_rest=True,
        other_units=(("m/s", 1.0), ("km/h", 1 / 3.6), ("cm/s", 1e-2), ("m/min", 1 / 60)),
    ),
    Channel(
        name="motor_current",
        unit="A",
        factor=1.0,
        label="motor current",
        word="motor_current",
        range=(-2000.0, 2000.0),
        sd_largest=100.0,
        read=lambda robot, signals: signals.current,
        where="in the leads of one motor",
        rests_on=CURRENT,
        zero_error=0.05,
        sd_share=0.02,
        resolution=3,
        other_units=(("mA", 1e-3),),
    ),
    Channel(
        name="output_speed",
        unit="rpm",
        factor=RPM,
        label="output speed",
        word="output_speed",
        range=(-30_000.0, 30_000.0),
        sd_largest=10_000.0,
        read=lambda robot, signals: signals.speed_output,
        sd_share=0.005,
        resolution=2,
        unit_si="rad/s",
        zero_at_rest=True,
        other_units=(("rad/s", 1.0), ("turns/s", 2 * math.pi), ("deg/s", DEG)),
    ),
    Channel(
        name="output_angle",
        unit="deg",
        factor=DEG,
        label="output angle",
        word="output_angle",
        range=(-1e6, 1e6),
        sd_largest=360.0,
        read=lambda robot, signals: signals.angle,
        sd_share=0.01,
        resolution=2,
        unit_si="rad",
        zero_at_rest=True,
        sign="",
        settled=False,
        other_units=(("rad", 1.0), ("turns", 2 * math.pi)),
    ),
    Channel(
        name="position",
        unit="mm",
        factor=MM,
        label="position",
        word="position",
        range=(-1e7, 1e7),
        sd_largest=1e4,
        read=lambda robot, signals: robot.chassis(signals.configuration).radius * signals.angle,
        sd_share=0.01,
        resolution=2,
        unit_si="m",
        zero_at_rest=True,
        sign="",
        settled=False,
        other_units=(("m", 1.0), ("cm", 1e-2), ("um", 1e-6)),
    ),
    Channel(
        name="motor_voltage",
        unit="V",
        factor=1.0,
        label="motor voltage",
        word="motor_voltage",
        range=(-200.0, 200.0),
        sd_largest=100.0,
        read=lambda robot, signals: signals.voltage,
        rests_on=VOLTAGE,
        zero_error=0.1,
        sd_share=0.01,
        resolution=2,
        other_units=(("mV", 1e-3),),
    ),
    Channel(
        name="output_torque",
        unit="Nm",
        factor=1.0,
        label="output torque",
        word="output_torque",
        range=(-1e4, 1e4),
        sd_largest=1e3,
        read=lambda robot, signals: signals.torque_output,
        zero_error=0.05,
        sd_share=0.01,
        resolution=4,
        unit_si="N·m",
        other_units=(("mNm", 1e-3), ("kNm", 1e3)),
    ),
    Channel(
        name="winding_temperature",
        unit="C",
        factor=1.0,
        label="winding temperature",
        word="temperature",
        range=(-50.0, 500.0),
        sd_largest=100.0,
        read=_winding_temperature,
        rests_on=HEAT,
        zero_error=2.0,
        sd_share=0.02,
        unit_si="°C",
        over_time=False,
        sign="",
    ),
)

_BY_NAME = {c.name: c for c in _EITHER}
#: Channels of robots that turn: of each side, and of the motion in the plane.
OF_TURNS: tuple[Channel, ...] = (
    *(_of_side(_BY_NAME[f"motor_{what}"], side) for what in ("current", "speed", "voltage") for side in (0, 1)),
    Channel(
        name="yaw_rate",
        unit="rad/s",
        factor=1.0,
        label="yaw rate",
        word="yaw_rate",
        range=(-100.0, 100.0),
        sd_largest=10.0,
        read=lambda robot, signals: signals.yaw_rate,
        sign=TURN,
        in_profiles=True,
        zero_error=0.01,
        sd_share=0.02,
        resolution=3,
        zero_at_rest=True,
        other_units=(("deg/s", DEG), ("rpm", RPM)),
    ),
    Channel(
        name="lateral_speed",
        unit="mm/s",
        factor=MM,
        label="lateral speed",
        word="lateral_speed",
        range=(-10_000.0, 10_000.0),
        sd_largest=5_000.0,
        read=lambda robot, signals: signals.speed_lateral,
        sd_share=0.02,
        unit_si="m/s",
        zero_at_rest=True,
        other_units=(("m/s", 1.0), ("cm/s", 1e-2)),
    ),
    Channel(
        name="yaw",
        unit="deg",
        factor=DEG,
        label="yaw angle from uphill",
        word="yaw",
        range=(-1e6, 1e6),
        sd_largest=360.0,
        read=lambda robot, signals: signals.heading,
        sd_share=0.01,
        resolution=2,
        unit_si="rad",
        sign="",
        settled=False,
        other_units=(("rad", 1.0),),
    ),
    *(
        Channel(
            name=name,
            stem=name[-1],
            unit="mm",
            factor=MM,
            label=label,
            word=name,
            range=(-1e7, 1e7),
            sd_largest=1e4,
            read=read,
            sd_share=0.01,
            unit_si="m",
            zero_at_rest=True,
            sign="",
            settled=False,
            other_units=(("m", 1.0), ("cm", 1e-2)),
        )
        for name, label, read in (
            ("place_x", "place uphill", lambda robot, signals: signals.place_x),
            ("place_y", "place to the left", lambda robot, signals: signals.place_y),
        )
    ),
)
#: All channels.
EVERY: tuple[Channel, ...] = _EITHER + OF_TURNS

#: Channels of a robot whose file states none.
USUAL = ("total_current", "motor_speed", "speed")


def channels_named(names: Iterable[str]) -> tuple[Channel, ...]:
    """The channels of these names, in the order of `EVERY`, which columns, arrays and reports follow.

    Raises:
        KeyError: no such channel.
    """
    wanted = set(names)
    if unknown := wanted - {c.name for c in EVERY}:
        raise KeyError(f"no channel {min(unknown)}; there are {', '.join(c.name for c in EVERY)}")
    return tuple(c for c in EVERY if c.name in wanted)


def usual_channels() -> tuple[Channel, ...]:
    """The channels of a robot without a rig."""
    return channels_named(USUAL)


def find_channel(name: str) -> Channel:
    """The channel with this name.

    Raises:
        KeyError: no such channel.
    """
    return channels_named((name,))[0]


def channel_names(shown: Iterable[Channel]) -> tuple[str, ...]:
    """Names of the channels, in order."""
    return tuple(c.name for c in shown)


def channel_index(name: str, shown: Iterable[Channel]) -> int:
    """Position of a channel in arrays over the channels `shown`.

    Raises:
        KeyError: `shown` does not contain the channel.
    """
    known = channel_names(shown)
    if name not in known:
        raise KeyError(f"no channel {name}; there are {', '.join(known)}")
    return known.index(name)


def channel_factors(shown: Iterable[Channel]) -> tuple[float, ...]:
    """SI value of one unit of each channel's column."""
    return tuple(c.factor for c in shown)
