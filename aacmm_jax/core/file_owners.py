"""Who owns a file and who may change it: what somebody else could have put there is not believed.

On POSIX only; elsewhere (Windows) access lists say more than a mode does, and everything passes.
"""

import os
import stat
import tempfile

POSIX = os.name == "posix"


def user_name(number: int) -> str:
    """The name of a user, or the number of one without a name."""
    import pwd

    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"user {number}"


def is_ours(status: os.stat_result) -> bool:
    """Whether this process's user owns a file."""
    return not POSIX or status.st_uid == os.geteuid()


def others_may_write(status: os.stat_result) -> bool:
    """Whether anybody but the owner may write to a file or a folder: all users, or a group that is not theirs alone."""
    mode = status.st_mode
    if not POSIX or stat.S_ISLNK(mode):
        return False
    return bool(mode & stat.S_IWOTH or (mode & stat.S_IWGRP and not _is_private(status.st_gid, status.st_uid)))


def others_may_rename(folder: os.stat_result) -> bool:
    """Whether others may put something else in the place of what a folder contains."""
    return others_may_write(folder) and not folder.st_mode & stat.S_ISVTX


def is_planted_link(path: str | os.PathLike) -> bool:
    """Whether a path is a link that another user made in a folder where everybody may make files, such as /tmp.

    Kernels that protect such folders do not follow it either; finding its target by `os.path.realpath` gets round that.
    """
    if not POSIX:
        return False
    try:
        link, folder = os.lstat(path), os.stat(os.path.dirname(path) or ".")
    except (OSError, ValueError):  # there is none
        return False
    shared = others_may_write(folder) and folder.st_uid != link.st_uid
    return stat.S_ISLNK(link.st_mode) and shared and not is_ours(link)


def may_replace(path: str | os.PathLike) -> bool:
    """Whether a file may be replaced, as far as its folder is concerned: of a sticky one, by its owner alone."""
    folder = os.stat(os.path.dirname(path) or ".")
    sticky = POSIX and folder.st_mode & stat.S_ISVTX and os.geteuid() != 0
    return not sticky or is_ours(folder) or is_ours(os.lstat(path))


def _is_private(group: int, user: int) -> bool:
    """Whether a group is that of one user alone: it bears the user's name, or is the first group of no other user."""
    import grp
    import pwd

    try:
        name, entry = pwd.getpwuid(user).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    alone = entry.gr_name == name or {entry.pw_name for entry in pwd.getpwall() if entry.pw_gid == group} == {name}
    return alone and set(entry.gr_mem) <= {name}


def keeps_owners(folder: str | os.PathLike) -> bool:
    """Whether a file system keeps owners and modes (some shares and drives of other systems show all files alike): a
    file that is made in the folder with access for its owner alone is ours and has that access. True where none can be
    made."""
    try:
        with tempfile.TemporaryFile(dir=folder) as probe:
            status = os.fstat(probe.fileno())
    except OSError:
        return True
    return is_ours(status) and not status.st_mode & 0o077
