"""A simulated town in which houses are built and demolished between the day of the map and that of the flight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from scenematch.simulator.canvas import CROP, ROOF
from scenematch.simulator.light import Float32
from scenematch.simulator.town import Day, Drawn, generator

EARTH_RGB = (146, 126, 98)


def rebuilt(seed: int, changed: float) -> Callable[[Drawn], Drawn]:
    """What rebuilds a share of a town's houses, half of them built and half demolished."""

    def rebuild(drawn: Drawn) -> Drawn:
        rng = generator(seed, 0x75)
        roofs = (drawn.canvas.material == ROOF).astype(np.uint8)
        count, labels = cv2.connectedComponents(roofs, connectivity=4)
        fate = rng.random(count)
        fate[0] = 1.0  # not a house
        new, gone = (fate < changed / 2)[labels], ((fate >= changed / 2) & (fate < changed))[labels]
        then = _without(drawn.then, new, drawn.ground_m, rng)
        return replace(drawn, then=then, today=_without(drawn.today, gone, drawn.ground_m, rng))

    return rebuild


def _without(day: Day, gone: NDArray[np.bool_], ground_m: Float32 | None, rng: np.random.Generator) -> Day:
    """The day with bare earth where (H, W) something was removed."""
    rgb, height, material = day.rgb.copy(), day.height_m.copy(), day.material.copy()
    count = int(gone.sum())
    rgb[gone] = np.clip(np.array(EARTH_RGB) * (1.0 + 0.07 * rng.standard_normal((count, 1))), 0, 255)
    height[gone] = 0.0 if ground_m is None else ground_m[gone]
    material[gone] = CROP
    return Day(rgb, height, material)
