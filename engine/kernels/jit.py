"""How loops are compiled: at their first call, kept on disk, and free of Python's lock."""

from __future__ import annotations

from typing import Any

from numba import njit

_FAST = {"contract", "reassoc", "nsz", "arcp", "afn"}  # not "nnan": a flat picture divides by nothing
_loops: list[Any] = []


def compiled(function):
    """Compile at the first call; the machine code is kept on disk where there is a folder for it."""
    try:
        loop = njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)(function)
    except RuntimeError:
        loop = njit(nogil=True, error_model="numpy", fastmath=_FAST)(function)
    _loops.append(loop)
    return loop


def count() -> int:
    """How many versions of loops were compiled, or loaded from where they are kept, so far."""
    return sum(len(loop.signatures) for loop in _loops)
