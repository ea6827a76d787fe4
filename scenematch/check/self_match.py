"""Self-match: correlate a map with altered patches of itself and compute statistics.

At every audited cell, the patch that the camera would see is altered by noise, changed ground and small telemetry
errors, and correlated with the window that a prior allows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.geo import Array
from engine.kernels.scores import enhance
from engine.maps.prepared import PreparedMap
from engine.matching.correlation import MIN_VALID_SHARE
from engine.matching.covariance import score_sigma
from engine.ncc_fft import surface
from engine.runtime.device import CPU
from engine.runtime.workers import in_order, safe_count
from engine.values import Window
from engine.window import SPREAD_SIGMAS, place_window, window_size_px
from scenematch.check.plan import NCC, AuditPlan

Gray = NDArray[np.uint8]
Pictures = NDArray[np.float32]

# The alteration of a patch, the same at every cell.
_DRAWS = 2
_TURN_DEG, _SCALE, _SHIFT_PX = 1.0, 1.01, 0.4  # residual errors of telemetry and level
_NOISE_SD = 3.0  # grey levels, of the sensor
_CHANGE, _CHANGE_PX = 1.0, 2.0  # other ground: standard deviations of the enhanced picture, and grain
# Shift at the edges, and a blur: a change that only fine texture is sensitive to.
_SHAKE_PX, _SHAKE_BLUR_PX = 2.0, 1.0
_NEAR_PX = 3  # largest shift at which a changed patch counts as matched at its own position


@dataclass(frozen=True, slots=True)
class SelfMatchStatistics:
    """Statistics of cells (...,); NaN where the map has no data.

    Attributes:
        texture: deviation of the grey levels from their neighbourhood's mean.
        rival: highest NCC of the unchanged patch outside its exclusion zone.
        stability: NCC of the patch with itself, blurred, rotated and scaled a little.
        score: NCC of the changed patch at its own position, in sigmas.
        lead: ``score`` minus its best rival, in sigmas.
    """

    texture: Array
    rival: Array
    stability: Array
    score: Array
    lead: Array


# ------------------------------------------------------------------------------------------------- measuring


def measure_self_match(plan: AuditPlan) -> Iterator[SelfMatchStatistics]:
    """Yield the statistics of each audited cell, row by row, using all cores.

    A large map is read on demand, using one core.
    """
    prepared = PreparedMap(plan.site, CPU)
    noise, centers_px = _noise(plan.shape), plan.centers_px[plan.audited]

    def measured(index: int) -> SelfMatchStatistics:
        return _measure(plan, prepared, noise, centers_px[index])

    yield from in_order(measured, len(centers_px), 1 if plan.site.reads_files else safe_count())


def _noise(shape: tuple[int, int]) -> Pictures:
    """(draws, 2, h, w): the sensor's noise in grey levels, and other ground of unit deviation."""
    noise = np.random.default_rng(0).normal(size=(_DRAWS, 2, *shape)).astype(np.float32)
    noise[:, 0] *= _NOISE_SD
    for draw in noise[:, 1]:
        draw[:] = cv2.GaussianBlur(draw, (0, 0), _CHANGE_PX)
        draw /= draw.std()
    return noise


def _measure(plan: AuditPlan, prepared: PreparedMap, noise: Pictures, center_px: Array) -> SelfMatchStatistics:
    site, level, (height, width) = plan.site, plan.level, plan.shape
    middle = site.level_from_full(center_px, level)
    x0, y0 = plan.corner_px(center_px)
    extent = Window(x0, y0, width, height)
    if not plan.contains(center_px) or site.valid(extent, level).mean() < MIN_VALID_SHARE:
        return SelfMatchStatistics(*[np.array(np.nan)] * len(fields(SelfMatchStatistics)))
    gray = site.gray(extent, level)
    region = prepared.cut(_window(plan, middle), level)
    scores = surface(region.search, _templates(gray, noise), min_overlap=MIN_VALID_SHARE)
    x, y = x0 - region.window.x0, y0 - region.window.y0
    exclusion_px = NCC.exclusion_m / (site.gsd_m_per_px * 2.0**level)
    own, rivals = _own_and_rivals(scores, x, y, exclusion_px)
    leads = own - rivals
    sigma = score_sigma(height * width)
    values = [
        _texture(gray),
        rivals[0],
        own[1],
        own[2:].mean() / sigma,
        leads[2:].mean() / sigma,
    ]
    return SelfMatchStatistics(*[np.array(value, np.float64) for value in values])


def _window(plan: AuditPlan, middle_px: Array) -> Window:
    """The adaptive window (eq. 4, 5) with the slack of the prior, in pixels of the level."""
    site, level, (height, width) = plan.site, plan.level, plan.shape
    rows, columns = site.level_shape(level)
    slack = 2.0 * SPREAD_SIGMAS * plan.options.prior_sigma_m / (site.gsd_m_per_px * 2.0**level)
    size = window_size_px(plan.view.footprint_px, (0.0, 0.0))
    size = (max(size[0], width + 4 + slack), max(size[1], height + 4 + slack))
    window = place_window((float(middle_px[0]), float(middle_px[1])), size, (columns, rows))
    assert window is not None  # the cell is on the map
    return window


def _templates(gray: Gray, noise: Pictures) -> Pictures:
    """(T, h, w) enhanced: the patch unchanged, shaken, and changed (draws)."""
    part = _SHAKE_PX / (max(gray.shape) / 2.0)
    shaken = cv2.GaussianBlur(_perturbed(gray, math.degrees(part), 1.0 + part, 0.0), (0, 0), _SHAKE_BLUR_PX)
    templates = [enhance(gray), enhance(np.asarray(shaken, np.uint8))]
    for sign, (sensor, ground) in zip((1.0, -1.0), noise, strict=True):
        turned = _perturbed(gray, sign * _TURN_DEG, _SCALE**sign, sign * _SHIFT_PX)
        seen = np.clip(turned + sensor, 0.0, 255.0).astype(np.uint8)
        templates.append(enhance(seen) + _CHANGE * ground)
    return np.stack(templates)


def _perturbed(gray: Gray, angle_deg: float, scale: float, shift_px: float) -> Gray:
    """The picture rotated and scaled about its middle, and moved along its diagonal."""
    height, width = gray.shape
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2.0, (height - 1) / 2.0), angle_deg, scale)
    matrix[:, 2] += shift_px
    return np.asarray(cv2.warpAffine(gray, matrix, (width, height), borderMode=cv2.BORDER_REFLECT_101), np.uint8)


def _texture(gray: Gray) -> float:
    smooth = cv2.GaussianBlur(gray, (3, 3), 0).astype(np.float32)
    return float((smooth - cv2.blur(smooth, (17, 17))).std())


def _own_and_rivals(scores: Pictures, x: int, y: int, exclusion_px: float) -> tuple[Array, Array]:
    """The highest score (T,) at a position, and outside its exclusion zone (-1 where nothing is outside)."""
    near = scores[:, max(0, y - _NEAR_PX) : y + _NEAR_PX + 1, max(0, x - _NEAR_PX) : x + _NEAR_PX + 1]
    down, across = np.ogrid[-y : scores.shape[1] - y, -x : scores.shape[2] - x]
    outside = down * down + across * across > max(exclusion_px, _NEAR_PX) ** 2
    rivals = np.where(outside, scores, -1.0).max(axis=(1, 2))
    return near.max(axis=(1, 2)).astype(np.float64), rivals.astype(np.float64)
