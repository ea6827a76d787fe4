"""wildnav: photographs of a DJI drone over Finnish fields, and a satellite map as images with corners.

Layout (https://github.com/TIERS/wildnav, a checkout of the repository with its photographs added)::

    assets/query/photo_metadata.csv    Filename,Latitude,Longitude,Altitude,Gimball_Roll,Gimball_Yaw,
                                       Gimball_Pitch,Flight_Roll,Flight_Yaw,Flight_Pitch
    assets/query/drone_image_1.jpg
    assets/map/map.csv                 Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_long
    assets/map/sat_map_00.png

The altitude is DJI's relative altitude, above take-off, where the photographs had one, else GPS altitude; the
table does not state which. There are no times.
"""

from __future__ import annotations

from pathlib import Path

from engine.errors import TelemetryError
from scenematch.files.datasets.mosaic import Mosaic, MosaicTile
from scenematch.files.datasets.sequence import DatasetSequence, SequenceImage
from scenematch.files.tables import LONGITUDE, QUARTER_TURN, CsvRow, read_table

_COLUMNS = ("Filename", "Latitude", "Longitude", "Altitude")
_GIMBAL = ("Gimball_Roll", "Gimball_Yaw", "Gimball_Pitch")
_CORNERS = ("Top_left_lat", "Top_left_lon", "Bottom_right_lat", "Bottom_right_long")
_NADIR_DEG = -90.0  # pitch of a DJI gimbal at nadir


def read_wildnav(root: Path) -> DatasetSequence:
    """Read a checkout with its photographs.

    Args:
        root: the checkout.

    Raises:
        TelemetryError: a file is missing or is not of the layout.
    """
    query, table = root / "assets" / "query", root / "assets" / "map" / "map.csv"
    images = [
        _sequence_image(csv_row, query) for csv_row in read_table(query / "photo_metadata.csv", _COLUMNS, _GIMBAL)
    ]
    if not images:
        raise TelemetryError(
            f"{query / 'photo_metadata.csv'}: expected one row per picture, got a header and no rows"
        )
    tiles = [_mosaic_tile(csv_row, table.parent) for csv_row in read_table(table, ("Filename", *_CORNERS))]
    present = [tile for tile in tiles if tile.path.is_file()]
    if not present:
        raise TelemetryError(f"{table}: expected the pictures that it names, got none of them")
    notes = [
        "positions are the drone's own GPS; the altitude is above take-off or by GPS, depending on the photograph"
    ]
    if len(present) < len(tiles):
        notes.append(f"{len(tiles) - len(present)} of {len(tiles)} pictures of the map are missing, left out")
    return DatasetSequence(dataset="wildnav", images=images, map=Mosaic(present, epsg=4326), notes=tuple(notes))


def _sequence_image(csv_row: CsvRow, folder: Path) -> SequenceImage:
    roll_deg, yaw_deg, gimbal_deg = (_number(csv_row, column) for column in _GIMBAL)
    pitch_deg = None if gimbal_deg is None else gimbal_deg - _NADIR_DEG
    return SequenceImage(
        path=folder / csv_row.text("Filename"),
        lat_deg=csv_row.required("Latitude", QUARTER_TURN),
        lon_deg=csv_row.required("Longitude", LONGITUDE),
        height_m=_number(csv_row, "Altitude"),
        heading_deg=yaw_deg,
        roll_deg=roll_deg,
        pitch_deg=pitch_deg,
    )


def _number(csv_row: CsvRow, column: str) -> float | None:
    """A number; the data set has NaN for unknown values."""
    return None if csv_row.values[column].lower() == "nan" else csv_row.number(column)


def _mosaic_tile(csv_row: CsvRow, folder: Path) -> MosaicTile:
    bounds = (QUARTER_TURN, LONGITUDE, QUARTER_TURN, LONGITUDE)
    top, left, bottom, right = (csv_row.required(*pair) for pair in zip(_CORNERS, bounds, strict=True))
    return MosaicTile(folder / csv_row.text("Filename"), left, top, right, bottom)
