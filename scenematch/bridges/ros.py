"""The ROS bridge: feed images and telemetry to the engine; publish poses, fixes and diagnostics.

It does not import ROS: it only accesses the fields of messages, which ros1.py and ros2.py transport. A pose is
never published without its covariance; a refusal is published in the diagnostics only. Stamps are capture times.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, Protocol

from engine.errors import EngineError, StateError
from engine.navigation.live import Answer, Counts, Live, LiveOptions
from engine.navigation.navigator import Navigator
from engine.orthomap import OrthoMap
from engine.values import Fix, Frame, NoFix, Prior
from scenematch.bridges.ros_in import RESTART_NS, RosTelemetry, RosTopics
from scenematch.bridges.ros_out import RosOptions, diagnostics, pose
from scenematch.bridges.vehicle import is_finite
from scenematch.files.ros.bags import QUANTITIES
from scenematch.files.ros.messages import MessageFactory, image_from_message, stamp_ns

_log = logging.getLogger("scenematch")

__all__ = ["RosBridge", "RosNode", "RosOptions", "RosStatus", "RosTopics"]

OUTPUTS = {
    "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "fix": "sensor_msgs/msg/NavSatFix",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
"""Message type of each topic that is published."""

_ATTITUDE_WAIT_S = 0.05  # that a picture waits for the next attitude
_MAX_SILENCE_S = 2.0  # without an image, before the diagnostics report it
_OK, _WARN, _ERROR = 0, 1, 2

Handler = Callable[[Any], None]


class RosNode(Protocol):
    """A node of ROS 1 or ROS 2, as seen by the bridge.

    Attributes:
        messages: constructs the messages of this ROS.
    """

    messages: MessageFactory

    def now_ns(self) -> int:
        """ROS time in nanoseconds, simulated if the node is configured so."""

    def wait_for(self, topic: str, msgtype: str, timeout_s: float) -> Any:
        """Wait for the next message of a topic; None after the timeout."""

    def publish(self, output: str, message: Any) -> None:
        """Publish a message of one of :data:`OUTPUTS`."""

    def spin(
        self, handlers: dict[str, tuple[str, Handler]], every_second: Callable[[], None], seconds: float | None
    ) -> None:
        """Subscribe to the topics and call ``every_second`` once a second until shutdown, or for ``seconds``."""


@dataclass(frozen=True, slots=True)
class RosStatus:
    """Counters of a ROS bridge since it was created.

    Attributes:
        counts: of the images submitted, dropped and answered.
        fixes: number of fixes published.
        refused: number of frames without a fix, by reason.
        unusable: number of images that could not be read or came out of order.
        restarts: number of times that ROS time went back and the bridge started over.
    """

    counts: Counts
    fixes: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    unusable: int = 0
    restarts: int = 0

    def line(self) -> str:
        """The same in one line."""
        others = {"unusable": self.unusable, "dropped": self.counts.dropped}
        counts = self.refused | {why: count for why, count in others.items() if count}
        reasons = ", ".join(f"{why} {count}" for why, count in counts.items()) or "nothing"
        again = f"; {self.restarts} restarts" if self.restarts else ""
        return f"{self.counts.submitted} pictures; published {self.fixes}; not published: {reasons}{again}"


class RosBridge:
    """Connects the topics of one vehicle to one navigator.

    Args:
        node: publishes messages and gives the time.
        site: the map.
        make_navigator: see :class:`engine.navigation.live.Live`.
        options: frame and origin of the poses.
        start: prior position at the start of the flight.
        live: deadlines of the frames.
        watch: called with every answer; must return quickly.
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
        self._live = self._start_live()
        self._held = _Held()
        self._image_topic = ""
        self._said: set[str] = set()  # printed to the terminal, each once
        self._last_ns: int | None = None
        self._last_image_s = time.monotonic()
        self._fixes = self._unusable = self._restarts = 0
        self._refused: Counter[str] = Counter()
        self._counts_before: Counts | None = None  # of replaced pipelines

    def close(self) -> None:
        """Answer the frame in progress and stop."""
        self._held.drop()
        self._live.close()

    @property
    def status(self) -> RosStatus:
        """Counters since the bridge was created."""
        now, before = self._live.counts, self._counts_before
        counts = now if before is None else before + now
        return RosStatus(counts, self._fixes, dict(self._refused), self._unusable, self._restarts)

    def handlers(self, topics: RosTopics) -> dict[str, tuple[str, Handler]]:
        """Type and handler of every topic to subscribe to, by name."""
        self._image_topic = topics.image
        handlers: dict[str, tuple[str, Handler]] = {
            topics.image: (topics.image_type, self.on_image),
            topics.imu: (QUANTITIES["imu"].type, self.on_imu),
        }
        for name in ("compass", "height", "range", "velocity", "odometry"):
            handlers[getattr(topics, name)] = (QUANTITIES[name].type, partial(self._store, name))
        return {topic: handler for topic, handler in handlers.items() if topic}

    def _store(self, name: str, message: Any) -> None:
        self.telemetry.add(name, message, self._node.now_ns())

    def on_imu(self, message: Any) -> None:
        """Store an attitude, and submit the picture that waited for it."""
        self._store("imu", message)
        self._held.release(lambda captured_ns: not self.telemetry.waits_for_attitude(captured_ns))

    def on_image(self, message: Any) -> None:
        """Submit the newest picture once its attitude is known; one without a stamp counts as captured now."""
        now_ns = self._node.now_ns()
        captured_ns = stamp_ns(message) or now_ns
        self._last_image_s = time.monotonic()
        if self._last_ns is not None and captured_ns < self._last_ns - RESTART_NS:
            self._restart()
        if self._last_ns is not None and captured_ns <= self._last_ns:
            self._unusable += 1
            return
        try:
            image = image_from_message(message)
        except EngineError as error:
            self._unusable += 1
            self._say("unusable", f"a picture cannot be used: {error}")
            self._diagnose(captured_ns, _ERROR, str(error), {})
            return
        self._last_ns = captured_ns

        def submit() -> None:
            frame = self.telemetry.vehicle(captured_ns).frame(image, captured_ns)
            with contextlib.suppress(StateError):  # closed in the meantime
                # A stamp in the future counts as now.
                self._live.submit(frame, captured_ns=min(captured_ns, now_ns))

        if self.telemetry.waits_for_attitude(captured_ns):
            self._held.hold(captured_ns, submit)
        else:
            self._held.drop()  # an older picture, overtaken by this one
            submit()

    def _start_live(self) -> Live:
        return Live(self._make_navigator, self.deliver, self._start, self._live_options, self._node.now_ns)

    def _restart(self) -> None:
        """Start over because time went back: a simulator or a bag was restarted."""
        self._held.drop()
        self._live.close()
        self._counts_before = self.status.counts
        self._restarts += 1
        self._live = self._start_live()
        self._last_ns = None

    def deliver(self, answer: Answer) -> None:
        """Publish the answer to a frame."""
        captured_ns, result = answer.frame.timestamp_ns, answer.result
        assert captured_ns is not None  # set by on_image
        values = {"method": result.method or "", "age_ms": f"{answer.age_ms:.1f}", **_known(answer.frame)}
        if result.score is not None:
            values["score"] = f"{result.score:.3f}"
        if isinstance(result, Fix) and is_finite(result):
            vehicle = self.telemetry.vehicle(captured_ns)
            messages = self._node.messages
            self._node.publish("pose", pose(messages, result, vehicle, captured_ns, self._site, self._options))
            position = result.lat_deg, result.lon_deg, result.covariance_m2
            self._node.publish("fix", messages.position(captured_ns, "base_link", *position))
            self._fixes += 1
            values["sigma_m"] = f"{result.sigma_m:.2f}"
            self._diagnose(captured_ns, _OK, "fix", values)
        else:
            refusal = result if isinstance(result, NoFix) else None
            reason = "not finite" if refusal is None else refusal.reason.value
            self._refused[reason] += 1
            values |= {"reason": reason, "detail": "" if refusal is None else refusal.detail}
            self._say(reason, f"first frame without a fix for this reason: {reason}; {values['detail']}")
            self._diagnose(captured_ns, _WARN, f"no fix: {reason}", values)
        if self._watch is not None:
            self._watch(answer)

    def check_input(self) -> None:
        """Publish an error if no images arrive; call it once a second."""
        silence_s = time.monotonic() - self._last_image_s
        if silence_s > _MAX_SILENCE_S:
            doubt = "does anything publish this topic with this type?"
            self._say("no picture", f"no picture on {self._image_topic}: {doubt}")
            self._diagnose(self._node.now_ns(), _ERROR, f"no picture for {silence_s:.0f} s", {})

    def _say(self, cause: str, text: str) -> None:
        """Print a line once for each cause; the diagnostics repeat it each time."""
        if cause not in self._said:
            self._said.add(cause)
            _log.warning("%s (more in /diagnostics)", text)

    def _diagnose(self, time_ns: int, level: int, text: str, values: dict[str, str]) -> None:
        status = self.status
        counters = {name: str(count) for name, count in asdict(status.counts).items()}
        counters |= {"fixes": str(status.fixes), "unusable": str(status.unusable)}
        message = diagnostics(self._node.messages, time_ns, level, text, values | counters)
        self._node.publish("diagnostics", message)


def _known(frame: Frame) -> dict[str, str]:
    """The telemetry that a frame had: a misnamed topic would go unnoticed."""
    values = {"attitude": frame.heading_deg, "height": frame.height_agl_m, "velocity": frame.east_velocity_mps}
    return {name: "unknown" if value is None else "known" for name, value in values.items()}


class _Held:
    """Holds at most one picture until its attitude arrives, for a limited time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: tuple[int, Callable[[], None], threading.Timer] | None = None

    def hold(self, captured_ns: int, submit: Callable[[], None]) -> None:
        """Hold a picture; one that was still waiting is submitted as it is."""
        self.release(lambda _: True)
        timer = threading.Timer(_ATTITUDE_WAIT_S, self.release, [lambda waiting_ns: waiting_ns == captured_ns])
        timer.daemon = True
        with self._lock:
            self._waiting = (captured_ns, submit, timer)
        timer.start()

    def release(self, may_go: Callable[[int], bool]) -> None:
        """Submit the picture if ``may_go`` accepts its capture time."""
        with self._lock:
            waiting = self._waiting
            if waiting is None or not may_go(waiting[0]):
                return
            self._waiting = None
        waiting[2].cancel()
        waiting[1]()

    def drop(self) -> None:
        """Forget the picture."""
        with self._lock:
            waiting, self._waiting = self._waiting, None
        if waiting is not None:
            waiting[2].cancel()


def find_class(name: str) -> Any:
    """The message class of a name such as "sensor_msgs/msg/Image", imported from ROS."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def topic_of(output: str, own: str) -> str:
    """The name of an output's topic; ``own`` is what a node's own names begin with."""
    return "/diagnostics" if output == "diagnostics" else f"{own}{output}"
