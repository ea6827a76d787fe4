"""Simulated towns as maps."""

from __future__ import annotations

from functools import cache

import cv2

from engine import OrthoMap
from engine.sim import Town, build_town


def drawn_town(seed: int = 1) -> Town:
    """The town of a seed, drawn once a process (two seconds): nobody writes into it."""
    return drawn_once(seed)


drawn_once = cache(build_town)


def site_of(town, *, surface=True):
    """The map that a simulated town is photographed as."""
    gray = cv2.cvtColor(town.ortho, cv2.COLOR_RGB2GRAY)
    heights = town.surface_m if surface else None
    return OrthoMap.from_arrays(gray, town.pixel_to_crs, f"EPSG:{town.crs_epsg}", surface_m=heights)
