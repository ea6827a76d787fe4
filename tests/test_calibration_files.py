"""Calibrations: camera_info, and as OpenCV's FileStorage, Kalibr's camchain and ROS's messages have them."""

from functools import partial

import cv2
import numpy as np
import pytest
import yaml

from engine.camera import Camera, mount_rotation
from engine.errors import CalibrationError
from scenematch.files.flight import camera_info
from tests.support.refusals import refusal

K = np.array([[500.0, 0.0, 319.5], [0.0, 505.0, 239.5], [0.0, 0.0, 1.0]])
MATRIX = str(K.ravel().tolist())
PLUMB_BOB = [-0.28, 0.09, 0.0007, -0.0004, -0.01]
DIGITS = np.array([-0.28, 0.09, 0.0007, -4e-20, -0.01])
FISHEYE = np.array([0.03, -0.012, 0.004, -0.001])
SAMPLES = {"image_width": 640, "image_height": 480, "camera_matrix": K, "distortion_coefficients": DIGITS}

INFO = f"""\
image_width: 640
image_height: 480
camera_name: nadir
camera_matrix:
  rows: 3
  cols: 3
  data: {MATRIX}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {PLUMB_BOB}
"""

# As kalibr_calibrate_cameras wrote it of one fisheye lens.
KALIBR = """\
cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.037616380662515145, -0.01017328830844074, 0.0021156274599045564, -0.00041016163581791436]
  distortion_model: equidistant
  intrinsics: [348.9572868848721, 351.98561676978676, 356.0925444657544, 238.4353424788532]
  resolution: [720, 540]
  rostopic: /cam_1
"""


def opencvs(path, **content):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in content.items():
        storage.write(name, value)
    storage.release()
    return path


@pytest.fixture
def save(save):
    return partial(save, name="camera.yaml")


def test_reads_camera_info_with_the_default_mount(save):
    read = Camera.load(save(INFO))
    assert (read.width_px, read.height_px, read.distortion_model) == (640, 480, "plumb_bob")
    np.testing.assert_array_equal(read.matrix, K)
    np.testing.assert_array_equal(read.distortion, PLUMB_BOB)
    assert read.focal_px == 502.5
    np.testing.assert_array_equal(read.mount, mount_rotation("nadir"))


def test_a_flights_camera_yaml_is_read_back(save):
    camera = Camera(640, 480, K, distortion=DIGITS, mount=mount_rotation("nadir", -30.0))
    read = Camera.load(save(camera_info(camera)))
    for name in ("matrix", "distortion", "mount"):
        np.testing.assert_array_equal(getattr(read, name), getattr(camera, name))


@pytest.mark.parametrize("zeros", ["[]", "[0, 0, 0, 0]", "[0, 0, 0, 0, 0]"])
def test_an_ideal_camera_may_be_written_in_any_length_of_zeros(save, zeros):
    read = Camera.load(save(INFO.replace(str(PLUMB_BOB), zeros)))
    assert not read.distorts
    image = np.zeros((480, 640, 3), np.uint8)
    assert read.undistort(image) is image


@pytest.mark.parametrize("model", ["equidistant", "fisheye"])
def test_a_fisheye_lens_distorts_even_with_zero_coefficients(save, model):
    read = Camera.load(save(INFO.replace("plumb_bob", model).replace(str(PLUMB_BOB), "[0, 0, 0, 0]")))
    assert read.distorts


def test_a_calibration_may_state_its_mount_by_name_or_numbers(save):
    assert np.allclose(Camera.load(save(INFO + "mount: nadir-tail\n")).mount, mount_rotation("nadir-tail"))
    pitched = Camera.load(save(INFO + "mount: nadir\ncamera_pitch_deg: -30\n"))
    assert np.allclose(pitched.mount, mount_rotation("nadir", -30.0))
    assert np.allclose(Camera.load(save(INFO + "camera_pitch_deg: -30\n")).mount, pitched.mount)
    by_numbers = Camera.load(save(INFO + "mount: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"))
    np.testing.assert_array_equal(by_numbers.mount, np.eye(3))


# ------------------------------------------------------------------------------------- other programs' files


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize("shape", [(1, 5), (5, 1)])
def test_what_opencv_writes_is_read_to_the_last_digit(tmp_path, suffix, shape):
    other = {"distortion_coefficients": DIGITS.reshape(shape), "calibration_time": "Mon Nov 23 2026"}
    read = Camera.load(opencvs(tmp_path / f"camera.{suffix}", **SAMPLES | other))
    assert (read.width_px, read.height_px, read.distortion_model) == (640, 480, "plumb_bob")
    np.testing.assert_array_equal(read.matrix, K)
    np.testing.assert_array_equal(read.distortion, DIGITS)
    np.testing.assert_array_equal(read.mount, mount_rotation())


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_names_of_the_tutorials_and_a_mount(tmp_path, suffix):
    path = opencvs(
        tmp_path / f"camera.{suffix}", K=K, D=FISHEYE, image_size=np.array([640, 480]), fisheye_model=1,
        mount="nadir-tail",
    )  # fmt: skip
    read = Camera.load(path)
    assert (read.width_px, read.height_px, read.distortion_model) == (640, 480, "fisheye")
    np.testing.assert_array_equal(read.mount, mount_rotation("nadir-tail"))


def test_fourteen_coefficients_are_eight_where_the_others_are_zero(tmp_path):
    eight = np.array([0.1, 0.02, 1e-3, 2e-3, 0.03, 0.2, 0.05, 0.01])
    written = SAMPLES | {"distortion_coefficients": np.r_[eight, np.zeros(6)]}
    read = Camera.load(opencvs(tmp_path / "camera.yml", **written))
    assert read.distortion_model == "rational_polynomial"
    np.testing.assert_array_equal(read.distortion, eight)
    written["distortion_coefficients"][9] = 1e-5
    line = refusal(Camera.load, opencvs(tmp_path / "camera.yml", **written), error=CalibrationError)
    assert "camera.yml: distortion_coefficients: expected 4, 5 or 8 numbers" in line


@pytest.mark.parametrize(("kalibrs", "ros"), [("equidistant", "equidistant"), ("radtan", "plumb_bob")])
def test_a_camchain_by_the_call_with_which_kalibr_writes_it(save, kalibrs, ros):
    """Kalibr's ConfigReader.writeYaml, of what kalibr_calibrate_imu_camera puts into a camera's block."""
    chain = {
        "cam0": {
            "T_cam_imu": np.eye(4).tolist(), "cam_overlaps": [], "camera_model": "pinhole",
            "distortion_coeffs": FISHEYE.tolist(), "distortion_model": kalibrs,
            "intrinsics": [500.0, 505.0, 319.5, 239.5], "line_delay": 0, "resolution": [640, 480],
            "rostopic": "/camera/image_raw", "timeshift_cam_imu": -0.0042,
        }
    }  # fmt: skip
    read = Camera.load(save(yaml.dump(chain, default_flow_style=None, width=2147483647)))
    assert (read.width_px, read.height_px, read.distortion_model) == (640, 480, ros)
    np.testing.assert_array_equal(read.matrix, K)
    np.testing.assert_array_equal(read.distortion, FISHEYE)


def test_a_first_line_that_is_no_yaml_and_a_mount_in_a_camchain(save):
    """Of older OpenCV, and of OpenVINS."""
    read = Camera.load(save("%YAML:1.0 # as OpenVINS wants it\n\n" + KALIBR + "mount: nadir-left\n"))
    np.testing.assert_array_equal(read.mount, mount_rotation("nadir-left"))


def test_camera_info_as_ros_prints_it(save):
    text = f"height: 480\nwidth: 640\ndistortion_model: plumb_bob\nD: {PLUMB_BOB}\nK: {MATRIX}\n"
    np.testing.assert_array_equal(Camera.load(save(text)).matrix, K)


# ---------------------------------------------------------------------------------------------- refusals

ONE = [1, 0, 0, 0, 1, 0, 0, 0, 1]
BAD = {
    "missing field": (INFO.replace("image_height: 480\n", ""), "lacks the field image_height"),
    "missing matrix": (INFO.replace("camera_matrix", "matrix"), "lacks the field camera_matrix"),
    "matrix without data": (INFO.replace("data: [500", "values: [500"), "camera_matrix: expected 9 numbers"),
    "short matrix": (INFO.replace(", 0.0, 0.0, 1.0]", "]"), "camera_matrix: expected 9 numbers, got 6"),
    "words": (INFO.replace("[500.0,", "[wide,"), "camera_matrix: expected numbers"),
    "nan": (INFO.replace("[500.0,", "[.nan,"), "camera_matrix: expected 9 finite"),
    "focal length": (INFO.replace("[500.0,", "[-500.0,"), "positive focal lengths"),
    "transposed": (
        INFO.replace(MATRIX, "[500, 0, 0, 0, 505, 0, 319, 239, 1]"),
        "expected fx 0 cx, 0 fy cy, 0 0 1",
    ),
    "model": (INFO.replace("plumb_bob", "omni"), "distortion_model: expected one of plumb_bob"),
    "coefficients": (INFO.replace(str(PLUMB_BOB), "[0.1, 0.2]"), "plumb_bob takes 4 or 5"),
    "fisheye with five": (INFO.replace("plumb_bob", "equidistant"), "equidistant takes 4"),
    "size": (INFO.replace("480", "0"), "image size: expected 1 x 1 or more"),
    "fractional size": (INFO.replace("480", "480.5"), "image_height: expected a whole number"),
    "blank size": (INFO.replace("480", ""), "image_height: expected a whole number"),
    "mount": (INFO + "mount: [1, 0, 0, 0, 2, 0, 0, 0, 1]\n", "not orthonormal"),
    "reflection": (INFO + "mount: [1, 0, 0, 0, 1, 0, 0, 0, -1]\n", "reflection"),
    "short mount": (INFO + "mount: [1, 0, 0]\n", "mount: expected 9 numbers, got 3"),
    "unknown mount": (INFO + "mount: up\n", "mount: expected one of nadir"),
    "pitch of numbers": (INFO + f"mount: {ONE}\ncamera_pitch_deg: -30\n", "expected a mount by"),
    "pitch in words": (INFO + "camera_pitch_deg: steep\n", "could not convert"),
    "empty": ("", "no camera_info mapping"),
    "list": ("- 1\n- 2\n", "no camera_info mapping"),
    "not yaml": ("image_width: [1, 2\n", "not a readable YAML file"),
    "not text": (b"\xff\xfe\x00\x80", "not a readable YAML file"),
    "stereo": (KALIBR + KALIBR.replace("cam0", "cam1"), "expected one camera, got cam0, cam1: keep the block"),
    "omni": (KALIBR.replace("pinhole", "omni"), "cam0: camera_model: expected pinhole, got 'omni'"),
    "fov": (KALIBR.replace("equidistant", "fov"), "distortion_model: expected one of radtan, equidistant, none"),
    "intrinsics": (KALIBR.replace("[348.9572868848721, ", "["), "cam0: intrinsics: expected 4 numbers"),
    "no resolution": (KALIBR.replace("resolution", "size"), "cam0: resolution: expected 2 numbers, got None"),
    "xml": ("<opencv_storage><K>", "not a readable XML file"),
    "no matrix": ("camera_matrix: !!opencv-matrix 3\n", "not a readable YAML file"),
}


@pytest.mark.parametrize("case", BAD, ids=list(BAD))
def test_a_bad_file_is_refused_in_one_line_that_names_it(save, case):
    text, expected = BAD[case]
    message = refusal(Camera.load, save(text), error=CalibrationError)
    assert expected in message
    assert "camera.yaml" in message


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    assert "no such file" in refusal(Camera.load, tmp_path / "none.yaml", error=CalibrationError)
    assert "not a readable" in refusal(Camera.load, tmp_path, error=CalibrationError)
