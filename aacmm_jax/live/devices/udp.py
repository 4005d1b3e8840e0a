"""Lines from datagrams: ``udp:host:port``, the address of this computer at which they arrive."""

import socket
from collections.abc import Mapping

from ..places import Setup
from .lines import AbstractLines
from .tcp import host_and_port


def open_device(where: str, options: Mapping[str, str], setup: Setup) -> "Udp":
    """The socket at which datagrams arrive."""
    return Udp(where, options, setup)


class Udp(AbstractLines):
    """Each datagram holds one line or several whole ones; ``from=ADDRESS`` takes only those of one sender."""

    def __init__(self, where: str, options: Mapping[str, str], setup: Setup):
        options = dict(options)
        self._from, self._address = options.pop("from", ""), host_and_port("udp", where)
        self._socket: socket.socket | None = None
        super().__init__(f"udp:{where}", options, setup.specification.arm)

    def _connect(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(self._address)
        self._socket.settimeout(0.02)

    def _bytes(self) -> bytes:
        assert self._socket is not None
        try:
            came, (sender, *_) = self._socket.recvfrom(65536)
        except TimeoutError:
            return b""
        if self._from and sender != self._from:
            self._count_bad("of another sender")
            return b""
        return came if came.endswith(b"\n") else came + b"\n"

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
