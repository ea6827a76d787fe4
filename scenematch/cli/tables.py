"""Print the results of runs as tables for people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenematch.cli import console

if TYPE_CHECKING:
    from scenematch.runs.map_audit import MapAudit

_RUN = (
    ("RMS m", "rms_m", "{:.2f}"),
    ("p50 ms", "p50", "{:.1f}"),
    ("p95 ms", "p95", "{:.1f}"),
    ("fixed", "availability", "{:.1%}"),
    ("false", "false_fixes", "{}"),
    ("NEES", "nees_mean", "{:.2f}"),
    ("up m", "height_rms_m", "{:.2f}"),
)
"""Columns of a table of runs, after the name: head, figure, form."""
_SUMMARY = (
    ("frames", "frames", "{}"),
    ("fixes", "fixes", "{}"),
    ("availability", "availability", "{:.1%}"),
    ("RMS error", "rms_m", "{:.2f} m"),
    ("median error", "median_m", "{:.2f} m"),
    ("95 % within", "r95_m", "{:.2f} m"),
    ("largest error", "max_m", "{:.2f} m"),
    ("false fixes", "false_fixes", "{}"),
    ("mean NEES (consistent: 2)", "nees_mean", "{:.2f}"),
    ("height RMS error", "height_rms_m", "{:.2f} m"),
)


def print_summary(summary: Mapping[str, Any], as_json: bool, title: str, out: Path) -> None:
    """Print the figures of a track, and where its files are."""
    if as_json:
        console.print_json(summary)
        return
    hidden = {"false_fixes"} if summary.get("scored_fixes") == 0 else set()  # 0 of 0 would read as a result
    shown_rows = [row for row in _SUMMARY if row[1] not in hidden]
    known = [(name, form, summary[key]) for name, key, form in shown_rows if summary.get(key) is not None]
    # An extreme value must fit its column.
    pairs = [(name, form.replace(".2f", ".1e" if abs(v) >= 1e5 else ".2f").format(v)) for name, form, v in known]
    if summary.get("rms_m") is None:
        pairs += _stated(summary)
    latency = summary["latency_ms"]
    if latency["p50"] is not None:
        shown = ", ".join(f"{name} {latency[name]:.1f}" for name in ("p50", "p95", "p99", "max"))
        pairs.append(("latency", f"{shown} ms"))
    if summary["deadlines_missed"]:
        pairs.append(("deadlines missed", str(summary["deadlines_missed"])))
    pairs += [(f"refused: {reason}", str(count)) for reason, count in summary["reasons"].items()]
    pairs += list((summary["settings"].get("diagnosis") or {}).items())
    console.print_pairs(title, pairs)
    console.say(f"written to {out}")


def _stated(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What a track says about itself without truth; this does not measure its accuracy."""
    pairs, motion = [], summary.get("motion_consistency")
    if summary.get("stated_sigma_median_m") is not None:
        median_m, p95_m = summary["stated_sigma_median_m"], summary["stated_sigma_p95_m"]
        pairs.append(("stated sigma (not measured)", f"median {median_m:.2f} m, 95 % below {p95_m:.2f} m"))
    if motion is not None:
        text = f"median {motion['median_m']:.2f} m, 95 % below {motion['p95_m']:.2f} m off the velocity"
        pairs.append((f"from fix to fix ({motion['steps']} steps)", text))
    return pairs


def print_comparison(results: Mapping[str, Mapping[str, Any]], title: str) -> None:
    """The table, one row per run."""
    rows = [(name, *_cells(summary)) for name, summary in results.items()]
    console.print_table(title, ("run", *(head for head, *_ in _RUN)), rows)


def print_paper_table(results: Mapping[str, Mapping[str, Any]], seed: int) -> None:
    """The paper's Table I beside the runs of the demo."""
    from scenematch.runs.demo import PAPER_TABLE

    rows: list[tuple[str, ...]] = []
    for method, (rms_m, time_ms) in PAPER_TABLE.items():
        rows.append((f"{method.upper()}, as published", f"{rms_m:.1f}", f"{time_ms:.0f}", *[""] * 5))
        for run, what in ((f"{method}-paper", "paper's recipe"), (f"{method}-engine", "scenematch")):
            rows.append((f"{method.upper()}, {what}", *_cells(results[run])))
    title = f"Built-in flight {seed}, {results['ncc-engine']['frames']} frames"
    console.print_table(title, ("Table I", *(head for head, *_ in _RUN)), rows)


def _cells(summary: Mapping[str, Any]) -> list[str]:
    from scenematch.report.metrics import figures_in_words

    return figures_in_words(summary, ((key, form.format) for _, key, form in _RUN))


def print_audit(result: MapAudit, title: str) -> None:
    """Print what an audit found, and the poor stretches of its route."""
    audit, route = result.audit, result.route
    plan = audit.plan
    footprint = " x ".join(f"{metres:.0f}" for metres in result.summary["footprint_m"])
    pairs = [
        ("frame on the ground", f"{footprint} m from {plan.height_agl_m:g} m"),
        ("places", f"{len(plan)}, every {plan.spacing_px.mean() * plan.site.gsd_m_per_px:.0f} m"),
        ("of the map", f"{plan.area_px * plan.site.gsd_m_per_px**2 / 1e6:.3g} km2"),
    ]
    pairs += [(name, f"{share:.1%}") for name, share in audit.shares.items() if share > 0.0 or name == "good"]
    if route is not None:
        pairs.append(("route", f"{route.length_m:,.0f} m, predicted availability {route.availability:.1%}"))
        for one in route.stretches:
            ends = (
                f"{one.start_lat_deg:.6f},{one.start_lon_deg:.6f} to {one.end_lat_deg:.6f},{one.end_lon_deg:.6f}"
            )
            pairs.append((f"poor: {one.flag}", f"{ends}, {one.length_m:,.0f} m, {one.availability:.0%}"))
    console.print_pairs(f"audit of {title}", pairs)
