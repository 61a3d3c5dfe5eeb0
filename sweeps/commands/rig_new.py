"""The command `rig new`: writes a rig file template, with the source of each number."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from calibration.data.input_errors import BadConfiguration, allowed_words
from calibration.data.input_files import file_bytes
from calibration.data.stated import EXAMPLE, example_numbers
from calibration.data.writing import write_text
from sweeps.commands.rig_numbers import (
    KINDS,
    JointNumbers,
    StatedNumber,
    fill_rig_template,
    free_unstated_losses,
    read_data_sheet,
    rig_template,
)
from sweeps.console import print_output

#: Kind of rig if neither an option nor a model states one.
USUAL = "bench"
#: Largest model that is read [bytes].
LARGEST = 2**26


def joint_numbers(source: Path, joint: str | None) -> JointNumbers:
    """Numbers of a driven joint of a URDF or MuJoCo model. The first element of the file determines the format.

    Args:
        joint: name of the joint. None: the only driven one.

    Raises:
        BadConfiguration: the file is missing or has another format, or the joint is missing or does not turn.
    """
    content = file_bytes(source, source, BadConfiguration, LARGEST)
    try:
        _, root = next(ElementTree.iterparse(io.BytesIO(content), ("start",)))
        if root.tag == "robot":
            from sweeps.commands import rig_from_urdf

            robot = rig_from_urdf.UrdfRobot(ElementTree.fromstring(content), source.name)
            return robot.numbers(robot.turning_joint(joint))
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # unknown encoding
        raise BadConfiguration(
            f"{source}: not a readable XML file ({error}); expected URDF or MuJoCo's XML"
        ) from error
    if root.tag != "mujoco":
        raise BadConfiguration(f"{source}: got <{root.tag}>; expected <robot> of URDF or <mujoco>")
    from sweeps.commands import rig_from_mujoco

    return rig_from_mujoco.read_mujoco_hinge(source, joint)


def new_rig_text(kind: str | None, source: Path | None, joint: str | None, sheet: Mapping[str, str] | None) -> str:
    """Text of a rig file with the numbers of a joint and a data sheet.

    Args:
        kind: kind of rig. None: that of the joint's load, otherwise `USUAL`.
        source: model file.
        joint: name of the joint.
        sheet: numbers of a data sheet by name.

    Raises:
        BadConfiguration: for the same reasons as `joint_numbers` and `rig_numbers.read_data_sheet`.
    """
    numbers: dict[str, StatedNumber] = {}
    origins = []
    if source is not None:
        joint_model = joint_numbers(source, joint)
        kind = joint_model.kind(kind)
        numbers |= joint_model.numbers(kind)
        origins.append(f"joint {joint_model.joint} of {joint_model.file}")
    if sheet is not None:
        numbers |= read_data_sheet(sheet)
        origins.append("a data sheet")
    kind = kind or USUAL
    if not origins:
        return rig_template(kind)
    if source is not None:
        numbers = free_unstated_losses(kind, numbers)
    origin = f"kind {kind}, filled from {' and '.join(origins)}"
    return fill_rig_template(kind, numbers, f"{origin}. Comments name sources, and each ± is a guess.")


def write_new_rig(
    file: Path,
    kind: str | None,
    force: bool,
    source: Path | None = None,
    joint: str | None = None,
    sheet: Mapping[str, str] | None = None,
) -> int:
    """Writes a rig file template, or a rig file with the numbers of a model or data sheet. Returns 0.

    Args:
        kind, source, joint, sheet: as in `new_rig_text`.

    Raises:
        BadConfiguration: a kind, model, joint or folder does not exist, the data sheet is contradictory, or the file
            exists and `force` is false.
    """
    if joint is not None and source is None:
        raise BadConfiguration(f"--joint: got {joint} without --from; expected a model that has this joint")
    if kind is not None and kind not in KINDS:
        kinds = "; ".join(f"{name}: {instruction}" for name, instruction in KINDS.items())
        raise BadConfiguration(f"--kind: got {kind}; {allowed_words(kind, KINDS)} ({kinds})")
    if file.exists() and (file.is_dir() or not force):
        instruction = (
            "a folder; give a file, such as my-rig.toml" if file.is_dir() else ("already exists; --force replaces it")
        )
        raise BadConfiguration(f"{file}: {instruction}")
    if not file.parent.is_dir():
        raise BadConfiguration(f"{file}: the folder {file.parent} does not exist; create it first")
    text = new_rig_text(kind, source, joint, sheet)
    if source is None and sheet is None:
        instruction = f'{KINDS[kind or USUAL]}. Replace the numbers marked "{EXAMPLE}" with your own, then'
    else:
        lacking = ", ".join(f"{name} {unit}".rstrip() for name, unit in example_numbers(text).items())
        instruction = text.removeprefix("# ").partition("; a comment")[0]
        instruction += f"; not found, so fill in: {lacking}. Then" if lacking else ". Next"
    try:
        write_text(file, text)
    except OSError as error:
        raise BadConfiguration(f"{file}: cannot be written ({error.strerror}); choose another path") from error
    print_output(f"{file}: {instruction}: mmrjax rig check {file} [DATA.csv]")
    return 0
