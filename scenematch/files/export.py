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
from datetime import UTC, datetime, timedelta
from xml.sax.saxutils import escape

from engine.errors import TelemetryError
from scenematch.files.quaternions import quaternion_xyzw
from scenematch.files.resampling import UTC_FROM_NS
from scenematch.files.tables import cell_text
from scenematch.files.track import TrackRow

Segment = list[TrackRow]
_ANGLES = ("roll_deg", "pitch_deg", "heading_deg", "roll_sigma_deg", "pitch_sigma_deg", "heading_sigma_deg")
_PROPERTIES = (
    "up_m", "alt_amsl_m", *_ANGLES, "sigma_east_m", "sigma_north_m", "sigma_up_m", "covariance_en_m2",
    "method", "score",
)  # fmt: skip


def angles_deg(row: TrackRow) -> tuple[float, float, float] | None:
    """Roll, pitch and heading of a fix, or None if one is unknown."""
    if row.roll_deg is None or row.pitch_deg is None or row.heading_deg is None:
        return None
    return row.roll_deg, row.pitch_deg, row.heading_deg


def segments(rows: Iterable[TrackRow]) -> list[Segment]:
    """Split a track into uninterrupted sequences of fixes."""
    found: list[Segment] = []
    previous: TrackRow | None = None
    for row in rows:
        if row.fixed:
            if previous is None or abs(_lon_deg(row) - _lon_deg(previous)) > 180.0:
                found.append([])
            found[-1].append(row)
        previous = row if row.fixed else None
    return found


def to_gpx(rows: Sequence[TrackRow]) -> str:
    """The track as GPX 1.1: one ``trkseg`` per segment; elevations if known above the sea."""
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="scenematch" xmlns="http://www.topografix.com/GPX/1/1">',
        "<trk><name>scenematch</name>",
    ]
    for segment in segments(rows):
        parts += ["<trkseg>", *map(_gpx_point, segment), "</trkseg>"]
    return "\n".join([*parts, "</trk>", "</gpx>", ""])


def _gpx_point(row: TrackRow) -> str:
    time = _utc_text(row)
    # The schema prescribes the order elevation, time, name.
    elements = [
        "" if row.alt_amsl_m is None else f"<ele>{row.alt_amsl_m:.3f}</ele>",
        "" if time is None else f"<time>{time}</time>",
        f"<name>{escape(row.frame)}</name>",
    ]
    return f'<trkpt lat="{row.lat_deg:.9f}" lon="{_lon_deg(row):.9f}">{"".join(elements)}</trkpt>'


def to_geojson(rows: Sequence[TrackRow]) -> str:
    """The track as GeoJSON: a MultiLineString, and each fix as a Point with its pose and sigmas."""
    parts = segments(rows)
    lines = [[_lon_lat(row) for row in part] for part in parts if len(part) > 1]
    features: list[dict[str, object]] = []
    if lines:
        features.append(_feature("MultiLineString", lines, {"name": "scenematch"}))
    features += [_feature("Point", _lon_lat(row), _properties(row)) for part in parts for row in part]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"


def _lon_lat(row: TrackRow) -> list[float]:
    assert row.lat_deg is not None
    return [round(_lon_deg(row), 9), round(row.lat_deg, 9)]


def _feature(kind: str, coordinates: object, properties: dict[str, object]) -> dict[str, object]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def _properties(row: TrackRow) -> dict[str, object]:
    times = {"timestamp_ns": row.timestamp_ns, "time": _utc_text(row)}
    return {"frame": row.frame} | times | {name: getattr(row, name) for name in _PROPERTIES}


def to_tum(rows: Sequence[TrackRow]) -> str:
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
    if all(angles_deg(row) is None for row in kept):
        head += "; attitude is not known, the quaternion is unity"
    lines = [head]
    for row in kept:
        if row.timestamp_ns is None:
            raise TelemetryError(
                f"timestamp_ns: expected a stamp for the format tum, got none at frame {row.frame}"
            )
        sign, (seconds, rest_ns) = "-" * (row.timestamp_ns < 0), divmod(abs(row.timestamp_ns), 1_000_000_000)
        position = " ".join(cell_text(value or 0.0, 4) for value in (row.east_m, row.north_m, row.up_m))
        angles = angles_deg(row)
        turn = (0.0, 0.0, 0.0, 1.0) if angles is None else quaternion_xyzw(*angles)
        quaternion = " ".join(f"{round(value, 9) + 0.0:.9g}" for value in turn)  # without a negative zero
        lines.append(f"{sign}{seconds}.{rest_ns:09d} {position} {quaternion}")
    return "\n".join([*lines, ""])


def tum_rows(rows: Sequence[TrackRow]) -> list[TrackRow]:
    """The fixes to write as TUM: those with a height and an attitude, if any fix has one."""
    kept = [row for segment in segments(rows) for row in segment]
    if any(row.up_m is not None for row in kept):
        kept = [row for row in kept if row.up_m is not None]
    if any(angles_deg(row) is not None for row in kept):
        kept = [row for row in kept if angles_deg(row) is not None]
    return kept


def _lon_deg(row: TrackRow) -> float:
    """Longitude in [-180, 180)."""
    assert row.lon_deg is not None
    return row.lon_deg if -180.0 <= row.lon_deg < 180.0 else (row.lon_deg + 180.0) % 360.0 - 180.0


def _utc_text(row: TrackRow) -> str | None:
    """The time of day in microseconds; None if the stamp does not state one."""
    if row.timestamp_ns is None or row.timestamp_ns < UTC_FROM_NS:
        return None
    time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=row.timestamp_ns // 1000)
    return f"{time:%Y-%m-%dT%H:%M:%S}.{time.microsecond:06d}Z"


WRITERS: dict[str, Callable[[Sequence[TrackRow]], str]] = {"gpx": to_gpx, "geojson": to_geojson, "tum": to_tum}
"""Function that formats a track, by the name of the format."""
