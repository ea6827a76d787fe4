"""Packets: MAVLink out of anybody's bytes; what is malformed, wrongly signed or a stranger's is dropped."""

from __future__ import annotations

import hashlib
import hmac
import time
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.errors import OptionError

V1, V2 = 0xFE, 0xFD
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
BRIDGE = mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY

_SIGNED, _SIGNATURE_BYTES = 0x01, 13
_MAX_BYTES = 65536  # of a stream that never makes a packet
_MAX_FAILED = 64  # beginnings in a datagram that are none, after which the rest is noise: a flood must stay cheap
_SIGNING_EPOCH_S = 1420070400  # 1 January 2015, from which signatures count
_STREAM_AGE = 60 * 100_000  # how far behind our clock a new signed stream may begin, in 10 us


def read_key(path: str | Path) -> bytes:
    """The secret of MAVLink's signing: 32 bytes, or 64 hexadecimal digits, in a file.

    Raises:
        OptionError: the file holds something else.
    """
    content = Path(path).read_bytes()
    if len(content) == 32:
        return content
    try:
        key = bytes.fromhex(content.decode("ascii").strip())
    except ValueError:
        key = b""
    if len(key) != 32:
        raise OptionError(f"key: expected 32 bytes or 64 hexadecimal digits in {path}, got {len(content)} bytes")
    return key


def signing_time() -> int:
    """Now, as signatures count it: 10 microseconds since 2015."""
    return max(0, int((time.time() - _SIGNING_EPOCH_S) * 1e5))


class Encoder:
    """Makes packets of messages, signed where there is a key.

    Args:
        system_id: of the vehicle, which the bridge is a part of.
        key: the secret, or None.
    """

    def __init__(self, system_id: int, key: bytes | None = None) -> None:
        self._mavlink: Any = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=BRIDGE)
        if key is not None:
            self._mavlink.signing.secret_key = key
            self._mavlink.signing.sign_outgoing = True

    def encode(self, message: Any) -> bytes:
        """The packet of a message."""
        signing = self._mavlink.signing
        signing.timestamp = max(signing.timestamp, signing_time())  # pymavlink's own clock stands still
        packet = bytes(message.pack(self._mavlink))
        self._mavlink.seq = (self._mavlink.seq + 1) % 256
        return packet


class Decoder:
    """Finds the messages of one autopilot among bytes.

    Args:
        system_id: whose messages are taken.
        wanted: numbers of the messages that are taken.
        is_stream: whether a packet may continue in the next bytes.
        key: the secret; where it is given, what is not signed with it is dropped.
    """

    def __init__(
        self, system_id: int, wanted: frozenset[int], *, is_stream: bool, key: bytes | None = None
    ) -> None:
        self._system_id, self._wanted, self._is_stream, self._key = system_id, wanted, is_stream, key
        self._mavlink: Any = mavlink.MAVLink(None)
        self._buffer = bytearray()
        self._newest: dict[int, int] = {}  # of each signed stream, the time of its last packet
        self.dropped = 0

    def feed(self, data: bytes) -> list[Any]:
        """The messages that these bytes complete."""
        self._buffer += data
        messages: list[Any] = []
        at = failed = 0
        while (at := self._start(at)) < len(self._buffer):
            size = self._size(at)
            if size is None or at + size > len(self._buffer):
                if size is not None and not self._is_stream:
                    at += 1
                    continue
                break  # the rest is still to come
            packet = bytes(self._buffer[at : at + size])
            message = self._decode(packet)
            if message is None:
                self.dropped += 1
                failed += 1
                if failed > _MAX_FAILED and not self._is_stream:
                    break
                at += 1  # no packet begins here, or none of which anybody knows where it ends
                continue
            at += size
            if self._is_wanted(packet):
                if self._key is None or self._is_signed(packet, self._key):
                    messages.append(message)
                else:
                    self.dropped += 1
        del self._buffer[: at if self._is_stream else None]
        if len(self._buffer) > _MAX_BYTES:
            self._buffer.clear()
        return messages

    def _start(self, at: int) -> int:
        """The next byte that may begin a packet."""
        found = [i for i in (self._buffer.find(V2, at), self._buffer.find(V1, at)) if i >= 0]
        return min(found, default=len(self._buffer))

    def _size(self, at: int) -> int | None:
        """Length of the packet that begins here; None where too little of it has come."""
        if at + 3 > len(self._buffer):
            return None
        payload = self._buffer[at + 1]
        if self._buffer[at] == V1:
            return 8 + payload
        return 12 + payload + (_SIGNATURE_BYTES if self._buffer[at + 2] & _SIGNED else 0)

    def _is_wanted(self, packet: bytes) -> bool:
        if packet[0] == V1:
            system, component, number = packet[3], packet[4], packet[5]
        else:
            system, component, number = packet[5], packet[6], int.from_bytes(packet[7:10], "little")
        return (system, component) == (self._system_id, AUTOPILOT) and number in self._wanted

    def _decode(self, packet: bytes) -> Any:
        """The message, or None where the packet is not sound or its kind unknown."""
        if packet[0] == V2 and packet[2] & ~_SIGNED:
            return None  # flags that must be understood and are not
        try:
            message = self._mavlink.decode(bytearray(packet))
        except Exception:  # the bytes are anybody's: whatever the decoder says of them, they are no message
            return None
        return None if isinstance(message, mavlink.MAVLink_unknown) else message

    def _is_signed(self, packet: bytes, key: bytes) -> bool:
        """Whether the signature is right, and not one that was seen before.

        pymavlink notes a packet's time before it has looked at the signature, so that a forged one would silence
        the stream; here the signature comes first.
        """
        if packet[0] != V2 or not packet[2] & _SIGNED:
            return False
        if not hmac.compare_digest(hashlib.sha256(key + packet[:-6]).digest()[:6], packet[-6:]):
            return False
        stream, stamp = packet[-13], int.from_bytes(packet[-12:-6], "little")
        if stamp <= self._newest.get(stream, signing_time() - _STREAM_AGE):
            return False
        self._newest[stream] = stamp
        return True
