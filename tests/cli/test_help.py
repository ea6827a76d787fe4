"""Help and completion: for every command, and without the packages that only its work needs."""

import json
import os
import re

import pytest

from scenematch.cli.app import run
from tests.support.commands import COMMANDS
from tests.support.interpreters import done_by

HEAVY = ("torch", "numba", "numpy", "cv2", "rasterio", "pyproj", "matplotlib", "kornia", "PIL", "rich")
MATCHING = ("torch", "kornia", "matplotlib")


def loaded_after(lines):
    """What a new interpreter printed by these commands, and the packages that it has loaded by then."""
    program = (
        "import json, sys; from scenematch.cli.app import run; "
        f"codes = [run(line) for line in {lines}]; assert not any(codes), codes; "
        "print('LOADED', json.dumps(sorted({name.split('.')[0] for name in sys.modules})))"
    )
    printed, _, loaded = done_by(program).stdout.partition("LOADED ")
    return printed, set(json.loads(loaded))


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
    printed, loaded = loaded_after([[*command, "--help"] for command in COMMANDS])
    assert printed.count("Usage: scenematch") == len(COMMANDS)
    assert not loaded.intersection(HEAVY)


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


@pytest.mark.slow
def test_commands_that_match_nothing_load_no_torch(flight):
    printed, loaded = loaded_after([["evaluate", "--help"], ["map", "info", str(flight / "map.tif")]])
    assert "gsd_m_per_px" in printed
    assert not loaded.intersection(MATCHING)
