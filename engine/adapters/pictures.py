"""Images with their capture times: from a camera or stream, or from a recorded flight replayed in real time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError
from engine.formats.flight import open_flight
from engine.formats.tables import quoted

__all__ = ["CapturedImage", "capture", "replay"]

CapturedImage = tuple[NDArray[np.uint8], int]
"""Image (H, W, 3) RGB uint8, and its capture time on ``time.monotonic_ns``."""


def replay(
    frames: Path, telemetry: Path | None, *, rate_hz: float, wait: Callable[[], None] | None = None
) -> Iterator[CapturedImage]:
    """Replay a folder of images or a video in real time.

    Args:
        frames: folder of images, or video.
        telemetry: telemetry.csv, whose stamps set the pace; None uses ``rate_hz``.
        rate_hz: images per second where there are no stamps.
        wait: called when the first image has been read; the replay starts when it returns.

    Yields:
        :data:`CapturedImage`, each at its time.

    Raises:
        TelemetryError: an image or the telemetry cannot be read.
    """
    begin_ns, first_ns = 0, 0
    for index, item in enumerate(open_flight(frames, telemetry)):
        stamp_ns = item.frame.timestamp_ns
        if stamp_ns is None:
            stamp_ns = round(index * 1e9 / rate_hz)
        if index == 0:
            if wait is not None:
                wait()
            begin_ns, first_ns = time.monotonic_ns(), stamp_ns
        captured_ns = begin_ns + stamp_ns - first_ns
        time.sleep(max(0.0, (captured_ns - time.monotonic_ns()) * 1e-9))
        yield np.asarray(item.frame.image, np.uint8), captured_ns


def capture(source: str, *, exposure_to_grab_ms: float = 0.0) -> Iterator[CapturedImage]:
    """Capture images from a camera or stream until it ends.

    Args:
        source: number of a camera, or a URL or pipeline that ``cv2.VideoCapture`` opens.
        exposure_to_grab_ms: time from exposure to arrival, a property of the camera.

    Yields:
        :data:`CapturedImage` as they arrive.

    Raises:
        TelemetryError: the camera or stream cannot be opened.
    """
    import cv2

    try:
        camera = cv2.VideoCapture(int(source) if source.isdecimal() else source)
        opened = camera.isOpened()
    except (cv2.error, ValueError):  # a number with more digits than OpenCV or Python accepts
        opened = False
    if not opened:
        raise TelemetryError(f"camera_source: expected a camera or stream that opens, got {quoted(source)}")
    camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    try:
        while camera.grab():
            captured_ns = time.monotonic_ns() - round(exposure_to_grab_ms * 1e6)
            good, image = camera.retrieve()
            if good and image is not None:
                yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8), captured_ns
    finally:
        camera.release()
