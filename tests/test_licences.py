"""The notices list what is installed for whom, under its licences; an image is built of the whole distribution."""

import re
import tomllib
from importlib import metadata

import pytest

from tests.support.paths import ROOT

FILE = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = FILE["project"]
NOTICES = (ROOT / "THIRD_PARTY_NOTICES.md").read_text(encoding="utf-8")
FOR_DEVELOPERS = {"test", "bench", "docs", "dev"}
NAME = re.compile(r"[A-Za-z0-9._-]+")
NEEDED = dict(re.findall(r"^\| ([\w-]+) \| ([^|]+) \| [^|]*\|$", NOTICES.split("\n## ")[1], re.MULTILINE)[1:])
OF_EXTRAS = re.findall(r"^\| `(\w+)` \| ([\w-]+) \| ([^|]+) \|$", NOTICES, re.MULTILINE)


def names(requirements):
    return {NAME.match(each)[0] for each in requirements} - {PROJECT["name"]}  # an extra may contain another


def test_every_package_that_is_needed_is_listed():
    assert set(NEEDED) == names(PROJECT["dependencies"])


def test_every_package_of_an_extra_is_listed():
    extras = {name: each for name, each in PROJECT["optional-dependencies"].items() if name not in FOR_DEVELOPERS}
    wanted = {(extra, name) for extra, requirements in extras.items() for name in names(requirements)}
    assert {(extra, name) for extra, name, _ in OF_EXTRAS} == wanted


@pytest.mark.parametrize(
    ("name", "licence"), [*NEEDED.items(), *((name, licence) for _, name, licence in OF_EXTRAS)]
)
def test_a_licence_is_that_which_its_package_declares(name, licence):
    try:
        facts = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        pytest.skip(f"{name} is not installed")
    fields = (facts.get("License-Expression"), facts.get("License"), *(facts.get_all("Classifier") or ()))
    declared = " ".join(field for field in fields if field)
    families = re.findall(r"Apache|BSD|MIT|LGPL|matplotlib", licence)
    assert families
    assert all(family in declared for family in families), declared[:200]


def test_the_notices_are_in_the_distribution():
    assert set(PROJECT["license-files"]) == {"LICENSE", "THIRD_PARTY_NOTICES.md"}


def test_an_image_is_built_of_every_package():
    recipe, sent = ((ROOT / name).read_text(encoding="utf-8") for name in ("Containerfile", ".containerignore"))
    for pattern in FILE["tool"]["setuptools"]["packages"]["find"]["include"]:
        package = pattern.rstrip("*")
        assert f"COPY {package} /src/{package}\n" in recipe
        assert f"!{package}\n" in sent
