"""Frames in order: dead reckoning against figures done by hand, loss and re-acquisition, and a whole flight."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine import (
    Attitude,
    Budget,
    Fix,
    Frame,
    MatcherOptions,
    Navigator,
    NavigatorOptions,
    NoFix,
    OptionError,
    OrthoMap,
    Prior,
    Reason,
    SceneMatcher,
    TelemetryError,
    Timings,
    Window,
)

IMAGE = np.zeros((8, 8), np.uint8)
START = Prior(east_m=10.0, north_m=20.0, sigma_m=5.0)
SECOND = 1_000_000_000


def fix_at(east_m, north_m, sigma_m=1.0, *, timestamp_ns=None, up_m=None):
    return Fix(
        timestamp_ns=timestamp_ns,
        lat_deg=48.0,
        lon_deg=15.0,
        east_m=east_m,
        north_m=north_m,
        up_m=up_m,
        covariance_m2=sigma_m**2 * np.eye(3),
        attitude=Attitude(0.0, 0.0, 0.0),
        score=0.9,
        method="sift",
        window=Window(0, 0, 10, 10),
        timings=Timings(),
        map_xy_px=(5.0, 5.0),
    )


class Script:
    """A matcher that answers from a list: a place, or None for a refusal. It keeps what it was asked."""

    def __init__(self, *answers, site=None, sigma_m=1.0, up_m=None):
        self.site, self.answers, self.sigma_m, self.up_m = site, list(answers), sigma_m, up_m
        self.frames, self.priors, self.budgets = [], [], []

    def locate(self, frame, prior=None, budget=None):
        self.frames.append(frame)
        self.priors.append(prior)
        self.budgets.append(budget)
        place = self.answers.pop(0)
        if place is None:
            return NoFix(reason=Reason.LOW_SCORE, timestamp_ns=frame.timestamp_ns)
        return fix_at(*place, self.sigma_m, timestamp_ns=frame.timestamp_ns, up_m=self.up_m)


def at(seconds, velocity=(None, None), height_agl_m=100.0):
    stamp = None if seconds is None else round(seconds * SECOND)
    return Frame(IMAGE, stamp, height_agl_m, 0.0, east_velocity_mps=velocity[0], north_velocity_mps=velocity[1])


def assert_prior(prior, east, north, sigma, moved=None):
    assert (prior.east_m, prior.north_m) == (pytest.approx(east), pytest.approx(north))
    assert prior.sigma_m == pytest.approx(sigma)
    if moved is not None:
        assert (prior.moved_east_m, prior.moved_north_m) == (pytest.approx(moved[0]), pytest.approx(moved[1]))


def test_a_flight_begins_at_its_start():
    script = Script((10.0, 20.0))
    navigator = Navigator(script, START)
    assert not navigator.tracking
    assert isinstance(navigator.update(at(1.0)), Fix)
    assert navigator.tracking
    assert_prior(script.priors[0], 10.0, 20.0, 5.0)


def test_without_a_start_the_whole_map_is_searched_until_a_first_fix():
    script = Script(None, None, (3.0, 4.0), (3.0, 4.0))
    navigator = Navigator(script)
    for k in range(4):
        navigator.update(at(k))
    assert script.priors[:3] == [None, None, None]
    assert script.priors[3] is not None


def test_it_predicts_with_the_velocity_of_the_telemetry():
    """2 s at (7, -3) m/s, known to 0.5 m/s: 14 m east and 6 m south, 1 m of sigma more."""
    script = Script((100.0, 50.0), None)
    navigator = Navigator(script, START)
    navigator.update(at(1.0))
    navigator.update(at(3.0, (7.0, -3.0)))
    assert_prior(script.priors[1], 114.0, 44.0, math.hypot(1.0, 1.0), moved=(14.0, -6.0))


def test_it_predicts_with_the_last_fixes_where_the_telemetry_has_no_velocity():
    """6 m east in 1 s, then 2 s more: 12 m further, and 3 m/s2 may have changed that by 6 m, plus 1 m/s."""
    script = Script((100.0, 50.0), (106.0, 50.0), None)
    navigator = Navigator(script, START)
    for seconds in (1.0, 2.0, 4.0):
        navigator.update(at(seconds))
    assert_prior(script.priors[1], 100.0, 50.0, math.hypot(1.0, 7.5), moved=(0.0, 0.0))  # 15 m/s, either way
    assert_prior(script.priors[2], 118.0, 50.0, math.hypot(1.0, 8.0), moved=(12.0, 0.0))


def test_dead_reckoning_adds_up_over_refusals():
    script = Script((0.0, 0.0), None, None, None)
    navigator = Navigator(script, START, options=NavigatorOptions(growth=1.5))
    navigator.update(at(0.0))
    for seconds, velocity in ((1.0, (4.0, 0.0)), (2.0, (4.0, 2.0)), (3.0, (0.0, 2.0))):
        navigator.update(at(seconds, velocity))
    first, second, third = script.priors[1:]
    assert_prior(first, 4.0, 0.0, math.sqrt(1.25), moved=(4.0, 0.0))
    assert_prior(second, 8.0, 2.0, math.sqrt(1.5) * 1.5, moved=(4.0, 2.0))
    assert_prior(third, 8.0, 4.0, math.sqrt(1.75) * 1.5**2, moved=(0.0, 2.0))


def test_a_fix_ends_the_growth():
    script = Script((0.0, 0.0), None, None, (20.0, 0.0), None)
    navigator = Navigator(script, START)
    for k in range(5):
        navigator.update(at(k, (0.0, 0.0)))
    assert_prior(script.priors[4], 20.0, 0.0, math.hypot(1.0, 0.5))


def test_the_uncertainty_of_a_fix_is_that_of_the_next_prediction():
    script = Script((0.0, 0.0), None, sigma_m=4.0)
    navigator = Navigator(script, START)
    navigator.update(at(0.0))
    navigator.update(at(1.0, (0.0, 0.0)))
    assert script.priors[1].sigma_m == pytest.approx(math.hypot(4.0, 0.5))


@pytest.mark.parametrize("stamp", [3.0, 2.999, 0.0])
def test_a_frame_that_is_not_newer_is_an_error_and_changes_nothing(stamp):
    script = Script((0.0, 0.0), (1.0, 0.0), None)
    navigator = Navigator(script, START)
    navigator.update(at(1.0))
    navigator.update(at(3.0, (1.0, 0.0)))
    with pytest.raises(TelemetryError, match=r"^timestamp_ns: expected later than 3000000000 .*, got "):
        navigator.update(at(stamp, (1.0, 0.0)))
    assert len(script.priors) == 2
    navigator.update(at(4.0, (1.0, 0.0)))
    assert_prior(script.priors[2], 2.0, 0.0, math.hypot(1.0, 0.5))


def test_frames_without_stamps_are_an_interval_apart():
    script = Script((0.0, 0.0), None)
    navigator = Navigator(script, START, options=NavigatorOptions(default_interval_s=0.5))
    navigator.update(at(None))
    navigator.update(at(None, (8.0, 0.0)))
    assert_prior(script.priors[1], 4.0, 0.0, math.hypot(1.0, 0.25))


def test_lost_after_enough_refusals_it_searches_the_whole_map():
    answers = [(0.0, 0.0), *[None] * 5, (40.0, 2.0), None]
    script = Script(*answers)
    navigator = Navigator(script, START, options=NavigatorOptions(lost_after=4))
    for k in range(len(answers)):
        navigator.update(at(k, (0.0, 0.0)))
        assert navigator.tracking == (k < 4 or k >= 6)
    known = [prior is not None for prior in script.priors]
    assert known == [True, True, True, True, True, False, False, True]
    assert_prior(script.priors[7], 40.0, 2.0, math.hypot(1.0, 0.5))


def test_a_start_that_leads_nowhere_widens_and_is_then_forgotten():
    script = Script(*[None] * 4)
    navigator = Navigator(script, START, options=NavigatorOptions(lost_after=3, growth=2.0))
    for k in range(4):
        navigator.update(at(k))
    assert [prior and prior.sigma_m for prior in script.priors] == [5.0, 10.0, 20.0, None]


@pytest.mark.parametrize(("sigma_m", "used"), [(0.2, True), (50.0, False)])
def test_the_tighter_of_its_own_prediction_and_a_given_prior_is_used(sigma_m, used):
    script = Script((0.0, 0.0), None)
    navigator = Navigator(script, START)
    navigator.update(at(0.0))
    given = Prior(east_m=77.0, north_m=0.0, sigma_m=sigma_m)
    navigator.update(at(1.0, (0.0, 0.0)), given)
    assert (script.priors[1] == given) == used


def test_a_given_prior_is_used_where_it_knows_nothing_itself():
    script = Script(None)
    given = Prior(lat_deg=48.0, lon_deg=15.0, sigma_m=900.0)
    Navigator(script).update(at(0.0), given)
    assert script.priors == [given]


def test_the_height_of_a_fix_is_handed_on_to_frames_without_one():
    """SIFT's height is in the datum of the surface; its ground lies at 30 m."""
    surface = np.full((64, 64), 30.0, np.float32)
    grid = np.array([[0.5, 0.0, 5e5], [0.0, -0.5, 5.3e6]])
    site = OrthoMap.from_arrays(np.zeros((64, 64), np.uint8), grid, "EPSG:32633", surface_m=surface)
    script = Script((0.0, 0.0), (0.0, 0.0), None, site=site, up_m=130.0)
    navigator = Navigator(script, START)
    navigator.update(at(0.0, height_agl_m=None))
    navigator.update(at(1.0, height_agl_m=None))
    navigator.update(at(2.0, height_agl_m=95.0))
    assert [frame.height_agl_m for frame in script.frames] == [None, 100.0, 95.0]


def test_every_frame_gets_the_budget():
    script = Script(None, None)
    navigator = Navigator(script, START, Budget(total_ms=40.0))
    for k in range(2):
        navigator.update(at(k))
    assert script.budgets == [Budget(total_ms=40.0)] * 2


@pytest.mark.parametrize("name", NavigatorOptions.__dataclass_fields__)
def test_options_are_refused_by_name(name):
    for value in (0, -1.0, math.nan, math.inf):
        with pytest.raises(OptionError, match=rf"^{name}: expected a number above 0, got "):
            NavigatorOptions(**{name: value})
    with pytest.raises(OptionError, match=r"^growth: expected 1 or more, got 0.9"):
        NavigatorOptions(growth=0.9)


# The simulated flight


def fly(sim_site, flight, method, *, profile="engine", start=True, skip=0):
    matcher = SceneMatcher(sim_site, flight.camera, method, "cpu", MatcherOptions(profile=profile))
    first = flight.truth[skip]
    prior = Prior(lat_deg=first.lat_deg, lon_deg=first.lon_deg, sigma_m=10.0) if start else None
    navigator = Navigator(matcher, prior)
    return [navigator.update(frame) for frame in flight.frames[skip:]]


@pytest.fixture(scope="module")
def errors_of(error_m, sim_site, sim_flight):
    def measure(results, skip=0):
        rows = zip(results, sim_flight.truth[skip:], strict=True)
        return np.array([error_m(sim_site, fix, truth) for fix, truth in rows if isinstance(fix, Fix)])

    return measure


@pytest.mark.parametrize(("method", "rms_m"), [("ncc", 2.4), ("sift", 2.1)])
def test_the_simulated_flight_is_followed_better_than_the_paper(sim_site, sim_flight, errors_of, method, rms_m):
    results = fly(sim_site, sim_flight, method)
    errors = errors_of(results)
    assert len(errors) >= 0.95 * len(results)
    assert math.sqrt(np.mean(errors**2)) < rms_m
    assert [result.timestamp_ns for result in results] == [frame.timestamp_ns for frame in sim_flight.frames]
    claimed = np.array([result.sigma_m for result in results if isinstance(result, Fix)])
    assert not ((errors > 10.0) & (errors > 3.0 * claimed)).any()  # no false fix
    if method == "sift":
        rise = [
            fix.up_m - truth.height_agl_m
            for fix, truth in zip(results, sim_flight.truth, strict=True)
            if isinstance(fix, Fix)
        ]
        assert math.sqrt(np.mean(np.square(rise))) < 2.0


def test_the_simulated_flight_is_joined_without_a_start(sim_site, sim_flight, errors_of):
    errors = errors_of(fly(sim_site, sim_flight, "ncc", start=False, skip=12), skip=12)
    assert len(errors) >= 11
    assert errors.max() < 10.0


@pytest.mark.parametrize("method", ["ncc", "sift"])
def test_the_papers_profile_flies_the_simulated_flight(sim_site, sim_flight, errors_of, method):
    """Its NCC knows no tilt: at 7 degrees it is 18.4 m off at 150 m, and more where height and heading err."""
    results = fly(sim_site, sim_flight, method, profile="paper")
    errors = errors_of(results)
    assert len(errors) >= 0.9 * len(results)
    assert np.median(errors) < (18.4 if method == "ncc" else 2.1)


def test_a_flight_is_found_again_after_an_outage(sim_site, sim_flight, error_m):
    """The camera sees nothing for 5 frames, 4.5 s: the window grows until the town is back in it."""
    start = Prior(lat_deg=sim_flight.truth[0].lat_deg, lon_deg=sim_flight.truth[0].lon_deg, sigma_m=10.0)
    navigator = Navigator(SceneMatcher(sim_site, sim_flight.camera, "ncc", "cpu"), start)
    for k, (frame, truth) in enumerate(zip(sim_flight.frames, sim_flight.truth, strict=True)):
        if 8 <= k < 13:
            black = Frame(np.zeros_like(frame.image), frame.timestamp_ns, 150.0, 0.0)
            assert navigator.update(black).reason is Reason.NO_TEXTURE
        else:
            assert error_m(sim_site, navigator.update(frame), truth) < 10.0
