"""The null hypothesis of SIFT: what the mirrored frame reaches is chance, and counts against the pose."""

from __future__ import annotations

import numpy as np

from engine import MatcherOptions, NoFix, Reason, SceneMatcher
from tests.support.fixes import px_off
from tests.support.ground import Ground


class SymmetricalGround(Ground):
    """Its west mirrors its east, so that a frame from above the axis is its own mirror image."""

    def levels(self, east_m, north_m):
        return super().levels(np.abs(east_m), north_m)


def locate(ground, camera, nadir_px, risk):
    matcher = SceneMatcher(ground.site, camera, "sift", "cpu", MatcherOptions(risk=risk))
    return matcher.locate(ground.frame(camera, nadir_px), ground.prior(nadir_px))


def test_a_frame_of_the_map_beats_its_mirror_image(ground, camera):
    """At a risk that leaves nothing beyond doubt."""
    nadir_px = np.array([310.0, 305.0])
    assert px_off(locate(ground, camera, nadir_px, 1e-20), nadir_px) < 0.3


def test_a_frame_that_is_its_own_mirror_image_is_refused(camera):
    result = locate(SymmetricalGround(), camera, np.array([319.5, 305.0]), 1e-4)
    assert isinstance(result, NoFix)
    assert result.reason is Reason.AMBIGUOUS
    assert "the mirrored frame fits the map as well" in result.detail
