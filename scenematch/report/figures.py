"""Shared parts of figures: colours, resolution, and labels of logarithmic axes.

Convention:
    Colours are distinct under all common colour vision deficiencies (Okabe and Ito). matplotlib's global state is
    not used, so other plots are unaffected.
"""

from __future__ import annotations

from typing import Any

DPI = 130
TRUTH, GRID = "#1a1a1a", "#d9d9d9"


def plain_log_ticks(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers: 1, 2 and 5 of each decade, or 1 alone over more than two.

    matplotlib's own labels of a short axis (2 x 10^1, 3 x 10^1, ...) overlap.

    Args:
        axis: ``xaxis`` or ``yaxis``, after everything is drawn on it.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    multiples = (1.0, 2.0, 5.0) if high <= 100.0 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=multiples, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
