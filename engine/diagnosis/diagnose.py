"""From the frames of a flight to what does not fit among its inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from engine.camera import Camera
from engine.covariance import map_sigma_of
from engine.diagnosis.causes import Diagnosis, Finding, Told, findings
from engine.diagnosis.sightings import sight
from engine.evidence import position_of
from engine.orthomap import OrthoMap
from engine.values import Frame, Prior

Array = NDArray[np.float64]

LOOKED_AT = 16
_MAX_SPEED_MPS = 15.0
_MAX_SIGMA_M = 300.0  # of a prior; beyond, the whole map is searched
# Nanoseconds in the units that stamps are given in by mistake, and the intervals between pictures that are usual.
_UNITS = {"microseconds": 1e3, "milliseconds": 1e6, "seconds": 1e9}
_USUAL_NS = (5e6, 2e10)
_FROZEN_SHARE = 0.1


def diagnose(
    frames: Sequence[Frame],
    site: OrthoMap,
    camera: Camera,
    *,
    priors: Sequence[Prior | None] | None = None,
    start: Prior | None = None,
    reference: Sequence[Prior | None] | None = None,
) -> Diagnosis:
    """Compare what a flight's telemetry says with what its pictures show by themselves.

    Args:
        frames: in the order of capture; a few of them are matched, the telemetry of all counts.
        site: the map.
        camera: the calibration.
        priors: positions that came with the frames, by another source; None where they have none.
        start: where the flight begins; None where that is not known.
        reference: positions that the map is held against; None takes ``priors``.

    Returns:
        Diagnosis: what does not fit, the strongest first.
    """
    priors = [None] * len(frames) if priors is None else list(priors)
    reference = priors if reference is None else list(reference)
    static = [found for found in (_stamps(frames), _frozen(frames)) if found is not None]
    told = _told(frames, reference, site, camera)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(LOOKED_AT, len(frames))).round().astype(int))
    about = [_searched(k, frames, priors, start, told.time_s) for k in chosen]
    seen = sight([frames[k] for k in chosen], about, site, camera)
    if seen.mirrored:
        static.append(
            Finding("mirrored", "the pictures are mirrored", "take them from the camera before they are flipped")
        )
        return Diagnosis(static, len(chosen), len(seen.sightings))
    sightings = [replace(s, index=int(chosen[s.index])) for s in seen.sightings]
    found = findings(told, sightings, map_sigma_of(site))
    return Diagnosis(static + found, len(chosen), len(sightings))


def _searched(
    k: int, frames: Sequence[Frame], priors: Sequence[Prior | None], start: Prior | None, time_s: Array
) -> Prior | None:
    """Where a picture is looked for: about its own position, or as far from the start as a vehicle gets."""
    if priors[k] is not None or start is None:
        return priors[k]
    elapsed_s = float(time_s[k] - time_s[0])
    sigma_m = start.sigma_m + _MAX_SPEED_MPS * max(elapsed_s, 0.0) / 3.0
    if not np.isfinite(sigma_m) or sigma_m > _MAX_SIGMA_M:
        return None
    return replace(start, sigma_m=sigma_m)


def _told(frames: Sequence[Frame], reference: Sequence[Prior | None], site: OrthoMap, camera: Camera) -> Told:
    def column(*names: str) -> Array:
        rows = [[getattr(frame, name) for name in names] for frame in frames]
        return np.array([[np.nan if v is None else v for v in row] for row in rows], np.float64)

    factor = _unit(frames)[1]
    places = [None if prior is None else position_of(prior, site) for prior in reference]
    return Told(
        time_s=column("timestamp_ns")[:, 0] * factor * 1e-9,
        angles_deg=column("roll_deg", "pitch_deg", "heading_deg"),
        height_m=column("height_agl_m")[:, 0],
        velocity_mps=column("east_velocity_mps", "north_velocity_mps"),
        reference_m=np.array([[np.nan, np.nan] if place is None else place.en_m for place in places], np.float64),
        reference_sigma_m=np.array([np.nan if place is None else place.sigma_m for place in places], np.float64),
        mount=camera.mount,
    )


def _unit(frames: Sequence[Frame]) -> tuple[str, float]:
    """The unit that the stamps are in, and the nanoseconds in it."""
    stamps = np.array([frame.timestamp_ns for frame in frames if frame.timestamp_ns is not None], np.float64)
    if len(stamps) < 3:
        return "nanoseconds", 1.0
    interval = float(np.median(np.diff(stamps)))
    if not 0.0 <= interval < _USUAL_NS[0]:
        return "nanoseconds", 1.0
    interval = float(np.mean(np.diff(stamps)))  # of seconds most are 0
    for unit, factor in _UNITS.items():
        if _USUAL_NS[0] <= interval * factor <= _USUAL_NS[1]:
            return unit, factor
    return "nanoseconds", 1.0


def _stamps(frames: Sequence[Frame]) -> Finding | None:
    unit, factor = _unit(frames)
    if factor == 1.0:
        return None
    text = f"timestamp_ns seems to be in {unit}: between pictures it grows by less than 5 ms"
    return Finding("stamps", text, f'--column "timestamp_ns={factor:.0f}*timestamp_ns"', factor)


def _frozen(frames: Sequence[Frame]) -> Finding | None:
    images = [np.asarray(frame.image) for frame in frames]
    repeated = sum(a.shape == b.shape and np.array_equal(a, b) for a, b in pairwise(images))
    if repeated <= _FROZEN_SHARE * len(images):
        return None
    text = f"{repeated} of {len(images)} pictures repeat the one before"
    return Finding("frozen", text, "look at the camera, or at how its pictures were saved", float(repeated))
