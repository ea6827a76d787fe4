"""Reports on a flight, a closed loop and several runs as Chromium shows them: light, dark, desk, phone."""

import base64
import json

import cv2
import numpy as np
import pytest

from engine.geo import LocalFrame
from scenematch import ClosedLoopSettings, FlightFiles, TrackSettings, fly_closed_loop, track
from scenematch.files.track import read_track
from scenematch.files.truth import read_truth
from scenematch.report.metrics import summarise
from scenematch.report.verdict import metres
from scenematch.runs.evaluation import report
from tests.support.contrast import SCRIPT
from tests.support.dark_flight import DARK, FRAMES, data_of
from tests.support.runs import bare_runs

pytestmark = pytest.mark.slow

WIDTHS = {"desk": 1400, "phone": 390}


@pytest.fixture(scope="module")
def pages(browser, flown, flight_in, tmp_path_factory):
    """The pages by name; none are made where no browser shows them."""
    folder = tmp_path_factory.mktemp("pages")
    flight_in(folder / "flight", frames=FRAMES)
    (folder / "flight" / "truth.csv").unlink()
    with bare_runs():
        track(FlightFiles.in_folder(folder / "flight"), folder / "no-truth", TrackSettings(method="sift"))
        fly_closed_loop(folder / "closed-loop", loop=ClosedLoopSettings(minutes=0.2, method="ncc", fault="killed"))
    report([flown, folder / "no-truth"], folder / "runs.html")
    tracks = {"flight": flown, "no-truth": folder / "no-truth", "closed-loop": folder / "closed-loop"}
    return {name: out / "report.html" for name, out in tracks.items()} | {"runs": folder / "runs.html"}


def texts(browser, selector):
    return browser.run(f"return [...document.querySelectorAll('{selector}')].map(e => e.textContent)")


def dress(browser, scheme):
    wanted = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", wanted)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", WIDTHS)
@pytest.mark.parametrize("name", ["flight", "no-truth", "closed-loop", "runs"])
def test_the_page_is_read_at_any_width_by_day_and_by_night(browser, pages, name, size, scheme):
    dress(browser, scheme)
    browser.open(pages[name], WIDTHS[size])
    assert browser.complaints() == []
    assert browser.requests() == [pages[name].resolve().as_uri()]
    assert browser.run("return document.documentElement.scrollWidth") == WIDTHS[size]
    assert browser.run(SCRIPT) == []
    dark = browser.run("return getComputedStyle(document.body).backgroundColor")
    assert (dark == "rgb(19, 22, 26)") == (scheme == "dark")
    assert all(browser.run("return [...document.querySelectorAll('svg[role]')].map(s => !!s.ariaLabel)"))


def test_a_name_that_is_markup_is_shown_as_text(browser, pages):
    browser.open(pages["flight"], 1400)
    assert browser.run("return typeof hacked") == "undefined"
    assert browser.run("return document.querySelectorAll('img').length") == 0


@pytest.mark.parametrize("name", ["flight", "no-truth", "closed-loop"])
def test_ellipses_are_outlines_and_few(browser, pages, name):
    browser.open(pages[name], 1400)
    fills = browser.run("return [...document.querySelectorAll('.map ellipse')].map(e => getComputedStyle(e).fill)")
    assert 0 < len(fills) <= 80  # each with its rim
    assert set(fills) == {"none"}


def test_the_map_is_in_colour_and_wider_than_a_frame(browser, pages):
    browser.open(pages["flight"], 1400)
    href = browser.run("return document.querySelector('.map image').getAttribute('href')")
    jpeg = np.frombuffer(base64.b64decode(href.partition(",")[2]), np.uint8)
    blue, _, red = cv2.split(cv2.imdecode(jpeg, cv2.IMREAD_COLOR).astype(int))
    assert np.abs(blue - red).max() > 30
    width_m = float(texts(browser, ".on-map + .hint")[0].split()[0])
    assert 200 < width_m < 600  # a frame shows 173


def span(browser):
    return [float(t) for t in texts(browser, "#time-span")[0].split(" to ")]


def drag(browser, begin, end):
    """From one share of the first chart's width to another, until the page shows another span of time."""
    before = json.dumps(texts(browser, "#time-span")[0])
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
    browser.open(pages["closed-loop"], 1400)
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
    assert browser.run(shown) > 3
    browser.run("document.querySelector('[data-run=\"1\"]').click()")
    assert browser.run(shown) == 0


def test_the_numbers_on_the_page_are_those_of_the_metrics(browser, pages):
    folder = pages["closed-loop"].parent
    rows, truth = read_track(folder / "track.csv"), read_truth(folder / "truth.csv")
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    mine = summarise(rows, truth, frame=LocalFrame(**summary["settings"]["origin"]))
    browser.open(pages["closed-loop"], 1400)
    tiles = dict(zip(texts(browser, ".tiles li span"), texts(browser, ".tiles li strong"), strict=True))
    assert tiles["median error"] == metres(mine["median_m"])
    assert tiles["largest error"] == metres(mine["max_m"])
    assert tiles["within 3 stated sigmas; 98.9 % if consistent"] == f"{mine['within_3_sigma']:.1%}"


def test_the_closed_loop_says_how_far_it_was_from_its_plan(browser, pages):
    figures = json.loads((pages["closed-loop"].parent / "loop.json").read_text(encoding="utf-8"))
    browser.open(pages["closed-loop"], 1400)
    (said,) = texts(browser, ".verdict")
    for key in ("plan_rms_m", "plan_max_m", "estimate_rms_m"):
        assert metres(figures[key]) in said


PICTURES = "return [...document.querySelectorAll('#pictures image')].map(i => i.getAttribute('href'))"


def test_keys_move_through_the_frames(browser, pages):
    browser.open(pages["flight"], 1280)
    seen = [browser.run(PICTURES)]
    for key in ("ArrowRight", "ArrowRight"):
        browser.press(key)
        seen.append(browser.run(PICTURES))
    assert [len(pictures) for pictures in seen] == [4, 4, 4]
    assert len({pictures[0] for pictures in seen}) == 3
    assert texts(browser, "#facts h3") == ["000002.jpg"]
    browser.press("ArrowLeft")
    assert browser.run(PICTURES) == seen[1]
    browser.run("document.getElementById('slider').focus()")
    browser.press("End")  # the slider's own
    assert texts(browser, "#facts h3") == [f"{FRAMES - 1:06d}.jpg"]
    assert browser.complaints() == []


def test_a_refusal_is_found_from_its_reason(browser, pages):
    browser.open(pages["flight"], 1280)
    browser.run("document.querySelector('[data-goto]').click()")
    assert texts(browser, "#facts h3") == [f"{DARK:06d}.jpg"]
    assert texts(browser, "#facts .answer") == ["Refused: no texture"]


def test_the_map_zooms_about_the_frame_shown(browser, pages):
    browser.open(pages["flight"], 1280)
    box = "return document.getElementById('map').getAttribute('viewBox').split(' ').map(Number)"
    whole = browser.run(box)
    browser.run("document.getElementById('zoom-in').click()")
    near = browser.run(box)
    x, y = data_of(pages["flight"])["frames"][0]["xy"]
    assert near[2] == pytest.approx(0.6 * whole[2])
    assert near[0] <= x <= near[0] + near[2]
    assert near[1] <= y <= near[1] + near[3]
    browser.run("document.getElementById('zoom-all').click()")
    assert browser.run(box) == whole
