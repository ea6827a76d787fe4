"""The camera of photographs, from their metadata: EXIF and DJI's XMP.

Convention:
    A 35 mm equivalent focal length compares diagonals: f_px = f_35 / 43.27 mm * diagonal in pixels. Makers state
        it for the whole sensor even if the picture is only part of it, as with 16:9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from engine.camera import Camera
from engine.errors import CalibrationError
from scenematch.files.photos import PhotoTags, read_photo_tags

_FOCAL_MM, _FOCAL_35MM, _ZOOM, _WIDTH = 0x920A, 0xA405, 0xA404, 0xA002
_PLANE_X, _PLANE_Y, _PLANE_UNIT = 0xA20E, 0xA20F, 0xA210
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_WIDER_THAN_SENSORS = 1.6  # sensors are 4:3 or 3:2: a 16:9 picture is cropped
_SENSORS_3_2_MM = ((14.5, 17.0), (24.0, 48.0))  # diagonals: of 1 inch, and of APS-C to full frame; others are 4:3
_SAME_FOCAL = 0.01
_CONTRADICTION = 1.25  # between two focal lengths of one photograph: rounding and aspect explain a tenth
_FOCAL_RANGE = (0.2, 50.0)  # of a focal length, in widths of the picture


PhotoCamera = tuple[Camera, str]
"""A camera mounted nadir, and the tags that describe it, in words."""


def photo_camera(paths: Sequence[Path]) -> PhotoCamera:
    """The common camera of some photographs, without distortion unless they state it.

    ==========================================  =====================================================
    drone-dji:DewarpData                        focal lengths, principal point and distortion
    drone-dji:CalibratedFocalLength             focal length in pixels
    FocalLength and FocalPlaneX/YResolution     focal length in mm, and the pixels of a mm
    FocalLengthIn35mmFilm                       focal length by the diagonal, about 3 % accurate
    ==========================================  =====================================================

    Args:
        paths: the photographs, at least one.

    Raises:
        CalibrationError: a photograph has none of these or contradicts itself, or they are from different cameras.
        TelemetryError: one cannot be opened.
    """
    one, source = _camera_of(read_photo_tags(paths[0]))
    for path in paths[1:]:
        two, _ = _camera_of(read_photo_tags(path))
        if (one.width_px, one.height_px) != (two.width_px, two.height_px):
            raise CalibrationError(
                f"{path}: expected {one.width_px} x {one.height_px} px as {paths[0].name}, "
                f"got {two.width_px} x {two.height_px}"
            )
        if abs(two.focal_px / one.focal_px - 1.0) > _SAME_FOCAL:
            raise CalibrationError(
                f"{path}: expected the focal length of {paths[0].name}, {one.focal_px:.0f} px, "
                f"got {two.focal_px:.0f} px; photographs of two lenses are two flights"
            )
    return one, source


def _camera_of(tags: PhotoTags) -> PhotoCamera:
    calibrated = _dewarp_camera(tags) or _calibrated_camera(tags)
    if calibrated is not None:
        return calibrated
    zoom = tags.number(_ZOOM) or 1.0
    if zoom > 1.0:
        raise CalibrationError(f"{tags.path}: expected no digital zoom, got {zoom:g}; give `hfov_deg` or `camera`")
    plane, film = _plane_focal_px(tags), _film_focal_px(tags)
    focal_px = film if plane is None else plane
    if focal_px is None:
        raise CalibrationError(
            f"{tags.path}: expected a focal length with the size of the sensor, or as 35 mm equivalent, in its "
            "EXIF, got neither; give `hfov_deg` or `camera`"
        )
    if plane is not None and film is not None and max(plane / film, film / plane) > _CONTRADICTION:
        raise CalibrationError(
            f"{tags.path}: expected one focal length in its EXIF, got {plane:.0f} px by FocalPlaneXResolution and "
            f"{film:.0f} px by FocalLengthIn35mmFilm; give `hfov_deg` or `camera`"
        )
    source = "FocalLengthIn35mmFilm" if plane is None else "FocalLength and FocalPlaneXResolution"
    return _ideal(tags, focal_px), source


def _ideal(tags: PhotoTags, focal_px: float) -> Camera:
    width_px, height_px = tags.size_px
    low, high = _FOCAL_RANGE
    if not low * width_px <= focal_px <= high * width_px:
        raise CalibrationError(
            f"{tags.path}: expected a focal length of {low:g} to {high:g} widths of the picture in its EXIF, got "
            f"{focal_px / width_px:.3g}; give `hfov_deg` or `camera`"
        )
    return Camera.from_fov(width_px, height_px, math.degrees(2.0 * math.atan(width_px / (2.0 * focal_px))))


def _recorded_scale(tags: PhotoTags) -> float:
    """Pixels of the stored picture per pixel of the recorded one; 1 unless it was scaled down."""
    recorded_px = tags.number(_WIDTH)
    return tags.size_px[0] / recorded_px if recorded_px and recorded_px > 0.0 else 1.0


def _dewarp_camera(tags: PhotoTags) -> PhotoCamera | None:
    """The camera by DJI's calibration, with the principal point relative to the picture's centre."""
    if not tags.dewarp:
        return None
    width_px, height_px = tags.size_px
    scale = _recorded_scale(tags)
    fx, fy, cx, cy = (scale * value for value in tags.dewarp[:4])
    if not 0.3 < min(fx, fy) / width_px <= max(fx, fy) / width_px < 10.0 or max(abs(cx), abs(cy)) > width_px / 10:
        return None
    matrix = np.array([[fx, 0.0, (width_px - 1) / 2 + cx], [0.0, fy, (height_px - 1) / 2 + cy], [0.0, 0.0, 1.0]])
    undone = tags.xmp.get("DewarpFlag") == 1.0
    camera = Camera(width_px, height_px, matrix, distortion=np.zeros(5) if undone else np.array(tags.dewarp[4:]))
    return camera, "drone-dji:DewarpData"


def _calibrated_camera(tags: PhotoTags) -> PhotoCamera | None:
    focal_px, middle_px = tags.xmp.get("CalibratedFocalLength", 0.0), tags.xmp.get("CalibratedOpticalCenterX", 0.0)
    if focal_px <= 0.0 or middle_px <= 0.0:  # the centre tells the width that the focal length refers to
        return None
    scale = tags.size_px[0] / (2.0 * middle_px)
    return _ideal(tags, focal_px * scale), "drone-dji:CalibratedFocalLength"


def _plane_focal_px(tags: PhotoTags) -> float | None:
    focal_mm, per_unit = tags.number(_FOCAL_MM), tags.number(_PLANE_X) or tags.number(_PLANE_Y)
    unit_mm = _UNIT_MM.get(int(tags.number(_PLANE_UNIT) or 2))
    if not focal_mm or not per_unit or unit_mm is None or focal_mm <= 0.0 or per_unit <= 0.0:
        return None
    return focal_mm * per_unit / unit_mm * _recorded_scale(tags)


def _film_focal_px(tags: PhotoTags) -> float | None:
    focal_35mm = tags.number(_FOCAL_35MM)
    if not focal_35mm or focal_35mm <= 0.0:
        return None
    return focal_35mm / _DIAGONAL_35MM * _sensor_diagonal_px(tags, focal_35mm)


def _sensor_diagonal_px(tags: PhotoTags, focal_35mm: float) -> float:
    """Diagonal of the whole sensor; the picture is all of it or a crop of another aspect."""
    short_px, long_px = sorted(tags.size_px)
    focal_mm = tags.number(_FOCAL_MM) or 0.0
    diagonal_mm = focal_mm * _DIAGONAL_35MM / focal_35mm
    if focal_mm > 0.0:
        aspect = 3 / 2 if any(low <= diagonal_mm <= high for low, high in _SENSORS_3_2_MM) else 4 / 3
    else:
        aspect = 4 / 3 if long_px > _WIDER_THAN_SENSORS * short_px else long_px / short_px
    return max(long_px * math.hypot(1.0, 1.0 / aspect), short_px * math.hypot(aspect, 1.0))
