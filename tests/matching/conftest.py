"""The map that several methods are tested on, its matchers, and a frame with its prior."""

import numpy as np
import pytest

from engine import SceneMatcher

NADIR = np.array([315.0, 296.0])


@pytest.fixture(scope="module")
def site(ground):
    return ground.flat_site


@pytest.fixture(scope="session")
def frame(ground, camera):
    """Taken above pixel (315, 296) of the ground's map."""
    return ground.frame(camera, NADIR, heading_deg=25.0, roll_deg=3.0, pitch_deg=-2.0, timestamp_ns=77)


@pytest.fixture(scope="session")
def prior(ground):
    return ground.prior(NADIR)


@pytest.fixture(scope="module")
def matchers(ground, camera):
    return {method: SceneMatcher(ground.site, camera, method, "cpu") for method in ("ncc", "sift", "auto")}
