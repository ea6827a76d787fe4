"""Visual odometry: pictures of a plane by two known poses, what must be refused, and dead reckoning by it."""

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine import Attitude, Budget, Camera, Frame, Navigator, NavigatorOptions, NoFix, OptionError, Prior, Reason
from engine.navigation.motion import GroundMotion, PositionEstimate, Ways, stated_step
from engine.navigation.odometry import NoMotion, VisualOdometry
from engine.navigation.tracks import Track
from scenematch.runs.settings import TrackSettings, load_settings
from tests.support.fixes import a_fix
from tests.support.ground import Ground
from tests.support.matchers import ScriptedMatcher, a_site

CAMERA = Camera.from_fov(320, 240, 60.0)
HEIGHT_M = 120.0
LEVEL = Attitude(0.0, 0.0, 0.0)
INTERVAL_S = 0.5


GROUND = Ground()


def picture(place_m, attitude=LEVEL, height_m=HEIGHT_M, ground=GROUND, camera=CAMERA):
    """What a pinhole camera shows of the ground, whose middle is the origin of east and north."""
    angles_deg = {"roll_deg": attitude.roll_deg, "pitch_deg": attitude.pitch_deg}
    return ground.picture_from(camera, place_m, height_m, heading_deg=attitude.heading_deg, **angles_deg)


def frame(image, seconds=0.0, attitude=LEVEL, height_m=HEIGHT_M, **more):
    angles_deg = attitude.heading_deg, attitude.roll_deg, attitude.pitch_deg
    return Frame(image, round(seconds * 1e9), height_m, *angles_deg, **more)


def motion_between(first, second, camera=CAMERA):
    """Of two frames, or of two pictures that are an interval apart."""
    odometry = VisualOdometry(camera)
    stamped = zip((first, second), (0.0, INTERVAL_S), strict=True)
    begin, end = (one if isinstance(one, Frame) else frame(one, at_s) for one, at_s in stamped)
    assert isinstance(odometry.update(begin), NoMotion)
    return odometry.update(end)


def noisy(image, sigma, rng):
    return np.clip(np.round(image + rng.normal(0.0, sigma, image.shape)), 0, 255).astype(np.uint8)


def refused(first, second, reason):
    assert reason in motion_between(first, second).reason


# What is measured


angles = st.floats(-8.0, 8.0)  # roll and pitch change places: beyond it the two pictures share little ground


@settings(max_examples=15, deadline=None)
@given(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0), st.floats(0.0, 360.0), angles, angles, st.floats(-8.0, 8.0))
def test_a_known_motion_is_found_at_every_attitude(east_m, north_m, heading_deg, roll_deg, pitch_deg, turn_deg):
    begin = Attitude(roll_deg, pitch_deg, heading_deg)
    end = Attitude(pitch_deg, roll_deg, (heading_deg + turn_deg) % 360.0)
    second = noisy(picture((east_m, north_m), end), 1.0, np.random.default_rng(9))
    motion = motion_between(frame(picture((0.0, 0.0), begin), 0.0, begin), frame(second, INTERVAL_S, end))
    assert isinstance(motion, GroundMotion)
    off_m = motion.moved_m - [east_m, north_m]
    assert np.hypot(*off_m) < 0.3  # three quarters of a pixel on the ground
    assert motion.velocity_mps == pytest.approx(motion.moved_m / INTERVAL_S)


def test_a_climb_is_no_motion_over_the_ground():
    first = frame(picture((0.0, 0.0)))
    second = frame(picture((4.0, -3.0), LEVEL, 1.05 * HEIGHT_M), INTERVAL_S, height_m=1.05 * HEIGHT_M)
    assert motion_between(first, second).moved_m == pytest.approx([4.0, -3.0], abs=0.2)


def test_errors_are_as_large_as_the_covariance_says():
    """Telemetry that is off by what the engine assumes of any, ground in noise: 2 if exact."""
    rng, nees = np.random.default_rng(5), []
    for _ in range(60):
        moved_m, true = rng.uniform(-15.0, 15.0, 2), Attitude(*rng.normal(0.0, 3.0, 2), rng.uniform(0.0, 360.0))
        off, shown = rng.normal(size=3) * [0.37, 0.37, 1.0], []
        for place_m, seconds in (((0.0, 0.0), 0.0), (moved_m, INTERVAL_S)):
            image = noisy(picture(place_m, true), 4.0, rng)
            stated = Attitude(true.roll_deg + off[0], true.pitch_deg + off[1], (true.heading_deg + off[2]) % 360.0)
            height_m = HEIGHT_M + (shown[0].height_agl_m - HEIGHT_M if shown else rng.normal(0.0, 1.3))
            shown.append(frame(image, seconds, stated, height_m))
        motion = motion_between(*shown)
        off_mps = motion.velocity_mps - moved_m / INTERVAL_S
        nees.append(off_mps @ np.linalg.solve(motion.velocity_covariance_m2ps2, off_mps))
    assert 0.5 < np.mean(nees) < 3.0
    assert np.max(nees) < 18.4  # what chance exceeds once in ten thousand


def test_a_distorting_lens_shows_the_same_motion():
    lens = replace(CAMERA, distortion=np.array([-0.15, 0.02, 0.0, 0.0, 0.0]))
    rows, columns = np.indices((240, 320), np.float32)
    flat = lens.undistort_points(np.column_stack([columns.ravel(), rows.ravel()]))
    rays, zero = np.column_stack([flat, np.ones(len(flat))]), np.zeros(3)
    again, _ = cv2.projectPoints(rays, zero, zero, lens.matrix, lens.distortion)
    assert again[:, 0] == pytest.approx(np.column_stack([columns.ravel(), rows.ravel()]), abs=0.01)
    wide = Camera.from_fov(480, 360, 80.0)
    at = (flat @ wide.matrix[:2, :2].T + wide.matrix[:2, 2]).astype(np.float32).reshape(240, 320, 2)
    shown = (picture(place, camera=wide) for place in ((0, 0), (9, 5)))
    images = [cv2.remap(one, at, None, cv2.INTER_LINEAR) for one in shown]
    assert motion_between(*images, camera=lens).moved_m == pytest.approx([9.0, 5.0], abs=0.3)


def test_large_pictures_are_followed_smaller_with_the_same_answer():
    camera = Camera.from_fov(1280, 960, 60.0)
    images = [picture(place, camera=camera) for place in ((0, 0), (6, -7))]
    assert motion_between(*images, camera=camera).moved_m == pytest.approx([6.0, -7.0], abs=0.3)


def test_something_fixed_to_the_camera_does_not_stop_the_ground():
    moved = [picture(place) for place in ((0, 0), (10, 0))]
    for image in moved:
        image[:80, :120] = GROUND.gray[:80, :120]
    assert motion_between(*moved).moved_m == pytest.approx([10, 0], abs=0.3)


# What is refused


def test_pictures_that_show_no_one_motion_are_refused():
    rng = np.random.default_rng(1)
    refused(*(np.full((240, 320), level, np.uint8) for level in (90, 91)), "0 points")
    refused(*(picture((0, 0), ground=Ground(seed=seed)) for seed in (1, 2)), "agree on one motion")
    dark = [np.clip(rng.normal(6.0, 2.0, (240, 320)), 0, 255).astype(np.uint8) for _ in range(2)]
    refused(*dark, "agree on one motion")
    refused(*[picture((0, 0))] * 2, "repeats the last one")


def test_what_is_fixed_to_the_camera_over_water_is_no_hover():
    """An overlay in a corner is all that can be followed: it stands still, whatever the vehicle does."""
    shown = [np.full((240, 320), grey, np.uint8) for grey in (90, 92)]
    for image in shown:
        image[:80, :100] = GROUND.gray[:80, :100]
    refused(*shown, "small part")


def test_telemetry_that_does_not_support_a_motion_is_refused():
    first, second = frame(picture((0, 0))), frame(picture((5, 0)), INTERVAL_S)
    refused(replace(first, height_agl_m=None), second, "height or heading")
    refused(first, replace(second, heading_deg=None), "height or heading")
    refused(replace(first, timestamp_ns=None), second, "no timestamp")
    refused(first, replace(second, timestamp_ns=9_000_000_000), "9.0 s apart")
    refused(first, replace(second, east_velocity_mps=1.0, north_velocity_mps=1.0), "velocity is known")
    refused(replace(first, pitch_deg=55.0), replace(second, pitch_deg=55.0), "too obliquely")  # 78 at an edge
    oblique = (replace(shown, pitch_deg=40.0) for shown in (first, second))
    assert isinstance(motion_between(*oblique), GroundMotion)


def test_a_velocity_that_is_too_uncertain_is_refused(monkeypatch):
    monkeypatch.setattr("engine.navigation.odometry._MAX_SIGMA_MPS", 1e-6)
    refused(picture((0, 0)), picture((5, 0)), "uncertain")


@pytest.mark.parametrize("as_given", [np.asarray, torch.from_numpy])
def test_a_buffer_that_is_filled_again_is_no_picture_that_repeats(as_given):
    odometry, buffer = VisualOdometry(CAMERA), as_given(picture((0, 0)))
    odometry.update(frame(buffer))
    buffer[:] = as_given(picture((5, 0)))
    assert odometry.update(frame(buffer, INTERVAL_S)).moved_m == pytest.approx([5.0, 0.0], abs=0.2)


def test_the_way_after_a_picture_that_repeats_is_unknown():
    odometry = VisualOdometry(CAMERA)
    shown = [picture((3.0 * k, 0.0)) for k in (0, 0, 2, 3)]
    motions = [odometry.update(frame(image, k * INTERVAL_S)) for k, image in enumerate(shown)]
    assert [isinstance(motion, GroundMotion) for motion in motions] == [False, False, False, True]
    assert motions[3].moved_m == pytest.approx([3.0, 0.0], abs=0.2)


# Dead reckoning

MOTION = GroundMotion(1.0, np.array([3.0, 4.0]), 0.04 * np.eye(2), 0.02, 1.0)
START = Prior(east_m=0.0, north_m=0.0, sigma_m=2.0)


def blind(**known):
    """A matcher that refuses all."""
    matcher = ScriptedMatcher(*[Reason.NO_TEXTURE] * 9, site=a_site(is_searchable=False, has_surface=False))
    vars(matcher).update(known)
    return matcher


def still(seconds, **velocity):
    return Frame(np.zeros((2, 2), np.uint8), round(seconds * 1e9), **velocity)


def test_motions_add_up_and_so_do_their_errors():
    """Four of 5 m: the share of height and heading lasts, the rest does not."""
    track = Track.begun(PositionEstimate(np.zeros(2), 0.0), 20.0, 0, None).with_velocity(MOTION.velocity_mps, 0.1)
    for _ in range(4):
        track = track.carried(Ways(1.0, seen=MOTION.step(MOTION.step(None))), NavigatorOptions())
    assert track.en_m == pytest.approx([12.0, 16.0])
    assert track.estimate.sigma_m == pytest.approx(np.hypot(0.02 * 20.0, 0.2 * np.sqrt(4)))


def test_a_motion_counts_over_its_own_interval_only(monkeypatch):
    """The frame at 1 s failed: what the pictures show is not the way of two seconds."""
    monkeypatch.setattr(VisualOdometry, "update", lambda *_: MOTION)
    for seconds, moved_m in ((1.0, 3.0), (2.0, 0.0)):
        navigator = Navigator(blind(camera=CAMERA), START, options=NavigatorOptions(odometry=True))
        for stamp in (0.0, seconds):
            navigator.update(still(stamp))
        assert navigator.prediction.east_m == pytest.approx(moved_m)


@pytest.mark.parametrize(("sigma_mps", "expected_mps"), [(None, 0.5), (0.1, 0.1), (2.0, 2.0)])
def test_a_velocity_with_its_own_accuracy_is_taken_at_its_word(sigma_mps, expected_mps):
    stated = {"east_velocity_mps": 1.0, "north_velocity_mps": 0.0, "velocity_sigma_mps": sigma_mps}
    assert stated_step(None, still(1.0, **stated), 1.0, NavigatorOptions()).sigma_mps == expected_mps


def test_a_navigator_follows_the_ground_where_it_is_asked_to():
    navigator = Navigator(blind(camera=CAMERA), START, options=NavigatorOptions(odometry=True))
    for k in range(6):
        navigator.update(frame(picture((3.0 * k, -2.0 * k)), INTERVAL_S * k))
    predicted = navigator.prediction
    assert navigator.ground_motion is not None
    assert (predicted.east_m, predicted.north_m) == pytest.approx((15.0, -10.0), abs=0.5)
    assert predicted.sigma_m < 3.0


def test_only_odometry_needs_a_camera_of_the_matcher():
    matcher = blind()
    navigator = Navigator(matcher, START)
    assert isinstance(navigator.update(frame(picture((0, 0)))), NoFix)
    assert navigator.ground_motion is None
    with pytest.raises(OptionError, match=r"^odometry: expected a matcher with a `camera`, got ScriptedM"):
        Navigator(matcher, START, options=NavigatorOptions(odometry=True))


@pytest.mark.parametrize(("total_ms", "search_ms"), [(1000.0, 2000.0), (1000.0, None), (50.0, None)])
def test_the_time_that_odometry_takes_is_the_frames(monkeypatch, total_ms, search_ms):
    def slow(*_):
        time.sleep(0.1)
        return NoMotion("slow")

    matcher, limit = blind(camera=CAMERA), Budget(total_ms=total_ms, search_ms=search_ms)
    monkeypatch.setattr(VisualOdometry, "update", slow)
    Navigator(matcher, START, limit, NavigatorOptions(odometry=True)).update(frame(picture((0, 0))))
    assert 0.0 < matcher.budgets[0].total_ms <= max(total_ms - 100.0, 1e-6)
    assert matcher.budgets[0].search_ms is None if search_ms is None else matcher.budgets[0].search_ms <= 1900.0


def test_odometry_flies_at_the_height_that_fixes_showed(monkeypatch):
    navigator = Navigator(blind(camera=CAMERA), START, options=NavigatorOptions(odometry=True))
    errors, flown = navigator._errors, frame(picture((0.0, 0.0)))
    for _ in range(5):
        errors.corrected(flown, 0.0)
        errors.note(a_fix(), 1.2 * HEIGHT_M)
    for k in range(2):
        navigator.update(frame(picture((5.0 * k, 0.0)), k * INTERVAL_S))
    assert navigator.ground_motion.moved_m[0] == pytest.approx(5.0 * 1.2, rel=0.05)


def test_it_is_asked_for_by_a_setting_and_not_with_the_papers_recipe():
    assert not TrackSettings().navigator.odometry
    assert load_settings("navigator.odometry=true").navigator.odometry
    with pytest.raises(OptionError, match=r"^odometry: expected with `profile` engine"):
        load_settings("navigator.odometry=true", profile="paper", method="ncc")
