"""Compiled programs are kept between processes, in the user's own cache folder; set up when the package is imported.

They are native code, which is run as it is read. So a folder is not used where anybody else can write to it, or can
have written what is in it, be it the default one or one that JAX_COMPILATION_CACHE_DIR names. AACMM_JAX_CACHE=0 leaves
JAX's setting alone, unchecked.

JAX never replaces an entry, so one that was cut off as it was written (the process was killed, the disk was full) would
make it warn in every process for ever. In the default folder, which exists because of this package, such entries are
removed: each import reads those that are newer than the file `checked`, which it dates by the newest. A folder that
the user names is JAX's and the user's own.
"""

import contextlib
import os
import stat
import sys
import warnings
from importlib import import_module
from pathlib import Path

from .file_owners import POSIX, is_ours, others_may_rename, others_may_write

_LEAST_SECONDS = "0.1"  # shorter compilations are not kept: reading them would take as long
_FOLDER, _TURNED_OFF = "JAX_COMPILATION_CACHE_DIR", "AACMM_JAX_CACHE"
_SHORTEST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
_ENTRY, _CHECKED = "-cache", "checked"  # how JAX's names end, and a file of ours
_ZLIB = b"\x78"  # begins what JAX compresses where it has no Zstandard


def set_up() -> None:
    """Tell JAX, by its environment where it is not imported yet, so that processes started from here have it too."""
    if os.environ.get(_TURNED_OFF, "").strip().lower() in {"0", "false", "off", "no"}:
        return
    jax = sys.modules.get("jax")
    given = os.environ.get(_FOLDER)
    if jax is not None:
        given = jax.config.jax_compilation_cache_dir or given
    if given == "" or (given is not None and "://" in given):  # turned off, or in a bucket with rules of its own
        return
    folder = _default_folder() if given is None else Path(given)
    if folder is None:
        return
    try:
        unsafe = _unsafe(folder)
    except OSError:  # there is none, and it cannot be made
        return
    usable = None if unsafe else str(folder)
    if unsafe:
        os.environ.pop(_FOLDER, None)
        os.environ[_TURNED_OFF] = "0"  # for processes started from here
        warnings.warn_explicit(
            f"the compilation cache {folder} is not used, because {unsafe}, and what is read there is run; remove the "
            f"folder, which is then made anew, or set {_FOLDER} to one that only you can write to.",
            UserWarning,
            "aacmm_jax",
            1,
        )
    else:
        os.environ[_FOLDER] = str(folder)
    if given is None and not unsafe:
        with contextlib.suppress(OSError):  # read-only, or another process was faster
            _remove_damaged(folder)
        if jax is not None and _SHORTEST not in os.environ:
            jax.config.update("jax_persistent_cache_min_compile_time_secs", float(_LEAST_SECONDS))
        os.environ.setdefault(_SHORTEST, _LEAST_SECONDS)
    if jax is not None:
        jax.config.update("jax_compilation_cache_dir", usable)


def _default_folder() -> Path | None:
    """The package's folder in the user's cache folder; None for a user without a home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aacmm_jax"
    except RuntimeError:
        return None


def _unsafe(folder: Path) -> str:
    """Why others could put programs into a folder, which is made if there is none; empty where only the user can."""
    if not folder.is_absolute():
        return "its path is relative, so it depends on where a program is started"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not POSIX:
        return ""
    folder = folder.resolve()
    status = folder.stat()
    if not is_ours(status):
        return "it belongs to another user"
    if status.st_mode & 0o022:
        return f"others may write to it (mode {stat.S_IMODE(status.st_mode):04o})"
    owner, others_may_enter = status.st_uid, status.st_mode & 0o011
    # Whoever can rename a folder above can put another one there.
    for above in folder.parents:
        status = above.stat()
        if status.st_uid != 0 and not is_ours(status):
            return f"{above} belongs to another user"
        if others_may_rename(status):
            return f"others may write to {above} (mode {stat.S_IMODE(status.st_mode):04o})"
    # What was put there while others could: JAX reads it by its name, and a link leads to where others may write now.
    with os.scandir(folder) as entries:
        for entry in entries:  # of which there may be thousands: 2 microseconds each
            with contextlib.suppress(FileNotFoundError):  # another process has removed it
                status = entry.stat(follow_symlinks=False)
                changeable = others_may_enter and status.st_mode & 0o022 and others_may_write(status)
                if status.st_uid != owner or changeable or entry.is_symlink():
                    return f"others can have written {entry.name} in it"
    return ""


def _remove_damaged(folder: Path) -> None:
    """Remove the entries written since the last check that end too early.

    To read 1,000 takes about a second, and they took minutes to compile. An entry that another process is just writing
    may be removed too; it is then compiled once more.
    """
    checked = folder / _CHECKED
    before = checked.stat().st_mtime_ns if checked.exists() else -1
    with os.scandir(folder) as entries:
        written = {entry.path: entry.stat().st_mtime_ns for entry in entries if entry.name.endswith(_ENTRY)}
    new = [Path(path) for path, time in written.items() if time > before]
    for entry in new:
        if not _complete(entry.read_bytes()):
            entry.unlink()
    if new:
        checked.touch(mode=0o600)
        os.utime(checked, ns=(max(written.values()), max(written.values())))


def _complete(content: bytes) -> bool:
    """Whether an entry of the cache can be decompressed; also true where this process lacks what tells it."""
    modules = ("zlib",) if not content or content.startswith(_ZLIB) else ("compression.zstd", "zstandard")
    for name in modules:  # Zstandard is Python's own since 3.14
        with contextlib.suppress(ImportError):
            module = import_module(name)
            try:
                module.decompress(content)
            except getattr(module, "error" if name == "zlib" else "ZstdError"):
                return False
    return True
