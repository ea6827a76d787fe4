"""Clusters of points in the plane, compiled by numba: for a few hundred points NumPy's call overhead dominates."""

import numpy as np

from engine.runtime.jit import compiled, inlined

_MAX_SIDE = 2048  # cells along a side of the histogram
_REACH = 2  # cells in a radius, counted to either side of each


@compiled("(f8[:, ::1], f8)")
def densest(points, radius):
    """Mark the points within a radius of the place with the most points.

    The fullest 5 x 5 cells of a histogram, whose cells are half a radius wide, give the place nearly; from there
    the mean of the points within the radius is followed while their number grows.

    Args:
        points: (M, 2) float64, finite.
        radius: in their unit.

    Returns:
        (M,) bool.
    """
    count = len(points)
    best = np.zeros(count, np.bool_)
    if count == 0:
        return best
    x, y = _place_of_fullest_cells(points, radius)
    most, near = 0, np.empty(count, np.bool_)
    # The middle of the fullest cells is off by up to half a cell.
    held, x, y = _mark_near(points, x, y, radius + 0.5 * radius / _REACH, near)
    held, x, y = _mark_near(points, x, y, radius, near)
    while held > most:
        most = held
        for n in range(count):
            best[n] = near[n]
        held, x, y = _mark_near(points, x, y, radius, near)
    return best


@inlined
def _mark_near(points, x, y, radius, near):
    """Mark the points within a radius of a place; return their number and mean, or the place if there is none."""
    held, east, north = 0, 0.0, 0.0
    for n in range(len(points)):
        off_x, off_y = points[n, 0] - x, points[n, 1] - y
        near[n] = off_x * off_x + off_y * off_y <= radius * radius
        if near[n]:
            held += 1
            east += points[n, 0]
            north += points[n, 1]
    return held, east / held if held else x, north / held if held else y


@inlined
def _place_of_fullest_cells(points, radius):
    """The middle of the cell about which most points lie, the first of equal ones row by row."""
    left, top, right, bottom = points[0, 0], points[0, 1], points[0, 0], points[0, 1]
    for n in range(1, len(points)):
        left, right = min(left, points[n, 0]), max(right, points[n, 0])
        top, bottom = min(top, points[n, 1]), max(bottom, points[n, 1])
    cell = max(radius / _REACH, max(right - left, bottom - top) / _MAX_SIDE)
    rows, columns = int((bottom - top) / cell) + 1, int((right - left) / cell) + 1
    margin = 2 * _REACH
    sums = np.zeros((rows + margin, columns + margin), np.int32)
    for n in range(len(points)):  # each point counts for the cells around its own
        row = min(int((points[n, 1] - top) / cell), rows - 1)
        column = min(int((points[n, 0] - left) / cell), columns - 1)
        for i in range(margin + 1):
            for j in range(margin + 1):
                sums[row + i, column + j] += 1
    fullest, at_row, at_column = 0, 0, 0
    for row in range(rows):
        for column in range(columns):
            if sums[row + _REACH, column + _REACH] > fullest:
                fullest, at_row, at_column = sums[row + _REACH, column + _REACH], row, column
    return left + (at_column + 0.5) * cell, top + (at_row + 0.5) * cell


@compiled("(f8[::1], f8[::1], f8[::1], f8[::1], f8)")
def count_near_pairs(ax, ay, bx, by, radius):
    """How many pairs of one set's points (N,) with another's (M,) lie within a radius."""
    total = 0
    for n in range(ax.size):
        for m in range(bx.size):
            off_x, off_y = ax[n] - bx[m], ay[n] - by[m]
            total += off_x * off_x + off_y * off_y <= radius * radius
    return total


@compiled("(f8[:, ::1], f8)")
def count_apart(points, apart):
    """How many of the points (N, 2), in turn, are further than ``apart`` from all that were counted before."""
    counted, total = np.empty((len(points), 2)), 0
    for n in range(len(points)):
        for m in range(total):
            off_x, off_y = points[n, 0] - counted[m, 0], points[n, 1] - counted[m, 1]
            if off_x * off_x + off_y * off_y <= apart * apart:
                break
        else:
            counted[total] = points[n]
            total += 1
    return total
