"""Every command ends with what to do next: one command that exists, for people only."""

import inspect
import json
import re
import shlex

import pytest

from scenematch.cli import console
from scenematch.cli.app import run
from tests.support.commands import COMMANDS, LEAVES, answer, file_options

pytestmark = pytest.mark.usefixtures("bare_runs")


@pytest.mark.parametrize("words", LEAVES, ids=" ".join)
def test_every_command_says_what_is_next(words):
    """By itself, or by the function that ends it."""
    ending = r"next_step\(|after_track\(|print_summary\(|_measure_delay\(|_write_parameters\("
    assert re.search(ending, inspect.getsource(inspect.unwrap(LEAVES[words].callback)))


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


def test_check_looks_at_one_frame_in_n_and_names_track(flight, capsys):
    given = ["check", *file_options(flight, surface=None), "--settings=input.every=2"]
    assert answer(capsys, given)["looked_at"] == 3
    assert parsed(next_of(capsys, given)) == "track"


@pytest.mark.parametrize("runs", [["ncc"], ["ncc", "sift"]])
def test_compare_names_a_file_that_it_wrote(flight, tmp_path, capsys, runs):
    out = tmp_path / "two  spaces"
    given = [f"--out={out}", *(f"--run={name}" for name in runs)]
    assert run(["compare", *file_options(flight, surface=None), *given]) == 0
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == f"next: open '{out / 'comparison.html'}'; with the same files; scenematch track --out out"
    assert (out / "comparison.html").is_file()


@pytest.mark.parametrize(("availability", "command"), [(0.9, "export"), (0.0, "check")])
def test_a_closed_loop_without_a_fix_is_not_exported(tmp_path, capsys, monkeypatch, availability, command):
    flown = {"availability": availability}
    monkeypatch.setattr("scenematch.runs.closed_loop.fly_closed_loop", lambda *_, **__: flown)
    assert parsed(next_of(capsys, ["simulate", f"--out={tmp_path / 'o'}", "--closed-loop"])) == command


def test_a_path_with_two_spaces_stays_as_it_is(capsys):
    console.next_step(f"map info {console.quoted('two  spaces/a map.tif')}")
    assert shlex.split(capsys.readouterr().err)[2:] == ["map", "info", "two  spaces/a map.tif"]
    console.say("one\n  line ")
    assert capsys.readouterr().err == "one line\n"


def test_a_run_without_a_fix_is_followed_by_a_check(flight, tmp_path, capsys):
    """An export would refuse it. By ncc every frame is refused under a heading that is 90 degrees off."""
    wrong = ["--correct=height_offset_m=900.0", "--correct=heading_deg=heading_deg+90", "--method=ncc"]
    given = ["track", *file_options(flight, surface=None), *wrong, "--profile=paper", f"--out={tmp_path / 'out'}"]
    assert parsed(next_of(capsys, given)) == "check"
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["fixes"] == 0
    evaluated = ["evaluate", str(tmp_path / "out"), f"--truth={flight / 'truth.csv'}"]
    assert parsed(next_of(capsys, evaluated)) == "check"
