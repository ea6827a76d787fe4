"""The examples run as they stand: in a flight folder, beside a stand-in autopilot, in a ROS that is none."""

import json
import os
import re
import runpy
import subprocess
import sys
import threading
import time
import types
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
import pytest

from engine import Budget, OptionError
from scenematch import RecentValues
from scenematch.files.flight import open_flight
from scenematch.files.truth import read_truth
from tests.support.fields import fields_of
from tests.support.paths import ROOT

EXAMPLES = ROOT / "examples"
FRAMES = 8


@pytest.fixture(scope="module")
def flight(flight_in, tmp_path_factory):
    """A flight folder."""
    folder = tmp_path_factory.mktemp("examples")
    flight_in(folder, FRAMES)
    return folder


@pytest.mark.parametrize("script", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short(script):
    lines = script.read_text(encoding="utf-8").split('"""', 2)[2].splitlines()
    code = [line for line in lines if line.strip() and not line.startswith(("import ", "from ", "#"))]
    assert len(code) <= 20


@pytest.mark.usefixtures("bare_runs")
def test_your_own_loop_fixes_every_frame(flight, monkeypatch, capsys):
    monkeypatch.chdir(flight)
    monkeypatch.setattr("engine.Budget", lambda total_ms: Budget())  # however slow this machine is
    runpy.run_path(str(EXAMPLES / "your_own_loop.py"))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == FRAMES
    assert all("NCC" in line for line in lines)


@pytest.mark.slow
@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
def test_beside_an_autopilot_that_hears_where_it_was(firmware, flight):
    pytest.importorskip("pymavlink", reason="pymavlink is not installed")
    from bench.live.bridge_counts import free_port
    from bench.live.flights.fly import fly

    port, start = free_port(), read_truth(flight / "truth.csv")[0]
    link, place = f"udpin:127.0.0.1:{port}", [str(start.lat_deg), str(start.lon_deg)]
    command = [sys.executable, str(EXAMPLES / "beside_autopilot.py"), firmware, link, *place]
    stated = {"cwd": flight, "env": os.environ | {"PYTHONPATH": str(EXAMPLES.parent)}, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **stated) as bridge:
        try:
            came = fly(flight, port, firmware)
            said, _ = bridge.communicate(timeout=60)
        finally:
            bridge.kill()
    assert bridge.returncode == 0
    # A busy machine hears of autopilot, origin, height and receiver after its first fix, and is late with some.
    unheard = {"no autopilot", "no origin", "no height", "receiver not heard yet"}
    assert set(re.findall(r"'([\w ]+)': \d+", said)) <= {"late", "unconfirmed"} | unheard
    assert len(came) >= 1
    assert len(came) == int(re.search(r"sent=(\d+)", said)[1])
    assert np.median([off_m for off_m, _ in came]) < 3.0


@pytest.mark.slow
def test_the_notebook_prints_what_it_shows(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names = {"__name__": "first_fix"}
    for cell in json.loads((EXAMPLES / "first_fix.ipynb").read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
            shown = [line for output in cell["outputs"] for line in output.get("text", [])]
            assert words(capsys.readouterr().out) == words("".join(shown))
    assert len(names["fixes"]) == len(names["flight"])
    assert max(names["errors_m"]) < 1.0


def words(text):
    """Text without its figures, whose last digits differ between processors."""
    return re.sub(r"\d+\.\d+", "#", text)


def test_a_video_and_its_telemetry_are_the_flight_again(flight, monkeypatch):
    monkeypatch.chdir(flight)
    runpy.run_path(str(EXAMPLES / "video_of_flight.py"))
    video = list(open_flight("flight.mp4", "video.csv"))
    for item, of_folder in zip(video, open_flight("frames", "telemetry.csv"), strict=True):
        assert fields_of(replace(item.frame, image=of_folder.frame.image)) == fields_of(of_folder.frame)
        assert np.abs(item.frame.image.astype(int) - of_folder.frame.image).mean() < 12.0  # compressed once more


class CameraOfNoCamera:
    """A camera that shows the flight's pictures, as OpenCV's, as picamera2's and as a pipe's."""

    def __init__(self, flight):
        self.frames = [item.frame for item in open_flight(flight / "frames", flight / "telemetry.csv")]
        self.left = list(self.frames)
        self.said, self.answered = [], threading.Event()

    def hears(self, line):
        """What the example prints."""
        self.said.append(line)
        self.answered.set()

    def known(self):
        """What the vehicle knows at the picture that was taken last."""
        frame = self.frames[len(self.frames) - len(self.left) - 1]
        return frame.roll_deg, frame.pitch_deg, frame.heading_deg, frame.height_agl_m

    def grab(self):
        """The next picture once the last one was answered, or is too old to be."""
        self.answered.wait(0.7)
        self.answered.clear()
        return bool(self.left)

    def retrieve(self):
        return True, cv2.cvtColor(np.atleast_3d(self.left.pop(0).image), cv2.COLOR_RGB2BGR)

    def pipe(self, source, exposure_to_grab_ms):
        assert source.startswith("exec:gst-launch-1.0 ")
        while self.grab():
            yield self.retrieve()[1][:, :, ::-1].copy(), time.monotonic_ns()
            yield None

    def create_video_configuration(self, mode):
        return mode

    def configure(self, mode):
        assert mode["format"] == "RGB888"

    def start(self):
        pass

    def capture_request(self):
        if not self.grab():
            raise KeyboardInterrupt
        return self

    def make_array(self, stream):
        return self.retrieve()[1]

    def get_metadata(self):
        return {"SensorTimestamp": time.monotonic_ns(), "ExposureTime": 1000}

    release = start


@pytest.mark.usefixtures("bare_runs")
@pytest.mark.parametrize("name", ["opencv_camera", "jetson_camera", "picamera2_camera"])
def test_a_camera_is_followed(name, flight, monkeypatch):
    camera, start = CameraOfNoCamera(flight), read_truth(flight / "truth.csv")[0]
    picamera2 = types.ModuleType("picamera2")
    picamera2.Picamera2 = lambda: camera
    monkeypatch.setitem(sys.modules, "picamera2", picamera2)
    monkeypatch.setattr("cv2.VideoCapture", lambda number: camera)
    monkeypatch.setattr("scenematch.bridges.pictures.capture", camera.pipe)
    monkeypatch.setattr("scenematch.bridges.vehicle.RecentValues.at", lambda self, ns: camera.known())
    monkeypatch.setattr(sys, "argv", [name, str(start.lat_deg), str(start.lon_deg)])
    monkeypatch.chdir(flight)
    with suppress(KeyboardInterrupt):
        runpy.run_path(str(EXAMPLES / f"{name}.py"), {"print": camera.hears})
    fixes = [re.fullmatch(r"(\S+) (\S+), \d+ ms old", line).groups() for line in camera.said]
    assert len(fixes) >= 2
    assert all(abs(float(lat) - start.lat_deg) < 1e-3 for lat, _ in fixes)


@pytest.mark.slow
def test_in_ros_the_topics_are_heard_and_every_picture_is_answered(flight, monkeypatch, capsys):
    """A node without ROS plays one picture and keeps what is published."""
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    from tests.support.ros import NOW_NS, StandInNode, maker_of

    node, topics = StandInNode(maker_of("ros1")), {}

    def spin(handlers, beat, seconds):
        topics.update({topic: kind for topic, (kind, _) in handlers.items()})
        handlers["/down/image_raw"][1](node.messages.image(NOW_NS, "camera", np.zeros((300, 300), np.uint8)))
        node.wait_for("diagnostics", 1)
        beat()

    node.spin = spin
    module = types.ModuleType("scenematch.bridges.ros1")
    module.Node = lambda name, arguments=(): node
    monkeypatch.setitem(sys.modules, "scenematch.bridges.ros1", module)
    monkeypatch.setattr(sys, "argv", ["in_ros.py", "1"])
    monkeypatch.chdir(flight)
    runpy.run_path(str(EXAMPLES / "in_ros.py"))
    assert topics["/down/image_raw"] == "sensor_msgs/msg/Image"
    assert "/mavros/global_position/compass_hdg" not in topics
    assert [output for output, _ in node.published] == ["diagnostics"]  # a black picture has no pose
    assert re.search(r"answered=1\b", capsys.readouterr().out)


def test_samples_of_another_length_are_refused_where_they_are_added():
    values = RecentValues()
    values.add(1, 2.0, 3.0)
    with pytest.raises(OptionError, match=r"^values: expected 2, as before, got 1$"):
        values.add(2, 2.0)
    assert values.at(2) == (2.0, 3.0)


def test_only_the_values_said_to_be_angles_go_the_shorter_way_round():
    values = RecentValues((False, True))
    for time_ns, degrees in ((0, 359.0), (10, 5.0)):
        values.add(time_ns, degrees, degrees, degrees)
    assert values.at(5) == (182.0, 362.0, 182.0)
