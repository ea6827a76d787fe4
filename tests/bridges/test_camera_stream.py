"""A live camera: it is opened again where it ends or stalls, and a picture that repeats is none."""

import shlex
import sys
import time

import numpy as np
import pytest

from scenematch.bridges.camera_stream import CameraStream, capture
from tests.support.refusals import refusal
from tests.support.videos import write_video

WRITER = """
import sys, time, cv2, numpy as np
begin, count, period_s, repeats, wait_s = int(sys.argv[1]), *map(float, sys.argv[2:])
for k in range(int(count)):
    image = np.full((32, 48, 3), (begin + k // int(repeats)) * 7 % 250, np.uint8)
    sys.stdout.buffer.write(cv2.imencode(".jpg", image)[1].tobytes())
    sys.stdout.buffer.flush()
    time.sleep(period_s)
time.sleep(wait_s)
"""


@pytest.fixture
def command(save):
    """A command that writes pictures: how many, every so many seconds, each so often, and how it ends."""
    script = save(WRITER, "writer.py")

    def make(count=5, period_s=0.05, repeats=1, wait_s=0.0):
        words = [sys.executable, str(script), "1", *map(str, (count, period_s, repeats, wait_s))]
        return "exec:" + shlex.join(words)

    return make


def taken(source, until, timeout_s=120.0, **options):
    """What is captured until something holds of it."""
    pictures, end = [], time.monotonic() + timeout_s
    for picture in capture(source, **options):
        pictures.append(picture)
        assert time.monotonic() < end
        if until(pictures):
            return pictures
    return pictures


def count(pictures):
    return sum(picture is not None for picture in pictures)


def test_a_command_is_a_camera(command):
    before_ns = time.monotonic_ns()
    found = [p for p in taken(command(), lambda pictures: count(pictures) >= 3, exposure_to_grab_ms=30.0) if p]
    assert all(image.shape == (32, 48, 3) and image.dtype == np.uint8 for image, _ in found)
    stamps = [stamp for _, stamp in found]
    assert stamps == sorted(stamps)
    assert before_ns - 30_000_000 < stamps[0] < time.monotonic_ns() - 30_000_000


def test_a_stream_that_ends_is_opened_again(command):
    pictures = taken(command(count=4), lambda found: count(found) >= 8)
    assert None in pictures  # the caller went on while there were none


def test_a_stream_that_stalls_is_opened_again(command, monkeypatch):
    monkeypatch.setattr("scenematch.bridges.camera_stream._STALL_S", 0.3)
    taken(command(count=4, wait_s=60.0), lambda found: count(found) >= 5)


def test_a_camera_that_starts_slowly_is_waited_for(command, monkeypatch, caplog):
    """An interpreter that imports OpenCV takes longer to its first picture than a camera in use may be silent."""
    monkeypatch.setattr("scenematch.bridges.camera_stream._STALL_S", 0.05)
    assert count(taken(command(count=1, wait_s=60.0), lambda pictures: count(pictures) == 1)) == 1
    assert "reopened" not in caplog.text


def test_a_camera_that_never_starts_is_opened_again(command, monkeypatch, caplog):
    monkeypatch.setattr("scenematch.bridges.camera_stream._START_S", 0.2)
    taken(command(count=0, wait_s=60.0), lambda _: "no picture for 0.2 s; reopened" in caplog.text)


def test_a_picture_that_repeats_is_none(command):
    stream = CameraStream(command(count=12, repeats=6, wait_s=120.0))
    found = [stream.next(60.0) for _ in range(2)]
    assert all(found)
    assert stream.next(0.6) is None
    assert stream.failure is None  # it hangs, and opening it again would not help
    stream.close()


def test_a_video_is_read_and_begins_again(tmp_path):
    path = str(tmp_path / "flight.avi")
    write_video(path, [40 * k for k in range(5)], rate_hz=10.0)
    assert count(taken(path, lambda found: count(found) >= 2)) == 2


@pytest.mark.parametrize("source", ["exec:", "exec:no-such-program", "exec:'"])
def test_a_command_that_cannot_be_run_is_told(source):
    assert refusal(next, capture(source)).startswith("camera_source: ")
