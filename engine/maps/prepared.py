"""The map prepared once for the NCC method: enhanced, with half-resolution levels.

A small level of the map is prepared as a whole, a large one in regions on a fixed grid as the flight reaches them.
The least recently used regions are evicted.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from engine.kernels.scores import enhance
from engine.ncc_fft import Search, prepare
from engine.runtime.device import Device, Picture, on_host, placed
from engine.values import Window

if TYPE_CHECKING:  # a map is built on what lies here
    from engine.orthomap import OrthoMap

FloatImage = NDArray[np.float32]

CELL_PX = 256
"""Regions begin and end on multiples of this, and at least half of it beyond the requested window, so that the
next windows of a flight fall in the same region."""
WHOLE_LEVEL_PX = 1 << 23
"""Levels of at most this many pixels are prepared as a whole."""
MAX_REGION_PX = 6 << 20
"""Regions are kept up to this many pixels in all, besides whole levels; a pixel takes 6 bytes, 11 with nodata,
and on a GPU 20."""
_HALVING_PX = 8  # windows begin on multiples of this within a region, so that three half-resolution levels fit


@dataclass(frozen=True, slots=True)
class Region:
    """A prepared part of one pyramid level.

    Attributes:
        window: its extent, in pixels of the level.
        search: prepared pixels that templates are matched against.
        valid: (H, W) bool, False on nodata; None if all pixels are valid.
        mask: the same on the host, to read without waiting for a device.
    """

    window: Window
    search: Search
    valid: Picture | None
    mask: NDArray[np.bool_] | None = None


class PreparedMap:
    """Prepared regions of one map, on one device.

    Args:
        site: the map.
        device: of the regions.
        radius_px: of the local normalisation, see :func:`engine.kernels.scores.enhance`.
        score: see :func:`engine.kernels.scores.enhance`.
    """

    def __init__(self, site: OrthoMap, device: Device, radius_px: int, score: str = "local") -> None:
        self._site, self._device, self._radius_px, self._score = site, device, radius_px, score
        self._regions: OrderedDict[tuple[int, Window], Region] = OrderedDict()  # the most recently used is last
        # Guards the regions, not their preparation: a thread that hangs there must not block others.
        self._lock = threading.Lock()
        self.created = 0
        """Regions prepared so far."""

    def cut(self, window: Window, level: int) -> Region:
        """The prepared part of a level that contains a window, cropped to it.

        Args:
            window: in pixels of the level, inside it.
            level: of the map's pyramid.

        Returns:
            Region: begins up to 7 pixels before the window and ends with it.
        """
        x0, y0 = window.x0 & -_HALVING_PX, window.y0 & -_HALVING_PX
        aligned = Window(x0, y0, window.x0 + window.width_px - x0, window.y0 + window.height_px - y0)
        region = self._region(aligned, level)
        i, j = aligned.x0 - region.window.x0, aligned.y0 - region.window.y0
        search = region.search.crop(i, j, aligned.width_px, aligned.height_px)
        part = np.s_[j : j + aligned.height_px, i : i + aligned.width_px]
        if region.valid is None or region.mask is None or region.mask[part].all():
            return Region(aligned, replace(search, counts=None), None)
        return Region(aligned, search, region.valid[part], region.mask[part])

    def enhanced(self, window: Window, level: int) -> tuple[FloatImage, NDArray[np.bool_] | None]:
        """The enhanced picture of a window, from prepared regions; equals :func:`enhanced_part`.

        Args:
            window: in pixels of the level, inside it.
            level: of the map's pyramid.

        Returns:
            (H, W) float32, and (H, W) bool, False on nodata; None if all pixels are valid.
        """
        region = self.cut(window, level)
        inner = np.s_[window.y0 - region.window.y0 :, window.x0 - region.window.x0 :]
        return on_host(region.search.image)[inner], None if region.mask is None else region.mask[inner]

    def _region(self, window: Window, level: int) -> Region:
        with self._lock:
            region = self._cached(window, level)
        if region is not None:
            return region
        rows, columns = self._site.level_shape(level)
        if rows * columns <= WHOLE_LEVEL_PX:
            target = Window(0, 0, columns, rows)
        else:
            target = _on_grid(window, columns, rows)
        region = self._prepare(target, level)
        with self._lock:
            self.created += 1
            self._regions[level, target] = region
            self._evict()
        return region

    def _cached(self, window: Window, level: int) -> Region | None:
        """The most recently used region that contains a window, now the most recent; or None."""
        for key in reversed(self._regions):
            if key[0] == level and _contains(key[1], window):
                self._regions.move_to_end(key)
                return self._regions[key]
        return None

    def _evict(self) -> None:
        """Evict the least recently used regions down to the limit; the newest and whole levels stay."""
        parts = [
            key for key in self._regions if (key[1].height_px, key[1].width_px) != self._site.level_shape(key[0])
        ]
        used = sum(window.area_px for _, window in parts)
        for key in parts[:-1]:
            if used <= MAX_REGION_PX:
                break
            used -= key[1].area_px
            del self._regions[key]

    def _prepare(self, window: Window, level: int) -> Region:
        picture, mask = enhanced_part(self._site, self._radius_px, self._score, window, level)
        image = placed(picture, self._device)
        if mask is None:
            return Region(window, prepare(image), None)
        return Region(window, prepare(image, valid=mask), placed(mask, self._device), mask)


def enhanced_part(
    site: OrthoMap, radius_px: int, score: str, window: Window, level: int
) -> tuple[FloatImage, NDArray[np.bool_] | None]:
    """A window of a level enhanced with the neighbourhood beyond it, so that windows join seamlessly.

    Args:
        site: the map.
        radius_px: of the local normalisation, see :func:`engine.kernels.scores.enhance`.
        score: see :func:`engine.kernels.scores.enhance`.
        window: in pixels of the level, inside it.
        level: of the map's pyramid.

    Returns:
        (H, W) float32, and (H, W) bool, False on nodata; None if all pixels are valid.
    """
    rows, columns = site.level_shape(level)
    margin = radius_px + 2  # reach of the box, plus one for the gradient and one for the smoothing
    x0, y0 = max(0, window.x0 - margin), max(0, window.y0 - margin)
    x1 = min(columns, window.x0 + window.width_px + margin)
    y1 = min(rows, window.y0 + window.height_px + margin)
    wide = Window(x0, y0, x1 - x0, y1 - y0)
    mask: NDArray[np.bool_] | None = None
    if not site.fully_valid:
        mask = site.valid(wide, level)
        mask = None if mask.all() else mask
    picture = enhance(site.gray(wide, level), radius_px=radius_px, score=score, valid=mask)
    inner = np.s_[
        window.y0 - y0 : window.y0 - y0 + window.height_px, window.x0 - x0 : window.x0 - x0 + window.width_px
    ]
    own = None if mask is None or mask[inner].all() else np.ascontiguousarray(mask[inner])
    return np.ascontiguousarray(picture[inner]), own


def _contains(region: Window, window: Window) -> bool:
    right, bottom = window.x0 + window.width_px, window.y0 + window.height_px
    across = region.x0 <= window.x0 and right <= region.x0 + region.width_px
    return across and region.y0 <= window.y0 and bottom <= region.y0 + region.height_px


def _on_grid(window: Window, columns: int, rows: int) -> Window:
    """The window extended by half a cell to each side, then to whole cells, and clipped at the level's edge."""
    ahead = CELL_PX // 2
    x0, y0 = (max(0, low - ahead) // CELL_PX * CELL_PX for low in (window.x0, window.y0))
    x1 = min(columns, -(-(window.x0 + window.width_px + ahead) // CELL_PX) * CELL_PX)
    y1 = min(rows, -(-(window.y0 + window.height_px + ahead) // CELL_PX) * CELL_PX)
    return Window(x0, y0, x1 - x0, y1 - y0)
