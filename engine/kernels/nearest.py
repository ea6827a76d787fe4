"""The two nearest of many descriptors for the CPU, compiled by numba: one pass over a table of cosines."""

from __future__ import annotations

import numpy as np

from engine.runtime.jit import compiled, inlined


@compiled("(f4[:, ::1], f4[:, ::1], f4[:, ::1], f4, f4, i8, f4[::1], i8[::1], f4[::1], b1[::1])")
def two_nearest(cosine, own, other, least_cos, most_log, start, best, index, second, mutual):
    """For each query: the largest cosine among allowed pairs so far, its row, and the second largest.

    Args:
        cosine: (M, N) float32 of M others with N queries; those of pairs that are not allowed are overwritten.
        own: (3, N) float32 of the queries: logarithm of scale, NaN where not valid; cosine and sine of the angle.
        other: (3, M) float32 likewise of the others, by the known rotation and scale.
        least_cos: of the difference of two angles; -2 allows all.
        most_log: difference of two logarithms of scale; infinite allows all.
        start: index of the first of these rows among all.
        best: (N,) float32 the largest cosine of the rows before, minus infinity if there is none; updated.
        index: (N,) int64 its row among all, the first of equal ones; updated.
        second: (N,) float32 the second largest, minus infinity if there is only one row; updated.
        mutual: (N,) bool whether no other query has a larger cosine with that row; updated.
    """
    for m in range(len(cosine)):
        row, at = cosine[m], np.int64(start + m)
        _forbid_scales(row, own[0], other[0, m], most_log)
        if least_cos > -1:
            _forbid_angles(row, own[1], own[2], other[1, m], other[2, m], least_cos)
        for n in range(row.size):  # over all queries at once, which is vectorised
            value, top, next_best = row[n], best[n], second[n]
            is_best = value > top
            rest = top if is_best else value
            second[n] = rest if rest > next_best else next_best
            index[n] = at if is_best else index[n]
            best[n] = value if is_best else top
    for n in range(best.size):
        if index[n] >= start:
            row, larger = cosine[index[n] - start], 0
            for k in range(row.size):
                larger += row[k] > best[n]
            mutual[n] = larger == 0


@inlined
def _forbid_scales(row, logs, own, most):
    """Forbid pairs of other scales, and by a comparison with NaN those that are not valid."""
    forbidden = np.float32(-np.inf)
    for m in range(row.size):
        row[m] = row[m] if abs(logs[m] - own) <= most else forbidden


@inlined
def _forbid_angles(row, cos, sin, own_cos, own_sin, least):
    forbidden = np.float32(-np.inf)
    for m in range(row.size):
        row[m] = row[m] if own_cos * cos[m] + own_sin * sin[m] >= least else forbidden
