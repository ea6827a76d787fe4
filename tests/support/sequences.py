"""Sequences of frames as nobody should send them, flown over a tiny map.

Gaps, duplicate and backward stamps, NaN priors, flat, black and saturated frames, wrong shapes and
types, impossible telemetry.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from engine import Camera, EngineError, Fix, Frame, MatcherOptions, Navigator, NoFix, Prior, SceneMatcher
from engine.options import PoseOptions, SiftOptions
from tests.support import ground

SIDE_PX, MAP_PX, GSD_M = 64, 192, 0.5
HEIGHT_M = GSD_M * SIDE_PX / (2.0 * math.tan(math.radians(30.0)))  # a pixel of the frame is one of the map
SECOND = 1_000_000_000
SPEED_PX_S = 10
METHODS = ("ncc", "sift", "auto")

LEVELS = {"flat": 90, "black": 0, "saturated": 255}
IMAGES = ("right", "noise", *LEVELS, "small", "float", "rgba", "empty")
STAMPS_S = {"next": 0.2, "gap": 60.0, "same": 0.0, "before": -0.3, "long before": -500.0, "far future": 1e8}
STAMPS = (*STAMPS_S, "none")
PRIORS = ("none", "right", "wide", "wrong", "off the map", "far away", "NaN", "both", "negative")
TELEMETRY: dict[str, dict[str, float | None]] = {
    "right": {},
    "no heading": {"heading_deg": None},
    "no height": {"height_agl_m": None},
    "nothing": dict.fromkeys(("height_agl_m", "heading_deg", "roll_deg", "pitch_deg")),
    "wrong heading": {"heading_deg": -1e9},
    "tilted": {"roll_deg": 85.0, "pitch_deg": -70.0},
    "upside down": {"roll_deg": 180.0},
    "tiny": {"height_agl_m": 1e-9},
    "huge": {"height_agl_m": 1e12},
    "NaN": {"pitch_deg": math.nan},
    "below ground": {"height_agl_m": -3.0},
    "fast": {"east_velocity_mps": 3.5, "north_velocity_mps": -3.5},
    "faster than light": {"east_velocity_mps": 1e12, "north_velocity_mps": -1e12},
}


@dataclass(frozen=True)
class Step:
    """What is wrong with one frame: one word of each of the lists above."""

    image: str
    stamp: str
    prior: str
    telemetry: str


class Ground:
    """A tiny map with its matchers, and the frames that are taken over it."""

    def __init__(self) -> None:
        drawn = ground.Ground(size=(MAP_PX, MAP_PX), gsd_m=GSD_M)
        self.gray, self.site = drawn.gray, drawn.site
        camera = Camera.from_fov(SIDE_PX, SIDE_PX, 60.0)
        # The frame is too small to be halved, and for matches 16 px apart to be many.
        options = MatcherOptions(sift=SiftOptions(scale=1.0, pose=PoseOptions(distinct_px=4.0)))
        self.matchers = {m: SceneMatcher(self.site, camera, m, "cpu", options) for m in METHODS}

    def frame(self, step: Step, stamp_ns: int | None, time_ns: int) -> Frame:
        """The frame of a step; the vehicle flies along the map's diagonal and back."""
        x = y = self.corner_px(time_ns)
        image: Any = self.gray[y : y + SIDE_PX, x : x + SIDE_PX]
        images = {
            "right": image,
            "noise": np.random.default_rng(abs(time_ns)).integers(0, 256, image.shape, dtype=np.uint8),
            **{name: np.full_like(image, level) for name, level in LEVELS.items()},
            "small": image[: SIDE_PX // 2],
            "float": image.astype(np.float32),
            "rgba": np.repeat(image[..., None], 4, axis=2),
            "empty": image[:0],
        }
        right = {"height_agl_m": HEIGHT_M, "heading_deg": 0.0, "roll_deg": 0.0, "pitch_deg": 0.0}
        return Frame(images[step.image], stamp_ns, **(right | TELEMETRY[step.telemetry]))

    def prior(self, step: Step, time_ns: int) -> Prior | None:
        """The prior of a step."""
        middle = self.corner_px(time_ns) + (SIDE_PX - 1) / 2.0
        east, north = (float(v) for v in self.site.enu_from_pixel(np.array([middle, middle])))
        sigma_m = {"wide": 500.0, "far away": 1e12, "negative": -1.0}.get(step.prior, 3.0)
        if step.prior == "none":
            return None
        if step.prior == "NaN":
            return Prior(east_m=math.nan, north_m=north, sigma_m=math.nan)
        if step.prior == "both":
            return Prior(east_m=east, north_m=north, lat_deg=48.0, lon_deg=15.0, sigma_m=1.0)
        off_m = {"wrong": 20.0, "off the map": 1e4, "far away": 1e12}.get(step.prior, 0.0)
        return Prior(east_m=east + off_m, north_m=north, sigma_m=sigma_m)

    def corner_px(self, time_ns: int) -> int:
        """Column and row where the frame of a moment begins."""
        last = MAP_PX - SIDE_PX
        return last - abs(time_ns * SPEED_PX_S // SECOND % (2 * last) - last)


def stamp_after(kind: str, newest_ns: int, number: int) -> int | None:
    """The stamp of a step after the newest that came."""
    if kind == "none":
        return None
    return newest_ns + round(STAMPS_S[kind] * SECOND) + number * (kind == "before")


def fly(over: Ground, steps: Sequence[Step], method: str, *, start: bool) -> Counter[str]:
    """Fly a sequence; returns how often each ending came.

    Raises:
        AssertionError: a frame ended in something else, or a fix without a sound covariance or with another
            frame's stamp.
    """
    newest_ns = SECOND
    begin = over.prior(Step("right", "next", "right", "right"), newest_ns) if start else None
    navigator, endings, resets = Navigator(over.matchers[method], begin), Counter[str](), 0
    for number, step in enumerate(steps):
        stamp = stamp_after(step.stamp, newest_ns, number)
        time_ns = newest_ns if stamp is None else stamp
        try:
            result = navigator.update(over.frame(step, stamp, time_ns), over.prior(step, time_ns))
        except EngineError as error:
            endings[type(error).__name__] += 1
            continue
        finally:
            check(navigator, resets)
            resets = navigator.reset_count
        newest_ns = max(newest_ns, time_ns)
        assert result.timestamp_ns == stamp
        endings["fix" if isinstance(result, Fix) else result.reason.value] += 1
        assert isinstance(result, NoFix) or is_sound(result.covariance_m2), result
    return endings


def check(navigator: Navigator, resets: int) -> None:
    """What holds between any two frames."""
    prediction, age_s = navigator.prediction, navigator.anchor_age_s
    assert prediction is None or math.isfinite(prediction.sigma_m)
    assert age_s is None or age_s >= 0.0
    assert navigator.reset_count >= resets
    assert navigator.state.name in ("TRACKING", "COASTING") or not navigator.healthy


def is_sound(covariance_m2: Any) -> bool:
    """Whether a covariance is (3, 3), finite, symmetric and positive definite."""
    finite = covariance_m2.shape == (3, 3) and np.isfinite(covariance_m2).all()
    return bool(
        finite and np.allclose(covariance_m2, covariance_m2.T) and np.linalg.eigvalsh(covariance_m2)[0] > 0.0
    )
