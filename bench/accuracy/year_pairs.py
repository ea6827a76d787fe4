"""Pictures of one year matched on the map of another: how many are answered, and how many answers are wrong.

    python -m bench.accuracy.year_pairs [--half report|fit] [--set naip-cities|naip] [--methods NCC,SIFT]
                                        [--matches N] [--seed N]

Every second match has no answer on its map. Nothing may be fitted on the half "report".
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from bench.accuracy.judged import Bench, Row
from bench.accuracy.trials import Ground, Trial
from bench.accuracy.years import HALVES, SETS, YearPair, pairs, trial
from bench.command import parser_on_one_thread
from bench.pages.integrity import calibration_error
from bench.pages.text import table
from engine import NoFix
from engine.window import level_crop

WITHIN_M = 6.0  # nearer than this a rival is the peak itself; a year's measured shift is good to a metre or two
PLAIN = "plain matchTemplate"
Timed = tuple[Row, float]


def matched(source: str, half: str, methods: list[str], matches: int, seed: int = 0) -> Iterator[Timed]:
    """Matches of a half of a set by each method, with the milliseconds that each took.

    Args:
        source: one of :data:`bench.accuracy.years.SETS`.
        half: "fit" or "report".
        methods: of :data:`bench.accuracy.judged.METHODS`, or :data:`PLAIN`.
        matches: by each method, in all.
        seed: of all that is drawn.
    """
    drawn = [pair for pair in pairs(source, half, seed=seed) if pair.ground.frames]
    share = np.array([len(pair.ground.frames) for pair in drawn], np.float64)
    ends = np.round(np.cumsum(share) / share.sum() * matches).astype(int)
    for index, (pair, begin, end) in enumerate(zip(drawn, [0, *ends[:-1]], ends, strict=True)):
        other = _other(drawn, index)
        bench, rng = Bench(pair.ground, other.ground), np.random.default_rng([seed, 1, index])
        for number in range(begin, end):
            made = trial(pair, other, number, rng)
            for method in methods:
                start = time.perf_counter()
                row = _plain(bench, made) if method == PLAIN else bench.judged(made, method)
                yield row._replace(right=row.error_m <= WITHIN_M), 1e3 * (time.perf_counter() - start)


def _other(drawn: list[YearPair], index: int) -> YearPair:
    """A pair of another place, or, of one place alone, the same mirrored ground."""
    here = drawn[index]
    elsewhere = [pair for pair in drawn if pair.place != here.place]
    return elsewhere[index * 7 % len(elsewhere)] if elsewhere else YearPair("mirrored", here.years, _flipped(here))


def _flipped(pair: YearPair) -> Ground:
    ground = pair.ground
    return Ground(ground.name, ground.relaid(np.ascontiguousarray(ground.gray[:, ::-1])), ground.camera,
                  ground.frames, ground.places_m)  # fmt: skip


def _plain(bench: Bench, made: Trial) -> Row:
    """The highest peak of OpenCV's plain zero-mean NCC of the rectified frame in the whole window."""
    query, _, found = bench.peak(made)
    if isinstance(found, NoFix):
        return bench.no_match(made, PLAIN)
    aligned, site = found.aligned, query.site
    crop = level_crop(site, found.fix.window, aligned.level)
    scores = cv2.matchTemplate(site.gray(crop, aligned.level), aligned.patch.gray, cv2.TM_CCOEFF_NORMED)
    _, best, _, (x, y) = cv2.minMaxLoc(scores)
    nadir_px = site.full_from_level(np.array([x + crop.x0, y + crop.y0]) - aligned.patch.offset_px, aligned.level)
    east, north = site.enu_from_pixel(nadir_px)
    fix = replace(found.fix, east_m=float(east), north_m=float(north))
    return bench.row(made, PLAIN, fix, True, [best], [])


def summary(rows: list[Timed]) -> list[str]:
    """Cells of one set and method, see :data:`HEAD`."""
    answerable = [row for row, _ in rows if row.kind == "another year"]
    found = [row for row, _ in rows if row.scores]
    worst = max((row.scores[0] for row in found if not row.right), default=0.0)
    at_zero = sum(row.right and row.scores[0] > worst for row in answerable if row.scores)
    stated = np.array([row.scores[0] for row in found])
    right = np.array([row.right for row in found])
    median_m = np.median([row.error_m for row in answerable if row.fixed and row.right] or [np.nan])
    n = len(answerable)
    return [
        f"{len(rows):,}",
        f"{sum(row.right for row in answerable) / n:.1%}",
        f"{sum(row.fixed and row.right for row in answerable) / n:.1%}",
        str(sum(row.fixed and not row.right for row, _ in rows)),
        f"{at_zero / n:.1%} ({worst:.4f})",
        f"{calibration_error(stated, right):.4f}",
        f"{median_m:.2f} m",
        f"{np.median([ms for _, ms in rows]):.1f}",
    ]


HEAD = ["set, method", "matches", "best candidate right", "availability", "wrong",
        "availability at 0 wrong (threshold)", "ECE", "median error", "ms"]  # fmt: skip


def main() -> None:
    """Match, and print."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--half", choices=HALVES, default="report")
    parser.add_argument("--set", choices=SETS, help="one of them alone")
    parser.add_argument("--methods", default=f"NCC,{PLAIN}")
    parser.add_argument("--matches", type=int, default=20_000, help="of each set, by each method")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cells = []
    for source in [options.set] if options.set else SETS:
        methods = options.methods.split(",")
        rows = list(matched(source, options.half, methods, options.matches, options.seed))
        for method in methods:
            cells.append(
                [f"{source}, {method}", *summary([(row, ms) for row, ms in rows if row.method == method])]
            )
    print("\n".join(table(HEAD, cells)))


if __name__ == "__main__":
    main()
