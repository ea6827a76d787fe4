"""A track in words: its key figures, the verdict in two sentences, and the meaning of each reason for refusal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from engine.values import Reason
from scenematch.report.loop_record import LoopRecord, rms
from scenematch.report.metrics import WRONG_M

MEANINGS = {
    Reason.NO_TEXTURE: "The picture is almost flat, or covers next to nothing of the map.",
    Reason.OUTSIDE_MAP: "The window lies outside the map, or on parts of it that hold no data.",
    Reason.AMBIGUOUS: "Another position matches nearly as well, or the best one lies at the window's edge.",
    Reason.LOW_SCORE: "The best match may be chance: the frame may not show this part of the map.",
    Reason.TOO_FEW_MATCHES: "Fewer features were matched than a pose requires.",
    Reason.BAD_POSE: "No pose explains enough of the matches, or only one that is implausible for a drone.",
    Reason.INCONSISTENT: "The match and a well-known prediction contradict each other.",
    Reason.UNCONFIRMED: "Only the match itself supports the position, and too few other fixes agree yet.",
    Reason.NO_HEIGHT: "The telemetry gives no height above the ground, which sets the scale of a frame.",
    Reason.NO_HEADING: "The telemetry gives no heading, without which a frame cannot be rotated.",
    Reason.MAP_TOO_LARGE: "The position was too uncertain: the part of the map to search is too large.",
    Reason.TILTED: "A corner of the frame looks so near the horizon that the ground is stretched beyond use.",
    Reason.LATE: "The answer came after the budget, or could not have come within it.",
    Reason.FAILED: "The frame could not be used: it repeats the last one, or the worker that matched it died.",
}
"""One sentence for each reason; ``docs/integrity.md`` has the rules behind them."""

# Of fixes with a consistent covariance 1 % lie beyond three sigmas, and the mean NEES is 2.
_BEYOND_SHARE, _MAX_NEES = 0.05, 8.0
_CAUTIOUS = 2.0  # ratio of sigmas to errors from which sigmas are called cautious
Figures = tuple[tuple[str, str, Callable[[Any], str]], ...]
"""Names for people, keys of the summary, and what writes the value."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on a track.

    Attributes:
        grade: "good", "mixed" or "bad"; "open" without truth.
        accuracy: one sentence on availability and accuracy.
        latency: one sentence on latency.
    """

    grade: str
    accuracy: str
    latency: str


def verdict_of(summary: Mapping[str, Any]) -> Verdict:
    """The verdict on a track, preceded by the diagnosis of the inputs, if there was one.

    Args:
        summary: figures of merit by :func:`scenematch.report.metrics.summarise`, and the run's settings.
    """
    settings = summary.get("settings", {})
    verdict, found = _judged(summary, settings.get("budget_ms")), settings.get("diagnosis") or {}
    said = [f"{sentence[:1].upper()}{sentence[1:]}." for sentence in found.values()]
    return replace(verdict, accuracy=" ".join([*said, verdict.accuracy]))


def loop_sentence(loop: LoopRecord) -> str:
    """The verdict on a closed loop in one sentence."""
    off = loop.off_plan_m
    rms_m, estimate_m = rms(off), rms(loop.estimate_error_m[loop.settled])
    return (
        f"Closed loop: steered by the fixes, the vehicle was {metres(rms_m)} RMS and at most "
        f"{metres(float(off.max()))} from its plan, with an estimate that was {metres(estimate_m)} RMS off."
    )


def _judged(summary: Mapping[str, Any], budget_ms: float | None) -> Verdict:
    """The verdict from the figures of merit alone."""
    frames, fixes = summary["frames"], summary["fixes"]
    fixed = f"{fixes} of {frames} frames fixed"
    late = _latency(summary, budget_ms)
    if not frames:
        return Verdict("bad", "The track has no frames.", late)
    if not fixes:
        reason = next(iter(summary["reasons"]), "unknown").replace("_", " ")
        return Verdict("bad", f"None of {frames} frames fixed; most were refused as {reason}.", late)
    if not summary.get("scored_fixes"):
        sigma_m = summary["stated_sigma_median_m"]
        stated = "" if sigma_m is None else f"; half of them state a sigma below {metres(sigma_m)}"
        text = f"{fixed}{stated}. Without truth their accuracy is unknown, and whether the map is where it says."
        return Verdict("open", text, late)
    spread = f"half of the fixes within {metres(summary['median_m'])} of the truth, the worst "
    spread += f"{metres(summary['max_m'])} off"
    if summary["scored_fixes"] < fixes:
        spread += f" ({summary['scored_fixes']} of {fixes} fixes have a truth)"
    if summary["false_fixes"]:
        false = _count(summary["false_fixes"], "fix is", "fixes are")
        text = f"{false} false: beyond three of their own sigmas and more than {WRONG_M:g} m off"
        return Verdict("bad", f"{text}; {fixed}, {spread}.", late)
    beyond, nees = summary["beyond_3_sigma"], summary["nees_mean"]
    if nees is None:
        return Verdict("mixed", f"{fixed}, without a covariance to judge them by; {spread}.", late)
    if beyond > max(1, _BEYOND_SHARE * summary["scored_fixes"]) or nees > _MAX_NEES:
        text = f"{beyond} of {summary['scored_fixes']} fixes are off by more than three of their own sigmas"
        text += f" (mean NEES {nees:.0f}, 2 is expected): something is off by more than it states"
        return Verdict("bad", f"{text}; {fixed}, {spread}.", late)
    grade = "good" if fixes >= 0.9 * frames and not summary["deadlines_missed"] else "mixed"
    within = "all" if not beyond else f"all but {beyond}"
    text = f"{fixed}, {within} within three of their own sigmas; {spread}.{_caution(nees)}"
    return Verdict(grade, text, late)


def _caution(nees: float) -> str:
    """A sentence on sigmas that are much larger than the errors; empty if they are not."""
    factor = math.sqrt(2.0 / max(nees, 1e-6))
    if factor < _CAUTIOUS:
        return ""
    return f" The stated sigmas are cautious: about {factor:.0f} times what the errors show."


def _latency(summary: Mapping[str, Any], budget_ms: float | None) -> str:
    p95_ms, missed = summary["latency_ms"]["p95"], summary["deadlines_missed"]
    if p95_ms is None:
        return "No latencies were recorded."
    latency = f"95 % of the answers took less than {p95_ms:.1f} ms"
    if budget_ms is None:
        return f"{latency}; no budget was set."
    if missed:
        return f"{_count(missed, 'answer', 'answers')} came after the budget of {budget_ms:g} ms; {latency}."
    return f"{latency}, all of them within the budget of {budget_ms:g} ms."


def _count(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def metres(value: float) -> str:
    """Format a length: centimetres below 10 m, decimetres below 100 m, powers of ten from 100 km on."""
    if value >= 1e5:
        return f"{value:.1e} m"
    return f"{value:.2f} m" if value < 10.0 else f"{value:.1f} m" if value < 100.0 else f"{value:,.0f} m"


_SHARE = "{:.1%}".format
_MEASURED: Figures = (
    ("RMS error", "rms_m", metres),
    ("median error", "median_m", metres),
    ("95 % within", "r95_m", metres),
    ("largest error", "max_m", metres),
    ("false fixes", "false_fixes", str),
    ("within 3 stated sigmas; 98.9 % if consistent", "within_3_sigma", _SHARE),
    ("within 1 stated sigma; 39.3 % if consistent", "within_1_sigma", _SHARE),
    ("NEES: 2 is consistent, less cautious, more overconfident", "nees_mean", "{:.3g}".format),
    ("RMS error of height", "height_rms_m", metres),
)
_STATED: Figures = (
    ("stated by the fixes, not measured: median sigma", "stated_sigma_median_m", metres),
    ("stated, not measured: 95 % of the sigmas below", "stated_sigma_p95_m", metres),
)
_LATENCY: Figures = (
    ("latency, median", "p50", "{:.1f} ms".format),
    ("latency, 95 % below", "p95", "{:.1f} ms".format),
    ("latency, largest", "max", "{:.1f} ms".format),
)


def key_figures(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and value of each key figure that is known; without truth, what the fixes state of themselves.

    Args:
        summary: by :func:`scenematch.report.metrics.summarise`.
    """
    known = {**summary, **summary["latency_ms"]}
    fixed = (f"fixed, {summary['fixes']} of {summary['frames']}", "availability", _SHARE)
    figures = (fixed, *(_MEASURED if summary.get("scored_fixes") else _STATED), *_LATENCY)
    return [(name, form(known[key])) for name, key, form in figures if known.get(key) is not None]
