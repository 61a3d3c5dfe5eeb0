"""The command `rig new`: a rig's file to fill in, with where each number comes from."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from calibration.data.input_errors import BadConfiguration, allowed_words
from sweeps.console import say

#: Kinds of rig, in words.
KINDS = {
    "bench": "a motor with its gearbox that turns a shaft: brake, disk, worm, winch",
    "dyno": "a motor against a brake whose torque is set and read",
    "pendulum": "a servo with an arm that gravity pulls",
    "servo": "a servo driven by PWM, whose angle is logged",
    "linear": "a carriage on a screw, a belt or a rope",
    "carriage": "the same on an amplifier that controls the current, with its position logged",
    "wheeled": "a robot on wheels",
    "tracked": "a robot on tracks",
}


def template(kind: str) -> str:
    """The file of a kind, to fill in."""
    return resources.files("sweeps").joinpath("rigs", f"{kind}.toml").read_text(encoding="utf-8")


def new(file: Path, kind: str, force: bool, source: Path | None = None, joint: str | None = None) -> int:
    """Write a rig's file to fill in, or the file of a joint of a model; returns 0.

    Args:
        source: the model; None: a file of a kind; joint: its name in the model.

    Raises:
        BadConfiguration: no such kind, model, joint or folder, or a file that exists without `force`.
    """
    if joint is not None and source is None:
        raise BadConfiguration(f"--joint: got {joint} without --from; expected a model that has this joint")
    if kind not in KINDS:
        each = "; ".join(f"{name}: {what}" for name, what in KINDS.items())
        raise BadConfiguration(f"--kind: got {kind}; {allowed_words(kind, KINDS)} ({each})")
    if file.exists() and (file.is_dir() or not force):
        what = "a folder; state a file, as my-rig.toml" if file.is_dir() else "there already; --force replaces it"
        raise BadConfiguration(f"{file}: {what}")
    if not file.parent.is_dir():
        raise BadConfiguration(f"{file}: no such folder as {file.parent}; make it first")
    if source is None:
        written, what = template(kind), f"{KINDS[kind]}. Fill in what is marked example: yours, then"
    else:
        from sweeps.commands import rig_from_model

        written, what = rig_from_model.text(source, joint), f"the joint of {source}. Next"
    try:
        file.write_text(written, encoding="utf-8")
    except OSError as error:
        raise BadConfiguration(f"{file}: cannot be written ({error.strerror}); state a file elsewhere") from error
    say(f"{file}: {what}: mmrjax rig check {file} [DATA.csv]")
    return 0
