"""Images of a flight, read one at a time from a folder or a video.

Convention:
    Images are RGB uint8 as stored: an EXIF orientation is ignored, since the camera's calibration refers to the
    stored pixels. The frames of a video are named by their index from 0.
"""

from __future__ import annotations

import itertools
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError

if TYPE_CHECKING:
    from PIL.Image import Image

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
"""Suffixes of image files, in lower or upper case."""
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".ts")
"""Suffixes of videos that may have subtitles beside them, in lower or upper case."""


class FrameSource(ABC):
    """A source of frames that are read by name.

    Attributes:
        path: the folder or file.
        names: names of the frames, in the order of the flight.
    """

    path: Path
    names: list[str]

    def __contains__(self, name: object) -> bool:
        return name in self._known

    @cached_property
    def _known(self) -> frozenset[str]:
        return frozenset(self.names)

    @abstractmethod
    def read(self, name: str) -> NDArray[np.uint8]:
        """Read one frame as (H, W, 3) RGB uint8.

        Raises:
            TelemetryError: there is no such frame, or it cannot be decoded.
        """

    def check_name(self, name: str) -> None:
        """Check that a frame exists, without reading it.

        Raises:
            TelemetryError: there is no such frame.
        """
        if name not in self:
            raise TelemetryError(f"{self.path}, frame: expected {self.description}, got {name!r}")

    @property
    def description(self) -> str:
        """The names of the frames in a few words, for messages."""
        return f"one of {len(self.names)} pictures, {self.names[0]} to {self.names[-1]}"


class PictureFolder(FrameSource):
    """The images of a folder, in natural order (2.jpg before 10.jpg), without hidden files."""

    def __init__(self, path: Path) -> None:
        self.path = path
        files = (file.name for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES)
        self.names = sorted((name for name in files if not name.startswith(".")), key=_natural)
        if not self.names:
            raise TelemetryError(f"{path}: expected pictures ({', '.join(PICTURE_SUFFIXES)}), got none")

    def read(self, name: str) -> NDArray[np.uint8]:
        """Read one image as (H, W, 3) RGB uint8."""
        self.check_name(name)
        return read_image(self.path / name)


class SinglePicture(PictureFolder):
    """A single image."""

    def __init__(self, path: Path) -> None:
        self.path, self.names = path.parent, [path.name]


class ForwardFrames(FrameSource):
    """Frames that are decoded forward and named by their index; going back restarts at the first."""

    _next = 0  # index of the frame that the decoder returns next
    _last: tuple[int, NDArray[np.uint8]] | None = None

    def read(self, name: str) -> NDArray[np.uint8]:
        """Read one frame as (H, W, 3) RGB uint8; fast for ascending indices."""
        self.check_name(name)
        index = int(name)
        if self._last is None or self._last[0] != index:
            if index < self._next:
                self._restart()
            self._last = index, self._decode(index)
        return self._last[1].copy()

    @abstractmethod
    def _restart(self) -> None:
        """Begin again with the first frame."""

    @abstractmethod
    def _decode(self, index: int) -> NDArray[np.uint8]:
        """The frame at an index of ``_next`` or more, as (H, W, 3) RGB uint8; advances ``_next`` past it."""


class VideoFile(ForwardFrames):
    """The frames of a video, decoded forward.

    An index is reached by decoding, not by seeking: containers seek to the nearest key frame or round a time
    stamp. Going back therefore restarts at the first frame.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._restart()
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if count < 1:  # the stream does not state its length
            while self._capture.grab():
                self._next += 1
            count = self._next
            self._restart()
        if count < 1:
            raise TelemetryError(f"{path}: expected a video, got a file without frames")
        self.names = [str(index) for index in range(count)]

    @property
    def description(self) -> str:
        """The range of indices, for messages."""
        return f"an index from 0 to {len(self.names) - 1} of the video"

    def stamps_ns(self) -> list[int]:
        """Presentation time of each frame in nanoseconds from the start, else from the frame rate.

        Raises:
            TelemetryError: the video states neither.
        """
        self._restart()
        stamps_ns: list[int] = []
        while len(stamps_ns) < len(self.names) and self._capture.grab():
            stamps_ns.append(round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6))
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self._restart()
        if len(stamps_ns) > 1 and all(a < b for a, b in itertools.pairwise(stamps_ns)):
            return stamps_ns
        if not (math.isfinite(rate_hz) and rate_hz > 0.0):
            raise TelemetryError(f"{self.path}: expected a video with time stamps or a frame rate, got neither")
        return [round(i * 1e9 / rate_hz) for i in range(len(stamps_ns))]

    def _restart(self) -> None:
        self._capture, self._next = cv2.VideoCapture(str(self.path)), 0
        if not self._capture.isOpened():
            raise TelemetryError(f"{self.path}: expected a picture folder or a video, got a file that is neither")

    def _decode(self, index: int) -> NDArray[np.uint8]:
        while self._next < index and self._capture.grab():
            self._next += 1
        success, image = self._capture.read() if self._next == index else (False, None)
        if not success or image is None:
            raise TelemetryError(
                f"{self.path}: frame {index}: expected {len(self.names)} frames as the file states, "
                f"got no more than {self._next}"
            )
        self._next += 1
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def open_frames(path: str | Path) -> FrameSource:
    """Open a folder of images, one image, or a video.

    Raises:
        TelemetryError: there is no such path, the folder holds no images, or the file is not a video.
    """
    path = Path(path)
    if path.is_dir():
        return PictureFolder(path)
    if not path.exists():
        raise TelemetryError(f"{path}: no such folder or video")
    if path.stat().st_size == 0:
        raise TelemetryError(f"{path}: expected a picture folder or a video, got an empty file")
    return SinglePicture(path) if path.suffix.lower() in PICTURE_SUFFIXES else VideoFile(path)


def read_image(path: str | Path) -> NDArray[np.uint8]:
    """Read an image file as RGB; grey is copied to three channels, 16 bits are reduced to the upper 8.

    Args:
        path: the file.

    Returns:
        (H, W, 3) uint8.

    Raises:
        TelemetryError: the file is missing, empty, truncated or not an image.
    """
    with opened_picture(path, str(path)) as picture:
        if picture.mode.startswith("I;16"):
            grey = (np.asarray(picture).astype(np.uint16) >> 8).astype(np.uint8)
            return np.repeat(grey[:, :, None], 3, axis=2)
        if picture.mode in ("I", "F"):
            raise TelemetryError(f"{path}: expected a picture of 8 or 16 bits a channel, got mode {picture.mode}")
        return np.array(picture.convert("RGB"), dtype=np.uint8)


@contextmanager
def opened_picture(source: str | Path | BinaryIO, name: str, kind: str = "picture") -> Iterator[Image]:
    """An open picture of Pillow's, whose pixels may be damaged.

    Args:
        source: the file.
        name: what it is, for messages.
        kind: what was expected, for messages.

    Raises:
        TelemetryError: there is none, or it cannot be opened or, inside the block, decoded.
    """
    from PIL import Image

    try:
        with Image.open(source) as picture:
            yield picture
    except FileNotFoundError:
        raise TelemetryError(f"{name}: no such picture") from None
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise TelemetryError(f"{name}: expected a readable {kind}: {reason}") from None


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key in which runs of digits compare as numbers."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(0, int(part), part) if part[0] in "0123456789" else (1, 0, part) for part in parts]
