"""What every method is given: one frame, what is known of its place, the map, and a running clock."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from engine.budget import Deadline
from engine.camera import Camera
from engine.device import synchronise
from engine.methods.costs import Costs
from engine.orthomap import OrthoMap
from engine.values import Attitude, Frame, NoFix, Prior, Reason, Timings, Window
from engine.window import SPREAD_SIGMAS, place_window, window_size_px

Array = NDArray[np.float64]


class Stopwatch:
    """Milliseconds by stage, against a deadline, and what is known of the price of a rung.

    Args:
        deadline: runs already.
        device: work on it is waited for when a stage ends.
        costs: prices of the rungs, refreshed by each.
    """

    def __init__(self, deadline: Deadline, device: torch.device, costs: Costs | None = None) -> None:
        self.deadline = deadline
        self._device = device
        self._costs = costs or Costs()
        self._stages_ms: dict[str, float] = {}

    def affords(self, rung: str, work: float) -> bool:
        """Whether the time that is left will do for a rung of this much work; True for one that never ran."""
        return self._costs.expected_ms(rung, work) <= self.deadline.remaining_ms

    def give_up(self, rung: str, *, price: bool) -> None:
        """Note that not even the least of a rung was affordable, see :meth:`engine.methods.costs.Costs.doubt`."""
        self._costs.doubt(rung, price=price)

    @contextmanager
    def rung(self, name: str, work: float) -> Iterator[None]:
        """Note what a rung of this much work costs."""
        start_ms = self.deadline.elapsed_ms
        yield
        self._costs.learn(name, work, self.deadline.elapsed_ms - start_ms)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage; stages of one name add up."""
        start_ms = self.deadline.elapsed_ms
        yield
        synchronise(self._device)
        self._stages_ms[name] = self._stages_ms.get(name, 0.0) + self.deadline.elapsed_ms - start_ms

    @property
    def timings(self) -> Timings:
        """What was measured so far."""
        return Timings(dict(self._stages_ms))


@dataclass(frozen=True)
class Query:
    """One frame on its way to a fix.

    Attributes:
        frame: as it came, but for its heading, which counts from the north of the map's plane.
        gray: (H, W) its undistorted grey picture.
        camera: the pinhole that the undistorted picture obeys.
        site: the map.
        prior: where the vehicle should be, or None: anywhere on the map.
        device: where tensors live.
        watch: the running clock.
    """

    frame: Frame
    gray: NDArray[np.uint8]
    camera: Camera
    site: OrthoMap
    prior: Prior | None
    device: torch.device
    watch: Stopwatch = field(repr=False)

    @cached_property
    def prior_px(self) -> Array | None:
        """The prior's position in map pixels (x, y); None without one, not finite where the CRS does not reach."""
        prior = self.prior
        if prior is None:
            return None
        with np.errstate(invalid="ignore"):
            if prior.east_m is not None and prior.north_m is not None:
                return self.site.pixel_from_enu(np.array([prior.east_m, prior.north_m]))
            assert prior.lat_deg is not None  # a Prior has one of the two
            assert prior.lon_deg is not None
            return self.site.pixel_from_geodetic(prior.lat_deg, prior.lon_deg)

    def with_frame(self, frame: Frame) -> Query:
        """The same asked of another frame; what is known of the prior by now stays."""
        other = copy(self)
        object.__setattr__(other, "frame", frame)
        return other

    def level_of(self, height_m: float) -> int:
        """The pyramid level whose pixels are like the frame's, taken from this high above the ground."""
        return level_for(self.site.gsd_m_per_px, height_m / self.camera.focal_px, self.site.levels)

    @cached_property
    def jacobian(self) -> Array:
        """(2, 2) metres east and north per map pixel where the vehicle should be, else at the map's middle."""
        place = self.prior_px
        if place is None:
            place = np.array([self.site.width_px - 1, self.site.height_px - 1]) / 2.0
        return self.site.enu_jacobian(place)

    def window(
        self,
        center_px: Array,
        footprint_px: tuple[float, float],
        least_px: tuple[float, float],
        *,
        margin: float,
    ) -> Window | None:
        """The adaptive window in map pixels (eq. 4, 5), or None where it lies outside the map.

        Args:
            center_px: where the middle of the footprint should lie.
            footprint_px: extent of the whole frame on the map.
            least_px: extent of what will be matched. The window holds it at every place within
                :data:`engine.window.SPREAD_SIGMAS` of the prior, also where equations 4 and 5 would be smaller.
            margin: the paper's 1.3.
        """
        prior = self.prior
        if prior is None:
            return Window(0, 0, self.site.width_px, self.site.height_px)
        moved_m = np.array([prior.moved_east_m, prior.moved_north_m])
        moved_px = np.abs(np.linalg.solve(self.jacobian, moved_m))
        size = window_size_px(footprint_px, (float(moved_px[0]), float(moved_px[1])), margin=margin)
        slack = 2.0 * SPREAD_SIGMAS * prior.sigma_m / self.site.gsd_m_per_px
        width, height = (max(a, b + slack) for a, b in zip(size, least_px, strict=True))
        shape = (self.site.width_px, self.site.height_px)
        return place_window((float(center_px[0]), float(center_px[1])), (width, height), shape)

    def refuse(
        self,
        reason: Reason,
        detail: str,
        method: str,
        *,
        score: float | None = None,
        window: Window | None = None,
    ) -> NoFix:
        """The refusal of this frame, with what was measured so far."""
        return NoFix(
            reason=reason,
            detail=detail,
            timestamp_ns=self.frame.timestamp_ns,
            method=method,
            score=score,
            window=window,
            timings=self.watch.timings,
        )

    def refuse_flat(self, method: str, min_deviation: float) -> NoFix | None:
        """A refusal where the picture has no texture to match, else None."""
        deviation = float(cv2.meanStdDev(self.gray)[1][0, 0])
        if deviation >= min_deviation:
            return None
        figure = f"the frame's grey levels deviate by {deviation:.1f}"
        return self.refuse(Reason.NO_TEXTURE, f"{figure}; {min_deviation:g} is asked for", method)

    def refuse_tilted(self, attitude: Attitude, method: str) -> NoFix:
        """The refusal of a frame of which some part sees the horizon, or nearly so."""
        tilt = f"roll {attitude.roll_deg:.1f}, pitch {attitude.pitch_deg:.1f} degrees"
        return self.refuse(Reason.TILTED, f"a corner of the frame looks at the horizon ({tilt})", method)

    def refuse_outside(self, method: str) -> NoFix:
        """The refusal of a frame whose window has nothing in common with the map."""
        return self.refuse(Reason.OUTSIDE_MAP, "the window lies outside the map", method)


def level_crop(site: OrthoMap, window: Window, level: int, *, step_px: int = 1) -> Window:
    """The part of one pyramid level that a window in map pixels covers.

    Args:
        site: the map.
        window: in full-resolution pixels, inside the map.
        level: of the pyramid.
        step_px: width and height are rounded up to a multiple of this where the level is large enough, so that
            a flight meets few different sizes and nothing is planned anew in flight.
    """
    rows, columns = site.level_shape(level)
    spans = []
    for start, size, limit in ((window.x0, window.width_px, columns), (window.y0, window.height_px, rows)):
        low, high = start >> level, min(limit, max((start + size) >> level, (start >> level) + 1))
        length = min(limit, -(-(high - low) // step_px) * step_px)
        spans.append((min(low, limit - length), length))
    return Window(spans[0][0], spans[1][0], spans[0][1], spans[1][1])


def level_for(gsd_m_per_px: float, wanted_m_per_px: float, levels: int) -> int:
    """The pyramid level whose pixels are nearest to the wanted size without being much coarser."""
    return int(np.clip(math.floor(math.log2(wanted_m_per_px / gsd_m_per_px) + 0.25), 0, levels - 1))
