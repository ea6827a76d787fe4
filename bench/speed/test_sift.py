"""SIFT: pictures in, keypoints and descriptors out; and the whole step, frame in and pose out."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import cache
from typing import Any

import numpy as np
import pytest

from bench.accuracy import quality
from bench.inputs.map_views import map_pairs
from bench.inputs.scenes import flight
from bench.inputs.views import Size, warped_pairs
from bench.speed import peers
from bench.speed.detectors import detectors
from engine import Fix, SceneMatcher, set_threads
from engine.options import NccOptions, SiftOptions
from scenematch.runs.settings import TrackSettings

SIZES: list[Size] = [(150, 150), (300, 300), (640, 480)]
BATCH = 16
SLOW = ("kornia SIFT", "COLMAP SIFT")  # no batches of theirs above the smallest size: seconds a call
PAIRS = {(150, 150): 16, (300, 300): 12, (640, 480): 8}  # of each kind
SECONDS = 0.4  # that a timing may take
Pictures = list[np.ndarray]


@cache
def _quality(peer: str, size: Size, count: int) -> dict[str, Any]:
    """Means over both kinds of pairs."""
    detector = detectors()[peer]()
    extract = detector.make()
    figures: dict[str, Any] = {}
    for kind, pairs in (("warped", warped_pairs(size, count)), ("on_map", map_pairs(size, count))):
        judged = [
            quality.judge(
                detector.keypoints(extract(pair.first, 0.0)),
                detector.keypoints(extract(pair.second, pair.turn_deg)),
                pair,
            )
            for pair in pairs
        ]
        figures[f"{kind}_pairs"] = len(judged)
        figures[kind] = asdict(quality.mean(judged)) if judged else None
    return figures


def _pictures(size: Size) -> Pictures:
    """What is timed: drone pictures from every source."""
    pairs = warped_pairs(size, BATCH) + map_pairs(size, BATCH)
    return [pairs[i * len(pairs) // BATCH].first for i in range(BATCH)]


def _one_by_one(peer: str, pictures: Pictures) -> Callable[[], Any]:
    extract, turn = detectors()[peer]().make(), iter(range(10**9))
    return lambda: extract(pictures[next(turn) % len(pictures)], 0.0)


def _side_by_side(peer: str, pictures: Pictures, threads: int) -> Callable[[], Any]:
    """All pictures: in one call where the library can, else shared among threads that each use one core."""
    detector = detectors()[peer]()
    if detector.batch is not None:
        batch = detector.batch
        return lambda: batch(pictures)
    set_threads(1)
    pool, workers = ThreadPoolExecutor(threads), [detector.make() for _ in range(threads)]

    def share(worker: int) -> list[Any]:
        return [workers[worker](picture, 0.0) for picture in pictures[worker::threads]]

    return lambda: list(pool.map(share, range(threads)))


@pytest.mark.parametrize("size", SIZES, ids=lambda s: f"{s[0]}x{s[1]}")
@pytest.mark.parametrize("batch", [1, BATCH], ids=lambda b: f"batch{b}")
@pytest.mark.parametrize("peer", list(detectors()))
def test_features(benchmark: Any, peer: str, batch: int, size: Size, threads: int, quick: bool) -> None:
    if batch > 1 and peer in SLOW and size != SIZES[0]:
        pytest.skip("seconds a call")
    figures = _quality(peer, size, 4 if quick else PAIRS[size])
    assert figures["warped"]["inlier_ratio"] > 0.5  # or a convention is broken, and its time means nothing
    pictures = _pictures(size)
    call = _one_by_one(peer, pictures) if batch == 1 else _side_by_side(peer, pictures, threads)
    call()
    start = time.perf_counter()
    call()
    rounds = 3 if quick else int(np.clip(SECONDS / (time.perf_counter() - start), 3, 48))
    benchmark.group = f"features {size[0]} x {size[1]}, batch of {batch}, {threads} thread(s)"
    benchmark.extra_info |= {"task": "features", "peer": peer, "size": list(size), "batch": batch}
    benchmark.extra_info |= {"threads": threads, **figures}
    benchmark.pedantic(call, rounds=rounds)


def _engine(method: str, profile: str = "engine", **sift: Any) -> SceneMatcher:
    scene, peak = flight(), NccOptions(refine=False)
    options = TrackSettings(method=method, profile=profile, device="cpu", ncc=peak, sift=SiftOptions(**sift))
    matcher = options.matcher(scene.site, scene.camera)
    matcher.warmup()
    return matcher


def _opencv(*, prepared: bool) -> peers.OpenCvFeatures:
    return peers.OpenCvFeatures(flight().site, flight().camera, prepared=prepared)


STEPS: dict[str, Callable[[], Any]] = {
    "paper's NCC": lambda: _engine("ncc", "paper"),
    "paper's SIFT": lambda: _engine("sift", "paper"),
    "OpenCV features, scenematch pose": lambda: _opencv(prepared=False),
    "OpenCV features, scenematch pose, map prepared": lambda: _opencv(prepared=True),
    "scenematch NCC": lambda: _engine("ncc"),
    "scenematch SIFT": lambda: _engine("sift"),
}


@pytest.mark.parametrize("peer", list(STEPS))
def test_sift_step(benchmark: Any, peer: str, threads: int, quick: bool) -> None:
    """A 300 x 300 colour frame in; position out, and by SIFT the height and the attitude."""
    scene, matcher = flight(), STEPS[peer]()
    results = [matcher.locate(frame, prior) for frame, prior in zip(scene.frames, scene.priors, strict=True)]
    truth = [scene.site.frame.enu_from_geodetic(t.lat_deg, t.lon_deg) for t in scene.truth]
    fixes = [
        (r, t, row.height_agl_m)
        for r, t, row in zip(results, truth, scene.truth, strict=True)
        if isinstance(r, Fix)
    ]
    errors_m = [np.hypot(fix.east_m - place[0], fix.north_m - place[1]) for fix, place, _ in fixes]
    heights_m = [fix.up_m - height for fix, _, height in fixes if fix.up_m is not None and height is not None]
    assert len(fixes) >= 0.9 * len(results)
    benchmark.group = f"SIFT step, {threads} thread(s)"
    benchmark.extra_info |= {
        "task": "sift step",
        "peer": peer,
        "threads": threads,
        "fixes": len(fixes),
        "frames": len(results),
        "rms_m": float(np.sqrt(np.mean(np.square(errors_m)))),
        "height_rms_m": float(np.sqrt(np.mean(np.square(heights_m)))) if heights_m else None,
    }
    turn = iter(range(10**9))

    def step() -> Any:
        i = next(turn) % len(results)
        return matcher.locate(scene.frames[i], scene.priors[i])

    benchmark.pedantic(step, rounds=20 if quick else 80, warmup_rounds=5)
