"""Results of a store as a CSV or Parquet table, written chunk by chunk."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mmrjax.fidelities import outputs
from mmrjax.fidelities.variation import STATUS
from mmrjax.model import channels, quantities
from mmrjax.model.power import COULOMB_PER_MAH
from mmrjax.model.signals import FLAGS, STATUSES
from sweeps.points.zarr_store import STORE, StoreLayout

#: Columns of conditions, as in tables of runs and options, and their unit in the unit of the store. Other quantities
#: keep their names.
COLUMNS = {c.field: (c.column, 1.0) for c in quantities.SET if c.in_tables and c.field} | {
    "motor_speed": ("motor_speed_rpm", quantities.RPM),
    "motor_current": ("motor_current_A", 1.0),
    "discharge": ("discharge_mAh", COULOMB_PER_MAH),
}


def export_runs(kind: str, folder: Path, layout: StoreLayout) -> Path:
    """Writes `runs.csv` or `runs.parquet` into a finished run folder. Returns the path.

    One row for each point, in order. Numbers that are not finite become empty cells.
    """
    path = folder / f"runs.{kind}"
    temporary = path.with_name(path.name + ".writing")
    try:
        _WRITERS[kind](temporary, chunk_tables(folder / STORE, layout))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def chunk_tables(store: Path, layout: StoreLayout) -> Iterator[Any]:
    """Yields the points of each chunk as an Arrow table."""
    import pyarrow as pa
    import zarr

    group = zarr.open_group(store, mode="r")
    design, blocks = layout.design, layout.blocks
    columns = {row.name: row.column for row in outputs.output_table(channels.EVERY)}
    for chunk in range(len(blocks)):
        box = blocks.box(chunk)
        shape = tuple(b.stop - b.start for b in box)
        tables: dict[str, Any] = {}
        for k, (name, values) in enumerate(design.axes.items()):
            along = values[box[k]][(slice(None),) + (None,) * (len(shape) - k - 1)]
            flat = np.broadcast_to(along, shape).ravel()
            words = layout.labels.get(name)
            column, unit = COLUMNS.get(name, (name, 1.0))
            tables[column] = (
                pa.array(flat / unit)
                if words is None
                else pa.DictionaryArray.from_arrays(flat.astype(np.int32), list(words))
            )
        for name in design.samples.names if design.samples is not None else ():
            sampled: Any = group[name]
            column, unit = COLUMNS.get(name, (name, 1.0))
            tables[column] = pa.array(np.broadcast_to(sampled[box[-1]], shape).ravel() / unit)
        for name, (dtype, _) in layout.variables.items():
            array: Any = group[name]
            flat = array[box].ravel()
            if name == STATUS:
                tables[STATUS] = pa.DictionaryArray.from_arrays(flat.astype(np.int32), list(STATUSES))
            elif np.dtype(dtype).kind != "f":
                names = [";".join(f for k, f in enumerate(FLAGS) if bits >> k & 1) for bits in range(1 << len(FLAGS))]
                tables[name] = pa.DictionaryArray.from_arrays(flat.astype(np.int32), names)
            else:
                tables[columns.get(name, name)] = pa.array(flat, from_pandas=True)
        yield pa.table(tables)


def _csv(path: Path, parts: Iterator[Any]) -> None:
    import pyarrow as pa
    from pyarrow import csv

    writer = None
    for part in parts:
        words = [pa.types.is_dictionary(f.type) for f in part.schema]
        part = part.cast(
            pa.schema([f.with_type(pa.string()) if w else f for f, w in zip(part.schema, words, strict=True)])
        )
        if writer is None:
            writer = csv.CSVWriter(path, part.schema, write_options=csv.WriteOptions(quoting_style="needed"))
        writer.write_table(part)
    if writer is not None:
        writer.close()


def _parquet(path: Path, parts: Iterator[Any]) -> None:
    from pyarrow import parquet

    writer = None
    for part in parts:
        if writer is None:
            writer = parquet.ParquetWriter(path, part.schema)
        writer.write_table(part)
    if writer is not None:
        writer.close()


_WRITERS = {"csv": _csv, "parquet": _parquet}
