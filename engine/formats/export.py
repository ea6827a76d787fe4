"""A finished track in the formats of other programs: GPX, GeoJSON, KML, TUM and NMEA.

Convention:
    A refused frame, and a crossing of the 180th meridian, end a segment. Stamps from September 2001 on are UTC;
    earlier ones count from the start of the vehicle, and such a track is written without times of day.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from xml.sax.saxutils import escape

from engine.errors import TelemetryError
from engine.formats.resampling import UTC_FROM_NS
from engine.formats.tables import cell_text
from engine.formats.track import TrackRow

Segment = list[TrackRow]


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
    """The track as GPX 1.1: one ``trkseg`` per segment; elevations where the method measures them."""
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="scenematch" xmlns="http://www.topografix.com/GPX/1/1">',
        "<trk><name>scenematch</name>",
    ]
    for segment in segments(rows):
        parts += ["<trkseg>", *map(_gpx_point, segment), "</trkseg>"]
    return "\n".join([*parts, "</trk>", "</gpx>", ""])


def _gpx_point(row: TrackRow) -> str:
    time = _utc(row)
    # The schema prescribes the order elevation, time, name.
    elements = [
        "" if row.up_m is None else f"<ele>{row.up_m:.3f}</ele>",
        "" if time is None else f"<time>{_iso(time)}</time>",
        f"<name>{escape(row.frame)}</name>",
    ]
    return f'<trkpt lat="{row.lat_deg:.9f}" lon="{_lon_deg(row):.9f}">{"".join(elements)}</trkpt>'


def to_geojson(rows: Sequence[TrackRow]) -> str:
    """The track as GeoJSON: a MultiLineString, and each fix as a Point with its sigmas in metres."""
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
    time = _utc(row)
    return {
        "frame": row.frame,
        "timestamp_ns": row.timestamp_ns,
        "time": None if time is None else _iso(time),
        "up_m": row.up_m,
        "sigma_east_m": row.sigma_east_m,
        "sigma_north_m": row.sigma_north_m,
        "covariance_en_m2": row.covariance_en_m2,
        "method": row.method,
        "score": row.score,
    }


def to_kml(rows: Sequence[TrackRow]) -> str:
    """The track as KML 2.2: lines on the ground, and each fix as a placemark with its sigmas in metres."""
    found = segments(rows)
    lines = [segment for segment in found if len(segment) > 1]
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<kml xmlns="http://www.opengis.net/kml/2.2">',
        "<Document><name>scenematch</name>",
    ]
    if lines:
        parts.append("<Placemark><name>track</name><MultiGeometry>")
        parts += [
            f"<LineString><tessellate>1</tessellate><coordinates>{' '.join(map(_kml_position, segment))}"
            "</coordinates></LineString>"
            for segment in lines
        ]
        parts.append("</MultiGeometry></Placemark>")
    parts += [
        "<Folder><name>fixes</name>",
        *(_kml_point(row) for segment in found for row in segment),
        "</Folder>",
    ]
    return "\n".join([*parts, "</Document>", "</kml>", ""])


def _kml_position(row: TrackRow) -> str:
    return f"{_lon_deg(row):.9f},{row.lat_deg:.9f}"


def _kml_point(row: TrackRow) -> str:
    time = _utc(row)
    stamp = "" if time is None else f"<TimeStamp><when>{_iso(time)}</when></TimeStamp>"
    description = f"sigma east {row.sigma_east_m:.2f} m, north {row.sigma_north_m:.2f} m"
    return (
        f"<Placemark><name>{escape(row.frame)}</name><description>{description}</description>{stamp}"
        f"<Point><coordinates>{_kml_position(row)}</coordinates></Point></Placemark>"
    )


def to_tum(rows: Sequence[TrackRow]) -> str:
    """The track as TUM, the format of evo: ``timestamp x y z qx qy qz qw`` in seconds and metres east, north, up.

    A track has no attitude: every quaternion is the identity. An unknown height is written as 0.

    Raises:
        TelemetryError: a fix has no stamp.
    """
    lines = ["# timestamp x y z qx qy qz qw: s, m east, north, up; attitude is not known, the quaternion is unity"]
    for row in (row for segment in segments(rows) for row in segment):
        if row.timestamp_ns is None:
            raise TelemetryError(
                f"timestamp_ns: expected a stamp for the format tum, got none at frame {row.frame}"
            )
        sign, (seconds, rest_ns) = "-" * (row.timestamp_ns < 0), divmod(abs(row.timestamp_ns), 1_000_000_000)
        position = " ".join(cell_text(value or 0.0, 4) for value in (row.east_m, row.north_m, row.up_m))
        lines.append(f"{sign}{seconds}.{rest_ns:09d} {position} 0 0 0 1")
    return "\n".join([*lines, ""])


def to_nmea(rows: Sequence[TrackRow]) -> str:
    """The track as NMEA 0183: GGA and RMC per frame; a refused frame is void, so that a reader sees the gap.

    The number of satellites is 0 and the dilution of precision blank; the quality is 1, as programs expect of a
    position. Time and date are blank where stamps are not UTC.
    """
    sentences = (sentence for row in rows for sentence in (_gga(row), _rmc(row)))
    return "".join(f"{sentence}\r\n" for sentence in sentences)


def _gga(row: TrackRow) -> str:
    time, _ = _utc_fields(row)
    height = "" if row.up_m is None else f"{row.up_m:.2f}"
    unit = "M" if height else ""
    return nmea_sentence(f"GPGGA,{time},{_nmea_position(row)},{int(row.fixed)},00,,{height},{unit},,,,")


def _rmc(row: TrackRow) -> str:
    time, date = _utc_fields(row)
    status, mode = ("A", "A") if row.fixed else ("V", "N")
    return nmea_sentence(f"GPRMC,{time},{status},{_nmea_position(row)},,,{date},,,{mode}")


def nmea_sentence(body: str) -> str:
    """An NMEA sentence: ``$``, the body, and the checksum, the exclusive or of the body's bytes."""
    return f"${body}*{reduce(xor, body.encode('ascii'), 0):02X}"


def degrees_minutes(value_deg: float, digits: int) -> str:
    """Unsigned degrees in ``digits`` digits and minutes with 6 decimals (2 mm); minutes stay below 60."""
    # Rounded before the split: 59.9999999 minutes become the next degree.
    degrees, micro_minutes = divmod(round(abs(value_deg) * 60e6), 60_000_000)
    minutes, rest = divmod(micro_minutes, 1_000_000)
    return f"{degrees:0{digits}d}{minutes:02d}.{rest:06d}"


def _nmea_position(row: TrackRow) -> str:
    if row.lat_deg is None or not row.fixed:
        return ",,,"
    lon_deg = _lon_deg(row)
    lat = f"{degrees_minutes(row.lat_deg, 2)},{'S' if row.lat_deg < 0 else 'N'}"
    return f"{lat},{degrees_minutes(lon_deg, 3)},{'W' if lon_deg < 0 else 'E'}"


def _utc_fields(row: TrackRow) -> tuple[str, str]:
    """Time of day and date as NMEA writes them, both after rounding to a hundredth of a second."""
    time = _utc(row)
    if time is None:
        return "", ""
    time = time.replace(microsecond=0) + timedelta(microseconds=round(time.microsecond, -4))
    return f"{time:%H%M%S}.{time.microsecond // 10_000:02d}", f"{time:%d%m%y}"


def _lon_deg(row: TrackRow) -> float:
    """Longitude in [-180, 180)."""
    assert row.lon_deg is not None
    return row.lon_deg if -180.0 <= row.lon_deg < 180.0 else (row.lon_deg + 180.0) % 360.0 - 180.0


def _utc(row: TrackRow) -> datetime | None:
    if row.timestamp_ns is None or row.timestamp_ns < UTC_FROM_NS:
        return None
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=row.timestamp_ns // 1000)


def _iso(time: datetime) -> str:
    return f"{time:%Y-%m-%dT%H:%M:%S}.{time.microsecond:06d}Z"


WRITERS: dict[str, Callable[[Sequence[TrackRow]], str]] = {
    "gpx": to_gpx,
    "geojson": to_geojson,
    "kml": to_kml,
    "tum": to_tum,
    "nmea": to_nmea,
}
"""Function that formats a track, by the name of the format."""
