"""The diagnosis: which single change makes telemetry, camera and clock fit what the pictures show."""

from dataclasses import replace

import numpy as np
import pytest

from engine.camera import mount_rotation
from engine.geo import attitude_from_rotation, enu_from_body
from engine.values import Attitude, Prior
from scenematch.check import Diagnosis, diagnose
from scenematch.check.causes import IN_CALIBRATION, findings, is_known
from scenematch.check.contradictions import contradictions
from scenematch.check.findings import Finding, TelemetrySeries
from scenematch.check.sightings import Sighting
from scenematch.runs.checking import _that_can_be_set, as_rows
from scenematch.simulator import plan_flight
from tests.support.towns import drawn_town, site_of

RNG = np.random.default_rng(5)
N = 80
TIME_S = 0.5 * np.arange(N)
ANGLES = np.stack(
    [9.0 * np.sin(0.9 * TIME_S), 7.0 * np.cos(0.7 * TIME_S), (40.0 + 60.0 * np.sin(0.15 * TIME_S)) % 360.0], axis=1
)
VELOCITY = np.stack([5.0 + np.sin(0.1 * TIME_S), -4.0 + np.cos(0.2 * TIME_S)], axis=1)
PLACES = np.concatenate([[[0.0, 0.0]], np.cumsum(0.5 * (VELOCITY[1:] + VELOCITY[:-1]) * 0.5, axis=0)])


def series(**changes):
    places, sigmas = np.full((N, 2), np.nan), np.full(N, np.nan)
    right = TelemetrySeries(TIME_S, ANGLES, np.full(N, 120.0), VELOCITY, places, sigmas, mount_rotation(), 260.0)
    return replace(right, **changes)


def seen(noise=True, outliers=2):
    """Sixteen poses as features give them, two of them wrong: the same in whatever order the tests run."""
    out, rng = [], np.random.default_rng(5)
    for number, k in enumerate(range(0, N, 5)):
        roll, pitch, heading = ANGLES[k] + (rng.normal(0.0, 0.5, 3) if noise else 0.0)
        place, height = PLACES[k] + rng.normal(0.0, 0.3, 2), 120.0 + rng.normal(0.0, 1.0)
        if number in range(3, 3 + outliers):
            roll, heading, height, place = roll + 30.0, heading + 100.0, 60.0, place + 90.0
        out.append(Sighting(k, Attitude(roll, pitch, heading % 360.0), height, place))
    return out


def facing(sighting, heading_deg):
    return replace(sighting, attitude=replace(sighting.attitude, heading_deg=heading_deg))


def with_headings(headings_deg):
    return series(angles_deg=np.column_stack([ANGLES[:, :2], headings_deg]))


def causes(telemetry, sightings):
    return [finding.cause for finding in findings(telemetry, sightings, 1.0)]


def seen_off(sightings, forward_m, right_m):
    """The same of a camera whose optical centre is off: places move with the heading."""
    moved = []
    for one in sightings:
        heading = np.radians(one.attitude.heading_deg)
        ahead, aside = np.array([np.sin(heading), np.cos(heading)]), np.array([np.cos(heading), -np.sin(heading)])
        moved.append(replace(one, en_m=one.en_m + forward_m * ahead + right_m * aside))
    return moved


def assert_is_off(found, forward_m, right_m):
    """By focal length over height it is so many pixels of the picture."""
    assert found.cause == "mount"
    assert found.value == pytest.approx(np.degrees(np.arctan2(np.hypot(forward_m, right_m), 120.0)), abs=1.0)
    column_row_px = [int(word) for word in found.cure.split() if word[0] in "+-"]
    assert column_row_px == pytest.approx([-right_m * 260.0 / 120.0, forward_m * 260.0 / 120.0], abs=4.0)


def test_what_fits_is_not_doubted():
    for _ in range(50):
        assert findings(series(), seen(), 1.0) == []


@pytest.mark.parametrize(("forward_m", "right_m"), [(-6.0, 7.0), (0.0, 9.0), (14.0, 3.0)])
def test_an_optical_centre_that_is_off_is_named_with_its_pixels(forward_m, right_m):
    (found,) = findings(series(), seen_off(seen(outliers=0), forward_m, right_m), 1.0)
    assert_is_off(found, forward_m, right_m)


def on_lines(headings_deg, outliers):
    """Telemetry and sightings of a level flight with these headings; false sightings are turned and elsewhere."""
    shown = [replace(one, attitude=Attitude(0.0, 0.0, float(headings_deg[one.index]))) for one in seen(outliers=0)]
    for number in range(3, 3 + outliers):
        turned = Attitude(0.0, 0.0, shown[number].attitude.heading_deg + 100.0)
        shown[number] = replace(shown[number], attitude=turned, en_m=shown[number].en_m + 90.0)
    return series(angles_deg=np.column_stack([np.zeros((N, 2)), headings_deg])), shown


@pytest.mark.parametrize("outliers", [0, 1])
def test_an_optical_centre_that_is_far_off_is_named_by_the_few_turns_of_straight_lines(outliers):
    """At each turn places move by many sigmas, which alone would be an outlier."""
    telemetry, shown = on_lines(np.where(np.arange(N) // 30 % 2, 160.0, 20.0), outliers)
    (found,) = (one for one in findings(telemetry, seen_off(shown, 25.0, 0.0), 1.0) if one.cause == "mount")
    assert_is_off(found, 25.0, 0.0)


@pytest.mark.parametrize("outliers", [1, 2])
def test_false_sightings_over_a_straight_line_are_no_optical_centre(outliers):
    telemetry, shown = on_lines(np.full(N, 20.0), outliers)
    assert findings(telemetry, shown, 1.0) == []


@pytest.mark.parametrize(
    ("field", "values", "cause", "word"),
    [
        ("angles_deg", np.radians(ANGLES), "radians", ""),
        ("angles_deg", ANGLES[:, [1, 0, 2]], "swapped", ""),
        ("angles_deg", ANGLES * [-1, 1, 1], "sign", ""),
        ("angles_deg", ANGLES * [-1, -1, 1], "sign", ""),
        ("angles_deg", ANGLES * [1, 1, -1], "heading_convention", ""),
        ("angles_deg", ANGLES * [1, 1, -1] + np.array([0, 0, 90]), "heading_convention", ""),
        ("angles_deg", ANGLES + np.array([4.0, -3.0, 0]), "mount", ""),
        ("height_m", np.full(N, 140.0), "height", ""),
        ("height_m", np.full(N, 100.0), "height", ""),
        ("height_m", np.full(N, 330.0), "height", ""),
        ("height_m", np.full(N, 120.0 / 0.3048), "height_feet", ""),
        ("velocity_mps", VELOCITY[:, ::-1], "velocity", "swapped"),
        ("velocity_mps", -VELOCITY, "velocity", "sign"),
        ("velocity_mps", 3.6 * VELOCITY, "velocity", "km/h"),
        ("velocity_mps", VELOCITY / 0.5144, "velocity", "knots"),
        ("velocity_mps", VELOCITY / 1.7, "velocity", "times as far"),
    ],
)
def test_a_field_that_is_wrong_is_named(field, values, cause, word):
    (found,) = findings(series(**{field: values}), seen(), 1.0)
    assert found.cause == cause
    assert word in found.text


def test_an_offset_has_its_value_within_three_sigma():
    for off_deg in (-14.0, -12.0, 5.0, 8.1):
        (found,) = findings(series(angles_deg=ANGLES + np.array([0, 0, off_deg])), seen(), 1.0)
        assert found.cause == "heading"
        assert abs(found.value + off_deg) < 3.0 * found.sigma
        assert found.cure.startswith(f"--correct heading_offset_deg={found.value:+.1f}")


@pytest.mark.parametrize("turn_deg", [90, 180, 270])
def test_a_camera_that_is_turned_is_no_compass_error(turn_deg):
    """The poses that its pictures give by the calibration's mount have roll and pitch turned as well."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    turned = []
    for one in seen(noise=False, outliers=0):
        a = one.attitude
        rotation = enu_from_body(a.roll_deg, a.pitch_deg, a.heading_deg) @ turn
        turned.append(replace(one, attitude=Attitude(*attitude_from_rotation(rotation))))
    (found,) = findings(series(), turned, 1.0)
    assert found.cause == "mount"
    name = {90: "nadir-right", 180: "nadir-tail", 270: "nadir-left"}[turn_deg]
    assert found.cure == f"--mount {name}"


def test_a_height_that_is_scaled_is_told_from_one_that_is_shifted():
    true = 60.0 + TIME_S * 2.0
    poses = [replace(one, height_agl_m=float(true[one.index])) for one in seen(outliers=0)]
    assert causes(series(height_m=true * 1.2), poses)[0] == "focal"
    assert causes(series(height_m=true + 25.0), poses)[0] == "height"


@pytest.mark.parametrize("shift_s", [-1.5, 0.5, 2.0])
def test_a_clock_that_is_off_is_named(shift_s):
    late = np.stack([np.interp(TIME_S - shift_s, TIME_S, column) for column in ANGLES.T], axis=1)
    (found,) = findings(series(angles_deg=late), seen(), 1.0)
    assert (found.cause, found.value) == ("clock", pytest.approx(shift_s, abs=0.15))


def test_a_map_that_other_positions_contradict_is_named():
    reference = {"reference_m": PLACES + np.array([8.0, 0.0]), "reference_sigma_m": np.full(N, 1.0)}
    (found,) = findings(series(**reference), seen(), 1.0)
    assert (found.cause, found.value) == ("map", pytest.approx(8.0, abs=0.5))
    assert findings(series(**reference), seen(), 5.0) == []  # within what the map states


@pytest.mark.parametrize("headings_deg", [np.zeros(N), RNG.uniform(0, 360, N)], ids=["stuck", "random"])
def test_what_no_single_change_explains_is_said_not_to_fit(headings_deg):
    assert causes(with_headings(headings_deg), seen()) == ["attitude"]


def test_what_is_not_known_is_not_said_to_fit():
    unknown = series(angles_deg=np.full((N, 3), np.nan), velocity_mps=np.full((N, 2), np.nan))
    assert findings(unknown, seen(), 1.0) == []
    assert is_known(unknown, seen()) == ("height",)
    assert is_known(series(), seen()) == ("attitude", "height", "velocity")


def test_a_yaw_in_radians_that_was_wrapped_as_degrees_is_recognised():
    angles = np.radians(np.column_stack([ANGLES[:, :2], (ANGLES[:, 2] + 180.0) % 360.0 - 180.0 - 100.0]))
    angles[:, 2] %= 360.0  # as telemetry.csv is read
    poses = [facing(one, one.attitude.heading_deg - 100.0) for one in seen()]
    assert causes(series(angles_deg=angles), poses) == ["radians"]


@pytest.fixture(scope="module")
def over_a_town():
    """Six frames of a flight over a drawn town, and what finds the causes in such frames."""
    town = drawn_town()
    plan = plan_flight(town=town, frames=6, rate_hz=0.3)
    site, camera, first = site_of(town), plan.camera, plan.truth_rows()[0]
    start = Prior(lat_deg=first.lat_deg, lon_deg=first.lon_deg, sigma_m=15.0)

    def found_in(frames):
        return diagnose(frames, frames.__getitem__, site, camera, start=start).findings

    return list(plan.iter_frames()), found_in


def test_pictures_say_it_by_themselves(over_a_town):
    """The whole way, on a drawn town: nothing where all fits, and a heading that is off."""
    frames, found_in = over_a_town
    assert found_in(frames) == []
    off = [replace(frame, heading_deg=(frame.heading_deg + 9.0) % 360.0) for frame in frames]
    (found,) = found_in(off)
    assert (found.cause, found.value) == ("heading", pytest.approx(-9.0, abs=1.0))


@pytest.mark.slow
def test_pictures_also_say_that_they_are_mirrored_hurried_or_frozen(over_a_town):
    frames, found_in = over_a_town
    mirrored = [replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1])) for frame in frames]
    assert found_in(mirrored)[0].cause == "mirrored"
    hurried = [replace(frame, timestamp_ns=frame.timestamp_ns // 1_000_000) for frame in frames]
    (found,) = found_in(hurried)
    assert found.cause == "velocity"
    assert "velocity and stamps" in found.text
    still = [replace(frame, image=frames[3 * (k // 3)].image) for k, frame in enumerate(frames)]
    assert "frozen" in [found.cause for found in found_in(still)]


def radians_near_north(turning):
    """Headings in radians, at so many of the sixteen sightings far from north; with the poses."""
    true = np.full(N, 2.0)
    true[0 : 5 * turning] = 80.0
    poses = [facing(one, float(true[one.index] + RNG.normal(0.0, 0.5))) for one in seen(outliers=0)]
    return with_headings(np.radians(true)), poses


@pytest.mark.parametrize("turning", [3, 6, 9, 13])
def test_headings_in_radians_are_named_where_most_of_them_are_near_north(turning):
    wrong, poses = radians_near_north(turning)
    (found,) = findings(wrong, poses, 1.0)
    assert (found.cause, found.cure) == ("radians", '--correct "heading_deg=57.29578*heading_deg"')
    counted = {one.field: (one.pictures, one.compared) for one in contradictions(wrong, poses)}
    assert counted == {"roll": (0, 16), "pitch": (0, 16), "heading": (turning, 16), "height": (0, 16),
                       "velocity": (0, 15)}  # fmt: skip


def in_words(telemetry, poses):
    """What is said of the pictures."""
    known, off = is_known(telemetry, poses), contradictions(telemetry, poses)
    return as_rows(Diagnosis(findings(telemetry, poses, 1.0), 16, 16, known, off))[-1][1]


def test_the_share_that_contradicts_and_the_field_are_said():
    wrong, poses = radians_near_north(6)
    assert in_words(wrong, poses).endswith("; 6 of 16 (38%) contradict the heading")
    wrong, poses = radians_near_north(1)  # one picture may be placed wrong
    assert causes(wrong, poses) == []
    stated = "they agree with the attitude, height, velocity, but 1 of 16 (6%) contradicts the heading"
    assert in_words(wrong, poses).endswith(stated)


def test_a_field_that_no_change_mends_is_suspected_by_its_name():
    headings = ANGLES[:, 2].copy()
    headings[::4] = RNG.uniform(0.0, 360.0, len(headings[::4]))
    (found,) = findings(with_headings(headings), seen(outliers=0), 1.0)
    assert found.cause == "attitude"
    assert found.text.startswith("heading of the telemetry and of the pictures differ")


def test_heights_that_are_coarse_are_not_wrong():
    """Steps of 5 m with an offset below 4 %, which no single picture contradicts."""
    poses = [replace(one, height_agl_m=120.0 + 4.0 * (-1) ** k) for k, one in enumerate(seen(outliers=0))]
    assert causes(series(height_m=np.full(N, 116.5)), poses) == []
    assert causes(series(height_m=np.full(N, 110.0)), poses) == ["height"]
    exact = [replace(one, height_agl_m=120.0) for one in poses]
    assert causes(series(height_m=np.full(N, 115.8)), exact) == ["height"]


def test_positions_of_what_the_middle_shows_are_no_shifted_map():
    """Of a camera that is tilted, where the telemetry knows of no tilt."""
    tilted = [replace(one, attitude=Attitude(5.0, 0.0, 0.0)) for one in seen(outliers=0)]
    left_m = 120.0 * np.tan(np.radians(5.0))  # right side down: the nadir camera looks left
    angles = np.column_stack([np.full((N, 2), np.nan), np.zeros(N)])
    telemetry = series(angles_deg=angles, reference_m=PLACES - (left_m, 0.0), reference_sigma_m=np.full(N, 1.0))
    assert causes(telemetry, tilted) == []
    assert causes(replace(telemetry, reference_m=PLACES - (left_m, -30.0)), tilted) == ["map"]


# --------------------------------------------------------------------------------------------- what a user can set


LINE = "mount: [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]"


def cure(text, *, gimbal=False, calibration=True, cause="mount"):
    return _that_can_be_set(Finding(cause, "it hangs off", text), gimbal, calibration).cure


def test_a_mount_is_written_where_there_is_a_calibration_or_can_be():
    assert cure(LINE + IN_CALIBRATION) == f"{LINE} in the calibration"
    assert cure(LINE + IN_CALIBRATION, calibration=False) == f"write a calibration file with {LINE}, for --camera"
    assert cure("--mount nadir-tail", calibration=False) == "--mount nadir-tail"


@pytest.mark.parametrize("text", [LINE + IN_CALIBRATION, "--mount nadir-tail"])
def test_beside_a_gimbal_its_angles_are_corrected(text):
    assert cure(text, gimbal=True).startswith("the gimbal's angles replace a mount: correct the angles")
    assert cure("--correct angles=radians", gimbal=True, cause="radians") == "--correct angles=radians"
