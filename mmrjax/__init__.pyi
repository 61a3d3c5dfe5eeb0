# `TYPE_CHECKING` lets mypy check the modules below before this list.
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calibration import calibrate as calibrate
    from calibration import discover as discover
    from calibration import read_robot as read_robot
    from calibration import read_runs as read_runs
    from calibration import runs as runs
    from calibration import to_pandas as to_pandas
    from calibration import to_polars as to_polars
    from calibration import to_xarray as to_xarray
    from calibration.described import describe as describe
    from mmrjax.effects import Effect as Effect
    from mmrjax.errors import UsageError as UsageError
    from mmrjax.fidelities.results import Results as Results
    from mmrjax.fidelities.simulation import simulate as simulate
    from mmrjax.fidelities.stepping import initial_state as initial_state
    from mmrjax.fidelities.stepping import rates as rates
    from mmrjax.fidelities.stepping import step as step
    from mmrjax.missions.profile import profile as profile
    from mmrjax.model.conditions import Conditions as Conditions
    from mmrjax.model.paper_robots import nominal as nominal
    from mmrjax.model.params import replace as replace
    from mmrjax.model.robot import Robot as Robot
    from mmrjax.model.signals import STATUSES as STATUSES
    from mmrjax.model.signals import State as State
    from sweeps import sweep as sweep
    from sweeps.commands.export_drive import export as export
    from sweeps.compilation_cache import keep_programs as keep_programs

__version__: str
OLDER_EMITTERS: str
SOUND_AT_LEVEL_0: str
WORKER: str
