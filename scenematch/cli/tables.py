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


def print_summary(summary: Mapping[str, Any], title: str, out: Path) -> None:
    """Print the figures of a track, where its files are, and what to do next."""
    if console.answered_as_json(summary):
        return
    from scenematch.report.verdict import key_figures

    pairs = key_figures(summary)
    if summary["deadlines_missed"]:
        pairs.append(("deadlines missed", str(summary["deadlines_missed"])))
    pairs += [(f"refused: {reason}", str(count)) for reason, count in summary["reasons"].items()]
    pairs += list((summary["settings"].get("diagnosis") or {}).items())
    console.print_pairs(title, pairs)
    console.say(f"written to {out}")
    console.after_track(out, summary["fixes"])


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
