"""UAV-VisLoc: photographs of fixed-wing drones over China, a sequence a folder, with a satellite map each.

Layout (https://github.com/IntelliSensing/UAV-VisLoc, and the headers of its files)::

    satellite_coordinates_range.csv    mapname,LT_lat_map,LT_lon_map,RB_lat_map,RB_lon_map,region
    NN/NN.csv                          num,filename,date,lat,lon,height,Omega,Kappa,Phi1,Phi2
    NN/drone/NN_0001.JPG
    NN/satelliteNN.tif                 or satelliteNN_RR-CC.tif, rows and columns of one map

The archive spells the first file with a space before "coordinates". Omega is pitch, Kappa roll, Phi1 the yaw that
is more trusted than Phi2; sequence 07 has none of the four. What the height is counted from is not said.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from engine.errors import TelemetryError
from engine.formats.datasets.mosaic import Mosaic, Piece, own_edges, size_px
from engine.formats.datasets.recording import Recording, Shot
from engine.formats.telemetry import HALF_TURN, LONGITUDE, QUARTER_TURN, Cells, read_table
from engine.geo import LocalFrame

_RANGE = ("satellite_coordinates_range.csv", "satellite_ coordinates_range.csv")
_EDGES = ("LT_lat_map", "LT_lon_map", "RB_lat_map", "RB_lon_map")
_PIECE = re.compile(r"_(\d+)-(\d+)\.tif$")
_DISAGREE_M = 3.0
_NOTES = (
    "places are set-points of the flight plan: hand-made labels were 24 to 48 m off them on four maps "
    "(issue 5 of the data set)",
    "no calibration is published; the field of view is yours to give",
)


def read_uav_visloc(root: Path, part: str) -> Recording:
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
    shots = [
        _shot(cells, folder / "drone")
        for cells in read_table(table, ("filename", "date", "lat", "lon", "height"), optional)
    ]
    if not shots:
        raise TelemetryError(f"{table}: expected a row a picture, got a header and no rows")
    mosaic = _map(root, part)
    notes = _NOTES if shots[0].heading_deg is not None else (*_NOTES, "this sequence has no attitude")
    return Recording(dataset="UAV-VisLoc", part=part, shots=shots, map=mosaic, notes=notes + _disagreement(mosaic))


def _shot(cells: Cells, folder: Path) -> Shot:
    try:
        moment = datetime.fromisoformat(cells.text("date"))
    except ValueError:
        raise cells.error("date", "a date and time of ISO 8601") from None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return Shot(
        picture=folder / cells.text("filename"),
        timestamp_ns=round(moment.timestamp() * 1e6) * 1000,
        lat_deg=cells.known("lat", QUARTER_TURN),
        lon_deg=cells.known("lon", LONGITUDE),
        height_m=cells.number("height"),
        heading_deg=cells.number("Phi1"),
        roll_deg=cells.number("Kappa", HALF_TURN),
        pitch_deg=cells.number("Omega", QUARTER_TURN),
    )


def _map(root: Path, part: str) -> Mosaic:
    """The sequence's satellite map by the published range, whatever its own georeference says."""
    path = next((root / name for name in _RANGE if (root / name).is_file()), root / _RANGE[0])
    top, left, bottom, right = _edges(path, part)
    whole = root / part / f"satellite{part}.tif"
    if whole.is_file():
        return Mosaic([Piece(whole, left, top, right, bottom)], epsg=4326)
    files = sorted((root / part).glob(f"satellite{part}_*-*.tif"))
    if not files:
        raise TelemetryError(f"{whole}: no such file")
    return Mosaic(_pieces(files, left, top, right, bottom), epsg=4326)


def _disagreement(mosaic: Mosaic) -> tuple[str, ...]:
    """How far the first piece's own georeference lies off the published range, where that can be seen."""
    piece = mosaic.pieces[0]
    own = own_edges(piece.path, mosaic.epsg)
    if own is None:
        return ()
    frame = LocalFrame(piece.top, piece.left)
    corners = ((piece.top, piece.left), (own[1], own[0]), (piece.bottom, piece.right), (own[3], own[2]))
    places_m = frame.enu_from_geodetic(*np.array(corners).T)
    off_m = float(np.hypot(*(places_m[1::2] - places_m[::2]).T[:2]).max())
    if off_m <= _DISAGREE_M:
        return ()
    return (f"{piece.path.name} has itself up to {off_m:.0f} m off its published range, which is taken here",)


def _edges(path: Path, part: str) -> tuple[float, float, float, float]:
    for cells in read_table(path, ("mapname", *_EDGES)):
        if cells.text("mapname") in (f"satellite{part}.tif", f"{part}.tif"):
            lat_top, lon_left, lat_bottom, lon_right = (cells.known(name) for name in _EDGES)
            return lat_top, lon_left, lat_bottom, lon_right
    raise TelemetryError(f"{path}: expected a row for satellite{part}.tif, got none")


def _pieces(files: list[Path], left: float, top: float, right: float, bottom: float) -> list[Piece]:
    """Rows and columns of one picture, cut where their sizes in pixels say."""
    sizes: dict[tuple[int, int], tuple[Path, int, int]] = {}
    for file in files:
        found = _PIECE.search(file.name)
        if found is None:
            raise TelemetryError(f"{file}: expected a name that ends in _ROW-COLUMN.tif")
        sizes[int(found[1]), int(found[2])] = (file, *size_px(file))
    widths = {column: w for (_, column), (_, w, _) in sizes.items()}
    heights = {row: h for (row, _), (_, _, h) in sizes.items()}
    step_x, step_y = (right - left) / sum(widths.values()), (top - bottom) / sum(heights.values())
    pieces = []
    for (row, column), (file, width, height) in sorted(sizes.items()):
        x = left + step_x * sum(w for other, w in widths.items() if other < column)
        y = top - step_y * sum(h for other, h in heights.items() if other < row)
        pieces.append(Piece(file, x, y, x + step_x * width, y - step_y * height))
    return pieces
