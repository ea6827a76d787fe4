"""Simulated towns as maps."""

import hashlib
import inspect
import pickle
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from engine import OrthoMap
from scenematch.simulator import FlightPlan, Town, build_town

kept_in: Path | None = None
"""The folder that the workers of a run share."""


def drawn_flight(plan: FlightPlan) -> SimpleNamespace:
    """A planned flight with its pictures: town, camera, frames and truth."""
    frames, truth = list(plan.iter_frames()), plan.truth_rows()
    return SimpleNamespace(town=plan.town, camera=plan.camera, frames=frames, truth=truth)


def drawn_town(*seed: Any, **options: Any) -> Town:
    """What ``build_town`` draws of these arguments, once a process (two seconds): nobody writes into it."""
    bound = inspect.signature(build_town).bind(*seed, **options)
    bound.apply_defaults()
    return _drawn(tuple(bound.arguments.items()))


@cache
def _drawn(options: tuple[tuple[str, Any], ...]) -> Town:
    """A town, kept in a file where the workers of a run share a folder."""
    if kept_in is None:
        return build_town(**dict(options))
    path = kept_in / f"town-{hashlib.sha256(repr(options).encode()).hexdigest()[:16]}.pickle"
    import fcntl  # not on Windows

    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # who comes second waits, and draws nothing
        if not path.exists():
            path.write_bytes(pickle.dumps(build_town(**dict(options))))
    return pickle.loads(path.read_bytes())


def site_of(town, *, surface=True, **said):
    """The map that a simulated town is photographed as, and what it says of its own errors."""
    gray = cv2.cvtColor(town.ortho, cv2.COLOR_RGB2GRAY)
    heights = town.surface_m if surface else None
    return OrthoMap.from_arrays(gray, town.pixel_to_crs, f"EPSG:{town.crs_epsg}", surface_m=heights, **said)


def under_map(town, raster):
    """A raster of a town's world where its map lies, (H, 2, W, 2): four pixels to one of the map's.

    The middle of the map's first pixel is the corner of four.
    """
    first = town.pixel_to_crs[:, 2] - town.world.pixel_to_crs[:, 2]
    corner = np.linalg.inv(town.world.pixel_to_crs[:, :2]) @ first
    np.testing.assert_allclose(corner % 1.0, 0.5, atol=1e-5)
    x, y = np.floor(corner).astype(int)
    height, width = town.surface_m.shape
    return raster[y : y + 2 * height, x : x + 2 * width].reshape(height, 2, width, 2)
