"""Options: how many there are, one spelling for one thing, and settings that take the place of the rare ones."""

import pytest

from scenematch.cli.app import run
from scenematch.cli.options import FlightOptions, live_view
from scenematch.runs.settings import Settings
from tests.support.commands import LEAVES
from tests.support.refusals import misuse

MAX_COMMANDS, MAX_OPTIONS = 14, 150


def options(command):
    return [option for option in command.params if any(name.startswith("--") for name in option.opts)]


def test_there_are_few():
    assert len(LEAVES) <= MAX_COMMANDS
    assert sum(len(options(command)) for command in LEAVES.values()) <= MAX_OPTIONS


def test_an_option_that_several_commands_have_is_of_one_kind():
    names = {}
    for command in LEAVES.values():
        for option in options(command):
            names.setdefault(option.name, set()).update(option.opts)
    spelled = {name: found for name, found in names.items() if len(found) > 1}
    assert spelled == {"out": {"--out", "--write-params"}}


def test_help_has_panels(capsys):
    assert run(["track", "--help"]) == 0
    printed = capsys.readouterr().out
    places = [printed.index(f"\n{panel}:\n") for panel in ("Map", "Input", "Options", "Expert", "Output")]
    assert places == sorted(places)


def test_later_settings_count_more_and_options_most(save):
    text = 'method = "sift"\nbudget_ms = 40\n[input]\nevery = 2\n[bridge]\nnice = -5\nrealtime = true\n'
    settings = Settings.read([save(text, "mine.toml"), "input.every=3", "navigator.odometry=true"])
    assert settings.table("input").every == 3
    track = settings.track(method="ncc", device=None)
    assert (track.method, track.budget_ms, track.navigator.odometry, track.device) == ("ncc", 40.0, True, "auto")
    assert settings.threads == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("inptu.every=3", "inptu: not a setting; did you mean input?"),
        ("input.evry=3", "input.evry: not a setting; did you mean every?"),
        ("input=3", "input: expected a table, got 3"),
        ("threads=0", "threads: expected a whole number above 0, got 0"),
        ("mavlink.connect=tcp:a:1", "mavlink.connect: not a setting"),
    ],
)
def test_a_setting_that_is_none_is_named(text, words):
    def read():
        settings = Settings.read([text])
        return settings.threads, settings.table("input"), settings.table("mavlink", connect="x")

    assert misuse(read).startswith(words)


def test_a_file_is_named_with_its_setting(save):
    settings = Settings.read([save("[input]\nevery = 'few'\n", "mine.toml"), "input.log_offset_s=1"])
    assert "mine.toml: input.every: expected a whole number" in misuse(settings.table, "input")


def test_files_are_those_of_options_and_settings():
    settings = Settings.read(["input.every=5", "input.map_sigma_m=2.0"])
    flight = FlightOptions(map="m.tif", frames="f", hfov_deg=60.0)
    files = flight.files(settings, ["heading_offset_deg=3", "roll_deg=-pitch_deg"])
    assert (files.every, files.map.map_sigma_m, files.corrections.heading_offset_deg) == (5, 2.0, 3.0)


def test_a_live_view_goes_to_a_file_and_to_a_viewer():
    assert not live_view(None)
    target = live_view(["a.rrd", "127.0.0.1:9876"])
    assert (target.recording, target.viewer) == ("a.rrd", "127.0.0.1:9876")
    assert misuse(live_view, ["a.rrd", "b.rrd"]).startswith("recording: expected one file and one viewer at most")


def test_the_settings_file_lists_every_table(save, capsys):
    assert run(["doctor", "--settings"]) == 0
    text = capsys.readouterr().out
    lines = ("#threads = 1", '#method = "auto"', "[input]", "#every = 1", "[mavlink]", "[ros.topics]", "[fetch]")
    assert all(f"\n{line}\n" in text for line in lines)
    assert Settings.read([save(text, "all.toml")]).table("input") == Settings().table("input")
