"""A telemetry whose roll and pitch are wrong: the picture outweighs it, by each method."""

from dataclasses import replace

import numpy as np
import pytest

from engine import Fix, OrthoMap, SceneMatcher

NADIR = np.array([310.0, 305.0])
TRUE = {"roll_deg": 4.0, "pitch_deg": -3.0, "heading_deg": 20.0}


@pytest.fixture(scope="module")
def site(ground):
    flat = np.zeros(ground.gray.shape, np.float32)
    return OrthoMap.from_arrays(
        ground.gray, ground.pixel_to_crs, f"EPSG:{ground.epsg}", surface_m=flat, georeference_sigma_m=0.1
    )


@pytest.mark.parametrize("method", ["ncc", "sift", "auto"])
@pytest.mark.parametrize(
    "stated",
    [
        {"roll_deg": 6.0, "pitch_deg": -1.0},  # a mount that is off
        {"roll_deg": -3.0, "pitch_deg": 4.0},  # swapped
        {"roll_deg": -4.0, "pitch_deg": 3.0},  # of the other sign
        {"roll_deg": 0.07, "pitch_deg": -0.05},  # radians
        {"roll_deg": 14.0, "pitch_deg": -3.0},
        {"roll_deg": 4.0, "pitch_deg": 7.0},
        {"roll_deg": 4.0, "pitch_deg": -13.0},
        {"roll_deg": -6.0, "pitch_deg": -3.0},
    ],
)
def test_the_picture_outweighs_a_wrong_roll_and_pitch(ground, site, camera, method, stated):
    frame = replace(ground.frame(camera, NADIR, 150.0, **TRUE), **stated)
    fix = SceneMatcher(site, camera, method, "cpu").locate(frame, ground.prior(NADIR))
    assert isinstance(fix, Fix)
    off_m = np.array([fix.east_m, fix.north_m]) - ground.enu_from_pixel(NADIR)
    assert np.hypot(*off_m) < 1.0
    assert np.hypot(*off_m) < 3.0 * fix.sigma_m
    assert fix.attitude is not None
    assert abs(fix.attitude.roll_deg - TRUE["roll_deg"]) < 0.5
    assert abs(fix.attitude.pitch_deg - TRUE["pitch_deg"]) < 0.5
