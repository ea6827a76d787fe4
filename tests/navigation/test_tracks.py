"""Tracks: their motion against independent figures, their odds by Bayes' rule, and flights."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine import NavigatorOptions, Prior, Window
from engine.matching.evidence import nats_of
from engine.navigation.motion import PositionEstimate, Step, Ways
from engine.navigation.tracks import CERTAIN, MAX_TRACKS, MISS, Match, Track, Tracks, stated_nats
from tests.support.fixes import a_fix
from tests.support.matchers import ScriptedMatcher, flown

OPTIONS = NavigatorOptions()
UNKNOWN = (None, None)  # velocity
AREA_M2 = 1e4
LONG_AGO = NavigatorOptions(memory_s=1e12)  # nothing fades


def fix_at(east_m, north_m=0.0, confidence=0.9999, sigma_m=1.0):
    window = Window(0, 0, 1000, 1000)
    return a_fix(east_m, north_m, sigma_m, method="sift", window=window, confidence=confidence)


def a_track(velocity=(0.0, 0.0), covariance=((4.0, 1.0), (1.0, 2.0)), **known):
    """A track whose position is the filtered one, with their covariance to the velocity."""
    usual = {"en_m": np.zeros(2), "support": 20.0, "trusts_velocity": True, "number": 0, "fix": fix_at(0.0)}
    usual |= {"misses": 0, "filtered_m": known.get("en_m", np.zeros(2)), "velocity_mps": np.array(velocity, float)}
    return Track(covariance=np.array(covariance)[np.ix_([0, 0, 1], [0, 0, 1])], **(usual | known))


def position_and_velocity(track):
    """(2, 2) covariance of the two."""
    return track.covariance[np.ix_([0, 2], [0, 2])]


def match(fix, searched_m2=AREA_M2, *, stated=None, seen=None, **known):
    """A match a fifth of a second after the frame before."""
    usual = {"height_m": None, "refusals": 0, "given": None, "is_about_given": False}
    return Match(fix, searched_m2, Ways(0.2, stated, seen), **(usual | known))


# Motion


def test_a_measured_step_carries_position_and_velocity_with_the_error_that_matches_found():
    """Told 4 to 6 m/s east, found to be 1 m/s less: 5 m/s over 2 s, less 2 m."""
    step = Step(np.array([10.0, 0.0]), np.array([4.0, 0.0]), np.array([6.0, 0.0]), sigma_mps=0.5, noise_m2=0.3)
    track = a_track(velocity=(3.0, 0.0)).carried(Ways(2.0, stated=step), OPTIONS)
    assert (*track.en_m, *track.velocity_mps) == pytest.approx((8.0, 0.0, 5.0, 0.0))
    expected = np.array([[4.0 + 2 * 2.0 + 4 * 2.0 + 0.3, 5.0], [5.0, 2.0]])
    assert position_and_velocity(track) == pytest.approx(expected)


def test_the_error_of_a_measured_velocity_is_never_known_better_than_it_may_change():
    step = Step(np.zeros(2), np.zeros(2), np.zeros(2), sigma_mps=0.5, noise_m2=0.0)
    track = a_track(covariance=((1.0, 0.0), (0.0, 1e-6))).carried(Ways(1.0, stated=step), OPTIONS)
    assert track.covariance[2, 2] == 0.25


@pytest.mark.parametrize("interval_s", [0.1, 1.0, 10.0, 100.0])
def test_without_a_measurement_it_drifts_as_a_process_of_bounded_velocity(interval_s):
    """Against the same process integrated in small steps."""
    sigma_mps = 0.5 * OPTIONS.max_speed_mps
    fades_s = 2.0 * (sigma_mps / OPTIONS.acceleration_mps2) ** 2
    state, covariance, steps = np.array([0.0, 7.0]), np.array([[4.0, 1.0], [1.0, 2.0]]), 20_000
    way = np.eye(2) + interval_s / steps * np.array([[0.0, 1.0], [0.0, -1.0 / fades_s]])
    for _ in range(steps):
        state = way @ state
        covariance = way @ covariance @ way.T
        covariance[1, 1] += 2.0 * sigma_mps**2 / fades_s * interval_s / steps
    covariance[0, 0] += 2.0 * (OPTIONS.attitude_jitter_s * 7.0) ** 2  # the stamps of both ends are off
    track = a_track(velocity=(7.0, 0.0)).carried(Ways(interval_s), OPTIONS)
    assert (track.en_m[0], track.velocity_mps[0]) == pytest.approx(tuple(state), rel=1e-3, abs=1e-3)
    assert position_and_velocity(track) == pytest.approx(covariance, rel=2e-3)


def test_a_match_gives_the_position_and_filters_the_velocity():
    """Against the errors of position, velocity and match, written out."""
    track, sigma_m = a_track(velocity=(3.0, 0.0)), 1.5
    after = track.matched(PositionEstimate(np.array([2.0, 0.0]), sigma_m), fix_at(2.0), 30.0)
    gain = 1.0 / (4.0 + sigma_m**2)
    assert (after.en_m[0], after.velocity_mps[0]) == pytest.approx((2.0, 3.0 + gain * 2.0))
    errors = np.array([[0.0, 0.0, 1.0], [-gain, 1.0, gain]])  # of the two, by position, velocity and match
    before = np.block([[position_and_velocity(track), np.zeros((2, 1))], [np.zeros((1, 2)), sigma_m**2]])
    assert position_and_velocity(after) == pytest.approx(errors @ before @ errors.T)
    assert (after.support, after.misses) == (30.0, 0)


def test_what_a_track_cannot_explain_is_the_stamps_error():
    """10 m off, 2 m explained: the velocity changes as by a match that is as uncertain as the rest."""
    track = a_track(velocity=(3.0, 0.0))
    off = track.matched(PositionEstimate(np.array([10.0, 0.0]), 0.1), fix_at(10.0), 30.0)
    gain = 1.0 / 50.0  # half of the square, as the two axes share it
    assert (off.en_m[0], off.velocity_mps[0]) == pytest.approx((10.0, 3.0 + gain * 10.0))
    assert off.estimate.sigma_m == pytest.approx(math.sqrt(50.0 - 4.0))


def test_matches_of_metres_tell_a_velocity_within_seconds():
    """10 m/s by 30 matches in 5 s that are 6 m uncertain each: as sure as a straight line through them, almost."""
    place_m = PositionEstimate(np.zeros(2), 6.0)
    track, seconds = Track.begun(place_m, 9.0, 0, fix_at(0.0)).with_velocity(np.zeros(2), 7.5), 5.0 / 30.0
    for k in range(1, 31):
        track = track.carried(Ways(seconds), OPTIONS)
        place_m = PositionEstimate(np.array([10.0 * k * seconds, 0.0]), 6.0)
        track = track.matched(place_m, fix_at(*place_m.en_m), 9.0)
    assert track.velocity_mps == pytest.approx([10.0, 0.0], abs=1.5)
    assert track.covariance[2, 2] < 3.5**2
    assert track.estimate.sigma_m == pytest.approx(6.0)  # their errors last


def test_a_new_account_moves_as_the_pictures_show():
    """Without a velocity of the telemetry."""
    seen = Step(np.array([2.0, 0.0]), np.array([10.0, 0.0]), np.array([10.0, 0.0]), 0.2, 0.01)
    tracks = Tracks(OPTIONS).weighed(match(fix_at(0.0), seen=seen)).tracks
    for track in tracks.carried(Ways(0.2, seen=seen)).known:
        assert track.en_m == pytest.approx([2.0, 0.0])
        assert track.estimate.sigma_m < 1.1


@given(
    legs=st.lists(
        st.tuples(st.floats(0.01, 30.0), st.sampled_from(["stated", "seen", "blind"]), st.floats(0.05, 30.0)),
        min_size=1,
        max_size=12,
    )
)
@settings(max_examples=60)
def test_a_covariance_stays_one_whatever_happens(legs):
    track = a_track()
    for interval_s, source, sigma_m in legs:
        step = Step(np.ones(2), None if sigma_m > 10 else np.ones(2), np.ones(2), 0.01 * sigma_m, 0.01)
        ways = {"stated": Ways(interval_s, stated=step), "seen": Ways(interval_s, seen=step)}
        track = track.carried(ways.get(source, Ways(interval_s)), OPTIONS)
        assert np.linalg.eigvalsh(position_and_velocity(track))[0] > 0.0
        track = track.matched(PositionEstimate(np.zeros(2), sigma_m), fix_at(0.0), 20.0)
        assert np.linalg.eigvalsh(track.covariance)[0] >= -1e-9 * np.trace(track.covariance)


def test_a_way_in_two_parts_is_the_whole_way():
    begin, between, end = np.array([[4.0, 0.0], [4.6, 0.6], [6.0, 2.0]])
    way = Ways(2.0, stated=Step(np.array([10.0, 0.0]), begin, end, 0.5, 0.3))
    whole = a_track(velocity=(3.0, 1.0)).carried(way, OPTIONS)
    parts = a_track(velocity=(3.0, 1.0))
    parts = parts.carried(Ways(0.6, stated=Step(np.array([3.0, 0.0]), begin, between, 0.5, 0.09)), OPTIONS)
    parts = parts.carried(Ways(1.4, stated=Step(np.array([7.0, 0.0]), between, end, 0.5, 0.21)), OPTIONS)
    for name in ("en_m", "velocity_mps", "covariance", "support"):
        assert getattr(parts, name) == pytest.approx(getattr(whole, name)), name


# Bayes' rule


def tracks_of(*known, options=LONG_AGO):
    return Tracks(options, known, len(known))


def test_a_match_where_a_track_predicts_it_is_right_by_both():
    """The track: 20 nats. The match: 9.2 of its own, that it lies here, and that every second frame is empty."""
    weighed = tracks_of(a_track(covariance=((3.0, 0.0), (0.0, 1.0)))).weighed(match(fix_at(0.0)))
    own = CERTAIN + math.log(AREA_M2 / (2.0 * math.pi * 4.0)) + MISS
    grown = 20.0 + 0.5 * CERTAIN  # of the same ground
    right, wrong = grown - np.logaddexp(0.0, -own), np.logaddexp(grown - np.logaddexp(0.0, own), 0.0)
    assert weighed.log_odds == pytest.approx(right - wrong)
    assert (weighed.number, weighed.tracks.best.log_odds) == (0, pytest.approx(grown))


def test_a_match_elsewhere_is_weighed_against_the_track():
    weighed = tracks_of(a_track()).weighed(match(fix_at(500.0)))
    assert weighed.log_odds == pytest.approx(CERTAIN - np.logaddexp(0.0, 20.0 - MISS))
    assert [each.number for each in weighed.tracks.known] == [0, 0, 1, 1]
    left = 20.0 - MISS
    assert [each.log_odds for each in weighed.tracks.known] == pytest.approx([left, left - CERTAIN, CERTAIN, 0.0])


@pytest.mark.parametrize(("moved_m", "share"), [(0.0, 0.0), (30.0, 0.25), (300.0, 1.0)])
def test_a_match_of_the_same_ground_counts_half_and_its_agreement_nothing(moved_m, share):
    track = a_track(covariance=((3.0, 0.0), (0.0, 1.0)), en_m=np.array([moved_m, 0.0]))
    weighed = tracks_of(track).weighed(match(fix_at(moved_m), height_m=120.0))
    here = math.log(AREA_M2 / (2.0 * math.pi * 4.0))
    assert weighed.tracks.best.log_odds == pytest.approx(20.0 + (0.5 + 0.5 * share) * CERTAIN + share * here)


def test_of_two_motions_the_better_one_gains_whatever_the_ground():
    near = a_track(trusts_velocity=True, covariance=((3.0, 0.0), (0.0, 1.0)))
    far = a_track(trusts_velocity=False, covariance=((15.0, 0.0), (0.0, 1.0)))
    first, second = tracks_of(near, far).weighed(match(fix_at(0.0))).tracks.known
    assert first.trusts_velocity
    assert first.log_odds - second.log_odds == pytest.approx(math.log(16.0 / 4.0))


def test_a_frame_without_a_match_leaves_half_of_the_past_evidence():
    (known, *_) = tracks_of(a_track(support=CERTAIN + 100.0)).missed().known
    assert known.log_odds == pytest.approx(CERTAIN + 50.0 - MISS)


def test_a_match_of_little_evidence_far_from_the_prediction_leaves_a_track_without_it():
    """Right with probability 0.99: the next match decides between the two."""
    tracks = tracks_of(a_track(covariance=((3.0, 0.0), (0.0, 1.0))))
    weighed = tracks.weighed(match(fix_at(7.0, confidence=0.99)))
    assert weighed.log_odds < math.log(999.0)
    assert sorted({each.en_m[0] for each in weighed.tracks.known}) == [0.0, 7.0]
    assert weighed.tracks.weighed(match(fix_at(-1.0))).tracks.best.en_m[0] == -1.0


def test_a_match_belongs_to_the_account_that_predicts_it_best():
    vague = a_track(covariance=((900.0, 0.0), (0.0, 1.0)), support=40.0)
    rival = a_track(support=20.0, number=1, en_m=np.array([50.0, 0.0]))
    weighed = tracks_of(vague, rival).weighed(match(fix_at(50.0)))
    assert weighed.number == 1
    assert [each.misses for each in weighed.tracks.known if each.number == 0] == [1, 1]


def test_another_source_speaks_for_or_against_a_new_place_by_its_reliability():
    """It is right 99 times in 100; where it is wrong, it says nothing."""
    places = (PositionEstimate(np.array([east_m, 0.0]), 3.0) for east_m in (0.0, 500.0))
    at_odds = [match(fix_at(0.0, confidence=0.9), given=place) for place in places]
    assert at_odds[0].support > nats_of(0.9) + 3.0
    assert at_odds[1].support == pytest.approx(nats_of(0.9) + math.log(0.01))
    vague = PositionEstimate(np.zeros(2), 500.0)
    assert match(fix_at(0.0, confidence=0.9), 1.0, given=vague).support == pytest.approx(nats_of(0.9))


def test_no_single_match_gives_a_place_more_than_was_tested():
    assert match(fix_at(0.0, confidence=1.0 - 1e-12)).support == pytest.approx(nats_of(0.9999))
    assert stated_nats(fix_at(0.0, confidence=None)) == pytest.approx(math.log(999.0))


def test_after_refusals_a_new_place_needs_more_evidence():
    """Two prior odds: one frame in two shows a place, and one in forty; and nothing adds more than was tested."""
    supports = [match(fix_at(0.0, confidence=0.9999), refusals=each).support for each in (0, 38)]
    assert supports[0] - supports[1] == pytest.approx(math.log((38 + 1) / 1))
    assert match(fix_at(0.0, confidence=1.0 - 1e-9), refusals=38).support == CERTAIN


@given(places=st.lists(st.tuples(st.floats(-500, 500), st.floats(-500, 500)), min_size=1, max_size=60))
@settings(max_examples=40)
def test_the_set_is_bounded_and_sorted_and_holds_two_motions_of_each_account(places):
    tracks = Tracks(OPTIONS)
    for place in places:
        stated = Step(np.zeros(2), None, np.zeros(2), sigma_mps=0.5, noise_m2=0.0)
        tracks = tracks.carried(Ways(0.2)).weighed(match(fix_at(*place), stated=stated)).tracks
        kinds = [(id(each.fix), each.trusts_velocity) for each in tracks.known]
        assert len(kinds) == len(set(kinds)) <= MAX_TRACKS
        firsts = [each.log_odds for each in tracks.known[::2]]
        assert firsts == sorted(firsts, reverse=True)


# Flights


def fly(places, confidence=0.9999, seconds=1.0, velocity=UNKNOWN, priors=None, sigma_m=1.0, start=None):
    """Which frames, so many seconds apart, are fixed, and the navigator."""
    matcher = ScriptedMatcher(*(place and fix_at(*place, confidence, sigma_m) for place in places))
    run = flown(matcher, start, every_s=seconds, velocity=velocity, given=priors)
    return run.fixed, run.navigator


def test_chance_never_adds_up():
    places = np.random.default_rng(3).uniform(-60.0, 60.0, (60, 2))
    fixed, _ = fly([(50.0 * k + x, y) for k, (x, y) in enumerate(places)], 0.8, velocity=(50.0, 0.0))
    assert not fixed


@pytest.mark.parametrize("off_m", [None, 7.0])
def test_photographs_seconds_apart_are_fixes_with_and_without_positions_of_their_own(off_m):
    places = [(80.0 * k, 0.0) for k in range(8)]
    priors = [off_m and Prior(east_m=east + off_m, north_m=north, sigma_m=15.0) for east, north in places]
    fixed, navigator = fly(places, seconds=14.0, priors=priors)
    assert fixed == list(range(8))
    assert off_m is None or [prior.sigma_m for prior in navigator._matcher.priors] == [15.0] * 8


@pytest.mark.parametrize(("off_m", "confirmed", "first"), [(80.0, True, 1), (80.0, False, 20), (3.0, False, 0)])
@pytest.mark.parametrize("stage", ["coarse", "unconfirmed"])
def test_an_attitude_that_nothing_confirmed_is_believed_where_the_start_predicts(stage, off_m, confirmed, first):
    """Its error moves all matches alike, however many: they agree with each other, and not with the start."""
    fixes = [replace(fix_at(off_m + 1.4 * k), stage="fine" if confirmed else stage) for k in range(20)]
    start = Prior(east_m=0.0, north_m=0.0, sigma_m=10.0)
    run = flown(ScriptedMatcher(*fixes), start, every_s=0.2, velocity=(7.0, 0.0))
    assert run.fixed == list(range(first, 20))


@pytest.mark.parametrize("stage", ["coarse", "unconfirmed"])
def test_an_attitude_that_nothing_confirmed_is_believed_where_another_source_says(stage):
    """A flight's first photograph: the attitude and the position of the other source agree."""
    prior = Prior(east_m=5.0, north_m=0.0, sigma_m=15.0)
    assert flown(ScriptedMatcher(replace(fix_at(2.0), stage=stage)), given=[prior]).fixed == [0]


def test_telemetry_that_leads_nowhere_is_left_in_turns():
    """It is right 99 times in 100: after seven refusals every second frame searches the whole map."""
    run = flown(ScriptedMatcher(*[None] * 18), given=[Prior(east_m=0.0, north_m=0.0, sigma_m=15.0)] * 18)
    assert [k for k, prior in enumerate(run.priors) if prior is None] == [8, 10, 12, 14, 16]


# Velocities that are wrong

FAULTS = {
    "swapped": lambda v: v[::-1],
    "reversed": lambda v: -v,
    "km/h": lambda v: 3.6 * v,
    "knots for metres": lambda v: v / 0.5144,
    "feet": lambda v: 3.28 * v,
    "drifting": lambda v: v + np.array([4.3, 0.0]),
}


def measured(stated=lambda v: v, seconds=30.0, rate_hz=5.0, seed=1):
    """How many frames are refused of a vehicle that turns and brakes, and the navigator."""
    rng, count = np.random.default_rng(seed), int(seconds * rate_hz)
    place, places, velocities, phase = np.zeros(2), [], [], rng.uniform(0, 2 * math.pi)
    for k in range(count):
        course = phase + 0.8 * math.sin(0.2 * k / rate_hz + phase)
        speed_mps = 7.0 * (0.6 + 0.4 * math.cos(0.3 * k / rate_hz))
        velocity = speed_mps * np.array([math.sin(course), math.cos(course)])
        velocities.append(stated(velocity + rng.normal(0.0, 0.2, 2)).tolist())
        places.append((place + rng.normal(0.0, 0.3, 2)).tolist())
        place = place + velocity / rate_hz
    start = Prior(east_m=0.0, north_m=0.0, sigma_m=5.0)
    fixed, navigator = fly(places, 1.0 - 1e-6, 1.0 / rate_hz, velocities, sigma_m=0.3, start=start)
    return count - len(fixed), navigator


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, pytest.param(30.0, marks=pytest.mark.slow)])
def test_a_right_velocity_costs_no_fix_and_is_believed(rate_hz):
    for seed in range(6):
        refused, navigator = measured(rate_hz=rate_hz, seed=seed)
        assert refused == 0
        assert navigator._last.tracks.best.trusts_velocity


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_velocity_costs_few_fixes_and_is_not_believed_for_long(fault):
    for seed in range(3):
        refused, navigator = measured(FAULTS[fault], seed=seed)
        assert refused <= 8
        assert navigator.reset_count == 0


def test_a_velocity_that_comes_later_and_is_wrong_is_left_too():
    """The first frame came before the velocity."""
    places, velocities = [(1.4 * k, 0.0) for k in range(100)], [UNKNOWN, *[(-7.0, 0.0)] * 99]
    assert len(fly(places, 1.0 - 1e-6, 0.2, velocities, sigma_m=0.3)[0]) >= 92


def test_of_a_wrong_match_in_five_none_is_a_fix_and_few_right_ones_are_lost():
    """8 m off, a second apart, beside a right velocity."""
    rng = np.random.default_rng(0)
    places = [(7.0 * k + 8.0 * (k > 50 and k % 5 == 0), 0.0) for k in range(120)]
    fixed, _ = fly([(x + rng.normal(0, 0.4), y) for x, y in places], 0.9999, velocity=(7.0, 0.0))
    wrong = set(range(55, 120, 5))
    assert not wrong & set(fixed)
    assert len(fixed) >= 120 - 2 * len(wrong)


@pytest.mark.parametrize("velocity", [(7.0, 0.0), UNKNOWN])
def test_after_a_loss_a_place_far_away_is_found_within_a_second(velocity):
    way = [(1.4 * k, 0.0) for k in range(300)]
    fixed, _ = fly([*way, *[None] * 100, *((1000.0 + x, y) for x, y in way[:10])], seconds=0.2, velocity=velocity)
    assert next(k for k in fixed if k >= 400) <= 404
