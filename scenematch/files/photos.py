"""Photographs: read the metadata of camera and drone, EXIF and DJI's XMP, and their telemetry.

Convention:
    Heights are above the take-off point; positions are from the onboard receiver. Gimbal angles of only zeros mean
    no gimbal. A photograph saved by a viewer may have been rotated: its heading and tilt are unknown.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from engine.errors import TelemetryError
from engine.geo import attitude_from_rotation, enu_from_body, wrap_heading_deg
from engine.values import Truth
from scenematch.files.frames import PictureFolder, opened_picture
from scenematch.files.stamps import since_1970_ns
from scenematch.files.telemetry import TelemetryRow, take_off_sigma_m

COMPASS_SIGMA_DEG = 3.0
"""Standard deviation of a heading by a drone's compass."""
GIMBAL_SIGMA_DEG = 2.0
"""Standard deviation of a gimbal's roll and pitch: in a survey with constant 0.0 and -89.9, poses by SIFT differ
by up to 3 degrees, 1.5 RMS."""
_VIEWERS = ("Photo Viewer", "Photo Gallery", "Picasa")
"""Parts of names of programs that rotate photographs without updating their metadata."""
_SOFTWARE = 0x0131
_GIMBAL = ("GimbalRollDegree", "GimbalPitchDegree", "GimbalYawDegree")
_GPS_IFD, _EXIF_IFD = 0x8825, 0x8769
_XMP_BYTES = 512 * 1024
_XMP_VALUE = re.compile(rb"drone-dji:(\w+)(?:=\"|>)\s*([+-]?[0-9]+(?:\.[0-9]+)?)")
_XMP_DEWARP = re.compile(rb"drone-dji:DewarpData(?:=\"|>)[0-9-]{0,20};([-+0-9.,eE ]{1,400})")


@dataclass(frozen=True, slots=True)
class PhotoTags:
    """The metadata of one photograph.

    Attributes:
        path: the file.
        size_px: width and height of the stored picture.
        exif: tags of the camera by number.
        gps: tags of the position by number.
        xmp: numbers of DJI's XMP by name.
        dewarp: DJI's DewarpData: fx, fy, cx, cy, k1, k2, p1, p2, k3; empty if there is none.
        software: program that last wrote the file.
    """

    path: Path
    size_px: tuple[int, int]
    exif: Mapping[int, Any]
    gps: Mapping[int, Any]
    xmp: Mapping[str, float]
    dewarp: tuple[float, ...] = ()
    software: str = ""

    @property
    def was_turned(self) -> bool:
        """Whether the picture may have been rotated since it was taken; its top is then unknown."""
        return any(viewer in self.software for viewer in _VIEWERS)

    def number(self, tag: int) -> float | None:
        """A finite number of the camera's tags, or None."""
        return _finite(self.exif.get(tag))


def read_photo_tags(path: Path) -> PhotoTags:
    """Read the tags of one picture; those that it lacks are empty.

    Raises:
        TelemetryError: the picture cannot be opened.
    """
    with opened_picture(path, str(path)) as picture, path.open("rb") as file:
        tags, size_px = picture.getexif(), picture.size
        gps, exif = tags.get_ifd(_GPS_IFD), tags.get_ifd(_EXIF_IFD)
        software = str(tags.get(_SOFTWARE, "")).strip("\0 ")
        head = file.read(_XMP_BYTES)
    xmp = {key.decode(): float(value) for key, value in _XMP_VALUE.findall(head)}
    found = _XMP_DEWARP.search(head)
    numbers = [_finite(part) for part in found.group(1).split(b",")] if found else []
    dewarp = tuple(number for number in numbers if number is not None)
    return PhotoTags(path, size_px, exif, gps, xmp, dewarp if len(dewarp) == 9 else (), software)


def exif_telemetry(folder: Path) -> list[TelemetryRow]:
    """Telemetry from the EXIF and DJI's XMP of a folder's photographs, see :func:`photo_telemetry`."""
    return photo_telemetry([folder / name for name in PictureFolder(folder).names])[0]


def photo_truth(folder: Path) -> list[Truth]:
    """Truth from the photographs' receiver; without its heights, which are too inaccurate.

    Raises:
        TelemetryError: the folder cannot be read, or none of its photographs has a time and a position.
    """
    found = [
        Truth(timestamp_ns=row.timestamp_ns, lat_deg=row.lat_deg, lon_deg=row.lon_deg)
        for row in exif_telemetry(folder)
        if row.lat_deg is not None and row.lon_deg is not None
    ]
    if not found:
        raise TelemetryError(f"{folder}: expected photographs with a time and a position in their EXIF, got none")
    return found


def photo_telemetry(paths: Sequence[Path]) -> tuple[list[TelemetryRow], list[str]]:
    """Telemetry from photographs' EXIF and DJI's XMP.

    ==================================  =====================================================================
    DateTimeOriginal, SubSec, Offset    timestamp_ns; UTC if there is no offset
    GPSLatitude, GPSLongitude           the prior; GPSHPositioningError its sigma
    GPSAltitude                         alt_amsl_m
    GPSImgDirection                     heading_deg, where its reference is true north
    drone-dji:RelativeAltitude          height_agl_m, above the take-off point
    drone-dji:Gimbal*Degree             heading, roll and pitch of a body with the camera mounted nadir; three
                                        zeros are no gimbal
    drone-dji:FlightYawDegree           heading_deg, if there are no gimbal angles
    ==================================  =====================================================================

    Args:
        paths: of the images.

    Returns:
        Rows in the order of time, named by file name; photographs without a capture time are omitted.
        Photographs in the same second without sub-seconds are spaced evenly within it. Also doubts about them, one
        sentence each.

    Raises:
        TelemetryError: an image cannot be opened.
    """
    photos = [read_photo_tags(path) for path in paths]
    rows = [row for tags in photos if (row := _exif_row(tags)) is not None]
    rows.sort(key=lambda row: row.timestamp_ns)  # stable: equal stamps keep the order of the names
    counts, seen = Counter(row.timestamp_ns for row in rows), Counter[int]()
    for i, row in enumerate(rows):
        shift_ns = seen[row.timestamp_ns] * 1_000_000_000 // counts[row.timestamp_ns]
        seen[row.timestamp_ns] += 1
        rows[i] = replace(row, timestamp_ns=row.timestamp_ns + shift_ns)
    return rows, _remarks(photos)


def _remarks(photos: Sequence[PhotoTags]) -> list[str]:
    turned = sum(tags.was_turned for tags in photos)
    zeros = sum(set(map(tags.xmp.get, _GIMBAL)) == {0.0} for tags in photos)
    remarks = {
        "photographs rotated and saved by a viewer, so their heading is unknown": turned,
        "photographs without gimbal angles, so their heading is the flight's and their tilt unknown": zeros,
    }
    return [f"{remark}: {count}" for remark, count in remarks.items() if count]


def _exif_row(tags: PhotoTags) -> TelemetryRow | None:
    stamp_ns = _capture_ns(tags.exif)
    if stamp_ns is None:
        return None
    height_m = tags.xmp.get("RelativeAltitude", 0.0)
    height = {"height_agl_m": height_m, "height_sigma_m": take_off_sigma_m(height_m)} if height_m > 0.0 else {}
    attitude = {} if tags.was_turned else gimbal_columns(tags.xmp, _GIMBAL) or _flight_heading(tags)
    return TelemetryRow(
        timestamp_ns=stamp_ns,
        frame=tags.path.name,
        alt_amsl_m=_altitude_m(tags.gps),
        **height,
        **attitude,
        **_position(tags.gps),
    )


def _capture_ns(exif: Mapping[int, Any]) -> int | None:
    """Nanoseconds since 1970 of DateTimeOriginal (0x9003), its sub-seconds (0x9291) and offset (0x9011)."""
    offset = str(exif.get(0x9011, "")).strip("\0 ") or "+00:00"
    try:
        time = datetime.strptime(f"{str(exif[0x9003]).strip(chr(0) + ' ')} {offset}", "%Y:%m:%d %H:%M:%S %z")
    except (KeyError, ValueError):
        return None
    fraction = re.match(r"[0-9]*", str(exif.get(0x9291, "")).strip())
    return since_1970_ns(time, fraction.group() if fraction else "")


def _finite(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _position(gps: Mapping[int, Any]) -> dict[str, float | None]:
    lat_deg, lon_deg = _degrees(gps.get(2), gps.get(1) == "S"), _degrees(gps.get(4), gps.get(3) == "W")
    # Receivers without a fix write zeros.
    if lat_deg is None or lon_deg is None or lat_deg == lon_deg == 0.0:
        return {}
    if abs(lat_deg) > 90.0 or abs(lon_deg) > 180.0:
        return {}
    sigma_m = _finite(gps.get(0x1F))
    return {"lat_deg": lat_deg, "lon_deg": lon_deg, "sigma_m": sigma_m if sigma_m and sigma_m > 0.0 else None}


def _degrees(parts: Any, negative: bool) -> float | None:
    known = [value for part in parts or () if (value := _finite(part)) is not None]
    if len(known) != 3:
        return None
    degrees = known[0] + known[1] / 60.0 + known[2] / 3600.0
    return -degrees if negative else degrees


def _altitude_m(gps: Mapping[int, Any]) -> float | None:
    altitude_m = _finite(gps.get(6))
    below_sea = gps.get(5) in (1, b"\x01")
    return -altitude_m if altitude_m is not None and below_sea else altitude_m


def _flight_heading(tags: PhotoTags) -> dict[str, float]:
    """The vehicle's heading, or the receiver's direction if relative to true north."""
    heading_deg = _finite(tags.xmp.get("FlightYawDegree"))
    if heading_deg is None and tags.gps.get(16) == "T":
        heading_deg = _finite(tags.gps.get(17))
    if heading_deg is None:
        return {}
    return {"heading_deg": wrap_heading_deg(heading_deg), "heading_sigma_deg": COMPASS_SIGMA_DEG}


def gimbal_columns(values: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    """Telemetry columns from a gimbal's angles; none if one is missing or all are zero, as without a gimbal.

    They are the attitude of a body with the gimbal's camera mounted nadir, the image's top towards the nose. DJI's
    angles rotate the camera's forward, right and down axes; a pitch of -90 degrees is nadir. The camera's forward
    is the body's down, its up the body's forward. The result is the same with a roll of 180 degrees, as some
    models write it.

    Args:
        values: numbers by name.
        names: of the gimbal's roll, its pitch, where -90 looks straight down, and its yaw from true north.
    """
    angles_deg = [values[name] for name in names if name in values]
    if len(angles_deg) < 3 or not any(angles_deg):
        return {}
    forward, right, down = enu_from_body(*angles_deg).T
    roll_deg, pitch_deg, heading_deg = attitude_from_rotation(np.stack([-down, right, forward], axis=1))
    return {
        "roll_deg": roll_deg,
        "pitch_deg": pitch_deg,
        "heading_deg": heading_deg,
        "heading_sigma_deg": COMPASS_SIGMA_DEG,
        "tilt_sigma_deg": GIMBAL_SIGMA_DEG,
    }
