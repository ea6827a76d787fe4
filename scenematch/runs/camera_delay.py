"""Measure a camera's latency by comparing its pictures with the autopilot's attitude."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import closing
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from engine.errors import OptionError, TelemetryError, require
from engine.options import NavigatorOptions
from engine.values import Frame, NoFix, Reason
from scenematch.bridges.camera_lag import Lag, camera_lag, turn_between
from scenematch.bridges.pictures import CapturedImage, capture
from scenematch.runs.cameras import CameraInput
from scenematch.runs.mavlink_bridge import MavlinkSettings, open_bridge
from scenematch.runs.output import SILENT, Progress

if TYPE_CHECKING:
    from scenematch.bridges.mavlink_in import MavlinkTelemetry

_SAMPLE_NS = 20_000_000  # of the attitude
_SETTLED_NS = 200_000_000  # after which no older attitude arrives


class _Idle:
    """A navigator that does nothing: the bridge is opened only for its telemetry."""

    options = NavigatorOptions()

    def update(self, frame: Frame, prior: object = None, budget: object = None) -> NoFix:
        return NoFix(reason=Reason.NO_TEXTURE, timestamp_ns=frame.timestamp_ns)


def measure_camera_delay(
    link: MavlinkSettings,
    camera: CameraInput,
    camera_source: str,
    *,
    seconds: float | None = None,
    progress: Progress = SILENT,
) -> Lag:
    """The time from exposure to grab, while the vehicle is tilted to and fro by hand over a textured ground.

    Args:
        link: the autopilot, as for the bridge.
        camera: a calibration, or a field of view.
        camera_source: as for the bridge.
        seconds: how long to take pictures, 5 or more; None is 20.
        progress: receives instructions for the user.

    Raises:
        OptionError: neither or both of calibration and field of view are given.
        BackendError: the link cannot be opened.
        TelemetryError: the camera does not open, or its pictures do not agree with the attitude.
    """
    require("pymavlink", "mavlink")
    seconds = 20.0 if seconds is None else seconds
    if not 5.0 <= seconds < math.inf:
        raise OptionError(f"seconds: expected 5 or more, got {seconds:g}")
    if camera.camera is None and camera.hfov_deg is None:
        raise OptionError("camera: expected a calibration, or `hfov_deg`")
    model = camera.load_live(camera_source, progress=progress)
    idle: Any = _Idle()
    bridge = open_bridge(link, lambda _: idle)
    progress.message(f"tilt the vehicle to and fro by some 10 degrees for {seconds:g} s, over textured ground")
    with bridge, closing(capture(camera_source)) as pictures:
        times_s, turns_rad, attitude = _recorded(bridge.telemetry, pictures, model.focal_px, seconds)
    if not attitude:
        raise TelemetryError(
            f"connect: expected an autopilot that reports its attitude, got none on {link.connect}"
        )
    return camera_lag(np.array(times_s), np.array(turns_rad), np.array(attitude), model.mount)


def _recorded(
    telemetry: MavlinkTelemetry, pictures: Iterator[CapturedImage | None], focal_px: float, seconds: float
) -> tuple[list[float], list[float], list[tuple[float, float, float, float]]]:
    """Arrival times of pictures, the turns between them, and samples of the attitude."""
    times_s, turns_rad, attitude, before = [], [], [], None
    begin_ns = next_ns = time.monotonic_ns()
    for picture in pictures:
        now_ns = time.monotonic_ns()
        while next_ns < now_ns - _SETTLED_NS:
            known = telemetry.vehicle(next_ns).attitude
            if known is not None:
                attitude.append((next_ns * 1e-9, known.roll_deg, known.pitch_deg, known.heading_deg))
            next_ns += _SAMPLE_NS
        if picture is not None:
            gray = np.asarray(cv2.cvtColor(picture[0], cv2.COLOR_RGB2GRAY), np.uint8)
            if before is not None:
                turns_rad.append(turn_between(before, gray, focal_px))
            before = gray
            times_s.append(picture[1] * 1e-9)
        if (now_ns - begin_ns) * 1e-9 > seconds:
            break
    return times_s, turns_rad, attitude
