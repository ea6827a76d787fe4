"""Runs of the commands without what costs most and no test of a command looks at."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from engine import OrthoMap, SceneMatcher
from tests.support.landmarks import landmarks_of

BLANK = cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes()


_open = OrthoMap.open
_opened: dict[Any, OrthoMap] = {}


def opened_once(path: Any, surface: Any = None, *, on_copy: Any = None, **options: Any) -> OrthoMap:
    """The map of a file, and of a copy of it that nobody wrote into, as it was opened before."""
    try:
        files = [os.stat(file) for file in (path, surface) if file is not None]
    except OSError:
        return _open(path, surface, on_copy=on_copy, **options)
    key = *((file.st_size, file.st_mtime_ns) for file in files), Path(path).name, *sorted(options.items())
    if key not in _opened:
        _opened[key] = _open(path, surface, on_copy=on_copy, **options)
        if len(_opened) > 6:
            del _opened[next(iter(_opened))]
    return _opened[key]


@contextmanager
def bare_runs() -> Iterator[None]:
    """Plots are one pixel, nothing is warmed up, a map and its features are had once: seconds less, one track."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("engine.matching.sift.LandmarkMap", landmarks_of)
        patch.setattr(OrthoMap, "open", opened_once)
        patch.setattr(Figure, "savefig", lambda _, path, **__: Path(path).write_bytes(BLANK))
        patch.setattr(SceneMatcher, "warmup", lambda *_: None)
        yield
