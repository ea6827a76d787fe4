"""Track before detect: matches that are not probable enough alone add up where they agree."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np

from engine import Fix, Frame, Navigator, Window
from engine.navigation.hypotheses import MAX_HYPOTHESES
from tests.support.fixes import a_fix

_NUMBERS = itertools.count()
SECOND = 1_000_000_000
SPEED_MPS = 50.0


def new_image():
    """A picture like no other: one that repeats is refused."""
    return np.full((8, 8), next(_NUMBERS) % 256, np.uint8)


class Weak:
    """A matcher whose matches, at the next of its places, are right with a probability of 0.8."""

    site = SimpleNamespace(is_searchable=True, has_surface=True, gsd_m_per_px=1.0, georeference_sigma_m=0.0)

    def __init__(self, places):
        self.places = list(places)

    def locate(self, frame, prior=None, budget=None):
        return a_fix(*self.places.pop(0), score=0.3, window=Window(0, 0, 200, 200), confidence=0.8)


def fly(places):
    """Frames eastwards from 100 m above the ground, one a second, without a start."""
    navigator, results = Navigator(Weak(places)), []
    for k in range(len(places)):
        moved = {"east_velocity_mps": SPEED_MPS, "north_velocity_mps": 0.0}
        results.append(navigator.update(Frame(new_image(), k * SECOND, 100.0, 0.0, **moved)))
    return [k for k, result in enumerate(results) if isinstance(result, Fix)], navigator


def test_matches_that_agree_are_a_fix_in_the_end():
    fixed, navigator = fly([(SPEED_MPS * k, 0.0) for k in range(8)])
    assert fixed[0] > 0
    assert fixed == list(range(fixed[0], 8))
    assert navigator.tracking


def test_chance_never_adds_up():
    places = np.random.default_rng(3).uniform(-60.0, 60.0, (60, 2))
    fixed, navigator = fly([(SPEED_MPS * k + x, y) for k, (x, y) in enumerate(places)])
    assert not fixed
    assert len(navigator._hypotheses._known) <= MAX_HYPOTHESES
