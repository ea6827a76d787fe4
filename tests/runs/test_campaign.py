"""campaign: many flights by several methods; the same on one process, on several and on Ray, killed or not."""

import contextlib
import csv
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from engine import OptionError
from engine.errors import TelemetryError
from scenematch.cli.app import run
from scenematch.files.logs.readers import LogClock
from scenematch.files.settings import read_settings
from scenematch.files.track import read_track
from scenematch.report.campaign import CampaignRow, pool_runs, write_tables
from scenematch.runs.campaign import _prepare
from scenematch.runs.campaign_plan import Campaign, _content_hash, plan_campaign
from scenematch.runs.executors import in_processes
from scenematch.runs.jobs import read_result
from scenematch.runs.simulation import write_flight
from scenematch.simulator import plan_flight
from tests.support.paths import ROOT
from tests.support.runs import bare_runs
from tests.support.towns import drawn_town

pytestmark = pytest.mark.timeout(900)  # a dozen processes, on a machine that may be busy
RUNS = ("town-1-noon/ncc", "good/ncc", "bad/ncc")
NO_RAY = "Ray is not installed: pip install 'scenematch-engine[ray]'"
FILE = """
runs = ["ncc"]
[flights.good]
folder = "flight"
surface = "none"
[flights.bad]
folder = "flight"
camera = "other.yaml"
[simulated]
seeds = [1]
frames = 2
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A campaign's file, with a flight of two frames and a calibration that does not fit it."""
    folder = tmp_path_factory.mktemp("campaign")
    write_flight(folder / "flight", plan_flight(town=drawn_town(), frames=2))
    text = (folder / "flight" / "camera.yaml").read_text(encoding="utf-8")
    other = text.replace("image_width: 300", "image_width: 320")
    (folder / "flight" / "other.yaml").write_text(other, encoding="utf-8")
    (folder / "campaign.toml").write_text(FILE, encoding="utf-8")
    return folder


def command(place, out, *more):
    return [
        sys.executable,
        "-m",
        "scenematch.cli",
        "campaign",
        str(place / "campaign.toml"),
        f"--out={out}",
        *more,
    ]


@contextlib.contextmanager
def in_this_process(*_):
    """An executor without processes: each of them would load PyTorch anew."""
    yield lambda do, jobs: ((job, do(job)) for job in jobs)


@pytest.fixture(scope="module")
def whole(place):
    """The campaign in this process, from its begin to its end."""
    with pytest.MonkeyPatch.context() as patch, bare_runs():
        patch.setattr("scenematch.runs.campaign._executor", in_this_process)
        code = run(["campaign", str(place / "campaign.toml"), f"--out={place / 'whole'}"])
    assert code == 1  # the flight that cannot be followed
    return place / "whole"


def results(out):
    """What every run left, without times: the result, and the rows of the track."""
    found = {}
    for path in sorted(out.glob("runs/*/*/result.json")):
        rows = [replace(row, latency_ms=None) for row in read_track(path.with_name("track.csv"))]
        found["/".join(path.parts[-3:-1])] = (path.read_bytes(), rows)
    return found


def same(out, whole):
    assert results(out) == results(whole)
    for name in ("campaign.csv", "campaign.md"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()


def test_every_run_is_told_once_and_a_flight_that_fails_costs_no_other(whole):
    with (whole / "campaign.csv").open(encoding="utf-8") as file:
        lines = {f"{row['flight']}/{row['run']}": row for row in csv.DictReader(file)}
    assert sorted(lines) == sorted(RUNS)
    for name, row in lines.items():
        if name.startswith("bad"):
            assert "300 x 300" in row["failure"]
            assert not row["rms_m"]
            continue
        summary = json.loads((whole / "runs" / name / "summary.json").read_text(encoding="utf-8"))
        assert float(row["rms_m"]) == pytest.approx(summary["rms_m"], abs=1e-4)
        assert row["frames"] == "2"
    assert sorted(results(whole)) == sorted(name for name in RUNS if not name.startswith("bad"))
    page = (whole / "campaign.md").read_text(encoding="utf-8")
    assert "## simulated noon" in page
    assert "300 x 300" in page


@pytest.mark.slow
def test_one_process_at_a_time_gives_the_same(place, whole):
    out = place / "processes"
    done = subprocess.run(command(place, out, "--workers=1"), capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    same(out, whole)


@pytest.mark.slow
def test_what_was_killed_half_way_is_resumed_by_more_processes_and_nothing_is_lost_or_doubled(place, whole):
    out = place / "resumed"
    begun = subprocess.Popen(command(place, out, "--workers=1"), stderr=subprocess.DEVNULL, start_new_session=True)
    first = out / "runs" / "town-1-noon" / "ncc" / "result.json"
    try:
        while not first.is_file():
            assert begun.poll() is None
            time.sleep(0.02)
    finally:
        os.kill(begun.pid, signal.SIGKILL)
        begun.wait()
    assert not (out / "campaign.csv").exists()
    before = {
        path: path.stat() for path in [*out.glob("runs/*/*/result.json"), *out.glob("flights/*/result.json")]
    }
    assert set(results(out)) < set(results(whole))

    again = subprocess.run(command(place, out, "--workers=2"), capture_output=True, text=True, check=False)
    assert again.returncode == 1
    done = len(before) - 1  # without the flight
    assert f"3 runs, {done} of them finished before" in again.stderr
    for path, was in before.items():
        assert (path.stat().st_ino, path.stat().st_mtime_ns) == (was.st_ino, was.st_mtime_ns)
    same(out, whole)


@pytest.mark.usefixtures("bare_runs")
def test_a_run_that_failed_is_tried_again_and_no_flight_is_drawn_for_nothing(
    place, whole, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "again"
    shutil.copytree(whole, out)
    shutil.rmtree(out / "flights")
    monkeypatch.setattr("scenematch.runs.campaign._executor", in_this_process)
    assert run(["campaign", str(place / "campaign.toml"), f"--out={out}", "--workers=1"]) == 1
    stated = capsys.readouterr().err
    assert "3 runs, 2 of them finished before" in stated
    assert "bad/ncc: " in stated
    assert not (out / "flights").exists()
    same(out, whole)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason=NO_RAY)
def test_a_ray_cluster_gives_the_same(place, whole):
    out = place / "ray"
    done = subprocess.run(
        command(place, out, "--ray=local", "--workers=2"), capture_output=True, text=True, check=False
    )
    if "timed out during startup" in done.stderr:
        pytest.skip(f"Ray gave up its own start, as it does on a machine with no time to spare: {done.stderr}")
    assert done.returncode == 1, done.stderr
    same(out, whole)


def test_a_cluster_elsewhere_has_its_own_number_of_workers(place, tmp_path, capsys):
    command = ["campaign", str(place / "campaign.toml"), f"--out={tmp_path / 'out'}", "--ray=auto", "--workers=2"]
    assert run(command) == 2
    assert "--workers: expected none with a cluster" in capsys.readouterr().err


def test_runs_of_other_inputs_are_named_and_kept_unless_forced(place, whole, capsys):
    """Nothing is done here: what changed is found before."""
    text = (place / "campaign.toml").read_text(encoding="utf-8")
    (place / "longer.toml").write_text(text.replace("frames = 2", "frames = 3"), encoding="utf-8")
    before = results(whole)
    assert run(["campaign", str(place / "longer.toml"), f"--out={whole}"]) == 2
    stated = capsys.readouterr().err
    assert "town-1-noon (simulation), town-1-noon/ncc (simulation);" in stated
    assert "--force" in stated
    assert results(whole) == before


def test_a_run_is_a_flight_by_a_method_in_the_order_of_the_file(place, tmp_path):
    file = place / "methods.toml"
    (place / "deep").mkdir()
    (place / "deep" / "fine.toml").write_text("[ncc]\nmargin = 2\n", encoding="utf-8")
    file.write_text(FILE.replace('["ncc"]', '["sift/paper", "deep/fine.toml"]'), encoding="utf-8")
    plan = plan_campaign(file, tmp_path)
    assert [job.name for job in plan.simulated] == ["town-1-noon"]
    flights = ("town-1-noon", "good", "bad")
    assert [job.name for job in plan.runs] == [
        f"{flight}/{run}" for flight in flights for run in ("sift-paper", "fine")
    ]
    assert plan.runs[1].task.settings.ncc.margin == 2.0
    assert {job.task.settings.device for job in plan.runs} == {"cpu"}  # whatever a machine of a cluster has


def test_the_file_in_the_documentation_is_one(tmp_path):
    page = (ROOT / "docs" / "campaigns.md").read_text(encoding="utf-8")
    path = tmp_path / "campaign.toml"
    path.write_text(re.search(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[1], encoding="utf-8")
    found = read_settings(path, Campaign)
    assert list(found.flights) == ["campus", "valley"]
    assert (found.flights["valley"].surface, found.simulated.seeds) == (None, (1, 2, 3, 4, 5))


def test_an_input_that_changed_on_disk_changes_its_print(place, tmp_path):
    def prints():
        return {job.name: dict(job.inputs) for job in plan_campaign(file, tmp_path).runs}

    (tmp_path / "flight").mkdir()
    for name in ("map.tif", "camera.yaml", "other.yaml", "telemetry.csv", "truth.csv"):
        (tmp_path / "flight" / name).write_bytes((place / "flight" / name).read_bytes())
    (tmp_path / "flight" / "frames").mkdir()
    (tmp_path / "flight" / "frames" / "0.jpg").write_bytes(b"picture")
    file = tmp_path / "campaign.toml"
    file.write_text(FILE, encoding="utf-8")
    before = prints()
    (tmp_path / "other").symlink_to(tmp_path / "flight")
    file.write_text(FILE.replace('"flight"', '"other"'), encoding="utf-8")
    assert prints() == before  # by another path the same
    file.write_text(FILE.replace('surface = "none"', "map_sigma_m = 2"), encoding="utf-8")
    assert set(prints()["good/ncc"].items()) - set(before["good/ncc"].items()) == {("map_sigma_m", "2.0")}

    # When the frames of a flight with a log were taken counts too.
    (tmp_path / "flight" / "log.ulg").write_bytes(b"log")
    (tmp_path / "flight" / "stamps.csv").write_text("timestamp_ns,frame\n1,0.jpg\n", encoding="utf-8")
    (tmp_path / "flight" / "flight.bag").write_bytes(b"bag")
    logged = 'telemetry = "log.ulg"\nframe_stamps = "stamps.csv"\nlog_offset_s = -0.5\n'
    logged += 'frames = "flight.bag"\nimage_topic = "/down"'
    file.write_text(FILE.replace('surface = "none"', logged), encoding="utf-8")
    (run,) = (job for job in plan_campaign(file, tmp_path).runs if job.name == "good/ncc")
    stamps = tmp_path.resolve() / "flight" / "stamps.csv"
    assert run.task.files.clock() == LogClock(stamps, -0.5)
    assert run.task.files.image_topic == "/down"
    changed = {name for name, value in run.inputs.items() if before["good/ncc"].get(name) != value}
    assert changed == {"frames", "telemetry", "frame_stamps", "log_offset_s", "image_topic"}
    file.write_text(FILE.replace('surface = "none"', "log_offset_s = 2"), encoding="utf-8")
    with pytest.raises(OptionError, match=r"flights\.good: frame_stamps, log_offset_s: expected a log as telem"):
        plan_campaign(file, tmp_path)

    file.write_text(FILE, encoding="utf-8")
    (tmp_path / "flight" / "frames" / "0.jpg").write_bytes(b"Picture")
    _content_hash.cache_clear()  # another process, another day
    after = prints()
    assert {name for name in after["good/ncc"] if after["good/ncc"][name] != before["good/ncc"][name]} == {
        "frames"
    }
    assert after["town-1-noon/ncc"] == before["town-1-noon/ncc"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('run = ["ncc"]', "run: not a setting; did you mean runs?"),
        ("runs = ['ncc']\n[flights.a]\nfodler = 'x'", "flights.a.fodler: not a setting; did you mean folder?"),
        ("runs = ['ncc']\n[simulated]\nseed = [1]", "simulated.seed: not a setting; did you mean seeds?"),
        ("[runs]\nncc = 1", "runs: expected a list, got {'ncc': 1}"),
        ("flights = ['a']", "flights: expected tables [flights.NAME], got ['a']"),
        ("[simulated]\nseeds = [1.5]", "simulated.seeds: expected a whole number, got 1.5"),
        ("[simulated]\nseeds = [-1]", "simulated.seeds: expected 0 or more, got -1"),
        ("[simulated]\nconditions = ['night']", "conditions: expected one of noon, "),
        ("[simulated]\nframes = 0", "simulated.frames: expected 1 or more, got 0"),
        ("[simulated]\nrelief_m = -5.0", "simulated.relief_m: expected 0 to 80, got -5"),
        ("[simulated]\nrelief_m = nan", "simulated.relief_m: expected 0 to 80, got nan"),
        ("[flights.a]\nlog_offset_s = inf", "flights.a.log_offset_s: expected finite seconds, got inf"),
        ("[flights.a]\nmap_sigma_m = -1", "flights.a.map_sigma_m: expected a number above 0"),
        ("[simulated]\nseeds = [1]", "runs: expected a list of METHOD, METHOD/PROFILE or settings files"),
        ("runs = ['ncc']", "expected flights, as [flights.NAME] or as seeds in [simulated], got none"),
        (
            "runs = ['orb']\n[simulated]\nseeds = [1]",
            "runs: expected ncc, sift, auto, learned, one of them with /paper, or",
        ),
        ("runs = ['ncc']\n[flights.a]", "flights.a.map: expected a file that is there, got"),
        (
            "runs = ['ncc']\n[flights.'a/b']",
            "flights: expected a name of letters, digits, '_', '.' and '-', got 'a/b'",
        ),
        ("runs = ['ncc'", "expected TOML, got something else"),
    ],
)
def test_a_file_that_cannot_be_is_refused_in_one_line(text, message, tmp_path):
    path = tmp_path / "campaign.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(OptionError) as caught:
        plan_campaign(path, tmp_path / "out")
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


def test_a_name_that_is_a_simulated_flights_is_refused(place):
    path = place / "twice.toml"
    path.write_text(FILE.replace("flights.good", "flights.town-1-noon"), encoding="utf-8")
    with pytest.raises(OptionError, match="this is a simulated flight's"):
        plan_campaign(path, place / "out")


def test_a_folder_that_is_no_campaigns_is_left_alone(place, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine", encoding="utf-8")
    assert run(["campaign", str(place / "campaign.toml"), f"--out={tmp_path}"]) == 2
    assert "exists; choose another folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_folder_that_only_looks_like_a_campaigns_keeps_its_files(place, tmp_path, capsys):
    """Folders of the same names are nobody's permission to remove what is in them."""
    for name in ("runs/lake.txt", "unfinished/thesis.txt"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("mine", encoding="utf-8")
    command = ["campaign", str(place / "campaign.toml"), f"--out={tmp_path}", "--workers=1"]
    assert run(command) == 2
    assert "exists; choose another folder" in capsys.readouterr().err
    assert run([*command, "--force"]) == 2
    assert "expected a folder without unfinished/" in capsys.readouterr().err
    found = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file())
    assert found == ["runs/lake.txt", "unfinished/thesis.txt"]


def test_a_campaigns_folder_is_known_by_its_marker_or_its_table(whole, tmp_path):
    left = []
    _prepare(tmp_path / "new", left, False)
    (tmp_path / "new" / "unfinished" / "half").mkdir()
    _prepare(tmp_path / "new", left, False)  # killed before its table was there
    assert not any((tmp_path / "new" / "unfinished").iterdir())
    (tmp_path / "copied" / "runs").mkdir(parents=True)
    shutil.copy(whole / "campaign.csv", tmp_path / "copied")
    _prepare(tmp_path / "copied", left, False)
    (tmp_path / "other" / "runs").mkdir(parents=True)
    (tmp_path / "other" / "campaign.csv").write_text("votes,party\n", encoding="utf-8")
    with pytest.raises(OptionError, match="exists"):
        _prepare(tmp_path / "other", left, False)


DAMAGE = {
    "result.json": [
        "", "{", "[]", "5", "deep", '{"inputs": 5, "figures": {}}', '{"inputs": {"map": 5}, "figures": {}}',
        ("figures", None), ("figures", {}), ("frames", "x"), ("frames", None), ("fixes", [1]), ("rms_m", "far"),
        ("rms_m", 1e300), ("scored_fixes", None), ("false_fixes", None), ("wrong_over_10m", "x"),
        ("availability", []), ("nees_mean", {}), ("median_m", True),
    ],
    "summary.json": ["", "[]", "{}", '{"latency_ms": 5}', '{"latency_ms": {"p50": "x"}}', '{"latency_ms": []}'],
}  # fmt: skip


@pytest.mark.parametrize(("name", "change"), [(name, change) for name in DAMAGE for change in DAMAGE[name]])
def test_a_finished_run_that_is_damaged_is_named_before_any_work(name, change, place, whole, tmp_path):
    (job,) = (job for job in plan_campaign(place / "campaign.toml", whole).runs if job.name == "good/ncc")
    folder = tmp_path / "ncc"
    shutil.copytree(job.folder, folder)
    text = "[" * 100_000 if change == "deep" else change
    if isinstance(change, tuple):
        result = json.loads((folder / name).read_text(encoding="utf-8"))
        (result if change[0] == "figures" else result["figures"])[change[0]] = change[1]
        text = json.dumps(result)
    (folder / name).write_text(text, encoding="utf-8")
    assert read_result(job).latency_ms["p50"] > 0.0
    with pytest.raises(TelemetryError, match=f"{name}: expected the result of a run, got something else"):
        read_result(replace(job, folder=folder))


# --------------------------------------------------------------------------------------------- executors


def part(number):
    """A job for the executor below: its answer says what it is."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 2:
        os._exit(3)
    return f"said by {number}, not by {os.getppid()}"


@pytest.mark.slow
def test_a_job_whose_process_ends_is_answered():
    with in_processes(1) as execute:
        assert list(execute(part, [2])) == [(2, "its process ended with code 3")]


@pytest.mark.slow
def test_each_job_is_answered_once_even_where_its_process_dies():
    with in_processes(2) as execute:
        answers = list(execute(part, [1, 2, 3]))
    assert dict(answers) == {
        1: "its process was ended by signal 9",
        2: "its process ended with code 3",
        3: f"said by 3, not by {os.getpid()}",
    }
    assert len(answers) == 3


# ------------------------------------------------------------------------------------------------ tables


def line(flight, rms_m, fixes, **more):
    figures = {
        "frames": 10,
        "fixes": fixes,
        "availability": fixes / 10,
        "scored_fixes": fixes,
        "rms_m": rms_m,
        "false_fixes": 1,
        "wrong_over_10m": 2,
    }
    return replace(CampaignRow("towns", flight, "ncc", figures, None, None), **more)


def test_a_pool_weighs_each_fix_alike():
    (pool,) = pool_runs([line("a", 3.0, 10), line("b", 4.0, 5), line("c", None, 0, figures=None, failure="gone")])
    assert pool.rms_m == pytest.approx(((10 * 9.0 + 5 * 16.0) / 15) ** 0.5)
    assert (pool.flights, pool.failed, pool.frames, pool.availability) == (2, 1, 20, 0.75)
    assert (pool.worst_rms_m, pool.false_fixes, pool.wrong_over_10m) == (4.0, 2, 4)


def test_what_has_no_truth_has_no_errors(tmp_path):
    blind = line("a", None, 10, figures={"frames": 10, "fixes": 10, "availability": 1.0})
    (pool,) = pool_runs([blind])
    assert (pool.rms_m, pool.false_fixes, pool.availability) == (None, None, 1.0)
    write_tables(tmp_path, [blind])
    assert "| a | ncc | 10 | 100.0% | - | - | - | - | - | - | - |" in (tmp_path / "campaign.md").read_text()


def test_published_figures_stand_beside_ours_and_are_marked(tmp_path):
    ours = [line("a", 3.0, 10, group="wildnav"), line("b", 3.0, 10)]
    write_tables(tmp_path, ours)
    wildnav, towns = (tmp_path / "campaign.md").read_text(encoding="utf-8").split("## towns")
    assert "published, not run here" in wildnav
    assert "| SuperGlue, data set 1 | 124 | 77 (62 %) | 15.82 m mean absolute |" in wildnav
    assert "published" not in towns
