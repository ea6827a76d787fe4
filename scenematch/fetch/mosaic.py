"""What is asked of a server, as pieces of one grid: the level that is fine enough, and its tiles over a place.

Convention:
    x runs east and y north in the units of the CRS, whatever order its axes have. Columns and rows count from the
    corner in the north-west.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from engine.errors import MapError, OptionError

if TYPE_CHECKING:
    from pyproj import CRS

Bounds = tuple[float, float, float, float]
"""West, south, east, north in the units of a CRS."""
FINE_ENOUGH = 1.02
"""Levels of tiles are so seldom as fine as asked that this much coarser counts as such."""
_EDGE = 1e-6
"""Of a pixel or tile, beyond which bounds reach into the next one."""


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
            OptionError: the CRS does not reach there, or the square crosses its edge.
        """
        from pyproj import CRS, Transformer

        plane = CRS.from_proj4(f"+proj=aeqd +lat_0={self.lat_deg} +lon_0={self.lon_deg} +datum=WGS84 +units=m")
        half = self.radius_m
        to_degrees = Transformer.from_crs(plane, 4326, always_xy=True)
        west, _, east, _ = to_degrees.transform_bounds(-half, -half, half, half)
        if not west < east < west + 180.0:  # in metres, its edges would be those of the whole Earth
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What the user wants of a server.

    Attributes:
        place: where.
        gsd_m_per_px: as coarse as the map may be; of a WMS its pixels.
        max_tiles: as many pieces as may be asked for.
        layer: of a service; None is the only one that there is.
        crs: of a service; None is one that it offers, in metres where it can be.
        image_format: of a service; None is PNG where it can be.
    """

    place: Place
    gsd_m_per_px: float
    max_tiles: int
    layer: str | None = None
    crs: str | None = None
    image_format: str | None = None


@dataclass(frozen=True, slots=True)
class Level:
    """A grid of tiles.

    Attributes:
        name: what the server calls it.
        corner: x and y of the north-western corner.
        step: size of a pixel in x and y, above 0.
        tile_px: width and height of a tile.
        columns, rows: of tiles.
    """

    name: str
    corner: tuple[float, float]
    step: tuple[float, float]
    tile_px: tuple[int, int]
    columns: int
    rows: int

    def corner_of(self, column: int, row: int) -> tuple[float, float]:
        """X and y of the north-western corner of a tile."""
        (x, y), (width, height) = self.corner, self.tile_px
        return x + column * width * self.step[0], y - row * height * self.step[1]


@dataclass(frozen=True, slots=True)
class Piece:
    """A picture that is asked for, with its column and row in the mosaic."""

    url: str
    column: int
    row: int


@dataclass(frozen=True, slots=True)
class Mosaic:
    """What is asked for, and the grid of the map that it makes.

    Attributes:
        kind: "XYZ", "WMS" or "WMTS".
        level: name of the zoom level or tile matrix; of WMS the layer.
        crs: of the map.
        corner: x and y of the north-western corner of the map.
        step: size of a pixel in x and y.
        piece_px: width and height of each piece.
        columns, rows: of pieces.
        gsd_m_per_px: on the ground, in the middle.
        pieces: those of the grid.
        gaps: whether a piece that the server does not have is nodata, as of tiles, and not an error.
        bytes_per_px: of a picture as it is sent, roughly: of aerial pictures as JPEG 0.5, as PNG 2.
        states: what the server says of itself, by name.
    """

    kind: str
    level: str
    crs: CRS
    corner: tuple[float, float]
    step: tuple[float, float]
    piece_px: tuple[int, int]
    columns: int
    rows: int
    gsd_m_per_px: float
    pieces: tuple[Piece, ...]
    gaps: bool
    bytes_per_px: float
    states: Mapping[str, str] = field(default_factory=dict)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the map."""
        return self.columns * self.piece_px[0], self.rows * self.piece_px[1]

    @property
    def bounds(self) -> Bounds:
        """Outer edges of the map."""
        (x, y), (width, height) = self.corner, self.size_px
        return x, y - height * self.step[1], x + width * self.step[0], y


def gsd_of(step: tuple[float, float], metres: tuple[float, float]) -> float:
    """Metres on the ground per pixel: the mean of both axes.

    Args:
        step: size of a pixel in units of the CRS.
        metres: per unit (:meth:`Place.metres_per_unit`).
    """
    return math.sqrt(step[0] * metres[0] * step[1] * metres[1])


def fine_enough(levels: Sequence[Level], gsd_m_per_px: float, metres: tuple[float, float]) -> Level:
    """The coarsest level that is as fine as asked, or the finest one."""
    by_gsd = sorted(levels, key=lambda level: gsd_of(level.step, metres))
    coarser = [level for level in by_gsd if gsd_of(level.step, metres) <= gsd_m_per_px * FINE_ENOUGH]
    return coarser[-1] if coarser else by_gsd[0]


@dataclass(frozen=True, slots=True)
class Part:
    """The tiles of a level over a place: the first column and row, and how many."""

    column: int
    row: int
    columns: int
    rows: int


def tiles_over(level: Level, bounds: Bounds) -> Part:
    """The tiles of a level that bounds reach into.

    Raises:
        MapError: the level has none there.
    """
    (x, y), (width, height) = level.corner, (n * s for n, s in zip(level.tile_px, level.step, strict=True))
    west, south, east, north = bounds
    first = max(0, math.floor((west - x) / width + _EDGE)), max(0, math.floor((y - north) / height + _EDGE))
    ends = (
        min(level.columns, math.ceil((east - x) / width - _EDGE)),
        min(level.rows, math.ceil((y - south) / height - _EDGE)),
    )
    if ends[0] <= first[0] or ends[1] <= first[1]:
        raise MapError(f"source: the server has no tiles there on its level {level.name!r}")
    return Part(*first, ends[0] - first[0], ends[1] - first[1])


def check_count(part: Part, max_tiles: int) -> None:
    """Refuse to ask for more than agreed, before anything is asked for.

    Raises:
        OptionError: there are more pieces.
    """
    count = part.columns * part.rows
    if count > max_tiles:
        raise OptionError(
            f"max_tiles: expected at most {max_tiles} tiles, but the area has {count}; choose a smaller "
            "`radius_m` or a larger `gsd_m_per_px`, or allow them if the server's terms do"
        )


def mosaic_of(
    level: Level, part: Part, crs: CRS, place: Place, url_of: Callable[[int, int], str], **rest: object
) -> Mosaic:
    """The mosaic of some tiles of a level.

    Args:
        level: it.
        part: which tiles.
        crs: of the level.
        place: where.
        url_of: address of a tile by its column and row on the level.
        **rest: the other attributes of :class:`Mosaic`.
    """
    return Mosaic(
        level=level.name,
        crs=crs,
        corner=level.corner_of(part.column, part.row),
        step=level.step,
        piece_px=level.tile_px,
        columns=part.columns,
        rows=part.rows,
        gsd_m_per_px=gsd_of(level.step, place.metres_per_unit(crs)),
        pieces=tuple(
            Piece(url_of(part.column + column, part.row + row), column, row)
            for row in range(part.rows)
            for column in range(part.columns)
        ),
        **rest,  # type: ignore[arg-type]
    )
