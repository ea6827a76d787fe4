"""A GPU beside the CPU, in one table: time of one frame, agreement, and copies.

    python -m bench.gpu [--device auto|cuda|cpu] [--quick]

Without CUDA it says so and ends; ``--device cpu`` runs the same code there, to see that it runs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from bench.inputs.scenes import flight, pair
from bench.pages.text import table
from engine import Fix, SceneMatcher
from engine.ncc_fft import match_template, prepare
from engine.runtime.device import resolve, synchronise
from engine.values import Peak

PAIRS = [(425, 228), (512, 256), (1024, 256), (1024, 512)]  # window and template, px; the first is the paper's
ROUNDS, QUICK_ROUNDS = 300, 3
EXCLUSION_PX = 11.0
COLUMNS = ["task", "p50 ms", "p99 ms", "per s", "off the CPU's", "copies up", "copies down"]


@dataclass(frozen=True)
class Row:
    """One task: times of single calls, agreement, and copies per call."""

    task: str
    times_ms: list[float]
    apart: str
    copies: tuple[int, int]

    def cells(self) -> list[str]:
        p50, p99 = np.percentile(self.times_ms, [50.0, 99.0])
        figures = [f"{p50:.3f}", f"{p99:.3f}", f"{1e3 / float(np.mean(self.times_ms)):.0f}"]
        return [self.task, *figures, self.apart, *map(str, self.copies)]


def timed(call: Callable[[], Any], device: torch.device, rounds: int) -> list[float]:
    """Milliseconds of each of so many calls, every one waited for."""
    for _ in range(3):
        call()
    times = []
    for _ in range(rounds):
        synchronise(device)
        start = time.perf_counter()
        call()
        synchronise(device)
        times.append((time.perf_counter() - start) * 1e3)
    return times


def copies(call: Callable[[], Any], device: torch.device) -> tuple[int, int]:
    """Copies to the device and from it in one call, as torch's profiler sees them; none on the CPU."""
    if device.type != "cuda":
        return 0, 0
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        call()
        synchronise(device)
    return directions([event.name for event in profile.events()])


def directions(names: list[str]) -> tuple[int, int]:
    """How many of a profile's events copy to the device, and how many from it."""
    return sum("Memcpy HtoD" in name for name in names), sum("Memcpy DtoH" in name for name in names)


def match(size: tuple[int, int], device: torch.device, rounds: int) -> Row:
    """NCC of one window with one template."""
    picture, cut = (torch.from_numpy(part) for part in pair(*size))
    expected = match_template(prepare(picture), cut, exclusion_px=EXCLUSION_PX, exhaustive=True)
    search, pinned = prepare(picture.to(device)), cut.pin_memory() if device.type == "cuda" else cut

    def one() -> Peak:
        there = pinned.to(device, non_blocking=True)
        return match_template(search, there, exclusion_px=EXCLUSION_PX, exhaustive=True)

    found, name = one(), f"NCC {size[1]} in {size[0]}"
    apart_px = float(np.hypot(found.x - expected.x, found.y - expected.y))
    apart = f"{apart_px:.0e} px, {abs(found.score - expected.score):.0e}"
    return Row(name, timed(one, device, rounds), apart, copies(one, device))


def frames(method: str, device: torch.device, rounds: int) -> Row:
    """Whole frames of the built-in flight, decoded frame to fix."""
    scene = flight(4 if rounds < 10 else 40)
    given = list(zip(scene.frames, scene.priors, strict=True))
    on_cpu = SceneMatcher(scene.site, scene.camera, method, "cpu")
    matcher = SceneMatcher(scene.site, scene.camera, method, device)
    metres = 0.0
    for frame, prior in given:
        fix, expected = matcher.locate(frame, prior), on_cpu.locate(frame, prior)
        if not (isinstance(fix, Fix) and isinstance(expected, Fix)):
            metres = max(metres, 0.0 if type(fix) is type(expected) else np.inf)
            continue
        metres = max(metres, float(np.hypot(fix.east_m - expected.east_m, fix.north_m - expected.north_m)))
    turn = iter(range(10**9))
    times = timed(lambda: matcher.locate(*given[next(turn) % len(given)]), device, rounds)
    return Row(f"locate, {method}", times, f"{metres:.0e} m", copies(lambda: matcher.locate(*given[0]), device))


def measure(device: torch.device, *, quick: bool) -> list[Row]:
    """All rows of the table."""
    rounds = QUICK_ROUNDS if quick else ROUNDS
    rows = [match(size, device, rounds) for size in PAIRS[: 1 if quick else None]]
    return [*rows, *(frames(method, device, rounds) for method in ("ncc", "sift"))]


def main(arguments: list[str] | None = None) -> None:
    """Print the table, or a line where there is no CUDA."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto", choices=["auto", "cuda", "cpu"])
    parser.add_argument("--quick", action="store_true", help="few rounds of few tasks: does it run?")
    options = parser.parse_args(arguments)
    if options.device != "cpu" and not torch.cuda.is_available():
        print("no GPU was measured: torch finds no CUDA device (--device cpu runs the same code on the CPU)")
        return
    device = resolve(options.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(
        f"{name}, torch {torch.__version__}; every call is waited for, templates and frames come from the host\n"
    )
    print("\n".join(table(COLUMNS, [row.cells() for row in measure(device, quick=options.quick)])))


if __name__ == "__main__":
    main()
