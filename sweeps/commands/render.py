"""The command `render`: a picture of a run of the track model."""

from __future__ import annotations

import jax

from calibration.data.input_errors import BadConfiguration
from calibration.data.writing import replacing
from mmrjax.fidelities.track import track_batch
from mmrjax.model.signals import STATUSES
from mmrjax.undercarriage import rendering
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.console import print_output, progress_bar
from sweeps.inputs import load_robot, one_run
from sweeps.pages import words
from sweeps.points import run, scale
from sweeps.store import DONE, SOLVER_FAILED


def execute(config: configuration.Render, picture: configuration.Picture) -> int:
    """Draws a run from standstill as a picture. Returns the exit code: 0 if the run settles or is still
    accelerating, otherwise 3.
    """
    file, options = picture.file, config.options
    try:
        rendering.check_picture(file, picture.time, options["duration"])
    except ValueError as error:
        raise BadConfiguration(f"render: {error}") from error
    if file.exists() and not picture.force:
        raise BadConfiguration(f"FILE: {file} exists already; choose another name (--force replaces it)")
    if not file.parent.is_dir():
        raise BadConfiguration(f"FILE: {file.parent} is not a folder; choose another path")
    robot = load_robot(config).robot
    capabilities.check_on_ground(robot, "render")
    conditions = run.conditions_of_runs(robot, one_run(robot, picture.stated, config.battery), config)
    run.check_fidelity_options(robot, conditions, config)
    with scale.share_progress() as report_share:
        trajectory = track_batch(
            robot, conditions, duration=options["duration"], step=options["step"], progress=report_share
        )
    trajectory, conditions = jax.tree.map(lambda x: x[0], (trajectory, conditions))

    with replacing(file) as temporary, progress_bar(1, quiet=False, doing="drawing") as advance:
        try:
            rendering.render(rendering.scene_of_run(robot, conditions, trajectory), temporary, picture.time)
        except ValueError as error:
            raise BadConfiguration(f"render: {error}".replace(temporary.name, file.name)) from error
        advance(1)
    status = STATUSES[int(trajectory.result.status)]
    print_output(f"{status}: {words.status_meaning(status)}")
    print_output(str(file))
    return SOLVER_FAILED if status == "failed" else DONE
