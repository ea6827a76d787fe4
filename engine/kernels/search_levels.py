"""Part of a map prepared for matching: with half-resolution levels, and its nodata counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.errors import DtypeError, ShapeError
from engine.kernels.sums import counts, halved
from engine.runtime.device import Picture, as_arrays, element_type, to_device

# Coarse to fine: templates are halved while they stay at least this wide.
COARSE_TEMPLATE_PX = 48
MAX_HALVINGS = 3


@dataclass(frozen=True, slots=True)
class MapRegion:
    """Part of a map prepared for matching, independent of the frame. Arrays on the CPU, tensors on a GPU.

    Attributes:
        image: (H, W) float32, its mean small against its standard deviation.
        half: the same part at half resolution, whose pixel (x, y) is the mean of 2 x 2 pixels from (2x, 2y);
            None on the coarsest level, and on a GPU.
        sums: (2, H+1, W+1) float64 running sums of the picture and of its square on a GPU; None on the CPU, where
            the sums of a window take one pass.
        counts: (H+1, W+1) int32 running sums of its valid pixels; invalid ones are 0 in the picture. None if all
            are valid, and at half resolution.
    """

    image: Picture
    half: MapRegion | None = None
    sums: Picture = None
    counts: Picture = None

    def crop(self, x0: int, y0: int, width: int, height: int) -> MapRegion:
        """Crop columns [x0, x0 + width) and rows [y0, y0 + height), without a copy.

        The half-resolution level is kept if the crop begins on an even pixel.
        """
        rows, columns = slice(y0, y0 + height), slice(x0, x0 + width)
        half = None
        if self.half is not None and not (x0 & 1 or y0 & 1):
            half = self.half.crop(x0 >> 1, y0 >> 1, width >> 1, height >> 1)
        inner = np.s_[..., y0 : y0 + height + 1, x0 : x0 + width + 1]
        sums = None if self.sums is None else self.sums[inner]
        counts = None if self.counts is None else self.counts[inner]
        return MapRegion(self.image[rows, columns], half, sums, counts)


def prepare(image: Picture, *, halvings: int = MAX_HALVINGS, valid: NDArray[np.bool_] | None = None) -> MapRegion:
    """Compute half-resolution levels, or on a GPU running sums.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        halvings: upper bound on the number of half-resolution levels.
        valid: (H, W); None if all pixels are. The picture is 0 where they are not.

    Returns:
        MapRegion: on the CPU with levels down to 48 x 48 pixels.

    Raises:
        ShapeError: the picture is not (H, W), or is empty.
        DtypeError: it is not float32.
    """
    if image.ndim != 2 or 0 in image.shape:
        raise ShapeError(f"image: expected (H, W) with no empty axis, got {tuple(image.shape)}")
    if element_type(image) != "float32":
        raise DtypeError(f"image: expected float32, got {image.dtype}")
    (image,) = as_arrays(image)
    known = None if valid is None else counts(valid)
    if not isinstance(image, np.ndarray):
        from engine.kernels.tensors import integrals

        known = None if known is None else to_device(known, image.device)
        return MapRegion(image.contiguous(), sums=integrals(image), counts=known)
    image, half = np.ascontiguousarray(image), None
    if halvings > 0 and min(image.shape) >= 2 * COARSE_TEMPLATE_PX:
        half = prepare(halved(image), halvings=halvings - 1)
    return MapRegion(image, half, counts=known)
