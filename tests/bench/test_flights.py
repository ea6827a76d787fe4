"""Flights of the benchmark: the score with faults, a simulated vehicle's pilot, recorded flights, their camera."""

import math
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from bench.live.flights import arducopter, fly, sitl
from bench.live.flights.faults import Fault
from bench.live.flights.recorded import captured_s, off_m, recorded
from bench.live.flights.sitl import Pilot
from bench.live.flights.video_camera import SIZE, Footage, ground_from_pixel, recorded_from_shown
from bench.live.standin import State
from engine.geo import LocalFrame
from tests.support.refusals import refusal
from tests.support.videos import write_subtitles, write_video

PLACE = LocalFrame(33.64, 72.99)


def message(kind, **fields):
    return SimpleNamespace(get_type=lambda: kind, **fields)


def degrees_1e7(east_m, north_m):
    lat_deg, lon_deg = PLACE.geodetic_from_enu(east_m, north_m)
    return round(float(lat_deg) * 1e7), round(float(lon_deg) * 1e7)


# ---------------------------------------------------------------------------------------------------------- scores


def test_the_fixes_of_a_flight_are_scored():
    scored = [(0.1, 10.0), (9.0, 10.0), (0.3, 10.0), (0.4, 20.0)]
    assert "| 4 | 4.51 | 0.35 | 9.00 | 1 | 10, 20 |" in fly.report(scored, "begun").splitlines()


def test_a_simulators_flight_is_scored_by_its_log():
    """East at 4 m/s, a fault from 109.5 to 129.5 s; fixes each second, 0.5 m off, to 110 s and from 133 s."""
    times_s = np.arange(100.0, 161.0)
    truth = np.column_stack([times_s, 4.0 * times_s, 0.0 * times_s])
    ekf = truth + np.array([0.0, 0.0, 2.0])
    is_fixed = (times_s < 110.5) | (times_s > 132.5)
    fixes = np.column_stack([truth + np.array([0.0, 0.5, 0.0]), times_s + 0.1])[is_fixed]
    fixes[3, 2] = 6.0
    covered = Fault("camera covered", 10.0, 20.0, 4.0)
    lines = arducopter.report([truth, ekf, fixes], 99.5, 61.0, (covered,)).splitlines()
    assert "| 2.00, 2.00 m | 39 | 1.08, 6.02 m | 1 | 23.0 s | 20, 20 ms |" in lines
    assert "6.0 m off, 3.5 s after the receiver's end" in lines
    drift = "4.0 m/s; 3.50 s; 0.50 m, 1.0 s"
    assert f"| camera covered 20 s, wind 4 m/s | 2.00 m | {drift} |" in lines


def test_a_global_position_is_stamped_when_it_is_sent_and_says_how_long_it_took():
    sensor = message("GLOBAL_POSITION_SENSOR", time_usec=5_300_000, processing_time=300_000)
    assert captured_s(sensor) == pytest.approx(5.0)
    assert captured_s(message("VISION_POSITION_ESTIMATE", usec=5_000_000)) == pytest.approx(5.0)


def test_a_fix_is_scored_about_the_origin_that_the_autopilot_has():
    state = State(10.0, 20.0, 100.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    pilot = SimpleNamespace(place=PLACE, origin=(*degrees_1e7(4.0, 5.0), 0))
    fix = message("VISION_POSITION_ESTIMATE", usec=0, x=15.0, y=6.0)
    assert off_m(fix, lambda _: state, pilot) == pytest.approx(0.0, abs=0.02)
    pilot.origin = None
    assert off_m(fix, lambda _: state, pilot) == pytest.approx(np.hypot(4.0, 5.0), abs=0.02)


# ----------------------------------------------------------------------------------------------- simulated vehicle


def test_the_estimate_is_held_against_the_true_state():
    pilot = Pilot(None, PLACE)
    lat, lon = degrees_1e7(0.0, 0.0)
    pilot.take(message("GLOBAL_POSITION_INT", lat=0, lon=0, relative_alt=0))  # no position yet
    pilot.take(message("SIM_STATE", lat_int=lat, lon_int=lon))
    assert pilot.errors_m == {}
    pilot.part = "course"
    lat, lon = degrees_1e7(53.0, 1.0)
    pilot.take(message("GLOBAL_POSITION_INT", lat=lat, lon=lon, relative_alt=170_000))
    lat, lon = degrees_1e7(50.0, 5.0)
    pilot.take(message("SIM_STATE", lat_int=lat, lon_int=lon))
    assert pilot.height_m == pytest.approx(170.0)
    assert pilot.errors_m["course"] == [pytest.approx(5.0, abs=0.02)]
    assert "| course | 1 | 5.00 | 5.00 |" in sitl.report(pilot)


def test_targets_have_the_heading_and_the_velocity_of_the_course():
    sent = []
    mav = SimpleNamespace(set_position_target_global_int_send=lambda *fields: sent.append(fields))
    link = SimpleNamespace(mav=mav, recv_match=lambda **_: None)
    state = State(10.0, 20.0, 170.0, 0.0, 0.0, 90.0, 3.0, 4.0)
    assert sitl.follow(Pilot(link, PLACE), lambda _: state, 0.05)
    ((ignored, *target),) = (fields[4:] for fields in sent)
    assert target[:2] == [*degrees_1e7(10.0, 20.0)]
    assert (target[3], target[4]) == (4.0, 3.0)  # north, east
    assert target[9] == pytest.approx(np.pi / 2.0)
    names = ("AX", "AY", "AZ", "YAW_RATE")
    assert ignored == sum(getattr(mavlink, f"POSITION_TARGET_TYPEMASK_{name}_IGNORE") for name in names)


ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def heartbeat(mode, *, armed=True):
    """Of an ArduCopter, in the mode by ArduPilot's number: 4 is GUIDED, 6 RTL, 9 LAND."""
    return message(
        "HEARTBEAT", type=mavlink.MAV_TYPE_QUADROTOR, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode=ARMED if armed else mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, custom_mode=mode,
        get_srcSystem=lambda: 1, get_srcComponent=lambda: 1,
    )  # fmt: skip


@pytest.mark.parametrize(("mode", "name"), [(9, "LAND"), (6, "RTL")])
def test_a_vehicle_that_lands_by_itself_is_steered_no_more_and_ends_the_flight(monkeypatch, mode, name):
    """A link that plays a failsafe early on, and a landing that takes a while."""
    monkeypatch.setattr(sitl, "take_off", lambda pilot, height_m: None)
    left = [heartbeat(4)] * 3 + [heartbeat(mode)] * 40 + [heartbeat(mode, armed=False)]
    waiting, commands, settings = [], [], []

    def heard(**_):
        time.sleep(0.01)
        return left.pop(0) if left else None

    mav = SimpleNamespace(
        set_position_target_global_int_send=lambda *_: waiting.append(len(left)),
        command_long_send=lambda *fields: commands.append(fields[2]),
    )
    link = SimpleNamespace(mav=mav, recv_match=heard, param_set_send=lambda *fields: settings.append(fields))
    pilot = Pilot(link, PLACE)
    pilot.texts.append("Scenematch: fixes begin")
    sitl.fly(pilot, lambda _: State(0.0, 0.0, 170.0, 0.0, 0.0, 0.0, 0.0, 0.0), 60.0, 30.0)
    assert (pilot.part, pilot.mode, pilot.armed, left) == (f"{name} by itself", name, False, [])
    assert len(waiting) == 1  # one target, before the failsafe was heard of
    assert mavlink.MAV_CMD_SET_EKF_SOURCE_SET not in commands
    assert settings == []  # the receiver stays on


# ------------------------------------------------------------------------------------------------ recorded flights


RATE_HZ, NORTH_MPS = 25.0, 9.0
CUE = "FrameCnt: {n}\n[latitude: {lat:.6f}] [longitude: 16.2] [rel_alt: 80.0 abs_alt: 300.0] {gimbal}"


def video(folder, gimbal, size=(32, 32), shade=1):
    """Three seconds due north, each frame a shade brighter, with a cue each: positions to 0.1 m, as DJI's."""
    path = folder / "DJI_0001.mp4"
    write_video(path, [shade * k for k in range(75)], size=size, rate_hz=RATE_HZ, codec="mp4v")
    lats_deg = 48.1 + NORTH_MPS * np.arange(75) / RATE_HZ / 111_200.0
    texts = (CUE.format(n=k + 1, lat=lat_deg, gimbal=gimbal) for k, lat_deg in enumerate(lats_deg))
    write_subtitles(folder / "DJI_0001.SRT", texts)
    return path


def test_it_flies_the_positions_and_the_velocity_of_the_subtitles(tmp_path):
    motion, place, duration_s = recorded(video(tmp_path, "[gb_yaw: 30.0 gb_pitch: -90.0 gb_roll: 0.0]"))
    assert (place.lat_deg, duration_s) == (pytest.approx(48.1), pytest.approx(74 / RATE_HZ))
    for time_s in (0.0, 1.0, 2.5):
        state = motion(time_s)
        assert (state.height_m, state.heading_deg) == pytest.approx((80.0, 30.0))
        assert (state.east_m, state.north_m) == pytest.approx((0.0, NORTH_MPS * time_s), abs=0.2)
        assert (state.east_mps, state.north_mps) == pytest.approx((0.0, NORTH_MPS), abs=0.3)


def test_subtitles_without_a_heading_are_refused(tmp_path):
    line = refusal(recorded, video(tmp_path, ""))
    assert "expected subtitles beside it with position, rel_alt and gimbal" in line


# --------------------------------------------------------------------------------------- the camera that shows one


FRAME, FOCAL_PX = (852, 480), 680.0
TAKEN = State(10.0, -20.0, 170.0, 0.0, 0.0, 104.0, 0.0, 0.0)
MARGIN = np.array([(FRAME[0] - SIZE[0]) / 2.0, (FRAME[1] - SIZE[1]) / 2.0])


def moved(forward_m: float, right_m: float) -> State:
    """The vehicle so far from where the frame was taken."""
    heading = math.radians(TAKEN.heading_deg)
    east_m = forward_m * math.sin(heading) + right_m * math.cos(heading)
    north_m = forward_m * math.cos(heading) - right_m * math.sin(heading)
    return replace(TAKEN, east_m=TAKEN.east_m + east_m, north_m=TAKEN.north_m + north_m)


@pytest.mark.parametrize(("forward_m", "right_m"), [(0.0, 0.0), (5.0, 3.0)])
def test_the_middle_of_the_frame_is_shown_forward_is_up_and_right_is_right(forward_m, right_m):
    metre_px = FOCAL_PX / TAKEN.height_m
    warp = recorded_from_shown(TAKEN, FRAME, moved(forward_m, right_m), FOCAL_PX)
    expected = MARGIN + metre_px * np.array([right_m, -forward_m])
    assert np.allclose(warp, np.column_stack([np.eye(2), expected]), atol=1e-9)


def test_a_pixel_is_on_the_same_ground_in_both_pictures():
    vehicle = replace(moved(-4.0, 2.0), height_m=181.0, heading_deg=97.0)
    warp = recorded_from_shown(TAKEN, FRAME, vehicle, FOCAL_PX)
    for pixel in ((0.0, 0.0, 1.0), (639.0, 399.0, 1.0), (100.0, 300.0, 1.0)):
        on_ground = ground_from_pixel(vehicle, SIZE, FOCAL_PX) @ pixel
        recorded = warp @ pixel
        assert np.allclose(ground_from_pixel(TAKEN, FRAME, FOCAL_PX) @ [*recorded, 1.0], on_ground, atol=1e-9)


def test_the_picture_is_of_the_frame_that_was_taken_nearest(tmp_path):
    """Frames of one shade each, 0.36 m apart due north: the shade tells the frame."""
    path = video(tmp_path, "[gb_yaw: 0.0 gb_pitch: -90.0 gb_roll: 0.0]", FRAME, shade=3)
    footage = Footage(path, 64.1, every=5)
    for index in (0, 7, 14):
        assert footage.picture(footage.states[index]).mean() == pytest.approx(15 * index, abs=4)
    assert footage.hfov_deg == pytest.approx(50.4, abs=0.1)
