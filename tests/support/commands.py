"""Commands of the command line: what there are, options of a flight's files, what one answers, how it refuses."""

import json
import re
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


def answer(capture: Any, arguments: list[Any], code: int = 0) -> Any:
    """What a command answers on standard output with --json."""
    assert run([*map(str, arguments), "--json"]) == code
    return json.loads(capture.readouterr().out)


def refusal(capsys: Any, arguments: list[Any], code: int = 2) -> str:
    """The one line, without colour, that a refused command leaves on standard error, less the program's name."""
    assert run([*map(str, arguments)]) == code
    printed = capsys.readouterr()
    line = re.fullmatch(r"scenematch: ([^\n\x1b]*\n)", printed.err)
    assert line, printed
    assert printed.out == ""
    return line[1]
