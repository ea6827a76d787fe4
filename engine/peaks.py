"""Peaks of correlation surfaces: the highest places, their rivals, and their summits below the pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from engine.errors import ShapeError
from engine.values import Peak

# Of surfaces of more places than this only the best place of every tile is looked at.
_TILED_PX = 1 << 18
_TILE_PX = 16


def best_places(scores: Tensor, separation_px: int, count: int) -> list[tuple[int, int, float]]:
    """The ``count`` highest places (x, y, score) of (H, W) that are more than ``separation_px`` apart.

    Of every tile of a large surface only the highest place is a candidate.
    """
    values = scores.cpu().numpy()
    if values.size > _TILED_PX:
        return _best_of_tiles(values, separation_px, count)
    left, places, r = values.copy(), [], separation_px
    for _ in range(count):
        y, x = divmod(int(left.argmax()), left.shape[1])
        score = float(left[y, x])
        if score <= -1.0:
            break
        places.append((x, y, score))
        left[max(0, y - r) : y + r + 1, max(0, x - r) : x + r + 1] = -1.0
    return places


def _best_of_tiles(values: NDArray[np.float32], separation_px: int, count: int) -> list[tuple[int, int, float]]:
    height, width = (-(-n // _TILE_PX) for n in values.shape)
    padded = np.full((height * _TILE_PX, width * _TILE_PX), -1.0, np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    tiles = padded.reshape(height, _TILE_PX, width, _TILE_PX).max(axis=(1, 3)).ravel()
    wanted = min(tiles.size, 16 * count)  # neighbouring tiles share one summit
    order = np.argpartition(-tiles, wanted - 1)[:wanted]
    places: list[tuple[int, int, float]] = []
    for index in order[np.argsort(-tiles[order], kind="stable")]:
        j, i = divmod(int(index), width)
        tile = padded[j * _TILE_PX : (j + 1) * _TILE_PX, i * _TILE_PX : (i + 1) * _TILE_PX]
        y, x = divmod(int(tile.argmax()), _TILE_PX)
        y, x, score = y + j * _TILE_PX, x + i * _TILE_PX, float(tile[y, x])
        if score > -1.0 and all(max(abs(x - u), abs(y - v)) > separation_px for u, v, _ in places):
            places.append((x, y, score))
        if len(places) == count:
            break
    return places


def find_peak(scores: Tensor, *, exclusion_px: float) -> Peak:
    """The highest place of one surface (H', W'), refined below the pixel, with its best rival.

    Args:
        scores: of one template, at least one place.
        exclusion_px: rivals nearer than this to the peak are the peak itself.

    Returns:
        Peak: (x, y) by :func:`fit_summit`, never further than half a pixel from the best whole pixel;
        unrefined on the border of the surface.
    """
    if scores.ndim != 2 or 0 in scores.shape:
        raise ShapeError(f"scores: expected (H, W) with no empty axis, got {tuple(scores.shape)}")
    values = scores.cpu().numpy()
    y, x = divmod(int(values.argmax()), values.shape[1])
    dx, dy, curvature = 0.0, 0.0, np.zeros((2, 2))
    r = min(2, x, y, values.shape[1] - 1 - x, values.shape[0] - 1 - y)
    if r > 0:
        dx, dy, curvature = fit_summit(values[y - r : y + r + 1, x - r : x + r + 1].astype(np.float64))
    second = _second_score(values, x, y, exclusion_px)
    return Peak(x + dx, y + dy, float(values[y, x]), second, curvature)


def _second_score(scores: NDArray[np.float32], x: int, y: int, exclusion_px: float) -> float:
    """The best of (H, W) outside a disc about the peak: the strips around the disc's box, then its corners."""
    height, width = scores.shape
    r = int(exclusion_px)
    x0, x1, y0, y1 = max(0, x - r), min(width, x + r + 1), max(0, y - r), min(height, y + r + 1)
    rows, columns = np.ogrid[y0 - y : y1 - y, x0 - x : x1 - x]
    outside = [scores[:y0], scores[y1:], scores[y0:y1, :x0], scores[y0:y1, x1:]]
    outside.append(scores[y0:y1, x0:x1][rows * rows + columns * columns > exclusion_px * exclusion_px])
    return max((float(part.max()) for part in outside if part.size), default=-1.0)


# The neighbourhood of a peak as rows and columns (dy, dx): 3 x 3 places, and the four two pixels away.
NEAR = np.array([[-1, -1, -1, 0, 0, 0, 1, 1, 1], [-1, 0, 1, -1, 0, 1, -1, 0, 1]])
FAR = np.array([[-2, 2, 0, 0], [0, 0, -2, 2]])
# Powers (i, j) of the polynomials c[i, j] x^i y^j that follow it: a quadratic by least squares over the 3 x 3;
# and, since a peak is sharper than a parabola, one of degree 4 that goes through all 13.
_QUADRATIC = [(0, 0), (1, 0), (2, 0), (0, 1), (0, 2), (1, 1)]
_QUARTIC = [*_QUADRATIC, (3, 0), (4, 0), (0, 3), (0, 4), (2, 1), (1, 2), (2, 2)]


def _derivatives(places: NDArray[np.int64], powers: list[tuple[int, int]], n: int) -> NDArray[np.float64]:
    """Takes the scores at places (dy, dx) to d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2 of the polynomial, n x n each."""
    y, x = places.astype(float)
    inverse = np.linalg.pinv(np.stack([x**i * y**j for i, j in powers], axis=1))
    c = np.zeros((n, n, places.shape[1]))
    for row, power in zip(inverse, powers, strict=True):
        c[power] = row
    slope = np.diag(np.arange(1.0, n), 1)
    in_x, in_y = np.einsum("ai,ijp->ajp", slope, c), np.einsum("bj,ijp->ibp", slope, c)
    in_xx, in_xy = np.einsum("ai,ijp->ajp", slope, in_x), np.einsum("bj,ijp->ibp", slope, in_x)
    return np.stack([in_x, in_y, in_xx, in_xy, np.einsum("bj,ijp->ibp", slope, in_y)]).reshape(5 * n * n, -1)


_WIDE = np.concatenate([NEAR, FAR], axis=1)
_SUMMITS = {3: (NEAR + 1, _derivatives(NEAR, _QUADRATIC, 3)), 5: (_WIDE + 2, _derivatives(_WIDE, _QUARTIC, 5))}
_NEWTON_STEPS = 5
_NEWTON_END_PX = 1e-4


def fit_summit(patch: NDArray[np.float64]) -> tuple[float, float, NDArray[np.float64]]:
    """Offset (dx, dy) of the summit of a 3 x 3 or 5 x 5 patch from its centre, and its second derivatives (2, 2).

    By Newton's method from the centre, on the polynomial through the neighbourhood of the centre. Where the way
    does not lead to a summit within half a pixel, the offset is cut off there.
    """
    n = patch.shape[0]
    places, take = _SUMMITS[n]
    derivatives = (take @ patch[places[0], places[1]]).reshape(5, n, n)
    orders = np.arange(n)
    x = y = 0.0
    for _ in range(_NEWTON_STEPS):
        gx, gy, xx, xy, yy = (derivatives @ y**orders @ x**orders).tolist()
        determinant = xx * yy - xy * xy
        if xx >= 0 or determinant <= 0:  # no summit: a ridge, a saddle
            break
        last_x, last_y = x, y
        x = min(0.5, max(-0.5, x - (yy * gx - xy * gy) / determinant))
        y = min(0.5, max(-0.5, y - (xx * gy - xy * gx) / determinant))
        if n == 3 or abs(x - last_x) + abs(y - last_y) < _NEWTON_END_PX:  # a quadratic takes one step
            break
    return x, y, np.array([[xx, xy], [xy, yy]])
