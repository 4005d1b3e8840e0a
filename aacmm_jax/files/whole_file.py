"""Files written whole or not at all, their names and fingerprints."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from ..core.errors import InputError
from .outputs import ELSEWHERE, OutputFile, hand_over, put_in_place, reading, remove_leftovers, waiting


@contextlib.contextmanager
def whole_file(path: str | os.PathLike, advice: str = ELSEWHERE, *, leftovers: bool = True) -> Iterator[Path]:
    """Write a file whole or not at all: yields a temporary path in the same folder, renamed onto it at the end.

    Inside `together`, the end is that of all outputs. A symbolic link is followed: the file that it points to is
    written. A file that is replaced leaves its permissions to the new one. Whatever goes wrong (Ctrl-C included), the
    temporary file is removed and an existing target stays as it was; ``leftovers``: those of killed processes are
    removed as well. Raises `InputError` where the path cannot be written, or is a folder, a device, a pipe or
    read-only.
    """
    file = OutputFile(path, advice)
    waits = False
    try:
        with file.refusing():
            file.check()
            if leftovers:
                remove_leftovers(file.target)
            file.create()
            yield file.temporary
            file.finish()
            waits = hand_over(file)
            if not waits:
                put_in_place([file])
    finally:
        if not waits:
            file.discard()


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text file whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_bytes(text.encode())


def check_readable(path: Path) -> None:
    """Raise `InputError` where a file is missing, a folder, may not be read, or is an output of the command."""
    reading(path)
    try:
        open(path, "rb").close()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; check the path.") from error
    except IsADirectoryError as error:
        raise InputError(f"{path} is a folder; name a file.") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{str(path)!r} cannot be read: {reason.lower()}; name another file.") from error


def fingerprint(path: str | os.PathLike, folder: str | os.PathLike | None = None) -> str:
    """A file's name and SHA-256, which identify it; the name is relative to ``folder`` where the file is below it."""
    import hashlib

    path = Path(path)
    content = waiting(path)
    check_readable(content)
    below = folder is not None and path.is_relative_to(folder)
    name = path.relative_to(folder).as_posix() if below and folder is not None else path.name
    return storable_name(f"{name} (SHA-256 {hashlib.sha256(content.read_bytes()).hexdigest()})")


def storable(text: str) -> str:
    """The same text, or `InputError` where HDF5 and TOML cannot hold it (NUL, or a file name that is not UTF-8)."""
    if "\0" in text or text.encode(errors="ignore").decode() != text:
        raise InputError(f"the name {text!r} holds a character that no file can hold; rename it.")
    return text


def storable_name(text: str) -> str:
    """A name in a form that HDF5 can hold: bytes that are not UTF-8 are written as escapes."""
    return text.encode(errors="backslashreplace").decode()
