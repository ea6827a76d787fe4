"""Where the vehicle of a recorded flight was: a video with its subtitles, and a folder."""

import pytest

from engine.errors import TelemetryError
from tests.support.videos import write_video

pytest.importorskip("pymavlink", reason="pymavlink is not installed")
from bench.live.flights.recorded import recorded

RATE_HZ, NORTH_MPS = 25.0, 9.0
CUE = (
    "{n}\n00:00:0{s},{ms:03d} --> 00:00:0{s},{ms:03d}\nFrameCnt: {n}\n[latitude: {lat:.6f}] [longitude: 16.2] "
    "[rel_alt: 80.0 abs_alt: 300.0] {gimbal}\n\n"
)


def video(folder, gimbal, size=(32, 32), shade=1):
    """Three seconds due north, each frame a shade brighter, with a cue each: positions to 0.1 m, as DJI's."""
    path, cues = folder / "DJI_0001.mp4", []
    write_video(path, [shade * k for k in range(75)], size=size, rate_hz=RATE_HZ, codec="mp4v")
    for k in range(75):
        lat_deg = 48.1 + NORTH_MPS * k / RATE_HZ / 111_200.0
        cues.append(CUE.format(n=k + 1, s=k // 25, ms=k % 25 * 40, lat=lat_deg, gimbal=gimbal))
    (folder / "DJI_0001.SRT").write_text("".join(cues))
    return path


def test_it_flies_the_positions_and_the_velocity_of_the_subtitles(tmp_path):
    motion, place, duration_s = recorded(video(tmp_path, "[gb_yaw: 30.0 gb_pitch: -90.0 gb_roll: 0.0]"))
    assert (place.lat_deg, duration_s) == (pytest.approx(48.1), pytest.approx(74 / RATE_HZ))
    for time_s in (0.0, 1.0, 2.5):
        state = motion(time_s)
        assert (state.height_m, state.heading_deg) == pytest.approx((80.0, 30.0))
        assert (state.east_m, state.north_m) == pytest.approx((0.0, NORTH_MPS * time_s), abs=0.2)
        assert (state.east_mps, state.north_mps) == pytest.approx((0.0, NORTH_MPS), abs=0.3)


def test_subtitles_without_a_heading_are_refused(tmp_path):
    with pytest.raises(TelemetryError, match="expected subtitles beside it with position, rel_alt and gimbal"):
        recorded(video(tmp_path, ""))


def folder(path, truth, telemetry):
    """Two seconds due north, a row a second, with these columns besides."""
    for name, columns in (("truth", truth), ("telemetry", telemetry)):
        places = {"lat_deg": 48.1, "lon_deg": 16.2} if name == "truth" else {"frame": 0}
        columns = places | columns
        rows = [",".join(["timestamp_ns", *columns])]
        for k in range(3):
            steps = {"lat_deg": 1e-4 * k, "frame": k}
            values = [value + steps.get(column, 0) for column, value in columns.items()]
            rows.append(",".join(map(str, [10**9 * (k + 1), *values])))
        (path / f"{name}.csv").write_text("\n".join(rows) + "\n")
    return path


def test_a_truth_without_heights_above_ground_is_flown_at_the_telemetrys(tmp_path):
    heading, height, altitude = {"heading_deg": 30.0}, {"height_agl_m": 150.0}, {"alt_amsl_m": 200.0}
    motion, _, _ = recorded(folder(tmp_path, heading | altitude, height))
    assert [motion(time_s).height_m for time_s in (0.0, 0.5, 2.0)] == [150.0] * 3
    motion, _, _ = recorded(folder(tmp_path, heading | {"height_agl_m": 149.0}, height))
    assert motion(1.0).height_m == 149.0
    with pytest.raises(TelemetryError, match=r"height_agl_m in truth.csv or telemetry.csv, got none in either$"):
        recorded(folder(tmp_path, heading | altitude, {}))
    with pytest.raises(TelemetryError, match=r"truth.csv: expected a heading_deg in every row$"):
        recorded(folder(tmp_path, altitude, height))
