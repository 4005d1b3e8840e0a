"""JAX as this package needs it: 64-bit floats, a platform that it can start on, and compiled programs that are kept.

Importing this module, before anything else of the package, turns on 64-bit floats: a calibration in float32 is wrong by
tens of micrometres without any sign of it.

In Python the platform is a setting of the whole program, so that it is not changed there: a sentence says what is wrong
with it. It is a `RuntimeError`, as JAX's own, and no `InputError`: to those, readers add the name of a file.

Compiled programs are kept between processes, in the user's own cache folder. They are native code, which is run as it
is read. So a folder is not used where anybody else can write to it, or can have written what is in it, be it the
default one or one that JAX_COMPILATION_CACHE_DIR names. AACMM_JAX_CACHE=0 leaves JAX's setting alone, unchecked.
"""

import contextlib
import functools
import os
import stat
import sys
import warnings
from importlib import import_module
from pathlib import Path

from .errors import InputError
from .file_owners import POSIX, is_ours, others_may_rename, others_may_write

LARGEST_INTEGER = 2**63 - 1  # of 64 bits; no seed may be larger
_NO = {"0", "false", "off", "no"}
_PLATFORMS = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")  # environment variables; the second is an older name
_GUARDS = [f"JAX_TRANSFER_GUARD{kind}" for kind in ("", "_HOST_TO_DEVICE", "_DEVICE_TO_DEVICE", "_DEVICE_TO_HOST")]
_LEAST_SECONDS = "0.1"  # shorter compilations are not kept: reading them would take as long
_FOLDER, _TURNED_OFF = "JAX_COMPILATION_CACHE_DIR", "AACMM_JAX_CACHE"
_SHORTEST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
_ENTRY, _CHECKED = "-cache", "checked"  # how JAX's names end, and a file of ours
_ZLIB = b"\x78"  # begins what JAX compresses where it has no Zstandard


def _turn_on_x64() -> None:
    setting = os.environ.get("JAX_ENABLE_X64")
    if setting is not None and setting.strip().lower() in _NO:
        refusal = (
            f"aacmm_jax needs 64-bit floats, but JAX_ENABLE_X64={setting} turns them off, and a calibration in "
            "float32 is wrong by tens of micrometres; unset JAX_ENABLE_X64 or set it to 1."
        )
        # The command line imports the package before any code of its own can catch this.
        if Path(sys.argv[0]).stem == "aacmm" or (sys.argv[0] == "-m" and "aacmm_jax" in sys.orig_argv):
            print(f"Error: {refusal}", file=sys.stderr)
            sys.exit(2)
        raise ImportError(refusal)
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", True)
    else:
        os.environ["JAX_ENABLE_X64"] = "1"  # read when JAX is imported, a second that ``aacmm --help`` can save


_turn_on_x64()


def check_x64() -> None:
    """Raise `InputError` where 64-bit floats were turned off after the import, and what `check_setting` raises."""
    import jax

    check_setting()
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError(
            "64-bit floats were turned off after aacmm_jax was imported, and a calibration in float32 is wrong by tens "
            "of micrometres; call aacmm_jax outside jax.enable_x64(False), or call jax.config.update('jax_enable_x64', "
            "True)."
        )


def _told() -> str:
    """The settings that name more than the CPU; where there are none, JAX takes what is there."""
    given = {name: os.environ.get(name, "") for name in _PLATFORMS}
    return " and ".join(f"{name}={value}" for name, value in given.items() if value not in ("", "cpu"))


def check_backend() -> None:
    """Raise `RuntimeError` where JAX has been imported and cannot start."""
    jax = sys.modules.get("jax")
    if jax is None:
        return
    try:
        jax.devices()
    except Exception as error:  # a RuntimeError, or an AssertionError where nothing that is named is there
        told = _told()
        device = f"device for {told}" if told else "device"
        advice = "remove this setting" if told else "see the message of JAX"
        raise RuntimeError(
            f"JAX cannot start, because this installation of JAX finds no {device}; {advice}, or set JAX_PLATFORMS=cpu."
        ) from error


@functools.cache
def check_setting() -> None:
    """The same, once, where a setting names more than the CPU; otherwise JAX is not started for it."""
    if _told():
        check_backend()


def prepare_command() -> str | None:
    """Before a command computes: go on on the CPU where JAX cannot start on what it is told to use; a sentence says so.

    Settings that are for finding copies to and from a device in programs with jit forbid what a command does.
    """
    for name in _GUARDS:
        os.environ.pop(name, None)
    if not _told():
        return None
    import jax

    try:
        check_backend()
    except RuntimeError as error:
        for name in _PLATFORMS:
            if name in os.environ:
                os.environ[name] = "cpu"  # for processes started from here
                jax.config.update(name.lower(), "cpu")
        check_backend()
        return f"Warning: {str(error).partition(';')[0]}; computing on the CPU instead."
    return None


def is_from_jax(error: BaseException) -> bool:
    """Whether JAX itself raised an exception, for its own reasons: no memory on a device, a setting that forbids."""
    return any(kind.__module__.partition(".")[0] in ("jax", "jaxlib") for kind in type(error).__mro__)


def set_up() -> None:
    """Have JAX keep programs, by its environment where it is not imported yet, so that processes started from here do
    too."""
    if os.environ.get(_TURNED_OFF, "").strip().lower() in _NO:
        return
    jax, given = sys.modules.get("jax"), os.environ.get(_FOLDER)
    if jax is not None:
        given = jax.config.jax_compilation_cache_dir or given
    if given == "" or (given is not None and "://" in given):  # turned off, or in a bucket with rules of its own
        return
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache" if given is None else ""
        folder = Path(home) / "aacmm_jax" if given is None else Path(given)
        unsafe = _unsafe(folder)
    except (OSError, RuntimeError):  # there is no folder, and it cannot be made; or the user has no home
        return
    if unsafe:
        os.environ.pop(_FOLDER, None)
        os.environ[_TURNED_OFF] = "0"  # for processes started from here
        warnings.warn_explicit(
            f"the compilation cache {folder} is not used, because {unsafe}, and aacmm_jax would run programs that "
            f"others may have put there; remove the folder (aacmm_jax then creates a new one), or set {_FOLDER} to a "
            "folder that only you can write to.",
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
        jax.config.update("jax_compilation_cache_dir", None if unsafe else str(folder))


def _unsafe(folder: Path) -> str:
    """Why others could put programs into a folder, which is made if there is none; empty where only the user can."""
    if not folder.is_absolute():
        return "its path is relative, so the folder depends on the current directory"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not POSIX:
        return ""
    folder = folder.resolve()
    status = folder.stat()
    if not is_ours(status):
        return "it belongs to another user"
    if status.st_mode & 0o022:
        return f"other users may write to it (mode {stat.S_IMODE(status.st_mode):04o})"
    owner, others_may_enter = status.st_uid, status.st_mode & 0o011
    # Whoever can rename a folder above can put another one there.
    for above in folder.parents:
        status = above.stat()
        if status.st_uid != 0 and not is_ours(status):
            return f"{above} belongs to another user"
        if others_may_rename(status):
            return f"other users may write to {above} (mode {stat.S_IMODE(status.st_mode):04o})"
    # What was put there while others could: JAX reads it by its name, and a link leads to where others may write now.
    with os.scandir(folder) as entries:
        for entry in entries:  # of which there may be thousands: 2 microseconds each
            with contextlib.suppress(FileNotFoundError):  # another process has removed it
                status = entry.stat(follow_symlinks=False)
                changeable = others_may_enter and status.st_mode & 0o022 and others_may_write(status)
                if status.st_uid != owner or changeable or entry.is_symlink():
                    return f"other users may have written {entry.name} in this folder"
    return ""


def _remove_damaged(folder: Path) -> None:
    """Remove the entries of the default folder, newer than the file `checked`, that end too early.

    JAX never replaces an entry, so one that was cut off as it was written (the process was killed, the disk was full)
    would make it warn in every process for ever. To read 1,000 takes about a second, and they took minutes to compile.
    One that another process is just writing may be removed too; it is then compiled once more.
    """
    checked = folder / _CHECKED
    before = checked.stat().st_mtime_ns if checked.exists() else -1
    with os.scandir(folder) as entries:
        written = {entry.path: entry.stat().st_mtime_ns for entry in entries if entry.name.endswith(_ENTRY)}
    new = [Path(path) for path, time in written.items() if time > before]
    for entry in new:
        if not _is_complete(entry.read_bytes()):
            entry.unlink()
    if new:
        checked.touch(mode=0o600)
        os.utime(checked, ns=(max(written.values()), max(written.values())))


def _is_complete(content: bytes) -> bool:
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
