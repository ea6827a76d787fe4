"""The shutter of a simulated camera: what blurs and shears is what optics and geometry say."""

import numpy as np
import pytest

from bench.accuracy.shutter import Shutter, ShutterFlight, row_rays
from engine import Attitude
from scenematch.simulator import FlightStyle, plan_flight
from tests.simulator.test_sim_camera import snap
from tests.support.patches import CAMERA, ORIGIN, TO_CRS, TO_GRID, centre_of_bright, patch_world, project

LEVEL, STILL = Attitude(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


def swayed(world, shutter, velocity_mps=STILL, turn_dps=STILL, attitude=LEVEL, grid=ORIGIN):
    """A picture from 150 m."""
    moments = row_rays(CAMERA, attitude, 150.0, shutter, velocity_mps, turn_dps)
    return snap(world, CAMERA, moments, attitude, grid=grid)


def spread(image: np.ndarray) -> np.ndarray:
    """Variance in x and y of a bright patch, in square pixels."""
    weight = np.clip(image[..., 1].astype(float) - 40.5, 0.0, None)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([np.average((v - np.average(v, weights=weight)) ** 2, weights=weight) for v in (x, y)])


def test_motion_blur_is_as_long_as_the_way_flown():
    world = patch_world(600, 600, 0.0)
    sharp, shutter = snap(world), Shutter(exposure_ms=50.0, exposure_samples=15)
    blurred = swayed(world, shutter, (50.0, 0.0, 0.0))  # 2.5 m east: 4.33 px
    np.testing.assert_allclose(centre_of_bright(blurred), centre_of_bright(sharp), atol=0.05)
    length = 259.81 * 2.5 / 150.0
    np.testing.assert_allclose(spread(blurred) - spread(sharp), (length**2 / 12.0, 0.0), atol=0.3)
    turned = swayed(world, shutter, turn_dps=(0.0, 20.0, 0.0))  # nose up by 1 degree
    length = 259.81 * np.radians(1.0)
    np.testing.assert_allclose(spread(turned) - spread(sharp), (0.0, length**2 / 12.0), atol=0.35)


@pytest.mark.parametrize("row", [320, 880])
def test_each_row_of_a_rolling_shutter_is_seen_from_where_the_camera_then_is(row):
    world = patch_world(600, row, 0.0)
    position = np.array([ORIGIN[0] + 6.3, ORIGIN[1] - 11.7])
    velocity, turn, attitude = (30.0, -20.0, 4.0), (20.0, -10.0, 40.0), Attitude(2.0, -1.0, 5.0)
    seen = centre_of_bright(swayed(world, Shutter(readout_ms=60.0), velocity, turn, attitude, tuple(position)))
    after_s = (seen[1] / 299.0 - 0.5) * 0.06
    way = TO_GRID @ velocity[:2] * after_s  # of the camera until that moment
    then = Attitude(2.0 + 20.0 * after_s, -1.0 - 10.0 * after_s, 5.0 + 40.0 * after_s)
    expected = project(CAMERA, TO_CRS @ (600, row, 1.0), 0.0, position + way, 150.0 + 4.0 * after_s, then)
    np.testing.assert_allclose(seen, expected, atol=0.25)
    still = centre_of_bright(swayed(world, Shutter(), velocity, turn, attitude, tuple(position)))
    assert np.abs(still - expected).max() > 0.8


def test_a_planned_flight_moves_while_its_shutter_is_open(sim_town):
    still = plan_flight(1, town=sim_town, style=FlightStyle(height_agl_m=90.0), rate_hz=0.5)
    blurred = ShutterFlight.of(still, Shutter(exposure_ms=30.0, readout_ms=30.0))
    sways = [blurred.sway(k) for k in range(len(blurred))]
    speed = np.linalg.norm([velocity for velocity, _ in sways], axis=1)
    np.testing.assert_allclose(speed, np.linalg.norm(blurred.truth.velocity_mps, axis=1), atol=1e-6)
    assert 1.0 < np.abs([turn for _, turn in sways]).max() < 90.0
    seen, stated = next(blurred.iter_frames()), next(still.iter_frames())
    assert seen.heading_deg == stated.heading_deg
    assert not np.array_equal(seen.image, stated.image)
