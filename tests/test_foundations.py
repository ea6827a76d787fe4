"""The ground floor: budget and clock, the device switch, the values that travel, the tree of errors."""

import dataclasses
import math
import os
from itertools import combinations

import cv2
import numpy as np
import pytest
import torch

import engine.errors
from engine import NavigatorOptions, set_threads
from engine.budget import Budget, Deadline
from engine.errors import DeviceError, DtypeError, EngineError, OptionError, ShapeError
from engine.runtime.device import resolve
from engine.values import Attitude, Fix, Frame, NoFix, Peak, Prior, Reason, Timings, Window
from tests.support.fixes import a_fix
from tests.support.interpreters import done_by
from tests.support.refusals import misuse, refusal

IMAGE = np.zeros((4, 6), np.uint8)


def test_a_frame_takes_pictures_of_opencv():
    bgr = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    frame = Frame.from_bgr(bgr, 5, height_agl_m=9.0)
    assert (frame.image == bgr[:, :, ::-1]).all()
    assert (frame.timestamp_ns, frame.height_agl_m) == (5, 9.0)
    with pytest.raises(ShapeError, match=r"^image: expected \(H, W, 3\) BGR, got \(2, 4\)"):
        Frame.from_bgr(bgr[:, :, 0])


# Budget and deadline


@pytest.mark.parametrize("total_ms", [0.0, -1.0, float("nan"), float("-inf")])
def test_a_budget_is_above_zero(total_ms):
    assert misuse(Budget, total_ms=total_ms).startswith("total_ms: expected more than 0 ms, got ")


def test_a_budget_is_endless_unless_stated_and_stated_by_name():
    assert Deadline(Budget(), lambda: 10**18).remaining_ms == math.inf
    with pytest.raises(TypeError):
        Budget(40.0)


def test_a_deadline_runs_from_its_start_to_its_budget():
    now_ns = 5_000
    deadline = Deadline(Budget(total_ms=40.0), lambda: now_ns)
    assert (deadline.elapsed_ms, deadline.remaining_ms, deadline.met) == (0.0, 40.0, True)
    now_ns += 30_000_000
    assert (deadline.elapsed_ms, deadline.remaining_ms) == (pytest.approx(30.0), pytest.approx(10.0))
    now_ns += 10_000_000
    assert deadline.met  # the last moment is in time
    now_ns += 1_000
    assert not deadline.met
    assert deadline.remaining_ms == pytest.approx(-0.001)


def test_a_frame_that_searches_has_a_budget_of_its_own():
    budget = Budget(total_ms=40.0, search_ms=500.0)
    assert Deadline(budget, lambda: 0).remaining_ms == 40.0
    assert Deadline(budget, lambda: 0, searches=True).remaining_ms == 500.0
    assert Deadline(Budget(total_ms=40.0), lambda: 0, searches=True).remaining_ms == 40.0


# Device


def test_a_device_is_resolved_by_name():
    assert resolve("cpu") == "cpu"
    assert torch.zeros(1).to(resolve("cpu")).device.type == "cpu"
    assert resolve(torch.device("cpu")).type == "cpu"
    assert resolve("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    assert resolve().type == resolve("auto").type


@pytest.mark.parametrize("name", ["gpu", "", "cpuu", "tpu:0", "mps", "meta", "cuda:x"])
def test_a_name_that_is_no_device_is_an_option_error(name):
    assert misuse(resolve, name).startswith("device: expected cpu, cuda or auto, got ")


@pytest.mark.parametrize("name", ["cuda", "cuda:0", "cuda:7"])
def test_a_device_that_is_missing_is_a_device_error(name):
    if torch.cuda.is_available() and torch.cuda.device_count() > int(name[5:] or 0):
        pytest.skip("this machine has that device")
    with pytest.raises(DeviceError, match=rf"^device: {name} was requested, but this machine has \d"):
        resolve(name)


def test_threads_are_set_for_torch_and_opencv():
    try:
        set_threads(2)
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (2, 2)
    finally:
        set_threads(1)
    assert (torch.get_num_threads(), cv2.getNumThreads()) == (1, 1)
    assert misuse(set_threads, 0).startswith("threads: expected 1 or more, got 0")


# Frames


@pytest.mark.parametrize("shape", [(4,), (4, 6, 1), (4, 6, 4), (0, 6), (4, 0, 3), (1, 4, 6, 3), ()])
@pytest.mark.parametrize("make", [np.zeros, torch.zeros])
def test_a_frame_is_grey_or_rgb(make, shape):
    dtype = np.uint8 if make is np.zeros else torch.uint8
    with pytest.raises(ShapeError, match=r"^image: expected \(H, W\) or \(H, W, 3\) with .+, got "):
        Frame(make(shape, dtype=dtype))


@pytest.mark.parametrize(
    "image",
    [IMAGE.astype(np.float32), IMAGE.astype(np.int8), torch.zeros(4, 6), torch.zeros(4, 6, dtype=torch.int8)],
)
def test_a_frame_is_uint8(image):
    assert refusal(Frame, image, error=DtypeError).startswith("image: expected uint8, got ")


@pytest.mark.parametrize(
    "name", ["height_agl_m", "heading_deg", "roll_deg", "pitch_deg", "east_velocity_mps", "north_velocity_mps"]
)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_numbers_of_a_frame_are_finite_or_unknown(name, value):
    assert refusal(Frame, IMAGE, **{name: value}).startswith(f"{name}: expected a finite number or None, got ")
    assert getattr(Frame(IMAGE, **{name: None}), name) is None


@pytest.mark.parametrize("height", [0.0, -3.0])
def test_the_height_of_a_frame_is_above_the_ground(height):
    assert refusal(Frame, IMAGE, height_agl_m=height).startswith("height_agl_m: expected a height above 0 m, got ")


def test_the_attitude_of_a_frame_takes_unknown_tilt_as_level():
    assert Frame(IMAGE).attitude is None
    assert Frame(IMAGE, roll_deg=3.0, pitch_deg=2.0).attitude is None
    assert Frame(IMAGE, heading_deg=-90.0).attitude == Attitude(0.0, 0.0, 270.0)
    assert Frame(IMAGE, heading_deg=5.0, roll_deg=3.0).attitude == Attitude(3.0, 0.0, 5.0)


# Priors


COORDINATES = ("lat_deg", "lon_deg", "east_m", "north_m")
PARTS = [part for n in range(5) for part in combinations(COORDINATES, n)]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        *(
            (dict.fromkeys(names, 1.0), "prior: expected either lat_deg and lon_deg or east_m and north_m")
            for names in PARTS
            if names not in (COORDINATES[:2], COORDINATES[2:])
        ),
        ({"lat_deg": 91.0, "lon_deg": 0.0}, "lat_deg: expected .+, got "),
        ({"lat_deg": 0.0, "lon_deg": 361.0}, "lon_deg: expected .+, got "),
        ({"east_m": math.nan, "north_m": 0.0}, "prior: expected .+, got "),
        ({"lat_deg": math.inf, "lon_deg": 0.0}, "prior: expected .+, got "),
        ({"east_m": 0.0, "north_m": 0.0, "sigma_m": -1.0}, "sigma_m: expected .+, got "),
        ({"east_m": 0.0, "north_m": 0.0, "sigma_m": math.nan}, "sigma_m: expected .+, got "),
        ({"east_m": 0.0, "north_m": 0.0, "moved_east_m": math.inf}, "moved: expected .+, got "),
    ],
)
def test_a_prior_has_one_finite_position(values, message):
    with pytest.raises(OptionError, match=rf"^{message}"):
        Prior(**{"sigma_m": 1.0, **values})


def test_a_prior_always_says_how_sure_it_is():
    assert "sigma_m" in refusal(Prior, east_m=0.0, north_m=0.0, error=TypeError)


# Other values


@pytest.mark.parametrize(
    "cls", [Attitude, Fix, Frame, NoFix, Peak, Prior, Timings, Window, Budget, NavigatorOptions]
)
def test_values_are_frozen_and_slotted(cls):
    assert dataclasses.is_dataclass(cls)
    assert cls.__dataclass_params__.frozen
    assert "__slots__" in vars(cls)


def test_timings_add_up():
    assert Timings().total_ms == 0
    assert Timings({"align": 1.5, "match": 3.0}).total_ms == 4.5


def test_the_sigma_of_a_fix_is_the_longer_axis_of_its_ellipse():
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    covariance = turn @ np.diag([9.0, 4.0, 100.0]) @ turn.T
    fix = a_fix(timestamp_ns=1, covariance_m2=covariance, score=1.0, window=Window(2, 3, 4, 5))
    assert fix.sigma_m == pytest.approx(3.0)


@pytest.mark.parametrize("risk", [1e-1, 1e-2, 1e-4])
def test_the_protection_level_holds_all_but_the_risk(risk):
    """Of 200,000 positions drawn by a fix's own statement; a circle of the larger axis is at least as wide."""
    fix = a_fix(covariance_m2=np.diag([1.0, 0.25, 4.0]), confidence=1.0 - risk / 10)
    level_m = fix.protection_level_m(risk)
    assert math.isfinite(level_m)
    off_m = np.random.default_rng(0).multivariate_normal(np.zeros(2), fix.covariance_m2[:2, :2], 200_000)
    assert (np.hypot(*off_m.T) > level_m).mean() + risk / 10 <= risk


@pytest.mark.parametrize("confidence", [None, 0.99])
def test_no_circle_protects_where_the_place_may_be_a_wrong_one(confidence):
    assert a_fix(confidence=confidence).protection_level_m(1e-3) == math.inf


@pytest.mark.parametrize("risk", [0.0, 1.0, math.nan])
def test_a_risk_is_a_probability(risk):
    with pytest.raises(OptionError, match="risk: expected a probability above 0 and below 1"):
        a_fix(confidence=0.99999).protection_level_m(risk)


# Errors


def test_the_tree_of_errors_is_as_it_is_drawn():
    builtin = {ShapeError: ValueError, DtypeError: TypeError, OptionError: ValueError}
    public = {getattr(engine, name) for name in engine.__all__ if name.endswith("Error")}
    found = {e for e in vars(engine.errors).values() if isinstance(e, type) and issubclass(e, EngineError)}
    assert public <= found
    assert all(error.__name__ in engine.errors.__doc__ for error in found)
    assert all(issubclass(error, base) for error, base in builtin.items())


MATCHERS = """
import cv2, numpy as np, sys, torch
from engine import Camera, OrthoMap, SceneMatcher, set_threads
site = OrthoMap.from_arrays(np.zeros((200, 200), np.uint8), [[0.5, 0, 5e5], [0, -0.5, 5e6]], "EPSG:32633")
for who in ("before", "after"):
    if sys.argv[1] == who:
        set_threads(2)
    SceneMatcher(site, Camera.from_fov(100, 100, 60.0), "ncc", "cpu")
print(torch.get_num_threads(), cv2.getNumThreads())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("chosen", "expected"), [("nowhere", "1 1"), ("before", "2 2"), ("after", "2 2"), ("environment", "2 ")]
)
def test_a_matcher_takes_one_thread_unless_somebody_chose(chosen, expected):
    """In a process of its own: the number of threads is the process's."""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    if chosen == "environment":
        environment["OMP_NUM_THREADS"] = "2"
    assert done_by(MATCHERS, chosen, env=environment).stdout.startswith(expected)


def test_an_answer_prints_as_one_line_that_says_where_or_why_not():
    fix = a_fix(sigma_m=2.96, stage="refined")
    assert str(fix) == "48.0000000, 15.0000000, sigma 3.0 m, by ncc, refined"
    assert (
        str(fix.refused(Reason.AMBIGUOUS, "two places look alike")) == "no fix, ambiguous: two places look alike"
    )
