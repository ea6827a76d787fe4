"""Relief under a frame: the surface model without objects on the ground."""

from __future__ import annotations

import cv2
import numpy as np

from engine.geo import Array
from engine.matching.align import Relief
from engine.orthomap import OrthoMap

_BUILDING_M = 30.0  # largest width of objects on the ground


def ground_relief(site: OrthoMap, nadir_px: Array | None, level: int) -> Relief | None:
    """The bare ground around a place: the surface without objects narrower than 30 m.

    Args:
        site: the map.
        nadir_px: (2,) full-resolution pixel that heights count from; None if it is unknown.
        level: the offsets are in its pixels.

    Returns:
        Relief | None: None if the place or the surface is unknown.
    """
    if nadir_px is None or not site.has_surface:
        return None
    nadir_level, ground_m = site.level_from_full(nadir_px, level), site.ground_at(nadir_px)

    def heights_m(offsets_px: Array) -> Array:
        surface_m = site.surface_at(site.full_from_level(nadir_level + offsets_px, level))
        spacing_m = np.ptp(offsets_px, axis=(0, 1)) / (np.array(offsets_px.shape[1::-1]) - 1.0)
        spacing_m = np.maximum(spacing_m * site.gsd_m_per_px * 2.0**level, 1e-6)
        reach = [int(n) for n in np.clip(np.ceil(_BUILDING_M / spacing_m / 2.0), 1, 8)]
        size = (2 * reach[0] + 1, 2 * reach[1] + 1)
        lower = cv2.erode(surface_m.astype(np.float32), np.ones(size[::-1], np.uint8))
        return np.asarray(cv2.blur(cv2.dilate(lower, np.ones(size[::-1], np.uint8)), size) - ground_m, np.float64)

    return heights_m
