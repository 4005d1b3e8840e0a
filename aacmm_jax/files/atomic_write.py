"""Files written whole or not at all, and names that a file can hold."""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from ..core.errors import InputError
from .outputs import ELSEWHERE, OutputFile, hand_over, put_in_place, remove_leftovers


@contextlib.contextmanager
def write_atomically(
    path: str | os.PathLike,
    advice: str = ELSEWHERE,
    *,
    leftovers: bool = True,
    same_kind: Callable[[Path], bool] | None = None,
) -> Iterator[Path]:
    """Write a file whole or not at all: yields a temporary path in the same folder, renamed onto it at the end.

    Inside `together`, the end is that of all outputs. A symbolic link is followed: the file that it points to is
    written. A file that is replaced leaves its permissions to the new one. Whatever goes wrong (Ctrl-C included), the
    temporary file is removed and an existing target stays as it was; ``leftovers``: those of killed processes are
    removed as well; ``same_kind`` as in `OutputFile`. Raises `InputError` where the path cannot be written, is a
    folder, a device, a pipe or read-only, or, in a command, where it is a file that aacmm did not write (`asking`).
    """
    file = OutputFile(path, advice, same_kind)
    waits = False
    try:
        with file.refusing():
            file.check()
            if leftovers:
                remove_leftovers(file.target)
            file.create()
            yield file.temporary
            file.finish()
            file.check_replaced()
            waits = hand_over(file)
            if not waits:
                put_in_place([file])
    finally:
        if not waits:
            file.discard()


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text file whole or not at all."""
    with write_atomically(path) as temporary:
        temporary.write_bytes(text.encode())


def storable(text: str) -> str:
    """The same text, or `InputError` where HDF5 and TOML cannot hold it (NUL, or a file name that is not UTF-8)."""
    if "\0" in text or text.encode(errors="ignore").decode() != text:
        raise InputError(f"the name {text!r} holds a character that no file can hold; rename it.")
    return text
