"""Sequences of frames as nobody should send them: each ends in a fix, a refusal or a documented error."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.sequences import IMAGES, METHODS, PRIORS, STAMPS, TELEMETRY, Ground, Step, fly

RIGHT = Step("right", "next", "none", "right")
WORDS = (IMAGES, STAMPS, PRIORS, tuple(TELEMETRY))
STEPS = st.just(RIGHT) | st.builds(Step, *(st.just(words[0]) | st.sampled_from(words) for words in WORDS))
"""Half of them as they should be, that a flight is followed, and others wrong in some respects."""


@pytest.fixture(scope="module")
def tiny():
    return Ground()


@given(steps=st.lists(STEPS, min_size=1, max_size=16), method=st.sampled_from(METHODS), start=st.booleans())
@settings(max_examples=60)
def test_any_sequence_ends_in_documented_ways(tiny, steps, method, start):
    fly(tiny, steps, method, start=start)


@pytest.mark.parametrize(
    ("method", "words", "times"),
    [
        *(("ncc", {"image": fault}, 1) for fault in IMAGES[1:]),
        *((method, {"image": "noise"}, 1) for method in METHODS[1:]),
        *(("ncc", {name: "NaN"}, 30) for name in ("prior", "telemetry")),
        *(("ncc", {"stamp": stamp}, 30) for stamp in ("same", "long before")),
    ],
)
def test_a_bad_frame_costs_itself_and_any_number_of_errors_nothing(tiny, method, words, times):
    endings = fly(tiny, [RIGHT] * 4 + [replace(RIGHT, **words)] * times + [RIGHT] * 3, method, start=True)
    assert (endings["fix"], endings.total()) == (7, 7 + times)
