"""Malformed data at every reader: mutated bytes, declared sizes, names, masks and faults. Each is read, or refused in
one short sentence, in bounded time and memory.

Mutations are drawn from a seeded generator.
"""

import contextlib
import io
import json
import os
import resource
import struct
import time
import zipfile

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
import samples
import xarray as xr
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pyarrow import feather, parquet
from test_more_formats import sysid_log, wpilog, write_xlsx
from test_sources import COLUMNS, RIG

from calibration.data import input_files, robot_file
from calibration.data.contents import inspect_source
from calibration.data.input_errors import InputError
from calibration.data.runs import read_runs
from mmrjax.errors import LONGEST
from sweeps.commands.rig_new import joint_numbers, new_rig_text
from tests.commands import Hangs, alarmed, text_file

#: Most processor time of one answer [s], and memory that it may take [bytes].
SECONDS, MEMORY = 5.0, 2**31
#: Mutations of each file.
EACH = 16


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return robot_file.read_robot(text_file(tmp_path_factory.mktemp("rig") / "rig.toml", RIG))


@contextlib.contextmanager
def bounded():
    """Limits of time and memory around one answer."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as stream:
        used = int(stream.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    with alarmed():
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def asked(*questions):
    """What is wrong with the answers to some questions, empty if nothing is, and the refusals."""
    wrong, refused = [], []
    for question in questions:
        began = time.process_time()
        try:
            with bounded():
                question()
        except InputError as error:
            refused.append(message := str(error))
            wrong += [f"{len(message)} characters"] * (len(message) > LONGEST)
            try:
                message.encode()
            except UnicodeEncodeError:
                wrong.append("not in UTF-8")
        except (Exception, Hangs) as error:
            wrong.append(f"{type(error).__name__}: {str(error)[:200]}")
        took = time.process_time() - began
        wrong += [f"{took:.1f} s"] * (took > SECONDS)
    return wrong, refused


def doors(source, robot):
    """Both ways into the readers: a list of what is in a file, and its columns as runs."""

    def inspect():
        json.dumps(inspect_source(source).to_json(), ensure_ascii=False).encode()

    def read():
        table = read_runs(source, robot, columns=COLUMNS)
        "".join(note for note in table.notes).encode()

    return inspect, read


# --- mutated bytes ----------------------------------------------------------------------------------------------------


def sheet(path, columns):
    write_xlsx(path, Log=[[*columns], *map(list, zip(*(v.tolist() for v in columns.values()), strict=True))])


def csv(path, columns):
    pd.DataFrame(columns).to_csv(path, index=False)


TABLES = {
    "log.csv": csv, "log.parquet": samples.parquet, "log.feather": samples.feather, "log.arrows": samples.arrow,
    "log.npz": samples.npz, "log.npy": lambda p, c: np.save(p, np.rec.fromarrays([*c.values()], names=[*c])),
    "records.json": samples.json_records, "arrays.json": samples.json_arrays, "v5.mat": samples.mat5,
    "v73.mat": samples.mat73, "log.xlsx": sheet,
}  # fmt: skip
LOGS = {
    "log.h5": samples.hdf5, "log.mf4": samples.mdf, "log.ulg": samples.ulog, "log.bag": samples.ros1,
    "ros2": samples.ros2, "mcap": samples.mcap,
}  # fmt: skip
FORMATS = [*TABLES, *LOGS, "robot.wpilog"]


def write(folder, name):
    """Writes a valid file. Returns the path to read, and the path of the bytes to damage."""
    path = folder / name
    if name in TABLES:
        TABLES[name](path, samples.table())
    elif name in LOGS:
        LOGS[name](path, samples.fast(0.4), samples.slow(0.4))
    else:
        path.write_bytes(wpilog(*sysid_log()))
    inner = sorted(path.glob("*.db3")) + sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    return path, inner[0]


def mutated(content, rng):
    """The bytes after one mutation."""
    content, size = bytearray(content), len(content)
    at, length = int(rng.integers(size)), int(rng.integers(1, 40))
    how = rng.integers(8)
    if how == 0:
        return bytes(content[:at])
    if how == 1:
        for k in rng.integers(size, size=4):
            content[k] ^= 1 << rng.integers(8)
    elif how == 2:
        content[at : at + length] = rng.bytes(length)
    elif how == 3:  # a size that is far too large
        content[at : at + 8] = b"\xff\xff\xff\xff\xff\xff\xff\x7f"
    elif how == 4:
        content[at : at + 4] = struct.pack("<I", 2**31 - 1)
    elif how == 5:
        content[at:at] = content[at : at + length]
    elif how == 6:
        del content[at : at + length]
    else:
        head = min(512, size)  # headers are where sizes are
        for k in rng.integers(head, size=3):
            content[k] = int(rng.integers(256))
    return bytes(content)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_mutated_bytes_are_read_or_refused_in_a_sentence(tmp_path, robot, name):
    path, damaged = write(tmp_path, name)
    wrong, refused = asked(*doors(path, robot)[:1])
    assert not wrong and not refused
    content, rng = damaged.read_bytes(), default_rng([69, FORMATS.index(name)])
    failures, refusals = [], 0
    for k in range(EACH):
        damaged.write_bytes(mutated(content, rng))
        wrong, refused = asked(*doors(path, robot))
        failures += [f"{k}: {each}" for each in wrong]
        refusals += bool(refused)
    assert not failures, "\n".join(failures)
    assert refusals > EACH // 4  # else nothing was attacked


# --- declared sizes ---------------------------------------------------------------------------------------------------


def npy_header(shape, descr):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def npy(shape, descr="<f8"):
    return lambda path: path.write_bytes(npy_header(shape, descr) + bytes(16))


def npz(*members):
    def made(path):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in members:
                archive.writestr(f"{name}.npy", content)

    return made


def many_arrays(path):
    np.savez(path, **{f"a{k}": np.zeros(3) for k in range(25_000)})


def twice(path):
    with pytest.warns(UserWarning, match="Duplicate name"):
        npz(("a", b"x"), ("a", b"y"))(path)


def hdf5(fill):
    def made(path):
        import h5py

        with h5py.File(path, "w") as file:
            fill(file, h5py)

    return made


def paths_without_end(file, _):
    """Groups of which each holds the next under two names: 2^40 paths."""
    group = file
    for _ in range(40):
        inner = group.create_group("a")
        group["b"] = inner
        group = inner
    group["t"] = np.arange(3.0)


def bomb_mat(path):
    """A compressed variable that declares 16 GB."""
    import zlib

    inner = zlib.compress(struct.pack("<II", 14, 2**32 - 1) + bytes(1000))
    path.write_bytes(b"MATLAB 5.0".ljust(124) + struct.pack("<H2sII", 0x0100, b"IM", 15, len(inner)) + inner)


def ulog_of(fields):
    def made(path):
        body = b"big:uint64_t timestamp;" + fields
        content = b"ULog\x01\x12\x35\x01" + bytes(8) + struct.pack("<HB", 40, ord("B")) + bytes(40)
        content += struct.pack("<HB", len(body), ord("F")) + body
        content += struct.pack("<HB", 6, ord("A")) + bytes(3) + b"big"
        path.write_bytes(content)

    return made


def far_cell(path):
    """A sheet with one cell in each of two corners."""
    write_xlsx(path, A=[["t"], [1]])
    with zipfile.ZipFile(path) as archive:
        items = {name: archive.read(name) for name in archive.namelist()}
    items["xl/worksheets/s1.xml"] = items["xl/worksheets/s1.xml"].replace(b"<c><v>", b'<c r="XFD1048576"><v>')
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in items.items():
            archive.writestr(name, content)


def long_mdf(path):
    """A group that declares 10^12 samples."""
    samples.mdf(path, samples.fast(0.2), samples.slow(0.2))
    content = path.read_bytes()
    at = content.index(b"##CG") + 24 + 6 * 8 + 8
    path.write_bytes(content[:at] + struct.pack("<Q", 10**12) + content[at + 8 :])


def long_bag(path):
    samples.ros2(path, samples.fast(0.2), samples.slow(0.2))
    about = path / "metadata.yaml"
    about.write_text(about.read_text().replace("message_count: 20", f"message_count: {10**15}"))


SIZES = {
    "wide.npy": npy((2, 10**8)), "words.npy": npy((1,), "<U1000000000"),
    "negative.npy": npy((-1, 3)), "long.npz": npz(("a", npy_header((10**11,), "<f8"))),
    "bomb.npz": npz(("t", npy_header((2**29,), "<u1") + bytes(2**29))), "many.npz": many_arrays,
    "twice.npz": twice,
    "rows.h5": hdf5(lambda f, _: [f.create_dataset(n, (10**9,), "f8") for n in ("t", "volts", "amps", "rpm")]),
    "chunks.h5": hdf5(lambda f, _: f.create_dataset("t", (10**9,), "f8", chunks=(10**4,), compression="gzip")),
    "words.h5": hdf5(lambda f, _: f.create_dataset("t", (3,), "S2000000000")),
    "paths.h5": hdf5(paths_without_end),
    "rows.parquet": lambda path: parquet.write_table(pa.table({"t": np.zeros(2**26, np.int8)}), path),
    "lists.parquet": lambda path: parquet.write_table(pa.table({"t": [[0.0] * 10**6] * 2}), path),
    "bomb.mat": bomb_mat,
    "keys.json": lambda path: path.write_text(json.dumps([{f"k{k}": 1} for k in range(100_000)])),
    "plain.csv": lambda path: path.write_text("c," * 10**6 + "c\n" + "1," * 10**6 + "1\n"),
    "array.ulg": ulog_of(b"float[1000000000] x;"),
    "far.xlsx": far_cell,
    "long.mf4": long_mdf, "long_bag": long_bag,
}  # fmt: skip


@pytest.mark.quick(
    "wide.npy", "words.npy", "many.npz", "rows.h5", "paths.h5", "keys.json", "plain.csv", "array.ulg", "far.xlsx"
)
@pytest.mark.parametrize("name", SIZES)
def test_sizes_that_a_file_declares_are_refused_before_they_are_read(tmp_path, robot, name):
    SIZES[name](tmp_path / name)
    inspect, read = doors(tmp_path / name, robot)
    wrong, refused = asked(inspect)
    assert not wrong, wrong
    if not refused:  # the signal alone is refused
        facts = inspect_source(tmp_path / name).signals
        assert any(fact.refused for fact in facts) or name in ("paths.h5", "lists.parquet", "negative.npy")
    wrong, refused = asked(read)
    assert not wrong and refused, (wrong, refused)


# --- names ------------------------------------------------------------------------------------------------------------

NAMES = [
    "\ud800",
    "a\ud800.b",
    "",
    " ",
    "x" * 100_000,
    "t\n",
    "\x1b[31mred",
    "../../t",
    "a.b.c",
    "nan",
    "💥",
    "=1+1",
    "a[0]",
]


def named(folder, name):
    """Tables of two columns, one with a name, in each container and file that can hold it."""
    columns = {name: [0.0, 1.0], "rpm": [1.0, 2.0]}
    yield columns
    yield [{name: 1.0, "rpm": 2.0}] * 3
    yield xr.Dataset({k: ("row", v) for k, v in columns.items()})
    (folder / "log.json").write_text(json.dumps(columns))
    yield folder / "log.json"
    with contextlib.suppress(UnicodeEncodeError):
        name.encode()
        yield pl.DataFrame(columns)
        yield pa.table(columns)
        yield pd.DataFrame(columns)
        csv(folder / "log.csv", columns)
        yield folder / "log.csv"
        parquet.write_table(pa.table(columns), folder / "log.parquet")
        yield folder / "log.parquet"
        feather.write_feather(pa.table(columns), str(folder / "log.feather"))
        yield folder / "log.feather"


@pytest.mark.parametrize("name", NAMES, ids=range(len(NAMES)))
def test_names_of_columns_are_read_or_refused_in_a_sentence(tmp_path, robot, name):
    failures = [(source, asked(*doors(source, robot))[0]) for source in named(tmp_path, name)]
    assert len(failures) in (4, 10) and not [f for f in failures if f[1]]


@pytest.mark.parametrize("name", ["rpm", "motor_speed_rpm"])  # by a mapping, and by itself
@pytest.mark.parametrize("kind", ["pandas", "Arrow", "parquet"])
def test_two_columns_of_one_name_are_refused(tmp_path, robot, kind, name):
    table = samples.table()
    names = ["t", "volts", "amps", name, name]
    source = pd.DataFrame(np.stack([*table.values(), table["rpm"] + 1], 1), columns=names)
    if kind != "pandas":
        source = pa.table([pa.array(source.iloc[:, k]) for k in range(5)], names=names)
    if kind == "parquet":
        parquet.write_table(source, tmp_path / "log.parquet")
        source = tmp_path / "log.parquet"
    columns = {**COLUMNS, "motor_speed_rpm": name} if name == "rpm" else {**COLUMNS, "motor_speed_rpm": None}
    with pytest.raises(InputError, match=f"{name}: (has the same name as another signal|the name fits 2 signals)"):
        read_runs(source, robot, columns={k: v for k, v in columns.items() if v})


@pytest.mark.parametrize("text", ['{"t": [1], "t": [2]}', '[{"t": 1, "t": 2}]', '{"t": 1}\n{"t": 1, "t": 2}'])
def test_a_key_twice_in_json_is_refused(tmp_path, robot, text):
    (tmp_path / "log.json").write_text(text)
    wrong, refused = asked(*doors(tmp_path / "log.json", robot))
    assert not wrong and len(refused) == 2 and all("has the key t twice" in each for each in refused)


# --- masks, complex numbers, times ------------------------------------------------------------------------------------


def mdf_with_invalid_bits(path, table, lost):
    from asammdf import MDF, Signal

    time, nowhere = table["t"], np.zeros(len(table["t"]), bool)
    with MDF(version="4.10") as file:
        file.append([
            Signal(v, time, name=n, invalidation_bits=lost if n == "rpm" else nowhere)
            for n, v in table.items() if n != "t"
        ])  # fmt: skip
        file.save(path)


def with_missing(folder, table, lost):
    """The table in every container that can mark a reading as missing, with the lost reading of the speed marked."""
    masked = np.ma.masked_array(table["rpm"], lost)
    marked, listed = table | {"rpm": masked}, table | {"rpm": masked.tolist()}
    gap, filled = table | {"rpm": masked.filled(np.nan)}, table | {"rpm": masked.filled(-9999.0)}
    yield marked
    yield table | {"rpm": masked.astype(int)}
    records = np.ma.masked_array(np.rec.fromarrays([*table.values()], names=[*table]))
    records["rpm"] = masked
    yield records
    yield {"m": np.ma.stack([*map(np.ma.asarray, marked.values())], 1)}
    for dtype in ("Float64", "object", "float"):
        yield pd.DataFrame(table).assign(rpm=pd.array(listed["rpm"], dtype))
    yield pl.DataFrame(listed)
    yield pa.table(listed)
    yield xr.Dataset({n: ("row", v) for n, v in gap.items()})
    samples.json_arrays(folder / "log.json", marked)
    yield folder / "log.json"
    csv(folder / "log.csv", gap)
    yield folder / "log.csv"
    mdf_with_invalid_bits(folder / "log.mf4", table, lost)
    yield folder / "log.mf4"

    def fill(file, _):
        for n, v in filled.items():
            file[n] = v
        file["rpm"].attrs["_FillValue"] = -9999.0

    hdf5(fill)(folder / "log.h5")
    yield folder / "log.h5"
    sheet(folder / "log.xlsx", marked)
    yield folder / "log.xlsx"


def test_a_masked_reading_is_missing_in_every_container(tmp_path, robot):
    table = samples.table()
    lost = np.arange(len(table["t"])) == 7
    sources = [*with_missing(tmp_path, table, lost)]
    for source in sources:
        columns = COLUMNS
        if isinstance(source, dict) and "m" in source:
            columns = {mine: f"m[{k}]" for k, mine in enumerate(COLUMNS)}
        elif str(source).endswith("mf4"):
            columns = COLUMNS | {"time_s": "time_s"}
        found = read_runs(source, robot, columns=columns)["motor_speed_rpm"]
        assert_array_equal(np.isnan(found), lost, str(source))
        assert_allclose(found[~lost], table["rpm"][~lost], atol=1)  # of integers
    assert len(sources) == 15


def with_complex(folder, table):
    from scipy import io as matlab

    wave = table | {"rpm": table["rpm"] * 1j}
    yield wave
    yield pd.DataFrame(wave)
    np.savez(folder / "log.npz", **wave)
    yield folder / "log.npz"
    matlab.savemat(folder / "log.mat", wave)
    yield folder / "log.mat"
    hdf5(lambda file, _: [file.create_dataset(n, data=v) for n, v in wave.items()])(folder / "log.h5")
    yield folder / "log.h5"


def test_complex_numbers_are_refused_by_every_reader(tmp_path, robot):
    for source in with_complex(tmp_path, samples.table()):
        _, read = doors(source, robot)
        wrong, refused = asked(read)
        assert not wrong and "rpm: holds complex numbers" in refused[0], source
        facts = {s.path.strip("/"): s for s in inspect_source(source).signals}
        assert "complex numbers" in facts["rpm"].refused


@pytest.mark.parametrize("stamp", [np.inf, -np.inf, np.nan, 1e308])
@pytest.mark.parametrize("kind", ["a dict", "CSV", "clocks"])
def test_times_that_are_not_finite_are_refused_without_a_warning(tmp_path, robot, stamp, kind):
    table = samples.table()
    table["t"][5] = stamp
    source = table
    if kind == "CSV":
        pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
        source = tmp_path / "log.csv"
    elif kind == "clocks":
        samples.hdf5(tmp_path / "log.h5", {n: v for n, v in table.items() if n != "rpm"}, samples.slow())
        source = tmp_path / "log.h5"
    inspect, read = doors(source, robot)
    wrong, refused = asked(read)
    assert not wrong and refused
    assert not asked(inspect)[0]


def test_times_without_a_date_are_listed_and_refused(tmp_path):
    import datetime

    times = [datetime.time(0, 0, k) for k in range(4)]
    parquet.write_table(pa.table({"t": times, "rpm": [1.0, 2, 3, 4]}), tmp_path / "log.parquet")
    found = inspect_source(tmp_path / "log.parquet").signals
    assert found[0].refused == "holds time64[us]; expected numbers or words" and found[1].greatest == 4


# --- faults -----------------------------------------------------------------------------------------------------------


# --- models of rigs ---------------------------------------------------------------------------------------------------

BODY = '<body name="b"><joint name="j" type="hinge" axis="0 1 0"/><geom type="cylinder" size="0.1 0.02" mass="1"/>%s</body>'
MODEL = f'<mujoco>%s<worldbody>{BODY}</worldbody><actuator><motor joint="j"/></actuator></mujoco>'
MODELS = {
    "nan": MODEL.replace('mass="1"', 'mass="nan"') % ("", ""),
    "user": MODEL % ('<size nuser_body="2000000000"/>', ""),
    "keys": MODEL % ('<size nkey="2000000000"/>', ""),
    "replicate": MODEL % ("", '<replicate count="100000000" offset="0 0 1"><geom size="0.1"/></replicate>'),
    "nested": MODEL % ("", '<replicate count="1000">' * 3 + '<geom size="0.1"/>' + "</replicate>" * 3),
    "composite": MODEL % ("", '<composite type="cable" count="100000 1 1" curve="s" size="1"/>'),
    "numeric": MODEL % ('<custom><numeric name="n" size="2000000000"/></custom>', ""),
    "texture": MODEL % ('<asset><texture name="t" type="2d" builtin="flat" width="100000" height="100000"/></asset>', ""),
    "hfield": MODEL % ('<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>', ""),
    "include": MODEL % ('<include file="pipe"/>', ""),
    "mesh": MODEL % ('<asset><mesh name="m" file="pipe.obj"/></asset>', ""),
    "hfield file": MODEL % ('<asset><hfield name="h" file="pipe.png" size="1 1 1 1"/></asset>', ""),
    "mesh in a folder": MODEL % ('<compiler meshdir="in"/><asset><mesh name="m" file="pipe.obj"/></asset>', ""),
    "includes": MODEL % ('<include file="model.xml"/>', ""),
}  # fmt: skip


@pytest.mark.parametrize("kind", MODELS)
def test_models_that_mujoco_does_not_end_with_are_refused(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    for pipe in ("pipe", "pipe.obj", "pipe.png", "in/pipe.obj"):
        os.mkfifo(tmp_path / pipe)
    (tmp_path / "model.xml").write_text(MODELS[kind])
    before = set(os.listdir())
    wrong, refused = asked(lambda: joint_numbers(tmp_path / "model.xml", None))
    assert not wrong and refused and set(os.listdir()) == before, wrong


def test_a_sound_model_is_read_and_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.xml").write_text('<mujoco><option timestep="0.001"/></mujoco>')
    assert (
        joint_numbers(
            text_file(
                tmp_path / "model.xml", MODEL % ('<size njmax="5000" nconmax="2000"/><include file="part.xml"/>', "")
            ),
            None,
        ).joint
        == "j"
    )
    assert sorted(os.listdir()) == ["model.xml", "part.xml"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["model.xml", "robot.urdf"])
def test_mutated_models_are_read_or_refused_in_a_sentence(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    text = MODEL % ("", "") if kind == "model.xml" else URDF
    rng, failures = default_rng([70, len(kind)]), []
    for k in range(4 * EACH):
        (tmp_path / kind).write_bytes(mutated(text.encode(), rng))
        wrong, _ = asked(lambda: new_rig_text(None, tmp_path / kind, None, None))
        failures += [f"{k}: {each}" for each in wrong]
    assert not failures, "\n".join(failures)
    assert os.listdir() == [kind]


URDF = """<robot name="r"><link name="base"><inertial><mass value="5"/></inertial></link><link name="wheel"><inertial>
<mass value="0.3"/><inertia ixx="1e-4" iyy="1e-4" izz="2e-4" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>
<cylinder radius="0.05" length="0.02"/></geometry></collision></link><joint name="j" type="continuous">
<parent link="base"/><child link="wheel"/><axis xyz="0 0 1"/><dynamics damping="0.1" friction="0.02"/></joint></robot>"""


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("fault", ["gone", "cut", "replaced"])
def test_a_file_that_changes_after_it_was_listed_is_refused_or_read(tmp_path, robot, name, fault, monkeypatch):
    path, damaged = write(tmp_path, name)
    content = damaged.read_bytes()

    def spoil(*_):
        if fault == "gone":
            damaged.unlink(missing_ok=True)
        else:
            damaged.write_bytes(content[: len(content) // 2] if fault == "cut" else b"\0" * 64)

    honest = input_files.check_memory
    monkeypatch.setattr(input_files, "check_memory", lambda *a: (spoil(), honest(*a)))
    wrong, _ = asked(*doors(path, robot))
    assert not wrong, wrong
