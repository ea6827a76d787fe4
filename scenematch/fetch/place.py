"""The place to map, in a server's coordinate system."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from engine.errors import OptionError

if TYPE_CHECKING:
    from pyproj import CRS

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
class Wanted:
    """What the user requests from a server.

    Attributes:
        place: where.
        gsd_m_per_px: coarsest acceptable resolution; for a WMS the exact one.
        max_tiles: largest number of requests.
        layer: of a service; None is its only one.
        crs: of a service; None is one that it offers, in metres if possible.
        image_format: of a service; None is PNG if possible.
    """

    place: Place
    gsd_m_per_px: float
    max_tiles: int
    layer: str | None = None
    crs: str | None = None
    image_format: str | None = None
