"""The command `sweep` at scale: any names, any number of points, into a Zarr store; resumable and in shares."""

from __future__ import annotations

import dataclasses
import errno
import itertools
import math
import shutil
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from calibration.data import profiles, robot_file, writing
from calibration.data.errors import BadConfiguration, InputError
from calibration.data.robot_file import RobotFile
from mmrjax import __version__, channels, fidelities, missions, outputs
from mmrjax.errors import UsageError
from mmrjax.profile import Profile
from mmrjax.robot import Robot
from mmrjax.signals import FLAGS, STATUSES
from mmrjax.variation import STATUS, Variation, check_outputs
from sweeps import config as configuration
from sweeps import config_campaign
from sweeps.config import Sweep
from sweeps.config_campaign import Campaign, How
from sweeps.console import progress, say, tell
from sweeps.inputs import load_robot
from sweeps.pages import words
from sweeps.points import axes, grid, scale
from sweeps.points.design import Blocks
from sweeps.points.identity import Identity, identity
from sweeps.points.zarr_store import ABSENT, STORE, Done, Layout, SweepStore, Variable
from sweeps.store import DONE, SOLVER_FAILED, default_path, digest, provenance

#: Points at which a fidelity is asked, before the first is simulated, whether it could bear them.
ASKED = 48
#: Bytes that are to stay free on the disk beside a store.
MARGIN = 64 * 2**20
#: Points on which the time of a slow fidelity is estimated.
PROBED = 64
NOTHING_SPECIAL = How()


def store_sweep(
    config: Campaign | Sweep,
    where: str,
    out: Path | None,
    force: bool,
    options: How = NOTHING_SPECIAL,
    wanted: tuple[str, ...] = (),
) -> int:
    """Simulate a design and leave a run folder with its store; returns the exit code.

    Args:
        config: the configuration; where: its file, for messages; out: the run folder; force: replace one.
        wanted: outputs, in place of those of the configuration.
    """
    file = load_robot(config)
    robot = file.robot
    if isinstance(config, Sweep):
        notes: list[str] = []
        stated = config.configurations
        config = grid.resolved(config, robot, config.battery, notes).model_copy(update={"configurations": stated})
        config = config_campaign.of_grid(config)
        for note in notes:
            tell(note)
    plan = axes.plan(config, robot, where)
    pool = None
    if options.scheduler is not None and not options.dry_run:
        from sweeps.points import cluster

        pool = cluster.connect(options.scheduler)
    try:
        devices = 1 if pool is not None else len(jax.local_devices())
        device = scale.device_kind() if pool is None else pool.device
        accelerator = not device.startswith("cpu")
        config = config.model_copy(
            update={
                "chunk": config.chunk or scale.default_chunk(config.model, accelerator, devices),
                "outputs": wanted
                or config.outputs
                or (channels.names(robot.channels) if config.profile is None else missions.USUAL),
            }
        )
        job = prepare(config, robot, plan, where)
        layout = laid_out(config, job)
        path = out or default_path("sweep")
        if options.dry_run:
            dry_run(job, layout, path)
            return DONE
        files = [*([config.robot] if Path(config.robot).is_file() else []), *config.effects, *plan.data]
        files += [config.profile] if config.profile is not None and config.profile not in profiles.PACKAGED else []
        same = identity(config, robot, files, device)
        store = SweepStore(path, same, layout, force=force)
        try:
            if not store.finished:
                simulate(store, job, options, pool)
            return finish(store, config, file, job, same, options)
        except (InputError, KeyboardInterrupt):
            if options.shard is None:
                store.abandon()
            raise
        finally:
            store.close()
    finally:
        if pool is not None:
            pool.close()


def prepare(config: Campaign, robot: Robot, plan: axes.Plan, where: str) -> scale.Job:
    """The job of a resolved configuration.

    Raises:
        BadConfiguration: an output that the fidelity does not have, or a point that it cannot bear.
    """
    variation = Variation(robot, plan.design.names)
    profile = None if config.profile is None else _profile(config.profile, robot, plan, where)
    repeated = [name for k, name in enumerate(config.outputs) if name in config.outputs[:k]]
    if repeated:
        raise BadConfiguration(f"{where}, outputs: got {repeated[0]} twice; expected each once")
    taken = [name for name in config.outputs if name in plan.design.names]
    if taken:
        raise BadConfiguration(f"{where}, outputs: got {taken[0]}, which varies; expected what comes out of a run")
    try:
        check_outputs(variation, config.model, plan.fixed(), config.options, config.outputs, profile)
    except UsageError as error:
        raise BadConfiguration(f"{where}, {error}") from error
    assert config.chunk is not None
    blocks = Blocks.of(plan.design.shape, config.chunk)
    _bearable(variation, config, plan)
    return scale.Job(robot, config.model, config.options, plan, config.outputs, config.storage, blocks, profile)


def _profile(name: str, robot: Robot, plan: axes.Plan, where: str) -> Profile:
    """The profile that every point follows.

    Raises:
        BadData: as `profiles.read`.
        BadConfiguration: it states what the plan states too, a supply voltage where a point is on the battery, or
            surfaces.
    """
    source = profiles.read(name)
    for note in source.notes:
        tell(note)
    if source.surface is not None:
        raise BadConfiguration(
            f"{where}, profile: got {source.source} with the column surface; expected the surface in conditions"
        )
    if source.begins:
        raise BadConfiguration(f"{where}, profile: got {source.source} with a start; points of a sweep begin at rest")
    for field in source.values:
        if field in (*plan.conditions, *plan.design.names):
            raise BadConfiguration(
                f"{where}, {field}: got it beside {source.source}, which states it; expected one of the two"
            )
    on_battery = plan.conditions.get("battery", 0.0) or "battery" in plan.design.names
    source.check_source(bool(on_battery))
    return source.profile(robot, plan.fixed())


def _bearable(variation: Variation, config: Campaign, plan: axes.Plan) -> None:
    """Ask the fidelity about points spread over the design, its corners among them.

    Raises:
        BadConfiguration: one that it cannot bear.
    """
    fidelity = fidelities.get(config.model)
    if not config.options:
        return
    shape = plan.design.shape
    ends = itertools.product(*({0, n - 1} for n in shape[:4]))
    corners = [(*end, *(0 for _ in shape[4:])) for end in ends]
    spread = np.linspace(0, plan.design.points - 1, ASKED).astype(np.int64)
    numbers = np.unique([*spread, *(int(np.ravel_multi_index(c, shape)) for c in corners)])
    for values in plan.design.at(numbers):
        robot, conditions = variation.at(jnp.asarray(values), plan.fixed())
        try:
            fidelity.check(robot, jax.tree.map(lambda x: jnp.asarray(x)[None], conditions), config.options)
        except ValueError as error:
            at = ", ".join(f"{n} {v:g}" for n, v in zip(plan.design.names, values, strict=True))
            raise BadConfiguration(f"--model {config.model}: at {at}: {error}") from error


def laid_out(config: Campaign, job: scale.Job) -> Layout:
    """Arrays of the store of a job, with units and long names."""
    further = () if job.profile is None else missions.OUTPUTS
    rows: dict[str, outputs.Output | missions.Output] = {row.name: row for row in outputs.table(job.robot.channels)}
    rows |= {row.column: row for row in further}
    variables = []
    for name in job.outputs:
        if name == "flags":
            about = {"long_name": "limits exceeded", "flag_masks": [1 << k for k in range(len(FLAGS))]}
            variables.append(Variable(name, "uint16", {**about, "flag_meanings": " ".join(FLAGS)}))
            continue
        unit, label = (rows[name].unit, rows[name].label) if name in rows else ("-", name.replace("_", " "))
        variables.append(Variable(name, config.storage, {"units": _unit(unit), "long_name": label}))
    meanings = {"flag_values": [*range(len(STATUSES)), ABSENT], "flag_meanings": " ".join((*STATUSES, "absent"))}
    variables.append(Variable(STATUS, "uint8", {"long_name": "how the run ended", **meanings}))
    known = job.plan.axes
    coordinates = {name: {"units": _unit(axis.unit), "long_name": axis.meaning} for name, axis in known.items()}
    for name in {axes.CONFIGURATION} & set(coordinates):
        del coordinates[name]["units"]
    labels = {axes.CONFIGURATION: job.robot.configurations.names}
    about = {"title": "sweep of a robot", "source": f"mmrjax {__version__}, {job.model}"}
    return Layout(job.plan.design, job.blocks, tuple(variables), coordinates, labels, about, config.compression)


def _unit(unit: str) -> str:
    return "1" if unit in ("-", "") else unit


# --- before ---------------------------------------------------------------------------------------------------------


def dry_run(job: scale.Job, layout: Layout, path: Path) -> None:
    """Say how many points, chunks and bytes a sweep is, and how long it would take; nothing is written."""
    compiled = scale.Compiled(job)
    blocks, slow = job.blocks, fidelities.facts(job.model).slow
    if slow and blocks.points > PROBED:
        small = Blocks.of(job.plan.design.shape, PROBED)
        compiled = scale.Compiled(dataclasses.replace(job, blocks=small))
    spent = []
    for _ in range(2 if slow else 4):  # the first compiles
        start = time.perf_counter()
        scale.fetched(compiled(compiled.points(0)), 1)
        spent.append(time.perf_counter() - start)
    each = min(spent[1:]) / compiled.size
    design = job.plan.design
    shown = Table(show_header=False)
    dimensions = " x ".join(f"{n} {name}" for n, name in zip(design.shape, design.dimensions, strict=True))
    free = _free(path)
    rows = {
        "points": f"{design.points:,} ({dimensions})",
        "chunks": f"{len(blocks):,} of {blocks.points:,} points on {device_words(compiled)}",
        "store": f"{amount(layout.size)} (uncompressed); free {amount(free)} in {_existing(path)}",
        "time": f"about {duration(each * blocks.points * len(blocks))} once compiled, {1 / each:,.0f} points/s "
        f"(timed here on {compiled.size:,} points); compiling {duration(max(spent[0] - spent[1], 0.0))}",
    }
    for heading, text in rows.items():
        shown.add_row(heading, text)
    say(shown)
    _refuse_without_space(layout.size, 1.0, path)


def device_words(compiled: scale.Compiled) -> str:
    """«2 x cpu: cpu»."""
    return f"{compiled.mesh.size} x {scale.device_kind()}"


def _existing(path: Path) -> Path:
    path = path.absolute().parent
    while not path.exists():
        path = path.parent
    return path


def _free(path: Path) -> int:
    return shutil.disk_usage(_existing(path)).free


def _refuse_without_space(size: int, share: float, path: Path) -> None:
    """Refuse a sweep whose results would not fit.

    Args:
        size: of the whole store [bytes]; share: of it that is still to be written.
    """
    needed, free = math.ceil(size * share) + MARGIN, _free(path)
    if needed > free:
        raise BadConfiguration(
            f"--out: the results would take {amount(needed)} (uncompressed); {_existing(path)} has {amount(free)} "
            'free; choose another disk, fewer points or outputs, or storage = "float32"'
        )


def amount(size: float) -> str:
    """Bytes as a person reads them."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if size < 1000 or unit == "TB":
            return f"{size:.3g} {unit}" if size < 1e6 else f"{size:,.0f} {unit}"
        size /= 1000
    raise AssertionError


def duration(seconds: float) -> str:
    """Seconds as a person reads them."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.2g} s"


# --- the run --------------------------------------------------------------------------------------------------------


def share(shard: tuple[int, int] | None, chunks: int) -> range:
    """Chunks of the k-th of n shares."""
    k, n = shard or (1, 1)
    return range((k - 1) * chunks // n, k * chunks // n)


def simulate(store: SweepStore, job: scale.Job, options: How, pool: Any) -> None:
    """Compute and write the chunks of this process's share that are not done.

    Raises:
        BadConfiguration: no room on the disk, before anything is computed, or in the middle; the scheduler's workers
            are lost for good.
    """
    store.begin(options.shard or (1, 1))
    done = store.done()
    mine = share(options.shard, len(job.blocks))
    left = [k for k in mine if k not in done]
    _refuse_without_space(store.layout.size, len(left) / len(job.blocks), store.path)
    if not left:
        return
    total = sum(job.blocks.count(k) for k in mine)
    before = total - sum(job.blocks.count(k) for k in left)
    if before:
        tell(f"{store.partial}: goes on after {before:,} of {total:,} points")
    times = scale.Times()
    chunks = pool.produce(job, left) if pool is not None else scale.produce(scale.Compiled(job), left, times)
    try:
        with progress(total, quiet=False, done=before, rate=True) as advance:
            scale.run(store, job, chunks, advance, times)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        written = len(store.done())
        raise DiskFull(
            f"{store.partial}: {error.strerror} after {written} of {len(job.blocks)} chunks; free some space, and "
            "the same command goes on from there"
        ) from error


class DiskFull(InputError):
    """No space left in the middle of a sweep, which can be taken up again."""


def finish(store: SweepStore, config: Campaign, file: RobotFile, job: scale.Job, same: Identity, options: How) -> int:
    """Write what a whole sweep leaves, and move it into place; say how far it is where it is not whole."""
    if not store.finished:
        with store.last() as last:
            if last:
                leave(store, config, file, job, same)
                store.move_into_place()
    done = store.done()
    if not store.finished:
        say(f"{len(done)} of {len(job.blocks)} chunks of {store.partial} are done; the last share finishes the sweep "
            "or the same command without --shard")  # fmt: skip
        return DONE
    if options.export:
        from sweeps.points import export

        for kind in options.export:
            tell(str(export.export(kind, store.path, store.layout)))
    counts = statuses(done.values())
    print_counts(counts)
    say(str(store.path))
    return DONE if words.solved(counts) else SOLVER_FAILED


def leave(store: SweepStore, config: Campaign, file: RobotFile, job: scale.Job, same: Identity) -> None:
    """Everything of a run folder beside the store."""
    folder, done = store.partial, store.done()
    (folder / "config.resolved.toml").write_text(configuration.as_toml(config), encoding="utf-8")
    robot_file.write(job.robot, folder / "robot.toml", note=f"the robot of this sweep, from {config.robot}")
    found = summary(store.layout, job, done.values())
    writing.write_json(folder / "result.json", found)
    if config.report:
        from sweeps.pages import campaign as campaign_page

        campaign_page.write(folder, file, store.layout, found)
    hashes = {"robot": digest((folder / "robot.toml").read_bytes()), **same["data"]}
    about = {**provenance(), "statuses": found["statuses"], "seed": config.samples.get("seed", 0), "hashes": hashes}
    writing.write_json(folder / "manifest.json", about)


def summary(layout: Layout, job: scale.Job, done: Iterable[Done]) -> dict[str, Any]:
    """`result.json`."""
    done = list(done)
    units = {v.name: v.attributes["units"] for v in layout.variables if "units" in v.attributes}
    names = [name for name in job.outputs if name in units]
    ranges = {name: [d.ranges[name] for d in done if name in d.ranges] for name in names}
    return {
        "schema": "mmrjax.sweep_store/1",
        "store": STORE,
        "model": job.model,
        "points": job.plan.design.points,
        "dimensions": dict(zip(job.plan.design.dimensions, job.plan.design.shape, strict=True)),
        "samples": list(job.plan.design.samples.names) if job.plan.design.samples is not None else [],
        "statuses": statuses(done),
        "outputs": {
            name: {
                "unit": units[name],
                "least": min((low for low, _ in found), default=None),
                "greatest": max((high for _, high in found), default=None),
            }
            for name, found in ranges.items()
        },
    }


def statuses(done: Iterable[Done]) -> dict[str, int]:
    """How many points ended in each status; every status is named."""
    total = np.sum([d.statuses for d in done], axis=0, dtype=int)
    return dict(zip(STATUSES, np.broadcast_to(total, len(STATUSES)).tolist(), strict=True))


def print_counts(counts: Mapping[str, int]) -> None:
    """How the runs ended, in words."""
    shown = Table(title=f"{sum(counts.values()):,} points", title_justify="left")
    for heading in ("status", "points", "meaning"):
        shown.add_column(heading, justify="right" if heading == "points" else "left")
    for status, count in counts.items():
        if count:
            shown.add_row(status, f"{count:,}", words.STATUSES[status].why)
    say(shown)
