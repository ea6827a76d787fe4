"""How often ``check`` names something in flights that have no fault.

    python -m bench.false_alarms [--flights 100] [--first-seed 500]

Each flight is over a town of its own, in one of the conditions, with its own height, speed, course and noise of
the sensors, and begins at its true place. Prints a row a flight and the counts.
"""

from __future__ import annotations

import numpy as np

from bench.accuracy.truth import true_start
from bench.command import parser_on_one_thread
from scenematch.check import Diagnosis, diagnose
from scenematch.simulator import CONDITIONS, FlightStyle, plan_flight

HEIGHTS_M, SPEEDS_MPS = (90.0, 160.0), (4.0, 12.0)
RATE_HZ = 1.12 / 2  # of the pictures; ``check`` looks at sixteen of them and the next ones


def checked(seed: int, condition: str) -> Diagnosis:
    """A flight of its own, and what ``check`` makes of it."""
    rng = np.random.default_rng(seed)
    style = FlightStyle(height_agl_m=rng.uniform(*HEIGHTS_M), cruise_mps=rng.uniform(*SPEEDS_MPS))
    plan = plan_flight(seed, rate_hz=RATE_HZ, style=style, condition=condition)
    frames, site, start = list(plan.iter_frames()), plan.town.site(), true_start(plan.truth_rows())
    return diagnose(frames, frames.__getitem__, site, plan.camera, start=start)


def main() -> None:
    """A row a flight."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=500)
    wanted = parser.parse_args()
    alarms = placed = 0
    for count in range(wanted.flights):
        condition = sorted(CONDITIONS)[count % len(CONDITIONS)]
        found = checked(wanted.first_seed + count, condition)
        alarms += bool(found.findings)
        placed += bool(found.compared)
        said = "; ".join(f"{one.cause}: {one.text}" for one in found.findings) or "nothing"
        print(
            f"{wanted.first_seed + count} {condition:12s} {found.seen:2d} of {found.looked_at} placed: {said}",
            flush=True,
        )
    print(f"{alarms} of {wanted.flights} flights without a fault were given one; {placed} could be compared")


if __name__ == "__main__":
    main()
