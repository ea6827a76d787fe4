"""With --json standard output holds one JSON value: the result, or what is wrong and of which argument."""

import json

import pytest

from scenematch.cli.app import run
from tests.support.commands import LEAVES, answer


@pytest.mark.parametrize("words", LEAVES, ids=" ".join)
def test_every_command_takes_json(words):
    assert any("--json" in option.opts for option in LEAVES[words].params)


def spoken(capsys, arguments, code):
    """The object on standard output, and the line on standard error."""
    assert run([*arguments, "--json"]) == code
    printed = capsys.readouterr()
    assert printed.err.startswith("scenematch: ")
    found = json.loads(printed.out)
    assert list(found) == ["error", "argument"]
    assert printed.err == f"scenematch: {found['error']}\n"
    return found


@pytest.mark.parametrize(
    ("arguments", "argument", "code"),
    [
        (["track"], "--map", 2),  # the first that is missing
        (["track", "--nonsense"], "--nonsense", 2),
        (["evaluate"], "DIR", 2),
        (["nonsense"], None, 2),
        (["demo", "--frames=x"], "--frames", 2),
        (["demo", "--frames=1"], "--frames", 2),
        (["track", "--map=m", "--frames=f", "--out=o", "--device=gpu"], "--device", 2),
        (["simulate", "--out=o", "--minutes=1"], "--minutes", 2),
        (["map", "info", "m.tif"], "MAP", 1),
        (["track", "--map=m.tif", "--frames=f", "--out=o", "--telemetry=no.csv"], "--map", 1),
        (["evaluate", "nothing/here"], "DIR", 1),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_an_error_names_its_argument(arguments, argument, code, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert spoken(capsys, arguments, code)["argument"] == argument


@pytest.mark.parametrize(
    "url",
    ["https://a.org/a[b]/map.tif", "s3://bucket//key", "file:///[red]m[/red].tif", "rtsp://[::1]:8554/x?a=b"],
)
def test_a_url_is_repeated_as_it_was_typed(url, capsys):
    for arguments in (
        ["map", "info", url],
        ["track", f"--map={url}", "--frames=f", "--out=o"],
        ["track", "--map", url, "--frames=f", "--out=o"],
    ):
        assert url in spoken(capsys, arguments, 1)["error"]


def test_files_that_commands_write_are_named(tmp_path, capsys):
    parameters = tmp_path / "p.param"
    command = ["bridge", "mavlink", "--firmware=px4", f"--write-params={parameters}"]
    settings = ("mavlink.message=global_position_sensor", "parameters.delay_ms=90")
    written = answer(capsys, [*command, *(f"--settings={setting}" for setting in settings)])
    assert written == {"parameters": str(parameters), "delay_ms": 90}
    assert "EKF2_AGP0_DELAY\t90" in parameters.read_text(encoding="utf-8")
    assert spoken(capsys, command, 2)["argument"] == "--write-params"
