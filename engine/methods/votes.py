"""The vote for a translation: of matches between an orthophoto and the map, most wrong, those that agree.

Every match says where the orthophoto lies. Right ones say nearly the same, wrong ones anything: the densest place
wins also where nine in ten are wrong. Small turns and changes of scale are tried as well.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TURNS_DEG = (0.0, -6.0, 6.0)
"""By which an orthophoto may be turned, since a heading may be wrong."""
SCALES = (1.0, 0.93, 1.075)
"""By which it may be scaled, since a height may be wrong."""
_ROUNDS = 4  # of the mean shift from the fullest cells to the middle of the votes
_MAX_SIDE = 2048  # cells along a side of the histogram


@dataclass(frozen=True, slots=True)
class Vote:
    """What most matches agree on.

    Attributes:
        turn_deg: of the orthophoto about its middle, from +x towards +y.
        scale: of the orthophoto about its middle.
        voters: (M,) bool, the matches that agree.
        shift_px: (2,) from the orthophoto, turned and scaled, to the map.
    """

    turn_deg: float
    scale: float
    voters: NDArray[np.bool_]
    shift_px: Array

    @property
    def votes(self) -> int:
        """How many agree."""
        return int(np.count_nonzero(self.voters))


def vote(photo_px: Array, map_px: Array, radius_px: float) -> Vote | None:
    """The translation that most matches agree on.

    Args:
        photo_px: (M, 2) in the orthophoto, about its middle.
        map_px: (M, 2) on the map.
        radius_px: matches within it of a translation agree with it.

    Returns:
        Vote | None: None without a match. Of equal ones the first, so that a turn needs more votes than none.
    """
    best: Vote | None = None
    for turn_deg, scale in itertools.product(TURNS_DEG, SCALES):
        shifts = map_px - photo_px @ similarity(turn_deg, scale).T
        voters = densest(shifts, radius_px)
        if voters.any() and (best is None or np.count_nonzero(voters) > best.votes):
            best = Vote(turn_deg, scale, voters, shifts[voters].mean(axis=0))
        if best is not None and 2 * best.votes > len(map_px):
            break  # a majority needs no further search
    return best


def similarity(turn_deg: float, scale: float) -> Array:
    """(2, 2) matrix that turns from +x towards +y and scales."""
    turn = math.radians(turn_deg)
    return scale * np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])


def densest(points: Array, radius: float) -> NDArray[np.bool_]:
    """Which of some points lie within a radius of the place about which most lie.

    The fullest 5 x 5 cells of a histogram, whose cells are half a radius wide, give the place nearly; from there
    the mean of the points within the radius is followed.

    Args:
        points: (M, 2).
        radius: in their unit.

    Returns:
        (M,) bool.
    """
    if not len(points):
        return np.zeros(0, np.bool_)
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())
    cell = max(radius / 2.0, extent / _MAX_SIDE)
    columns, rows = ((points - low) / cell).astype(np.intp).T
    shape = (int(rows.max()) + 1, int(columns.max()) + 1)
    counts = np.bincount(rows * shape[1] + columns, minlength=shape[0] * shape[1]).reshape(shape)
    sums = cv2.boxFilter(counts.astype(np.float32), -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    row, column = np.unravel_index(int(sums.argmax()), sums.shape)
    center = low + (np.array([column, row]) + 0.5) * cell
    near = _within(points, center, 1.25 * radius)
    best = near & False
    for _ in range(_ROUNDS):
        if not near.any():
            break
        near = _within(points, points[near].mean(axis=0), radius)
        if np.count_nonzero(near) > np.count_nonzero(best):
            best = near
    return best


def _within(points: Array, center: Array, radius: float) -> NDArray[np.bool_]:
    offsets = points - center
    return np.asarray(np.einsum("ij,ij->i", offsets, offsets) <= radius * radius)
