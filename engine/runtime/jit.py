"""Compilation of loops by numba: before a flight, on all cores, cached on disk; they release Python's lock."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from importlib import import_module
from typing import Any

from numba import njit
from numba.core.sigutils import normalize_signature

from engine.runtime import workers
from engine.runtime.garbage import no_collection

_FAST = {"contract", "reassoc", "nsz", "arcp", "afn"}  # not "nnan": a flat picture divides by zero
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": _FAST, "no_cfunc_wrapper": True}
_signatures: list[tuple[Any, str]] = []  # of loops called from Python


def compiled(*signatures: str):
    """Compile a loop by :func:`prepare`, else at its first call; cached on disk if a folder for it is writable.

    Args:
        signatures: types of the arguments; none for a loop that only other loops call.
    """

    def decorate(function):
        try:
            loop = njit(cache=True, **_OPTIONS)(function)
        except RuntimeError:  # no folder is writable
            loop = njit(**_OPTIONS)(function)
        _signatures.extend((loop, signature) for signature in signatures)
        return loop

    return decorate


def inlined(function):
    """Inline a function into the loops that call it: this compiles faster than a separate loop."""
    return njit(inline="always", **_OPTIONS)(function)


def prepare(modules: Iterable[str], report: Callable[[int, int], None] = lambda done, total: None) -> None:
    """Compile the loops of modules of :mod:`engine.kernels`, or load them from the cache.

    If something must be compiled, a second process starts at the other end until both meet; this process then
    loads what the other compiled.

    Args:
        modules: of :mod:`engine.kernels`, by name.
        report: called with the number of finished loops and the total.
    """
    names = [import_module(f"engine.kernels.{module}").__name__ for module in modules]
    written = [entry for name in names for entry in _signatures if entry[0].__module__ == name]
    # Types as in a first call: the cache distinguishes a text from the types that it denotes.
    loops = [(loop, normalize_signature(text)[0]) for loop, text in written]  # type: ignore[no-untyped-call]
    helper = None
    try:
        with no_collection():  # little of a compiler's memory is garbage before it is done
            for number, (loop, signature) in enumerate(loops, 1):
                loop.compile(signature)
                if helper is None and loop.stats.cache_misses and loop.stats.cache_path:
                    helper = workers.start_helper(partial(_compile, loops[:number:-1]))
                report(number, len(loops))
    finally:
        if helper is not None:
            helper.kill()
            helper.join()


def _compile(loops: list[tuple[Any, Any]]) -> None:
    for loop, signature in loops:
        loop.compile(signature)
