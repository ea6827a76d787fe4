"""Multi-hypothesis search: NCC over headings and heights, or a whole map, coarse for all, fine for the best.

A hypothesis is a height and a heading of the frame. All are aligned on a coarse level of the map and scored
against one spectrum. The best places are then matched level by level, and the winner's heading and height are
refined below the step between hypotheses.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engine.kernels.peaks import best_positions
from engine.matching.correlation import MIN_SIDE_PX, MIN_VALID_SHARE, Aligned, Correlator
from engine.matching.covariance import score_sigma
from engine.matching.evidence import Evidence, is_beyond_doubt, is_hopeless, surprise_of
from engine.matching.peak_evidence import places_in
from engine.ncc_fft import surfaces
from engine.runtime.device import to_device
from engine.values import GridPose, NoFix, Peak, Window
from engine.window import SPREAD_SIGMAS

Array = NDArray[np.float64]

Reach = tuple[float, float]
"""How far off the heading, in degrees, and the height, as a share of it, may be."""
OWN = (0.0, 0.0)
"""The reach of the frame's own hypothesis alone."""
Found = tuple[Peak, Aligned]
"""A peak, and the hypothesis that it belongs to."""

# Most hypotheses times places on the coarse level, unless the template gets too small: in all, and in multiples of
# the places of one look at the frame's own level.
_MAX_COARSE_PLACES, _MAX_LOOKS = 32_000_000, 16
_MAX_COARSE_PX = 4_000_000  # of the map, likewise; and of the surfaces in memory at once
_CANDIDATES = 8  # on the coarsest level; half of them are refined, and half of those at full resolution
_MAX_SHARE = 0.2  # of the height, by which it may be off
_EDGE_PX = 1.5  # error at the patch's corner by the nearest heading, and by the nearest height
_ROUNDS = 2  # of fitting heading and height, on the middle level and at full resolution


def reach_of(correlator: Correlator) -> Reach:
    """How far heading and height are searched: as far as the position, in sigmas."""
    query, height_m = correlator.query, correlator.query.telemetry.known_height_m
    share = SPREAD_SIGMAS * query.errors.height_sigma_m(height_m) / height_m
    return min(SPREAD_SIGMAS * query.errors.heading_deg, 180.0), min(share, _MAX_SHARE)


def search(
    correlator: Correlator, first: Aligned, window: Window, reach: Reach
) -> tuple[Peak | None, Aligned, int]:
    """The best peak over all hypotheses in the window, at the level of ``first``; its hypothesis; their number.

    Args:
        correlator: of the frame.
        first: the frame's own hypothesis.
        window: to search.
        reach: of the other headings and heights to try.
    """
    level, poses = _coarse_level(correlator, first, window, reach)
    if level == first.level and len(poses) == 1:
        return correlator.search(first, window), first, 1
    query, tried, above = correlator.query, len(poses) * places_in(first, window), level + 1
    if above < query.site.levels:  # with fewer hypotheses, at a sixteenth of the cost
        _, turns, shares = _grid_on(first, above, reach)
        best = _from_level(correlator, first, window, above, _hypotheses(query.telemetry, turns, shares))
        if best is not None and is_beyond_doubt(_nats(*best, tried), query.risk):
            return *best, len(poses)
    return *(_from_level(correlator, first, window, level, poses) or (None, first)), len(poses)


def _nats(peak: Peak, aligned: Aligned, tried: float) -> float:
    """The evidence for the best of so many places under all hypotheses."""
    sigma = score_sigma(aligned.template.size)
    return Evidence(surprise_of(peak.score, sigma), surprise_of(peak.second_score, sigma), tried, tried, None).nats


def _from_level(
    correlator: Correlator, first: Aligned, window: Window, level: int, poses: list[GridPose]
) -> Found | None:
    """The best peak over some hypotheses, all scored on one level."""
    middle, places = max(first.level, level - 1), _coarse(correlator, poses, window, level)
    near = [_near(correlator, pose, middle, nadir, level) for pose, nadir in places]
    found = sorted(filter(None, near), key=lambda pair: -pair[0].score)
    several = len(poses) > 1
    if several and found:
        (peak, aligned), tried = found[0], len(poses) * places_in(first, window)
        if is_hopeless(_nats(replace(peak, second_score=0.0), aligned, tried), correlator.query.risk):
            return None
        found = [_refined(correlator, pair) for pair in found[: _CANDIDATES // 2]]
        found.sort(key=lambda pair: -pair[0].score)
    return _best_at_full_resolution(correlator, found, first.level, refine=several)


def coarse_px(correlator: Correlator, first: Aligned, window: Window) -> int:
    """Map pixels that :func:`search` searches first, all at once, for the frame's own hypothesis."""
    return window.area_px >> 2 * _coarse_level(correlator, first, window, OWN)[0]


def is_single(correlator: Correlator, first: Aligned, window: Window, reach: Reach) -> bool:
    """Whether a search tries only the frame's own heading and height, which are near all possible ones."""
    return len(_coarse_level(correlator, first, window, reach)[1]) == 1


def _coarse_level(
    correlator: Correlator, first: Aligned, window: Window, reach: Reach
) -> tuple[int, list[GridPose]]:
    """The level on which to score all hypotheses, and the hypotheses: fewer at lower resolution."""
    level, levels = first.level, correlator.query.site.levels
    most = min(_MAX_COARSE_PLACES, _MAX_LOOKS * first.work_px(window))
    while True:
        side_px, turns, shares = _grid_on(first, level, reach)
        area_px = window.area_px / 4**level
        few = area_px <= _MAX_COARSE_PX and len(turns) * len(shares) * area_px <= most
        if few or level + 1 == levels or side_px >> 1 < MIN_SIDE_PX:
            return level, _hypotheses(correlator.query.telemetry, turns, shares)
        level += 1


def _grid_on(first: Aligned, level: int, reach: Reach) -> tuple[int, list[float], list[float]]:
    """The template's shorter side on a level, in its pixels, with the turns and shares to try there.

    Turns, in degrees, and shares of the height keep a patch's corners within :data:`_EDGE_PX` of one of them.
    """
    turn_deg, share = reach
    h, w = (n >> (level - first.level) for n in first.template.shape)
    step = 4.0 * _EDGE_PX / math.hypot(h, w)  # radians, or a share: each moves a corner by twice the edge
    turns = _steps(turn_deg, math.degrees(step))
    if turn_deg == 180.0:
        turns = turns[:-1]  # -180 and 180 are one heading
    return min(h, w), turns, _steps(share, step)


def _steps(reach: float, step: float) -> list[float]:
    """Offsets from -reach to reach, including 0, spaced by at most the step; 0 alone if it is near all of them."""
    count = math.ceil(reach / step - 0.5)
    return [reach * i / count for i in range(-count, count + 1)] if count else [0.0]


def _hypotheses(pose: GridPose, turns: list[float], shares: list[float]) -> list[GridPose]:
    """The pose with its heading turned by each of ``turns`` and its height changed by each of ``shares``."""
    return [_turned(pose, turn, share) for turn, share in itertools.product(turns, shares)]


def _turned(pose: GridPose, turn_deg: float, share: float) -> GridPose:
    heading_deg, height_m = (pose.grid_heading_deg or 0.0) + turn_deg, pose.known_height_m * (1.0 + share)
    return replace(pose, grid_heading_deg=heading_deg % 360.0, height_agl_m=height_m)


def _coarse(
    correlator: Correlator, poses: list[GridPose], window: Window, level: int
) -> list[tuple[GridPose, Array]]:
    """The best places of all hypotheses on a coarse level: (hypothesis, nadir in map pixels), falling scores."""
    query = correlator.query
    with query.scheduler.stage("map"):
        region = correlator.cut(window, level)
    with query.scheduler.stage("align"):
        tried = [correlator.align(pose, level) for pose in poses]
    fitting = [aligned for aligned in tried if isinstance(aligned, Aligned)]
    if not fitting:
        return []
    templates, trims = _same_size(fitting)
    if templates.shape[1] > region.window.height_px or templates.shape[2] > region.window.width_px:
        return []
    separation = max(2, round(correlator.exclusion_px(level)))
    found: list[tuple[float, GridPose, Array]] = []
    with query.scheduler.stage("match"):
        group = max(1, _MAX_COARSE_PX // region.window.area_px)
        own = to_device(templates, query.device)
        groups = surfaces(region.search, own, group=group, min_overlap=MIN_VALID_SHARE)
        each = itertools.chain.from_iterable(groups)  # one at a time; only a group is in memory
        for aligned, trim, scores in zip(fitting, trims, each, strict=True):
            for x, y, score in best_positions(scores, separation, _CANDIDATES):
                place = np.array([x + region.window.x0, y + region.window.y0], dtype=np.float64) - trim
                nadir = query.site.full_from_level(place - aligned.patch.offset_px, level)
                found.append((score, aligned.pose, nadir))
    found.sort(key=lambda item: -item[0])
    return _separated(found, separation * 2.0**level)


def _same_size(fitting: list[Aligned]) -> tuple[NDArray[np.float32], list[Array]]:
    """Templates (T, h, w) cropped centrally to the smallest, and the (x, y) cut off at their corner."""
    h = min(aligned.template.shape[0] for aligned in fitting)
    w = min(aligned.template.shape[1] for aligned in fitting)
    trims = [((a.template.shape[1] - w) // 2, (a.template.shape[0] - h) // 2) for a in fitting]
    cut = [a.template[y : y + h, x : x + w] for a, (x, y) in zip(fitting, trims, strict=True)]
    return np.stack(cut), [np.array(trim, dtype=np.float64) for trim in trims]


def _separated(found: list[tuple[float, GridPose, Array]], distance_px: float) -> list[tuple[GridPose, Array]]:
    """The best few of places in falling order, without neighbours of a better one."""
    kept: list[tuple[GridPose, Array]] = []
    for _, pose, nadir in found:
        if all(np.hypot(*(nadir - other)) > distance_px for _, other in kept):
            kept.append((pose, nadir))
        if len(kept) == _CANDIDATES:
            break
    return kept


def _near(correlator: Correlator, pose: GridPose, level: int, nadir_px: Array, coarse: int) -> Found | None:
    """The peak on a level near a nadir from a coarse one, as far as heading and height move a place there."""
    aligned = correlator.align(pose, level, nadir_px)
    if isinstance(aligned, NoFix):
        return None
    peak = correlator.search(aligned, correlator.near(aligned, nadir_px, round(2.0 * _EDGE_PX * 2**coarse)))
    return None if peak is None else (peak, aligned)


def _refined(correlator: Correlator, best: Found) -> Found:
    """Heading and height between the hypotheses: parabolas through three scores, over ever smaller steps."""
    step = 2.0 * _EDGE_PX / math.hypot(*best[1].template.shape)
    for _ in range(_ROUNDS):
        for turn, share in ((step, 0.0), (0.0, step)):
            sides = [_moved(correlator, best, sign * turn, sign * share) for sign in (-1.0, 1.0)]
            if sides[0] is None or sides[1] is None:
                continue
            low, high = sides[0][0].score, sides[1][0].score
            bend = low - 2.0 * best[0].score + high
            vertex = float(np.clip(0.5 * (low - high) / bend if bend < 0 else np.sign(high - low), -1.5, 1.5))
            tried = _moved(correlator, best, vertex * turn, vertex * share)
            best = max([best, *(s for s in (*sides, tried) if s is not None)], key=lambda pair: pair[0].score)
        step /= 2.0
    return best


def _moved(correlator: Correlator, best: Found, turn_rad: float, share: float) -> Found | None:
    """The peak near the last one, with the heading turned and the height changed by a share."""
    pose, level = _turned(best[1].pose, math.degrees(turn_rad), share), best[1].level
    return _near(correlator, pose, level, correlator.nadir_px(*best), level)


def _best_at_full_resolution(
    correlator: Correlator, found: list[Found], level: int, *, refine: bool
) -> Found | None:
    """The best of a few places at full resolution; its rival is the best of the others."""
    final: list[Found] = []
    for peak, aligned in found[: _CANDIDATES // 4]:
        nadir_px, coarse = correlator.nadir_px(peak, aligned), aligned.level + 1
        better = _near(correlator, aligned.pose, level, nadir_px, coarse)
        if better is not None:
            # Rivals are refined in heading and height like the winner, or refinement alone would create the lead.
            final.append(_refined(correlator, better) if refine else better)
    if not final:
        return None
    (best, winner), *others = sorted(final, key=lambda pair: -pair[0].score)
    place, distance_px = correlator.nadir_px(best, winner), correlator.exclusion_px(0)
    apart_px = [np.hypot(*(correlator.nadir_px(peak, aligned) - place)) for peak, aligned in others]
    elsewhere = [peak.score for (peak, _), apart in zip(others, apart_px, strict=True) if apart > distance_px]
    return replace(best, second_score=max([best.second_score, *elsewhere])), winner
