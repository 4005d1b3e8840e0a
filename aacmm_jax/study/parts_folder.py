"""Whose blocks are believed: those in a folder of the user who runs the study, or who owns the file that is read.

All is checked before anything in the folder is read or removed. What has been checked may be opened by its name
afterwards, by HDF5 too, which opens the blocks of a virtual array itself: nobody but the folder's owner can replace it.
"""

import os
import stat
import warnings
from pathlib import Path

from ..core.errors import InputError
from ..core.file_owners import POSIX, is_ours, is_planted_link, keeps_owners, others_may_write, user_name
from .blocks import parts_of


def check_ours(path: Path) -> None:
    """Raise `InputError` where a study that is to be run or continued is somebody else's, or its folder of blocks."""
    for item in (path, parts_of(path)):
        found = _status(item)
        if found is None:
            continue
        if not is_ours(found):
            _refuse(
                item,
                f"{item} belongs to {user_name(found.st_uid)}, so its results are not continued; choose another output "
                "path.",
            )
    _check_folder(parts_of(path))


def check_readable(path: Path) -> None:
    """Raise `InputError` where the blocks of a study that is read are neither ours nor those of who owns its file."""
    found = _status(parts_of(path))
    if found is None or not POSIX:
        return
    owner = os.stat(path).st_uid
    if found.st_uid != owner and not is_ours(found):
        raise InputError(
            f"{parts_of(path)} belongs to {user_name(found.st_uid)}, but {path.name} to {user_name(owner)}, so its "
            "blocks are not read; have one user own both."
        )
    _check_folder(parts_of(path))


def check_block(file: Path) -> None:
    """Raise `InputError` where a block is a link, or not the property of who owns its folder."""
    found = _status(file)
    if found is None or not POSIX:
        return
    if stat.S_ISLNK(found.st_mode):
        raise InputError(f"{file} is a link, so it is not read; remove it, and run the study again with --resume.")
    if found.st_uid != os.stat(file.parent).st_uid:
        raise InputError(
            f"{file} belongs to {user_name(found.st_uid)}, who does not own its folder, so it is not read; remove it, "
            "and run the study again with --resume."
        )


def refuse_planted(path: str | os.PathLike) -> None:
    """Raise `InputError` where the path of a study is another user's link in a folder where everybody may make one."""
    if is_planted_link(path):
        raise InputError(f"{path} cannot be written: it is another user's link; choose another output path.")


def _check_folder(folder: Path) -> None:
    found = _status(folder)
    if found is None:
        return
    if stat.S_ISLNK(found.st_mode):
        raise InputError(
            f"{folder} is a link, so the blocks in it are not read; put the folder itself there, or remove the link."
        )
    if others_may_write(found):
        _refuse(
            folder,
            f"others may write to {folder} (mode {stat.S_IMODE(found.st_mode):04o}), so the blocks in it are not read; "
            f"if they are yours, run chmod go-w '{folder}', otherwise remove it.",
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
