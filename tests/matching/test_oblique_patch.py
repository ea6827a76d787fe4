"""What NCC takes of an oblique frame: the largest upright part that shows the map."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from engine.matching.oblique import largest_rectangle


@pytest.mark.parametrize("seed", range(6))
def test_the_largest_rectangle_is_that_of_an_exhaustive_search(seed):
    valid = np.random.default_rng(seed).random((9, 11)) > 0.25
    best = 0
    for top, bottom in itertools.combinations(range(10), 2):
        for left, right in itertools.combinations(range(12), 2):
            if valid[top:bottom, left:right].all():
                best = max(best, (bottom - top) * (right - left))
    box = largest_rectangle(valid)
    assert box.area_px == best
    assert valid[box.y0 : box.y0 + box.height_px, box.x0 : box.x0 + box.width_px].all()


def test_a_large_one_is_found_within_a_cell():
    valid = np.zeros((480, 640), bool)
    valid[101:402, 53:517] = True
    box = largest_rectangle(valid)
    assert valid[box.y0 : box.y0 + box.height_px, box.x0 : box.x0 + box.width_px].all()
    assert box.area_px > 0.95 * 301 * 464
    assert largest_rectangle(np.zeros((50, 50), bool)).area_px == 0
    assert largest_rectangle(np.ones((1, 200), bool)).area_px == 0  # lower than a cell
