"""The map that several methods are tested on."""

import pytest


@pytest.fixture(scope="module")
def site(ground):
    return ground.flat_site
