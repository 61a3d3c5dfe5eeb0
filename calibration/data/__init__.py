"""Data from outside: tables of runs, noise, robot and effect files, and the checks at the door."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    import numpy as np

#: Names in order, such as those of effects or columns.
Names: TypeAlias = tuple[str, ...]
#: A table: arrays of the same length by column.
Columns: TypeAlias = "dict[str, np.ndarray]"
#: Content of a JSON object.
Json: TypeAlias = dict[str, Any]
#: Priors of parameters by name: mean and sd [SI].
Priors: TypeAlias = Mapping[str, tuple[float, float]]
