"""Lasting errors of the telemetry: learnt from fixes within their own sigmas, taken off new frames."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine import AssumedErrors, Attitude, Camera, Fix, Frame, Navigator, NavigatorOptions, Prior, SceneMatcher
from engine.navigation.telemetry_errors import TelemetryErrors, considered
from scenematch.runs.paper_recipe import ACCEPT_ALL
from scenematch.simulator import plan_flight
from tests.support.fields import fields_of
from tests.support.fixes import a_fix
from tests.support.matchers import ScriptedMatcher, a_site, at
from tests.support.towns import drawn_town

IMAGE = np.zeros((4, 4), np.uint8)
HEIGHT_M, INTERVAL_S = 150.0, 0.1
ASSUMED = AssumedErrors()
ANGLES = ("roll_deg", "pitch_deg", "heading_deg")
CALM = Frame(IMAGE, None, HEIGHT_M, 40.0, 0.0, 0.0)


def fix_of(attitude, stage="refined", up_m=None):
    roll, pitch, heading = attitude
    return a_fix(up_m=up_m, attitude=Attitude(roll, pitch, heading % 360.0), stage=stage)


def angles(time_s):
    """Roll, pitch and heading of a vehicle that brakes and turns through north, up to 30 degrees a second."""
    return [0.0, 0.0, 350.0] + np.array([6.0, 12.0, 20.0]) * np.sin(np.array([2.0, 2.5, 1.5]) * time_s)


def frame_at(time_s, off=(0.0, 0.0, 0.0), lag_s=0.0, off_m=0.0, **changes):
    roll, pitch, heading = (angles(time_s - lag_s) + off).tolist()
    return replace(Frame(IMAGE, round(time_s * 1e9), HEIGHT_M + off_m, heading % 360.0, roll, pitch), **changes)


def errors_of(frame, truth):
    known = np.array([frame.roll_deg, frame.pitch_deg, frame.heading_deg])
    return np.array([math.remainder(float(v), 360.0) for v in known - truth])


def flown(off=(0.0, 0.0, 0.0), *, lag_s=0.0, off_m=0.0, frames=100, seed=1, noise_deg=0.4, measured=True,
          options=None, **changes):  # fmt: skip
    """What is learnt of a telemetry that reads too much by this, and the frames as they were corrected."""
    errors, rng, shown = TelemetryErrors(options or NavigatorOptions()), np.random.default_rng(seed), []
    for k in range(frames):
        time_s = k * INTERVAL_S
        shown.append(errors.corrected(frame_at(time_s, off, lag_s, off_m, **changes), time_s))
        height_m = HEIGHT_M + rng.normal(0.0, 0.5)
        fix = fix_of(angles(time_s) + rng.normal(0.0, noise_deg, 3))
        errors.note(fix, height_m if measured else None)
    return errors, shown


def taught(frames, attitude_at):
    """What is learnt of frames at times, whose fixes measure these attitudes exactly."""
    errors = TelemetryErrors(NavigatorOptions())
    for time_s, frame in frames:
        errors.corrected(frame, time_s)
        errors.note(fix_of(attitude_at(time_s)), HEIGHT_M)
    return errors.calibration


@settings(max_examples=20)
@given(
    off=st.tuples(st.floats(0.9, 3.0), st.floats(-3.0, -0.9), st.floats(-8.0, -2.1)),
    lag_s=st.floats(0.0, 0.15),
    off_m=st.floats(-20.0, 20.0),
    seed=st.integers(0, 1000),
)
def test_what_is_off_is_learnt_within_its_sigma_and_taken_off(off, lag_s, off_m, seed):
    errors, frames = flown(off, lag_s=lag_s, off_m=off_m, seed=seed)
    found = errors.calibration
    left = np.add([found.attitude.roll_deg, found.attitude.pitch_deg, found.attitude.heading_deg], off)
    assert np.all(np.abs(left) <= 4.0 * np.array(found.attitude.sigma_deg))
    assert abs(found.attitude_lag_s - lag_s) < 0.02
    assert abs(found.height_m + off_m) < 4.0 * found.height_sigma_m
    assert found.height_factor == pytest.approx(HEIGHT_M / (HEIGHT_M + off_m), abs=0.01)
    last = frames[-1]
    left_deg = 2.0 + 4.0 * max(found.attitude.sigma_deg)  # an estimate within two of the heading's sigmas is left
    assert np.abs(errors_of(last, angles(99 * INTERVAL_S))).max() < left_deg
    if abs(off_m) > 6.0:
        assert last.height_agl_m == pytest.approx(HEIGHT_M, abs=1.5)


def test_a_corrected_height_makes_a_fix_less_certain_the_more_the_camera_looks_aside():
    fix, frame = fix_of((0.0, 0.0, 0.0)), Frame(IMAGE, None, 100.0, 0.0, 0.0, 0.0)
    shown = replace(frame, height_agl_m=110.0)
    assert considered(fix, frame, frame, None) is fix
    grown_m = []
    for pitch_deg in (0.0, 45.0):
        tilted, looked = replace(fix, attitude=Attitude(0.0, pitch_deg, 0.0)), replace(shown, pitch_deg=pitch_deg)
        variance_m2 = considered(tilted, frame, looked, Camera.from_fov(4, 4, 60.0)).covariance_m2[0, 0]
        grown_m.append(math.sqrt(variance_m2 - fix.covariance_m2[0, 0]))
    edge = math.tan(math.radians(2.0))
    assert grown_m == pytest.approx([10.0 * edge, 10.0 * (1.0 + edge)])


def test_what_is_assumed_of_any_telemetry_is_not_corrected():
    errors, frames = flown((0.4, -0.4, 1.5), off_m=3.0, noise_deg=0.0)
    assert errors.calibration.attitude.roll_deg == pytest.approx(-0.4, abs=0.1)
    left = np.array([errors_of(frame, angles(k * INTERVAL_S)) for k, frame in enumerate(frames)])[50:]
    assert np.median(left, axis=0) == pytest.approx([0.4, -0.4, 1.5], abs=0.1)
    assert frames[-1].height_agl_m == HEIGHT_M + 3.0


def test_an_unknown_lag_widens_the_attitude_of_a_vehicle_that_turns():
    _, frames = flown(lag_s=0.1, measured=False)
    here = angles(99 * INTERVAL_S - 0.1)
    rates = np.abs(here - angles(99 * INTERVAL_S - 0.2)) / INTERVAL_S * math.hypot(0.1, 0.03)
    assert frames[-1].tilt_sigma_deg == pytest.approx(math.hypot(ASSUMED.tilt_deg, rates[:2].max()))
    assert frames[-1].heading_sigma_deg == pytest.approx(math.hypot(ASSUMED.heading_deg, rates[2]))
    assert errors_of(frames[-1], here) == pytest.approx([0.0, 0.0, 0.0])  # nothing is corrected on suspicion
    _, stated = flown(lag_s=0.1, measured=False, tilt_sigma_deg=2.0)
    assert stated[-1].tilt_sigma_deg == pytest.approx(math.hypot(2.0, rates[:2].max()))


def test_a_calm_flight_is_as_it_was():
    errors = TelemetryErrors(NavigatorOptions())
    for k in range(5):
        frame = replace(CALM, timestamp_ns=k * 100_000_000)
        assert errors.corrected(frame, 0.1 * k) is frame
        errors.note(fix_of((0.0, 0.0, 40.0)), HEIGHT_M)


@pytest.mark.parametrize("changes", [{"timestamp_ns": None}, *({name: None} for name in ANGLES)])
def test_without_stamp_or_attitude_there_is_no_rate(changes):
    _, frames = flown(lag_s=0.1, frames=4, measured=False, **changes)
    given = [frame_at(k * INTERVAL_S, lag_s=0.1, **changes) for k in range(4)]
    assert list(map(fields_of, frames)) == list(map(fields_of, given))


@pytest.mark.parametrize(
    ("missing", "attitude", "height", "lag_s"),
    [
        *(({name: None}, False, True, 0.0) for name in ANGLES),
        ({"height_agl_m": None}, True, False, 0.1),
        ({"measured": False}, False, False, 0.0),  # no height, or over ground that is taken for flat
    ],
)
def test_what_is_not_known_of_a_frame_or_its_fix_teaches_nothing(missing, attitude, height, lag_s):
    found = flown((2.0, 2.0, 5.0), lag_s=0.1, off_m=20.0, **missing)[0].calibration
    assert (found.attitude is not None, found.height_m is not None) == (attitude, height)
    assert found.attitude_lag_s == pytest.approx(lag_s, abs=0.05)
    assert not attitude or found.attitude.heading_deg == pytest.approx(-5.0, abs=1.0)
    assert (found.height_factor is None, found.height_sigma_m is None) == (not height, not height)
    assert not height or abs(found.height_m + 20.0) < 4.0 * found.height_sigma_m


def test_frames_far_apart_have_no_rate_and_stamps_of_another_unit_a_bounded_one():
    errors = TelemetryErrors(NavigatorOptions())
    for k in range(4):
        frame = frame_at(2.0 * k, lag_s=0.1)
        assert errors.corrected(frame, 2.0 * k) is frame
    turned = errors.corrected(frame_at(6.2, timestamp_ns=6_000_000_200), 6.2)  # that was milliseconds
    assert turned.tilt_sigma_deg <= 181.0
    assert turned.heading_sigma_deg <= 181.0


def test_an_attitude_that_is_simply_wrong_is_no_lag_of_seconds():
    true = [(time_s, frame_at(time_s)) for time_s in np.arange(100) * INTERVAL_S]
    wrong = [(time_s, replace(one, roll_deg=-one.roll_deg, pitch_deg=-one.pitch_deg)) for time_s, one in true]
    assert abs(taught(wrong, angles).attitude_lag_s) <= 0.3


def test_a_bias_that_changes_is_followed():
    times_s = np.arange(300) * INTERVAL_S
    flight = [(time_s, frame_at(time_s, (0.0, 0.0, -4.0 if time_s < 15.0 else 4.0))) for time_s in times_s]
    assert taught(flight, angles).attitude.heading_deg == pytest.approx(-4.0, abs=0.5)


def test_one_wild_attitude_moves_it_by_little():
    errors, _ = flown(noise_deg=0.0)
    errors.corrected(frame_at(10.0), 10.0)
    errors.note(fix_of(angles(10.0) + np.array([20.0, -20.0, 90.0])), HEIGHT_M)
    known = errors.calibration.attitude
    assert max(abs(known.roll_deg), abs(known.pitch_deg)) < 0.5
    assert abs(known.heading_deg) < 1.0


@pytest.mark.parametrize(("stage", "noise_deg"), [("refined", 0.6), ("fine", 2.0)])
def test_an_unsure_attitude_counts_less(stage, noise_deg):
    errors = TelemetryErrors(NavigatorOptions())
    errors.corrected(CALM, 0.0)
    errors.note(fix_of((2.0, 0.0, 40.0), stage=stage), HEIGHT_M)
    errors.corrected(CALM, 0.0)
    assert errors.calibration.attitude.roll_deg == pytest.approx(2.0 / (1.0 + noise_deg**2), rel=1e-6)  # by hand


def test_the_noise_of_an_attitude_is_no_lag():
    """A frame's noise is in the turn rate up to it as well: the two look like a lag of half an interval."""
    lags_s = []
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(0.0, 1.0, (60, 3))
        frames = [(0.4 * k, frame_at(0.4 * k, off - angles(0.4 * k))) for k, off in enumerate(noise)]
        lags_s.append(taught(frames, lambda _: (0.0, 0.0, 0.0)).attitude_lag_s)
    assert abs(np.mean(lags_s)) < 0.01


def test_one_fix_alone_takes_nothing_off():
    _, frames = flown((6.0, -6.0, 20.0), frames=2)
    assert errors_of(frames[-1], angles(INTERVAL_S)) == pytest.approx([6.0, -6.0, 20.0])


def test_a_bias_within_what_the_frame_states_of_itself_is_left():
    errors, _ = flown((0.0, 0.0, 4.0))
    for sigma_deg, left_deg in ((None, 0.0), (3.0, 4.0)):
        shown = errors.without_errors(replace(CALM, heading_sigma_deg=sigma_deg))
        assert shown.heading_deg == pytest.approx(36.0 + left_deg, abs=0.5)


def test_the_baseline_takes_telemetry_as_it_is():
    _, frames = flown((0.0, 0.0, -6.0), lag_s=0.1, options=ACCEPT_ALL)
    for k, frame in enumerate(frames):
        stated = np.add(angles(k * INTERVAL_S - 0.1), [0.0, 0.0, -6.0])
        assert errors_of(frame, stated) == pytest.approx([0.0] * 3)
        assert (frame.tilt_sigma_deg or ASSUMED.tilt_deg) == pytest.approx(ASSUMED.tilt_deg)


def is_doubted(frame):
    """Whether its heading and height are to be searched far around."""
    return (frame.heading_sigma_deg or 0.0) >= 8.0 and (frame.height_sigma_m or 0.0) >= 0.07 * HEIGHT_M


def refused(frames, frame=CALM):
    """In which of so many frames that are all refused heading and height are doubted."""
    errors = TelemetryErrors(NavigatorOptions())
    shown = [errors.corrected(frame, 0.2 * k, refusals=k) for k in range(frames)]
    return errors, [k for k, one in enumerate(shown) if is_doubted(one)]


def test_refused_frames_are_doubted_ever_more_rarely():
    assert refused(100)[1] == [3, 6, 12, 24, 48, 96]


def test_a_frame_without_heading_or_height_has_nothing_to_doubt():
    assert refused(20, Frame(IMAGE, None, HEIGHT_M))[1] == []
    assert refused(20, Frame(IMAGE, None, None, 40.0))[1] == []


def test_after_a_fix_frames_are_doubted_until_three_fixes_settled_what_is_off():
    errors, _ = refused(4)
    doubted = []
    for k in range(6):
        errors.note(fix_of((0.0, 0.0, 30.0)), HEIGHT_M)
        shown = errors.corrected(CALM, 1.0 + 0.2 * k)
        doubted.append(is_doubted(shown))
    assert doubted == [True, True, False, False, False, False]
    assert shown.heading_deg == pytest.approx(30.0, abs=0.6)


def test_nothing_is_known_before_a_fix_nor_after_a_jump():
    after, _ = flown((0.0, 0.0, 8.0), off_m=20.0)
    after.forget()
    for errors in (TelemetryErrors(NavigatorOptions()), after):
        found = errors.calibration
        assert (found.attitude, found.height_m, found.height_factor, found.height_sigma_m) == (None,) * 4


def test_the_navigator_takes_it_off_new_frames_and_forgets_it_when_it_leads_nowhere():
    measured = fix_of((0.0, 0.0, -6.0), up_m=HEIGHT_M)
    matcher = ScriptedMatcher(*[measured] * 30, *[None] * 15, site=a_site(ground_at=lambda _: 0.0))

    def level_at(time_s):
        return replace(at(time_s, (0.0, 0.0), HEIGHT_M), roll_deg=0.0, pitch_deg=0.0)

    navigator = Navigator(matcher, Prior(east_m=0.0, north_m=0.0, sigma_m=5.0))
    for k in range(30):
        navigator.update(level_at(0.1 * k))
    assert navigator.calibration.attitude.heading_deg == pytest.approx(-6.0, abs=0.3)
    assert matcher.frames[-1].heading_deg == pytest.approx(354.0, abs=0.3)
    for k in range(15):
        navigator.update(level_at(3.0 + 0.1 * k))
    assert navigator.calibration.attitude is None
    assert matcher.frames[-1].heading_deg == 0.0


def test_over_ground_that_is_taken_for_flat_nothing_is_learnt():
    measured = fix_of((0.0, 0.0, -6.0), up_m=HEIGHT_M)
    site = a_site(ground_at=lambda _: 0.0, has_surface=False)
    navigator = Navigator(ScriptedMatcher(*[measured] * 5, site=site), Prior(east_m=0.0, north_m=0.0, sigma_m=5.0))
    for k in range(5):
        navigator.update(replace(at(0.1 * k, (0.0, 0.0), HEIGHT_M), roll_deg=0.0, pitch_deg=0.0))
    assert (navigator.calibration.attitude, navigator.calibration.height_m) == (None, None)


@pytest.mark.slow
def test_ncc_finds_a_heading_and_a_height_that_are_far_off():
    """Three refused frames, then the place, the heading and the height, which later frames are matched by."""
    plan = plan_flight(1, frames=10, town=drawn_town(1))
    site, first = plan.town.site(), plan.truth_rows()[0]
    start = Prior(lat_deg=first.lat_deg, lon_deg=first.lon_deg, sigma_m=10.0)
    navigator, results = Navigator(SceneMatcher(site, plan.camera, "ncc", "cpu"), start), []
    for frame in plan.iter_frames():
        off = {"heading_deg": (frame.heading_deg + 9.0) % 360.0, "height_agl_m": 1.12 * frame.height_agl_m}
        results.append(navigator.update(replace(frame, **off)))
    assert [isinstance(one, Fix) for one in results] == [False] * 3 + [True] * 7
    for fix, there in zip(results[3:], plan.truth.position_m[3:], strict=True):
        assert math.hypot(fix.east_m - there[0], fix.north_m - there[1]) < min(1.0, 3.0 * fix.sigma_m)
    found = navigator.calibration
    assert abs(found.attitude.heading_deg + 9.0) < 3.0 * found.attitude.sigma_deg[2]
    assert found.height_factor == pytest.approx(1.0 / 1.12, abs=0.02)
