"""Flights whose surface model is withheld: what refinement over a plane gives beside the peak alone.

    python -m bench.accuracy.map_alone [--flights NAME ...] [--map FILE]

Prints the recorded flights' rows of the table in docs/results/ncc.md. Frames are matched one by one, each with a
prior that is 4 m off per axis and says 8 m. The Gazebo maps are exact and said to be good to 0.1 m; that of
caliterra as :data:`bench.accuracy.nees.RECORDED` has it.
"""

from __future__ import annotations

import argparse

import numpy as np

from bench import SHARED
from bench.accuracy.flights import recorded
from bench.accuracy.nees import RECORDED, Flight, Sample, flight_of, samples
from bench.pages.text import table
from engine.runtime.threads import set_threads
from scenematch.report.metrics import FALSE_SIGMAS

STEPS = {"gazebo-a1": 3, "gazebo-a2": 3, "gazebo-a1-evening": 3, "caliterra": 1}
GAZEBO_MAP_M = 0.1


def flown(name: str, map_name: str) -> Flight:
    """Every few frames of a flight, over its map alone."""
    map_m = RECORDED[name].map_m if name == "caliterra" else GAZEBO_MAP_M
    over = recorded(name, STEPS[name], map_name=map_name, with_surface=False, georeference_sigma_m=map_m)
    return flight_of(over, RECORDED[name])


def cells(fixes: list[Sample]) -> list[str]:
    """RMS, NEES, and the number beyond three sigmas."""
    error_m, squared = (
        np.array([fix.error_m[:2] for fix in fixes]),
        np.array([fix.squared_sigmas for fix in fixes]),
    )
    rms_m = float(np.sqrt(np.mean(np.sum(error_m**2, axis=1))))
    return [f"{rms_m:.2f}", f"{squared.mean():.1f}", f"{int((squared > FALSE_SIGMAS**2).sum())}"]


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
        peak, refined = (
            [found for found in samples(flight, method) if found is not None]
            for method in ("NCC, peak", "NCC, refined")
        )
        both = [f"{old}, **{new}**" for old, new in zip(cells(peak), cells(refined), strict=True)]
        rows.append([f"`{name}`", f"{sum(fix.is_refined for fix in refined)} of {len(refined)}", *both])
    print("\n".join(table(["flight", "confirmed", "RMS m", "NEES", "beyond 3 sigma"], rows)))


if __name__ == "__main__":
    main()
