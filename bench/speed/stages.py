"""Where the time of a frame goes: a tracked flight, stage by stage, in turns with OpenCV's plain step.

    python -m bench.speed.stages OUT.json

Blocks of frames by the engine, from the prior that its navigator has, and the same frames by
:class:`bench.speed.peers.OpenCvStep`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench import SHARED
from bench.accuracy.truth import off, prior_at, true_places_m
from bench.inputs.faults import load
from bench.live.endless import draw
from bench.speed.peers import OpenCvStep
from engine import Camera, Fix, Frame, Navigator, NoFix, OrthoMap, SceneMatcher
from engine.geo import Array
from engine.runtime.threads import set_threads
from scenematch.files.truth import interpolate_truth

FRAMES, BLOCK, SKIPPED = 160, 20, 4  # in all, in turns, and at the start of a block whose caches are the peer's
START_SIGMA_M = 10.0


@dataclass
class Timed:
    """A matcher whose calls are timed."""

    matcher: SceneMatcher
    ms: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.matcher, name)

    def locate(self, *args: Any) -> Fix | NoFix:
        """As the matcher's."""
        start = time.perf_counter()
        result = self.matcher.locate(*args)
        self.ms.append((time.perf_counter() - start) * 1e3)
        for name, ms in result.timings.stages_ms.items():
            self.stages[name].append(ms)
        return result


def in_own_process() -> list[dict[str, Any]]:
    """The rows of :func:`run` by a process that holds nothing else: its garbage collector would search it, too."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "stages.json"
        subprocess.run([sys.executable, "-m", "bench.speed.stages", str(out)], check=True)
        rows: list[dict[str, Any]] = json.loads(out.read_text(encoding="utf-8"))
        return rows


def run() -> list[dict[str, Any]]:
    """A row a flight and method; Gazebo's where it is there."""
    course = draw(FRAMES, dive_m=0.0, rate_hz=1.12)
    flights = {"demo": (course.site, course.camera, course.frames, course.places_m)}
    if (SHARED / "gazebo-a1").is_dir():
        told = load(SHARED / "gazebo-a1", "map_ortho.tif", 2, FRAMES)
        site, rows = told.site(), [interpolate_truth(told.truth, frame.timestamp_ns or 0) for frame in told.frames]
        places_m = true_places_m(site, [row for row in rows if row is not None])
        flights["gazebo-a1"] = (site, told.camera, told.frames, places_m)
    return [
        {"flight": name, "method": method, **_flown(*flight, method)}
        for name, flight in flights.items()
        for method in ("ncc", "sift")
    ]


def _flown(site: OrthoMap, camera: Camera, frames: list[Frame], places_m: Array, method: str) -> dict[str, Any]:
    matcher = SceneMatcher(site, camera, method, "cpu")
    matcher.warmup()
    timed, peer, peer_ms = Timed(matcher), OpenCvStep(site, camera, prepared=False), []
    navigator = Navigator(timed, prior_at(places_m[0], START_SIGMA_M))  # type: ignore[arg-type]
    errors, kept = [], []
    for begin in range(0, len(frames), BLOCK):
        block = slice(begin, begin + BLOCK)
        for place, frame in zip(places_m[block], frames[block], strict=True):
            result = navigator.update(frame)
            if isinstance(result, Fix):
                errors.append(off(result, place))
        kept += timed.ms[-BLOCK + SKIPPED :]
        for number, (place, frame) in enumerate(zip(places_m[block], frames[block], strict=True)):
            prior = prior_at(np.add(place, (2.0, -2.0)), 5.0)
            start = time.perf_counter()
            peer(frame, prior)
            peer_ms += [(time.perf_counter() - start) * 1e3] * (number >= SKIPPED)
    stages = {name: float(np.median(ms)) for name, ms in timed.stages.items() if len(ms) > len(frames) / 2}
    p50_ms = float(np.median(kept))
    rms_m, rms_sigmas = np.sqrt(np.mean(np.square(errors), axis=0)).tolist()
    return {
        "frames": len(frames),
        "fixed": len(errors),
        "rms_m": rms_m,
        "nees": rms_sigmas**2 / 2.0,
        "p50_ms": p50_ms,
        "p99_ms": float(np.percentile(kept, 99)),
        "opencv_p50_ms": float(np.median(peer_ms)),
        "stages_ms": {**stages, "rest": max(p50_ms - sum(stages.values()), 0.0)},
    }


if __name__ == "__main__":
    set_threads(1)
    Path(sys.argv[1]).write_text(json.dumps(run(), indent=1) + "\n", encoding="utf-8")
