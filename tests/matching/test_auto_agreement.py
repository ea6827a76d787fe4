"""Where NCC and SIFT differ: of one place SIFT's pose is taken and made vaguer, of two the more evident one."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine import Reason, SceneMatcher
from engine.matching.evidence import Evidence, probability
from engine.matching.feature_pose import FeatureMatcher
from engine.matching.ladder import Rung, climb
from engine.matching.ncc import Ncc
from engine.matching.sift import Sift


@pytest.fixture
def told(site, camera, frame, prior, monkeypatch):
    """The answer of auto if NCC's fix is this far off, by the evidence for each; and SIFT's fix."""

    def answer(off_m, ncc_nats, sift_nats):
        rungs_of_ncc, rungs_of_sift, seen = Ncc.rungs, Sift.rungs, []

        def off(self, query):
            found = climb(query, rungs_of_ncc(self, query)[0])["ncc"]
            moved = {"east_m": found.fix.east_m + off_m, "covariance_m2": 0.01 * np.eye(3), "map_sigma_m": 0.0}
            found = weighed(replace(found, fix=replace(found.fix, stage="fine", **moved)), ncc_nats)
            return [Rung("ncc", "peak", lambda _: {"told": 1.0}, lambda *_: found)], []

        def noted(self, query):
            seen.append(weighed(climb(query, rungs_of_sift(self, query))["sift"], sift_nats))
            return [Rung("sift", "features", lambda _: {"told": 1.0}, lambda *_: seen[0])]

        monkeypatch.setattr(Ncc, "rungs", off)
        monkeypatch.setattr(Sift, "rungs", noted)
        return SceneMatcher(site, camera, "auto", "cpu").locate(frame, prior), seen[0].fix

    return answer


def weighed(found, nats):
    return found.weighed(Evidence(nats, 0.0, math.e, 1.0, None, is_tested=True))


def test_a_small_difference_widens_the_covariance(told):
    result, sift = told(4.0, ncc_nats=30.0, sift_nats=30.0)
    assert (result.east_m, result.north_m) == (sift.east_m, sift.north_m)
    assert result.covariance_m2[0, 0] > sift.covariance_m2[0, 0] + 0.8 * 4.0**2


@pytest.mark.parametrize(
    ("ncc_nats", "sift_nats", "wins"), [(10.0, 30.0, "sift"), (30.0, 10.0, "ncc"), (8.0, 30.0, "sift")]
)
def test_of_two_places_the_far_more_evident_one_is_the_answer(told, ncc_nats, sift_nats, wins):
    result, sift = told(25.0, ncc_nats=ncc_nats, sift_nats=sift_nats)
    assert result.method == wins
    assert ((result.east_m, result.north_m) == (sift.east_m, sift.north_m)) == (wins == "sift")
    assert result.confidence == pytest.approx(probability(abs(ncc_nats - sift_nats)), rel=1e-9)


@pytest.mark.parametrize("sift_nats", [22.0, 30.0, 38.0])
def test_two_places_that_are_about_as_evident_refuse(told, sift_nats):
    result, _ = told(25.0, ncc_nats=30.0, sift_nats=sift_nats)
    assert result.reason is Reason.AMBIGUOUS
    assert "evidence for another place" in result.detail


def test_a_refined_fix_beyond_doubt_is_not_matched_a_second_time(site, camera, frame, prior, monkeypatch):
    monkeypatch.setattr(FeatureMatcher, "find_at_once", lambda *_: pytest.fail("SIFT was asked"))
    monkeypatch.setattr(FeatureMatcher, "find", lambda *_: pytest.fail("SIFT was asked"))
    fix = SceneMatcher(site, camera, "auto", "cpu").locate(frame, prior)
    assert (fix.method, fix.stage) == ("ncc", "refined")
    assert 1.0 - fix.confidence < 1e-11
