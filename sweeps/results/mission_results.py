"""Result of `simulate` over a profile: numbers, segments and course of every run."""

from __future__ import annotations

import dataclasses

from calibration.data import Columns, Json, profiles
from calibration.data.profiles import ProfileTable
from mmrjax.missions import mission_batch
from mmrjax.model.energy import SINKS


@dataclasses.dataclass(frozen=True)
class Missions:
    """Runs over one profile, as tables.

    Attributes:
        table: a row a run, `runs.csv`; segments: a row a segment, `segments.csv`; course: a row an accepted step that
            is kept, `history.csv`.
        source: the profile that they follow.
        whole: whether the course of every run reaches its end.
    """

    table: Columns
    segments: Columns
    course: Columns
    source: ProfileTable
    whole: bool

    def to_json(self) -> Json:
        """Content of `result.json`: for one run its numbers by name, for several a list of them."""
        each = [self._one(k) for k in range(len(self.table["status"]))]
        about = {
            "name": self.source.source, "sha256": self.source.digest, "duration_s": self.source.duration,
            "segments": self.source.segments, "cycles": self.source.cycles,
            "between_rows": profiles.BETWEEN[self.source.linear],
        }  # fmt: skip
        return {"profile": about, **(each[0] if len(each) == 1 else {"missions": each})}

    def _one(self, row: int) -> Json:
        to = {name: f"energy_to_{name}_Wh" for name in SINKS}
        numbers = {
            c: float(self.table[c][row])
            for c in mission_batch.mission_columns(self.source.turns)
            if c not in to.values()
        }
        flags = str(self.table["flags"][row])
        return {
            **numbers,
            "energy_by_where_Wh": {name: float(self.table[column][row]) for name, column in to.items()},
            "status": str(self.table["status"][row]),
            "flags_raised": flags.split(";") if flags else [],
        }
