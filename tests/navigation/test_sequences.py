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
    ("method", "fault"),
    [*(("ncc", fault) for fault in IMAGES[1:]), *((method, "noise") for method in METHODS[1:])],
)
def test_one_bad_frame_costs_one_frame(tiny, method, fault):
    steps = [RIGHT] * 4 + [replace(RIGHT, image=fault)] + [RIGHT] * 3
    endings = fly(tiny, steps, method, start=True)
    assert endings["fix"] == 7


@pytest.mark.parametrize(
    "words", [{"stamp": "same"}, {"stamp": "long before"}, {"prior": "NaN"}, {"telemetry": "NaN"}]
)
def test_a_call_that_is_an_error_costs_nothing(tiny, words):
    steps = [RIGHT] * 4 + [replace(RIGHT, **words)] * 30 + [RIGHT] * 3
    endings = fly(tiny, steps, "ncc", start=True)
    assert endings["fix"] == 7
    assert endings.total() == 37
