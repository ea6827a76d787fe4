"""NCC: window and template in, peak out. OpenCV, scikit-image and SciPy are the peers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from bench.inputs.scenes import flight, pair
from bench.speed import peers
from bench.speed.conftest import peak_memory_mb
from engine import Fix, MatcherOptions, SceneMatcher, ncc_fft
from engine.options import NccOptions

SIZES = [
    (96, 64),
    (192, 128),
    (425, 228),
    (425, 327),
    (512, 256),
    (1024, 256),
    (1024, 512),
    (2048, 128),
    (2048, 512),
]
SLOW_PEERS_UP_TO = 1024


def _ours(window: np.ndarray, template: np.ndarray, **options: Any) -> Callable[[], tuple[float, float, float]]:
    search, model = ncc_fft.prepare(torch.from_numpy(window)), torch.from_numpy(template)

    def call() -> tuple[float, float, float]:
        peak = ncc_fft.match_template(search, model, exclusion_px=11.0, **options)
        return peak.x, peak.y, peak.score

    return call


def _surface(window: np.ndarray, template: np.ndarray) -> Callable[[], tuple[int, int, float]]:
    search, model = torch.from_numpy(window)[None], torch.from_numpy(template)[None, None]

    def call() -> tuple[int, int, float]:
        scores = ncc_fft.ncc(search, model)[0, 0]
        y, x = divmod(int(scores.argmax()), scores.shape[1])
        return x, y, float(scores[y, x])

    return call


CALLS: dict[str, Callable[[np.ndarray, np.ndarray], Callable[[], tuple[float, float, float]]]] = {
    "OpenCV": lambda w, t: lambda: peers.opencv_peak(w, t),
    "scenematch, map prepared": _ours,
    "scenematch, exhaustive": lambda w, t: _ours(w, t, exhaustive=True),
    "scenematch, ncc()": _surface,
    "scikit-image": lambda w, t: lambda: peers.skimage_peak(w, t),
    "SciPy fftconvolve": lambda w, t: lambda: peers.scipy_peak(w, t),
}


@pytest.mark.parametrize("size", SIZES, ids=lambda s: f"{s[1]}in{s[0]}")
@pytest.mark.parametrize("peer", list(CALLS))
def test_peak(benchmark: Any, peer: str, size: tuple[int, int], threads: int) -> None:
    if peer in ("scikit-image", "SciPy fftconvolve") and size[0] > SLOW_PEERS_UP_TO:
        pytest.skip("seconds a call")
    window, template = pair(*size)
    call = CALLS[peer](window, template)
    x, y, score = call()
    true_x, true_y, _ = peers.opencv_peak(window, template)
    cut = window[true_y : true_y + template.shape[0], true_x : true_x + template.shape[1]]
    error = abs(score - float(np.corrcoef(cut.ravel(), template.ravel())[0, 1]))  # in float64
    assert (round(x), round(y)) == (true_x, true_y)
    assert error <= 1e-5
    benchmark.group = f"peak {size[1]} in {size[0]}, {threads} thread(s)"
    benchmark.extra_info |= {
        "task": "peak",
        "peer": peer,
        "window_px": size[0],
        "template_px": size[1],
        "dtype": "float32",
        "threads": threads,
        "error": error,
        "peak_memory_mb": peak_memory_mb(call),
    }
    benchmark.pedantic(call, rounds=9 if size[0] > 1000 else 60, warmup_rounds=3)


@pytest.mark.parametrize("peer", ["OpenCV", "OpenCV, map prepared", "scenematch"])
def test_step(benchmark: Any, peer: str, threads: int) -> None:
    """A 300 x 300 colour frame in; grey, enhanced, rectified, matched; sub-pixel position out."""
    scene = flight()
    if peer == "scenematch":
        # The peak alone, as the peers do it; what the refinement adds is measured by bench.live.latency.
        options = MatcherOptions(ncc=NccOptions(refine=False))
        matcher = SceneMatcher(scene.site, scene.camera, "ncc", "cpu", options)
        matcher.warmup()

        def step(i: int) -> tuple[float, float]:
            fix = matcher.locate(scene.frames[i], scene.priors[i])
            assert isinstance(fix, Fix)
            return fix.east_m, fix.north_m
    else:
        by_hand = peers.OpenCvStep(scene.site, scene.camera, prepared=peer != "OpenCV")

        def step(i: int) -> tuple[float, float]:
            return by_hand(scene.frames[i], scene.priors[i])

    truth = [scene.site.frame.enu_from_geodetic(t.lat_deg, t.lon_deg) for t in scene.truth]
    errors = [np.hypot(*(np.array(step(i)) - truth[i])) for i in range(len(scene.frames))]
    rms_m = float(np.sqrt(np.mean(np.square(errors))))
    assert rms_m < 2.4
    benchmark.group = f"NCC step, {threads} thread(s)"
    benchmark.extra_info |= {
        "task": "step",
        "peer": peer,
        "threads": threads,
        "rms_m": rms_m,
        "peak_memory_mb": peak_memory_mb(lambda: step(0)),
    }
    turn = iter(range(10**9))
    benchmark.pedantic(lambda: step(next(turn) % len(scene.frames)), rounds=200, warmup_rounds=10)


HEADINGS, SCALES = 36, 5


@pytest.mark.parametrize("peer", ["OpenCV loop", "scenematch"])
def test_hypotheses(benchmark: Any, peer: str, threads: int) -> None:
    """36 headings x 5 scales over the paper's whole map: which place, which heading?"""
    from dataclasses import replace

    from engine.kernels.scores import enhance
    from engine.matching.align import rectify, view_of
    from engine.values import Attitude, Window
    from engine.window import SPREAD_SIGMAS

    scene = flight()
    frame, truth, site = scene.frames[5], scene.truth[5], scene.site
    assert frame.height_agl_m is not None
    if peer == "scenematch":
        matcher = SceneMatcher(site, scene.camera, "ncc", "cpu")
        height_sigma_m = 0.1 * frame.height_agl_m / SPREAD_SIGMAS
        unknown = replace(frame, heading_deg=0.0, heading_sigma_deg=180.0, height_sigma_m=height_sigma_m)

        def call() -> np.ndarray:
            fix = matcher.locate(unknown)
            assert isinstance(fix, Fix)
            return np.array([fix.east_m, fix.north_m])
    else:
        picture = enhance(site.gray(Window(0, 0, site.width_px, site.height_px)))
        gray = np.asarray(np.asarray(frame.image) @ np.array([0.299, 0.587, 0.114]), np.uint8)
        jacobian = site.enu_jacobian(np.array([450.0, 500.0]))

        def call() -> np.ndarray:
            best, place = -1.0, np.zeros(2)
            for heading in np.arange(HEADINGS) * 360.0 / HEADINGS:
                for scale in np.linspace(0.9, 1.1, SCALES):
                    attitude = Attitude(frame.roll_deg or 0.0, frame.pitch_deg or 0.0, float(heading))
                    view = view_of(scene.camera, attitude, frame.height_agl_m * scale, jacobian)
                    patch = rectify(gray, view)
                    x, y, score = peers.opencv_peak(picture, enhance(patch.gray))
                    if score > best:
                        best, place = score, np.array([x, y]) - patch.offset_px
            return np.asarray(site.enu_from_pixel(place))

    error_m = float(np.hypot(*(call() - site.frame.enu_from_geodetic(truth.lat_deg, truth.lon_deg))))
    assert error_m < 10.0
    benchmark.group = f"{HEADINGS * SCALES} hypotheses, {threads} thread(s)"
    benchmark.extra_info |= {
        "task": "hypotheses",
        "peer": peer,
        "threads": threads,
        "error_m": error_m,
        "peak_memory_mb": peak_memory_mb(call),
    }
    benchmark.pedantic(call, rounds=3 if peer == "OpenCV loop" else 15, warmup_rounds=1)
