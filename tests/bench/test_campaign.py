"""A campaign: each flight by each method is a run of its own; one that fails costs no other, done is done."""

import subprocess
import sys

import pytest

from bench import campaign
from bench.accuracy.truth import pooled

PLAN = """
[runs.ncc]
method = "ncc"
[flights.good]
folder = "{folder}"
surface = "none"
group = "real"
[flights.bad]
folder = "{folder}"
camera = "{folder}/other.yaml"
group = "real"
[simulated]
seeds = [1]
frames = 2
"""


def test_options_are_those_of_the_command_line():
    given = {"hfov_deg": 60.0, "closed_loop": True, "surface": "none", "force": False, "settings": ["a=1", "b=2"]}
    assert campaign.options(given) == ["--hfov-deg=60.0", "--closed-loop", "--settings=a=1", "--settings=b=2"]


def test_fixes_count_alike_in_a_pool():
    one = {"frames": 10, "fixes": 9, "scored_fixes": 9, "rms_m": 1.0, "false_fixes": 0, "wrong_over_10m": 1}
    other = {"frames": 10, "fixes": 3, "scored_fixes": 3, "rms_m": 3.0, "false_fixes": 2, "wrong_over_10m": 2}
    counts = {"tracks": 2, "frames": 20, "fixes": 12, "false_fixes": 2, "wrong_over_10m": 3, "availability": 0.6}
    both = pooled([one, other])
    assert both.items() >= counts.items()
    assert (both["rms_m"], both["worst_rms_m"]) == (pytest.approx(3.0**0.5), 3.0)
    assert pooled([{"frames": 4, "fixes": 4}]).items() >= {"availability": 1.0, "rms_m": None}.items()


@pytest.mark.slow
@pytest.mark.timeout(900)  # processes, on a machine that may be busy
def test_a_campaign_goes_on_where_it_ended(flight_in, tmp_path):
    flight, out = tmp_path / "flight", tmp_path / "out"
    flight_in(flight, frames=2)
    text = (flight / "camera.yaml").read_text(encoding="utf-8")
    (flight / "other.yaml").write_text(text.replace("image_width: 300", "image_width: 320"), encoding="utf-8")
    (tmp_path / "plan.toml").write_text(PLAN.format(folder=flight), encoding="utf-8")
    command = [sys.executable, "-m", "bench.campaign", str(tmp_path / "plan.toml"), f"--out={out}", "--workers=1"]
    begun = subprocess.run(command, capture_output=True, text=True, check=False)
    assert begun.returncode == 1, begun.stderr
    page = (out / "campaign.md").read_text(encoding="utf-8")
    assert begun.stdout.strip() == page.strip()
    assert "300 x 300" in page.partition("## Failed")[2]
    assert "## simulated noon" in page
    tracks = {path: path.stat().st_mtime_ns for path in out.glob("runs/*/ncc/track.csv")}
    assert {path.parent.parent.name for path in tracks} == {"good", "town-1-noon"}
    assert subprocess.run(command, capture_output=True, check=False).returncode == 1
    assert {path: path.stat().st_mtime_ns for path in out.glob("runs/*/ncc/track.csv")} == tracks
    assert (out / "campaign.md").read_text(encoding="utf-8") == page
