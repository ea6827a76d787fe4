"""Headings count from true north at the place, wherever on the map: near a pole it turns within a street."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine import Window
from scenematch.runs.settings import TrackSettings
from tests.support.fixes import px_off
from tests.support.ground import Ground

PLANE_DEG = 25.0  # the heading in the plane's axes, by which the pictures are drawn
NADIR = np.array([500.0, 300.0])


@pytest.fixture(scope="module")
def polar():
    """3.3 km from the pole: 90 m east of the map's middle north has turned by a degree and a half."""
    return Ground(epsg=32661, lat_deg=89.97, lon_deg=15.0)


@pytest.fixture(scope="module")
def frame(polar, camera):
    """Its heading counts from true north, which is found by two places on the meridian of its own place."""
    lat, lon = (float(v) for v in polar.site.geodetic_from_pixel(NADIR))
    south, north = polar.site.frame.enu_from_geodetic(np.array([lat - 1e-5, lat + 1e-5]), lon)
    north_deg = math.degrees(math.atan2(*(north - south)))
    assert -1.6 < north_deg < -1.4
    drawn = polar.frame(camera, NADIR, 80.0, heading_deg=PLANE_DEG)
    return replace(drawn, heading_deg=PLANE_DEG - north_deg)


@pytest.fixture(scope="module")
def make(polar, camera):
    def build(method, profile="engine"):
        return TrackSettings(method=method, profile=profile, device="cpu").matcher(polar.site, camera)

    return build


def heading_off(fix, heading_deg):
    return abs(math.remainder(fix.attitude.heading_deg - heading_deg, 360.0))


@pytest.mark.parametrize(
    ("method", "profile"),
    [("ncc", "engine"), ("sift", "engine"), ("auto", "engine"), ("ncc", "paper"), ("sift", "paper")],
)
def test_a_frame_with_its_true_heading_lies_on_the_map(make, polar, frame, method, profile):
    fix = make(method, profile).locate(frame, polar.prior(NADIR))
    assert fix.score > 0.97
    assert px_off(fix, NADIR) < (1.0 if profile == "paper" else 0.2)
    if fix.attitude is not None:
        assert heading_off(fix, frame.heading_deg) < 0.05


@pytest.mark.parametrize("known", [True, False], ids=["prior", "whole map"])
def test_a_heading_that_was_searched_for_is_the_true_one(make, polar, frame, known):
    """Without a prior the search begins with north as in the map's middle."""
    turned = replace(frame, heading_deg=frame.heading_deg + 20.0, heading_sigma_deg=8.0)
    fix = make("ncc").locate(turned, polar.prior(NADIR) if known else None)
    assert heading_off(fix, frame.heading_deg) < 0.2


def test_an_explanation_lays_the_frame_by_its_true_heading(make, frame):
    window, told = Window(300, 100, 340, 400), (frame, replace(frame, heading_deg=PLANE_DEG))
    scores = [make("ncc").explain(stated, window).surface.score for stated in told]
    assert scores[0] > 0.97
    assert scores[1] < 0.93
