"""ROS bags, version 1 and 2, and MCAP files: fields of the messages of each topic."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Columns
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Clock, Signal, part_of, refused_signal

#: Longest array in a message whose elements become signals. Longer arrays are images and point clouds.
ELEMENTS = 64
#: Field with the time of a message, and its largest plausible difference from the time of recording [ns].
_STAMP, _APART = "header.stamp", 60_000_000_000
#: Units of fields by message type, as stated in its definition.
UNITS = {
    "sensor_msgs/msg/JointState": {"position": "rad", "velocity": "rad/s", "effort": "Nm"},
    "sensor_msgs/msg/BatteryState": {"voltage": "V", "current": "A", "temperature": "C"},
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s"},
    "sensor_msgs/msg/Temperature": {"temperature": "C"},
    "geometry_msgs/msg/Twist": {"angular": "rad/s", "linear": "m/s"},
    "geometry_msgs/msg/TwistStamped": {"twist.angular": "rad/s", "twist.linear": "m/s"},
    "nav_msgs/msg/Odometry": {"twist.twist.angular": "rad/s", "twist.twist.linear": "m/s"},
}


def signals_of_bag(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a bag: `/topic.field.part[2]`, each with the time stamps of its topic.

    The time is the stamp of a message's header, or the time of recording if it has none.

    Raises:
        BadData: the bag lacks the definitions of its messages.
    """
    signals: list[Signal] = []
    with _opened(path) as reader:
        for topic in sorted({c.topic for c in reader.connections}):
            connections = [c for c in reader.connections if c.topic == topic]
            count = sum(c.msgcount for c in connections)
            kind, *others = sorted({c.msgtype for c in connections})
            why = ""
            if others:
                why = f"has messages of types {' and '.join((kind, *others))}; expected one type"
            elif not count:
                why = f"has no message of type {kind}"
            elif kind not in reader.typestore.fielddefs:
                why = (
                    f"has messages of type {kind}, which the bag does not define; record it as MCAP, or convert it "
                    "with rosbags-convert"
                )
            if why:
                signals.append(refused_signal(topic, count, why))
                continue
            connection, _, raw = next(reader.messages(connections=connections))
            fields = dict(_values(reader.deserialize(raw, connection.msgtype)))
            stamped = fields.pop(_STAMP, None) is not None
            read = functools.cache(functools.partial(_topic_values, path, topic))
            clock = Clock(f"{topic}.{_STAMP}" if stamped else f"{topic} (recorded)", part_of(read, ""), "ns")
            for field, value in fields.items():
                units = (unit for start, unit in UNITS.get(kind, {}).items() if field.startswith(start))
                load, words = part_of(read, field), isinstance(value, str)
                signals.append(Signal(f"{topic}.{field}", count, load, next(units, ""), clock, words))
    return tuple(signals)


def _opened(path: Path) -> Any:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    return AnyReader([path], default_typestore=store)


def _topic_values(path: Path, topic: str) -> Columns:
    """Values of every field of a topic, and under "" its time [ns]."""
    rows: list[list[Any]] = []
    recorded: list[int] = []
    names: list[str] = []
    with _opened(path) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, instant, raw in reader.messages(connections=connections):
            values = dict(_values(reader.deserialize(raw, connection.msgtype)))
            names = names or list(values)
            if len(values) != len(names):
                odd_name = next((n for n in (*names, *values) if (n in values) != (n in names)), "")
                amount = "more" if len(values) > len(names) else "fewer"
                raise BadData(
                    f"{path.name}, {topic}.{odd_name}: message {len(rows) + 1} has {amount} elements than the first; "
                    "expected arrays of one length in every message"
                )
            rows.append([values[n] for n in names if n in values])
            recorded.append(instant)
    columns = {n: np.array(column) for n, column in zip(names, zip(*rows, strict=True), strict=True)}
    received = np.array(recorded, np.int64)
    stamps = columns.pop(_STAMP, np.zeros(len(received)))
    are_plausible = (stamps > 0).all() and np.median(np.abs(stamps - received)) <= _APART  # or simulated, or missing
    return columns | {"": stamps if are_plausible else received}


def _values(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers and words in a message, by their path. Times in ns."""
    if path and hasattr(value, "sec") and hasattr(value, "nanosec"):
        yield path, value.sec * 1_000_000_000 + value.nanosec
    elif hasattr(value, "__dataclass_fields__"):
        for field in value.__dataclass_fields__:
            if not field.startswith("__"):
                yield from _values(getattr(value, field), f"{path}.{field}" if path else field)
    elif not isinstance(value, list | tuple | np.ndarray):
        yield path, value
    elif len(value) <= ELEMENTS:
        for k, element in enumerate(value):
            yield from _values(element, f"{path}[{k}]")
