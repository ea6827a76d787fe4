"""OrthoLoC: single photographs with an orthophoto, a surface model and an exact pose each, in local metres.

Layout (https://github.com/deepscenario/OrthoLoC): one file per sample, ``L01_R0000.npz``, with

    image_query    (H, W, 3)    the photograph
    image_dop      (h, w, 3)    the orthophoto
    dsm            (h, w, 3)    easting, northing and height of each of its pixels, NaN where unknown
    intrinsics     (3, 3)       of the photograph
    extrinsics     (3, 4)       from the world to the camera
    mask_dsm       (h, w)       in some samples: where the heights are known
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.errors import TelemetryError
from engine.geo import attitude_from_rotation
from engine.values import Attitude
from scenematch.files.datasets.single_photos import Array, LocalMap, SinglePhoto, as_rgb_image, read_arrays

_NAMES = ("image_query", "image_dop", "dsm", "intrinsics", "extrinsics")
_MASK = "mask_dsm"
_MAX_GRID_ERROR_PX = 0.05  # deviation of positions from a regular grid


def find_ortholoc(root: Path) -> list[Path]:
    """The samples in a folder, in the order of their names."""
    return sorted(root.glob("*.npz"))


def read_ortholoc(path: Path) -> tuple[SinglePhoto, LocalMap]:
    """Read one sample.

    Raises:
        TelemetryError: it is not of the layout.
        CalibrationError: its intrinsics are invalid.
    """
    arrays = read_arrays(path, _NAMES, (_MASK,))
    image = as_rgb_image(arrays["image_query"], path, "image_query")
    ortho = as_rgb_image(arrays["image_dop"], path, "image_dop")
    world, pose = (np.asarray(arrays[name], dtype=np.float64) for name in ("dsm", "extrinsics"))
    if world.shape != ortho.shape or pose.shape != (3, 4):
        raise TelemetryError(
            f"{path}: expected dsm as image_dop and extrinsics (3, 4), got {world.shape}, {pose.shape}"
        )
    pixel_to_m, origin = _grid(world, path)
    rotation = pose[:, :3]
    camera = Camera(image.shape[1], image.shape[0], np.asarray(arrays["intrinsics"], dtype=np.float64))
    position_m = -rotation.T @ pose[:, 3]
    attitude = attitude_from_rotation(rotation.T @ camera.mount.T)
    single = SinglePhoto(
        name=path.stem,
        image=image,
        camera=camera,
        position_m=position_m - (*origin, 0.0),
        attitude=Attitude(*attitude),
    )
    heights_m = world[:, :, 2].astype(np.float32)
    known = np.asarray(arrays.get(_MASK, np.ones(heights_m.shape)), dtype=np.bool_)
    if known.shape != heights_m.shape:
        raise TelemetryError(f"{path}: expected {_MASK} as image_dop, got {known.shape}")
    heights_m[~known] = np.nan
    return single, LocalMap(picture=ortho, pixel_to_m=pixel_to_m, surface_m=heights_m, surface_to_m=pixel_to_m)


def _grid(world: Array, path: Path) -> tuple[Array, NDArray[np.float64]]:
    """(2, 3) affine transform of pixels to metres about the centre of the map, and (2,) that centre."""
    known = np.isfinite(world[:, :, :2]).all(axis=2)
    y, x = np.nonzero(known)
    if len(x) < 3:
        raise TelemetryError(f"{path}: dsm: expected positions of its pixels, got {len(x)} that are finite")
    origin = world[known][:, :2].mean(axis=0)
    design = np.column_stack([x, y, np.ones(len(x))])
    positions_m = world[known][:, :2] - origin
    matrix: Array = np.asarray(np.linalg.lstsq(design, positions_m, rcond=None)[0].T, dtype=np.float64)
    off_px = float(
        np.abs(design @ matrix.T - positions_m).max() / np.sqrt(abs(np.linalg.det(matrix[:, :2])) or 1.0)
    )
    if not off_px <= _MAX_GRID_ERROR_PX:
        raise TelemetryError(
            f"{path}: dsm: expected positions on a regular grid, got some {off_px:.2f} pixels off it"
        )
    return matrix, origin
