"""Checking a flight before it is tracked: whether its inputs fit each other, and which change would make them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from engine.errors import OptionError
from engine.values import Prior, Truth
from scenematch.check import Diagnosis, Finding, diagnose
from scenematch.check.causes import IN_CALIBRATION
from scenematch.files.truth import interpolate_truth
from scenematch.runs.arguments import parse_position
from scenematch.runs.inputs import FlightFiles, FlightInputs, open_inputs
from scenematch.runs.progress import SILENT, Progress
from scenematch.runs.settings import TrackSettings

_TRUTH_SIGMA_M = 1.0
_LEAST_SEEN = 3


def diagnose_flight(
    files: FlightFiles,
    start: str | None = None,
    *,
    columns: Mapping[str, str] = {},
    inputs: FlightInputs | None = None,
    progress: Progress = SILENT,
) -> Diagnosis:
    """Compare telemetry, camera, clock and map of a flight with what its pictures show by themselves.

    Args:
        files: of the flight.
        start: where it begins, "LAT,LON" or "LAT,LON,SIGMA_M"; None takes the telemetry's positions.
        columns: what the telemetry.csv calls a column, by our name for it.
        inputs: what :func:`scenematch.runs.inputs.open_inputs` read of the files.
        progress: is shown what is read.

    Returns:
        Diagnosis: what does not fit.

    Raises:
        OptionError, TelemetryError, CalibrationError, MapError: an argument or a file is not as expected.
    """
    settings = TrackSettings(method="sift", start=start, telemetry_columns=dict(columns))
    inputs = inputs or open_inputs(files, [settings], progress=progress)
    begin = parse_position("start", start)
    flight = inputs.flight
    if not len(flight):
        raise OptionError("frames: expected at least one picture, got none")
    positions = [row.prior for row in flight.rows] or [None] * len(flight)
    stamps = [row.timestamp_ns for row in flight.rows]
    reference = [_of_truth(stamp, inputs.truth) for stamp in stamps] if inputs.truth and stamps else positions
    with progress.task("placing pictures without the telemetry"):
        found = diagnose(
            flight.rows or [flight.read(0).frame] * len(flight),
            lambda index: flight.read(index).frame,
            inputs.site,
            inputs.camera,
            priors=positions if begin is None else None,
            start=begin,
            reference=reference,
        )
    # A bag holds its calibration, which cannot be written to.
    cures = [
        _that_can_be_set(one, flight.has_gimbal, files.camera.camera not in (None, files.frames))
        for one in found.findings
    ]
    return replace(found, findings=cures)


def _that_can_be_set(finding: Finding, has_gimbal: bool, has_calibration: bool) -> Finding:
    """A finding whose cure is possible: not every flight has a mount that can be written somewhere."""
    line, where, _ = finding.cure.partition(IN_CALIBRATION)
    if finding.cause != "mount" or not (has_gimbal or where):
        return finding
    if has_gimbal:
        return replace(
            finding, cure="beside a gimbal's angles no mount is set: correct the angles, with --correct "
            "roll_deg=roll_deg+DEG, --correct pitch_deg=pitch_deg+DEG or --correct heading_offset_deg=DEG",
        )  # fmt: skip
    return (
        finding
        if has_calibration
        else replace(finding, cure=f"write a calibration file with {line}, for --camera")
    )


def _of_truth(stamp_ns: int, truth: list[Truth]) -> Prior | None:
    there = interpolate_truth(truth, stamp_ns)
    if there is None:
        return None
    return Prior(lat_deg=there.lat_deg, lon_deg=there.lon_deg, sigma_m=_TRUTH_SIGMA_M)


def as_rows(found: Diagnosis, *, corrected: bool = False) -> list[tuple[str, str]]:
    """What a diagnosis says, a name and a sentence a row.

    Args:
        found: the diagnosis.
        corrected: whether the telemetry was corrected already: what is found comes on top of that.
    """
    seen = f"{found.seen} of {found.looked_at} pictures were placed on the map without the telemetry"
    more = ", on top of the corrections that were given" if corrected else ""
    out = []
    for one in found.findings:
        cure = f"try {one.cure}{more}" if one.cure.startswith("--") else one.cure
        out.append((one.cause.replace("_", " "), f"{one.text}; {cure}"))
    if found.seen < _LEAST_SEEN:
        seen += ", too few to say more: is it the map of this place and season, the calibration of this camera?"
    elif not out and found.compared:
        seen += f"; they fit what is said of {', '.join(found.compared)}{_contradicted(found, ', but ')}"
    elif not out:
        seen += "; there is no telemetry to compare them with"
    else:
        seen += _contradicted(found, "; ")
    return [*out, ("pictures", seen)]


def _contradicted(found: Diagnosis, before: str) -> str:
    """Which share of the pictures contradicts which field, the largest first; "" where none does."""
    shares = sorted(
        (one for one in found.contradicted if one.pictures),
        key=lambda one: one.pictures / one.compared, reverse=True,
    )  # fmt: skip
    ways = {"velocity": " ways between them"}
    texts = [
        f"{one.pictures} of {one.compared}{ways.get(one.field, '')} ({one.pictures / one.compared:.0%}) "
        f"{'contradicts' if one.pictures == 1 else 'contradict'} the {one.field}"
        for one in shares
    ]
    return before + ", ".join(texts) if texts else ""
