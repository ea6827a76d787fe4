"""SceneMatcher: one frame, one prior, one budget in; a Fix or a NoFix out. It remembers nothing between frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch

from engine import device as devices
from engine.align import to_gray
from engine.budget import Budget
from engine.camera import Camera
from engine.errors import OptionError
from engine.methods import ncc, paper, sift
from engine.methods.laid import NccOptions
from engine.methods.query import Query, Stopwatch
from engine.methods.sift import SiftOptions
from engine.orthomap import OrthoMap
from engine.prepared import PreparedMap
from engine.types import Fix, Frame, NoFix, Prior, Reason

METHODS = ("ncc", "sift", "auto")
PROFILES = ("engine", "paper")


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


class SceneMatcher:
    """Matches single frames against one map with one camera.

    Args:
        site: the map.
        camera: as calibrated, with its distortion; frames are undistorted by a lookup computed once.
        method: "ncc" (needs height and heading), "sift" (needs neither), or "auto": NCC where height and
            heading are known, SIFT where they are not or where NCC refuses.
        device: "cpu", "cuda" or "auto".
        options: settings; the defaults serve.

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
        self.options = options or MatcherOptions()
        if self.options.profile == "paper" and method == "auto":
            raise OptionError("method: the paper's profile has ncc and sift, got 'auto'")
        self.site = site
        self.camera = camera
        self.method = method
        self.device = devices.resolve(device)
        self._prepared = PreparedMap(site, self.device, self.options.ncc.enhance_radius_px, self.options.ncc.score)
        # What an undistorted picture obeys; the mount stays.
        self._pinhole = replace(camera, distortion_model="plumb_bob", distortion=np.zeros(5))

    def warmup(self) -> None:
        """Match a made-up frame once, so that lookups, plans and pools exist before take-off."""
        rng = np.random.default_rng(0)
        noise = rng.integers(0, 256, (self.camera.height_px, self.camera.width_px), dtype=np.uint8)
        height_m = 0.25 * min(self.site.width_px, self.site.height_px) * self.site.gsd_m_per_px
        frame = Frame(noise, 0, height_m, 0.0, 0.0, 0.0)
        self.locate(frame, Prior(east_m=0.0, north_m=0.0, sigma_m=10.0))

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
        watch = Stopwatch(budget or Budget(), self.device)
        with watch.stage("grey"):
            gray = self.camera.undistort(to_gray(frame))
        query = Query(frame, gray, self._pinhole, self.site, prior, self.device, watch)
        result = self._dispatch(query)
        if isinstance(result, Fix) and not watch.deadline.met:
            return query.refuse(
                Reason.LATE, "the answer came after the budget", result.method, window=result.window
            )
        return replace(result, timings=watch.timings)

    def _dispatch(self, query: Query) -> Fix | NoFix:
        if self.options.profile == "paper":
            return paper.locate(query, self.method)
        known = query.frame.height_agl_m is not None and query.frame.heading_deg is not None
        if self.method == "sift" or (self.method == "auto" and not known):
            return sift.locate(query, self.options.sift)
        result = ncc.locate(query, self._prepared, self.options.ncc)
        if self.method == "auto" and isinstance(result, NoFix) and result.reason is not Reason.LATE:
            return sift.locate(query, self.options.sift)
        return result
