"""Repeated pictures: a camera that hangs shows where the vehicle was, and a match of that is no fix of now."""

from __future__ import annotations

import numpy as np
import torch

from engine.motion import OdometrySample
from engine.values import Frame, NoFix, Reason

_LEAST_M = 0.5  # a camera without noise may show one place twice


class Repeats:
    """Knows the last picture that was new, and where the vehicle was then."""

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._sample: OdometrySample | None = None

    def refusal(self, frame: Frame, now: OdometrySample) -> NoFix | None:
        """The refusal of a picture that is the last one again though the vehicle has moved since, else None."""
        last, sample = self._frame, self._sample
        if last is None or sample is None or not _is_same(last, frame):
            self._frame, self._sample = frame, now
            return None
        moved_m = float(np.hypot(*(now.moved_m - sample.moved_m)))
        if now.blind_s != sample.blind_s or moved_m < _LEAST_M:  # not measured, or not moved
            return None
        detail = f"the picture is the one of {now.time_s - sample.time_s:.1f} s and {moved_m:.1f} m ago"
        return NoFix(reason=Reason.FAILED, detail=detail, timestamp_ns=frame.timestamp_ns)


def _is_same(a: Frame, b: Frame) -> bool:
    if a.image is b.image:
        return True
    if tuple(a.image.shape) != tuple(b.image.shape):
        return False
    if isinstance(a.image, torch.Tensor) or isinstance(b.image, torch.Tensor):
        return torch.equal(torch.as_tensor(a.image), torch.as_tensor(b.image).to(torch.as_tensor(a.image).device))
    return bool(np.array_equal(a.image[:1], b.image[:1]) and np.array_equal(a.image, b.image))
