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
class Picture:
    """The last new picture. Its digest is kept in its place, since buffers are reused.

    Attributes:
        digest: of its pixels.
        since_s: time since then.
        moved_m: (2,) way since then, east and north; NaN if it was not measured.
    """

    digest: tuple[object, ...]
    since_s: float
    moved_m: Array

    @classmethod
    def of(cls, frame: Frame) -> Picture:
        """The frame's own, as a new one."""
        return cls(_digest(frame), 0.0, np.zeros(2))

    def next(self, frame: Frame, ways: Ways) -> Picture:
        """The last new picture at the next frame, which this is the way to."""
        new, step = Picture.of(frame), ways.stated or ways.seen
        if new.digest != self.digest:
            return new
        way_m = np.full(2, np.nan) if step is None else step.moved_m
        return Picture(self.digest, self.since_s + ways.interval_s, self.moved_m + way_m)

    def refusal(self, frame: Frame) -> NoFix | None:
        """Refuse a frame that repeats it although the vehicle has moved since; else None."""
        moved_m = float(np.hypot(*self.moved_m))
        if not moved_m >= _MIN_M:
            return None
        detail = f"the picture repeats the one {self.since_s:.1f} s and {moved_m:.1f} m ago"
        return NoFix(reason=Reason.FAILED, detail=detail, timestamp_ns=frame.timestamp_ns)


def _digest(frame: Frame) -> tuple[object, ...]:
    image, shape = frame.image, tuple(frame.image.shape)
    step = max(1, int(np.prod(shape)) // _SAMPLES) | 1  # odd, so that all columns and channels are sampled
    flat = image.reshape(-1)[::step]
    values = np.ascontiguousarray(flat) if isinstance(flat, np.ndarray) else flat.cpu().numpy()
    return shape, zlib.crc32(values.tobytes())
