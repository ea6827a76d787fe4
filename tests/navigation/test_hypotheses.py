"""Track before detect: matches that are not probable enough alone add up where they agree."""

from __future__ import annotations

import itertools

import numpy as np

from engine import Fix, Frame, Navigator, Window
from engine.navigation.hypotheses import MAX_HYPOTHESES
from tests.support.fixes import a_fix
from tests.support.matchers import ScriptedMatcher

_NUMBERS = itertools.count()
SECOND = 1_000_000_000
SPEED_MPS = 50.0


def new_image():
    """A picture like no other: one that repeats is refused."""
    return np.full((8, 8), next(_NUMBERS) % 256, np.uint8)


def fly(places):
    """Frames eastwards, one a second, without a start, whose matches are right with a probability of 0.8."""
    stated = {"score": 0.3, "window": Window(0, 0, 200, 200), "confidence": 0.8}
    navigator, results = Navigator(ScriptedMatcher(*(a_fix(*place, **stated) for place in places))), []
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
