"""SceneMatcher: one frame, one prior, one budget in; a Fix or a NoFix out. Of a frame it keeps only its cost."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch

from engine import device as devices
from engine.align import to_gray
from engine.budget import Budget, Deadline
from engine.camera import Camera
from engine.errors import OptionError
from engine.features import plans_created
from engine.geo import wrap_heading_deg
from engine.indexes.landmarks import LandmarkMap
from engine.indexes.prepared import PreparedMap
from engine.indexes.samples import SampleMap
from engine.integrity import with_map_accuracy
from engine.kernels import loops_compiled
from engine.methods import explanation, paper, scheduler
from engine.methods.costs import Costs
from engine.methods.explanation import Explanation
from engine.methods.hypothesis import NccOptions
from engine.methods.query import Query, Stopwatch, level_crop, level_for
from engine.methods.sift import SiftOptions
from engine.orthomap import OrthoMap
from engine.values import MAX_SIGMA_M, Fix, Frame, NoFix, Prior, Reason, Window

METHODS = ("ncc", "sift", "auto")
PROFILES = ("engine", "paper")
_WARM_SHARES = (0.25, 0.12)  # of the map's shorter side that a made-up frame sees
_WARM_ROUNDS = 3
_WARM_SIDE_PX = 4096  # of a larger map it is a part of this side


@dataclass(frozen=True, slots=True, kw_only=True)
class MatcherOptions:
    """Settings of both methods.

    Attributes:
        profile: "engine", or "paper" for the paper's own recipe with OpenCV.
        ncc: settings of the NCC method.
        sift: settings of the SIFT method.
    """

    profile: str = "engine"
    ncc: NccOptions = field(default_factory=NccOptions)
    sift: SiftOptions = field(default_factory=SiftOptions)

    def __post_init__(self) -> None:
        if self.profile not in PROFILES:
            raise OptionError(f"profile: expected one of {', '.join(PROFILES)}, got {self.profile!r}")


def _with_map_accuracy(site: OrthoMap, options: MatcherOptions) -> MatcherOptions:
    ncc, sift = options.ncc, options.sift
    return replace(
        options,
        ncc=replace(ncc, errors=with_map_accuracy(site, ncc.errors)),
        sift=replace(sift, errors=with_map_accuracy(site, sift.errors)),
    )


def _bounded(prior: Prior) -> Prior:
    """The prior no vaguer, and moved no farther, than any map is wide."""
    moved = (prior.moved_east_m, prior.moved_north_m)
    if prior.sigma_m <= MAX_SIGMA_M and max(map(abs, moved)) <= MAX_SIGMA_M:
        return prior
    east, north = (min(max(v, -MAX_SIGMA_M), MAX_SIGMA_M) for v in moved)
    return replace(prior, sigma_m=min(prior.sigma_m, MAX_SIGMA_M), moved_east_m=east, moved_north_m=north)


class SceneMatcher:
    """Matches single frames against one map with one camera.

    Args:
        site: the map.
        camera: as calibrated, with its distortion; frames are undistorted by a lookup computed once.
        method: "ncc" (needs height and heading), "sift" (needs neither), or "auto": NCC where height and heading
            are known, then SIFT where there is time; where both have a fix they must agree.
        device: "cpu", "cuda" or "auto".
        options: settings; the defaults serve. What the map says of its accuracy counts more than they do.

    Raises:
        OptionError: the method is unknown.
        DeviceError: the device was asked for by name and is missing.
    """

    def __init__(
        self,
        site: OrthoMap,
        camera: Camera,
        method: str = "ncc",
        device: str | torch.device = "auto",
        options: MatcherOptions | None = None,
    ) -> None:
        if method not in METHODS:
            raise OptionError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
        self.options = _with_map_accuracy(site, options or MatcherOptions())
        if self.options.profile == "paper" and method == "auto":
            raise OptionError("method: the paper's profile has ncc and sift, got 'auto'")
        self.site = site
        self.camera = camera
        self.method = method
        self.device = devices.resolve(device)
        self._prepared = PreparedMap(site, self.device, self.options.ncc.enhance_radius_px, self.options.ncc.score)
        self._landmarks = LandmarkMap(site, self.device)
        self._samples = SampleMap(site, self._prepared)
        self._tools = scheduler.Tools(
            self._prepared, self._landmarks, self._samples, self.options.ncc, self.options.sift
        )
        self._costs = Costs()
        # What an undistorted picture obeys; the mount stays.
        self._pinhole = replace(camera, distortion_model="plumb_bob", distortion=np.zeros(5))

    def warmup(self) -> None:
        """Do before take-off what is done once: find the map's features, compile, plan, and learn what rungs cost.

        Features are found on every level of at most :data:`engine.indexes.landmarks.PREPARED_PX` pixels; those of
        a map that comes from a file are kept for the next start. The frames that are matched are the map's own.
        """
        features = self.options.sift.map_features == "prepared" and self.options.sift.matcher is None
        if features and self.method != "ncc" and self.options.profile == "engine":
            self._landmarks.prepare()
        for warm in (False, True):
            self._costs = Costs()  # what compiles and plans is no price of a flight's
            for share in _WARM_SHARES:
                frame, prior = self._made_up(share)
                for _ in range(_WARM_ROUNDS if warm else 1):
                    self.locate(frame, prior)
                    if self.options.profile == "engine":
                        scheduler.every_rung(
                            self._query(frame, prior, Deadline(Budget())), self._tools, self.method
                        )
            if self.options.profile == "engine" and self.site.is_searchable:
                self.locate(frame)  # the search of the whole map

    def _made_up(self, share: float) -> tuple[Frame, Prior]:
        """The frame that a camera takes above the map's middle where it sees this share of its shorter side."""
        site, camera = self.site, self.camera
        side_px = share * min(site.width_px, site.height_px, _WARM_SIDE_PX)
        per_px = side_px / max(camera.width_px, camera.height_px)
        level = level_for(1.0, per_px, site.levels)
        size = (round(camera.width_px * per_px), round(camera.height_px * per_px))
        place = site.inner_px
        last = (site.width_px - size[0], site.height_px - size[1])
        x, y = (int(np.clip(v - (n - 1) / 2, 0, most)) for v, n, most in zip(place, size, last, strict=True))
        crop = level_crop(site, Window(x, y, max(1, size[0]), max(1, size[1])), level)
        image = cv2.resize(site.gray(crop, level), (camera.width_px, camera.height_px))
        middle = site.enu_from_pixel(place)
        height_m = per_px * camera.focal_px * site.gsd_m_per_px
        prior = Prior(east_m=float(middle[0]), north_m=float(middle[1]), sigma_m=5.0)
        return Frame(np.asarray(image, np.uint8), 0, height_m, 0.0, 0.0, 0.0), prior

    @property
    def cache_counters(self) -> dict[str, int]:
        """Counts of what is made once and kept; after :meth:`warmup` none should rise while the map is small."""
        return {
            "map regions": self._prepared.created,
            "landmark tiles": self._landmarks.created,
            "sampled cells": self._samples.created,
            "feature plans": plans_created(),
            "compiled loops": loops_compiled(),
        }

    def locate(self, frame: Frame, prior: Prior | None = None, budget: Budget | None = None) -> Fix | NoFix:
        """Where the camera was when the frame was taken.

        Args:
            frame: of the camera's resolution.
            prior: where the vehicle should be; None searches the whole map.
            budget: how long the answer may take; None does not hurry. An answer that would come too late is
                refused with ``Reason.LATE``.

        Raises:
            CalibrationError: the frame is not of the camera's resolution.
        """
        deadline = Deadline(budget or Budget(), whole_map=prior is None)
        query = self._query(frame, prior, deadline)
        if query.prior_px is not None and not np.isfinite(query.prior_px).all():
            return query.refuse_outside(self.method)  # nowhere in the map's coordinate system
        if prior is None and not self.site.is_searchable:
            detail = f"the map of {self.site.size_km} is not searched as a whole; a position to begin at is needed"
            return query.refuse(Reason.MAP_TOO_LARGE, detail, self.method)
        result = self._dispatch(query)
        if isinstance(result, Fix) and not deadline.met:
            return query.refuse(
                Reason.LATE, "the answer came after the budget", result.method, window=result.window
            )
        return replace(self._to_true_north(result), timings=query.watch.timings)

    def explain(self, frame: Frame, window: Window, method: str | None = None) -> Explanation:
        """What the match of a frame in a window looks like: its surface or its matches, for reports.

        Args:
            frame: of the camera's resolution.
            window: that was searched, in map pixels.
            method: "ncc" or "sift"; None takes the matcher's own, and NCC of "auto".
        """
        middle_px = np.array([window.x0, window.y0]) + np.array([window.width_px - 1, window.height_px - 1]) / 2.0
        east, north = self.site.enu_from_pixel(middle_px)
        prior = Prior(east_m=float(east), north_m=float(north), sigma_m=0.0)
        query = self._query(frame, prior, Deadline(Budget()))
        method = method or self.method
        if self.options.profile == "paper":
            return explanation.by_paper(query, method, window)
        if method == "sift":
            return explanation.by_sift(query, self._landmarks, window, self.options.sift)
        return explanation.by_ncc(query, self._prepared, window, self.options.ncc)

    def _query(self, frame: Frame, prior: Prior | None, deadline: Deadline) -> Query:
        watch = Stopwatch(deadline, self.device, self._costs)
        with watch.stage("grey"):
            gray = self.camera.undistort(to_gray(frame))
        prior = None if prior is None else _bounded(prior)
        return self._from_true_north(Query(frame, gray, self._pinhole, self.site, prior, self.device, watch))

    def _from_true_north(self, query: Query) -> Query:
        """The query with its frame's heading turned from true north, at the prior's place, to the plane's."""
        heading_deg, place = query.frame.heading_deg, query.prior_px
        if heading_deg is None or place is None or not np.isfinite(place).all():
            return query  # without a place it is taken at the middle of the map, where the two are one
        lat, lon = self.site.geodetic_from_pixel(place)
        turn_deg = self.site.frame.convergence_deg(float(lat), float(lon))
        heading_deg = wrap_heading_deg(heading_deg + turn_deg)
        return query.with_frame(replace(query.frame, heading_deg=heading_deg))

    def _to_true_north(self, result: Fix | NoFix) -> Fix | NoFix:
        """The result with its attitude's heading turned from the plane's north to true north at the fix."""
        if isinstance(result, NoFix) or result.attitude is None:
            return result
        turn_deg = self.site.frame.convergence_deg(result.lat_deg, result.lon_deg)
        heading_deg = wrap_heading_deg(result.attitude.heading_deg - turn_deg)
        return replace(result, attitude=replace(result.attitude, heading_deg=heading_deg))

    def _dispatch(self, query: Query) -> Fix | NoFix:
        if self.options.profile == "paper":
            return paper.locate(query, self.method)
        if self.method == "ncc":
            return scheduler.by_ncc(query, self._tools)
        if self.method == "sift":
            return scheduler.by_sift(query, self._tools)
        return scheduler.by_both(query, self._tools)
