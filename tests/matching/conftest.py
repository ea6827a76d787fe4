"""The map that several methods are tested on."""

import numpy as np
import pytest

from engine import OrthoMap


@pytest.fixture(scope="module")
def site(ground):
    """The ground with a surface model that says how flat it is: only then is a pose refined."""
    flat = np.zeros(ground.gray.shape, np.float32)
    return OrthoMap.from_arrays(ground.gray, ground.pixel_to_crs, f"EPSG:{ground.epsg}", surface_m=flat)
