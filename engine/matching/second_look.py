"""NCC's second look at a window whose highest peak was refused: correlate structure as well as grey levels.

Another season, year or sun changes grey levels and swaps the brighter side of an edge, but not the position and
direction of edges. The surface is the mean over grey levels and both orientation channels
(:func:`engine.kernels.scores.orientation`). Null-hypothesis templates, the frame's own upside down and mirrored,
measure in the same window what chance reaches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.kernels.coarse_to_fine import WIDE_PX
from engine.kernels.peaks import best_positions, find_peak
from engine.kernels.scores import enhance, orientation
from engine.kernels.search_levels import COARSE_TEMPLATE_PX
from engine.kernels.sums import counts, counts_inside
from engine.matching.correlation import Aligned, Correlator
from engine.matching.peak_evidence import PeakCandidate, candidate_of
from engine.ncc_fft import ncc
from engine.runtime.device import on_host, placed
from engine.values import Peak, Window
from engine.window import level_crop

FloatImage = NDArray[np.float32]

_PLACES, _APART_PX = 48, 2  # places of a coarser level to examine closely, and their spacing there
_NEAR_PX, _ABOUT_PX = 8, 32  # around such a place, and around the best one, in pixels of the hypothesis' level


@dataclass(frozen=True, slots=True)
class SecondLook:
    """The peak of the second look.

    Attributes:
        peak: in pixels of the aligned level; its rival is the better of the surface's and of chance's best.
        chance_sigma: one standard deviation of the scores of the null-hypothesis templates in the window.
    """

    peak: Peak
    chance_sigma: float


def can_look_coarsely(correlator: Correlator, aligned: Aligned, window: Window) -> bool:
    """Whether a window is wide and scored on the CPU, so that coarser levels save work."""
    is_on_cpu = correlator.query.device.type == "cpu"
    return is_on_cpu and aligned.work_px(window) > WIDE_PX and not correlator.options.exhaustive


def hopeful_look(correlator: Correlator, aligned: Aligned, window: Window) -> SecondLook | None:
    """The best that a second look at a wide window can show, from the best places of a coarser level.

    The coarser level's best places are examined on the hypothesis' own. The rival is at most the whole window's,
    and chance is measured around the best place.

    Args:
        correlator: of the frame.
        aligned: the hypothesis.
        window: in full-resolution map pixels.

    Returns:
        SecondLook | None: None if every place has to be scored.
    """
    coarse = _on_coarser_level(correlator, aligned, window)
    if coarse is None:
        return None
    scored = _scores(correlator, coarse, window, _templates(correlator, coarse, null=False))
    if scored is None:
        return None
    own = _templates(correlator, aligned, null=False)
    site, (scores, crop) = correlator.query.site, scored
    found: list[tuple[Peak, NDArray[np.float64]]] = []
    for x, y, _ in best_positions(scores[0], _APART_PX, _PLACES):
        nadir = site.full_from_level(np.array([x + crop.x0, y + crop.y0]) - coarse.patch.offset_px, coarse.level)
        peak = _peak_of(correlator, aligned, correlator.near(aligned, nadir, _NEAR_PX << aligned.level), own)
        if peak is not None:
            found.append((peak, nadir))
    if not found:
        return None
    best, nadir = max(found, key=lambda pair: pair[0].score)
    about = second_look(correlator, aligned, correlator.near(aligned, nadir, _ABOUT_PX << aligned.level))
    if about is None:
        return None
    exclusion_px = correlator.exclusion_px(aligned.level)
    rivals = [p.score for p, _ in found if np.hypot(p.x - best.x, p.y - best.y) > exclusion_px]
    second = max([about.peak.second_score, *rivals])
    return SecondLook(replace(about.peak, second_score=second), about.chance_sigma)


def _on_coarser_level(correlator: Correlator, aligned: Aligned, window: Window) -> Aligned | None:
    """The same hypothesis on the coarsest usable level; None if there is none."""
    for above in (2, 1):
        level = aligned.level + above
        if level < correlator.query.site.levels and min(aligned.template.shape) >> above >= COARSE_TEMPLATE_PX:
            found = correlator.align(aligned.pose, level)
            return found if isinstance(found, Aligned) else None
    return None


def _peak_of(correlator: Correlator, aligned: Aligned, window: Window, own: FloatImage) -> Peak | None:
    """The peak of the frame's own template, without what chance reaches; None if it is nowhere on the map."""
    scored = _scores(correlator, aligned, window, own)
    if scored is None or scored[0].max() <= -1.0:
        return None
    (scores, crop), exclusion_px = scored, float(max(scored[0].shape))
    peak = find_peak(scores[0], exclusion_px=exclusion_px)
    return replace(peak, x=peak.x + crop.x0, y=peak.y + crop.y0)


def second_look(correlator: Correlator, aligned: Aligned, window: Window) -> SecondLook | None:
    """Correlate grey levels and structure at every place of a window.

    Args:
        correlator: of the frame.
        aligned: the hypothesis to examine.
        window: in full-resolution map pixels.

    Returns:
        SecondLook | None: None if the template is nowhere on the map.
    """
    scored = _scores(correlator, aligned, window, _templates(correlator, aligned, null=True))
    if scored is None:
        return None
    scores, crop = scored
    chance = scores[1:][scores[1:] > -1.0]
    if not chance.size:
        return None
    peak = find_peak(scores[0], exclusion_px=correlator.exclusion_px(aligned.level))
    peak = replace(
        peak,
        x=peak.x + crop.x0,
        y=peak.y + crop.y0,
        second_score=max(peak.second_score, float(chance.max())),
    )
    return SecondLook(peak, max(float(chance.std(dtype=np.float64)), 1e-3))


def _templates(correlator: Correlator, aligned: Aligned, *, null: bool) -> FloatImage:
    """Channels (3, T, h, w) of the frame, and of the null-hypothesis templates if requested."""
    patches = [aligned.patch.gray, *(correlator.nowhere(aligned) if null else [])]
    radius_px = correlator.options.enhance_radius_px
    return np.stack([_channels(patch, radius_px, None) for patch in patches], axis=1)


def _scores(
    correlator: Correlator, aligned: Aligned, window: Window, templates: FloatImage
) -> tuple[FloatImage, Window] | None:
    """Scores (T, H', W') of templates by all channels, and where they begin; None if these do not fit."""
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
    scores = on_host(ncc(placed(search, query.device), placed(templates, query.device)).mean(0))
    if valid is not None:
        # Nodata is 0 in all channels, near their mean, and so hardly lowers places that are mostly on the map.
        scores[:, _share_on_map(valid, height, width) < options.min_valid_share] = -1.0
    return scores, crop


def _share_on_map(valid: NDArray[np.bool_], height: int, width: int) -> NDArray[np.float64]:
    """Share of the template's pixels on valid map at every place (H', W')."""
    return np.asarray(counts_inside(counts(valid), height, width) / (height * width), np.float64)


def _channels(gray: NDArray[np.uint8], radius_px: int, valid: NDArray[np.bool_] | None) -> FloatImage:
    """Grey levels and both orientation channels, (3, H, W)."""
    return np.concatenate([enhance(gray, radius_px=radius_px, valid=valid)[None], orientation(gray, valid=valid)])


def confirmed(correlator: Correlator, found: PeakCandidate, looked: SecondLook, window: Window) -> PeakCandidate:
    """The candidate that the peak of a second look gives.

    Args:
        correlator: of the frame.
        found: the candidate of the first look.
        looked: the second look.
        window: the window of the second look.
    """
    peak = looked.peak
    if not found.is_tested and found.peak.score > 0.0:  # only the search knows the rest of the map
        elsewhere = found.peak.second_score / found.peak.score * peak.score
        peak = replace(peak, second_score=max(peak.second_score, elsewhere))
    own = candidate_of(
        correlator, found.aligned, peak, window,
        searched=found.searched, tried=found.evidence.tried, sigma=looked.chance_sigma, is_tested=True,
    )  # fmt: skip
    return replace(own, fix=replace(own.fix, window=found.fix.window))
