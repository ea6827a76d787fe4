"""The vote for a translation: what is planted is found, and chance is not taken for it."""

import math

import numpy as np
import pytest

from engine.kernels.clusters import count_near_pairs, densest
from engine.matching.votes import SCALES, TURNS_DEG, _log10_binomial_tail, similarity, vote

RADIUS_PX = 4.0


def planted(rng, *, right, wrong, turn_deg=0.0, scale=1.0, shift=(31.0, -12.0)):
    """Matches of which the first few agree on one translation, to half a pixel, and the others on nothing."""
    photo = rng.uniform(-80, 80, (right + wrong, 2))
    on_map = photo @ similarity(turn_deg, scale).T + shift + rng.normal(0, 0.5, photo.shape)
    on_map[right:] = rng.uniform(-180, 180, (wrong, 2))
    return photo, on_map


@pytest.mark.parametrize("turn_deg", TURNS_DEG)
@pytest.mark.parametrize("scale", SCALES)
def test_one_match_in_ten_gives_the_turn_the_scale_and_the_place(turn_deg, scale):
    photo, on_map = planted(np.random.default_rng(3), right=20, wrong=180, turn_deg=turn_deg, scale=scale)
    found = vote(photo, on_map, RADIUS_PX)
    assert (found.turn_deg, found.scale) == (turn_deg, scale)
    assert found.voters[:20].all()
    assert np.hypot(*(found.shift_px - (31.0, -12.0))) < 1.0
    assert found.log10_nfa < -10
    assert found.rival < 0.5 * found.votes


def test_wrong_matches_are_taken_for_a_place_no_oftener_than_their_false_alarms_say():
    """The number of false alarms bounds the expected number of such votes: of 200 draws 20 may have 0.1."""
    rng = np.random.default_rng(5)
    alarms = [vote(*planted(rng, right=0, wrong=60), RADIUS_PX).log10_nfa for _ in range(200)]
    assert sum(alarm < -1.0 for alarm in alarms) <= 20
    assert sum(alarm < -3.0 for alarm in alarms) == 0


def test_crowded_matches_count_less():
    """Where all points of frame and map lie in two small crowds, agreeing on their distance says nothing."""
    rng = np.random.default_rng(7)
    photo, on_map = rng.normal(0, 2, (40, 2)), rng.normal((31.0, -12.0), 2, (40, 2))
    assert vote(photo, on_map, RADIUS_PX).votes > 20
    assert vote(photo, on_map, RADIUS_PX).log10_nfa > -3


def test_a_second_place_with_as_many_votes_is_a_rival():
    rng = np.random.default_rng(9)
    photo = rng.uniform(-80, 80, (60, 2))
    on_map = photo + np.where(np.arange(60)[:, None] < 30, (31.0, -12.0), (-60.0, 50.0))
    found = vote(photo, on_map, RADIUS_PX)
    assert found.votes == found.rival == 30


def test_the_densest_place_is_where_brute_force_finds_it():
    rng = np.random.default_rng(11)
    for _ in range(20):
        points = np.concatenate([rng.uniform(0, 100, (60, 2)), rng.normal(rng.uniform(10, 90, 2), 1.0, (12, 2))])
        near = np.hypot(*(points[:, None] - points).transpose(2, 0, 1)) <= 4.0
        assert np.count_nonzero(densest(points, 4.0)) >= 0.9 * near.sum(axis=1).max()


@pytest.mark.parametrize("spread", [0.01, 1.0, 1e5])
def test_the_densest_place_holds_every_point_where_all_lie_together(spread):
    points = np.random.default_rng(12).uniform(0.0, spread, (50, 2)) + 3e5
    assert densest(points, 2.0 * spread).all()
    apart = np.concatenate([points, points[:30] - 50.0 * spread])
    assert densest(apart, 2.0 * spread).tolist() == [True] * 50 + [False] * 30


def test_near_pairs_are_counted_one_by_one():
    rng = np.random.default_rng(13)
    a, b = rng.uniform(0, 50, (2, 40)), rng.uniform(0, 50, (2, 70))
    apart = np.hypot(*(a[:, :, None] - b[:, None, :]))
    assert count_near_pairs(*a, *b, 6.0) == np.count_nonzero(apart <= 6.0) > 50
    assert count_near_pairs(*a[:, :0], *b, 6.0) == 0


def test_without_matches_nothing_is_voted_for():
    assert vote(np.zeros((0, 2)), np.zeros((0, 2)), RADIUS_PX) is None
    alone = vote(np.zeros((1, 2)), np.ones((1, 2)), RADIUS_PX)
    assert alone.votes == 1
    assert alone.log10_nfa > 0


def test_the_tail_is_bounded_from_above():
    for n, k, p in ((40, 6, 0.01), (200, 20, 0.02), (10, 10, 0.3), (50, 1, 0.5)):
        exact = sum(math.comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(k, n + 1))
        assert math.log10(exact) <= _log10_binomial_tail(n, k, p) <= 0.0
