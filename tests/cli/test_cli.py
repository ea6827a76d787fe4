"""The command line as a user meets it: results, exit codes, and one clear line for everything that is wrong."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from engine.errors import OptionError
from scenematch.cli import console
from scenematch.cli.app import run
from scenematch.runs import tracking as track_module
from tests.support.commands import FILES, answer, file_options, refusal

FRAMES = 6  # of `flight`
WRITTEN = {"track.csv", "summary.json", "notes.csv", "report.html"}
pytestmark = pytest.mark.usefixtures("bare_runs")  # but for `done`, which is drawn before it
SCRIPT = str(Path(sys.executable).with_name("scenematch"))
NARROW = os.environ | {"COLUMNS": "30", "TERM": "dumb"}


@pytest.fixture
def copy(flight, tmp_path):
    """The same, to be spoiled."""
    return Path(shutil.copytree(flight, tmp_path / "copy"))


@pytest.fixture(scope="module")
def done(flight, tmp_path_factory):
    """A finished NCC track of the flight."""
    out = tmp_path_factory.mktemp("done") / "out"
    assert run(track(flight, out)) == 0
    return out


def track(folder, out, *more, **replaced):
    return ["track", *file_options(folder, **replaced), "--method=ncc", f"--out={out}", *map(str, more)]


def refused(capsys, folder, out, code, *words, more=(), **replaced):
    """A track is refused in one line that has these words, and no output folder is made."""
    line = refusal(capsys, track(folder, out, *more, **replaced), code)
    for word in words:
        assert str(word) in line
    assert not out.exists()


def edit(path, old, new, count=1):
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, count), encoding="utf-8")


def cells(path):
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def set_cell(path, row, column, value):
    rows = cells(path)
    rows[row][column] = value
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


# ------------------------------------------------------------------------------------------------ what works


def test_track_writes_one_row_a_frame_and_every_file_and_what_it_was_made_of(done, flight):
    rows = cells(done / "track.csv")
    assert [row["frame"] for row in rows] == [f"{i:06d}.jpg" for i in range(FRAMES)]
    told = ("status", "reason", "method", "deadline_met")
    assert {tuple(row[name] for name in told) for row in rows} == {("fix", "", "ncc", "")}
    assert {file.name for file in done.iterdir()} == WRITTEN
    summary = json.loads((done / "summary.json").read_text(encoding="utf-8"))
    assert summary["frames"] == summary["fixes"] == summary["scored_fixes"] == FRAMES
    assert summary["status"] == {"fix": FRAMES, "no_fix": 0}
    assert summary["rms_m"] < 5
    assert set(summary["latency_ms"]) == {"p50", "p95", "p99", "max"}
    made_of = {"map": str(flight / "map.tif"), "truth": str(flight / "truth.csv"), "method": "ncc"}
    assert summary["settings"].items() >= (made_of | {"profile": "engine"}).items()


def test_track_prints_a_table_and_keeps_the_rest_from_standard_output(flight, tmp_path, capsys):
    assert run(track(flight, tmp_path / "out")) == 0
    printed = capsys.readouterr()
    assert re.search(r"^RMS error +\d+\.\d\d m$", printed.out, re.MULTILINE)
    assert "\x1b" not in printed.out + printed.err
    written, following = printed.err.splitlines()
    assert written == f"written to {tmp_path / 'out'}"
    assert following.startswith("next: ")


def test_json_is_all_there_is_on_standard_output(flight, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(track(flight, out, "--json", "--method=sift", "--budget-ms=3600000")) == 0
    printed = capsys.readouterr()
    summary = json.loads(printed.out)
    assert printed.err == ""
    assert summary == json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["height_rms_m"] < 5
    assert {row["deadline_met"] for row in cells(out / "track.csv")} == {"true"}


def test_a_truth_of_other_times_scores_nothing_and_replaces_no_scores(done, flight, tmp_path, capsys):
    folder = Path(shutil.copytree(done, tmp_path / "again"))
    late = Path(shutil.copy(flight / "truth.csv", tmp_path / "late.csv"))
    stamps = [int(row["timestamp_ns"]) for row in cells(late)]
    for row, stamp in enumerate(stamps):
        set_cell(late, row, "timestamp_ns", str(1_700_000_000_000_000_000 + stamp))
    when = f"{stamps[0] / 1e9:.1f} to {stamps[-1] / 1e9:.1f} s, got 2023-11-14T22:13:21Z to 2023-11-14T22:13:25Z"
    text = f"expected a truth at the times of the fixes, {when} in {late}"
    kept = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    assert refusal(capsys, ["evaluate", str(folder), f"--truth={late}"], code=1) == f"--truth: {text}\n"
    assert {path: path.read_bytes() for path in folder.iterdir() if path.is_file()} == kept
    assert run(track(flight, tmp_path / "out", f"--truth={late}")) == 0  # a run is kept all the same
    printed = capsys.readouterr()
    assert f"no fix is scored: {text}" in printed.err
    assert "false fixes" not in printed.out
    assert json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["scored_fixes"] == 0


def test_start_comes_before_the_telemetry(flight, tmp_path):
    truth, out = cells(flight / "truth.csv")[0], tmp_path / "out"
    # So far from the truth, and so sure of it, that nothing but the start itself can lead astray.
    lat = float(truth["lat_deg"]) + 0.002
    given = [f"--start={lat},{truth['lon_deg']},1", f"--settings=input.every={FRAMES}"]
    assert run(track(flight, out, *given)) == 0
    (row,) = cells(out / "track.csv")
    assert row["status"] == "no_fix" or abs(float(row["lat_deg"]) - lat) < 0.001


def test_a_flight_without_truth_is_tracked_and_not_scored(copy, tmp_path, capsys):
    (copy / "truth.csv").unlink()
    out = tmp_path / "out"
    assert run(track(copy, out, surface=None)) == 0
    assert "RMS" not in capsys.readouterr().out
    assert "rms_m" not in json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert run(["evaluate", str(out)]) == 0
    assert "RMS" not in capsys.readouterr().out


def test_a_budget_that_cannot_be_met_refuses_and_says_so(flight, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(track(flight, out, "--budget-ms=0.001")) == 0
    rows = cells(out / "track.csv")
    # The second frame knows no place to look at: its search of the whole map is not held to the budget.
    assert [row["reason"] for row in rows] == ["late", "", *["late"] * (len(rows) - 2)]
    assert "deadlines missed" in capsys.readouterr().out


def test_demo_prints_table_one_in_80_columns_and_keeps_every_run(tmp_path, capsys):
    out = tmp_path / "demo"
    assert run(["demo", "--frames=2", f"--out={out}"]) == 0
    printed, said = capsys.readouterr()
    assert Path(said.partition("next: open ")[2].partition(";")[0]).is_file()  # the report that it names
    assert max(map(len, printed.splitlines())) <= 80
    for row in ("NCC, as published", "NCC, paper's recipe", "SIFT, scenematch"):
        assert row in printed
    runs = {"ncc-paper", "ncc-engine", "sift-paper", "sift-engine"}
    assert set(json.loads((out / "table.json").read_text(encoding="utf-8"))) == runs
    assert runs < {path.name for path in out.iterdir()}


@pytest.mark.slow
def test_a_second_demo_is_shorter_and_leaves_nothing_of_the_first_beside_it(tmp_path, capsys):
    out = tmp_path / "demo"
    for frames in (4, 2):
        capsys.readouterr()
        assert run(["demo", f"--frames={frames}", f"--out={out}", "--force", "--json"]) == 0
    printed = capsys.readouterr()
    runs = {"ncc-paper", "ncc-engine", "sift-paper", "sift-engine"}
    assert {name: result["frames"] for name, result in json.loads(printed.out).items()} == dict.fromkeys(runs, 2)
    assert len(list((out / "flight" / "frames").iterdir())) == 2
    assert "left out" not in printed.err


def test_locate_finds_a_picture_without_a_prior(flight, capsys):
    image, truth = flight / "frames" / "000000.jpg", cells(flight / "truth.csv")[0]
    base = ["locate", str(image), f"--map={flight / 'map.tif'}", f"--camera={flight / 'camera.yaml'}"]
    fix = answer(capsys, base)
    assert fix["status"] == "fix"
    assert abs(fix["lat_deg"] - float(truth["lat_deg"])) < 1e-4
    assert np.shape(fix["covariance_m2"]) == (3, 3)
    assert run([*base, "--method=ncc"]) == 1
    printed = capsys.readouterr()
    assert "no_height" in printed.out
    assert printed.err == f"next: scenematch map info {flight / 'map.tif'}\n"


def test_a_map_that_lies_badly_makes_a_fix_doubtful_and_a_start_off_it_is_refused(flight, capsys):
    """The built-in map says that it is exact; input.map_sigma_m counts more, and adds up with the rest."""
    image, truth = flight / "frames" / "000000.jpg", cells(flight / "truth.csv")[0]
    base = ["locate", str(image), f"--map={flight / 'map.tif'}", f"--camera={flight / 'camera.yaml'}"]
    assert "--start" in refusal(capsys, [*base, "--start=10,10"])
    base += [f"--start={truth['lat_deg']},{truth['lon_deg']}"]
    given = ([*base, "--settings=input.map_sigma_m=3"], base)
    doubtful_m2, exact_m2 = (answer(capsys, each)["covariance_m2"] for each in given)
    np.testing.assert_allclose(np.diag(np.subtract(doubtful_m2, exact_m2)), 9.0, rtol=1e-4)


def test_map_info(flight, capsys):
    path = str(flight / "map.tif")
    assert run(["map", "info", path, f"--surface={flight / 'dsm.tif'}"]) == 0
    assert re.search(r"^gsd_m_per_px +0\.5\d+$", capsys.readouterr().out, re.MULTILINE)
    facts = answer(capsys, ["map", "info", path])
    assert (facts["width_px"], facts["height_px"]) == (900, 1000)


def test_doctor(capsys):
    assert run(["doctor"]) == 0
    assert "torch" in capsys.readouterr().out
    assert run(["doctor", "--json"]) == 0
    printed = capsys.readouterr()
    facts = json.loads(printed.out)
    assert printed.err == ""
    assert (facts["missing"], facts["numba"]) == ("nothing", metadata.version("numba"))


def test_doctor_asks_for_what_the_installation_states(monkeypatch, capsys):
    stated = [
        "numpy>=2.0", "no-such-package<2,>=1", 'pillow>=10; extra == "pictures"',
        'no-such-tool; platform_system == "Linux" and extra == "pictures"', 'pytest>=8.3; extra == "test"',
    ]  # fmt: skip
    monkeypatch.setattr(metadata, "requires", lambda _: stated)
    facts = answer(capsys, ["doctor"], 1)
    assert facts["missing"] == ["no-such-package"]
    expected = f"pillow {metadata.version('pillow')}, no-such-tool is not installed"
    assert [(name, value) for name, value in facts.items() if "extra" in name] == [("extra [pictures]", expected)]


def test_no_command_at_all_shows_help(capsys):
    assert run([]) == 2
    assert "Commands:" in capsys.readouterr().out


def test_version(capsys):
    assert run(["--version"]) == 0
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", capsys.readouterr().out)


# ---------------------------------------------------------------------------------------------- wrong usage


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fly"], ["'fly'", "--help"]),
        (["track", "--bogus"], ["--bogus", "scenematch track --help"]),
        (["map"], ["scenematch map --help"]),
        (["demo", "--seed=-1"], ["--seed"]),
        (["simulate", "--out=o", "--frames=0"], ["--frames"]),
        (["simulate", "--out=o", "--surface=dsm.tif"], ["--surface: expected with --map only"]),
    ],
)
def test_wrong_usage_is_told_with_the_help_that_there_is(arguments, words, capsys):
    line = refusal(capsys, arguments, 2)
    assert all(word in line for word in words)


def test_an_output_folder_is_not_overwritten(done, flight, tmp_path, capsys):
    before = (done / "track.csv").read_bytes()
    line = refusal(capsys, track(flight, done), 2)
    assert "--out" in line
    assert "--force" in line
    assert (done / "track.csv").read_bytes() == before
    file = tmp_path / "file"
    file.touch()
    assert str(file) in refusal(capsys, track(flight, file), 2)
    assert str(file) in refusal(capsys, track(flight, file / "deeper", "--force"), 2)


def test_force_replaces_results_and_touches_nothing_else(done, flight, tmp_path):
    out = Path(shutil.copytree(done, tmp_path / "out"))
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    for name in WRITTEN:
        (out / name).write_text("of another run", encoding="utf-8")
    assert run(track(flight, out, "--force")) == 0
    assert {file.name for file in out.iterdir()} == {"notes.txt"} | WRITTEN
    assert not [name for name in WRITTEN if "of another run" in (out / name).read_text(encoding="utf-8")]


# ---------------------------------------------------------------------------------------------- wrong input


@pytest.mark.parametrize("option", [*FILES, "truth"])
def test_an_input_that_is_missing_is_named(option, flight, tmp_path, capsys):
    refused(capsys, flight, tmp_path / "out", 1, "gone", **{option: "gone"})


def test_a_position_that_lies_off_the_map_is_named(copy, tmp_path, capsys):
    set_cell(copy / "telemetry.csv", 0, "lat_deg", "48.1")
    refused(capsys, copy, tmp_path / "out", 1, "telemetry.csv", "map.tif", "48.1")


@pytest.mark.parametrize("kind", ["truncated", "truncated png", "text", "other size"])
def test_broken_pictures_are_found_before_the_run(kind, copy, tmp_path, capsys):
    path = copy / "frames" / "000003.jpg"
    if kind == "other size":
        Image.new("RGB", (64, 48)).save(path)
    elif kind == "truncated png":
        with Image.open(path) as picture:
            picture.save(path, "PNG")
        path.write_bytes(path.read_bytes()[:-2000])
    else:
        path.write_bytes(path.read_bytes()[:-3000] if kind == "truncated" else b"not a picture")
    refused(capsys, copy, tmp_path / "out", 1, path)


def test_telemetry_without_what_the_method_needs(copy, tmp_path, capsys):
    edit(copy / "telemetry.csv", "heading_deg", "course")
    refused(capsys, copy, tmp_path / "out", 1, "heading_deg", "sift")
    edit(copy / "telemetry.csv", "height_agl_m", "height")
    refused(capsys, copy, tmp_path / "out", 1, "height_agl_m", more=["--method=sift", "--profile=paper"])


def test_evaluate_of_what_is_no_finished_track(done, tmp_path, capsys):
    assert str(tmp_path) in refusal(capsys, ["evaluate", tmp_path], 1)
    folder = Path(shutil.copytree(done, tmp_path / "again"))
    for content in ("", "5", "[]", '{"settings": []}', '{"settings": {"map": 1', "[" * 100_000):
        (folder / "summary.json").write_text(content, encoding="utf-8")
        assert "summary.json" in refusal(capsys, ["evaluate", folder], 1)
    (folder / "summary.json").unlink()
    assert "summary.json" in refusal(capsys, ["evaluate", folder], 1)
    edit(folder / "track.csv", "fix", "perhaps")
    assert "track.csv" in refusal(capsys, ["evaluate", folder], 1)


def test_an_output_folder_that_cannot_be_made(flight, tmp_path, capsys, monkeypatch):
    def deny(self, *args, **kwargs):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", deny)
    assert f"{tmp_path / 'out'}: Permission denied" in refusal(capsys, track(flight, tmp_path / "out"), 1)


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (OptionError("sigma_m: expected 0 m or more, got nan"), 1, ["000002.jpg", "sigma_m"]),
        (KeyboardInterrupt(), 130, ["interrupted"]),
    ],
    ids=["error", "Ctrl-C"],
)
def test_a_run_that_ends_in_the_middle_keeps_its_rows(error, code, words, flight, tmp_path, capsys, monkeypatch):
    update, third = track_module.Navigator.update, int(cells(flight / "telemetry.csv")[2]["timestamp_ns"])

    def failing(self, frame, prior=None):
        if frame.timestamp_ns == third:
            raise error
        return update(self, frame, prior)

    monkeypatch.setattr(track_module.Navigator, "update", failing)
    out = tmp_path / "out"
    line = refusal(capsys, track(flight, out), code)
    assert all(word in line for word in words)
    assert len(cells(out / "track.csv")) == 2
    assert not (out / "summary.json").exists()
    assert "summary.json" in refusal(capsys, ["evaluate", out], 1)


def test_the_learned_method_says_that_it_needs_weights(flight, tmp_path, capsys):
    words = "--settings learned.weights: expected the files of LoFTR"
    refused(capsys, flight, tmp_path / "out", 2, words, more=["--method=learned"])


@pytest.mark.slow
def test_the_console_script_in_a_narrow_pipe_leaves_one_line_and_no_words_of_a_decoder(flight, tmp_path):
    (tmp_path / "flight.mp4").write_bytes(b"no video at all")
    command = [SCRIPT, *track(flight, tmp_path / "out", frames=tmp_path / "flight.mp4")]
    done = subprocess.run(command, env=NARROW, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done.stderr
    assert str(tmp_path / "flight.mp4") in done.stderr


def test_counts_of_a_result_are_words_for_people(capsys):
    """As a bridge's, of what it did not send."""
    console.facts({"withheld": {"no height": 1, "late": 16}, "refused": {}}, "bridge")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[-1].strip() for line in lines[1:]] == ["no height 1, late 16", "none"]
