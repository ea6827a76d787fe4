"""What to read from a map server: a raster that GDAL opens, and the part that becomes the map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

from engine.errors import MapError
from scenematch.fetch.place import Bounds, Place
from scenematch.fetch.urls import user_agent

if TYPE_CHECKING:
    from pyproj import CRS

FINE_ENOUGH = 1.02
"""Tile levels rarely have the requested resolution; one coarser by this factor still counts as fine enough."""
TILE_PX = 256


@dataclass(frozen=True, slots=True)
class Access:
    """How to send requests to a server.

    Attributes:
        timeout_s: of a request.
        cache: folder of fetched data.
    """

    timeout_s: float
    cache: Path

    def elements(self) -> dict[str, Any]:
        """Elements common to GDAL's descriptions of services."""
        return {
            "BandsCount": 4,
            "ZeroBlockHttpCodes": "204,404,410",
            "MaxConnections": 1,
            "Timeout": math.ceil(self.timeout_s),
            "UserAgent": user_agent(),
            "Cache": {"Path": self.cache},
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """The part of a server's raster that becomes the map.

    Attributes:
        kind: "XYZ", "WMS" or "WMTS".
        level: the zoom level; of a WMS or WMTS the coordinate system.
        source: what GDAL opens.
        overview: index of the source's overview; None is the finest level.
        offset_px: column and row of the map in it.
        size_px: width and height of the map.
        tile_px: width and height of one request.
        corner: x and y of the north-western corner of the map.
        step: size of a pixel in x and y.
        crs: of the map.
        gsd_m_per_px: on the ground, in the middle.
        states: the server's statements about itself, by name.
    """

    kind: str
    level: str
    source: str
    overview: int | None = None
    offset_px: tuple[int, int] = (0, 0)
    size_px: tuple[int, int]
    tile_px: tuple[int, int]
    corner: tuple[float, float]
    step: tuple[float, float]
    crs: CRS
    gsd_m_per_px: float
    states: Mapping[str, str] = field(default_factory=dict)

    @property
    def tiles(self) -> int:
        """Number of pictures to request; approximate for a WMTS."""
        (width, height), (across, down) = self.size_px, self.tile_px
        return math.ceil(width / across) * math.ceil(height / down)

    @property
    def bounds(self) -> Bounds:
        """Outer edges of the map."""
        (x, y), (width, height) = self.corner, self.size_px
        return x, y - height * self.step[1], x + width * self.step[0], y


def part_of(
    kind: str,
    level: str,
    source: str,
    corner: tuple[float, float],
    step: tuple[float, float],
    place: Place,
    crs: CRS,
    sides_px: tuple[int, int],
    multiple_px: int = 1,
    **rest: Any,
) -> Grid:
    """The part of a raster over a place, from one multiple of some pixels to another.

    Raises:
        MapError: the raster has nothing there.
    """
    west, south, east, north = place.bounds(crs)
    edge = 1e-6  # of a pixel, beyond which bounds reach into the next one
    first = [(west - corner[0]) / step[0], (corner[1] - north) / step[1]]
    last = [(east - corner[0]) / step[0], (corner[1] - south) / step[1]]
    begin = [max(0, math.floor(v / multiple_px + edge)) * multiple_px for v in first]
    ends = [
        min(side, math.ceil(v / multiple_px - edge) * multiple_px) for v, side in zip(last, sides_px, strict=True)
    ]
    if ends[0] <= begin[0] or ends[1] <= begin[1]:
        raise MapError(f"source: the server has no tiles there on its level {level!r}")
    return Grid(
        kind=kind,
        level=level,
        source=source,
        offset_px=(begin[0], begin[1]),
        size_px=(ends[0] - begin[0], ends[1] - begin[1]),
        tile_px=(TILE_PX, TILE_PX) if multiple_px == 1 else (multiple_px, multiple_px),
        corner=(corner[0] + begin[0] * step[0], corner[1] - begin[1] * step[1]),
        step=step,
        crs=crs,
        gsd_m_per_px=place.gsd_m_per_px(step, crs),
        **rest,
    )


def reason_of(error: BaseException) -> str:
    """GDAL's error in one line: rasterio hides it in a chain of causes."""
    texts = [" ".join(str(error).split())]
    while error.__cause__ is not None:
        error = error.__cause__
        texts.append(" ".join(str(error).split()))
    return next((text for text in texts[1:] if "HTTP status" in text or "exception" in text.lower()), texts[-1])


def gdal_xml(tag: str, values: Mapping[str, Any]) -> str:
    """A description that GDAL opens; empty values are left out."""
    inner = "".join(
        gdal_xml(name, value) if isinstance(value, Mapping) else f"<{name}>{escape(str(value))}</{name}>"
        for name, value in values.items()
        if value != ""
    )
    return f"<{tag}>{inner}</{tag.split()[0]}>"
