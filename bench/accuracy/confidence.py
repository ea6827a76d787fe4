"""Calibrate the evidence that a place is right (:mod:`engine.matching.evidence`).

    python -m bench.accuracy.confidence [--matches N] [--method "NCC, grey levels"|"NCC, structure"|SIFT]

On towns that no other benchmark reports on, and as many matches of one year on the map of another: over the
cities' half for fitting, and for SIFT over the farmland's. Half of the matches have an answer; what is left out of
the telemetry and how coarsely SIFT looks changes from match to match. Printed is how often evidence is met for
wrong places, beside how often it may be.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.judged import GREY, STRUCTURE, Bench, Row
from bench.accuracy.trials import Trial, ground
from bench.accuracy.year_pairs import matched as year_matched
from bench.command import parser_on_one_thread
from engine.options import SiftOptions
from engine.runtime.threads import set_threads

FIT_SEEDS = (21, 22, 23, 24, 25, 26)
METHODS = (GREY, STRUCTURE, "SIFT")
UNTOLD = 0.25  # how often something is left out
SCALES = (0.5, 0.35, 0.25)  # of the frame, as a budget asks for


def alarms(nats: NDArray[np.float64], right: NDArray[np.bool_]) -> str:
    """How many wrong places have more evidence than a few nats, beside how many may have.

    Args:
        nats: (N,) evidence of each place.
        right: (N,) whether it was right.
    """
    wrong = nats[~right]
    shown = (
        f"{(wrong > e).sum()} of wrong places above {e} nats, {wrong.size * np.exp(-e):.1f} may be"
        for e in (2, 4, 6, 8)
    )
    return "\n".join(shown)


def matched(job: tuple[int, int, int, str]) -> list[Row]:
    """Matches of one town by one method, another town being the wrong one."""
    seed, other, count, method = job
    set_threads(1)
    bench, rng = Bench(ground(seed), ground(other, map_only=True)), np.random.default_rng(seed)
    trials = bench.trials(range(count), rng)
    if method in (GREY, STRUCTURE):
        return [bench.judged(made, method) for made in trials]
    return [_by_sift(bench, made, rng) for made in trials]


def matched_years(count: int, method: str) -> list[Row]:
    """Matches of one year on the map of another; right by the benchmark's own distance."""
    set_threads(1)
    sources = {"naip-cities": 0.7, "naip": 0.3} if method == "SIFT" else {"naip-cities": 1.0}
    return [
        row
        for source, share in sources.items()
        for row, _ in year_matched(source, "fit", [method], round(share * count))
    ]


def _by_sift(bench: Bench, made: Trial, rng: np.random.Generator) -> Row:
    frame, prior = made.frame, made.prior if rng.random() > UNTOLD else None
    for names in (("heading_deg",), ("roll_deg", "pitch_deg"), ("height_agl_m",)):
        if rng.random() < UNTOLD:
            frame = replace(frame, **dict.fromkeys(names))
    return bench.posed(made, frame, prior, SiftOptions(scale=float(rng.choice(SCALES))))


def main() -> None:
    """Match, count and print."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--matches", type=int, default=12_000, help="by each method")
    parser.add_argument("--method", choices=METHODS)
    options = parser.parse_args()
    each = options.matches // len(FIT_SEEDS)
    for method in METHODS:
        if options.method not in (None, method):
            continue
        jobs = [(a, b, each, method) for a, b in zip(FIT_SEEDS, FIT_SEEDS[1:] + FIT_SEEDS[:1], strict=True)]
        with ProcessPoolExecutor(2) as pool:
            years = pool.submit(matched_years, options.matches, method)
            parts = [*pool.map(matched, jobs), years.result()]
        found = [row for part in parts for row in part if row.regressors]
        right = np.array([row.right for row in found])
        values = np.array([row.regressors for row in found])
        wrong = int((~right).sum())
        counts = f"{sum(map(len, parts))} matches, {len(found)} found something, {wrong} wrong"
        print(f"{method}\n{alarms(values[:, 0], right)}\n{counts}", flush=True)


if __name__ == "__main__":
    main()
