"""Sums and 2 x 2 means of a picture, computed once on the CPU by OpenCV, and what nodata does to scores."""

from __future__ import annotations

from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError
from engine.runtime.device import Picture, as_float

Number = TypeVar("Number", np.float32, np.uint8)

# Sums of squares about a mean below this share of the whole picture's are rounding: there a patch is flat.
FLAT_SHARE = 1e-12
MIDDLE_GREY = 128
"""Of uint8; levels are counted from it, so that sums of squares lose fewer digits."""


def halved(image: NDArray[Number]) -> NDArray[Number]:
    """Means of 2 x 2 pixels.

    Args:
        image: (H, W) float32 or uint8; an odd last row or column is left out.

    Returns:
        (H // 2, W // 2) of the same type.
    """
    height, width = image.shape[0] & ~1, image.shape[1] & ~1
    size = (width // 2, height // 2)
    return np.asarray(cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA), image.dtype)


def check_finite(name: str, is_finite: bool) -> None:
    """Raise OptionError if the values of the argument of this name are not all finite."""
    if not is_finite:
        raise OptionError(f"{name}: expected finite values, got NaN or infinity")


def counts(valid: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Running sums of the valid pixels of a mask.

    Args:
        valid: (H, W).

    Returns:
        (H+1, W+1) int32; the first row and column are 0.
    """
    return np.asarray(cv2.integral(np.ascontiguousarray(valid).view(np.uint8)))


def box_sum(running: Picture, h: int, w: int) -> Picture:
    """Sums over every patch.

    Args:
        running: (..., H+1, W+1) running sums, such as :func:`counts`, or a crop of a larger picture's.
        h: rows of a patch.
        w: columns of a patch.

    Returns:
        (..., H-h+1, W-w+1) of the same type.
    """
    sums = running[..., h:, w:] - running[..., :-h, w:]
    sums -= running[..., h:, :-w]
    sums += running[..., :-h, :-w]
    return sums


def share_on_map(counts: Picture, h: int, w: int) -> Picture:
    """Share (H-h+1, W-w+1) float32 of every patch's pixels that is valid, from running sums of these."""
    return as_float(box_sum(counts, h, w), "float32") / (h * w)


def over_nodata(inverse_norms: Picture, share: Picture, min_overlap: float) -> tuple[Picture, Picture]:
    """What takes nodata out of the scores of a picture that is 0 there.

    Zeros add nothing to the sum of products nor to the patch's norm, but the template keeps its whole norm: if its
    contrast is spread evenly, a share s of it on the map scores less by the root of s.

    Args:
        inverse_norms: (H', W') float32 reciprocal norms of the patches.
        share: (H', W') float32 of the template's pixels that lie on the map.
        min_overlap: positions with a smaller share score -1.

    Returns:
        The norms to score by, and what to add to the scores: -1 where too little of the template lies on the map.
    """
    is_on = as_float((share > 0.0) & (share >= min_overlap), "float32")
    return inverse_norms * is_on / share.clip(FLAT_SHARE) ** 0.5, is_on - 1.0
