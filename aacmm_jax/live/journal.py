"""The journal of a live capture: one line an event, on disk before anybody is told, beside the capture's file.

A line is ``number checksum {JSON}``. Whatever kills the process, at most the last line is half written: it is dropped,
and counted, when the journal is continued. Numbers are written as Python writes them, which gives the same floats back.
"""

import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from ..core.errors import InputError

_LONGEST = 10_000_000  # characters of a line


def journal_of(capture: Path) -> Path:
    """The journal beside the file of a capture."""
    return capture.with_name(capture.name + ".journal")


class Journal:
    """Appends events; `events` are those that an earlier process left, ``dropped`` its half line, if any.

    Raises `InputError` where another process has it, the file cannot be written, or a line before the last is damaged.
    """

    def __init__(self, path: Path):
        self.path, self.dropped = path, 0
        self._lock = FileLock(path.with_name(f".{path.name}.lock"))
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise InputError(
                f"{path} is in use by another live capture; close that one, or choose another output path."
            ) from None
        except OSError as error:
            raise InputError(f"{path} cannot be written ({error.strerror}); choose another output path.") from error
        try:
            self.events = self._read()
            # As bytes: in the text mode that Windows has by default, every line would get a byte more.
            binary = getattr(os, "O_BINARY", 0)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | binary, 0o644)
            if self.dropped:
                os.ftruncate(self._file, self._end)
            self._sync_folder()
        except OSError as error:
            self._lock.release()
            raise InputError(f"{path} cannot be written ({error.strerror}); choose another output path.") from error
        except InputError:
            self._lock.release()
            raise

    def _sync_folder(self) -> None:
        """Make the file's name in its folder last, too."""
        if os.name == "posix":
            folder = os.open(self.path.parent, os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)

    def _read(self) -> list[dict[str, Any]]:
        self._end = 0
        if not self.path.exists():
            return []
        events: list[dict[str, Any]] = []
        with open(self.path, "rb") as file:
            while line := file.readline(_LONGEST):
                event = _event(line, len(events) + 1)
                if event is None:
                    if file.read(1):
                        raise InputError(
                            f"{self.path} line {len(events) + 1} is damaged, and lines follow it; restore the file "
                            "from a copy, or move it away to begin anew."
                        )
                    self.dropped = 1
                    break
                events.append(event)
                self._end = file.tell()
        return events

    def append(self, event: Mapping[str, Any]) -> None:
        """Write one event; it is on the disk when this returns. `InputError` where the disk refuses."""
        try:
            text = json.dumps(event, default=_plain, allow_nan=False, ensure_ascii=True)
        except ValueError as error:
            raise InputError("a value of this pose is not finite, so it is not recorded; take it again.") from error
        number = len(self.events) + 1
        line = f"{number} {_checksum(number, text)} {text}\n".encode()
        try:
            written = os.write(self._file, line)
            if written < len(line):
                raise OSError(28, "no space left on device")
            os.fsync(self._file)
        except OSError as error:
            os.ftruncate(self._file, self._end)
            raise InputError(
                f"{self.path} cannot be written ({error.strerror}), so nothing was recorded; free some disk space and "
                "try again."
            ) from error
        self._end += len(line)
        self.events.append(json.loads(text))

    def close(self) -> None:
        """Close the file, and let others have it."""
        os.close(self._file)
        self._lock.release()


def _checksum(number: int, text: str) -> str:
    return f"{zlib.crc32(f'{number} {text}'.encode()):08x}"


def _event(line: bytes, number: int) -> dict[str, Any] | None:
    """The event of a line; None where it is not whole."""
    if not line.endswith(b"\n"):
        return None
    parts = line.rstrip(b"\n").split(b" ", 2)
    if len(parts) != 3 or parts[0] != str(number).encode():
        return None
    text = parts[2].decode("ascii", "replace")
    if parts[1].decode("ascii", "replace") != _checksum(number, text):
        return None
    try:
        event = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event, dict) else None


def _plain(value: Any) -> Any:
    """Arrays and numbers of NumPy as JSON has them."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} cannot be written to a journal")
