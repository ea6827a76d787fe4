"""Correlation of one hypothesis: align the frame with the map by a height and a heading, find the peak."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.kernels import coarse_to_fine
from engine.kernels.coarse_to_fine import EarlyStop
from engine.kernels.scores import enhance
from engine.maps.prepared import PreparedMap, Region
from engine.matching import refusals
from engine.matching.align import FRACTION, MIN_SHRINK, GroundView, Patch, ground_bounds_px, rectify, view_of
from engine.matching.oblique import is_oblique, relief_patch
from engine.matching.query import Query
from engine.ncc_fft import match_template
from engine.options import NccOptions
from engine.runtime.device import to_device
from engine.runtime.scheduler import OutOfTime
from engine.values import GridPose, NoFix, Peak, Reason, Window
from engine.window import MARGIN, SPREAD_SIGMAS, level_crop

Array = NDArray[np.float64]

METHOD = "ncc"
MIN_VALID_SHARE = 0.9
"""A place counts only if this share of the patch lies on valid map."""
COARSER = (0, 1, 2)
"""Levels above the frame's own that are matched if time is short, or if the own one leaves doubt."""
MIN_SIDE_PX = 24
"""Least side of a template on a coarser level."""
_EVERY_PLACE = "every place of a wide window"  # a step


@dataclass(frozen=True, slots=True)
class Aligned:
    """A frame in the pixels of one level of the map's pyramid.

    Attributes:
        pose: the height and heading that aligned it.
        level: of the pyramid.
        view: how the ground is seen.
        patch: the rectified frame.
        template: (h, w) the patch, enhanced.
        nadir_px: (2,) where the ground's relief was looked up; None takes it for level.
        is_over_relief: whether it was drawn over that, and not on a plane.
    """

    pose: GridPose
    level: int
    view: GroundView
    patch: Patch
    template: NDArray[np.float32]
    nadir_px: Array | None = None
    is_over_relief: bool = False

    def work_px(self, window: Window) -> float:
        """Pixels of a window on this level."""
        return float(window.area_px >> 2 * self.level)


@dataclass(frozen=True, slots=True)
class Correlator:
    """One frame and the map to correlate it with.

    Attributes:
        query: the frame.
        prepared: the map.
        options: settings.
    """

    query: Query
    prepared: PreparedMap
    options: NccOptions

    def align(
        self,
        pose: GridPose,
        level: int,
        nadir_px: Array | None = None,
        over_relief_px: tuple[int, int] | None = None,
    ) -> Aligned | NoFix:
        """Equations 2 and 3: the frame in the pixels of one map level.

        Args:
            pose: the height and heading to align it by.
            level: of the pyramid.
            nadir_px: (2,) where to look up the ground's relief; None takes the prior's place, or level ground.
            over_relief_px: rows and columns to draw over the relief, in the middle of what would lie on the map
                there; None draws the frame's middle on a plane, and all of an oblique frame over the relief.
        """
        drawn = self._drawn(pose, level, nadir_px, over_relief_px)
        if isinstance(drawn, NoFix):
            return drawn
        view, patch, place, is_over_relief = drawn
        return Aligned(pose, level, view, patch, enhance(patch.gray), place, is_over_relief)

    def nowhere(self, aligned: Aligned) -> list[NDArray[np.uint8]]:
        """Patches for the null hypothesis, as large as the frame's: upside down, and mirrored.

        They show no place on Earth, unless the compass is wrong by half a turn or the camera mirrors its picture.
        """
        own = aligned.patch.gray
        mirrored = replace(self.query, gray=np.ascontiguousarray(self.query.gray[:, ::-1]))
        size = (own.shape[0], own.shape[1]) if aligned.is_over_relief else None
        drawn = replace(self, query=mirrored)._drawn(aligned.pose, aligned.level, aligned.nadir_px, size)
        turned, patch = np.ascontiguousarray(own[::-1, ::-1]), np.ascontiguousarray(own[:, ::-1])
        if not isinstance(drawn, NoFix) and drawn[1].gray.shape == own.shape:
            patch = drawn[1].gray
        return [turned, patch]

    def _drawn(
        self, pose: GridPose, level: int, nadir_px: Array | None, over_relief_px: tuple[int, int] | None
    ) -> tuple[GroundView, Patch, Array | None, bool] | NoFix:
        """The frame on a plane or over the relief: how it is seen, the patch, where the relief is, and whether."""
        query = self.query
        attitude, height = pose.known_attitude, pose.known_height_m
        if over_relief_px or is_oblique(query, attitude):
            place = query.prior_px if nadir_px is None else nadir_px
            patch = relief_patch(query, attitude, height, level, place, over_relief_px)
            if patch is None and ground_bounds_px(query.camera, attitude, height, query.jacobian) is None:
                return refusals.tilted(query, attitude, METHOD)
            if patch is None:
                detail = "what the frame would show at the prior's place lies outside the map"
                return query.refuse(Reason.OUTSIDE_MAP, detail, METHOD)
            size = np.array(patch.gray.shape[::-1], np.float64)
            extent = (float(size[0]), float(size[1]))
            view = GroundView(np.eye(3), patch.offset_px + (size - 1.0) / 2.0, extent, float(size.prod()))
            return view, patch, place, True
        seen = view_of(query.camera, attitude, height, query.jacobian * 2.0**level)
        if seen is None:
            return refusals.tilted(query, attitude, METHOD)
        rows, columns = query.site.level_shape(level)
        if (MIN_SHRINK * FRACTION) ** 2 * seen.area_px > rows * columns:
            return query.refuse(Reason.OUTSIDE_MAP, "the frame covers more ground than the map", METHOD)
        patch = rectify(query.gray, seen)
        if patch is None:
            detail = "the frame covers fewer than 8 x 8 pixels of the map"
            return query.refuse(Reason.NO_TEXTURE, detail, METHOD)
        return seen, patch, None, False

    def window(self, aligned: Aligned) -> Window | None:
        """The adaptive window in full-resolution map pixels; the whole map without a prior."""
        query = self.query
        nadir = query.prior_px
        if nadir is None:
            return Window(0, 0, query.site.width_px, query.site.height_px)
        scale = 2.0**aligned.level
        height, width = aligned.template.shape
        footprint = (aligned.view.footprint_px[0] * scale, aligned.view.footprint_px[1] * scale)
        center = nadir + aligned.view.center_px * scale
        min_px = ((width + 4) * scale, (height + 4) * scale)
        return query.window(center, footprint, min_px)

    def near(self, aligned: Aligned, nadir_px: Array, slack_px: int) -> Window:
        """The window that holds the template around a nadir, with a margin in full-resolution pixels."""
        site, scale = self.query.site, 2**aligned.level
        height, width = aligned.template.shape
        x0, y0 = (int(v) - slack_px for v in np.round(nadir_px + aligned.patch.offset_px * scale))
        x1 = min(site.width_px, x0 + width * scale + 2 * slack_px)
        y1 = min(site.height_px, y0 + height * scale + 2 * slack_px)
        x0, y0 = max(0, x0), max(0, y0)
        return Window(x0, y0, max(1, x1 - x0), max(1, y1 - y0))

    def cut(self, window: Window, level: int) -> Region:
        """The prepared map under a window of full-resolution pixels."""
        return self.prepared.cut(level_crop(self.query.site, window, level), level)

    def search(self, aligned: Aligned, window: Window, stop: EarlyStop | None = None) -> Peak | None:
        """The peak in a window, in pixels of the aligned level; None if the template is nowhere on the map.

        Args:
            aligned: the hypothesis.
            window: in full-resolution map pixels.
            stop: which peaks of a wide window to keep although not every place was scored.
        """
        height, width = aligned.template.shape
        with self.query.scheduler.stage("map"):
            region = self.cut(window, aligned.level)
        if region.window.width_px < width or region.window.height_px < height:
            return None
        exclusion_px = self.exclusion_px(aligned.level)
        stop = None if stop is None else _about(stop, region.window)
        peak = self._peak(region, aligned.template, exclusion_px, stop)
        return None if peak.score <= -1.0 and region.valid is not None else _moved(peak, region.window)

    def _peak(
        self, region: Region, template: NDArray[np.float32], exclusion_px: float, stop: EarlyStop | None
    ) -> Peak:
        """The peak coarse to fine if that suffices, else over every place if there is time."""
        scheduler, search, least = self.query.scheduler, region.search, MIN_VALID_SHARE
        by_levels = isinstance(search.image, np.ndarray) and not self.options.exhaustive  # on the CPU
        with scheduler.stage("match"):
            if by_levels:
                found = coarse_to_fine.peak(search, template, exclusion_px, min_overlap=least, stop=stop)
                if found is not None:
                    return found
            if not (by_levels and coarse_to_fine.is_wide(search)):
                return self._of_every_place(region, template, exclusion_px)
        work_px = float(math.prod(search.image.shape))
        if not scheduler.can_afford({_EVERY_PLACE: work_px}):
            scheduler.note_refusal(_EVERY_PLACE)
            raise OutOfTime
        with scheduler.costed(_EVERY_PLACE, work_px), scheduler.stage("match"):
            return self._of_every_place(region, template, exclusion_px)

    def _of_every_place(self, region: Region, template: NDArray[np.float32], exclusion_px: float) -> Peak:
        own, least = to_device(template, self.query.device), MIN_VALID_SHARE
        return match_template(region.search, own, exclusion_px=exclusion_px, exhaustive=True, min_overlap=least)

    def exclusion_px(self, level: int) -> float:
        """Distance within which a rival is the peak itself, in pixels of a level."""
        return self.options.exclusion_m / (self.query.site.gsd_m_per_px * 2.0**level)

    def nadir_px(self, peak: Peak, aligned: Aligned) -> Array:
        """The camera's nadir (2,) in map pixels, from where its patch was found."""
        place = np.array([peak.x, peak.y]) - aligned.patch.offset_px
        return self.query.site.full_from_level(place, aligned.level)


def _moved(peak: Peak, window: Window) -> Peak:
    """The peak of a window's surface, in pixels of the level."""
    return replace(peak, x=peak.x + window.x0, y=peak.y + window.y0)


def _about(stop: EarlyStop, window: Window) -> EarlyStop:
    """An early stop by peaks of a window's surface, from one by peaks in pixels of the level."""
    return EarlyStop(
        is_clear=lambda peak: stop.is_clear(_moved(peak, window)),
        is_hopeless=lambda peak: stop.is_hopeless(_moved(peak, window)),
    )


def expected_window_px(query: Query) -> dict[int, float]:
    """Expected pixels of the window per level above the frame's own; the cost is proportional to them."""
    site, camera, height_m = query.site, query.camera, query.telemetry.known_height_m
    assert query.prior is not None
    own = query.level_of(height_m)
    out = {}
    for coarser in COARSER:
        gsd_m = site.gsd_m_per_px * 2.0 ** (own + coarser)
        per_px = height_m / (camera.focal_px * gsd_m)
        side_px = FRACTION * min(camera.width_px, camera.height_px) * per_px
        if coarser == 0 or (own + coarser < site.levels and side_px >= MIN_SIDE_PX):
            slack_px = 2.0 * SPREAD_SIGMAS * query.prior.sigma_m / gsd_m
            width, height = (MARGIN * n * per_px + slack_px for n in (camera.width_px, camera.height_px))
            rows, columns = site.level_shape(own + coarser)  # no window is larger
            out[coarser] = min(width, columns) * min(height, rows)
    return out
