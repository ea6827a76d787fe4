"""The null hypothesis of SIFT: what the mirrored frame reaches is chance, and counts against the pose."""

from __future__ import annotations

import numpy as np
import pytest

from engine import Fix, MatcherOptions, NoFix, Reason, SceneMatcher
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


NEARLY_NONE = 1e-20  # a risk that leaves nothing beyond doubt


def locate(ground, camera, nadir, risk):
    options = MatcherOptions(risk=risk)
    return SceneMatcher(ground.site, camera, "sift", "cpu", options).locate(
        ground.frame(camera, nadir), ground.prior(nadir)
    )


def test_a_frame_of_the_map_beats_its_mirror_image(ground, camera):
    result = locate(ground, camera, NADIR, NEARLY_NONE)
    assert isinstance(result, Fix)
    assert np.hypot(*(np.array(result.map_xy_px) - NADIR)) < 0.3


def test_a_frame_that_is_its_own_mirror_image_is_refused(symmetrical, camera):
    result = locate(symmetrical, camera, ON_AXIS, 1e-4)
    assert isinstance(result, NoFix)
    assert result.reason is Reason.AMBIGUOUS
    assert "the mirrored frame fits the map as well" in result.detail
