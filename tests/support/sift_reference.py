"""SIFT as Lowe's paper has it, in float64 and one keypoint at a time: the oracle of the compiled loops.

Keypoints are rows x, y, growth, contrast, level, octave, in pixels of the octave, as in :mod:`engine.sift.loops`.
"""

import math

import numpy as np
from scipy.ndimage import map_coordinates, maximum_filter

from engine.sift.scale_space import FIRST_SIGMA_PX, SCALES, Octave

Array = np.ndarray
BORDER, EARLY, MOVES, MAX_SHIFT, EDGE_RATIO = 4, 0.8, 2, 0.7, 10.0


def gaussian_matrix(inputs: int, sigma: float, up: int) -> Array:
    """(outputs, inputs): G[i, j] ~ exp(-(i / up - j)^2 / (2 sigma^2)) within 3 sigma, mirrored at the ends."""
    near = math.ceil(3.0 * sigma)
    out, source = np.arange(up * (inputs - 1) + 1)[:, None], np.arange(-near, inputs + near + up)
    weights = np.exp(-0.5 * ((out / up - source) / max(sigma, 1e-3)) ** 2)
    weights *= (source - out // up >= -near) & (source - out // up < near + up)
    weights /= weights.sum(axis=1, keepdims=True)
    folded = np.zeros((len(out), inputs))
    for column, j in enumerate(np.pad(np.arange(inputs), (near, near + up), mode="reflect")):
        folded[:, j] += weights[:, column]
    return folded


def levels_of(image: Array, octaves: tuple[Octave, ...]) -> list[Array]:
    """The Gaussian levels (L, H, W) of every octave."""
    found, source = [], image.astype(np.float64)
    for octave in octaves:
        down, across = ([gaussian_matrix(n, sigma, octave.up) for sigma in octave.sigmas] for n in source.shape)
        found.append(np.stack([down[level] @ source @ across[level].T for level in range(SCALES + 3)]))
        source = found[-1][SCALES, ::2, ::2]
    return found


def keypoints_of(levels: list[Array], contrast_threshold: float) -> Array:
    """(K, 6) extrema of |DoG|, refined, without those of low contrast and on edges."""
    rows = [
        row
        for octave, gaussians in enumerate(levels)
        for dog in [np.diff(gaussians, axis=0)]
        for place in _extrema(dog, EARLY * contrast_threshold / SCALES)
        if (row := _refined(dog, place, contrast_threshold / SCALES, octave)) is not None
    ]
    return np.array(rows).reshape(-1, 6)


def _extrema(dog: Array, threshold: float) -> Array:
    size = np.abs(dog)
    is_top = (size >= maximum_filter(size, 3)) & (size >= threshold)
    is_top[[0, -1]] = is_top[:, :BORDER] = is_top[:, -BORDER:] = False
    is_top[:, :, :BORDER] = is_top[:, :, -BORDER:] = False
    return np.argwhere(is_top)


def _refined(dog: Array, place: Array, threshold: float, octave: int) -> tuple[float, ...] | None:
    highest = np.array([SCALES, *(np.array(dog.shape[1:]) - 2)])
    for move in range(MOVES + 1):
        gradient, hessian = _derivatives(dog[tuple(slice(n - 1, n + 2) for n in place)])
        shift = -np.linalg.solve(hessian + 1e-300 * np.eye(3), gradient)
        if move < MOVES:
            place = np.clip(place + np.where(np.abs(shift) > 0.5, np.sign(shift), 0).astype(int), 1, highest)
    contrast = abs(dog[tuple(place)] + gradient @ shift / 2.0)
    trace, determinant = hessian[1, 1] + hessian[2, 2], np.linalg.det(hessian[1:, 1:])
    if contrast < threshold or np.abs(shift).max() >= MAX_SHIFT or determinant <= 0.0:
        return None
    if trace**2 * EDGE_RATIO >= (EDGE_RATIO + 1.0) ** 2 * determinant:
        return None
    level, y, x = place + shift
    return x, y, 2.0 ** (level / SCALES), contrast, place[0], octave


def _derivatives(cube: Array) -> tuple[Array, Array]:
    """Gradient and Hessian over (level, y, x) by central differences."""

    def at(level: int, y: int, x: int) -> float:
        return float(cube[1 + level, 1 + y, 1 + x])

    axes = np.eye(3, dtype=int)
    gradient = np.array([(at(*a) - at(*-a)) / 2.0 for a in axes])
    hessian = np.empty((3, 3))
    for i, a in enumerate(axes):
        hessian[i, i] = at(*a) + at(*-a) - 2.0 * at(0, 0, 0)
        for j, b in enumerate(axes[:i]):
            hessian[i, j] = hessian[j, i] = (at(*a + b) + at(*-a - b) - at(*a - b) - at(*b - a)) / 4.0
    return gradient, hessian


def strongest(keypoints: Array, mask: Array, upsample: int, most: int, spread: int) -> list[int]:
    """Indices of the keypoints that are kept, in order: those within their cell's share, then the others."""
    height, width = mask.shape
    sides = [(n - 1) + 1 / upsample for n in (width, height)]
    strength = keypoints[:, 3] * np.sqrt(FIRST_SIGMA_PX * keypoints[:, 2] * 2.0 ** keypoints[:, 5])
    held: dict[tuple[int, ...], int] = {}
    first, later = [], []
    for i in np.argsort(-strength, kind="stable"):
        x, y = keypoints[i, :2] * np.float32(2.0 ** keypoints[i, 5] / upsample)
        if not mask[min(round(y), height - 1), min(round(x), width - 1)]:
            continue
        cell = tuple(min(int(n * spread / side), spread - 1) for n, side in zip((x, y), sides, strict=True))
        held[cell] = held.get(cell, 0) + 1
        is_crowded = spread > 1 and held[cell] - 1 >= 2 * most / spread**2
        (later if is_crowded else first).append(int(i))
    return (first + later)[:most]


def gradients(level: Array, keypoint: Array, first_sigma: float, turn: float, samples: int, step: float) -> Array:
    """(2, S, S) differences along x and y of a bilinear grid about a keypoint, turned; steps are in sigmas."""
    ramp = (np.arange(samples + 2) - 0.5 * (samples + 1)) * step * first_sigma * keypoint[2]
    v, u = np.meshgrid(ramp, ramp, indexing="ij")
    x = keypoint[0] + math.cos(turn) * u - math.sin(turn) * v
    y = keypoint[1] + math.sin(turn) * u + math.cos(turn) * v
    patch = map_coordinates(level, [y, x], order=1, mode="nearest")
    return np.stack([patch[1:-1, 2:] - patch[1:-1, :-2], patch[2:, 1:-1] - patch[:-2, 1:-1]])


def angle_of(level: Array, keypoint: Array, first_sigma: float) -> float:
    """Radians from +x towards +y of the highest of 36 bins, smoothed by 1 4 6 4 1 and refined by a parabola."""
    gx, gy = gradients(level, keypoint, first_sigma, 0.0, 13, 0.75)
    ramp = (np.arange(13) - 6) * 0.75
    window = np.exp(-0.5 * (ramp[:, None] ** 2 + ramp**2) / 1.5**2)
    bins = np.rint(np.arctan2(gy, gx) * 36 / math.tau).astype(int) % 36
    histogram = np.bincount(bins.ravel(), (np.hypot(gx, gy) * window).ravel(), 36)
    smooth = sum(w / 16 * np.roll(histogram, k) for k, w in zip(range(-2, 3), (1, 4, 6, 4, 1), strict=True))
    top = int(smooth.argmax())
    left, middle, right = (smooth[(top + k) % 36] for k in (-1, 0, 1))
    return (top + 0.5 * (left - right) / min(left - 2.0 * middle + right, -1e-12)) * math.tau / 36


def descriptor_of(level: Array, keypoint: Array, first_sigma: float, turn: float) -> Array:
    """(128,): each gradient is shared by its two directions and by its four cells, bilinearly in the cells."""
    gx, gy = gradients(level, keypoint, first_sigma, turn, 12, 1.0)
    ramp = (np.arange(12) - 5.5) / 3.0
    size = np.hypot(gx, gy) * np.exp(-0.5 * (ramp[:, None] ** 2 + ramp**2) / 4.0)
    sector = np.arctan2(gy, gx) % math.tau / (math.pi / 4.0)
    first, part = sector.astype(int) % 8, (sector % 1.0) * math.pi / 4.0
    # The vector is the sum of its shares along both directions, 45 degrees apart.
    along, across = size * np.sin(math.pi / 4.0 - part), size * np.sin(part)
    both = (first[..., None] == np.arange(8), (first[..., None] + 1) % 8 == np.arange(8))
    shares = along[..., None] * both[0] + across[..., None] * both[1]
    tents = np.maximum(0.0, 1.0 - np.abs(ramp[:, None] - (np.arange(4) - 1.5)))
    return normalised(np.einsum("vj,ui,vud->jid", tents, tents, shares).ravel())


def normalised(descriptor: Array) -> Array:
    """The root of what sums to 1, entries bounded by 0.2 before."""
    bounded = np.minimum(descriptor / max(np.linalg.norm(descriptor), 1e-12), 0.2)
    return np.sqrt(bounded / max(bounded.sum(), 1e-12))
