"""Evidence for a match: Bayes' rule against figures done by hand, and flights whose frames are seconds apart."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine import Fix, Frame, Navigator, Prior, Window
from engine.navigation.motion import PositionEstimate
from engine.navigation.odds import (
    MAX_PROBABILITY,
    agreement_log_odds,
    log_odds,
    match_log_odds,
    new_ground_share,
    repeated_log_odds,
)
from tests.support.fixes import a_fix
from tests.support.matchers import ScriptedMatcher

IMAGE = np.zeros((8, 8), np.uint8)
SECOND = 1_000_000_000
MAP_M = 1000.0


def fix_at(east_m, north_m, confidence=None, sigma_m=1.0):
    window = Window(0, 0, round(MAP_M), round(MAP_M))
    return a_fix(east_m, north_m, sigma_m, method="sift", window=window, confidence=confidence)


def flown(answers, seconds, start=None, priors=None):
    """The reasons, or "fix", of frames that are so many seconds apart, without velocities."""
    script = ScriptedMatcher(*(fix_at(*answer) for answer in answers))
    navigator, stated = Navigator(script, start), []
    for k in range(len(answers)):
        frame = Frame(IMAGE, round(k * seconds * SECOND), 100.0, 0.0)
        result = navigator.update(frame, None if priors is None else priors[k])
        stated.append("fix" if isinstance(result, Fix) else result.reason.value)
    return stated, script.priors, navigator


# Bayes' rule


def test_an_estimate_counts_by_the_densities_of_right_and_wrong_matches():
    """Right: a Gaussian of 5 m, here at its summit; wrong: anywhere in a square kilometre."""
    estimate = PositionEstimate(np.zeros(2), 3.0, log_odds(0.99))
    right = 0.99 / (2.0 * math.pi * 25.0)
    expected = math.log((1e6 + 2.0 * math.pi * 9.0) * right + 0.01)
    assert agreement_log_odds(estimate, fix_at(0.0, 0.0, sigma_m=4.0), 1e6) == pytest.approx(expected)


def test_an_estimate_that_is_contradicted_counts_by_the_probability_that_it_is_wrong():
    estimate = PositionEstimate(np.zeros(2), 3.0, log_odds(0.99))
    assert agreement_log_odds(estimate, fix_at(500.0, 0.0), 1e6) == pytest.approx(math.log(0.01))


def test_an_estimate_vaguer_than_what_was_searched_says_nothing():
    vague = PositionEstimate(np.zeros(2), 500.0, log_odds(0.99))
    assert abs(agreement_log_odds(vague, fix_at(0.0, 0.0), 1.0)) < 0.02


def test_no_match_is_trusted_beyond_what_was_tested():
    assert match_log_odds(fix_at(0.0, 0.0, 1.0 - 1e-12)) == log_odds(MAX_PROBABILITY)
    assert match_log_odds(fix_at(0.0, 0.0)) == log_odds(0.98)


def test_a_match_of_the_same_ground_counts_half_and_its_agreement_nothing():
    fix = fix_at(0.0, 0.0, 0.99)
    assert repeated_log_odds(fix, 4.0, 0.0) == pytest.approx(0.5 * match_log_odds(fix))
    assert repeated_log_odds(fix, 4.0, 1.0) == pytest.approx(match_log_odds(fix) + 4.0)
    assert (new_ground_share(30.0, 120.0), new_ground_share(300.0, 120.0)) == (0.25, 1.0)


# Frames seconds apart

WAY = [(80.0 * k, 0.0) for k in range(6)]


def telemetry(places, sigma_m=15.0):
    return [Prior(east_m=east + 7.0, north_m=north, sigma_m=sigma_m) for east, north in places]


def test_photographs_with_positions_of_their_own_are_fixes_one_by_one():
    stated, priors, navigator = flown([(*place, 0.98) for place in WAY], 14.0, priors=telemetry(WAY))
    assert stated == ["fix"] * 6
    assert [prior.sigma_m for prior in priors] == [15.0] * 6
    assert navigator.state.value == "tracking"


def test_photographs_alone_are_fixes_where_each_is_probable():
    stated, priors, _ = flown([(*place, 0.9995) for place in WAY], 14.0)
    assert stated == ["fix"] * 6
    assert priors[0] is None


def test_improbable_photographs_confirm_each_other_where_a_vehicle_can_fly_between_them():
    stated, _, _ = flown([(*place, 0.98) for place in WAY], 14.0)
    assert stated == ["unconfirmed"] + ["fix"] * 5
    scattered = [(3000.0 * (k % 2), 2000.0 * (k % 3), 0.98) for k in range(6)]
    assert "fix" not in flown(scattered, 14.0)[0]


def test_one_match_of_high_probability_is_refused_where_what_was_flown_contradicts_it():
    answers = [(0.0, 0.0, 0.9999), (900.0, 0.0, 0.9999), (16.0, 0.0, 0.9999)]
    assert flown(answers, 2.0)[0] == ["fix", "inconsistent", "fix"]


def test_a_match_far_from_its_own_telemetry_is_refused_until_others_agree():
    """The telemetry may be the one that is wrong; then the matches outweigh it one after the other."""
    astray = telemetry([(400.0, 400.0)] * 6)
    stated, _, _ = flown([(0.0, 0.0, 0.98)] * 6, 0.2, priors=astray)
    assert (stated[:2], stated[-1]) == (["unconfirmed"] * 2, "fix")


def test_telemetry_that_leads_nowhere_is_left_in_turns():
    """After twelve refusals every third frame searches the whole map."""

    script = ScriptedMatcher(*[None] * 18)
    navigator = Navigator(script)
    for k in range(18):
        navigator.update(Frame(IMAGE, k * SECOND, 100.0, 0.0), Prior(east_m=0.0, north_m=0.0, sigma_m=15.0))
    assert [k for k, prior in enumerate(script.priors) if prior is None] == [12, 15]
