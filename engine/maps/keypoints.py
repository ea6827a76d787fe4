"""The map's keypoints by a network: each tile is described once, when the flight reaches it. Lookup by window.

A tile is described with the neighbourhood beyond its edges. A network that normalises over the whole picture, such
as DISK, still describes a tile slightly differently from the whole level.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from engine.learned.keypoints import Keypoints
from engine.learned.matchers import KeypointMatcher
from engine.maps.landmarks import MAX_LANDMARKS, as_picture
from engine.maps.recently_used import RecentlyUsed
from engine.maps.tiles import HALO_PX, RIM_PX, tiles_under, widened
from engine.runtime.device import CPU, as_tensor, on_host
from engine.runtime.tensors import torch
from engine.values import Window

if TYPE_CHECKING:  # avoids an import circle with the map
    from engine.orthomap import OrthoMap

TILE_PX = 512
"""Tiles begin on multiples of this in every level."""
PX_PER_KEYPOINT = 64
"""A tile has at most one keypoint per this many pixels."""


class KeypointMap:
    """Cache of the keypoints of one map.

    Args:
        site: the map.
        matcher: its extractor describes the map.

    Attributes:
        tiles: described so far, by window and level; the least recently used are evicted.
    """

    def __init__(self, site: OrthoMap, matcher: KeypointMatcher) -> None:
        self._site, self._matcher = site, matcher
        self.tiles = RecentlyUsed(self._describe, lambda _, tile: len(tile), MAX_LANDMARKS)  # of up to 520 bytes

    def find(self, window: Window, level: int, count: int) -> Keypoints:
        """The strongest keypoints of a window.

        Args:
            window: in pixels of the level, inside it.
            level: of the map's pyramid.
            count: upper bound on the keypoints; if there are more, every tile keeps the same share of its own.

        Returns:
            Keypoints: in pixels of the window.
        """
        windows = tiles_under(window, TILE_PX, self._site.level_shape(level))
        parts = []
        for tile in self.tiles.get(*((own, level) for own in windows)):
            xy = tile.xy_px - tile.xy_px.new_tensor([window.x0, window.y0])
            last = xy.new_tensor([window.width_px - 1, window.height_px - 1])
            inside = ((xy >= 0.0) & (xy <= last)).all(dim=1)
            parts.append(Keypoints(xy, tile.descriptors).only(inside))
        share = min(1.0, count / max(1, sum(map(len, parts))))
        parts = [part.only(torch.arange(int(share * len(part)), device=part.xy_px.device)) for part in parts]
        return Keypoints(torch.cat([p.xy_px for p in parts]), torch.cat([p.descriptors for p in parts]))

    def _describe(self, tile: Window, level: int) -> Keypoints:
        """The keypoints of a tile, in pixels of the level."""
        wide = widened(tile, HALO_PX, self._site.level_shape(level))
        picture = as_tensor(as_picture(self._site.gray(wide, level), CPU))
        found = self._matcher.extract(picture, math.ceil(wide.area_px / PX_PER_KEYPOINT))
        xy = found.xy_px + found.xy_px.new_tensor([wide.x0, wide.y0])
        low, size = xy.new_tensor([tile.x0, tile.y0]), xy.new_tensor([tile.width_px, tile.height_px])
        own = ((xy >= low - 0.5) & (xy < low + size - 0.5)).all(dim=1) & self._on_data(found, wide, level)
        return Keypoints(xy, found.descriptors).only(own)

    def _on_data(self, found: Keypoints, wide: Window, level: int) -> torch.Tensor:
        """Which keypoints (N,) of a window lie on the map's data and not at its edge."""
        near = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
        solid = cv2.erode(self._site.valid(wide, level).astype(np.uint8), near) > 0
        x, y = np.clip(on_host(found.xy_px.round().long()), 0, [wide.width_px - 1, wide.height_px - 1]).T
        return torch.from_numpy(solid[y, x]).to(found.xy_px.device)
