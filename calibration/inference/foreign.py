"""Priors inherited from another robot: a file changes a part of the nominal robot but not the friction of that
part.
"""

from __future__ import annotations

from collections.abc import Collection

from calibration.inference.fit_notes import Remark
from calibration.inference.priors import FRICTION, GUIDE_FRICTION, GUIDE_SHARE, parameters_by_name
from mmrjax.model import paper_robots
from mmrjax.model.robot import Robot

#: Values of a part that makers and scales state, and values of its friction measured on the nominal robot.
DRIVE = {
    "motor": (("resistance", "torque_constant"), ("friction_coulomb", "friction_viscous")),
    "gearbox": (("ratio",), ("efficiency_load", "friction_coulomb", "friction_viscous")),
}
CHASSIS, GUIDES = (("mass", "radius"), FRICTION), (GUIDE_SHARE, GUIDE_FRICTION)
#: Relative difference above which a stated value belongs to another part [-].
DIFFERS = 0.2


def inherited_friction_remarks(robot: Robot, stated: Collection[str] = ()) -> list[Remark]:
    """Remarks on parts that differ from those of the nominal robot but have the same friction. Empty for a rig
    without inheritance.

    A configuration is compared with the one of the nominal robot that has the same friction.

    Args:
        stated: names of the parameters whose priors the user states.
    """
    if not robot.rig.inherits:
        return []
    own_friction, nominal = (
        {name: float(p.value) for name, p in parameters_by_name(r).items()} for r in (robot, paper_robots.nominal())
    )
    pairs = [(part, part, *DRIVE[part]) for part in DRIVE]
    pairs += [(c, other, *CHASSIS) for c in robot.configurations for other in paper_robots.nominal().configurations]
    inherited: dict[str, Remark] = {}
    for part, other, sheet, friction in pairs:
        on_tracks = part in robot.configurations and float(robot.configurations[part].on_tracks) > 0.5
        guides = GUIDES if on_tracks else ()
        kept_priors = tuple(
            f"{part}.{name}"
            for name in (*friction, *guides)
            if own_friction[f"{part}.{name}"] == nominal[f"{other}.{name}"] != 0 and f"{part}.{name}" not in stated
        )
        changed = tuple(
            (name, own_friction[f"{part}.{name}"], nominal[f"{other}.{name}"])
            for name in sheet
            if abs(own_friction[f"{part}.{name}"] / nominal[f"{other}.{name}"] - 1) > DIFFERS
        )
        if len(kept_priors) > len(inherited[part].kept if part in inherited else ()):
            inherited[part] = Remark("inherited_priors", part=part, changed=changed, kept=kept_priors)
    return [note for note in inherited.values() if note.changed]
