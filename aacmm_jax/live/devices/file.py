"""Lines of a file that grows, such as a recorder's table: ``file:path``; it is read from its beginning."""

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from ..places import Setup
from .lines import AbstractLines

_MOST = 65536  # bytes at once


def open_device(where: str, options: Mapping[str, str], setup: Setup) -> "File":
    """The file of a recorder."""
    return File(where, options, setup)


class File(AbstractLines):
    """Follows a file, also where it is replaced or begins anew."""

    def __init__(self, where: str, options: Mapping[str, str], setup: Setup):
        self._path, self._file = Path(where), None
        super().__init__(f"file:{where}", options, setup.specification.arm)

    _file: BinaryIO | None

    def _connect(self) -> None:
        self._file = open(self._path, "rb")  # noqa: SIM115 - closed by `_disconnect`

    def _bytes(self) -> bytes:
        assert self._file is not None
        came = self._file.read(_MOST)
        if came:
            return came
        own = os.fstat(self._file.fileno())
        now = os.stat(self._path) if self._path.exists() else None
        if now is None or (now.st_ino, now.st_dev) != (own.st_ino, own.st_dev) or now.st_size < self._file.tell():
            if rest := self._file.read(_MOST):  # written before it was replaced
                return rest
            raise OSError(None, "the file begins anew")
        time.sleep(0.02)
        return b""

    def _disconnect(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None
