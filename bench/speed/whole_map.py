"""A 20,000 x 20,000 map and no position: heading known to 5 degrees, height to 5 %. Where is the frame?

Run alone, so that its peak memory is its own: ``python -m bench.speed.whole_map [side]`` prints one JSON object.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.inputs.scenes import flight, mosaic, town_gray
from bench.resident import peak_mb
from engine import Fix, MatcherOptions, OrthoMap, SceneMatcher, set_threads
from engine.options import NccOptions
from scenematch.files.geotiff import write_geotiff
from scenematch.simulator import build_town


def _write_map(path: Path, side: int) -> None:
    """A mosaic of other towns with the flight's own town somewhere in it."""
    town = build_town(1)
    gray = mosaic(side).copy()
    x, y = int(side * 0.31), int(side * 0.62)
    gray[y : y + 1000, x : x + 900] = town_gray(1)
    to_crs = np.array(town.pixel_to_crs)
    to_crs[:, 2] -= to_crs[:, :2] @ np.array([x, y])
    write_geotiff(path, gray, to_crs, town.crs_epsg)


def ours(path: Path, count: int) -> dict[str, Any]:
    """Time, memory and right answers of the engine."""
    set_threads(1)
    scene = flight()
    start = time.perf_counter()
    site = OrthoMap.open(path)
    options = NccOptions(heading_search_deg=5.0, height_search_share=0.05)
    matcher = SceneMatcher(site, scene.camera, "ncc", "cpu", MatcherOptions(ncc=options))
    matcher.warmup()
    prepared_s = time.perf_counter() - start
    rng = np.random.default_rng(0)
    times, errors, right = [], [], 0
    for i in range(0, len(scene.frames), max(1, len(scene.frames) // count)):
        truth = scene.truth[i]
        assert truth.heading_deg is not None
        assert truth.height_agl_m is not None
        heading = (truth.heading_deg + rng.uniform(-5, 5)) % 360.0
        height = truth.height_agl_m * (1 + rng.uniform(-0.05, 0.05))
        frame = replace(scene.frames[i], heading_deg=heading, height_agl_m=height)
        start = time.perf_counter()
        fix = matcher.locate(frame)
        times.append(time.perf_counter() - start)
        if isinstance(fix, Fix):
            place = site.frame.enu_from_geodetic(truth.lat_deg, truth.lon_deg)
            errors.append(float(np.hypot(fix.east_m - place[0], fix.north_m - place[1])))
            right += errors[-1] < 10.0
    return {
        "peer": "scenematch",
        "frames": len(times),
        "right": right,
        "wrong": len(errors) - right,
        "median_s": float(np.median(times)),
        "max_s": float(np.max(times)),
        "prepared_s": prepared_s,
        "peak_memory_mb": peak_mb(),
    }


def opencv(path: Path) -> dict[str, Any]:
    """One of the nine hypotheses by ``matchTemplate`` over the whole map, at full resolution."""
    import rasterio

    cv2.setNumThreads(1)
    with rasterio.open(path) as dataset:
        gray = dataset.read(1)
    template = town_gray(1)[300:529, 300:529]
    start = time.perf_counter()
    scores = cv2.matchTemplate(gray, template, cv2.TM_CCOEFF_NORMED)
    cv2.minMaxLoc(scores)
    return {
        "peer": "OpenCV, one hypothesis",
        "median_s": time.perf_counter() - start,
        "peak_memory_mb": peak_mb(),
    }


def main() -> None:
    """``write DIR SIDE``, ``ours DIR``, ``opencv DIR``: each in a process of its own."""
    what, folder = sys.argv[1], Path(sys.argv[2])
    path = folder / "map.tif"
    if what == "write":
        _write_map(path, int(sys.argv[3]))
    else:
        print(json.dumps(ours(path, 10) if what == "ours" else opencv(path)))


def run(side: int = 20_000) -> list[dict[str, Any]]:
    """Both, one after the other, each in a process of its own so that peak memories are their own."""
    import subprocess

    def module(*arguments: str) -> str:
        command = [sys.executable, "-m", "bench.speed.whole_map", *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    with tempfile.TemporaryDirectory() as folder:
        module("write", folder, str(side))
        return [json.loads(module(what, folder)) for what in ("ours", "opencv")]


if __name__ == "__main__":
    main()
