"""The fault matrix: what the engine makes of wrong telemetry, cameras, clocks, maps and surfaces.

    python -m bench.faults FOLDER... [--methods ncc sift auto] [--step 4] [--count 60] [--only TEXT] [--map NAME]

Each fault is put into what the engine is told of a flight folder with truth; the flight begins at its true place.
A false fix is off by more than 5 m and by more than three of its own standard deviations.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bench.inputs.faults import Fault, Told, faults, load
from engine import Fix, Navigator, Prior, SceneMatcher
from engine.device import set_threads
from engine.diagnosis import diagnose
from engine.formats.truth import interpolate_truth

FALSE_M, FALSE_SIGMAS = 5.0, 3.0
START_SIGMA_M = 15.0


@dataclass(frozen=True)
class Cell:
    """What one method made of one fault of one flight.

    Attributes:
        flight, fault, method: names.
        frames, fixed, false: their numbers.
        rms_m: over all fixes; None without one.
        nees: mean over the fixes, 1 where covariances are true.
        said: what was diagnosed.
    """

    flight: str
    fault: str
    method: str
    frames: int
    fixed: int
    false: int
    rms_m: float | None
    nees: float | None
    largest_m: float | None
    said: str = ""


def fly(told: Told, stamps_ns: list[int], flight: str, fault: str, method: str) -> Cell:
    """One flight; ``stamps_ns`` are the true ones of its frames."""
    site = told.site()
    matcher = SceneMatcher(site, told.camera, method, "cpu")
    first = interpolate_truth(told.truth, stamps_ns[0])
    assert first is not None
    navigator = Navigator(matcher, Prior(lat_deg=first.lat_deg, lon_deg=first.lon_deg, sigma_m=START_SIGMA_M))
    off_m, chi = [], []
    for frame, stamp_ns in zip(told.frames, stamps_ns, strict=True):
        result = navigator.update(frame)
        there = interpolate_truth(told.truth, stamp_ns)
        if not isinstance(result, Fix) or there is None:
            continue
        east, north = site.frame.enu_from_geodetic(there.lat_deg, there.lon_deg)[:2]
        off = np.array([result.east_m - east, result.north_m - north])
        off_m.append(math.hypot(*off))
        chi.append(float(off @ np.linalg.solve(result.covariance_m2[:2, :2], off)))
    error, chi_square = np.array(off_m), np.array(chi)
    false = int(((error > FALSE_M) & (chi_square > FALSE_SIGMAS**2)).sum())
    if not off_m:
        return Cell(flight, fault, method, len(told.frames), 0, 0, None, None, None)
    rms_m = float(np.sqrt(np.mean(error**2)))
    return Cell(
        flight, fault, method, len(told.frames), len(error), false, rms_m, float(chi_square.mean() / 2),
        float(error.max()),
    )  # fmt: skip


def cell(told: Told, fault: Fault, flight: str, method: str) -> Cell:
    """A flight with a fault; its true stamps go with its pictures."""
    spoiled = fault.spoil(told)
    stamps = [frame.timestamp_ns or 0 for frame in told.frames]
    if len(spoiled.frames) != len(stamps):
        stamps = [frame.timestamp_ns or 0 for frame in spoiled.frames]
    return fly(spoiled, stamps, flight, fault.name, method)


def diagnosed(told: Told, fault: Fault) -> str:
    """What a diagnosis says of it."""
    spoiled = fault.spoil(told)
    first = interpolate_truth(told.truth, told.frames[0].timestamp_ns or 0)
    assert first is not None
    start = Prior(lat_deg=first.lat_deg, lon_deg=first.lon_deg, sigma_m=START_SIGMA_M)
    found = diagnose(spoiled.frames, spoiled.site(), spoiled.camera, start=start)
    named = bool(set(fault.causes) & {finding.cause for finding in found.findings[:1]})
    verdict = "right" if named else "silent" if not found.findings else "WRONG" if fault.causes else "FALSE ALARM"
    return f"{verdict}: seen {found.seen}: " + "; ".join(f"{f.cause}: {f.text}" for f in found.findings)


def _row(found: Cell) -> str:
    def shown(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    return (
        f"{found.flight:18s} {found.fault:38s} {found.method:5s} {found.fixed:3d} of {found.frames:3d}  "
        f"false {found.false:3d}  RMS {shown(found.rms_m):>6s}  max {shown(found.largest_m):>6s}  "
        f"NEES {shown(found.nees):>7s}  {found.said}"
    )


def main() -> None:
    """Print a row a cell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--methods", nargs="*", default=["ncc", "sift", "auto"])
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--map", default="map.tif")
    parser.add_argument("--only", default="")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--diagnose", action="store_true")
    wanted = parser.parse_args()
    set_threads(1)
    begin, cells = time.monotonic(), []
    for folder in wanted.folders:
        told = load(folder, wanted.map, wanted.step, wanted.count)
        for fault in faults():
            if wanted.only not in fault.name:
                continue
            if wanted.diagnose:
                print(f"{folder.name:18s} {fault.name:38s} {diagnosed(told, fault)}", flush=True)
            for method in wanted.methods:
                cells.append(cell(told, fault, folder.name, method))
                print(_row(cells[-1]), flush=True)
    print(f"{len(cells)} cells in {time.monotonic() - begin:.0f} s")
    if wanted.json is not None:
        wanted.json.write_text(json.dumps([asdict(found) for found in cells], indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
