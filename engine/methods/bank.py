"""NCC over a bank of headings and heights, and over whole maps: coarse for all of them, fine for the best.

Every hypothesis is the frame with another heading or height. All are laid on a coarse level of the map and scored
against one spectrum; the best places are then matched level by level, and the winner's heading and height refined
below the step of the bank.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from engine.errors import OptionError
from engine.methods import laid
from engine.methods.laid import Aligned, NccOptions
from engine.methods.query import Query, level_crop
from engine.ncc_fft import best_places, surface
from engine.prepared import PreparedMap
from engine.types import Frame, NoFix, Peak, Window

Array = NDArray[np.float64]

# Levels are gone up until hypotheses times places are no more than this, or the template gets too small.
_COARSE_PLACES = 4_000_000
_COARSE_TEMPLATE_PX = 28
_CANDIDATES = 8
_GROUP = 8  # templates in one batch, which bounds the memory of their surfaces
_SLACK_PX = 3  # by which a coarse place may be wrong, in pixels of its level
_REFINEMENTS = 3


def hypotheses(frame: Frame, options: NccOptions) -> list[Frame]:
    """The frame under every heading and height to be tried, the likeliest first; itself where both are trusted."""
    heading, height = frame.heading_deg, frame.height_agl_m
    if height is None:
        raise OptionError("frame: expected a height")
    half_turn = options.heading_search_deg
    turns = _steps(half_turn, options.heading_step_deg)
    if half_turn == 180.0:
        turns = turns[:-1] if len(turns) > 1 else turns  # -180 and 180 are one heading
    shares = _steps(options.height_search_share, options.height_step_share)
    if len(turns) == len(shares) == 1 and heading is not None:
        return [frame]
    base = heading or 0.0
    return [
        replace(frame, heading_deg=(base + turn) % 360.0, height_agl_m=height * (1.0 + share))
        for turn, share in sorted(itertools.product(turns, shares), key=lambda p: (abs(p[0]), abs(p[1])))
    ]


def _steps(reach: float, step: float) -> list[float]:
    """Offsets from -reach to reach, no further apart than the step, 0 among them."""
    count = math.ceil(reach / step)
    return [reach * i / count for i in range(-count, count + 1)] if count else [0.0]


def search(
    query: Query,
    prepared: PreparedMap,
    first: Aligned,
    frames: list[Frame],
    window: Window,
    options: NccOptions,
) -> tuple[Peak | None, Aligned]:
    """The best peak over all hypotheses in the window, at the level of ``first``, and whose it is."""
    level = _coarse_level(query, first, window, len(frames))
    if level == first.level and len(frames) == 1:
        return laid.search(query, prepared, first, window, options), first
    places = _coarse(query, prepared, frames, window, level, options)
    found: list[tuple[Peak, Aligned]] = []
    for frame, nadir in places:
        aligned = laid.align(query, frame, first.level, options)
        if isinstance(aligned, NoFix):
            continue
        peak = laid.search(query, prepared, aligned, _around(query, aligned, nadir, level), options)
        if peak is not None:
            found.append((peak, aligned))
    if not found:
        return None, first
    found.sort(key=lambda pair: -pair[0].score)
    best, aligned = found[0]
    rival = _best_elsewhere(query, found, options.rule.exclusion_m)
    if len(frames) > 1:
        best, aligned = _refine(query, prepared, best, aligned, options)
    return replace(best, second_score=max(rival, best.second_score)), aligned


def _coarse_level(query: Query, first: Aligned, window: Window, count: int) -> int:
    level, places = first.level, count * window.area_px / 4**first.level
    while (
        level + 1 < query.site.levels
        and places > _COARSE_PLACES
        and min(first.template.shape) >> (level + 1 - first.level) >= _COARSE_TEMPLATE_PX
    ):
        level, places = level + 1, places / 4
    return level


def _coarse(
    query: Query, prepared: PreparedMap, frames: list[Frame], window: Window, level: int, options: NccOptions
) -> list[tuple[Frame, Array]]:
    """The best places of all hypotheses on a coarse level: (hypothesis, nadir in map pixels), falling scores."""
    with query.watch.stage("map"):
        region = prepared.cut(level_crop(query.site, window, level), level)
    found: list[tuple[float, Frame, Array]] = []
    separation = max(2, round(options.rule.exclusion_m / (query.site.gsd_m_per_px * 2.0**level)))
    for start in range(0, len(frames), _GROUP):
        with query.watch.stage("align"):
            group = [laid.align(query, frame, level, options) for frame in frames[start : start + _GROUP]]
        fitting = [aligned for aligned in group if isinstance(aligned, Aligned)]
        if not fitting:
            continue
        with query.watch.stage("match"):
            templates, trims = _same_size(fitting)
            h, w = templates.shape[-2:]
            if h > region.window.height_px or w > region.window.width_px:
                continue
            if region.valid is None:
                scores = surface(region.search, templates)
            else:
                scores = laid.masked_scores(region, templates, options)
            for aligned, trim, own in zip(fitting, trims, scores, strict=True):
                for x, y, score in best_places(own, separation, _CANDIDATES):
                    place = np.array([x + region.window.x0, y + region.window.y0], dtype=np.float64) - trim
                    nadir = query.site.full_from_level(place - aligned.patch.offset_px, level)
                    found.append((score, aligned.frame, nadir))
    found.sort(key=lambda item: -item[0])
    return _apart(found, separation * 2.0**level)


def _same_size(fitting: list[Aligned]) -> tuple[torch.Tensor, list[Array]]:
    """Templates (T, h, w) cut about their middles to the smallest, and what was cut off (x, y) at their corner."""
    h = min(aligned.template.shape[0] for aligned in fitting)
    w = min(aligned.template.shape[1] for aligned in fitting)
    trims = [((a.template.shape[1] - w) // 2, (a.template.shape[0] - h) // 2) for a in fitting]
    cut = [a.template[y : y + h, x : x + w] for a, (x, y) in zip(fitting, trims, strict=True)]
    return torch.stack(cut), [np.array(trim, dtype=np.float64) for trim in trims]


def _apart(found: list[tuple[float, Frame, Array]], distance_px: float) -> list[tuple[Frame, Array]]:
    """The best few of places in falling order that are no neighbours of a better one."""
    kept: list[tuple[Frame, Array]] = []
    for _, frame, nadir in found:
        if all(np.hypot(*(nadir - other)) > distance_px for _, other in kept):
            kept.append((frame, nadir))
        if len(kept) == _CANDIDATES:
            break
    return kept


def _around(query: Query, aligned: Aligned, nadir_px: Array, level: int) -> Window:
    """A window for a nadir that was found on a coarse level, which forgives it a few pixels of that level."""
    scale, slack = 2**aligned.level, _SLACK_PX * 2**level
    height, width = aligned.template.shape
    x0, y0 = (int(v) - slack for v in np.round(nadir_px + aligned.patch.offset_px * scale))
    x1 = min(query.site.width_px, x0 + width * scale + 2 * slack)
    y1 = min(query.site.height_px, y0 + height * scale + 2 * slack)
    x0, y0 = max(0, x0), max(0, y0)
    return Window(x0, y0, max(1, x1 - x0), max(1, y1 - y0))


def _nadir_px(query: Query, peak: Peak, aligned: Aligned) -> Array:
    place = np.array([peak.x, peak.y]) - aligned.patch.offset_px
    return query.site.full_from_level(place, aligned.level)


def _best_elsewhere(query: Query, found: list[tuple[Peak, Aligned]], exclusion_m: float) -> float:
    """The best score at another place than the winner's."""
    winner = _nadir_px(query, *found[0])
    distance_px = exclusion_m / query.site.gsd_m_per_px
    scores = [
        peak.score
        for peak, aligned in found[1:]
        if np.hypot(*(_nadir_px(query, peak, aligned) - winner)) > distance_px
    ]
    return max(scores, default=-1.0)


def _refine(
    query: Query, prepared: PreparedMap, peak: Peak, aligned: Aligned, options: NccOptions
) -> tuple[Peak, Aligned]:
    """Heading and height below the step of the bank: parabolas through three scores, over ever smaller steps."""
    turn, share = options.heading_step_deg / 2.0, options.height_step_share / 2.0
    for _ in range(_REFINEMENTS):
        for step in ((turn, 0.0), (0.0, share)):
            sides = [_moved(query, prepared, peak, aligned, sign, step, options) for sign in (-1.0, 1.0)]
            if sides[0] is None or sides[1] is None:
                continue
            low, high = sides[0][0].score, sides[1][0].score
            bend = low - 2.0 * peak.score + high
            summit = 0.5 * (low - high) / bend if bend < 0 else float(np.sign(high - low))
            tried = _moved(query, prepared, peak, aligned, float(np.clip(summit, -1.0, 1.0)), step, options)
            peak, aligned = max(
                [(peak, aligned), *(s for s in (*sides, tried) if s is not None)], key=lambda pair: pair[0].score
            )
        turn, share = turn / 2.0, share / 2.0
    return peak, aligned


def _moved(
    query: Query,
    prepared: PreparedMap,
    peak: Peak,
    aligned: Aligned,
    sign: float,
    step: tuple[float, float],
    options: NccOptions,
) -> tuple[Peak, Aligned] | None:
    """The peak near the last one with the heading and height moved by ``sign`` steps."""
    frame = aligned.frame
    assert frame.heading_deg is not None
    assert frame.height_agl_m is not None
    moved = replace(
        frame,
        heading_deg=(frame.heading_deg + sign * step[0]) % 360.0,
        height_agl_m=frame.height_agl_m * (1.0 + sign * step[1]),
    )
    other = laid.align(query, moved, aligned.level, options)
    if isinstance(other, NoFix):
        return None
    window = _around(query, other, _nadir_px(query, peak, aligned), aligned.level + 1)
    found = laid.search(query, prepared, other, window, options)
    return None if found is None else (found, other)
