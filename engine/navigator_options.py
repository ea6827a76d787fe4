"""Settings of the navigator: how a position is carried from frame to frame, and what is accepted."""

from __future__ import annotations

import math
from dataclasses import dataclass

from engine.errors import OptionError
from engine.values import check_positive


@dataclass(frozen=True, slots=True, kw_only=True)
class NavigatorOptions:
    """How a position is carried from frame to frame, and what is accepted; ``docs/integrity.md`` has the rules.

    Attributes:
        measured_velocity_sigma_mps: of a velocity that came with the frame.
        acceleration_mps2: how hard the vehicle accelerates, for a second at a time, while its velocity is taken
            from its last fixes.
        max_speed_mps: assumed while nothing is known of the velocity.
        growth: factor on the uncertainty that the window is made for, for every refusal in a row.
        default_interval_s: time between frames that carry no stamp.
        gate: chi-square of two degrees of freedom, beyond which a fix contradicts a prediction.
        trusted_sigma_m: a prediction that is better known than this may contradict a fix.
        min_confidence: probability of being right that is asked of a fix, by all the evidence for it.
        lost_after: refusals in a row after which the whole map is searched again.
        lost_sigma_m: uncertainty of the prediction at which the same is done.
        search_every: while lost, of so many frames one searches the whole map; the others look where dead
            reckoning leads.
        hold_s: how long dead reckoning by measured velocities may contradict fixes that agree with each other.
        late_s: how much older than the newest frame a frame may be.
        attitude_lag_s: standard deviation of how late the telemetry's attitude is, while no picture measured it.
        attitude_jitter_s: of a single frame's lag about its mean.
        tilt_bias_deg: standard deviation of a lasting error of roll and of pitch while no picture measured it.
        heading_bias_deg: of the heading.
        healthy_s: age of the last fix up to which the navigator calls itself healthy.
        odometry: whether frames that come without a velocity are followed from one to the next, as
            ``docs/odometry.md`` says.
    """

    measured_velocity_sigma_mps: float = 0.5
    acceleration_mps2: float = 3.0
    max_speed_mps: float = 15.0
    growth: float = 1.4
    default_interval_s: float = 0.2
    gate: float = 18.4
    trusted_sigma_m: float = 50.0
    min_confidence: float = 0.999
    lost_after: int = 12
    lost_sigma_m: float = 100.0
    search_every: int = 3
    hold_s: float = 15.0
    late_s: float = 2.0
    attitude_lag_s: float = 0.1
    attitude_jitter_s: float = 0.03
    tilt_bias_deg: float = 1.0
    heading_bias_deg: float = 5.0
    healthy_s: float = 1.0
    odometry: bool = False

    def __post_init__(self) -> None:
        check_positive(self, *(name for name in self.__dataclass_fields__ if name != "odometry"))
        if self.growth < 1.0:
            raise OptionError(f"growth: expected 1 or more, got {self.growth}")
        if self.min_confidence >= 1.0:
            raise OptionError(f"min_confidence: expected a probability below 1, got {self.min_confidence}")

    @property
    def min_log_odds(self) -> float:
        """The required probability as log(p / (1 - p))."""
        return math.log(self.min_confidence / (1.0 - self.min_confidence))


ACCEPT_ALL = NavigatorOptions(
    gate=1e12,
    min_confidence=1e-12,
    attitude_lag_s=1e-9,
    attitude_jitter_s=1e-9,
    tilt_bias_deg=1e-9,
    heading_bias_deg=1e-9,
)
"""Every match is accepted, as by the paper's recipe: the baseline."""
