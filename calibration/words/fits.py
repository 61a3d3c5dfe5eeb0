"""What is said of a fit, of the loop as of a calibration."""

from __future__ import annotations

from calibration.inference.identifiability import HELD
from calibration.inference.notes import FarFromPrior, HeldByPrior, NoiseOff
from mmrjax import channels


def held_by_prior(note: HeldByPrior) -> str:
    """Which parameters are held by their priors."""
    whose = "its prior" if len(note.names) == 1 else "their priors"
    return f"held by {whose} (posterior sd above {HELD:g} of the prior's): {', '.join(note.names)}"


#: What a parameter far from its prior means, by what it is told of.
FAR = {
    "loop": "{} lies {:.1f} prior sds from its prior: it stands in for something",
}


def far_from_prior(note: FarFromPrior) -> str:
    """A parameter far from its prior, and what that means."""
    return FAR[note.of].format(note.name, note.sds)


def noise_off(note: NoiseOff) -> str:
    """By what sds are off."""
    if not note.channel:
        return (
            f"residuals are {note.factor:.2g} times the {note.source} sds in every channel and everywhere alike: are "
            "the sds right?"
        )
    return (
        f"residuals of {channels.of(note.channel).label} are {note.factor:.2g} times the {note.source} sds, "
        "everywhere alike: are these sds right?"
    )
