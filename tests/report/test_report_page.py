"""The report page: its words, what it shows of single matches, and what is kept where it is drawn again."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine import NccOptions, NoFix, OptionError, OrthoMap, Prior, Reason, SiftOptions, Window
from scenematch import TrackSettings, evaluate
from scenematch.cli.app import run
from scenematch.files.settings import changed, nested, options_from_mapping
from scenematch.files.track import NOTE_COLUMNS, TrackRow, read_track, track_row, with_notes, write_notes
from scenematch.report.charts import ChartArea, ticks
from scenematch.report.explain import choose_frames
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.metrics import Ground, TrackErrors, summarise
from scenematch.report.page import write_page
from scenematch.report.verdict import MEANINGS, verdict_of
from tests.support.commands import refusal
from tests.support.dark_flight import DARK, FRAMES, data_of

pytestmark = pytest.mark.usefixtures("bare_runs")

# --------------------------------------------------------------------------------------------- the verdict


def summary_of(**known):
    """Ten frames, nine of them fixed and right, but for what is given."""
    counts = {"frames": 10, "fixes": 9, "reasons": {"ambiguous": 1}, "deadlines_missed": 0, "scored_fixes": 9}
    errors = {"median_m": 0.12, "max_m": 0.42, "wrong_over_10m": 0, "false_fixes": 0}
    sigmas = {"beyond_3_sigma": 0, "nees_mean": 1.9, "stated_sigma_median_m": 0.4}
    return counts | errors | sigmas | {"latency_ms": {"p95": 9.94}, "settings": {"budget_ms": 40.0}} | known


@pytest.mark.parametrize(
    ("known", "grade", "begins"),
    [
        ({}, "good",
         "9 of 10 frames fixed, all within three of their own sigmas; half of the fixes within 0.12 m"),
        ({"fixes": 5, "scored_fixes": 5}, "mixed", "5 of 10 frames fixed, all within three of their own sigmas"),
        ({"deadlines_missed": 2}, "mixed", "9 of 10 frames fixed, all within three of their own sigmas"),
        # By its own sigma, not by a number of metres: 12 m off and said so, 4 m off and not said so.
        ({"wrong_over_10m": 1, "max_m": 12.0}, "good",
         "9 of 10 frames fixed, all within three of their own sigmas"),
        ({"beyond_3_sigma": 1, "max_m": 4.0}, "good", "9 of 10 frames fixed, all but 1 within three of their own"),
        ({"beyond_3_sigma": 2, "max_m": 4.0}, "bad",
         "2 of 9 fixes are off by more than three of their own sigmas"),
        ({"wrong_over_10m": 2, "false_fixes": 2}, "bad", "2 fixes are false"),
        ({"scored_fixes": 0}, "open", "9 of 10 frames fixed; half of them state a sigma below 0.40 m. With"),
        ({"fixes": 0, "scored_fixes": 0}, "bad", "None of 10 frames fixed; most were refused as ambiguous"),
        ({"frames": 0, "fixes": 0}, "bad", "The track has no frames"),
        (  # a map that is shifted by 8 m and calls itself good to 0.5
            {"beyond_3_sigma": 9, "nees_mean": 552.0, "max_m": 8.4},
            "bad",
            "9 of 9 fixes are off by more than three of their own sigmas (mean NEES 552, 2 is expected)",
        ),
        ({"fixes": 0, "scored_fixes": 0, "settings": {"diagnosis": {"heading": "the heading reads low"}}}, "bad",
         "The heading reads low. None of 10 frames fixed"),
    ],
)  # fmt: skip
def test_the_verdict_says_the_worst_first(known, grade, begins):
    verdict = verdict_of(summary_of(**known))
    assert verdict.grade == grade
    assert verdict.accuracy.startswith(begins)


def test_sigmas_that_are_far_larger_than_the_errors_are_said_to_be():
    assert "cautious: about 14 times" in verdict_of(summary_of(nees_mean=0.01)).accuracy
    assert "cautious" not in verdict_of(summary_of(nees_mean=1.0)).accuracy


def test_the_verdict_on_time():
    assert "all of them within the budget of 40 ms" in verdict_of(summary_of()).latency
    assert "3 answers came after" in verdict_of(summary_of(deadlines_missed=3)).latency
    assert "no budget" in verdict_of(summary_of(settings={})).latency
    assert "9.9 ms" in verdict_of(summary_of(settings={})).latency


def test_every_reason_has_its_meaning_in_one_sentence():
    assert set(MEANINGS) == set(Reason)
    assert all(re.fullmatch(r"[A-Z][^.]+\.", text) for text in MEANINGS.values())


# --------------------------------------------------------------------------------------------- parts


@pytest.mark.parametrize("low", [0.0, -3.7, 1e5])
@pytest.mark.parametrize("span", [1e-3, 0.7, 12.0, 999.0])
def test_ticks_are_round_and_inside(low, span):
    found = ticks(low, low + span, 5)
    values = np.array([value for value, _ in found])
    assert 2 <= len(found) <= 11
    assert values.min() >= low - 1e-9 * span
    assert values.max() <= low + span * (1 + 1e-9)
    assert [float(text.replace(",", "")) for _, text in found] == pytest.approx(list(values), rel=1e-9, abs=1e-12)
    step = values[1] - values[0]
    leading = step / 10 ** np.floor(np.log10(step) + 1e-9)
    assert any(leading == pytest.approx(round_one, rel=1e-4) for round_one in (1, 2, 2.5, 5))


def test_a_line_breaks_where_nothing_is_known_and_a_dot_outside_is_not_drawn():
    plot = ChartArea((0.0, 4.0), (0.0, 1.0))
    time, values = np.arange(5.0), np.array([0.0, 0.5, np.nan, 0.5, 7.0])
    assert plot.line(time, values, "truth").count("M") == 2
    assert plot.dots(time, values, "fix").count("h0") == 3
    assert plot.overflow(time, values, "over").count("M") == 1


def errors_of(distances_m):
    """Errors to the east, each stated to be good to a metre."""
    east = np.array(distances_m, float)
    error = np.column_stack([east, np.where(np.isfinite(east), 0.0, np.nan)])
    return TrackErrors(np.zeros_like(error), error, error, np.tile(np.eye(2), (len(east), 1, 1)))


def test_frames_beyond_their_sigmas_are_shown_before_refusals_before_others():
    beyond, refused = {100, 777}, set(range(300, 400))
    statuses = ["no_fix" if i in refused else "fix" for i in range(1000)]
    rows = [TrackRow(timestamp_ns=i, frame=str(i), status=status) for i, status in enumerate(statuses)]
    errors = errors_of([np.nan if i in refused else 50.0 if i in beyond else 0.1 for i in range(1000)])
    chosen = choose_frames(rows, errors)
    assert chosen == sorted(set(chosen))
    assert len(chosen) == 60
    assert beyond <= set(chosen)
    assert {300, 399, 0, 999} <= set(chosen)
    assert len(refused & set(chosen)) == 38
    assert choose_frames(rows[:50], errors_of([0.1] * 50)) == list(range(50))
    assert len(choose_frames(rows[300:400], errors_of([np.nan] * 100))) == 60


def test_notes_come_back_as_they_were(tmp_path):
    refusal = NoFix(reason=Reason.AMBIGUOUS, detail='0.41 against 0.40, "here"', window=Window(3, 4, 50, 60))
    notes = [
        track_row("a.jpg", refusal, latency_ms=None, deadline_met=None, state="lost"),
        TrackRow(timestamp_ns=1, frame="b.jpg", status="fix", state="tracking", heading_deg=12.5, stage="fine"),
    ]
    write_notes(tmp_path / "notes.csv", notes)
    empty = dict.fromkeys(NOTE_COLUMNS[1:])
    assert with_notes([replace(row, **empty) for row in notes], tmp_path / "notes.csv") == notes
    assert (notes[0].window_x0_px, notes[0].window_y0_px) == (3, 4)


def test_settings_are_read_back_from_the_record():
    options = {"ncc": NccOptions(refine=False), "sift": SiftOptions(max_height_m=90.0)}
    columns = {"timestamp_us": "time_us", "height_agl_m": "altitude_agl [m]"}
    settings = TrackSettings(method="sift", budget_ms=40.0, risk=1e-3, telemetry_columns=columns, **options)
    record = json.loads(json.dumps(changed(settings)))
    assert options_from_mapping(TrackSettings, nested(record)) == settings


# --------------------------------------------------------------------------------------------- single matches


def matched(flight, site, method, profile="engine"):
    """A matcher and its first fix of a flight, with the frame."""
    coarse = {"ncc": NccOptions(refine=False), "sift": SiftOptions(refine=False)}
    matcher = TrackSettings(method=method, profile=profile, device="cpu", **coarse).matcher(site, flight.camera)
    frame, truth = flight.frames[0], flight.truth[0]
    prior = Prior(lat_deg=truth.lat_deg, lon_deg=truth.lon_deg, sigma_m=4.0)
    return matcher, frame, matcher.locate(frame, prior)


@pytest.mark.parametrize("profile", ["engine", "paper"])
def test_the_surface_is_that_of_the_run(sim_flight, sim_site, profile):
    matcher, frame, fix = matched(sim_flight, sim_site, "ncc", profile)
    found = matcher.explain(frame, fix.window)
    assert found.surface.score == pytest.approx(fix.score, abs=1e-4)
    assert found.surface.scores.max() == found.surface.score
    # The frame is nearly level, so that the nadir lies near the middle of what was found.
    middle = found.outline_px.mean(axis=0)
    np.testing.assert_allclose(middle, fix.map_xy_px, atol=0.1 * found.rectified.shape[0])
    at_peak = found.surface.corner_px + found.surface.step_px * np.array(found.surface.peak_px)
    np.testing.assert_allclose(middle, at_peak, atol=1e-6)


def test_the_matches_are_those_of_the_run(sim_flight, sim_site):
    matcher, frame, fix = matched(sim_flight, sim_site, "sift")
    found = matcher.explain(frame, fix.window)
    assert found.matches.agree.mean() == pytest.approx(fix.score, abs=1e-9)
    # By the outline's own corners: what agrees lies where the frame's pixels see the map.
    size = np.array([frame.image.shape[1], frame.image.shape[0]]) - 0.5
    corners = np.array([[-0.5, -0.5], [size[0], -0.5], size, [-0.5, size[1]]])
    affine, *_ = np.linalg.lstsq(np.c_[corners, np.ones(4)], found.outline_px, rcond=None)
    there = np.c_[found.matches.frame_px, np.ones(len(found.matches.frame_px))] @ affine
    off = np.linalg.norm(there - found.matches.map_px, axis=1)[found.matches.agree]
    assert np.median(off) < 6.0  # houses stand above the level ground of the outline


def test_a_method_that_the_matcher_does_not_have_is_not_explained(sim_flight, sim_site):
    matcher, frame, fix = matched(sim_flight, sim_site, "ncc")
    with pytest.raises(OptionError, match=r"^method: expected one of this matcher's \(ncc\), got 'sift'"):
        matcher.explain(frame, fix.window, "sift")


def test_nothing_is_made_up_where_the_telemetry_is_silent(sim_flight, sim_site):
    matcher, frame, fix = matched(sim_flight, sim_site, "auto")
    blind = type(frame)(frame.image)
    for method in (None, "ncc", "sift"):
        found = matcher.explain(blind, fix.window, method)
        assert (found.rectified, found.surface, found.matches, found.outline_px) == (None,) * 4


# --------------------------------------------------------------------------------------------- the page


def test_the_page_needs_nothing_but_itself(flown):
    text = (flown / "report.html").read_text(encoding="utf-8")
    assert set(re.findall(r"https?://[^\s\"'<]+", text)) == {"http://www.w3.org/2000/svg"}
    assert all(link.startswith("data:image/jpeg;base64,") for link in re.findall(r'(?:href|src)="([^"]*)"', text))
    assert len(text) < 15e6


def test_every_frame_is_shown_with_its_match(flown):
    frames = data_of(flown / "report.html")["frames"]
    assert [frame["kind"] for frame in frames] == ["refused" if i == DARK else "fix" for i in range(FRAMES)]
    assert [len(frame["pictures"]) for frame in frames] == [1 if i == DARK else 4 for i in range(FRAMES)]
    assert "deviate" in frames[DARK]["detail"]


def test_a_run_that_left_no_notes_has_a_page_without_frames(flown, tmp_path):
    again = shutil.copytree(flown, tmp_path / "again")
    (again / "notes.csv").unlink()
    evaluate(again, None)
    assert "notes.csv" in (again / "report.html").read_text(encoding="utf-8")


@pytest.fixture
def page_of(flown, tmp_path):
    """The text of a page of these rows, without truth, under the settings of the run."""
    settings = json.loads((flown / "summary.json").read_text(encoding="utf-8"))["settings"]

    def written(rows):
        summary, site = summarise(rows) | {"settings": settings | {"truth": None}}, OrthoMap.open(settings["map"])
        write_page(tmp_path / "report.html", FinishedTrack(rows, None, site, Ground(), summary))
        return (tmp_path / "report.html").read_text(encoding="utf-8")

    return written


def test_without_truth_nothing_is_claimed(flown, page_of):
    text = page_of(read_track(flown / "track.csv"))
    assert "Without truth their accuracy is unknown" in text
    assert "median error" not in text


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_track_without_a_single_fix_has_a_page(page_of, count):
    refused = {"timestamp_ns": None, "status": "no_fix", "reason": "late"}
    text = page_of([TrackRow(frame=str(i), **refused) for i in range(count)])
    assert ("None of" in text, "has no frames" in text) == (count > 0, count == 0)
    assert "nan" not in re.sub(r'data:image[^"]*', "", text).lower()


# --------------------------------------------------------------------------------------------- drawn again


@pytest.fixture
def moved(flown, tmp_path):
    """A copy of the track whose frames are not where they were."""
    out = Path(shutil.copytree(flown, tmp_path / "out"))
    frames = flown.parent / "flight" / "frames"
    frames.rename(frames.with_name("moved"))
    yield out
    frames.with_name("moved").rename(frames)


def test_a_page_loses_frames_that_were_moved_only_where_it_may(moved, capsys):
    before = (moved / "report.html").read_text(encoding="utf-8")
    assert 'id="slider"' in before
    told = r"DIR.*: .*report\.html shows frames, which redrawing would lose; add --force to do it anyway; .*frames"
    assert re.match(told, refusal(capsys, ["evaluate", moved]))
    assert (moved / "report.html").read_text(encoding="utf-8") == before
    assert run(["evaluate", str(moved), "--force"]) == 0
    assert "report.html loses the frames that it shows: " in capsys.readouterr().err
    after = (moved / "report.html").read_text(encoding="utf-8")
    assert ('id="slider"' in after, "No frames are shown: " in after) == (False, True)
    assert run(["evaluate", str(moved)]) == 0  # there is nothing more to lose


def test_seconds_and_numbers_of_frames_are_not_drawn_over_one_axis(flown, tmp_path):
    other = Path(shutil.copytree(flown, tmp_path / "other"))
    rows = (other / "track.csv").read_text(encoding="utf-8").splitlines()
    blank = [line if k == 0 else "," + line.partition(",")[2] for k, line in enumerate(rows)]
    (other / "track.csv").write_text("\n".join(blank) + "\n", encoding="utf-8")
    third, alike, mixed = shutil.copytree(other, tmp_path / "c"), tmp_path / "alike.html", tmp_path / "mixed.html"
    assert run(["evaluate", str(flown), str(third), f"--out={mixed}"]) == 0
    assert run(["evaluate", str(other), str(third), f"--out={alike}"]) == 0
    assert "Stated sigma (m)" in alike.read_text(encoding="utf-8")
    assert "Stated sigma (m)" not in mixed.read_text(encoding="utf-8")


def test_a_page_for_no_folder_is_refused_before_anything_is_drawn(flown, tmp_path, monkeypatch, capsys):
    other = shutil.copytree(flown, tmp_path / "other")
    monkeypatch.setattr("scenematch.runs.evaluation.draw_together", lambda *_, **__: pytest.fail("drawn"))
    page = tmp_path / "nofolder" / "x.html"
    line = refusal(capsys, ["evaluate", flown, other, f"--out={page}"])
    assert line == f"--out: expected a file in a folder that exists, got {page}\n"
