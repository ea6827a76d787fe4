"""UAV-VisLoc: photographs of fixed-wing drones over China, one folder per sequence, each with a satellite map.

Layout (https://github.com/IntelliSensing/UAV-VisLoc, and the headers of its files)::

    satellite_coordinates_range.csv    mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map,region
    NN/NN.csv                          num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2
    NN/drone/NN_0001.JPG
    NN/satelliteNN.tif                 or satelliteNN_RR-CC.tif, rows and columns of one map

The archive spells the first file with a space before "coordinates". Omega is pitch, Kappa roll, Phi1 the yaw that
is more reliable than Phi2; sequence 07 has none of the four. The datum of the height is not published.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from engine.errors import TelemetryError
from engine.geo import LocalFrame
from scenematch.files.datasets.mosaic import Mosaic, MosaicTile, own_edges, size_px
from scenematch.files.datasets.sequence import DatasetSequence, SequenceImage
from scenematch.files.tables import HALF_TURN, LONGITUDE, QUARTER_TURN, CsvRow, read_table

_RANGE = ("satellite_coordinates_range.csv", "satellite_ coordinates_range.csv")
_EDGES = ("LT_lat_map", "LT_lon_map", "RB_lat_map", "RB_lon_map")
_PIECE = re.compile(r"_(\d+)-(\d+)\.tif$")
_MAX_DISAGREEMENT_M = 3.0
_NOTES = (
    "positions are set-points of the flight plan: manual labels were 24 to 48 m off them on four maps "
    "(issue 5 of the data set)",
    "no calibration is published; give the field of view",
)


def read_uav_visloc(root: Path, part: str) -> DatasetSequence:
    """Read one sequence.

    Args:
        root: the unpacked data set.
        part: the sequence, such as "03".

    Raises:
        TelemetryError: a file is missing or is not of the layout.
    """
    folder = root / part
    table = folder / f"{part}.csv"
    optional = ("Omega", "Kappa", "Phi1")
    images = [
        _sequence_image(csv_row, folder / "drone")
        for csv_row in read_table(table, ("filename", "date", "lat", "lon", "height"), optional)
    ]
    if not images:
        raise TelemetryError(f"{table}: expected one row per picture, got a header and no rows")
    mosaic = _map(root, part)
    notes = _NOTES if images[0].heading_deg is not None else (*_NOTES, "this sequence has no attitude")
    return DatasetSequence(
        dataset="UAV-VisLoc", part=part, images=images, map=mosaic, notes=notes + _disagreement(mosaic)
    )


def _sequence_image(csv_row: CsvRow, folder: Path) -> SequenceImage:
    try:
        time = datetime.fromisoformat(csv_row.text("date"))
    except ValueError:
        raise csv_row.error("date", "a date and time of ISO 8601") from None
    time = time if time.tzinfo else time.replace(tzinfo=UTC)
    return SequenceImage(
        path=folder / csv_row.text("filename"),
        timestamp_ns=round(time.timestamp() * 1e6) * 1000,
        lat_deg=csv_row.required("lat", QUARTER_TURN),
        lon_deg=csv_row.required("lon", LONGITUDE),
        height_m=csv_row.number("height"),
        heading_deg=csv_row.number("Phi1"),
        roll_deg=csv_row.number("Kappa", HALF_TURN),
        pitch_deg=csv_row.number("Omega", QUARTER_TURN),
    )


def _map(root: Path, part: str) -> Mosaic:
    """The satellite map of the sequence, placed by the published range, not by its own georeference."""
    path = next((root / name for name in _RANGE if (root / name).is_file()), root / _RANGE[0])
    top, left, bottom, right = _edges(path, part)
    whole = root / part / f"satellite{part}.tif"
    if whole.is_file():
        return Mosaic([MosaicTile(whole, left, top, right, bottom)], epsg=4326)
    files = sorted((root / part).glob(f"satellite{part}_*-*.tif"))
    if not files:
        raise TelemetryError(f"{whole}: no such file")
    return Mosaic(_mosaic_tiles(files, left, top, right, bottom), epsg=4326)


def _disagreement(mosaic: Mosaic) -> tuple[str, ...]:
    """A note where the first tile's own georeference deviates from the published range."""
    tile = mosaic.tiles[0]
    own = own_edges(tile.path, mosaic.epsg)
    if own is None:
        return ()
    frame = LocalFrame(tile.top, tile.left)
    corners = ((tile.top, tile.left), (own[1], own[0]), (tile.bottom, tile.right), (own[3], own[2]))
    positions_m = frame.enu_from_geodetic(*np.array(corners).T)
    off_m = float(np.hypot(*(positions_m[1::2] - positions_m[::2]).T[:2]).max())
    if off_m <= _MAX_DISAGREEMENT_M:
        return ()
    return (f"the georeference of {tile.path.name} is up to {off_m:.0f} m off its published range, which is used",)


def _edges(path: Path, part: str) -> tuple[float, float, float, float]:
    for csv_row in read_table(path, ("mapname", *_EDGES)):
        if csv_row.text("mapname") in (f"satellite{part}.tif", f"{part}.tif"):
            lat_top, lon_left, lat_bottom, lon_right = (csv_row.required(name) for name in _EDGES)
            return lat_top, lon_left, lat_bottom, lon_right
    raise TelemetryError(f"{path}: expected a row for satellite{part}.tif, got none")


def _mosaic_tiles(files: list[Path], left: float, top: float, right: float, bottom: float) -> list[MosaicTile]:
    """The tiles of one map in rows and columns, whose edges follow from their sizes in pixels."""
    sizes: dict[tuple[int, int], tuple[Path, int, int]] = {}
    for file in files:
        found = _PIECE.search(file.name)
        if found is None:
            raise TelemetryError(f"{file}: expected a name that ends in _ROW-COLUMN.tif")
        sizes[int(found[1]), int(found[2])] = (file, *size_px(file))
    widths = {column: w for (_, column), (_, w, _) in sizes.items()}
    heights = {row: h for (row, _), (_, _, h) in sizes.items()}
    step_x, step_y = (right - left) / sum(widths.values()), (top - bottom) / sum(heights.values())
    tiles = []
    for (row, column), (file, width, height) in sorted(sizes.items()):
        x = left + step_x * sum(w for other, w in widths.items() if other < column)
        y = top - step_y * sum(h for other, h in heights.items() if other < row)
        tiles.append(MosaicTile(file, x, y, x + step_x * width, y - step_y * height))
    return tiles
