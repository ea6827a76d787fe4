"""The statistics of the integrity pages."""

from __future__ import annotations

import numpy as np

from bench.pages.integrity import auc, calibration_error, false_positives


def test_scores_are_ranked():
    """Right ones 3 and 1, wrong ones 2 and 0: of four pairs three are in order; 1 is kept, so 2 passes."""
    score, right = np.array([3.0, 1.0, 2.0, 0.0]), np.array([True, True, False, False])
    assert auc(score, right) == 0.75
    assert false_positives(score, right, kept=1.0) == 0.5
    assert calibration_error(np.array([0.75] * 4), np.array([True, True, True, False])) == 0.0
    assert calibration_error(np.array([1.0] * 4), right) == 0.5
