"""The map's features, detected once: 3D points with their descriptors, looked up by window.

A level of the map is described tile by tile as the flight reaches it, or all at once before the flight
(:meth:`LandmarkMap.prepare`), and then cached in a file. A tile is described with the neighbourhood beyond its
edges, so that the tiles together equal the level described in one piece.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from engine.features import Features, chosen_backend, sift
from engine.geo import Array
from engine.maps.landmark_cache import NamedArrays, cache_path, load_arrays, save_arrays
from engine.maps.rasters import COARSE_LIMIT_PX
from engine.maps.recently_used import RecentlyUsed
from engine.maps.tiles import HALO_PX, TILE_PX, tiles_under, widened, within
from engine.runtime.device import Device, Picture, as_float, on_host, to_device
from engine.sift.values import fields_of, ranks_within
from engine.values import Window

if TYPE_CHECKING:  # a map is built on what lies here
    from engine.orthomap import OrthoMap

DETECTOR_VERSION = 4
"""Part of the key of cached landmarks; raise it with every change of detector or descriptor."""
MIN_CONTRAST = 0.005
"""Lowe's contrast threshold: bare ground has little; elsewhere the strongest are taken."""
CELL_PX = 64
"""Landmarks are ranked by strength within square cells of the level."""
MAX_PER_CELL = 96
PREPARED_PX = COARSE_LIMIT_PX
"""Most pixels of levels prepared at once, and of a level that is searched as a whole."""
MAX_LANDMARKS = 1 << 19
"""Landmarks cached in memory, besides those of the last window; one takes 300 bytes.

If more were prepared before the flight, the limit rises to their number, up to 236 MB.
"""
_SLOTS = 8192  # more than the detector finds in a tile
_STORED: dict[str, tuple[type[Any], tuple[int, ...]]] = {  # element type, and shape of one
    "xy_px": (np.float32, (2,)),  # in pixels of the level
    "scale_px": (np.float32, ()),
    "angle_deg": (np.float32, ()),
    "rank": (np.uint8, ()),  # by strength within its cell
    "descriptors": (np.float16, (128,)),  # half the memory, and the same matches
}


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Features of a part of the map.

    Attributes:
        features: batch of one, N slots, in pixels of the level, on the device.
        xy_px: (N, 2) a copy of their positions in host memory.
        points_m: (N, 3) east, north and height of the surface.
    """

    features: Features
    xy_px: NDArray[np.float32]
    points_m: Array


class LandmarkMap:
    """Cache of the landmarks of one map.

    Args:
        site: the map.
        device: of detection and of the returned features, the frame's too; the cache is in host memory.
        backend: of :func:`engine.features.sift`.

    Attributes:
        tiles: described so far; the least recently used are evicted.
    """

    def __init__(self, site: OrthoMap, device: Device, backend: str = "auto") -> None:
        self._site, self.device = site, device
        self._backend = chosen_backend(backend, device)
        self.tiles = RecentlyUsed(self._describe, lambda _, tile: _count(tile), MAX_LANDMARKS)

    def find(self, window: Window, level: int, *, upright: bool, per_px: float = math.inf) -> Landmarks:
        """The landmarks of a window.

        Args:
            window: in pixels of the level, inside it.
            level: of the map's pyramid.
            upright: every angle is 0, along the map's x axis, instead of the dominant gradient's.
            per_px: upper bound on landmarks per pixel; each cell keeps its strongest.

        Returns:
            Landmarks: those whose keypoint is inside the window.
        """
        tiles = self.tiles.get(*self._keys(window, level, upright))
        max_rank = math.ceil(min(per_px * CELL_PX**2, MAX_PER_CELL))
        parts = [(tile, _inside(tile, window, max_rank)) for tile in tiles]
        found = {name: np.concatenate([part[name][i] for part, i in parts]) for name in tiles[0]}
        columns = [found[name] for name in ("xy_px", "scale_px", "angle_deg", "descriptors")]
        xy, scale, angle, descriptors = (to_device(column[None], self.device) for column in columns)
        valid = scale > 0.0  # of every landmark
        features = Features(xy, scale, angle, as_float(descriptors, "float32"), valid)
        return Landmarks(features, found["xy_px"], found["points_m"])

    def prepare(self, levels: Iterable[int] | None = None) -> None:
        """Describe whole levels, upright and not, and cache them in a file if the map comes from one.

        Args:
            levels: in order of preference, up to :data:`PREPARED_PX` in all; None takes all, the coarsest first.
        """
        pixels, usual = 0, self.tiles.limit
        self.tiles.limit = math.inf
        for level in reversed(range(self._site.levels)) if levels is None else levels:
            pixels += math.prod(self._site.level_shape(level))
            if pixels > PREPARED_PX:
                break
            for upright in (True, False):
                self._prepare(level, upright)
        # No more than is prepared now: a large map with few prepared levels keeps the usual limit.
        self.tiles.limit = max(usual, sum(map(_count, self.tiles.values())))

    def _prepare(self, level: int, upright: bool) -> None:
        rows, columns = self._site.level_shape(level)
        whole = Window(0, 0, columns, rows)
        keys = self._keys(whole, level, upright)
        if self._site.open_file is None or all(key in self.tiles for key in keys):
            self.tiles.get(*keys)
            return
        settings = (self._backend, DETECTOR_VERSION, TILE_PX, HALO_PX, CELL_PX, MAX_PER_CELL, upright)
        path = cache_path(settings, (self._site.gray(whole, level), self._site.valid(whole, level)))
        stored = load_arrays(path)
        if stored is None:
            tiles = self.tiles.get(*keys)
            save_arrays(path, {field: np.concatenate([tile[field] for tile in tiles]) for field in _STORED})
            return
        corner = np.rint(stored["xy_px"]).astype(np.int64) // TILE_PX * TILE_PX  # of each one's tile
        for key in keys:
            own = (corner == (key[2].x0, key[2].y0)).all(axis=1)
            self.tiles[key] = self._with_points({field: stored[field][own] for field in _STORED}, level)

    def _keys(self, window: Window, level: int, upright: bool) -> list[tuple[int, bool, Window]]:
        """Level, upright and window of the tiles that a window touches."""
        return [(level, upright, tile) for tile in tiles_under(window, TILE_PX, self._site.level_shape(level))]

    def _describe(self, level: int, upright: bool, own: Window) -> NamedArrays:
        """Every keypoint on a tile, as detected in the whole level."""
        wide = widened(own, HALO_PX, self._site.level_shape(level))
        inner = within(own, wide)
        mask = np.zeros((wide.height_px, wide.width_px), np.bool_)
        mask[inner] = self._site.valid(wide, level)[inner]
        if not mask.any():
            none = {field: np.zeros((0, *shape), dtype) for field, (dtype, shape) in _STORED.items()}
            return self._with_points(none, level)
        found = sift(
            as_picture(self._site.gray(wide, level), self.device),
            max_keypoints=_SLOTS,
            backend=self._backend,
            upright=upright,
            mask=to_device(mask[None, None], self.device),
            contrast_threshold=MIN_CONTRAST,
            spread=1,  # by strength alone; the level's cells spread landmarks
        )
        *all_slots, valid = (on_host(values[0]) for values in fields_of(found))
        positions, scale, angle, descriptors = (values[valid] for values in all_slots)
        xy = positions + np.array([wide.x0, wide.y0], np.float32)
        _, cell = np.unique(np.rint(xy).astype(np.int64) // CELL_PX, axis=0, return_inverse=True)
        rank = ranks_within(cell.ravel())
        kept = np.flatnonzero(rank < MAX_PER_CELL)
        arrays = (xy, scale, angle, rank, descriptors)
        named = zip(_STORED.items(), arrays, strict=True)
        return self._with_points({name: a[kept].astype(kind) for (name, (kind, _)), a in named}, level)

    def _with_points(self, tile: NamedArrays, level: int) -> NamedArrays:
        map_px = self._site.full_from_level(tile["xy_px"], level)
        return tile | {"points_m": self._site.surface_points(map_px)}


def _count(tile: NamedArrays) -> int:
    return len(tile["rank"])


def as_picture(gray: NDArray[np.uint8], device: Device) -> Picture:
    """Grey levels as a batch of one picture for :func:`engine.features.sift`.

    Args:
        gray: (H, W).
        device: of the result.

    Returns:
        (1, 1, H, W) float32 in [0, 1].
    """
    return as_float(to_device(np.ascontiguousarray(gray), device), "float32")[None, None] / 255.0


def _inside(tile: NamedArrays, window: Window, max_rank: int) -> NDArray[np.intp]:
    """Indices of a tile's landmarks in a window, those below a rank."""
    x, y = tile["xy_px"].T
    left, top = window.x0 - 0.5, window.y0 - 0.5
    inside = (x >= left) & (x < left + window.width_px) & (y >= top) & (y < top + window.height_px)
    return np.flatnonzero(inside & (tile["rank"] < max_rank))
