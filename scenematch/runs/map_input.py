"""The map of a run: its files, and what they do not state themselves."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from engine.errors import MapError, OptionError
from engine.orthomap import OrthoMap
from engine.values import MAX_SIGMA_M
from scenematch.runs.arguments import check_above, is_in_degrees, parse_bounds
from scenematch.runs.folders import StrPath
from scenematch.runs.progress import SILENT, Progress
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
