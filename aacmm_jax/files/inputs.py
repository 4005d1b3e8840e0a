"""Files that are read: ordinary ones of a limited size, and each of them once."""

import contextlib
import hashlib
import io
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from .outputs import as_path, reading, waiting

LARGEST_FILE = "AACMM_LARGEST_FILE_MB"  # environment variable: size limit of inputs, MiB
ROBOT_FILES = (".urdf", ".xacro", ".xml", ".mjcf")  # URDF and MJCF; xacro for the message that says how to expand it
STREAMED = 100  # a study's file, which is read in parts, may be larger than the limit by this factor


def largest_file() -> int:
    """Size in bytes above which no input is read: 1 GiB, or what the environment variable says."""
    text = os.environ.get(LARGEST_FILE, "1024")
    if not text.isascii() or not text.isdigit() or not 0 < int(text[:9]) < 1e9:
        raise InputError(
            f"{LARGEST_FILE} is {text!r}; give a whole number of MiB, or unset the variable for the default of 1024."
        )
    return int(text[:9]) * 2**20


class InputFile(os.PathLike):
    """A file that is read once: what is parsed and what `fingerprint` identifies are the same bytes.

    Functions that read a file take one in place of a path, and so does this class. Refused is what is missing, cannot
    be read, is not an ordinary file, or is larger than this ``share`` of `largest_file`.
    """

    def __init__(self, path: str | os.PathLike, share: float = 1.0):
        self._path = as_path(path)
        with open_input(path, share) as stream:
            self.content: bytes = stream.read()

    def __fspath__(self) -> str:
        return str(self._path)

    __str__ = __fspath__

    @property
    def text(self) -> str:
        """The content as text in UTF-8, with or without a byte order mark; lines end with a line feed. Raises
        `InputError`."""
        try:
            return self.content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
        except UnicodeDecodeError as error:
            raise InputError(f"{self} is not UTF-8 text; save it as UTF-8.") from error


@contextlib.contextmanager
def open_input(path: str | os.PathLike, times: float = 1) -> Iterator[Any]:
    """Open an ordinary file for reading, of at most ``times`` the limit of `largest_file`; bytes, never more than that.

    Pipes and devices are not opened: reading them may have no end. Raises `InputError`.
    """
    if isinstance(path, InputFile):
        yield io.BytesIO(path.content)
        return
    reading(as_path(path))
    limit = times * largest_file()

    def check_ordinary(status: os.stat_result) -> None:
        if not stat.S_ISREG(status.st_mode):
            folder = stat.S_ISDIR(status.st_mode)
            kind = "a folder; give a file" if folder else "a pipe or a device; give an ordinary file"
            raise InputError(f"{path} is {kind}.")

    try:
        # Before it is opened, as opening a device may have effects; and again, as it may have been replaced.
        check_ordinary(os.stat(path))
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; check the path.") from error
    except InputError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{str(path)!r} cannot be read: {reason.lower()}; give another file.") from error
    with open(descriptor, "rb") as stream:
        status = os.fstat(descriptor)
        check_ordinary(status)
        if status.st_size > limit:
            raise InputError(
                f"{path} has {status.st_size / 2**20:,.0f} MiB, more than the limit of {limit / 2**20:,.0f} MiB; give "
                f"another file, or raise the limit with the environment variable {LARGEST_FILE}."
            )
        yield stream


def fingerprint(path: str | os.PathLike, folder: str | os.PathLike | None = None) -> str:
    """A file's name and SHA-256, which identify it; the name is relative to ``folder`` where the file is below it.

    Of an `InputFile`, the SHA-256 is that of the bytes that were read from it; of an output that waits for the others
    of its command, that of what was written.
    """
    with open_input(path if isinstance(path, InputFile) else waiting(path), STREAMED) as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    path = Path(path)
    below = folder is not None and path.is_relative_to(folder)
    name = path.relative_to(folder).as_posix() if below and folder is not None else path.name
    return storable_name(f"{name} (SHA-256 {digest})")


def storable_name(text: str) -> str:
    """A name in a form that HDF5 can hold: bytes that are not UTF-8 are written as escapes."""
    return text.encode(errors="backslashreplace").decode()
