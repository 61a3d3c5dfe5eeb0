"""Outputs: the results of a simulated run. Importable without jax.

They are the columns of `runs.csv`, of `Results.to_dict` and of printed tables.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mmrjax.model.channels import Channel
from mmrjax.model.quantities import TABLE, Quantity

if TYPE_CHECKING:
    from mmrjax.model.signals import Result

#: Outputs in addition to the channels, which come first.
FURTHER = TABLE["run"]


def output_table(channels: Iterable[Channel]) -> tuple[Quantity, ...]:
    """Every output in the order of columns, the channels `channels` first. Each is an attribute of `Result`."""
    return (*channels, *FURTHER)


def output_names(channels: Iterable[Channel]) -> tuple[str, ...]:
    """Names of all outputs, the channels `channels` first."""
    return tuple(output.name for output in output_table(channels))


def output_columns(
    result: Result, channels: Iterable[Channel], further: Mapping[str, Any] | None = None
) -> dict[str, np.ndarray]:
    """Results in the units and words of `runs.csv`.

    Args:
        channels: channels, of the robot.
        further: columns that a fidelity adds, in their units (`fidelities.base.RunBatch.columns`).
    """
    return {
        **{o.column: np.asarray(getattr(result, o.name)) / o.factor for o in output_table(channels)},
        **status_words(result.status, result.flags),
        **{name: np.asarray(values) for name, values in (further or {}).items()},
    }


def status_words(status: Any, flags: Any) -> dict[str, np.ndarray]:
    """Statuses and flags as words of `runs.csv`, in the shape of the codes. Flags separated by semicolons."""
    from mmrjax.model.signals import FLAGS, STATUSES

    bits = np.asarray(flags)
    names = [";".join(flag for k, flag in enumerate(FLAGS) if b >> k & 1) for b in bits.ravel()]
    return {
        "status": np.array(STATUSES)[np.asarray(status)],
        "flags": np.array(names, dtype=str).reshape(bits.shape),
    }
