"""Batched normalised cross-correlation (equation 1): score surfaces, and their peaks coarse to fine.

Convention:
    ``search`` is the crop of the map, ``templates`` the aligned frame under T hypotheses. ``surface[b, t, y, x]``
    is the score with the template's top-left pixel at pixel (x, y) of the crop.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from engine.errors import DtypeError, OptionError, ShapeError
from engine.kernels import coarse_to_fine
from engine.kernels.peaks import find_peak
from engine.kernels.search_levels import MapRegion, prepare
from engine.kernels.sums import over_nodata, share_on_map
from engine.runtime.device import Picture, as_arrays, as_float, as_tensor, element_type, same_kind_as
from engine.values import Peak

if TYPE_CHECKING:
    from engine.runtime.tensors import Tensor

__all__ = ["MapRegion", "Peak", "find_peak", "match_template", "ncc", "prepare", "surface", "surfaces"]

FloatImage = NDArray[np.float32]
Given = TypeVar("Given", NDArray[Any], "Tensor")  # the result has the same kind as the inputs

_TYPES = ("uint8", "int16", "uint16", "int32", "float16", "float32", "float64")
_DOUBLE = ("float64", "int32")  # float32 would round these


def ncc(search: Given, templates: Given, *, zero_mean: bool = True) -> Given:
    """Scores in [-1, 1]: normalised cross-correlation of templates with every position in a window.

    All arguments are tensors, or all are arrays. On the CPU torch is used only for float64 and int32.

    Args:
        search: (B, H, W), any of uint8, int16, uint16, int32, float16, float32, float64.
        templates: (B, T, h, w) with h <= H and w <= W, on the same device.
        zero_mean: subtract the means (OpenCV's ``TM_CCOEFF_NORMED``); False is the paper's equation 1 as it
            stands (``TM_CCORR_NORMED``).

    Returns:
        (B, T, H-h+1, W-w+1), float64 if either input is float64, else float32. A perfect match scores 1; with
        ``zero_mean`` an inverted one -1 and a flat patch or template 0, without it one that is 0 throughout.
        Never NaN.

    Raises:
        ShapeError: the shapes do not fit each other.
        DtypeError: an element type is not in the list above.
        OptionError: different devices, NaN or infinity.
    """
    _check(search, templates)
    types = (element_type(search), element_type(templates))
    if types[0] in _DOUBLE or types[1] in _DOUBLE:
        pictures = [as_tensor(as_float(v, "float64")) for v in (search, templates)]
    else:
        pictures = as_arrays(*(as_float(v, "float32") for v in (search, templates)))
    scores = _kernels(pictures[0]).ncc_surface(*pictures, zero_mean=zero_mean)
    found: Given = same_kind_as(search, as_float(scores, "float64" if "float64" in types else "float32"))
    return found


def _check(search: Picture, templates: Picture) -> None:
    if search.ndim != 3 or 0 in search.shape:
        raise ShapeError(f"search: expected (B, H, W) with no empty axis, got {tuple(search.shape)}")
    if templates.ndim != 4 or 0 in templates.shape:
        raise ShapeError(f"templates: expected (B, T, h, w) with no empty axis, got {tuple(templates.shape)}")
    if search.shape[0] != templates.shape[0]:
        raise ShapeError(f"templates: expected a batch of {search.shape[0]} (search), got {templates.shape[0]}")
    _check_size(search, templates)
    for name, picture in (("search", search), ("templates", templates)):
        if element_type(picture) not in _TYPES:
            raise DtypeError(f"{name}: expected uint8, int16, uint16, int32 or a float, got {picture.dtype}")
    places = ["numpy" if isinstance(v, np.ndarray) else str(v.device) for v in (search, templates)]
    if places[0] != places[1]:
        raise OptionError(f"templates: expected on {places[0]} like search, got {places[1]}")


def _kernels(picture: Picture) -> Any:
    """The kernels of arrays, or those of tensors; torch and numba take a while to import."""
    if isinstance(picture, np.ndarray):
        from engine.kernels import blocks

        return blocks
    from engine.kernels import tensors

    return tensors


def surface(search: MapRegion, templates: Given, *, min_overlap: float = 0.0) -> Given:
    """Zero-mean NCC of templates with a prepared part of a map.

    Args:
        search: (H, W) from :func:`prepare`.
        templates: (T, h, w) float32 on the same device, with h <= H and w <= W.
        min_overlap: positions where a smaller share of a template lies on valid pixels score -1.

    Returns:
        (T, H-h+1, W-w+1) float32 in [-1, 1].

    Raises:
        ShapeError: the templates are not (T, h, w), are empty, or are larger than the map.
    """
    _check_prepared(search, templates)
    return next(surfaces(search, templates, group=templates.shape[0], min_overlap=min_overlap))


def _check_prepared(search: MapRegion, templates: Picture) -> None:
    if templates.ndim != 3 or 0 in templates.shape:
        raise ShapeError(f"templates: expected (T, h, w) with no empty axis, got {tuple(templates.shape)}")
    _check_size(search.image, templates)


def _check_size(search: Picture, templates: Picture) -> None:
    (H, W), (h, w) = search.shape[-2:], templates.shape[-2:]
    if h > H or w > W:
        raise ShapeError(f"templates: expected at most {H} x {W} (search), got {h} x {w}")


def surfaces(search: MapRegion, templates: Given, *, group: int, min_overlap: float = 0.0) -> Iterator[Given]:
    """Zero-mean NCC, a group of templates at a time, to bound memory for many templates on a large map.

    Args:
        search: (H, W) from :func:`prepare`.
        templates: (T, h, w) float32 on the same device, with h <= H and w <= W.
        group: number of templates per tensor.
        min_overlap: see :func:`surface`.

    Returns:
        Yields (group, H-h+1, W-w+1) float32; the last group holds the remainder of T.
    """
    kernels, (h, w), off = _kernels(search.image), templates.shape[-2:], None
    inverse_norms = kernels.inverse_norm(search.image if search.sums is None else search.sums, h, w)
    if search.counts is not None:
        inverse_norms, off = over_nodata(inverse_norms, share_on_map(search.counts, h, w), min_overlap)
    for first in range(0, len(templates), group):
        part = same_kind_as(search.image, templates[first : first + group])
        found = kernels.prepared_surface(search.image, inverse_norms, part - part.mean((-2, -1), keepdims=True))
        yield same_kind_as(templates, found if off is None else found + off)


def match_template(
    search: MapRegion,
    template: Picture,
    *,
    exclusion_px: float,
    exhaustive: bool = False,
    min_overlap: float = 0.0,
) -> Peak:
    """The peak of one template in a prepared part of a map.

    Coarse to fine, see :mod:`engine.kernels.coarse_to_fine`. If that is not certain, with ``exhaustive``, or off
    the CPU, all positions are scored at full resolution.

    Args:
        search: from :func:`prepare`.
        template: (h, w) float32 on the same device.
        exclusion_px: radius about the peak within which no rival is counted.
        exhaustive: score all positions at full resolution; the peak is then the reference's.
        min_overlap: see :func:`surface`.

    Returns:
        Peak: as :func:`engine.kernels.peaks.find_peak`; on the CPU without ``exhaustive`` the second score may be
        that of a coarse level.

    Raises:
        ShapeError: the template is not (h, w), is empty, or is larger than the map.
    """
    _check_prepared(search, template[None])
    if isinstance(search.image, np.ndarray) and not exhaustive:
        own = same_kind_as(search.image, template)
        found = coarse_to_fine.peak(search, own, exclusion_px, min_overlap=min_overlap)
        if found is not None:
            return found
    return find_peak(surface(search, template[None], min_overlap=min_overlap)[0], exclusion_px=exclusion_px)
