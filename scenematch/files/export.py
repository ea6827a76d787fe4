"""Write a finished track in the formats of other programs: GPX, GeoJSON and TUM.

Convention:
    GPX defines heights above the sea, so they are omitted if the track's are in another datum.
    TUM and GeoJSON contain the track's own heights, in the datum of the surface model.
    A refused frame, and a crossing of the 180th meridian, end a segment. Stamps from September 2001 on are UTC;
    earlier ones count from the start of the vehicle, and a track with those is written without times of day.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from xml.sax.saxutils import escape

from engine.errors import TelemetryError
from scenematch.files.notes import FrameNote
from scenematch.files.quaternions import quaternion_xyzw
from scenematch.files.resampling import UTC_FROM_NS
from scenematch.files.tables import cell_text
from scenematch.files.track import TrackRow


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseRow(TrackRow):
    """A row of a track with the rest of the pose; what is unknown is None.

    Attributes:
        alt_amsl_m: height above mean sea level.
        sigma_up_m: standard deviation of the height.
        roll_deg: positive right side down.
        pitch_deg: positive nose up.
        heading_deg: clockwise from true north.
        roll_sigma_deg: standard deviation of the roll.
        pitch_sigma_deg: of the pitch.
        heading_sigma_deg: of the heading.
    """

    alt_amsl_m: float | None = None
    sigma_up_m: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    heading_deg: float | None = None
    roll_sigma_deg: float | None = None
    pitch_sigma_deg: float | None = None
    heading_sigma_deg: float | None = None

    @property
    def angles_deg(self) -> tuple[float, float, float] | None:
        """Roll, pitch and heading, or None if one is unknown."""
        if self.roll_deg is None or self.pitch_deg is None or self.heading_deg is None:
            return None
        return self.roll_deg, self.pitch_deg, self.heading_deg


Segment = list[PoseRow]
_ANGLES = ("roll_deg", "pitch_deg", "heading_deg", "roll_sigma_deg", "pitch_sigma_deg", "heading_sigma_deg")
_NOTED = ("sigma_up_m", *_ANGLES)
_PROPERTIES = (
    "up_m", "alt_amsl_m", *_ANGLES, "sigma_east_m", "sigma_north_m", "sigma_up_m", "covariance_en_m2",
    "method", "score",
)  # fmt: skip


def pose_rows(
    rows: Iterable[TrackRow], notes: Sequence[FrameNote] | None = None, *, is_amsl: bool = False
) -> list[PoseRow]:
    """The rows of a track with the rest of their poses.

    Args:
        rows: of track.csv.
        notes: of notes.csv; notes on frames that the track lacks are ignored.
        is_amsl: whether the heights of the track are above mean sea level.
    """
    by_frame = {note.frame: note for note in notes or ()}
    found = []
    for row in rows:
        note = by_frame.get(row.frame) if row.fixed else None
        more = {} if note is None else {name: getattr(note, name) for name in _NOTED}
        known = {each.name: getattr(row, each.name) for each in fields(TrackRow)}
        found.append(PoseRow(**known, **more, alt_amsl_m=row.up_m if is_amsl else None))
    return found


def segments(rows: Iterable[PoseRow]) -> list[Segment]:
    """Split a track into uninterrupted sequences of fixes."""
    found: list[Segment] = []
    previous: PoseRow | None = None
    for row in rows:
        if row.fixed:
            if previous is None or abs(_lon_deg(row) - _lon_deg(previous)) > 180.0:
                found.append([])
            found[-1].append(row)
        previous = row if row.fixed else None
    return found


def to_gpx(rows: Sequence[PoseRow]) -> str:
    """The track as GPX 1.1: one ``trkseg`` per segment; elevations if known above the sea."""
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="scenematch" xmlns="http://www.topografix.com/GPX/1/1">',
        "<trk><name>scenematch</name>",
    ]
    for segment in segments(rows):
        parts += ["<trkseg>", *map(_gpx_point, segment), "</trkseg>"]
    return "\n".join([*parts, "</trk>", "</gpx>", ""])


def _gpx_point(row: PoseRow) -> str:
    time = _utc_text(row)
    # The schema prescribes the order elevation, time, name.
    elements = [
        "" if row.alt_amsl_m is None else f"<ele>{row.alt_amsl_m:.3f}</ele>",
        "" if time is None else f"<time>{time}</time>",
        f"<name>{escape(row.frame)}</name>",
    ]
    return f'<trkpt lat="{row.lat_deg:.9f}" lon="{_lon_deg(row):.9f}">{"".join(elements)}</trkpt>'


def to_geojson(rows: Sequence[PoseRow]) -> str:
    """The track as GeoJSON: a MultiLineString, and each fix as a Point with its pose and sigmas."""
    parts = segments(rows)
    lines = [[_lon_lat(row) for row in part] for part in parts if len(part) > 1]
    features: list[dict[str, object]] = []
    if lines:
        features.append(_feature("MultiLineString", lines, {"name": "scenematch"}))
    features += [_feature("Point", _lon_lat(row), _properties(row)) for part in parts for row in part]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"


def _lon_lat(row: PoseRow) -> list[float]:
    assert row.lat_deg is not None
    return [round(_lon_deg(row), 9), round(row.lat_deg, 9)]


def _feature(kind: str, coordinates: object, properties: dict[str, object]) -> dict[str, object]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def _properties(row: PoseRow) -> dict[str, object]:
    times = {"timestamp_ns": row.timestamp_ns, "time": _utc_text(row)}
    return {"frame": row.frame} | times | {name: getattr(row, name) for name in _PROPERTIES}


def to_tum(rows: Sequence[PoseRow]) -> str:
    """The track as TUM, the format of evo: ``timestamp x y z qx qy qz qw`` in seconds and metres east, north, up.

    The quaternion rotates the body (forward, left, up) to east, north, up, as in ROS. Programs that read TUM treat
    each line as a full pose. If some fixes have a height or an attitude, those without are omitted
    (:func:`tum_rows`); if none has, all z are 0 or all quaternions unity, and the first line says so.

    Raises:
        TelemetryError: a fix has no stamp.
    """
    kept = tum_rows(rows)
    head = "# timestamp x y z qx qy qz qw: s, m east, north, up"
    if all(row.up_m is None for row in kept):
        head += "; no height is known, z is 0"
    if all(row.angles_deg is None for row in kept):
        head += "; attitude is not known, the quaternion is unity"
    lines = [head]
    for row in kept:
        if row.timestamp_ns is None:
            raise TelemetryError(
                f"timestamp_ns: expected a stamp for the format tum, got none at frame {row.frame}"
            )
        sign, (seconds, rest_ns) = "-" * (row.timestamp_ns < 0), divmod(abs(row.timestamp_ns), 1_000_000_000)
        position = " ".join(cell_text(value or 0.0, 4) for value in (row.east_m, row.north_m, row.up_m))
        turn = (0.0, 0.0, 0.0, 1.0) if row.angles_deg is None else quaternion_xyzw(*row.angles_deg)
        quaternion = " ".join(f"{round(value, 9) + 0.0:.9g}" for value in turn)  # without a negative zero
        lines.append(f"{sign}{seconds}.{rest_ns:09d} {position} {quaternion}")
    return "\n".join([*lines, ""])


def tum_rows(rows: Sequence[PoseRow]) -> list[PoseRow]:
    """The fixes to write as TUM: those with a height and an attitude, if any fix has one."""
    kept = [row for segment in segments(rows) for row in segment]
    if any(row.up_m is not None for row in kept):
        kept = [row for row in kept if row.up_m is not None]
    if any(row.angles_deg is not None for row in kept):
        kept = [row for row in kept if row.angles_deg is not None]
    return kept


def _lon_deg(row: PoseRow) -> float:
    """Longitude in [-180, 180)."""
    assert row.lon_deg is not None
    return row.lon_deg if -180.0 <= row.lon_deg < 180.0 else (row.lon_deg + 180.0) % 360.0 - 180.0


def _utc_text(row: PoseRow) -> str | None:
    """The time of day in microseconds; None if the stamp does not state one."""
    if row.timestamp_ns is None or row.timestamp_ns < UTC_FROM_NS:
        return None
    time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=row.timestamp_ns // 1000)
    return f"{time:%Y-%m-%dT%H:%M:%S}.{time.microsecond:06d}Z"


WRITERS: dict[str, Callable[[Sequence[PoseRow]], str]] = {"gpx": to_gpx, "geojson": to_geojson, "tum": to_tum}
"""Function that formats a track, by the name of the format."""
