"""Checking a flight before it is tracked: whether its inputs fit each other, and which change would make them."""

from __future__ import annotations

from engine.diagnosis import Diagnosis, diagnose
from engine.errors import OptionError
from engine.formats.truth import interpolate_truth
from engine.runs.arguments import parse_position
from engine.runs.inputs import FlightFiles, FlightInputs, open_inputs
from engine.runs.progress import SILENT, Progress
from engine.runs.settings import TrackSettings
from engine.values import Frame, Prior, Truth

MAX_FRAMES = 400
"""Frames whose telemetry is compared; of a longer flight they are taken evenly."""
_TRUTH_SIGMA_M = 1.0
_LEAST_SEEN = 3


def diagnose_flight(
    files: FlightFiles,
    start: str | None = None,
    *,
    inputs: FlightInputs | None = None,
    progress: Progress = SILENT,
) -> Diagnosis:
    """Compare telemetry, camera, clock and map of a flight with what its pictures show by themselves.

    Args:
        files: of the flight.
        start: where it begins, "LAT,LON" or "LAT,LON,SIGMA_M"; None takes the telemetry's positions.
        inputs: what :func:`engine.runs.inputs.open_inputs` read of the files.
        progress: is shown what is read.

    Returns:
        Diagnosis: what does not fit.

    Raises:
        OptionError, TelemetryError, CalibrationError, MapError: an argument or a file is not as expected.
    """
    inputs = inputs or open_inputs(files, [TrackSettings(method="sift", start=start)], progress=progress)
    begin = parse_position("start", start)
    flight = inputs.flight
    if not len(flight):
        raise OptionError("frames: expected at least one picture, got none")
    step = -(-len(flight) // MAX_FRAMES)
    frames: list[Frame] = []
    priors: list[Prior | None] = []
    for index in progress.track(range(0, len(flight), step), -(-len(flight) // step), "reading pictures"):
        item = flight.read(index)
        frames.append(item.frame)
        priors.append(item.prior if begin is None else None)
    known = begin or next((prior for prior in priors if prior is not None), None)
    reference = [_of_truth(frame, inputs.truth) for frame in frames] if inputs.truth else None
    return diagnose(frames, inputs.site, inputs.camera, priors=priors, start=known, reference=reference)


def _of_truth(frame: Frame, truth: list[Truth] | None) -> Prior | None:
    there = None if truth is None or frame.timestamp_ns is None else interpolate_truth(truth, frame.timestamp_ns)
    if there is None:
        return None
    return Prior(lat_deg=there.lat_deg, lon_deg=there.lon_deg, sigma_m=_TRUTH_SIGMA_M)


def as_rows(found: Diagnosis) -> list[tuple[str, str]]:
    """What a diagnosis says, a name and a sentence a row."""
    seen = f"{found.seen} of {found.looked_at} pictures were placed on the map without the telemetry"
    out = [
        (one.cause.replace("_", " "), f"{one.text}; {'try ' if one.cure.startswith('-') else ''}{one.cure}")
        for one in found.findings
    ]
    if found.seen < _LEAST_SEEN:
        seen += ", too few to say more: is it the map of this place and season, the calibration of this camera?"
    elif not out:
        seen += "; height, attitude, clock, camera and map fit each other"
    return [*out, ("pictures", seen)]
