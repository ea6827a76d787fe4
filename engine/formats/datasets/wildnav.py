"""wildnav: photographs of a DJI drone over Finnish fields, and a satellite map in pictures with their corners.

Layout (https://github.com/TIERS/wildnav, a checkout of the repository with its photographs added)::

    assets/query/photo_metadata.csv    Filename,Latitude,Longitude,Altitude,Gimball_Roll,Gimball_Yaw,
                                       Gimball_Pitch,Flight_Roll,Flight_Yaw,Flight_Pitch
    assets/query/drone_image_1.jpg
    assets/map/map.csv                 Filename,Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_long
    assets/map/sat_map_00.png

The altitude is DJI's relative altitude, above the place of take-off, where the photographs had one, else GPS
altitude; the table does not tell which. There are no times.
"""

from __future__ import annotations

from pathlib import Path

from engine.errors import TelemetryError
from engine.formats.datasets.mosaic import Mosaic, Piece
from engine.formats.datasets.recording import Recording, Shot
from engine.formats.telemetry import LONGITUDE, QUARTER_TURN, Cells, read_table

_COLUMNS = ("Filename", "Latitude", "Longitude", "Altitude")
_GIMBAL = ("Gimball_Roll", "Gimball_Yaw", "Gimball_Pitch")
_CORNERS = ("Top_left_lat", "Top_left_lon", "Bottom_right_lat", "Bottom_right_long")
_NADIR_DEG = -90.0  # a DJI gimbal's pitch when its camera looks straight down


def read_wildnav(root: Path) -> Recording:
    """Read a checkout with its photographs.

    Args:
        root: the checkout.

    Raises:
        TelemetryError: a file is missing or is not of the layout.
    """
    query, table = root / "assets" / "query", root / "assets" / "map" / "map.csv"
    shots = [_shot(cells, query) for cells in read_table(query / "photo_metadata.csv", _COLUMNS, _GIMBAL)]
    if not shots:
        raise TelemetryError(f"{query / 'photo_metadata.csv'}: expected a row a picture, got a header and no rows")
    pieces = [_piece(cells, table.parent) for cells in read_table(table, ("Filename", *_CORNERS))]
    here = [piece for piece in pieces if piece.path.is_file()]
    if not here:
        raise TelemetryError(f"{table}: expected the pictures that it names, got none of them")
    notes = ["places are the drone's own GPS; the altitude is above take-off or by GPS, photograph by photograph"]
    if len(here) < len(pieces):
        notes.append(f"{len(pieces) - len(here)} of {len(pieces)} pictures of the map are not there, left out")
    return Recording(dataset="wildnav", shots=shots, map=Mosaic(here, epsg=4326), notes=tuple(notes))


def _shot(cells: Cells, folder: Path) -> Shot:
    roll_deg, yaw_deg, gimbal_deg = (_number(cells, column) for column in _GIMBAL)
    pitch_deg = None if gimbal_deg is None else gimbal_deg - _NADIR_DEG
    return Shot(
        picture=folder / cells.text("Filename"),
        lat_deg=cells.known("Latitude", QUARTER_TURN),
        lon_deg=cells.known("Longitude", LONGITUDE),
        height_m=_number(cells, "Altitude"),
        heading_deg=yaw_deg,
        roll_deg=roll_deg,
        pitch_deg=pitch_deg,
    )


def _number(cells: Cells, column: str) -> float | None:
    """A number; its script writes NaN for what a photograph does not say."""
    return None if cells.values[column].lower() == "nan" else cells.number(column)


def _piece(cells: Cells, folder: Path) -> Piece:
    bounds = (QUARTER_TURN, LONGITUDE, QUARTER_TURN, LONGITUDE)
    top, left, bottom, right = (cells.known(*pair) for pair in zip(_CORNERS, bounds, strict=True))
    return Piece(folder / cells.text("Filename"), left, top, right, bottom)
