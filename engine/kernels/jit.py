"""Compilation of loops by numba: at their first call, cached on disk, and without Python's global lock."""

from __future__ import annotations

from typing import Any

from numba import njit

_FAST = {"contract", "reassoc", "nsz", "arcp", "afn"}  # not "nnan": a flat picture divides by zero
_loops: list[Any] = []


def compiled(function):
    """Compile at the first call; the machine code is cached on disk where a folder for it is writable."""
    try:
        loop = njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)(function)
    except RuntimeError:
        loop = njit(nogil=True, error_model="numpy", fastmath=_FAST)(function)
    _loops.append(loop)
    return loop


def count() -> int:
    """Number of specialisations that were compiled, or loaded from the cache, so far."""
    return sum(len(loop.signatures) for loop in _loops)
