"""Batched normalised cross-correlation (equation 1): score surfaces, and their peaks coarse to fine.

Convention:
    ``search`` is the crop of the map, ``templates`` the aligned frame under T hypotheses. ``surface[b, t, y, x]``
    is the score with the template's top-left pixel at pixel (x, y) of the crop.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from engine.errors import DtypeError, OptionError, ShapeError
from engine.kernels import coarse_to_fine
from engine.kernels import ncc as kernels
from engine.kernels.peaks import find_peak, peak_of
from engine.kernels.search_levels import Search, prepare
from engine.runtime.device import Picture, as_float, as_tensor, element_type, like, plain
from engine.values import Peak

if TYPE_CHECKING:
    from engine.runtime.tensors import Tensor

__all__ = [
    "Peak",
    "Search",
    "find_peak",
    "match_template",
    "match_templates",
    "ncc",
    "prepare",
    "surface",
    "surfaces",
]

FloatImage = NDArray[np.float32]
Given = TypeVar("Given", NDArray[Any], "Tensor")  # the result has the same kind as the inputs

_TYPES = ("uint8", "int16", "uint16", "int32", "float16", "float32", "float64")
_DOUBLE = ("float64", "int32")  # float32 would round these


def ncc(
    search: Given,
    templates: Given,
    *,
    zero_mean: bool = True,
    search_valid: Given | None = None,
    templates_valid: Given | None = None,
    min_overlap: float = 0.5,
) -> Given:
    """Scores in [-1, 1]: normalised cross-correlation of templates with every position in a window.

    All arguments are tensors, or all are arrays. On the CPU torch is used only for float64.

    Args:
        search: (B, H, W), any of uint8, int16, uint16, int32, float16, float32, float64.
        templates: (B, T, h, w) with h <= H and w <= W, on the same device.
        zero_mean: subtract the means (OpenCV's ``TM_CCOEFF_NORMED``); False is equation 1 (``TM_CCORR_NORMED``).
        search_valid: (B, H, W) bool, or None: all. Invalid pixels are left out of all sums.
        templates_valid: (B, T, h, w) bool, or None: all.
        min_overlap: with masks, positions where less than this share of the template's valid pixels is on valid
            map score -1.

    Returns:
        (B, T, H-h+1, W-w+1), float64 if either input is float64, else float32. A perfect match scores 1, an
        inverted one -1; if patch or template is flat the score is 0, never NaN.

    Raises:
        ShapeError: the shapes do not fit each other.
        DtypeError: an element type is not in the list above, or a mask is not bool.
        OptionError: different devices, NaN or infinity, or masks without ``zero_mean``.
    """
    _check(search, templates)
    types = (element_type(search), element_type(templates))
    if search_valid is not None or templates_valid is not None:
        masks = _mask("search_valid", search, search_valid), _mask("templates_valid", templates, templates_valid)
        if not zero_mean:
            raise OptionError("zero_mean: expected True with masks, got False")
        if not 0.0 < min_overlap <= 1.0:
            raise OptionError(f"min_overlap: expected above 0 and at most 1, got {min_overlap}")
        pictures = plain(search, masks[0], templates, masks[1])
        scores = kernels.masked_ncc_surface(*pictures, min_overlap=min_overlap)
    elif types[0] in _DOUBLE or types[1] in _DOUBLE:
        scores = kernels.ncc_surface(
            *(as_tensor(as_float(v, "float64")) for v in (search, templates)), zero_mean=zero_mean
        )
    else:
        scores = kernels.ncc_surface(
            *plain(as_float(search, "float32"), as_float(templates, "float32")), zero_mean=zero_mean
        )
    found: Given = like(search, as_float(scores, "float64" if "float64" in types else "float32"))
    return found


def _check(search: Picture, templates: Picture) -> None:
    if search.ndim != 3 or 0 in search.shape:
        raise ShapeError(f"search: expected (B, H, W) with no empty axis, got {tuple(search.shape)}")
    if templates.ndim != 4 or 0 in templates.shape:
        raise ShapeError(f"templates: expected (B, T, h, w) with no empty axis, got {tuple(templates.shape)}")
    if search.shape[0] != templates.shape[0]:
        raise ShapeError(f"templates: expected a batch of {search.shape[0]} (search), got {templates.shape[0]}")
    (H, W), (h, w) = search.shape[-2:], templates.shape[-2:]
    if h > H or w > W:
        raise ShapeError(f"templates: expected at most {H} x {W} (search), got {h} x {w}")
    for name, picture in (("search", search), ("templates", templates)):
        if element_type(picture) not in _TYPES:
            raise DtypeError(f"{name}: expected uint8, int16, uint16, int32 or a float, got {picture.dtype}")
    places = ["numpy" if isinstance(v, np.ndarray) else str(v.device) for v in (search, templates)]
    if places[0] != places[1]:
        raise OptionError(f"templates: expected on {places[0]} like search, got {places[1]}")


def _mask(name: str, picture: Picture, mask: Picture | None) -> Picture:
    """The mask, or one that is all True if none was given."""
    if mask is None:
        return (
            np.ones(picture.shape, bool)
            if isinstance(picture, np.ndarray)
            else as_tensor(picture).new_ones(picture.shape).bool()
        )
    if element_type(mask) != "bool":
        raise DtypeError(f"{name}: expected bool, got {mask.dtype}")
    if mask.shape != picture.shape:
        raise ShapeError(f"{name}: expected {tuple(picture.shape)}, got {tuple(mask.shape)}")
    return mask


def surface(search: Search, templates: Given) -> Given:
    """Zero-mean NCC of templates with a prepared part of a map.

    Args:
        search: (H, W) from :func:`prepare`.
        templates: (T, h, w) float32 on the same device, with h <= H and w <= W.

    Returns:
        (T, H-h+1, W-w+1) float32 in [-1, 1].

    Raises:
        ShapeError: the templates are not (T, h, w), are empty, or are larger than the map.
    """
    if templates.ndim != 3 or 0 in templates.shape:
        raise ShapeError(f"templates: expected (T, h, w) with no empty axis, got {tuple(templates.shape)}")
    _check_fit(search, templates)
    return next(surfaces(search, templates, group=templates.shape[0]))


def _check_fit(search: Search, templates: Picture) -> None:
    (H, W), (h, w) = search.image.shape, templates.shape[-2:]
    if h > H or w > W:
        raise ShapeError(f"templates: expected at most {H} x {W} (search), got {h} x {w}")


def surfaces(search: Search, templates: Given, *, group: int) -> Iterator[Given]:
    """Zero-mean NCC, a group of templates at a time, to bound memory for many templates on a large map.

    Args:
        search: (H, W) from :func:`prepare`.
        templates: (T, h, w) float32 on the same device, with h <= H and w <= W.
        group: number of templates per tensor.

    Returns:
        Yields (group, H-h+1, W-w+1) float32; the last group holds the remainder of T.
    """
    inverse_norms = kernels.inverse_norm(search.image, search.sums, *templates.shape[-2:])
    for first in range(0, len(templates), group):
        part = _of_kind(search, templates[first : first + group])
        found = kernels.prepared_surface(search.image, inverse_norms, part - part.mean((-2, -1), keepdims=True))
        yield like(templates, found)


def _of_kind(search: Search, template: Picture) -> Picture:
    """The template as an array if the map is one; else unchanged."""
    return plain(template)[0] if isinstance(search.image, np.ndarray) else template


def match_template(search: Search, template: Picture, *, exclusion_px: float, exhaustive: bool = False) -> Peak:
    """The peak of one template in a prepared part of a map; all its pixels count as valid.

    Coarse to fine, see :mod:`engine.kernels.coarse_to_fine`. If that is not certain, with ``exhaustive``, or off
    the CPU, all positions are scored at full resolution.

    Args:
        search: from :func:`prepare`.
        template: (h, w) float32 on the same device.
        exclusion_px: radius about the peak within which no rival is counted.
        exhaustive: score all positions at full resolution; the peak is then the reference's.

    Returns:
        Peak: as :func:`engine.kernels.peaks.find_peak`; on the CPU without ``exhaustive`` the second score may be
        that of a coarse level.

    Raises:
        ShapeError: the template is not (h, w), is empty, or is larger than the map.
    """
    _check_template(search, template)
    if not isinstance(search.image, np.ndarray):
        return _peaks_on_device([search], [template], exclusion_px)[0]
    (template,) = plain(template)
    if not exhaustive:
        found = coarse_to_fine.peak(search, template, exclusion_px)
        if found is not None:
            return found
    return find_peak(surface(search, template[None])[0], exclusion_px=exclusion_px)


def match_templates(
    searches: Sequence[Search], templates: Sequence[Picture], *, exclusion_px: float
) -> list[Peak]:
    """The peaks of many templates, each in its own part of a map, with one copy from a GPU for all.

    On a GPU pairs of equal shapes are matched in one batch.

    Args:
        searches: from :func:`prepare`, on one device.
        templates: (h, w) float32 each, as many, on the same device.
        exclusion_px: radius about a peak within which no rival is counted.

    Returns:
        The peaks as :func:`match_template` finds them, in the same order.

    Raises:
        ShapeError: there are not as many templates as parts of a map, or one of them does not fit its part.
    """
    if len(searches) != len(templates):
        raise ShapeError(f"templates: expected {len(searches)} (searches), got {len(templates)}")
    for search, template in zip(searches, templates, strict=True):
        _check_template(search, template)
    if not searches or isinstance(searches[0].image, np.ndarray):
        pairs = zip(searches, templates, strict=True)
        return [match_template(search, template, exclusion_px=exclusion_px) for search, template in pairs]
    return _peaks_on_device(searches, templates, exclusion_px)


def _check_template(search: Search, template: Picture) -> None:
    if template.ndim != 2 or 0 in template.shape:
        raise ShapeError(f"template: expected (h, w) with no empty axis, got {tuple(template.shape)}")
    _check_fit(search, template[None])


def _peaks_on_device(searches: Sequence[Search], templates: Sequence[Tensor], exclusion_px: float) -> list[Peak]:
    """:func:`find_peak` of the surfaces, bit for bit; 28 numbers a surface are copied from the device, at once."""
    from engine.kernels.peak_tensors import of_groups

    groups: dict[tuple[tuple[int, ...], tuple[int, ...]], list[int]] = {}
    for index, (search, template) in enumerate(zip(searches, templates, strict=True)):
        groups.setdefault((search.image.shape, template.shape), []).append(index)
    found = of_groups(
        [[(searches[i].image, searches[i].sums, templates[i]) for i in members] for members in groups.values()],
        exclusion_px,
    )
    peaks: dict[int, Peak] = {}
    for (size, shape), members in groups.items():
        width, height = size[1] - shape[1] + 1, size[0] - shape[0] + 1
        for index in members:
            peaks[index] = peak_of(found[len(peaks)], height, width)
    return [peaks[index] for index in range(len(searches))]
