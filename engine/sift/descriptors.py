"""Windows of SIFT's orientation and descriptor, as weights of the samples around a keypoint."""

import numpy as np

from engine.sift.scale_space import TRUNCATE

ORIENT_STEP = 0.75
"""Sigmas between the samples of an orientation: half of the sigma of Lowe's window."""
_ANGLE_BINS = 36  # Lowe's
_CELLS = 4  # Lowe's, along each side
_CELL_SAMPLES = 3  # per side of a cell, one a sigma

_ACROSS = np.arange(-round(2 * TRUNCATE), round(2 * TRUNCATE) + 1) / 2  # in sigmas of the window
ORIENT_WINDOW = np.exp(-0.5 * (_ACROSS[:, None] ** 2 + _ACROSS**2)).astype(np.float32)
"""(S, S) weights of an orientation's samples, of sigma 1.5 keypoint sigmas."""
_TAPS = np.array([1, 4, 6, 4, 1]) / 16
_SHIFTED = np.stack([np.roll(np.eye(_ANGLE_BINS), shift, 1) for shift in (-2, -1, 0, 1, 2)])
SMOOTHING = np.tensordot(_TAPS, _SHIFTED, 1).astype(np.float32)
"""(36, 36) circular smoothing of the histogram of angles by 1 4 6 4 1."""

_ALONG = (np.arange(_CELLS * _CELL_SAMPLES) - (_CELLS * _CELL_SAMPLES - 1) / 2) / _CELL_SAMPLES
_CENTRES = np.arange(_CELLS) - (_CELLS - 1) / 2
_CELL_TENTS = np.maximum(0, 1 - np.abs(_ALONG - _CENTRES[:, None])) * np.exp(-0.5 * (_ALONG / (_CELLS / 2)) ** 2)
TENTS = _CELL_TENTS.astype(np.float32)
"""(cells, samples): bilinear weights along one axis, times a Gaussian of half the width."""
