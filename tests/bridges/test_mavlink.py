"""The MAVLink bridge: bytes as pymavlink makes them, the firmwares' traps, a stand-in autopilot on loopback."""

import contextlib
import itertools
import math
import os
import random
import re
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.quaternion import Quaternion

from bench.live.bridge_counts import free_port
from engine import Attitude, NavigatorOptions, NoFix, OptionError, Prior, Reason, TelemetryError
from engine.camera import mount_rotation
from engine.geo import LocalFrame
from scenematch.bridges import mavlink_out, mavlink_requests, packets
from scenematch.bridges.fix_velocity import GroundVelocity, VelocityFromFixes
from scenematch.bridges.links import Connection, parse_connection
from scenematch.bridges.mavlink import CONFIRM_COMMAND, MavlinkBridge
from scenematch.bridges.mavlink_in import HANDLED_MESSAGES, REQUESTED_RATES_HZ, AutopilotClock, MavlinkTelemetry
from scenematch.bridges.mavlink_out import command_message, fix_message, pose_covariance, timesync_message
from scenematch.bridges.mavlink_requests import AutopilotRequests
from scenematch.bridges.mavlink_status import MIN_RATE_HZ
from scenematch.bridges.packets import AUTOPILOT_COMPONENT, BRIDGE_COMPONENT, PacketDecoder, read_key, signing_time
from scenematch.bridges.parameters import MESSAGES, MavlinkOptions, parameter_file
from scenematch.bridges.pictures import replay
from scenematch.bridges.vehicle import NedOrigin, VehicleState, north_east_m
from scenematch.cli.app import run as main
from tests.support.fixes import a_fix
from tests.support.paths import ROOT
from tests.support.refusals import misuse
from tests.support.waiting import wait_until

GOLDEN = ROOT / "tests" / "golden" / "mavlink"
ORIGIN = NedOrigin(33.6400000, 72.9900000, 510.0)
VEHICLE = VehicleState(
    roll_deg=2.0, pitch_deg=-3.0, heading_deg=270.0, east_velocity_mps=1.0, north_velocity_mps=2.0,
    up_velocity_mps=0.5, height_agl_m=120.0, alt_amsl_m=630.0, down_m=-120.0,
)  # fmt: skip
KINDS = [(firmware, kind) for firmware, kinds in MESSAGES.items() for kind in kinds]
ORIGIN_1E7 = (336400000, 729900000, 510000)
KEY = bytes(range(32))


def fix(sigma_m=0.5, **changes):
    covariance = np.diag([sigma_m**2, (0.8 * sigma_m) ** 2, 1e6])
    place = {"timestamp_ns": 1, "lat_deg": 33.6410000, "lon_deg": 72.9920000, "covariance_m2": covariance}
    return a_fix(**(place | changes))


def sending(**changes):
    values = {
        "fix": fix(), "captured_ns": 12_345_678_901, "age_ms": 80.0, "vehicle": VEHICLE, "origin": ORIGIN,
        "velocity": GroundVelocity(1.5, -2.5, 0.7), "reset_counter": 3, "unix_ns": 1_700_000_000_123_000_000,
    }  # fmt: skip
    return mavlink_out.FixReport(**(values | changes))


def autopilot(key=None, system=1, component=1):
    """What packs the messages of a component of a vehicle."""
    made = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    if key is not None:
        made.signing.secret_key, made.signing.sign_outgoing, made.signing.timestamp = key, True, signing_time()
    return made


# -------------------------------------------------------------------------------------------- what is sent


SENT = {
    f"{firmware}-{kind}": fix_message(sending(), MavlinkOptions(firmware=firmware, message=kind))
    for firmware, kind in KINDS
} | {
    "heartbeat": mavlink_out.heartbeat_message(),
    "timesync-question": timesync_message(12_345_678_901),
    "timesync-answer": timesync_message(12_345_678_901, 5_000_000_007),
    "set_gps_global_origin": mavlink_out.set_origin_message(1, ORIGIN, 12_345_678_901),
    "ask-origin": command_message(1, mavlink.MAV_CMD_REQUEST_MESSAGE, 49),
    "ask-attitude": command_message(1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 1e6 / 50),
}


def golden(name):
    return (GOLDEN / f"{name}.hex").read_text(encoding="ascii").strip()


@pytest.mark.parametrize("name", SENT)
def test_bytes_are_the_golden_ones(name):
    assert packets.PacketEncoder(1).encode(SENT[name]).hex() == golden(name)


def test_signed_bytes_are_the_golden_ones(monkeypatch):
    monkeypatch.setattr("scenematch.bridges.packets.signing_time", lambda: 10 * 365 * 86400 * 100_000)
    made = packets.PacketEncoder(1, KEY).encode(fix_message(sending(), MavlinkOptions()))
    assert made.hex() == golden("ardupilot-signed")


def test_golden_bytes_are_made_without_the_engine(tmp_path):
    """The generator spells out every field by hand; it knows nothing of the engine."""
    assert "engine" not in (GOLDEN / "make_golden.py").read_text(encoding="utf-8")
    subprocess.run([sys.executable, str(GOLDEN / "make_golden.py"), str(tmp_path)], check=True)
    for made in tmp_path.iterdir():
        assert made.read_text(encoding="ascii").strip() == golden(made.stem)


@pytest.mark.parametrize(("firmware", "kind"), KINDS)
def test_stamps_are_of_capture_whenever_it_is_sent(firmware, kind):
    for age_ms in (0.0, 200.0):
        m = fix_message(sending(age_ms=age_ms), MavlinkOptions(firmware=firmware, message=kind))
        stamp_us = m.usec if kind == "vision_position_estimate" else m.time_usec
        waited_us = m.processing_time if kind == "global_position_sensor" else 0
        assert stamp_us - waited_us == 12_345_678


def by_ardupilot(north, east, origin):
    """Degrees by the scale of its Location, metres per 1e-7 degrees, and the cosine of the middle latitude."""
    lat = origin.lat_deg + north / 0.011131884502145034 * 1e-7
    middle = math.radians(0.5 * (lat + origin.lat_deg))
    return lat, origin.lon_deg + east / 0.011131884502145034 / math.cos(middle) * 1e-7


def by_px4(north, east, origin):
    """Degrees by the inverse of the azimuthal projection."""
    distance, lat0 = math.hypot(north, east), math.radians(origin.lat_deg)
    c, along, across = distance / 6371000.0, north / distance, east / distance
    back = math.asin(math.cos(c) * math.sin(lat0) + along * math.sin(c) * math.cos(lat0))
    turn = math.atan2(across * math.sin(c), math.cos(lat0) * math.cos(c) - along * math.sin(lat0) * math.sin(c))
    return math.degrees(back), origin.lon_deg + math.degrees(turn)


@pytest.mark.parametrize(("firmware", "back"), [("ardupilot", by_ardupilot), ("px4", by_px4)])
def test_a_firmware_finds_the_fix_again_by_its_own_projection(firmware, back):
    rng = np.random.default_rng(1)
    for _ in range(50):
        origin = NedOrigin(rng.uniform(-70, 70), rng.uniform(-180, 180), 0.0)
        lat, lon = origin.lat_deg + rng.uniform(-0.05, 0.05), origin.lon_deg + rng.uniform(-0.05, 0.05)
        back_lat, back_lon = back(*north_east_m(lat, lon, origin, firmware), origin)
        assert back_lat == pytest.approx(lat, abs=1e-9)
        assert math.remainder(back_lon - lon, 360.0) == pytest.approx(0.0, abs=1e-9)
    assert north_east_m(10.0, 20.0, NedOrigin(10.0, 20.0, 0.0), firmware) == (0.0, 0.0)


def test_the_height_does_not_drown_the_covariance():
    flat = pose_covariance(fix(sigma_m=0.5))
    assert len(flat) == 21
    n, e, d = flat[0], flat[6], flat[11]
    assert (n, e) == pytest.approx((0.4**2, 0.5**2))
    newer, older = math.sqrt(n + e + d), (n * n + e * e + d * d) ** (1 / 3)  # how ArduPilot collapses it
    assert 0.5 <= newer <= math.sqrt(3) * 0.5
    assert older <= math.sqrt(3) * 0.5
    turned = fix(covariance_m2=np.array([[4.0, 1.0, 0], [1.0, 9.0, 0], [0, 0, 1e8]]))
    assert pose_covariance(turned)[:2] == pytest.approx([9.0, 1.0])


@pytest.mark.parametrize("message", ["vision_position_estimate", "odometry"])
def test_a_whole_pose_is_sent_with_the_attitude_that_was_measured(message):
    angles_deg2 = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.25]])
    whole = fix(attitude=Attitude(1.0, 2.0, 300.0), up_m=120.0, attitude_covariance_deg2=angles_deg2)
    options, angles = MavlinkOptions(message=message), np.radians([1.0, 2.0, -60.0])
    m, own = fix_message(sending(fix=whole), options), fix_message(sending(), options)
    held = replace(VEHICLE, holder=Attitude(0.0, -45.0, 90.0))  # by a gimbal, which is not the vehicle's attitude
    gimbal = fix_message(sending(fix=whole, vehicle=held), options)
    if message == "vision_position_estimate":
        assert (m.roll, m.pitch, m.yaw) == pytest.approx(tuple(angles))
        assert (gimbal.roll, gimbal.pitch, gimbal.yaw) == (own.roll, own.pitch, own.yaw)
        covariance = "covariance"
    else:
        assert m.q == pytest.approx(list(Quaternion(angles).q))
        assert gimbal.q == own.q
        assert (m.vx, m.vy, m.vz) == (own.vx, own.vy, own.vz)  # about the autopilot's own axes
        covariance = "pose_covariance"
    # Of the upper triangle the last six are roll, pitch and yaw; a degree each is the mount's.
    expected_deg2 = [1.04, 0.01, 0.0, 1.09, 0.0, 1.25]
    assert np.array(getattr(m, covariance)[15:]) * math.degrees(1.0) ** 2 == pytest.approx(expected_deg2)
    assert getattr(gimbal, covariance) == getattr(own, covariance)
    vague = replace(whole, attitude_covariance_deg2=angles_deg2 * math.nan)
    assert mavlink_out.withhold_reason(sending(fix=vague), options)


def test_odometry_to_px4_may_have_no_velocity():
    px4 = fix_message(sending(velocity=None), MavlinkOptions(firmware="px4", message="odometry"))
    assert all(map(math.isnan, (px4.vx, px4.vy, px4.vz, px4.velocity_covariance[0])))


def test_gps_input_tells_what_is_poor_and_what_is_unknown():
    poor = fix_message(sending(fix=fix(sigma_m=4.0)), MavlinkOptions(message="gps_input"))
    assert (poor.hdop, poor.satellites_visible) == pytest.approx((4.0, 2))  # which no arming check passes
    bare = fix_message(sending(vehicle=VehicleState()), MavlinkOptions(message="gps_input"))
    assert bare.ignore_flags == mavlink.GPS_INPUT_IGNORE_FLAG_ALT | mavlink.GPS_INPUT_IGNORE_FLAG_VEL_VERT


@pytest.mark.parametrize(
    ("changes", "message", "why"),
    [
        ({}, "vision_position_estimate", None),
        ({}, "gps_input", None),
        ({"fix": fix(sigma_m=10.1)}, "gps_input", "too uncertain"),
        ({"age_ms": 250.1}, "gps_input", "too old"),
        ({"origin": None}, "vision_position_estimate", "no origin"),
        ({"origin": None}, "gps_input", None),
        ({"vehicle": VehicleState(roll_deg=0.0, pitch_deg=0.0, heading_deg=0.0)}, "odometry", "no height"),
        ({"vehicle": VehicleState(down_m=-1.0)}, "vision_position_estimate", "no attitude"),
        ({"velocity": None}, "gps_input", "no velocity"),
        ({"velocity": None}, "odometry", "no velocity"),
        ({"velocity": None}, "vision_position_estimate", None),
        ({"fix": fix(lat_deg=math.nan)}, "gps_input", "not finite"),
    ],
)
def test_what_would_mislead_is_withheld(changes, message, why):
    assert mavlink_out.withhold_reason(sending(**changes), MavlinkOptions(message=message)) == why


def test_velocity_is_that_of_the_last_fixes_and_forgets_at_a_reset():
    by_fixes, still = VelocityFromFixes(), VehicleState()
    times = np.arange(1.0, 4.0, 0.1)
    found = [by_fixes.add(fix(east_m=3.0 * t, north_m=-t), round(t * 1e9), 0, still) for t in times]
    assert found[0] is None
    assert (found[-1].east_mps, found[-1].north_mps) == pytest.approx((3.0, -1.0))
    assert found[-1].sigma_mps < 1.0  # what EKF3 asks for before it starts by GPS_INPUT
    assert by_fixes.add(fix(east_m=500.0), 4_200_000_000, 1, still) is None


def test_velocity_holds_at_the_last_fix_while_the_vehicle_brakes():
    """Its own velocity is wrong by a constant, and only its change is used."""
    by_fixes = VelocityFromFixes()
    for t in np.arange(0.0, 3.0, 0.1):
        own = VehicleState(east_velocity_mps=9.0 - 2.0 * t + 0.7, north_velocity_mps=0.4)
        found = by_fixes.add(fix(east_m=9.0 * t - t**2), round(1e9 * (1.0 + t)), 0, own)
    assert (found.east_mps, found.north_mps) == pytest.approx((9.0 - 2.0 * t, 0.0), abs=0.05)
    assert found.sigma_mps < 0.6


# ------------------------------------------------------------------------------------------ what is heard


NOW_NS = 10_000_000_000


def heard(*messages, **options):
    """The vehicle after messages that come a millisecond apart, at the time of the first."""
    telemetry = MavlinkTelemetry(**options)
    for i, message in enumerate(messages):
        telemetry.update(message, NOW_NS + i * 1_000_000)
    return telemetry.vehicle(NOW_NS)


def from_camera(message, component=197):
    """A message as it comes over the wire from another component of the vehicle."""
    return mavlink.MAVLink(None).parse_char(message.pack(autopilot(component=component)))


def speed_estimate(*ned_mps, variance=math.nan):
    covariance = [variance, 0, 0, 0, variance, 0, 0, 0, variance]
    return mavlink.MAVLink_vision_speed_estimate_message(1, *ned_mps, covariance)


def odometry(*velocity_mps, frame=mavlink.MAV_FRAME_BODY_FRD, variance=0.04, by=mavlink.MAV_ESTIMATOR_TYPE_VIO,
             quality=80):  # fmt: skip
    covariance = [math.nan] * 21
    covariance[0] = covariance[6] = covariance[11] = variance
    local, whole = mavlink.MAV_FRAME_LOCAL_FRD, [1.0, 0.0, 0.0, 0.0]
    return mavlink.MAVLink_odometry_message(
        1, local, frame, 0, 0, 0, whole, *velocity_mps, 0, 0, 0, [math.nan] * 21, covariance, 0, by, quality
    )


TO_THE_WEST = mavlink.MAVLink_attitude_message(5000, 0, 0, -math.pi / 2, 0, 0, 0)


@pytest.mark.parametrize(
    ("message", "east_north_up", "sigma_mps"),
    [
        (speed_estimate(3.0, -4.0, 0.5), (-4.0, 3.0, -0.5), None),
        (speed_estimate(3.0, -4.0, 0.5, variance=0.09), (-4.0, 3.0, -0.5), 0.3),
        (odometry(2.0, 1.0, 0.0), (-2.0, 1.0, 0.0), math.hypot(0.2, math.radians(1.0) * math.hypot(2.0, 1.0))),
        (odometry(2.0, 1.0, 0.0, variance=1e-9), (-2.0, 1.0, 0.0), 0.1),
        (odometry(30.0, 0.0, 0.0, variance=1e-9), (-30.0, 0.0, 0.0), math.radians(1.0) * 30.0),
        (odometry(2.0, 1.0, -0.25, frame=mavlink.MAV_FRAME_LOCAL_NED, variance=math.nan), (1.0, 2.0, 0.25), None),
    ],
)
def test_a_velocity_by_another_camera_counts_more_than_the_autopilots(message, east_north_up, sigma_mps):
    own = mavlink.MAVLink_local_position_ned_message(5000, 1, 2, -118.0, 1.5, -2.5, 0.5)
    vehicle = heard(TO_THE_WEST, own, from_camera(message))
    velocity = (vehicle.east_velocity_mps, vehicle.north_velocity_mps, vehicle.up_velocity_mps)
    assert velocity == pytest.approx(east_north_up, abs=1e-6)
    assert vehicle.velocity_sigma_mps == (None if sigma_mps is None else pytest.approx(sigma_mps))
    frame = vehicle.frame(np.zeros((2, 2), np.uint8), 0)
    assert (frame.east_velocity_mps, frame.velocity_sigma_mps) == (velocity[0], vehicle.velocity_sigma_mps)


@pytest.mark.parametrize(
    "message",
    [
        from_camera(odometry(1.0, 2.0, 3.0, by=mavlink.MAV_ESTIMATOR_TYPE_VISION), BRIDGE_COMPONENT),
        from_camera(odometry(1.0, 2.0, 3.0, by=mavlink.MAV_ESTIMATOR_TYPE_VISION), AUTOPILOT_COMPONENT),
        from_camera(odometry(1.0, 2.0, 3.0), AUTOPILOT_COMPONENT),
        from_camera(speed_estimate(1.0, 2.0, 3.0), AUTOPILOT_COMPONENT),
        from_camera(speed_estimate(math.nan, 2.0, 3.0)),
        from_camera(speed_estimate(1e30, 2.0, 3.0)),
        from_camera(speed_estimate(1.0, 2.0, 3.0, variance=math.inf)),
        from_camera(odometry(1.0, 2.0, 3.0, variance=3.4e38)),
        from_camera(odometry(1.0, 2.0, 3.0, variance=100.0)),
        from_camera(odometry(1.0, 2.0, 3.0, by=mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT)),
        from_camera(odometry(1.0, 2.0, 3.0, quality=-1)),
        from_camera(odometry(1.0, 2.0, 3.0, frame=mavlink.MAV_FRAME_LOCAL_FRD)),
    ],
)
def test_what_is_no_velocity_of_another_camera_is_left_out(message):
    vehicle = heard(TO_THE_WEST, message)
    assert (vehicle.east_velocity_mps, vehicle.velocity_sigma_mps) == (None, None)


@pytest.mark.parametrize(("bridge", "camera"), [(194, 197), (197, 191), (191, 197)])
def test_beside_a_camera_with_the_usual_id_the_bridge_takes_another(bridge, camera):
    """And its own messages, which a router passes back, count for nothing: neither a velocity nor a failure."""
    by = mavlink.MAV_ESTIMATOR_TYPE_VISION
    messages = [
        TO_THE_WEST,
        from_camera(odometry(2.0, 1.0, 0.0, by=by), camera),
        from_camera(odometry(9.0, 9.0, 9.0, by=by), bridge),
        from_camera(mavlink_out.no_position_message(1), bridge),
    ]
    vehicle = heard(*messages, bridge_component=bridge)
    assert (vehicle.east_velocity_mps, vehicle.north_velocity_mps) == pytest.approx((-2.0, 1.0), abs=1e-6)
    failed = from_camera(odometry(0.0, 0.0, 0.0, by=by, quality=-1), camera)
    assert heard(*messages, failed, bridge_component=bridge).east_velocity_mps is None


def test_an_accuracy_that_is_not_stated_is_not_mixed_with_one_that_is():
    telemetry = MavlinkTelemetry()
    for time_ns, variance in ((0, math.nan), (100_000_000, 4.0)):
        telemetry.update(from_camera(speed_estimate(1.0, 2.0, 3.0, variance=variance)), time_ns)
    sigmas = [telemetry.vehicle(ms * 1_000_000).velocity_sigma_mps for ms in (0, 1, 99, 100)]
    assert sigmas == [None, None, 2.0, 2.0]


@pytest.mark.parametrize("component", [191, 197, 158, 100])
def test_velocities_arrive_from_every_component_of_the_vehicle(component):
    decoder, telemetry = PacketDecoder(1, HANDLED_MESSAGES, is_stream=False), MavlinkTelemetry()
    foreign, own = speed_estimate(9.0, 9.0, 9.0), speed_estimate(3.0, -4.0, 0.5)
    for system, message in ((2, foreign), (1, own), (1, TO_THE_WEST)):
        for one in decoder.feed(bytes(message.pack(autopilot(system=system, component=component)))):
            telemetry.update(one, 1)
    vehicle = telemetry.vehicle(1)
    assert (vehicle.east_velocity_mps, vehicle.north_velocity_mps) == pytest.approx((-4.0, 3.0))
    assert vehicle.heading_deg is None  # of anything else the autopilot alone is heard


def test_units_end_at_the_door():
    vehicle = heard(
        mavlink.MAVLink_attitude_message(5000, 0.1, -0.2, -math.pi / 2, 0, 0, 0),
        mavlink.MAVLink_global_position_int_message(5000, 1, 1, 630_000, 120_000, 150, -250, 50, 9000),
        mavlink.MAVLink_local_position_ned_message(5001, 1, 2, -118.0, 1.5, -2.5, 0.5),
    )
    attitude_deg = (vehicle.roll_deg, vehicle.pitch_deg, vehicle.heading_deg)
    assert attitude_deg == pytest.approx((math.degrees(0.1), math.degrees(-0.2), 270.0))
    east_north_up = (vehicle.east_velocity_mps, vehicle.north_velocity_mps, vehicle.up_velocity_mps)
    assert east_north_up == pytest.approx((-2.5, 1.5, -0.5))
    assert (vehicle.alt_amsl_m, vehicle.height_agl_m, vehicle.down_m) == pytest.approx((630.0, 120.0, -118.0))


def test_height_is_by_the_rangefinder_then_the_clearance_then_above_home():
    home = mavlink.MAVLink_global_position_int_message(5000, 1, 1, 0, 90_000, 0, 0, 0, 0)
    clear = mavlink.MAVLink_altitude_message(5_000_000, 0, 0, 0, 0, -1001.0, 95.0)
    beam = mavlink.MAVLink_distance_sensor_message(5000, 20, 20000, 10_000, 0, 0, 25, 0)
    ahead = mavlink.MAVLink_distance_sensor_message(5000, 20, 20000, 10_000, 0, 0, 0, 0)
    level, tilted = (mavlink.MAVLink_attitude_message(5000, roll, 0, 0, 0, 0, 0) for roll in (0, math.pi / 3))
    assert heard(home).height_agl_m == pytest.approx(90.0)
    assert heard(home, clear).height_agl_m == pytest.approx(95.0)
    assert heard(home, clear, ahead).height_agl_m == pytest.approx(95.0)
    assert heard(home, clear, beam, tilted).height_agl_m == pytest.approx(50.0)
    unstamped = (mavlink.MAVLink_rangefinder_message(range_m, 1.0) for range_m in (80.0, 0.0))
    assert [heard(level, beam).height_agl_m for beam in unstamped] == [pytest.approx(80.0), None]


def test_the_date_is_the_autopilots_or_where_it_has_none_this_machines():
    telemetry, unix_us = MavlinkTelemetry(), 1_700_000_000_000_000
    telemetry.update(mavlink.MAVLink_system_time_message(0, 5000), NOW_NS)  # no date before a GPS fix
    before_ns = time.time_ns()
    stamp_ns = telemetry.unix_ns(time.monotonic_ns())
    assert before_ns - 1e8 < stamp_ns < time.time_ns() + 1e8  # this machine's
    telemetry.update(mavlink.MAVLink_system_time_message(unix_us, 6000), 11_000_000_000)
    assert telemetry.unix_ns(12_000_000_000) == unix_us * 1000 + 1_000_000_000


def test_clock_finds_the_offset_by_timesync_and_without():
    rng = random.Random(3)
    offset = 7_000_000_000
    by_arrival, by_sync = AutopilotClock(), AutopilotClock()
    for sent in range(10**10, 10**10 + 10**9, 10**7):
        delay = rng.randrange(1_000_000, 30_000_000)
        by_arrival.local_ns(sent + offset, sent + delay)
        by_sync.add_request(sent)
        by_sync.accept_response(sent, sent + delay // 2 + offset, sent + delay)
    assert abs(by_arrival.offset_ns - offset) < 3_000_000  # late by the quickest way
    assert abs(by_sync.offset_ns - offset) < 1_000_000
    by_sync.accept_response(12345, 0, 10**11)  # nobody asked
    assert abs(by_sync.offset_ns - offset) < 1_000_000


@pytest.mark.parametrize("heading_deg", [0.0, 250.0])
@pytest.mark.parametrize("pitch_deg", [-90.0, -70.0])
@pytest.mark.parametrize("kind", ["device", "locked", "mount"])
def test_a_gimbal_turns_the_mount(heading_deg, pitch_deg, kind):
    """The vehicle rolls by 10 degrees, and a stabilised camera stays where it points, down or 20 degrees ahead."""
    heading = math.radians(heading_deg)
    attitude = mavlink.MAVLink_attitude_message(5, 0.17, 0.0, heading, 0, 0, 0)
    if kind == "mount":
        message = mavlink.MAVLink_mount_orientation_message(5, 0.0, pitch_deg, 0.0)
    else:
        flags = mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK if kind == "locked" else 32
        angles = [0.0, math.radians(pitch_deg), heading if kind == "locked" else 0.0]
        q = [float(v) for v in Quaternion(angles).q]
        message = mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, 5, flags, q, 0, 0, 0, 0)
    vehicle = heard(attitude, message, gimbal_mount=mount_rotation("nadir"))
    frame = vehicle.frame(np.zeros((2, 2), np.uint8), 1)
    assert (frame.roll_deg, frame.pitch_deg) == pytest.approx((0.0, pitch_deg + 90.0), abs=1e-4)
    assert math.remainder(frame.heading_deg - heading_deg, 360.0) == pytest.approx(0.0, abs=1e-4)
    assert vehicle.roll_deg == pytest.approx(math.degrees(0.17))  # that of the messages to the autopilot


def test_an_origin_of_zeros_is_none():
    telemetry = MavlinkTelemetry()
    telemetry.update(mavlink.MAVLink_gps_global_origin_message(0, 0, 0), 1)
    assert telemetry.origin is None
    telemetry.update(mavlink.MAVLink_gps_global_origin_message(336400000, 729900000, 510000), 1)
    assert telemetry.origin == NedOrigin(pytest.approx(33.64), pytest.approx(72.99), 510.0)


def test_an_autopilot_that_starts_again_is_followed():
    telemetry = MavlinkTelemetry()
    telemetry.update(mavlink.MAVLink_gps_global_origin_message(336400000, 729900000, 0), 0)
    for ms in range(60_000, 61_000, 10):
        telemetry.update(mavlink.MAVLink_attitude_message(ms, 0.1, 0, 0, 0, 0, 0), ms * 1_000_000)
    for ms in range(0, 2000, 10):
        now = (61_000 + ms) * 1_000_000
        telemetry.update(mavlink.MAVLink_attitude_message(ms, 0.2, 0, 0, 0, 0, 0), now)
    assert telemetry.vehicle(now).roll_deg == pytest.approx(math.degrees(0.2))
    assert telemetry.origin is None


def test_a_restart_shows_in_timesync_before_it_shows_in_the_stamps():
    """Its first answer after the restart is quicker than all before it, and must not pass for a better one."""
    telemetry, boot_ns = MavlinkTelemetry(), 60_000_000_000

    def ask(now_ns, since_boot_ns, trip_ns):
        telemetry.add_timesync_request(now_ns)
        telemetry.update(mavlink.MAVLink_timesync_message(since_boot_ns, now_ns), now_ns + trip_ns)

    telemetry.update(mavlink.MAVLink_gps_global_origin_message(336400000, 729900000, 0), 0)
    for k in range(10):
        ask(k * 500_000_000, boot_ns + k * 500_000_000 + 10_000_000, 20_000_000)
    assert telemetry.origin is not None
    ask(5_000_000_000, boot_ns + 5_300_000_000, 600_000_000)  # a slow answer is no restart
    assert telemetry.origin is not None
    ask(6_000_000_000, 1_000_000, 2_000_000)
    assert telemetry.origin is None
    ask(6_500_000_000, 501_000_000, 2_000_000)
    telemetry.update(mavlink.MAVLink_attitude_message(550, 0.2, 0, 0, 0, 0, 0), 6_552_000_000)
    assert telemetry.vehicle(6_549_000_000).roll_deg == pytest.approx(math.degrees(0.2))


@pytest.mark.parametrize("step_ms", [-950, -700, -300, -50, 50, 700])
def test_a_clock_that_is_set_is_followed_from_the_next_answer_on(step_ms):
    """Less than a restart: the origin stays, and heights are those of their times, though answers took longer."""
    telemetry, boot_ms = MavlinkTelemetry(), 100_000
    telemetry.update(mavlink.MAVLink_gps_global_origin_message(336400000, 729900000, 0), 0)
    for ms in range(10_000, 14_000, 20):
        at_ns, own_ms = ms * 1_000_000, ms + boot_ms + (step_ms if ms >= 12_000 else 0)
        if ms % 500 == 0:
            trip_ns = 4_000_000 if ms < 12_000 else 20_000_000
            telemetry.add_timesync_request(at_ns)
            answer = mavlink.MAVLink_timesync_message(own_ms * 1_000_000 + trip_ns // 2, at_ns)
            telemetry.update(answer, at_ns + trip_ns)
        telemetry.update(mavlink.MAVLink_local_position_ned_message(own_ms, 0, 0, -ms * 1e-3, 0, 0, 0), at_ns)
        if ms >= 12_520 - min(step_ms, 0):
            assert telemetry.vehicle(at_ns - 100_000_000).down_m == pytest.approx(0.1 - ms * 1e-3, abs=0.01)
    assert telemetry.origin is not None


# ------------------------------------------------------------------------------------------------ security


def beat(made, firmware=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA):
    return mavlink.MAVLink_heartbeat_message(2, firmware, 0, 0, 4, 3).pack(made)


def decoder(**options):
    return PacketDecoder(1, HANDLED_MESSAGES, **({"is_stream": True} | options))


def test_packets_may_be_cut_anywhere_in_a_stream_but_not_in_datagrams():
    data = b"noise" + beat(autopilot()) + b"\xfd\x00" + beat(autopilot()) * 2
    stream = decoder()
    assert sum(len(stream.feed(data[i : i + 1])) for i in range(len(data))) >= 2
    datagrams = decoder(is_stream=False)
    half = len(beat(autopilot())) // 2
    assert not datagrams.feed(beat(autopilot())[:half])
    assert len(datagrams.feed(beat(autopilot()))) == 1  # the half before it is forgotten


def test_a_datagram_of_noise_is_given_up_soon():
    noise, datagrams = b"\xfd\x10\x00" * 20_000, decoder(is_stream=False)
    assert not datagrams.feed(noise)
    assert datagrams.dropped < 100  # not the 20,000 packets that may begin in it
    assert len(datagrams.feed(noise[:30] + beat(autopilot()))) == 1


def test_with_a_key_only_what_is_rightly_signed_and_new_is_heard():
    signed = decoder(key=KEY, is_stream=False)
    other, mine = autopilot(bytes(32)), autopilot(KEY)
    assert not signed.feed(beat(autopilot()))
    assert not signed.feed(beat(other))
    first = beat(mine)
    assert len(signed.feed(first)) == 1
    assert not signed.feed(first)  # a replay
    assert len(signed.feed(beat(mine))) == 1
    forged = bytearray(beat(mine))
    forged[-12:-6] = b"\xff" * 6  # a time far ahead must not silence the stream
    assert not signed.feed(bytes(forged))
    assert len(signed.feed(beat(mine))) == 1
    old = autopilot(KEY)
    old.signing.link_id, old.signing.timestamp = 9, signing_time() - 6_100_000
    assert not signed.feed(beat(old))


def test_keys_are_bytes_or_hexadecimal(tmp_path):
    raw, text, bad = tmp_path / "raw", tmp_path / "text", tmp_path / "bad"
    raw.write_bytes(KEY)
    text.write_text(KEY.hex() + "\n", encoding="ascii")
    bad.write_text("secret", encoding="ascii")
    assert read_key(raw) == read_key(text) == KEY
    assert "32 bytes" in misuse(read_key, bad)


@pytest.mark.slow
def test_hours_of_traffic_leave_nothing_behind():
    from bench.live.fuzz_mavlink import growth_bytes

    assert growth_bytes(hours=0.05) < 20_000


@pytest.mark.slow
def test_minutes_of_the_hour_in_which_everything_goes_wrong():
    from bench.live.bridge_hour import hour

    flown = hour(minutes=1.5, flood_pieces=2000)
    assert flown["due"] > 200
    nothing = ("missing", "twice", "foreign", "unwanted")
    assert {name: flown[name] for name in nothing} == dict.fromkeys(nothing, 0)
    assert flown["steps"] == flown["resets"]
    assert flown["reconnections"] == 2
    assert flown["least_hz"] >= MIN_RATE_HZ
    assert flown["stamp_off_ms"] < 12.5  # half of what the link may take
    assert flown["place_off_m"] < 0.01
    assert flown["heading_off_deg"] < 1.0
    assert flown["unplaced"] == 0


@pytest.mark.slow
def test_random_and_mutated_packets_harm_nothing():
    from bench.live.fuzz_mavlink import fuzz

    assert fuzz(count=3000, seed=5).longest_s < 2.0


# --------------------------------------------------------------------------------------------- connections


@pytest.mark.parametrize(
    "text",
    ["", "udp:127.0.0.1", "udpin:127.0.0.1", "udpin::1", "udpin:127.0.0.1:0", "tcp:host:65536", "udp:", "udp://",
     "serial:/dev/x:a", "serial:/dev/x", "/dev/x", "tcp:host:１２", "127.0.0.1:14550", "tcp:5760", "udpout:14550"],
)  # fmt: skip
def test_bad_connection_strings_are_refused_in_one_line(text):
    assert "connect: expected udpin:HOST:PORT" in misuse(parse_connection, text)


@pytest.mark.parametrize(
    ("text", "kind", "host", "number"),
    [
        ("udp:127.0.0.1:14550", "udpin", "127.0.0.1", 14550),  # pymavlink, MAVProxy
        ("udp:14550", "udpin", "127.0.0.1", 14550),
        ("udpin:14550", "udpin", "127.0.0.1", 14550),
        ("udpin:localhost:14550", "udpin", "localhost", 14550),
        ("udp://:14540", "udpin", "127.0.0.1", 14540),  # MAVSDK
        ("udp://127.0.0.1:14540", "udpin", "127.0.0.1", 14540),
        ("udpin://[::1]:14540", "udpin", "::1", 14540),
        ("udpout://192.168.1.12:14550", "udpout", "192.168.1.12", 14550),
        ("tcp:localhost:5760", "tcp", "localhost", 5760),
        ("tcpout://127.0.0.1:5760", "tcp", "127.0.0.1", 5760),
        ("serial:/dev/ttyACM0:57600", "serial", "/dev/ttyACM0", 57600),
        ("serial:///dev/ttyACM0:57600", "serial", "/dev/ttyACM0", 57600),  # MAVSDK
        ("/dev/ttyACM0,57600", "serial", "/dev/ttyACM0", 57600),  # MAVProxy
        ("/dev/ttyACM0:57600", "serial", "/dev/ttyACM0", 57600),
        ("serial:COM3:115200", "serial", "COM3", 115200),
    ],
)
def test_connection_strings_are_read_as_people_type_them(text, kind, host, number):
    assert parse_connection(text) == Connection(kind, host, number)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.2", "[::]", "example.org"])
def test_nothing_listens_off_loopback_unless_told(host):
    assert "`listen_anywhere`" in misuse(parse_connection, f"udpin:{host}:14550")
    assert "`listen_anywhere`" in misuse(parse_connection, f"udp://{host}:14550")
    assert parse_connection(f"udpin:{host}:14550", listen_anywhere=True).number == 14550
    assert parse_connection(f"udpout:{host}:14550").kind == "udpout"
    assert parse_connection("udp://:14540", listen_anywhere=True).host == "0.0.0.0"


# ---------------------------------------------------------------------------------------------- parameters


def parameters(message, gps_id=0, **options):
    """Values by name of a parameter file of ArduPilot."""
    text = parameter_file(MavlinkOptions(message=message, gps_id=gps_id), **options)
    return dict(line.split(",") for line in text.splitlines() if not line.startswith("#"))


def test_parameter_files():
    values = parameters(message="vision_position_estimate", delay_ms=120)
    assert (values["VISO_TYPE"], values["VISO_DELAY_MS"], values["EK3_SRC1_POSXY"]) == ("1", "120", "6")
    assert values["GPS1_TYPE"] == "0"
    text = parameter_file(MavlinkOptions(firmware="px4", message="global_position_sensor"), delay_ms=120)
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    assert all(len(row) == 5 and row[:2] == ["1", "1"] and len(row[2]) <= 16 for row in rows)
    assert ["1", "1", "EKF2_AGP0_CTRL", "1", "6"] in rows
    assert ["1", "1", "EKF2_AGP0_DELAY", "120", "9"] in rows
    assert ["1", "1", "EKF2_DELAY_MAX", "120", "9"] in rows  # a fix that waits longer is further behind
    assert "EKF2_EV_CTRL\t1\t6" in parameter_file(MavlinkOptions(firmware="px4", message="odometry"))
    assert "250" in misuse(parameter_file, MavlinkOptions(message="vision_position_estimate"), delay_ms=251)


def test_a_take_off_with_gnss_leaves_the_receiver_in_the_first_source_set_and_a_switch():
    values = parameters(message="vision_position_estimate", takeoff="gnss")
    assert (values["EK3_SRC1_POSXY"], values["EK3_SRC2_POSXY"], values["RC7_OPTION"]) == ("3", "6", "90")
    assert "GPS1_TYPE" not in values
    assert {"FS_EKF_ACTION", "FS_EKF_THRESH"} <= set(values)
    with pytest.raises(OptionError, match="takeoff: expected none for px4"):
        parameter_file(MavlinkOptions(firmware="px4", message="odometry"), takeoff="gnss")


def test_gps_input_stands_beside_a_receiver_as_the_second():
    values = parameters(message="gps_input", takeoff="gnss", gps_id=1, delay_ms=30)
    assert (values["GPS2_TYPE"], values["GPS2_DELAY_MS"]) == ("14", "30")
    assert values["GPS_AUTO_SWITCH"] == "4"  # by the most satellites it would change over on the ground
    assert parameters(message="gps_input", delay_ms=0)["GPS1_DELAY_MS"] == "1"  # 0 would mean 200
    assert fix_message(sending(), MavlinkOptions(message="gps_input", gps_id=1)).gps_id == 1
    with pytest.raises(OptionError, match="gps_id: expected 1 or more beside a receiver"):
        parameter_file(MavlinkOptions(message="gps_input"), takeoff="gnss")
    assert "gps_id: expected with gps_input only" in misuse(MavlinkOptions, gps_id=1)


def test_a_system_id_that_mavlink_cannot_send_is_refused():
    assert "system_id: expected 1 to 255, got 256" in misuse(MavlinkOptions, system_id=256)


def test_the_delay_is_the_one_that_is_given_and_said(tmp_path, capsys):
    words = ["bridge", "mavlink", "--force", "--write-params", str(tmp_path / "x.param")]
    assert main(words) == 0
    assert "100 ms" in capsys.readouterr().err
    assert main([*words, "--settings", "parameters.delay_ms=33"]) == 0
    assert "33 ms" in capsys.readouterr().err
    assert "VISO_DELAY_MS,33\n" in (tmp_path / "x.param").read_text(encoding="utf-8")


# ------------------------------------------------------------------------------------------ in the loop


class Standin:
    """An autopilot on loopback: heartbeats, attitude, positions, TIMESYNC, an origin once it is given one."""

    def __init__(self, port, *, origin=None, key=None, receiver=None, uptime_ns=5_000_000_000):
        self.uptime_ns = uptime_ns  # when it is heard first
        self.mav = autopilot(key)
        self.parser = mavlink.MAVLink(None)
        self.parser.robust_parsing = True
        self.parser.signing.secret_key = key
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(0.02)
        self.receiver, self.armed = receiver, False
        self.origin, self.got, self.silent, self.over = origin, [], False, threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.begin_ns = time.monotonic_ns()
        self.thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.over.set()
        self.thread.join()
        self.socket.close()

    def boot_ns(self):
        return time.monotonic_ns() - self.begin_ns + self.uptime_ns

    def send(self, message):
        if not self.silent:
            with contextlib.suppress(ConnectionRefusedError):  # nobody listens yet, or any more
                self.socket.send(message.pack(self.mav))

    def run(self):
        tick = 0
        while not self.over.is_set():
            ms = self.boot_ns() // 1_000_000
            if tick % 10 == 0:
                self.send(mavlink.MAVLink_heartbeat_message(2, 3, 128 if self.armed else 0, 0, 4, 3))
                self.send(mavlink.MAVLink_timesync_message(0, self.boot_ns()))
            self.send(mavlink.MAVLink_attitude_message(ms, 0.0, 0.0, 0.5, 0, 0, 0))
            self.send(mavlink.MAVLink_local_position_ned_message(ms, 0, 0, -100.0, 0, 0, 0))
            if self.receiver is not None:
                self.send(mavlink.MAVLink_gps_raw_int_message(0, *self.receiver, 0, 0, 0, 0, 0, 9, h_acc=1000))
            self.send(mavlink.MAVLink_global_position_int_message(ms, 1, 1, 0, 100_000, 0, 0, 0, 0))
            tick += 1
            self.listen()

    def listen(self):
        try:
            data = self.socket.recv(2048)
        except OSError:
            return
        if self.silent:
            return
        for message in self.parser.parse_buffer(data) or []:
            self.got.append((message, time.monotonic_ns()))
            kind = message.get_type()
            if kind == "TIMESYNC" and message.tc1 == 0:
                self.send(mavlink.MAVLink_timesync_message(self.boot_ns(), message.ts1))
            if kind == "SET_GPS_GLOBAL_ORIGIN" and self.origin is None:
                self.origin = (message.latitude, message.longitude, message.altitude)
            if kind in ("COMMAND_LONG", "SET_GPS_GLOBAL_ORIGIN") and self.origin is not None:
                self.send(mavlink.MAVLink_gps_global_origin_message(*self.origin))

    def of(self, kind):
        return [(m, at) for m, at in list(self.got) if m.get_type() == kind]


class Matched:
    """A navigator whose every frame is a fix; it re-localises when asked to."""

    options = NavigatorOptions()

    def __init__(self):
        self.reset_count, self.frames, self.result = 0, [], None

    def update(self, frame, prior=None, budget=None):
        self.frames.append(frame)
        return self.result or fix(timestamp_ns=frame.timestamp_ns)


def test_a_flight_that_is_played_begins_when_it_is_told(tmp_path):
    for index in range(2):
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.zeros((8, 8), np.uint8))
    begun_ns = []

    def wait():
        time.sleep(0.2)
        begun_ns.append(time.monotonic_ns())

    first, second = (captured_ns for _, captured_ns in replay(tmp_path, None, rate_hz=50.0, wait=wait))
    assert [first >= at_ns for at_ns in begun_ns] == [True]
    assert second - first == 20_000_000
    for index in (2, 3):
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.full((8, 8), index, np.uint8))
    played = list(replay(tmp_path, None, rate_hz=50.0, every=2))  # one in two, each at its own time
    assert [picture.max() for picture, _ in played] == [0, 2]
    assert played[1][1] - played[0][1] == 40_000_000
    with pytest.raises(TelemetryError, match="no such"):  # before its first picture is asked for
        replay(tmp_path / "none", None, rate_hz=50.0)


@pytest.fixture
def bridge_to():
    """Makes a bridge that listens on a free port of loopback, and its navigator; closes both."""
    opened = []

    def make(options=None, **more):
        port, navigator, starts = free_port(), Matched(), []
        link = parse_connection(f"udpin:127.0.0.1:{port}")
        options = options or MavlinkOptions()
        bridge = MavlinkBridge(link, lambda start: starts.append(start) or navigator, options, **more)
        opened.append(bridge)
        return SimpleNamespace(bridge=bridge, navigator=navigator, port=port, starts=starts)

    yield make
    for bridge in opened:
        bridge.close()


@pytest.fixture
def loop(bridge_to):
    """Makes a bridge in the loop with its navigator, and a stand-in autopilot, by default with an origin."""
    with contextlib.ExitStack() as flown:

        def make(options=None, pilot=None, **more):
            made, stated = bridge_to(options, **more), {"origin": ORIGIN_1E7} if pilot is None else pilot
            return made, flown.enter_context(Standin(made.port, **stated))

        yield make


def fly(bridge, until, *, timeout_s=120.0, every_s=0.02):
    """Pictures at 50 Hz until something holds; their captures."""
    image, captures, end = np.zeros((4, 4, 3), np.uint8), [], time.monotonic() + timeout_s
    while not until():
        assert time.monotonic() < end, bridge.status
        captures.append(time.monotonic_ns())
        bridge.submit(image, captures[-1])
        time.sleep(every_s)
    return captures


def test_fixes_reach_the_autopilot_with_stamps_of_capture(loop):
    made, pilot = loop()
    captures = fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) >= 40)
    got = pilot.of("VISION_POSITION_ESTIMATE")
    stamps = [m.usec for m, _ in got]
    assert set(stamps) <= {c // 1000 for c in captures}
    assert all(b > a for a, b in itertools.pairwise(stamps))
    north, east = north_east_m(fix().lat_deg, fix().lon_deg, ORIGIN, "ardupilot")
    m = got[-1][0]
    assert (m.x, m.y, m.z) == pytest.approx((north, east, -100.0), abs=1e-2)
    assert m.yaw == pytest.approx(0.5, abs=1e-6)
    frame = made.navigator.frames[-1]
    assert frame.heading_deg == pytest.approx(math.degrees(0.5), abs=1e-4)
    assert frame.height_agl_m == pytest.approx(100.0)
    # The clock of the stamps is the one that TIMESYNC was answered on.
    answers = [m for m, _ in pilot.of("TIMESYNC") if m.tc1 != 0]
    assert answers
    assert all(captures[0] - 10**10 < m.tc1 < captures[-1] + 10**10 for m in answers)


def test_a_packet_that_cannot_be_read_does_not_end_the_reading(loop, monkeypatch, caplog):
    made, pilot = loop()
    update, faults = made.bridge.telemetry.update, []

    def fail_thrice(message, now_ns):
        if len(faults) < 3:
            faults.append(message)
            raise ValueError("cannot convert float NaN to integer")
        update(message, now_ns)

    monkeypatch.setattr(made.bridge.telemetry, "update", fail_thrice)
    # One record of three faults, the first, however short a time the machine has been up.
    monkeypatch.setattr("scenematch.bridges.mavlink._REOPEN_S", 1e9)
    fly(made.bridge, lambda: len(faults) == 3)
    before = len(pilot.of("VISION_POSITION_ESTIMATE"))
    fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) > before)
    assert [record.exc_info[0] for record in caplog.records if record.exc_info] == [ValueError]


def test_an_origin_is_set_where_there_is_none_and_nothing_is_sent_before(loop, monkeypatch):
    """After 3 s of an autopilot that has had time to find a receiver, here a tenth of it."""
    monkeypatch.setattr(mavlink_requests, "_ORIGIN_TIMEOUT_NS", 300_000_000)
    monkeypatch.setattr(mavlink_requests, "_PERIOD_NS", 100_000_000)
    made, pilot = loop(origin=ORIGIN, pilot={"uptime_ns": 30_000_000_000})
    fly(made.bridge, lambda: pilot.of("VISION_POSITION_ESTIMATE"))
    given = pilot.of("SET_GPS_GLOBAL_ORIGIN")
    assert [(m.latitude, m.longitude, m.altitude) for m, _ in given[:1]] == [(336400000, 729900000, 510000)]
    assert given[0][1] < pilot.of("VISION_POSITION_ESTIMATE")[0][1]
    assert made.bridge.status.withheld["no origin"] > 0


@pytest.mark.parametrize(
    ("begin_s", "armed", "receiver", "expected_s"),
    [
        (30.0, False, 0, 4.0),  # the first request after 3 s
        (5.0, False, 0, 15.0),  # it may find a receiver until 20 s after its start
        (5.0, True, 0, 4.0),  # none is looked for in flight
        (30.0, False, 1, 61.0),  # a receiver may get its fix for a minute
    ],
)
def test_an_origin_is_set_when_no_receiver_will_set_a_better_one(begin_s, armed, receiver, expected_s):
    """By a clock of the test's own, asked every 0.1 s: how long after the vehicle is first heard."""
    requests, telemetry = AutopilotRequests(MavlinkOptions(), ORIGIN, with_gimbal=False), MavlinkTelemetry()
    now_ns = 10**15
    requests.restart(now_ns)
    telemetry.update(mavlink.MAVLink_gps_raw_int_message(0, receiver, 0, 0, 0, 0, 0, 0, 0, 0), now_ns)
    for tenths in range(1000):
        telemetry.armed, telemetry.uptime_ms = armed, begin_s * 1000.0 + 100.0 * tenths
        sent = requests.due(telemetry, now_ns + tenths * 100_000_000)
        if any(message.get_type() == "SET_GPS_GLOBAL_ORIGIN" for message in sent):
            assert tenths / 10.0 == expected_s
            return
    pytest.fail("no origin was set in 100 s")


def test_an_origin_that_is_lost_is_set_again_only_after_the_wait():
    requests = AutopilotRequests(MavlinkOptions(), ORIGIN, with_gimbal=False)
    requests.restart(0)
    for second in range(60):
        known = ORIGIN if second < 40 else None
        telemetry = SimpleNamespace(origin=known, has_receiver=False, armed=False, uptime_ms=10**6)
        sent = [message.get_type() for message in requests.due(telemetry, 10**15 + second * 10**9)]
        assert ("SET_GPS_GLOBAL_ORIGIN" in sent) == (second >= 43)


@pytest.mark.parametrize(("local_ms", "down_m"), [(1000, -120.0), (0, -100.0)])
def test_the_height_goes_on_by_that_above_home_where_there_is_no_local_position(local_ms, down_m):
    """Home is 20 m above the origin. ArduPilot has no local position before the first fix, and must get it."""
    telemetry = MavlinkTelemetry()
    for ms in range(0, 3000, 100):
        now_ns = 10_000_000_000 + ms * 1_000_000
        if ms < local_ms:
            telemetry.update(mavlink.MAVLink_local_position_ned_message(ms, 0, 0, -120.0, 0, 0, 0), now_ns)
        telemetry.update(mavlink.MAVLink_global_position_int_message(ms, 1, 1, 0, 100_000, 0, 0, 0, 0), now_ns)
    assert telemetry.vehicle(now_ns).down_m == pytest.approx(down_m)


@pytest.mark.parametrize(("flags", "known"), [(831, True), (831 & ~2, False), (831 | 128, False), (167, False)])
def test_a_velocity_that_the_estimator_does_not_know_is_none(flags, known):
    status = mavlink.MAVLink_ekf_status_report_message(flags, 0, 0, 0, 0, 0)
    position = mavlink.MAVLink_global_position_int_message(5, 1, 1, 0, 9, 0, 0, 0, 0)
    assert (heard(status, position).east_velocity_mps is not None) == known


@pytest.mark.parametrize(("armed", "period_s", "known"), [(True, 0.2, 11), (True, 2.0, 5), (False, 0.2, 0)])
def test_an_estimator_that_aligned_in_the_air_knows_its_velocity_after_two_seconds_of_fixes(
    armed, period_s, known
):
    """At 5 Hz; of slower fixes each counts as half a second. On the ground it knows that it stands."""
    telemetry, time_ns = MavlinkTelemetry(), NOW_NS
    beat = mavlink.MAVLink_heartbeat_message(2, 3, 128 if armed else 0, 0, 4, 3)
    for flags in (167, 831):
        telemetry.update(beat, time_ns)
        telemetry.update(mavlink.MAVLink_ekf_status_report_message(flags, 0, 0, 0, 0, 0), time_ns)
    telemetry.update(mavlink.MAVLink_global_position_int_message(5, 1, 1, 0, 9, 0, 0, 0, 0), time_ns)
    sent = 0
    while telemetry.vehicle(time_ns).east_velocity_mps is None:
        telemetry.add_sent(NOW_NS + round(sent * period_s * 1e9))
        sent += 1
    assert sent == known


def test_each_firmware_is_asked_for_what_it_has(loop):
    made, pilot = loop(pilot={})
    fly(made.bridge, lambda: len(pilot.of("COMMAND_LONG")) >= 8)
    asked = {m.param1 for m, _ in pilot.of("COMMAND_LONG") if m.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}
    assert mavlink.MAVLINK_MSG_ID_ALTITUDE not in asked  # "No ap_message for mavlink id 141"
    assert mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT in asked
    assert mavlink.MAVLINK_MSG_ID_ALTITUDE in REQUESTED_RATES_HZ["px4"]


def sent_in_flight(made, pilot, kind):
    """How many messages of a kind come, once the vehicle is armed, while frames are refused."""
    pilot.armed = True
    fly(made.bridge, lambda: made.bridge.telemetry.armed)
    before = len(pilot.of(kind))
    fly(made.bridge, lambda: made.bridge.status.refused["no_texture"] > 40)
    return len(pilot.of(kind)) - before


def test_a_camera_that_sees_nothing_does_not_keep_the_vehicle_from_arming(loop):
    """ArduPilot's check wants a message of visual odometry in the last 0.3 s; its quality says it is no fix."""
    made, pilot = loop()
    made.navigator.result = NoFix(reason=Reason.NO_TEXTURE)
    fly(made.bridge, lambda: len(pilot.of("ODOMETRY")) >= 5)
    assert {m.quality for m, _ in pilot.of("ODOMETRY")} == {-1}
    assert sent_in_flight(made, pilot, "ODOMETRY") <= 2  # in flight its health is that of the fixes
    assert not pilot.of("VISION_POSITION_ESTIMATE")


def test_a_second_receiver_repeats_the_first_until_the_vehicle_is_armed(loop):
    """ArduPilot's check wants a fix of every receiver, and on the ground a camera sees nothing."""
    options, receiver = MavlinkOptions(message="gps_input", gps_id=1), (3, *ORIGIN_1E7[:2])
    made, pilot = loop(options, pilot={"receiver": receiver})
    made.navigator.result = NoFix(reason=Reason.NO_TEXTURE)
    fly(made.bridge, lambda: len(pilot.of("GPS_INPUT")) >= 5)
    repeated = pilot.of("GPS_INPUT")[-1][0]
    assert (repeated.gps_id, repeated.fix_type, repeated.lat, repeated.lon) == (1, 3, 336400000, 729900000)
    assert repeated.ignore_flags & mavlink.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ
    # The quickest message counts as the one without delay, and must be a fix.
    assert repeated.time_usec <= time.monotonic_ns() // 1000 - 250_000
    assert sent_in_flight(made, pilot, "GPS_INPUT") <= 2  # in flight it has a fix where the camera has one


def test_the_pilot_is_told_when_fixes_begin_and_stop(loop, monkeypatch):
    monkeypatch.setattr("scenematch.bridges.notices._STOPPED_S", 1.5)
    made, pilot = loop()
    fly(made.bridge, lambda: pilot.of("STATUSTEXT"))
    made.navigator.result = NoFix(reason=Reason.NO_TEXTURE)
    fly(made.bridge, lambda: len(pilot.of("STATUSTEXT")) >= 2)
    made.navigator.result = None
    fly(made.bridge, lambda: len(pilot.of("STATUSTEXT")) >= 3)
    texts = [m.text for m, _ in pilot.of("STATUSTEXT")]
    assert texts[0] == texts[2] == "Scenematch: fixes begin"
    assert re.fullmatch(r"Scenematch: fixes stopped, \d+ refused: no texture", texts[1])


def test_fixes_that_contradict_the_track_are_sent_on_an_operators_word_only(loop):
    made, pilot = loop()
    fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) >= 5)
    made.navigator.result = fix(east_m=40.0)
    fly(made.bridge, lambda: made.bridge.status.withheld.get("contradicts the track", 0) > 10)
    before = len(pilot.of("VISION_POSITION_ESTIMATE"))
    assert any(m.text.startswith("Scenematch: map doubted, 40 m off") for m, _ in pilot.of("STATUSTEXT"))
    station = autopilot(system=255, component=190)  # on the vehicle's link, as an autopilot passes it on
    number = mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
    word = mavlink.MAVLink_command_long_message(1, number, CONFIRM_COMMAND, 0, *[0.0] * 7)
    pilot.socket.send(word.pack(station))
    fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) > before + 5)
    assert [m.result for m, _ in pilot.of("COMMAND_ACK")] == [mavlink.MAV_RESULT_ACCEPTED]


def test_a_navigator_that_followed_a_shifted_map_starts_anew_where_its_refused_matches_continue_the_track(loop):
    made, pilot = loop()
    fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) >= 5)
    made.navigator.result = fix(east_m=40.0)
    fly(made.bridge, lambda: made.bridge.status.withheld.get("contradicts the track", 0) > 10)
    made.navigator.result = NoFix(reason=Reason.INCONSISTENT, match=fix(east_m=1.0))
    fly(made.bridge, lambda: len(made.starts) > 1)
    assert made.starts[0] is None
    assert made.starts[1].east_m == 1.0
    made.navigator.result, before = fix(east_m=1.0), len(pilot.of("VISION_POSITION_ESTIMATE"))
    fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) > before + 5)
    assert len(made.starts) == 2


def test_a_bridge_of_another_id_sends_by_it_is_commanded_by_it_and_hears_197(loop):
    made, pilot = loop(MavlinkOptions(component_id=194, use_velocity=False))
    camera, station = autopilot(component=197), autopilot(system=255, component=190)
    for number in (197, 194):
        word = mavlink.MAVLink_command_long_message(1, number, CONFIRM_COMMAND, 0, *[0.0] * 7)
        fly(made.bridge, lambda: pilot.of("HEARTBEAT"))
        pilot.socket.send(word.pack(station))

    def seen():
        pilot.socket.send(odometry(2.0, 1.0, 0.0, by=mavlink.MAV_ESTIMATOR_TYPE_VISION).pack(camera))
        frames = made.navigator.frames
        return frames and frames[-1].east_velocity_mps is not None and pilot.of("COMMAND_ACK")

    fly(made.bridge, seen)
    fly(made.bridge, lambda: pilot.of("VISION_POSITION_ESTIMATE"))
    assert len(pilot.of("COMMAND_ACK")) == 1
    for kind in ("HEARTBEAT", "COMMAND_ACK", "VISION_POSITION_ESTIMATE"):
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m, _ in pilot.of(kind)} == {(1, 194)}


@pytest.mark.parametrize(("use_velocity", "expected"), [(True, 0.0), (False, None)])
def test_the_autopilots_velocity_is_used_if_the_bridge_is_told_so(loop, use_velocity, expected):
    made, _ = loop(MavlinkOptions(use_velocity=use_velocity), pilot={})
    frames = made.navigator.frames
    fly(made.bridge, lambda: len(frames) > 10 and frames[-1].heading_deg is not None)
    assert (frames[-1].east_velocity_mps, frames[-1].north_velocity_mps) == (expected, expected)


AT_THE_ORIGIN = Prior(lat_deg=33.64, lon_deg=72.99, sigma_m=20.0)


@pytest.mark.parametrize(
    ("given", "off_m", "is_sent"),
    [
        ({"pilot": {"origin": ORIGIN_1E7, "receiver": (3, *ORIGIN_1E7[:2])}}, 40.0, True),
        ({"start": AT_THE_ORIGIN, "resumed": True}, 400.0, True),
        ({"start": AT_THE_ORIGIN, "resumed": False}, 400.0, False),
    ],
    ids=["heard", "resumed", "not heard"],
)
def test_the_first_fixes_are_held_against_the_receiver(loop, given, off_m, is_sent, monkeypatch):
    """Or wait for the autopilot's word on it; a bridge that goes on from its last fix asks for none."""
    monkeypatch.setattr("scenematch.bridges.mavlink._GNSS_STALE_NS", 10**15)
    made, pilot = loop(site=SimpleNamespace(frame=LocalFrame(33.64, 72.99)), **given)
    made.navigator.result = fix(east_m=off_m)
    fly(made.bridge, lambda: made.bridge.status.withheld.get("contradicts the track", 0) > 5)
    made.navigator.result = fix(east_m=1.0)
    if is_sent:
        fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) > 2)
    else:
        fly(made.bridge, lambda: made.bridge.status.withheld.get("receiver not heard yet", 0) > 5)
        assert not pilot.of("VISION_POSITION_ESTIMATE")


@pytest.mark.parametrize(
    ("resumed", "system_id", "is_connected"), [(True, 1, True), (False, 1, False), (True, 255, False)]
)
def test_a_bridge_that_goes_on_waits_for_no_heartbeat(bridge_to, resumed, system_id, is_connected):
    made = bridge_to(start=AT_THE_ORIGIN, resumed=resumed)
    sender = autopilot(system=system_id)
    confirm = mavlink.MAVLink_command_long_message(1, BRIDGE_COMPONENT, CONFIRM_COMMAND, 0, *[0.0] * 7)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.connect(("127.0.0.1", made.port))
        line.settimeout(0.5)
        for message in (mavlink.MAVLink_attitude_message(5_000, 0, 0, 0, 0, 0, 0), confirm):
            line.send(message.pack(sender))
        if is_connected:
            assert line.recv(2048)  # requests
        else:
            with pytest.raises(TimeoutError):
                line.recv(2048)
    assert made.bridge.connected == made.bridge.telemetry.armed == is_connected


def test_the_navigators_options_decide_what_contradicts_the_track(loop, monkeypatch):
    monkeypatch.setattr(Matched, "options", NavigatorOptions(gate=1e9))
    made, pilot = loop()
    fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) >= 5)
    made.navigator.result = fix(east_m=40.0)
    fly(made.bridge, lambda: pilot.of("VISION_POSITION_ESTIMATE")[-1][0].y > 30.0)
    assert "contradicts the track" not in made.bridge.status.withheld


def test_reset_counter_steps_once_per_relocalisation(loop):
    made, pilot = loop()
    fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) >= 5)
    made.navigator.reset_count = 1
    fly(made.bridge, lambda: pilot.of("VISION_POSITION_ESTIMATE")[-1][0].reset_counter == 1)
    made.navigator.reset_count = 256
    fly(made.bridge, lambda: pilot.of("VISION_POSITION_ESTIMATE")[-1][0].reset_counter == 0)
    counters = [m.reset_counter for m, _ in pilot.of("VISION_POSITION_ESTIMATE")]
    assert [c for i, c in enumerate(counters) if i == 0 or c != counters[i - 1]] == [0, 1, 0]


@pytest.mark.parametrize(
    ("firmware", "result", "why"),
    [
        ("ardupilot", fix(sigma_m=11.0), "too uncertain"),
        ("ardupilot", NoFix(reason=Reason.NO_TEXTURE), "no_texture"),
        ("px4", None, "other firmware"),
    ],
)
def test_nothing_is_sent_of_poor_fixes_and_refusals_and_to_the_other_firmware(loop, firmware, result, why):
    made, pilot = loop(MavlinkOptions(firmware=firmware))
    made.navigator.result = result
    fly(made.bridge, lambda: (made.bridge.status.withheld | made.bridge.status.refused).get(why, 0) > 3)
    assert not pilot.of("VISION_POSITION_ESTIMATE") + pilot.of("GLOBAL_POSITION_SENSOR")


def test_reconnects_after_silence_and_to_a_new_address(bridge_to, monkeypatch):
    monkeypatch.setattr("scenematch.bridges.mavlink._SILENCE_NS", 2_000_000_000)
    made = bridge_to()
    with Standin(made.port, origin=ORIGIN_1E7) as pilot:
        fly(made.bridge, lambda: pilot.of("VISION_POSITION_ESTIMATE"))
        pilot.silent = True
        fly(made.bridge, lambda: not made.bridge.connected)
    with Standin(made.port, origin=ORIGIN_1E7) as pilot:
        fly(made.bridge, lambda: pilot.of("VISION_POSITION_ESTIMATE"))
    assert made.bridge.status.reconnections == 1


def test_with_a_key_what_is_not_signed_cannot_steer_even_from_the_vehicles_own_address(loop):
    made, pilot = loop(key=KEY, pilot={"origin": ORIGIN_1E7, "key": KEY})
    fly(made.bridge, lambda: pilot.of("VISION_POSITION_ESTIMATE"))
    liar = autopilot()
    lies = mavlink.MAVLink_gps_global_origin_message(1, 1, 1).pack(liar) + beat(liar)
    lies += mavlink.MAVLink_attitude_message(1, 1.0, 1.0, 1.0, 0, 0, 0).pack(liar)
    before = made.bridge.status.dropped
    for _ in range(50):
        pilot.socket.send(lies)
    fly(made.bridge, lambda: made.bridge.status.dropped >= before + 100)
    fly(made.bridge, lambda: len(made.navigator.frames) > 5)
    assert made.navigator.frames[-1].roll_deg == pytest.approx(0.0)
    assert made.bridge.telemetry.origin.lat_deg == pytest.approx(33.64)


@pytest.mark.skipif(not Path("/proc/net/udp").exists(), reason="asks Linux which sockets are open")
def test_the_open_sockets_are_those_of_loopback(bridge_to):
    bridge_to()
    links = [f"/proc/self/fd/{number}" for number in os.listdir("/proc/self/fd")]
    own = {os.readlink(link) for link in links if os.path.lexists(link)}
    addresses = []
    for table in ("udp", "udp6", "tcp", "tcp6"):
        rows = [line.split() for line in Path(f"/proc/net/{table}").read_text(encoding="ascii").splitlines()[1:]]
        addresses += [(table, row[1].split(":")[0]) for row in rows if f"socket:[{row[9]}]" in own]
    assert addresses
    assert set(addresses) <= {("udp", "0100007F"), ("tcp", "0100007F")}  # 127.0.0.1, as the kernel writes it


def test_a_flood_and_a_stranger_do_not_steer_it(loop):
    made, pilot = loop()
    rng = random.Random(4)
    fly(made.bridge, lambda: pilot.of("VISION_POSITION_ESTIMATE"))
    before = len(pilot.of("VISION_POSITION_ESTIMATE"))
    stranger, flood = autopilot(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    flood.connect(("127.0.0.1", made.port))
    lies = mavlink.MAVLink_gps_global_origin_message(1, 1, 1).pack(stranger) + beat(stranger)
    for _ in range(2000):
        flood.send(lies if rng.random() < 0.5 else rng.randbytes(300))
    fly(made.bridge, lambda: len(pilot.of("VISION_POSITION_ESTIMATE")) > before + 10)
    flood.close()
    assert made.bridge.telemetry.origin.lat_deg == pytest.approx(33.64)


def test_tcp_reconnects_after_the_link_drops(monkeypatch):
    monkeypatch.setattr("scenematch.bridges.mavlink._REOPEN_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(60.0)
        made = autopilot()
        link = parse_connection(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        with MavlinkBridge(link, lambda _: Matched(), MavlinkOptions()) as bridge:
            for expected in (0, 1):
                other, _ = server.accept()
                with other:
                    packet = beat(made)
                    other.sendall(packet[:5])
                    time.sleep(0.05)
                    other.sendall(packet[5:])
                    wait_until(lambda: bridge.connected)
                    assert other.recv(1) == b"\xfd"
                    assert bridge.status.reconnections == expected


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pair of serial ports")
def test_a_serial_port_takes_halves_and_its_loss_is_survived(monkeypatch):
    import tty

    pytest.importorskip("serial")
    monkeypatch.setattr("scenematch.bridges.mavlink._REOPEN_S", 0.05)
    vehicle, port = os.openpty()
    tty.setraw(vehicle)
    tty.setraw(port)
    packet, link = beat(autopilot()), parse_connection(f"serial:{os.ttyname(port)}:115200")
    with MavlinkBridge(link, lambda _: Matched(), MavlinkOptions()) as bridge:
        os.write(vehicle, packet[:7])
        time.sleep(0.05)
        assert not bridge.connected
        os.write(vehicle, packet[7:])
        wait_until(lambda: bridge.connected)
        assert os.read(vehicle, 1) == b"\xfd"
        os.close(vehicle)
        wait_until(lambda: not bridge.connected)
    os.close(port)


# ---------------------------------------------------------------------------------------------- the page


def test_the_table_of_traps_names_tests_and_code_that_are_there():
    def found(pattern, folder):
        return set(re.findall(pattern, "".join(path.read_text(encoding="utf-8") for path in folder.rglob("*.py"))))

    page = (ROOT / "docs" / "results" / "mavlink.md").read_text(encoding="utf-8")
    named = re.findall(r"`([\w.]+)`", page.split("## The traps", 1)[1].split("\n## ", 1)[0])
    assert sum(name.startswith("test_") for name in named) > 12
    tests, words = found(r"(?m)^def (test_\w+)", Path(__file__).parent), found(r"\w+", ROOT / "scenematch/bridges")
    for name in named:
        assert name in tests if name.startswith("test_") else name.split(".")[-1] in words, name
