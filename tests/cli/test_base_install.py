"""What an installation without extras does: all that a vehicle needs; the rest names the extra that it needs."""

import json
import sys
import tomllib

import pytest

from scenematch.cli.app import run
from tests.support.commands import file_options
from tests.support.interpreters import done_by
from tests.support.paths import ROOT

OF_DESKS = ("matplotlib",)
"""The packages of the extra `desk`."""
PROGRAM = """
import json, sys
for name in {absent}:
    sys.modules[name] = None
import scenematch.runs.mavlink_bridge
scenematch.runs.mavlink_bridge._AUTOPILOT_TIMEOUT_S = 0.1  # there is none
from scenematch.cli.app import run
print("CODES", json.dumps([run(line) for line in {lines}]))
"""


@pytest.mark.slow
def test_a_vehicle_needs_no_extra_of_a_desk(flight, tmp_path):
    files, picture, out = file_options(flight), flight / "frames" / "000000.jpg", tmp_path / "out"
    truth = (flight / "truth.csv").read_text(encoding="utf-8").splitlines()[1].split(",")
    lines = [
        ["doctor"],
        ["doctor", "--settings"],
        ["track", *files, f"--out={out}"],
        ["evaluate", out],
        ["export", out, "--format=geojson"],
        ["compare", *files, "--run=ncc", f"--out={tmp_path / 'runs'}"],
        ["locate", picture, *files[:3], "--height-agl=150", "--method=sift", f"--start={truth[1]},{truth[2]}"],
        ["check", *files],
        ["map", "info", flight / "map.tif"],
        ["bridge", "mavlink", "--connect=udpout:127.0.0.1:9", *files, "--settings=bridge.seconds=0.1"],
    ]
    done = done_by(PROGRAM.format(absent=OF_DESKS, lines=[[str(word) for word in line] for line in lines]))
    codes = json.loads(done.stdout.rpartition("CODES ")[2])
    names = [" ".join(map(str, line[:2])) for line in lines]
    assert dict(zip(names, codes, strict=True)) == dict.fromkeys(names, 0), done.stderr
    assert "Traceback" not in done.stderr
    assert (out / "report.html").is_file()


def test_what_draws_names_its_extra_before_it_begins(flight, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    out = tmp_path / "out"
    assert run(["map", "audit", str(flight / "map.tif"), f"--out={out}"]) == 1
    missing = "expected matplotlib to be installed, got none: pip install 'scenematch-engine[desk]'"
    assert capsys.readouterr().err == f"scenematch: {missing}\n"
    assert not out.exists()


def test_the_extras_of_a_desk_are_all_that_is_missing_here():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    named = " ".join(extras["desk"])
    assert all(name in named for name in OF_DESKS)
    assert not [line for line in project["dependencies"] if line.startswith(OF_DESKS)]
    assert "scenematch-engine[desk]" in extras["test"]
