"""What NCC is by its definition."""

from __future__ import annotations

import numpy as np

from engine.kernels import reference


def reference_scores(search, templates, zero_mean=True):
    """Scores (B, T, Y, X) in float64 of windows (B, H, W) and templates (B, T, h, w)."""
    return np.stack(
        [
            [reference.ncc_surface(window, template, zero_mean=zero_mean) for template in hypotheses]
            for window, hypotheses in zip(search, templates, strict=True)
        ]
    )
