"""Help and completion: for every command, and without the packages that only its work needs."""

import os
import re

import pytest

from scenematch.cli.app import run
from tests.support.commands import COMMANDS
from tests.support.interpreters import done_by

HEAVY = ("torch", "numba", "numpy", "cv2", "rasterio", "pyproj", "matplotlib", "kornia", "PIL", "rich")


@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: " ".join(words) or "scenematch")
def test_h_is_help_which_fits_80_columns_and_is_not_cut_off(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert run([*command, "-h"]) == 0
    short = capsys.readouterr().out
    assert run([*command, "--help"]) == 0
    assert capsys.readouterr().out == short
    assert "-h, --help" in short
    assert max(map(len, short.splitlines())) <= 80
    assert "..." not in re.sub(r"(\[ARGS\]|\[NAME:=VALUE\]|\{DIR\})\.\.\.", "", short)


def test_help_of_every_command_loads_nothing_that_only_its_work_needs():
    program = (
        "import json, sys; from scenematch.cli.app import run; "
        f"codes = [run([*words, '--help']) for words in {list(COMMANDS)}]; assert not any(codes), codes; "
        f"print('HEAVY', [name for name in {HEAVY} if name in sys.modules])"
    )
    printed = done_by(program).stdout
    assert printed.count("Usage: scenematch") == len(COMMANDS)
    assert printed.endswith("HEAVY []\n")


def test_completion_loads_nothing_that_only_work_needs():
    program = (
        "import atexit, sys; atexit.register(lambda: print('HEAVY', "
        f"[name for name in {HEAVY} if name in sys.modules])); "
        "sys.argv[0] = 'scenematch'; from scenematch.cli import main; main()"
    )
    asked = {"_SCENEMATCH_COMPLETE": "complete_bash", "COMP_WORDS": "scenematch bridge mavl", "COMP_CWORD": "2"}
    printed = done_by(program, env=os.environ | asked).stdout
    assert printed.split("HEAVY")[0].split() == ["mavlink"]
    assert printed.endswith("HEAVY []\n")


@pytest.mark.parametrize(
    ("command", "start"),
    [
        ("track", "Where the flight begins; replaces the telemetry's positions"),
        ("locate", "Where to search (default: the whole map)."),
        ("bridge mavlink", "Where the flight begins (default: the last fix of an earlier bridge"),
        ("bridge ros", "Where the flight begins (default: anywhere on the map)."),
    ],
)
def test_a_command_says_what_an_option_that_others_share_does_there(command, start, capsys):
    run([*command.split(), "--help"])
    assert f"--start LAT,LON[,SIGMA_M] {start}" in " ".join(capsys.readouterr().out.split())
