"""Labels of surfaces: the names of their configurations, and the labels that scale a robot's adhesion."""

from __future__ import annotations

import re

import numpy as np

from mmrjax.model.paper_tables import SURFACES
from mmrjax.model.robot import Robot


def configuration_on_surface(configuration: str, surface: str) -> str:
    """Name of a configuration on a surface."""
    return f"{configuration}-{re.sub(r'[^0-9A-Za-z_]+', '_', surface)}"


def rows_of_scaled_adhesion(robot: Robot, configurations: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """True for rows whose adhesion is the robot's times the ratio of Table 5, shape (rows,)."""
    pairs = list(zip(configurations.tolist(), labels.tolist(), strict=True))
    labelled = SURFACES if robot.rig.scales_adhesion else ()
    of_table5 = {
        (name, label): label in labelled and configuration_on_surface(name, label) not in robot.configurations
        for name, label in set(pairs)
    }
    return np.array([of_table5[pair] for pair in pairs], bool)
