"""The peak of one template coarse to fine: all positions at reduced resolution, the best few at full resolution.

The error bound of the coarse scores is twice the largest error at the refined positions, and at least the loss of
a match between coarse pixels. If that bound does not exclude every other position, all must be scored at full
resolution, unless the window is wide and a :class:`EarlyStop` already decides about the frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.kernels.local import LocalScores
from engine.kernels.peaks import FAR, NEAR, best_outside, best_positions, fit_peak
from engine.kernels.search_levels import COARSE_TEMPLATE_PX, MapRegion
from engine.kernels.sums import halved, over_nodata
from engine.values import Peak

FloatImage = NDArray[np.float32]
Candidate = tuple[int, int, float]  # x, y and score on the coarsest level

WIDE_PX = 2_000_000
"""Windows of more pixels are wide: every position at full resolution takes a tenth of a second and more."""
_CANDIDATES, _CANDIDATES_WIDE = 6, 64  # refined before all positions are scored; that takes long in a wide window
_SEPARATION_PX = 2  # of candidates, on the coarsest level
_MAX_LOSS = 0.5  # of a perfect match between pixels, on the coarsest level usable for an early stop


@dataclass(frozen=True, slots=True)
class EarlyStop:
    """Which peaks of a wide window to keep although not every position was scored at full resolution.

    Attributes:
        is_clear: whether a peak holds even if its rival is as high as the coarse scores allow elsewhere.
        is_hopeless: whether a peak is useless even if nothing elsewhere is higher than the refined rivals.
    """

    is_clear: Callable[[Peak], bool]
    is_hopeless: Callable[[Peak], bool]


@dataclass(frozen=True, slots=True)
class _Levels:
    """A window and a template on its levels, the finest first.

    Attributes:
        parts: the window.
        models: the template, of zero mean.
        min_overlap: positions with a smaller share of the template on valid pixels do not count.
    """

    parts: list[MapRegion]
    models: list[FloatImage]
    min_overlap: float

    @property
    def loss(self) -> float:
        """The most that a perfect match loses between the coarsest level's pixels."""
        return _phase_loss(self.models[-2], self.models[-1])

    @property
    def scale(self) -> int:
        """Pixels of the finest level per pixel of the coarsest."""
        return 1 << (len(self.parts) - 1)


def is_wide(search: MapRegion) -> bool:
    """Whether a window has more than :data:`WIDE_PX` pixels."""
    return int(np.prod(search.image.shape)) > WIDE_PX


def peak(
    search: MapRegion,
    template: FloatImage,
    exclusion_px: float,
    *,
    min_overlap: float = 0.0,
    stop: EarlyStop | None = None,
) -> Peak | None:
    """The peak by way of the half-resolution levels.

    Args:
        search: (H, W) arrays.
        template: (h, w) float32.
        exclusion_px: radius about the peak within which no rival is counted.
        min_overlap: positions where a smaller share of the template lies on valid pixels do not count.
        stop: which peaks of a wide window to keep beyond the certain ones.

    Returns:
        Peak | None: as :func:`engine.kernels.peaks.find_peak`, but the second score is a coarse level's if that is
        higher than the refined rivals; None if positions elsewhere are not excluded.
    """
    wide = stop is not None and is_wide(search)
    levels = _levels(search, template, min_overlap, _MAX_LOSS if wide else 1.0)
    if levels is None:
        return None  # no gain
    scores = _coarse_scores(levels)
    found, is_certain, unresolved = _refined_candidates(levels, scores, wide=wide)
    if not found:
        return None
    best, origin = max(found, key=lambda pair: pair[0].score)
    rivals = [pair for pair in found if math.hypot(pair[0].x - best.x, pair[0].y - best.y) > exclusion_px]
    second = max((refined.score for refined, _ in rivals), default=-1.0)
    rest = _coarse_rest(scores, [candidate for _, candidate in rivals], levels.scale, best, exclusion_px)
    by_coarse_scores = replace(best, second_score=max(rest, second))
    if is_certain:
        return by_coarse_scores
    if stop is None or not wide or unresolved >= origin[2]:
        return None
    # A place between coarse pixels has more at full resolution than the coarse score shows.
    pessimistic = replace(best, second_score=max(min(rest / (1.0 - levels.loss), 1.0), second))
    if stop.is_clear(pessimistic):
        return pessimistic
    return by_coarse_scores if stop.is_hopeless(replace(best, second_score=second)) else None


def _levels(search: MapRegion, template: FloatImage, min_overlap: float, max_loss: float) -> _Levels | None:
    """The levels worth searching, or None if that is only the finest.

    Args:
        search: the window.
        template: (h, w) float32.
        min_overlap: see :func:`peak`.
        max_loss: of a perfect match between pixels, beyond which a level is too coarse.
    """
    parts, models = [search], [template - template.mean()]
    while (half := parts[-1].half) is not None:
        (H, W), (h, w) = parts[-1].image.shape, models[-1].shape
        if min(h, w) < 2 * COARSE_TEMPLATE_PX or min(H - h, W - w) < 16:
            break
        coarser = halved(models[-1])
        if max_loss < 1.0 and _phase_loss(models[-1], coarser) > max_loss:
            break
        parts.append(half)
        models.append(coarser)
    return _Levels(parts, models, min_overlap) if len(parts) > 1 else None


def _coarse_scores(levels: _Levels) -> FloatImage:
    """Scores on the coarsest level; positions partly on nodata score about as at full resolution."""
    from engine.kernels import blocks  # numba takes a while to import

    coarse, model = levels.parts[-1], levels.models[-1]
    inverse_norms = blocks.inverse_norm(coarse.image, *model.shape)
    counts, (h, w), step = levels.parts[0].counts, levels.models[0].shape, levels.scale
    if counts is None:
        return np.asarray(blocks.prepared_surface(coarse.image, inverse_norms, model[None])[0])
    share = _share_on_map(counts, (h, w), step, inverse_norms.shape)
    # A position between those of the level has this much more of the template on the map at most.
    inverse_norms, off = over_nodata(inverse_norms, share, levels.min_overlap - step * (1.0 / h + 1.0 / w))
    return np.asarray(blocks.prepared_surface(coarse.image, inverse_norms, model[None])[0] + off)


def _share_on_map(
    counts: NDArray[np.int32], model: tuple[int, int], step: int, shape: tuple[int, ...]
) -> FloatImage:
    """Share of a template's pixels (h, w) that are valid, at every ``step``-th position of the finest level."""
    (h, w), (rows, columns) = model, counts.shape
    y = np.minimum(np.arange(shape[0]) * step, rows - 1 - h)[:, None]
    x = np.minimum(np.arange(shape[1]) * step, columns - 1 - w)
    inside = counts[y + h, x + w] - counts[y, x + w] + counts[y, x] - counts[y + h, x]
    return np.asarray(inside / np.float32(h * w), np.float32)


def _refined_candidates(
    levels: _Levels, scores: FloatImage, *, wide: bool
) -> tuple[list[tuple[Peak, Candidate]], bool, float]:
    """Refine candidates until they exclude every other position.

    Args:
        levels: of window and template.
        scores: on the coarsest level.
        wide: refine more of them, also if they do not exclude every other position; else return nothing as soon as
            that is known.

    Returns:
        Each refined position with its candidate; whether these exclude every other position; and the best coarse
        score of those that lie at the window's edge, and were not refined.
    """
    loss, count = levels.loss, _CANDIDATES_WIDE if wide else _CANDIDATES
    found: list[tuple[Peak, Candidate]] = []
    best, error, unresolved, is_certain = -math.inf, 0.0, -1.0, True
    for index, candidate in enumerate(best_positions(scores, _SEPARATION_PX, count + 1)):
        if found and is_certain and candidate[2] + error < best:
            break  # candidates are in falling order: none of the rest can win
        refined, is_peak = _refined(levels, scores, *candidate[:2]) if index < count else (None, False)
        is_certain = is_certain and is_peak
        if not (wide or is_certain):
            return [], False, unresolved
        if refined is None:
            unresolved = max(unresolved, candidate[2]) if index < count else unresolved
            continue
        found.append((refined, candidate))
        best = max(best, refined.score)
        error = max(error, 2.0 * abs(refined.score - candidate[2]) + 0.01, loss * best + 0.01)
    return found, is_certain, unresolved


def _phase_loss(fine: FloatImage, coarse: FloatImage) -> float:
    """Loss of a perfect match on the coarser of two levels if it lies between that level's pixels."""
    between = halved(fine[1:, 1:]).ravel()
    model = coarse[: (fine.shape[0] - 1) // 2, : (fine.shape[1] - 1) // 2].ravel()
    norm = math.sqrt(float(np.dot(between, between)) * float(np.dot(model, model)))
    return 1.0 - float(np.dot(between, model)) / norm if norm > 0.0 else 1.0


def _coarse_rest(
    scores: FloatImage, rivals: list[Candidate], scale: int, best: Peak, exclusion_px: float
) -> float:
    """The best coarse score outside the peak's exclusion zone and away from the refined rivals."""
    remaining, r = scores.copy(), _SEPARATION_PX
    for x, y, _ in rivals:
        remaining[max(0, y - r) : y + r + 1, max(0, x - r) : x + r + 1] = -1.0
    return best_outside(remaining, best.x / scale, best.y / scale, exclusion_px / scale)


def _refined(levels: _Levels, scores: FloatImage, x: int, y: int) -> tuple[Peak | None, bool]:
    """A coarse position at full resolution, and whether it is a maximum there and not at the edge of anything.

    None if it is on the border of the coarse level, or too much of it on nodata.
    """
    if not (0 < y < scores.shape[0] - 1 and 0 < x < scores.shape[1] - 1):
        return None, False
    part, model, scale = levels.parts[0], levels.models[0], levels.scale
    dx, dy, _ = fit_peak(scores[y - 1 : y + 2, x - 1 : x + 2].astype(np.float64))
    y, x = round(scale * (y + dy)), round(scale * (x + dx))
    scorer = LocalScores(part.image, model, (y, x), part.counts, levels.min_overlap)
    for steps_left in reversed(range(scorer.REACH)):  # each looks one pixel further
        if not all(2 <= v <= n - 2 for v, n in zip((y, x), scorer.limits, strict=True)):
            return None, False
        around = scorer.at(y + NEAR[0], x + NEAR[1]).reshape(3, 3)
        if around.max() <= -1.0:
            return None, False
        if steps_left == 0:
            return Peak(x, y, float(around[1, 1]), -1.0, np.zeros((2, 2))), False
        best = int(around.argmax())
        if best == 4:
            break
        y, x = y + best // 3 - 1, x + best % 3 - 1
    wide = np.zeros((5, 5))
    wide[1:4, 1:4] = around
    wide[FAR[0] + 2, FAR[1] + 2] = scorer.at(y + FAR[0], x + FAR[1])
    dx, dy, curvature = fit_peak(wide)
    return Peak(x + dx, y + dy, float(around[1, 1]), -1.0, curvature), True
