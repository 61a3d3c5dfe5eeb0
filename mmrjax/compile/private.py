"""Folders that only the user can change. Native code is read only from these."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def exposure_reason(folder: Path) -> str:
    """Reason why another user could place files in a folder, empty if only the user and root can.

    The folder and its files have to belong to the user, and neither the group nor others may write to it. Each folder
    above it has to belong to the user or to root, and be sticky if others may write to it: they could rename it.

    Args:
        folder: may not exist yet. The folders above it are checked then.
    """
    if not hasattr(os, "geteuid"):  # a system without owners and modes
        return ""
    absolute_folder = folder.absolute()
    try:
        for part in (absolute_folder, *absolute_folder.parents):
            if part.exists() and (reason := _folder_exposure_reason(part, part == absolute_folder)):
                return reason
        if absolute_folder.resolve() != absolute_folder:
            return exposure_reason(absolute_folder.resolve())
        for entry in absolute_folder.iterdir() if absolute_folder.is_dir() else ():
            if entry.lstat().st_uid != os.geteuid():
                return f"{entry} belongs to another user"
    except OSError as error:
        return f"{error.filename or folder}: {error.strerror}"
    return ""


def _folder_exposure_reason(part: Path, itself: bool) -> str:
    """Reason why another user could replace a folder above, or place files in the folder itself."""
    state = part.stat(follow_symlinks=itself)
    if state.st_uid != os.geteuid() and (itself or state.st_uid != 0):
        return f"{part} belongs to another user"
    writable = state.st_mode & stat.S_IWOTH or (state.st_mode & stat.S_IWGRP and not _own_group(state.st_gid))
    sticky = state.st_mode & stat.S_ISVTX and not itself
    if writable and not sticky and not stat.S_ISLNK(state.st_mode):
        return f"others may write to {part}"
    return ""


def _own_group(group: int) -> bool:
    """True if a group has the user's name: many systems create one for each user."""
    import grp
    import pwd

    try:
        return grp.getgrgid(group).gr_name == pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return False
