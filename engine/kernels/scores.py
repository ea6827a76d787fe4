"""What is correlated: grey levels by the paper's "enhance" step, and structure."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import OptionError
from engine.kernels.sums import MIDDLE_GREY

FloatImage = NDArray[np.float32]

RADIUS_PX = 8
"""Of the local normalisation: neighbourhoods are boxes of 2 x 8 + 1 pixels."""
MAX_RADIUS_PX = (math.isqrt(np.iinfo(np.int32).max // MIDDLE_GREY**2) - 1) // 2
"""Of the largest neighbourhood whose sum of squares fits into the compiled loop's int32."""
# Added to the local variance, in squared grey levels, so that sensor noise on flat ground is not amplified.
_NOISE_VARIANCE = 4.0

_EDGE_SCALE_PX, _STRUCTURE_SCALE_PX = 1.0, 1.5  # of the gradients, and of the structure tensor
_STRUCTURE_NOISE = 20.0  # squared grey levels, so that sensor noise on flat ground has no orientation


def enhance(
    gray: NDArray[np.uint8], *, radius_px: int = RADIUS_PX, valid: NDArray[np.bool_] | None = None
) -> FloatImage:
    """The paper's "enhance" step, the same for frame and map: robust to shadows, haze and exposure.

    Each pixel less its neighbourhood's mean, over its standard deviation. The picture is first smoothed by the
    binomial 1-2-1, since aliasing of sampled edges biases correlation peaks towards whole pixels.

    Args:
        gray: (H, W).
        radius_px: neighbourhoods are boxes of 2 radius_px + 1 pixels; at most :data:`MAX_RADIUS_PX`.
        valid: (H, W) bool; pixels where it is False are ignored and 0 in the result.

    Returns:
        (H, W) float32.

    Raises:
        OptionError: the radius is out of range.
    """
    if not 1 <= radius_px <= MAX_RADIUS_PX:
        raise OptionError(f"radius_px: expected 1 to {MAX_RADIUS_PX}, got {radius_px}")
    if valid is not None:
        return _normalised(gray, valid.astype(np.float32), radius_px)
    from engine.kernels.local_normalisation import normalised  # numba takes a while to import

    smooth = cv2.GaussianBlur(gray, (3, 3), 0)
    padded = cv2.copyMakeBorder(smooth, *(radius_px,) * 4, cv2.BORDER_REFLECT_101)
    return np.asarray(normalised(padded, radius_px, _NOISE_VARIANCE), np.float32)


def orientation(gray: NDArray[np.uint8], *, valid: NDArray[np.bool_] | None = None) -> FloatImage:
    """Which way edges run, and how clearly, as two channels: cosine and sine of the doubled angle.

    The structure tensor's deviation from isotropy, smoothed, over its mean strength in the neighbourhood. An edge
    whose sides swap their tones has the same orientation.

    Args:
        gray: (H, W).
        valid: (H, W) bool; the result is 0 where it is False.

    Returns:
        (2, H, W) float32.

    References:
        Granlund, In search of a general picture processing operator, CGIP 1978 (the doubled angle).
    """
    smooth = cv2.GaussianBlur(gray, (5, 5), _EDGE_SCALE_PX)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, i, 1 - i, ksize=3) for i in (1, 0))
    weight = None if valid is None else cv2.erode(valid.astype(np.float32), np.ones((5, 5), np.uint8))
    sine = cv2.multiply(across, down, scale=2.0)
    cv2.multiply(across, across, dst=across)
    cv2.multiply(down, down, dst=down)
    parts = [cv2.subtract(across, down), sine, cv2.add(across, down)]
    if weight is not None:
        parts = [part * weight for part in parts]
    cosine, sine, strength = (cv2.GaussianBlur(part, (7, 7), _STRUCTURE_SCALE_PX) for part in parts)
    box = (2 * RADIUS_PX + 1, 2 * RADIUS_PX + 1)
    size = cv2.sqrt(cv2.multiply(strength, cv2.blur(strength, box)))
    size += _STRUCTURE_NOISE
    found = np.stack([cv2.divide(part, size) for part in (cosine, sine)])
    return found if weight is None else found * weight


def _normalised(gray: NDArray[np.uint8], weight: FloatImage, radius_px: int) -> FloatImage:
    """The picture smoothed by 1-2-1, less its neighbourhood's mean, over its standard deviation, all weighted."""
    share = np.maximum(cv2.GaussianBlur(weight, (3, 3), 0), 1e-6)
    picture = cv2.GaussianBlur(gray * weight, (3, 3), 0) / share
    box = (2 * radius_px + 1, 2 * radius_px + 1)
    share = np.maximum(cv2.blur(weight, box), 1e-6)
    mean = cv2.blur(picture * weight, box) / share
    square = cv2.blur(picture * picture * weight, box) / share
    # In place: on a patch of 228 x 228 pixels an allocation takes longer than the arithmetic.
    square -= mean * mean
    np.maximum(square, 0.0, out=square)
    square += _NOISE_VARIANCE
    normal = np.subtract(picture, mean, out=mean)
    normal /= np.sqrt(square, out=square)
    return np.asarray(normal * weight, np.float32)
