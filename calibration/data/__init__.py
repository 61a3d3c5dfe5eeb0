"""Input data: tables of runs, noise, robot files and effect files, with the checks of everything that is read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from mmrjax.model.quantities import Names as Names

if TYPE_CHECKING:
    import numpy as np

#: A table: arrays of the same length by column.
Columns: TypeAlias = "dict[str, np.ndarray]"
#: Content of a JSON object.
Json: TypeAlias = dict[str, Any]
#: Columns with other names in a source: name in this program, name in the source, factor from its unit.
Mapped: TypeAlias = tuple[tuple[str, str, float], ...]
#: Priors of parameters by name: mean and sd [SI].
Priors: TypeAlias = Mapping[str, tuple[float, float]]
