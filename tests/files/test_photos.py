"""Photographs: telemetry and camera from what stands in them, against hand-computed values and a real survey."""

import math

import numpy as np
import pytest

from engine.errors import CalibrationError, TelemetryError
from scenematch.files.flight import open_flight
from scenematch.files.logs.readers import open_truth
from scenematch.files.photo_camera import photo_camera
from scenematch.files.photos import COMPASS_SIGMA_DEG, GIMBAL_SIGMA_DEG, exif_telemetry, photo_telemetry
from scenematch.files.telemetry import DEFAULT_PRIOR_SIGMA_M, read_telemetry
from scenematch.files.truth import read_truth
from tests.support.paths import NO_SHARED, SHARED
from tests.support.photos import gimbal, photograph

FOCAL_MM, FOCAL_35MM, ZOOM, WIDTH, PLANE_X, PLANE_UNIT = 0x920A, 0xA405, 0xA404, 0xA002, 0xA20E, 0xA210

PLACE = {1: "S", 2: (33.0, 30.0, 36.0), 3: "W", 4: (70.0, 15.0, 0.0), 5: b"\0", 6: 512.5}


def test_exif_gives_stamp_prior_and_altitude(tmp_path):
    photograph(tmp_path / "a.jpg", gps=PLACE, subsec="045", offset="+02:00")
    (row,) = exif_telemetry(tmp_path)
    assert row.timestamp_ns == 1_714_972_089_045_000_000  # 2024-05-06 05:08:09.045 UTC
    place = (row.lat_deg, row.lon_deg, row.alt_amsl_m)
    assert place == (pytest.approx(-33.51), pytest.approx(-70.25), 512.5)
    assert row.heading_deg is None
    assert row.prior.sigma_m == DEFAULT_PRIOR_SIGMA_M


def test_exif_heading_counts_only_from_true_north(tmp_path):
    photograph(tmp_path / "a.jpg", gps=PLACE | {16: "T", 17: 123.5})
    photograph(tmp_path / "b.jpg", gps=PLACE | {16: "M", 17: 123.5}, taken="2024:05:06 07:08:10")
    assert [row.heading_deg for row in exif_telemetry(tmp_path)] == [123.5, None]


def test_exif_without_a_fix_or_below_the_sea(tmp_path):
    nowhere = {1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0), 5: b"\1", 6: 3.0, 31: 2.5}
    (row,), _ = photo_telemetry([photograph(tmp_path / "a.jpg", gps=nowhere)])
    assert row.prior is None
    assert row.alt_amsl_m == -3.0


def test_xmp_gives_height_and_the_attitude_of_the_gimbal(tmp_path):
    photograph(tmp_path / "a.jpg", xmp=gimbal("+0.00", "-80.00", "-170.00", height="+36.10"))
    photograph(tmp_path / "b.jpg", xmp=gimbal("+180.00", "-80.00", "+10.00"), taken="2024:05:06 07:08:10")
    photograph(tmp_path / "c.jpg", xmp='drone-dji:FlightYawDegree="-20.5"', taken="2024:05:06 07:08:11")
    level, flipped, body = exif_telemetry(tmp_path)
    assert level.height_agl_m == 36.1
    assert (level.heading_deg, level.pitch_deg) == (pytest.approx(190.0), pytest.approx(10.0))
    assert level.roll_deg == pytest.approx(0.0, abs=1e-9)
    # Turned over about its own axis, the same camera heads the other way and leans back instead of forward.
    assert (flipped.heading_deg, flipped.pitch_deg) == (pytest.approx(190.0), pytest.approx(-10.0))
    assert (body.heading_deg, body.pitch_deg, body.height_agl_m) == (339.5, None, None)


def test_photographs_sort_by_time_share_a_second_and_need_a_time(tmp_path):
    photograph(tmp_path / "b.jpg")
    photograph(tmp_path / "c.jpg")
    photograph(tmp_path / "a.jpg", taken="2024:05:06 07:08:10")
    photograph(tmp_path / "d.jpg", taken="0000:00:00 00:00:00")
    rows = exif_telemetry(tmp_path)
    assert [row.frame for row in rows] == ["b.jpg", "c.jpg", "a.jpg"]
    assert np.diff([row.timestamp_ns for row in rows]).tolist() == [500_000_000, 500_000_000]


ZEROS = gimbal("+0.00", "+0.00", "+0.00", flight_yaw="-47.60")


def test_a_gimbal_of_zeros_is_none_and_the_flights_yaw_counts(tmp_path):
    paths = [photograph(tmp_path / "a.jpg", xmp=ZEROS), photograph(tmp_path / "b.jpg", xmp=gimbal())]
    (none, down), remarks = photo_telemetry(paths)
    assert (none.heading_deg, none.roll_deg, none.pitch_deg) == (pytest.approx(312.4), None, None)
    assert (none.heading_sigma_deg, none.tilt_sigma_deg) == (COMPASS_SIGMA_DEG, None)
    assert (down.heading_deg, down.tilt_sigma_deg) == (pytest.approx(30.0), GIMBAL_SIGMA_DEG)
    said = "photographs without gimbal angles, so their heading is the flight's and their tilt unknown: 1"
    assert remarks == [said]


def test_a_height_above_take_off_is_vaguer_than_one_above_ground(tmp_path):
    photograph(tmp_path / "a.jpg", xmp=gimbal(height="+100.0"))
    (row,) = exif_telemetry(tmp_path)
    assert (row.height_agl_m, row.height_sigma_m) == (100.0, pytest.approx(math.hypot(5.0, 5.0)))
    photograph(tmp_path / "a.jpg", gps=PLACE)  # above the sea only: nothing is known of the ground
    (row,) = exif_telemetry(tmp_path)
    assert (row.height_agl_m, row.height_sigma_m, row.alt_amsl_m) == (None, None, 512.5)


def test_a_photograph_that_a_viewer_turned_has_no_heading(tmp_path):
    photograph(tmp_path / "a.jpg", xmp=gimbal(), software="Microsoft Windows Photo Viewer 10.0.10240.16384")
    photograph(tmp_path / "b.jpg", xmp=gimbal(), software="v01.23.4920")
    flight = open_flight(tmp_path)
    assert [row.heading_deg for row in flight.rows] == [None, pytest.approx(30.0)]
    assert [row.height_agl_m for row in flight.rows] == [80.0, 80.0]
    assert flight.remarks == ["photographs rotated and saved by a viewer, so their heading is unknown: 1"]
    assert flight.has_gimbal
    assert flight.heights == {"take-off": 2}


def focal_px(tmp_path, size_px, tags=(), xmp=""):
    camera, _ = photo_camera([photograph(tmp_path / "a.jpg", tags=dict(tags), xmp=xmp, size_px=size_px)])
    assert (camera.width_px, camera.height_px) == size_px
    return camera.focal_px


# Pixels of cameras whose sensors are published: width of the sensor, focal length, its 35 mm equivalent.
@pytest.mark.parametrize(
    ("size_px", "focal_mm", "focal_35mm", "pixel_mm"),
    [
        ((4000, 3000), 3.61, 20, 6.17 / 4000),  # 1/2.3 inch, 4:3
        ((4000, 2250), 3.61, 20, 6.17 / 4000),  # its part of 16:9
        ((5472, 3648), 8.8, 24, 13.2 / 5472),  # 1 inch, 3:2
        ((5472, 3078), 8.8, 24, 13.2 / 5472),
        ((4864, 3648), 8.8, 24, 13.2 / 5472),  # its part of 4:3
        ((5280, 3956), 12.29, 24, 17.3 / 5280),  # 4/3 inch
        ((6000, 4000), 16.0, 24, 23.5 / 6000),  # APS-C
    ],
)
def test_a_35mm_equivalent_is_that_of_the_whole_sensor(tmp_path, size_px, focal_mm, focal_35mm, pixel_mm):
    small = (size_px[0] // 20, size_px[1] // 20)
    measured = focal_px(tmp_path, small, {FOCAL_MM: focal_mm, FOCAL_35MM: focal_35mm})
    assert measured == pytest.approx(focal_mm / pixel_mm / 20.0, rel=0.04)


def test_a_35mm_equivalent_alone_is_by_the_diagonal(tmp_path):
    assert focal_px(tmp_path, (300, 200), {FOCAL_35MM: 36}) == pytest.approx(300.0)


@pytest.mark.parametrize(("unit", "mm"), [(2, 25.4), (3, 10.0), (4, 1.0), (None, 25.4)])
def test_a_focal_length_with_the_pixels_of_a_unit(tmp_path, unit, mm):
    tags = {FOCAL_MM: 5.0, PLANE_X: 40.0 * mm, WIDTH: 640} | ({} if unit is None else {PLANE_UNIT: unit})
    assert focal_px(tmp_path, (640, 480), tags) == pytest.approx(200.0)
    assert focal_px(tmp_path, (320, 240), tags) == pytest.approx(100.0)  # made smaller since it was taken


def test_djis_own_calibration_counts_first(tmp_path):
    tags = {FOCAL_35MM: 24, WIDTH: 640}
    xmp = 'drone-dji:CalibratedFocalLength="600.0" drone-dji:CalibratedOpticalCenterX="320.0"'
    assert focal_px(tmp_path, (640, 480), tags, xmp) == pytest.approx(600.0)
    assert focal_px(tmp_path, (320, 240), tags, xmp) == pytest.approx(300.0)
    numbers = "610.0,611.0,3.0,-4.0,-0.27,0.11,1e-5,-4e-5,-0.03"
    xmp += f' drone-dji:DewarpFlag="{{}}" drone-dji:DewarpData="2018-09-04;{numbers}"'
    for flag, distortion in ((0, [-0.27, 0.11, 1e-5, -4e-5, -0.03]), (1, [0.0] * 5)):
        path = photograph(tmp_path / "b.jpg", tags=tags, xmp=xmp.format(flag), size_px=(640, 480))
        camera, _ = photo_camera([path])
        assert np.allclose(camera.matrix, [[610.0, 0.0, 322.5], [0.0, 611.0, 235.5], [0.0, 0.0, 1.0]])
        assert camera.distortion.tolist() == distortion


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        ({}, "expected a focal length .* got neither; give `hfov_deg` or `camera`"),
        ({FOCAL_MM: 5.0}, "got neither"),
        ({FOCAL_35MM: 24, ZOOM: 2.0}, "expected no digital zoom, got 2"),
        ({FOCAL_MM: 5.0, PLANE_X: 1000.0, PLANE_UNIT: 4, FOCAL_35MM: 24}, "expected one focal length in its EXIF"),
        ({FOCAL_35MM: 6000}, "expected a focal length of 0.2 to 50 widths"),
    ],
)
def test_a_camera_that_photographs_do_not_give_is_refused(tmp_path, tags, words):
    with pytest.raises(CalibrationError, match=words):
        photo_camera([photograph(tmp_path / "a.jpg", tags=tags)])


def test_photographs_of_two_lenses_are_refused(tmp_path):
    wide = photograph(tmp_path / "a.jpg", tags={FOCAL_35MM: 24})
    with pytest.raises(CalibrationError, match=r"b\.jpg: expected the focal length of a\.jpg, 22 px, got 65 px"):
        photo_camera([wide, photograph(tmp_path / "b.jpg", tags={FOCAL_35MM: 70})])
    with pytest.raises(CalibrationError, match=r"b\.jpg: expected 32 x 24 px as a\.jpg, got 24 x 32"):
        photo_camera([wide, photograph(tmp_path / "b.jpg", tags={FOCAL_35MM: 24}, size_px=(24, 32))])


def test_a_real_survey_says_camera_place_height_and_heading_itself():
    folder = SHARED / "brighton"
    if not (folder / "photos").is_dir():
        pytest.skip(NO_SHARED)
    flight = open_flight(folder / "photos")
    camera, _ = photo_camera([flight.source.path / name for name in flight.names])
    assert (camera.width_px, camera.height_px) == (4000, 2250)
    assert camera.focal_px == pytest.approx(3.61 / (6.17 / 4000), rel=0.02)
    assert flight.has_gimbal
    truth, posed = read_truth(folder / "truth.csv"), read_telemetry(folder / "telemetry.csv")
    assert [row.frame for row in flight.rows] == [row.frame for row in posed]
    for row, true, pose in zip(flight.rows, truth, posed, strict=True):
        north_m = (row.lat_deg - true.lat_deg) * 111_200.0
        east_m = (row.lon_deg - true.lon_deg) * 111_200.0 * math.cos(math.radians(row.lat_deg))
        assert math.hypot(east_m, north_m) < 1.0
        # Structure from motion over a plane leaves the focal length open, and with it the height: only the
        # scale of the picture is known.
        scale = (row.height_agl_m / camera.focal_px * 2.5) / (true.height_agl_m / 1125.5349)
        assert abs(scale - 1.0) < 2.0 * row.height_sigma_m / row.height_agl_m
        if row.heading_deg is not None:
            turn_deg = (row.heading_deg - pose.heading_deg + 180.0) % 360.0 - 180.0
            assert abs(turn_deg) < 3.0 * row.heading_sigma_deg
            assert max(abs(row.roll_deg), abs(row.pitch_deg)) < 0.2
    turned = [row.frame for row in flight.rows if row.heading_deg is None]
    assert turned == ["DJI_0025.JPG", "DJI_0027.JPG", "DJI_0029.JPG"]  # saved by a viewer, upside down


def test_positions_of_photographs_serve_as_truth_at_their_own_times(tmp_path):
    place = {1: "N", 2: (48.0, 15.0, 0.0), 3: "E", 4: (16.0, 30.0, 0.0), 5: b"\x00", 6: 300.0}
    photograph(tmp_path / "b.jpg", taken="2024:05:06 07:08:19", gps=place, xmp=gimbal())
    photograph(tmp_path / "a.jpg", gps=place | {2: (48.0, 16.0, 12.0)})
    photograph(tmp_path / "without.jpg", taken="2024:05:06 07:08:29")
    early, late = open_truth(tmp_path)
    stamps = [row.timestamp_ns for row in exif_telemetry(tmp_path)]
    assert [early.timestamp_ns, late.timestamp_ns] == stamps[:2]
    assert (early.lat_deg, late.lat_deg, late.lon_deg) == pytest.approx((48.27, 48.25, 16.5), abs=1e-12)
    assert (late.alt_amsl_m, late.height_agl_m, late.heading_deg) == (None, None, None)  # no truth
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / name).unlink()
    with pytest.raises(TelemetryError, match="expected photographs with a time and a position in their EXIF"):
        open_truth(tmp_path)
