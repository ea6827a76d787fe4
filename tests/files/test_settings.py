"""Settings files: made from the option classes, read back with every key checked."""

import re

import pytest

from engine import NavigatorOptions, SiftOptions
from scenematch.files.settings import changed, field_descriptions, options_from_mapping, settings_text
from scenematch.runs.settings import TrackSettings, load_settings
from tests.support.refusals import misuse

KEY = re.compile(r"^#(\w+ = )", re.MULTILINE)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "settings.toml"


def loaded(path, text, **typed):
    path.write_text(text, encoding="utf-8")
    return load_settings(path, **typed)


def test_all_keys_set_to_what_the_file_shows_are_the_defaults(path):
    text = settings_text(TrackSettings())
    assert loaded(path, KEY.sub(r"\1", text)) == TrackSettings()
    assert len(KEY.findall(text)) > 40


def test_every_field_that_a_file_can_hold_is_explained():
    """A key without a meaning would fail here by its name: the classes' docstrings are the file's comments."""
    text = settings_text(TrackSettings())
    for line in KEY.findall(text):
        before = text[: text.index("\n#" + line)]
        assert before.splitlines()[-1].startswith("# "), line


def test_values_arrive(path):
    text = 'method = "sift"\n[ncc]\nexclusion_m = 2\n[errors]\nmap_m = 6.5\n[navigator]\nodometry = true\n'
    text += '[telemetry_columns]\nheight_agl_m = "altitude_agl [m]"\n'
    found = loaded(path, text)
    assert (found.method, found.ncc.exclusion_m, found.errors.map_m) == ("sift", 2.0, 6.5)
    assert found.navigator.odometry is True
    columns = {"height_agl_m": "altitude_agl [m]"}
    assert found.telemetry_columns == columns
    options = {"method": "sift", "ncc.exclusion_m": 2.0, "errors.map_m": 6.5, "navigator.odometry": True}
    assert changed(found) == options | {"telemetry_columns": columns}
    assert changed(TrackSettings()) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("risk = 5", "risk: expected a probability above 0 and below 1, got 5.0"),
        ('profile = "fast"', "profile: expected one of engine, paper, got 'fast'"),
        ("methud = 'ncc'", "methud: not a setting; did you mean method?"),
        ("[ncc]\nexclusoin_m = 1", "ncc.exclusoin_m: not a setting; did you mean exclusion_m?"),
        ("[errors]\nmpa_m = 4", "errors.mpa_m: not a setting; did you mean map_m?"),
        ("[ncc]\nzebra = 1", "ncc.zebra: not a setting; expected one of "),
        ('[ncc]\nexclusion_m = "wide"', "ncc.exclusion_m: expected a number, got 'wide'"),
        ("[ncc]\nexclusion_m = 0.0", "ncc.exclusion_m: expected a number above 0, got 0.0"),
        ("[sift]\nupsample = 2.5", "sift.upsample: expected a whole number, got 2.5"),
        ("[ncc]\nrefine = 1", "ncc.refine: expected true or false, got 1"),
        ("errors = 3", "errors: expected a table, got 3"),
        ("[errors]\nmap_m = -1", "errors.map_m: expected a number above 0, got -1.0"),
        ("[errors]\nmap_m = 1e200", "errors.map_m: expected at most 1e+06, got 1e+200"),
        ('[telemetry_columns]\naltitude = "alt"', "telemetry_columns: expected one of timestamp_ns, "),
        (
            '[telemetry_columns]\nframe = " "',
            "telemetry_columns.frame: expected the name of a column, got an empty",
        ),
        ("[telemetry_columns]\nframe = 3", "telemetry_columns.frame: expected a quoted string, got 3"),
        ("exclusion_m = ", "expected TOML, got something else: "),
    ],
)
def test_what_is_wrong_is_named(path, text, message):
    assert misuse(loaded, path, text).startswith(f"{path}: {message}")


def test_a_file_cannot_hold_what_is_no_value():
    """A matcher of the user's own is code; a file that names one is refused with that reason."""
    assert misuse(options_from_mapping, SiftOptions, {"matcher": "mine"}).startswith("matcher: not a setting")


def test_meanings_are_whole_sentences_of_the_docstring():
    meanings = field_descriptions(NavigatorOptions)
    assert meanings["memory_s"].endswith("agree with each other can outweigh it.")
    assert set(meanings) == set(NavigatorOptions.__dataclass_fields__)
