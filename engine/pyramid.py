"""The pyramid of a map: grey and validity at every level, in memory or read window by window."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np

from engine.errors import OptionError
from engine.grids import Array
from engine.rasters import MEMORY_LIMIT_PX, Gray, Mask
from engine.types import Window

Read = Callable[[Window], tuple[Gray, Mask]]

SMALLEST_LEVEL_PX = 16


class Pyramid:
    """Grey and validity at every level: in memory from the first level that is small enough, read below it.

    Args:
        width_px: of level 0.
        height_px: of level 0.
        read: grey and validity (h, w) of a window of level 0.
    """

    def __init__(self, width_px: int, height_px: int, read: Read) -> None:
        self._size, self._read = (height_px, width_px), read
        self.levels = max(1, int(math.log2(max(1.0, min(self._size) / SMALLEST_LEVEL_PX))) + 1)
        self._base = 0
        while self._base < self.levels - 1 and math.prod(self.shape(self._base)) > MEMORY_LIMIT_PX:
            self._base += 1
        self._kept: dict[int, tuple[Gray, Mask]] = {}
        self._last: tuple[tuple[Window, int], tuple[Gray, Mask]] | None = None
        if self._base == 0:
            self._kept[0] = self._streamed(0)

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        if not 0 <= level < self.levels:
            raise OptionError(f"level: expected 0 to {self.levels - 1}, got {level}")
        return self._size[0] >> level, self._size[1] >> level

    def _streamed(self, level: int) -> tuple[Gray, Mask]:
        """A whole level, read in strips so that colour and masks of the file never lie in memory at once."""
        height, width = self.shape(level)
        gray, valid = np.empty((height, width), np.uint8), np.empty((height, width), np.bool_)
        rows = max(1, 1024 >> level)
        for y0 in range(0, height, rows):
            strip = Window(0, y0, width, min(rows, height - y0))
            gray[y0 : y0 + rows], valid[y0 : y0 + rows] = self._from_file(strip, level)
        return gray, valid

    def _from_file(self, window: Window, level: int) -> tuple[Gray, Mask]:
        both = self._read(Window(*(v << level for v in (window.x0, window.y0, window.width_px, window.height_px))))
        for _ in range(level):
            both = _halved(*both)
        return both

    def _level(self, level: int) -> tuple[Gray, Mask]:
        if level not in self._kept:
            at_base = level == self._base
            self._kept[level] = self._streamed(level) if at_base else _halved(*self._level(level - 1))
        return self._kept[level]

    def crop(self, window: Window, level: int) -> tuple[Gray, Mask]:
        """Grey and validity (h, w) of a window in pixels of a level."""
        height, width = self.shape(level)
        x1, y1 = window.x0 + window.width_px, window.y0 + window.height_px
        if not (0 <= window.x0 < x1 <= width and 0 <= window.y0 < y1 <= height):
            raise OptionError(f"window: expected one inside {width} x {height} px of level {level}, got {window}")
        if level >= self._base:
            gray, valid = self._level(level)
            return gray[window.y0 : y1, window.x0 : x1], valid[window.y0 : y1, window.x0 : x1]
        last = self._last
        if last is None or last[0] != (window, level):  # grey and validity are often asked in turn
            last = self._last = ((window, level), self._from_file(window, level))
        return last[1]

    @cached_property
    def nodata_share(self) -> float:
        """Share of the pixels that are not valid, at the finest level in memory."""
        return 1.0 - float(self._level(self._base)[1].mean())

    def valid_at(self, xy_px: Array) -> Mask:
        """Validity (...,) of the nearest pixel at the finest level in memory."""
        height, width = self.shape(self._base)
        x, y = np.moveaxis(xy_px.astype(np.intp) >> self._base, -1, 0)
        return np.asarray(self._level(self._base)[1][np.minimum(y, height - 1), np.minimum(x, width - 1)])


def _halved(gray: Gray, valid: Mask) -> tuple[Gray, Mask]:
    """2 x 2 area averages; valid where all four are. An odd last row or column is left out."""
    import cv2

    height, width = gray.shape[0] // 2, gray.shape[1] // 2
    even = slice(0, 2 * height), slice(0, 2 * width)
    small = cv2.resize(gray[even], (width, height), interpolation=cv2.INTER_AREA)
    all_four = np.asarray(valid[even].reshape(height, 2, width, 2).all(axis=(1, 3)))
    return np.asarray(small, np.uint8), all_four
