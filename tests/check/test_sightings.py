"""Sightings: poses of pictures that owe nothing to their telemetry."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from scenematch.check import sightings
from scenematch.check.sightings import sight

ATTITUDE = {"roll_deg": 4.0, "pitch_deg": -3.0, "heading_deg": 25.0}
NADIRS = np.array([[300.0, 290.0], [320.0, 310.0], [290.0, 330.0], [330.0, 280.0]])


@pytest.mark.parametrize("told_off_deg", [0.0, 5.0])
def test_pictures_that_features_alone_do_not_place_are_placed_from_a_rough_heading(
    ground, camera, monkeypatch, told_off_deg
):
    """And their poses are the pictures', whatever heading, height and tilt the telemetry states."""
    monkeypatch.setattr(sightings, "_by_features", lambda *_: [])
    stated = {"heading_deg": 25.0 + told_off_deg, "height_agl_m": 155.0, "roll_deg": 0.0, "pitch_deg": 0.0}
    frames = [replace(ground.frame(camera, nadir, 150.0, **ATTITUDE), **stated) for nadir in NADIRS]
    found, is_mirrored = sight(frames, [ground.prior(nadir) for nadir in NADIRS], ground.site, camera)
    assert not is_mirrored
    assert [one.index for one in found] == [0, 1, 2, 3]
    for one, nadir in zip(found, NADIRS, strict=True):
        assert asdict(one.attitude) == pytest.approx(ATTITUDE, abs=0.5)
        assert one.height_agl_m == pytest.approx(150.0, abs=1.0)
        assert np.hypot(*(one.en_m - ground.enu_from_pixel(nadir))) < 1.5
