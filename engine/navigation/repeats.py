"""Repeated pictures: a camera that hangs shows where the vehicle was, and a match of that is no fix of now."""

from __future__ import annotations

import zlib

import numpy as np

from engine.navigation.motion import OdometrySample
from engine.values import Frame, NoFix, Reason

_LEAST_M = 0.5  # a camera without noise may show one place twice
_SAMPLES = 1 << 16  # of a picture, by which it is told from the next


class Repeats:
    """Knows the last picture that was new, and where it was taken; by a digest, since buffers are filled again."""

    def __init__(self) -> None:
        self._digest: tuple[object, ...] | None = None
        self._sample: OdometrySample | None = None

    def refusal(self, frame: Frame, now: OdometrySample) -> NoFix | None:
        """The refusal of a picture that is the last one again though the vehicle has moved since, else None."""
        digest, sample = _digest(frame), self._sample
        if sample is None or digest != self._digest:
            self._digest, self._sample = digest, now
            return None
        moved_m = float(np.hypot(*(now.moved_m - sample.moved_m)))
        if now.blind_s != sample.blind_s or moved_m < _LEAST_M:  # not measured, or not moved
            return None
        detail = f"the picture is the one of {now.time_s - sample.time_s:.1f} s and {moved_m:.1f} m ago"
        return NoFix(reason=Reason.FAILED, detail=detail, timestamp_ns=frame.timestamp_ns)


def _digest(frame: Frame) -> tuple[object, ...]:
    image, shape = frame.image, tuple(frame.image.shape)
    step = max(1, int(np.prod(shape)) // _SAMPLES) | 1  # odd, so that all columns and channels take part
    flat = image.reshape(-1)[::step]
    values = np.ascontiguousarray(flat) if isinstance(flat, np.ndarray) else flat.cpu().numpy()
    return shape, zlib.crc32(values.tobytes())
