"""Pictures of a flight: a folder of photographs or a video, read one at a time; and what EXIF says of them.

Convention:
    Pictures are RGB uint8 as stored: an EXIF orientation turns nothing, since the camera's calibration
    counts the stored pixels. The frames of a video are named by their index from 0.
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
"""Files that count as pictures, in either case."""
_GPS_IFD, _EXIF_IFD = 0x8825, 0x8769
_XMP_BYTES = 512 * 1024
_XMP_VALUE = re.compile(rb"drone-dji:(\w+)(?:=\"|>)\s*([+-]?[0-9]+(?:\.[0-9]+)?)")


class FrameSource(ABC):
    """Frames that are read by name.

    Attributes:
        path: the folder or file.
        names: what can be read, in the order of the flight.
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
        """One frame as (H, W, 3) RGB.

        Raises:
            TelemetryError: there is no such frame, or it cannot be decoded.
        """

    def check(self, name: str) -> None:
        """Refuse a name that is not there, without reading it.

        Raises:
            TelemetryError: there is no such frame.
        """
        if name not in self:
            raise TelemetryError(f"{self.path}, frame: expected {self.described}, got {name!r}")

    @property
    def described(self) -> str:
        """The names that there are, in a few words."""
        return f"one of {len(self.names)} pictures, {self.names[0]} to {self.names[-1]}"


class PictureFolder(FrameSource):
    """The pictures of a folder, in natural order (2.jpg before 10.jpg); hidden files do not count."""

    def __init__(self, path: Path) -> None:
        self.path = path
        files = (file.name for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES)
        self.names = sorted((name for name in files if not name.startswith(".")), key=_natural)
        if not self.names:
            raise TelemetryError(f"{path}: expected pictures ({', '.join(PICTURE_SUFFIXES)}), got none")

    def read(self, name: str) -> NDArray[np.uint8]:
        """One picture as (H, W, 3) RGB."""
        self.check(name)
        return read_image(self.path / name)


class SinglePicture(PictureFolder):
    """One picture by itself."""

    def __init__(self, path: Path) -> None:
        self.path, self.names = path.parent, [path.name]


class VideoFile(FrameSource):
    """The frames of a video, decoded forward.

    An index is counted by decoding, never sought: containers answer a seek with the nearest key frame or
    round a time stamp. Going back therefore starts again at the first frame.
    """

    def __init__(self, path: Path) -> None:
        import cv2

        self.path = path
        self._reset()
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if count < 1:  # a stream that does not say how long it is
            while self._capture.grab():
                self._next += 1
            count = self._next
            self._reset()
        if count < 1:
            raise TelemetryError(f"{path}: expected a video, got a file without frames")
        self.names = [str(index) for index in range(count)]

    @property
    def described(self) -> str:
        """The indices that there are."""
        return f"an index from 0 to {len(self.names) - 1} of the video"

    def stamps_ns(self) -> list[int]:
        """When each frame is shown, from the start of the video; where it does not say, by its frame rate.

        Raises:
            TelemetryError: the video tells neither.
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
            raise TelemetryError(f"{self.path}: expected a video that tells its frames' times, got none")
        return [round(i * 1e9 / rate_hz) for i in range(len(stamps_ns))]

    def _reset(self) -> None:
        import cv2

        self._capture = cv2.VideoCapture(str(self.path))
        self._next = 0  # the index that the decoder hands out next
        self._last: tuple[int, NDArray[np.uint8]] | None = None
        if not self._capture.isOpened():
            raise TelemetryError(f"{self.path}: expected a picture folder or a video, got a file that is neither")

    def read(self, name: str) -> NDArray[np.uint8]:
        """One frame as (H, W, 3) RGB; cheap where names come in ascending order."""
        import cv2

        self.check(name)
        index = int(name)
        if self._last is not None and self._last[0] == index:
            return self._last[1].copy()
        if index < self._next:
            self._reset()
        while self._next < index and self._capture.grab():
            self._next += 1
        good, image = self._capture.read() if self._next == index else (False, None)
        if not good or image is None:
            raise TelemetryError(
                f"{self.path}: frame {index}: expected {len(self.names)} frames as the file says, "
                f"got no more than {self._next}"
            )
        self._next += 1
        rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        self._last = (index, rgb)
        return rgb.copy()


def open_frames(path: str | Path) -> FrameSource:
    """A folder of pictures, one picture, or a video.

    Raises:
        TelemetryError: there is no such path, the folder holds no pictures, or the file is no video.
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
    """One picture as (H, W, 3) RGB; grey is spread over three channels, 16 bits lose the lower 8.

    Raises:
        TelemetryError: the file is missing, empty, truncated or no picture.
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
    DateTimeOriginal, SubSec, Offset    timestamp_ns; a clock without offset is taken as UTC
    GPSLatitude, GPSLongitude           the prior; GPSHPositioningError its sigma
    GPSAltitude                         alt_amsl_m
    GPSImgDirection                     heading_deg, where its reference is true north
    drone-dji:RelativeAltitude          height_agl_m, above the place of take-off
    drone-dji:Gimbal*Degree             heading, roll and pitch of a body that carries the camera looking down
    drone-dji:FlightYawDegree           heading_deg, where the gimbal says nothing
    ==================================  =====================================================================

    Args:
        source: a folder, or the pictures.

    Returns:
        Rows in the order of time, named by file name; photographs without a capture time are left out.
        Photographs of one second without sub-seconds are spread evenly over it.

    Raises:
        TelemetryError: a picture cannot be opened.
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
            gps, taken = exif.get_ifd(_GPS_IFD), exif.get_ifd(_EXIF_IFD)
        with path.open("rb") as file:
            xmp = {key.decode(): float(value) for key, value in _XMP_VALUE.findall(file.read(_XMP_BYTES))}
    except (OSError, SyntaxError, ValueError) as error:
        raise TelemetryError(f"{path}: expected a readable picture: {str(error).splitlines()[0]}") from None
    stamp_ns = _capture_ns(taken)
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


def _capture_ns(taken: Mapping[int, Any]) -> int | None:
    """Nanoseconds since 1970 of DateTimeOriginal (0x9003), its sub-seconds (0x9291) and offset (0x9011)."""
    offset = str(taken.get(0x9011, "")).strip("\0 ") or "+00:00"
    try:
        moment = datetime.strptime(f"{str(taken[0x9003]).strip(chr(0) + ' ')} {offset}", "%Y:%m:%d %H:%M:%S %z")
    except (KeyError, ValueError):
        return None
    fraction = re.match(r"[0-9]*", str(taken.get(0x9291, "")).strip())
    nanoseconds = int(fraction.group().ljust(9, "0")[:9]) if fraction else 0
    since = moment - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + nanoseconds


def _finite(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _position(gps: Mapping[int, Any]) -> dict[str, float | None]:
    lat_deg, lon_deg = _degrees(gps.get(2), gps.get(1) == "S"), _degrees(gps.get(4), gps.get(3) == "W")
    # A receiver without a fix writes zeros.
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
    """Attitude of the body on which the gimbal's camera would be mounted looking down, top to the nose.

    DJI's angles turn the camera's own forward, right and down, in which a pitch of -90 degrees looks at the
    ground. Its forward is that body's down, and its up the body's forward; with a roll of 180 degrees, as
    some models write it, the same rotation comes out.

    Returns:
        tuple[float, float, float]: roll, pitch and heading.
    """
    forward, right, down = enu_from_body(gimbal_roll_deg, gimbal_pitch_deg, gimbal_yaw_deg).T
    return attitude_from_rotation(np.stack([-down, right, forward], axis=1))


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key under which digits count as numbers."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(0, int(part), part) if part[0] in "0123456789" else (1, 0, part) for part in parts]
