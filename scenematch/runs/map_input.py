"""The map of a run: its files, what they do not state themselves, and whether a position lies on it."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from engine.errors import MapError, OptionError, TelemetryError
from engine.orthomap import OrthoMap
from engine.values import MAX_SIGMA_M, Prior
from scenematch.runs.arguments import check_above, is_in_degrees, parse_bounds
from scenematch.runs.output import SILENT, Progress, StrPath
from scenematch.runs.renaming import renamed_in_errors


@dataclass(frozen=True, slots=True)
class MapInput:
    """A map with its surface; None for each value that the files state themselves.

    Attributes:
        map: see :meth:`engine.OrthoMap.open`.
        surface: surface model, a GeoTIFF of heights; None assumes flat ground.
        map_sigma_m: georeferencing accuracy of the map per axis.
        map_bounds: "W,S,E,N" of the outer edges of a picture without georeference, in degrees or in ``map_crs``;
            numbers that may be degrees are degrees.
        map_crs: coordinate reference system of a map that names none, such as "EPSG:32636".

    Raises:
        OptionError: the bounds are invalid.
    """

    map: StrPath
    _: KW_ONLY
    surface: StrPath | None = None
    map_sigma_m: float | None = None
    map_bounds: str | None = None
    map_crs: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "map", Path(self.map))
        object.__setattr__(self, "surface", None if self.surface is None else Path(self.surface))
        parse_bounds("map_bounds", self.map_bounds)

    @classmethod
    def of(cls, value: MapInput | StrPath) -> MapInput:
        """The map from a path, or unchanged."""
        return value if isinstance(value, MapInput) else cls(value)

    def open(self, progress: Progress = SILENT) -> OrthoMap:
        """Open the map; copying it into the cache is reported as a task.

        Raises:
            OptionError: the accuracy is out of range, or bounds or CRS do not suit the file.
            MapError: a file cannot be read, or is nowhere on the Earth.
        """
        check_above("map_sigma_m", self.map_sigma_m, 0.0, MAX_SIGMA_M)
        corners = parse_bounds("map_bounds", self.map_bounds)
        in_degrees = self.map_crs is None or corners is None or is_in_degrees(corners)
        try:
            with (
                progress.task("copying the map into the cache") as update,
                renamed_in_errors(bounds_deg="map_bounds", bounds_crs="map_bounds", crs="map_crs"),
            ):
                return OrthoMap.open(
                    self.map,
                    self.surface,
                    bounds_deg=corners if in_degrees else None,
                    bounds_crs=None if in_degrees else corners,
                    crs=self.map_crs,
                    georeference_sigma_m=self.map_sigma_m,
                    on_copy=update,
                )
        except MapError as error:
            if str(error).startswith(("map_bounds:", "map_crs:")):
                raise OptionError(str(error)) from None
            raise


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
