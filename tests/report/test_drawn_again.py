"""Reports that are drawn again lose nothing of what they were, unless asked to."""

import re
import shutil
from pathlib import Path

import pytest

from scenematch.cli.app import run
from scenematch.runs.inputs import FlightFiles
from scenematch.runs.settings import TrackSettings
from scenematch.runs.tracking import track
from tests.support.commands import refusal
from tests.support.runs import bare_runs

pytestmark = pytest.mark.usefixtures("bare_runs")
PAGE = "report.html"


@pytest.fixture(scope="module")
def finished(flight_in, tmp_path_factory):
    """A flight of three frames, and a finished track of it."""
    folder = tmp_path_factory.mktemp("again")
    flight_in(folder / "flight", frames=3)
    with bare_runs():
        track(FlightFiles.in_folder(folder / "flight"), folder / "out", TrackSettings(method="ncc"))
    return folder


@pytest.fixture
def moved(finished, tmp_path):
    """A copy of the track whose frames are not where they were."""
    out = Path(shutil.copytree(finished / "out", tmp_path / "out"))
    frames = finished / "flight" / "frames"
    frames.rename(frames.with_name("moved"))
    yield out
    frames.with_name("moved").rename(frames)


def test_a_page_loses_frames_that_were_moved_only_where_it_may(moved, capsys):
    before = (moved / PAGE).read_text(encoding="utf-8")
    assert 'id="slider"' in before
    told = r"DIR.*: .*report\.html shows frames, which redrawing would lose; add --force to do it anyway; .*frames"
    assert re.match(told, refusal(capsys, ["evaluate", moved]))
    assert (moved / PAGE).read_text(encoding="utf-8") == before
    assert run(["evaluate", str(moved), "--force"]) == 0
    assert "report.html loses the frames that it shows: " in capsys.readouterr().err
    after = (moved / PAGE).read_text(encoding="utf-8")
    assert ('id="slider"' in after, "No frames are shown: " in after) == (False, True)
    assert run(["evaluate", str(moved)]) == 0  # there is nothing more to lose


def test_seconds_and_numbers_of_frames_are_not_drawn_over_one_axis(finished, tmp_path):
    other = Path(shutil.copytree(finished / "out", tmp_path / "other"))
    rows = (other / "track.csv").read_text(encoding="utf-8").splitlines()
    blank = [line if k == 0 else "," + line.partition(",")[2] for k, line in enumerate(rows)]
    (other / "track.csv").write_text("\n".join(blank) + "\n", encoding="utf-8")
    third, alike, mixed = shutil.copytree(other, tmp_path / "c"), tmp_path / "alike.html", tmp_path / "mixed.html"
    assert run(["evaluate", str(finished / "out"), str(third), f"--out={mixed}"]) == 0
    assert run(["evaluate", str(other), str(third), f"--out={alike}"]) == 0
    assert "Stated sigma (m)" in alike.read_text(encoding="utf-8")
    assert "Stated sigma (m)" not in mixed.read_text(encoding="utf-8")


def test_a_page_for_a_folder_that_is_not_there_is_refused_before_anything_is_drawn(
    finished, tmp_path, monkeypatch, capsys
):
    other = shutil.copytree(finished / "out", tmp_path / "other")
    monkeypatch.setattr("scenematch.runs.evaluation.draw_together", lambda *_, **__: pytest.fail("drawn"))
    page = tmp_path / "nofolder" / "x.html"
    line = refusal(capsys, ["evaluate", finished / "out", other, f"--out={page}"])
    assert line == f"--out: expected a file in a folder that exists, got {page}\n"
