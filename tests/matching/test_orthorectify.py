"""The whole frame in the map's pixels: every pixel is where the camera's own projection puts it."""

import math

import cv2
import numpy as np
import pytest

from engine import Attitude, Camera
from engine.geo import enu_from_body
from engine.matching.align import MAX_FIELD_DEG, SIDE_STEP_PX, ground_bounds_px, orthorectify, view_of

CAMERA = Camera.from_fov(320, 240, 60.0)
JACOBIAN = np.diag([0.5, -0.5])
GRAY = np.random.default_rng(1).integers(0, 255, (240, 320), dtype=np.uint8)


def projected(attitude, height_m, offsets_px, up_m=0.0):
    """Pixels (N, 2) of ground points at offsets from the nadir, in map pixels."""
    turn = enu_from_body(attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg) @ CAMERA.mount
    points = np.column_stack([offsets_px @ JACOBIAN.T, np.full(len(offsets_px), up_m) - height_m]) @ turn
    return (points @ CAMERA.matrix.T / points[:, 2:])[:, :2]


def places(photo, count=200):
    """Valid pixels (N, 2) of an orthophoto."""
    rows, columns = np.nonzero(photo.valid)
    some = np.random.default_rng(2).integers(0, len(rows), count)
    return np.column_stack([columns, rows])[some].astype(np.float64)


@pytest.mark.parametrize(
    ("attitude", "within_px"),
    [
        (Attitude(0, 0, 0), 0.01),
        (Attitude(8, -5, 137), 0.2),
        (Attitude(0, 45, 20), 2.5),
        (Attitude(-20, 40, 290), 2.5),
    ],
)
def test_a_pixel_comes_from_where_its_ground_point_is_seen(attitude, within_px):
    """Between the nodes of the grid it is interpolated: what is drawn there comes from there all the same."""
    photo = orthorectify(GRAY, CAMERA, attitude, 120.0, JACOBIAN)
    at = places(photo)
    seen = projected(attitude, 120.0, at + photo.offset_px)
    assert np.abs(photo.to_frame(at) - seen).max() < within_px
    assert (photo.to_frame(at) >= 0).all()
    assert (photo.to_frame(at) <= [319, 239]).all()
    drawn = photo.gray[tuple(at[:, ::-1].astype(int).T)].astype(float)
    x, y = photo.to_frame(at).astype(np.float32).T
    assert np.abs(cv2.remap(GRAY, x, y, cv2.INTER_LINEAR).ravel() - drawn).max() <= 8.0


def test_over_a_plateau_it_is_drawn_as_from_so_much_lower():
    attitude = Attitude(3.0, -4.0, 33.0)
    photo = orthorectify(GRAY, CAMERA, attitude, 120.0, JACOBIAN, lambda px: np.full(px.shape[:-1], 30.0))
    at = places(photo)
    assert np.abs(photo.to_frame(at) - projected(attitude, 120.0, at + photo.offset_px, up_m=30.0)).max() < 0.1


def test_its_sides_are_in_steps_and_it_holds_the_footprint_of_a_near_vertical_view():
    attitude = Attitude(2.0, 3.0, 77.0)
    photo, view = orthorectify(GRAY, CAMERA, attitude, 120.0, JACOBIAN), view_of(CAMERA, attitude, 120.0, JACOBIAN)
    extent_px = np.ptp(ground_bounds_px(CAMERA, attitude, 120.0, JACOBIAN), axis=0)[::-1]
    assert (np.array(photo.gray.shape) % SIDE_STEP_PX == 0).all()
    assert (np.abs(np.array(photo.gray.shape) - extent_px - 1 - SIDE_STEP_PX / 2) <= SIDE_STEP_PX / 2).all()
    rim_px = 4.2 * math.sqrt(view.area_px) * 5 * math.sqrt(2)  # its length, and how wide it is along a diagonal
    assert view.area_px - rim_px <= photo.valid.sum() <= view.area_px


@pytest.mark.parametrize("pitch_deg", [30.0, 45.0, 60.0])
def test_of_an_oblique_frame_the_far_field_is_cut(pitch_deg):
    attitude = Attitude(0.0, pitch_deg, 10.0)
    photo = orthorectify(GRAY, CAMERA, attitude, 60.0, JACOBIAN)
    away_m = np.hypot(*((places(photo) + photo.offset_px) @ JACOBIAN.T).T)
    assert away_m.max() <= 60.0 * math.tan(math.radians(MAX_FIELD_DEG + 1.0))
    bounds = ground_bounds_px(CAMERA, attitude, 60.0, JACOBIAN)
    assert np.abs(bounds).max() * 0.5 <= 60.0 * math.tan(math.radians(MAX_FIELD_DEG)) + 0.5


def test_what_looks_at_the_horizon_or_covers_next_to_nothing_is_not_drawn():
    assert orthorectify(GRAY, CAMERA, Attitude(0.0, MAX_FIELD_DEG, 0.0), 60.0, JACOBIAN) is None
    assert orthorectify(GRAY, CAMERA, Attitude(0.0, 100.0, 0.0), 60.0, JACOBIAN) is None
    assert orthorectify(GRAY, CAMERA, Attitude(0.0, 0.0, 0.0), 3.0, JACOBIAN) is None
    assert orthorectify(GRAY, CAMERA, Attitude(0.0, 0.0, 0.0), 1e6, JACOBIAN) is None
