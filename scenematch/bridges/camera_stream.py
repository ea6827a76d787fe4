"""A live camera: deliver the newest picture with its capture time, despite stalls, repeats and reconnections.

A separate thread reads, so that no picture waits in a buffer and a blocked read delays nobody. A source is a
camera's number, a URL or SDP file that OpenCV's FFmpeg opens, or ``exec:COMMAND``, which writes JPEG pictures to
its standard output. The latter reads GStreamer and libcamera without a special build of OpenCV.
"""

from __future__ import annotations

import logging
import os
import shlex
import subprocess
import threading
import time
from collections.abc import Generator
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError
from engine.runtime.realtime import Realtime, start_thread
from scenematch.files.tables import quoted

__all__ = ["CameraStream", "capture"]

Image = NDArray[np.uint8]

EXEC = "exec:"
"""Prefix of a source that is a command."""

_REOPEN_S = 1.0
_STALL_S = 2.0  # without a picture, after which the camera is reopened
_START_S = 15.0  # the same for a command before its first picture: it may start slowly
_CLOSE_S = 3.0  # longest time that closing waits for a read in progress
_IDLE_S = 0.5  # without a new picture, after which ``next`` returns
_READ_BYTES = 65536
_JPEG_BEGIN, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_MAX_JPEG_BYTES = 64 * 2**20
_FFMPEG_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
# SDP files need more protocols than FFmpeg allows by itself; the rest keeps it from buffering.
_FFMPEG_OPTIONS = (
    "protocol_whitelist;file,crypto,data,rtp,udp,tcp,http,https,rtsp,tls|rtsp_flags;prefer_tcp"
    "|fflags;nobuffer|flags;low_delay"
)
_TIMEOUTS = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 5000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, 2000]

_GSTREAMER_HINT = "; read a GStreamer pipeline by 'exec:gst-launch-1.0 -q ... ! jpegenc ! fdsink'"

_log = logging.getLogger("scenematch")


class _OpenCvSource:
    """An open camera or stream."""

    def __init__(self, source: str) -> None:
        try:
            if "://" in source or source.endswith(".sdp"):
                self._camera = _open_stream(source)
            else:
                self._camera = cv2.VideoCapture(int(source) if source.isdecimal() else source)
            opened = self._camera.isOpened()
        except (cv2.error, ValueError):  # a number with more digits than OpenCV or Python accepts
            opened = False
        if not opened:
            hint = _GSTREAMER_HINT if "!" in source or source.split(" ")[0].endswith("src") else ""
            raise TelemetryError(
                f"camera_source: expected a camera or stream that opens, got {quoted(source)}{hint}"
            )
        self._camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)

    def read(self) -> tuple[Image, int] | None:
        """The next picture (H, W, 3) RGB and when it arrived on ``time.monotonic_ns``; blocks; None at the end."""
        if not self._camera.grab():
            return None
        arrived_ns = time.monotonic_ns()
        good, image = self._camera.retrieve()
        return (_rgb(image), arrived_ns) if good and image is not None else None

    def interrupt(self) -> None:
        """Make a blocked read return from another thread: here the next picture or the timeout does."""

    def close(self) -> None:
        """Release the camera."""
        self._camera.release()


def _open_stream(source: str) -> Any:
    """A stream without buffering; OpenCV reads FFmpeg's options from the environment, which is then restored."""
    given = os.environ.get(_FFMPEG_VARIABLE)
    os.environ[_FFMPEG_VARIABLE] = given or _FFMPEG_OPTIONS
    try:
        return cv2.VideoCapture(source, cv2.CAP_FFMPEG, _TIMEOUTS)
    finally:
        if given is None:
            del os.environ[_FFMPEG_VARIABLE]


class _CommandSource:
    """Consecutive JPEG pictures from the standard output of a command, read like :class:`_OpenCvSource`."""

    def __init__(self, command: str) -> None:
        try:
            self._process: Any = subprocess.Popen(shlex.split(command), stdout=subprocess.PIPE, bufsize=0)
        except (OSError, ValueError, IndexError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise TelemetryError(f"camera_source: {quoted(command)} cannot be run: {reason}") from None
        self._buffer, self._arrived_ns = bytearray(), 0

    def read(self) -> tuple[Image, int] | None:
        while True:
            begin = self._buffer.find(_JPEG_BEGIN)
            end = self._buffer.find(_JPEG_END, begin + 2) if begin >= 0 else -1
            if end >= 0:
                data = np.frombuffer(bytes(self._buffer[begin : end + 2]), np.uint8)
                del self._buffer[: end + 2]
                image = cv2.imdecode(data, cv2.IMREAD_COLOR)
                if image is not None:  # this end may be a thumbnail's
                    return _rgb(image), self._arrived_ns
                continue
            data = self._process.stdout.read(_READ_BYTES)
            if not data or len(self._buffer) > _MAX_JPEG_BYTES:
                return None
            self._arrived_ns = time.monotonic_ns()
            self._buffer += data

    def interrupt(self) -> None:
        self._process.kill()

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()


def _rgb(image: Any) -> Image:
    code = cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code), np.uint8)


class CameraStream:
    """Reads a source in a thread, and reopens it if it ends or stalls.

    Args:
        source: number, URL, SDP file or ``exec:COMMAND``.
        realtime: scheduling of the reader, whose delay makes every stamp late; None is normal.

    Raises:
        TelemetryError: it cannot be opened now. After later failures it is reopened, and they are logged.
    """

    def __init__(self, source: str, realtime: Realtime | None = None) -> None:
        self._name, self._realtime = source, realtime
        self._changed = threading.Condition()
        self._newest: tuple[Image, int] | None = None
        self._last: Image | None = None
        self._arrived_s = time.monotonic()
        self._number = 0  # of the present reader; an older one that still blocks is ignored
        self._has_read = self._has_started = False  # ever; since the source was last opened
        self._start(self._open())

    def next(self, timeout_s: float) -> tuple[Image, int] | None:
        """The newest picture that differs from the one before it; None if none came in time."""
        until = time.monotonic() + timeout_s
        while (left_s := until - time.monotonic()) > 0.0:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None, left_s)
                newest, self._newest = self._newest, None
            if newest is not None:
                before, self._last = self._last, newest[0]
                if before is None or not np.array_equal(newest[0], before):
                    return newest
        return None

    def close(self) -> None:
        """Stop reading; a process that ends while a thread runs compiled code would abort."""
        self._number += 1
        self._source.interrupt()
        self._thread.join(_CLOSE_S)

    def reopen(self, cause: str) -> None:
        """Abandon the present reader and reopen the source.

        Raises:
            TelemetryError: a command ended without ever delivering a picture.
        """
        if not self._has_read and self._name.startswith(EXEC) and not self._thread.is_alive():
            raise TelemetryError(
                f"camera_source: expected pictures, got none: {quoted(self._name)} ended before the first"
            )
        _log.warning("camera %s: %s; reopened", quoted(self._name), cause)
        self._number += 1
        self._source.interrupt()
        self._arrived_s = time.monotonic()
        try:
            self._start(self._open())
        except TelemetryError:
            time.sleep(_REOPEN_S)

    @property
    def failure(self) -> str | None:
        """Why the source must be reopened; None while pictures arrive, even repeated ones."""
        if not self._thread.is_alive():
            return "the stream ended"
        limit_s = _START_S if self._name.startswith(EXEC) and not self._has_started else _STALL_S
        return f"no picture for {limit_s:g} s" if time.monotonic() - self._arrived_s > limit_s else None

    def _open(self) -> _OpenCvSource | _CommandSource:
        if self._name.startswith(EXEC):
            return _CommandSource(self._name.removeprefix(EXEC))
        return _OpenCvSource(self._name)

    def _start(self, source: _OpenCvSource | _CommandSource) -> None:
        self._source, self._has_started = source, False
        read = partial(self._read, source, self._number)
        self._thread = start_thread(read, "scenematch-camera", self._realtime)

    def _read(self, source: _OpenCvSource | _CommandSource, number: int) -> None:
        try:
            while self._number == number and (picture := source.read()) is not None:
                with self._changed:
                    if self._number == number:
                        self._newest, self._arrived_s = picture, time.monotonic()
                        self._has_read = self._has_started = True
                        self._changed.notify_all()
        except (cv2.error, OSError, ValueError) as error:
            _log.warning("camera %s: %s", quoted(self._name), error)
        finally:
            source.close()


def capture(
    source: str, *, exposure_to_grab_ms: float = 0.0, realtime: Realtime | None = None
) -> Generator[tuple[Image, int] | None, None, None]:
    """Capture pictures from a camera or stream forever.

    Args:
        source: see :class:`CameraStream`; a file of pictures starts again when it ends.
        exposure_to_grab_ms: camera latency, from exposure to arrival.
        realtime: see :class:`CameraStream`.

    Yields:
        Picture and capture time; None if no new one came for half a second. A picture identical to the last does
        not count: a hung camera repeats its last one.

    Raises:
        TelemetryError: the camera or stream cannot be opened at first, or a command ends before its first picture.
    """
    stream = CameraStream(source, realtime)
    try:
        while True:
            picture = stream.next(_IDLE_S)
            if picture is not None:
                yield picture[0], picture[1] - round(exposure_to_grab_ms * 1e6)
                continue
            yield None
            if (failure := stream.failure) is not None:
                stream.reopen(failure)
    finally:
        stream.close()
