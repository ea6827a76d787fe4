"""Peaks of correlation surfaces: the highest positions, their rivals, and sub-pixel refinement."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from engine.errors import ShapeError
from engine.runtime.device import Picture, device_of, on_host
from engine.values import Peak


def best_positions(scores: Picture, separation_px: int, count: int) -> list[tuple[int, int, float]]:
    """The highest positions of a surface that are apart from each other.

    Args:
        scores: (H, W), -1 where a position is excluded.
        separation_px: positions are more than this apart in x or in y.
        count: upper bound on their number.

    Returns:
        (x, y, score) in falling order of the score.
    """
    remaining, positions, r = on_host(scores).copy(), [], separation_px
    for _ in range(count):
        y, x = divmod(int(remaining.argmax()), remaining.shape[1])
        score = float(remaining[y, x])
        if score <= -1.0:
            break
        positions.append((x, y, score))
        remaining[max(0, y - r) : y + r + 1, max(0, x - r) : x + r + 1] = -1.0
    return positions


def find_peak(scores: Picture, *, exclusion_px: float) -> Peak:
    """The maximum of a surface, refined to sub-pixel accuracy, with its best rival.

    Args:
        scores: (H', W') of one template, at least one position.
        exclusion_px: radius about the peak within which no rival is counted.

    Returns:
        Peak: (x, y) by :func:`fit_peak`, never further than half a pixel from the best whole pixel;
        unrefined on the border of the surface.

    Raises:
        ShapeError: the surface is not (H, W), or is empty.
    """
    if scores.ndim != 2 or 0 in scores.shape:
        raise ShapeError(f"scores: expected (H, W) with no empty axis, got {tuple(scores.shape)}")
    height, width = scores.shape
    if device_of(scores).type == "cpu":
        around = on_host(scores)
        y, x = row, column = divmod(int(around.argmax()), width)
        score, second = float(around[y, x]), best_outside(around, x, y, exclusion_px)
    else:
        from engine.kernels.tensors import peak_numbers

        index, score, second, *near = peak_numbers(scores, exclusion_px)
        y, x = divmod(int(index), width)
        around, row, column = np.reshape(near, (5, 5)), 2, 2
    dx, dy, curvature = 0.0, 0.0, np.zeros((2, 2))
    r = min(2, x, y, width - 1 - x, height - 1 - y)
    if r > 0:
        patch = around[row - r : row + r + 1, column - r : column + r + 1]
        dx, dy, curvature = fit_peak(patch.astype(np.float64))
    return Peak(x + dx, y + dy, score, second, curvature)


def best_outside(scores: NDArray[np.float32], x: float, y: float, radius_px: float) -> float:
    """The best score outside a disc.

    Args:
        scores: (H, W).
        x: the disc's middle, which may lie between pixels.
        y: likewise.
        radius_px: of the disc.

    Returns:
        In [-1, 1]; -1 if no position is outside.
    """
    rest, r = scores.copy(), math.ceil(radius_px)
    top, left = max(0, math.floor(y) - r), max(0, math.floor(x) - r)
    near = rest[top : math.ceil(y) + r + 1, left : math.ceil(x) + r + 1]
    down, across = np.arange(near.shape[0]) + (top - y), np.arange(near.shape[1]) + (left - x)
    near[np.square(down)[:, None] + np.square(across) <= radius_px * radius_px] = -1.0
    return float(rest.max())


# The neighbourhood of a peak as rows and columns (dy, dx): 3 x 3 positions, and the four two pixels away.
NEAR = np.array([[-1, -1, -1, 0, 0, 0, 1, 1, 1], [-1, 0, 1, -1, 0, 1, -1, 0, 1]])
FAR = np.array([[-2, 2, 0, 0], [0, 0, -2, 2]])
# Powers (i, j) of the polynomials c[i, j] x^i y^j that follow it: a quadratic by least squares over the 3 x 3;
# and, since a peak is sharper than a parabola, one of degree 4 through all 13.
_QUADRATIC = [(i, j) for i in range(3) for j in range(3 - i)]
_QUARTIC = [*_QUADRATIC, (3, 0), (4, 0), (0, 3), (0, 4), (2, 1), (1, 2), (2, 2)]


def _derivatives(positions: NDArray[np.int64], powers: list[tuple[int, int]], n: int) -> NDArray[np.float64]:
    """Matrix from scores at positions (dy, dx) to d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2 of the polynomial, n x n."""
    y, x = positions.astype(float)
    inverse = np.linalg.pinv(np.stack([x**i * y**j for i, j in powers], axis=1))
    c = np.zeros((n, n, positions.shape[1]))
    for row, power in zip(inverse, powers, strict=True):
        c[power] = row
    slope = np.diag(np.arange(1.0, n), 1)
    in_x, in_y = np.einsum("ai,ijp->ajp", slope, c), np.einsum("bj,ijp->ibp", slope, c)
    in_xx, in_xy = np.einsum("ai,ijp->ajp", slope, in_x), np.einsum("bj,ijp->ibp", slope, in_x)
    return np.stack([in_x, in_y, in_xx, in_xy, np.einsum("bj,ijp->ibp", slope, in_y)]).reshape(5 * n * n, -1)


_WIDE = np.concatenate([NEAR, FAR], axis=1)
_SUMMITS = {3: (NEAR + 1, _derivatives(NEAR, _QUADRATIC, 3)), 5: (_WIDE + 2, _derivatives(_WIDE, _QUARTIC, 5))}
_NEWTON_STEPS = 5  # which end within 1e-8 px of the maximum


def fit_peak(patch: NDArray[np.float64]) -> tuple[float, float, NDArray[np.float64]]:
    """Sub-pixel maximum of a patch, by Newton's method from its centre on a polynomial fit.

    Args:
        patch: (3, 3) or (5, 5) scores.

    Returns:
        Offset (dx, dy) from the centre, clipped to half a pixel, and second derivatives (2, 2) per square pixel.
    """
    n = patch.shape[0]
    positions, matrix = _SUMMITS[n]
    derivatives = (matrix @ patch[positions[0], positions[1]]).reshape(5, n, n)
    orders = np.arange(n)
    x = y = 0.0
    for _ in range(1 if n == 3 else _NEWTON_STEPS):  # a quadratic needs one step
        gx, gy, xx, xy, yy = (derivatives @ y**orders @ x**orders).tolist()
        determinant = xx * yy - xy * xy
        if xx >= 0 or determinant <= 0:  # no maximum: a ridge, a saddle
            break
        x = min(0.5, max(-0.5, x - (yy * gx - xy * gy) / determinant))
        y = min(0.5, max(-0.5, y - (xx * gy - xy * gx) / determinant))
    return x, y, np.array([[xx, xy], [xy, yy]])
