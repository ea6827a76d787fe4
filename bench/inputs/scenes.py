"""Inputs of the benchmarks: pictures with the look of a map, and the built-in flight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from engine import Camera, Frame, OrthoMap, Prior
from engine.values import Truth
from scenematch.simulator import build_town, plan_flight

Image = NDArray[np.float32]


@cache
def town_gray(seed: int = 1) -> NDArray[np.uint8]:
    """The orthophoto of a simulated town, grey."""
    return np.asarray(cv2.cvtColor(build_town(seed).ortho, cv2.COLOR_RGB2GRAY), np.uint8)


@cache
def mosaic(side: int, shown: int | None = None) -> NDArray[np.uint8]:
    """A square map of any size, of simulated towns turned and mirrored, each lit a little differently.

    Of its rows and columns the first ``shown`` are drawn, and no town for what lies beyond.
    """
    rng, shown = np.random.default_rng(side), shown or side
    out = np.empty((shown, shown), np.uint8)
    for y in range(0, side, 900):
        for x in range(0, side, 900):
            seed, turns = 2 + int(rng.integers(4)), rng.integers(4)
            mirrored, light = rng.choice([-1, 1]), rng.uniform(0.8, 1.1)
            part = out[y : y + 900, x : x + 900]
            if part.size:
                tile = np.rot90(town_gray(seed)[50:950], turns)[:, ::mirrored] * light
                part[:] = tile[: part.shape[0], : part.shape[1]]
    return out


@cache
def pair(window_px: int, template_px: int) -> tuple[Image, Image]:
    """A window of map, enhanced, and a noisy cut of it as template."""
    from engine.kernels.scores import enhance

    gray = mosaic(max(window_px, 1000), window_px)
    window = enhance(gray)
    start = (window_px - template_px) // 3
    cut = window[start : start + template_px, start : start + template_px]
    noise = np.random.default_rng(0).normal(0.0, 0.5, cut.shape)
    return np.ascontiguousarray(window), np.ascontiguousarray(cut + noise, np.float32)


@dataclass(frozen=True)
class Flight:
    """Frames of the built-in flight with what a matcher is given, and the truth."""

    site: OrthoMap
    camera: Camera
    frames: list[Frame]
    priors: list[Prior]
    truth: list[Truth]


@cache
def flight(count: int = 40) -> Flight:
    """Every fourth frame of the built-in flight, with a prior a few metres off."""
    plan = plan_flight(1, rate_hz=0.28)
    site = plan.town.site()
    frames, truth = list(islice(plan.iter_frames(), count)), plan.truth_rows()[:count]
    rng = np.random.default_rng(0)
    priors = []
    for row in truth:
        east, north = site.frame.enu_from_geodetic(row.lat_deg, row.lon_deg) + rng.normal(0.0, 3.0, 2)
        priors.append(Prior(east_m=float(east), north_m=float(north), sigma_m=5.0, moved_north_m=7.0 * 0.2))
    return Flight(site, plan.camera, frames, priors, truth)
