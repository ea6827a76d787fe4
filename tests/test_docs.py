"""The documentation tells the truth: its snippets run, its links resolve, its lists are those of the code."""

import ctypes
import os
import re
import tomllib
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest

from docs.draw_architecture import drawn, floors, members, picture
from docs.site_commands import with_options
from docs.site_roles import on_page_content
from engine import AssumedErrors, MatcherOptions, NavigatorOptions, NccOptions, PoseOptions, Reason, SiftOptions
from scenematch.files.track import COLUMNS
from tests.support.commands import LEAVES
from tests.support.paths import ROOT

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
FENCE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
INCLUDE = re.compile(r'^--8<-- "(.+)"$', re.MULTILINE)
CODE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def page_name(path):
    return path.relative_to(ROOT).as_posix()


def read(name):
    return (ROOT / name).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def flight(flight_in, tmp_path_factory):
    """The folder in which a reader would try the snippets."""
    folder = tmp_path_factory.mktemp("docs")
    flight_in(folder, frames=3)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if FENCE.search(page.read_text("utf-8"))], ids=page_name)
def test_snippets_run_as_they_stand(page, flight, monkeypatch):
    monkeypatch.chdir(flight)
    names = {"__name__": page.stem}  # the snippets of a page follow each other
    with ThreadPoolExecutor(1) as reader:  # a snippet that asks for real time shall not leave it to other tests
        for number, snippet in enumerate(FENCE.findall(with_examples(page))):
            reader.submit(exec, compile(snippet, f"{page.name}, snippet {number + 1}", "exec"), names).result()
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    ctypes.CDLL(None).munlockall()


def with_examples(page):
    """The page as the site shows it, with the examples that it includes."""
    return INCLUDE.sub(lambda name: read(f"examples/{name[1]}"), page.read_text(encoding="utf-8"))


def test_every_example_is_shown_by_a_page():
    shown = {name for page in PAGES for name in INCLUDE.findall(page.read_text(encoding="utf-8"))}
    assert shown == {path.name for path in (ROOT / "examples").glob("*.py")}


def test_no_role_is_shown_raw_on_the_site():
    found = Counter()
    for path in [*(ROOT / "engine").rglob("*.py"), *(ROOT / "scenematch").rglob("*.py")]:
        for role, name in re.findall(r"(:[a-z]+:)`([^`]*)`", path.read_text(encoding="utf-8")):
            html = on_page_content(f"<p>see {role}<code>{name}</code>, and more</p>")
            assert role not in html, f"{path.name}: {role}`{name}`"
            assert f'identifier="{name}"' in html
            found[role] += 1
    assert found[":func:"] > 10


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_resolve(page):
    text = CODE.sub("", page.read_text(encoding="utf-8"))
    for link in LINK.findall(text):
        if not link.startswith(("https://", "#")):
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve()
            assert target.exists(), f"{page.name}: {link}"
            assert not anchor or anchor in headings(target), f"{page.name}: {link}"


def headings(page):
    titles = re.findall(r"^#+ (.+)$", CODE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_the_readme_is_short():
    assert len(read("README.md").split()) <= 500


def test_every_page_is_reached_from_the_readme():
    reached, pending = set(), [ROOT / "README.md"]
    while pending:
        page = pending.pop()
        if page in reached:
            continue
        reached.add(page)
        links = [link.partition("#")[0] for link in LINK.findall(page.read_text(encoding="utf-8"))]
        pending += [(page.parent / link).resolve() for link in links if link.endswith(".md") and "://" not in link]
    assert set(PAGES) <= reached


def test_the_site_shows_every_page():
    nav = re.findall(r": (\S+\.md)$", read("mkdocs.yml"), re.MULTILINE)
    docs = ROOT / "docs"
    assert sorted(nav) == sorted(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))


def test_pages_fit_the_line():
    for page in PAGES:
        prose = CODE.sub("", page.read_text(encoding="utf-8"))
        long = [line for line in prose.splitlines() if len(line) > 120 and not line.startswith(("|", "`"))]
        assert not long, f"{page.name}: {long}"


def test_pages_use_the_words_of_the_field():
    private = r"laid|bank|rungs?|ladder|priced?|told|surer|leans|boastful|watchman|believe[sd]?|beliefs?"
    for page in PAGES:
        prose = re.sub(r"`[^`]*`", "", CODE.sub("", page.read_text(encoding="utf-8")))
        assert re.findall(rf"\b(?:{private})\b", prose, re.IGNORECASE) == [], page.name


# ------------------------------------------------------------------------------------------- architecture


PATH = re.compile(r"`(engine/[\w/]+(?:\.\w+)?)`")


def test_architecture_is_drawn_from_the_code():
    """``python docs/draw_architecture.py`` draws it anew."""
    assert sorted(name for names in floors() for name in names) == sorted(members())
    page = read("docs/architecture.md")
    assert page == drawn(page)
    assert read("docs/img/architecture.svg") == picture()


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_files_and_benchmarks_that_a_page_names_are_there(page):
    text = page.read_text(encoding="utf-8")
    benchmarks = re.findall(r"python\s+-m\s+(bench(?:\.\w+)+)", text)
    named = [*PATH.findall(text), *(f"{name.replace('.', '/')}.py" for name in benchmarks)]
    assert [name for name in named if not (ROOT / name).exists()] == []
    assert named or page.name != "architecture.md"


# ------------------------------------------------------------------------------------------ lists and values


def test_every_reason_is_explained():
    stated = set(re.findall(r"`(\w+)`", " ".join(line for line in read("docs/integrity.md").split("\n\n")[2:3])))
    assert {reason.value for reason in Reason} <= stated


OWNERS = (MatcherOptions, NccOptions, PoseOptions, SiftOptions, NavigatorOptions, AssumedErrors)


def test_defaults_are_those_of_the_code():
    owners = {cls.__name__: cls() for cls in OWNERS}
    found = re.findall(r"^\| `(\w+)\.(\w+)` \| (\S+) \|", read("docs/integrity.md"), re.MULTILINE)
    assert len(found) > 10
    for owner, name, value in found:
        assert float(value) == getattr(owners[owner], name), f"{owner}.{name}"
    assumed = {name for owner, name, _ in found if owner == "AssumedErrors"}
    assert assumed == set(AssumedErrors.__dataclass_fields__)


def test_columns_of_the_track_are_listed():
    assert f"`{','.join(COLUMNS)}`" in read("docs/map-and-flight-files.md")


def test_every_command_has_its_section():
    stated = set(re.findall(r"^## (.+)$", read("docs/command-line.md"), re.MULTILINE))
    assert stated == {" ".join(words) for words in LEAVES}


def command_options():
    """Options by command, without those that the page tells once for all."""
    for name, command in LEAVES.items():
        words = {word for option in command.params for word in (*option.opts, *option.secondary_opts)}
        options = {word for word in words if word.startswith("--")}
        yield " ".join(name), sorted(options - {"--help", "--json", "--force"})


@pytest.mark.parametrize(("command", "options"), sorted(command_options()), ids=lambda value: str(value)[:20])
def test_every_option_is_in_the_lines_of_its_command(command, options):
    section = read("docs/command-line.md").split(f"## {command}\n", 1)[1].split("\n## ", 1)[0]
    lines = next(iter(re.findall(r"^```\n(.*?)^```", section, re.MULTILINE | re.DOTALL)), "")
    assert set(re.findall(r"--[a-z][a-z-]*", lines)) - {"--force"} == set(options)


def test_the_site_shows_the_help_of_every_option():
    shown = with_options(read("docs/command-line.md"))
    for command, options in command_options():
        section = shown.split(f"## {command}\n", 1)[1].split("\n## ", 1)[0]
        rows = re.findall(r"^\| `(--[a-z-]+)[^|]*\| .* \| .+ \|$", section, re.MULTILINE)
        assert set(options) <= set(rows), command


def test_the_changelog_names_the_version():
    version = tomllib.loads(read("pyproject.toml"))["project"]["version"]
    assert re.search(rf"^## .*{re.escape(version)}", read("CHANGELOG.md"), re.MULTILINE)
