"""The core of the ROS nodes: pictures and telemetry into the engine, poses, fixes and diagnostics out of it.

Knows no ROS but by the fields of its messages: ros1.py and ros2.py carry them. A pose never travels without its
covariance, and a refusal is never one: it is told in the diagnostics. Stamps are of capture.
"""

from __future__ import annotations

import importlib
import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

from engine.adapters.ros_out import RosOptions, diagnostics, is_finite, pose, window_picture
from engine.adapters.vehicle import ANGLES, RecentValues, Vehicle, only
from engine.errors import EngineError
from engine.formats.ros import bags
from engine.formats.ros.messages import MessageFactory, attitude_of, picture_of, range_of, stamp_ns
from engine.live import Answer, Counts, Live, LiveOptions
from engine.navigator import Navigator
from engine.orthomap import OrthoMap
from engine.values import Fix, NoFix, Prior

OUTPUTS = {
    "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "fix": "sensor_msgs/msg/NavSatFix",
    "window": "sensor_msgs/msg/Image",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
"""What is published."""

_BACK_NS = 1_000_000_000  # a stamp so much older than the last: a simulator or a bag began again
_SILENT_S = 2.0  # without a picture, after which the diagnostics say so
_OK, _WARN, _ERROR = 0, 1, 2

Handler = Callable[[Any], None]


class RosNode(Protocol):
    """What a node of either ROS does for the bridge."""

    maker: MessageFactory

    def now_ns(self) -> int:
        """The time of ROS, simulated where it is."""

    def wait_for(self, topic: str, msgtype: str, timeout_s: float) -> Any:
        """The next message of a topic; None after the timeout."""

    def publish(self, output: str, message: Any) -> None:
        """Publish a message of one of :data:`OUTPUTS`."""

    def is_wanted(self, output: str) -> bool:
        """Whether anybody subscribes to it."""

    def spin(
        self, handlers: dict[str, tuple[str, Handler]], beat: Callable[[], None], seconds: float | None
    ) -> None:
        """Subscribe, and call ``beat`` every second until the end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Topics:
    """What is subscribed to; an empty name leaves it out.

    Attributes:
        image: sensor_msgs/Image.
        camera_info: sensor_msgs/CameraInfo, where no calibration was given.
        imu: sensor_msgs/Imu, whose orientation is the attitude.
        compass: std_msgs/Float64, degrees clockwise from north; heard, it outranks the Imu's heading.
        height: std_msgs/Float64, metres above take-off.
        range: sensor_msgs/Range, along the body's down axis; heard, it outranks the height.
        velocity: geometry_msgs/TwistStamped, east and north in metres a second.
    """

    image: str = bags.IMAGE
    camera_info: str = bags.CAMERA_INFO
    imu: str = bags.IMU
    compass: str = bags.COMPASS
    height: str = bags.HEIGHT
    range: str = bags.RANGE
    velocity: str = bags.VELOCITY


@dataclass(frozen=True, slots=True)
class RosStatus:
    """What a node did so far.

    Attributes:
        counts: of the pictures.
        fixes: that were published.
        refused: frames without a fix, by reason.
        unusable: pictures that could not be read.
        restarts: how often the time went back, and everything began again.
    """

    counts: Counts
    fixes: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    unusable: int = 0
    restarts: int = 0


class RosTelemetry:
    """What the topics said lately, on the time of ROS. May be read from another thread than those that fill it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._attitude, self._compass, self._velocity = RecentValues(ANGLES), RecentValues((True,)), RecentValues()
        self._range, self._height = RecentValues(), RecentValues()

    def imu(self, message: Any) -> None:
        """Take a sensor_msgs/Imu."""
        attitude = attitude_of(message)
        if attitude is not None:
            self._add(self._attitude, stamp_ns(message), *attitude)

    def compass(self, heading_deg: float, now_ns: int) -> None:
        """Take a heading that came without a stamp."""
        self._add(self._compass, now_ns, heading_deg)

    def height(self, height_m: float, now_ns: int) -> None:
        """Take a height above take-off that came without a stamp."""
        self._add(self._height, now_ns, height_m)

    def range(self, message: Any) -> None:
        """Take a sensor_msgs/Range."""
        range_m = range_of(message)
        if range_m is not None:
            self._add(self._range, stamp_ns(message), range_m)

    def velocity(self, message: Any) -> None:
        """Take a geometry_msgs/TwistStamped in east-north-up."""
        linear = message.twist.linear
        self._add(self._velocity, stamp_ns(message), linear.x, linear.y)

    def vehicle(self, time_ns: int) -> Vehicle:
        """What the vehicle knew at a moment."""
        with self._lock:
            roll_deg, pitch_deg, yaw_deg = self._attitude.at(time_ns) or (None, None, None)
            heading_deg = only(self._compass.at(time_ns))
            heading_deg = yaw_deg if heading_deg is None else heading_deg
            east_mps, north_mps = self._velocity.at(time_ns) or (None, None)
            slant_m, height_m = only(self._range.at(time_ns)), only(self._height.at(time_ns))
        above_m = height_m
        if slant_m is not None:  # the beam is fixed to the body
            lean = math.cos(math.radians(roll_deg or 0.0)) * math.cos(math.radians(pitch_deg or 0.0))
            above_m = slant_m * lean
        return Vehicle(
            roll_deg=roll_deg,
            pitch_deg=pitch_deg,
            heading_deg=None if heading_deg is None else heading_deg % 360.0 % 360.0,
            east_velocity_mps=east_mps,
            north_velocity_mps=north_mps,
            height_agl_m=above_m if above_m is not None and above_m > 0.0 else None,
            down_m=None if height_m is None else -height_m,
        )

    def _add(self, series: RecentValues, time_ns: int, *values: float) -> None:
        with self._lock:
            if series.last_ns is not None and time_ns < series.last_ns - _BACK_NS:
                series.clear()
            series.add(time_ns, *values)


class RosBridge:
    """Between the topics of one vehicle and one navigator.

    Args:
        node: publishes, and knows the time.
        site: the map.
        make_navigator: as of :class:`engine.live.Live`.
        options: how fixes are told.
        start: where the flight begins.
        live: deadlines of the frames.
        watch: is told every answer, and must not take long; None tells nobody.
    """

    def __init__(
        self,
        node: RosNode,
        site: OrthoMap,
        make_navigator: Callable[[Prior | None], Navigator],
        options: RosOptions,
        start: Prior | None = None,
        live: LiveOptions | None = None,
        *,
        watch: Callable[[Answer], None] | None = None,
    ) -> None:
        self.telemetry = RosTelemetry()
        self._watch = watch
        self._node, self._site, self._options, self._start = node, site, options, start
        self._make_navigator, self._live_options = make_navigator, live
        self._live = Live(make_navigator, self.deliver, start, live)
        self._last_ns: int | None = None
        self._pictured_s = time.monotonic()
        self._fixes = self._unusable = self._restarts = 0
        self._refused: Counter[str] = Counter()
        self._before = Counts()  # of pipelines that were replaced

    def close(self) -> None:
        """Answer the frame in work."""
        self._live.close()

    @property
    def status(self) -> RosStatus:
        """What was done so far."""
        now, before = self._live.counts, self._before
        counts = Counts(**{name: getattr(now, name) + getattr(before, name) for name in Counts.__slots__})
        return RosStatus(counts, self._fixes, dict(self._refused), self._unusable, self._restarts)

    def handlers(self, topics: Topics) -> dict[str, tuple[str, Handler]]:
        """Type and handler of every topic that is subscribed to."""
        heard, now_ns = self.telemetry, self._node.now_ns
        every: dict[str, tuple[str, Handler]] = {
            topics.image: ("sensor_msgs/msg/Image", self.on_image),
            topics.imu: ("sensor_msgs/msg/Imu", heard.imu),
            topics.compass: ("std_msgs/msg/Float64", lambda m: heard.compass(m.data, now_ns())),
            topics.height: ("std_msgs/msg/Float64", lambda m: heard.height(m.data, now_ns())),
            topics.range: ("sensor_msgs/msg/Range", heard.range),
            topics.velocity: ("geometry_msgs/msg/TwistStamped", heard.velocity),
        }
        return {name: known for name, known in every.items() if name}

    def on_image(self, message: Any) -> None:
        """Take the newest picture; one without a stamp counts as captured now."""
        now_ns = self._node.now_ns()
        captured_ns = stamp_ns(message) or now_ns
        self._pictured_s = time.monotonic()
        if self._last_ns is not None and captured_ns < self._last_ns - _BACK_NS:
            self._begin_again()
        if self._last_ns is not None and captured_ns <= self._last_ns:
            self._unusable += 1
            return
        try:
            frame = self.telemetry.vehicle(captured_ns).frame(picture_of(message), captured_ns)
        except EngineError as error:
            self._unusable += 1
            self._diagnose(captured_ns, _ERROR, str(error), {})
            return
        self._last_ns = captured_ns
        age_ns = max(now_ns - captured_ns, 0)  # a stamp ahead of the clock is taken as now
        self._live.submit(frame, captured_ns=time.monotonic_ns() - age_ns)

    def _begin_again(self) -> None:
        """The time went back: another run of a simulator, or a bag from its beginning."""
        self._live.close()
        self._before = self.status.counts
        self._restarts += 1
        self._live = Live(self._make_navigator, self.deliver, self._start, self._live_options)
        self._last_ns = None

    def deliver(self, answer: Answer) -> None:
        """Publish what became of a frame."""
        captured_ns, result = answer.frame.timestamp_ns, answer.result
        assert captured_ns is not None  # on_image has stamped it
        values = {"method": result.method or "", "age_ms": f"{answer.age_ms:.1f}"}
        if result.score is not None:
            values["score"] = f"{result.score:.3f}"
        if isinstance(result, Fix) and is_finite(result):
            vehicle = self.telemetry.vehicle(captured_ns)
            make = self._node.maker
            self._node.publish("pose", pose(make, result, vehicle, captured_ns, self._site, self._options))
            place = result.lat_deg, result.lon_deg, result.covariance_m2
            self._node.publish("fix", make.position(captured_ns, "base_link", *place))
            self._fixes += 1
            values["sigma_m"] = f"{result.sigma_m:.2f}"
            self._diagnose(captured_ns, _OK, "fix", values)
        else:
            refusal = result if isinstance(result, NoFix) else None
            reason = "not finite" if refusal is None else refusal.reason.value
            self._refused[reason] += 1
            values |= {"reason": reason, "detail": "" if refusal is None else refusal.detail}
            self._diagnose(captured_ns, _WARN, f"no fix: {reason}", values)
        if result.window is not None and self._node.is_wanted("window"):
            shown = window_picture(self._site, result.window, result if isinstance(result, Fix) else None)
            self._node.publish("window", self._node.maker.image(captured_ns, self._options.frame_id, shown))
        if self._watch is not None:
            self._watch(answer)

    def beat(self) -> None:
        """Once a second: say so where no pictures come."""
        silent_s = time.monotonic() - self._pictured_s
        if silent_s > _SILENT_S:
            self._diagnose(self._node.now_ns(), _ERROR, f"no picture for {silent_s:.0f} s", {})

    def _diagnose(self, time_ns: int, level: int, text: str, values: dict[str, str]) -> None:
        status = self.status
        counted = {name: str(count) for name, count in asdict(status.counts).items()}
        counted |= {"fixes": str(status.fixes), "unusable": str(status.unusable)}
        self._node.publish("diagnostics", diagnostics(self._node.maker, time_ns, level, text, values | counted))


def find_class(name: str) -> Any:
    """The class of a name such as "sensor_msgs/msg/Image", out of rospy's or rclpy's message packages."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)
