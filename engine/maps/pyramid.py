"""The pyramid of a map: grey and validity at every level, in memory or read window by window."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from engine.errors import DtypeError, OptionError, ShapeError
from engine.kernels.sums import halved
from engine.maps.grids import Array
from engine.maps.rasters import BLOCK_PX, COARSE_LIMIT_PX, Gray, GrayReader, Mask, is_large
from engine.values import Window

MIN_LEVEL_PX = 16


def check_arrays(gray: Gray, valid: Mask, heights: NDArray[np.float32] | None) -> None:
    """Refuse arrays that do not form a map.

    Args:
        gray: (H, W) uint8.
        valid: (H, W) bool.
        heights: (H, W), or None.

    Raises:
        ShapeError: an array has another shape.
        DtypeError: ``gray`` is not uint8.
    """
    if gray.ndim != 2 or 0 in gray.shape:
        raise ShapeError(f"gray: expected (H, W) with at least one pixel, got {gray.shape}")
    if gray.dtype != np.uint8:
        raise DtypeError(f"gray: expected uint8, got {gray.dtype}")
    for name, array in (("valid", valid), ("surface_m", heights)):
        if array is not None and array.shape != gray.shape:
            raise ShapeError(f"{name}: expected the shape of gray {gray.shape}, got {array.shape}")


class Pyramid:
    """Grey and validity at every level; a large map's fine levels are read from the file, all others in memory.

    Args:
        width_px: of level 0.
        height_px: of level 0.
        pixels: reads the file, or grey and validity of level 0 in memory.
    """

    def __init__(self, width_px: int, height_px: int, pixels: GrayReader | tuple[Gray, Mask]) -> None:
        self._size = (height_px, width_px)
        self.levels = max(1, int(math.log2(max(1.0, min(self._size) / MIN_LEVEL_PX))) + 1)
        self._file = None if isinstance(pixels, tuple) else pixels
        self._cached = {0: pixels} if isinstance(pixels, tuple) else {}
        self.is_large = self._file is not None and is_large(width_px * height_px)
        """Whether it is too large for memory."""
        areas_px = [math.prod(self.shape(level)) for level in range(self.levels - 1)]
        # The finest level in memory: 0, or that after all which are too large.
        self._base = sum(area_px > COARSE_LIMIT_PX for area_px in areas_px) if self.is_large else 0
        self._last: tuple[tuple[Window, int], tuple[Gray, Mask]] | None = None
        if self._base == 0:
            self._level(0)

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        if not 0 <= level < self.levels:
            raise OptionError(f"level: expected 0 to {self.levels - 1}, got {level}")
        return self._size[0] >> level, self._size[1] >> level

    def _level(self, level: int) -> tuple[Gray, Mask]:
        if level not in self._cached:
            at_base = level == self._base
            self._cached[level] = self._streamed(level) if at_base else _halved(*self._level(level - 1))
        return self._cached[level]

    def _streamed(self, level: int) -> tuple[Gray, Mask]:
        """A whole level, read in strips to keep the file's colour and masks out of memory."""
        height, width = self.shape(level)
        gray, valid = np.empty((height, width), np.uint8), np.empty((height, width), np.bool_)
        for y0 in range(0, height, BLOCK_PX):
            strip = Window(0, y0, width, min(BLOCK_PX, height - y0))
            gray[strip.slices], valid[strip.slices] = self._from_file(strip, level)
        return gray, valid

    def _from_file(self, window: Window, level: int) -> tuple[Gray, Mask]:
        assert self._file is not None  # all of a map without a file is in memory
        return self._file.read(window, level)

    def crop(self, window: Window, level: int) -> tuple[Gray, Mask]:
        """Grey and validity of a window.

        Args:
            window: in pixels of the level.
            level: of the pyramid.

        Returns:
            (h, w) uint8 grey and (h, w) bool validity; views if the level is in memory.

        Raises:
            OptionError: the window is empty or not inside, or there is no such level.
        """
        height, width = self.shape(level)
        if not (0 <= window.x0 < window.x1 <= width and 0 <= window.y0 < window.y1 <= height):
            raise OptionError(f"window: expected one inside {width} x {height} px of level {level}, got {window}")
        if level >= self._base:
            gray, valid = self._level(level)
            return gray[window.slices], valid[window.slices]
        last = self._last
        if last is None or last[0] != (window, level):  # grey and validity are often read in turn
            last = self._last = ((window, level), self._from_file(window, level))
        return last[1]

    @cached_property
    def nodata_share(self) -> float:
        """Share of the pixels that are not valid, at the finest level in memory."""
        return 1.0 - float(self._level(self._base)[1].mean())

    def valid_at(self, xy_px: Array) -> Mask:
        """Validity at the nearest pixels of the finest level in memory.

        Args:
            xy_px: (..., 2) pixels of level 0, not negative.

        Returns:
            (...,) bool.
        """
        height, width = self.shape(self._base)
        x, y = np.moveaxis(xy_px.astype(np.intp) >> self._base, -1, 0)
        return np.asarray(self._level(self._base)[1][np.minimum(y, height - 1), np.minimum(x, width - 1)])

    def innermost_px(self) -> Array:
        """The valid pixel that is farthest from any nodata.

        Returns:
            (2,) pixels of level 0.
        """
        import cv2

        valid = np.pad(self._level(self._base)[1].astype(np.uint8), 1)
        inside = cv2.distanceTransform(valid, cv2.DIST_L2, 3)[1:-1, 1:-1]
        y, x = np.unravel_index(int(np.argmax(inside)), inside.shape)
        return (np.array([x, y]) + 0.5) * 2.0**self._base - 0.5


def _halved(gray: Gray, valid: Mask) -> tuple[Gray, Mask]:
    """2 x 2 area averages, valid if all four are. An odd last row or column is left out."""
    small = halved(gray)
    height, width = small.shape
    return small, np.asarray(valid[: 2 * height, : 2 * width].reshape(height, 2, width, 2).all(axis=(1, 3)))
