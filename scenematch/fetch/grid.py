"""What to read from a map server: the place, and the part of a raster that GDAL opens which becomes the map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

from engine.errors import MapError, OptionError
from scenematch.fetch.urls import user_agent

if TYPE_CHECKING:
    from pyproj import CRS

FINE_ENOUGH = 1.02
"""Tile levels rarely have the requested resolution; one coarser by this factor still counts as fine enough."""
TILE_PX = 256


Bounds = tuple[float, float, float, float]
"""West, south, east, north in the units of a CRS."""


@dataclass(frozen=True, slots=True)
class Place:
    """A square on the Earth.

    Attributes:
        lat_deg, lon_deg: its middle.
        radius_m: half its side.
    """

    lat_deg: float
    lon_deg: float
    radius_m: float

    def bounds(self, crs: CRS) -> Bounds:
        """The edges of the square in a CRS.

        Raises:
            OptionError: the CRS does not cover it, or the square crosses its edge.
        """
        from pyproj import CRS, Transformer

        plane = CRS.from_proj4(f"+proj=aeqd +lat_0={self.lat_deg} +lon_0={self.lon_deg} +datum=WGS84 +units=m")
        half = self.radius_m
        to_degrees = Transformer.from_crs(plane, 4326, always_xy=True)
        west, _, east, _ = to_degrees.transform_bounds(-half, -half, half, half)
        if not west < east < west + 180.0:  # in metres, it would span the whole Earth
            raise OptionError(
                f"around: expected a square that does not cross 180 degrees east, got {self.lat_deg:g},"
                f"{self.lon_deg:g} with `radius_m` {half:g}"
            )
        to_crs = Transformer.from_crs(plane, crs, always_xy=True)
        found: Bounds = to_crs.transform_bounds(-half, -half, half, half)
        if not (all(map(math.isfinite, found)) and found[0] < found[2] and found[1] < found[3]):
            raise OptionError(
                f"around: expected a place within {crs.name!r}, and not at its edge, got "
                f"{self.lat_deg:g},{self.lon_deg:g}"
            )
        return found

    def metres_per_unit(self, crs: CRS) -> tuple[float, float]:
        """Metres on the ground per unit of the CRS in x and in y, at the middle of the square."""
        from pyproj import Geod, Transformer

        to_crs = Transformer.from_crs(4326, crs, always_xy=True)
        geod, found = Geod(ellps="WGS84"), []
        for azimuths_deg in ((90.0, -90.0), (0.0, 180.0)):  # chords of 2 m, to the east and to the north
            ends = [geod.fwd(self.lon_deg, self.lat_deg, azimuth, 1.0)[:2] for azimuth in azimuths_deg]
            (ahead_x, ahead_y), (back_x, back_y) = (to_crs.transform(*end) for end in ends)
            found.append(2.0 / math.hypot(ahead_x - back_x, ahead_y - back_y))
        return found[0], found[1]

    def gsd_m_per_px(self, step: tuple[float, float], crs: CRS) -> float:
        """Metres on the ground per pixel, averaged over both axes, for a pixel size in units of the CRS."""
        metres = self.metres_per_unit(crs)
        return math.sqrt(step[0] * metres[0] * step[1] * metres[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchSettings:
    """What to fetch, and how; None for each not given.

    Attributes:
        around: "LAT,LON", the centre of the map, or a folder of photographs with positions.
        radius_m: half the side of the square to cover at least; None covers what the photographs show, plus 50 m.
        source: template of tiles with {z}, {x}, {y}, or the address of a WMS or WMTS.
        gsd_m_per_px: coarsest ground sample distance; that of a WMS's picture. None is 0.5, or proportionally less
            for photographs taken from less than 150 m.
        layer: of a service that has several.
        crs: of a service that offers several, EPSG:N.
        image_format: of a service that offers several, such as image/jpeg.
        tile_px: side of the tiles of a template.
        map_sigma_m: georeferencing accuracy per axis, written into the file.
        attribution: whom to credit, written into the file.
        licence: what may be done with it, written into the file.
        surface: file or URL of heights, or a template with {lat} and {lon}.
        surface_datum: vertical datum of its heights, EPSG:N.
        surface_slope_sigma_deg: slope accuracy over one frame, written into the file.
        max_tiles: most tiles to request.
        pause_ms: between requests.
        timeout_s: longest wait for data.
        dry_run: only plan.
        force: whether the files may be there already.
    """

    around: str
    source: str
    radius_m: float | None = None
    gsd_m_per_px: float | None = None
    layer: str | None = None
    crs: str | None = None
    image_format: str | None = None
    tile_px: int = 256
    map_sigma_m: float | None = None
    attribution: str | None = None
    licence: str | None = None
    surface: str | None = None
    surface_datum: str | None = None
    surface_slope_sigma_deg: float | None = None
    max_tiles: int = 2000
    pause_ms: float = 100.0
    timeout_s: float = 30.0
    dry_run: bool = False
    force: bool = False


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the user requests from a server.

    Attributes:
        place: where.
        gsd_m_per_px: coarsest acceptable resolution; for a WMS the exact one.
        settings: how.
        cache: folder of fetched data.
    """

    place: Place
    gsd_m_per_px: float
    settings: FetchSettings
    cache: Path

    def elements(self) -> dict[str, Any]:
        """Elements common to GDAL's descriptions of services."""
        return {
            "BandsCount": 4,
            "ZeroBlockHttpCodes": "204,404,410",
            "MaxConnections": 1,
            "Timeout": math.ceil(self.settings.timeout_s),
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
