"""Sums and 2 x 2 means of a picture, computed once on the CPU by OpenCV, and scores from sums."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError
from engine.runtime.device import Picture

# Sums of squares about a mean below this share of the whole picture's are rounding: there a patch is flat.
FLAT_SHARE = 1e-12
MIDDLE_GREY = 128
"""Of uint8; levels are counted from it, so that sums of squares lose fewer digits."""


def integrals(image: NDArray[Any]) -> NDArray[np.float64]:
    """Integral images of pictures and of their squares.

    Args:
        image: (..., H, W) float32 or float64.

    Returns:
        (2, ..., H+1, W+1) float64 running sums; the first row and column are 0.
    """
    *batch, height, width = image.shape
    sums, squares = both = np.empty((2, *batch, height + 1, width + 1))
    for at in np.ndindex(*batch):
        cv2.integral2(np.ascontiguousarray(image[at]), sums[at], squares[at], cv2.CV_64F, cv2.CV_64F)
    return both


def halved(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of 2 x 2 pixels.

    Args:
        image: (H, W) float32; an odd last row or column is left out.

    Returns:
        (H // 2, W // 2) float32.
    """
    height, width = image.shape[0] & ~1, image.shape[1] & ~1
    size = (width // 2, height // 2)
    return np.asarray(cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA), np.float32)


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


def masked_scores(
    products: Picture,
    of_model: Picture,
    of_squares: Picture,
    total: Picture,
    square: Picture,
    count: Picture,
    floors: tuple[Picture, Picture],
) -> Picture:
    """Correlation coefficients over valid pixels, from sums over them.

    Args:
        products: (...) float64 sums of the picture's products with the template, both about some mean.
        of_model: of the template.
        of_squares: of its squares.
        total: of the picture.
        square: of its squares.
        count: number of valid pixels.
        floors: sums of squares of picture and template that are rounding.

    Returns:
        (...) float64 in [-1, 1]; 0 where picture or template is flat.
    """
    count = count.clip(1)
    spread, model_spread = square - total * total / count, of_squares - of_model * of_model / count
    textured = (spread > floors[0]) & (model_spread > floors[1])
    norm = (spread * model_spread * textured + ~textured) ** 0.5
    return ((products - total * of_model / count) / norm * textured).clip(-1.0, 1.0)
