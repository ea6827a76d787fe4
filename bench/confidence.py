"""What tells a right peak from a wrong one: the probability of a fix, fitted on some towns and judged on others.

    python -m bench.confidence --fit               prints the constants of engine.evidence.FITTED
    python -m bench.confidence [--matches N]       judges them, beside single scores

Half of the matches have an answer. Every rule gets the threshold that keeps 95 % of the right peaks of the towns
of the fit, and is then judged on towns, and recorded flights, that it has not seen.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.flights import recorded
from bench.integrity import ANSWERABLE
from engine import Frame, MatcherOptions, NoFix, OrthoMap, Prior, SceneMatcher
from engine.budget import Budget, Deadline
from engine.device import set_threads
from engine.evidence import Logistic, probability, terms
from engine.formats.truth import interpolate_truth
from engine.integrity import judge_peak
from engine.methods import ncc
from engine.methods.laid import NccOptions
from engine.methods.query import Query, level_crop
from engine.ncc_fft import surface
from engine.report.metrics import FALSE_SIGMAS, WRONG_M
from engine.sim import plan_flight

Array = NDArray[np.float64]

FIT_SEEDS = (21, 22, 23, 24, 25, 26)
REPORT_SEEDS = (41, 42, 43, 44)
FLIGHTS = {"gazebo-a1": 8, "gazebo-a2": 8, "gazebo-a1-evening": 8, "caliterra": 1}
FRAMES = 60
SIGMA_M = 8.0
FAR_M = 150.0
TPR = 0.95
UNANSWERABLE = ("prior elsewhere", "another map", "mirrored frame", "upside down")
RULES = ("probability", "NCC", "PSR", "second peak")
UNSUITABLE = ("heading off by 5 degrees", "height off by 5 %")  # several times what is assumed of the telemetry


@dataclass(frozen=True)
class Ground:
    """A map, and frames taken over it with their true east and north."""

    name: str
    matcher: SceneMatcher
    frames: list[Frame]
    places_m: Array


@dataclass(frozen=True)
class Sample:
    """One match. ``right`` is whether its peak lies where the frame was taken; ``squared_sigmas`` NaN if not."""

    ground: str
    kind: str
    right: bool
    rule: bool
    scores: tuple[float, ...]  # one for each of RULES; higher speaks for the peak
    terms: Array
    error_m: float
    squared_sigmas: float


def town(seed: int) -> Ground:
    """A flight over a simulated town; every third one in the evening, over the map of noon."""
    plan = plan_flight(seed, frames=None, rate_hz=0.45, light="evening" if seed % 3 == 0 else "noon")
    drawn = plan.town
    gray = np.asarray(cv2.cvtColor(drawn.ortho, cv2.COLOR_RGB2GRAY), np.uint8)
    site = OrthoMap.from_arrays(gray, drawn.pixel_to_crs, f"EPSG:{drawn.crs_epsg}", surface_m=drawn.surface_m)
    frames = [frame for _, frame in zip(range(FRAMES), plan.iter_frames(), strict=False)]
    places = [site.frame.enu_from_geodetic(t.lat_deg, t.lon_deg)[:2] for t in plan.truth_rows()[: len(frames)]]
    return Ground(f"town {seed}", _matcher(site, plan.camera), frames, np.array(places))


def flight(name: str) -> Ground:
    """Frames of a shared flight."""
    flown = recorded(name, FLIGHTS[name])
    frames, places = [], []
    for frame, _ in flown.frames:
        true = None if frame.timestamp_ns is None else interpolate_truth(flown.truth, frame.timestamp_ns)
        if true is not None and frame.height_agl_m is not None and frame.heading_deg is not None:
            frames.append(frame)
            places.append(flown.site.frame.enu_from_geodetic(true.lat_deg, true.lon_deg)[:2])
    return Ground(name, _matcher(flown.site, flown.camera), frames, np.array(places))


def _matcher(site: OrthoMap, camera: object) -> SceneMatcher:
    options = MatcherOptions(ncc=NccOptions(refine=False))
    return SceneMatcher(site, camera, "ncc", "cpu", options)  # type: ignore[arg-type]


def samples(own: Ground, other: Ground, count: int, seed: int) -> list[Sample]:
    """Matches of one ground's frames, every second without an answer."""
    rng, out = np.random.default_rng(seed), []
    for number in range(count):
        index = int(rng.integers(len(own.frames)))
        frame, place, where = own.frames[index], own.places_m[index], own
        if number % 2 == 0:
            kind = list(ANSWERABLE)[number // 2 % len(ANSWERABLE)]
            frame = ANSWERABLE[kind](frame, rng)
            truth = place
        else:
            kind = UNANSWERABLE[number // 2 % len(UNANSWERABLE)]
            frame, place, where, truth = _unanswerable(kind, own, other, index, rng)
        found = _sample(where, kind, frame, place, truth, rng)
        if found is not None:
            out.append(replace(found, ground=own.name))
    return out


def _unanswerable(
    kind: str, own: Ground, other: Ground, index: int, rng: np.random.Generator
) -> tuple[Frame, Array, Ground, Array | None]:
    frame, place = own.frames[index], own.places_m[index]
    image = np.asarray(frame.image)
    if kind == "mirrored frame":
        return replace(frame, image=np.ascontiguousarray(image[:, ::-1])), place, own, None
    if kind == "upside down":
        return replace(frame, image=np.ascontiguousarray(image[::-1, ::-1])), place, own, None
    far = np.flatnonzero(np.hypot(*(own.places_m - place).T) > FAR_M)
    if kind == "prior elsewhere" and len(far):
        return frame, own.places_m[rng.choice(far)], own, place
    return frame, other.places_m[int(rng.integers(len(other.places_m)))], other, None


def _sample(
    where: Ground, kind: str, frame: Frame, place: Array, truth: Array | None, rng: np.random.Generator
) -> Sample | None:
    east, north = place + rng.normal(0.0, SIGMA_M, 2)
    prior = Prior(east_m=float(east), north_m=float(north), sigma_m=SIGMA_M)
    options = where.matcher.options.ncc
    query = where.matcher._query(frame, prior, Deadline(Budget()))
    found = ncc.find(query, where.matcher._prepared, options)
    if isinstance(found, NoFix):
        return None
    fix = found.fix
    error = np.array([fix.east_m, fix.north_m]) - truth if truth is not None else np.full(2, np.inf)
    error_m = float(np.hypot(*error))
    right = error_m <= WRONG_M or error_m <= FALSE_SIGMAS * fix.sigma_m
    squared = float(error @ np.linalg.solve(fix.covariance_m2[:2, :2], error)) if right else np.nan
    evidence = found.evidence
    assert evidence is not None  # there is a prior, and a heading and height to trust
    rule = judge_peak(
        found.peak,
        found.aligned.template.numel(),
        options.rule,
        whole_map=evidence.off_prior > options.rule.max_prior_chi_square,
    )
    scores = (
        probability(evidence),
        found.peak.score,
        _psr(query, where, found),
        -evidence.ratio,
    )
    return Sample("", kind, right, rule is None, scores, terms(evidence), error_m, squared)


def _psr(query: Query, where: Ground, found: ncc.Found) -> float:
    """Peak-to-sidelobe ratio: the peak above the mean of the rest, in standard deviations of the rest."""
    crop = level_crop(query.site, found.fix.window, found.aligned.level)
    region = where.matcher._prepared.cut(crop, found.aligned.level)
    template = found.aligned.template
    if region.window.height_px < template.shape[0] or region.window.width_px < template.shape[1]:
        return 0.0
    scores = surface(region.search, template[None])[0].numpy()
    y, x = np.unravel_index(int(scores.argmax()), scores.shape)
    rows, columns = np.ogrid[: scores.shape[0], : scores.shape[1]]
    rest = scores[np.hypot(rows - y, columns - x) > 11.0]
    return float((scores[y, x] - rest.mean()) / max(float(rest.std()), 1e-6)) if rest.size else 0.0


def fitted(found: list[Sample]) -> Logistic:
    """Maximum likelihood by Newton's method, with a whisper of ridge that keeps it finite."""
    x = np.array([s.terms for s in found])
    y = np.array([s.right for s in found], float)
    weights = np.zeros(x.shape[1])
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-np.clip(x @ weights, -30, 30)))
        hessian = (x * (p * (1.0 - p))[:, None]).T @ x + 0.1 * np.eye(x.shape[1])
        step = np.linalg.solve(hessian, x.T @ (y - p) - 0.1 * weights)
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    return Logistic(*(float(round(w, 3)) for w in weights))


def gather(seeds: tuple[int, ...], flights: tuple[str, ...], count: int, seed: int) -> list[Sample]:
    """Matches over all grounds, by two processes; each ground's stranger is the next one."""
    names: list[int | str] = [*seeds, *flights]
    jobs = [(name, names[(i + 1) % len(names)], count // len(names), seed + i) for i, name in enumerate(names)]
    with ProcessPoolExecutor(2) as pool:
        return [sample for part in pool.map(_job, jobs) for sample in part]


def _job(job: tuple[int | str, int | str, int, int]) -> list[Sample]:
    set_threads(1)
    own, other = (town(n) if isinstance(n, int) else flight(n) for n in job[:2])
    return samples(own, other, job[2], job[3])


def calibration_error(p: Array, right: NDArray[np.bool_], bins: int = 10) -> float:
    """ECE: how far the share of right ones is from the probability stated, over bins of equal width."""
    index = np.minimum((p * bins).astype(int), bins - 1)
    parts = [(index == b) for b in range(bins) if (index == b).any()]
    return float(sum(abs(p[part].mean() - right[part].mean()) * part.mean() for part in parts))


def auc(score: Array, right: NDArray[np.bool_]) -> float:
    """Chance that a right one scores above a wrong one."""
    from scipy.stats import rankdata

    ranks, n = rankdata(score), int(right.sum())
    return float((ranks[right].sum() - n * (n + 1) / 2) / (n * (len(right) - n)))


def table(fit: list[Sample], judged: list[Sample]) -> list[str]:
    """Lines of Markdown: each rule at the threshold that the fit set gives it."""
    lines = [
        "| rule | threshold | right kept | wrong let through | wrong in 100,000 matches | AUC |",
        "|---" * 6 + "|",
    ]
    fit = [s for s in fit if s.kind not in UNSUITABLE]
    right_fit = np.array([s.right for s in fit])
    right = np.array([s.right for s in judged])
    for k, name in enumerate(RULES):
        threshold = float(np.quantile(np.array([s.scores[k] for s in fit])[right_fit], 1.0 - TPR))
        score = np.array([s.scores[k] for s in judged])
        kept = score >= threshold
        lines.append(_row(name, f"{threshold:.3f}", kept, right, auc(score, right)))
    lines.append(_row("PeakRule", "as set", np.array([s.rule for s in judged]), right, float("nan")))
    return lines


def _row(name: str, threshold: str, kept: NDArray[np.bool_], right: NDArray[np.bool_], area: float) -> str:
    per = 1e5 * float((kept & ~right).mean())
    tpr, fpr = float(kept[right].mean()), float(kept[~right].mean())
    return f"| {name} | {threshold} | {100 * tpr:.1f} % | {100 * fpr:.2f} % | {per:.0f} | {area:.4f} |"


def by_kind(judged: list[Sample], threshold: float) -> list[str]:
    """Lines of Markdown: what the probability lets through of each kind, with NEES and coverage."""
    lines = ["| kind | matches | believed | wrong | PeakRule: believed | wrong | NEES | in the 95 % ellipse |"]
    lines.append("|---" * 8 + "|")
    for kind in (*ANSWERABLE, *UNANSWERABLE):
        of = [s for s in judged if s.kind == kind]
        if not of:
            continue
        kept, old = [s for s in of if s.scores[0] >= threshold], [s for s in of if s.rule]
        squared = np.array([s.squared_sigmas for s in kept if s.right])
        nees = f"{squared.mean():.2f} | {100 * (squared <= 5.99).mean():.0f} %" if len(squared) else "- | -"
        shares = [f"{100 * len(p) / len(of):.1f} % | {sum(not s.right for s in p)}" for p in (kept, old)]
        lines.append(f"| {kind} | {len(of)} | {shares[0]} | {shares[1]} | {nees} |")
    return lines


def main() -> None:
    """Fit, or judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--matches", type=int, default=12_000)
    options = parser.parse_args()
    fit = gather(FIT_SEEDS, (), options.matches, 0)
    if options.fit:
        print(fitted(fit))
        return
    threshold = NccOptions().rule.min_confidence
    sets = (("Other towns", REPORT_SEEDS, (), 1), ("Recorded flights", (), tuple(FLIGHTS), 8))
    for name, seeds, flights, fewer in sets:
        judged = gather(seeds, flights, options.matches // fewer, 1000)
        suitable = [s for s in judged if s.kind not in UNSUITABLE]
        right, p = np.array([s.right for s in judged]), np.array([s.scores[0] for s in judged])
        print(f"\n## {name}: {len(judged)} matches, ECE {calibration_error(p, right):.4f}\n")
        print("\n".join([*table(fit, suitable), "", *by_kind(judged, threshold)]), flush=True)


if __name__ == "__main__":
    main()
