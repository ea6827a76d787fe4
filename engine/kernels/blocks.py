"""NCC on the CPU: OpenCV's transforms in blocks that fit the cache, and compiled loops around them.

In float32 OpenCV's transforms take as little as half of MKL's time, and less than ``matchTemplate``'s, which are
mostly in float64. Blocks with weak patches in a window of strong contrast use float64.
"""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.kernels import surface_loops
from engine.kernels.sums import check_finite
from engine.runtime.threads import in_parallel, own_array

FloatImage = NDArray[np.float32]
Spectrum = NDArray[np.floating]  # in the packed order of OpenCV's real transforms
_Block = tuple[tuple[slice, slice], Spectrum]  # where its scores lie, and its transform

# A float32 transform has an error of about 1e-7 of the window's norm in every numerator, which is divided by the
# norm of a patch: if a patch's norm is smaller than the window's by this factor, the transform is in float64.
_FLOAT32_NORM_RATIO = 16.0
# Transforms of longer sides leave the cache, and cost twice as much per pixel.
_CACHED_SIDE = 1152
_MAX_BLOCKS = 16  # into which a surface is divided along one axis
_USES_IPP = hasattr(cv2, "ipp") and bool(cv2.ipp.useIPP())


def ncc_surface(search: FloatImage, templates: FloatImage, *, zero_mean: bool) -> FloatImage:
    """NCC by equation 1.

    Args:
        search: (B, H, W) float32.
        templates: (B, T, h, w) float32.
        zero_mean: subtract the means first.

    Returns:
        (B, T, H-h+1, W-w+1) float32 in [-1, 1]; 0 where patch or template is flat.

    Raises:
        OptionError: NaN or infinity, which show in sums that are needed anyway.
    """
    (B, H, W), (T, h, w) = search.shape, templates.shape[1:]
    windows, pictures = np.ascontiguousarray(search), np.ascontiguousarray(templates)
    out = np.empty((B, T, H - h + 1, W - w + 1), np.float32)

    def one_window(b: int) -> None:
        mean, energy = surface_loops.moments(windows[b], zero_mean)
        models = [surface_loops.unit(template, zero_mean) for template in pictures[b]]
        check_finite("search", math.isfinite(energy))
        check_finite("templates", math.isfinite(sum(energy for _, energy in models)))
        inverse_norms = surface_loops.inverse_norms(windows[b], mean, energy, h, w, zero_mean)
        correlate(out[b], windows[b], mean, inverse_norms, [model for model, _ in models])

    in_parallel(one_window, range(B))
    return out


def inverse_norm(image: FloatImage, h: int, w: int) -> FloatImage:
    """Reciprocal norm about the mean of every patch.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        h: rows of a patch.
        w: columns of a patch.

    Returns:
        (H-h+1, W-w+1) float32, 0 where a patch is flat.
    """
    image = np.ascontiguousarray(image)  # loops over a crop of a larger picture would not be vectorised
    mean, energy = surface_loops.moments(image, False)
    return np.asarray(surface_loops.inverse_norms(image, mean, energy, h, w, True))


def prepared_surface(image: FloatImage, inverse_norms: FloatImage, templates: FloatImage) -> FloatImage:
    """Zero-mean NCC with a picture whose patches' norms are known.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        inverse_norms: (H-h+1, W-w+1) float32, 0 where a patch is flat.
        templates: (T, h, w) float32 of zero mean.

    Returns:
        (T, H-h+1, W-w+1) float32 in [-1, 1].
    """
    image = np.ascontiguousarray(image)  # loops over a crop of a larger picture would not be vectorised
    out = np.empty((len(templates), *inverse_norms.shape), np.float32)
    models = [surface_loops.unit(picture, False)[0] for picture in np.ascontiguousarray(templates)]
    correlate(out, image, 0.0, inverse_norms, models)
    return out


def correlate(
    out: FloatImage, window: FloatImage, mean: float, inverse_norms: FloatImage, models: list[FloatImage]
) -> None:
    """Write the scores of all templates.

    Args:
        out: (T, H-h+1, W-w+1) takes the scores.
        window: (H, W).
        mean: of the window.
        inverse_norms: (H-h+1, W-w+1) reciprocal norm of every patch; 0 makes its score 0.
        models: T templates (h, w) of norm 1, about their means where the scores are.
    """
    (height, width), (h, w) = out.shape[1:], models[0].shape
    (ny, rows), (nx, columns) = _division(height, h), _division(width, w)
    size = (rows, columns)

    def prepared(index: int) -> _Block:
        y, x = index // nx * (rows - h + 1), index % nx * (columns - w + 1)
        part = np.s_[y : y + rows - h + 1, x : x + columns - w + 1]
        return part, _window_spectrum(window[y : y + rows, x : x + columns], mean, size, inverse_norms[part])

    blocks = in_parallel(prepared, range(ny * nx))
    kinds = {spectrum.dtype for _, spectrum in blocks}

    def one_template(t: int) -> None:
        spectra = {kind: _model_spectrum(models[t], size, kind) for kind in kinds}

        def one_block(block: _Block) -> None:
            part, spectrum = block
            _write_scores(out[t][part], spectrum, spectra[spectrum.dtype], inverse_norms[part])

        in_parallel(one_block, blocks)

    in_parallel(one_template, range(len(models)))


@lru_cache(maxsize=1024)
def _division(count: int, model: int) -> tuple[int, int]:
    """Number and side of the blocks along an axis that give ``count`` scores at the least cost."""
    sides = [fast_side(-(-count // n) + model - 1) for n in range(1, _MAX_BLOCKS + 1)]
    costs = [n * side * (1 if side <= _CACHED_SIDE else 2) for n, side in enumerate(sides, 1)]
    best = costs.index(min(costs))
    return -(-count // (sides[best] - model + 1)), sides[best]


def fast_side(n: int) -> int:
    """The next side that is transformed fast: without prime factors above 5, and even, for the packed orders."""
    step = 16 if n >= 64 else 2
    return step * int(cv2.getOptimalDFTSize(-(-n // step)))


def _window_spectrum(
    window: FloatImage, mean: float, size: tuple[int, int], inverse_norms: FloatImage
) -> Spectrum:
    """The transform of a window minus a mean, in float64 if some patch is too weak for float32."""
    values: Spectrum = np.empty(size, np.float32)
    energy = surface_loops.centre(values, window, mean)
    if energy * float(inverse_norms.max()) ** 2 > _FLOAT32_NORM_RATIO**2:
        values = values.astype(np.float64)
    transform(values, 0, window.shape[0])
    return values


def _model_spectrum(model: FloatImage, size: tuple[int, int], kind: np.dtype[np.floating]) -> Spectrum:
    """The transform of a template with zeros beyond it."""
    values = np.zeros(size, kind)
    values[: model.shape[0], : model.shape[1]] = model
    transform(values, 0, len(model))
    return values


def _write_scores(out: FloatImage, block: Spectrum, model: Spectrum, inverse_norms: FloatImage) -> None:
    """Write the scores by the transforms of part of a window and of a template, both of one type."""
    is_kept = max(block.shape) <= _CACHED_SIDE  # a larger one takes longer to transform than fresh pages do
    products = own_array("products", block.shape, block.dtype) if is_kept else np.empty_like(block)
    cv2.mulSpectrums(block, model, 0, products, True)
    transform(products, cv2.DFT_INVERSE, out.shape[0])
    if products.dtype != np.float32:
        products = products[: out.shape[0], : out.shape[1]].astype(np.float32)
    surface_loops.normalise(out, products, inverse_norms, np.float32(1.0 / block.size))


def transform(values: NDArray[np.floating], flags: int, rows: int) -> None:
    """Transform in place.

    If built with IPP, OpenCV passes whole pictures to it; that is three to four times as fast as its own transform
    of a part of the rows.

    Args:
        values: (H, W) float32 or float64.
        flags: of ``cv2.dft``.
        rows: number of rows that are not zero, or for an inverse that are wanted.
    """
    cv2.dft(values, values, flags, 0 if _USES_IPP else rows)
