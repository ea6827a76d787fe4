"""The live view: what a recording holds, that it changes no result, and how it looks in a real browser."""

import socket
import sys
import threading
from collections import defaultdict
from functools import cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from engine import Answer, Frame, Navigator, NavigatorState, NoFix, Prior, Reason, SceneMatcher
from scenematch import TrackSettings, track
from scenematch.bridges.ros import RosBridge
from scenematch.bridges.ros_out import RosOptions
from scenematch.cli.app import run
from scenematch.files.track import read_track
from scenematch.runs.live_viewing import NO_LIVE_VIEW, LiveViewTarget
from tests.support.runs import bare_runs

pytest.importorskip("rerun", reason="rerun-sdk is not installed")
from pyarrow import duration, timestamp
from rerun.chunk import RrdReader

from scenematch.report import live_view
from scenematch.report.live_view import FIX_RGB, SIGMAS, ellipsoid
from tests.support import browser
from tests.support.commands import refusal
from tests.support.dark_flight import DARK, FRAMES, dark_flight
from tests.support.ros import StandInNode, maker_of
from tests.support.waiting import wait_until


def rows_of(recording):
    """Every row that was logged on the frames' timeline: entity, frame, then its columns by name."""
    rows = defaultdict(dict)
    for chunk in RrdReader(recording).stream():
        batch = chunk.to_record_batch()
        table = {name: plain(batch.column(name)) for name in batch.schema.names}
        for k, frame in enumerate(table.get("frame", [])):
            row = {name: values[k] for name, values in table.items() if values[k] is not None}
            rows[chunk.entity_path.lstrip("/")].setdefault(frame, []).append(row)
    return rows


def plain(column):
    """Its values; moments and durations in nanoseconds."""
    return (column.cast("int64") if column.type in (timestamp("ns"), duration("ns")) else column).to_pylist()


def has_content(row):
    return not any(name.startswith("Clear") for name in row)


@pytest.fixture(scope="module")
def flown(flight_in, tmp_path_factory):
    """A flight with a black frame, and what tracks it by a method and says where the results are."""
    folder = tmp_path_factory.mktemp("live")
    files = dark_flight(flight_in, folder / "flight")

    @cache
    def tracked(method, name):
        target = LiveViewTarget(folder / f"{method}.rrd") if name == "on" else NO_LIVE_VIEW
        out = folder / f"{method}-{name}"
        with bare_runs():
            track(files, out, TrackSettings(device="cpu", method=method), report=False, live_view=target)
        return folder

    return tracked


@pytest.fixture(scope="module")
def runs(flown):
    """The flight tracked by NCC, with a recording."""
    return flown("ncc", "on")


# ------------------------------------------------------------------------------------------- the recording


@pytest.mark.parametrize("method", ["ncc", pytest.param("sift", marks=pytest.mark.slow)])
def test_it_changes_no_result(flown, method):
    tables = []
    for name in ("off", "on"):
        runs = flown(method, name)
        lines = (runs / f"{method}-{name}" / "track.csv").read_text(encoding="utf-8").splitlines()
        latency = lines[0].split(",").index("latency_ms")
        tables.append([[c for k, c in enumerate(line.split(",")) if k != latency] for line in lines])
    assert tables[0] == tables[1]
    notes = [(runs / f"{method}-{name}" / "notes.csv").read_bytes() for name in ("off", "on")]
    assert notes[0] == notes[1]


def test_each_frame_is_there_once_with_its_stamp(runs):
    rows = rows_of(runs / "ncc.rrd")
    for entity in ("frame", "state", "plots/latency_ms", "log"):
        assert sorted(rows[entity]) == list(range(FRAMES)), entity
        assert all(len(at) == 1 for at in rows[entity].values()), entity
    for frame, row in enumerate(read_track(runs / "ncc-on" / "track.csv")):
        assert rows["frame"][frame][0]["capture"] == row.timestamp_ns


def test_a_fixed_frame_has_all_that_is_promised_and_a_refused_one_does_not_show_the_last(runs):
    track = read_track(runs / "ncc-on" / "track.csv")
    rows = rows_of(runs / "ncc.rrd")
    assert [row.fixed for row in track] == [frame != DARK for frame in range(FRAMES)]
    for frame, row in enumerate(track):
        for entity in ("world/fixes", "plots/sigma_m"):
            assert (frame in rows[entity]) == row.fixed, entity
        for logged in rows["world/fixes"].get(frame, []):
            (place,) = logged["Points3D:positions"]
            assert place == pytest.approx([row.east_m, row.north_m, row.up_m], abs=1e-3)
        for entity in (*live_view.PICTURES, *live_view.PLACES):
            (logged,) = rows[entity][frame]
            assert has_content(logged) == (row.fixed and entity != "matches"), (entity, frame)
    assert "refused, no_texture" in rows["log"][DARK][0]["TextLog:text"][0]
    assert rows["state"][DARK][0]["StateChange:state"] == ["coasting"]


@pytest.mark.slow
def test_sift_shows_its_matches(flown):
    rows = rows_of(flown("sift", "on") / "sift.rrd")
    fixed = [frame for frame in range(FRAMES) if frame != DARK]
    assert all(has_content(rows["matches"][frame][0]) for frame in fixed)
    assert not any(has_content(rows["surface"][frame][0]) for frame in fixed)


def test_the_frame_is_the_picture_that_was_taken(runs):
    (row,) = rows_of(runs / "ncc.rrd")["frame"][0]
    (blob,) = row["EncodedImage:blob"]
    shown = cv2.imdecode(np.frombuffer(bytes(blob), np.uint8), cv2.IMREAD_COLOR)
    taken = cv2.imread(str(runs / "flight" / "frames" / "000000.jpg"))
    assert shown.shape == taken.shape
    off, off_swapped = (np.abs(shown.astype(int) - other).mean() for other in (taken, taken[:, :, ::-1]))
    assert off < min(8.0, 0.7 * off_swapped)  # compressed once more, and its colours are its own


@pytest.mark.parametrize("seed", range(4))
def test_the_ellipsoid_is_the_covariance(seed):
    root = np.random.default_rng(seed).standard_normal((3, 3))
    covariance = root @ root.T
    shape = ellipsoid(np.zeros(3), covariance)
    (about,) = shape.rotation_axis_angles.as_arrow_array().to_pylist()
    turn = cv2.Rodrigues(np.asarray(about["axis"], np.float64) * about["angle"])[0]
    half = np.asarray(shape.half_sizes.as_arrow_array().to_pylist()[0], np.float64) / SIGMAS
    assert turn @ np.diag(half**2) @ turn.T == pytest.approx(covariance, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(
    ("stamp_ns", "kind"), [(None, None), (1_790_000_000_123_456_789, "timestamp"), (5_000_000_001, "duration")]
)
def test_stamps_of_the_epoch_are_dates_others_a_clock_and_none_is_none(stamp_ns, kind, matcher, tmp_path):
    image = np.zeros((300, 300), np.uint8)
    view = live_view.open_live_view(matcher, tmp_path / "a.rrd", None)
    refused = matcher.locate(Frame(image), Prior(east_m=0.0, north_m=0.0, sigma_m=1.0))
    view.show(0, "0", Frame(image, stamp_ns), refused, None, 1.0)
    view.close()
    (chunk,) = [c for c in RrdReader(tmp_path / "a.rrd").stream() if c.entity_path == "/frame"]
    batch = chunk.to_record_batch()
    assert ("capture" in batch.schema.names) == (kind is not None)
    if kind is not None:
        assert str(batch.column("capture").type).startswith(kind)
        assert batch.column("capture").cast("int64").to_pylist() == [stamp_ns]


@pytest.fixture(scope="module")
def matcher(sim_site, sim_flight):
    return SceneMatcher(sim_site, sim_flight.camera, device="cpu")


# --------------------------------------------------------------------------------------- loop and bridges


@pytest.mark.slow
@pytest.mark.usefixtures("bare_runs")
def test_the_closed_loop_is_recorded_frame_by_frame(tmp_path, capsys):
    recording, out = tmp_path / "loop.rrd", tmp_path / "out"
    command = ["simulate", "--closed-loop", "--minutes", "0.1", "--method", "ncc"]
    assert run([*command, "--out", str(out), "--rerun", str(recording)]) == 0
    track, rows = read_track(out / "track.csv"), rows_of(recording)
    assert sorted(rows["frame"]) == list(range(len(track)))
    assert [rows["frame"][k][0]["capture"] for k in range(len(track))] == [row.timestamp_ns for row in track]
    assert sorted(rows["world/fixes"]) == [k for k, row in enumerate(track) if row.fixed]


class SlowView:
    """A view that takes its time, and once fails."""

    def __init__(self):
        self.shown, self.go, self.closed = [], threading.Event(), False

    def show(self, index, name, frame, result, state, latency_ms):
        self.shown.append((index, state))
        if index == 0:
            self.go.wait(60.0)
            raise RuntimeError("the viewer is gone")

    def close(self):
        self.closed = True


def test_a_bridge_never_waits_for_the_view_and_the_newest_is_shown(matcher, caplog):
    view = SlowView()
    watcher = live_view.Watcher(view)
    navigator = Navigator(matcher)
    assert watcher.follow(navigator) is navigator
    answer = Answer(Frame(np.zeros((300, 300), np.uint8), 1), None, 1.0)
    watcher(answer)
    wait_until(lambda: view.shown)
    for _ in range(5):  # nobody takes them
        watcher(answer)
    view.go.set()
    watcher.close()
    assert view.shown == [(0, NavigatorState.SEARCHING), (5, NavigatorState.SEARCHING)]
    assert view.closed
    assert "the live view failed at frame 0" in caplog.text


@pytest.mark.parametrize("bridge", ["mavlink", "ros"])
def test_the_bridges_tell_the_watcher_every_answer(bridge, sim_site):
    stated = []
    answer = Answer(Frame(np.zeros((3, 3), np.uint8), 1), NoFix(reason=Reason.NO_TEXTURE), 1.0)
    quiet = lambda prior: SimpleNamespace(options=None)  # noqa: E731
    if bridge == "mavlink":
        mavlink = pytest.importorskip("scenematch.bridges.mavlink", reason="pymavlink is not installed")
        from scenematch.bridges.links import Connection
        from scenematch.bridges.parameters import MavlinkOptions

        link, options = Connection("udpin", "127.0.0.1", 0), MavlinkOptions()
        made = mavlink.MavlinkBridge(link, quiet, options, watch=lambda answer, _: stated.append(answer))
    else:
        made = RosBridge(StandInNode(maker_of("ros2")), sim_site, quiet, RosOptions(), watch=stated.append)
    made.deliver(answer)
    made.close()
    assert stated == [answer]


# -------------------------------------------------------------------------------------------- what is refused


def test_what_cannot_be_watched_is_refused_in_one_line_before_any_work(tmp_path, capsys, monkeypatch):
    def refused(view, code=2):
        command = ["track", "--map", "m.tif", "--camera", "c.yaml", "--frames", "f", "--out", "no-such-folder"]
        return refusal(capsys, [*command, "--rerun", view], code)

    there = tmp_path / "there.rrd"
    there.touch()
    assert refused(there) == f"--rerun: {there} exists; choose another file\n"
    assert refused("view.rec") == "--rerun: expected a file that ends in .rrd, got view.rec\n"
    for address in ("here:port", ":9876", "here:70000"):
        assert refused(address) == f"--rerun: expected HOST:PORT, got {address!r}\n"
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        line = refused(f"127.0.0.1:{taken.getsockname()[1]}", code=1)
    assert "no viewer listens" in line
    assert "rerun --bind 127.0.0.1" in line
    monkeypatch.setitem(sys.modules, "rerun", None)
    missing = "expected rerun-sdk to be installed, got none: pip install 'scenematch-engine[live]'\n"
    assert refused("view.rrd", code=1) == missing


# ---------------------------------------------------------------------------------------------- the viewer


@pytest.mark.slow
@pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all is there")
def test_the_viewer_draws_it_without_a_complaint(runs, tmp_path):
    picture = tmp_path / "view.png"
    with browser.serve_recording(runs / "ncc.rrd") as address, browser.open_browser(browser.WITH_GL) as page:
        page.open(address, 1200, 800)
        page.wait_until_still()
        page.save(picture)
        complaints = [line for line in page.complaints() if '"ERROR ' in line]
    assert not complaints
    shown = cv2.cvtColor(cv2.imread(str(picture)), cv2.COLOR_BGR2RGB).astype(int)
    world, pictures = shown[:400, :720], shown[:440, 720:]
    one_dot_px = np.pi * 3.0**2
    assert (np.abs(world - FIX_RGB).max(axis=2) < 40).sum() > 0.9 * one_dot_px  # the fixes above the map
    assert (np.ptp(world, axis=2) < 10).mean() > 0.5  # a grey map
    assert (np.ptp(pictures, axis=2) > 40).mean() > 0.02  # a frame and a surface in colour
