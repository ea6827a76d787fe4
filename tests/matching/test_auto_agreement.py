"""Where NCC and SIFT differ: at one place SIFT's pose is taken and made vaguer, at two places nothing is."""

from dataclasses import replace

import numpy as np
import pytest

from engine import SceneMatcher
from engine.matching.ncc import Ncc
from engine.matching.sift import Sift
from engine.values import Reason


@pytest.mark.parametrize(("off_m", "same_place"), [(4.0, True), (25.0, False)])
def test_a_small_difference_widens_the_covariance_and_a_large_one_refuses(
    site, camera, frame, prior, monkeypatch, off_m, same_place
):
    own, compared = Ncc.locate, Sift.locate
    seen = []
    monkeypatch.setattr(Sift, "locate", lambda self, *args: seen.append(compared(self, *args)) or seen[-1])

    def off(self, query, *args, **kwargs):
        fix = own(self, query, *args, **kwargs)
        off = {"east_m": fix.east_m + off_m, "covariance_m2": 0.01 * np.eye(3), "map_sigma_m": 0.0}
        return replace(fix, stage="fine", **off)

    monkeypatch.setattr(Ncc, "locate", off)
    result = SceneMatcher(site, camera, "auto", "cpu").locate(frame, prior)
    if same_place:
        (sift,) = seen
        assert (result.east_m, result.north_m) == (sift.east_m, sift.north_m)
        assert result.covariance_m2[0, 0] > sift.covariance_m2[0, 0] + 0.8 * off_m**2
    else:
        assert result.reason is Reason.INCONSISTENT
        assert "m apart" in result.detail


def test_few_features_that_disagree_are_not_the_second_opinion(site, camera, frame, prior, monkeypatch):
    """All of them are; a pose of few, a level coarser, is off by more."""
    matcher = SceneMatcher(site, camera, "auto", "cpu")
    expected, few = matcher.locate(frame, prior), Sift.find_few

    def off(self, *args):
        found = few(self, *args)
        north_m = found.fix.north_m + 4.0
        fix = replace(found.fix, north_m=north_m, covariance_m2=0.01 * np.eye(3), map_sigma_m=0.0)
        return replace(found, fix=fix)

    monkeypatch.setattr(Sift, "find_few", off)
    result = matcher.locate(frame, prior)
    assert result.stage == expected.stage == "verified"
    assert (result.east_m, result.north_m) == (expected.east_m, expected.north_m)
