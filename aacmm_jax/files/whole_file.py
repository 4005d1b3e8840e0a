"""Files written whole or not at all, and names that a file can hold."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from ..core.errors import InputError

ELSEWHERE = "choose another output path"


@contextlib.contextmanager
def whole_file(path: str | os.PathLike, advice: str = ELSEWHERE) -> Iterator[Path]:
    """Write a file whole or not at all: yields a temporary path in the same folder, renamed onto it at the end.

    A symbolic link is followed: the file that it points to is written. Whatever goes wrong (Ctrl-C included), the
    temporary file is removed and an existing target stays as it was. Raises `InputError` where the path cannot be
    written, or is a folder, a device or a pipe.
    """
    named = Path(path)
    target = Path(os.path.realpath(named))
    # Named before it is made: an interrupt between the two must not leave a file behind.
    temporary = target.parent / f".{target.name}.{secrets.token_hex(4)}.part"
    try:
        # A link in /proc (/dev/stdout) leads to what has no path, and one that leads to itself remains a link.
        if (named.exists() or target.exists() or target.is_symlink()) and not target.is_file():
            raise OSError(None, "it is a folder" if target.is_dir() else "it is not an ordinary file")
        open(temporary, "xb").close()
        yield temporary
        with open(temporary, "rb+") as written:
            os.fsync(written.fileno())
        os.replace(temporary, target)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{named} cannot be written: {reason}; {advice}.") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text file whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_bytes(text.encode())


def storable(text: str) -> str:
    """The same text, or `InputError` where HDF5 and TOML cannot hold it (NUL, or a file name that is not UTF-8)."""
    if "\0" in text or text.encode(errors="ignore").decode() != text:
        raise InputError(f"the name {text!r} holds a character that no file can hold; rename it.")
    return text
