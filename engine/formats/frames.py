"""Images of a flight, read one at a time from a folder or a video; and the telemetry in their EXIF.

Convention:
    Images are RGB uint8 as stored: an EXIF orientation is ignored, since the camera's calibration refers to the
    stored pixels. The frames of a video are named by their index from 0.
"""

from __future__ import annotations

import itertools
import math
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import TelemetryError
from engine.formats.telemetry import TelemetryRow
from engine.geo import attitude_from_rotation, enu_from_body, wrap_heading_deg

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
"""Suffixes of image files, in lower or upper case."""
_GPS_IFD, _EXIF_IFD = 0x8825, 0x8769
_XMP_BYTES = 512 * 1024
_XMP_VALUE = re.compile(rb"drone-dji:(\w+)(?:=\"|>)\s*([+-]?[0-9]+(?:\.[0-9]+)?)")


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

    @property
    def _known(self) -> frozenset[str]:
        if not hasattr(self, "_names"):
            self._names = frozenset(self.names)
        return self._names

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


class VideoFile(FrameSource):
    """The frames of a video, decoded forward.

    An index is reached by decoding, not by seeking: containers seek to the nearest key frame or round a time
    stamp. Going back therefore restarts at the first frame.
    """

    def __init__(self, path: Path) -> None:
        import cv2

        self.path = path
        self._reset()
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if count < 1:  # a stream that does not state its length
            while self._capture.grab():
                self._next += 1
            count = self._next
            self._reset()
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
        import cv2

        self._reset()
        stamps_ns: list[int] = []
        while len(stamps_ns) < len(self.names) and self._capture.grab():
            stamps_ns.append(round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6))
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self._reset()
        if len(stamps_ns) > 1 and all(a < b for a, b in itertools.pairwise(stamps_ns)):
            return stamps_ns
        if not (math.isfinite(rate_hz) and rate_hz > 0.0):
            raise TelemetryError(f"{self.path}: expected a video with time stamps or a frame rate, got neither")
        return [round(i * 1e9 / rate_hz) for i in range(len(stamps_ns))]

    def _reset(self) -> None:
        import cv2

        self._capture = cv2.VideoCapture(str(self.path))
        self._next = 0  # index of the frame that the decoder returns next
        self._last: tuple[int, NDArray[np.uint8]] | None = None
        if not self._capture.isOpened():
            raise TelemetryError(f"{self.path}: expected a picture folder or a video, got a file that is neither")

    def read(self, name: str) -> NDArray[np.uint8]:
        """Read one frame as (H, W, 3) RGB uint8; fast for ascending indices."""
        import cv2

        self.check_name(name)
        index = int(name)
        if self._last is not None and self._last[0] == index:
            return self._last[1].copy()
        if index < self._next:
            self._reset()
        while self._next < index and self._capture.grab():
            self._next += 1
        success, image = self._capture.read() if self._next == index else (False, None)
        if not success or image is None:
            raise TelemetryError(
                f"{self.path}: frame {index}: expected {len(self.names)} frames as the file says, "
                f"got no more than {self._next}"
            )
        self._next += 1
        rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        self._last = (index, rgb)
        return rgb.copy()


def open_frames(path: str | Path) -> FrameSource:
    """Open a folder of images, one image, or a video.

    Raises:
        TelemetryError: there is no such path, the folder holds no images, or the file is no video.
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
        TelemetryError: the file is missing, empty, truncated or no image.
    """
    from PIL import Image

    try:
        with Image.open(path) as picture:
            if picture.mode.startswith("I;16"):
                grey = (np.asarray(picture).astype(np.uint16) >> 8).astype(np.uint8)
                return np.repeat(grey[:, :, None], 3, axis=2)
            if picture.mode in ("I", "F"):
                raise TelemetryError(
                    f"{path}: expected a picture of 8 or 16 bits a channel, got mode {picture.mode}"
                )
            return np.array(picture.convert("RGB"), dtype=np.uint8)
    except FileNotFoundError:
        raise TelemetryError(f"{path}: no such picture") from None
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise TelemetryError(f"{path}: expected a readable picture: {reason}") from None


def exif_telemetry(source: str | Path | Sequence[str | Path]) -> list[TelemetryRow]:
    """Telemetry from photographs' EXIF and DJI's XMP.

    ==================================  =====================================================================
    DateTimeOriginal, SubSec, Offset    timestamp_ns; UTC where there is no offset
    GPSLatitude, GPSLongitude           the prior; GPSHPositioningError its sigma
    GPSAltitude                         alt_amsl_m
    GPSImgDirection                     heading_deg, where its reference is true north
    drone-dji:RelativeAltitude          height_agl_m, above the take-off point
    drone-dji:Gimbal*Degree             heading, roll and pitch of a body with the camera mounted nadir
    drone-dji:FlightYawDegree           heading_deg, where there are no gimbal angles
    ==================================  =====================================================================

    Args:
        source: a folder, or paths of images.

    Returns:
        Rows in the order of time, named by file name; photographs without a capture time are omitted.
        Photographs of the same second without sub-seconds are spaced evenly within it.

    Raises:
        TelemetryError: an image cannot be opened.
    """
    if isinstance(source, (str, Path)):
        folder = PictureFolder(Path(source))
        source = [folder.path / name for name in folder.names]
    rows = [row for path in source if (row := _exif_row(Path(path))) is not None]
    rows.sort(key=lambda row: row.timestamp_ns)  # stable: equal stamps keep the order of the names
    counts, seen = Counter(row.timestamp_ns for row in rows), Counter[int]()
    for i, row in enumerate(rows):
        shift_ns = seen[row.timestamp_ns] * 1_000_000_000 // counts[row.timestamp_ns]
        seen[row.timestamp_ns] += 1
        rows[i] = replace(row, timestamp_ns=row.timestamp_ns + shift_ns)
    return rows


def _exif_row(path: Path) -> TelemetryRow | None:
    from PIL import Image

    try:
        with Image.open(path) as picture:
            exif = picture.getexif()
            gps, captured = exif.get_ifd(_GPS_IFD), exif.get_ifd(_EXIF_IFD)
        with path.open("rb") as file:
            xmp = {key.decode(): float(value) for key, value in _XMP_VALUE.findall(file.read(_XMP_BYTES))}
    except (OSError, SyntaxError, ValueError) as error:
        raise TelemetryError(f"{path}: expected a readable picture: {str(error).splitlines()[0]}") from None
    stamp_ns = _capture_ns(captured)
    if stamp_ns is None:
        return None
    attitude = _gimbal_attitude(xmp) or {"heading_deg": _heading_deg(gps, xmp)}
    height_m = xmp.get("RelativeAltitude", 0.0)
    return TelemetryRow(
        timestamp_ns=stamp_ns,
        frame=path.name,
        height_agl_m=height_m if height_m > 0.0 else None,
        alt_amsl_m=_altitude_m(gps),
        **attitude,
        **_position(gps),
    )


def _capture_ns(exif: Mapping[int, Any]) -> int | None:
    """Nanoseconds since 1970 of DateTimeOriginal (0x9003), its sub-seconds (0x9291) and offset (0x9011)."""
    offset = str(exif.get(0x9011, "")).strip("\0 ") or "+00:00"
    try:
        time = datetime.strptime(f"{str(exif[0x9003]).strip(chr(0) + ' ')} {offset}", "%Y:%m:%d %H:%M:%S %z")
    except (KeyError, ValueError):
        return None
    fraction = re.match(r"[0-9]*", str(exif.get(0x9291, "")).strip())
    nanoseconds = int(fraction.group().ljust(9, "0")[:9]) if fraction else 0
    since = time - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + nanoseconds


def _finite(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _position(gps: Mapping[int, Any]) -> dict[str, float | None]:
    lat_deg, lon_deg = _degrees(gps.get(2), gps.get(1) == "S"), _degrees(gps.get(4), gps.get(3) == "W")
    # Receivers without a fix write zeros.
    if lat_deg is None or lon_deg is None or (lat_deg == 0.0 and lon_deg == 0.0):
        return {}
    if abs(lat_deg) > 90.0 or abs(lon_deg) > 180.0:
        return {}
    sigma_m = _finite(gps.get(0x1F))
    return {"lat_deg": lat_deg, "lon_deg": lon_deg, "sigma_m": sigma_m if sigma_m and sigma_m > 0.0 else None}


def _degrees(parts: Any, negative: bool) -> float | None:
    values = [_finite(part) for part in parts or ()]
    if len(values) != 3 or None in values:
        return None
    degrees = sum(
        value / unit for value, unit in zip(values, (1.0, 60.0, 3600.0), strict=True) if value is not None
    )
    return -degrees if negative else degrees


def _altitude_m(gps: Mapping[int, Any]) -> float | None:
    altitude_m = _finite(gps.get(6))
    below_sea = gps.get(5) in (1, b"\x01")
    return -altitude_m if altitude_m is not None and below_sea else altitude_m


def _heading_deg(gps: Mapping[int, Any], xmp: Mapping[str, float]) -> float | None:
    if "FlightYawDegree" in xmp:
        return wrap_heading_deg(xmp["FlightYawDegree"])
    heading_deg = _finite(gps.get(17))
    return wrap_heading_deg(heading_deg) if heading_deg is not None and gps.get(16) == "T" else None


def _gimbal_attitude(xmp: Mapping[str, float]) -> dict[str, float | None] | None:
    try:
        angles = (xmp["GimbalRollDegree"], xmp["GimbalPitchDegree"], xmp["GimbalYawDegree"])
    except KeyError:
        return None
    return dict(zip(("roll_deg", "pitch_deg", "heading_deg"), nadir_attitude(*angles), strict=True))


def nadir_attitude(
    gimbal_roll_deg: float, gimbal_pitch_deg: float, gimbal_yaw_deg: float
) -> tuple[float, float, float]:
    """Attitude of a body on which the gimbal's camera would be mounted nadir, the image's top to the nose.

    DJI's angles rotate the camera's forward, right and down axes; a pitch of -90 degrees is nadir. The camera's
    forward is the body's down, its up the body's forward. The result is the same with a roll of 180 degrees, as
    some models write it.

    Args:
        gimbal_roll_deg: roll in degrees.
        gimbal_pitch_deg: pitch in degrees, -90 looks straight down.
        gimbal_yaw_deg: yaw in degrees, clockwise from true north.

    Returns:
        Roll, pitch and heading in degrees.
    """
    forward, right, down = enu_from_body(gimbal_roll_deg, gimbal_pitch_deg, gimbal_yaw_deg).T
    return attitude_from_rotation(np.stack([-down, right, forward], axis=1))


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key in which runs of digits compare as numbers."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(0, int(part), part) if part[0] in "0123456789" else (1, 0, part) for part in parts]
