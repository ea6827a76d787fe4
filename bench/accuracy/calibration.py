"""Calibration: constant errors of the inputs, as the flight itself and ``check`` measure them.

    python -m bench.accuracy.calibration FOLDER... [--methods ncc sift] [--step 1] [--count 400] [--map NAME]

Each error is put into a flight folder with truth. A row says what `Navigator.calibration` held at the end, how
soon it was and stayed within three of its sigmas and a fifth of the error, what ``check`` names, and the RMS
of the fixes as given, with what ``check`` says taken off, and without the error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.command import parser_on_one_thread
from bench.faults import Flown, findings, fly, stamps_of
from bench.inputs.faults import FlightInputs, Spoil, late, lens, load, mounted, raised, turned
from bench.pages.text import shown
from engine.navigation.telemetry_errors import Calibration
from scenematch.check import Finding
from scenematch.files.truth import interpolate_truth

Measured = tuple[float, float]  # a value and its standard deviation
CLOSE = 0.2  # of the error, within which it counts as recovered


@dataclass(frozen=True)
class Error:
    """A constant error.

    Attributes:
        name: of the row.
        spoil: puts it in.
        size: what is to be found, in the unit of ``measured``, besides what the telemetry is off by itself.
        measured: the navigator's value of it; None while it has none.
        own: what the telemetry is off by itself, by its truth.
        cure: takes off what ``check`` found.
        causes: what ``check`` may call it.
    """

    name: str
    spoil: Spoil
    size: float
    measured: Callable[[Calibration], Measured | None]
    own: Callable[[FlightInputs], float]
    cure: Callable[[float], Spoil]
    causes: tuple[str, ...]


def _heading(found: Calibration) -> Measured | None:
    return None if found.attitude is None else (found.attitude.heading_deg, found.attitude.sigma_deg[2])


def _pitch(found: Calibration) -> Measured | None:
    return None if found.attitude is None else (found.attitude.pitch_deg, found.attitude.sigma_deg[1])


def _height(found: Calibration) -> Measured | None:
    known = found.height_m is not None and found.height_sigma_m is not None
    return (found.height_m or 0.0, found.height_sigma_m or 0.0) if known else None


def _factor(found: Calibration) -> Measured | None:
    measured = _height(found)
    if measured is None or found.height_factor is None or not measured[0]:
        return None
    return found.height_factor - 1.0, abs((found.height_factor - 1.0) / measured[0]) * measured[1]


def _lag(found: Calibration) -> Measured | None:
    return found.attitude_lag_s, found.attitude_lag_sigma_s


def _own(name: str) -> Callable[[FlightInputs], float]:
    """Median of what is to be added to an angle of the telemetry, over the flight."""

    def off_deg(true: FlightInputs) -> float:
        apart = []
        for frame in true.frames:
            there = interpolate_truth(true.truth, frame.timestamp_ns or 0)
            known, right = getattr(frame, name), None if there is None else getattr(there, name)
            if known is not None and right is not None:
                apart.append(math.remainder(right - known, 360.0))
        return float(np.median(apart)) if apart else 0.0

    return off_deg


def _none(true: FlightInputs) -> float:
    return 0.0


ERRORS = (
    Error("heading +5 degrees", turned(0, 0, 5), -5.0, _heading, _own("heading_deg"),
          lambda v: turned(0, 0, v), ("heading", "mount")),
    Error("height +10 m", raised(lambda h: h + 10), -10.0, _height, _none,
          lambda v: raised(lambda h: h + v), ("height",)),
    Error("mount 2 degrees", mounted(tilt_deg=2), -2.0, _pitch, _own("pitch_deg"),
          lambda v: mounted(tilt_deg=-v), ("mount",)),
    Error("clock 0.3 s", late(0.3), 0.3, _lag, _none, lambda v: late(-v), ("clock",)),
    Error("focal length +5 %", lens(1.05), 0.05, _factor, _none, lambda v: lens(1 / v), ("focal", "height")),
)  # fmt: skip


def converged_s(flown: Flown, true: FlightInputs, error: Error, truth: float) -> float | None:
    """Since when the value was within three sigmas and a fifth of the error, to the end."""
    since: float | None = None
    for stamp_ns, found in zip(stamps_of(true), flown.history, strict=True):
        value = error.measured(found)
        good = value is not None and abs(value[0] - truth) <= min(3.0 * value[1], CLOSE * abs(error.size))
        time_s = (stamp_ns - stamps_of(true)[0]) * 1e-9
        since = (time_s if since is None else since) if good else None
    return since


def cured(inputs: FlightInputs, error: Error, found: Finding) -> FlightInputs:
    """The inputs without what was found."""
    value = found.value or 0.0
    if error.name.startswith("focal") and found.cause == "height":  # the sentence names both
        heights = [frame.height_agl_m for frame in inputs.frames if frame.height_agl_m is not None]
        value = 1.0 + value / float(np.median(heights))
    return error.cure(value)(inputs)


def figures(flown: Flown) -> str:
    """Fixes, RMS and NEES."""
    return f"{len(flown.error_m)}, RMS {shown(flown.rms_m)} m, NEES {shown(flown.nees)}"


def row(error: Error, true: FlightInputs, method: str, right: Flown, found: list[Finding]) -> str:
    """A line of the table."""
    inputs = error.spoil(true)
    before = fly(inputs, stamps_of(true), method)
    truth = error.size + error.own(true)
    value, since = error.measured(before.history[-1]), converged_s(before, true, error, truth)
    learnt = "-" if value is None else f"{value[0]:.3g} ± {value[1]:.2g}"
    soon = "-" if since is None else f"{since:.1f} s"
    rightly = [one for one in found if one.cause in error.causes and one.value is not None]
    if rightly:
        one = rightly[0]
        after = fly(cured(inputs, error, one), stamps_of(true), method)
        said = f"{one.cause} {one.value:.3g} ± {one.sigma or 0.0:.2g}"
        rest = figures(after)
    else:
        said, rest = ", ".join(one.cause for one in found) or "silent", "-"
    return (
        f"{error.name:18s} {method:5s} learnt {learnt:16s} of {truth:.3g}  within {soon:7s} "
        f"check: {said:24s} as given {figures(before)} of {len(true.frames)}; "
        f"cured {rest}; right {figures(right)}"
    )


def main() -> None:
    """A row an error and method."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--methods", nargs="*", default=["ncc", "sift"])
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--map", default="map.tif")
    wanted = parser.parse_args()
    for folder in wanted.folders:
        true = load(folder, wanted.map, wanted.step, wanted.count)
        right = {method: fly(true, stamps_of(true), method) for method in wanted.methods}
        print(f"{folder.name}, {len(true.frames)} frames", flush=True)
        for error in ERRORS:
            found = findings(error.spoil(true), true)
            for method in wanted.methods:
                print(row(error, true, method, right[method], found), flush=True)


if __name__ == "__main__":
    main()
