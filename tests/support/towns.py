"""Simulated towns as maps."""

from __future__ import annotations

import cv2

from engine import OrthoMap


def site_of(town, *, surface=True):
    """The map that a simulated town is photographed as."""
    gray = cv2.cvtColor(town.ortho, cv2.COLOR_RGB2GRAY)
    heights = town.surface_m if surface else None
    return OrthoMap.from_arrays(gray, town.pixel_to_crs, f"EPSG:{town.crs_epsg}", surface_m=heights)
