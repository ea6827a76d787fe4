"""Errors by segment against a plain loop in float64, and what they are blind to."""

import math
from itertools import pairwise

import numpy as np
import pytest

from scenematch.files.track import TrackRow
from scenematch.report.metrics import TrackErrors
from scenematch.report.segments import segment_ends, segment_errors


def flown(seed=3, count=400, rate_hz=5.0):
    """A walk with a stop, refusals and errors that are known."""
    rng = np.random.default_rng(seed)
    step = rng.normal([1.2, 0.4], 0.3, (count, 2))
    step[100:140] = 0.0  # it hovers
    true = np.cumsum(step, axis=0)
    error = rng.normal(0.0, 0.5, (count, 2))
    error[rng.random(count) < 0.1] = np.nan
    rows = [TrackRow(timestamp_ns=round(i * 1e9 / rate_hz), frame=str(i), status="fix") for i in range(count)]
    return rows, TrackErrors(true, true + error, error, np.tile(np.eye(2), (count, 1, 1)))


def by_hand(along, error, asked):
    """Every pair (i, j), j not before i, nearest to the asked length and within a tenth of it."""
    off = []
    for i in range(len(along)):
        best = min(range(i, len(along)), key=lambda j: (abs(along[j] - along[i] - asked), j))
        if abs(along[best] - along[i] - asked) <= 0.1 * asked:
            off.append(math.dist(error[best], error[i]))
    return off


def test_the_table_is_that_of_a_plain_loop():
    rows, errors = flown()
    known = np.isfinite(errors.error_en_m[:, 0])
    true, error = errors.truth_en_m[known], errors.error_en_m[known]
    path = [0.0]
    for a, b in pairwise(true):
        path.append(path[-1] + math.dist(a, b))
    time = [rows[i].timestamp_ns / 1e9 for i in np.flatnonzero(known)]
    found = segment_errors(rows, errors)
    assert [row["length_m"] for row in found if "length_m" in row][:3] == [10.0, 50.0, 100.0]
    assert [row["duration_s"] for row in found if "duration_s" in row] == [1.0, 10.0, 30.0, 60.0]
    for row in found:
        along, asked = (path, row["length_m"]) if "length_m" in row else (time, row["duration_s"])
        off = by_hand(along, error, asked)
        assert row["segments"] == len(off)
        assert row["median_m"] == pytest.approx(np.median(off), abs=1e-9)
        assert row["p95_m"] == pytest.approx(np.percentile(off, 95), abs=1e-9)
        assert row["max_m"] == pytest.approx(max(off), abs=1e-9)


def test_an_offset_does_not_show_and_a_drift_does():
    rows, errors = flown()
    still = errors.truth_en_m + np.array([7.0, -3.0])
    shifted = TrackErrors(errors.truth_en_m, still, still - errors.truth_en_m, errors.covariance_en_m2)
    assert all(row["max_m"] < 1e-9 for row in segment_errors(rows, shifted))
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(errors.truth_en_m, axis=0), axis=1))])
    drift = np.column_stack([0.01 * path, np.zeros(len(path))])
    drifted = TrackErrors(errors.truth_en_m, errors.truth_en_m + drift, drift, errors.covariance_en_m2)
    (row,) = [row for row in segment_errors(rows, drifted) if row.get("length_m") == 100.0]
    assert row["median_m"] == pytest.approx(1.0, abs=0.02)  # a hundredth of 100 m


def test_what_is_too_short_has_no_row():
    rows, errors = flown(count=3)
    assert [row.get("length_m", row.get("duration_s")) for row in segment_errors(rows, errors)] in ([], [1.0])
    begins, ends = segment_ends(np.array([0.0, 0.0, 4.0]), 100.0)
    assert (begins.size, ends.size) == (0, 0)
    assert segment_errors(rows[:1], TrackErrors(*(a[:1] for a in (
        errors.truth_en_m, errors.fix_en_m, errors.error_en_m, errors.covariance_en_m2)))) == []  # fmt: skip
