"""ROS bags, version 1 and 2, and MCAP files: fields of the messages of each topic."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Columns
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Clock, Load, Signal

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
        topics = {c.topic: c for c in reader.connections}
        for topic in sorted(topics):
            kind = topics[topic].msgtype
            count = sum(c.msgcount for c in reader.connections if c.topic == topic)
            kinds = sorted({c.msgtype for c in reader.connections if c.topic == topic})
            if len(kinds) > 1:
                signals.append(
                    _refused(topic, count, f"has messages of types {' and '.join(kinds)}; expected one type")
                )
                continue
            if not count:
                signals.append(_refused(topic, 0, f"has no message of type {kind}"))
                continue
            if kind not in reader.typestore.fielddefs:
                signals.append(
                    _refused(
                        topic,
                        count,
                        f"has messages of type {kind}, which the bag does not define; record it as MCAP, or "
                        "convert it with rosbags-convert",
                    )
                )
                continue
            fields = dict(_values(_first(reader, topic)))
            stamped = fields.pop(_STAMP, None) is not None
            read = functools.cache(functools.partial(_topic_values, path, topic))
            clock = Clock(f"{topic}.{_STAMP}" if stamped else f"{topic} (recorded)", _column(read, ""), "ns")
            units = UNITS.get(kind, {})
            for field, value in fields.items():
                unit = next((unit for start, unit in units.items() if field.startswith(start)), "")
                words = isinstance(value, str)
                signals.append(Signal(f"{topic}.{field}", count, _column(read, field), unit, clock, words))
    return tuple(signals)


def _opened(path: Path) -> Any:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    return AnyReader([path], default_typestore=store)


def _refused(topic: str, count: int, why: str) -> Signal:
    return Signal(topic, count, lambda: np.empty(0), refused=why)


def _first(reader: Any, topic: str) -> Any:
    connections = [c for c in reader.connections if c.topic == topic]
    connection, _, raw = next(reader.messages(connections=connections))
    return reader.deserialize(raw, connection.msgtype)


def _column(read: Callable[[], Columns], field: str) -> Load:
    return lambda: read()[field]


def _topic_values(path: Path, topic: str) -> Columns:
    """Values of every field of a topic, and under "" its time [ns]."""
    rows: list[tuple[Any, ...]] = []
    recorded: list[int] = []
    with _opened(path) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        names: list[str] | None = None
        for connection, instant, raw in reader.messages(connections=connections):
            message = reader.deserialize(raw, connection.msgtype)
            values = dict(_values(message))
            if names is None:
                names = list(values)
            if len(values) != len(names):
                odd_name = next((n for n in (*names, *values) if (n in values) != (n in names)), "")
                longer = len(values) > len(names)
                raise BadData(
                    f"{path.name}, {topic}.{odd_name}: message {len(rows) + 1} has {'more' if longer else 'fewer'} "
                    "elements than the first; expected arrays of one length in every message"
                )
            rows.append(tuple(values[n] for n in names if n in values))
            recorded.append(instant)
    columns = {n: np.array(column) for n, column in zip(names or [], zip(*rows, strict=True), strict=True)}
    stamps = columns.pop(_STAMP, None)
    received = np.array(recorded, np.int64)
    if stamps is None or not (stamps > 0).all() or np.median(np.abs(stamps - received)) > _APART:
        return columns | {"": received}  # simulated stamps, or none
    return columns | {"": stamps}


def _values(message: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    for field in message.__dataclass_fields__:
        if field.startswith("__"):
            continue
        value = getattr(message, field)
        field_path = f"{at}.{field}" if at else field
        if hasattr(value, "sec") and hasattr(value, "nanosec"):
            yield field_path, value.sec * 1_000_000_000 + value.nanosec
        elif hasattr(value, "__dataclass_fields__"):
            yield from _values(value, field_path)
        elif isinstance(value, list | tuple | np.ndarray):
            if len(value) > ELEMENTS:
                continue
            for k, element in enumerate(value):
                if hasattr(element, "__dataclass_fields__"):
                    yield from _values(element, f"{field_path}[{k}]")
                else:
                    yield f"{field_path}[{k}]", element
        else:
            yield field_path, value
