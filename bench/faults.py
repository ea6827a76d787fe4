"""The fault matrix: what the engine makes of wrong telemetry, cameras, clocks, maps and surfaces.

    python -m bench.faults FOLDER... [--methods ncc sift auto] [--step 4] [--count 60] [--only TEXT] [--map NAME]
                           [--no-diagnosis] [--docs DIR]

Each fault is put into the inputs of a flight folder with truth; the flight begins at its true place.
A false fix is off by more than 5 m and by more than three of its own standard deviations. ``--docs`` writes the
table of docs/results/wrong-inputs.md.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench import RESULTS
from bench.accuracy.truth import START_SIGMA_M, off, true_places_m
from bench.command import parser_on_one_thread
from bench.inputs.faults import Fault, FlightInputs, faults, load
from bench.pages.text import fill, shown, table
from engine import Fix, Navigator, Prior, SceneMatcher
from engine.geo import Array
from engine.navigation.telemetry_errors import Calibration
from scenematch.check import Finding, diagnose
from scenematch.files.truth import interpolate_truth

FALSE_M, FALSE_SIGMAS = 5.0, 3.0


@dataclass(frozen=True)
class Cell:
    """What one method made of one fault of one flight.

    Attributes:
        flight, fault, method: names.
        frames, fixed, false: their numbers.
        rms_m: over all fixes; None without one.
        nees: mean over the fixes, 1 where covariances are true.
        largest_m: the largest error.
        named: what the diagnosis made of the fault: "right", "silent", "misfit" where it says that
            something does not fit and not what, "wrong", "false alarm"; "" was not asked.
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
    named: str = ""


@dataclass(frozen=True)
class Flown:
    """A flight by one method.

    Attributes:
        error_m, sigmas: of each fix whose true place is known.
        history: the calibration after each frame.
    """

    error_m: Array
    sigmas: Array
    history: list[Calibration]

    @property
    def rms_m(self) -> float | None:
        """None without a fix."""
        return float(np.sqrt(np.mean(self.error_m**2))) if len(self.error_m) else None

    @property
    def nees(self) -> float | None:
        """Per axis; None without a fix."""
        return float((self.sigmas**2).mean() / 2) if len(self.error_m) else None


def start_of(inputs: FlightInputs, stamp_ns: int) -> Prior:
    """The true place at a moment."""
    first = interpolate_truth(inputs.truth, stamp_ns)
    assert first is not None
    return Prior(lat_deg=first.lat_deg, lon_deg=first.lon_deg, sigma_m=START_SIGMA_M)


def fly(inputs: FlightInputs, stamps_ns: list[int], method: str) -> Flown:
    """Follow a flight from its true place; ``stamps_ns`` are the true ones of its frames."""
    site = inputs.site()
    matcher = SceneMatcher(site, inputs.camera, method, "cpu")
    navigator = Navigator(matcher, start_of(inputs, stamps_ns[0]))
    errors, history = [], []
    for frame, stamp_ns in zip(inputs.frames, stamps_ns, strict=True):
        result = navigator.update(frame)
        history.append(navigator.calibration)
        there = interpolate_truth(inputs.truth, stamp_ns)
        if isinstance(result, Fix) and there is not None:
            errors.append(off(result, true_places_m(site, [there])[0]))
    error_m, sigmas = np.reshape(errors, (-1, 2)).T
    return Flown(error_m, sigmas, history)


def stamps_of(inputs: FlightInputs) -> list[int]:
    """Of its frames."""
    return [frame.timestamp_ns or 0 for frame in inputs.frames]


def cell(inputs: FlightInputs, fault: Fault, flight: str, method: str) -> Cell:
    """A flight with a fault; its true stamps go with its pictures."""
    spoiled = fault.spoil(inputs)
    stamps = stamps_of(inputs if len(inputs.frames) == len(spoiled.frames) else spoiled)
    flown = fly(spoiled, stamps, method)
    false = int(((flown.error_m > FALSE_M) & (flown.sigmas > FALSE_SIGMAS)).sum())
    largest_m = float(flown.error_m.max()) if len(flown.error_m) else None
    counts = len(stamps), len(flown.error_m), false
    return Cell(flight, fault.name, method, *counts, flown.rms_m, flown.nees, largest_m)


def findings(inputs: FlightInputs, true: FlightInputs) -> list[Finding]:
    """What ``check`` finds in inputs that may have a fault, from the start of the true ones."""
    start = start_of(true, stamps_of(true)[0])
    return diagnose(inputs.frames, inputs.frames.__getitem__, inputs.site(), inputs.camera, start=start).findings


def diagnosed(inputs: FlightInputs, fault: Fault) -> tuple[str, str]:
    """Whether a diagnosis names it, and what it says."""
    found = findings(fault.spoil(inputs), inputs)
    if not found:
        verdict = "silent"
    elif found[0].cause in fault.causes:
        verdict = "right"
    elif fault.causes and not found[0].cure.startswith("--"):
        verdict = "misfit"
    else:
        verdict = "wrong" if fault.causes else "false alarm"
    return verdict, "; ".join(f"{finding.cause}: {finding.text}" for finding in found)


def _row(found: Cell) -> str:
    return (
        f"{found.flight:18s} {found.fault:38s} {found.method:5s} {found.fixed:3d} of {found.frames:3d}  "
        f"false {found.false:3d}  RMS {shown(found.rms_m):>6s}  max {shown(found.largest_m):>6s}  "
        f"NEES {shown(found.nees):>7s}  {found.named}"
    )


def rows_of(
    inputs: FlightInputs, flight: str, methods: list[str], only: str, *, diagnosis: bool
) -> Iterator[Cell]:
    """Every cell of a flight."""
    for fault in faults():
        if only not in fault.name:
            continue
        named, text = diagnosed(inputs, fault) if diagnosis else ("", "")
        if text:
            print(f"{flight:18s} {fault.name:38s} {named}: {text}", flush=True)
        for method in methods:
            yield replace(cell(inputs, fault, flight, method), named=named)


def lines_of(cells: list[Cell]) -> list[str]:
    """The table of each flight: fixes and false ones by method, and whether the fault is named."""
    lines = []
    methods = list(dict.fromkeys(found.method for found in cells))
    for flight in dict.fromkeys(found.flight for found in cells):
        rows = []
        of_flight = [found for found in cells if found.flight == flight]
        for name in dict.fromkeys(found.fault for found in of_flight):
            of_fault = {found.method: found for found in of_flight if found.fault == name}
            counts = [f"{of_fault[m].fixed}, {of_fault[m].false}" for m in methods]
            largest = [
                max((value for value in values if value is not None), default=None)
                for values in zip(*((found.largest_m, found.nees) for found in of_fault.values()), strict=True)
            ]
            named = next(iter(of_fault.values())).named
            rows.append([name, *counts, *(shown(value, ".1f") for value in largest), named])
        frames = max(found.frames for found in of_flight)
        columns = [f"`{flight}`, {frames} frames: fixed, false", *methods, "largest m", "NEES", "named"]
        lines += table(columns, rows)
    return lines


def main() -> None:
    """Print a row a cell."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--methods", nargs="*", default=["ncc", "sift", "auto"])
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--map", default="map.tif")
    parser.add_argument("--only", default="")
    parser.add_argument("--no-diagnosis", action="store_true")
    parser.add_argument("--docs", type=Path, nargs="?", const=RESULTS)
    wanted = parser.parse_args()
    begin, cells = time.monotonic(), []
    for folder in wanted.folders:
        inputs = load(folder, wanted.map, wanted.step, wanted.count)
        of_flight = rows_of(inputs, folder.name, wanted.methods, wanted.only, diagnosis=not wanted.no_diagnosis)
        for found in of_flight:
            cells.append(found)
            print(_row(found), flush=True)
    print(f"{len(cells)} cells in {time.monotonic() - begin:.0f} s")
    if wanted.docs is not None:
        fill(wanted.docs / "wrong-inputs.md", {"faults": lines_of(cells)})


if __name__ == "__main__":
    main()
