"""Surfaces of runs: labels of Table 5 scale the adhesion of the paper's robots. Any other surface has its own
friction.

A surface without stated friction becomes a separate configuration, named after configuration and label. Its
`ground.*` parameters are free, and all others follow the first configuration (`rig.surfaces`).
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

from calibration.data.columns import Layout
from calibration.data.table import Runs, configuration_on_surface
from mmrjax.errors import allowed_words
from mmrjax.model.paper_tables import SURFACES
from mmrjax.model.robot import Configurations, Robot

#: First part of the names of parameters that belong to a surface.
GROUND = "ground."
#: Similarity to a label of Table 5 above which a label counts as misspelt [-].
MISSPELT = 0.75

V = TypeVar("V")


def common_configuration(configurations: Sequence[str], labels: Iterable[str]) -> str | None:
    """The only configuration, or the one with all of these surfaces, otherwise None."""
    if len(configurations) == 1:
        return configurations[0]
    stems = [
        {c[: -len(end)] for c in configurations if c.endswith(end)}
        for end in (configuration_on_surface("", label) for label in labels)
    ]
    stem = set.intersection(*stems) if stems else set()
    return stem.pop() if len(stem) == 1 else None


def allowed_labels(label: str, layout: Layout) -> str:
    """Allowed labels, for the message about a wrong label. Empty if the label is allowed."""
    if not layout.inherits:
        return "" if label else "the name of a surface"
    if label in SURFACES:
        return ""
    alike = difflib.get_close_matches(label, SURFACES, 1, MISSPELT)
    return (
        f"one of these; {allowed_words(label, SURFACES)}" if not label or alike or not layout.configurations else ""
    )


def with_surface_configurations(robot: Robot, runs: Runs) -> Robot:
    """`robot` with a configuration for each surface of the table without a label of Table 5.

    If all surfaces of a configuration have such configurations, these replace it, unless there is only one surface.
    Priors that the robot's file states apply to the new configurations.
    """
    if not runs.has("surface") or not robot.has_ground:
        return robot
    pairs = list(dict.fromkeys(zip(runs["configuration"].tolist(), runs["surface"].tolist(), strict=True)))
    members = dict(robot.configurations.items())
    labelled = SURFACES if robot.rig.scales_adhesion else ()
    leaders: dict[str, str] = {}
    for configuration in dict.fromkeys(c for c, _ in pairs):
        labels = [label for c, label in pairs if c == configuration]
        own_names = [x for x in labels if x not in labelled or configuration_on_surface(configuration, x) in members]
        present = [
            configuration_on_surface(configuration, x)
            for x in own_names
            if configuration_on_surface(configuration, x) in members
        ]
        if not own_names or (len(labels) == 1 and not present) or (configuration not in members and not present):
            continue
        is_kept = configuration in members and len(own_names) < len(labels)
        pattern = members[configuration] if configuration in members else members[present[0]]
        names = list(dict.fromkeys(configuration_on_surface(configuration, x) for x in own_names))
        if configuration in members and not is_kept:  # replaces the configuration
            members = {
                n: m for key, value in members.items()
                for n, m in (
                    [(n, members.get(n, pattern)) for n in names] if key == configuration else [(key, value)]
                )
            }  # fmt: skip
        else:
            members |= {n: members.get(n, pattern) for n in names}
        first = configuration if is_kept else names[0]
        leaders |= {n: first for n in names if n != first}
    rig = dataclasses.replace(robot.rig, surfaces=tuple(leaders.items()))
    with_surfaces = dataclasses.replace(robot, configurations=Configurations(members), rig=rig)
    priors = values_of_surface_configurations(
        {name: (mean, sd) for name, mean, sd in rig.priors}, with_surfaces, runs
    )
    rig = dataclasses.replace(rig, priors=tuple((name, *value) for name, value in priors.items()))
    return dataclasses.replace(with_surfaces, rig=rig)


def values_of_surface_configurations(stated: Mapping[str, V], robot: Robot, runs: Runs) -> dict[str, V]:
    """Values stated by parameter, with replaced configurations renamed to the configurations of their surfaces.

    Args:
        robot: as returned by `with_surface_configurations`.
    """
    by_name: dict[str, V] = {}
    for name, value in stated.items():
        for new in names_of_surfaces([name], robot, runs):
            by_name[new] = value
    return by_name


def names_of_surfaces(names: Iterable[str], robot: Robot, runs: Runs) -> list[str]:
    """Names of parameters, with replaced configurations renamed to the configurations of their surfaces.

    A parameter of the ground becomes one parameter for each surface. Any other becomes that of the first surface.
    """
    names_found: list[str] = []
    for name in names:
        configuration, _, key = name.partition(".")
        is_replaced = configuration not in robot.configurations and configuration in (
            runs["configuration"] if runs.has("surface") else ()
        )
        if not is_replaced:
            names_found.append(name)
            continue
        surface_names = runs["surface"][runs["configuration"] == configuration]
        on = [
            n
            for n in dict.fromkeys(configuration_on_surface(configuration, s) for s in surface_names)
            if n in robot.configurations
        ]
        names_found += [f"{n}.{key}" for n in (on if key.startswith((GROUND, "*")) else on[:1])]
    return names_found
