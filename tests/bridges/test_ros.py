"""The ROS nodes: messages of both ROS in and out by rosbags' types, REP-103 by hand, and nodes on stand-ins."""

import array
import contextlib
import math
import signal
import sys
import threading
import time
from types import ModuleType, SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from engine import Attitude, Camera, LiveOptions, NoFix, Reason, Window
from engine.errors import BackendError, CalibrationError, OptionError
from scenematch import CameraInput, MapInput, RosSettings, run_ros_bridge
from scenematch.bridges.ros import OUTPUTS, RosBridge
from scenematch.bridges.ros_in import RosTelemetry, RosTopics
from scenematch.bridges.ros_out import RosOptions, pose
from scenematch.bridges.vehicle import NedOrigin, VehicleState, north_east_m
from scenematch.cli.app import run as main
from scenematch.cli.argument_names import ros_arguments_last
from scenematch.files.quaternions import quaternion_xyzw
from scenematch.files.ros import messages as ros_messages
from scenematch.files.ros.messages import body_velocity_from_message, camera_from_message, image_from_message
from tests.support.fixes import a_fix
from tests.support.ground import body_axes
from tests.support.odometries import odometry_message
from tests.support.refusals import misuse, refusal
from tests.support.ros import NOW_NS, STORES, StandInNode, maker_of


def wired(name, message):
    """A message as it comes off the wire."""
    store, kind = STORES[name], message.__msgtype__
    if name == "ros1":
        return store.deserialize_ros1(store.serialize_ros1(message, kind), kind)
    return store.deserialize_cdr(store.serialize_cdr(message, kind), kind)


@pytest.fixture(params=list(STORES))
def ros(request):
    return request.param


@pytest.fixture
def maker(ros):
    return maker_of(ros)


# ------------------------------------------------------------------------------------------------- pictures


def raw_image(maker, encoding, pixels, padding=0):
    """A picture with these values, and some bytes behind each row."""
    rows = [row.tobytes() + b"\xee" * padding for row in pixels]
    message = maker.image(NOW_NS, "camera", np.zeros(pixels.shape[:2], np.uint8))
    message.encoding, message.step = encoding, len(rows[0])
    message.data = np.frombuffer(b"".join(rows), np.uint8)
    return message


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "order"),
    [("rgb8", "rgb"), ("bgr8", "bgr"), ("bgra8", "bgra"), ("rgba8", "rgba"), ("8UC3", "bgr"), ("8UC4", "bgra")],
)
def test_colours_of_every_encoding(ros, maker, encoding, order, padding):
    rgba = np.random.default_rng(2).integers(0, 256, (5, 7, 4), dtype=np.uint8)
    message = raw_image(maker, encoding, rgba[:, :, ["rgba".index(colour) for colour in order]], padding)
    assert np.array_equal(image_from_message(wired(ros, message)), rgba[:, :, :3])
    message.data = message.data[: len(message.data) - padding]  # some drivers leave the last padding out
    assert np.array_equal(image_from_message(wired(ros, message)), rgba[:, :, :3])


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_stays_grey(ros, maker, encoding):
    grey = np.random.default_rng(2).integers(0, 256, (5, 7), dtype=np.uint8)
    picture = image_from_message(wired(ros, raw_image(maker, encoding, grey, 9)))
    assert np.array_equal(picture, grey)
    picture[0, 0] ^= 255  # a copy, not the message's own bytes


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"])
def test_a_mosaic_becomes_the_colours_that_it_was_made_of(ros, maker, encoding):
    rgb = np.zeros((8, 12, 3), np.uint8) + np.array([200, 120, 40], np.uint8)
    mosaic = np.zeros(rgb.shape[:2], np.uint8)
    for k, colour in enumerate(encoding.removeprefix("bayer_")[:4]):
        row, column = divmod(k, 2)
        mosaic[row::2, column::2] = rgb[row::2, column::2, "rgb".index(colour)]
    assert np.array_equal(image_from_message(wired(ros, raw_image(maker, encoding, mosaic, 4))), rgb)


@pytest.mark.parametrize(("encoding", "big"), [("mono16", False), ("mono16", True), ("16UC1", False)])
def test_deep_pictures_keep_their_contrast(ros, maker, encoding, big):
    levels = np.linspace(100, 4095, 30 * 40).astype(np.uint16).reshape(30, 40)  # of a camera of 12 bits
    message = raw_image(maker, encoding, levels.astype(">u2" if big else "<u2"), 6)
    message.is_bigendian = int(big)
    picture = image_from_message(wired(ros, message)).astype(float)
    assert picture.max() == 255.0
    assert np.abs(picture - levels / 4095.0 * 255.0).max() < 2.0


@pytest.mark.parametrize(
    "kind", [bytes, bytearray, lambda b: array.array("B", b), lambda b: np.frombuffer(b, np.uint8)]
)
def test_bytes_as_rospy_and_rclpy_have_them(maker, kind):
    message = maker.image(NOW_NS, "", np.zeros((2, 3, 3), np.uint8))
    message.data = kind(bytes(range(18)))
    assert image_from_message(message).tobytes() == bytes(range(18))


@pytest.mark.parametrize(
    ("changes", "stated"),
    [
        ({"encoding": "32FC1"}, "got '32FC1'"),
        ({"encoding": "bayer_rggb8", "width": 1, "height": 1}, "2 x 2 pixels of a Bayer mosaic"),
        ({"encoding": "mono16", "width": 10}, "10 x 4 mono16"),
        ({"step": 8}, "rows of 8 bytes"),
        ({"height": 5}, "got 36 bytes"),
        ({"width": 0}, "0 x 4"),
        ({"height": 2**31, "step": 2**31}, "got 36 bytes"),
    ],
)
def test_pictures_that_are_none_are_named(maker, changes, stated):
    message = maker.image(NOW_NS, "", np.zeros((4, 3, 3), np.uint8))
    for name, value in changes.items():
        setattr(message, name, value)
    assert stated in refusal(image_from_message, message)


# --------------------------------------------------------------------------------------------- calibration


def test_an_ideal_camera_may_state_no_distortion(ros, maker):
    message = maker.camera_info(NOW_NS, "", Camera.from_fov(64, 48, 60.0))
    setattr(message, "D" if ros == "ros1" else "d", np.zeros(0))
    message.distortion_model = ""
    assert not camera_from_message(wired(ros, message)).distorts


def test_calibrations_that_are_none_are_named(ros, maker):
    blank = maker.camera_info(NOW_NS, "", Camera.from_fov(64, 48, 60.0))
    setattr(blank, "K" if ros == "ros1" else "k", np.zeros(9))
    assert "camera_info" in refusal(camera_from_message, blank, error=CalibrationError)
    binned = maker.camera_info(NOW_NS, "", Camera.from_fov(64, 48, 60.0))
    binned.binning_x = 2
    assert "binning" in refusal(camera_from_message, binned, error=CalibrationError)


# ------------------------------------------------------------------------------------------ REP-103, by hand


def random_angles(count=200):
    rng = np.random.default_rng(7)
    return [(rng.uniform(-180, 180), rng.uniform(-89, 89), rng.uniform(0, 360)) for _ in range(count)]


def test_quaternions_turn_forward_left_up_to_east_north_up():
    for angles in [*random_angles(), (0, 0, 0), (0, 0, 90), (0, 0, 180), (180, 0, 270), (90, 0, 45)]:
        turn = Rotation.from_quat(quaternion_xyzw(*angles)).as_matrix()
        forward, right, down = body_axes(*angles)
        assert np.allclose(turn, np.stack([forward, -right, -down], axis=1), atol=1e-12)
        assert quaternion_xyzw(*angles)[3] >= 0.0


def test_an_imu_without_orientation_says_nothing(maker):
    message = maker.imu(NOW_NS, "", 1, 2, 3)
    message.orientation_covariance = np.array([-1.0, *(0.0,) * 8])
    assert ros_messages.attitude_from_message(message) is None
    for values in ((0, 0, 0, 0), (0, 0, math.nan, 1), (0, 0, 3, 1)):
        message = maker.imu(NOW_NS, "", 1, 2, 3)
        message.orientation = maker.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", values, strict=True)))
        assert ros_messages.attitude_from_message(message) is None


def a_range(maker, range_m):
    return maker.make("sensor_msgs/msg/Range", header=maker.header(NOW_NS, ""), radiation_type=1,
                      field_of_view=0.1, min_range=0.5, max_range=50.0, range=range_m)  # fmt: skip


@pytest.mark.parametrize(("range_m", "stated"), [(12.0, 12.0), (0.1, None), (60.0, None), (math.inf, None),
                                               (math.nan, None), (-math.inf, None)])  # fmt: skip
def test_ranges_beyond_reach_and_of_any_sensor_are_unknown(maker, range_m, stated):
    """MAVROS' rangefinder states 0 to 1000 m of every sensor, and one of 50 m reports 50 m from 150."""
    message = a_range(maker, range_m)
    assert ros_messages.range_from_message(message) == stated
    message.min_range, message.max_range = 0.0, 1000.0
    assert ros_messages.range_from_message(message) is None


def test_positions_carry_the_worse_axis(ros, maker):
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    covariance = turn @ np.diag([4.0, 25.0, 9.0]) @ turn.T
    message = wired(ros, maker.position(NOW_NS, "", 33.5, -72.25, covariance))
    assert ros_messages.position_from_message(message) == pytest.approx((33.5, -72.25, 5.0))
    assert math.isnan(message.altitude)
    message.position_covariance_type = 0
    assert ros_messages.position_from_message(message) == (33.5, -72.25, None)
    message.status.status = ros_messages.NO_POSITION
    assert ros_messages.position_from_message(message) is None


# ------------------------------------------------------------------------------------------------ telemetry


def test_telemetry_is_that_of_the_capture(maker):
    heard, step_ns = RosTelemetry(), 100_000_000
    for k in range(6):
        time_ns = NOW_NS + k * step_ns
        heard.add("imu", maker.imu(time_ns, "", 2.0 * k, -k, 350.0 + 5.0 * k), 0)
        heard.add("height", maker.float64(100.0 + k), time_ns)
        heard.add("velocity", maker.velocity(time_ns, "", k, -2.0 * k), 0)
    heard.add("height", maker.float64(math.nan), NOW_NS + 550_000_000)
    now = heard.vehicle(NOW_NS + 150_000_000)
    # A heading between 355 and 0 is found the shorter way round.
    assert (now.roll_deg, now.pitch_deg, now.heading_deg) == pytest.approx((3.0, -1.5, 357.5))
    assert (now.height_agl_m, now.down_m) == pytest.approx((101.5, -101.5))
    assert (now.east_velocity_mps, now.north_velocity_mps) == pytest.approx((1.5, -3.0))
    assert heard.vehicle(NOW_NS + 900_000_000).height_agl_m == 105.0  # the last, for half a second
    assert heard.vehicle(NOW_NS + 1_100_000_000).height_agl_m is None
    heard.add("compass", maker.float64(20.0), NOW_NS + 250_000_000)
    assert heard.vehicle(NOW_NS + 250_000_000).heading_deg == pytest.approx(20.0)
    assert heard.vehicle(NOW_NS + 3_000_000_000) == VehicleState()


def test_the_beam_leans_with_the_body(maker):
    heard = RosTelemetry()
    heard.add("imu", maker.imu(NOW_NS, "", 20.0, 30.0, 10.0), 0)
    heard.add("height", maker.float64(33.0), NOW_NS)
    heard.add("range", a_range(maker, 40.0), 0)
    _, _, down = body_axes(20.0, 30.0, 10.0)
    now = heard.vehicle(NOW_NS)
    assert now.height_agl_m == pytest.approx(-40.0 * down[2], abs=1e-5)
    assert now.down_m == -33.0


def test_a_time_that_goes_back_begins_again(maker):
    heard = RosTelemetry()
    heard.add("height", maker.float64(100.0), NOW_NS)
    heard.add("height", maker.float64(50.0), NOW_NS - 500_000_000)  # late, and of no use
    assert heard.vehicle(NOW_NS).height_agl_m == 100.0
    heard.add("height", maker.float64(70.0), NOW_NS - 60_000_000_000)
    assert heard.vehicle(NOW_NS - 60_000_000_000).height_agl_m == 70.0
    assert heard.vehicle(NOW_NS).height_agl_m is None


@pytest.mark.parametrize("child", ["base_link", "", "odom"])
def test_another_odometry_is_turned_by_the_vehicles_own_attitude(ros, maker, child):
    """Wherever the odometry has its own north, and along whichever of the two frames its twist is."""
    rng = np.random.default_rng(5)
    for angles in random_angles(10):
        enu_mps, heard = rng.normal(0.0, 8.0, 3), RosTelemetry()
        message = odometry_message(maker, NOW_NS, angles, enu_mps, yaw_deg=77.0, child=child)
        heard.add("odometry", wired(ros, message), 0)
        assert heard.vehicle(NOW_NS).east_velocity_mps is None  # towards nobody knows where
        heard.add("imu", maker.imu(NOW_NS, "", *angles), 0)
        now = heard.vehicle(NOW_NS)
        assert (now.east_velocity_mps, now.north_velocity_mps) == pytest.approx(enu_mps[:2], abs=1e-9)


@pytest.mark.parametrize(
    ("variances", "sigma_mps"),
    [
        ((0.04, 0.09, 0.01), math.hypot(0.3, math.radians(1.0) * 10.0)),  # the heading is off by a degree
        ((1e-12, 1e-12, 1e-12), math.radians(1.0) * 10.0),
        ((0.0, 0.0, 0.0), 0.0),
        ((-1.0, 9.0, 9.0), 0.0),  # not stated, by its first element
        ((math.nan, 0.04, 0.04), 0.0),
        ((0.04, 30.0, 0.04), None),  # lost
    ],
)
def test_an_odometrys_covariance_is_that_of_the_velocity(ros, maker, variances, sigma_mps):
    message = odometry_message(maker, NOW_NS, (0.0, 0.0, 90.0), (10.0, 0.0, 0.0), variances=variances)
    stated = body_velocity_from_message(wired(ros, message))
    assert stated == (None if sigma_mps is None else pytest.approx((10.0, 0.0, 0.0, sigma_mps), abs=1e-9))


def test_a_velocity_takes_the_place_of_an_odometry_that_is_silent(maker):
    heard = RosTelemetry()
    for after_ms in (0, 500, 1000, 1500):
        time_ns = NOW_NS + after_ms * 1_000_000
        heard.add("imu", maker.imu(time_ns, "", 0.0, 0.0, 90.0), 0)
        heard.add("velocity", maker.velocity(time_ns, "", 3.0, 4.0), 0)
        if after_ms <= 500:
            heard.add("odometry", odometry_message(maker, time_ns, (0.0, 0.0, 90.0), (1.0, 0.0, 0.0)), 0)
    known = [heard.vehicle(NOW_NS + after_ms * 1_000_000) for after_ms in (500, 900, 1100, 1500)]
    velocities = [(now.east_velocity_mps, now.north_velocity_mps) for now in known]
    assert velocities == [pytest.approx(v, abs=1e-9) for v in ((1.0, 0.0), (1.0, 0.0), (3.0, 4.0), (3.0, 4.0))]


def test_an_accuracy_that_one_odometry_states_and_the_next_does_not_is_not_mixed(maker):
    heard, step_ns = RosTelemetry(), 100_000_000
    for time_ns, variances in ((NOW_NS, (0.04, 0.04, 0.04)), (NOW_NS + step_ns, None)):
        heard.add("imu", maker.imu(time_ns, "", 0.0, 0.0, 90.0), 0)
        message = odometry_message(maker, time_ns, (0.0, 0.0, 90.0), (1.0, 0.0, 0.0), variances=variances)
        heard.add("odometry", message, 0)
    stated_mps = math.hypot(0.2, math.radians(1.0))
    assert heard.vehicle(NOW_NS + step_ns // 4).velocity_sigma_mps == pytest.approx(stated_mps)
    assert heard.vehicle(NOW_NS + 3 * step_ns // 4).velocity_sigma_mps is None


def test_an_odometry_that_says_nothing(maker):
    angles = (0.0, 0.0, 0.0)
    for velocity in ((math.nan, 0.0, 0.0), (0.0, 1e4, 0.0)):
        assert body_velocity_from_message(odometry_message(maker, NOW_NS, angles, velocity)) is None
    message = odometry_message(maker, NOW_NS, angles, (1.0, 2.0, 3.0), child="odom")
    message.pose.pose.orientation.w = 5.0  # no turn, which a twist along the pose's frame needs
    assert body_velocity_from_message(message) is None
    heard = RosTelemetry()
    heard.add("imu", maker.imu(NOW_NS, "", *angles), 0)
    heard.add("odometry", odometry_message(maker, 0, angles, (1.0, 2.0, 3.0)), NOW_NS)  # unstamped, so of now
    assert heard.vehicle(NOW_NS).north_velocity_mps == pytest.approx(2.0)
    assert heard.vehicle(NOW_NS + 600_000_000).north_velocity_mps is None


# ---------------------------------------------------------------------------------------------------- poses


def fix_on(site, **changes):
    xy = np.array([site.width_px / 2 + 30.25, site.height_px / 2 - 20.5])
    east, north = site.enu_from_pixel(xy)
    lat, lon = site.geodetic_from_pixel(xy)
    values = {
        "timestamp_ns": NOW_NS, "lat_deg": float(lat), "lon_deg": float(lon), "east_m": float(east),
        "north_m": float(north), "window": Window(10, 20, 200, 100), "map_xy_px": tuple(map(float, xy)),
        "covariance_m2": np.array([[0.5, 0.1, 0.02], [0.1, 0.25, 0.03], [0.02, 0.03, 4.0]]),
    }  # fmt: skip
    return a_fix(**(values | changes))


VEHICLE = VehicleState(roll_deg=2.0, pitch_deg=-3.0, heading_deg=200.0, height_agl_m=120.0, down_m=-118.0)


def pose_of(maker, fix, vehicle, site, *, ros=None, **options):
    """Position, quaternion and covariance (6, 6) of the message of a fix."""
    message = pose(maker, fix, vehicle, NOW_NS, site, RosOptions(**options))
    message = message if ros is None else wired(ros, message)
    assert (ros_messages.stamp_ns(message), message.header.frame_id) == (NOW_NS, "map")
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    covariance = np.asarray(message.pose.covariance).reshape(6, 6)
    return (at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w), covariance


def test_a_pose_is_the_fix_with_its_covariance(ros, maker, sim_site):
    fix = fix_on(sim_site)
    place, turn, covariance = pose_of(maker, fix, VEHICLE, sim_site, ros=ros)
    assert place == (fix.east_m, fix.north_m, 118.0)
    assert turn == pytest.approx(quaternion_xyzw(2.0, -3.0, 200.0))
    assert np.array_equal(covariance[:3, :3], fix.covariance_m2)
    assert np.array_equal(covariance, covariance.T)
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_a_measured_attitude_outranks_the_vehicles(maker, sim_site):
    fix = fix_on(sim_site, attitude=Attitude(5.0, 6.0, 77.0), up_m=sim_site.ground_m + 80.0)
    place, turn, _ = pose_of(maker, fix, VehicleState(roll_deg=0.0, pitch_deg=0.0, heading_deg=0.0), sim_site)
    assert turn == pytest.approx(quaternion_xyzw(5.0, 6.0, 77.0))
    assert place[2] == pytest.approx(80.0)


def test_a_whole_pose_has_the_covariance_of_its_attitude_about_east_north_up(maker, sim_site):
    # Heading east: a roll is a turn about east, a pitch one about north.
    known = {"attitude_covariance_deg2": np.diag([4.0, 9.0, 16.0])}
    for heading_deg, expected in ((90.0, [5.0, 10.0, 17.0]), (0.0, [10.0, 5.0, 17.0])):  # a degree is the mount's
        fix = fix_on(sim_site, **known | {"attitude": Attitude(0.0, 0.0, heading_deg)})
        _, _, covariance = pose_of(maker, fix, VEHICLE, sim_site)
        assert covariance[3:, 3:] * math.degrees(1.0) ** 2 == pytest.approx(np.diag(expected))


def test_what_is_unknown_is_as_uncertain_as_can_be(maker, sim_site):
    _, turn, covariance = pose_of(maker, fix_on(sim_site), VehicleState(), sim_site)
    assert covariance[2, 2] >= 1e6
    assert (np.diag(covariance)[3:] >= math.pi**2).all()
    assert np.linalg.norm(turn) == pytest.approx(1.0)


def test_the_origin_moves_the_pose(maker, sim_site):
    fix = fix_on(sim_site)
    place, _, _ = pose_of(maker, fix, VEHICLE, sim_site, origin=NedOrigin(fix.lat_deg, fix.lon_deg, 0.0))
    assert place[:2] == pytest.approx((0.0, 0.0), abs=1e-6)


def test_ardupilot_finds_the_fix_again_and_the_height_drowns_nothing(maker, sim_site):
    fix, origin = fix_on(sim_site), NedOrigin(sim_site.frame.lat_deg + 0.01, sim_site.frame.lon_deg - 0.01, 0.0)
    (x, y, _), _, covariance = pose_of(maker, fix, VEHICLE, sim_site, firmware="ardupilot", origin=origin)
    assert (y, x) == pytest.approx(north_east_m(fix.lat_deg, fix.lon_deg, origin, "ardupilot"))
    assert np.array_equal(covariance[:2, :2], fix.covariance_m2[:2, :2])
    assert covariance[2, 2] == pytest.approx(fix.sigma_m**2)
    assert not covariance[2, :2].any()


# ----------------------------------------------------------------------------------------------- the bridge


@pytest.fixture
def node(maker):
    return StandInNode(maker)


class Answers:
    """A navigator that answers as it was set up to."""

    def __init__(self, make):
        self.make, self.frames = make, []

    def update(self, frame, prior=None, budget=None):
        self.frames.append(frame)
        return self.make(frame)


@contextlib.contextmanager
def bridge_of(node, site, make=None, deadline_ms=60_000):
    """A bridge and its navigator, by default one whose every frame is a fix."""
    navigator = Answers(make or (lambda frame: fix_on(site, timestamp_ns=frame.timestamp_ns)))
    live = LiveOptions(deadline_ms=deadline_ms)
    bridge = RosBridge(node, site, lambda start: navigator, RosOptions(), None, live)
    with contextlib.closing(bridge):
        yield bridge, navigator


def an_image(maker, time_ns, shape=(4, 6)):
    return maker.image(time_ns, "camera", np.zeros(shape, np.uint8))


def test_a_fix_is_published_with_the_stamp_of_its_capture(ros, maker, node, sim_site):
    captured_ns = NOW_NS - 50_000_000
    with bridge_of(node, sim_site) as (bridge, seen):
        bridge.telemetry.add("imu", maker.imu(captured_ns, "", 1.0, 2.0, 3.0), 0)
        bridge.on_image(an_image(maker, captured_ns))
        node.wait_for("diagnostics", 1)
    for output, kind in OUTPUTS.items():
        (message,) = (wired(ros, m) for m in node.of(output))  # each can be sent
        assert message.__msgtype__ == kind
        assert ros_messages.stamp_ns(message) == captured_ns
    assert seen.frames[0].heading_deg == pytest.approx(3.0)
    fix, (place,) = fix_on(sim_site), node.of("fix")
    assert (place.latitude, place.longitude) == (fix.lat_deg, fix.lon_deg)
    assert np.array_equal(np.reshape(place.position_covariance, (3, 3)), fix.covariance_m2)
    values = {pair.key: pair.value for pair in node.of("diagnostics")[0].status[0].values}
    assert float(values["age_ms"]) >= 50.0
    assert values["fixes"] == "1"


def test_a_refusal_is_told_and_never_a_pose(maker, node, sim_site):
    broken = [fix_on(sim_site, east_m=math.nan), fix_on(sim_site, covariance_m2=np.full((3, 3), np.inf))]
    answers = iter([NoFix(reason=reason, detail="why") for reason in Reason] + broken)
    with bridge_of(node, sim_site, lambda frame: next(answers)) as (bridge, _):
        for k in range(len(Reason) + 2):
            bridge.on_image(an_image(maker, NOW_NS + k))
            node.wait_for("diagnostics", k + 1)
        status = bridge.status
    assert not node.of("pose")
    assert not node.of("fix")
    stated = [message.status[0] for message in node.of("diagnostics")]
    assert [status.level for status in stated] == [1] * len(stated)
    first = next(iter(Reason)).value
    assert (stated[0].name, stated[0].message) == ("scenematch: position", f"no fix: {first}")
    assert status.refused == {**{reason.value: 1 for reason in Reason}, "not finite": 2}
    assert {pair.key: pair.value for pair in stated[0].values}["reason"] == first


def test_pictures_that_cannot_be_read_are_told(maker, node, sim_site):
    with bridge_of(node, sim_site) as (bridge, _):
        odd = an_image(maker, NOW_NS)
        odd.encoding = "32FC1"
        bridge.on_image(odd)
        bridge.on_image(an_image(maker, NOW_NS + 1))
        node.wait_for("diagnostics", 2)  # the odd one's, and the fix's, which is reported when it has been counted
        bridge.on_image(an_image(maker, NOW_NS))  # older than the last
        status = bridge.status
    first = node.of("diagnostics")[0].status[0]
    assert (first.level, "32FC1" in first.message) == (2, True)
    assert (status.unusable, status.counts.submitted, status.fixes) == (2, 1, 1)


def test_a_picture_without_a_stamp_is_of_now_and_a_bag_may_begin_again(maker, node, sim_site):
    with bridge_of(node, sim_site) as (bridge, seen):
        for k, time_ns in enumerate((0, NOW_NS + 1, NOW_NS - 60_000_000_000)):
            node.time_ns = time_ns or NOW_NS
            bridge.on_image(an_image(maker, time_ns))
            node.wait_for("pose", k + 1)
        status = bridge.status
    assert [frame.timestamp_ns for frame in seen.frames] == [NOW_NS, NOW_NS + 1, NOW_NS - 60_000_000_000]
    assert (status.restarts, status.counts.submitted, status.counts.answered) == (1, 3, 3)


def test_compressed_pictures_are_live_too(ros, maker, node, sim_site):
    picture = np.random.default_rng(1).integers(0, 256, (5, 7), dtype=np.uint8)
    with bridge_of(node, sim_site) as (bridge, seen):
        handlers = bridge.handlers(RosTopics(image="/camera/image_raw/compressed"))
        kind, handler = handlers["/camera/image_raw/compressed"]
        header, data = maker.header(NOW_NS, ""), cv2.imencode(".png", picture)[1]
        made = maker.make("sensor_msgs/msg/CompressedImage", header=header, format="png", data=data)
        message = wired(ros, made)
        assert message.__msgtype__ == kind
        handler(message)
        node.wait_for("pose", 1)
    assert np.array_equal(seen.frames[0].image, picture)


def test_a_picture_waits_for_the_attitude_of_its_capture(maker, node, sim_site):
    after_ns = NOW_NS + 40_000_000
    with bridge_of(node, sim_site) as (bridge, seen):
        bridge.on_imu(maker.imu(NOW_NS - 60_000_000, "", 0.0, -6.0, 0.0))
        bridge.on_image(an_image(maker, NOW_NS))
        assert bridge.status.counts.submitted == 0
        bridge.on_imu(maker.imu(after_ns, "", 0.0, 4.0, 0.0))
        node.wait_for("pose", 1)
        assert seen.frames[0].pitch_deg == pytest.approx(0.0, abs=1e-6)
        bridge.on_image(an_image(maker, after_ns + 1))  # no attitude follows: it goes on as it is
        node.wait_for("pose", 2)
        bridge.on_image(an_image(maker, after_ns + 1_000_000_000))  # attitudes have ended: none is waited for
        assert bridge.status.counts.submitted == 3


def test_deadlines_are_on_the_clock_that_the_node_is_told(maker, node, sim_site):
    """A simulator at a tenth of the real speed, and one that runs away."""
    answers = threading.Event()

    def slowly(frame):
        answers.wait(60.0)
        return fix_on(sim_site)

    with bridge_of(node, sim_site, slowly, deadline_ms=50) as (bridge, _):
        bridge.on_image(an_image(maker, NOW_NS))
        time.sleep(0.2)
        answers.set()  # 200 ms here, none there
        node.wait_for("pose", 1)
        answers.clear()
        bridge.on_image(an_image(maker, NOW_NS + 1))
        node.time_ns = NOW_NS + 60_000_000
        node.wait_for("diagnostics", 2)
        answers.set()
    assert bridge.status.refused == {"late": 1}


def test_silence_is_told(node, sim_site, monkeypatch):
    with bridge_of(node, sim_site) as (bridge, _):
        bridge.check_input()
        assert not node.of("diagnostics")
        later = time.monotonic() + 5.0
        monkeypatch.setattr("scenematch.bridges.ros.time.monotonic", lambda: later)
        bridge.check_input()
    assert "no picture for" in node.of("diagnostics")[0].status[0].message


def test_an_empty_name_leaves_a_topic_out(maker, node, sim_site):
    with bridge_of(node, sim_site) as (bridge, _):
        handlers = bridge.handlers(RosTopics(velocity=""))
        kinds = {topic: kind for topic, (kind, _) in handlers.items()}
        handlers[RosTopics().height][1](maker.float64(42.0))
        assert bridge.telemetry.vehicle(NOW_NS).height_agl_m == 42.0
        handlers = bridge.handlers(RosTopics(odometry="/vio", range="/r"))
        both = {topic: kind for topic, (kind, _) in handlers.items()}
        assert (both["/vio"], both["/r"]) == ("nav_msgs/msg/Odometry", "sensor_msgs/msg/Range")
        assert both[RosTopics().velocity] == "geometry_msgs/msg/TwistStamped"
    assert set(kinds) == {RosTopics().image, RosTopics().imu, RosTopics().height}
    known = set(STORES["ros1"].types) & set(STORES["ros2"].types)
    assert known >= {*kinds.values(), *both.values()}


# ---------------------------------------------------------------------------------- the nodes, on stand-ins


def stand_in(patch, name, **holds):
    """A module with these names in it, in place of one that is not installed."""
    module = ModuleType(name)
    vars(module).update(holds)
    patch.setitem(sys.modules, name, module)


def packages_of(patch, ros):
    """ROS' message packages, with rosbags' classes in them, and no settings of ROS in the environment."""
    made = {}
    for name, kind in STORES[ros].types.items():
        package, _, short = name.split("/")
        made.setdefault(package, {})[short] = kind
    for package, kinds in made.items():
        stand_in(patch, package)
        stand_in(patch, f"{package}.msg", **kinds)
    for variable in ("ROS_IP", "ROS_HOSTNAME", "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        patch.setenv(variable, "")
        patch.delenv(variable)


class ShutdownError(Exception):
    """As rclpy's ExternalShutdownException, which no other of its exceptions is an ancestor of."""


class NameValidationError(Exception):
    """As rclpy's NameValidationException."""


class ParameterError(Exception):
    """As rclpy's ParameterException."""


class Rclpy(ModuleType):
    """As much of rclpy as the node uses: what is subscribed to is delivered once when it is spun.

    Like rclpy's executor it raises once its context was shut down, here after some turns.
    """

    def __init__(self, messages, given=None, ends=ShutdownError):
        super().__init__("rclpy")
        self.messages, self.published, self.subscribed, self.turns = messages, {}, {}, 0
        self.given, self.ends = given or {}, ends

    def init(self, args, signal_handler_options):
        if "wrong" in args:
            raise RuntimeError("Failed to parse global arguments\nat rcl/arguments.c")
        self.arguments, self.handles = args, signal_handler_options

    def declare_parameter(self, name, default, descriptor):
        assert descriptor.dynamic_typing  # else an integer for a number with a point raises
        return SimpleNamespace(value=self.given.get(name, default))

    def ok(self):
        return self.turns < 20

    def create_node(self, name):
        if "use_sim_time:=yes" in self.arguments:
            raise ParameterError("Trying to set parameter 'use_sim_time'")
        return self

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append, kind=kind)

    def create_subscription(self, kind, topic, handler, quality):
        if " " in topic:
            raise NameValidationError(topic)
        self.subscribed[topic] = handler
        return topic

    def destroy_subscription(self, topic):
        del self.subscribed[topic]

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=NOW_NS))

    def spin_once(self, node, timeout_sec):
        self.turns += 1
        if self.turns > 20:
            raise self.ends
        for topic, handler in list(self.subscribed.items()):
            if topic in self.messages:
                handler(self.messages.pop(topic))
        time.sleep(0.01)


@pytest.fixture
def rclpy_with(monkeypatch):
    packages_of(monkeypatch, "ros2")

    def make(messages=(), **options):
        rclpy = Rclpy(dict(messages), **options)
        monkeypatch.setitem(sys.modules, "rclpy", rclpy)
        stand_in(monkeypatch, "rclpy.qos", qos_profile_sensor_data="best effort")
        exceptions = {"NameValidationException": NameValidationError, "ParameterException": ParameterError}
        stand_in(monkeypatch, "rclpy.exceptions", **exceptions)
        stand_in(monkeypatch, "rclpy.executors", ExternalShutdownException=ShutdownError)
        stand_in(monkeypatch, "rclpy.signals", SignalHandlerOptions=SimpleNamespace(NO="none"))
        stand_in(monkeypatch, "rcl_interfaces.msg", ParameterDescriptor=SimpleNamespace)
        return rclpy

    return make


def test_the_ros2_node_hears_and_publishes_until_its_context_ends(rclpy_with, sim_site):
    maker, camera = maker_of("ros2"), Camera.from_fov(6, 4, 60.0)
    rclpy = rclpy_with({
        RosTopics().camera_info: maker.camera_info(NOW_NS, "", camera),
        RosTopics().image: an_image(maker, NOW_NS),
    })  # fmt: skip
    from scenematch.bridges import ros2

    node = ros2.Node("scenematch", ["--ros-args", "-r", "__ns:=/uav1"])
    assert rclpy.arguments == ["--ros-args", "-r", "__ns:=/uav1"]
    assert rclpy.handles == "none"
    stated = node.wait_for(RosTopics().camera_info, "sensor_msgs/msg/CameraInfo", 5.0)
    assert np.array_equal(camera_from_message(stated).matrix, camera.matrix)
    assert node.wait_for("/silent", "sensor_msgs/msg/CameraInfo", 0.01) is None
    with bridge_of(node, sim_site) as (bridge, _):
        node.spin(bridge.handlers(RosTopics()), bridge.check_input, None)
    assert {topic: len(sent) for topic, sent in rclpy.published.items()} == {
        "~/pose": 1, "~/fix": 1, "/diagnostics": 1,
    }  # fmt: skip
    assert rclpy.published["/diagnostics"][0].status[0].level == b"\x00"
    with pytest.raises(KeyboardInterrupt):  # and not "got none within 30 s"
        node.wait_for("/silent", "sensor_msgs/msg/CameraInfo", 5.0)


def test_what_ros2_does_not_take_is_one_line(rclpy_with):
    rclpy_with(given={"map_sigma_m": 3, "start": 48, "hfov_deg": "wide", "map": True, "threads": 1.5})
    from scenematch.bridges import ros2

    node = ros2.Node("scenematch")
    taken = node.parameter("map_sigma_m", 0.0), node.parameter("start", ""), node.parameter("mount", "")
    assert repr(taken) == "(3.0, '48', '')"
    for name, default, stated in (
        ("hfov_deg", 0.0, "hfov_deg: expected a number, got 'wide'"),
        ("map", "", "map: expected text, got True"),
        ("threads", 1, "threads: expected a whole number, got 1.5"),
    ):
        assert misuse(node.parameter, name, default) == stated
    with pytest.raises(OptionError, match=r"^topic: expected a name that ROS 2 permits, got 'a b'$"):
        node.wait_for("a b", "sensor_msgs/msg/CameraInfo", 0.01)
    for argument, reason in {
        "wrong": "Failed to parse global arguments", "use_sim_time:=yes": "Trying to set parameter 'use_sim_time'",
    }.items():  # fmt: skip
        with pytest.raises(OptionError, match=f"^ros_arguments: .* got {reason}$"):
            ros2.Node("scenematch", [argument])


@pytest.mark.parametrize("given", [{}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, {"ROS_LOCALHOST_ONLY": "0"}])
def test_discovery_stays_here_unless_it_is_set(rclpy_with, monkeypatch, given):
    rclpy_with()
    from scenematch.bridges import ros2

    for name, value in given.items():
        monkeypatch.setenv(name, value)
    ros2.Node("scenematch")
    names = ("ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE")
    stated = {name: ros2.os.environ[name] for name in names if name in ros2.os.environ}
    assert stated == (given or {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})


@pytest.mark.parametrize("ends", [ShutdownError, KeyboardInterrupt])
def test_a_run_that_is_ended_has_its_counts(rclpy_with, monkeypatch, flight, ends):
    """By Ctrl-C, by SIGTERM, which is made the same, or by a context that was shut down."""
    rclpy_with(ends=ends)
    monkeypatch.setattr("engine.matching.matcher.SceneMatcher.warmup", lambda self, report: None)
    before = signal.getsignal(signal.SIGTERM)
    try:
        camera = CameraInput(flight / "camera.yaml")
        settings = RosSettings(map=MapInput(flight / "map.tif"), camera=camera, version=2)
        assert run_ros_bridge(settings).line() == "0 pictures; published 0; not published: nothing"
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGTERM, before)


class Rospy(ModuleType):
    """As much of rospy as the node uses: what is subscribed to is delivered at once."""

    ROSException = TimeoutError

    def __init__(self, messages):
        super().__init__("rospy")
        self.messages, self.published, self.subscribed, self.named = messages, {}, {}, None
        self.Time = SimpleNamespace(now=lambda: SimpleNamespace(to_nsec=lambda: NOW_NS))

    def init_node(self, name, argv):
        self.named, self.arguments = name, argv

    def is_shutdown(self):
        return False

    def Publisher(self, topic, kind, queue_size, tcp_nodelay):  # noqa: N802
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def Subscriber(self, topic, kind, handler, tcp_nodelay, **options):  # noqa: N802
        self.subscribed[topic] = options
        if topic in self.messages:
            handler(self.messages[topic])

    def wait_for_message(self, topic, kind, timeout_s):
        if topic not in self.messages:
            raise TimeoutError
        return self.messages[topic]


def test_the_ros1_node_hears_and_publishes(monkeypatch, sim_site):
    maker = maker_of("ros1")
    packages_of(monkeypatch, "ros1")
    rospy = Rospy({RosTopics().image: an_image(maker, NOW_NS)})
    monkeypatch.setitem(sys.modules, "rospy", rospy)
    stand_in(monkeypatch, "genpy", Time=lambda secs, nsecs: SimpleNamespace(secs=secs, nsecs=nsecs))
    online = {"is_master_online": lambda: rospy.named is None, "get_master_uri": lambda: "http://here"}
    stand_in(monkeypatch, "rosgraph", **online)
    from scenematch.bridges import ros1

    node = ros1.Node("scenematch", ["/a:=/b"])
    assert rospy.arguments == ["/a:=/b"]
    assert ros1.os.environ["ROS_IP"] == "127.0.0.1"
    assert node.wait_for("/silent", "sensor_msgs/msg/CameraInfo", 0.01) is None
    with bridge_of(node, sim_site) as (bridge, _):
        node.spin(bridge.handlers(RosTopics()), bridge.check_input, 1.0)
    assert {topic: len(sent) for topic, sent in rospy.published.items()} == {
        "~pose": 1, "~fix": 1, "/diagnostics": 1,
    }  # fmt: skip
    assert ros_messages.stamp_ns(rospy.published["~pose"][0]) == NOW_NS
    # By rospy's own buffer pictures would grow old in the socket.
    assert rospy.subscribed[RosTopics().image] == {"queue_size": 1, "buff_size": 2**24}
    assert "expected a ROS master at http://here" in refusal(ros1.Node, "again", error=BackendError)


def test_a_camera_without_a_calibration_is_of_the_first_pictures_size(maker, node, flight, monkeypatch):
    """Of its field of view; nothing but the picture's topic is waited for."""
    node.wait_for = Mock(side_effect=[an_image(maker, NOW_NS, (30, 40, 3)), None])
    matcher = Mock(side_effect=LookupError)  # ends the run where the camera is known
    monkeypatch.setattr("engine.matching.matcher.SceneMatcher", matcher)
    camera, topics = CameraInput(hfov_deg=90.0), RosTopics(image="/down")
    settings = RosSettings(map=MapInput(flight / "map.tif"), camera=camera, topics=topics)
    with pytest.raises(LookupError):
        run_ros_bridge(settings, node=node)
    _, camera, *_ = matcher.call_args.args
    assert [asked.args[:2] for asked in node.wait_for.call_args_list] == [("/down", "sensor_msgs/msg/Image")]
    assert (camera.width_px, camera.height_px, camera.matrix[0, 0]) == (40, 30, pytest.approx(20.0))
    with pytest.raises(BackendError, match=r"image_topic: expected a picture on /down within 30 s, got none"):
        run_ros_bridge(settings, node=node)


def test_a_ros_that_is_not_there_is_one_line(monkeypatch, capsys, flight):
    for name in ("rospy", "rclpy"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setenv("ROS_IP", "127.0.0.1")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    for version, code, stated in (("1", 1, "rospy"), ("2", 1, "rclpy"), ("3", 2, "--ros: expected 1 or 2")):
        capsys.readouterr()
        assert main(["bridge", "ros", "--ros", version, "--map", str(flight / "map.tif")]) == code
        assert stated in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "moved"),
    [
        (["--ros", "2", "--map", "m"], ["--ros", "2", "--map", "m"]),
        (["/a:=/b", "--map", "m", "__name:=x"], ["--map", "m", "--", "/a:=/b", "__name:=x"]),
        (["--map", "m", "--ros-args", "-r", "a:=b", "--params-file", "f", "--", "--method", "ncc"],
         ["--map", "m", "--method", "ncc", "--", "--ros-args", "-r", "a:=b", "--params-file", "f", "--"]),
    ],
)  # fmt: skip
def test_arguments_of_ros_are_told_apart(typed, moved):
    assert ros_arguments_last(typed) == moved


def test_arguments_of_another_ros_are_refused(capsys, tmp_path):
    for version, given, stated in (
        ("1", ["--ros-args", "-r", "a:=b"], "expected NAME:=VALUE for ROS 1, got --ros-args -r"),
        ("2", ["a:=b"], "expected --ros-args -r NAME:=VALUE, got a:=b"),
        ("1", ["nonsense"], "expected NAME:=VALUE for ROS 1, got nonsense"),
    ):
        assert main(["bridge", "ros", "--ros", version, "--map", str(tmp_path / "m.tif"), *given]) == 2
        assert stated in capsys.readouterr().err
