"""``init``: a settings file with every option, its unit, its default and what it means."""

from __future__ import annotations

from pathlib import Path

from engine.cli import console
from engine.errors import OptionError
from engine.formats.settings import settings_text
from engine.runs.tracking import Settings

_HEAD = """\
# Settings of scenematch: every option with its default. Take the # off a key to change it; what stays commented
# follows the defaults. Use it with: scenematch track --settings FILE; options given there count more.

"""


def run_init(out: Path, *, force: bool = False) -> None:
    """Write the file.

    Raises:
        OptionError: it is there already and ``force`` was not given.
    """
    if out.exists() and not force:
        raise OptionError(f"--out: {out} exists; choose another name, or add --force to replace it")
    out.write_text(_HEAD + settings_text(Settings()), encoding="utf-8")
    console.say(f"settings: {out}")
