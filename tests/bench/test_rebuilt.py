"""A town that changes between the map and the flight: each house that comes or goes is on one of the two."""

import numpy as np
import pytest

from bench.accuracy.rebuilt import rebuilt
from scenematch.simulator import build_town
from tests.support.towns import under_map

SMALL = {"width_px": 300, "height_px": 280}


@pytest.mark.slow
def test_houses_come_and_go_between_the_map_and_the_flight():
    same, other = build_town(5, **SMALL), build_town(5, **SMALL, rebuild=rebuilt(5, 0.4))
    lost = (same.surface_m > 3.0) & (other.surface_m == 0.0)
    assert 0.05 < np.mean(lost) / np.mean(same.surface_m > 3.0) < 0.4  # not yet built when the map was made
    gone = (same.world.height_m > 3.0) & (other.world.height_m == 0.0)
    assert 0.05 < np.mean(gone) / np.mean(same.world.height_m > 3.0) < 0.4
    gone_on_map = under_map(same, gone).all(axis=(1, 3))
    assert not (lost & gone_on_map).any()  # what was pulled down is on the map
    assert (other.surface_m[gone_on_map] == same.surface_m[gone_on_map]).all()
