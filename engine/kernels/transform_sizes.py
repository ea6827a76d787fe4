"""Sizes for which Fourier transforms are fast, and the limits of their accuracy."""

from __future__ import annotations

from functools import lru_cache

# A float32 transform has an error of about 1e-7 of the window's norm in every numerator, which is divided by the
# norm of a patch: if a patch's norm is smaller than the window's by this factor, the transform is in float64.
FLOAT32_NORM_RATIO = 16.0
# Sums of squares about a mean below this share of the whole picture's are rounding: there a patch is flat.
FLAT_SHARE = 1e-12


@lru_cache(maxsize=4096)
def fast_length(n: int) -> int:
    """The smallest length of at least ``n`` without prime factors above 5, for which FFTs are fast."""
    best = 1 << (n - 1).bit_length()
    five = 1
    while five < best:
        three = five
        while three < best:
            length = three << max(0, (-(-n // three) - 1).bit_length())
            best = min(best, length)
            three *= 3
        five *= 5
    return best
