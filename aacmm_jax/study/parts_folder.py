"""Whose blocks are believed: those in a folder of the user who runs the study, or who owns the file that is read.

All is checked before anything in the folder is read or removed. What has been checked may be opened by its name
afterwards: nobody but the folder's owner can replace it.
"""

import os
import stat
import warnings
from pathlib import Path

from ..core.errors import InputError
from ..core.file_owners import POSIX, is_ours, keeps_owners, others_may_write, user_name
from .blocks import parts_of


def check_ours(path: Path) -> None:
    """Raise `InputError` where a study that is to be run or continued is somebody else's, or its folder of blocks."""
    for item in (path, parts_of(path)):
        status = _status(item)
        if status is not None and not is_ours(status):
            _refuse(
                item,
                f"{item} belongs to {user_name(status.st_uid)}, so its results are not continued; choose another "
                "output path.",
            )
    _check_folder(parts_of(path))


def check_readable(path: Path) -> None:
    """Raise `InputError` where the blocks of a study that is read are neither ours nor those of who owns its file."""
    folder = parts_of(path)
    status = _status(folder)
    if status is None or not POSIX:
        return
    owner = os.stat(path).st_uid
    if status.st_uid != owner and not is_ours(status):
        raise InputError(
            f"{folder} belongs to {user_name(status.st_uid)}, but {path.name} to {user_name(owner)}, so its blocks are "
            "not read; have one user own both."
        )
    _check_folder(folder)


def check_block(file: Path) -> None:
    """Raise `InputError` where a block is a link, or not the property of who owns its folder."""
    status = _status(file)
    if status is None or not POSIX:
        return
    what = "is a link" if stat.S_ISLNK(status.st_mode) else ""
    if not what and status.st_uid != os.stat(file.parent).st_uid:
        what = f"belongs to {user_name(status.st_uid)}, who does not own its folder"
    if what:
        raise InputError(f"{file} {what}, so it is not read; remove it, and run the study again with --resume.")


def _check_folder(folder: Path) -> None:
    status = _status(folder)
    if status is None:
        return
    if stat.S_ISLNK(status.st_mode):
        raise InputError(
            f"{folder} is a link, so the blocks in it are not read; put the folder itself there, or remove the link."
        )
    if others_may_write(status):
        _refuse(
            folder,
            f"others may write to {folder} (mode {stat.S_IMODE(status.st_mode):04o}), so the blocks in it are not "
            f"read; if they are yours, run chmod go-w '{folder}', otherwise remove it.",
        )


def _refuse(path: Path, sentence: str) -> None:
    """Raise `InputError`, unless the file system says nothing of owners: then a warning says that none are checked."""
    if keeps_owners(path.parent):
        raise InputError(sentence)
    warnings.warn(
        f"the file system of {path.parent} does not keep who owns a file, so nothing shows whether somebody else wrote "
        "the blocks of this study.",
        UserWarning,
        stacklevel=3,
    )


def _status(path: Path) -> os.stat_result | None:
    try:
        return os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
