"""Commands of the command line: what there are, options of a flight's files, and the one line of a refusal."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from typer.main import get_command

from scenematch.cli.app import app, run

FILES = {"map": "map.tif", "surface": "dsm.tif", "camera": "camera.yaml", "frames": "frames",
         "telemetry": "telemetry.csv"}  # fmt: skip


def _below(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """A command and all below it, by their words."""
    yield path, command
    for name, each in getattr(command, "commands", {}).items():
        yield from _below(each, (*path, name))


COMMANDS = dict(_below(get_command(app)))
"""Every command by its words, groups too."""
LEAVES = {words: command for words, command in COMMANDS.items() if not hasattr(command, "commands")}
"""Those that can be run."""


def file_options(folder: Path, **other: str | Path | None) -> list[str]:
    """Options of the files of a flight folder; other ones are within it, or none."""
    return [f"--{name}={folder / file}" for name, file in (FILES | other).items() if file is not None]


def refusal(capsys: Any, arguments: list[Any], code: int = 2) -> str:
    """The one line that a refused command leaves on standard error, without the program's name."""
    assert run([str(argument) for argument in arguments]) == code
    printed = capsys.readouterr()
    assert (printed.out, printed.err.count("\n")) == ("", 1), printed
    assert printed.err.endswith("\n")
    assert "\x1b" not in printed.err
    name, _, line = printed.err.partition(": ")
    assert name == "scenematch"
    return line
