"""Frames in order: dead reckoning against figures done by hand, loss and re-acquisition, and a whole flight."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine import Budget, Navigator, NavigatorState, TelemetryError
from engine.options import NavigatorOptions
from engine.values import Attitude, Fix, NoFix, Prior, Reason
from scenematch.runs.paper_recipe import ACCEPT_ALL
from scenematch.runs.settings import TrackSettings
from tests.support import matchers
from tests.support.fixes import a_fix
from tests.support.matchers import ScriptedMatcher, a_site, at

START = Prior(east_m=10.0, north_m=20.0, sigma_m=5.0)
STILL, UNKNOWN = (0.0, 0.0), (None, None)


def fix_at(east_m, north_m, sigma_m=1.0, **stated):
    return a_fix(east_m, north_m, sigma_m, attitude=Attitude(0.0, 0.0, 0.0), method="sift", **stated)


def script(*answers, sigma_m=1.0, site=None, **stated):
    """A matcher that answers from a list: a place, None for a refusal, or its reason."""
    fixes = (fix_at(*a, sigma_m, **stated) if isinstance(a, tuple) else a for a in answers)
    return ScriptedMatcher(*fixes, site=site)


def flown(*answers, start=START, every_s=1.0, seconds=None, velocity=STILL, options=None, **known):
    """Frames that are answered from a list: see :func:`tests.support.matchers.flown`."""
    timing = {"every_s": every_s, "seconds": seconds}
    return matchers.flown(script(*answers, **known), start, velocity=velocity, options=options, **timing)


def assert_prior(prior, east, north, sigma, moved=None):
    assert (prior.east_m, prior.north_m) == (pytest.approx(east), pytest.approx(north))
    assert prior.sigma_m == pytest.approx(sigma)
    if moved is not None:
        assert (prior.moved_east_m, prior.moved_north_m) == (pytest.approx(moved[0]), pytest.approx(moved[1]))


# Prediction


def drift_m(*legs_s, sigma_mps=0.5, speeds_mps=None):
    """How far a velocity leads astray: its error lasts, and it changes by 3 m/s2 between its samples.

    At a speed, the stamps of both ends are off by 30 ms each, too.
    """
    walks_m = [math.sqrt(3.0**2 * leg_s**3 / 12.0) for leg_s in legs_s]
    return math.hypot(sigma_mps * sum(legs_s), *walks_m, *(math.sqrt(2.0) * 0.03 * v for v in speeds_mps or ()))


def test_it_predicts_with_the_last_fixes_where_the_telemetry_has_no_velocity():
    """Six fixes a second, each 6 m further east; then it goes on, less and less certain."""
    places = [(10.0 + 6.0 * k, 20.0) for k in range(6)]
    priors = flown(*places, None, None, velocity=UNKNOWN).priors
    assert priors[1].sigma_m > 7.0  # at an unknown speed, either way
    first, second = priors[6:]
    assert (first.east_m, first.north_m) == (pytest.approx(46.0, abs=1.0), pytest.approx(20.0))
    assert (second.east_m, second.north_m) == (pytest.approx(52.0, abs=2.0), pytest.approx(20.0))
    assert 2.0 < first.sigma_m < second.sigma_m / math.sqrt(2.0) < 7.0


def test_dead_reckoning_adds_up_over_refusals():
    """By the mean of two velocities; a refusal doubles the area searched, and not the prediction's."""
    velocities = [(4.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)]
    run = flown((10.0, 20.0), None, None, None, velocity=velocities)
    _, first, second, third = run.priors
    speeds_mps = 4.0, math.hypot(4.0, 2.0), math.hypot(2.0, 4.0)
    sigmas_m = [math.hypot(1.0, drift_m(*[1.0] * n, speeds_mps=speeds_mps[:n])) for n in (1, 2, 3)]
    assert_prior(first, 14.0, 20.0, sigmas_m[0], moved=(4.0, 0.0))
    assert_prior(second, 18.0, 22.0, sigmas_m[1] * math.sqrt(2.0), moved=(4.0, 2.0))
    assert_prior(third, 20.0, 26.0, sigmas_m[2] * 2.0, moved=(2.0, 4.0))
    assert_prior(run.navigator.prediction, 20.0, 26.0, sigmas_m[2])


def test_frames_without_stamps_are_an_interval_apart():
    options = NavigatorOptions(default_interval_s=0.5)
    run = flown((10.0, 20.0), None, seconds=[None, None], velocity=(8.0, 0.0), options=options)
    assert_prior(run.priors[1], 14.0, 20.0, math.hypot(1.0, drift_m(0.5, speeds_mps=[8.0])))


def test_a_start_that_leads_nowhere_widens_and_is_left_in_turns():
    """It is right 99 times in 100; seven refusals later the vehicle is as probably elsewhere."""
    run = flown(*[None] * 11)
    assert_prior(run.priors[0], 10.0, 20.0, 5.0)
    grown_m = [2.0 ** (0.5 * k) * math.hypot(5.0, drift_m(*[1.0] * k)) for k in range(7)]
    assert [prior.sigma_m for prior in run.priors[:7]] == pytest.approx(grown_m)
    assert [prior is None for prior in run.priors[7:]] == [True, False, True, False]
    assert run.states[-1] == "SEARCHING"


@pytest.mark.parametrize(("sigma_m", "used"), [(0.2, True), (50.0, False)])
def test_the_tighter_of_its_own_prediction_and_a_given_prior_is_used(sigma_m, used):
    given = Prior(east_m=77.0, north_m=0.0, sigma_m=sigma_m)
    run = matchers.flown(script((10.0, 20.0), None), START, velocity=STILL, given=[None, given])
    assert (run.priors[1] == given) == used


# Belief


def test_a_match_of_the_whole_map_is_believed_once_others_agree():
    """Right with a probability of 0.99 each, by the motion that was measured; others are sought near the first."""
    answers = None, (100.0, 0.0), (104.1, 0.0), (108.0, 0.0), (112.0, 0.0), None
    run = flown(*answers, start=None, velocity=(4.0, 0.0), confidence=0.99)
    assert run.ends == ["low_score", *["unconfirmed"] * 3, "fix", "low_score"]
    assert run.priors[:2] == [None, None]
    assert_prior(run.priors[2], 104.0, 0.0, math.hypot(1.0, drift_m(1.0, speeds_mps=[4.0])))
    assert run.priors[5].east_m == pytest.approx(116.0, abs=0.2)
    assert (run.states[-1], run.navigator.reset_count) == ("COASTING", 0)


@pytest.mark.parametrize("second", [None, (140.0, 0.0)])
def test_a_match_that_is_not_confirmed_waits_longer(second):
    """A frame that finds nothing there, or finds another place, speaks against it."""
    places = (100.0, 0.0), second, *[(100.0 + 4.0 * k, 0.0) for k in range(2, 7)]
    ends = flown(*places, start=None, velocity=(4.0, 0.0), confidence=0.99).ends
    assert "fix" not in ends[:3]
    assert ends[5:] == ["fix"] * 2


def test_a_fix_that_contradicts_the_prediction_is_held_and_the_next_right_one_believed():
    run = flown((10.0, 20.0), (10.0, 60.0), (10.0, 20.0))
    assert run.ends == ["fix", "inconsistent", "fix"]
    assert "40.0 m from the prediction, sigma 1.7 m" in run.results[1].detail
    assert run.results[1].timestamp_ns == 1_000_000_000
    assert run.navigator.reset_count == 0


def test_the_gate_is_a_chi_square_of_the_prediction_and_the_fix():
    """Both known to 1 m, and the way besides: 18.4 lies at 4.29 sigmas."""
    sigma_m = math.hypot(1.0, 1.0, drift_m(1.0))
    for off_m, end in ((4.28 * sigma_m, "fix"), (4.30 * sigma_m, "inconsistent")):
        assert flown((10.0, 20.0), (10.0 + off_m, 20.0), confidence=1.0 - 1e-9).ends[1] == end


def test_within_the_gate_a_match_of_little_evidence_must_lie_nearer():
    off_m = 3.5 * math.hypot(1.0, 1.0, drift_m(1.0))
    ends = [flown((10.0, 20.0), (10.0 + off_m, 20.0), confidence=1.0 - wrong).ends[1] for wrong in (1e-9, 1e-3)]
    assert ends == ["fix", "unconfirmed"]


def test_fixes_that_agree_outweigh_a_track_that_was_as_short():
    """One fix, and it was wrong: a few that agree with each other are more."""
    run = flown((10.0, 20.0), *[(60.0, 20.0)] * 6)
    assert 4 <= run.fixed[1] <= 5
    assert (run.ends[1], run.navigator.reset_count) == ("inconsistent", 1)


def test_without_a_velocity_a_jump_is_believed_once_a_vehicle_could_have_flown_it():
    """50 m, from where it stood still: some three seconds at 3 m/s2 that change every second."""
    places = [(10.0, 20.0)] * 20 + [(60.0, 20.0)] * 25
    fixed = flown(*places, every_s=0.2, velocity=UNKNOWN).fixed
    assert 2.0 < 0.2 * (fixed[20] - 19) < 4.0
    assert fixed == [*range(20), *range(fixed[20], 45)]


@pytest.mark.parametrize(("late_s", "lost"), [(0.05, 0), (0.09, 0), (0.15, 1), (0.25, 2)])
@pytest.mark.parametrize("velocity", [(8.0, 0.0), UNKNOWN])
def test_a_picture_stamped_late_costs_no_other_frame(late_s, lost, velocity):
    """At 8 m/s and ten pictures a second, known to 5 cm; those that its stamp has overtaken are left out."""
    times_s = [0.1 * k for k in range(60)]
    del times_s[31 : 31 + lost]
    places = [(10.0 + 8.0 * time_s, 20.0) for time_s in times_s]
    stamps_s = [time_s + late_s * (k == 30) for k, time_s in enumerate(times_s)]
    run = flown(*places, seconds=stamps_s, velocity=velocity, sigma_m=0.05, confidence=1.0 - 1e-9)
    assert {*range(len(places))} - {*run.fixed} <= {30}


@pytest.mark.parametrize(("seconds_before", "held_s"), [(20.0, 10.0), (150.0, 18.0)])
def test_a_jump_that_lasts_is_unhealthy_at_first_and_believed_in_the_end(seconds_before, held_s):
    """A map that shifts by 40 m. Past evidence fades within a minute, however long the flight was right."""
    right = round(5 * seconds_before)
    run = flown(*[(10.0, 20.0)] * right, *[(50.0, 20.0)] * 125, every_s=0.2)
    assert all(run.healthy[:right])
    first = run.fixed[right]
    assert run.fixed == [*range(right), *range(first, right + 125)]
    assert 0.2 * (first - right + 1) == pytest.approx(held_s, abs=1.0)
    assert not any(run.healthy[right + 5 : first])  # a second after the last right fix
    assert (run.states[-1], run.navigator.reset_count) == ("TRACKING", 1)


def test_two_methods_that_disagree_for_a_second_are_unhealthy():
    healthy = flown(*[(10.0, 20.0)] * 10, *[Reason.INCONSISTENT] * 10, every_s=0.2).healthy
    assert healthy[:14] == [True] * 14  # for less than a second
    assert healthy[16:] == [False] * 4


def test_the_baseline_is_handed_out_as_it_comes():
    answers = (10.0, 20.0), (400.0, 20.0), None, (10.0, 20.0)
    assert flown(*answers, start=None, every_s=0.2, options=ACCEPT_ALL).ends == ["fix", "fix", "low_score", "fix"]


def test_a_broken_covariance_is_no_fix():
    for covariance in (np.zeros((3, 3)), np.full((3, 3), np.nan), np.diag([1.0, -1.0, 1.0])):
        broken = ScriptedMatcher(replace(fix_at(10.0, 20.0), covariance_m2=covariance))
        assert Navigator(broken, START).update(at(0.0)).reason is Reason.BAD_POSE


# Loss


def test_lost_after_enough_refusals_it_searches_the_whole_map_and_then_confirms():
    """Fourteen halve the odds from 1 in 10,000 to even. The whole map and dead reckoning take turns."""
    found = [(400.0, 2.0)] * 5
    run = flown((10.0, 20.0), *[None] * 15, *found, None, confidence=0.99)
    assert run.states[:18] == ["TRACKING", *["COASTING"] * 13, *["LOST"] * 4]
    assert run.states[-2:] == ["TRACKING", "COASTING"]
    assert [k for k, prior in enumerate(run.priors) if prior is None] == [15]
    assert_prior(run.priors[17], 400.0, 2.0, math.hypot(1.0, drift_m(1.0)))  # near what was found
    assert run.navigator.reset_count == 1


def test_late_frames_are_no_sign_of_being_lost():
    assert all(prior is not None for prior in flown(*[Reason.LATE] * 30).priors)


def test_lost_over_a_map_too_large_to_search_it_looks_where_dead_reckoning_leads():
    options = NavigatorOptions(lost_sigma_m=3.0)
    run = flown((10.0, 20.0), *[None] * 9, site=a_site(is_searchable=False), options=options)
    assert run.states[-1] == "LOST"
    sigmas_m = [prior.sigma_m for prior in run.priors[1:]]
    assert sigmas_m == sorted(sigmas_m)


def test_no_single_match_of_little_evidence_is_believed_after_a_run_of_refusals():
    """Not even where dead reckoning leads."""
    answers = (10.0, 20.0), *[None] * 14, (10.0, 20.0), None, *[(10.0, 20.0)] * 5
    fixed = flown(*answers, every_s=0.2, confidence=0.99).fixed
    assert (fixed[0], fixed[-1]) == (0, 21)
    assert fixed[1] >= 17


def test_a_prediction_that_is_too_uncertain_is_given_up():
    """100 m at 0.5 m/s: after 200 s in which there was no time to match."""
    states = flown((10.0, 20.0), *[Reason.LATE] * 200).states
    assert states[1:199] == ["COASTING"] * 198
    assert states[200] == "LOST"


def test_its_state_and_age_are_told():
    navigator = Navigator(script(), START)
    assert (navigator.state, navigator.healthy) == (NavigatorState.SEARCHING, False)
    assert navigator.anchor_age_s is None
    run = flown((10.0, 20.0), None, (10.0, 20.0), every_s=0.8)
    assert run.states == ["TRACKING", "COASTING", "TRACKING"]
    assert run.ages_s == pytest.approx([0.0, 0.8, 0.0])
    assert all(run.healthy)


# Stamps


@pytest.mark.parametrize("stamp", [3.0, 2.9, 0.0])
def test_a_frame_that_is_not_newer_is_an_error_and_changes_nothing(stamp):
    run = flown((10.0, 20.0), (10.0, 20.0), None, seconds=[1.0, 3.0])
    with pytest.raises(TelemetryError, match=r"^timestamp_ns: expected later than the last frame's 3000000000"):
        run.navigator.update(at(stamp, STILL))
    assert len(run.priors) == 2
    run.navigator.update(at(4.0, STILL))
    assert_prior(run.priors[2], 10.0, 20.0, pytest.approx(math.hypot(1.0, drift_m(1.0)), rel=0.1))


# What is handed on


def test_every_frame_gets_the_budget():
    matcher = script(None, None)
    navigator = Navigator(matcher, START, Budget(total_ms=40.0))
    for k in range(2):
        navigator.update(at(k))
    assert matcher.budgets == [Budget(total_ms=40.0)] * 2


# The simulated flight


@pytest.fixture(scope="module")
def fly(error_m, sim_site, sim_flight):
    def fly(method, *, profile="engine", start=True, skip=0, dark=()):
        """Frames from one on: their results, and the errors of those that are fixes."""
        matcher = TrackSettings(method=method, profile=profile, device="cpu").matcher(sim_site, sim_flight.camera)
        truth = sim_flight.truth[skip:]
        prior = Prior(lat_deg=truth[0].lat_deg, lon_deg=truth[0].lon_deg, sigma_m=10.0) if start else None
        navigator = Navigator(matcher, prior, options=ACCEPT_ALL if profile == "paper" else None)
        frames = list(sim_flight.frames[skip:])
        for k in dark:
            frames[k] = replace(frames[k], image=np.full_like(frames[k].image, k))
        results = [navigator.update(frame) for frame in frames]
        fixes = [(fix, place) for fix, place in zip(results, truth, strict=True) if isinstance(fix, Fix)]
        return results, np.array([error_m(sim_site, *each) for each in fixes])

    return fly


@pytest.mark.parametrize(("method", "rms_m"), [("ncc", 2.4), ("sift", 2.1)])
def test_the_simulated_flight_is_followed_better_than_the_paper(fly, sim_flight, method, rms_m):
    results, errors = fly(method)
    assert len(errors) >= 0.95 * len(results)
    assert math.sqrt(np.mean(errors**2)) < rms_m
    assert [result.timestamp_ns for result in results] == [frame.timestamp_ns for frame in sim_flight.frames]
    claimed = np.array([result.sigma_m for result in results if isinstance(result, Fix)])
    assert not ((errors > 10.0) & (errors > 3.0 * claimed)).any()  # no false fix
    if method == "sift":
        rows = zip(results, sim_flight.truth, strict=True)
        rise = [fix.up_m - truth.height_agl_m for fix, truth in rows if isinstance(fix, Fix)]
        assert math.sqrt(np.mean(np.square(rise))) < 2.0


def test_the_simulated_flight_is_joined_without_a_start(fly):
    """By its first frame, one of twelve: a place that stands out on the whole map needs no second."""
    _, errors = fly("ncc", start=False, skip=12)
    assert len(errors) == 12
    assert errors.max() < 10.0


@pytest.mark.parametrize("method", ["ncc", pytest.param("sift", marks=pytest.mark.slow)])
def test_the_papers_profile_flies_the_simulated_flight(fly, method):
    """Its NCC knows no tilt: at 7 degrees it is 18.4 m off at 150 m, and more where height and heading err."""
    results, errors = fly(method, profile="paper")
    assert len(errors) >= 0.9 * len(results)
    assert np.median(errors) < (18.4 if method == "ncc" else 2.1)


def test_a_flight_is_found_again_after_an_outage(fly):
    """The camera sees nothing for 5 frames, 4.5 s: the window grows until the town is back in it."""
    results, errors = fly("ncc", dark=range(8, 13))
    assert [result.reason for result in results if isinstance(result, NoFix)] == [Reason.NO_TEXTURE] * 5
    assert errors.max() < 10.0


# Pictures that repeat

PICTURE = np.full((8, 8), 90, np.uint8)


def shown(images, velocities):
    """The results of pictures a second apart, all of which match where the first one does."""
    navigator = Navigator(script(*[(10.0, 20.0)] * len(velocities)), START)
    frames = (at(k, velocity) for k, velocity in enumerate(velocities))
    return [navigator.update(replace(frame, image=image)) for frame, image in zip(frames, images, strict=True)]


def test_a_picture_that_repeats_while_the_vehicle_moves_is_refused():
    """Of a camera that hangs: its match is where the vehicle was."""
    first, again, still = shown([PICTURE, PICTURE.copy(), PICTURE.copy()], [(4.0, 0.0), (4.0, 0.0), STILL])
    assert isinstance(first, Fix)
    assert (again.reason, still.reason) == (Reason.FAILED, Reason.FAILED)
    assert again.detail == "the picture repeats the one 1.0 s and 4.0 m ago"


def test_a_buffer_that_is_filled_again_is_no_repeat():
    def filled(buffer):
        for level in (0, 10, 20):
            buffer[:] = level
            yield buffer

    assert all(isinstance(result, Fix) for result in shown(filled(PICTURE.copy()), [(0.6, 0.0)] * 3))


def test_a_camera_without_noise_may_show_one_place_twice():
    assert isinstance(shown([PICTURE, PICTURE], [STILL, STILL])[1], Fix)
