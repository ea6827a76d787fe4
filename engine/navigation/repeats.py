"""Repeated images: a frozen camera shows where the vehicle was, so its match is no current fix."""

from __future__ import annotations

import zlib

import numpy as np

from engine.navigation.motion import Ways
from engine.values import Frame, NoFix, Reason

_MIN_M = 0.5  # a noise-free camera at rest may repeat an image
_SAMPLES = 1 << 16  # pixels of a picture that enter its digest


class Repeats:
    """Remembers the last new picture by its digest, since buffers are reused, and where it was taken."""

    def __init__(self) -> None:
        self._digest: tuple[object, ...] | None = None
        self._since_s, self._moved_m = 0.0, np.zeros(2)
        self._is_measured = True  # the movement since then

    def refusal(self, frame: Frame, ways: Ways) -> NoFix | None:
        """Refuse a picture that repeats the last one although the vehicle has moved since; else None."""
        digest, step = _digest(frame), ways.told or ways.seen
        if digest != self._digest:
            self._digest = digest
            self._since_s, self._moved_m, self._is_measured = 0.0, np.zeros(2), True
            return None
        self._since_s += ways.interval_s
        self._is_measured &= step is not None
        self._moved_m = self._moved_m + (0.0 if step is None else step.moved_m)
        moved_m = float(np.hypot(*self._moved_m))
        if not self._is_measured or moved_m < _MIN_M:
            return None
        detail = f"the picture repeats the one {self._since_s:.1f} s and {moved_m:.1f} m ago"
        return NoFix(reason=Reason.FAILED, detail=detail, timestamp_ns=frame.timestamp_ns)


def _digest(frame: Frame) -> tuple[object, ...]:
    image, shape = frame.image, tuple(frame.image.shape)
    step = max(1, int(np.prod(shape)) // _SAMPLES) | 1  # odd, so that all columns and channels are sampled
    flat = image.reshape(-1)[::step]
    values = np.ascontiguousarray(flat) if isinstance(flat, np.ndarray) else flat.cpu().numpy()
    return shape, zlib.crc32(values.tobytes())
