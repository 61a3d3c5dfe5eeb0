"""Identity of a sweep: two with the same identity give the same numbers, bit by bit, on one machine."""

from __future__ import annotations

import functools
import importlib.metadata
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path

from calibration.data import Json
from calibration.data.input_errors import BadConfiguration
from mmrjax.model import params
from mmrjax.model.robot import Robot
from sweeps.config import Part
from sweeps.store import PACKAGES, sha256_hex

#: Packages besides those of every result whose version is part of a sweep's identity.
FURTHER = ("scipy", "zarr")

Identity = dict[str, dict[str, str]]


def job_identity(config: Part, robot: Robot, files: Iterable[str], device: str) -> Identity:
    """Sections, each of words by key: configuration, data, code, versions, device.

    Args:
        config: of the sweep, chunk and outputs resolved; files: that it reads; device: kind of the devices.

    Raises:
        BadConfiguration: a file that cannot be read.
    """
    configuration = _flat(config.model_dump(mode="json", exclude={"report", "table"}), "")
    configuration |= {f"robot {p.name}": repr(float(p.value)) for p in params.walk_parameters(robot)}
    return {
        "configuration": configuration,
        "data": {file: _hash(file) for file in files},
        "code": module_hashes(),
        "versions": {"python": platform.python_version(), **installed_versions((*PACKAGES, *FURTHER))},
        "device": {"device": device},
    }


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Installed versions by package."""
    return {name: importlib.metadata.version(name) for name in packages}


@functools.cache
def _code() -> tuple[tuple[str, str], ...]:
    root = Path(__file__).resolve().parents[2]
    files = sorted(file for package in ("mmrjax", "calibration", "sweeps") for file in (root / package).rglob("*.py"))
    return tuple((str(file.relative_to(root)), sha256_hex(file.read_bytes())[:16]) for file in files)


def module_hashes() -> dict[str, str]:
    """Hash of each module of this program."""
    return dict(_code())


def _hash(file: str) -> str:
    try:
        return sha256_hex(Path(file).read_bytes())
    except OSError as error:
        raise BadConfiguration(f"{file}: cannot be read ({error.strerror})") from error


def _flat(content: Json, prefix: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = repr(value)
    return found


def identity_differences(
    stored: Mapping[str, Mapping[str, str]], now: Mapping[str, Mapping[str, str]], most: int = 3
) -> str:
    """In which sections two identities differ, with the first keys; empty where they do not."""
    said = []
    for section in dict.fromkeys((*now, *stored)):
        old, new = stored.get(section, {}), now.get(section, {})
        keys = [key for key in dict.fromkeys((*new, *old)) if old.get(key) != new.get(key)]
        if keys:
            shown = [f"{key}{_change(old.get(key), new.get(key), section)}" for key in keys[:most]]
            more = f" and {len(keys) - most} more" if len(keys) > most else ""
            said.append(f"{section} ({', '.join(shown)}{more})")
    return "; ".join(said)


def _change(old: str | None, new: str | None, section: str) -> str:
    if old is None or new is None:
        return " is new" if old is None else " is gone"
    # hashes say nothing to a person, and a long list not much
    return "" if section in ("data", "code") or len(old) + len(new) > 80 else f" was {old}, is {new}"
