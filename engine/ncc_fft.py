"""Batched normalised cross-correlation (equation 1): surfaces, and the peaks on them.

Convention:
    ``search`` is the crop of the map, ``templates`` the aligned frame under T hypotheses. ``surface[b, t, y, x]``
    belongs to the template's top-left pixel lying on pixel (x, y) of the crop.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from engine import kernels
from engine.errors import DtypeError, OptionError, ShapeError
from engine.types import Peak

_DTYPES = (torch.uint8, torch.int16, torch.uint16, torch.int32, torch.float16, torch.float32, torch.float64)
_DOUBLE = (torch.float64, torch.int32, torch.uint16)  # float32 holds these too, but not squares near their ends


def ncc(search: Tensor, templates: Tensor, *, zero_mean: bool = True) -> Tensor:
    """Values in [-1, 1]: normalised cross-correlation of templates with every place of a window.

    Args:
        search: (B, H, W), any of uint8, int16, uint16, int32, float16, float32, float64.
        templates: (B, T, h, w) with h <= H and w <= W, on the same device.
        zero_mean: take the means off first (OpenCV's ``TM_CCOEFF_NORMED``); otherwise the paper's equation 1
            as it stands (``TM_CCORR_NORMED``).

    Returns:
        (B, T, H-h+1, W-w+1), float64 if either input is float64, else float32. A perfect match scores 1, an
        inverted one -1; where patch or template is flat the score is 0, never NaN.

    Raises:
        ShapeError: the shapes do not fit each other.
        DtypeError: an element type is not in the list above.
        OptionError: the tensors live on different devices, or hold NaN or infinity.
    """
    _check(search, templates)
    double = torch.float64 in (search.dtype, templates.dtype)
    work = torch.float64 if double else torch.float32
    if {search.dtype, templates.dtype} & set(_DOUBLE):
        scores = kernels.ncc_surface(search.double(), templates.double(), zero_mean=zero_mean)
    else:
        scores = kernels.ncc_surface(search.float(), templates.float(), zero_mean=zero_mean)
    return scores.to(work)


def _check(search: Tensor, templates: Tensor) -> None:
    if search.ndim != 3 or 0 in search.shape:
        raise ShapeError(f"search: expected (B, H, W) with no empty axis, got {tuple(search.shape)}")
    if templates.ndim != 4 or 0 in templates.shape:
        raise ShapeError(f"templates: expected (B, T, h, w) with no empty axis, got {tuple(templates.shape)}")
    if search.shape[0] != templates.shape[0]:
        raise ShapeError(
            f"templates: expected a batch of {search.shape[0]} as in search, got {templates.shape[0]}"
        )
    (H, W), (h, w) = search.shape[-2:], templates.shape[-2:]
    if h > H or w > W:
        raise ShapeError(f"templates: expected at most {H} x {W} (search), got {h} x {w}")
    for name, tensor in (("search", search), ("templates", templates)):
        if tensor.dtype not in _DTYPES:
            raise DtypeError(f"{name}: expected uint8, int16, uint16, int32 or a float, got {tensor.dtype}")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise OptionError(f"{name}: expected finite values, got NaN or infinity")
    if search.device != templates.device:
        raise OptionError(f"templates: expected on {search.device} like search, got {templates.device}")


def find_peak(surface: Tensor, *, exclusion_px: float) -> Peak:
    """The highest place of one surface (T, H', W'), refined below the pixel, with its best rival.

    Args:
        surface: scores of T hypotheses; the peak is the highest over all of them.
        exclusion_px: rivals nearer than this to the peak, under any hypothesis, are the peak itself.

    Returns:
        Peak: (x, y) by the least-squares quadratic of the 3 x 3 neighbourhood, never further than half a pixel
        from the best whole pixel; unrefined on the border of the surface.
    """
    if surface.ndim != 3 or 0 in surface.shape:
        raise ShapeError(f"surface: expected (T, H, W) with no empty axis, got {tuple(surface.shape)}")
    _, height, width = surface.shape
    index = int(surface.argmax())
    t, y, x = index // (height * width), index // width % height, index % width
    score = float(surface[t, y, x])
    dx, dy, curvature = 0.0, 0.0, np.zeros((2, 2))
    if 0 < x < width - 1 and 0 < y < height - 1:
        patch = surface[t, y - 1 : y + 2, x - 1 : x + 2].double().cpu().numpy()
        dx, dy, curvature = fit_quadratic(patch)
    return Peak(x + dx, y + dy, score, _second_score(surface, x, y, exclusion_px), curvature, t)


def _second_score(surface: Tensor, x: int, y: int, exclusion_px: float) -> float:
    """The best score outside a disc about the peak: the four strips around the disc's box, then its corners."""
    best = surface.amax(dim=0)
    height, width = best.shape
    r = int(exclusion_px)
    x0, x1, y0, y1 = max(0, x - r), min(width, x + r + 1), max(0, y - r), min(height, y + r + 1)
    outside = [best[:y0], best[y1:], best[y0:y1, :x0], best[y0:y1, x1:]]
    box = best[y0:y1, x0:x1]
    rows = torch.arange(y0, y1, device=best.device)[:, None] - y
    columns = torch.arange(x0, x1, device=best.device)[None, :] - x
    outside.append(box[rows * rows + columns * columns > exclusion_px * exclusion_px])
    return max((float(part.max()) for part in outside if part.numel()), default=-1.0)


# Least squares of a + b x + c y + d x^2 + e x y + f y^2 over the 3 x 3 neighbourhood; rows give b, c, d, e, f.
_Y, _X = (g.ravel().astype(float) for g in np.mgrid[-1:2, -1:2])
_QUADRATIC = np.linalg.pinv(np.stack([np.ones(9), _X, _Y, _X * _X, _X * _Y, _Y * _Y], axis=1))[1:]


def fit_quadratic(patch: NDArray[np.float64]) -> tuple[float, float, NDArray[np.float64]]:
    """Offset (dx, dy) of the summit of a 3 x 3 patch from its centre, and its (2, 2) second derivatives."""
    b, c, d, e, f = _QUADRATIC @ patch.ravel()
    curvature = np.array([[2 * d, e], [e, 2 * f]])
    if d >= 0 or f >= 0 or 4 * d * f <= e * e:  # not a summit: a ridge or a saddle
        return 0.0, 0.0, curvature
    dx, dy = np.clip(-np.linalg.solve(curvature, [b, c]), -0.5, 0.5)
    return float(dx), float(dy), curvature
