"""NCC over a bank of headings and heights, and over whole maps: coarse for all of them, fine for the best.

Every hypothesis is the frame with another heading or height. All are laid on a coarse level of the map and scored
against one spectrum; the best places are then matched level by level, and the winner's heading and height refined
below the step of the bank.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from engine.indexes.prepared import PreparedMap, Region
from engine.methods import hypothesis
from engine.methods.hypothesis import Aligned, NccOptions
from engine.methods.query import Query, level_crop
from engine.ncc_fft import surfaces
from engine.peaks import best_positions
from engine.values import Frame, NoFix, Peak, Window

Array = NDArray[np.float64]

# Levels are gone up until hypotheses times places are no more than this, or the template gets too small.
_COARSE_PLACES = 4_000_000
_COARSE_TEMPLATE_PX = 20
_CANDIDATES = 8
_SEMIFINALISTS = 4
_FINALISTS = 2
_GROUP = 2  # templates in one batch, which bounds the memory of their surfaces
_SLACK_PX = 3  # by which a place that was found on a level may be wrong, in pixels of that level
_EDGE_PX = 1.5  # by which a hypothesis may move the corner of the patch
_MIDDLE_ROUNDS = 2
_FINE_ROUNDS = 2


def is_trusted(frame: Frame, options: NccOptions) -> bool:
    """Whether the frame's own heading and height are the only hypothesis."""
    return frame.heading_deg is not None and options.heading_search_deg == options.height_search_share == 0.0


def _hypotheses(frame: Frame, turns: list[float], shares: list[float]) -> list[Frame]:
    """The frame with its heading turned by each of ``turns`` and its height changed by each of ``shares``."""
    height, heading = frame.height_agl_m, frame.heading_deg or 0.0
    assert height is not None  # ncc.locate() refused the frame otherwise
    return [
        replace(frame, heading_deg=(heading + turn) % 360.0, height_agl_m=height * (1.0 + share))
        for turn, share in itertools.product(turns, shares)
    ]


def _grid(options: NccOptions, reach_px: float) -> tuple[list[float], list[float]]:
    """Turns in degrees and shares of the height that leave no corner of a patch off by more than :data:`_EDGE_PX`.

    Args:
        options: how far heading and height may be off.
        reach_px: from the patch's middle to its corner, on the level where the hypotheses are scored.
    """
    step = 2.0 * _EDGE_PX / reach_px  # radians, or a share of the height: both move the corner by step * reach
    turns = _steps(options.heading_search_deg, math.degrees(step))
    if options.heading_search_deg == 180.0:
        turns = turns[:-1]  # -180 and 180 are one heading
    return turns, _steps(options.height_search_share, step)


def _steps(reach: float, step: float) -> list[float]:
    """Offsets from -reach to reach, no further apart than the step, 0 among them."""
    count = math.ceil(reach / step)
    return [reach * i / count for i in range(-count, count + 1)] if count else [0.0]


def search(
    query: Query, prepared: PreparedMap, first: Aligned, window: Window, options: NccOptions
) -> tuple[Peak | None, Aligned]:
    """The best peak over all hypotheses in the window, at the level of ``first``, and whose it is."""
    level, frames = _coarse_level(query, first, window, options)
    if level == first.level and len(frames) == 1:
        return hypothesis.search(query, prepared, first, window, options), first
    found: list[tuple[Peak, Aligned]] = []
    middle = max(first.level, level - 1)
    for frame, nadir in _coarse(query, prepared, frames, window, level, options):
        aligned = hypothesis.align(query, frame, middle, options, nadir)
        peak = None if isinstance(aligned, NoFix) else _near(query, prepared, aligned, nadir, level, options)
        if peak is not None and isinstance(aligned, Aligned):
            found.append((peak, aligned))
    found.sort(key=lambda pair: -pair[0].score)
    if len(frames) > 1:
        found = [_refine(query, prepared, *pair, options, _MIDDLE_ROUNDS) for pair in found[:_SEMIFINALISTS]]
        found.sort(key=lambda pair: -pair[0].score)
    return _finish(query, prepared, found, first.level, len(frames) > 1, options) or (None, first)


def _finish(
    query: Query,
    prepared: PreparedMap,
    found: list[tuple[Peak, Aligned]],
    level: int,
    refine: bool,
    options: NccOptions,
) -> tuple[Peak, Aligned] | None:
    """The best few places at full resolution; the rival is the best of the others."""
    final: list[tuple[Peak, Aligned]] = []
    for peak, aligned in found[:_FINALISTS]:
        nadir = hypothesis.nadir_px(query, peak, aligned)
        fine = hypothesis.align(query, aligned.frame, level, options, nadir)
        if isinstance(fine, NoFix):
            continue
        better = _near(query, prepared, fine, nadir, aligned.level + 1, options)
        if better is None:
            continue
        # Rivals get as good a heading and height as the winner, or the lead would be that of the refinement.
        final.append(_refine(query, prepared, better, fine, options, _FINE_ROUNDS) if refine else (better, fine))
    if not final:
        return None
    final.sort(key=lambda pair: -pair[0].score)
    best, aligned = final[0]
    rival = _best_elsewhere(query, final, options.rule.exclusion_m)
    return replace(best, second_score=max(rival, best.second_score)), aligned


def coarse_px(query: Query, first: Aligned, window: Window, options: NccOptions) -> int:
    """Pixels of the map that :func:`search` looks at first, all at once."""
    return window.area_px >> 2 * _coarse_level(query, first, window, options)[0]


def _coarse_level(query: Query, first: Aligned, window: Window, options: NccOptions) -> tuple[int, list[Frame]]:
    """The level on which all hypotheses are scored, and the hypotheses, whose number falls with the resolution."""
    level = first.level
    while True:
        h, w = (n >> (level - first.level) for n in first.template.shape)
        turns, shares = _grid(options, math.hypot(h, w) / 2.0)
        places = len(turns) * len(shares) * window.area_px / 4**level
        if places <= _COARSE_PLACES or level + 1 == query.site.levels or min(h, w) >> 1 < _COARSE_TEMPLATE_PX:
            return level, _hypotheses(query.frame, turns, shares)
        level += 1


def _coarse(
    query: Query, prepared: PreparedMap, frames: list[Frame], window: Window, level: int, options: NccOptions
) -> list[tuple[Frame, Array]]:
    """The best places of all hypotheses on a coarse level: (hypothesis, nadir in map pixels), falling scores."""
    with query.watch.stage("map"):
        region = prepared.cut(level_crop(query.site, window, level), level)
    with query.watch.stage("align"):
        tried = [hypothesis.align(query, frame, level, options) for frame in frames]
    fitting = [aligned for aligned in tried if isinstance(aligned, Aligned)]
    if not fitting:
        return []
    templates, trims = _same_size(fitting)
    if templates.shape[1] > region.window.height_px or templates.shape[2] > region.window.width_px:
        return []
    separation = max(2, round(options.rule.exclusion_m / (query.site.gsd_m_per_px * 2.0**level)))
    found: list[tuple[float, Frame, Array]] = []
    with query.watch.stage("match"):
        for aligned, trim, scores in zip(fitting, trims, _all_scores(region, templates, options), strict=True):
            for x, y, score in best_positions(scores, separation, _CANDIDATES):
                place = np.array([x + region.window.x0, y + region.window.y0], dtype=np.float64) - trim
                nadir = query.site.full_from_level(place - aligned.patch.offset_px, level)
                found.append((score, aligned.frame, nadir))
    found.sort(key=lambda item: -item[0])
    return _apart(found, separation * 2.0**level)


def _all_scores(region: Region, templates: torch.Tensor, options: NccOptions) -> Iterator[torch.Tensor]:
    """One surface (H', W') after the other, of which only a few are in memory."""
    if region.valid is None:
        for group in surfaces(region.search, templates, group=_GROUP):
            yield from group
    else:
        for template in templates:
            yield hypothesis.masked_scores(region, template[None], options)[0]


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


def _near(
    query: Query, prepared: PreparedMap, aligned: Aligned, nadir_px: Array, level: int, options: NccOptions
) -> Peak | None:
    """The peak near a nadir that was found on some level, which is forgiven a few pixels of that level."""
    scale, slack = 2**aligned.level, _SLACK_PX * 2**level
    height, width = aligned.template.shape
    x0, y0 = (int(v) - slack for v in np.round(nadir_px + aligned.patch.offset_px * scale))
    x1 = min(query.site.width_px, x0 + width * scale + 2 * slack)
    y1 = min(query.site.height_px, y0 + height * scale + 2 * slack)
    x0, y0 = max(0, x0), max(0, y0)
    window = Window(x0, y0, max(1, x1 - x0), max(1, y1 - y0))
    return hypothesis.search(query, prepared, aligned, window, options)


def _best_elsewhere(query: Query, found: list[tuple[Peak, Aligned]], exclusion_m: float) -> float:
    """The best score at another place than the winner's."""
    winner = hypothesis.nadir_px(query, *found[0])
    distance_px = exclusion_m / query.site.gsd_m_per_px
    scores = [
        peak.score
        for peak, aligned in found[1:]
        if np.hypot(*(hypothesis.nadir_px(query, peak, aligned) - winner)) > distance_px
    ]
    return max(scores, default=-1.0)


def _refine(
    query: Query, prepared: PreparedMap, peak: Peak, aligned: Aligned, options: NccOptions, rounds: int
) -> tuple[Peak, Aligned]:
    """Heading and height below the step of the bank: parabolas through three scores, over ever smaller steps."""
    step = 2.0 * _EDGE_PX / math.hypot(*aligned.template.shape)
    best = (peak, aligned)
    for _ in range(rounds):
        for turn, share in ((step, 0.0), (0.0, step)):
            sides = [_moved(query, prepared, best, sign * turn, sign * share, options) for sign in (-1.0, 1.0)]
            if sides[0] is None or sides[1] is None:
                continue
            low, high = sides[0][0].score, sides[1][0].score
            bend = low - 2.0 * best[0].score + high
            summit = float(np.clip(0.5 * (low - high) / bend if bend < 0 else np.sign(high - low), -1.5, 1.5))
            tried = _moved(query, prepared, best, summit * turn, summit * share, options)
            best = max([best, *(s for s in (*sides, tried) if s is not None)], key=lambda pair: pair[0].score)
        step /= 2.0
    return best


def _moved(
    query: Query,
    prepared: PreparedMap,
    best: tuple[Peak, Aligned],
    turn_rad: float,
    share: float,
    options: NccOptions,
) -> tuple[Peak, Aligned] | None:
    """The peak near the last one, with the heading turned and the height changed by a share."""
    peak, aligned = best
    frame = aligned.frame
    assert frame.heading_deg is not None
    assert frame.height_agl_m is not None
    moved = replace(
        frame,
        heading_deg=(frame.heading_deg + math.degrees(turn_rad)) % 360.0,
        height_agl_m=frame.height_agl_m * (1.0 + share),
    )
    nadir = hypothesis.nadir_px(query, peak, aligned)
    other = hypothesis.align(query, moved, aligned.level, options, nadir)
    if isinstance(other, NoFix):
        return None
    found = _near(query, prepared, other, nadir, aligned.level, options)
    return None if found is None else (found, other)
