"""The vote for a translation: what is planted is found, and chance is not taken for it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.kernels.clusters import count_apart, count_near_pairs, densest
from engine.matching.votes import TURNS_DEG, rotation, vote

RADIUS_PX, DISTINCT_PX = 4.0, 2.0
NOTHING = np.zeros(1000, bool)
"""No match is explained by a pose."""


def planted(rng, *, right, wrong, turn_deg=0.0, shift=(31.0, -12.0)):
    """Matches of which the first few agree on one translation, to half a pixel, and the others on nothing."""
    photo = rng.uniform(-80, 80, (right + wrong, 2))
    on_map = photo @ rotation(turn_deg).T + shift + rng.normal(0, 0.5, photo.shape)
    on_map[right:] = rng.uniform(-180, 180, (wrong, 2))
    return photo, on_map


@pytest.mark.parametrize("turn_deg", TURNS_DEG)
def test_one_match_in_ten_gives_the_turn_and_the_place(turn_deg):
    photo, on_map = planted(np.random.default_rng(3), right=20, wrong=180, turn_deg=turn_deg)
    found = vote(photo, on_map, RADIUS_PX, DISTINCT_PX)
    assert found.turn_deg == turn_deg
    assert found.voters[:20].all()
    assert np.hypot(*(found.shift_px - (31.0, -12.0))) < 1.0
    assert found.surprise - math.log(found.tried) > 23.0
    assert found.rival_surprise(NOTHING[: len(photo)]) < 0.5 * found.surprise


def test_chance_makes_a_vote_no_oftener_than_its_surprise_says():
    """One of n translations surprises by log n + e with a probability of at most exp(-e): 20 of 200 by 2.3."""
    rng = np.random.default_rng(5)
    votes = [vote(*planted(rng, right=0, wrong=60), RADIUS_PX, DISTINCT_PX) for _ in range(200)]
    excess = [found.surprise - math.log(found.tried) for found in votes if found is not None]
    assert len(excess) > 150
    assert sum(e > 2.3 for e in excess) <= 20
    assert sum(e > 6.9 for e in excess) == 0


def test_matches_that_see_the_same_pixels_are_one_piece_of_evidence():
    """Four keypoints on each of 12 corners say no more than one on each."""
    rng = np.random.default_rng(8)
    photo, on_map = planted(rng, right=12, wrong=60)
    jitter = rng.normal(0, 0.3, (4, 72, 2))
    once = vote(photo, on_map, RADIUS_PX, DISTINCT_PX)
    often = vote((photo + jitter).reshape(-1, 2), (on_map + jitter).reshape(-1, 2), RADIUS_PX, DISTINCT_PX)
    assert np.count_nonzero(once.voters) >= 12
    assert np.count_nonzero(often.voters) >= 48
    assert often.surprise == pytest.approx(once.surprise, rel=0.25)


def test_crowded_matches_count_less():
    """Where all points of frame and map lie in two small crowds, agreeing on their distance says nothing."""
    rng = np.random.default_rng(7)
    photo, on_map = rng.normal(0, 2, (40, 2)), rng.normal((31.0, -12.0), 2, (40, 2))
    found = vote(photo, on_map, RADIUS_PX, DISTINCT_PX)
    assert np.count_nonzero(found.voters) > 20
    assert found.surprise - math.log(found.tried) < 6.9


def test_a_second_place_with_as_many_votes_is_a_rival():
    photo = np.random.default_rng(9).uniform(-80, 80, (60, 2))
    on_map = photo + np.where(np.arange(60)[:, None] < 30, (31.0, -12.0), (-60.0, 50.0))
    found = vote(photo, on_map, RADIUS_PX, DISTINCT_PX)
    assert np.count_nonzero(found.voters) == 30
    rival = found.rival_surprise(NOTHING[:60])
    assert rival == pytest.approx(found.surprise, rel=0.2)  # as many, but crowded otherwise
    assert found.rival_surprise(found.voters) == rival  # which the pose of the winner does not explain


def test_matches_of_the_pose_are_no_rival_though_a_wrong_height_scatters_their_votes():
    photo, on_map = planted(np.random.default_rng(10), right=60, wrong=60)
    on_map[:60] += 0.3 * photo[:60]
    found = vote(photo, on_map, RADIUS_PX, DISTINCT_PX)
    assert found.rival_surprise(NOTHING[:120]) > 0.5 * found.surprise
    assert found.rival_surprise(np.arange(120) < 60) < 0.3 * found.surprise


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


@given(st.integers(0, 60), st.floats(0.1, 50.0), st.integers(0, 2**32 - 1))
def test_points_apart_are_a_set_that_nothing_can_join(count, apart, seed):
    points = np.random.default_rng(seed).uniform(0.0, 100.0, (count, 2))
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.hypot(*(point - other)) > apart for other in kept):
            kept.append(point)
    assert count_apart(points, apart) == len(kept)


def test_without_matches_nothing_is_voted_for():
    assert vote(np.zeros((0, 2)), np.zeros((0, 2)), RADIUS_PX, DISTINCT_PX) is None
    alone = vote(np.zeros((1, 2)), np.ones((1, 2)), RADIUS_PX, DISTINCT_PX)
    assert np.count_nonzero(alone.voters) == 1
    assert alone.surprise == 0.0 < math.log(alone.tried)
