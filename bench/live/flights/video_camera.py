"""The camera of a simulated vehicle that shows a recorded video, from where the vehicle is.

``python -m bench.live.flights.video_camera FLIGHT --hfov-deg DEG [--link udpin:127.0.0.1:14551]`` writes JPEG
pictures to its standard output, for ``--camera-source exec:``. FLIGHT is a video with DJI's ``.SRT`` beside it, or
a flight folder with its ``flight.mp4``. ArduPilot's simulator (SITL) sends SIM_STATE, its true state; each picture
is the frame of the video that was taken nearest to there, moved, turned and scaled over level ground by what is
left. The camera looks straight down whatever the vehicle does, as one on a gimbal. Only the middle of a frame is
shown, so that it can be moved by the rest.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.quaternion import QuaternionBase

from bench.live.flights.recorded import recorded
from bench.live.standin import State
from engine.geo import Array, LocalFrame

_STATES = ("SIM_STATE", "HIL_STATE_QUATERNION")  # of ArduPilot and of PX4
SIZE = (640, 400)
"""Of the pictures; 852 x 480 of the video leave 106 and 40 pixels on either side."""


def ground_from_pixel(state: State, size: tuple[int, int], focal_px: float) -> Array:
    """(2, 3) from a pixel of a camera that looks straight down, its top to the heading, to metres east, north."""
    metres = state.height_m / focal_px
    heading = math.radians(state.heading_deg)
    right = np.array([math.cos(heading), -math.sin(heading)]) * metres
    down = np.array([-math.sin(heading), -math.cos(heading)]) * metres
    centre = np.array([(size[0] - 1) / 2.0, (size[1] - 1) / 2.0])
    origin = np.array([state.east_m, state.north_m]) - centre[0] * right - centre[1] * down
    return np.column_stack([right, down, origin])


def recorded_from_shown(frame: State, frame_size: tuple[int, int], vehicle: State, focal_px: float) -> Array:
    """(2, 3) from a pixel of the picture that is shown to that of the frame that was taken there."""
    shown, taken = ground_from_pixel(vehicle, SIZE, focal_px), ground_from_pixel(frame, frame_size, focal_px)
    inverse = np.linalg.inv(taken[:, :2])
    return np.column_stack([inverse @ shown[:, :2], inverse @ (shown[:, 2] - taken[:, 2])])


class Footage:
    """A video's frames, one in so many, with where each was taken."""

    def __init__(self, flight: Path, hfov_deg: float, every: int = 3) -> None:
        motion, self.place, _ = recorded(flight)
        capture = cv2.VideoCapture(str(flight / "flight.mp4" if flight.is_dir() else flight))
        rate_hz, self._jpegs, self.states, index = capture.get(cv2.CAP_PROP_FPS), [], [], 0
        while capture.grab():
            if index % every == 0:
                image = capture.retrieve()[1]
                self._jpegs.append(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
                self.states.append(motion(index / rate_hz))
            index += 1
        self.size = (image.shape[1], image.shape[0])
        self.focal_px = self.size[0] / 2.0 / math.tan(math.radians(hfov_deg) / 2.0)
        self.hfov_deg = math.degrees(2.0 * math.atan(SIZE[0] / 2.0 / self.focal_px))  # of the pictures shown
        self._noise = np.random.default_rng(1)  # a vehicle on the ground would else send one picture for ever

    def picture(self, vehicle: State) -> NDArray[np.uint8]:
        """What the camera of a vehicle sees; black where the video did not look."""
        away_m = [math.hypot(s.east_m - vehicle.east_m, s.north_m - vehicle.north_m) for s in self.states]
        nearest = int(np.argmin(away_m))
        image = cv2.imdecode(self._jpegs[nearest], cv2.IMREAD_COLOR)
        warp = recorded_from_shown(self.states[nearest], self.size, vehicle, self.focal_px)
        shown = cv2.warpAffine(image, warp, SIZE, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        return cv2.add(shown, self._noise.integers(0, 3, shown.shape, np.uint8))


def state_of(message: Any, place: LocalFrame, ground_alt_m: float) -> State:
    """The vehicle of a SIM_STATE (ArduPilot) or HIL_STATE_QUATERNION (PX4) about a place."""
    if message.get_type() == "HIL_STATE_QUATERNION":
        east_m, north_m = place.enu_from_geodetic(message.lat * 1e-7, message.lon * 1e-7)[:2]
        angles = [math.degrees(angle) for angle in QuaternionBase(message.attitude_quaternion).euler]
        height_m = max(message.alt * 1e-3 - ground_alt_m, 0.5)
        return State(float(east_m), float(north_m), height_m, *angles, message.vy * 1e-2, message.vx * 1e-2)
    east_m, north_m = place.enu_from_geodetic(message.lat_int * 1e-7, message.lon_int * 1e-7)[:2]
    angles = [math.degrees(angle) for angle in (message.roll, message.pitch, message.yaw)]
    return State(
        float(east_m), float(north_m), max(message.alt - ground_alt_m, 0.5), *angles, message.ve, message.vn
    )


class View(Protocol):
    """What a vehicle's camera sees."""

    place: LocalFrame

    def picture(self, vehicle: State) -> NDArray[np.uint8]:
        """(H, W, 3) BGR."""


def film(view: View, link: Any, out: BinaryIO, rate_hz: float, delay_s: float, ground_alt_m: float) -> None:
    """Write pictures until nobody reads them, each ``delay_s`` after the state that it shows has come.

    A picture that this machine did not draw by then is left out: its age would be unknown.
    """
    while link.recv_match(type=_STATES) is not None:  # states of the time in which nobody read
        pass
    due_s = 0.0
    while True:
        message = link.recv_match(type=["HEARTBEAT", *_STATES], blocking=True)
        now_s = time.monotonic()
        if message.get_type() == "HEARTBEAT":
            for number in (mavlink.MAVLINK_MSG_ID_SIM_STATE, mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION):
                interval = (number, 20_000, 0, 0, 0, 0, 0)
                link.mav.command_long_send(1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, *interval)
            continue
        if now_s < due_s:
            continue
        while (newer := link.recv_match(type=_STATES)) is not None:  # what came while the last one was drawn
            message = newer
        due_s = now_s + 1.0 / rate_hz - 0.01
        picture = view.picture(state_of(message, view.place, ground_alt_m))
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
        if (wait_s := now_s + delay_s - time.monotonic()) >= 0.0:
            time.sleep(wait_s)
            out.write(jpeg)
            out.flush()


def main() -> None:
    """Film until the pipe is closed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--hfov-deg", type=float, required=True, help="of the video")
    parser.add_argument("--link", default="udpin:127.0.0.1:14551")
    parser.add_argument("--rate-hz", type=float, default=10.0)
    parser.add_argument("--ground-alt-m", type=float, default=0.0, help="above sea level, as in SITL's --home")
    parser.add_argument("--delay-ms", type=float, default=60.0, help="from the state to the picture")
    arguments = parser.parse_args()
    footage = Footage(arguments.flight, arguments.hfov_deg)
    print(f"pictures of {SIZE[0]} x {SIZE[1]}, --hfov-deg {footage.hfov_deg:.2f}", file=sys.stderr, flush=True)
    link = mavutil.mavlink_connection(arguments.link, source_system=250)
    pace = (arguments.rate_hz, arguments.delay_ms * 1e-3)
    with contextlib.suppress(BrokenPipeError):
        film(footage, link, sys.stdout.buffer, *pace, arguments.ground_alt_m)


if __name__ == "__main__":
    main()
