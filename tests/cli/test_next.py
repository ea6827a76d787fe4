"""Every command ends with what to do next: one command that exists, for people only."""

import inspect
import json
import re
import shlex

import pytest

from scenematch.cli import console
from scenematch.cli.app import run
from tests.support.commands import COMMANDS, LEAVES, file_options

pytestmark = pytest.mark.usefixtures("bare_runs")


@pytest.mark.parametrize("words", LEAVES, ids=" ".join)
def test_every_command_says_what_is_next(words):
    assert "console.next_step(" in inspect.getsource(inspect.unwrap(LEAVES[words].callback))


def next_of(capsys, arguments, code=0):
    """The words of the command that is named last on standard error."""
    assert run(arguments) == code
    last = capsys.readouterr().err.splitlines()[-1]
    found = re.fullmatch(r"next: (?:.*; )?scenematch (.+)", last)
    assert found, last
    return shlex.split(found[1])


def parsed(words):
    """The command that these words call, with its options; fails where there is no such one."""
    command = COMMANDS[()]
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    known = {option for parameter in command.params for option in parameter.opts}
    assert {word for word in words if word.startswith("--")} <= known
    return command.name


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    out = tmp_path_factory.mktemp("a flight")
    assert run(["simulate", f"--out={out / 'f'}", "--frames=2"]) == 0
    return out / "f"


def files_of(flight):
    """Options of a flight's files, as a command says them again."""
    return [word for option in file_options(flight, surface=None) for word in option.split("=")]


def test_from_a_flight_to_its_export_by_what_is_said(flight, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = next_of(capsys, ["simulate", f"--out={tmp_path / 'again'}", "--frames=1"])
    assert parsed(words) == "track"
    words = next_of(capsys, [*words, "--device=cpu", "--method=ncc"])  # what simulate said, as it stands
    assert parsed(words) == "export"
    words = next_of(capsys, words)
    assert parsed(words) == "evaluate"
    assert (tmp_path / "again-track" / "track.geojson").is_file()


def test_others_name_commands_that_exist(flight, capsys):
    assert parsed(next_of(capsys, ["map", "info", str(flight / "map.tif")])) == "audit"
    assert parsed(next_of(capsys, ["doctor"])) == "demo"


def test_check_looks_at_one_frame_in_n_and_track_is_named_with_the_same(flight, capsys):
    given = ["check", *files_of(flight)]
    assert run([*given, "--settings=input.every=2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["looked_at"] == 1
    words = next_of(capsys, [*given, "--settings=input.every=2"])
    assert parsed(words) == "track"
    assert words[words.index("--settings") + 1] == "input.every=2"
    assert "--settings" not in next_of(capsys, given)


@pytest.mark.parametrize("runs", [["ncc"], ["ncc", "sift"]])
def test_compare_names_a_file_that_it_wrote_and_its_settings_again(flight, tmp_path, capsys, monkeypatch, runs):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenematch.toml").touch()
    out, files = tmp_path / "two  spaces", files_of(flight)
    given = [f"--out={out}", "--settings=scenematch.toml", *(f"--run={name}" for name in runs)]
    assert run(["compare", *files, *given]) == 0
    last = capsys.readouterr().err.splitlines()[-1]
    found = re.fullmatch(r"next: open (.+); scenematch (.+)", last)
    assert shlex.split(found[1]) == [str(out / "comparison.html")]
    assert (out / "comparison.html").is_file()
    words = shlex.split(found[2])
    assert parsed(words) == "track"
    assert set(files) | {"--settings", "scenematch.toml"} <= set(words)


@pytest.mark.parametrize(("availability", "command"), [(0.9, "export"), (0.0, "check")])
def test_a_closed_loop_without_a_fix_is_not_exported(tmp_path, capsys, monkeypatch, availability, command):
    monkeypatch.setattr(
        "scenematch.runs.closed_loop.fly_closed_loop", lambda *_, **__: {"availability": availability}
    )
    words = next_of(capsys, ["simulate", f"--out={tmp_path / 'o'}", "--closed-loop"])
    assert parsed(words) == command
    assert (str(tmp_path / "o" / "telemetry.csv") in words) == (command == "check")


def test_a_path_with_two_spaces_stays_as_it_is(capsys):
    console.next_step(f"track {console.options(map='two  spaces/a map.tif', truth=None, log_offset_s=2)}")
    said = capsys.readouterr().err
    assert shlex.split(said)[2:] == ["track", "--map", "two  spaces/a map.tif", "--log-offset-s", "2"]
    console.say("one\n  line ")
    assert capsys.readouterr().err == "one line\n"


def test_a_run_without_a_fix_is_followed_by_check_of_the_same_files(flight, tmp_path, capsys):
    """An export would refuse it. By ncc every frame is refused under a heading that is 90 degrees off."""
    files = files_of(flight)
    corrected = ("height_offset_m=900.0", "heading_deg=heading_deg+90")
    wrong = [*(word for text in corrected for word in ("--correct", text)), "--settings", "input.every=2"]
    out = tmp_path / "out"
    words = next_of(capsys, ["track", *files, *wrong, "--out", str(out), "--method", "ncc", "--profile", "paper"])
    assert json.loads((out / "summary.json").read_text())["fixes"] == 0
    assert parsed(words) == "check"
    assert set(files) | set(wrong) <= set(words)
    words = next_of(capsys, ["evaluate", str(out), "--truth", str(flight / "truth.csv")])
    assert parsed(words) == "check"
    assert set(files) | set(wrong) <= set(words)
    words = next_of(capsys, words)
    assert parsed(words) == "track"
    assert set(files) | set(wrong) <= set(words)
