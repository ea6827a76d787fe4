"""The camera of a simulated vehicle over a drawn town.

``python -m bench.live.flights.town_camera FLIGHT PIPE FAULT_FILE`` draws the town of a flight as seen from SITL's
true state, and writes JPEG pictures like :mod:`bench.live.flights.video_camera` to a named pipe, for
``--camera-source "exec:cat PIPE"``. While FAULT_FILE names a fault, the picture is covered, frozen, or taken 40 m
further east, as if the map were shifted.
"""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pymavlink import mavutil

from bench.live.flights.faults import reigning
from bench.live.flights.recorded import recorded
from bench.live.flights.video_camera import film
from bench.live.standin import State
from engine.values import Attitude
from scenematch.simulator import build_town, render_frame
from scenematch.simulator.flight import DRONE_SENSOR, grid_at, paper_camera

SHIFT_M = 40.0


class TownView:
    """What a camera fixed to the vehicle sees of a town."""

    def __init__(self, flight: Path, town: int, fault_file: Path) -> None:
        self.place, self._fault_file = recorded(flight)[1], fault_file
        self._town, self._camera = build_town(town), paper_camera()
        # A colour for each ray must do: several cannot be drawn in time at a tilt of 30 degrees.
        self._world = replace(self._town.world, rgb=np.asarray(cv2.blur(self._town.world.rgb, (3, 3)), np.uint8))
        self._roof_m = float(self._town.world.height_m.max())
        self._noise, self._last = np.random.default_rng(1), np.zeros((300, 300, 3), np.uint8)

    def picture(self, vehicle: State) -> NDArray[np.uint8]:
        """(H, W, 3) BGR; among the roofs only noise."""
        fault = reigning(self._fault_file)
        if fault == "camera covered":
            return np.zeros_like(self._last)
        if fault == "picture frozen":
            return self._last
        if fault == "map shifted":
            vehicle = replace(vehicle, east_m=vehicle.east_m + SHIFT_M)
        if vehicle.height_m <= self._roof_m + 1.0:
            return self._noise.integers(0, 30, self._last.shape, np.uint8)
        where = np.array([vehicle.east_m, vehicle.north_m, vehicle.height_m])
        attitude = Attitude(vehicle.roll_deg, vehicle.pitch_deg, vehicle.heading_deg % 360.0)
        grid = grid_at(self._town, self.place, where)
        sharp = render_frame(self._world, self._camera, grid, vehicle.height_m, attitude, supersample=1)
        seen = self._town.condition.sensor(DRONE_SENSOR).develop(sharp, self._noise)
        self._last = np.asarray(cv2.cvtColor(seen, cv2.COLOR_RGB2BGR), np.uint8)
        return self._last


def main() -> None:
    """Film for one reader of the pipe after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("pipe", type=Path)
    parser.add_argument("fault_file", type=Path)
    parser.add_argument("--town", type=int, default=1)
    parser.add_argument("--link", default="udpin:127.0.0.1:14551")
    parser.add_argument("--delay-ms", type=float, default=100.0, help="from the state to the picture")
    parser.add_argument("--ground-alt-m", type=float, default=0.0, help="above sea level, as in SITL's --home")
    arguments = parser.parse_args()
    view = TownView(arguments.flight, arguments.town, arguments.fault_file)
    link = mavutil.mavlink_connection(arguments.link, source_system=250)
    while True:
        with contextlib.suppress(BrokenPipeError), arguments.pipe.open("wb") as out:
            film(view, link, out, 10.0, arguments.delay_ms * 1e-3, arguments.ground_alt_m)


if __name__ == "__main__":
    main()
