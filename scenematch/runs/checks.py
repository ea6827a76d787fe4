"""Check a flight as a whole, before a run begins and before its folder is created."""

from __future__ import annotations

import math

import numpy as np

from engine.camera import Camera, mount_rotation
from engine.errors import CalibrationError, OptionError, TelemetryError
from engine.orthomap import OrthoMap
from engine.values import Prior
from scenematch.files.flight import Flight
from scenematch.files.frames import PictureFolder
from scenematch.runs.cameras import check_size
from scenematch.runs.progress import SILENT, Progress


def check_pictures(flight: Flight, camera: Camera, progress: Progress = SILENT) -> None:
    """Check that every picture decodes and has the camera's size; of a video only the first frame is checked.

    Raises:
        TelemetryError: a picture is empty, truncated or not a picture.
        CalibrationError: a picture has another size.
    """
    source = flight.source
    if not isinstance(source, PictureFolder):
        check_size(camera, source.read(flight.names[0]).shape)
        return
    for name in progress.track(flight.names, len(flight), "checking pictures"):
        path = source.path / name
        size = _decoded_size(str(path))
        try:
            check_size(camera, (size[1], size[0]))
        except CalibrationError as error:
            raise CalibrationError(f"{path}: {error}") from None


def _decoded_size(path: str) -> tuple[int, int]:
    """Width and height; a JPEG is decoded at 1/8 scale, of a PNG the checksums are read, others are decoded."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            size = picture.size
            if picture.format == "PNG":
                picture.verify()
            else:
                picture.draft("L", (1, 1))
                picture.load()
            return size
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:
        reason = "it is no picture" if isinstance(error, UnidentifiedImageError) else str(error)
        raise TelemetryError(f"{path}: expected a readable picture: {' '.join(reason.split())}") from None


def check_gimbal(flight: Flight, camera: Camera) -> None:
    """Refuse a mount in addition to a gimbal's angles, which already state where the camera looks.

    Raises:
        CalibrationError: the camera would be turned twice.
    """
    if flight.has_gimbal and not np.allclose(camera.mount, mount_rotation(), atol=1e-3):
        raise CalibrationError(
            "mount: expected nadir, since the telemetry's gimbal angles already state where the camera looks"
        )


def _needs(method: str, profile: str) -> list[str]:
    """Telemetry that a method requires."""
    needs = ["height_agl_m"] if profile == "paper" or method == "ncc" else []
    return [*needs, "heading_deg"] if method == "ncc" else needs


def check_needs(flight: Flight, method: str, profile: str, progress: Progress) -> None:
    """Report how many frames the method will certainly refuse for lack of telemetry, and which method would not.

    Raises:
        TelemetryError: every frame would be refused.
    """
    needs, other = _needs(method, profile), "" if profile == "paper" else "; sift and auto do not need it"
    if needs and not any(all(getattr(row, name) is not None for name in needs) for row in flight.rows):
        asked, doubts = " and ".join(needs), "".join(f"; {remark}" for remark in flight.remarks)
        raise TelemetryError(f"telemetry: {method} needs {asked}, got no frame with a value there{other}{doubts}")
    for name in needs:
        lacking = sum(getattr(row, name) is None for row in flight.rows)
        if lacking:
            progress.message(f"{lacking} of {len(flight)} frames lack {name}, so {method} will refuse them{other}")


def check_start(start: Prior | None, site: OrthoMap) -> None:
    """Refuse a flight without a start if the map is too large to search.

    Raises:
        OptionError: no position is known.
    """
    if start is None and not site.is_searchable:
        raise OptionError(
            f"start: expected LAT,LON or LAT,LON,SIGMA_M: the map of {site.size_km} is too large to search, "
            "and the telemetry has no position"
        )


def check_position(
    name: str, position: Prior | None, site: OrthoMap, error: type[OptionError | TelemetryError]
) -> None:
    """Refuse a latitude and longitude far off the map.

    Raises:
        OptionError, TelemetryError: as requested; it is further away than the map is wide.
    """
    from pyproj import Geod

    if position is None or position.lat_deg is None or position.lon_deg is None:
        return
    middle = site.frame

    def off_m(lat_deg: float, lon_deg: float) -> float:
        return float(Geod(ellps="WGS84").inv(middle.lon_deg, middle.lat_deg, lon_deg, lat_deg)[2])

    distance_m = off_m(position.lat_deg, position.lon_deg)
    extent_m = math.hypot(site.width_px, site.height_px) * site.gsd_m_per_px
    limit_m = extent_m + 3.0 * position.sigma_m
    if distance_m > limit_m:
        is_swapped = abs(position.lon_deg) <= 90.0 and off_m(position.lon_deg, position.lat_deg) <= limit_m
        hint = "; are latitude and longitude swapped?" if is_swapped else ""
        raise error(
            f"{name}: expected a place on the map {site.name}, got {position.lat_deg:g},{position.lon_deg:g}, "
            f"{distance_m / 1000.0:,.1f} km from its middle ({middle.lat_deg:.5f},{middle.lon_deg:.5f}){hint}"
        )
