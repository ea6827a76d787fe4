"""Options: frozen, stated by name, and refused by name where every frame would fail."""

import dataclasses
import math

import pytest

from engine import AssumedErrors, LearnedOptions, LiveOptions, MatcherOptions, NavigatorOptions, OptionError
from engine.options import NccOptions, PoseOptions, SiftOptions

ENGINE = (AssumedErrors, LearnedOptions, MatcherOptions, NavigatorOptions, NccOptions, PoseOptions, SiftOptions)


@pytest.mark.parametrize("options", [*ENGINE, LiveOptions])
def test_options_are_frozen_and_stated_by_name(options):
    assert options.__dataclass_params__.frozen
    assert all(field.kw_only for field in dataclasses.fields(options))


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize(
    ("options", "name"),
    [
        (options, field.name)
        for options in (AssumedErrors, NavigatorOptions, LiveOptions)
        for field in dataclasses.fields(options)
        if field.name not in ("height_share", "odometry", "realtime")
    ],
)
def test_numbers_are_above_0(options, name, value):
    with pytest.raises(OptionError, match=rf"^{name}: expected a number above 0, got {value}"):
        options(**{name: value})


@pytest.mark.parametrize(
    ("options", "name", "value", "text"),
    [
        *((AssumedErrors, "height_share", value, "a number from 0 up") for value in (-1e-9, math.nan, math.inf)),
        *((LiveOptions, name, 60_001, "at most 60000") for name in ("deadline_ms", "patience_ms")),
        (NccOptions, "exclusion_m", math.nan, "a number above 0"),
        (SiftOptions, "scale", 0.0, "above 0 and at most 1"),
        (SiftOptions, "max_keypoints", 3, "4 or more"),
        *((SiftOptions, "max_height_m", value, "a finite number above 1") for value in (0.5, math.inf)),
        *((SiftOptions, "upsample", value, "1 or 2") for value in (0, 3)),
        *((SiftOptions, name, -1, "a number above 0") for name in ("keypoints_per_px", "tolerance_px")),
        *((PoseOptions, name, value, "a number above 0") for name, value in (
            ("reprojection_px", 0), ("distinct_px", -1))),
        (LearnedOptions, "max_keypoints", 1, ".+"), (LearnedOptions, "max_picture_px", 10, ".+"),
        (LearnedOptions, "max_window_px", 10, ".+"),
        *((MatcherOptions, "risk", value, "a probability above 0 and below 1")
          for value in (0.0, 1.0, 98.0, math.nan)),
    ],
)  # fmt: skip
def test_options_by_which_every_frame_would_fail_are_refused(options, name, value, text):
    with pytest.raises(OptionError, match=rf"^{name}: expected {text}, got '?{value}"):
        options(**{name: value})
