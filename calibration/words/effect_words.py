"""Description of an effect, and tests that distinguish it from others on a bench."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.words.experiment_words import ACTS, DOING
from mmrjax.effects import OF_TURNS, Effect
from mmrjax.effects.base import THE_SIDE
from mmrjax.model.channels import find_channel

#: Tests that isolate a balance: rows of `experiments.DOING`, `weigh`, and of a channel of `sensor` rows of `ACTS`.
ISOLATED_BY = {
    "mass": ("weigh",), "duty": ("alone",), "supply": ("held", "one held"), "electrical": ("held", "alone"),
    "motor": ("alone",),
    "gearbox": ("braked", "lifted"), "track": ("lifted",), "ground": ("laden", "about"), "slip": ("laden",),
    "inertia": ("lifted",), "inductance": ("held",),
}  # fmt: skip
CHECKED_BY = {"total_current": ("zero current", "shunt"), "motor_speed": ("strobe",), "speed": ("timing",)}
#: Test of any other channel.
COMPARE = "Read a second instrument next to that of the {}, at several values"
#: Condition to vary, all others constant, so that a term that depends on a signal changes.
VARY = {
    "speed": "the speed (the supply voltage)", "current": "the current (slope or payload at one voltage)",
    "load": "the load (slope or payload at one voltage)", "slope": "the slope", "weight": "the payload",
    "duty": "the duty at one supply voltage",
    "configuration": "the configuration", "direction": "the direction of travel",
    "demand": "the demand on adhesion (slope or payload)", "angle": "nothing: sample fast enough to see a turn",
    THE_SIDE: "nothing: compare the sides in straight travel and in turns both ways",
    "position": "the position: go over the whole travel both ways at one voltage",
    "": "nothing: it is the same share everywhere",
}  # fmt: skip
WEIGH = "Weigh the robot, unladen and laden, and take the stated mass from it"


def effect_summary(effect: type[Effect]) -> tuple[str, str, str]:
    """Equation, meaning and source of an effect, each on one line."""
    text, _, source = (effect.__doc__ or "").partition("Source:")
    equation, meaning = ([" ".join(part.split()) for part in text.split("\n\n")] + [""])[:2]
    return equation.rstrip("."), meaning, " ".join(source.split())


def effect_declarations(effect: type[Effect]) -> Iterator[str]:
    """Declarations of an effect in addition to its equation."""
    words = [
        "dissipative" * effect.dissipative,
        "in histories alone" * effect.transient,
        "in turns alone" * (effect.name in OF_TURNS),
        f"settles to `{effect.settles_to}`" * bool(effect.settles_to),
        "on the battery alone" * effect.needs_battery,
        "in runs both ways alone" * effect.needs_reverse,
        "at a duty below 1 alone" * effect.needs_duty,
        "odd in travel" * effect.odd_in_travel,
        f"on {effect.movers} alone" * bool(effect.movers),
        f"rests on `{', '.join(effect.rests_on)}`" * bool(effect.rests_on),
    ]
    yield from filter(None, words)


def effect_tests(effect: type[Effect]) -> Iterator[str]:
    """Bench tests that distinguish it from other effects: how to isolate its balance, and the change to make."""
    if effect.channel:
        for name in CHECKED_BY.get(effect.channel, ()):
            yield ACTS[name].format("several values")
        if effect.channel not in CHECKED_BY:
            channel_shown = find_channel(effect.channel)
            yield from [ACTS["zero reading"].format(channel_shown.label)] * channel_shown.misses_zero
            yield COMPARE.format(channel_shown.label)
        return
    for name in ISOLATED_BY.get(effect.balance, ()):
        if name == "weigh":
            yield WEIGH
        else:
            text = DOING[name].format(
                payload=8,
                brake=20,
                others="all motors but one disconnected",
                gears="gearboxes",
                shafts="the motor shafts",
            )
            yield f"{text[0].upper()}{text[1:].rstrip(',')}, at several voltages"
    what = VARY.get(effect.driver, f"the {effect.driver}")  # one's own may go with anything
    yield f"Vary {what}" + ("; from rest, over time" if effect.transient or effect.settles_to else "")
