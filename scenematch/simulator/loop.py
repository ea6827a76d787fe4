"""The closed loop: fly a simulated vehicle by a filter that gets positions only from the engine's fixes.

If fixes fail:

- No fix: the filter propagates on the IMU alone, and the vehicle follows its route while the estimate's sigma
stays below 5 m.
- Above that it holds: it slows down on its route and hovers by the estimate, until fixes have brought the sigma
  below half of that limit. Then it returns to where it left the route and continues.
- Above 20 m the estimate is too uncertain to hover by: the flight is handed over to the pilot.
- A fix that contradicts the filter by chi-square is not fused. After 15 such fixes in a row,
either the filter or the engine is wrong, and the flight is handed over too.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from engine.geo import Array, attitude_from_rotation
from engine.navigation.navigator import Matcher, Navigator, NavigatorState
from engine.values import Attitude, Fix, Frame, NoFix, Prior, Reason
from scenematch.simulator import ekf
from scenematch.simulator.faults import Fault, ShiftedMap
from scenematch.simulator.light import Image
from scenematch.simulator.pilot import Pilot, Route, Setpoint
from scenematch.simulator.quadrotor import STEP_S, State, WindField, advance, hovering, shaken
from scenematch.simulator.sensors import Instruments, SensorSuite, steps_between
from scenematch.simulator.vehicle import START_NS

__all__ = ["ClosedLoop", "Fault", "LoopAnswer", "LoopResult", "LoopSample", "Mode"]

FRAME_RATE_HZ, LATENCY_S = 5.0, 0.12
"""Of the camera, and from the capture of a frame to the arrival of its fix."""
_START_SIGMA_M = 3.0  # standard deviation of the position at the start, per axis
# Horizontal sigma of the estimate above which the vehicle holds, and above which the flight is handed over.
_HOLD_SIGMA_M, _GIVE_UP_SIGMA_M = 5.0, 20.0
_RESUME_M = 5.0  # largest estimated distance from the route at which the vehicle continues after a hold
_PACE_CHANGE_PER_S = 0.25  # how fast it slows down along its route and speeds up again; 1 takes a second
_GATE = 18.4  # chi-square of two degrees of freedom, beyond which a fix contradicts the filter
_MAX_CONTRADICTIONS = 15  # in a row, at which the flight is handed over
_HEALTHY_S = 1.0  # largest age of the last fix, beyond its latency, at which the engine counts as healthy

RenderCallback = Callable[[State], Image]
"""Returns the camera's picture at a state of the vehicle."""


class Mode(enum.Enum):
    """Whether the vehicle follows its route, holds its position, or is handed over to the pilot."""

    FOLLOW = "follow"
    HOLD = "hold"
    HANDED_OVER = "handed_over"


@dataclass(frozen=True, slots=True)
class LoopSample:
    """One row of the flight's record.

    Attributes:
        time_s: since the start.
        truth: the true state of the vehicle.
        estimate: the filter's.
        plan_m: (3,) position of the setpoint, east, north and up.
        mode: of the flight.
        healthy: whether the engine's last fix is recent.
    """

    time_s: float
    truth: State
    estimate: ekf.FilterState
    plan_m: Array
    mode: Mode
    healthy: bool


@dataclass(frozen=True, slots=True)
class LoopAnswer:
    """The engine's answer to one frame.

    Attributes:
        timestamp_ns: of its capture.
        truth: the vehicle's true state then.
        result: the engine's.
        state: the navigator's after it; None if the engine was killed.
    """

    timestamp_ns: int
    truth: State
    result: Fix | NoFix
    state: NavigatorState | None


@dataclass
class LoopResult:
    """A completed flight.

    Attributes:
        record: ten times a second.
        answers: the engine's, one per frame.
        used: timestamps of the fixes that the filter fused.
        start_m: (3,) the filter's estimate before the start, east, north and up.
        resets: how often the navigator reset its position.
    """

    record: list[LoopSample]
    answers: list[LoopAnswer]
    used: list[int]
    start_m: Array
    resets: int = 0

    @property
    def plan_error_m(self) -> Array:
        """(N, 3) truth less plan of every sample, in east, north and up."""
        return np.array([row.truth.position_m - row.plan_m for row in self.record])

    @property
    def estimate_error_m(self) -> Array:
        """(N, 3) estimate less truth of every sample, in east, north and up."""
        return np.array([row.estimate.position_m - row.truth.position_m for row in self.record])


class ClosedLoop:
    """A flight by the engine's fixes, frame by frame.

    Args:
        route: the route to fly, relative to the origin of the matcher's map, up from its ground.
        camera: takes the pictures.
        matcher: matches them; a :class:`engine.matching.matcher.SceneMatcher`, or a stand-in.
        seed: of wind, vibration and all sensors.
        fault: injected failure.
        latency_s: from the capture of a frame to the arrival of its fix.

    Attributes:
        latency_s: as given.
        fault: as given.
        flown: the flight so far.
    """

    def __init__(
        self,
        route: Route,
        camera: RenderCallback,
        matcher: Matcher,
        *,
        seed: int = 1,
        fault: Fault | None = None,
        latency_s: float = LATENCY_S,
    ) -> None:
        air, sensors, start, self._shakes = np.random.default_rng(np.random.SeedSequence([seed, 0xC1])).spawn(4)
        self._route, self._camera, self.fault, self.latency_s = route, camera, fault or Fault(), latency_s
        self._suite = SensorSuite()
        self._map = ShiftedMap(matcher)
        self._air, self._pilot = WindField(air), Pilot()
        self._instruments = Instruments(self._suite, sensors)
        self._state = hovering(route.position_m[0], float(route.heading_deg[0]))
        self._history = ekf.History(self._initial_estimate(start), self._suite, 1.0 + latency_s)
        self._navigator: Navigator | None = self._new_engine()
        self._clock_s, self._pace, self._plan = 0.0, 1.0, route.at(0.0)
        self._kicks = deque(route.kicks_s)
        self._picture: Image | None = None
        self._pending: deque[LoopAnswer] = deque()
        self._contradictions = 0  # in a row
        self._last_fix_s = -math.inf
        self._mode = Mode.FOLLOW
        self.flown = LoopResult([], [], [], self._history.now.position_m)

    def _initial_estimate(self, rng: np.random.Generator) -> ekf.FilterState:
        """The state at rest, with errors drawn from the filter's own covariance."""
        white = rng.standard_normal(5)
        heading = self._instruments.heading_deg(self._state)
        attitude = Attitude(ekf.START_TILT_DEG * white[3], ekf.START_TILT_DEG * white[4], heading)
        position_m = self._state.position_m + _START_SIGMA_M * white[:3]
        return ekf.initial_state(position_m, _START_SIGMA_M, attitude, self._suite)

    def _new_engine(self) -> Navigator:
        """A navigator that starts from the filter's estimate."""
        estimate = self._history.now
        east, north = (float(v) for v in estimate.position_m[:2])
        return Navigator(self._map, Prior(east_m=east, north_m=north, sigma_m=estimate.sigma_m))

    def fly(self, seconds: float | None = None) -> Iterator[Frame]:
        """Fly; yields every frame as given to the engine, after its answer.

        Args:
            seconds: maximum duration; None flies as long as the route takes without holding. A handover ends the
                flight.
        """
        every = steps_between(FRAME_RATE_HZ)
        for k in range(1, round((self._route.duration_s if seconds is None else seconds) / STEP_S) + 1):
            self._step(k)
            if k % every == 0:
                yield self._process_frame()
            self._receive()
            self._choose_mode()
            over = self._mode is Mode.HANDED_OVER
            if over or k % round(0.1 / STEP_S) == 0:
                self._record()
            if over:
                return

    def _step(self, k: int) -> None:
        """The ``k``-th step of :data:`scenematch.simulator.quadrotor.STEP_S`."""
        estimate = self._history.now
        target = self._plan = self._target()
        while self._kicks and self._clock_s >= self._kicks[0]:
            self._kicks.popleft()
            self._state = shaken(self._state, self._shakes)
        wanted = self._pilot.steer(target, estimate.position_m, estimate.velocity_mps)
        self._state, felt = advance(self._state, wanted, target.heading_deg, self._air.next())
        self._history.advance(self._instruments.imu(felt))
        self._sense(k)

    def _target(self) -> Setpoint:
        """The setpoint; during a hold, the route's clock slows to a stop and later runs again."""
        faster = _PACE_CHANGE_PER_S * (1.0 if self._mode is Mode.FOLLOW else -1.0)
        pace = min(max(self._pace + faster * STEP_S, 0.0), 1.0)
        change, self._pace = (pace - self._pace) / STEP_S, pace
        self._clock_s += pace * STEP_S
        return self._route.at(self._clock_s, pace, change)

    def _sense(self, k: int) -> None:
        """Read barometer and compass."""
        suite, instruments, state = self._suite, self._instruments, self._state
        now_s = self._history.now.time_s
        if k % steps_between(suite.barometer.rate_hz) == 0:
            height_m = instruments.height_m(state)
            self._history.fuse(partial(ekf.fuse_height, height_m=height_m, suite=suite), now_s)
        if k % steps_between(suite.compass.rate_hz) == 0:
            heading_deg = instruments.heading_deg(state)
            self._history.fuse(partial(ekf.fuse_heading, heading_deg=heading_deg, suite=suite), now_s)

    def _process_frame(self) -> Frame:
        """Take a picture and match it; the answer arrives after the latency."""
        time_s, fault = self._state.time_s, self.fault
        if self._picture is None or not fault.acts("frozen", time_s):
            self._picture = self._camera(self._state)
        self._map.shift_m = fault.shift_m if fault.acts("shifted", time_s) else 0.0
        stamp_ns = START_NS + round(time_s * 1e9)
        frame = self._frame(self._picture, stamp_ns)
        result: Fix | NoFix = NoFix(reason=Reason.FAILED, detail="the engine was killed", timestamp_ns=stamp_ns)
        if fault.acts("killed", time_s):
            self._navigator = None
        else:
            self._navigator = self._navigator or self._new_engine()
            before = self._navigator.reset_count
            result = self._navigator.update(frame)
            self.flown.resets += self._navigator.reset_count - before
        state = None if self._navigator is None else self._navigator.state
        answer = LoopAnswer(stamp_ns, self._state, result, state)
        self.flown.answers.append(answer)
        self._pending.append(answer)
        return frame

    def _frame(self, picture: Image, stamp_ns: int) -> Frame:
        """The picture with the filter's estimate at its capture."""
        estimate = self._history.now
        roll, pitch, heading = attitude_from_rotation(estimate.enu_from_body)
        return Frame(
            picture,
            timestamp_ns=stamp_ns,
            height_agl_m=max(float(estimate.position_m[2]) - self._map.site.ground_m, 1.0),
            heading_deg=heading,
            roll_deg=roll,
            pitch_deg=pitch,
            east_velocity_mps=float(estimate.velocity_mps[0]),
            north_velocity_mps=float(estimate.velocity_mps[1]),
        )

    def _receive(self) -> None:
        """Fuse the fixes that have arrived, each at its own time, if they pass the chi-square gate."""
        now_s = self._state.time_s + 0.5 * STEP_S
        while self._pending and self._pending[0].truth.time_s + self.latency_s <= now_s:
            answer = self._pending.popleft()
            fix, captured_s = answer.result, answer.truth.time_s
            if isinstance(fix, NoFix):
                continue
            self._last_fix_s = captured_s
            if ekf.fix_chi_square(self._history.at(captured_s), fix) > _GATE:
                self._contradictions += 1
                continue
            self._contradictions = 0
            self._history.fuse(partial(ekf.fuse_fix, fix=fix), captured_s)
            self.flown.used.append(answer.timestamp_ns)

    def _choose_mode(self) -> None:
        estimate = self._history.now
        sigma_m = estimate.sigma_m
        off_m = float(np.hypot(*(estimate.position_m - self._plan.position_m)[:2]))
        if self._contradictions >= _MAX_CONTRADICTIONS or sigma_m > _GIVE_UP_SIGMA_M:
            self._mode = Mode.HANDED_OVER
        elif sigma_m > _HOLD_SIGMA_M:
            self._mode = Mode.HOLD
        elif sigma_m < 0.5 * _HOLD_SIGMA_M and off_m < _RESUME_M:
            self._mode = Mode.FOLLOW

    def _record(self) -> None:
        """Add a row to the record."""
        state = self._state
        healthy = state.time_s - self._last_fix_s - self.latency_s <= _HEALTHY_S
        row = LoopSample(state.time_s, state, self._history.now, self._plan.position_m, self._mode, healthy)
        self.flown.record.append(row)
