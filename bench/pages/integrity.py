"""Tables and charts of the benchmark of integrity, written into docs/results/integrity.md."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import binomtest

from bench.accuracy.judged import METHODS, RISKS, SCORES, Row
from bench.accuracy.trials import ANSWERABLE, SUITABLE, UNANSWERABLE, UNSUITABLE
from bench.pages.text import fill, paragraph, percent, save_pictures, table
from engine.geo import Array

Mask = NDArray[np.bool_]

TPR, COVERAGE = 0.95, 0.75
THRESHOLDS = (0.93, 0.95, 0.97, 0.98, 0.99, 0.995)
IN_95 = 5.991  # chi-square of two degrees of freedom that holds 95 %
BINS = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 0.99, 0.999, 1.0])


def write(rows: list[Row], docs: Path) -> None:
    """Fill in the sections of the page, and draw its pictures."""
    found = sections(rows)
    fill(docs / "integrity.md", found)
    pictures = {"integrity-risk.png": _risk_chart(rows), "integrity-reliability.png": _reliability_chart(rows)}
    save_pictures(docs, pictures, dpi=110)
    print("\n".join(line for lines in found.values() for line in lines))


def sections(rows: list[Row]) -> dict[str, list[str]]:
    """Lines by the names of their sections."""
    grounds = list(dict.fromkeys(row.ground for row in rows))
    said = f"{len(rows):,} matches over {', '.join(grounds)}: **{sum(map(_is_wrong, rows))} wrong fixes**."
    kinds = _crossed(rows, (*ANSWERABLE, *UNANSWERABLE), lambda row: row.kind, _fixes)
    by_ground = _crossed(rows, grounds, lambda row: row.ground, _by_ground_cell)
    scores = ["method", "score", "right, wrong found", "FPR at 95 % TPR", "AUC", "wrong in 100,000 at 75 %"]
    columns = ["method", "matches", "availability", "wrong", "NEES", "in 95 %", "ECE"]
    return {
        "matches": paragraph(said),
        "methods": table(columns, _by_method(rows)),
        "thresholds": table(["`confidence` of at least", *METHODS, "all wrong"], _by_threshold(rows)),
        "risks": table(["method", "fixes", *(f"risk {risk:g}" for risk in RISKS)], _by_risk(rows)),
        "kinds": table(["kind", *METHODS], kinds),
        "grounds": table(["ground", *METHODS], by_ground),
        "scores": table(scores, _by_score(rows)),
    }


def _is_wrong(row: Row) -> bool:
    return row.fixed and not row.right


def _of(rows: list[Row], method: str) -> list[Row]:
    return [row for row in rows if row.method == method]


def _by_method(rows: list[Row]) -> list[list[str]]:
    out = []
    for method in METHODS:
        of = _of(rows, method)
        suitable = [row for row in of if row.kind in SUITABLE]
        stated = np.array([row.scores[0] for row in of if row.scores])
        right = np.array([row.right for row in of if row.scores])
        error = f"{calibration_error(stated, right):.4f}" if len(right) else "-"
        cells = [f"{len(of):,}", percent(_available(suitable)), str(sum(map(_is_wrong, of)))]
        out.append([method, *cells, *_consistency(suitable), error])
    return out


def _by_threshold(rows: list[Row]) -> list[list[str]]:
    """A line for each threshold; none below the one that the matches were made with lets more through."""
    out = []
    for threshold in THRESHOLDS:
        kept = [row for row in rows if row.fixed and row.scores[0] >= threshold]
        cells = []
        for method in METHODS:
            suitable = sum(row.kind in SUITABLE for row in _of(rows, method))
            right = sum(row.right and row.kind in SUITABLE for row in _of(kept, method))
            wrong = sum(map(_is_wrong, _of(kept, method)))
            cells.append(f"{percent(right / max(1, suitable))}, {wrong}")
        out.append([f"{threshold:g}", *cells, str(sum(map(_is_wrong, kept)))])
    return out


def _by_risk(rows: list[Row]) -> list[list[str]]:
    """A line for each method: of its fixes with a finite level, what lies beyond it."""
    out = []
    for method in METHODS:
        fixes = [row for row in _of(rows, method) if row.fixed and row.kind in SUITABLE]
        cells = []
        for k in range(len(RISKS)):
            known = [row for row in fixes if np.isfinite(row.levels_m[k])]
            beyond, count = sum(row.error_m > row.levels_m[k] for row in known), len(known)
            least, most = binomtest(beyond, count).proportion_ci()
            level_m = np.median([row.levels_m[k] for row in known])
            cells.append(f"{beyond} of {count:,}, {least:.1g} to {most:.1g}, {level_m:.1f} m")
        out.append([method, f"{len(fixes):,}", *cells])
    return out


def _crossed(
    rows: list[Row], names: Sequence[str], key: Callable[[Row], str], cell: Callable[[list[Row]], str]
) -> list[list[str]]:
    """A line for each name, a cell for each method."""
    out = []
    for name in names:
        of = [row for row in rows if key(row) == name]
        shown = f"{name} (unsuitable)" if name in UNSUITABLE else name
        if of:
            out.append([shown, *(cell(_of(of, method)) for method in METHODS)])
    return out


def _fixes(of: list[Row]) -> str:
    if not of:
        return "-"
    fixed = sum(row.fixed for row in of)
    return f"{len(of):,}, {percent(fixed / len(of))}, {sum(map(_is_wrong, of))}"


def _by_ground_cell(of: list[Row]) -> str:
    suitable = [row for row in of if row.kind in SUITABLE]
    if not suitable:
        return "-"
    return f"{percent(_available(suitable))}, {sum(map(_is_wrong, of))}, {', '.join(_consistency(suitable))}"


def _available(of: list[Row]) -> float:
    return sum(row.fixed and row.right for row in of) / max(1, len(of))


def _consistency(suitable: list[Row]) -> list[str]:
    squared = np.array([row.squared for row in suitable if row.fixed and row.right])
    if not len(squared):
        return ["-", "-"]
    return [f"{squared.mean():.2f}", percent(float((squared <= IN_95).mean()))]


def _by_score(rows: list[Row]) -> list[list[str]]:
    out = []
    for method, names in SCORES.items():
        judged = [row for row in _of(rows, method) if row.scores and row.kind not in UNSUITABLE]
        if len(names) < 2 or not judged:
            continue
        right = np.array([row.right for row in judged])
        answered = np.array([row.kind in SUITABLE for row in judged])
        counts = f"{right.sum():,}, {(~right).sum():,}"
        suitable = sum(row.kind in SUITABLE for row in _of(rows, method))
        of = len(_of(rows, method))
        for index, name in enumerate(names):
            score = np.array([row.scores[index] for row in judged])
            order = np.argsort(-score, kind="stable")
            enough = np.searchsorted(np.cumsum((right & answered)[order]), COVERAGE * suitable)
            per = f"{1e5 * float((~right[order][:enough]).sum()) / of:.0f}" if enough < len(order) else "never"
            rates = [percent(false_positives(score, right)), f"{auc(score, right):.4f}"]
            out.append([method, name, counts, *(rates if (~right).any() else ["-", "-"]), per])
    return out


def false_positives(score: Array, right: Mask, kept: float = TPR) -> float:
    """Share of the wrong ones at or above the threshold that keeps a share of the right ones."""
    if right.all() or not right.any():
        return float("nan")
    threshold = float(np.quantile(score[right], 1.0 - kept))
    return float((score[~right] >= threshold).mean())


def auc(score: Array, right: Mask) -> float:
    """Chance that a right one scores above a wrong one."""
    from scipy.stats import rankdata

    n = int(right.sum())
    if n in (0, len(right)):
        return float("nan")
    return float((rankdata(score)[right].sum() - n * (n + 1) / 2) / (n * (len(right) - n)))


def calibration_error(stated: Array, right: Mask, bins: int = 10) -> float:
    """ECE: how far the share of right ones is from the probability stated, over bins of equal width."""
    index = np.minimum((stated * bins).astype(int), bins - 1)
    parts = [(index == b) for b in range(bins) if (index == b).any()]
    return float(sum(abs(stated[part].mean() - right[part].mean()) * part.mean() for part in parts))


def _risk_chart(rows: list[Row]) -> Figure:
    """Wrong ones among those accepted, against the share of the suitable matches that is answered rightly."""
    shown = [method for method, names in SCORES.items() if len(names) > 1]
    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.subplots(1, len(shown), sharey=True)
    for axis, method in zip(axes, shown, strict=True):
        judged = [row for row in _of(rows, method) if row.scores and row.kind not in UNSUITABLE]
        right = np.array([row.right for row in judged])
        answered = np.array([row.kind in SUITABLE for row in judged])
        suitable = max(1, sum(row.kind in SUITABLE for row in _of(rows, method)))
        for index, name in enumerate(SCORES[method]):
            order = np.argsort([-row.scores[index] for row in judged], kind="stable")
            coverage = np.cumsum((right & answered)[order]) / suitable
            risk = np.cumsum(~right[order]) / np.arange(1, len(order) + 1)
            axis.plot(100 * coverage, np.maximum(risk, 1e-5), label=name, lw=2 if index == 0 else 1.2)
        axis.set(title=method, xlabel="suitable matches with a right fix, %", yscale="log", ylim=(1e-5, 1))
        axis.axvline(100 * COVERAGE, color="0.7", lw=0.8, ls=":")
        axis.grid(alpha=0.3)
        axis.legend()
    axes[0].set_ylabel("share of wrong ones among the accepted")
    return figure


def _reliability_chart(rows: list[Row]) -> Figure:
    """How often a place is right of which the engine says so with a probability."""
    figure = Figure(figsize=(5, 4.2), layout="constrained")
    axis = figure.subplots()
    axis.plot([0, 1], [0, 1], color="0.7", lw=0.8)
    for method in SCORES:
        judged = [row for row in _of(rows, method) if row.scores]
        if len(SCORES[method]) < 2 or not judged:
            continue
        stated, right = np.array([row.scores[0] for row in judged]), np.array([row.right for row in judged])
        index = np.clip(np.digitize(stated, BINS) - 1, 0, len(BINS) - 2)
        parts = [index == b for b in range(len(BINS) - 1) if (index == b).sum() >= 10]
        x, y = ([float(v[part].mean()) for part in parts] for v in (stated, right))
        axis.plot(x, y, "o-", label=method)
    axis.set(xlabel="probability stated", ylabel="share that is right", xlim=(0, 1.02), ylim=(0, 1.02))
    axis.grid(alpha=0.3)
    axis.legend()
    return figure
