"""Reports on shared flights, a closed loop and several runs as Chromium shows them: light, dark, desk, phone.

Pictures of them are left in the folder that ``SCENEMATCH_SCREENSHOTS`` names.
"""

import json
import os
from pathlib import Path

import pytest

from engine.geo import LocalFrame
from scenematch.files.track import read_track
from scenematch.files.truth import read_truth
from scenematch.report.metrics import summarise
from scenematch.report.verdict import metres
from scenematch.runs.closed_loop import ClosedLoopSettings, fly_closed_loop
from scenematch.runs.evaluation import report
from scenematch.runs.inputs import FlightFiles
from scenematch.runs.settings import TrackSettings
from scenematch.runs.tracking import track
from tests.support.contrast import SCRIPT
from tests.support.runs import bare_runs

pytestmark = pytest.mark.slow

PAGES = ("nust", "gazebo-a1-evening", "closed-loop", "runs")
WIDTHS = {"desk": 1400, "phone": 390}
EVERY = 12  # frame of a shared flight that is followed


def thinned(source, target):
    """Every few rows of a telemetry, alone in a folder, so that no truth lies beside it."""
    head, *rows = source.read_text(encoding="utf-8").splitlines()
    target.parent.mkdir()
    target.write_text("\n".join([head, *rows[::EVERY]]) + "\n", encoding="utf-8")
    return target


def followed(flight, out, method="ncc", **given):
    """A run over a shared flight, begun at its true place."""
    first = read_truth(flight / "truth.csv")[0]
    files = FlightFiles.from_flat(
        map=flight / "map.tif",
        camera=flight / "camera.yaml",
        telemetry=thinned(flight / "telemetry.csv", out.with_name(f"{out.name}-telemetry") / "telemetry.csv"),
        **given,
    )
    start = f"{first.lat_deg},{first.lon_deg},20"
    track(files, out, TrackSettings(method=method, start=start, device="cpu"), diagnosis=False)
    return out


@pytest.fixture(scope="module")
def pages(shared, browser, tmp_path_factory):
    """The pages by name; none are made where no browser shows them."""
    folder = tmp_path_factory.mktemp("pages")
    nust, evening = shared / "nust", shared / "gazebo-a1-evening"
    with bare_runs():
        followed(nust, folder / "nust", frames=nust / "flight.mp4")  # without truth
        own = {"frames": evening / "frames", "surface": evening / "dsm.tif", "truth": evening / "truth.csv"}
        runs = [followed(evening, folder / f"gazebo-{method}", method, **own) for method in ("ncc", "sift")]
        fly_closed_loop(folder / "closed-loop", loop=ClosedLoopSettings(minutes=0.2, method="ncc", fault="killed"))
    report(runs, folder / "runs.html")
    return {
        "nust": folder / "nust" / "report.html",
        "gazebo-a1-evening": runs[0] / "report.html",
        "closed-loop": folder / "closed-loop" / "report.html",
        "runs": folder / "runs.html",
    }


def dress(browser, scheme):
    wanted = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", wanted)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", WIDTHS)
@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_read_at_any_width_by_day_and_by_night(browser, pages, name, size, scheme):
    dress(browser, scheme)
    browser.open(pages[name], WIDTHS[size])
    assert browser.complaints() == []
    assert browser.requests() == [pages[name].resolve().as_uri()]
    assert browser.run("return document.documentElement.scrollWidth") == WIDTHS[size]
    assert browser.run(SCRIPT) == []
    dark = browser.run("return getComputedStyle(document.body).backgroundColor")
    assert (dark == "rgb(19, 22, 26)") == (scheme == "dark")
    if folder := os.environ.get("SCENEMATCH_SCREENSHOTS"):
        browser.resize(WIDTHS[size], browser.run("return document.documentElement.scrollHeight"))
        browser.save(Path(folder) / f"{name}-{scheme}-{size}.png")


@pytest.mark.parametrize("name", ["nust", "gazebo-a1-evening", "closed-loop"])
def test_ellipses_are_outlines_and_few(browser, pages, name):
    browser.open(pages[name], 1400)
    fills = browser.run("return [...document.querySelectorAll('.map ellipse')].map(e => getComputedStyle(e).fill)")
    assert 0 < len(fills) <= 80  # each with its rim
    assert set(fills) == {"none"}


def test_the_map_is_in_colour_and_wider_than_a_frame(browser, pages):
    browser.open(pages["nust"], 1400)
    spread = browser.run("""
        const image = new Image(); image.src = document.querySelector('.map image').getAttribute('href');
        const canvas = document.createElement('canvas'); canvas.width = image.width; canvas.height = image.height;
        const at = canvas.getContext('2d'); at.drawImage(image, 0, 0);
        const { data } = at.getImageData(0, 0, image.width, image.height);
        let most = 0;
        for (let i = 0; i < data.length; i += 4) most = Math.max(most, Math.abs(data[i] - data[i + 2]));
        return most;""")
    assert spread > 30
    width_m = browser.run("return parseFloat(document.querySelector('.on-map + .hint').textContent)")
    assert 300 < width_m < 1500


def span(browser):
    said = browser.run("return document.getElementById('time-span').textContent")
    return [float(t) for t in said.split(" to ")]


def drag(browser, begin, end):
    """From one share of the first chart's width to another, until the page shows another span of time."""
    before = json.dumps(browser.run("return document.getElementById('time-span').textContent"))
    box = browser.run(
        "const c = document.querySelector('svg.chart[data-from]'); c.scrollIntoView({block: 'center'});"
        "const b = c.querySelector('.axis').getBoundingClientRect(); return [b.left, b.width, b.top]"
    )
    at = [{"x": box[0] + share * box[1], "y": box[2] - 20} for share in (begin, (begin + end) / 2, end)]
    for kind, place in zip(("mousePressed", "mouseMoved", "mouseReleased"), at, strict=True):
        event = {"type": kind, "button": "left", "buttons": 1, "clickCount": 1, **place}
        browser.driver.execute_cdp_cmd("Input.dispatchMouseEvent", event)
    browser.wait_for(f"document.getElementById('time-span').textContent !== {before}")


def test_time_zooms_in_all_charts_by_dragging_and_comes_back(browser, pages):
    dress(browser, "light")
    browser.open(pages["gazebo-a1-evening"], 1400)
    low, high = span(browser)
    drag(browser, 0.25, 0.5)
    near = span(browser)
    assert near == pytest.approx([low + 0.25 * (high - low), low + 0.5 * (high - low)], abs=0.02 * (high - low))
    labels = browser.run(
        "return [...document.querySelectorAll('svg.chart[data-from] .x-grid')].map("
        "g => [...g.querySelectorAll('text')].map(t => parseFloat(t.textContent)))"
    )
    assert len(labels) > 6
    assert all(near[0] <= min(values) and max(values) <= near[1] for values in labels)
    # A dot of a known time lies where the axis says.
    x = browser.run(
        "const c = document.querySelector('svg.chart[data-from]'); "
        "const t = (+c.dataset.from + +c.dataset.to) * 0.375;"
        "const p = new DOMPoint(+c.dataset.left + (t - c.dataset.from) / (c.dataset.to - c.dataset.from)"
        " * (c.dataset.right - c.dataset.left), 50).matrixTransform(c.querySelector('.data').getScreenCTM());"
        "const b = c.querySelector('.axis').getBoundingClientRect(); return (p.x - b.left) / b.width"
    )
    assert x == pytest.approx((0.375 * (high - low) + low - near[0]) / (near[1] - near[0]), abs=0.02)
    browser.run("document.getElementById('time-all').click()")
    assert span(browser) == [low, high]
    assert browser.complaints() == []


def test_a_run_is_hidden_on_map_and_charts(browser, pages):
    browser.open(pages["runs"], 1400)
    shown = "return [...document.querySelectorAll('.run1')].filter(g => g.getClientRects().length).length"
    before = browser.run(shown)
    assert before > 3
    browser.run("document.querySelector('[data-run=\"1\"]').click()")
    assert browser.run(shown) == 0


def test_the_numbers_on_the_page_are_those_of_the_metrics(shared, browser, pages):
    folder = pages["gazebo-a1-evening"].parent
    rows, truth = read_track(folder / "track.csv"), read_truth(shared / "gazebo-a1-evening" / "truth.csv")
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    mine = summarise(rows, truth, frame=LocalFrame(**summary["settings"]["origin"]))
    browser.open(pages["gazebo-a1-evening"], 1400)
    tiles = dict(
        browser.run(
            "return [...document.querySelectorAll('.tiles li')].map("
            "li => [li.querySelector('span').textContent, li.querySelector('strong').textContent])"
        )
    )
    assert tiles["median error"] == metres(mine["median_m"])
    assert tiles["largest error"] == metres(mine["max_m"])
    assert tiles["within 3 stated sigmas; 98.9 % if consistent"] == f"{mine['within_3_sigma']:.1%}"
    cells = browser.run(
        "return [...document.querySelectorAll('.figures tbody tr')].map("
        "r => [...r.children].map(c => c.textContent))"
    )
    assert [row[1:] for row in cells] == [
        [str(s["segments"]), *(metres(s[key]) for key in ("median_m", "p95_m", "max_m"))]
        for s in summary["segments"]
    ]
    assert len(cells) >= 4


def test_the_closed_loop_says_how_far_it_was_from_its_plan(browser, pages):
    figures = json.loads((pages["closed-loop"].parent / "loop.json").read_text(encoding="utf-8"))
    browser.open(pages["closed-loop"], 1400)
    said = browser.run("return document.querySelector('.verdict').textContent")
    for key in ("plan_rms_m", "plan_max_m", "estimate_rms_m"):
        assert metres(figures[key]) in said
