"""The null hypothesis of SIFT: a pose that is not quite certain must beat its own frame mirrored."""

from __future__ import annotations

import math

import numpy as np
import pytest

from engine import Fix, MatcherOptions, NoFix, OptionError, Reason, SceneMatcher
from engine.matching.acceptance import judge_pose
from engine.matching.confidence import PoseFeatures
from engine.options import SiftOptions
from tests.support.ground import Ground

NADIR = np.array([310.0, 305.0])
ON_AXIS = np.array([319.5, 305.0])


class SymmetricalGround(Ground):
    """Its west mirrors its east, so that a frame from above the axis is its own mirror image."""

    def levels(self, east_m, north_m):
        return super().levels(np.abs(east_m), north_m)


@pytest.fixture(scope="module")
def symmetrical():
    return SymmetricalGround()


def locate(ground, camera, nadir, null_test_below):
    options = MatcherOptions(sift=SiftOptions(null_test_below=null_test_below))
    return SceneMatcher(ground.site, camera, "sift", "cpu", options).locate(
        ground.frame(camera, nadir), ground.prior(nadir)
    )


def test_a_frame_of_the_map_beats_its_mirror_image(ground, camera):
    result = locate(ground, camera, NADIR, 1.0)
    assert isinstance(result, Fix)
    assert np.hypot(*(np.array(result.map_xy_px) - NADIR)) < 0.3


def test_a_frame_that_is_its_own_mirror_image_is_refused(symmetrical, camera):
    assert isinstance(locate(symmetrical, camera, ON_AXIS, 0.0), Fix)
    result = locate(symmetrical, camera, ON_AXIS, 1.0)
    assert isinstance(result, NoFix)
    assert result.reason is Reason.AMBIGUOUS
    assert "the mirrored frame fits the map as well" in result.detail
    assert not result.candidates  # it is no evidence for later frames either


def test_the_null_hypothesis_needs_to_reach_only_as_much():
    features = PoseFeatures(-20.0, 0.5, 0.5, 0.2)
    assert judge_pose(features, 0.999, 0.995) is None
    assert judge_pose(features, 0.999, 0.995, -19.9) is None
    assert judge_pose(features, 0.999, 0.995, -20.0)[0] is Reason.AMBIGUOUS
    assert judge_pose(features, 0.99, 0.995)[0] is Reason.BAD_POSE


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan])
def test_the_test_asks_for_a_probability(value):
    with pytest.raises(OptionError, match=r"^null_test_below: expected a probability, got "):
        SiftOptions(null_test_below=value)
