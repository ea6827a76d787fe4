"""Sightings: find the poses of pictures without any telemetry."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from engine.camera import Camera
from engine.geo import Array, wrap_heading_deg
from engine.matching.matcher import SceneMatcher
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.values import Attitude, Fix, Frame, Prior

_ENOUGH_SHARE = 0.25  # of the pictures; with fewer, the search continues
_LEAST = 4
_PROBED = 5  # pictures used to try a change
_HEIGHT_FACTORS = (1.0, 0.88, 1.14, 0.77, 1.3)
_MAX_S = 15.0  # longest search for height and turn
_TURNS_DEG = (0, 8, -8, 16, -16, 24, -24, 32, -32, 40, -40)


@dataclass(frozen=True, slots=True)
class Sighting:
    """The pose of one picture.

    Attributes:
        index: of the picture.
        attitude: of the body, by the calibration's mount.
        height_agl_m: above the ground below.
        en_m: (2,) east and north.
    """

    index: int
    attitude: Attitude
    height_agl_m: float
    en_m: Array


def sight(
    frames: Sequence[Frame], priors: Sequence[Prior | None], site: OrthoMap, camera: Camera
) -> tuple[list[Sighting], bool]:
    """The poses of pictures by their features alone, else from rough headings, else by correlation over these.

    Args:
        frames: a few, from all over the flight.
        priors: where each may be; None means anywhere on the map.
        site: the map.
        camera: the calibration.

    Returns:
        The sightings in the order of the pictures, and whether only mirrored pictures gave them.
    """
    mirrored = [_mirrored(frame) for frame in frames]
    most: list[Sighting] = []
    for method, ways in (("sift", (_by_features, _by_rough_headings)), ("ncc", (_by_correlation,))):
        matcher = SceneMatcher(site, camera, method, "cpu", MatcherOptions())
        for locate, is_mirrored in product(ways, (False, True)):
            found = locate(matcher, mirrored if is_mirrored else frames, priors)
            if _is_enough(found, frames):
                return found, is_mirrored
            if not is_mirrored:
                most = max(most, found, key=len)
    return most, False


def _is_enough(found: Sequence[Sighting], frames: Sequence[Frame]) -> bool:
    return len(found) >= max(min(_LEAST, len(frames)), _ENOUGH_SHARE * len(frames))


def _mirrored(frame: Frame) -> Frame:
    return replace(frame, image=np.ascontiguousarray(np.asarray(frame.image)[:, ::-1]))


def _by_features(matcher: SceneMatcher, frames: Sequence[Frame], priors: Sequence[Prior | None]) -> list[Sighting]:
    pictures = [Frame(frame.image) for frame in frames]
    return _located(matcher, range(len(frames)), pictures, priors)


def _by_rough_headings(
    matcher: SceneMatcher, frames: Sequence[Frame], priors: Sequence[Prior | None]
) -> list[Sighting]:
    """As if heading and height were known roughly: features of one direction tell more places apart."""
    usable = _with_pose(frames)
    return _located(matcher, usable, [_rough(frames[k]) for k in usable], [priors[k] for k in usable])


def _with_pose(frames: Sequence[Frame]) -> list[int]:
    """The frames that came with height and heading."""
    return [k for k, f in enumerate(frames) if f.height_agl_m is not None and f.heading_deg is not None]


def _rough(frame: Frame) -> Frame:
    """The frame with so uncertain a heading and height that the pose is the picture's."""
    assert frame.height_agl_m is not None
    sigma_m = 0.3 * frame.height_agl_m
    return replace(frame, roll_deg=None, pitch_deg=None, heading_sigma_deg=30.0, height_sigma_m=sigma_m)


def _by_correlation(
    matcher: SceneMatcher, frames: Sequence[Frame], priors: Sequence[Prior | None]
) -> list[Sighting]:
    """Use the height and turn at which most of a few pictures match, then refine to whole poses."""
    if not matcher.site.has_surface:  # refinement needs one
        return []
    usable = [k for k in _with_pose(frames) if priors[k] is not None]  # else: the whole map
    probed = usable[:: max(1, len(usable) // _PROBED)][:_PROBED]
    best: tuple[int, float, float] = (0, 1.0, 0.0)
    until_s = time.monotonic() + _MAX_S
    for factor, turn_deg in product(_HEIGHT_FACTORS, _TURNS_DEG):
        hits = 0
        for k in probed:
            result = matcher.locate(_changed(frames[k], factor, turn_deg), priors[k])
            hits += isinstance(result, Fix) and result.stage == "refined"
        best = max(best, (hits, factor, float(turn_deg)), key=lambda row: row[0])
        if 2 * best[0] > len(probed) or time.monotonic() > until_s:
            break
    if best[0] < 2:
        return []
    changed = [_changed(frames[k], *best[1:]) for k in usable]
    return _located(matcher, usable, changed, [priors[k] for k in usable])


def _located(
    matcher: SceneMatcher, indices: Sequence[int], frames: Sequence[Frame], priors: Sequence[Prior | None]
) -> list[Sighting]:
    """The sightings of frames, each with its index."""
    results = zip(indices, matcher.locate_many(frames, priors), strict=True)
    found = [_sighting(index, fix, matcher.site) for index, fix in results if isinstance(fix, Fix)]
    return [one for one in found if one is not None]


def _changed(frame: Frame, height_factor: float, turn_deg: float) -> Frame:
    assert frame.height_agl_m is not None
    assert frame.heading_deg is not None
    return replace(
        frame,
        height_agl_m=frame.height_agl_m * height_factor,
        heading_deg=wrap_heading_deg(frame.heading_deg + turn_deg),
        height_sigma_m=0.05 * frame.height_agl_m,
        heading_sigma_deg=4.0,
    )


def _sighting(index: int, fix: Fix, site: OrthoMap) -> Sighting | None:
    """The sighting of a fix that measured its whole pose."""
    if fix.attitude is None or fix.up_m is None:
        return None
    height_m = fix.up_m - site.ground_at(np.array(fix.map_xy_px))
    return Sighting(index, fix.attitude, height_m, np.array([fix.east_m, fix.north_m])) if height_m > 0 else None
