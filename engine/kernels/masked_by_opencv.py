"""Masked NCC on the CPU: the sums of :mod:`engine.kernels.masked` by OpenCV's transforms, in float64."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.kernels import masked_whole
from engine.kernels.by_opencv import transform
from engine.kernels.transform_sizes import FLAT_SHARE, fast_length

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def ncc_surface(
    search: NDArray[Any], search_valid: Mask, templates: NDArray[Any], templates_valid: Mask, *, min_overlap: float
) -> Array:
    """Zero-mean NCC over the pixels that are valid in both.

    Args:
        search: (B, H, W).
        search_valid: (B, H, W) bool.
        templates: (B, T, h, w).
        templates_valid: (B, T, h, w) bool.
        min_overlap: positions with a smaller share of the template's valid pixels in common score -1.

    Returns:
        (B, T, H-h+1, W-w+1) float64 in [-1, 1].
    """
    (H, W), (h, w) = search.shape[-2:], templates.shape[-2:]
    size = (2 * fast_length(-(-H // 2)), 2 * fast_length(-(-W // 2)))  # even, for the packed order
    out = np.empty((*templates.shape[:2], H - h + 1, W - w + 1))
    for b, (window, valid) in enumerate(zip(search, search_valid, strict=True)):
        if templates_valid[b].all():
            out[b] = masked_whole.surfaces(window, valid, templates[b], min_overlap)
            continue
        of_window = _spectra(window, valid, size)
        for t, (template, shown) in enumerate(zip(templates[b], templates_valid[b], strict=True)):
            least = min_overlap * max(1, int(shown.sum()))
            out[b, t] = _scores(of_window, _spectra(template, shown, size), out.shape[2:], least)
    return out


def _scores(of_window: list[Array], of_template: list[Array], shape: tuple[int, ...], least: float) -> Array:
    """Scores (H', W') by the spectra of both; -1 with fewer than so many pixels in common."""

    def sums(a: Array, b: Array) -> Array:
        product = cv2.mulSpectrums(a, b, 0, conjB=True)
        transform(product, cv2.DFT_INVERSE | cv2.DFT_SCALE, shape[0])
        return np.asarray(product[: shape[0], : shape[1]])

    (m, i, ii), (n, t, tt) = of_window, of_template
    common = np.rint(sums(m, n))  # a count of pixels
    safe = np.maximum(common, 1.0)
    sum_i, sum_t = sums(i, n), sums(m, t)
    spread_i, spread_t = sums(ii, n) - sum_i * sum_i / safe, sums(m, tt) - sum_t * sum_t / safe
    textured = (spread_i > FLAT_SHARE * ii[0, 0]) & (spread_t > FLAT_SHARE * tt[0, 0])
    norms = np.sqrt(spread_i * spread_t, out=np.ones_like(common), where=textured)
    scores = np.clip((sums(i, t) - sum_i * sum_t / safe) / norms, -1.0, 1.0)
    scores[~textured] = 0.0
    scores[common < least] = -1.0
    return np.asarray(scores)


def _spectra(picture: NDArray[Any], valid: Mask, size: tuple[int, int]) -> list[Array]:
    """Packed transforms of the mask, of the picture less its mean, and of its square, all 0 where not valid."""
    height, width = picture.shape
    out = []
    mean = float(picture.mean(dtype=np.float64, where=valid)) if valid.any() else 0.0
    centred = np.where(valid, picture - np.float64(mean), 0.0)
    for values in (valid, centred, centred * centred):
        padded = np.zeros(size)
        padded[:height, :width] = values
        transform(padded, 0, height)
        out.append(padded)
    return out
