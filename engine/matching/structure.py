"""NCC by structure as well as grey levels, in a window whose highest peak by grey levels was refused.

Another season, year or sun changes grey levels and swaps the brighter side of an edge, but not the position and
direction of edges. The surface is the mean over grey levels and both orientation channels
(:func:`engine.kernels.scores.orientation`). With a surface model the frame is drawn over the ground's relief, and
not on a plane, which takes longer; and of it the part that would lie on the map at an assumed place, which may be
another part than that matched before. Null-hypothesis templates, the frame's own upside down and mirrored, measure
in the same window what chance reaches.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engine.kernels.peaks import find_peak
from engine.kernels.scores import enhance, orientation
from engine.kernels.sums import counts, share_on_map
from engine.matching.candidates import PeakCandidate
from engine.matching.correlation import COARSER, MIN_SIDE_PX, MIN_VALID_SHARE, Aligned, Correlator
from engine.matching.peak_evidence import candidate_of
from engine.ncc_fft import ncc
from engine.runtime.device import on_host, to_device
from engine.values import Window
from engine.window import level_crop

FloatImage = NDArray[np.float32]


def match_structure(correlator: Correlator, found: PeakCandidate, around: Correlator) -> PeakCandidate | None:
    """The candidate of the highest peak by grey levels and structure, on the first level where it suffices.

    A map is often blurrier than its pixels: what a coarser level leaves out, it does not show. If none suffices,
    it is that of the own level, where a rival that looks the same scores the same, whatever the pixels' phase.

    Args:
        correlator: of the frame.
        found: the candidate by grey levels, whose hypothesis is examined; the fix names its window.
        around: of the frame with the prior about which the place must stand out.

    Returns:
        PeakCandidate | None: None if the template is nowhere on the map.
    """
    risk, own = correlator.query.risk, _on_level(correlator, found, around, 0)
    if own is not None and own.suffices(risk):
        return own
    alike = 1.0 if own is None else own.evidence.alike
    for coarser in COARSER[1:]:
        seen = _on_level(correlator, found, around, coarser)
        weighed = None if seen is None else seen.weighed(replace(seen.evidence, least_alike=alike))
        if weighed is not None and weighed.suffices(risk):
            return weighed
    return own


def _on_level(
    correlator: Correlator, found: PeakCandidate, around: Correlator, coarser: int
) -> PeakCandidate | None:
    """The candidate out of every place of its window, so many levels above that of the candidate by grey levels.

    Its rival is the better of the best elsewhere and of what chance reaches.
    """
    aligned = _coarser(correlator, found, coarser)
    window = None if aligned is None else around.window(aligned)
    if aligned is None or window is None:
        return None
    scored = _scores(correlator, aligned, window, _templates(correlator, aligned))
    if scored is None:
        return None
    scores, crop = scored
    chance = scores[1:][scores[1:] > -1.0]
    if not chance.size:
        return None
    peak = find_peak(scores[0], exclusion_px=correlator.exclusion_px(aligned.level))
    rival = max(peak.second_score, float(chance.max()))
    if found.by_search and found.peak.score > 0.0:  # only the search knows the rest of the map
        rival = max(rival, found.peak.second_score / found.peak.score * peak.score)
    own = candidate_of(
        correlator,
        aligned,
        replace(peak, x=peak.x + crop.x0, y=peak.y + crop.y0, second_score=rival),
        window,
        is_fitted=found.is_fitted,
        tried=found.evidence.tried * (coarser + 1.0),  # levels as well
        sigma=max(float(chance.std(dtype=np.float64)), 1e-3),
    )
    evidence, fix = replace(own.evidence, is_tested=True), replace(own.fix, window=found.fix.window)
    return replace(own, by_structure=True, evidence=evidence, fix=fix)


def _coarser(correlator: Correlator, found: PeakCandidate, coarser: int) -> Aligned | None:
    """The candidate's hypothesis over the relief, so many levels above its own; None if it shows too little.

    Its own level takes the relief at the prior's place, coarser ones that at the peak's: each may be off.
    """
    own, site = found.aligned, correlator.query.site
    if coarser == 0 and (own.is_over_relief or not site.has_surface):
        return own
    level = own.level + coarser
    if coarser and (level >= site.levels or min(own.template.shape) >> coarser < MIN_SIDE_PX):
        return None
    place = correlator.nadir_px(found.peak, own) if coarser or correlator.query.prior is None else None
    rows, columns = (n >> coarser for n in own.template.shape)
    aligned = correlator.align(own.pose, level, place, (rows, columns) if site.has_surface else None)
    return aligned if isinstance(aligned, Aligned) else None


def _templates(correlator: Correlator, aligned: Aligned) -> FloatImage:
    """Channels (3, T, h, w) of the frame and of the null-hypothesis templates."""
    patches = [aligned.patch.gray, *correlator.nowhere(aligned)]
    return np.stack([_channels(patch, None) for patch in patches], axis=1)


def _scores(
    correlator: Correlator, aligned: Aligned, window: Window, templates: FloatImage
) -> tuple[FloatImage, Window] | None:
    """Scores (T, H', W') of templates by all channels, and where they begin; None if these do not fit."""
    query = correlator.query
    crop = level_crop(query.site, window, aligned.level)
    height, width = aligned.template.shape
    if crop.width_px < width + 2 or crop.height_px < height + 2:
        return None
    gray, mask = query.site.gray(crop, aligned.level), query.site.valid(crop, aligned.level)
    valid = None if mask.all() else mask
    search = _channels(gray, valid)
    scores = on_host(ncc(to_device(search, query.device), to_device(templates, query.device)).mean(0))
    if valid is not None:
        # Nodata is 0 in all channels, near their mean, and so hardly lowers places that are mostly on the map.
        scores[:, share_on_map(counts(valid), height, width) < MIN_VALID_SHARE] = -1.0
    return scores, crop


def _channels(gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None) -> FloatImage:
    """Grey levels and both orientation channels, (3, H, W)."""
    return np.concatenate([enhance(gray, valid=valid)[None], orientation(gray, valid=valid)])
