"""Compare a flight's telemetry with its pictures to find errors in its inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from engine.assumed_errors import AssumedErrors
from engine.camera import Camera
from engine.geo import Array
from engine.navigation.motion import position_of
from engine.orthomap import OrthoMap
from engine.values import Frame, Prior
from scenematch.check.causes import findings, is_known
from scenematch.check.contradictions import contradictions
from scenematch.check.findings import Diagnosis, Finding, TelemetrySeries
from scenematch.check.sightings import sight

LOOKED_AT = 16
_SPEED_MPS = 5.0  # growth of a position's uncertainty with the time to the nearest known one
_MAX_SIGMA_M = 300.0  # of a prior; beyond it the whole map is searched if possible
_FROZEN_SHARE = 0.1


def diagnose(
    telemetry: Sequence[object],
    picture: Callable[[int], Frame],
    site: OrthoMap,
    camera: Camera,
    *,
    priors: Sequence[Prior | None] | None = None,
    start: Prior | None = None,
    reference: Sequence[Prior | None] | None = None,
) -> Diagnosis:
    """Compare a flight's telemetry with what its pictures show.

    Args:
        telemetry: of every picture, in the order of capture: frames, or rows of telemetry.csv, which name what is
            read of them alike.
        picture: reads the picture of an index; some thirty are read.
        site: the map.
        camera: the calibration.
        priors: positions of the pictures from another source; None if they have none.
        start: where the flight begins; None if unknown.
        reference: positions to check the map against; None uses ``priors``.

    Returns:
        Diagnosis: what does not agree, strongest first.
    """
    count = len(telemetry)
    priors = [None] * count if priors is None else list(priors)
    series = _series(telemetry, priors if reference is None else list(reference), site, camera)
    chosen = np.unique(np.linspace(0, count - 1, min(LOOKED_AT, count)).round().astype(int)).tolist()
    frames = [picture(k) for k in chosen]
    static = _frozen(chosen, frames, picture, count)
    if start is not None:
        priors[0] = start
    seen, are_mirrored = sight(frames, [_searched(k, priors, series.time_s, site) for k in chosen], site, camera)
    if are_mirrored:
        cure = "take them from the camera before they are flipped"
        static.append(Finding("mirrored", "the pictures are mirrored", cure))
        return Diagnosis(static, len(chosen), len(seen), ())
    sightings = [replace(s, index=chosen[s.index]) for s in seen]
    found = findings(series, sightings, AssumedErrors().on_map(site).map_m)
    compared, contradicted = is_known(series, sightings), contradictions(series, sightings)
    return Diagnosis(static + found, len(chosen), len(sightings), compared, contradicted)


def _searched(k: int, priors: Sequence[Prior | None], time_s: Array, site: OrthoMap) -> Prior | None:
    """Where to look for a picture: around the known position nearest in time."""
    known = [j for j, prior in enumerate(priors) if prior is not None]
    if not known:
        return None
    nearest = min(
        known, key=lambda j: abs(time_s[j] - time_s[k]) if np.isfinite(time_s[[j, k]]).all() else abs(j - k)
    )
    prior = priors[nearest]
    assert prior is not None
    elapsed_s = abs(float(time_s[nearest] - time_s[k])) if nearest != k else 0.0
    sigma_m = prior.sigma_m + _SPEED_MPS * elapsed_s
    if np.isfinite(sigma_m) and sigma_m <= _MAX_SIGMA_M:
        return replace(prior, sigma_m=sigma_m)
    return None if site.is_searchable else replace(prior, sigma_m=_MAX_SIGMA_M)


def _series(
    telemetry: Sequence[object], reference: Sequence[Prior | None], site: OrthoMap, camera: Camera
) -> TelemetrySeries:
    def column(*names: str) -> Array:
        rows = [[getattr(row, name) for name in names] for row in telemetry]
        return np.array([[np.nan if v is None else v for v in row] for row in rows], np.float64)

    places = [None if prior is None else position_of(prior, site) for prior in reference]
    return TelemetrySeries(
        time_s=column("timestamp_ns")[:, 0] * 1e-9,
        angles_deg=column("roll_deg", "pitch_deg", "heading_deg"),
        height_m=column("height_agl_m")[:, 0],
        velocity_mps=column("east_velocity_mps", "north_velocity_mps"),
        reference_m=np.array([[np.nan, np.nan] if place is None else place.en_m for place in places], np.float64),
        reference_sigma_m=np.array([np.nan if place is None else place.sigma_m for place in places], np.float64),
        mount=camera.mount,
        focal_px=camera.focal_px,
    )


def _frozen(
    chosen: Sequence[int], frames: Sequence[Frame], picture: Callable[[int], Frame], count: int
) -> list[Finding]:
    """Compare each sampled picture with the flight's next one."""
    followed = [(k, frame) for k, frame in zip(chosen, frames, strict=True) if k + 1 < count]
    repeated = sum(np.array_equal(frame.image, picture(k + 1).image) for k, frame in followed)
    if repeated <= _FROZEN_SHARE * len(followed):
        return []
    text = f"{repeated} of {len(followed)} pictures are repeated by the next"
    return [Finding("frozen", text, "look at the camera, or at how its pictures were saved", float(repeated))]
