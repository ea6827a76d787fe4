"""The map prepared once for the NCC method: enhanced, with half-resolution levels.

A small level of the map is prepared as a whole, a large one in regions on a fixed grid as the flight reaches them.
The least recently used regions are evicted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from engine.kernels.scores import RADIUS_PX, enhance
from engine.kernels.search_levels import MAX_HALVINGS
from engine.maps.recently_used import RecentlyUsed
from engine.maps.tiles import TILE_PX, WHOLE_LEVEL_PX, cells_under, widened, within
from engine.ncc_fft import MapRegion, prepare
from engine.runtime.device import Device, to_device
from engine.values import Window

if TYPE_CHECKING:  # a map is built on what lies here
    from engine.orthomap import OrthoMap

FloatImage = NDArray[np.float32]

MAX_REGION_PX = WHOLE_LEVEL_PX
"""Regions are kept up to this many pixels in all, besides whole levels; a pixel takes 6 bytes, 11 with nodata,
and on a GPU 20."""


@dataclass(frozen=True, slots=True)
class Region:
    """A prepared part of one pyramid level.

    Attributes:
        window: its extent, in pixels of the level.
        search: prepared pixels that templates are matched against.
        valid: (H, W) bool, False on nodata; None if all pixels are valid.
    """

    window: Window
    search: MapRegion
    valid: NDArray[np.bool_] | None


class PreparedMap:
    """Prepared regions of one map, on one device.

    Args:
        site: the map.
        device: of the regions.

    Attributes:
        regions: prepared so far, by window and level; the least recently used are evicted.
    """

    def __init__(self, site: OrthoMap, device: Device) -> None:
        self._site, self._device = site, device
        self.regions = RecentlyUsed(self._prepare, self._evictable_px, MAX_REGION_PX)

    def cut(self, window: Window, level: int) -> Region:
        """The prepared part of a level that contains a window, cropped to it.

        Args:
            window: in pixels of the level, inside it.
            level: of the map's pyramid.

        Returns:
            Region: begins up to 7 pixels before the window and ends with it.
        """
        step_px = 1 << MAX_HALVINGS  # so that the half-resolution levels fit
        x0, y0 = window.x0 & -step_px, window.y0 & -step_px
        aligned = Window(x0, y0, window.x1 - x0, window.y1 - y0)
        region = self._region(aligned, level)
        i, j = aligned.x0 - region.window.x0, aligned.y0 - region.window.y0
        search = region.search.crop(i, j, aligned.width_px, aligned.height_px)
        part = within(aligned, region.window)
        if region.valid is None or region.valid[part].all():
            return Region(aligned, replace(search, counts=None), None)
        return Region(aligned, search, region.valid[part])

    def _region(self, window: Window, level: int) -> Region:
        """The most recently used region that contains a window, or a new one."""
        held = (key for key in reversed(list(self.regions)) if key[1] == level and _contains(key[0], window))
        key = next(held, None) or (self._to_prepare(window, self._site.level_shape(level)), level)
        return self.regions.get(key)[0]

    @staticmethod
    def _to_prepare(window: Window, shape: tuple[int, int]) -> Window:
        """What to prepare for a window: all of a small level, else whole tiles with half a tile to each side."""
        ahead_px = TILE_PX // 2  # the next windows of a flight fall in the same region
        cells = cells_under(widened(window, ahead_px, shape), shape)
        first, last = cells[0], cells[-1]
        return Window(first.x0, first.y0, last.x1 - first.x0, last.y1 - first.y0)

    def _evictable_px(self, key: tuple[Window, int], _: Region) -> int:
        """Pixels of a region; 0 of a whole level, which stays."""
        window, level = key
        return 0 if (window.height_px, window.width_px) == self._site.level_shape(level) else window.area_px

    def _prepare(self, window: Window, level: int) -> Region:
        picture, mask = enhanced_part(self._site, window, level)
        return Region(window, prepare(to_device(picture, self._device), valid=mask), mask)


def enhanced_part(site: OrthoMap, window: Window, level: int) -> tuple[FloatImage, NDArray[np.bool_] | None]:
    """A window of a level enhanced with the neighbourhood beyond it, so that windows join seamlessly.

    Args:
        site: the map.
        window: in pixels of the level, inside it.
        level: of the map's pyramid.

    Returns:
        (H, W) float32, and (H, W) bool, False on nodata; None if all pixels are valid.
    """
    wide = widened(window, RADIUS_PX + 1, site.level_shape(level))
    gray, mask = site.gray(wide, level), site.valid(wide, level)
    picture = enhance(gray, valid=None if mask.all() else mask)
    inner = within(window, wide)
    own = None if mask[inner].all() else np.ascontiguousarray(mask[inner])
    return np.ascontiguousarray(picture[inner]), own


def _contains(region: Window, window: Window) -> bool:
    across = region.x0 <= window.x0 and window.x1 <= region.x1
    return across and region.y0 <= window.y0 and window.y1 <= region.y1
