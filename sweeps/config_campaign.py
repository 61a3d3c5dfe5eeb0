"""Configuration of a sweep that is written to a store: input tables or the grid of the options, and execution."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from calibration.data import Json, Names
from calibration.data.input_errors import BadConfiguration
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from mmrjax.model.quantities import RPM
from sweeps.config import (
    BatchPart,
    ClimbPart,
    FolderPart,
    OutputPart,
    ProfilePart,
    RobotPart,
    Sweep,
    combination_error,
    option_field,
    read_toml,
    resolve_configuration,
)
from sweeps.options import options_of_fields

#: Keys that only a sweep into a store has.
KEYS = ("axes", "samples", "conditions", "outputs", "storage", "compression", "profile", "obstacle")
#: Options of a grid, which have no effect with a file that has its own axes.
GRID = (
    "configurations", "voltages_V", "motor_speeds_rpm", "payloads_kg", "slopes_deg", "load_torques_Nm", "surface",
    "battery",
    "discharge_mAh",
)  # fmt: skip


#: Axis of the size of the obstacle.
SIZE = "obstacle_mm"


class Obstacle(ClimbPart):
    """Obstacle that every point of a sweep climbs (`sweeps.points.tasks`).

    Its size is the axis `obstacle_mm`, or a search finds the largest one.
    """

    kind: Literal["step", "stairs", "gap"]
    find: bool = False
    tread_mm: float = Field(default=290.0, ge=10, le=5000)
    count: int = Field(default=3, ge=1, le=50)

    @model_validator(mode="after")
    def _of_its_kind(self) -> Self:
        for name, kinds in {"tread_mm": ("stairs",), "count": ("stairs",), "nose_mm": ("step", "stairs")}.items():
            if self.states(name) and self.kind not in kinds:
                raise combination_error(f"`{name}` has an effect only with `kind` {' or '.join(kinds)}")
        return self


class Campaign(RobotPart, ProfilePart, BatchPart, OutputPart):
    """A sweep of any size over any names, into a Zarr store. `sweeps.points.axes` reads its tables.

    Attributes:
        conditions: constant conditions, by name.
        axes: axes of the grid, by name: a list, `first:last:step`, or a table with start, stop, number and scale.
        samples: a sampled design: design, number, seed, over (distributions by name), posterior.
        outputs: names of `mmrjax.fidelities.outputs.output_table()`, columns of the fidelity, or flags. Default: the
            channels. With a profile: columns of `missions.mission_batch.OUTPUTS`, or flags. Default: its `USUAL`.
        storage: type in which outputs are stored.
        compression: compression of the store's chunks.
        obstacle: obstacle that every point climbs, in place of a run of the fidelity.
    """

    conditions: Json = Field(default_factory=dict)
    axes: Json = Field(default_factory=dict)
    samples: Json = Field(default_factory=dict)
    outputs: Names = ()
    storage: Literal["float64", "float32"] = "float64"
    compression: Literal["none", "zstd"] = "none"
    obstacle: Obstacle | None = None


class StoreOptions(FolderPart):
    """Execution and storage options of a sweep. They do not affect results."""

    plan: Path | None = option_field(
        None, "TOML file with [axes] or [samples] (docs/reference/plans.md)", argument=True, metavar="[CONFIG.toml]"
    )
    zarr: bool = option_field(False, "Write a Zarr store for small grids too")
    outputs: Names = option_field((), "Outputs to store, comma-separated", usual="the channels of its instruments")
    dry_run: bool = option_field(False, "Print points, chunks, size and expected time only")
    export: tuple[Literal["csv", "parquet"], ...] = option_field((), "Also write csv or parquet. Repeatable")
    shard: str | None = option_field(None, "Simulate the i-th of n shares, such as 3/8")

    @model_validator(mode="after")
    def _shared(self) -> Self:
        if not 1 <= self.share[0] <= self.share[1]:
            raise combination_error(f"`shard`: got {self.shard}; expected i/n with i from 1 to n, such as 3/8")
        return self

    @property
    def where(self) -> str:
        """Origin of the configuration, for messages."""
        return "options" if self.plan is None else self.plan.name

    @property
    def share(self) -> tuple[int, int]:
        """This process's share of the chunks, k of n."""
        match = re.fullmatch(r"(\d+)/(\d+)", self.shard or "1/1")
        return (int(match[1]), int(match[2])) if match else (0, 0)

    @property
    def of_store(self) -> bool:
        """True if an option is given that only a store supports."""
        return any((self.zarr, self.outputs, self.dry_run, self.export, self.shard))


def resolve_campaign(file: Path | None, options: Json, trust: bool = False) -> Campaign | Sweep:
    """Configuration of a sweep: a campaign if the file has its own axes, otherwise a grid.

    `campaign_of_grid` turns a grid into a campaign once the robot is known.

    Raises:
        BadConfiguration: for the same reasons as `resolve_configuration`, or an option of the grid is combined with a
            file that has its own axes.
    """
    if file is not None and not set(KEYS).isdisjoint(read_toml(file)):
        for name in GRID:
            if options.get(name) is not None:
                raise BadConfiguration(
                    f"{options_of_fields(Sweep)[name]}: has an effect only with a grid given by options; put it "
                    f"into the axes or conditions of {file.name}"
                )
        return resolve_configuration(Campaign, file, {k: v for k, v in options.items() if k not in GRID}, trust)
    return resolve_configuration(Sweep, file, options, trust)


def campaign_of_grid(grid: Sweep) -> Campaign:
    """Campaign whose axes are the stated axes of a grid, in the units of `variation`."""
    motor_speeds = grid.motor_speeds_rpm
    axes: dict[str, tuple[float, ...] | None] = {
        "voltage": None if grid.battery else grid.voltages_V,
        "motor_speed": None if motor_speeds is None else tuple(n * RPM for n in motor_speeds),
        "payload": grid.payloads_kg,
        "load_torque": grid.load_torques_Nm,
        "slope_deg": grid.slopes_deg,
    }
    # Each run of the grid is combined with each drawn robot, along the last dimension of the store.
    posterior_samples = {"design": "random", "number": grid.posterior, "posterior": str(Path(grid.robot).parent)}
    names = "all" if grid.configurations is None else list(grid.configurations)
    return Campaign(
        **{key: getattr(grid, key) for key in Sweep.model_fields if key in Campaign.model_fields},
        samples=posterior_samples if grid.posterior is not None else {},
        axes={"configuration": names, **{name: list(values) for name, values in axes.items() if values is not None}},
        conditions={
            **({} if grid.surface is None else {"surface": grid.surface}),
            "battery": grid.battery,
            "discharge": grid.discharge_mAh * COULOMB_PER_MAH,
        },
    )
