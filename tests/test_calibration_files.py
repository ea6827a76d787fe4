"""Calibrations as other programs write them: OpenCV's FileStorage, Kalibr's camchain, ROS's printed messages."""

import cv2
import numpy as np
import pytest
import yaml

from engine.camera import Camera, mount_rotation
from engine.errors import CalibrationError

K = np.array([[500.0, 0.0, 319.5], [0.0, 505.0, 239.5], [0.0, 0.0, 1.0]])
PLUMB_BOB = np.array([-0.28, 0.09, 0.0007, -4e-20, -0.01])
FISHEYE = np.array([0.03, -0.012, 0.004, -0.001])
SAMPLES = {"image_width": 640, "image_height": 480, "camera_matrix": K, "distortion_coefficients": PLUMB_BOB}

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


def saved(tmp_path, text):
    path = tmp_path / "camchain.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize("shape", [(1, 5), (5, 1)])
def test_what_opencv_writes_is_read_to_the_last_digit(tmp_path, suffix, shape):
    written = SAMPLES | {
        "distortion_coefficients": PLUMB_BOB.reshape(shape),
        "calibration_time": "Mon Nov 23 2026",
    }
    read = Camera.load(opencvs(tmp_path / f"camera.{suffix}", **written))
    assert (read.width_px, read.height_px, read.distortion_model) == (640, 480, "plumb_bob")
    np.testing.assert_array_equal(read.matrix, K)
    np.testing.assert_array_equal(read.distortion, PLUMB_BOB)
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
    with pytest.raises(
        CalibrationError, match=r"camera\.yml: distortion_coefficients: expected 4, 5 or 8 numbers"
    ):
        Camera.load(opencvs(tmp_path / "camera.yml", **written))


@pytest.mark.parametrize(("kalibrs", "ros"), [("equidistant", "equidistant"), ("radtan", "plumb_bob")])
def test_a_camchain_by_the_call_with_which_kalibr_writes_it(tmp_path, kalibrs, ros):
    """Kalibr's ConfigReader.writeYaml, of what kalibr_calibrate_imu_camera puts into a camera's block."""
    chain = {
        "cam0": {
            "T_cam_imu": np.eye(4).tolist(), "cam_overlaps": [], "camera_model": "pinhole",
            "distortion_coeffs": FISHEYE.tolist(), "distortion_model": kalibrs,
            "intrinsics": [500.0, 505.0, 319.5, 239.5], "line_delay": 0, "resolution": [640, 480],
            "rostopic": "/camera/image_raw", "timeshift_cam_imu": -0.0042,
        }
    }  # fmt: skip
    read = Camera.load(saved(tmp_path, yaml.dump(chain, default_flow_style=None, width=2147483647)))
    assert (read.width_px, read.height_px, read.distortion_model) == (640, 480, ros)
    np.testing.assert_array_equal(read.matrix, K)
    np.testing.assert_array_equal(read.distortion, FISHEYE)


def test_a_first_line_that_is_no_yaml_and_a_mount_in_a_camchain(tmp_path):
    """Of older OpenCV, and of OpenVINS."""
    read = Camera.load(saved(tmp_path, "%YAML:1.0 # as OpenVINS wants it\n\n" + KALIBR + "mount: nadir-left\n"))
    np.testing.assert_array_equal(read.mount, mount_rotation("nadir-left"))


def test_camera_info_as_ros_prints_it(tmp_path):
    text = (
        "height: 480\nwidth: 640\ndistortion_model: plumb_bob\nD: [-0.28, 0.09, 0.0007, -0.0004, -0.01]\n"
        "K: [500.0, 0.0, 319.5, 0.0, 505.0, 239.5, 0.0, 0.0, 1.0]\n"
    )
    np.testing.assert_array_equal(Camera.load(saved(tmp_path, text)).matrix, K)


BAD = {
    "stereo": (KALIBR + KALIBR.replace("cam0", "cam1"), "expected one camera, got cam0, cam1: keep the block"),
    "omni": (KALIBR.replace("pinhole", "omni"), "cam0: camera_model: expected pinhole, got 'omni'"),
    "fov": (KALIBR.replace("equidistant", "fov"), "distortion_model: expected one of radtan, equidistant, none"),
    "intrinsics": (KALIBR.replace("[348.9572868848721, ", "["), "cam0: intrinsics: expected 4 numbers"),
    "no resolution": (KALIBR.replace("resolution", "size"), "cam0: resolution: expected 2 numbers, got None"),
    "xml": ("<opencv_storage><K>", "not a readable XML file"),
    "no matrix": ("camera_matrix: !!opencv-matrix 3\n", "not a readable YAML file"),
}


@pytest.mark.parametrize("case", BAD, ids=list(BAD))
def test_what_cannot_be_one_camera_is_refused_in_one_line(tmp_path, case):
    text, expected = BAD[case]
    with pytest.raises(CalibrationError) as caught:
        Camera.load(saved(tmp_path, text))
    assert expected in str(caught.value)
    assert "camchain.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)
