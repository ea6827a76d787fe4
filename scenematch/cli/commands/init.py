"""The command `init`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console
from scenematch.cli.options import JsonOption

_HEAD = """\
# Settings of scenematch: every option with its default. Take the # off a key to change it; what stays commented
# follows the defaults. Use it with: scenematch track --settings FILE; options given there count more.

"""


def init(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The file.")] = Path("scenematch.toml"),
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Settings file with every option.

    Each with its unit, its default and what it means; track takes the file with --settings.
    """
    from scenematch.files.settings import settings_text
    from scenematch.runs.folders import check_file
    from scenematch.runs.settings import TrackSettings

    check_file(out, force)
    out.write_text(_HEAD + settings_text(TrackSettings()), encoding="utf-8")
    if as_json:
        console.print_json({"settings": str(out)})
    else:
        console.say(f"settings: {out}")
    console.next_step(
        f"track {console.options(settings=out)} --map MAP --frames FRAMES --out out", as_json=as_json
    )
