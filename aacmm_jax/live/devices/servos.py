"""Servos on one bus, as of LeRobot's arms, whose positions are asked for: ``servos:table.toml``.

``protocol`` 1 is that of Feetech's STS and SCS servos and of Dynamixel's first one, ``protocol`` 2 Dynamixel's second
(ROBOTIS e-Manual, protocols 1.0 and 2.0). All torques are left as they are: nothing is ever written to a servo.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveInt

from ...core.errors import InputError, require
from ...files.controllers.lerobot import angles_by_motors
from ...files.inputs import InputFile, fingerprint
from ...files.manifest_readings import recorded_as
from ...files.manifest_tables import Angles
from ...files.toml import Strict, read_toml
from ..places import Setup
from ..samples import Sample
from .device import AbstractDevice
from .lines import RETRY
from .serial import opened

_ADDRESSES = {1: (56, 2), 2: (132, 4)}  # of the present position: STS3215, and X series; and its bytes
_READ = 2  # the instruction, in both protocols
_BROADCAST = 253  # identifiers above are not of one servo
_REASONS = {"short": "no answer", "checksum": "wrong checksum", "error": "a servo reports an error"}


class Bus(Strict):
    """The keys of the table: where the bus is, which servo is which joint, and what its counts mean."""

    port: str
    ids: Annotated[list[Annotated[NonNegativeInt, Field(lt=_BROADCAST)]], Field(min_length=1, max_length=40)]
    baud: PositiveInt = 1_000_000
    protocol: Literal[1, 2] = 1
    address: NonNegativeInt | None = None  # of the present position
    bytes: Annotated[int, Field(ge=1, le=4)] | None = None  # the least significant first
    signed: bool = False  # negative numbers as two's complement; else in the highest bit, as Feetech's
    angles: Angles = Field(default_factory=lambda: Angles(unit="counts", counts_per_turn=4096, offset=2048))


def open_device(where: str, options: Mapping[str, str], setup: Setup) -> "Servos":
    """The bus that a table describes."""
    require("live", "a bus of servos", "serial")
    if options:
        raise InputError(f"device 'servos:{where}' has the option '{next(iter(options))}'; state it in {where}.")
    return Servos(where, read_toml(where, Bus), setup)


class Servos(AbstractDevice):
    """Asks one servo after the other; a round with a bad answer gives no sample."""

    def __init__(self, where: str, bus: Bus, setup: Setup):
        super().__init__(f"servos:{where}")
        self._bus, self._arm, self._port, self._retry_at = bus, setup.specification.arm, None, 0.0
        self.joints, self._angles = len(bus.ids), bus.angles
        self.read_as = bus.angles.read_as(self.joints)
        if bus.angles.calibration is not None:
            if bus.angles.unit != "counts":
                raise InputError(f"{where}: servos answer in counts; write unit = 'counts' beside calibration.")
            file = InputFile(Path(where).parent / bus.angles.calibration)
            self._angles, self.sources = angles_by_motors(bus.angles, file, self.joints), (fingerprint(file),)
        if not self._arm.chains and self.joints == self._arm.joints:
            self.recorded_as = recorded_as(self._angles, self._arm, [f"servo {servo}" for servo in bus.ids])
        usual = _ADDRESSES[bus.protocol]
        self._address, self._bytes = bus.address or usual[0], bus.bytes or usual[1]
        self._silent = 0

    def read(self) -> list[Sample]:
        try:
            if self._port is None:
                if time.monotonic() < self._retry_at:
                    time.sleep(0.01)
                    return []
                self._port, self._silent = opened(self._bus.port, self._bus.baud), 0
                self.connected, self.message = True, ""
            counts = [self._position(servo) for servo in self._bus.ids]
        except OSError as error:
            self._lost(error)
            return []
        self.lines += 1
        bad = next((reason for count in counts if isinstance(reason := count, str)), None)
        if bad is not None:
            self.bad[_REASONS[bad]] += 1
            self._silent = self._silent + 1 if bad == "short" else 0
            self.message = "the servos do not answer; are they supplied?" if self._silent > 10 else ""
            return []
        self._silent, self.message = 0, ""
        q = self._angles.converted(np.array([counts], dtype=float), self._arm)[0]
        return [Sample(time.monotonic(), q)]

    def _position(self, servo: int) -> int | str:
        """The counts of a servo, or why there are none."""
        port, n = self._port, self._bytes
        if port is None:
            return "short"
        try:
            port.reset_input_buffer()
            port.write(request(self._bus.protocol, servo, self._address, n))
            answer = port.read(6 + n if self._bus.protocol == 1 else 11 + n)
        except Exception as error:
            raise OSError(getattr(error, "errno", None), "the port is gone") from error
        return counts_in(answer, self._bus.protocol, servo, n, self._bus.signed or self._bus.protocol == 2)

    def _lost(self, error: OSError) -> None:
        self.close()
        self._retry_at = time.monotonic() + RETRY
        self.message = f"not connected ({error.strerror}); trying again"

    def close(self) -> None:
        if self._port is not None:
            try:
                self._port.close()
            except OSError:
                self._port = None
        self._port, self.connected = None, False


def request(protocol: int, servo: int, address: int, count: int) -> bytes:
    """The packet that asks a servo for so many bytes at an address."""
    if protocol == 1:
        body = bytes([servo, 4, _READ, address, count])
        return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])
    body = b"\xff\xff\xfd\x00" + bytes([servo, 7, 0, _READ])
    body += address.to_bytes(2, "little") + count.to_bytes(2, "little")
    return body + crc_of_dynamixel(body).to_bytes(2, "little")


def counts_in(answer: bytes, protocol: int, servo: int, count: int, signed: bool) -> int | str:
    """The number in a status packet; ``short``, ``checksum`` or ``error`` where there is none."""
    head = b"\xff\xff" if protocol == 1 else b"\xff\xff\xfd\x00"
    if len(answer) < (6 if protocol == 1 else 11) + count or not answer.startswith(head):
        return "short"
    if protocol == 1:
        body, good = answer[2:-1], answer[-1] == ~sum(answer[2:-1]) & 0xFF
        named, error, data = body[0], body[2], body[3 : 3 + count]
    else:
        good = crc_of_dynamixel(answer[:-2]) == int.from_bytes(answer[-2:], "little")
        named, error, data = answer[4], answer[8], answer[9 : 9 + count]
    if not good or named != servo:
        return "checksum"
    if error:
        return "error"
    value = int.from_bytes(data, "little", signed=signed)
    top = 1 << (8 * count - 1)
    return value if signed or not value & top else -(value & (top - 1))


def crc_of_dynamixel(data: bytes) -> int:
    """CRC-16 of Dynamixel's protocol 2: polynomial 0x8005, beginning with 0."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc
