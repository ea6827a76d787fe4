"""Single photographs with their maps: flights of one frame, put somewhere on the Earth where theirs is secret."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from engine.camera import Camera
from engine.errors import TelemetryError
from engine.formats.datasets.mosaic import Mosaic, Piece, size_px, write_mosaic
from engine.formats.datasets.recording import ABOUT, START_SIGMA_M
from engine.formats.flight import camera_info
from engine.formats.geotiff import write_geotiff
from engine.formats.telemetry import TelemetryRow, write_telemetry
from engine.formats.truth import write_truth
from engine.values import Attitude, Truth

Array = NDArray[np.float64]

EPSG, ANCHOR_M = 32631, (500_000.0, 5_500_000.0)
"""Where local metres begin: on the middle of a UTM zone, where north on the grid is true north."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalMap:
    """A map with its surface model, in metres east, north and up about a local origin.

    Attributes:
        picture: (H, W, 3) uint8, or the file of a picture that is too large to be held.
        pixel_to_m: (2, 3), takes pixel centres (x, y, 1) to east and north.
        surface_m: (H', W') heights.
        surface_to_m: (2, 3), the same for them.
    """

    picture: NDArray[np.uint8] | Path
    pixel_to_m: Array
    surface_m: NDArray[np.float32]
    surface_to_m: Array

    def ground_at(self, east_north_m: Array) -> float:
        """Height of the surface below a place, or where that is unknown the median of all of it."""
        inverse = np.linalg.inv(np.vstack([self.surface_to_m, [0.0, 0.0, 1.0]]))
        x, y = (round(float(v)) for v in (inverse @ (*east_north_m, 1.0))[:2])
        rows, columns = self.surface_m.shape
        height_m = float(self.surface_m[y, x]) if 0 <= x < columns and 0 <= y < rows else math.nan
        return height_m if math.isfinite(height_m) else float(np.nanmedian(self.surface_m))


@dataclass(frozen=True, slots=True, kw_only=True)
class Single:
    """One photograph.

    Attributes:
        name: of the sample.
        image: (H, W, 3) RGB uint8.
        camera: its calibration.
        position_m: (3,) east, north and up in the map's local metres.
        attitude: of a body whose camera looks straight down, the picture's top to the nose.
    """

    name: str
    image: NDArray[np.uint8]
    camera: Camera
    position_m: Array
    attitude: Attitude

    @property
    def tilt_deg(self) -> float:
        """Angle between the optical axis and straight down."""
        roll, pitch = (math.radians(v) for v in (self.attitude.roll_deg, self.attitude.pitch_deg))
        return math.degrees(math.acos(max(-1.0, min(1.0, math.cos(roll) * math.cos(pitch)))))


def write_place(folder: Path, place: LocalMap) -> None:
    """Write map.tif and dsm.tif.

    Raises:
        MapError: they cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(place.picture, Path):
        write_mosaic(folder / "map.tif", Mosaic([_piece(place.picture, _anchored(place.pixel_to_m))], EPSG))
    else:
        write_geotiff(folder / "map.tif", place.picture, _anchored(place.pixel_to_m), EPSG)
    heights_m = np.asarray(place.surface_m, np.float32)
    write_geotiff(folder / "dsm.tif", heights_m, _anchored(place.surface_to_m), EPSG, nodata=math.nan)


def _anchored(matrix: Array) -> Array:
    return np.asarray(matrix + np.array([[0.0, 0.0, ANCHOR_M[0]], [0.0, 0.0, ANCHOR_M[1]]]))


def _piece(path: Path, matrix: Array) -> Piece:
    """The outer edges of a north-up picture."""
    width, height = size_px(path)
    left, top = matrix @ (-0.5, -0.5, 1.0)
    right, bottom = matrix @ (width - 0.5, height - 0.5, 1.0)
    return Piece(path, float(left), float(top), float(right), float(bottom))


def write_single(folder: Path, single: Single, place: LocalMap, maps: Path, dataset: str) -> None:
    """Write a flight folder of one frame, whose height and attitude are the true ones.

    Args:
        folder: made here.
        single: the photograph.
        place: what it looks at.
        maps: the folder that :func:`write_place` writes the place into.
        dataset: its name.

    Raises:
        TelemetryError: the photograph is not above its ground, or a file cannot be written.
    """
    from pyproj import Transformer

    east_m, north_m, up_m = (float(v) for v in single.position_m)
    height_m = up_m - place.ground_at(single.position_m[:2])
    if height_m <= 0.0:
        raise TelemetryError(f"{single.name}: expected a camera above its ground, got one {-height_m:.1f} m below")
    to_degrees = Transformer.from_crs(EPSG, 4326, always_xy=True)
    lon_deg, lat_deg = to_degrees.transform(ANCHOR_M[0] + east_m, ANCHOR_M[1] + north_m)
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    # First: it says that an import made the folder, and that a later one may replace it.
    (folder / ABOUT).write_text(json.dumps({"dataset": dataset, "part": single.name}) + "\n", encoding="utf-8")
    Image.fromarray(single.image).save(folder / "frames" / f"{single.name}.png")
    attitude = single.attitude
    angles = {
        "heading_deg": attitude.heading_deg % 360.0,
        "roll_deg": attitude.roll_deg,
        "pitch_deg": attitude.pitch_deg,
        "height_agl_m": height_m,
    }
    row = TelemetryRow(
        timestamp_ns=0,
        frame=f"{single.name}.png",
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        sigma_m=START_SIGMA_M,
        **angles,
    )
    write_telemetry(folder / "telemetry.csv", [row])
    write_truth(folder / "truth.csv", [Truth(timestamp_ns=0, lat_deg=lat_deg, lon_deg=lon_deg, **angles)])
    (folder / "camera.yaml").write_text(camera_info(single.camera), encoding="utf-8")
    for name in ("map.tif", "dsm.tif"):
        if maps != folder:
            os.symlink(os.path.relpath(maps / name, folder), folder / name)


def campaign_text(names: Sequence[str]) -> str:
    """A campaign's file that follows each of the flights by both methods."""
    lines = ['runs = ["ncc", "sift"]', ""]
    for name in names:
        lines += [f'[flights."{name}"]', f'folder = "{name}"', ""]
    return "\n".join(lines)


def read_arrays(path: Path, names: Sequence[str]) -> dict[str, NDArray[np.generic]]:
    """Arrays of an .npz file; nothing in it is executed.

    Raises:
        TelemetryError: the file is missing, is no .npz file, or lacks an array.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names}
    except FileNotFoundError:
        raise TelemetryError(f"{path}: no such file") from None
    except KeyError as error:
        raise TelemetryError(f"{path}: lacks the array {error.args[0]!r}") from None
    except (OSError, ValueError, EOFError) as error:
        raise TelemetryError(f"{path}: expected arrays of numpy: {str(error).splitlines()[0]}") from None


def picture_of(array: NDArray[np.generic], path: Path, name: str) -> NDArray[np.uint8]:
    """An array as a picture (H, W, 3).

    Raises:
        TelemetryError: it has another shape or element type.
    """
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8:
        raise TelemetryError(f"{path}: {name}: expected (H, W, 3) uint8, got {array.shape} {array.dtype}")
    return np.ascontiguousarray(array, dtype=np.uint8)
