"""What the tests of the closed loop share: synthetic tables with undeclared effects, and the stages of the loop."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np
from worlds import settled

from calibration.data.runs import Runs
from calibration.data.runs import read_runs as read_runs
from calibration.discovery import assembly, discover, loop_input
from calibration.discovery.candidates import fit_base
from calibration.discovery.loop_input import LoopInput
from calibration.discovery.outliers import screen_outliers
from calibration.discovery.settings import Settings, settings_for
from calibration.inference import noise, observers
from calibration.inference.calibration import calibrate
from calibration.inference.fit_notes import Remark
from calibration.inference.observers import SettledRuns
from mmrjax.effects import BY_NAME, Effect
from mmrjax.model import paper_robots

#: The analyst's prior on the surface, which Table 5 does not know.
STATED = {f"{c}.ground.friction.static": (0.6, 0.09) for c in ("6T2A", "4W2T")}
#: A servo's output that loses a degree at each reversal.
LOST_MOTION = Remark(
    "lost_motion",
    source="r.csv",
    column="output_angle_deg",
    reversals=20,
    width=0.958,
    unit="deg",
    angle=0.0167,
    stiffness=0.0,
)


def table(made):
    """The runs of a case without its label, or of columns."""
    return Runs("synthetic", dict(getattr(made, "table", made)))


def known(runs):
    """The sds that a table states."""
    return noise.noise_from_table(runs, observers.observer_kind(runs).sizes(runs))


@dataclasses.dataclass(frozen=True)
class Analyst:
    """Who looks for effects: settings, library and priors of a file of tests, so that all share what is compiled."""

    settings: Settings
    library: Mapping[str, type[Effect]]
    stated: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=lambda: STATED)

    def seeded(self, seed):
        """The same with another random seed."""
        return dataclasses.replace(self, settings=dataclasses.replace(self.settings, seed=seed))

    def space(self, runs):
        """What can be fitted to a table."""
        return loop_input.build_candidate_space(
            runs, paper_robots.nominal(), known(runs).sd, self.settings, self.stated, self.library
        )

    def base(self, runs):
        """The base fitted to a table."""
        return fit_base(self.space(runs), runs.source)

    def screened(self, runs):
        """The base fitted to a table, rows that stand alone set aside."""
        return screen_outliers(self.base(runs), runs, self.settings)

    def given(self, runs):
        """What the loop is given for a table."""
        numbers = np.arange(1, len(runs) + 1)
        return LoopInput(runs, numbers, paper_robots.nominal(), known(runs), self.stated, self.settings, self.library)

    def trace(self, runs):
        """The stages of the loop up to its verdict."""
        return discover.trace_verdict(self.given(runs))

    def result(self, traced, runs):
        """What the loop makes of its stages."""
        return assembly.assemble_result(self.given(runs), traced)

    def discover(self, runs):
        """The whole loop."""
        return self.result(self.trace(runs), runs)


def parts(runs, traced):
    """What tests of the stages ask for, under short names."""
    base = traced.screened.base
    return SimpleNamespace(
        runs=runs, traced=traced, left=traced.left, space=base.space, base=base.candidate, bases=traced.screened.bases
    )


#: The smallest search, which ordinary tests share with the command of tests/test_loop_command.py: tables of 24 runs, and
#: seven effects, of which settled runs do not show the last.
FEWEST = (
    "churning", "series_resistance", "load_slip", "winding_heating", "mass_offset", "supply_sag", "cogging",
)  # fmt: skip
FEW = Analyst(settings_for(SettledRuns, 250), {name: BY_NAME[name] for name in FEWEST})


def small(p=settled.CLIMBING):
    """24 runs: two slopes, two payloads, three voltages, both configurations."""
    return settled.table8(p, payloads=(0.0, 8.0), slopes=(0.0, 10.0))


@functools.cache
def calibrated():
    """The packaged table from four starts, without profiles and without what is left out. Made once for all files."""
    return calibrate(read_runs("measured"), paper_robots.nominal(), starts=4, profiles=False, blocks=())


#: What tables of settled runs are searched for; the whole library is what the command and the campaign search.
SEARCHED = (
    "mass_error", "mass_offset", "supply_sag", "series_resistance", "brush_drop", "winding_heating", "windage",
    "gear_load_loss", "churning", "stribeck_track", "tension_friction", "speed_rolling", "slope_bias",
    "rolling_radius", "load_slip", "ammeter_offset", "speed_gain",
)  # fmt: skip
#: Of settled runs. Tables of 81 to 96 rows have one padded size, and all files share what is compiled for it.
SETTLED = Analyst(
    dataclasses.replace(settings_for(SettledRuns, 192), slots=2), {name: BY_NAME[name] for name in SEARCHED}
)
