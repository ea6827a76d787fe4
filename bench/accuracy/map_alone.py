"""Flights whose surface model is withheld: what refinement over a plane gives beside the peak alone.

    python -m bench.accuracy.map_alone [--flights NAME ...] [--map FILE]

Prints the recorded flights' rows of the table in docs/how-ncc-works.md. Frames are matched one by one, each with a
prior that is 4 m off per axis and says 8 m. The Gazebo maps are exact and said to be good to 0.1 m; that of
caliterra as :data:`bench.accuracy.nees.RECORDED` has it.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench import SHARED
from bench.accuracy.flights import Recorded, recorded
from bench.accuracy.nees import OFF_M, SIGMA_M
from bench.accuracy.nees import RECORDED as KNOWN
from bench.pages.text import table
from engine import Fix, MatcherOptions, Prior, SceneMatcher
from engine.formats.truth import interpolate_truth
from engine.methods.options import NccOptions
from engine.report.metrics import FALSE_SIGMAS
from engine.threads import set_threads

Array = NDArray[np.float64]
STEPS = {"gazebo-a1": 3, "gazebo-a2": 3, "gazebo-a1-evening": 3, "caliterra": 1}
GAZEBO_MAP_M = 0.1


@dataclass(frozen=True)
class Row:
    """The fixes of a flight.

    Attributes:
        confirmed: fixes whose refinement stood.
        error_m: (N, 2) of the fixes.
        squared_sigmas: (N,) the same by their covariance.
    """

    confirmed: int
    error_m: Array
    squared_sigmas: Array

    @property
    def cells(self) -> list[str]:
        """RMS, NEES, and the number beyond three sigmas."""
        rms_m = float(np.sqrt(np.mean(np.sum(self.error_m**2, axis=1))))
        beyond = int((self.squared_sigmas > FALSE_SIGMAS**2).sum())
        return [f"{rms_m:.2f}", f"{self.squared_sigmas.mean():.1f}", f"{beyond}"]


def flown(name: str, map_name: str) -> Recorded:
    """Every few frames of a flight, over its map alone."""
    map_m = KNOWN[name].map_m if name == "caliterra" else GAZEBO_MAP_M
    return recorded(name, STEPS[name], map_name=map_name, with_surface=False, georeference_sigma_m=map_m)


def matched(name: str, flight: Recorded, *, refine: bool) -> Row:
    """Every frame by NCC."""
    rng, options = np.random.default_rng(0), NccOptions(errors=KNOWN[name].errors, refine=refine)
    matcher = SceneMatcher(flight.site, flight.camera, "ncc", "cpu", MatcherOptions(ncc=options))
    matcher.warmup()
    frames, priors, places = [], [], []
    for frame, _ in flight.frames:
        true = None if frame.timestamp_ns is None else interpolate_truth(flight.truth, frame.timestamp_ns)
        if true is None:
            continue
        place = np.array(flight.site.frame.enu_from_geodetic(true.lat_deg, true.lon_deg)[:2])
        east, north = place + rng.normal(0.0, OFF_M, 2)
        frames.append(frame)
        places.append(place)
        priors.append(Prior(east_m=float(east), north_m=float(north), sigma_m=SIGMA_M))
    found = zip(matcher.locate_many(frames, priors), places, strict=True)
    fixes = [(fix, place) for fix, place in found if isinstance(fix, Fix)]
    error_m = np.array([[fix.east_m, fix.north_m] - place for fix, place in fixes])
    covariances = np.array([fix.covariance_m2[:2, :2] for fix, _ in fixes])
    squared = np.einsum("ni,ni->n", error_m, np.linalg.solve(covariances, error_m[..., None])[..., 0])
    return Row(sum(fix.stage == "refined" for fix, _ in fixes), error_m, squared)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", nargs="*", choices=STEPS, default=STEPS)
    parser.add_argument("--map", default="map.tif")
    options, rows = parser.parse_args(), []
    set_threads(1)
    for name in options.flights:
        if not (SHARED / name / options.map).exists():
            continue
        flight = flown(name, options.map)
        peak, refined = (matched(name, flight, refine=refine) for refine in (False, True))
        both = [f"{old}, **{new}**" for old, new in zip(peak.cells, refined.cells, strict=True)]
        rows.append([f"`{name}`", f"{refined.confirmed} of {len(refined.error_m)}", *both])
    print("\n".join(table(["flight", "confirmed", "RMS m", "NEES", "beyond 3 sigma"], rows)))


if __name__ == "__main__":
    main()
