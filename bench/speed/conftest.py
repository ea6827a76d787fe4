"""What every benchmark needs: a fixed number of threads, and the peak memory of one call."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bench.live.growth import resident_mb
from engine.runtime.threads import set_threads


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--quick", action="store_true", help="few pictures and rounds: does every benchmark run?")


@pytest.fixture
def quick(request: pytest.FixtureRequest) -> bool:
    """Whether figures are only wanted to see that there are some."""
    return bool(request.config.getoption("--quick"))


@pytest.fixture(params=[1, 2], ids=["1thread", "2threads"])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    """Both libraries use so many threads."""
    count: int = request.param
    if count > (os.cpu_count() or 1):
        pytest.skip(f"this machine has fewer than {count} cores")
    set_threads(count)
    yield count
    set_threads(1)


def peak_memory_mb(call: Callable[[], Any]) -> float | None:
    """By how much one call raises the process's resident memory at its highest; None where Linux does not tell."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # forget the highest so far
        before = resident_mb()
        call()
        return resident_mb(field="VmHWM") - before
    except OSError:
        return None
