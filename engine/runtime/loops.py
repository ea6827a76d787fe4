"""The compiled loops of the kernels: prepared before take-off, counted in flight. numba is imported on use."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence


def prepare_loops(modules: Sequence[str], report: Callable[[int, int], None]) -> None:
    """Compile the loops of some modules of :mod:`engine.kernels`, see :func:`engine.runtime.jit.prepare`."""
    if modules:
        from engine.runtime import jit

        jit.prepare(modules, report)


def loops_compiled() -> int:
    """How often numba compiled a loop, or loaded one from its cache, so far."""
    jit = sys.modules.get("engine.runtime.jit")
    return 0 if jit is None else jit.count()
