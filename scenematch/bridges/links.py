"""Byte links to a vehicle over UDP, TCP or a serial port. UDP listens on loopback unless allowed otherwise."""

from __future__ import annotations

import contextlib
import ipaddress
import select
import socket
from dataclasses import dataclass
from typing import Any

from engine.errors import OptionError, require

PeerAddress = tuple[str, int] | None
"""Host and port that sent a datagram; None on a point-to-point link."""

_DATAGRAM_BYTES = 65535
_MAX_DATAGRAMS = 256  # per call, so that a flood cannot stop the reader's other work
_SYNTAX = "udpin:HOST:PORT, udp:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"
_KINDS = {"udp": "udpin", "udpin": "udpin", "udpout": "udpout", "tcp": "tcp", "tcpout": "tcp", "serial": "serial"}
"""Kinds of links by their names here, in pymavlink and MAVProxy (udp listens), and in MAVSDK (tcpout)."""


@dataclass(frozen=True, slots=True)
class Connection:
    """The endpoint of a link.

    Attributes:
        kind: udpin, udpout, tcp or serial.
        host: host name, IP address, or path of the serial device.
        number: port, or baud rate.
    """

    kind: str
    host: str
    number: int

    def open(self) -> Link:
        """Open the link.

        Raises:
            OSError: the link cannot be opened now.
            MissingExtraError: a serial port is requested and pyserial is not installed.
        """
        try:
            if self.kind == "tcp":
                return _Tcp(self.host, self.number)
            if self.kind == "serial":
                return _Serial(self.host, self.number)
            return _Udp(self.host, self.number, listens=self.kind == "udpin")
        except UnicodeError:  # host names are encoded before the lookup
            raise OSError(f"{self.host!r} is not a valid host name") from None


def parse_connection(text: str, *, listen_anywhere: bool = False) -> Connection:
    """Read a connection string, also in the forms of pymavlink, MAVProxy and MAVSDK.

    Args:
        text: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD. ``udp`` means udpin. Two
            slashes may precede the host or device (udp://:14540), a comma the baud rate, and a device needs no
            kind (/dev/ttyACM0,57600). Without a host, udpin listens on 127.0.0.1, or with ``listen_anywhere`` on
            every IPv4 address.
        listen_anywhere: allow listening on addresses that other machines can reach.

    Raises:
        OptionError: the syntax is wrong, or the address is not loopback and ``listen_anywhere`` is off.
    """
    name, _, rest = ("serial", "", text) if text.startswith("/dev/") else text.partition(":")
    kind = _KINDS.get(name)
    is_url = rest.startswith("//")
    rest = rest.removeprefix("//")
    host, separator, number_text = (rest.replace(",", ":") if kind == "serial" else rest).rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if kind == "udpin" and not host and (is_url or not separator):
        host = "0.0.0.0" if listen_anywhere else "127.0.0.1"
    number = int(number_text) if number_text.isascii() and number_text.isdecimal() else 0
    max_number = 10_000_000 if kind == "serial" else 65535
    if kind is None or not host or not 0 < number <= max_number:
        raise OptionError(f"connect: expected {_SYNTAX}, got {text!r}")
    if kind == "udpin" and not listen_anywhere and not _is_loopback(host):
        raise OptionError(
            f"connect: expected a loopback address to listen on, got {host!r}; "
            "add `listen_anywhere` to accept other machines, or send to them by udpout"
        )
    return Connection(kind, host, number)


def _is_loopback(host: str) -> bool:
    """Whether only this machine can reach the host; no name but localhost is trusted."""
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
                self._socket.connect(found[4])  # the kernel drops datagrams from other peers
        except OSError:
            self._socket.close()
            raise
        self._listens = listens

    def receive(self, timeout_s: float) -> list[tuple[bytes, PeerAddress]]:
        received: list[tuple[bytes, PeerAddress]] = []
        if _wait(self._socket, timeout_s):
            # Connection refused: the peer is not listening yet.
            with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
                while len(received) < _MAX_DATAGRAMS:
                    data, sender = self._socket.recvfrom(_DATAGRAM_BYTES)
                    received.append((data, sender[:2] if self._listens else None))
        return received

    def send(self, data: bytes, to: PeerAddress) -> None:
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

    def receive(self, timeout_s: float) -> list[tuple[bytes, PeerAddress]]:
        if not _wait(self._socket, timeout_s):
            return []
        data = self._socket.recv(_DATAGRAM_BYTES)
        if not data:
            raise ConnectionResetError("the other end closed the connection")
        return [(data, None)]

    def send(self, data: bytes, to: PeerAddress) -> None:
        self._socket.sendall(data)

    def close(self) -> None:
        self._socket.close()


class _Serial:
    is_stream = True

    def __init__(self, device: str, baud: int) -> None:
        serial = require("serial", "mavlink", "pyserial")
        self._port: Any = serial.Serial(device, baud, timeout=0, write_timeout=1.0)

    def receive(self, timeout_s: float) -> list[tuple[bytes, PeerAddress]]:
        self._port.timeout = timeout_s
        data = self._port.read(max(1, min(self._port.in_waiting, _DATAGRAM_BYTES)))
        return [(data, None)] if data else []

    def send(self, data: bytes, to: PeerAddress) -> None:
        self._port.write(data)

    def close(self) -> None:
        self._port.close()


Link = _Udp | _Tcp | _Serial
"""A byte link to a vehicle; failures after it was opened raise OSError.

``receive`` returns the received (bytes, sender) pairs, waiting at most a time; ``send`` sends one packet, which is
dropped while no peer is known. ``is_stream`` says whether a packet may be split between reads.
"""
