"""Fuzz of the MAVLink bridge's door: random and mutated packets into decoder and telemetry; nothing may break."""

from __future__ import annotations

import random
import sys
import time
import tracemalloc
from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from engine.errors import EngineError
from scenematch.bridges.mavlink_in import HANDLED_MESSAGES, MavlinkTelemetry
from scenematch.bridges.packets import PacketDecoder

IMAGE = np.zeros((4, 4), np.uint8)


@dataclass
class Fuzzed:
    packets: int = 0
    heard: int = 0
    longest_s: float = 0.0


def packet(rng: random.Random) -> bytes:
    """A well-formed message of the autopilot with any content."""
    kind = mavlink.mavlink_map[rng.choice(sorted(HANDLED_MESSAGES))]
    message = kind.__new__(kind)
    mavlink.MAVLink_message.__init__(message, kind.id, kind.msgname)
    payload = bytearray(rng.randbytes(kind.unpacker.size))
    if rng.random() < 0.2:
        payload[: len(payload)] = bytes([rng.choice((0, 0x7F, 0x80, 0xFF))]) * len(payload)
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    return message._pack(
        sender, kind.crc_extra, bytes(payload), force_mavlink1=kind.id < 256 and rng.random() < 0.1
    )


def mutated(rng: random.Random) -> bytes:
    data = bytearray(packet(rng))
    for _ in range(rng.randrange(1, 5)):
        choice = rng.random()
        at = rng.randrange(len(data)) if data else 0
        if choice < 0.4 and data:
            data[at] ^= 1 << rng.randrange(8)
        elif choice < 0.6:
            del data[at:]
        elif choice < 0.8:
            data[at:at] = rng.randbytes(rng.randrange(1, 20))
        else:
            data += packet(rng)
    return bytes(data)


def fuzz(count: int, seed: int) -> Fuzzed:
    """So many pieces into a stream, a datagram and a signed decoder; what is heard goes on to a frame."""
    rng, result, telemetry = random.Random(seed), Fuzzed(), MavlinkTelemetry()
    decoders = [PacketDecoder(1, HANDLED_MESSAGES, is_stream=stream, key=key) for stream, key in
                ((True, None), (False, None), (True, bytes(32)))]  # fmt: skip
    makers = (packet, mutated, lambda r: r.randbytes(r.randrange(600)), lambda r: b"\xfd" * r.randrange(3000))
    now_ns = 10**12
    for _ in range(count):
        piece = rng.choices(makers, (4, 8, 4, 1))[0](rng)
        now_ns += rng.randrange(20_000_000)
        begin = time.thread_time()
        for decoder in decoders:
            for message in decoder.feed(piece):
                assert decoder is not decoders[2], "an unsigned message was heard"
                telemetry.update(message, now_ns)
                result.heard += 1
        vehicle = telemetry.vehicle(now_ns)
        try:
            vehicle.frame(IMAGE, now_ns)
        except EngineError as error:
            raise AssertionError(f"telemetry made an impossible frame: {error}") from error
        result.longest_s = max(result.longest_s, time.thread_time() - begin)
        result.packets += 1
    return result


def growth_bytes(hours: float) -> int:
    """By how much memory grew from the first tenth of so many hours of an autopilot's traffic to their end."""
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    decoder, telemetry = PacketDecoder(1, HANDLED_MESSAGES, is_stream=True), MavlinkTelemetry()
    early = 0
    tracemalloc.start()
    for tick in range(round(hours * 3600 * 50)):
        now_ns, ms = tick * 20_000_000, tick * 20
        messages = [mavlink.MAVLink_attitude_message(ms, 0.1, 0.0, 0.5, 0, 0, 0)]
        if tick % 5 == 0:
            telemetry.add_timesync_request(now_ns)
            messages.append(mavlink.MAVLink_local_position_ned_message(ms, 0, 0, -100.0, 1, 2, 0))
            messages.append(mavlink.MAVLink_timesync_message(now_ns + 1, now_ns))
        for message in messages:
            for heard in decoder.feed(message.pack(sender)):
                telemetry.update(heard, now_ns)
        telemetry.vehicle(now_ns)
        if tick == round(hours * 3600 * 5):
            early = tracemalloc.get_traced_memory()[0]
    grown = tracemalloc.get_traced_memory()[0] - early
    tracemalloc.stop()
    return grown


if __name__ == "__main__":
    begin = time.perf_counter()
    done = fuzz(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000, seed=1)
    print(f"{done.packets} pieces, {done.heard} messages heard, longest {done.longest_s * 1e3:.1f} ms, "
          f"{time.perf_counter() - begin:.0f} s")  # fmt: skip
    print(f"an hour of traffic: {growth_bytes(1.0)} bytes more at its end than after its first tenth")
