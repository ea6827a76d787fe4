"""The farmland of the NAIP by year, grey: the same ground, photographed in eight summers."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from bench import SHARED

FARMLAND = SHARED / "naip"


def vintages() -> tuple[str, ...]:
    """The years."""
    return tuple(sorted(path.stem.rsplit("_", 1)[1][:4] for path in FARMLAND.glob("*.tif")))


@cache
def farmland(year: str) -> NDArray[np.uint8]:
    """Grey levels of a year."""
    with rasterio.open(next(FARMLAND.glob(f"*_{year}*.tif"))) as source:
        colour = np.ascontiguousarray(np.moveaxis(source.read([1, 2, 3]), 0, 2))
    return np.asarray(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY), np.uint8)
