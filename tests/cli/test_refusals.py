"""What is refused before any work is done for it: in one line that begins with the option as it was typed."""

import pytest

from engine.errors import TelemetryError
from tests.support.commands import refusal

BRIDGE = ["bridge", "mavlink", "--map=m.tif", "--camera=c.yaml", "--connect=udpout:127.0.0.1:14999"]
PLAYED, LIVE = [*BRIDGE, "--frames=f"], [*BRIDGE, "--camera-source=0"]
ROS = ["bridge", "ros", "--map=m.tif"]
IN_REAL_TIME = [[*command, "--settings=bridge.realtime=true"] for command in (PLAYED, ROS)]
NO_ORIGIN = ["--settings=mavlink.set_origin=false", "--settings=mavlink.origin_alt_m=3"]
SIMULATE = ["simulate", "--out=o"]
LOOP = [*SIMULATE, "--closed-loop"]
TRACK = ["track", "--map=m.tif", "--camera=c.yaml", "--frames=f", "--out=o"]
CHECK = ["check", "--map=m.tif", "--camera=c.yaml", "--frames=f"]
LOCATE = ["locate", "i.jpg", "--map=m.tif", "--camera=c.yaml"]


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [
        *((PLAYED, "mavlink.origin_alt_m", value) for value in ("nan", "inf", "-inf", "1e9", "-10001")),
        *((LIVE, "input.exposure_to_grab_ms", value) for value in ("nan", "inf", "1e308", "-1")),
        *((PLAYED, "input.rate_hz", value) for value in ("nan", "inf", "0", "1e-300")),
        *((command, "bridge.deadline_ms", value) for command in (PLAYED, ROS) for value in ("nan", "0", "-1")),
        *((command, "input.map_sigma_m", value) for command in (TRACK, LOCATE) for value in ("nan", "0", "1e200")),
        *((command, "--start", "48,16,1e200") for command in (PLAYED, ROS, TRACK, LOCATE)),
        *((TRACK, "input.log_offset_s", value) for value in ("nan", "inf", "1e10")),
        *((command, "bridge.nice", value) for command in IN_REAL_TIME for value in ("0", "5", "-21")),
        *((command, "bridge.cores", value) for command in IN_REAL_TIME for value in ("x", "-1", "99999")),
        *((command, "input.every", value) for command in (TRACK, CHECK, PLAYED) for value in ("0", "-3")),
        *((TRACK, "--start", value) for value in ("here", "33", "33,35,1,2", "nan,35")),
        *((TRACK, "--budget-ms", value) for value in ("0", "-5", "nan")),
        *((command, "--method", "orb") for command in (TRACK, LOCATE)),
        (LOCATE, "--height-agl", "-3"),
        (LOCATE, "--heading", "nan"),
        (TRACK, "--profile", "fast"),
        ([*TRACK, "--profile=paper"], "--method", "auto"),
        *((SIMULATE, "--relief-m", value) for value in ("nan", "-5", "81")),
        *((SIMULATE, "--camera-pitch-deg", value) for value in ("nan", "-91", "0")),
        ([*SIMULATE, "--map=m.tif"], "--relief-m", "5"),
        (SIMULATE, "--condition", "eclipse"),
        *((LOOP, f"--{name}", value) for name, value in (("fault", "lost"), ("method", "orb"), ("minutes", "0"))),
        (LOOP, "--frames", "3"),
        (LOOP, "--camera-pitch-deg", "-45"),
        *((command, "--device", "gpu") for command in (PLAYED, ROS, TRACK, LOCATE)),
        (PLAYED, "--firmware", "x"),
        *((PLAYED, "--connect", value) for value in ("nonsense", "udpin:0.0.0.0:14550")),
        *((PLAYED, "mavlink.message", value) for value in ("x", "global_position_sensor")),  # which is PX4's
        (PLAYED, "mavlink.max_sigma_m", "1e308"),
        *((PLAYED, "mavlink.component_id", value) for value in ("1", "0", "256")),  # an autopilot, a broadcast
        (ROS, "--firmware", "x"),
    ],
)
def test_a_value_out_of_range_is_refused_by_its_option(command, option, value, tmp_path, monkeypatch, capsys):
    if option.startswith(("--firmware", "mavlink.")):
        pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    monkeypatch.chdir(tmp_path)
    name = option if option.startswith("--") else f"--settings {option}"
    given = [f"{option}={value}"] if name == option else ["--settings", f"{option}={value}"]
    assert refusal(capsys, [*command, *given]).startswith(f"{name}: expected ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "option", "wanted"),
    [
        ([*LIVE, "--telemetry=t.csv"], "--telemetry", "--frames"),
        ([*LIVE, "--settings=input.rate_hz=3"], "--settings input.rate_hz", "--frames"),
        ([*LIVE, "--settings=input.every=3"], "--settings input.every", "--frames"),
        ([*PLAYED, "--settings=input.exposure_to_grab_ms=3"], "--settings input.exposure_to_grab_ms",
         "--camera-source"),
        ([*PLAYED, "--settings=bridge.nice=-5"], "--settings bridge.nice", "--settings bridge.realtime"),
        ([*ROS, "--settings=bridge.cores=0"], "--settings bridge.cores", "--settings bridge.realtime"),
        ([*PLAYED, *NO_ORIGIN], "--settings mavlink.origin_alt_m", "--settings mavlink.set_origin"),
        *(([*SIMULATE, f"--{name}={value}"], f"--{name}", "--closed-loop") for name, value in
          (("minutes", 1), ("rerun", "a.rrd"), ("fault", "killed"), ("method", "ncc"))),
    ],
)  # fmt: skip
def test_an_option_that_would_say_nothing_is_refused(command, option, wanted, capsys):
    assert refusal(capsys, command) == f"{option}: expected with {wanted} only\n"


def test_a_topic_is_of_a_bag_and_a_start_on_the_earth(capsys):
    line = refusal(capsys, [*TRACK, "--settings=input.image_topic=/down"])
    assert line == "--settings input.image_topic: expected a bag as frames, got f\n"
    line = refusal(capsys, [*TRACK, "--telemetry=t.csv", "--settings=input.odometry_topic=/vio"])
    assert line == "--settings input.odometry_topic: expected a bag as telemetry, got t.csv\n"
    for start in ("95,35", "33,35,-1"):
        assert refusal(capsys, [*TRACK, f"--start={start}"]).startswith("--start: ")


GSTREAMER = ("nvarguscamerasrc", "nvarguscamerasrc ! nvvidconv ! appsink", "v4l2src ! appsink")


@pytest.mark.parametrize("source", ["9" * 20, "9" * 5000, "7", "²", "no-such-file.mp4", *GSTREAMER])
def test_a_camera_that_does_not_open_is_told_and_how_a_gstreamer_pipeline_is_read(source):
    from scenematch.bridges.pictures import capture

    opened = "^camera_source: expected a camera or stream that opens, got "
    with pytest.raises(TelemetryError, match=opened) as error:
        next(capture(source))
    assert ("; read a GStreamer pipeline by 'exec:gst-launch-1.0 " in str(error.value)) == (source in GSTREAMER)


@pytest.mark.parametrize("link", ["udpout:192.168..1:14550", f"udpout:{'x' * 300}:5", "tcp:a..b:5"])
def test_a_host_that_cannot_be_one_is_told(link):
    from scenematch.bridges.links import parse_connection

    with pytest.raises(OSError, match="is not a valid host name"):
        parse_connection(link).open()
