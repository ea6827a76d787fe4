"""Settings of matching and navigation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from engine.assumed_errors import AssumedErrors
from engine.geo import chi_square_of
from engine.learned.pairs import PairMatcher
from engine.sift import BACKENDS
from engine.values import RISK, SIGNIFICANCE, check, check_choice, check_positive

if TYPE_CHECKING:
    from engine.orthomap import OrthoMap

PAPER_SCALE = 0.5
"""To which the paper reduces frame and map before detection."""
MIN_HEIGHT_M = 1.0
"""The lowest height to search if the height is unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseOptions:
    """Tolerances of a pose from matched points.

    Attributes:
        reprojection_px: Largest reprojection distance of an inlier.
        distinct_px: Matches nearer to each other than this count once: they see the same pixels. In pixels of the
            frame as it was matched, rectified if its height and heading are known.

    Raises:
        OptionError: a value is out of range.
    """

    reprojection_px: float = 3.0
    distinct_px: float = 16.0

    def __post_init__(self) -> None:
        check_positive(self, "reprojection_px", "distinct_px")

    @property
    def min_spread_px(self) -> float:
        """Least standard deviation of inliers in any direction: that of ``distinct_px`` evenly covered."""
        return self.distinct_px / math.sqrt(12.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class NccOptions:
    """Settings of the NCC method.

    Attributes:
        exhaustive: score every place of the window at full resolution.
        refine: refine the pose densely after the peak.
        exclusion_m: rivals nearer than this are the peak itself.

    Raises:
        OptionError: a value is out of range.
    """

    exhaustive: bool = False
    refine: bool = True
    exclusion_m: float = 6.0

    def __post_init__(self) -> None:
        check_positive(self, "exclusion_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class SiftOptions:
    """Settings of the SIFT method.

    Attributes:
        scale: the frame is reduced to this before detection.
        max_keypoints: features of a frame, unless the next setting asks for more; the map's are as dense.
        keypoints_per_px: features per pixel that the frame covers on the map's level.
        backend: computes the features of frame and map: "compiled" loops on the CPU, whatever the device, or
            "kornia" on the device; "auto" is "compiled".
        upsample: samples per pixel in the first octave of a frame that is drawn in the map's pixels. 2 locates
            small keypoints more exactly and takes three times as long. The map always has 2.
        tolerance_px: distance, in pixels of the map's level, within which a match agrees with the voted pose.
        search_widely: if too little is found, search again without the heading, and with heights from half of the
            telemetry's to double.
        max_height_m: the largest height to search if the height is unknown.
        matcher: replaces the features: it gets the reduced frame and the map's crop; its matches are lifted and
            solved for the pose like those of features.
        use_attitude: use the known heading, roll and pitch as a prior of the pose, weighted by their assumed
            errors; a few features alone hardly separate a tilt from a displacement.
        refine: refine the pose densely after PnP, if height, heading, tilt and surface are known.
        pose: settings of PnP and RANSAC.

    Raises:
        OptionError: a value is out of range.
    """

    scale: float = PAPER_SCALE
    max_keypoints: int = 300
    keypoints_per_px: float = 0.01
    backend: str = "auto"
    upsample: int = 2
    tolerance_px: float = 1.0
    search_widely: bool = True
    max_height_m: float = 500.0
    matcher: PairMatcher | None = None
    use_attitude: bool = True
    refine: bool = True
    pose: PoseOptions = field(default_factory=PoseOptions)

    def __post_init__(self) -> None:
        check_positive(self, "keypoints_per_px", "tolerance_px")
        check(self, "scale", "above 0 and at most 1", lambda scale: 0.0 < scale <= 1.0)
        heights = f"a finite number above {MIN_HEIGHT_M:g}"
        check(self, "max_height_m", heights, lambda height_m: MIN_HEIGHT_M < height_m < math.inf)
        check(self, "upsample", "1 or 2", lambda factor: factor in (1, 2))
        check_choice(self, "backend", BACKENDS)
        check(self, "max_keypoints", "4 or more", lambda count: count >= 4)


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedOptions:
    """Settings of the learned method; it takes all others from SIFT's.

    Attributes:
        weights: files of LoFTR, or of LightGlue with DISK or ALIKED.
        max_picture_px: largest number of pixels that a frame covers on the map level it is matched on.
        max_keypoints: largest number of keypoints of a frame; a window has up to four times as many, LoFTR none.
        max_window_px: a window with more pixels on its level is not searched.
        tolerance_px: replaces SIFT's; networks locate points less exactly.

    Raises:
        OptionError: a value is out of range.
    """

    weights: tuple[str, ...] = ()
    max_picture_px: int = 130_000
    max_keypoints: int = 512
    max_window_px: int = 1 << 22
    tolerance_px: float = 2.0

    def __post_init__(self) -> None:
        for name in ("max_picture_px", "max_window_px"):
            check(self, name, "4096 or more", lambda pixels: pixels >= 4096)
        check(self, "max_keypoints", "4 or more", lambda count: count >= 4)
        check_positive(self, "tolerance_px")


@dataclass(frozen=True, slots=True, kw_only=True)
class MatcherOptions:
    """Settings of all methods.

    Attributes:
        risk: allowed probability of a wrong fix, see :mod:`engine.matching.evidence`.
        errors: assumed errors of the telemetry and the map.
        ncc: settings of the NCC method.
        sift: settings of the SIFT method.
        learned: settings of the learned method.

    Raises:
        OptionError: a value is out of range.
    """

    risk: float = RISK
    errors: AssumedErrors = field(default_factory=AssumedErrors)
    ncc: NccOptions = field(default_factory=NccOptions)
    sift: SiftOptions = field(default_factory=SiftOptions)
    learned: LearnedOptions = field(default_factory=LearnedOptions)

    def __post_init__(self) -> None:
        check(self, "risk", "a probability above 0 and below 1", lambda risk: 0.0 < risk < 1.0)

    def on_map(self, site: OrthoMap) -> MatcherOptions:
        """The settings, with the map's stated accuracy in place of the assumed one."""
        return replace(self, errors=self.errors.on_map(site))


@dataclass(frozen=True, slots=True, kw_only=True)
class NavigatorOptions:
    """Settings of dead reckoning between frames and of acceptance; ``docs/integrity.md`` has the rules.

    Attributes:
        measured_velocity_sigma_mps: standard deviation of a velocity that came with the frame.
        acceleration_mps2: acceleration of the vehicle, for a second at a time, where its velocity is not measured.
        max_speed_mps: two standard deviations of an unknown velocity, per axis.
        default_interval_s: time between frames without a timestamp.
        gate: chi-square of two degrees of freedom, beyond which a fix contradicts a prediction.
        risk: allowed probability, by all evidence of the flight, that a fix is wrong.
        lost_sigma_m: uncertainty of the prediction above which the whole map is searched instead, if it can be.
        memory_s: time constant with which the evidence of past fixes fades, so that even late in a flight matches
            that agree with each other can outweigh it.
        attitude_lag_s: standard deviation of the delay of the attitude telemetry, until images measure it.
        attitude_jitter_s: standard deviation of one frame's delay about the mean delay, in attitude and position.
        tilt_bias_deg: standard deviation of a lasting error in roll and in pitch, until images measure it.
        heading_bias_deg: the same for the heading.
        healthy_s: age of the last fix up to which the navigator calls itself healthy.
        odometry: whether to measure motion from image to image for frames without a velocity; see
            ``docs/odometry.md``.

    Raises:
        OptionError: a value is out of range.
    """

    measured_velocity_sigma_mps: float = 0.5
    acceleration_mps2: float = 3.0
    max_speed_mps: float = 15.0
    default_interval_s: float = 0.2
    gate: float = round(chi_square_of(RISK, 2), 1)
    risk: float = SIGNIFICANCE
    lost_sigma_m: float = 100.0
    memory_s: float = 30.0
    attitude_lag_s: float = 0.1
    attitude_jitter_s: float = 0.03
    tilt_bias_deg: float = 1.0
    heading_bias_deg: float = 8.0
    healthy_s: float = 1.0
    odometry: bool = False

    def __post_init__(self) -> None:
        check_positive(self, *(name for name in self.__dataclass_fields__ if name != "odometry"))
        check(self, "risk", "a probability below 1", lambda risk: risk < 1.0)
