"""Windows of SIFT's orientation and descriptor, as weights of the samples around a keypoint."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from engine.sift.scale_space import TRUNCATE

Floats = NDArray[np.float32]

ORIENT_STEP = 0.75
"""Sigmas between the samples of an orientation: half of the sigma of Lowe's window."""
_ANGLE_BINS = 36  # Lowe's
_CELLS = 4  # Lowe's, along each side
_CELL_SAMPLES = 3  # per side of a cell, one a sigma


@lru_cache(maxsize=1)
def orientation_weights() -> tuple[Floats, Floats]:
    """Return the window (S, S) of sigma 1.5 keypoint sigmas, and the (36, 36) circular smoothing 1 4 6 4 1."""
    reach = round(2 * TRUNCATE)
    ramp = np.arange(-reach, reach + 1) / 2  # in sigmas of the window
    window = np.exp(-0.5 * (ramp[:, None] ** 2 + ramp**2))
    taps = zip((-2, -1, 0, 1, 2), (1, 4, 6, 4, 1), strict=True)
    smooth = sum(weight / 16 * np.roll(np.eye(_ANGLE_BINS), shift, 1) for shift, weight in taps)
    return window.astype(np.float32), np.asarray(smooth, np.float32)


@lru_cache(maxsize=1)
def tents() -> Floats:
    """Return (cells, samples): bilinear weights along one axis, times a Gaussian of half the width."""
    samples = _CELLS * _CELL_SAMPLES
    ramp = (np.arange(samples) - (samples - 1) / 2) / _CELL_SAMPLES
    centres = np.arange(_CELLS) - (_CELLS - 1) / 2
    weights = np.maximum(0, 1 - np.abs(ramp - centres[:, None])) * np.exp(-0.5 * (ramp / (_CELLS / 2)) ** 2)
    return np.asarray(weights, np.float32)
