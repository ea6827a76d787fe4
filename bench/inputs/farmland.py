"""The farmland of the NAIP by year, grey: the same ground, photographed in eight summers."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from bench import SHARED
from engine import OrthoMap

FARMLAND = SHARED / "naip"
SHAPE = (723, 934)  # that all years show
GSD_M = 0.5  # the pixels of 5 m are laid out as if they were this


def vintages() -> tuple[str, ...]:
    """The years."""
    return tuple(sorted(path.stem.rsplit("_", 1)[1][:4] for path in FARMLAND.glob("*.tif")))


@cache
def farmland(year: str) -> NDArray[np.uint8]:
    """Grey levels of a year."""
    with rasterio.open(next(FARMLAND.glob(f"*_{year}*.tif"))) as source:
        colour = np.ascontiguousarray(np.moveaxis(source.read([1, 2, 3]), 0, 2))
    return np.asarray(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY), np.uint8)[: SHAPE[0], : SHAPE[1]]


def half_of(gray: NDArray[np.uint8], *, east: bool) -> NDArray[np.uint8]:
    """One half of the farmland: the west is to fit on, the east to report on."""
    middle = gray.shape[1] // 2
    return np.ascontiguousarray(gray[:, middle:] if east else gray[:, :middle])


def laid_out(gray: NDArray[np.uint8]) -> OrthoMap:
    """Grey levels as a map."""
    return OrthoMap.from_arrays(gray, np.array([[GSD_M, 0.0, 5e5], [0.0, -GSD_M, 5.2e6]]), "EPSG:32614")
