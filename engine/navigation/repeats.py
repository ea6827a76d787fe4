"""Repeated images: a frozen camera shows where the vehicle was, so its match is no current fix."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from engine.navigation.motion import Array, Ways
from engine.values import Frame, NoFix, Reason

_MIN_M = 0.5  # a noise-free camera at rest may repeat an image
_SAMPLES = 1 << 16  # pixels of a picture that enter its digest


@dataclass(frozen=True, slots=True)
class _Picture:
    """The last new picture: its digest, and the time and way since then; None if the way was not measured."""

    digest: tuple[object, ...] | None
    since_s: float
    moved_m: Array | None


class Repeats:
    """Remembers the last new picture by its digest, since buffers are reused, and the way since then."""

    def __init__(self) -> None:
        self._last = self._next = _Picture(None, 0.0, None)

    def refusal(self, frame: Frame, ways: Ways) -> NoFix | None:
        """Refuse a picture that repeats the last one although the vehicle has moved since; else None."""
        last, digest, step = self._last, _digest(frame), ways.told or ways.seen
        if digest != last.digest:
            self._next = _Picture(digest, 0.0, np.zeros(2))
            return None
        moved_m = None if step is None or last.moved_m is None else last.moved_m + step.moved_m
        self._next = _Picture(digest, last.since_s + ways.interval_s, moved_m)
        if moved_m is None or np.hypot(*moved_m) < _MIN_M:
            return None
        ago = f"{self._next.since_s:.1f} s and {np.hypot(*moved_m):.1f} m ago"
        detail = f"the picture repeats the one {ago}"
        return NoFix(reason=Reason.FAILED, detail=detail, timestamp_ns=frame.timestamp_ns)

    def take(self) -> None:
        """Remember the picture last asked about: its frame was matched."""
        self._last = self._next


def _digest(frame: Frame) -> tuple[object, ...]:
    image, shape = frame.image, tuple(frame.image.shape)
    step = max(1, int(np.prod(shape)) // _SAMPLES) | 1  # odd, so that all columns and channels are sampled
    flat = image.reshape(-1)[::step]
    values = np.ascontiguousarray(flat) if isinstance(flat, np.ndarray) else flat.cpu().numpy()
    return shape, zlib.crc32(values.tobytes())
