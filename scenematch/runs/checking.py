"""Check a flight before tracking: whether its inputs agree, and which change would make them agree."""

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
from scenematch.runs.output import SILENT, Progress
from scenematch.runs.settings import TrackSettings

_TRUTH_SIGMA_M = 1.0
_MIN_SEEN = 3


def diagnose_flight(
    files: FlightFiles,
    start: str | None = None,
    *,
    columns: Mapping[str, str] = {},
    inputs: FlightInputs | None = None,
    progress: Progress = SILENT,
) -> Diagnosis:
    """Compare a flight's telemetry, camera, clock and map with what its pictures show.

    Args:
        files: files of the flight.
        start: where it begins, "LAT,LON" or "LAT,LON,SIGMA_M"; None uses the telemetry's positions.
        columns: telemetry.csv's own names of standard columns: ``{"height_agl_m": "alt"}``.
        inputs: the inputs, if :func:`scenematch.runs.inputs.open_inputs` has already read them.
        progress: receives progress and messages.

    Returns:
        Diagnosis: what does not agree.

    Raises:
        OptionError, TelemetryError, CalibrationError, MapError: an argument or a file is invalid.
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
    with progress.task("locating pictures without the telemetry"):
        found = diagnose(
            flight.rows or [flight.read(0).frame] * len(flight),
            lambda index: flight.read(index).frame,
            inputs.site,
            inputs.camera,
            priors=positions if begin is None else None,
            start=begin,
            reference=reference,
        )
    # A bag contains its calibration and cannot be edited.
    cures = [
        _that_can_be_set(one, flight.has_gimbal, files.camera.camera not in (None, files.frames))
        for one in found.findings
    ]
    return replace(found, findings=cures)


def _that_can_be_set(finding: Finding, has_gimbal: bool, has_calibration: bool) -> Finding:
    """A finding with a cure that applies: some flights have no file to write a mount into."""
    line, where, _ = finding.cure.partition(IN_CALIBRATION)
    if finding.cause != "mount" or not (has_gimbal or where):
        return finding
    if has_gimbal:
        corrections = (
            "roll_deg=roll_deg+DEG, --correct pitch_deg=pitch_deg+DEG or --correct heading_offset_deg=DEG"
        )
        cure = f"the gimbal's angles replace a mount: correct the angles with --correct {corrections}"
        return replace(finding, cure=cure)
    if has_calibration:
        return finding
    return replace(finding, cure=f"write a calibration file with {line}, for --camera")


def _of_truth(stamp_ns: int, truth: list[Truth]) -> Prior | None:
    there = interpolate_truth(truth, stamp_ns)
    if there is None:
        return None
    return Prior(lat_deg=there.lat_deg, lon_deg=there.lon_deg, sigma_m=_TRUTH_SIGMA_M)


def as_rows(found: Diagnosis, *, corrected: bool = False) -> list[tuple[str, str]]:
    """A diagnosis as rows, each a name and a sentence.

    Args:
        found: the diagnosis.
        corrected: whether the telemetry was already corrected; the findings then add to that.
    """
    seen = f"{found.seen} of {found.looked_at} pictures were located on the map without the telemetry"
    more = ", in addition to the given corrections" if corrected else ""
    out = []
    for one in found.findings:
        cure = f"try {one.cure}{more}" if one.cure.startswith("--") else one.cure
        out.append((one.cause.replace("_", " "), f"{one.text}; {cure}"))
    if found.seen < _MIN_SEEN:
        seen += (
            ", too few to say more: does the map show this place and season, and is the calibration this camera's?"
        )
    elif not out and found.compared:
        seen += f"; they agree with the {', '.join(found.compared)}{_contradicted(found, ', but ')}"
    elif not out:
        seen += "; there is no telemetry to compare them with"
    else:
        seen += _contradicted(found, "; ")
    return [*out, ("pictures", seen)]


def _contradicted(found: Diagnosis, before: str) -> str:
    """The share of pictures that contradict each field, largest first; "" if none do."""
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
