"""Track before detect: doubted matches add up where they agree, on new ground and without rivals."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from engine import Fix, Frame, Navigator, NoFix, Prior, Reason, Window
from engine.navigation.hypotheses import MAX_HYPOTHESES
from tests.support.fixes import a_fix

_NUMBERS = itertools.count()


def new_image():
    """A picture like no other: one that repeats is refused."""
    return np.full((8, 8), next(_NUMBERS) % 256, np.uint8)


SECOND = 1_000_000_000


def fix_at(east_m, north_m, confidence):
    return a_fix(east_m, north_m, score=0.3, window=Window(0, 0, 200, 200), confidence=confidence)


class Doubting:
    """A matcher that refuses every frame; (east, north, confidence) of its next list are the candidates."""

    site = SimpleNamespace(is_searchable=True, has_surface=True, gsd_m_per_px=1.0, georeference_sigma_m=0.0)

    def __init__(self, frames):
        self.frames = list(frames)

    def locate(self, frame, prior=None, budget=None):
        candidates = tuple(fix_at(*place) for place in self.frames.pop(0))
        return NoFix(reason=Reason.AMBIGUOUS, timestamp_ns=frame.timestamp_ns, candidates=candidates)


def fly(frames, speed_mps, seconds=1.0):
    """Frames eastwards from 100 m above the ground, with positions of 20 m by another source."""
    navigator = Navigator(Doubting(frames))
    results = []
    for k in range(len(frames)):
        given = Prior(east_m=speed_mps * seconds * k + 9.0, north_m=-6.0, sigma_m=20.0)
        frame = Frame(
            new_image(),
            round(k * seconds * SECOND),
            100.0,
            0.0,
            east_velocity_mps=speed_mps,
            north_velocity_mps=0.0,
        )
        results.append(navigator.update(frame, given))
    return results, navigator


def along(speed_mps, count, north_m=0.0, confidence=0.8):
    return [(speed_mps * k, north_m, confidence) for k in range(count)]


def fixed(results):
    return [k for k, result in enumerate(results) if isinstance(result, Fix)]


def test_doubted_matches_that_agree_over_new_ground_are_a_fix_in_the_end():
    results, navigator = fly([[place] for place in along(50.0, 8)], 50.0)
    assert fixed(results)
    first = results[fixed(results)[0]]
    assert first.east_m == pytest.approx(50.0 * fixed(results)[0])
    assert 0.999 <= first.confidence < 1.0
    assert navigator.tracking


def test_over_the_same_ground_they_never_are():
    """A frame that is looked at again says nothing new: repeated structure stays where it is."""
    results, _ = fly([[place] for place in along(0.0, 60)], 0.0)
    assert not fixed(results)


def test_rivals_that_follow_the_vehicle_as_faithfully_keep_each_other_from_a_fix():
    """Rows of 15 m: one place as good as the next in every frame."""
    frames = [[a, b] for a, b in zip(along(50.0, 20), along(50.0, 20, north_m=15.0), strict=True)]
    results, _ = fly(frames, 50.0)
    assert not fixed(results)


def test_chance_never_adds_up():
    rng = np.random.default_rng(3)
    frames = [[(50.0 * k + x, y, 0.8) for x, y in rng.uniform(-60.0, 60.0, (4, 2))] for k in range(60)]
    results, navigator = fly(frames, 50.0)
    assert not fixed(results)
    assert len(navigator._hypotheses._known) <= MAX_HYPOTHESES


def test_a_track_that_was_measured_is_not_left_for_doubted_matches():
    frames = [[place] for place in along(50.0, 8)] + [[(50.0 * k, 40.0, 0.9)] for k in range(8, 16)]
    results, _ = fly(frames, 50.0)
    assert fixed(results)
    assert all(result.north_m == 0.0 for result in results if isinstance(result, Fix))


def test_candidates_with_a_broken_covariance_are_left_out():
    broken = replace(fix_at(0.0, 0.0, 0.9), covariance_m2=np.full((3, 3), np.nan))
    matcher = Doubting([])
    matcher.locate = lambda frame, *_: NoFix(reason=Reason.AMBIGUOUS, candidates=(broken,))
    assert isinstance(Navigator(matcher).update(Frame(new_image(), 0, 100.0, 0.0)), NoFix)
