"""A GPU beside the CPU and OpenCV, in one table: time of one call, agreement, and copies.

    python -m bench.gpu [--device auto|cuda|cpu] [--quick]

Without CUDA it says so and ends; ``--device cpu`` runs the same code there, to see that it runs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch

from bench.inputs.scenes import flight, pair, town_gray
from bench.pages.text import table
from engine import Fix, SceneMatcher
from engine.features import sift
from engine.ncc_fft import match_template, ncc, prepare
from engine.runtime.device import resolve, synchronise
from engine.values import Peak

PAIRS = [(425, 228), (512, 256), (1024, 256), (1024, 512)]  # window and template, px; the first is the paper's
CPU = torch.device("cpu")
BATCHES = [1, 16]  # pictures at once
ROUNDS, QUICK_ROUNDS, LONGEST_S = 300, 3, 2.0
EXCLUSION_PX = 11.0
COLUMNS = [
    "task", "device p50 ms", "p99 ms", "engine on CPU", "OpenCV on CPU", "off the CPU's", "copies up",
    "copies down",
]  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One task: times of single calls there, on the CPU and by OpenCV, agreement, and copies per call."""

    task: str
    times_ms: tuple[list[float], list[float], list[float]]
    apart: str
    copies: tuple[int, int]

    def cells(self) -> list[str]:
        p50, p99 = np.percentile(self.times_ms[0], [50.0, 99.0])
        beside = [f"{np.median(ms):.3f}" if ms else "" for ms in self.times_ms[1:]]
        return [self.task, f"{p50:.3f}", f"{p99:.3f}", *beside, self.apart, *map(str, self.copies)]


def timed(call: Callable[[], Any], device: torch.device, rounds: int) -> list[float]:
    """Milliseconds of each of so many calls, every one waited for; fewer if they take longer than some seconds."""
    for _ in range(3):
        call()
    times: list[float] = []
    for _ in range(rounds):
        if sum(times) > LONGEST_S * 1e3:
            break
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
    with torch.profiler.profile(activities=activities, acc_events=True) as profile:
        call()
        synchronise(device)
    return directions([event.name for event in profile.events()])


def directions(names: list[str]) -> tuple[int, int]:
    """How many of a profile's events copy to the device, and how many from it."""
    return sum("Memcpy HtoD" in name for name in names), sum("Memcpy DtoH" in name for name in names)


def match(size: tuple[int, int], device: torch.device, rounds: int) -> Row:
    """NCC of one window with one template, to its peak."""
    window, template = pair(*size)
    picture, cut = torch.from_numpy(window), torch.from_numpy(template)
    on_cpu = partial(match_template, prepare(picture), cut, exclusion_px=EXCLUSION_PX, exhaustive=True)
    search, pinned = prepare(picture.to(device)), cut.pin_memory() if device.type == "cuda" else cut

    def one() -> Peak:
        there = pinned.to(device, non_blocking=True)
        return match_template(search, there, exclusion_px=EXCLUSION_PX, exhaustive=True)

    def opencv() -> Any:
        return cv2.minMaxLoc(cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED))

    found, expected = one(), on_cpu()
    apart_px = float(np.hypot(found.x - expected.x, found.y - expected.y))
    times = timed(one, device, rounds), timed(on_cpu, CPU, rounds), timed(opencv, CPU, rounds)
    apart = f"{apart_px:.0e} px, {abs(found.score - expected.score):.0e}"
    return Row(f"NCC {size[1]} in {size[0]}", times, apart, copies(one, device))


def surfaces(count: int, device: torch.device, rounds: int) -> Row:
    """The batched surface of the paper's pair: as many windows, each with its template."""
    window, template = pair(*PAIRS[0])
    windows = torch.from_numpy(np.stack([np.roll(window, 7 * k, 1) for k in range(count)]))
    templates = torch.from_numpy(np.stack([template] * count))[:, None]
    there = windows.to(device), templates.to(device)
    arrays = windows.numpy()

    def opencv() -> Any:
        return [cv2.matchTemplate(one, template, cv2.TM_CCOEFF_NORMED) for one in arrays]

    apart = float((ncc(*there).cpu() - ncc(windows, templates)).abs().max())
    one, on_cpu = partial(ncc, *there), partial(ncc, windows, templates)
    times = timed(one, device, rounds), timed(on_cpu, CPU, rounds), timed(opencv, CPU, rounds)
    return Row(f"NCC surfaces, {count}", times, f"{apart:.0e}", copies(one, device))


def features(count: int, device: torch.device, rounds: int) -> Row:
    """SIFT of as many pictures, by kornia's stages there and by the compiled detector on the CPU."""
    gray = np.stack([town_gray(seed)[100:500, 100:500] for seed in range(1, count + 1)])
    pictures = torch.from_numpy(gray)[:, None].float() / 255.0
    there, detector = pictures.to(device), cv2.SIFT_create(300)

    def opencv() -> Any:
        return [detector.detectAndCompute(picture, None) for picture in gray]

    one, on_cpu = partial(sift, there, backend="kornia"), partial(sift, pictures)
    found, expected = one(), sift(pictures, backend="kornia")
    sets = found.xy_px.cpu(), found.valid.cpu(), expected.xy_px, expected.valid
    least = min(shares(*each) for each in zip(*sets, strict=True))
    times = timed(one, device, rounds), timed(on_cpu, CPU, rounds), timed(opencv, CPU, rounds)
    return Row(f"SIFT of {count}", times, f"{least:.1%} shared", copies(one, device))


def shares(found: torch.Tensor, there: torch.Tensor, expected: torch.Tensor, own: torch.Tensor) -> float:
    """The share of the expected points, (N, 2), that were found within 0.01 px; the masks say which count."""
    apart = torch.cdist(expected[own].double(), found[there].double())
    return float((apart.min(1).values < 0.01).double().mean())


def frames(method: str, device: torch.device, rounds: int, *, searched: bool = False) -> Row:
    """Whole frames of the built-in flight, decoded frame to fix: from its prior, or searched on the whole map."""
    scene = flight(4 if rounds < 10 else 40)
    given = [(frame, None if searched else prior) for frame, prior in zip(scene.frames, scene.priors, strict=True)]
    matchers = [SceneMatcher(scene.site, scene.camera, method, str(where)) for where in (device, CPU)]
    metres = 0.0
    for frame, prior in given:
        fix, expected = (matcher.locate(frame, prior) for matcher in matchers)
        if not (isinstance(fix, Fix) and isinstance(expected, Fix)):
            metres = max(metres, 0.0 if type(fix) is type(expected) else np.inf)
            continue
        metres = max(metres, float(np.hypot(fix.east_m - expected.east_m, fix.north_m - expected.north_m)))

    def next_frame(matcher: SceneMatcher) -> Callable[[], Any]:
        turn = iter(range(10**9))
        return lambda: matcher.locate(*given[next(turn) % len(given)])

    there, here = map(next_frame, matchers)
    times = timed(there, device, rounds), timed(here, CPU, rounds), list[float]()
    name = f"whole map, {method}" if searched else f"locate, {method}"
    return Row(name, times, f"{metres:.0e} m", copies(there, device))


def measure(device: torch.device, *, quick: bool) -> Iterator[Row]:
    """All rows of the table, each as soon as it is measured."""
    rounds, end = (QUICK_ROUNDS, 1) if quick else (ROUNDS, None)
    yield from (match(size, device, rounds) for size in PAIRS[:end])
    yield from (surfaces(count, device, rounds) for count in BATCHES[:end])
    yield from (features(count, device, rounds) for count in BATCHES[:end])
    yield from (frames(method, device, rounds) for method in ("ncc", "sift"))
    yield frames("ncc", device, rounds, searched=True)


def main(arguments: list[str] | None = None) -> None:
    """Print the table, or a line where there is no CUDA."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto", choices=["auto", "cuda", "cpu"])
    parser.add_argument("--quick", action="store_true", help="few rounds of few tasks: does it run?")
    options = parser.parse_args(arguments)
    if options.device != "cpu" and not torch.cuda.is_available():
        print("no GPU was measured: torch finds no CUDA device (--device cpu runs the same code on the CPU)")
        return
    device = torch.device(resolve(options.device))
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(
        f"{name}, torch {torch.__version__}; every call is waited for, templates and frames come from the host\n"
    )
    heading, rule, *_ = table(COLUMNS, [])
    print(f"{heading}\n{rule}", flush=True)
    for row in measure(device, quick=options.quick):
        print(table(COLUMNS, [row.cells()])[2], flush=True)


if __name__ == "__main__":
    main()
