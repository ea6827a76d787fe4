"""Pictures as they are captured: by a camera or stream, or by a flight that is played at its own pace."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError
from engine.formats.flight import open_flight
from engine.formats.telemetry import shown

Picture = tuple[NDArray[np.uint8], int]
"""(H, W, 3) RGB, and when it was captured on ``time.monotonic_ns``."""


def replay(
    frames: Path, telemetry: Path | None, *, rate_hz: float, wait: Callable[[], None] | None = None
) -> Iterator[Picture]:
    """A folder or video again, each picture when its turn has come.

    Args:
        frames: pictures or video.
        telemetry: telemetry.csv, whose stamps set the pace; without it ``rate_hz`` does.
        rate_hz: pictures a second where there are no stamps.
        wait: called when the first picture is at hand; the pace begins when it returns.

    Raises:
        TelemetryError: it cannot be read.
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


def capture(source: str, *, exposure_to_grab_ms: float = 0.0) -> Iterator[Picture]:
    """A camera by its number, or a stream by its URL or pipeline, until it ends.

    Args:
        source: a number, or what ``cv2.VideoCapture`` opens.
        exposure_to_grab_ms: how much earlier than its arrival here a picture was exposed; a camera's own figure.

    Raises:
        TelemetryError: it cannot be opened.
    """
    import cv2

    try:
        camera = cv2.VideoCapture(int(source) if source.isdecimal() else source)
        opened = camera.isOpened()
    except (cv2.error, ValueError):  # a number with more digits than OpenCV or Python takes
        opened = False
    if not opened:
        raise TelemetryError(f"camera_source: expected a camera or stream that opens, got {shown(source)}")
    camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    try:
        while camera.grab():
            captured_ns = time.monotonic_ns() - round(exposure_to_grab_ms * 1e6)
            good, image = camera.retrieve()
            if good and image is not None:
                yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8), captured_ns
    finally:
        camera.release()
