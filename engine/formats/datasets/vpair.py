"""VPAIR: pictures of a light aircraft over the Eifel with poses on the Earth; the map is the user's.

Layout of the published sample (https://github.com/AerVisLoc/vpair, https://zenodo.org/record/6473989)::

    poses_query.txt          filepath,x,y,z,undulation,roll,pitch,yaw
    queries/00001.png        as filepath says, 800 x 600 px
    poses_reference_view.txt, reference_views/, distractors/    not read: renderings, not a map

Places are in metres on the axes of the Earth (ECEF), angles in radians about north, east and down. The undulation
is the geoid's height, which makes heights above the sea of them. There are no times.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from engine.errors import TelemetryError
from engine.formats.datasets.recording import Recording, Shot
from engine.formats.telemetry import Cells, read_table
from engine.geo import geodetic_from_ecef

_COLUMNS = ("filepath", "x", "y", "z", "undulation", "roll", "pitch", "yaw")
_NOTES = (
    "the data set has renderings and no map: an orthophoto of the area is yours to give",
    "whether the angles are the aircraft's or the camera's is not said; a mount in your calibration counts",
)


def read_vpair(root: Path) -> Recording:
    """Read the queries of the unpacked sample.

    Args:
        root: the folder with ``poses_query.txt``.

    Raises:
        TelemetryError: a file is missing or is not of the layout.
    """
    shots = [_shot(cells, root) for cells in read_table(root / "poses_query.txt", _COLUMNS)]
    if not shots:
        raise TelemetryError(f"{root / 'poses_query.txt'}: expected a row a picture, got a header and no rows")
    return Recording(dataset="VPAIR", shots=shots, datum="amsl", notes=_NOTES)


def _shot(cells: Cells, root: Path) -> Shot:
    ecef_m = np.array([cells.known(axis) for axis in ("x", "y", "z")])
    lat_deg, lon_deg, ellipsoid_m = (float(value) for value in geodetic_from_ecef(ecef_m))
    return Shot(
        picture=root / cells.text("filepath"),
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        height_m=ellipsoid_m - cells.known("undulation"),
        heading_deg=math.degrees(cells.known("yaw")),
        roll_deg=math.degrees(cells.known("roll")),
        pitch_deg=math.degrees(cells.known("pitch")),
    )
