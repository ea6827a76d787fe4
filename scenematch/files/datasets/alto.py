"""ALTO: images of a helicopter between Ohio and Pittsburgh, and aerial images around the same route.

Layout of the competition's data (https://github.com/MetaSLAM/ALTO, the README in its download)::

    Train|Val/query.csv                  easting,northing,altitude,orient_x,orient_y,orient_z,orient_w,name
    Train|Val/query_images/000000.png    500 x 500 px, about 20 a second
    Train|Val/reference.csv              easting,northing,name
    Train|Val/reference_images/offset_0_None/000000.png     500 x 500 px, every 10 m, and on parallels to the route

The altitude is above the ellipsoid; the quaternion (scalar last) rotates the camera's axes to ECEF. The UTM zone
is that of the area. That the aerial images are north up, and their pixel size, is not published.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError, TelemetryError
from engine.geo import LocalFrame, attitude_from_rotation
from scenematch.files.datasets.mosaic import Mosaic, MosaicTile, size_px
from scenematch.files.datasets.sequence import DatasetSequence, SequenceImage
from scenematch.files.tables import CsvRow, read_table

EPSG = 32617
"""UTM zone 17 north, in which Pittsburgh and eastern Ohio lie."""
RATE_HZ = 20.0
_QUATERNION = ("orient_x", "orient_y", "orient_z", "orient_w")
_MIN_SPACING_M = 100.0  # of the aerial images that are used; each covers about 300 m
_NOTES = (
    "times assume 20 pictures per second, which the README calls approximate",
    "the UTM zone is assumed to be 17 north",
    "the picture's right points to the nose: your own calibration needs the identity as its mount",
)


def read_alto(root: Path, part: str, gsd_m: float | None = None) -> DatasetSequence:
    """Read one split of the competition's data.

    Args:
        root: the unpacked data set.
        part: "Train" or "Val".
        gsd_m: pixel size of the aerial images in metres, which are then mosaicked to a map; None reads no map.

    Raises:
        TelemetryError: a file is missing or is not of the layout.
        OptionError: the pixel size is out of range.
    """
    if gsd_m is not None and not 1e-3 <= gsd_m <= 100.0:
        raise OptionError(f"gsd_m: expected 0.001 to 100 metres, got {gsd_m:g}")
    table = root / part / "query.csv"
    rows = list(read_table(table, ("name", "easting", "northing", "altitude", *_QUATERNION)))
    if not rows:
        raise TelemetryError(f"{table}: expected one row per picture, got a header and no rows")
    positions_m = np.array([[csv_row.required("easting"), csv_row.required("northing")] for csv_row in rows])
    lat_deg, lon_deg = _geodetic(positions_m)
    folder = root / part / "query_images"
    images = [
        _sequence_image(csv_row, folder, k, float(lat_deg[k]), float(lon_deg[k])) for k, csv_row in enumerate(rows)
    ]
    mosaic = None if gsd_m is None else _map(root / part, gsd_m)
    return DatasetSequence(
        dataset="ALTO", part=part, images=images, datum="ellipsoid", mount=np.eye(3), map=mosaic, notes=_NOTES
    )


def _geodetic(positions_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    from pyproj import Transformer

    lon, lat = Transformer.from_crs(EPSG, 4326, always_xy=True).transform(positions_m[:, 0], positions_m[:, 1])
    return np.asarray(lat), np.asarray(lon)


def _sequence_image(csv_row: CsvRow, folder: Path, index: int, lat_deg: float, lon_deg: float) -> SequenceImage:
    """The camera's axes (right, down, optical axis) point forward, right and down: they are the body's."""
    x, y, z, w = np.array([csv_row.required(name) for name in _QUATERNION])
    norm = float(x * x + y * y + z * z + w * w)
    if not 0.9 < norm < 1.1:
        raise csv_row.error("orient_w", "a quaternion of length 1 in orient_x to orient_w")
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
    return SequenceImage(
        path=folder / csv_row.text("name"),
        timestamp_ns=round(index * 1e9 / RATE_HZ),
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        height_m=csv_row.required("altitude"),
        heading_deg=heading_deg,
        roll_deg=roll_deg,
        pitch_deg=pitch_deg,
    )


def _map(folder: Path, gsd_m: float) -> Mosaic:
    """The aerial images, those of the route last, so that they take precedence where others overlap them."""
    last: dict[str, NDArray[np.float64]] = {}
    tiles: list[tuple[bool, MosaicTile]] = []
    for csv_row in read_table(folder / "reference.csv", ("name", "easting", "northing")):
        name, position_m = (
            csv_row.text("name"),
            np.array([csv_row.required("easting"), csv_row.required("northing")]),
        )
        track = name.partition("/")[0]
        path = folder / "reference_images" / name
        if (track in last and np.hypot(*(position_m - last[track])) < _MIN_SPACING_M) or not path.is_file():
            continue
        last[track] = position_m
        half_x, half_y = (0.5 * gsd_m * n for n in size_px(path))
        tile = MosaicTile(
            path, position_m[0] - half_x, position_m[1] + half_y, position_m[0] + half_x, position_m[1] - half_y
        )
        tiles.append((track == "offset_0_None", tile))
    if not tiles:
        raise TelemetryError(f"{folder / 'reference.csv'}: expected the pictures that it names, got none of them")
    return Mosaic([tile for _, tile in sorted(tiles, key=lambda item: item[0])], epsg=EPSG)
