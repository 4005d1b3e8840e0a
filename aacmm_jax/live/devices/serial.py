"""Lines from a serial port: ``serial:/dev/ttyUSB0?baud=115200`` (``serial:COM3`` on Windows)."""

import contextlib
from collections.abc import Mapping
from typing import Any

from ...core.errors import InputError, require
from ..places import Setup
from .lines import AbstractLines


def open_device(where: str, options: Mapping[str, str], setup: Setup) -> "Serial":
    """The port of a device."""
    require("live", "a serial port", "serial")
    return Serial(where, options, setup)


def opened(port: str, baud: int) -> Any:
    """A serial port, or `OSError`."""
    import serial

    try:
        return serial.Serial(port, baud, timeout=0.02, exclusive=True)
    except serial.SerialException as error:
        reason = {2: "no such port", 13: "permission denied", 16: "in use"}.get(error.errno or 0, "cannot be opened")
        raise OSError(error.errno, reason) from error


class Serial(AbstractLines):
    """A serial port, 8 data bits, no parity."""

    cuts_first = True

    def __init__(self, where: str, options: Mapping[str, str], setup: Setup):
        options = dict(options)
        baud = options.pop("baud", "115200")
        if not baud.isascii() or not baud.isdigit() or not 50 <= int(baud) <= 10_000_000:
            raise InputError(f"device 'serial:{where}' has baud={baud}; give a number such as 115200.")
        self._path, self._baud, self._port = where, int(baud), None
        super().__init__(f"serial:{where}", options, setup.specification.arm)

    _port: Any

    def _connect(self) -> None:
        self._port = opened(self._path, self._baud)

    def _bytes(self) -> bytes:
        try:
            return self._port.read(max(1, min(self._port.in_waiting, 65536)))
        except Exception as error:  # pyserial passes on what the system says in several ways
            raise OSError(getattr(error, "errno", None), "the port is gone") from error

    def _disconnect(self) -> None:
        if self._port is not None:
            with contextlib.suppress(OSError):
                self._port.close()
            self._port = None
