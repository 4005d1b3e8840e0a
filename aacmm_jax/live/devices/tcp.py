"""Lines from a socket: ``tcp:host:port``."""

import socket
from collections.abc import Mapping

from ...core.errors import InputError
from ..places import Setup
from .lines import AbstractLines


def open_device(where: str, options: Mapping[str, str], setup: Setup) -> "Tcp":
    """The socket of a device."""
    return Tcp(where, options, setup)


def host_and_port(kind: str, where: str) -> tuple[str, int]:
    """The address that a text states, or `InputError`."""
    host, _, port = where.rpartition(":")
    if not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError(f"device '{kind}:{where}' has no port from 1 to 65535; write {kind}:host:port.")
    return host.strip("[]"), int(port)


class Tcp(AbstractLines):
    """A connection to a server that sends lines."""

    def __init__(self, where: str, options: Mapping[str, str], setup: Setup):
        self._address = host_and_port("tcp", where)
        self._socket: socket.socket | None = None
        super().__init__(f"tcp:{where}", options, setup.specification.arm)

    def _connect(self) -> None:
        self._socket = socket.create_connection(self._address, timeout=1.0)
        self._socket.settimeout(0.02)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def _bytes(self) -> bytes:
        assert self._socket is not None
        try:
            came = self._socket.recv(65536)
        except TimeoutError:
            return b""
        if not came:
            raise OSError(None, "the other side has closed the connection")
        return came

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
