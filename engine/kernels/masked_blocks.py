"""Masked NCC on the CPU for whole templates: positions wholly on valid pixels are scored without a mask.

The sums of :mod:`engine.kernels.masked_tensors` are needed only where a template crosses the mask's edge. A
template without a mask needs three of their six correlations; the others are sums over boxes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.kernels.blocks import MAX_BLOCKS, Mask, fast_side, spectrum_of, transform, write_surfaces
from engine.kernels.sums import FLAT_SHARE, box_sum, check_finite, counts, integrals, masked_scores

Array = NDArray[np.float64]

_SMALL_PX = 1 << 17  # windows up to this size are neither split nor scored in two ways


class _Model(NamedTuple):
    """A template about its mean in float64, its sum of squares, and transforms of both that the blocks share."""

    energy: float
    values: NDArray[np.floating]
    squares: NDArray[np.floating]


def ncc_surface(
    search: NDArray[Any], search_valid: Mask, templates: NDArray[Any], *, min_overlap: float
) -> NDArray[Any]:
    """Zero-mean NCC over the valid pixels of windows.

    Args:
        search: (B, H, W).
        search_valid: (B, H, W) bool.
        templates: (B, T, h, w).
        min_overlap: positions where a smaller share of the template lies on valid pixels score -1.

    Returns:
        (B, T, H-h+1, W-w+1) in [-1, 1]: float32 if both pictures are, else float64.

    Raises:
        OptionError: NaN or infinity.
    """
    check_finite("search", bool(np.isfinite(search).all()))
    check_finite("templates", bool(np.isfinite(templates).all()))
    windows = zip(search, search_valid, templates, strict=True)
    return np.stack([_surfaces(*window, min_overlap) for window in windows])


def _surfaces(window: NDArray[Any], valid: Mask, templates: NDArray[Any], min_overlap: float) -> NDArray[Any]:
    """The same of one window.

    Args:
        window: (H, W).
        valid: (H, W) bool.
        templates: (T, h, w).
        min_overlap: positions where a smaller share of the template lies on valid pixels score -1.

    Returns:
        (T, H-h+1, W-w+1) in [-1, 1]: float32 if both pictures are, else float64.
    """
    h, w = templates.shape[1:]
    common = box_sum(counts(valid), h, w)
    is_single = window.dtype == templates.dtype == np.float32
    out = np.zeros((len(templates), *common.shape), np.float32 if is_single else np.float64)
    enough = common >= max(min_overlap * (h * w), 1.0)
    mean = float(window.mean(dtype=np.float64, where=valid)) if valid.any() else 0.0
    asked = enough
    if is_single and window.size > _SMALL_PX:
        whole = common == h * w
        asked = enough & ~whole
        if whole.any():
            centred = np.where(valid, window - np.float64(mean), 0.0).astype(np.float32)
            write_surfaces(out, centred, np.ascontiguousarray(templates), zero_mean=True, asked=whole)
    if asked.any():
        _score_partial(out, (window, valid, mean), templates, asked)
    out[:, ~enough] = -1.0
    return out


def _score_partial(
    out: NDArray[Any], picture: tuple[NDArray[Any], Mask, float], templates: NDArray[Any], asked: Mask
) -> None:
    """Write the scores of the requested places, in float64, block by block; many blocks have none."""
    h, w = templates.shape[1:]
    (rows, columns), corners = _blocks(asked, h, w)
    size = fast_side(rows + h - 1), fast_side(columns + w - 1)
    models = [_model(template, size) for template in templates]
    window, valid, mean = picture
    shown = window[valid] - np.float64(mean)
    floor = FLAT_SHARE * float(np.dot(shown, shown))
    # Kept from block to block: fresh pages of memory cost as much as a transform.
    spectra, products = np.empty((2, *size)), np.empty((3, *size))
    for y, x in corners:
        part = np.s_[y : y + rows, x : x + columns]
        inner = np.s_[y : y + rows + h - 1, x : x + columns + w - 1]
        mask = valid[inner].astype(np.float32)
        values = np.where(valid[inner], window[inner] - np.float64(mean), 0.0)
        at = asked[part]
        total, square = (sums[at] for sums in box_sum(integrals(values), h, w))
        count = box_sum(counts(valid[inner]), h, w)[at]
        spectrum_of(values, spectra[0])
        spectrum_of(mask, spectra[1])
        for t, model in enumerate(models):
            pairs = (spectra[0], model.values), (spectra[1], model.values), (spectra[1], model.squares)
            for product, (one, other) in zip(products, pairs, strict=True):
                cv2.mulSpectrums(one, other, 0, product, True)
                transform(product, cv2.DFT_INVERSE, rows)
            sums = [product[: at.shape[0], : at.shape[1]][at] / product.size for product in products]
            floors = floor, FLAT_SHARE * model.energy
            out[t][part][at] = masked_scores(sums[0], sums[1], sums[2], total, square, count, floors)


def _blocks(asked: Mask, h: int, w: int) -> tuple[tuple[int, int], list[tuple[int, int]]]:
    """Rows and columns of the blocks that cost least, and the corners of those with a place to score."""
    height, width = asked.shape
    sums, best = counts(asked), (np.inf, (height, width), [(0, 0)])
    for n in _divisions(asked.size):
        rows, columns = -(-height // n), -(-width // n)
        y, x = np.arange(0, height, rows), np.arange(0, width, columns)
        below, right = np.minimum(y + rows, height), np.minimum(x + columns, width)
        inside = sums[np.ix_(below, right)] - sums[np.ix_(y, right)] - sums[np.ix_(below, x)] + sums[np.ix_(y, x)]
        j, i = np.nonzero(inside)
        # A block takes two transforms of its pixels and three of products, the template two for all blocks.
        cost = (5 * len(j) + 2) * fast_side(rows + h - 1) * fast_side(columns + w - 1)
        if cost < best[0]:
            best = cost, (rows, columns), list(zip(y[j].tolist(), x[i].tolist(), strict=True))
    return best[1:]


def _divisions(places: int) -> range:
    """Into how many blocks along each axis a surface may be divided."""
    return range(1, MAX_BLOCKS + 1 if places > _SMALL_PX else 2)


def _model(template: NDArray[Any], size: tuple[int, int]) -> _Model:
    values = template.astype(np.float64)
    values -= values[0, 0]  # of one level are exact zeros
    values -= values.mean()
    squares = values * values
    return _Model(float(squares.sum()), *(spectrum_of(part, np.empty(size)) for part in (values, squares)))
