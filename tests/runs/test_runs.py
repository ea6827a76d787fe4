"""Runs as a library: a flight tracked in three lines of Python, what it reports, and errors by argument."""

import sys
from dataclasses import replace

import pytest

import scenematch
from bench.inputs.log_files import ulog_flight
from engine import BackendError, MissingExtraError, TelemetryError
from scenematch import FlightFiles, Progress, TrackSettings, track
from scenematch.bridges.links import parse_connection
from scenematch.check import Diagnosis, Finding
from scenematch.check.findings import Contradiction
from scenematch.files.corrections import Corrections
from scenematch.files.logs.ulog import read_ulog
from scenematch.files.ros.bags import import_rosbags
from scenematch.files.track import read_track
from scenematch.files.truth import read_truth
from scenematch.runs.inputs import FOLDER_LAYOUT
from tests.support.dark_flight import dark_flight
from tests.support.interpreters import done_by
from tests.support.refusals import misuse

FRAMES = 3
pytestmark = pytest.mark.usefixtures("bare_runs")


class Recorded(Progress):
    """Keeps what it is shown."""

    def __init__(self):
        self.messages, self.updates, self.finished = [], {}, []

    def message(self, text):
        self.messages.append(text)

    def update(self, description, done, total):
        self.updates.setdefault(description, []).append((done, total))

    def finish(self, description):
        self.finished.append(description)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A flight folder, to be read and not written."""
    folder = tmp_path_factory.mktemp("runs") / "flight"
    assert scenematch.simulate(str(folder), scenematch.WorldSettings(), frames=FRAMES)["frames"] == FRAMES
    return folder


def test_a_flight_is_tracked_in_three_lines_and_nothing_is_printed(flight, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    summary = track(FlightFiles.in_folder(str(flight)), "out", TrackSettings(method="sift"))
    assert (summary["frames"], summary["fixes"]) == (FRAMES, FRAMES)
    assert summary["rms_m"] < 2.0
    assert {"track.csv", "summary.json", "report.html"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert capfd.readouterr() == ("", "")


def test_one_frame_in_two_is_tracked_and_scored_again(flight, tmp_path):
    progress, names = Recorded(), ["000000.jpg", "000002.jpg"]
    paths = {name: flight / file for name, file in FOLDER_LAYOUT.items()}
    track(FlightFiles.from_flat(**paths, every=2), tmp_path / "out", progress=progress)
    assert [row.frame for row in read_track(tmp_path / "out" / "track.csv")] == names
    assert progress.messages == ["using one frame in 2, 2 in all"]
    page = (tmp_path / "out" / "report.html").read_bytes()
    summary = scenematch.evaluate(tmp_path / "out")
    assert (summary["settings"]["every"], summary["frames_without_truth"]) == (2, 0)
    assert (tmp_path / "out" / "report.html").read_bytes() == page  # with the pictures of the same frames


def test_progress_is_shown_what_a_run_does(flight, tmp_path):
    progress = Recorded()
    files = FlightFiles.in_folder(flight)
    (flight / "frames" / "spare.jpg").write_bytes((flight / "frames" / "000000.jpg").read_bytes())
    track(files, tmp_path / "out", report=False, progress=progress)
    (flight / "frames" / "spare.jpg").unlink()
    counted = [(done, FRAMES) for done in range(FRAMES + 1)]
    assert progress.updates["auto, engine profile"] == counted
    assert progress.updates["checking pictures"] == counted
    assert progress.finished[-1] == "auto, engine profile"
    assert progress.messages == ["frames left out because the telemetry has no row: 1"]


def test_a_task_that_is_interrupted_is_finished():
    progress = Recorded()
    for item in progress.track("abc", 3, "letters"):
        if item == "b":
            break
    assert (progress.updates, progress.finished) == ({"letters": [(0, 3), (1, 3)]}, ["letters"])


def test_a_folder_gives_what_it_has(flight, tmp_path):
    files = FlightFiles.in_folder(flight)
    assert (files.map.surface, files.truth) == (flight / "dsm.tif", flight / "truth.csv")
    bare = FlightFiles.in_folder(tmp_path)
    assert (bare.map.surface, bare.telemetry, bare.truth) == (None, None, None)
    assert bare.map.map == tmp_path / "map.tif"


def test_errors_name_arguments(flight, tmp_path):
    files = FlightFiles.in_folder(flight)
    assert misuse(TrackSettings, budget_ms=-1.0) == "budget_ms: expected milliseconds above 0, got -1"
    exists = "exists; choose another folder, or add `force` to replace its results"
    assert misuse(track, files, flight) == f"out: {flight} {exists}"
    off_it = misuse(track, files, tmp_path / "out", TrackSettings(start="0,0"))
    assert off_it.startswith("start: expected a place on the map")
    assert "swapped" not in off_it
    place = next(iter(read_truth(flight / "truth.csv")))
    swapped = TrackSettings(start=f"{place.lon_deg},{place.lat_deg}")
    assert misuse(track, files, tmp_path / "out", swapped).endswith("; are latitude and longitude swapped?")
    assert misuse(scenematch.export_track, tmp_path, "shp").startswith("kind: expected one of gpx")
    assert not (tmp_path / "out").exists()


def test_what_is_no_picture_is_not_located(flight, tmp_path):
    for file, said in ((tmp_path / "a.jpg", "no such file"), (flight, "one picture")):
        with pytest.raises(TelemetryError, match=f"expected .*{said}"):
            scenematch.locate_image(file, flight / "map.tif", camera=flight / "camera.yaml")


@pytest.mark.slow
def test_the_library_imports_nothing_optional_and_no_command_line():
    loaded = "print(*[n for n in sys.modules if n.partition('.')[0] in wanted or 'scenematch.cli' in n])"
    script = (
        "import sys; from scenematch import *; wanted = "
        "{'rerun', 'pymavlink', 'serial', 'rospy', 'rclpy', 'rosbags', 'pyulog', 'rich', 'typer'}; "
    )
    assert done_by(script + loaded).stdout.strip() == ""


# ------------------------------------------------------------------------------------- extras that are missing


def bridge(_):
    from scenematch import BridgeFiles, BridgeSettings, CameraInput, MapInput, MavlinkSettings, run_mavlink_bridge

    files = BridgeFiles(map=MapInput("m.tif"), camera=CameraInput("c.yaml"), frames="f")
    run_mavlink_bridge(files, MavlinkSettings(connect="udpout:127.0.0.1:1"), BridgeSettings())


@pytest.mark.parametrize(
    ("module", "package", "extra", "use"),
    [
        ("pymavlink", "pymavlink", "mavlink", bridge),
        ("pymavlink", "pymavlink", "mavlink", lambda _: scenematch.write_parameter_file("px4", "", "out.params")),
        ("serial", "pyserial", "mavlink", lambda _: parse_connection("serial:/dev/null:57600").open()),
        ("rosbags", "rosbags", "bags", lambda _: import_rosbags()),
        ("rosbags.highlevel", "rosbags", "bags", lambda _: import_rosbags()),
        ("pyulog", "pyulog", "logs", lambda path: read_ulog(ulog_flight(path / "a.ulg"))),
    ],
)
def test_a_missing_extra_is_always_the_same_error(module, package, extra, use, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError) as caught:
        use(tmp_path)
    assert isinstance(caught.value, BackendError)
    cure = f"pip install 'scenematch-engine[{extra}]'"
    assert str(caught.value) == f"expected {package} to be installed, got none: {cure}"


@pytest.mark.parametrize("is_wrong", [True, False])
def test_a_run_with_refused_frames_ends_with_what_does_not_fit(flight_in, tmp_path, monkeypatch, is_wrong):
    """One frame of six is refused; where all inputs fit, nothing is said of them."""
    findings = [Finding("radians", "the heading is in radians", "--correct angles=radians")] if is_wrong else []
    found = Diagnosis(findings, 16, 16, ("attitude",), (Contradiction("heading", 6 * is_wrong, 16),))
    monkeypatch.setattr("scenematch.runs.tracking.diagnose_flight", lambda *_, **__: found)
    files = dark_flight(flight_in, tmp_path / "flight")
    summary = track(files, tmp_path / "out", TrackSettings(method="ncc"), report=False)
    assert summary["fixes"] == summary["frames"] - 1
    said = summary["settings"]["diagnosis"]
    assert (said is not None) == is_wrong
    if said:
        assert said["radians"] == "the heading is in radians; try --correct angles=radians"
        assert said["pictures"].endswith("; 6 of 16 (38%) contradict the heading")


@pytest.mark.parametrize("off_deg", [0.0, 60.0])
def test_a_heading_that_the_pictures_contradict_is_looked_into_though_all_frames_are_fixed(
    flight_in, tmp_path, monkeypatch, off_deg
):
    finding = Finding("heading", "the heading reads 60 degrees too high", "--correct heading_offset_deg=-60")
    found = Diagnosis([finding], 6, 6, ("attitude",), (Contradiction("heading", 6, 6),))
    monkeypatch.setattr("scenematch.runs.tracking.diagnose_flight", lambda *_, **__: found)
    files = flight_in(tmp_path / "flight", frames=6)
    corrections = Corrections(heading_offset_deg=off_deg)
    settings, files = TrackSettings(method="sift"), replace(files, corrections=corrections)
    summary = track(files, tmp_path / "out", settings, report=False)
    assert summary["fixes"] == summary["frames"]
    assert (summary["settings"]["diagnosis"] is not None) == (off_deg > 0.0)
