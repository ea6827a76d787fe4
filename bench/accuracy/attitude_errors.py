"""Flights whose attitude is late or wrong: what the fixes lose, and whether their covariances say so.

    python -m bench.accuracy.attitude_errors FOLDER [--method ncc] [--step 2] [--flat] [--errors off:1/0/3]

FOLDER is a flight folder with truth.csv. Errors are ``right`` for none, ``late:`` with a lag in seconds, or with
two as ``0-0.15`` for one drawn anew for every frame, ``off:`` with what is added to roll, pitch and heading in
degrees, ``radians``, ``swapped`` for roll and pitch in each other's place, and ``signs`` for both negative.
``--flat`` leaves the surface model out.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine import Camera, Fix, Frame, Navigator, OrthoMap, Prior, SceneMatcher
from engine.runtime.threads import set_threads
from engine.values import Truth
from scenematch.files.flight import open_flight
from scenematch.files.truth import read_truth

Array = NDArray[np.float64]
MAP_SIGMA_M = 0.3  # of these worlds, so that the covariances are not the map's
HEADER = "error | answered | RMS m | largest m | NEES | beyond 4 sigma | learnt lag s | learnt bias deg"


def delayed(frames: list[Frame], angles: Array, lag: str) -> Array:
    """The angles (N, 3) of some time ago: "0.1", or "0-0.15" for a lag of its own for every frame."""
    low, _, high = lag.partition("-")
    drawn_s = np.random.default_rng(3).uniform(float(low), float(high or low), len(frames))
    time_s = np.array([(frame.timestamp_ns or 0) * 1e-9 for frame in frames])
    heading = np.degrees(np.unwrap(np.radians(angles[:, 2])))
    columns = (*angles.T[:2], heading)
    return np.stack([np.interp(time_s - drawn_s, time_s, column) for column in columns], axis=1)


def spoiled(frames: list[Frame], error: str) -> list[Frame]:
    """The frames with an error of their attitude, as the module names it."""
    kind, _, size = error.partition(":")
    angles = np.array([(f.roll_deg, f.pitch_deg, f.heading_deg) for f in frames], np.float64)
    if kind == "late":
        angles = delayed(frames, angles, size)
    elif kind == "off":
        angles += [float(part) for part in size.split("/")]
    elif kind == "radians":
        angles = np.radians(angles)
    elif kind == "swapped":
        angles = angles[:, [1, 0, 2]]
    elif kind == "signs":
        angles *= [-1.0, -1.0, 1.0]
    elif kind != "right":
        raise SystemExit(f"--errors: expected right, late:, off:, radians, swapped or signs, got {error!r}")
    return [
        replace(frame, roll_deg=float(roll), pitch_deg=float(pitch), heading_deg=float(heading % 360.0))
        for frame, (roll, pitch, heading) in zip(frames, angles, strict=True)
    ]


def fly(matcher: SceneMatcher, frames: list[Frame], truth: dict[int, Truth]) -> str:
    """The figures of one flight; the covariance counts without the map's own error."""
    first = truth[frames[0].timestamp_ns or 0]
    navigator = Navigator(matcher, Prior(lat_deg=first.lat_deg, lon_deg=first.lon_deg, sigma_m=10.0))
    errors, chi_squares = [], []
    for frame in frames:
        result = navigator.update(frame)
        if isinstance(result, Fix):
            there = truth[frame.timestamp_ns or 0]
            east, north = matcher.site.frame.enu_from_geodetic(there.lat_deg, there.lon_deg)
            off = np.array([result.east_m - east, result.north_m - north])
            errors.append(math.hypot(*off))
            chi_squares.append(off @ np.linalg.solve(result.relative_covariance_m2, off))
    if not errors:
        return f"0 of {len(frames)}"
    error, chi, bias = np.array(errors), np.array(chi_squares), navigator.attitude_bias
    learnt = "" if bias is None else f"{bias.roll_deg:.1f}, {bias.pitch_deg:.1f}, {bias.heading_deg:.1f}"
    return (
        f"{len(error)} of {len(frames)} | {np.sqrt(np.mean(error**2)):.2f} | {error.max():.2f} | "
        f"{chi.mean() / 2:.2f} | {(chi > 16.0).sum()} | {navigator.attitude_lag_s:.2f} | {learnt}"
    )


def main() -> None:
    """Print one row an error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--method", default="ncc")
    parser.add_argument("--step", type=int, default=2)
    parser.add_argument("--flat", action="store_true")
    parser.add_argument("--errors", default="right,late:0.1,late:0.15,late:0-0.15,off:1.4/0.5/3,swapped,signs")
    wanted = parser.parse_args()
    set_threads(1)
    surface = None if wanted.flat else wanted.folder / "dsm.tif"
    site = OrthoMap.open(wanted.folder / "map_ortho.tif", surface=surface, georeference_sigma_m=MAP_SIGMA_M)
    matcher = SceneMatcher(site, Camera.load(wanted.folder / "camera.yaml"), method=wanted.method)
    matcher.warmup()
    flown = open_flight(wanted.folder / "frames", wanted.folder / "telemetry.csv")
    frames = [item.frame for index, item in enumerate(flown) if index % wanted.step == 0]
    truth = {row.timestamp_ns: row for row in read_truth(wanted.folder / "truth.csv")}
    print(HEADER)
    for error in wanted.errors.split(","):
        print(f"{error} | {fly(matcher, spoiled(frames, error), truth)}", flush=True)


if __name__ == "__main__":
    main()
