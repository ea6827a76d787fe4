"""Local features of every library at 300 keypoints: what is timed, and how it reads as a common value.

Every library keeps its defaults but for the number of keypoints, and its own idea of where a pixel lies is
honoured where it is documented (COLMAP: centres at 0.5). OpenCV's bias of 0.25 px is not, and is left in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
import torch

from bench.accuracy.quality import Gray, Keypoints
from engine.features import Features, sift

MAX_KEYPOINTS = 300
Extract = Callable[[Gray, float], Any]


@dataclass(frozen=True)
class Detector:
    """One way to detect and describe.

    Attributes:
        make: gives what is timed: a picture, and its direction of up in degrees, to whatever the library returns.
            One is made for each thread.
        keypoints: the same, as the other libraries are compared by; at most 300, the best by the library's order.
        batch: many pictures of one size in one call, where the library can.
    """

    make: Callable[[], Extract]
    keypoints: Callable[[Any], Keypoints]
    batch: Callable[[list[Gray]], Any] | None = None


def _first(xy_px: Any, scale_px: Any, descriptors: Any, count: int = MAX_KEYPOINTS) -> Keypoints:
    parts = (np.asarray(part)[:count] for part in (xy_px, scale_px, descriptors))
    xy, scale, words = parts
    return Keypoints(xy.astype(np.float64).reshape(-1, 2), scale.astype(np.float64), words)


# -------------------------------------------------------------------------------------------------- engine


def picture_tensor(grays: list[Gray]) -> torch.Tensor:
    """Pictures as :func:`engine.features.sift` takes them."""
    return torch.from_numpy(np.stack(grays))[:, None].float() / 255.0


def _ours(gray: Gray, up_deg: float, *, upright: bool, backend: str) -> Features:
    up = {"upright": True, "up_deg": up_deg} if upright else {}
    return sift(picture_tensor([gray]), max_keypoints=MAX_KEYPOINTS, backend=backend, **up)


def _ours_batch(grays: list[Gray], *, upright: bool, backend: str) -> Features:
    return sift(picture_tensor(grays), max_keypoints=MAX_KEYPOINTS, backend=backend, upright=upright)


def keypoints_of_features(found: Features) -> Keypoints:
    """Those of one picture."""
    kept = found.valid[0]
    columns = (found.xy_px[0, kept], found.scale_px[0, kept], found.descriptors[0, kept])
    return _first(*columns, found.valid.shape[1])


def _engine(*, upright: bool = False, backend: str = "compiled") -> Detector:
    extract: Extract = partial(_ours, upright=upright, backend=backend)
    batch = partial(_ours_batch, upright=upright, backend=backend)
    return Detector(lambda: extract, keypoints_of_features, batch)


# -------------------------------------------------------------------------------------------------- OpenCV


def keypoints_of_opencv(found: tuple[Any, Any], count: int = MAX_KEYPOINTS) -> Keypoints:
    """The best by response."""
    points, words = found
    if not points:
        return _first(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 1), np.float32))
    best = np.argsort([-point.response for point in points], kind="stable")  # each orientation is a keypoint
    return _first([points[i].pt for i in best], [points[i].size / 2 for i in best], words[best], count)


def _opencv(create: Callable[[], Any]) -> Detector:
    def make() -> Extract:
        detector = create()
        return lambda gray, _up: detector.detectAndCompute(gray, None)

    return Detector(make, keypoints_of_opencv)


# ------------------------------------------------------------------------------------------------ pycolmap


def _colmap() -> Detector:
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    options.sift.max_num_features = MAX_KEYPOINTS

    def make() -> Extract:
        extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        return lambda gray, _up: extractor.extract_from_uint8_array(gray)

    def keypoints(found: Any) -> Keypoints:
        points, words = found  # more than asked for: each orientation is a keypoint
        scale_px = np.array([point.compute_scale() for point in points])
        coarse = np.argsort(-scale_px, kind="stable")  # what it keeps where it has too many
        xy_px = np.array([(point.x, point.y) for point in points]).reshape(-1, 2) - 0.5  # the corner is its origin
        return _first(xy_px[coarse], scale_px[coarse], words.data.astype(np.float32)[coarse])

    return Detector(make, keypoints)


def detectors() -> dict[str, Callable[[], Detector]]:
    """Those whose libraries are there; OpenCV 5 has moved AKAZE out of its main package."""
    known: dict[str, Callable[[], Detector]] = {
        "OpenCV SIFT": lambda: _opencv(lambda: cv2.SIFT_create(nfeatures=MAX_KEYPOINTS)),
        "OpenCV SIFT, contrast 0.02": lambda: _opencv(
            lambda: cv2.SIFT_create(nfeatures=MAX_KEYPOINTS, contrastThreshold=0.02)
        ),
        "scenematch": _engine,
        "scenematch, upright": lambda: _engine(upright=True),
        "COLMAP SIFT": _colmap,
        "kornia SIFT": lambda: _engine(backend="kornia"),
        "OpenCV ORB": lambda: _opencv(lambda: cv2.ORB_create(nfeatures=MAX_KEYPOINTS)),
        "OpenCV AKAZE": lambda: _opencv(cv2.AKAZE_create),
    }
    missing = {"COLMAP SIFT": find_spec("pycolmap") is None, "OpenCV AKAZE": not hasattr(cv2, "AKAZE_create")}
    return {name: create for name, create in known.items() if not missing.get(name, False)}
