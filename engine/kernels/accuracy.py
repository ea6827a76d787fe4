"""Limits of the accuracy of Fourier transforms and of sums."""

from __future__ import annotations

# A float32 transform has an error of about 1e-7 of the window's norm in every numerator, which is divided by the
# norm of a patch: if a patch's norm is smaller than the window's by this factor, the transform is in float64.
FLOAT32_NORM_RATIO = 16.0
# Sums of squares about a mean below this share of the whole picture's are rounding: there a patch is flat.
FLAT_SHARE = 1e-12
