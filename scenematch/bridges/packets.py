"""Parse MAVLink packets from untrusted bytes; drop malformed, wrongly signed and unrelated ones."""

from __future__ import annotations

import hashlib
import hmac
import time
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.errors import OptionError

V1, V2 = 0xFE, 0xFD
AUTOPILOT_COMPONENT = mavlink.MAV_COMP_ID_AUTOPILOT1
BRIDGE_COMPONENT = mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
"""Default component id of the bridge."""

# A companion computer is another component; `vision_in` leaves out the autopilot's and the bridge's own.
_FROM_ANY_COMPONENT = (mavlink.MAVLINK_MSG_ID_ODOMETRY, mavlink.MAVLINK_MSG_ID_VISION_SPEED_ESTIMATE)
_SIGNED, _SIGNATURE_BYTES = 0x01, 13
_MAX_FAILED = 64  # false start bytes in a datagram, after which the rest is discarded to keep a flood cheap
_SIGNING_EPOCH_S = 1420070400  # 1 January 2015, the epoch of signature time stamps
_MAX_STREAM_AGE = 60 * 100_000  # of a new signed stream's first stamp, in units of 10 us


def read_key(path: str | Path) -> bytes:
    """Read the key of MAVLink signing from a file: 32 bytes, or 64 hexadecimal digits.

    Raises:
        OptionError: the file has other content.
        OSError: the file cannot be read.
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
    """Current time as signatures count it, in units of 10 us since 2015."""
    return max(0, int((time.time() - _SIGNING_EPOCH_S) * 1e5))


class PacketEncoder:
    """Encodes messages as packets, signed if there is a key.

    Args:
        system_id: MAVLink system id of the vehicle to which the bridge belongs.
        key: 32-byte signing key, or None.
        component_id: component id of the bridge.
    """

    def __init__(self, system_id: int, key: bytes | None = None, component_id: int = BRIDGE_COMPONENT) -> None:
        self._mavlink: Any = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        if key is not None:
            self._mavlink.signing.secret_key = key
            self._mavlink.signing.sign_outgoing = True

    def encode(self, message: Any) -> bytes:
        """The packet of a message."""
        signing = self._mavlink.signing
        signing.timestamp = max(signing.timestamp, signing_time())  # pymavlink does not advance its own clock
        packet = bytes(message.pack(self._mavlink))
        self._mavlink.seq = (self._mavlink.seq + 1) % 256
        return packet


class PacketDecoder:
    """Extracts the messages of one autopilot, and the velocities of its companion computers, from bytes.

    Args:
        system_id: MAVLink system id of the messages to keep.
        message_ids: ids of the messages to keep.
        is_stream: whether a packet may continue in the next bytes.
        key: 32-byte signing key; if given, other packets are dropped.

    Attributes:
        dropped: number of malformed or wrongly signed packets so far.
    """

    def __init__(
        self, system_id: int, message_ids: frozenset[int], *, is_stream: bool, key: bytes | None = None
    ) -> None:
        self._system_id, self._message_ids = system_id, message_ids
        self._is_stream, self._key = is_stream, key
        self._mavlink: Any = mavlink.MAVLink(None)
        self._buffer = bytearray()
        self._last_stamps: dict[int, int] = {}  # by signing link id
        self.dropped = 0

    def feed(self, data: bytes) -> list[Any]:
        """Add bytes; returns the messages they complete."""
        self._buffer += data
        messages: list[Any] = []
        at = failed = 0
        while (at := self._start(at)) < len(self._buffer):
            size = self._size(at)
            if size is None or at + size > len(self._buffer):
                if size is not None and not self._is_stream:
                    at += 1
                    continue
                break  # the rest has not arrived yet
            packet = bytes(self._buffer[at : at + size])
            message = self._decode(packet)
            if message is None:
                self.dropped += 1
                failed += 1
                if failed > _MAX_FAILED and not self._is_stream:
                    break
                at += 1  # no packet begins here, or one of unknown length
                continue
            at += size
            if self._is_addressed(message):
                if self._key is None or self._is_signed(packet, self._key):
                    messages.append(message)
                else:
                    self.dropped += 1
        del self._buffer[: at if self._is_stream else None]  # at most one incomplete packet stays
        return messages

    def _start(self, at: int) -> int:
        """Offset of the next byte that may begin a packet."""
        found = [i for i in (self._buffer.find(V2, at), self._buffer.find(V1, at)) if i >= 0]
        return min(found, default=len(self._buffer))

    def _size(self, at: int) -> int | None:
        """Length in bytes of the packet that begins here; None if its header is incomplete."""
        if at + 3 > len(self._buffer):
            return None
        payload = self._buffer[at + 1]
        if self._buffer[at] == V1:
            return 8 + payload
        return 12 + payload + (_SIGNATURE_BYTES if self._buffer[at + 2] & _SIGNED else 0)

    def _is_addressed(self, message: Any) -> bool:
        number = message.get_msgId()
        from_vehicle = message.get_srcComponent() == AUTOPILOT_COMPONENT or number in _FROM_ANY_COMPONENT
        from_vehicle = from_vehicle and message.get_srcSystem() == self._system_id
        # An operator's command comes from the ground station, on the autopilot's link.
        return number in self._message_ids and (from_vehicle or number == mavlink.MAVLINK_MSG_ID_COMMAND_LONG)

    def _decode(self, packet: bytes) -> Any:
        """The message, or None if the packet is invalid or its type unknown."""
        if packet[0] == V2 and packet[2] & ~_SIGNED:
            return None  # incompatibility flags that this decoder does not support
        try:
            message = self._mavlink.decode(bytearray(packet))
        except Exception:  # untrusted bytes: whatever the decoder raises, they are not a message
            return None
        return None if isinstance(message, mavlink.MAVLink_unknown) else message

    def _is_signed(self, packet: bytes, key: bytes) -> bool:
        """Whether the signature is valid and newer than the last one of its stream.

        pymavlink stores a packet's time stamp before it checks the signature, so a forged packet could block the
        stream. This function checks the signature first.
        """
        if packet[0] != V2 or not packet[2] & _SIGNED:
            return False
        if not hmac.compare_digest(hashlib.sha256(key + packet[:-6]).digest()[:6], packet[-6:]):
            return False
        link_id, stamp = packet[-13], int.from_bytes(packet[-12:-6], "little")
        if stamp <= self._last_stamps.get(link_id, signing_time() - _MAX_STREAM_AGE):
            return False
        self._last_stamps[link_id] = stamp
        return True
