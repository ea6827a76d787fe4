"""The two nearest of many descriptors for the CPU, compiled by numba: one pass over a table of cosines."""

import numpy as np

from engine.runtime.jit import compiled


@compiled("(f4[:, ::1], f4[::1], f4[::1], f4, i8, f4[::1], i8[::1], f4[::1], b1[::1])")
def two_nearest(cosine, own, other, most_log, start, best, index, second, mutual):
    """For each query: the largest cosine among allowed pairs so far, its row, and the second largest.

    Args:
        cosine: (M, N) float32 of M others with N queries; those of pairs that are not allowed are overwritten.
        own: (N,) float32 of the queries: logarithm of scale, NaN where not valid.
        other: (M,) float32 likewise of the others.
        most_log: difference of two logarithms of scale; infinite allows all.
        start: index of the first of these rows among all.
        best: (N,) float32 the largest cosine of the rows before, minus infinity if there is none; updated.
        index: (N,) int64 its row among all, the first of equal ones; updated.
        second: (N,) float32 the second largest, minus infinity if there is only one row; updated.
        mutual: (N,) bool whether no other query has a larger cosine with that row; updated.
    """
    forbidden = np.float32(-np.inf)
    for m in range(len(cosine)):
        row, log, at = cosine[m], other[m], np.int64(start + m)
        for n in range(row.size):  # a comparison with NaN is false
            row[n] = row[n] if abs(own[n] - log) <= most_log else forbidden
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
