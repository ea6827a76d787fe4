"""What the tests of audits share: a town's grey levels on a grid, a camera above it, and the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from engine import Camera
from tests.support.towns import drawn_town

CAMERA = Camera.from_fov(300, 300, 60.0)
HEIGHT_M = 75.0
GRID = np.array([[0.5, 0.0, 600_000.0], [0.0, -0.5, 4_500_000.0]])
UTM = "EPSG:32614"
SIDE = 900


def town_gray() -> Any:
    """A town, (SIDE, SIDE)."""
    return cv2.cvtColor(drawn_town(1).ortho, cv2.COLOR_RGB2GRAY)[:SIDE, :SIDE]


def lat_lon(site: Any, xy_px: Any) -> Any:
    """Latitudes and longitudes (N, 2) of pixels."""
    return np.stack(site.geodetic_from_pixel(np.asarray(xy_px, float)), axis=-1)


def write_route(folder: Path, site: Any, xy_px: Any) -> Path:
    """A route through pixels of a map, as GeoJSON."""
    line = {"type": "LineString", "coordinates": lat_lon(site, xy_px)[:, ::-1].tolist()}
    (folder / "route.geojson").write_text(json.dumps(line), encoding="utf-8")
    return folder / "route.geojson"


def audit(map_file: Path, out: Path, *more: Any) -> list[str]:
    """The command."""
    return ["map", "audit", str(map_file), f"--height-agl={HEIGHT_M:g}", f"--out={out}", *map(str, more)]
