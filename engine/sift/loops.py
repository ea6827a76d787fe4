"""SIFT on the CPU: compiled loops over one picture at a time, whose scale space fits into the cache.

Keypoints are rows (K, 6) float32 in the pixels of their octave: x, y, sigma over that of the octave's first level,
contrast, level, octave.
"""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.kernels import sift_descriptors
from engine.kernels.sift_extrema import TAPS, find_extrema
from engine.kernels.sift_refinement import refine_extrema
from engine.runtime import threads
from engine.sift.descriptors import ORIENT_STEP, ORIENT_WINDOW, SMOOTHING, TENTS
from engine.sift.scale_space import EDGE_RATIO, FIRST_SIGMA_PX, SCALES, TRUNCATE, Octave, octaves_of
from engine.sift.values import Features, SiftChoice, ranks_within

Floats = NDArray[np.float32]
Octaves = tuple[Octave, ...]

_BORDER = 4  # octave pixels along the edge without keypoints
_EARLY = 0.8  # share of the contrast threshold that a voxel must reach before it is refined
_MOVES = 2  # times that a keypoint may move to a neighbouring voxel
_MAX_SHIFT = 0.7  # distance from the last voxel, in voxels, beyond which a refinement has not converged
_, _, _GROWTH, _CONTRAST, _, _OCTAVE = range(6)


@lru_cache(maxsize=16)
def filters(sigmas: tuple[float, ...], up: int) -> tuple[Floats, NDArray[np.int64]]:
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
    octaves = octaves_of(*image.shape, int(choice.upsample))
    gaussians, keypoints = detect(image, octaves, choice.contrast_threshold)
    keypoints = strongest(keypoints, octaves, mask, choice.max_keypoints, choice.spread)
    angle_rad, descriptors = describe(gaussians, keypoints, choice.up_rad, octaves)
    angle_deg = np.remainder(np.rad2deg(angle_rad), np.float32(360))
    return xy_px(keypoints, octaves), scale_px(keypoints), angle_deg, descriptors


def detect(image: Floats, octaves: Octaves, contrast_threshold: float) -> tuple[Floats, Floats]:
    """Find the extrema of all octaves, refine them, and drop those of low contrast and on edges.

    Args:
        image: (H, W), contiguous.
        octaves: of its shape.
        contrast_threshold: Lowe's.

    Returns:
        The Gaussian levels (N,), which the thread's next call overwrites; and keypoints (K, 6).
    """
    buffer = threads.own_array("scale space", (octaves[-1].end,), np.float32)
    found, source = [], image
    threshold = contrast_threshold / SCALES
    limits = (SCALES, _MOVES, threshold, _MAX_SHIFT, EDGE_RATIO)
    for number, octave in enumerate(octaves):
        layout, of_octave = octave.layout, filters(octave.sigmas, octave.up)
        early, margin = np.float32(_EARLY * threshold), int(of_octave[1].max()) + TAPS
        padded = cv2.copyMakeBorder(source, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
        # Each part filters again what its neighbours' filters reach, and has at least as many rows of its own.
        voxels = threads.in_parallel(
            lambda part: find_extrema(padded, of_octave, buffer, layout, part, _BORDER, early),  # noqa: B023
            threads.parts(octave.height, octave.height // (2 * octave.up * margin)),
        )
        found.append(refine_extrema(buffer, layout, np.concatenate(voxels), limits, number))
        start = octave.offset + SCALES * octave.per_level
        level = buffer[start : start + octave.per_level].reshape(octave.height, octave.width)
        source = level[::2, ::2]
    return buffer, np.concatenate(found)


def strongest(
    keypoints: Floats, octaves: Octaves, mask: NDArray[np.bool_] | None, max_keypoints: int, spread: int
) -> Floats:
    """The keypoints to keep by precedence.

    Strength is contrast times the root of scale, since of two keypoints of equal contrast the coarser is detected
    more reliably.

    Args:
        keypoints: (K, 6).
        octaves: of their picture.
        mask: (H, W), True where keypoints are allowed; None is everywhere.
        max_keypoints: how many are kept.
        spread: cells along each side of the picture; keypoints beyond a cell's double share come last.

    Returns:
        (M, 6) at most ``max_keypoints`` of them.
    """
    xy, octave = xy_px(keypoints, octaves), octaves[0]
    if mask is not None:
        column, row = np.clip(np.rint(xy).astype(np.intp), 0, np.array(mask.shape)[::-1] - 1).T
        allowed = mask[row, column]
        keypoints, xy = keypoints[allowed], xy[allowed]
    order = np.argsort(-keypoints[:, _CONTRAST] * np.sqrt(scale_px(keypoints)), kind="stable")
    cells_per_px = np.array([octave.up * spread / n for n in (octave.width, octave.height)], np.float32)
    column, row = np.clip((xy * cells_per_px).astype(np.int64), 0, spread - 1).T
    is_crowded = ranks_within((row * spread + column)[order]) >= 2 * max_keypoints / spread**2
    kept = np.argsort(is_crowded, kind="stable")[:max_keypoints]
    return np.asarray(keypoints[order[kept]], np.float32)


def describe(
    gaussians: Floats, keypoints: Floats, up_rad: float | None, octaves: Octaves
) -> tuple[Floats, Floats]:
    """Angles, and 4 x 4 cells of 8 orientations in the keypoints' frames as RootSIFT.

    Args:
        gaussians: (N,) levels.
        keypoints: (K, 6).
        up_rad: every angle, from +x towards +y; None is the direction of the highest peak in the histogram of
            gradient directions.
        octaves: of their picture.

    Returns:
        (K,) radians, and (K, 128) of unit L2 norm.
    """
    table = np.array([octave.layout for octave in octaves])
    sigma = np.float32(FIRST_SIGMA_PX * octaves[0].up)  # of each octave's first level, in its pixels

    def described(part: tuple[int, int]) -> tuple[Floats, Floats]:
        own = keypoints[slice(*part)]
        if up_rad is None:
            step = np.float32(ORIENT_STEP) * sigma
            angles = sift_descriptors.angles(gaussians, table, own, step, ORIENT_WINDOW, SMOOTHING)
        else:
            angles = np.full(len(own), up_rad, np.float32)
        return angles, sift_descriptors.descriptors(gaussians, table, own, angles, sigma, TENTS)

    parts = threads.in_parallel(described, threads.parts(len(keypoints), len(keypoints)))
    angle_rad, descriptors = map(np.concatenate, zip(*parts, strict=True))
    return angle_rad, descriptors


def xy_px(keypoints: Floats, octaves: Octaves) -> Floats:
    """Positions (K, 2) in pixels of the picture."""
    pixel_px = np.exp2(keypoints[:, _OCTAVE]) / np.float32(octaves[0].up)  # of the octave's, in the picture's
    return np.asarray(keypoints[:, :2] * pixel_px[:, None], np.float32)


def scale_px(keypoints: Floats) -> Floats:
    """Sigmas (K,) in pixels of the picture."""
    return np.asarray(np.float32(FIRST_SIGMA_PX) * keypoints[:, _GROWTH] * np.exp2(keypoints[:, _OCTAVE]))
