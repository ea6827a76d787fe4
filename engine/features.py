"""Local features: a batched SIFT that detects, describes and matches arrays, or tensors on any torch device.

The detector is Lowe's: extrema of differences of Gaussians over position and scale, refined by a quadratic.
The descriptor is Lowe's 4 x 4 cells of 8 orientations as RootSIFT: square roots of their shares. On a CPU both are
compiled loops (:mod:`engine.sift.loops`), on a GPU kornia's tensor ops (:mod:`engine.sift.tensors`).

Convention:
    Points are (x, y) with pixel centres at integers and the origin at the centre of the top-left pixel.
    Angles turn from +x towards +y, which is clockwise on the screen. ``scale_px`` is Lowe's: the sigma of the
    finer of the two Gaussians whose difference is extremal; a Gaussian blob of sigma b gives about b / 2^(1/6).

References:
    Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004,
    https://doi.org/10.1023/B:VISI.0000029664.99615.94.
    Arandjelovic and Zisserman, Three things everyone should know to improve object retrieval, CVPR 2012,
    https://doi.org/10.1109/CVPR.2012.6248018 (RootSIFT).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from engine.errors import DtypeError, OptionError, ShapeError
from engine.runtime.device import (
    Device,
    Picture,
    as_float,
    as_tensor,
    device_of,
    element_type,
    on_host,
    same_kind_as,
)
from engine.sift import BACKENDS
from engine.sift.matching import match
from engine.sift.values import Features, Matches, SiftChoice, fields_of

if TYPE_CHECKING:
    from engine.runtime.tensors import torch

_MAX_MAGNITUDE = 1e6  # of a pixel's value
__all__ = ["Features", "Matches", "chosen_backend", "match", "sift"]


def sift(
    images: Picture,
    *,
    max_keypoints: int = 300,
    backend: str = "auto",
    upright: bool = False,
    up_deg: float = 0.0,
    mask: Picture | None = None,
    upsample: int = 2,
    contrast_threshold: float = 0.02,
    spread: int = 6,
) -> Features:
    """Detect and describe at most ``max_keypoints`` SIFT features per image, spread over the image.

    Args:
        images: (B, 1, H, W) floating point, values in [0, 1]: an array, or a tensor on any device.
        max_keypoints: Number of slots N.
        backend: "compiled" loops (CPU) or "kornia" (any device); "auto" takes the first on a CPU, else the second.
        upright: Use ``up_deg`` as every angle instead of the dominant gradient's; faster, for a known heading.
        up_deg: From +x towards +y; the angles of two pictures must differ by the rotation between them.
        mask: (B, 1, H, W) bool, True where keypoints are allowed.
        upsample: Samples per image pixel of the first octave: 1 or 2, kornia only 2. No scale depends on it.
        contrast_threshold: Lowe's, as OpenCV counts it: a keypoint's DoG is at least a third of it.
        spread: Cells along each side of the image; of each cell, keypoints beyond twice its even share rank last.
            1 ranks by strength alone: contrast times the square root of scale.

    Returns:
        Features as arrays or tensors, as the images are, on their device; no value is NaN.

    Raises:
        ShapeError: The images or the mask have another shape.
        DtypeError: The images are not floating point, or the mask is not bool.
        OptionError: An option is out of range, or the backend does not serve the images' device.
    """
    _check_images(images, mask)
    if not math.isfinite(up_deg):
        raise OptionError(f"up_deg: expected a finite number, got {up_deg}")
    up_rad = math.radians(up_deg) if upright else None
    choice = SiftChoice(max_keypoints, up_rad, upsample, contrast_threshold, spread)
    # Sums of values far from [0, 1] may overflow, and the loops use them as indices.
    pictures = as_float(images[:, 0], "float32")
    if chosen_backend(backend, device_of(images)) == "kornia":
        from engine.sift import tensors  # torch takes a while to import

        pictures = as_tensor(pictures).nan_to_num(0.0, 1.0, 0.0).clamp(-_MAX_MAGNITUDE, _MAX_MAGNITUDE)
        found = tensors.find_features(pictures, None if mask is None else as_tensor(mask), choice)
    else:
        from engine.sift import loops  # numba takes a while to import

        pictures = np.nan_to_num(on_host(pictures), nan=0.0, posinf=1.0, neginf=0.0)
        pictures = np.ascontiguousarray(pictures.clip(-_MAX_MAGNITUDE, _MAX_MAGNITUDE))
        found = loops.find_features(pictures, None if mask is None else on_host(mask), choice)
    return Features(*(same_kind_as(images, values) for values in fields_of(found)))


def chosen_backend(backend: str, device: Device | torch.device) -> str:
    """The backend of features on a device.

    Args:
        backend: "auto", "compiled" or "kornia".
        device: of the images.

    Returns:
        "compiled" or "kornia".

    Raises:
        OptionError: it is none of them, or "compiled" on another device than the CPU.
    """
    if backend not in BACKENDS:
        raise OptionError(f"backend: expected one of {', '.join(BACKENDS)}, got {backend!r}")
    if backend == "auto":
        return "compiled" if device.type == "cpu" else "kornia"
    if backend == "compiled" and device.type != "cpu":
        raise OptionError(f"backend: expected auto or kornia for images on {device}, got 'compiled'")
    return backend


def _check_images(images: Picture, mask: Picture | None) -> None:
    if images.ndim != 4 or images.shape[1] != 1 or 0 in images.shape:
        raise ShapeError(f"images: expected (B, 1, H, W), got {tuple(images.shape)}")
    if "float" not in element_type(images):
        raise DtypeError(f"images: expected floating point, got {images.dtype}")
    if mask is not None and mask.shape != images.shape:
        raise ShapeError(f"mask: expected {tuple(images.shape)} as the images, got {tuple(mask.shape)}")
    if mask is not None and element_type(mask) != "bool":
        raise DtypeError(f"mask: expected bool, got {mask.dtype}")
