"""camera.py: undistortion against OpenCV, mounts, other sizes of frames; files in test_calibration_files."""

import math

import cv2
import numpy as np
import pytest

from engine.camera import MOUNTS, Camera, mount_rotation
from engine.errors import CalibrationError
from tests.support.refusals import refusal

K = [500.0, 0.0, 319.5, 0.0, 505.0, 239.5, 0.0, 0.0, 1.0]
PLUMB_BOB = [-0.28, 0.09, 0.0007, -0.0004, -0.01]
FISHEYE = [0.03, -0.012, 0.004, -0.001]
RATIONAL = [0.2, 0.05, 0.0005, -0.0003, 0.01, 0.45, 0.1, 0.02]
LENSES = {"plumb_bob": PLUMB_BOB, "rational_polynomial": RATIONAL, "equidistant": FISHEYE, "fisheye": FISHEYE}


def camera(model="plumb_bob", distortion=PLUMB_BOB):
    return Camera(640, 480, np.reshape(K, (3, 3)), model, np.array(distortion))


def texture(shape=(480, 640, 3)):
    return cv2.GaussianBlur(np.random.default_rng(5).integers(0, 256, shape, dtype=np.uint8), (0, 0), 3.0)


def test_focal_length_from_the_field_of_view_is_the_papers():
    paper = Camera.from_fov(300, 300, 60.0)
    assert paper.focal_px == pytest.approx(150.0 / math.tan(math.radians(30.0)))
    assert paper.matrix[0, 2] == paper.matrix[1, 2] == 149.5
    assert not paper.distorts


@pytest.mark.parametrize("fov_deg", [0.0, 180.0, -5.0, float("nan")])
def test_an_impossible_field_of_view_is_refused(fov_deg):
    assert "fov_deg" in refusal(Camera.from_fov, 300, 300, fov_deg, error=CalibrationError)


@pytest.mark.parametrize("shape", [(480, 640), (480, 640, 3)])
@pytest.mark.parametrize("model", LENSES)
def test_undistortion_is_opencvs(model, shape):
    image, lens = texture(shape), camera(model, LENSES[model])
    if model in ("equidistant", "fisheye"):
        expected = cv2.fisheye.undistortImage(image, lens.matrix, lens.distortion, Knew=lens.matrix)
    else:
        expected = cv2.undistort(image, lens.matrix, lens.distortion)
    np.testing.assert_allclose(lens.undistort(image).astype(int), expected, atol=1)


@pytest.mark.parametrize("model", LENSES)
def test_the_rays_of_pixels_lead_back_to_them_in_every_corner(model):
    lens = camera(model, LENSES[model])
    xy_px = np.array([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0], [320.0, 240.0]])
    flat, zero = lens.undistort_points(xy_px), np.zeros(3)
    rays = np.column_stack([flat, np.ones(len(flat))])[:, None]
    opencvs = cv2.fisheye if model in ("equidistant", "fisheye") else cv2
    again, _ = opencvs.projectPoints(rays, zero, zero, lens.matrix, lens.distortion)
    assert again.reshape(-1, 2) == pytest.approx(xy_px, abs=1e-3)


# -------------------------------------------------------------------------------------------------- mounts

DOWN, NOSE, RIGHT, TAIL, LEFT = [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]


@pytest.mark.parametrize(
    ("name", "axis", "top"),
    [
        ("nadir", DOWN, NOSE),
        ("nadir-right", DOWN, RIGHT),
        ("nadir-tail", DOWN, TAIL),
        ("nadir-left", DOWN, LEFT),
        ("forward-45", [math.sqrt(0.5), 0, math.sqrt(0.5)], [math.sqrt(0.5), 0, -math.sqrt(0.5)]),
    ],
)
def test_a_mount_by_name_says_where_axis_and_top_point(name, axis, top):
    mount = mount_rotation(name)
    assert np.linalg.det(mount) == pytest.approx(1.0)
    assert np.allclose(mount @ [0, 0, 1], axis)
    assert np.allclose(mount @ [0, -1, 0], top)


@pytest.mark.parametrize("name", [name for name in MOUNTS if name.startswith("nadir")])
def test_pitch_turns_the_axis_up_towards_the_top_of_the_picture(name):
    top = mount_rotation(name) @ [0, -1, 0]
    axis = mount_rotation(name, -60.0) @ [0, 0, 1]
    assert np.allclose(axis, math.sin(math.radians(60.0)) * np.array(DOWN) + 0.5 * top)
    assert np.allclose(mount_rotation(name, -90.0), mount_rotation(name))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("front",), "mount: expected one of nadir, nadir-right"),
        (("nadir", 30.0), "camera_pitch_deg: expected -90"),
        (("nadir", -91.0), "camera_pitch_deg: expected -90"),
        (("nadir", math.nan), "camera_pitch_deg: expected -90"),
        (("forward-45", -60.0), "camera_pitch_deg: expected none with the mount forward-45"),
    ],
)
def test_a_mount_that_is_none_is_refused(arguments, words):
    assert words in refusal(mount_rotation, *arguments, error=CalibrationError)


# ------------------------------------------------------------------------------------------- another frame size


@pytest.mark.parametrize("size", [(320, 240), (1280, 960), (213, 160)])
def test_a_scaled_camera_sees_the_same_through_the_same_place_of_its_frame(size):
    lens = camera()
    scaled = lens.scaled_to(*size)
    assert (scaled.width_px, scaled.height_px) == size
    np.testing.assert_array_equal(scaled.distortion, lens.distortion)
    np.testing.assert_array_equal(scaled.mount, lens.mount)
    assert np.allclose(scaled.frame_rays, lens.frame_rays, atol=1e-12)
    assert np.allclose(lens.scaled_to(*size).scaled_to(640, 480).matrix, lens.matrix)
