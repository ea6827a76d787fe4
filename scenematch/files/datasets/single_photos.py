"""Single photographs with local maps: flights of one frame, placed at an arbitrary position on the Earth."""

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
from engine.values import Attitude, Truth
from scenematch.files.datasets.mosaic import Mosaic, MosaicTile, size_px, write_mosaic
from scenematch.files.datasets.sequence import MANIFEST, START_SIGMA_M
from scenematch.files.flight import camera_info
from scenematch.files.geotiff import write_geotiff
from scenematch.files.telemetry import TelemetryRow, write_telemetry
from scenematch.files.truth import write_truth

Array = NDArray[np.float64]

EPSG, ANCHOR_M = 32631, (500_000.0, 5_500_000.0)
"""CRS and position of the local origin: on the central meridian of a UTM zone, where grid north is true north."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalMap:
    """A map with its surface model, in metres east, north and up of a local origin.

    Attributes:
        picture: (H, W, 3) uint8, or the path of an image that is too large for memory.
        pixel_to_m: (2, 3) affine transform from pixel centres (x, y, 1) to east and north.
        surface_m: (H', W') heights; NaN where unknown.
        surface_to_m: (2, 3) affine transform of the surface model.
    """

    picture: NDArray[np.uint8] | Path
    pixel_to_m: Array
    surface_m: NDArray[np.float32]
    surface_to_m: Array

    def ground_at(self, east_north_m: Array) -> float:
        """Height of the surface in metres at (2,) east and north, or the median of all where it is unknown."""
        inverse = np.linalg.inv(np.vstack([self.surface_to_m, [0.0, 0.0, 1.0]]))
        x, y = (round(float(v)) for v in (inverse @ (*east_north_m, 1.0))[:2])
        rows, columns = self.surface_m.shape
        height_m = float(self.surface_m[y, x]) if 0 <= x < columns and 0 <= y < rows else math.nan
        return height_m if math.isfinite(height_m) else float(np.nanmedian(self.surface_m))


@dataclass(frozen=True, slots=True, kw_only=True)
class SinglePhoto:
    """One photograph.

    Attributes:
        name: name of the sample.
        image: (H, W, 3) RGB uint8.
        camera: calibration.
        position_m: (3,) east, north and up in the map's local metres.
        attitude: of a body with a nadir camera, the image's top to the nose.
    """

    name: str
    image: NDArray[np.uint8]
    camera: Camera
    position_m: Array
    attitude: Attitude

    @property
    def tilt_deg(self) -> float:
        """Angle between the optical axis and nadir."""
        roll, pitch = (math.radians(v) for v in (self.attitude.roll_deg, self.attitude.pitch_deg))
        return math.degrees(math.acos(max(-1.0, min(1.0, math.cos(roll) * math.cos(pitch)))))


def write_local_map(folder: Path, local_map: LocalMap) -> None:
    """Write map.tif and dsm.tif into a folder, which is created.

    Raises:
        MapError: they cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(local_map.picture, Path):
        write_mosaic(
            folder / "map.tif", Mosaic([_mosaic_tile(local_map.picture, _anchored(local_map.pixel_to_m))], EPSG)
        )
    else:
        write_geotiff(folder / "map.tif", local_map.picture, _anchored(local_map.pixel_to_m), EPSG)
    heights_m = np.asarray(local_map.surface_m, np.float32)
    write_geotiff(folder / "dsm.tif", heights_m, _anchored(local_map.surface_to_m), EPSG, nodata=math.nan)


def _anchored(matrix: Array) -> Array:
    return np.asarray(matrix + np.array([[0.0, 0.0, ANCHOR_M[0]], [0.0, 0.0, ANCHOR_M[1]]]))


def _mosaic_tile(path: Path, matrix: Array) -> MosaicTile:
    """The mosaic tile of a north-up image with a given affine transform."""
    width, height = size_px(path)
    left, top = matrix @ (-0.5, -0.5, 1.0)
    right, bottom = matrix @ (width - 0.5, height - 0.5, 1.0)
    return MosaicTile(path, float(left), float(top), float(right), float(bottom))


def write_single_photo(folder: Path, photo: SinglePhoto, local_map: LocalMap, maps: Path, dataset: str) -> None:
    """Write a flight folder of one frame with its true height and attitude.

    Args:
        folder: the flight folder, which is created.
        photo: the photograph.
        local_map: the map that it shows.
        maps: the folder that :func:`write_local_map` writes the map into.
        dataset: name of the data set.

    Raises:
        TelemetryError: the camera is not above the ground, or a file cannot be written.
    """
    from pyproj import Transformer

    east_m, north_m, up_m = (float(v) for v in photo.position_m)
    height_m = up_m - local_map.ground_at(photo.position_m[:2])
    if height_m <= 0.0:
        raise TelemetryError(f"{photo.name}: expected a camera above its ground, got one {-height_m:.1f} m below")
    to_degrees = Transformer.from_crs(EPSG, 4326, always_xy=True)
    lon_deg, lat_deg = to_degrees.transform(ANCHOR_M[0] + east_m, ANCHOR_M[1] + north_m)
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    # Written first: it marks the folder as imported, so that a later import may replace it.
    (folder / MANIFEST).write_text(json.dumps({"dataset": dataset, "part": photo.name}) + "\n", encoding="utf-8")
    Image.fromarray(photo.image).save(folder / "frames" / f"{photo.name}.png")
    attitude = photo.attitude
    angles = {
        "heading_deg": attitude.heading_deg % 360.0,
        "roll_deg": attitude.roll_deg,
        "pitch_deg": attitude.pitch_deg,
        "height_agl_m": height_m,
    }
    row = TelemetryRow(
        timestamp_ns=0,
        frame=f"{photo.name}.png",
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        sigma_m=START_SIGMA_M,
        **angles,
    )
    write_telemetry(folder / "telemetry.csv", [row])
    write_truth(folder / "truth.csv", [Truth(timestamp_ns=0, lat_deg=lat_deg, lon_deg=lon_deg, **angles)])
    (folder / "camera.yaml").write_text(camera_info(photo.camera), encoding="utf-8")
    for name in ("map.tif", "dsm.tif"):
        if maps != folder:
            os.symlink(os.path.relpath(maps / name, folder), folder / name)


def campaign_text(names: Sequence[str]) -> str:
    """The text of a campaign file that tracks each of the flights by both methods."""
    lines = ['runs = ["ncc", "sift"]', ""]
    for name in names:
        lines += [f'[flights."{name}"]', f'folder = "{name}"', ""]
    return "\n".join(lines)


def read_arrays(path: Path, names: Sequence[str], optional: Sequence[str] = ()) -> dict[str, NDArray[np.generic]]:
    """Read arrays of an .npz file; pickled objects are refused.

    Args:
        path: the file.
        names: names of the arrays.
        optional: names of arrays that it may lack.

    Raises:
        TelemetryError: the file is missing, is no .npz file, or lacks an array.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in (*names, *(n for n in optional if n in file))}
    except FileNotFoundError:
        raise TelemetryError(f"{path}: no such file") from None
    except KeyError as error:
        raise TelemetryError(f"{path}: lacks the array {error.args[0]!r}") from None
    except (OSError, ValueError, EOFError) as error:
        raise TelemetryError(f"{path}: expected NumPy arrays: {str(error).splitlines()[0]}") from None


def as_rgb_image(array: NDArray[np.generic], path: Path, name: str) -> NDArray[np.uint8]:
    """Check that an array is an image.

    Args:
        array: the array.
        path: its file, for messages.
        name: its name in the file, for messages.

    Returns:
        (H, W, 3) uint8, contiguous.

    Raises:
        TelemetryError: the array has another shape or element type.
    """
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8:
        raise TelemetryError(f"{path}: {name}: expected (H, W, 3) uint8, got {array.shape} {array.dtype}")
    return np.ascontiguousarray(array, dtype=np.uint8)
