"""The table of recall: every detector finds a turned picture again, at the places that the turn says."""

import cv2
import numpy as np
import pytest

from bench.accuracy.recall import DETECTORS, WARPS, measured, warped


@pytest.mark.parametrize("name", list(DETECTORS))
def test_matches_are_judged_by_the_warp(name):
    noise = np.random.default_rng(0).normal(0.0, 1.0, (160, 200))
    gray = np.clip(128.0 + 200.0 * cv2.GaussianBlur(noise, (0, 0), 2.0), 0, 255).astype(np.uint8)
    found, _ = measured(DETECTORS[name], 100, [warped("noise", gray, *warp) for warp in WARPS])
    assert all(quality.correct > 20 for quality in found)
    assert all(quality.inlier_ratio > 0.9 for quality in found)
    assert all(quality.error_px < 0.5 for quality in found)
