"""Images with their capture times: from a camera or stream, or from a recorded flight replayed in real time."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError
from scenematch.bridges.camera_stream import capture
from scenematch.files.flight import Flight, open_flight
from scenematch.files.tables import quoted

__all__ = ["CapturedImage", "capture", "first_picture", "replay"]

_FIRST_PICTURE_S = 30.0

CapturedImage = tuple[NDArray[np.uint8], int]
"""Image (H, W, 3) RGB uint8, and its capture time on ``time.monotonic_ns``."""


def first_picture(camera_source: str) -> NDArray[np.uint8]:
    """Open a camera, take its first picture and close it.

    Args:
        camera_source: see :func:`scenematch.bridges.camera_stream.capture`.

    Returns:
        (H, W, 3) RGB uint8.

    Raises:
        TelemetryError: the camera does not open, or delivers no picture for a while.
    """
    until = time.monotonic() + _FIRST_PICTURE_S
    with closing(capture(camera_source)) as pictures:
        for picture in pictures:
            if picture is not None:
                return picture[0]
            if time.monotonic() > until:
                break
    raise TelemetryError(
        f"camera_source: expected a picture within {_FIRST_PICTURE_S:g} s, got none of {quoted(camera_source)}"
    )


def replay(
    frames: Path, telemetry: Path | None, *, rate_hz: float, every: int = 1, wait: Callable[[], None] | None = None
) -> Generator[CapturedImage, None, None]:
    """Replay a folder of images or a video in real time.

    This call opens the flight, because reading a video's times takes seconds in which the autopilot flies.

    Args:
        frames: folder of images, or video.
        telemetry: telemetry.csv or a log that times the replay; None uses the subtitles beside a video, the EXIF
            of photographs, else ``rate_hz``.
        rate_hz: images per second if there are no stamps.
        every: replay every Nth image, at its own time.
        wait: called once the first image has been read; the replay starts when it returns.

    Returns:
        :data:`CapturedImage`, each at its time.

    Raises:
        TelemetryError: an image or the telemetry cannot be read.
    """
    return _play(open_flight(frames, telemetry).every(every), rate_hz / every, wait)


def _play(flight: Flight, rate_hz: float, wait: Callable[[], None] | None) -> Generator[CapturedImage, None, None]:
    begin_ns, first_ns = 0, 0
    for index, item in enumerate(flight):
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
