"""SIFT on the CPU: compiled loops over one picture at a time, whose scale space fits into the cache.

Keypoints are rows (K, 6) float32 in the pixels of their octave: x, y, sigma over that of the octave's first level,
contrast, level, octave.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.kernels import sift_descriptors
from engine.kernels.sift_extrema import TAPS, find_extrema
from engine.kernels.sift_refinement import refine_extrema
from engine.runtime import threads
from engine.sift.descriptors import ORIENT_STEP, orientation_weights, tents
from engine.sift.scale_space import EDGE_RATIO, FIRST_SIGMA_PX, SCALES, TRUNCATE, Octave, octaves_of
from engine.sift.values import Features, SiftChoice

AnyArray = NDArray[Any]
Floats = NDArray[np.float32]
Filters = tuple[Floats, NDArray[np.int64]]

_BORDER = 4  # octave pixels along the edge without keypoints
_EARLY = 0.8  # share of the contrast threshold that a voxel must reach before it is refined
_MOVES = 2  # times that a keypoint may move to a neighbouring voxel
_MAX_SHIFT = 0.7  # distance from the last voxel, in voxels, beyond which a refinement has not converged
_X, _Y, _GROWTH, _CONTRAST, _, _OCTAVE = range(6)


@dataclass(frozen=True, slots=True)
class LoopPlan:
    """What the loops need to know of pictures of one shape.

    Attributes:
        octaves: layout in the buffer of Gaussian levels.
        table: (octaves, 5) int64, the octaves' layouts.
        upsample: samples per image pixel of the first octave.
    """

    octaves: tuple[Octave, ...]
    table: NDArray[np.int64]
    upsample: int

    @property
    def first_sigma(self) -> np.float32:
        """Sigma of each octave's first level in pixels of the octave."""
        return np.float32(FIRST_SIGMA_PX * self.upsample)


@lru_cache(maxsize=256)
def plan_loops(height: int, width: int, upsample: int) -> LoopPlan:
    """Lay out the octaves of a picture.

    Args:
        height: of the picture.
        width: of the picture.
        upsample: 1 or 2.
    """
    octaves = octaves_of(height, width, upsample)
    return LoopPlan(octaves, np.array([octave.layout for octave in octaves]), upsample)


@lru_cache(maxsize=16)
def filters(sigmas: tuple[float, ...], up: int) -> Filters:
    """Gaussian filters of all levels along one axis.

    Args:
        sigmas: of the levels, in pixels of the input; 0 copies.
        up: outputs per input, 1 or 2.

    Returns:
        Weights (levels, up, taps), and reach (levels,) to either side in pixels of the input.
    """
    reach = np.ceil(TRUNCATE * np.array(sigmas)).astype(np.int64)
    taps = -(-(2 * reach.max() + up) // TAPS) * TAPS
    offsets = np.arange(taps) - reach[:, None, None]  # (levels, 1, taps)
    phase = np.arange(up).reshape(1, -1, 1) / up
    weights = np.exp(-0.5 * ((offsets - phase) / np.maximum(np.array(sigmas), 1e-3).reshape(-1, 1, 1)) ** 2)
    weights *= offsets < reach[:, None, None] + up
    weights /= weights.sum(-1, keepdims=True)
    return weights.astype(np.float32), reach


def find_features(pictures: Floats, allowed: NDArray[np.bool_] | None, choice: SiftChoice) -> Features:
    """The strongest features of pictures, one at a time.

    Args:
        pictures: (B, H, W).
        allowed: (B, 1, H, W), True where keypoints are allowed; None is everywhere.
        choice: which keypoints to keep and describe.

    Returns:
        Features as arrays.
    """
    size = (len(pictures), choice.max_keypoints)
    points, scales, angles = (np.zeros((*size, *shape), np.float32) for shape in ((2,), (), ()))
    descriptors, valid = np.zeros((*size, 128), np.float32), np.zeros(size, np.bool_)

    def work(image: int) -> None:
        found = _of_picture(pictures[image], None if allowed is None else allowed[image, 0], choice)
        valid[image, : len(found[0])] = True
        for slot, values in zip((points, scales, angles, descriptors), found, strict=True):
            slot[image, : len(values)] = values

    threads.in_parallel(work, range(len(pictures)))
    return Features(points, scales, angles, descriptors, valid)


def _of_picture(image: Floats, mask: NDArray[np.bool_] | None, choice: SiftChoice) -> tuple[Floats, ...]:
    """Positions, scales, angles in degrees and descriptors of the keypoints of one picture (H, W)."""
    plan = plan_loops(*image.shape, choice.upsample)
    gaussians, keypoints = detect(image, plan, choice.contrast_threshold)
    keypoints = strongest(keypoints, plan, mask, choice.max_keypoints, choice.spread)
    if choice.up_rad is None:
        angle_rad = dominant_angle(gaussians, keypoints, plan)
    else:
        angle_rad = np.full(len(keypoints), choice.up_rad, np.float32)
    descriptors = describe(gaussians, keypoints, angle_rad, plan)
    angle_deg = np.remainder(np.rad2deg(angle_rad), np.float32(360))
    return xy_px(keypoints, plan), scale_px(keypoints), angle_deg, descriptors


def detect(image: Floats, plan: LoopPlan, contrast_threshold: float) -> tuple[Floats, Floats]:
    """Find the extrema of all octaves, refine them, and drop those of low contrast and on edges.

    Args:
        image: (H, W), contiguous.
        plan: of its shape.
        contrast_threshold: Lowe's.

    Returns:
        The Gaussian levels (N,), which the thread's next call overwrites; and keypoints (K, 6).
    """
    buffer = threads.own_array("scale space", (plan.octaves[-1].end,), np.float32)
    found, source = [], image
    threshold = contrast_threshold / SCALES
    limits = (SCALES, _MOVES, threshold, _MAX_SHIFT, EDGE_RATIO)
    for number, octave in enumerate(plan.octaves):
        layout, of_octave = octave.layout, filters(octave.sigmas, octave.up)
        early, margin = np.float32(_EARLY * threshold), int(of_octave[1].max()) + TAPS
        padded = cv2.copyMakeBorder(source, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
        # Each part filters again what its neighbours' filters reach, and has at least as many rows of its own.
        voxels = _in_parts(
            lambda part: find_extrema(padded, of_octave, buffer, layout, part, _BORDER, early),  # noqa: B023
            threads.parts(octave.height, octave.height // (2 * octave.up * margin)),
        )
        found.append(refine_extrema(buffer, layout, voxels, limits, number))
        start = octave.offset + SCALES * octave.per_level
        level = buffer[start : start + octave.per_level].reshape(octave.height, octave.width)
        source = level[::2, ::2]
    return buffer, np.concatenate(found)


def strongest(
    keypoints: Floats, plan: LoopPlan, mask: NDArray[np.bool_] | None, max_keypoints: int, spread: int
) -> Floats:
    """The keypoints to keep by precedence.

    Strength is contrast times the root of scale, since of two keypoints of equal contrast the coarser is detected
    more reliably.

    Args:
        keypoints: (K, 6).
        plan: of their picture.
        mask: (H, W), True where keypoints are allowed; None is everywhere.
        max_keypoints: how many are kept.
        spread: cells along each side of the picture; keypoints beyond a cell's double share come last.

    Returns:
        (M, 6) at most ``max_keypoints`` of them.
    """
    pixel_px = _pixel_px(keypoints, plan)
    x, y = keypoints[:, _X] * pixel_px, keypoints[:, _Y] * pixel_px
    if mask is not None:
        column = np.clip(np.rint(x).astype(np.intp), 0, mask.shape[1] - 1)
        row = np.clip(np.rint(y).astype(np.intp), 0, mask.shape[0] - 1)
        allowed = mask[row, column]
        keypoints, x, y = keypoints[allowed], x[allowed], y[allowed]
    order = np.argsort(-keypoints[:, _CONTRAST] * np.sqrt(scale_px(keypoints)), kind="stable")
    octave = plan.octaves[0]
    column = np.clip((x * (plan.upsample * spread / octave.width)).astype(np.int64), 0, spread - 1)
    row = np.clip((y * (plan.upsample * spread / octave.height)).astype(np.int64), 0, spread - 1)
    is_crowded = _rank((row * spread + column)[order]) >= 2 * max_keypoints / spread**2
    kept = np.argsort(is_crowded, kind="stable")[:max_keypoints]
    return np.asarray(keypoints[order[kept]], np.float32)


def _rank(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many before each element (N,) are of the same group."""
    order = np.argsort(group, kind="stable")
    rank, ordered = np.empty_like(order), group[order]
    rank[order] = np.arange(len(group)) - np.searchsorted(ordered, ordered)
    return rank


def dominant_angle(gaussians: Floats, keypoints: Floats, plan: LoopPlan) -> Floats:
    """Direction of the highest peak in the histogram of gradient directions.

    Args:
        gaussians: (N,) levels.
        keypoints: (K, 6).
        plan: of their picture.

    Returns:
        (K,) radians from +x towards +y.
    """
    window, smooth = orientation_weights()
    step = np.float32(ORIENT_STEP) * plan.first_sigma
    return _in_parts(
        lambda part: sift_descriptors.angles(gaussians, plan.table, keypoints[slice(*part)], step, window, smooth),
        threads.parts(len(keypoints), len(keypoints)),
    )


def describe(gaussians: Floats, keypoints: Floats, angle_rad: Floats, plan: LoopPlan) -> Floats:
    """4 x 4 cells of 8 orientations in the keypoints' frames, as RootSIFT.

    Args:
        gaussians: (N,) levels.
        keypoints: (K, 6).
        angle_rad: (K,) from +x towards +y.
        plan: of their picture.

    Returns:
        (K, 128) of unit L2 norm.
    """
    return _in_parts(
        lambda part: sift_descriptors.descriptors(
            gaussians, plan.table, keypoints[slice(*part)], angle_rad[slice(*part)], plan.first_sigma, tents()
        ),
        threads.parts(len(keypoints), len(keypoints)),
    )


def xy_px(keypoints: Floats, plan: LoopPlan) -> Floats:
    """Positions (K, 2) in pixels of the picture."""
    return np.asarray(keypoints[:, :2] * _pixel_px(keypoints, plan)[:, None], np.float32)


def scale_px(keypoints: Floats) -> Floats:
    """Sigmas (K,) in pixels of the picture."""
    return np.asarray(np.float32(FIRST_SIGMA_PX) * keypoints[:, _GROWTH] * np.exp2(keypoints[:, _OCTAVE]))


def _pixel_px(keypoints: Floats, plan: LoopPlan) -> Floats:
    """(K,) pixels of the picture per octave pixel."""
    return np.asarray(np.exp2(keypoints[:, _OCTAVE]) / np.float32(plan.upsample))


def _in_parts(work: Callable[[tuple[int, int]], AnyArray], parts: list[tuple[int, int]]) -> AnyArray:
    done = threads.in_parallel(work, parts)
    return done[0] if len(done) == 1 else np.concatenate(done)
