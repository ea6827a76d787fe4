"""The second look of NCC at a window whose highest peak was refused: structure correlated besides grey levels.

Another season, year or sun changes grey levels, and which side of an edge is the brighter one; where edges lie and
which way they run stays. The surface is the mean of that of the grey levels and of both orientation channels
(:func:`engine.scores.orientation`). What chance reaches is measured in the same window by null-hypothesis
templates, the frame's own upside down and mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.coarse_to_fine import WIDE_PX
from engine.device import on_host, placed
from engine.methods.correlation import Aligned, Correlator
from engine.ncc_fft import ncc
from engine.peaks import find_peak
from engine.scores import enhance, orientation
from engine.search_levels import COARSE_TEMPLATE_PX
from engine.values import Peak, Window
from engine.window import level_crop

FloatImage = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class SecondLook:
    """The peak of the second look.

    Attributes:
        peak: in pixels of the aligned level; its rival is the better one of the surface's and of chance's best.
        chance_sigma: one standard deviation of the scores of the null-hypothesis templates in the window.
    """

    peak: Peak
    chance_sigma: float


def on_coarser_level(correlator: Correlator, aligned: Aligned, window: Window) -> Aligned | None:
    """The same hypothesis on the coarsest level on which a wide window is looked at first.

    Args:
        correlator: of the frame.
        aligned: the hypothesis.
        window: in full-resolution map pixels.

    Returns:
        Aligned | None: None where the window is not wide, or the template would be too small.
    """
    if aligned.work_px(window) <= WIDE_PX or correlator.options.exhaustive:
        return None
    for above in (2, 1):
        level = aligned.level + above
        if level < correlator.query.site.levels and min(aligned.template.shape) >> above >= COARSE_TEMPLATE_PX:
            found = correlator.align(aligned.pose, level)
            return found if isinstance(found, Aligned) else None
    return None


def second_look(correlator: Correlator, aligned: Aligned, window: Window) -> SecondLook | None:
    """Correlate grey levels and structure at every place of a window.

    Args:
        correlator: of the frame.
        aligned: the hypothesis that is looked at.
        window: in full-resolution map pixels.

    Returns:
        SecondLook | None: None where the template is nowhere on the map.
    """
    query, options = correlator.query, correlator.options
    crop = level_crop(query.site, window, aligned.level)
    height, width = aligned.template.shape
    if crop.width_px < width + 2 or crop.height_px < height + 2:
        return None
    gray, valid = query.site.gray(crop, aligned.level), None
    if not query.site.fully_valid:
        valid = query.site.valid(crop, aligned.level)
        valid = None if valid.all() else valid
    search = _channels(gray, options.enhance_radius_px, valid)
    patches = [aligned.patch.gray, *correlator.nowhere(aligned)]
    stacked = np.stack([_channels(patch, options.enhance_radius_px, None) for patch in patches], axis=1)
    scores = on_host(ncc(placed(search, query.device), placed(stacked, query.device)).mean(0))
    if valid is not None:
        # Nodata is 0 in all channels, about their mean, and costs places that are mostly on the map little.
        scores[:, _share_on_map(valid, height, width) < options.min_valid_share] = -1.0
    chance = scores[1:][scores[1:] > -1.0]
    if not chance.size:
        return None
    peak = find_peak(
        scores[0], exclusion_px=options.rule.exclusion_m / (query.site.gsd_m_per_px * 2.0**aligned.level)
    )
    peak = replace(
        peak,
        x=peak.x + crop.x0,
        y=peak.y + crop.y0,
        second_score=max(peak.second_score, float(chance.max())),
    )
    return SecondLook(peak, max(float(chance.std(dtype=np.float64)), 1e-3))


def _share_on_map(valid: NDArray[np.bool_], height: int, width: int) -> NDArray[np.float64]:
    """Share of the template's pixels on valid map at every place (H', W')."""
    sums = cv2.integral(valid.astype(np.uint8))
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    return np.asarray(inside / (height * width), np.float64)


def _channels(gray: NDArray[np.uint8], radius_px: int, valid: NDArray[np.bool_] | None) -> FloatImage:
    """Grey levels and both orientation channels, (3, H, W)."""
    return np.concatenate([enhance(gray, radius_px=radius_px, valid=valid)[None], orientation(gray, valid=valid)])
