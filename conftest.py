# ruff: noqa: E402 (the cache and double precision are set before anything is imported)
"""What the tests share: the compilation cache, double precision, the runs of Table 8, and compiled functions."""

import contextlib
import ctypes
import dataclasses
import functools
import gc
import os
import sys
from collections import Counter
from pathlib import Path

os.environ["MMRJAX_PROGRAMS"] = ""  # what tests put in the place of a function is traced, not read
from sweeps import compilation_cache

compilation_cache.exposure_reason = functools.cache(compilation_cache.exposure_reason)  # of thousands of files
compilation_cache.keep_programs()  # one for all workers, and for the next time

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_traceback_in_locations_limit", 0)  # no lines of source in programs that only run here

import jax.numpy as jnp
import numpy as np
import pytest
import typer.main

from mmrjax.effects import ALL, BY_NAME
from mmrjax.fidelities.drive import drive, drive_batch
from mmrjax.fidelities.steady import steady, steady_batch
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions
from sweeps import cli, console

typer.main.get_command = functools.cache(typer.main.get_command)  # the commands are the same in all tests
console.FIRST_MESSAGE = 1e6  # the message depends on timing, so recorded output must not contain it

#: Memory mappings of a process from which its compiled programs are dropped; Linux allows 65530, and the
#: compiler crashes or hangs beyond. A program takes some dozens.
MAPPINGS = 30_000
#: Memory from which they are dropped too [bytes]; a file adds 0.8e9 at most.
MEMORY = 3.0e9
#: What a test that is not marked slow may take [s of processor time, on a core that does nothing else].
LIMIT = 10.0
STARTED = pytest.StashKey[float]()


def _crowded():
    """Whether this process has too many programs to begin another file. Where Linux's files are not there: no."""
    own = Path("/proc/self")
    if not (own / "statm").exists():
        return False
    resident = int((own / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return resident > MEMORY or (own / "maps").read_bytes().count(b"\n") > MAPPINGS


def _make_room():
    """Forget compiled programs before the process has too many, and give their memory back."""
    if not _crowded():
        return
    gc.collect()  # what is no longer used, which may be enough
    if _crowded():
        jax.clear_caches()
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):  # not every C library has it
            ctypes.CDLL(None).malloc_trim(0)


def _spent():
    """Processor time of this process and of those that it has waited for [s]."""
    at = os.times()
    return at.user + at.system + at.children_user + at.children_system


#: Files that share results, which a process makes once: one worker runs them, and first, since they take longest.
SHARING = {
    "loop": (
        "test_loop_command", "test_loop_page", "test_discovery", "test_implausible", "test_stated_values",
        "test_discrepancy", "test_residual_clusters",
    ),
    "calibrated": ("test_calibrate", "test_posterior", "test_held_by_prior"),
}  # fmt: skip


GROUP = {file: name for name, files in SHARING.items() for file in files}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """With `--dist loadfile` a worker takes a file at a time, or the files that share results."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            file = Path(nodeid.partition("::")[0]).stem
            return GROUP.get(file, file)

    return ByFile(config, log)


def pytest_collection_finish():
    """Look for cycles of garbage seldom, and never in what was imported: a tenth of the time goes otherwise."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark as slow the nightly tests and the parameter sets that `quick` leaves to `make test-all`.

    Files that share results come first.
    """
    met = Counter()
    for item in items:
        if item.get_closest_marker("nightly"):
            item.add_marker("slow")
        mark = item.get_closest_marker("quick")
        if mark is not None:
            test = item.nodeid.partition("[")[0]
            met[test] += 1
            quick = met[test] <= mark.args[0] if isinstance(mark.args[0], int) else item.callspec.id in mark.args
            if not quick:
                item.add_marker("slow")
    items.sort(key=lambda item: list(SHARING).index(g) if (g := GROUP.get(item.path.stem)) else len(SHARING))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Note the processor time of each test, its fixtures included, and make room between files."""
    start = _spent()
    item.user_properties.append(("slow", item.get_closest_marker("slow") is not None))
    item.config.stash[STARTED] = start
    done = yield
    if nextitem is not None and nextitem.path != item.path:
        _make_room()
    return done


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if call.when == "teardown":
        report.user_properties.append(("processor_time", _spent() - item.config.stash[STARTED]))
    return report


def pytest_terminal_summary(terminalreporter):
    """Print the processor time of each test file, and name the tests above the limit that are not marked slow.

    It fails nothing: processor time too grows on a loaded machine, and by half from one to another.
    """
    long, files = [], Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            properties = dict(getattr(report, "user_properties", ()))
            seconds = properties.get("processor_time", 0.0)
            files[getattr(report, "nodeid", "").partition("::")[0]] += seconds
            if seconds > LIMIT and not properties.get("slow"):
                long.append((seconds, report.nodeid))
    listed = [f"{s:6.1f} {Path(file).stem.removeprefix('test_'):30}" for file, s in files.most_common() if s >= 0.05]
    if len(listed) > 1:
        terminalreporter.section(f"processor time of each test file [s], {sum(files.values()):.0f} in all")
        for k in range(0, len(listed), 3):
            terminalreporter.write_line("".join(listed[k : k + 3]).rstrip())
    if long:
        terminalreporter.section(f"not marked slow, and longer than {LIMIT:g} s of processor time")
        for seconds, name in sorted(long, reverse=True):
            terminalreporter.write_line(f"{seconds:6.1f} s  {name}")


@pytest.fixture(scope="session")
def robot():
    return paper_robots.nominal()


@pytest.fixture(scope="session")
def robot_with_effects():
    """Nominal, with every effect of the library at zero amplitude."""
    return dataclasses.replace(paper_robots.nominal(), effects=tuple(effect() for effect in ALL))


@pytest.fixture(scope="session")
def grid():
    """Rows (wheeled, slope [deg], payload [kg], voltage [V]) of Table 8 in both configurations."""
    axes = (0.0, 1.0), paper_robots.SLOPES_DEG, paper_robots.PAYLOADS_KG, paper_robots.VOLTAGES_V
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 4)


@pytest.fixture(scope="session")
def table8(grid):
    wheeled, slope, payload, voltage = grid.T
    return Conditions(voltage=voltage, slope_deg=slope, payload=payload, configuration=wheeled)


@pytest.fixture(scope="session")
def steady_table8(robot, table8):
    return steady_batch(robot, table8)


@pytest.fixture(scope="session")
def times_fine():
    """1001 instants of 2 s, close together where the armature's current rises (time constant 0.2 ms)."""
    early = np.geomspace(1e-5, 0.05, 400, endpoint=False)
    return jnp.asarray(np.concatenate([[0.0], early, np.linspace(0.05, 2.0, 600)]))


@pytest.fixture(scope="session")
def drive_table8(robot, table8, times_fine):
    """The 180 runs of Table 8, 2 s from standstill, at the default tolerance."""
    return drive_batch(robot, table8, times_fine)


#: One effect of each balance (of `inductance` none: it would be motor.inductance again), one with a memory;
#: tests/test_effects.py and tests/test_worlds_histories.py try every one, each by itself.
REPRESENTATIVE = (
    "mass_offset",
    "rotating_inertia",
    "supply_sag",
    "series_resistance",
    "windage",
    "gear_load_loss",
    "churning",
    "slope_bias",
    "belt_creep",
    "pulley_eccentricity",
    "ammeter_gain",
)


@pytest.fixture(scope="session")
def robot_with_representatives():
    """Nominal, with the representative effects at zero amplitude."""
    return dataclasses.replace(paper_robots.nominal(), effects=tuple(BY_NAME[name]() for name in REPRESENTATIVE))


@pytest.fixture(scope="session")
def free(robot_with_representatives):
    """Every parameter that can be freed, amplitudes of the representative effects included.

    Shape parameters are not: at amplitude zero nothing depends on them.
    """
    every = params.walk_parameters(robot_with_representatives)
    return [p for p in every if p.spec.amplitude or not p.name.startswith("effects.")]


@pytest.fixture(scope="session")
def theta(free):
    return jnp.stack([p.value for p in free])


@pytest.fixture(scope="session")
def scales(free):
    """By how much a parameter moves: its value, or where that is 0 a hundredth of its prior's deviation.

    Less for the absent because an effect may be strong where it never was meant to be seen: at the 50 A
    of a start, a winding at its settled temperature would have 46 times its resistance.
    """
    return np.array([abs(float(p.value)) or 0.01 * p.spec.prior_sd(0.0) for p in free])


@pytest.fixture(scope="session")
def rebuild(robot_with_representatives, free):
    """The robot with its parameters taken from a vector."""
    names = [p.name for p in free]
    return lambda vector: params.replace(robot_with_representatives, {n: vector[k] for k, n in enumerate(names)})


def numbers(tree):
    """Every floating-point leaf of a result in one vector."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.concatenate([jnp.ravel(x) for x in leaves])


@pytest.fixture(scope="session")
def steady_numbers(rebuild):
    """Floats of `steady` over (parameter vector, command), not compiled."""
    return lambda vector, run: numbers(steady(rebuild(vector), run))


@pytest.fixture(scope="session")
def drive_numbers(rebuild):
    """Every signal and the distance over time, and every float of the result, of `drive`, not compiled."""

    def outputs(vector, run, times):
        answer = drive(rebuild(vector), run, times, tolerance=1e-10)
        series = [jnp.broadcast_to(x, times.shape) for x in jax.tree.leaves((answer.distance, answer.signals))]
        return jnp.stack(series), numbers(answer.result)

    return outputs


@pytest.fixture
def compilations():
    """A list that grows by one for each program that XLA compiles while the test runs."""
    seen = []

    def listen(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            seen.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture
def mmrjax(monkeypatch, capsys, tmp_path):
    """Run a command in this process, its first words as one string. Returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))  # a command may set it, for this process alone

    monkeypatch.setattr(os, "_exit", sys.exit)  # how an interrupted command ends; this process goes on

    def command(words="", *arguments):
        monkeypatch.setattr(sys, "argv", ["mmrjax", *str(words).split(), *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        out = capsys.readouterr()
        return end.value.code, out.out, out.err

    return command


@pytest.fixture(scope="session")
def worlds():
    """Twelve rigs of every kind with everything imposed."""
    from worlds import rigs

    return [
        rigs.world(np.random.default_rng([3, seed]), kind, imposed)
        for kind in rigs.KINDS
        for imposed in rigs.IMPOSED
        for seed in range(12)
    ]
