"""Settings files: made from the option classes, read back with every key checked."""

import re
from dataclasses import replace

import pytest

from engine import OptionError
from engine.options import NavigatorOptions, SiftOptions
from scenematch.files.settings import (
    changed,
    field_descriptions,
    options_from_mapping,
    settings_text,
)
from scenematch.runs.settings import TrackSettings, load_settings

KEY = re.compile(r"^#(\w+ = )", re.MULTILINE)


def test_all_keys_set_to_what_the_file_shows_are_the_defaults(tmp_path):
    path = tmp_path / "all.toml"
    text = KEY.sub(r"\1", settings_text(TrackSettings()))
    path.write_text(text, encoding="utf-8")
    assert load_settings(path) == TrackSettings()
    assert len(KEY.findall(settings_text(TrackSettings()))) > 60


def test_a_new_file_changes_nothing(tmp_path):
    path = tmp_path / "new.toml"
    path.write_text(settings_text(TrackSettings()), encoding="utf-8")
    assert load_settings(path) == TrackSettings()


def test_every_field_that_a_file_can_hold_is_explained():
    """A key without a meaning would fail here by its name: the classes' docstrings are the file's comments."""
    text = settings_text(TrackSettings())
    for line in KEY.findall(text):
        before = text[: text.index("\n#" + line)]
        assert before.splitlines()[-1].startswith("# "), line


def test_values_arrive(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'method = "sift"\n[ncc]\nexclusion_m = 2\n[ncc.errors]\nmap_m = 6.5\n[navigator]\nodometry = true\n',
        encoding="utf-8",
    )
    found = load_settings(path)
    assert (found.method, found.ncc.exclusion_m, found.ncc.errors.map_m) == ("sift", 2.0, 6.5)
    assert found.navigator.odometry is True
    assert changed(found) == {
        "method": "sift",
        "ncc.exclusion_m": 2.0,
        "ncc.errors.map_m": 6.5,
        "navigator.odometry": True,
    }
    assert changed(TrackSettings()) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("risk = 5", "risk: expected a probability above 0 and below 1, got 5.0"),
        ('profile = "fast"', "profile: expected one of engine, paper, got 'fast'"),
    ],
)
def test_what_the_matcher_would_refuse_is_refused_as_the_file_is_read(tmp_path, text, message):
    path = tmp_path / "bad.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(OptionError) as caught:
        load_settings(path)
    assert str(caught.value) == f"{path}: {message}"


def test_the_command_line_counts_more_than_the_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('method = "sift"\nbudget_ms = 40\n', encoding="utf-8")
    found = load_settings(path, method="ncc", budget_ms=None)
    assert found == replace(TrackSettings(), method="ncc", budget_ms=40.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("exclusoin_m = 1", "exclusoin_m: not a setting; did you mean exclusion_m?"),
        ("[errors]\nmpa_m = 4", "errors.mpa_m: not a setting; did you mean map_m?"),
        ("zebra = 1", "zebra: not a setting; expected one of score, "),
        ('exclusion_m = "wide"', "exclusion_m: expected a number, got 'wide'"),
        ("exclusion_m = 0.0", "exclusion_m: expected a number above 0, got 0.0"),
        ("enhance_radius_px = 2.5", "enhance_radius_px: expected a whole number, got 2.5"),
        ("refine = 1", "refine: expected true or false, got 1"),
        ("errors = 3", "errors: expected a table, got 3"),
        ("[errors]\nmap_m = -1", "errors.map_m: expected a number above 0, got -1.0"),
        ("exclusion_m = ", "expected TOML, got something else: "),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, message):
    path = tmp_path / "bad.toml"
    path.write_text("[ncc]\n" + text.replace("[errors]", "[ncc.errors]"), encoding="utf-8")
    with pytest.raises(OptionError) as caught:
        load_settings(path)
    assert str(caught.value).startswith((f"{path}: ncc.{message}", f"{path}: {message}"))
    assert "\n" not in str(caught.value)


def test_a_file_cannot_hold_what_is_no_value():
    """A matcher of the user's own is code; a file that names one is refused with that reason."""
    with pytest.raises(OptionError, match=r"^matcher: not a setting"):
        options_from_mapping(SiftOptions, {"matcher": "mine"})


def test_meanings_are_whole_sentences_of_the_docstring():
    meanings = field_descriptions(NavigatorOptions)
    assert meanings["memory_s"].endswith("agree with each other outweigh it.")
    assert set(meanings) == set(NavigatorOptions.__dataclass_fields__)
