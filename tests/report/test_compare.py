"""compare: several runs over one flight, in one table and one chart."""

import json
from dataclasses import replace

import pytest

from scenematch import FlightFiles, TrackSettings, parse_runs, track
from scenematch.cli.app import run
from scenematch.files.track import read_track
from tests.support.commands import answer, file_options, refusal
from tests.support.refusals import misuse


def command(flight, out, *more):
    return ["compare", *file_options(flight), f"--out={out}", *more]


@pytest.mark.slow
@pytest.mark.usefixtures("bare_runs")
def test_each_run_is_what_track_makes_of_it(flight, tmp_path, capsys):
    (tmp_path / "few.toml").write_text('method = "sift"\n[sift]\nmax_keypoints = 120\n', encoding="utf-8")
    out, runs = tmp_path / "out", ["--run=ncc", "--run=sift/paper", f"--run={tmp_path / 'few.toml'}"]
    assert run(command(flight, out, *runs)) == 0
    printed = capsys.readouterr().out
    table = json.loads((out / "table.json").read_text(encoding="utf-8"))
    assert list(table) == ["ncc", "sift-paper", "few"]
    assert table["few"]["settings"]["changed"] == {"method": "sift", "sift.max_keypoints": 120}
    for name, summary in table.items():
        assert name in printed
        assert summary == json.loads((out / name / "summary.json").read_text(encoding="utf-8"))
        assert len(read_track(out / name / "track.csv")) == summary["frames"] == 6
    assert f"{table['ncc']['rms_m']:.2f}" in printed
    track(FlightFiles.in_folder(flight), tmp_path / "alone", TrackSettings(method="ncc"), report=False)
    alone, beside = (read_track(path / "track.csv") for path in (tmp_path / "alone", out / "ncc"))
    assert [replace(row, latency_ms=None) for row in alone] == [replace(row, latency_ms=None) for row in beside]
    page = (out / "comparison.html").read_text(encoding="utf-8")
    assert all(f"Share of all frames by {what}" in page for what in ("error", "latency"))

    assert "--force" in refusal(capsys, command(flight, out, "--run=ncc"))
    assert list(answer(capsys, command(flight, out, "--run=sift", "--force"))) == ["sift"]


def test_nothing_is_flown_or_made_before_every_run_is_found_possible(flight, tmp_path, save, capsys):
    """The last run is refused: by what the telemetry lacks, by a place, by a file in its folder's place."""
    text = (flight / "telemetry.csv").read_text(encoding="utf-8").replace("heading_deg", "course_deg")
    blind, far = save(text, "blind.csv"), save('method = "sift"\nstart = "0,0"\n', "far.toml")
    out, two = tmp_path / "out", ["--run=sift", "--run=ncc"]
    line = refusal(capsys, [*command(flight, out, *two), f"--telemetry={blind}"], 1)
    assert "telemetry: ncc needs height_agl_m and heading_deg" in line
    head, *rows = text.splitlines()
    # A heading for the last frame alone.
    blind.write_text("\n".join([f"{head},heading_deg", *(f"{row}," for row in rows)]) + "10\n", encoding="utf-8")
    assert run([*command(flight, out, *two, f"--run={far}"), f"--telemetry={blind}"]) == 2
    said = capsys.readouterr().err
    assert "5 of 6 frames lack heading_deg, so ncc will refuse them; sift and auto do not need it" in said
    assert "no such file" in refusal(capsys, [*command(flight, out, *two), f"--camera={flight / 'none.yaml'}"], 1)
    line = refusal(capsys, command(flight, out, "--run=ncc", f"--run={far}"))
    assert line.startswith("--start: expected a place on the map")
    assert not out.exists()
    out.mkdir()
    (out / "sift").write_text("mine", encoding="utf-8")
    assert "sift is a file" in refusal(capsys, command(flight, out, "--run=ncc", "--run=sift", "--force"))
    assert [path.name for path in out.iterdir()] == ["sift"]


def test_when_the_frames_of_a_log_were_taken_is_said_as_to_track(flight, tmp_path, monkeypatch):
    compared = []
    monkeypatch.setattr("scenematch.runs.comparison.compare", lambda files, *_, **__: compared.append(files) or {})
    monkeypatch.setattr("scenematch.cli.tables.print_comparison", lambda *_: None)
    log, stamps = tmp_path / "flight.ulg", tmp_path / "stamps.csv"
    settings = {"frame_stamps": stamps, "log_offset_s": -1.5, "image_topic": "/down"}
    options = [f"--frames={tmp_path / 'flight.bag'}", f"--telemetry={log}"]
    options += [f"--settings=input.{name}={value}" for name, value in settings.items()]
    assert run(command(flight, tmp_path, *options)) == 0
    assert (compared[0].frame_stamps, compared[0].log_offset_s, compared[0].image_topic) == (stamps, -1.5, "/down")
    assert run(command(flight, tmp_path)) == 0
    assert (compared[1].frame_stamps, compared[1].log_offset_s, compared[1].image_topic) == (None, 0.0, None)
    assert run(command(flight, tmp_path, "--settings=input.log_offset_s=2")) == 2  # telemetry.csv is no log


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        (["orb"],
         "runs: expected ncc, sift, auto, learned, one of them with /paper, or a settings file, got 'orb'"),
        (["ncc", "ncc"], "runs: expected runs of different names, got 'ncc' twice"),
        (["ncc/fast"], "profile: expected one of engine, paper, got 'fast'"),
        (["auto/paper"], "method: expected ncc or sift with `profile` paper, got 'auto'"),
    ],
)  # fmt: skip
def test_a_run_that_cannot_be_is_refused(runs, message):
    assert misuse(parse_runs, runs) == message


def test_what_the_command_line_gives_holds_for_every_run(save):
    runs = parse_runs(["ncc", str(save("budget_ms = 40\n", "mine.toml"))], budget_ms=121.0, start=None)
    assert [settings.budget_ms for settings in runs.values()] == [121.0, 121.0]
