"""ALTO: pictures of a helicopter between Ohio and Pittsburgh, and aerial pictures round the same route.

Layout of the competition's data (https://github.com/MetaSLAM/ALTO, the README in its download)::

    Train|Val/query.csv                  easting,northing,altitude,orient_x,orient_y,orient_z,orient_w,name
    Train|Val/query_images/000000.png    500 x 500 px, about 20 a second
    Train|Val/reference.csv              easting,northing,name
    Train|Val/reference_images/offset_0_None/000000.png     500 x 500 px, every 10 m, and on parallels to the route

The altitude is above the ellipsoid, the quaternion (scalar last) turns the camera's axes into those of the Earth.
The UTM zone is the area's; that the aerial pictures are north up, and their pixel size, is not said.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError, TelemetryError
from engine.formats.datasets.mosaic import Mosaic, Piece, size_px
from engine.formats.datasets.recording import Recording, Shot
from engine.formats.telemetry import Cells, read_table
from engine.geo import LocalFrame, attitude_from_rotation

EPSG = 32617
"""UTM zone 17 north, in which Pittsburgh and eastern Ohio lie."""
RATE_HZ = 20.0
_QUATERNION = ("orient_x", "orient_y", "orient_z", "orient_w")
_APART_M = 100.0  # between the aerial pictures that are used: each covers some 300 m
_NOTES = (
    "times are those of 20 pictures a second, which the README calls approximate",
    "the UTM zone is taken to be 17 north",
    "the picture's right points to the nose: a calibration of yours needs the identity as its mount",
)


def read_alto(root: Path, part: str, gsd_m: float | None = None) -> Recording:
    """Read one split of the competition's data.

    Args:
        root: the unpacked data set.
        part: "Train" or "Val".
        gsd_m: pixel of the aerial pictures, which are then laid together to a map; None reads no map.

    Raises:
        TelemetryError: a file is missing or is not of the layout.
        OptionError: the pixel is of no such size.
    """
    if gsd_m is not None and not 1e-3 <= gsd_m <= 100.0:
        raise OptionError(f"gsd_m: expected 0.001 to 100 metres, got {gsd_m:g}")
    table = root / part / "query.csv"
    rows = list(read_table(table, ("name", "easting", "northing", "altitude", *_QUATERNION)))
    if not rows:
        raise TelemetryError(f"{table}: expected a row a picture, got a header and no rows")
    places = np.array([[cells.known("easting"), cells.known("northing")] for cells in rows])
    lat_deg, lon_deg = _geodetic(places)
    folder = root / part / "query_images"
    shots = [_shot(cells, folder, k, float(lat_deg[k]), float(lon_deg[k])) for k, cells in enumerate(rows)]
    mosaic = None if gsd_m is None else _map(root / part, gsd_m)
    return Recording(
        dataset="ALTO", part=part, shots=shots, datum="ellipsoid", mount=np.eye(3), map=mosaic, notes=_NOTES
    )


def _geodetic(places_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    from pyproj import Transformer

    lon, lat = Transformer.from_crs(EPSG, 4326, always_xy=True).transform(places_m[:, 0], places_m[:, 1])
    return np.asarray(lat), np.asarray(lon)


def _shot(cells: Cells, folder: Path, index: int, lat_deg: float, lon_deg: float) -> Shot:
    """The camera's axes (right, down, into the picture) point forward, right and down: they are the body's."""
    x, y, z, w = np.array([cells.known(name) for name in _QUATERNION])
    norm = float(x * x + y * y + z * z + w * w)
    if not 0.9 < norm < 1.1:
        raise cells.error("orient_w", "a quaternion of length 1 in orient_x to orient_w")
    s = 2.0 / norm
    ecef_from_camera = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    )
    enu_from_camera = LocalFrame(lat_deg, lon_deg).enu_from_ecef @ ecef_from_camera
    roll_deg, pitch_deg, heading_deg = attitude_from_rotation(enu_from_camera)
    return Shot(
        picture=folder / cells.text("name"),
        timestamp_ns=round(index * 1e9 / RATE_HZ),
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        height_m=cells.known("altitude"),
        heading_deg=heading_deg,
        roll_deg=roll_deg,
        pitch_deg=pitch_deg,
    )


def _map(folder: Path, gsd_m: float) -> Mosaic:
    """The aerial pictures, those of the route itself last, so that they count where others overlap them."""
    last: dict[str, NDArray[np.float64]] = {}
    pieces: list[tuple[bool, Piece]] = []
    for cells in read_table(folder / "reference.csv", ("name", "easting", "northing")):
        name, place = cells.text("name"), np.array([cells.known("easting"), cells.known("northing")])
        track = name.partition("/")[0]
        path = folder / "reference_images" / name
        if (track in last and np.hypot(*(place - last[track])) < _APART_M) or not path.is_file():
            continue
        last[track] = place
        half_x, half_y = (0.5 * gsd_m * n for n in size_px(path))
        piece = Piece(path, place[0] - half_x, place[1] + half_y, place[0] + half_x, place[1] - half_y)
        pieces.append((track == "offset_0_None", piece))
    if not pieces:
        raise TelemetryError(f"{folder / 'reference.csv'}: expected the pictures that it names, got none of them")
    return Mosaic([piece for _, piece in sorted(pieces, key=lambda item: item[0])], epsg=EPSG)
