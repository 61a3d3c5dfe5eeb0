"""What of the numbers of a run a robot has: a shaft has no ground, and a rig only what its file states."""

from __future__ import annotations

import numpy as np

from calibration.data import rig_file
from calibration.data.robot_file import RobotFile
from mmrjax import params
from mmrjax.channels import SIDES
from mmrjax.motor import Motor
from mmrjax.power import Battery
from mmrjax.robot import Robot
from mmrjax.robots import blank

#: Columns of runs and histories that are of the ground.
OF_GROUND = (
    "slip", "adhesion_used", "traction_N", "slope_deg", "power_ground_W", "power_lift_W", "efficiency_chassis",
)  # fmt: skip
#: Those of travel, which a shaft has where a channel shows it.
OF_TRAVEL = (
    "theoretical_speed_mm_s", "distance_m", "displacement_m", "demanded_speed_mm_s", "energy_per_metre_Wh", "range_m",
)  # fmt: skip
#: Those of the heat of a winding, which a rig has where its file states how heat leaves it.
OF_HEAT = (
    "winding_settled_C", "permissible_time_s", "winding_temperature_C", "housing_temperature_C", "winding_peak_C",
    "winding_end_C", "housing_end_C", "winding_left_C", "winding_right_C",
)  # fmt: skip
_THERMAL = ("resistance_thermal_winding", "resistance_thermal_housing")


def stated(robot: Robot, prefix: str) -> bool:
    """Whether any parameter whose name begins so is another than that of a rig of which nothing is known."""
    nothing = _nothing(robot)
    return any(float(p.value) != nothing[p.name] for p in params.walk(robot) if p.name.startswith(prefix))


def _nothing(robot: Robot) -> dict[str, float]:
    """Parameters of a rig of which nothing is known but its loads."""
    return {p.name: float(p.value) for p in params.walk(blank(robot.configurations, rig=robot.rig))}


def thermal(robot: Robot) -> bool:
    """Whether it is known how heat leaves the windings."""
    sheet = Motor()
    return robot.rig.inherits or any(
        float(getattr(robot.motor, name)) != float(getattr(sheet, name)) for name in _THERMAL
    )


def battery(robot: Robot) -> bool:
    """Whether it has a battery of its own."""
    if robot.rig.inherits:
        return True
    nothing, other = Battery(), "current_other"  # `rig_file.DEFAULTS` states that one
    same = [
        float(getattr(robot.battery, name)) == float(value)
        for name, value in vars(nothing).items()
        if name != other and isinstance(value, int | float)
    ]
    return not all(same)


def idle_columns(robot: Robot) -> set[str]:
    """Columns of runs and histories that mean nothing for a robot."""
    found: set[str] = set()
    if not robot.has_ground:
        found |= {*OF_GROUND}
    if not robot.shows_travel:
        found |= {*OF_TRAVEL}
    if not thermal(robot):
        found |= {*OF_HEAT, *(f"{column.removesuffix('_C')}_{side}_C" for column in OF_HEAT for side in SIDES)}
    if not battery(robot):
        found |= {"voltage_cell_V"}
    return found


def without_idle(robot: Robot, table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A table without what means nothing for the robot, the columns of its channels aside."""
    idle = idle_columns(robot) - {c.column for c in robot.channels}
    ends = ("", "_sd", "_lower", "_upper")
    gone = {column + end for column in idle for end in ends}
    return {column: values for column, values in table.items() if column not in gone}


def parameters(file: RobotFile) -> list[dict[str, str]]:
    """Parameters of a rig: those that its file states, and all else that is not as nothing is; with the source."""
    robot = file.robot
    nothing, found = _nothing(robot), []
    for p in params.walk(robot):
        head = p.name.partition(".")[0]
        load = head in robot.configurations
        own = p.name in file.stated and head not in file.linear
        moved = p.name not in nothing or float(p.value) != nothing[p.name]
        if not own and not moved and not (load and float(p.value) != 0):
            continue
        if not own and (p.name in rig_file.DEFAULTS or (p.name.endswith(".radius") and not robot.shows_travel)):
            continue
        of_file = own or head in file.linear
        source = f"stated in {file.name}" if of_file else "default" if not moved or load else "changed"
        found.append(
            {"name": p.name, "meaning": p.spec.meaning, "unit": p.spec.unit, "value": f"{float(p.value):.6g}"}
            | {"source": source}
        )
    return found
