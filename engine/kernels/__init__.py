"""Kernels: NCC's are tensor ops behind :mod:`engine.kernels.ncc`, the others loops that numba compiles.

Tests compare every kernel of NCC with :mod:`engine.kernels.reference`, which is slow, float64 and obvious.

Loops compiled by numba (SIFT from picture to votes, dense refinement, surfaces and the georeference of maps) are
imported where they are called, since numba takes a while to import. Tests compare SIFT's with the equivalent
tensor ops, the others with OpenCV, NumPy and difference quotients.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence


def prepare_loops(modules: Sequence[str], report: Callable[[int, int], None]) -> None:
    """Compile the loops of some modules of this package, see :func:`engine.kernels.jit.prepare`."""
    if modules:
        from engine.kernels import jit  # numba takes a while to import

        jit.prepare(modules, report)


def loops_compiled() -> int:
    """How often numba compiled a loop, or loaded one from its cache, so far; it is imported when needed."""
    jit = sys.modules.get("engine.kernels.jit")
    return 0 if jit is None else jit.count()
