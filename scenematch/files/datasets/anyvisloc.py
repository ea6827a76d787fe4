"""AnyVisLoc: single photographs of drones over China, one folder per scene with two maps, in local metres.

Layout (https://github.com/UAV-AVL/Benchmark)::

    Scene_01/L01_reference.json    modes.aerial|satellite: map_path, dsm_path, map_origin_local, dsm_origin_local
                                   (from the map's), map_resolution, dsm_resolution; x east, y south
    Scene_01/aerial_map.png, aerial_dsm.npy, satellite_map.png, satellite_dsm.npy
    Scene_01/L01_0001.npz          image or image_relpath, K, dist, xyz (z up), euler_deg (roll, pitch, yaw)

A pitch of 0 is nadir, a yaw of 0 north. The sign of the roll could not be verified: it is taken as 0, as on a
gimbal.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from engine.camera import Camera
from engine.errors import TelemetryError
from engine.values import Attitude
from scenematch.files.datasets.single_photos import Array, LocalMap, SinglePhoto, as_rgb_image, read_arrays

MODES = ("aerial", "satellite")


def find_anyvisloc(scene: Path) -> list[Path]:
    """The samples of a scene, in the order of their names."""
    return sorted(scene.glob("L??_????.npz"))


def read_local_map(scene: Path, mode: str) -> LocalMap:
    """Read one of the two maps of a scene.

    Args:
        scene: folder of the scene.
        mode: one of :data:`MODES`.

    Raises:
        TelemetryError: a file is missing or is not of the layout.
    """
    path = next(iter(sorted(scene.glob("L??_reference.json"))), scene / "L01_reference.json")
    try:
        entry: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["modes"][mode]
        map_px, dsm_px = (_pair(entry[f"{name}_resolution"]) for name in ("map", "dsm"))
        map_origin, dsm_offset = (_pair(entry.get(f"{name}_origin_local", (0.0, 0.0))) for name in ("map", "dsm"))
        picture, heights = scene / str(entry["map_path"]), scene / str(entry["dsm_path"])
    except FileNotFoundError:
        raise TelemetryError(f"{path}: no such file") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TelemetryError(f"{path}: expected modes.{mode} with its map and DSM, got {error!r}") from None
    try:
        surface_m = np.load(heights, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise TelemetryError(f"{heights}: cannot be read: {str(error).splitlines()[0]}") from None
    surface_m = np.asarray(surface_m if surface_m.ndim == 2 else surface_m[..., 0], dtype=np.float32)
    return LocalMap(
        picture=picture,
        pixel_to_m=_affine(map_origin, map_px),
        surface_m=surface_m,
        surface_to_m=_affine(map_origin + dsm_offset, dsm_px),
    )


def _pair(value: Any) -> Array:
    pair = np.asarray(value, dtype=np.float64).reshape(-1)[:2]
    if pair.shape != (2,) or not np.isfinite(pair).all():
        raise ValueError(f"two numbers, not {value!r}")
    return pair


def _affine(origin: Array, step: Array) -> Array:
    """(2, 3) affine transform of pixels, whose local y points south, to east and north."""
    return np.array([[step[0], 0.0, origin[0]], [0.0, -step[1], -origin[1]]])


def read_anyvisloc(path: Path) -> SinglePhoto:
    """Read one sample.

    Raises:
        TelemetryError: it is not of the layout.
        CalibrationError: its intrinsics are invalid.
    """
    arrays = read_arrays(path, ("image", "K", "dist", "xyz", "euler_deg"))
    image = arrays["image"]
    if image.size == 0:
        relative = str(read_arrays(path, ("image_relpath",))["image_relpath"])
        try:
            with Image.open(path.parent / relative) as opened:
                image = np.array(opened.convert("RGB"))
        except OSError as error:
            raise TelemetryError(f"{path.parent / relative}: cannot be read: {error.strerror or error}") from None
    picture = as_rgb_image(image, path, "image")
    east_m, south_m, up_m = (float(v) for v in np.asarray(arrays["xyz"], dtype=np.float64).reshape(3))
    _, pitch_deg, yaw_deg = (float(v) for v in np.asarray(arrays["euler_deg"], dtype=np.float64).reshape(3))
    distortion = np.asarray(arrays["dist"], dtype=np.float64).reshape(-1)
    matrix = np.asarray(arrays["K"], dtype=np.float64)
    return SinglePhoto(
        name=path.stem,
        image=picture,
        camera=Camera(picture.shape[1], picture.shape[0], matrix, distortion=distortion),
        position_m=np.array([east_m, -south_m, up_m]),
        attitude=Attitude(0.0, pitch_deg, yaw_deg),
    )
