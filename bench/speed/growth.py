"""How the cost of NCC grows: against window, template, hypotheses, batch, and the size of the map."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from bench.inputs.scenes import flight, mosaic, pair
from engine import OrthoMap, Prior, SceneMatcher, ncc_fft


@dataclass(frozen=True)
class Curve:
    """Median milliseconds at some sizes, and the exponent of the power law that fits them best."""

    name: str
    unit: str
    sizes: list[float]
    median_ms: list[float]

    @property
    def exponent(self) -> float:
        """Slope in the log-log plane, least squares."""
        return float(np.polyfit(np.log(self.sizes), np.log(self.median_ms), 1)[0])


def median_ms(call: Callable[[], object], rounds: int = 15) -> float:
    """Median time of one call after two to warm up."""
    call(), call()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        times.append((time.perf_counter() - start) * 1e3)
    return float(np.median(times))


def curves() -> list[Curve]:
    """All of them, with whatever number of threads is set."""
    return [_window(False), _window(True), _template(), _hypotheses(), _batch(), _map()]


def _peak_ms(window_px: int, template_px: int, exhaustive: bool) -> float:
    window, template = (torch.from_numpy(a) for a in pair(window_px, template_px))
    search = ncc_fft.prepare(window)
    return median_ms(lambda: ncc_fft.match_template(search, template, exclusion_px=11.0, exhaustive=exhaustive))


def _window(exhaustive: bool) -> Curve:
    sizes = [320, 448, 640, 900, 1280, 1800]
    name = "window, exhaustive" if exhaustive else "window, coarse to fine"
    return Curve(name, "px a side, template 228", sizes, [_peak_ms(n, 228, exhaustive) for n in sizes])


def _template() -> Curve:
    sizes = [100, 140, 200, 280, 400, 560]
    return Curve("template", "px a side, window 800", sizes, [_peak_ms(800, n, False) for n in sizes])


def _hypotheses() -> Curve:
    window, template = (torch.from_numpy(a) for a in pair(425, 228))
    search, sizes = ncc_fft.prepare(window), [1, 3, 9, 27, 81]
    times = [median_ms(lambda n=n: ncc_fft.surface(search, template.expand(n, -1, -1))) for n in sizes]
    return Curve("hypotheses", "templates of 228 in one window of 425", [float(n) for n in sizes], times)


def _batch() -> Curve:
    window, template = (torch.from_numpy(a) for a in pair(425, 228))
    sizes = [1, 2, 4, 8, 16]
    times = [
        median_ms(lambda n=n: ncc_fft.ncc(window.expand(n, -1, -1), template.expand(n, 1, -1, -1))) for n in sizes
    ]
    return Curve("batch, ncc()", "windows of 425 with 228", [float(n) for n in sizes], times)


def _map() -> Curve:
    scene = flight()
    sizes, times = [1000, 2000, 4000, 8000], []
    town = np.asarray(mosaic(1000))
    for side in sizes:
        gray = np.asarray(mosaic(side)).copy()
        gray[:1000, :900] = town[:1000, :900]
        jacobian = 0.53
        site = OrthoMap.from_arrays(gray, np.array([[jacobian, 0, 6e5], [0, -jacobian, 5.3e6]]), "EPSG:32633")
        matcher = SceneMatcher(site, scene.camera, "ncc", "cpu")
        east, north = site.enu_from_pixel(np.array([450.0, 500.0]))
        prior = Prior(east_m=float(east), north_m=float(north), sigma_m=5.0)
        times.append(median_ms(lambda m=matcher, p=prior: m.locate(scene.frames[5], p), 60))
    return Curve("map, window fixed", "px a side", [float(n) for n in sizes], times)
