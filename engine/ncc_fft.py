"""Batched normalised cross-correlation (equation 1): score surfaces, and their peaks coarse to fine.

Convention:
    ``search`` is the crop of the map, ``templates`` the aligned frame under T hypotheses. ``surface[b, t, y, x]``
    is the score with the template's top-left pixel at pixel (x, y) of the crop.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from engine.device import Picture, as_float, as_tensor, element_type, like, plain
from engine.errors import DtypeError, OptionError, ShapeError
from engine.kernels import ncc as kernels
from engine.peaks import FAR, NEAR, best_positions, find_peak, fit_summit, peak_of
from engine.values import Peak

if TYPE_CHECKING:
    from engine.tensors import Tensor

FloatImage = NDArray[np.float32]
Given = TypeVar("Given", NDArray[Any], "Tensor")  # answers are of the kind of what is asked about

_TYPES = ("uint8", "int16", "uint16", "int32", "float16", "float32", "float64")
_DOUBLE = ("float64", "int32")  # float32 would round these

# Coarse to fine: templates are halved while they stay at least this wide and the window is large enough.
_COARSE_TEMPLATE_PX = 48
_MIN_HALVED_PX = 128 * 128
_CANDIDATES = 6
_SEPARATION_PX = 2  # of candidates, on the coarsest level
_MAX_HALVINGS = 3
_UPHILL_STEPS = 4  # within the reach of one LocalScores


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

    All arguments are tensors, or all are arrays. What is on the CPU is computed without torch, but for float64.

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
        inverted one -1; where patch or template is flat the score is 0, never NaN.

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
            raise OptionError("zero_mean: expected True where masks are given, got False")
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
    """A mask, all True where none was given."""
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


@dataclass(frozen=True, slots=True)
class Search:
    """Part of a map prepared for matching: what does not depend on the frame. Arrays on the CPU, tensors on a GPU.

    Attributes:
        image: (H, W) float32, its mean small against its standard deviation.
        sums: (2, H+1, W+1) float64 running sums of the picture and of its square.
        half: the same part at half resolution, whose pixel (x, y) is the mean of 2 x 2 pixels from (2x, 2y);
            None on the coarsest level.
    """

    image: Picture
    sums: Picture
    half: Search | None = None

    def crop(self, x0: int, y0: int, width: int, height: int) -> Search:
        """Crop columns [x0, x0 + width) and rows [y0, y0 + height), without a copy.

        The half-resolution level is kept where the crop begins on an even pixel.
        """
        rows, columns = slice(y0, y0 + height), slice(x0, x0 + width)
        half = None
        if self.half is not None and not (x0 & 1 or y0 & 1):
            half = self.half.crop(x0 >> 1, y0 >> 1, width >> 1, height >> 1)
        return Search(self.image[rows, columns], self.sums[:, y0 : y0 + height + 1, x0 : x0 + width + 1], half)


def prepare(image: Picture, *, halvings: int = _MAX_HALVINGS) -> Search:
    """Compute running sums and half-resolution levels.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        halvings: upper bound on the number of half-resolution levels.

    Returns:
        Search: with integral images (2, H+1, W+1) float64, and levels down to 48 x 48 pixels.

    Raises:
        ShapeError: the picture is not (H, W), or is empty.
        DtypeError: it is not float32.
    """
    if image.ndim != 2 or 0 in image.shape:
        raise ShapeError(f"image: expected (H, W) with no empty axis, got {tuple(image.shape)}")
    if element_type(image) != "float32":
        raise DtypeError(f"image: expected float32, got {image.dtype}")
    (image,) = plain(image)
    image = np.ascontiguousarray(image) if isinstance(image, np.ndarray) else image.contiguous()
    half = None
    if halvings > 0 and min(image.shape) >= 2 * _COARSE_TEMPLATE_PX:
        half = prepare(kernels.halved(image), halvings=halvings - 1)
    return Search(image, kernels.integrals(image), half)


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
    """Zero-mean NCC for a group of templates at a time, which bounds the memory of many templates on a large map.

    Args:
        search: (H, W) from :func:`prepare`.
        templates: (T, h, w) float32 on the same device, with h <= H and w <= W.
        group: number of templates per tensor.

    Returns:
        Yields (group, H-h+1, W-w+1) float32, the last one with the remainder of T.
    """
    inverse_norms = kernels.inverse_norm(search.sums, *templates.shape[-2:])
    for first in range(0, len(templates), group):
        part = _of_kind(search, templates[first : first + group])
        found = kernels.prepared_surface(search.image, inverse_norms, part - part.mean((-2, -1), keepdims=True))
        yield like(templates, found)


def _of_kind(search: Search, template: Picture) -> Picture:
    """A template as an array where the map is one; else as it is."""
    return plain(template)[0] if isinstance(search.image, np.ndarray) else template


def match_template(search: Search, template: Picture, *, exclusion_px: float, exhaustive: bool = False) -> Peak:
    """The peak of one template in a prepared part of a map.

    Coarse to fine: all positions are scored at reduced resolution, the best few at full resolution. The error of
    the coarse scores is bounded by twice the largest error at the refined positions, and by at least what a match
    between coarse pixels loses. Where that bound does not exclude every other position, and with ``exhaustive`` or
    on another device than the CPU, all positions are scored at full resolution.

    Args:
        search: from :func:`prepare`.
        template: (h, w) float32 on the same device.
        exclusion_px: radius about the peak within which no rival is counted.
        exhaustive: score all positions at full resolution; the peak is then the reference's.

    Returns:
        Peak: as :func:`engine.peaks.find_peak`; on the CPU without ``exhaustive`` the second score may be that of
        a coarse level.

    Raises:
        ShapeError: the template is not (h, w), is empty, or is larger than the map.
    """
    _check_template(search, template)
    if not isinstance(search.image, np.ndarray):
        return _peaks_on_device([search], [template], exclusion_px)[0]
    (template,) = plain(template)
    if not exhaustive:
        found = _coarse_to_fine(search, template, exclusion_px)
        if found is not None:
            return found
    return find_peak(surface(search, template[None])[0], exclusion_px=exclusion_px)


def match_templates(
    searches: Sequence[Search], templates: Sequence[Picture], *, exclusion_px: float
) -> list[Peak]:
    """The peaks of many templates, each in its own part of a map: one copy from a GPU for all of them.

    On a GPU pairs of equal shapes are matched at once.

    Args:
        searches: from :func:`prepare`, on one device.
        templates: (h, w) float32 each, as many, on the same device.
        exclusion_px: radius about a peak within which no rival is counted.

    Returns:
        Those of :func:`match_template`, in the same order.

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
    from engine.kernels.summits import of_groups

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


def _coarse_to_fine(search: Search, template: FloatImage, exclusion_px: float) -> Peak | None:
    """The peak by way of the half-resolution levels, or None where their errors do not exclude other positions."""
    levels = [(search, template - template.mean())]
    while True:
        part, model = levels[-1]
        (H, W), (h, w) = part.image.shape, model.shape
        if len(levels) > _MAX_HALVINGS or part.half is None or min(h, w) < 2 * _COARSE_TEMPLATE_PX:
            break
        if H * W < _MIN_HALVED_PX or min(H - h, W - w) < 16:
            break
        levels.append((part.half, kernels.halved(model)))
    if len(levels) == 1:
        return None  # nothing to gain
    (coarse, model), scale = levels[-1], 2 ** (len(levels) - 1)
    inverse_norms = kernels.inverse_norm(coarse.sums, *model.shape)
    scores = kernels.prepared_surface(coarse.image, inverse_norms, model[None])[0]
    candidates = best_positions(scores, _SEPARATION_PX, _CANDIDATES + 1)
    loss = _phase_loss(levels[-2][1], model)
    best: Peak | None = None
    error, peaks = 0.0, []
    for index, (x, y, score) in enumerate(candidates):
        if best is not None and score + error < best.score:
            break  # candidates are in falling order: none of the rest can win
        if index == _CANDIDATES:
            return None
        found = _refined(levels, scores, x, y)
        if found is None:
            return None
        peaks.append(found)
        best = found if best is None or found.score > best.score else best
        error = max(error, 2.0 * abs(found.score - score) + 0.01, loss * best.score + 0.01)
    assert best is not None  # a surface has a maximum
    rivals = [
        (found, candidate)
        for found, candidate in zip(peaks, candidates, strict=False)
        if math.hypot(found.x - best.x, found.y - best.y) > exclusion_px
    ]
    rest = _coarse_rest(scores, [candidate for _, candidate in rivals], scale, best, exclusion_px)
    return replace(best, second_score=max([rest, *(found.score for found, _ in rivals)]))


def _phase_loss(fine: FloatImage, coarse: FloatImage) -> float:
    """What a perfect match loses on the coarser of two levels where it is between that level's pixels."""
    between = kernels.halved(fine[1:, 1:]).ravel()
    model = coarse[: (fine.shape[0] - 1) // 2, : (fine.shape[1] - 1) // 2].ravel()
    norm = math.sqrt(float(np.dot(between, between)) * float(np.dot(model, model)))
    return 1.0 - float(np.dot(between, model)) / norm if norm > 0.0 else 1.0


def _coarse_rest(
    scores: FloatImage, rivals: list[tuple[int, int, float]], scale: int, best: Peak, exclusion_px: float
) -> float:
    """The best coarse score outside the peak's exclusion zone and away from the refined rivals."""
    remaining, r = scores.copy(), _SEPARATION_PX
    for x, y, _ in rivals:
        remaining[max(0, y - r) : y + r + 1, max(0, x - r) : x + r + 1] = -1.0
    down, across = (
        np.square(np.arange(n) * scale - at) for n, at in zip(remaining.shape, (best.y, best.x), strict=True)
    )
    remaining[down[:, None] + across <= exclusion_px**2] = -1.0
    return float(remaining.max())


def _refined(levels: list[tuple[Search, FloatImage]], scores: FloatImage, x: int, y: int) -> Peak | None:
    """A coarse position at full resolution; None where the ascent reaches the window's edge or its last step."""
    if not (0 < y < scores.shape[0] - 1 and 0 < x < scores.shape[1] - 1):
        return None
    (part, model), scale = levels[0], 2 ** (len(levels) - 1)
    dx, dy, _ = fit_summit(scores[y - 1 : y + 2, x - 1 : x + 2].astype(np.float64))
    y, x = round(scale * (y + dy)), round(scale * (x + dx))
    scorer = kernels.LocalScores(part.image, part.sums, model, (y, x))
    for uphill in range(_UPHILL_STEPS + 1):
        if uphill == _UPHILL_STEPS or not all(2 <= v <= n - 2 for v, n in zip((y, x), scorer.limits, strict=True)):
            return None
        around = scorer.at(y + NEAR[0], x + NEAR[1]).reshape(3, 3)
        best = int(around.argmax())
        if best == 4:
            break
        y, x = y + best // 3 - 1, x + best % 3 - 1
    wide = np.zeros((5, 5))
    wide[1:4, 1:4] = around
    wide[FAR[0] + 2, FAR[1] + 2] = scorer.at(y + FAR[0], x + FAR[1])
    dx, dy, curvature = fit_summit(wide)
    return Peak(x + dx, y + dy, float(around[1, 1]), -1.0, curvature)
