"""Draw charts as SVG: axes with round ticks, and the report's marks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from engine.geo import Array
from scenematch.report.page_parts import filled

Limits = tuple[float, float]

WIDTH, HEIGHT = 720.0, 236.0
_TOP, _RIGHT, _BOTTOM = 12.0, 14.0, 50.0
_MAX_POINTS = 4000  # of a line; more are not visible


@dataclass(frozen=True, slots=True)
class ChartArea:
    """The plotting area of a chart, which maps data to SVG units.

    Attributes:
        x_limits: limits of x in data units.
        y_limits: limits of y in data units; descending limits invert the axis.
        left: left edge of the area in SVG units.
    """

    x_limits: Limits
    y_limits: Limits
    left: float = 62.0

    def points(self, x: Array, y: Array) -> Array:
        """(N, 2) SVG units of data (N,); NaN where y is unknown."""
        return np.column_stack([self.x(x), self.y(y)])

    def x(self, values: Array | float) -> Array:
        """SVG units from the left."""
        return self._scaled(values, self.x_limits, self.left, WIDTH - _RIGHT)

    def y(self, values: Array | float) -> Array:
        """SVG units from the top."""
        return self._scaled(values, self.y_limits, HEIGHT - _BOTTOM, _TOP)

    @staticmethod
    def _scaled(values: Array | float, limits: Limits, begin: float, end: float) -> Array:
        span = limits[1] - limits[0] or 1.0
        return begin + (np.asarray(values, np.float64) - limits[0]) / span * (end - begin)

    def dots(self, x: Array, y: Array, kind: str) -> str:
        """A dot for each finite pair within the limits."""
        inside = (y >= self.y_limits[0]) & (y <= self.y_limits[1])
        return dots(self.points(x[inside], y[inside]), kind)

    def line(self, x: Array, y: Array, kind: str) -> str:
        """A line that is broken where y is NaN, and clipped at the limits."""
        return line(self.points(x, np.clip(y, *self.y_limits)), kind)

    def band(self, x: Array, low: Array, high: Array, kind: str) -> str:
        """The area between two lines, broken where one of them is NaN."""
        parts = []
        for segment in _segments(np.isfinite(low) & np.isfinite(high)):
            part = segment[:: max(1, len(segment) // _MAX_POINTS)]
            there, back = (self.points(x[part], np.clip(y[part], *self.y_limits)) for y in (high, low))
            parts.append(f"M{_joined(there)}L{_joined(back[::-1])}Z")
        return f'<path class="{kind}" d="{"".join(parts)}"/>' if parts else ""

    def overflow(self, x: Array, y: Array, kind: str) -> str:
        """A stroke at the upper edge for each value above it."""
        above = self.x(x[y > self.y_limits[1]])
        marks = "".join(f"M{v:.1f} {_TOP}v9" for v in np.unique(np.round(above, 1)))
        return f'<path class="{kind}" d="{marks}"/>' if marks else ""

    def strip(self, x: Array, values: Sequence[str]) -> str:
        """A background in the CSS class of each x, up to the next x."""
        parts, edges = [], self.x(np.append(x, x[-1:])).tolist()
        for kind, same in itertools.groupby(range(len(values)), key=values.__getitem__):
            places = list(same)
            left, right = edges[places[0]], edges[places[-1] + 1]
            size = f'width="{max(right - left, 0.8):.1f}" height="{HEIGHT - _BOTTOM - _TOP}"'
            parts.append(f'<rect class="{escape(kind)}" x="{left:.1f}" y="{_TOP}" {size}/>')
        return "".join(parts)

    def svg(
        self,
        label: str,
        x_label: str,
        marks: Sequence[str],
        *,
        rows: Sequence[str] = (),
        timed: bool,
        limit: tuple[float, str] | None = None,
        period: float | None = None,
    ) -> str:
        """The complete chart, by the template ``chart.svg``.

        Args:
            label: alternative text.
            x_label: label of the x axis.
            marks: SVG elements, from bottom to top; the page's script stretches them along x.
            rows: labels of y = 0, 1, ... instead of numbers.
            timed: whether x is time, which shows the page's cursor and lets the axis zoom.
            limit: a value of y within the limits that a labelled line marks, and its label.
            period: period of y, which labels ticks from 0 to it; None without one.
        """
        y_ticks = list(enumerate(rows)) if rows else ticks(*self.y_limits, 4)
        if period is not None:
            y_ticks = [(value, f"{value % period:g}") for value, _ in y_ticks]
        return filled(
            "chart.svg", area=self, label=label, x_label=x_label, x_ticks=ticks(*self.x_limits, 6),
            y_ticks=y_ticks, marks=marks, timed=timed, limit=limit, size=(WIDTH, HEIGHT), top=_TOP,
            right=WIDTH - _RIGHT, foot=HEIGHT - _BOTTOM,
        )  # fmt: skip


def ticks(low: float, high: float, count: int) -> list[tuple[float, str]]:
    """Round values within the limits, about ``count`` of them, with their labels."""
    rough = max(high - low, 1e-9) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if power * m >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    decimals = next(n for n in range(12) if abs(round(step, n) - step) < 1e-6 * step)
    return [(n * step, f"{n * step + 0.0:,.{decimals}f}") for n in range(first, last + 1)]


def dots(points: Array, kind: str) -> str:
    """Round dots at (N, 2), each position drawn once; their size is the stroke width."""
    marks = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in _distinct(points))
    return f'<path class="dots {kind}" d="{marks}"/>' if marks else ""


def crosses(points: Array, kind: str, size: float) -> str:
    """Diagonal crosses at (N, 2), with arms of ``size``."""
    arms = f"l{2 * size:.1f} {2 * size:.1f}m0 {-2 * size:.1f}l{-2 * size:.1f} {2 * size:.1f}"
    marks = "".join(f"M{x - size:.1f} {y - size:.1f}{arms}" for x, y in _distinct(points))
    return f'<path class="{kind}" d="{marks}"/>' if marks else ""


def line(points: Array, kind: str) -> str:
    """A line through (N, 2), broken where a point is NaN."""
    segments = _segments(np.asarray(np.isfinite(points).all(axis=1), bool))
    thin = max(1, sum(map(len, segments)) // _MAX_POINTS)
    marks = "".join(f"M{_joined(points[segment[::thin]])}" for segment in segments)
    return f'<path class="line {kind}" d="{marks}"/>' if marks else ""


def _distinct(points: Array) -> Array:
    """The finite points that differ after rounding to 0.1."""
    return np.unique(np.round(points[np.isfinite(points).all(axis=1)], 1), axis=0)


def _segments(known: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Indices of true values, split where false ones lie between."""
    indices = np.flatnonzero(known)
    if not indices.size:
        return []
    return np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)


def _joined(points: Array) -> str:
    return "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
