"""A pose to trust: 100,000 sets of wrong matches, none of which may give one; and errors beside their covariance.

``python -m bench.accuracy.poses [sets] [cases] [seed]`` prints two tables.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from bench.accuracy.pose_scenes import CAMERA, GROUNDS, WRONG, attitude, measured, scene
from engine.matching.pose import solve_pose

CHI2_3_SIGMA = 14.156  # three degrees of freedom, 99.73 %


@dataclass(frozen=True)
class Coverage:
    """How errors lie within their covariance, over the frames that gave a pose."""

    cases: int
    accepted: int
    off: int  # accepted more than 10 m and 3 sigma off
    within: float  # share within 3 sigma in the sense of Mahalanobis, of the centre
    within_axis: float  # the same, the worst of east, north and up
    nees: float  # mean; 3 is consistent
    within_turn: float  # of the attitude
    nees_turn: float


def accepted(kind: str, sets: int, seed: int) -> int:
    """How many sets of wrong matches gave a pose; every other one comes with telemetry."""
    rng, count = np.random.default_rng([seed, list(WRONG).index(kind)]), 0
    for i in range(sets):
        points, pixels = WRONG[kind](rng)
        prior = measured(rng, attitude(rng, rng.uniform(0, 10))) if i % 2 else None
        count += solve_pose(points, pixels, CAMERA.matrix, prior=prior) is not None
    return count


def coverage(ground: str, with_prior: bool, cases: int, seed: int) -> Coverage:
    """Errors of many simulated frames against their own covariance."""
    rng, rows = np.random.default_rng([seed, GROUNDS.index(ground), with_prior]), []
    for _ in range(cases):
        s = scene(rng, ground, with_prior=with_prior)
        pose = solve_pose(s.points_m, s.points_px, CAMERA.matrix, prior=s.prior)
        if pose is None:
            continue
        error = pose.center_m - s.center_m
        turn = cv2.Rodrigues(s.rotation @ pose.rotation.T)[0][:, 0]
        within = np.abs(error) < 3 * np.sqrt(np.diag(pose.covariance_center_m2))
        nees = error @ np.linalg.solve(pose.covariance_center_m2, error)
        off = nees > CHI2_3_SIGMA and np.linalg.norm(error) > 10
        rows.append([nees, turn @ np.linalg.solve(pose.covariance[3:, 3:], turn), off, *within])
    table = np.array(rows, dtype=float)
    return Coverage(
        cases=cases,
        accepted=len(table),
        off=int(table[:, 2].sum()),
        within=float(np.mean(table[:, 0] < CHI2_3_SIGMA)),
        within_axis=float(table[:, 3:].mean(axis=0).min()),
        nees=float(table[:, 0].mean()),
        within_turn=float(np.mean(table[:, 1] < CHI2_3_SIGMA)),
        nees_turn=float(table[:, 1].mean()),
    )


def main() -> None:
    """Both tables, over two processes."""
    sets, cases, seed = (int(v) for v in [*sys.argv[1:], *["100000", "2000", "0"][len(sys.argv) - 1 :]])
    kinds = list(WRONG)
    shares = [sets // len(kinds) + (i < sets % len(kinds)) for i in range(len(kinds))]
    settings = [(ground, prior) for ground in GROUNDS for prior in (False, True)]
    with ProcessPoolExecutor(2, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        counts = list(pool.map(partial(accepted, seed=seed), kinds, shares))
        print("| wrong matches | sets | accepted |\n|---|---|---|")
        for row in [*zip(kinds, shares, counts, strict=True), ("all", sets, sum(counts))]:
            print("| {} | {:,} | {} |".format(*row))
        print("\n| ground | attitude | poses | within 3 sigma | worst axis | NEES | of attitude | NEES | false |")
        print("|---|---|---|---|---|---|---|---|---|")
        task: Callable[[str, bool], Coverage] = partial(coverage, cases=cases, seed=seed)
        for (ground, prior), c in zip(settings, pool.map(task, *zip(*settings, strict=True)), strict=True):
            shown = (
                f"{c.within:.2%} | {c.within_axis:.2%} | {c.nees:.2f} | {c.within_turn:.2%} | {c.nees_turn:.2f}"
            )
            known = "telemetry" if prior else "free"
            print(f"| {ground} | {known} | {c.accepted} of {c.cases} | {shown} | {c.off} |")


if __name__ == "__main__":
    main()
