"""The engine's value types: frames and priors in, fixes or refusals out.

All are frozen and slotted. Names include their units; a position always comes with its covariance.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import DtypeError, OptionError, ShapeError, TelemetryError
from engine.geo import larger_variance, wrap_heading_deg

if TYPE_CHECKING:
    from torch import Tensor

MAX_SIGMA_M = 1e6
"""Upper bound on the standard deviation of a position or of a map's georeference."""
RISK = 1e-4
"""Probability of an error that is allowed unless another is chosen."""
SIGNIFICANCE = 1e-3
"""Two estimates contradict each other if chance sets them so far apart less often than this."""


@dataclass(frozen=True, slots=True)
class Attitude:
    """Attitude of the body (forward-right-down): turned by yaw first, then pitch, then roll.

    Convention:
        ``heading_deg`` clockwise from true north in [0, 360), or from grid north if a name says ``grid_``;
        ``pitch_deg`` positive nose up;
        ``roll_deg`` positive right side down.
    """

    roll_deg: float
    pitch_deg: float
    heading_deg: float


# Fields of a frame that are finite or None.
_FINITE = ("height_agl_m", "heading_deg", "roll_deg", "pitch_deg", "east_velocity_mps", "north_velocity_mps")
_SIGMAS = ("height_sigma_m", "heading_sigma_deg", "tilt_sigma_deg", "velocity_sigma_mps")


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture with the vehicle's telemetry at its capture.

    Attributes:
        image: (H, W) grey or (H, W, 3) RGB, uint8, numpy or torch.
        timestamp_ns: capture time on the vehicle's clock, or None.
        height_agl_m: height above the ground, positive, or None if unknown.
        heading_deg: clockwise from true north, or None if unknown.
        roll_deg: positive right side down; None, if unknown, is level with a wide sigma.
        pitch_deg: positive nose up; likewise.
        east_velocity_mps: velocity over ground, or None if unknown.
        north_velocity_mps: velocity over ground, or None if unknown.
        height_sigma_m: standard deviation of the height. None, here and for the next two, takes the matcher's
            assumption. Heights and headings are searched within three of these sigmas.
        heading_sigma_deg: standard deviation of the heading; with 180 any heading is possible.
        tilt_sigma_deg: standard deviation of roll and of pitch.
        velocity_sigma_mps: standard deviation of the velocity, per axis; None takes the navigator's assumption.

    Raises:
        ShapeError: the image is not (H, W) or (H, W, 3), or is empty.
        DtypeError: the image is not uint8.
        TelemetryError: a number is not finite, the height or a standard deviation is not positive, or a standard
            deviation is above :data:`MAX_SIGMA_M`.
    """

    image: NDArray[np.uint8] | Tensor
    timestamp_ns: int | None = None
    height_agl_m: float | None = None
    heading_deg: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    east_velocity_mps: float | None = None
    north_velocity_mps: float | None = None
    height_sigma_m: float | None = None
    heading_sigma_deg: float | None = None
    tilt_sigma_deg: float | None = None
    velocity_sigma_mps: float | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.image.shape)
        if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] != 3) or 0 in shape:
            raise ShapeError(f"image: expected (H, W) or (H, W, 3) with at least one pixel, got {shape}")
        if str(self.image.dtype).removeprefix("torch.") != "uint8":
            raise DtypeError(f"image: expected uint8, got {self.image.dtype}")
        for name in _FINITE:
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise TelemetryError(f"{name}: expected a finite number or None, got {value}")
        if self.height_agl_m is not None and self.height_agl_m <= 0:
            raise TelemetryError(f"height_agl_m: expected a height above 0 m, got {self.height_agl_m}")
        for name in _SIGMAS:
            sigma = getattr(self, name)
            if sigma is not None and not 0.0 < sigma <= MAX_SIGMA_M:
                raise TelemetryError(f"{name}: expected a number above 0 and at most {MAX_SIGMA_M:g}, got {sigma}")

    @classmethod
    def from_bgr(cls, image: NDArray[np.uint8], *args: Any, **known: Any) -> Frame:
        """A frame from a picture in OpenCV's channel order.

        Args:
            image: (H, W, 3) BGR, uint8, as ``cv2.VideoCapture`` and ``cv2.imread`` return it.
            *args: as the frame takes them after its image.
            **known: likewise, by name.

        Returns:
            Frame: with the picture as RGB, a copy.

        Raises:
            ShapeError: the image is not (H, W, 3).
        """
        if np.ndim(image) != 3 or np.shape(image)[2] != 3:
            raise ShapeError(f"image: expected (H, W, 3) BGR, got {np.shape(image)}")
        return cls(np.ascontiguousarray(image[:, :, ::-1]), *args, **known)

    @property
    def attitude(self) -> Attitude | None:
        """The attitude with unknown roll and pitch as 0, or None if the heading is unknown."""
        if self.heading_deg is None:
            return None
        return Attitude(self.roll_deg or 0.0, self.pitch_deg or 0.0, wrap_heading_deg(self.heading_deg))


@dataclass(frozen=True, slots=True)
class GridPose:
    """Height and attitude by which a frame is projected onto the map; None if unknown.

    Attributes:
        height_agl_m: above the ground.
        grid_heading_deg: clockwise from grid north, the north of the map's plane. It differs from true north by
            the meridian convergence (:meth:`engine.geo.LocalFrame.convergence_deg`).
        roll_deg: positive right side down.
        pitch_deg: positive nose up.
    """

    height_agl_m: float | None
    grid_heading_deg: float | None
    roll_deg: float | None
    pitch_deg: float | None

    @property
    def has_tilt(self) -> bool:
        """Whether roll and pitch are known."""
        return self.roll_deg is not None and self.pitch_deg is not None

    @property
    def grid_attitude(self) -> Attitude | None:
        """The attitude about grid north, unknown roll and pitch taken as level; None without a heading."""
        if self.grid_heading_deg is None:
            return None
        return Attitude(self.roll_deg or 0.0, self.pitch_deg or 0.0, wrap_heading_deg(self.grid_heading_deg))

    @property
    def known_height_m(self) -> float:
        """The height; only of a pose that has one, or its frame would have been refused."""
        assert self.height_agl_m is not None
        return self.height_agl_m

    @property
    def known_attitude(self) -> Attitude:
        """The attitude; only of a pose that has a heading, or its frame would have been refused."""
        attitude = self.grid_attitude
        assert attitude is not None
        return attitude


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """Prior of the vehicle's position at the capture of a frame.

    Give either ``lat_deg`` and ``lon_deg`` (WGS84) or ``east_m`` and ``north_m`` (about the map's origin).

    Attributes:
        sigma_m: one standard deviation of the position, per axis.
        moved_east_m: movement to the east since the last frame; eq. 4 and 5 add it to the window.
        moved_north_m: movement to the north since the last frame.

    Raises:
        OptionError: the position is missing, given twice or not finite, or sigma_m is negative.
    """

    lat_deg: float | None = None
    lon_deg: float | None = None
    east_m: float | None = None
    north_m: float | None = None
    sigma_m: float
    moved_east_m: float = 0.0
    moved_north_m: float = 0.0

    def __post_init__(self) -> None:
        geographic = self.lat_deg is not None and self.lon_deg is not None
        local = self.east_m is not None and self.north_m is not None
        given = [v for v in (self.lat_deg, self.lon_deg, self.east_m, self.north_m) if v is not None]
        if geographic == local or len(given) != 2:
            raise OptionError("prior: expected either lat_deg and lon_deg or east_m and north_m")
        if not all(map(math.isfinite, given)):
            raise OptionError(f"prior: expected a finite position, got {tuple(given)}")
        check(self, "lat_deg", "-90 to 90", lambda lat: lat is None or abs(lat) <= 90)
        check(self, "lon_deg", "-360 to 360", lambda lon: lon is None or abs(lon) <= 360)
        if not (math.isfinite(self.moved_east_m) and math.isfinite(self.moved_north_m)):
            raise OptionError(f"moved: expected finite metres, got {self.moved_east_m}, {self.moved_north_m}")
        check(self, "sigma_m", "0 m or more", lambda sigma: math.isfinite(sigma) and sigma >= 0)


@dataclass(frozen=True, slots=True)
class Window:
    """A crop of the map, in whole map pixels: columns [x0, x0 + width_px), rows [y0, y0 + height_px)."""

    x0: int
    y0: int
    width_px: int
    height_px: int

    @property
    def x1(self) -> int:
        """The column after the last."""
        return self.x0 + self.width_px

    @property
    def y1(self) -> int:
        """The row after the last."""
        return self.y0 + self.height_px

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its rows and columns, as NumPy and rasterio take them."""
        return np.s_[self.y0 : self.y1, self.x0 : self.x1]

    @property
    def area_px(self) -> int:
        """Number of pixels inside."""
        return self.width_px * self.height_px


@dataclass(frozen=True, slots=True)
class Peak:
    """The maximum of a correlation surface.

    Attributes:
        x: sub-pixel column of the template's top-left pixel in the window.
        y: sub-pixel row of the same.
        score: NCC at the best whole pixel, in [-1, 1].
        second_score: the highest NCC outside the peak's exclusion zone, or of a null hypothesis if that is higher;
            -1 where there is none.
        curvature: (2, 2) second derivatives of the score at the peak, per square pixel; 0 at the window's edge.
    """

    x: float
    y: float
    score: float
    second_score: float
    curvature: NDArray[np.float64]


class Reason(enum.Enum):
    """Why a frame was refused."""

    NO_TEXTURE = "no_texture"
    OUTSIDE_MAP = "outside_map"
    AMBIGUOUS = "ambiguous"
    LOW_SCORE = "low_score"
    TOO_FEW_MATCHES = "too_few_matches"
    BAD_POSE = "bad_pose"
    INCONSISTENT = "inconsistent"
    UNCONFIRMED = "unconfirmed"
    NO_HEIGHT = "no_height"
    NO_HEADING = "no_heading"
    MAP_TOO_LARGE = "map_too_large"
    TILTED = "tilted"
    LATE = "late"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Timings:
    """Milliseconds spent in each stage, in the order in which the stages ran."""

    stages_ms: Mapping[str, float] = field(default_factory=dict)

    @property
    def total_ms(self) -> float:
        """Sum over the stages."""
        return sum(self.stages_ms.values())


@dataclass(frozen=True, slots=True)
class Look:
    """What was known of a frame's place after one look at it.

    Attributes:
        method: "ncc", "sift" or "learned".
        name: of the look, such as "structure".
        nats: evidence for the place that its method then proposed, in natural log-odds; None if it proposed none.
            A fix needs log((1 - risk) / risk), three times that if no null hypothesis was tested.
    """

    method: str
    name: str
    nats: float | None

    def __str__(self) -> str:
        return f"{self.method} {self.name} {'-' if self.nats is None else format(self.nats, '.1f')}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fix:
    """A position with its covariance, at the capture of the frame.

    Attributes:
        timestamp_ns: capture time of the frame, or None if the frame had none.
        lat_deg: WGS84 latitude of the camera.
        lon_deg: WGS84 longitude of the camera.
        east_m: east of the map's origin.
        north_m: north of the map's origin.
        up_m: height of the camera in the surface model's datum (above flat ground if there is none);
            None if the method does not measure height.
        covariance_m2: (3, 3) in east, north, up; if ``up_m`` is None, up is the variance of the frame's height.
        attitude: measured by the method, or None. If NCC searched headings or heights without refinement, only the
            heading is measured; roll and pitch are the frame's, or 0.
        attitude_covariance_deg2: (3, 3) in roll, pitch, heading if the whole pose was solved, else None.
        score: NCC in [-1, 1], of the peak or of image and map at a refined pose; for features, the share of
            matches that are inliers.
        method: "ncc", "sift" or "learned".
        window: the crop of the map that was searched.
        timings: milliseconds per stage.
        map_xy_px: the camera's nadir in map pixels (x, y).
        stage: last stage reached within the budget: "coarse" at reduced resolution, "fine" at full; "refined": the
            whole pose was; "verified": NCC and SIFT agree; "unconfirmed": no picture confirms the attitude.
        confidence: probability in (0, 1) that the position is correct, see ``docs/integrity.md``; None if the
            method states none, as in the paper's profile.
        map_sigma_m: the georeference's part of ``covariance_m2``, one standard deviation per axis. All fixes on a
            map share this one error.
        looks: the looks at the frame, in their order: why it was accepted.
    """

    timestamp_ns: int | None
    lat_deg: float
    lon_deg: float
    east_m: float
    north_m: float
    up_m: float | None
    covariance_m2: NDArray[np.float64]
    attitude: Attitude | None
    score: float
    method: str
    window: Window
    timings: Timings
    map_xy_px: tuple[float, float]
    stage: str = "fine"
    confidence: float | None = None
    map_sigma_m: float = 0.0
    attitude_covariance_deg2: NDArray[np.float64] | None = None
    looks: tuple[Look, ...] = ()

    @property
    def rests_on_attitude(self) -> bool:
        """Whether the position is only as good as the telemetry's attitude, which no picture confirmed."""
        return self.stage == "unconfirmed" or (self.stage == "coarse" and self.up_m is None)

    @property
    def attitude_sigma_deg(self) -> tuple[float, ...] | None:
        """Standard deviations of roll, pitch and heading; None if the whole pose was not solved."""
        covariance = self.attitude_covariance_deg2
        return None if covariance is None else tuple(np.sqrt(np.diag(covariance)).tolist())

    @property
    def relative_covariance_m2(self) -> NDArray[np.float64]:
        """(2, 2) east and north relative to the map and to other fixes on it: without the map's own error."""
        return self.covariance_m2[:2, :2] - self.map_sigma_m**2 * np.eye(2)

    @property
    def relative_sigma_m(self) -> float:
        """As :attr:`sigma_m`, without the map's own error."""
        return math.sqrt(larger_variance(self.relative_covariance_m2))

    @property
    def sigma_m(self) -> float:
        """Horizontal standard deviation, the larger of the two axes of the ellipse."""
        return math.sqrt(larger_variance(self.covariance_m2[:2, :2]))

    def protection_level_m(self, risk: float = RISK) -> float:
        """Horizontal radius around the fix that the vehicle exceeds with at most this probability.

        It allows for a wrong place, by :attr:`confidence`, and for the covariance, as a circle with the ellipse's
        larger axis.

        Args:
            risk: the allowed probability, above 0 and below 1.

        Returns:
            float: infinite if a wrong place alone is more probable than that, or if its probability is unknown.

        Raises:
            OptionError: the risk is not such a probability.
        """
        if not 0.0 < risk < 1.0:
            raise OptionError(f"risk: expected a probability above 0 and below 1, got {risk}")
        left = risk - (1.0 - (self.confidence or 0.0))
        return self.sigma_m * math.sqrt(-2.0 * math.log(left)) if left > 0.0 else math.inf

    def __str__(self) -> str:
        place = f"{self.lat_deg:.7f}, {self.lon_deg:.7f}, sigma {self.sigma_m:.1f} m"
        return f"{place}, by {self.method}, {self.stage}"

    def refused(self, reason: Reason, detail: str) -> NoFix:
        """Turn this fix into a refusal that keeps it as its :attr:`NoFix.match`."""
        return NoFix(
            reason=reason,
            detail=detail,
            timestamp_ns=self.timestamp_ns,
            method=self.method,
            score=self.score,
            window=self.window,
            timings=self.timings,
            match=self,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class NoFix:
    """A refusal: the frame gave no reliable position, and the reason.

    Attributes:
        reason: of the refusal.
        detail: one sentence with the figures behind the reason.
        timestamp_ns: capture time of the frame, or None if the frame had none.
        method: the method that refused, or None if none was tried.
        score: of the best match, or None if there was none.
        window: the crop that was searched, or None.
        timings: milliseconds per stage that ran.
        match: what was found but not accepted, with its own confidence and covariance, or None.
        looks: the looks at the frame, in their order.
    """

    reason: Reason
    detail: str = ""
    timestamp_ns: int | None = None
    method: str | None = None
    score: float | None = None
    window: Window | None = None
    timings: Timings = field(default_factory=Timings)
    match: Fix | None = None
    looks: tuple[Look, ...] = ()

    def __str__(self) -> str:
        return f"no fix, {self.reason.value}: {self.detail}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """True pose of the vehicle at one time; unknown fields are None.

    Attributes:
        timestamp_ns: on the clock of the frames.
        lat_deg: WGS84 latitude.
        lon_deg: WGS84 longitude.
        alt_amsl_m: height above mean sea level.
        height_agl_m: height above the ground.
        roll_deg: positive right side down.
        pitch_deg: positive nose up.
        heading_deg: clockwise from true north.
    """

    timestamp_ns: int
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float | None = None
    height_agl_m: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    heading_deg: float | None = None


Result = Fix | NoFix
"""The answer to a frame."""


def check(options: object, name: str, expected: str, is_valid: Callable[[Any], bool]) -> None:
    """Check one option.

    Args:
        options: has it.
        name: of the option.
        expected: what it may be, in words.
        is_valid: the same as a test of its value.

    Raises:
        OptionError: it is not valid.
    """
    value = getattr(options, name)
    if not is_valid(value):
        raise OptionError(f"{name}: expected {expected}, got {value}")


def check_choice(options: object, name: str, choices: Sequence[str]) -> None:
    """Check that an option is one of these words.

    Raises:
        OptionError: it is not.
    """
    value = getattr(options, name)
    if value not in choices:
        raise OptionError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def check_positive(options: object, *names: str) -> None:
    """Check that all options are finite numbers above 0.

    Raises:
        OptionError: names the first that is not.
    """
    for name in names:
        check(options, name, "a number above 0", lambda value: math.isfinite(value) and value > 0)
