"""Sample logs in every format that is read, each made of the same arrays by the format's own writer."""

import json
import struct

import numpy as np

#: Two rates: a motor's supply and current at 100 Hz, its speed at 40 Hz.
FAST, SLOW = 100, 40


def fast(seconds=2.0):
    """Time [s], voltage [V] and current [A] of a staircase, at `FAST` Hz."""
    t = np.arange(round(seconds * FAST)) / FAST
    volts = 6.0 + 6.0 * np.floor(2 * t)
    return {"t": t, "volts": volts, "amps": 0.1 * volts + 0.01 * np.sin(40 * t)}


def slow(seconds=2.0):
    """Time [s] and speed [rpm], at `SLOW` Hz, from 5 ms on."""
    t = 0.005 + np.arange(round(seconds * SLOW)) / SLOW
    return {"t": t, "rpm": 100.0 * np.floor(2 * t) + 50.0 + np.sin(9 * t)}


def table():
    """One table of the signals at `FAST` Hz."""
    return {**fast(), "rpm": np.interp(fast()["t"], *slow().values())}


def _arrow(columns):
    import pyarrow as pa

    units = {"t": "s", "volts": "V", "amps": "A", "rpm": "rpm"}
    fields = [pa.field(n, pa.float64(), metadata={"unit": units[n]}) for n in columns]
    return pa.table({n: pa.array(v) for n, v in columns.items()}, schema=pa.schema(fields))


def parquet(path, columns):
    from pyarrow import parquet as writer

    writer.write_table(_arrow(columns), path)


def feather(path, columns):
    from pyarrow import feather as writer

    writer.write_feather(_arrow(columns), str(path))


def arrow(path, columns):
    import pyarrow as pa

    made = _arrow(columns)
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_stream(sink, made.schema) as writer:
        writer.write_table(made)


def npz(path, columns):
    np.savez_compressed(path, **columns)


def json_records(path, columns):
    rows = [dict(zip(columns, map(float, row), strict=True)) for row in zip(*columns.values(), strict=True)]
    path.write_text(json.dumps(rows))


def json_arrays(path, columns):
    path.write_text(json.dumps({"rig": {"motor": {n: v.tolist() for n, v in columns.items()}}}))


def mat5(path, columns):
    from scipy import io

    io.savemat(path, {"log": columns})


def hdf5(path, fast_signals, slow_signals):
    import h5py

    with h5py.File(path, "w") as file:
        for group, signals in (("drive", fast_signals), ("encoder", slow_signals)):
            for name, values in signals.items():
                file.create_dataset(f"{group}/{name}", data=values)
        file["encoder/rpm"].attrs["units"] = "rpm"


def mat73(path, columns):
    """As MATLAB writes it: HDF5 below a block of 512 bytes, columns of a matrix as rows."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values[None, :]).attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H2s", 0x0200, b"IM"))


#: Topics of bags, and types of their messages.
TOPICS = {
    "/volts": "std_msgs/msg/Float64", "/drive/amps": "std_msgs/msg/Float64", "/joint_states": "sensor_msgs/msg/JointState",
}  # fmt: skip


def _write_messages(writer, store, serialize, fast_signals, slow_signals, header, lose=False):
    """Messages of both rates into a bag in the order of time. `header` of a time [s] and [ns]."""
    links = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in TOPICS.items()}
    number, joint = (store.types[TOPICS[topic]] for topic in ("/volts", "/joint_states"))
    found, empty, last = [], np.zeros(0), slow_signals["t"][-1]
    for t, v, a in zip(*fast_signals.values(), strict=True):
        found += [("/volts", t, number(v)), ("/drive/amps", t, number(a))]
    for t, rpm in zip(*slow_signals.values(), strict=True):
        rates = np.array([0.0, 0.0, rpm])[: 2 if lose and t == last else 3]
        stamp = header(*divmod(BEGIN * 10**9 + round(t * 1e9), 10**9))
        found.append(("/joint_states", t, joint(stamp, ["a", "b", "c"], empty, rates, empty)))
    for topic, t, message in sorted(found, key=lambda each: each[1]):
        writer.write(links[topic], BEGIN * 10**9 + round(t * 1e9), serialize(message, links[topic].msgtype))


#: When the bags begin [s since 1970].
BEGIN = 1_700_000_000


def ros1(path, fast_signals, slow_signals):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    with Writer(path) as writer:
        _write_messages(writer, store, store.serialize_ros1, fast_signals, slow_signals,
                        lambda s, ns: header(0, time(s, ns), ""))  # fmt: skip


def mcap(path, fast_signals, slow_signals):
    ros2(path, fast_signals, slow_signals, as_mcap=True)


def ros2(path, fast_signals, slow_signals, as_mcap=False, lose=False):
    """The last message of the joints has one joint less with `lose`."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    plugin = StoragePlugin.MCAP if as_mcap else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        _write_messages(writer, store, store.serialize_cdr, fast_signals, slow_signals,
                        lambda s, ns: header(time(s, ns), ""), lose)  # fmt: skip


def ulog(path, fast_signals, slow_signals):
    """By the definition of the format (PX4 guide, ULog file format), since pyulog writes only what it has read."""

    def message(kind, body):
        return struct.pack("<HB", len(body), kind[0]) + body

    written = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000)
    written += message(b"B", bytes(40))
    written += message(b"F", b"battery_status:uint64_t timestamp;float voltage_v;float current_a;")
    written += message(b"F", b"rpm:uint64_t timestamp;float rpm_estimate;")
    written += message(b"A", struct.pack("<BH", 0, 0) + b"battery_status")
    written += message(b"A", struct.pack("<BH", 0, 1) + b"rpm")
    for t, *values in zip(*fast_signals.values(), strict=True):
        written += message(b"D", struct.pack("<HQff", 0, 1_000_000 + round(1e6 * t), *values))
    for t, *values in zip(*slow_signals.values(), strict=True):
        written += message(b"D", struct.pack("<HQf", 1, 1_000_000 + round(1e6 * t), *values))
    path.write_bytes(written)


def mdf(path, fast_signals, slow_signals):
    from asammdf import MDF, Signal

    units = {"volts": "V", "amps": "A", "rpm": "rpm"}
    with MDF(version="4.10") as file:
        for signals in (fast_signals, slow_signals):
            time, *_ = signals.values()
            file.append([Signal(v, time, name=n, unit=units[n]) for n, v in signals.items() if n != "t"])
        file.save(path)
