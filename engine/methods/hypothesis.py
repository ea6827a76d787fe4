"""One hypothesis of the NCC method: the frame laid on the map by its height and heading, and correlated there."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from engine.align import MIN_SHRINK, GroundView, Patch, check_score, enhance, rectify, view_of
from engine.errors import OptionError
from engine.indexes.prepared import PreparedMap, Region
from engine.integrity import AssumedErrors, PeakRule
from engine.methods.query import Query, level_crop
from engine.ncc_fft import match_template, ncc
from engine.peaks import find_peak
from engine.values import Frame, NoFix, Peak, Reason, Window

Array = NDArray[np.float64]

METHOD = "ncc"
_GROUND_SHARE = 0.3  # of the height: as far about the middle of a frame its ground is taken for a plane
_SPREAD_SIGMAS = 2.0  # and as far as this, where its place is less certain


@dataclass(frozen=True, slots=True, kw_only=True)
class NccOptions:
    """Settings of the NCC method.

    Attributes:
        margin: the 1.3 of equations 4 and 5.
        fraction: the rectified patch's size against the frame's.
        score: what is correlated: "grey", "local", "gradient" or "mixed", see ``docs/scores.md``.
        enhance_radius_px: neighbourhood of the local normalisation; 0 leaves it out. "grey" has none.
        min_valid_share: a place counts only where this share of the patch lies on map that is not nodata.
        exhaustive: score every place of the window at full resolution.
        heading_search_deg: the frame's heading may be off by this much; 0 trusts it, 180 searches all around,
            also where the frame has none.
        height_search_share: the height may be off by this share; 0 trusts it.
        refine: refine the pose densely after the peak, where heading and height are trusted.
        rule: when a peak is believed.
        errors: what is assumed of the telemetry and the map.
    """

    margin: float = 1.3
    fraction: float = 0.7
    score: str = "local"
    enhance_radius_px: int = 8
    min_valid_share: float = 0.9
    exhaustive: bool = False
    heading_search_deg: float = 0.0
    height_search_share: float = 0.0
    refine: bool = True
    rule: PeakRule = field(default_factory=PeakRule)
    errors: AssumedErrors = field(default_factory=AssumedErrors)

    def __post_init__(self) -> None:
        if math.isinf(self.margin):
            raise OptionError(f"margin: expected a finite number, got {self.margin}")
        if not self.margin >= 1.0:
            raise OptionError(f"margin: expected 1 or more, got {self.margin}")
        for name in ("fraction", "min_valid_share"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise OptionError(f"{name}: expected above 0 and at most 1, got {getattr(self, name)}")
        for name, limit in (("heading_search_deg", 180.0), ("height_search_share", 0.5)):
            if not 0.0 <= getattr(self, name) <= limit:
                raise OptionError(f"{name}: expected 0 to {limit:g}, got {getattr(self, name)}")
        check_score(self.score)
        if self.enhance_radius_px < 0:
            raise OptionError(f"enhance_radius_px: expected 0 or more, got {self.enhance_radius_px}")


@dataclass(frozen=True, slots=True)
class Aligned:
    """A frame laid on one level of the map's pyramid.

    Attributes:
        frame: with the height and heading by which it was laid.
        level: of the pyramid.
        jacobian: (2, 2) metres per pixel of the level.
        view: how the ground is seen.
        patch: the rectified frame.
        template: (h, w) the patch, enhanced.
    """

    frame: Frame
    level: int
    jacobian: Array
    view: GroundView
    patch: Patch
    template: torch.Tensor


def align(
    query: Query, frame: Frame, level: int, options: NccOptions, nadir_px: Array | None = None
) -> Aligned | NoFix:
    """Equations 2 and 3: the frame in the pixels of one map level.

    Args:
        query: what is asked.
        frame: with the height and heading to lay it by.
        level: of the pyramid.
        options: settings.
        nadir_px: where (2,) its ground is looked up; None takes the prior's place, or level ground without one.
    """
    attitude, height = frame.attitude, frame.height_agl_m
    assert attitude is not None  # a hypothesis has both
    assert height is not None
    jacobian = query.jacobian * 2.0**level
    view = view_of(query.camera, attitude, height, jacobian)
    if view is not None:
        slope = _slope(query, view, height, level, nadir_px)
        if slope.any():
            view = view_of(query.camera, attitude, height, jacobian, slope) or view
    if view is None:
        return query.refuse_tilted(attitude, METHOD)
    rows, columns = query.site.level_shape(level)
    if (MIN_SHRINK * options.fraction) ** 2 * view.area_px > rows * columns:
        return query.refuse(Reason.OUTSIDE_MAP, "the frame covers more ground than the map", METHOD)
    patch = rectify(query.gray, query.camera, view, fraction=options.fraction)
    if patch is None:
        detail = "the frame covers fewer than 8 x 8 pixels of the map"
        return query.refuse(Reason.NO_TEXTURE, detail, METHOD)
    enhanced = enhance(patch.gray, radius_px=options.enhance_radius_px, score=options.score)
    template = torch.from_numpy(enhanced).to(query.device)
    return Aligned(frame, level, jacobian, view, patch, template)


def _slope(query: Query, view: GroundView, height_m: float, level: int, nadir_px: Array | None) -> Array:
    """Rise (2,) of the ground under the frame per pixel of the level, the flatter the less its place is known."""
    reach_m, place = _GROUND_SHARE * height_m, nadir_px
    if place is None and query.prior is not None:
        reach_m, place = max(reach_m, _SPREAD_SIGMAS * query.prior.sigma_m), query.prior_px
    if place is None:
        return np.zeros(2)
    return query.site.ground_plane(place + view.center_px * 2.0**level, reach_m)[1] * 2.0**level


def window_about(query: Query, aligned: Aligned, options: NccOptions) -> Window | None:
    """The adaptive window in full-resolution map pixels; the whole map where there is no prior."""
    nadir = query.prior_px
    if nadir is None:
        return Window(0, 0, query.site.width_px, query.site.height_px)
    scale = 2.0**aligned.level
    height, width = aligned.template.shape
    footprint = (aligned.view.footprint_px[0] * scale, aligned.view.footprint_px[1] * scale)
    center = nadir + aligned.view.center_px * scale
    least = ((width + 4) * scale, (height + 4) * scale)
    return query.window(center, footprint, least, margin=options.margin)


def search(
    query: Query, prepared: PreparedMap, aligned: Aligned, window: Window, options: NccOptions
) -> Peak | None:
    """The peak in a window, in pixels of the aligned level; None where the patch lies nowhere on the map."""
    height, width = aligned.template.shape
    with query.watch.stage("map"):
        region = prepared.cut(level_crop(query.site, window, aligned.level), aligned.level)
    if region.window.width_px < width or region.window.height_px < height:
        return None
    exclusion_px = options.rule.exclusion_m / (query.site.gsd_m_per_px * 2.0**aligned.level)
    with query.watch.stage("match"):
        if region.valid is None:
            peak = match_template(
                region.search, aligned.template, exclusion_px=exclusion_px, exhaustive=options.exhaustive
            )
        else:
            scores = masked_scores(region, aligned.template[None], options)
            if not bool((scores > -1.0).any()):
                return None
            peak = find_peak(scores[0], exclusion_px=exclusion_px)
    x, y = peak.x + region.window.x0, peak.y + region.window.y0
    return Peak(x, y, peak.score, peak.second_score, peak.curvature)


def surface(
    query: Query, prepared: PreparedMap, aligned: Aligned, window: Window, options: NccOptions
) -> tuple[torch.Tensor, Array] | None:
    """The whole surface that :func:`search` finds its peak on, for reports.

    Returns:
        Scores (H', W') of the template's top-left pixel, and that place (2,) of the first in pixels of the level;
        None where the patch does not fit the window.
    """
    height, width = aligned.template.shape
    region = prepared.cut(level_crop(query.site, window, aligned.level), aligned.level)
    if region.window.width_px < width or region.window.height_px < height:
        return None
    template = aligned.template[None]
    if region.valid is None:
        scores = ncc(region.search.image[None], template[None])[0, 0]
    else:
        scores = masked_scores(region, template, options)[0]
    return scores, np.array([region.window.x0, region.window.y0], np.float64)


def nadir_px(query: Query, peak: Peak, aligned: Aligned) -> Array:
    """The camera's nadir (2,) in map pixels, from where its patch was found."""
    place = np.array([peak.x, peak.y]) - aligned.patch.offset_px
    return query.site.full_from_level(place, aligned.level)


def masked_scores(region: Region, templates: torch.Tensor, options: NccOptions) -> torch.Tensor:
    """Scores (T, H', W') where the region has nodata; -1 where too little of a template lies on map."""
    assert region.valid is not None
    scores = ncc(
        region.search.image[None],
        templates[None],
        search_valid=region.valid[None],
        min_overlap=options.min_valid_share,
    )
    return scores[0]
