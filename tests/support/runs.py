"""Runs of the commands without what costs most and no test of a command looks at."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from engine import SceneMatcher
from engine.report import figures

BLANK = cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes()


@contextmanager
def bare_runs() -> Iterator[None]:
    """Plots are one pixel, and nothing is warmed up: two seconds less a run, and the same track."""
    with pytest.MonkeyPatch.context() as patch:
        for plot in ("_path", "_position", "_height", "_error"):
            patch.setattr(figures, plot, lambda *_: Figure(figsize=(1, 1)))
        patch.setattr(Figure, "savefig", lambda _, path, **__: Path(path).write_bytes(BLANK))
        patch.setattr(SceneMatcher, "warmup", lambda _: None)
        yield
