"""Every measured figure in the README and the pages is one of docs/results.

``FIGURES`` says which rows of which results a page quotes. A figure that changes on either side fails here, as
does one that is quoted without an entry.
"""

import re

import pytest

from tests.support.paths import ROOT

FIGURES = {  # page: claim: results page, heading and words of each row that states it
    "README.md": {
        "| 9 photographs of a wooded park | 0.48 | 0 | 0.91 |":
            [("field.md", "`brighton`", "| auto |", "| plain classical recipe")],
        "| 82 near-infrared photographs of fields | 0.58 | 0 | 1.16 |":
            [("field.md", "`seneca`", "| auto |", "| plain classical recipe")],
        "| 37 photographs of bare ground | 0.13 | 0 | 0.71 |":
            [("field.md", "`caliterra`", "| auto |", "| plain classical recipe")],
        "| 271 video frames of a campus, satellite map of another date | 1.08 | 0 | 1.15 |":
            [("field.md", "`nust`", "| auto |", "| paper's NCC, OpenCV |")],
        "| 79 frames from Gazebo and ArduPilot | 0.19 | 0 | 1.23 |":
            [("field.md", "`gazebo-a1`:", "| auto,"), ("field.md", "The paper's recipe", "| `gazebo-a1` |")],
        "| the same flight in evening light, map of noon | 0.21 | 0 | 1.31 |":
            [("field.md", "`gazebo-a1-evening`", "| auto,", "| plain classical recipe")],
        "5 to 120 ms a frame":
            [("field.md", "`gazebo-a1`:", "| auto,"), ("field.md", "`brighton`", "| auto |")],
        "30 to 185 m above ground":
            [("field.md", "`caliterra`", "survey photographs"), ("video.md", "A public", "every fifth frame")],
        "five minutes in 10 m/s wind without GNSS, their EKFs 0.1 m RMS off":
            [("mavlink.md", "Five minutes", "| ArduCopter | `odometry` | `auto` | 10 |", "| PX4 | `odometry` |")],
    },
    "docs/calibrate.md": {
        "300 x 300 px were enough from 100 m": [("mavlink.md", "ArduCopter SITL", "ArduCopter 4.8-dev")],
    },
    "docs/embed.md": {"`auto` needs 6.8 ms": [("latency.md", "Table I", "| auto, scenematch | 1 |")]},
    "docs/datasets.md": {"by 26 degrees": [("datasets.md", "Published", "The 26 degrees")]},
    "docs/first-hour.md": {
        "300 of 300 frames were fixed, with 0.20 m RMS and 0.65 m at most":
            [("simulator.md", "The first hour", "| `track`")],
        "(here 290 of 300)": [("simulator.md", "The first hour", "290 of 300 fixes")],
    },
    "docs/how-ncc-works.md": {"from 1.4 to 0.15 m": [("ncc.md", "Dense refinement", "| `gazebo-a1` |")]},
    "docs/mavlink.md": {
        "PX4's position in simulation was 0.07 to 0.09 m RMS off":
            [("mavlink.md", "Five minutes", "| PX4 | `odometry` | NCC | 10 |", "| PX4 | `odometry` | NCC | 5 |")],
        "by `global_position_sensor` 0.7 m":
            [("mavlink.md", "Five minutes", "| PX4 | `global_position_sensor` | NCC |")],
        "some 0.1 s": [("vehicle.md", "The unit of systemd", "| worker killed |")],
        "takes 2 to 3 s to its first fix":
            [("mavlink.md", "Starts", "| bridge, NCC |", "| bridge, `auto` |")],
        "3 to 6 s without": [("mavlink.md", "Starts", "| bridge, NCC |", "| bridge, `auto` |")],
    },
    "docs/odometry.md": {
        "Drift over 5 s without a match was 2 m per 100 m":
            [("odometry.md", "Gaps", "Velocities are withheld", "| gazebo-a1 | odometry |")],
        "4 m on real video": [("odometry.md", "Gaps", "| nust | odometry |")],
    },
    "docs/seasons.md": {
        "NCC answered 93 to 100 %":
            [("seasons.md", "First draw", "| naip-cities (900) | **NCC**", "| naip (900) | **NCC**")],
        "SIFT 89 to 95 %":
            [("seasons.md", "Second draw", "| naip-cities (5,000) | SIFT", "| naip (2,000) | SIFT")],
    },
    "docs/vehicle.md": {
        "some 0.1 s": [("vehicle.md", "The unit of systemd", "| worker killed |")],
        "those of x86-64 to 0.15 mm": [("vehicle.md", "arm64", "| 11 frames")],
        "1.5 GB on disk": [("vehicle.md", "On disk", "| plain |")],
        "0.3 GB of memory for NCC": [("vehicle.md", "To the first fix", "| ncc | all kept |")],
        "0.6 GB for `auto`": [("vehicle.md", "To the first fix", "| auto | all kept |")],
        "1 to 3 s to the first fix":
            [("vehicle.md", "To the first fix", "| ncc | all kept |", "| auto | all kept |")],
        "35 s before that": [("vehicle.md", "To the first fix", "| auto | nothing kept |")],
    },
    "docs/walkthrough-photographs.md": {
        "SIFT fixed 5 on a map of 0.41 m/px (1.30 m RMS)": [("photographs.md", "The map", "| 0.41")],
        "all on one of 0.10 (1.00 m": [("photographs.md", "The map", "| 0.10")],
        "RMS error 1.08 m median error 1.06 m":
            [("photographs.md", "A public", "| `track`")],
        "within 1.51 m largest error 1.71 m": [("photographs.md", "A public", "| `track`")],
        "18 of a park, 44 m up": [("photographs.md", "A public", "18 photographs")],
        "3.1 degrees too high": [("photographs.md", "A public", "`check` located")],
        "81.7 degrees": [("photographs.md", "Photographs", "The [walkthrough]")],
        "`--hfov-deg 70.8` gives 0.73 m RMS": [("photographs.md", "A public", "| the same, `--hfov")],
    },
    "docs/walkthrough-video.md": {
        "All 265 frames are fixed, 0.83 m RMS": [("video.md", "A public", "| `--method ncc --settings")],
        "hangs aside: 17.1 m": [("video.md", "A public", "| `--method ncc` |")],
        "its positions: 1.06 m RMS": [("video.md", "A public", "Beside the stand-in")],
    },
    "docs/wrong-inputs.md": {
        "3 degrees of heading": [("wrong-inputs.md", "Faults", "| heading off by 3 |")],
        "5 % of the focal length": [("wrong-inputs.md", "Faults", "| focal length off by 5 % |")],
    },
}  # fmt: skip

FIGURE = re.compile(
    r"(?<![\w.])(\d+(?:\.\d+)?)(?= (?:m|mm|ms|s|GB|MB|degrees|%|of \d+|RMS)(?!\w)| to [\d.]+ (?:m|ms|s|%))"
)
UNMEASURED = {  # what the front pages state as assumed
    "README.md": ["only good to 1 m", "includes: 3 m (1 sigma) unless", "over 10 m off"],
    "docs/index.md": [],
}


def page(name):
    """A page as one line, so that a claim may run over two."""
    return " ".join((ROOT / name).read_text(encoding="utf-8").split())


def results(name, heading, *words):
    """The first row or paragraph with each of these words, from the heading on that begins with those."""
    text = (ROOT / "docs" / "results" / name).read_text(encoding="utf-8")
    section = re.search(rf"^#+ ({re.escape(heading)}.*?)(?=^#|\Z)", text, re.MULTILINE | re.DOTALL)
    assert section, f"{name}: no heading begins with {heading}"
    rows = [" ".join(row.split()) for row in re.split(r"\n\n|\n(?=\|)", section[1])]
    return [next(row for row in rows if each in row) for each in words]


def numbers(text):
    return [word.replace(",", "") for word in re.findall(r"(?<![\w.-])\d[\d,]*(?:\.\d+)?", text)]


def states(rows, word):
    """Whether rows state a number, to its decimals, in its unit or in thousandths of it."""
    half = 0.5 * 10.0 ** -len(word.partition(".")[2]) + 1e-9
    return any(abs(float(word) - float(row) / unit) <= half for row in rows for unit in (1.0, 1000.0))


CLAIMS = [(name, claim) for name, claims in FIGURES.items() for claim in claims]


@pytest.mark.parametrize(("name", "claim"), CLAIMS)
def test_a_quoted_figure_is_that_of_the_results(name, claim):
    assert claim in page(name), f"{name} does not say: {claim}"
    rows = [number for where in FIGURES[name][claim] for number in numbers(" ".join(results(*where)))]
    assert numbers(claim)
    assert [word for word in numbers(claim) if not states(rows, word)] == []


def without_claims(name, text):
    """Text without what is traced or was never measured."""
    for claim in [*FIGURES.get(name, []), *UNMEASURED.get(name, [])]:
        text = text.replace(claim, "")
    return text


@pytest.mark.parametrize("name", sorted(UNMEASURED))
def test_every_figure_of_the_front_pages_is_traced(name):
    assert FIGURE.findall(without_claims(name, re.sub(r"```.*?```", "", page(name)))) == []


PAGES = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").glob("*.md"))


@pytest.mark.parametrize("name", PAGES)
def test_every_figure_beside_a_link_to_results_is_traced(name):
    sentences = re.split(r"(?<=[.:]) (?=[A-Z`*|])| (?=#+ )", without_claims(name, page(name)))
    assert {s: FIGURE.findall(s) for s in sentences if "(results/" in s and FIGURE.search(s)} == {}
