"""Links: bytes to and from a vehicle over UDP, TCP or a serial port. Listens on loopback only, unless told."""

from __future__ import annotations

import contextlib
import ipaddress
import select
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from engine.errors import OptionError, require

Sender = tuple[str, int] | None
"""Who sent a datagram; None on a link with one other end."""

_DATAGRAM_BYTES = 65535
_MAX_AT_ONCE = 256  # datagrams, so that a flood cannot keep the reader from its other work
_FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


class Link(Protocol):
    """One way to a vehicle. Opened by its constructor; what fails later raises OSError.

    Attributes:
        is_stream: whether packets may be cut anywhere; a datagram holds whole ones.
    """

    is_stream: bool

    def receive(self, timeout_s: float) -> list[tuple[bytes, Sender]]:
        """What has come, waiting at most so long for it."""

    def send(self, data: bytes, to: Sender) -> None:
        """Send one packet; dropped where there is nobody to send to."""

    def close(self) -> None:
        """Give the port back."""


@dataclass(frozen=True, slots=True)
class Connection:
    """Where a link leads.

    Attributes:
        kind: udpin, udpout, tcp or serial.
        host: name, address, or path of the serial device.
        number: port, or baud.
    """

    kind: str
    host: str
    number: int

    def open(self) -> Link:
        """Open the link.

        Raises:
            OSError: it cannot be opened now.
            MissingExtraError: a serial port is asked for and pyserial is not installed.
        """
        makers: dict[str, Callable[[str, int], Link]] = {
            "udpin": lambda host, port: _Udp(host, port, listens=True),
            "udpout": lambda host, port: _Udp(host, port, listens=False),
            "tcp": _Tcp,
            "serial": _Serial,
        }
        try:
            return makers[self.kind](self.host, self.number)
        except UnicodeError:  # names are encoded before they are looked up
            raise OSError(f"{self.host!r} cannot be the name of a host") from None


def parse_connection(text: str, *, listen_anywhere: bool = False) -> Connection:
    """Read a connection string.

    Args:
        text: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD.
        listen_anywhere: allows to listen on addresses that other machines reach.

    Raises:
        OptionError: the text is of another form, or would listen off loopback.
    """
    kind, _, rest = text.partition(":")
    host, _, number_text = rest.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    number = int(number_text) if number_text.isascii() and number_text.isdecimal() else 0
    most = 10_000_000 if kind == "serial" else 65535
    if kind not in ("udpin", "udpout", "tcp", "serial") or not host or not 0 < number <= most:
        raise OptionError(f"connect: expected {_FORMS}, got {text!r}")
    if kind == "udpin" and not listen_anywhere and not _is_loopback(host):
        raise OptionError(
            f"connect: expected a loopback address to listen on, got {host!r}; "
            "add `listen_anywhere` to be reached from other machines"
        )
    return Connection(kind, host, number)


def _is_loopback(host: str) -> bool:
    """Whether only this machine reaches it; a name other than localhost may mean anything."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _wait(source: socket.socket, timeout_s: float) -> bool:
    return bool(select.select([source], [], [], timeout_s)[0])


class _Udp:
    is_stream = False

    def __init__(self, host: str, port: int, *, listens: bool) -> None:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(found[0], socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            if listens:
                self._socket.bind(found[4])
            else:
                self._socket.connect(found[4])  # datagrams of others never arrive
        except OSError:
            self._socket.close()
            raise
        self._listens = listens

    def receive(self, timeout_s: float) -> list[tuple[bytes, Sender]]:
        got: list[tuple[bytes, Sender]] = []
        if _wait(self._socket, timeout_s):
            # Refused means that nobody listens there yet.
            with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
                while len(got) < _MAX_AT_ONCE:
                    data, sender = self._socket.recvfrom(_DATAGRAM_BYTES)
                    got.append((data, sender[:2] if self._listens else None))
        return got

    def send(self, data: bytes, to: Sender) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
            if not self._listens:
                self._socket.send(data)
            elif to is not None:
                self._socket.sendto(data, to)

    def close(self) -> None:
        self._socket.close()


class _Tcp:
    is_stream = True

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), timeout=2.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def receive(self, timeout_s: float) -> list[tuple[bytes, Sender]]:
        if not _wait(self._socket, timeout_s):
            return []
        data = self._socket.recv(_DATAGRAM_BYTES)
        if not data:
            raise ConnectionResetError("the other end closed the connection")
        return [(data, None)]

    def send(self, data: bytes, to: Sender) -> None:
        self._socket.sendall(data)

    def close(self) -> None:
        self._socket.close()


class _Serial:
    is_stream = True

    def __init__(self, device: str, baud: int) -> None:
        serial = require("serial", "mavlink", "pyserial")
        self._port: Any = serial.Serial(device, baud, timeout=0, write_timeout=1.0)

    def receive(self, timeout_s: float) -> list[tuple[bytes, Sender]]:
        self._port.timeout = timeout_s
        data = self._port.read(max(1, min(self._port.in_waiting, _DATAGRAM_BYTES)))
        return [(data, None)] if data else []

    def send(self, data: bytes, to: Sender) -> None:
        self._port.write(data)

    def close(self) -> None:
        self._port.close()
