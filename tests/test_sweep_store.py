"""Sweeps into a store: what xarray reads, resumption bit by bit, shares, devices, and what is refused."""

import contextlib
import errno
import json
import os
import shutil
import subprocess
import sys
import tomllib
import zlib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose, assert_array_equal
from test_cli import MMRJAX

from calibration.data.input_errors import BadConfiguration, BadData
from mmrjax.model import paper_robots, params
from mmrjax.model.signals import STATUSES
from sweeps.commands import sweep as command
from sweeps.config_campaign import Campaign
from sweeps.points import axes, scale, zarr_store
from sweeps.points.job import prepare_job, store_layout
from sweeps.points.tasks import task_of_configuration
from sweeps.store import LOCK, MANIFEST, RunFolder
from tests.commands import ROOT, ends, read_json, refused, rows
from tests.commands import command as run_command

CONFIG = """report = false
chunk = 40
[conditions]
payload = 3
[axes]
configuration = "all"
slope_deg = [0, 5, 20]
[samples]
design = "latin_hypercube"
number = 50
seed = 7
[samples.over]
"motor.resistance" = "prior"
voltage = {distribution = "uniform", low = 15, high = 33}
"""
POINTS, CHUNKS = 300, 12
#: Four devices, compiled as these tests are.
FOUR = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4".strip()


@pytest.fixture
def sweep(mmrjax, tmp_path):
    """Sweep the configuration above, or another, into a folder. Returns exit code, stdout and stderr."""
    (tmp_path / "plan.toml").write_text(CONFIG)

    def command(out, *options, config=None):
        if config is not None:
            (tmp_path / "plan.toml").write_text(config)
        return mmrjax("sweep plan.toml --out", out, *options)

    return command


def arrays(folder):
    """Bytes of every file of a store."""
    store = Path(folder) / zarr_store.STORE
    return {str(f.relative_to(store)): f.read_bytes() for f in sorted(store.rglob("*")) if f.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The store that the configuration above gives when nothing goes wrong."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "plan.toml").write_text(CONFIG)
    with contextlib.chdir(folder):
        assert run_command(["sweep", "plan.toml", "--out", "s"]) == 0  # some slide
    return folder / "s"


# --- what is left -------------------------------------------------------------------------------------------


def test_store_is_opened_by_xarray_with_units_and_long_names(whole, robot):
    found = xr.open_zarr(whole / zarr_store.STORE)
    assert dict(found.sizes) == {"configuration": 2, "slope_deg": 3, "sample": 50}
    assert found["configuration"].values.tolist() == ["6T2A", "4W2T"]
    assert found["slope_deg"].values.tolist() == [0, 5, 20]
    assert {"motor.resistance", "voltage"} <= set(found.coords)
    units = {name: found[name].attrs.get("units") for name in (*found.data_vars, *found.coords)}
    assert units == {
        "total_current": "A", "motor_speed": "rpm", "speed": "mm/s", "status": None, "configuration": None,
        "slope_deg": "deg", "motor.resistance": "Ohm", "voltage": "V",
    } | {"motor.resistance": next(p.spec.unit for p in params.walk_parameters(robot) if p.name == "motor.resistance")}  # fmt: skip
    assert all(found[name].attrs["long_name"] for name in units)
    meanings = dict(zip(found.status.attrs["flag_values"], found.status.attrs["flag_meanings"].split(), strict=True))
    assert [meanings[k] for k in range(len(STATUSES))] == list(STATUSES) and found.status.dtype == np.uint8


def test_result_counts_statuses_and_states_ranges(whole):
    found = xr.open_zarr(whole / zarr_store.STORE).load()
    result = read_json(whole / "result.json")
    assert result["schema"] == "mmrjax.sweep_store/1" and result["points"] == POINTS
    for code, status in enumerate(STATUSES):
        assert result["statuses"][status] == int((found.status == code).sum())
    assert result["outputs"]["total_current"] == {
        "unit": "A", "least": float(found.total_current.min()), "greatest": float(found.total_current.max()),
    }  # fmt: skip
    assert result["statuses"]["slides"] > 0
    manifest = read_json(whole / "manifest.json")
    assert manifest["statuses"] == result["statuses"] and manifest["seed"] == 7


@pytest.mark.slow
def test_large_grid_of_options_leaves_a_store_with_the_numbers_of_the_table(mmrjax, tmp_path, monkeypatch):
    """Above the limit: no runs.csv, which is said. The same command with --export csv writes it, simulating nothing."""
    grid = ["sweep", "--slopes", "0,5,20", "--voltages", "24", "--payloads", "0,3", "--no-report"]
    monkeypatch.setattr("sweeps.commands.sweep.MAX_TABLE_RUNS", 12)
    small, _, _ = mmrjax(*grid, "--out", "small")
    assert small == 0  # some slide
    assert (tmp_path / "small/runs.csv").exists() and not (tmp_path / "small" / zarr_store.STORE).exists()
    monkeypatch.setattr("sweeps.commands.sweep.MAX_TABLE_RUNS", 11)
    code, out, said = mmrjax(*grid, "--out", "large")
    assert code == small and out.splitlines()[-1] == "large"
    assert "12 points: too many for runs.csv (11), see results.zarr" in said
    assert "--export csv" in said
    assert mmrjax(*grid, "--out", "large", "--export", "csv")[0] == small
    table, exported = (rows(tmp_path / name / "runs.csv") for name in ("small", "large"))
    assert set(exported[0]) < set(table[0])
    for column in set(exported[0]) - {"configuration", "status"}:
        one, other = ([float(row[column] or "nan") for row in t] for t in (table, exported))
        assert_allclose(one, other, rtol=1e-8, err_msg=column)


def test_exports_hold_the_store_row_by_row(sweep, tmp_path, whole):
    from pyarrow import csv as arrow
    from pyarrow import parquet

    _, out, _ = ends(sweep("s", "--export", "csv", "--export", "parquet"), "300/300", "/s", "runs.parquet", code=0)
    assert "slides" in out and "above the adhesion limit μ_s N" in " ".join(out.split())
    found = xr.open_zarr(tmp_path / "s" / zarr_store.STORE).load()
    one, other = parquet.read_table(tmp_path / "s/runs.parquet"), arrow.read_csv(tmp_path / "s/runs.csv")
    assert one.column_names == other.column_names == [
        "configuration", "slope_deg", "motor.resistance", "supply_voltage_V",
        "total_current_A", "motor_speed_rpm", "speed_mm_s", "status",
    ]  # fmt: skip
    assert one.num_rows == other.num_rows == POINTS
    for table in (one, other):
        speed = table["speed_mm_s"].to_numpy()
        assert_array_equal(speed, found.speed.values.ravel())
        assert table["status"].to_pylist() == [STATUSES[k] for k in found.status.values.ravel()]
        assert_array_equal(table["supply_voltage_V"].to_numpy()[:50], found.voltage.values)
        assert table["configuration"].to_pylist() == ["6T2A"] * 150 + ["4W2T"] * 150
    assert one["speed_mm_s"].null_count > 0  # a run that slides has no speed


@pytest.mark.slow
def test_outputs_storage_and_compression_are_as_stated(sweep, tmp_path, whole):
    config = 'outputs = ["slip", "efficiency_motor", "flags"]\nstorage = "float32"\ncompression = "zstd"\n' + CONFIG
    assert sweep("s", config=config)[0] == 0
    found = xr.open_zarr(tmp_path / "s" / zarr_store.STORE).load()
    assert set(found.data_vars) == {"slip", "efficiency_motor", "flags", "status"}
    assert found.slip.dtype == np.float32 and found.flags.dtype == np.uint16
    assert (found.status.values == xr.open_zarr(whole / zarr_store.STORE).status.values).all()
    assert found.slip.attrs == {"units": "1", "long_name": "slip"}
    assert found["motor.resistance"].dtype == np.float64


@pytest.mark.slow
def test_resolved_configuration_and_robot_repeat_the_sweep(sweep, whole, tmp_path):
    assert sweep("s", config=(whole / "config.resolved.toml").read_text())[0] == 0
    assert sweep("t", "--robot", tmp_path / "s/robot.toml")[0] == 0
    assert arrays("s") == arrays(whole) == arrays("t")


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [7, 1000])
def test_chunks_change_no_sample_and_results_by_1e_12(sweep, whole, tmp_path, chunk):
    assert sweep("s", "--chunk", chunk)[0] == 0
    compare(tmp_path / "s", whole)


def compare(one, other, rtol=1e-12):
    one, other = (xr.open_zarr(f / zarr_store.STORE).load() for f in (one, other))
    for name in other.coords:
        assert np.array_equal(one[name], other[name]), name
    assert np.array_equal(one.status, other.status)
    for name in other.data_vars:
        assert_allclose(one[name], other[name], rtol=rtol, err_msg=name)


def test_finished_sweep_is_not_simulated_again(sweep, monkeypatch, tmp_path):
    assert sweep("s")[0] == 0
    monkeypatch.setattr(scale, "CompiledJob", None)
    _, out, _ = ends(sweep("s", "--export", "parquet"), code=0)
    assert out.splitlines()[-1] == "s" and (tmp_path / "s/runs.parquet").is_file()
    ends(
        sweep("s", config=CONFIG.replace("seed = 7", "seed = 8")),
        "s contains another sweep, which differs in configuration (samples.seed was 7, is 8)",
    )


@pytest.mark.slow
@pytest.mark.parametrize("model, options", [("drive", "duration_s = 0.5"), ("track", "duration_s = 0.01")])
def test_every_fidelity_is_swept_over_parameters(sweep, tmp_path, model, options):
    config = (
        f'model = "{model}"\n{options}\nreport = false\nchunk = 2\n[axes]\n"motor.resistance" = [0.6, 0.9, 1.2]\n'
        '[conditions]\nslope_deg = 5\nconfiguration = "6T2A"\n'
    )
    if model == "track":
        config = 'outputs = ["speed", "guide_share"]\n' + config
    sweep("s", config=config)
    found = xr.open_zarr(tmp_path / "s" / zarr_store.STORE).load()
    assert found.speed.dims == ("motor.resistance",) and np.isfinite(found.speed).all()
    assert len(set(found.speed.values.tolist())) == 3
    if model == "track":
        assert ((found.guide_share > 0) & (found.guide_share < 1)).all()


@pytest.mark.slow
def test_track_step_that_a_corner_cannot_bear_is_refused_before_the_first_run(sweep, tmp_path):
    config = (
        'model = "track"\nduration_s = 0.01\nstep_s = 1e-3\n[axes]\n"running_gear.contact_stiffness" = [3e7, 3e9]\n'
    )
    ends(sweep("s", config=config), "--model track: at running_gear.contact_stiffness 3e+09: step: got 0.001 s")
    assert not list(tmp_path.glob("s*"))


# --- resumption ---------------------------------------------------------------------------------------------


def stopping(monkeypatch, at, error):
    """Let the writing of files fail from the `at`-th on."""
    honest, count = zarr_store.write_file, iter(range(10**9))

    def write(path, content, aside):
        if next(count) >= at:
            raise error
        honest(path, content, aside)

    monkeypatch.setattr(zarr_store, "write_file", write)
    return lambda: monkeypatch.setattr(zarr_store, "write_file", honest)


FULL = OSError(errno.ENOSPC, "No space left on device")
STOPS = {
    130: (KeyboardInterrupt(), "continues after the last complete chunk"),
    2: (FULL, "s.partial: No space left on device after 5 of 12 chunks. Free some space"),
}


@pytest.mark.quick("2-130", "25-2")
@pytest.mark.parametrize("at, code", [(2, 130), (6, 130), (7, 130), (20, 130), (25, 2), (40, 130)])
def test_interrupted_sweep_goes_on_to_the_same_bits(sweep, whole, monkeypatch, tmp_path, at, code):
    error, said = STOPS[code]
    heal = stopping(monkeypatch, at, error)
    ends(sweep("s"), said, code=code)
    assert not (tmp_path / "s").exists()
    heal()
    computed, honest = [], scale.CompiledJob.__call__
    monkeypatch.setattr(scale.CompiledJob, "__call__", lambda *a: (computed.append(1), honest(*a))[1])
    _, _, err = ends(sweep("s"), code=0)
    assert not (tmp_path / "s.partial").exists()
    done = CHUNKS - len(computed)
    assert (done > 0) == ("resumes after" in err) == (at > 6)
    assert arrays("s") == arrays(whole)


def test_interrupt_before_a_chunk_is_done_leaves_nothing(sweep, monkeypatch, tmp_path):
    stopping(monkeypatch, 1, KeyboardInterrupt())
    assert sweep("s")[0] == 130 and not list(tmp_path.glob("s*"))


class FullDisk:
    """A journal on a disk that is full from its third line on."""

    def __init__(self, file):
        self.file, self.lines = file, 0

    def write(self, text):
        self.lines += 1
        self.file.write(text if self.lines < 3 else text[: len(text) // 2])

    def flush(self):
        self.file.flush()
        if self.lines >= 3:
            raise FULL

    def close(self):
        self.file.close()
        raise FULL

    def fileno(self):
        return self.file.fileno()


def test_full_disk_of_the_journal_loses_no_more_than_its_chunk(sweep, whole, monkeypatch):
    honest = zarr_store.SweepStore.begin

    def begin(store, shard):
        honest(store, shard)
        store._journal = FullDisk(store._journal)

    monkeypatch.setattr(zarr_store.SweepStore, "begin", begin)
    ends(sweep("s"), "No space left on device after 2 of 12 chunks")
    monkeypatch.setattr(zarr_store.SweepStore, "begin", honest)
    assert sweep("s")[0] == 0
    assert arrays("s") == arrays(whole)


def test_failing_write_leaves_no_file_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(FULL))
    with pytest.raises(OSError, match="No space"):
        zarr_store.write_file(tmp_path / "c", b"abc", tmp_path / "aside")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def begun(sweep, monkeypatch, tmp_path):
    """A sweep with the robot of a file, stopped in the middle."""
    assert sweep("first", "--chunk", "300")[0] == 0
    shutil.copy(tmp_path / "first/robot.toml", tmp_path / "robot.toml")
    heal = stopping(monkeypatch, 30, KeyboardInterrupt())
    assert sweep("s", "--robot", "robot.toml")[0] == 130
    heal()
    return lambda *options: sweep("s", "--robot", "robot.toml", *options)


@pytest.mark.slow
def test_sweep_of_other_data_code_or_versions_is_refused_saying_which(begun, monkeypatch, tmp_path):
    robot = tmp_path / "robot.toml"
    text = robot.read_text()
    robot.write_text(text + "\n# another day\n")
    ends(begun(), "differs in data (robot.toml);")
    robot.write_text(text)
    with monkeypatch.context() as patch:
        patch.setattr(zarr_store, "source_hash", lambda: "other")
        ends(begun(), "differs in code (source);")
    real = zarr_store.installed_versions
    monkeypatch.setattr(zarr_store, "installed_versions", lambda packages: {**real(packages), "jax": "0.9.9"})
    ends(begun(), "differs in versions (jax was ", ", is 0.9.9);")
    monkeypatch.setattr(zarr_store, "installed_versions", real)
    monkeypatch.setattr(scale, "device_kind", lambda: "cpu: another")
    _, _, err = ends(begun(), "differs in device")
    assert "differs in device (device was 'cpu: cpu'" not in err
    monkeypatch.undo()


def test_identity_differences_are_few_words():
    old = {"configuration": {"a": "1", "b": "2", "c": "3", "d": "4"}, "code": {"x.py": "0"}}
    new = {"configuration": {"a": "2", "b": "3", "c": "4", "e": "5"}, "code": {"x.py": "1"}}
    said = zarr_store.identity_differences(old, new)
    assert said == "configuration (a was 1, is 2, b was 2, is 3, c was 3, is 4 and 2 more); code (x.py)"
    assert zarr_store.identity_differences(old, old) == ""


# --- shares -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_shares_make_the_same_store_in_any_order(sweep, whole, tmp_path):
    for k in (3, 1):
        ends(sweep("s", "--shard", f"{k}/3"), "chunks of s.partial are finished. The last share", code=0)
    assert not (tmp_path / "s").exists()
    _, out, _ = ends(sweep("s", "--shard", "2/3"), code=0)
    assert out.splitlines()[-1] == "s"
    assert arrays("s") == arrays(whole)
    assert sweep("s", "--shard", "1/3")[0] == 0  # a job of the array that comes late


@pytest.mark.slow
def test_shares_started_at_once_finish_one_store(whole, tmp_path):
    (tmp_path / "plan.toml").write_text(CONFIG)
    running = [
        subprocess.Popen(
            [*MMRJAX, "sweep", "plan.toml", "--out", "s", "--shard", f"{k}/4"], cwd=tmp_path, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )
        for k in (1, 2, 3, 4)
    ]  # fmt: skip
    ended = [(process.communicate(), process.returncode) for process in running]
    assert {code for _, code in ended} == {0}, ended
    assert arrays(tmp_path / "s") == arrays(whole) and not (tmp_path / "s.partial").exists()


def test_shares_hold_every_chunk_once():
    for chunks, n in ((12, 5), (3, 8), (7, 7), (1000, 3)):
        held = [c for k in range(1, n + 1) for c in command.chunks_of_shard((k, n), chunks)]
        assert held == list(range(chunks))


@pytest.fixture(scope="module")
def layout():
    """Three chunks of one point each."""
    return laid_out_of(axes={"voltage": [15, 24, 33]}, chunk=1, outputs=("speed",))


@pytest.fixture
def opened(layout, tmp_path):
    """Open the store `s` as one more process would. `seed` is its identity."""
    stores = []

    def open_store(seed=0, force=False):
        identity = {"configuration": {"seed": str(seed)}}
        stores.append(zarr_store.SweepStore(tmp_path / "s", identity, layout, force=force))
        return stores[-1]

    yield open_store
    for store in stores:
        store.close()


def written(store, *chunks, speed=1.0):
    for chunk in chunks:
        store.write(chunk, {"speed": np.array([speed]), "status": np.array([0])}, None)


def test_refused_second_process_leaves_the_store_of_the_first(opened):
    first, second = opened(), opened()
    first.begin()
    with refused(r"another process is using \S*s\.partial, share 1 of 1; wait", BadConfiguration):
        second.begin()
    second.abandon()
    written(first, 0)
    assert set(opened().done()) == {0}


def test_store_is_not_abandoned_while_a_share_is_at_work(opened, tmp_path):
    share, rest = opened(), opened()
    share.begin((2, 3))
    rest.begin()
    rest.abandon()
    assert (tmp_path / "s.partial/identity.json").is_file()
    share.close()
    rest.abandon()
    assert not list(tmp_path.iterdir())


def test_process_whose_store_was_abandoned_meanwhile_is_told(opened):
    early, other = opened(), opened()
    other.begin()
    other.abandon()
    with refused(r"another process has removed \S*s\.partial; the same command starts again", BadConfiguration):
        early.begin()


def test_force_is_refused_while_another_process_writes(opened):
    first = opened()
    first.begin((2, 3))
    with refused(r"another process is using \S*s\.partial, share 2 of 3; wait", BadConfiguration):
        opened(seed=1, force=True)
    written(first, 1)
    assert set(opened().done()) == {1}
    first.close()
    forced = opened(seed=1, force=True)
    forced.begin()
    assert not forced.done()


def test_process_whose_store_was_replaced_meanwhile_does_not_write_into_the_new_one(opened):
    early, forced = opened(), opened(seed=1, force=True)
    with refused(r"s\.partial contains another sweep, which differs in configuration", BadConfiguration):
        early.begin()
    forced.begin()
    assert str(os.getpid()) in forced._temporary.name


@pytest.mark.parametrize("cut", range(4))
def test_replacement_killed_between_any_two_steps_is_taken_up(opened, monkeypatch, tmp_path, cut):
    def simulated(speed, **options):
        store = opened(**options)
        store.begin()
        written(store, 0, 1, 2, speed=speed)
        return store

    old = simulated(1.0)
    finished(old)
    old.close()
    forced, steps = simulated(2.0, seed=1, force=True), iter(range(100))

    def killed(honest):
        def step(path, *arguments, **options):
            if Path(path).parent.name != "writing" and next(steps) == cut:
                raise KeyboardInterrupt
            return honest(path, *arguments, **options)

        return step

    with monkeypatch.context() as patch:  # two moves, and two deletions
        patch.setattr(os, "replace", killed(os.replace))
        patch.setattr(shutil, "rmtree", killed(shutil.rmtree))
        patch.setattr(Path, "unlink", killed(Path.unlink))
        with pytest.raises(KeyboardInterrupt):
            finished(forced)
    forced.close()
    again = opened(seed=1, force=True)
    assert len(again.done()) == 3  # nothing is simulated again
    if not again.finished:
        finished(again)
    assert [p.name for p in tmp_path.iterdir()] == ["s"]
    assert not {"lock", "writing"} & {p.name for p in (tmp_path / "s").iterdir()}
    assert xr.open_zarr(tmp_path / "s" / zarr_store.STORE).speed.values.tolist() == [2.0] * 3


# --- damage ---------------------------------------------------------------------------------------------------------


def cut(file):
    file.write_bytes(file.read_bytes()[:-3])


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


HARMS = {"cut": cut, "flip": flip, "empty": lambda file: file.write_bytes(b""), "remove": Path.unlink}
DAMAGED = (
    "identity.json",
    "journal/1-of-1.jsonl",
    "zarr.json",
    "speed/zarr.json",
    "speed/c/1",
    "status/c/1",
    "voltage/c/0",
)
WHOLE = [1.0, 2.0, 3.0]


def victim(folder, name):
    return folder / name if name.startswith(("identity", "journal")) else folder / zarr_store.STORE / name


def finished(store):
    with store.finishing() as finishes:
        assert finishes
        names = ["identity.json", "journal", "manifest.json", zarr_store.STORE]
        store.write_json("manifest.json", {"schema": MANIFEST, "contents": names})
        store.move_into_place()


@pytest.mark.parametrize("name", DAMAGED)
@pytest.mark.parametrize("harm", HARMS)
def test_what_is_damaged_of_an_interrupted_sweep_is_computed_again(opened, tmp_path, capsys, name, harm):
    store = opened()
    store.begin()
    for k, speed in enumerate(WHOLE):
        written(store, k, speed=speed)
    store.close()
    HARMS[harm](victim(store.partial, name))
    if name == "identity.json" and harm != "remove":  # without one the store had not begun
        with refused(r"identity\.json is damaged; choose another path, or --force to start again"):
            opened()
        again = opened(force=True)
    else:
        again = opened()
    again.begin()
    for k in set(range(3)) - set(again.done()):
        written(again, k, speed=WHOLE[k])
    finished(again)
    assert xr.open_zarr(tmp_path / "s" / zarr_store.STORE).speed.values.tolist() == WHOLE
    assert ("damaged, so" in capsys.readouterr().err) == ("identity" not in name and "journal" not in name)
    last = opened()  # which reads the chunk's second line
    assert last.finished and len(last.done()) == 3


@pytest.mark.parametrize(
    "name, harm", [*((n, h) for n in DAMAGED for h in ("flip", "remove")), ("manifest.json", "cut")]
)
def test_what_is_damaged_of_a_finished_sweep_is_said(opened, tmp_path, name, harm):
    store = opened()
    store.begin()
    written(store, 0, 1, 2)
    finished(store)
    store.close()
    file = tmp_path / "s" / name if name == "manifest.json" else victim(tmp_path / "s", name)
    HARMS[harm](file)
    with pytest.raises((BadData, BadConfiguration), match=r"is damaged; choose another path|s exists already"):
        opened()
    if name not in ("manifest.json", "identity.json") or harm == "flip":
        return
    before = sorted(tmp_path.rglob("*"))
    with contextlib.suppress(BadConfiguration):
        opened(force=True).close()
    assert (sorted(tmp_path.rglob("*")) == before) == (name == "manifest.json")


@pytest.mark.parametrize(
    "line", ["[0]", '[0,[1],{},{"speed":1}]', "[0,1,2,3]", '["a",[],{},{}]', "[7,[1],{},{}]", "[" * 9000]
)
def test_a_forged_line_of_a_journal_counts_for_nothing(opened, line):
    store = opened()
    store.begin()
    check = f"{zlib.crc32(line.encode()):08x}"
    (store.partial / "journal/0-of-1.jsonl").write_text(f"{check} {line}\n")
    assert not store.done()
    written(store, 0, 1, 2)
    assert len(store.done()) == 3


def test_a_store_and_a_table_of_one_path_leave_each_other_alone(opened, tmp_path):
    store = opened()
    store.begin()
    written(store, 0)
    for force, why in ((False, "contains an interrupted sweep into a store"), (True, "another process is using")):
        with refused(why, BadConfiguration):
            RunFolder(tmp_path / "s", {"command": "sweep"}, force=force)
    assert len(store.done()) == 1
    store.close()
    with RunFolder(tmp_path / "s", {"command": "sweep"}, force=True) as folder:
        with refused("another process is using", BadConfiguration):
            opened(force=True)
        folder.stage("base", lambda: 1)
    with refused("contains an interrupted sweep", BadConfiguration):
        opened()
    store = opened(force=True)
    assert read_json(store.partial / LOCK)["command"] == zarr_store.COMMAND and not store.done()


# --- devices --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_four_devices_give_the_same_samples_and_results_to_1e_12(whole, tmp_path):
    (tmp_path / "plan.toml").write_text(CONFIG)
    environment = {**os.environ, "XLA_FLAGS": FOUR, "JAX_PLATFORMS": "cpu"}
    command = [*MMRJAX, "sweep", "plan.toml", "--chunk", "27", "--out", "s"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(read_json(tmp_path / "s/manifest.json")["devices"]) == 4
    compare(tmp_path / "s", whole)


@pytest.mark.slow
def test_chunk_is_split_along_the_points_among_all_devices():
    probe = (
        "import numpy as np, jax, mmrjax\n"
        "from sweeps.points import axes, scale\n"
        "from sweeps.config_campaign import Campaign\n"
        "from sweeps.points.sampled_design import Blocks\n"
        "from sweeps.points.tasks import run_task\n"
        "robot = mmrjax.nominal()\n"
        "plan = axes.plan_design(Campaign(axes={'voltage': [15, 20, 24, 28, 33]}), robot, 'x')\n"
        "job = scale.Job(robot, run_task('steady', {}, robot), plan, ('speed',), 'float64', Blocks.of((5,), 5))\n"
        "compiled = scale.CompiledJob(job)\n"
        "found = compiled(compiled.points(0))['speed']\n"
        "print(len(found.sharding.device_set), [s.data.shape for s in found.addressable_shards], tuple(found.sharding.spec))\n"
        "rows = mmrjax.Conditions(voltage=np.array([15.0, 20, 24, 28, 33]))\n"
        "job = scale.Job(robot, run_task('steady', {}, robot), axes.SweepPlan.of_rows(rows), ('speed',), 'float64', Blocks.of((5,), 5))\n"
        "compiled = scale.CompiledJob(job)\n"
        "table = compiled(compiled.points(0))['speed']\n"
        "print(len(table.sharding.device_set), bool((table == found).all()))"
    )
    environment = {**os.environ, "XLA_FLAGS": FOUR, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", probe], env=environment, capture_output=True, text=True)
    # A plan, few points of which are filled up on each device; the rows of a table.
    said = ["4 [(256,), (256,), (256,), (256,)] ('points',)", "4 True"]
    assert done.stdout.splitlines() == said, done.stderr


# --- before it starts ---------------------------------------------------------------------------------------------


def test_dry_run_states_points_chunks_bytes_and_time_and_writes_nothing(sweep, tmp_path):
    code, out, _ = sweep("s", "--dry-run")
    words = " ".join(out.split())
    assert code == 0 and "300 (2 configuration x 3 slope_deg x 50 sample)" in words
    assert "12 of 25 points on 1 x cpu" in words and "about" in words and "points/s (timed here on" in words
    assert [p.name for p in tmp_path.iterdir()] == ["plan.toml"]


def laid_out_of(**stated):
    config, robot = Campaign(**stated), paper_robots.nominal()
    config = config.model_copy(
        update={"outputs": config.outputs or task_of_configuration(config, robot).default_outputs}
    )
    return store_layout(config, prepare_job(config, robot, axes.plan_design(config, robot, "x"), "x"))


def test_full_disk_is_refused_before_anything_is_written(sweep, monkeypatch, tmp_path):
    usage = shutil.disk_usage(tmp_path)._replace(free=0)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    monkeypatch.setattr(zarr_store, "create_store", None)
    ends(sweep("s"), "results need")
    assert [p.name for p in tmp_path.iterdir()] == ["plan.toml"]


def test_size_of_a_store_is_what_it_takes(whole):
    """Also of small chunks: 12 of 25 points and 4 arrays, 2 arrays of samples, 2 axes, in blocks of 4 kB."""
    kept = [p for name in (zarr_store.STORE, "journal") for p in (whole / name, *(whole / name).rglob("*"))]
    taken = sum(4096 if p.is_dir() else -(-p.stat().st_size // 4096) * 4096 for p in kept)
    assert 0.95 * taken < laid_out_of(**tomllib.loads(CONFIG)).size < 1.1 * taken


def test_somebody_elses_folder_is_left_alone(sweep, tmp_path):
    (tmp_path / "s.partial").mkdir()
    (tmp_path / "s.partial/thesis.txt").write_text("years of work")
    ends(sweep("s"), "was not created by mmrjax")
    (tmp_path / "t").mkdir()
    (tmp_path / "t/thesis.txt").write_text("years of work")
    for force in ([], ["--force"]):
        ends(sweep("t", *force), "t exists already")
    assert (tmp_path / "s.partial/thesis.txt").is_file() and (tmp_path / "t/thesis.txt").is_file()


@pytest.mark.slow
def test_plan_of_the_page_is_accepted(mmrjax, tmp_path):
    page = (ROOT / "docs/reference/plans.md").read_text(encoding="utf-8")
    (tmp_path / "plan.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    _, out, _ = ends(mmrjax("sweep plan.toml --dry-run --chunk 1000"), code=0)
    assert "60,680,000 (2 configuration x 41 slope_deg x 37 voltage x 20 motor.friction_coulomb x 1000 sample)" in out


def test_what_is_half_written_is_not_trusted(sweep, whole, monkeypatch, tmp_path):
    heal = stopping(monkeypatch, 30, KeyboardInterrupt())
    assert sweep("s")[0] == 130
    heal()
    journal = tmp_path / "s.partial/journal/1-of-1.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    assert len(lines) > 3
    chunk = json.loads(lines[-1][9:])[0]
    journal.write_text("".join(lines[:-1]) + lines[-1][:-9])  # as if killed while it was written
    place = xr.open_zarr(tmp_path / "s.partial" / zarr_store.STORE).speed.encoding["chunks"]
    assert place == (1, 1, 25)
    where = "/".join(map(str, np.unravel_index(chunk, (2, 3, 2))))
    victim = tmp_path / "s.partial" / zarr_store.STORE / "speed/c" / where
    victim.write_bytes(victim.read_bytes()[:11])
    assert sweep("s")[0] == 0
    assert arrays("s") == arrays(whole)


def test_share_that_another_process_works_on_is_refused(sweep, tmp_path):
    assert sweep("s", "--shard", "1/3")[0] == 0
    import fcntl

    with (tmp_path / "s.partial/journal/2-of-3.jsonl").open("a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        code, _, err = sweep("s", "--shard", "2/3")
    assert code == 2 and "another process is using s.partial, share 2 of 3" in err
    assert sweep("s", "--shard", "2/3")[0] == 0
