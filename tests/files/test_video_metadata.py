"""A video's metadata by the way that the documentation shows: KLV to subtitles, subtitles to telemetry."""

import struct
import subprocess
import sys

import pytest

from scenematch.files.logs.readers import open_log
from scenematch.files.resampling import rows_and_sources_at
from tests.support.paths import ROOT

UAS_DATALINK = bytes.fromhex("060e2b34020b01010e01030101000000")
BEGIN_US = 1_777_636_800_000_000


def packet(k):
    """MISB ST 0601, written here by the formulas of the standard: 1.25 s after the one before."""
    lat, lon, heading, altitude_m = 48.25 + 1e-4 * k, -16.5 + 2e-4 * k, 90.0 + k, 420.0 + 2.0 * k
    items = [
        (2, struct.pack(">Q", BEGIN_US + 1_250_000 * k)),
        (5, struct.pack(">H", round(heading / 360.0 * 0xFFFF))),
        (13, struct.pack(">i", round(lat / 90.0 * 0x7FFFFFFF))),
        (14, struct.pack(">i", round(lon / 180.0 * 0x7FFFFFFF))),
        (15, struct.pack(">H", round((altitude_m + 900.0) / 19900.0 * 0xFFFF))),
    ]
    body = b"".join(bytes([tag, len(value)]) + value for tag, value in items) + b"\x01\x02"
    head = UAS_DATALINK + bytes([len(body) + 2])
    checksum = sum(byte << (8 * (1 - i % 2)) for i, byte in enumerate(head + body)) & 0xFFFF
    return head + body + struct.pack(">H", checksum)


def test_the_documented_script_makes_telemetry_of_klv(tmp_path):
    pytest.importorskip("klvdata", reason="klvdata is not installed")
    (tmp_path / "flight.klv").write_bytes(b"".join(packet(k) for k in range(4)))
    command = [sys.executable, str(ROOT / "examples" / "klv_to_srt.py"), "flight.klv"]
    text = subprocess.run(command, cwd=tmp_path, capture_output=True, check=True).stdout
    (tmp_path / "flight.srt").write_bytes(text)
    log = open_log(tmp_path / "flight.srt")
    rows, _ = rows_and_sources_at(log, [1_250_000_000 * k for k in range(4)], list("0123"))
    for k, row in enumerate(rows):
        assert (row.lat_deg, row.lon_deg) == pytest.approx((48.25 + 1e-4 * k, -16.5 + 2e-4 * k), abs=2e-7)
        assert row.alt_amsl_m == pytest.approx(420.0 + 2.0 * k, abs=0.16)  # the standard's step is 0.3 m
        assert row.heading_deg == pytest.approx(90.0 + k, abs=0.004)
        assert (row.roll_deg, row.pitch_deg) == pytest.approx((0.0, 0.0), abs=1e-9)
