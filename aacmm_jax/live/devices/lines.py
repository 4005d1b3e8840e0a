"""Devices that send lines of text: what they have in common whatever carries the bytes."""

import abc
import time
from collections.abc import Mapping

from ...kinematics.arm import Arm
from ..samples import Sample
from .device import AbstractDevice
from .line_format import LONGEST, format_of_lines

RETRY = 0.5  # s between attempts to connect
_QUIET = 0.1  # s: where nothing comes for so long after connecting, the first line is whole
_MOST_RAW = 100_000  # bytes without an end of a line
_SILENT = 3.0  # s without a line after which people are told


class AbstractLines(AbstractDevice):
    """Reads lines, counts the bad ones, and connects again.

    A kind says how to connect and how to read bytes. A line that begins or ends with a connection counts as bad where
    it is not whole.
    """

    cuts_first = False  # whether a connection may begin within a line

    def __init__(self, name: str, options: Mapping[str, str], arm: Arm):
        super().__init__(name)
        self._format = format_of_lines(name, options, arm)
        self._buffer, self._raw = bytearray(), bytearray()
        self._skips = self._too_long = False
        self._retry_at = self._connected_at = 0.0
        self._before = self._line_at = time.monotonic()

    @property
    def joints(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Of the line format; a header may still say."""
        return self._format.joints

    @property
    def read_as(self) -> tuple[int, ...] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Likewise."""
        return self._format.read_as

    @abc.abstractmethod
    def _connect(self) -> None:
        """Connect, or raise `OSError`."""

    @abc.abstractmethod
    def _bytes(self) -> bytes:
        """What has come; empty where nothing has within some hundredths of a second. `OSError` where the connection
        is lost."""

    @abc.abstractmethod
    def _disconnect(self) -> None:
        """Give up the connection, if there is one."""

    def read(self) -> list[Sample]:
        now = time.monotonic()
        try:
            if not self.connected:
                if now < self._retry_at:
                    time.sleep(0.01)
                    return []
                self._connect()
                self.connected, self.message, self._skips = True, "", self.cuts_first
                self._connected_at = self._line_at = self._before = time.monotonic()
                self._format.connected()
            came = self._bytes()
        except OSError as error:
            self._lost(error)
            return []
        now = time.monotonic()
        if not came:
            self._skips = self._skips and now < self._connected_at + _QUIET
            self.message = "" if now < self._line_at + _SILENT else f"no line for {now - self._line_at:.0f} s"
            return []
        self._raw += came
        return self._samples(came, now)

    def _lost(self, error: OSError) -> None:
        self._disconnect()
        if self._buffer or self._too_long:
            self._count_bad("half a line")
        self._buffer.clear()
        self.connected, self._too_long = False, False
        self._retry_at = time.monotonic() + RETRY
        self.message = f"not connected ({(error.strerror or str(error)).lower()[:100]}); trying again"

    def _count_bad(self, reason: str) -> None:
        self.lines += 1
        self.bad[reason] += 1

    def _samples(self, came: bytes, now: float) -> list[Sample]:
        self._buffer += came
        *lines, rest = self._buffer.split(b"\n")
        self._buffer = bytearray(rest)
        if len(rest) > LONGEST:
            self._too_long = True
            self._buffer.clear()
        samples: list[Sample] = []
        for i, line in enumerate(lines, start=1):
            self._line_at = now
            if self._too_long:
                self._too_long = False
                self._count_bad(f"longer than {LONGEST} characters")
                continue
            at = self._before + (now - self._before) * i / len(lines)  # lines that came together did not happen so
            sample, reason, missing = self._format.sample(bytes(line), at)
            if self._skips and not (self._format.has_checksum and sample is not None):
                self._skips = False
                self._count_bad("half a line")
                continue
            self._skips = False
            if missing:
                self.bad["missing"] += missing
            if reason:
                self._count_bad(reason)
            elif sample is not None:
                self.lines += 1
                samples.append(sample)
        if lines:
            self._before, self.message = now, ""
        return samples

    def raw(self) -> bytes:
        whole = self._raw.rfind(b"\n") + 1 if self.connected and len(self._raw) < _MOST_RAW else len(self._raw)
        came = bytes(self._raw[:whole])
        del self._raw[:whole]
        return came if came.endswith(b"\n") or not came else came + b"\n"

    def close(self) -> None:
        self._disconnect()
        self.connected = False
