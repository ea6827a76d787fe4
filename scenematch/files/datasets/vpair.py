"""VPAIR: images of a light aircraft over the Eifel with poses in ECEF; the user provides the map.

Layout of the published sample (https://github.com/AerVisLoc/vpair, https://zenodo.org/record/6473989)::

    poses_query.txt          filepath,x,y,z,undulation,roll,pitch,yaw
    queries/00001.png        as filepath says, 800 x 600 px
    poses_reference_view.txt, reference_views/, distractors/    not read: renderings, not a map

Positions are in metres in ECEF, angles in radians about north, east and down. The undulation is the geoid's
height, which converts ellipsoidal heights to heights above the sea. There are no times.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from engine.errors import TelemetryError
from engine.geo import geodetic_from_ecef
from scenematch.files.datasets.sequence import DatasetSequence, SequenceImage
from scenematch.files.tables import CsvRow, read_table

_COLUMNS = ("filepath", "x", "y", "z", "undulation", "roll", "pitch", "yaw")
_NOTES = (
    "the data set has renderings and no map: give an orthophoto of the area",
    "whether the angles are the aircraft's or the camera's is not published; a mount in your calibration applies",
)


def read_vpair(root: Path) -> DatasetSequence:
    """Read the queries of the unpacked sample.

    Args:
        root: the folder with ``poses_query.txt``.

    Raises:
        TelemetryError: a file is missing or is not of the layout.
    """
    images = [_sequence_image(csv_row, root) for csv_row in read_table(root / "poses_query.txt", _COLUMNS)]
    if not images:
        raise TelemetryError(f"{root / 'poses_query.txt'}: expected one row per picture, got a header and no rows")
    return DatasetSequence(dataset="VPAIR", images=images, datum="amsl", notes=_NOTES)


def _sequence_image(csv_row: CsvRow, root: Path) -> SequenceImage:
    ecef_m = np.array([csv_row.required(axis) for axis in ("x", "y", "z")])
    lat_deg, lon_deg, ellipsoid_m = (float(value) for value in geodetic_from_ecef(ecef_m))
    return SequenceImage(
        path=root / csv_row.text("filepath"),
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        height_m=ellipsoid_m - csv_row.required("undulation"),
        heading_deg=math.degrees(csv_row.required("yaw")),
        roll_deg=math.degrees(csv_row.required("roll")),
        pitch_deg=math.degrees(csv_row.required("pitch")),
    )
