"""A hook of mkdocs: the page of the command line shows what each command's own help says of its options."""

import re
from typing import Any

from scenematch.cli.app import command

_SECTION = re.compile(r"^## (?P<name>[a-z ]+)\n\n```\n.*?^```\n", re.MULTILINE | re.DOTALL)


def on_page_markdown(markdown: str, *, page: Any, **_: object) -> str:
    """Called by mkdocs with each page's source."""
    return with_options(markdown) if page.file.src_uri == "command-line.md" else markdown


def with_options(markdown: str) -> str:
    """The page with a table of options below the lines that each section begins with."""
    return _SECTION.sub(lambda section: f"{section[0]}\n{_table(section['name'])}\n", markdown)


def _table(name: str) -> str:
    found: Any = command()
    for word in name.split():
        found = found.commands[word]
    rows = [
        f"| `{', '.join(option.opts)}` | {_cell(option.metavar)} | {_text(option.help)} |"
        for option in found.params
        if option.param_type_name == "option" and option.help and not option.hidden
    ]
    return "\n".join(["| option | value | meaning |", "|---|---|---|", *rows, ""])


def _cell(metavar: str | None) -> str:
    return f"<code>{_text(metavar)}</code>" if metavar else ""


def _text(words: str) -> str:
    return " ".join(words.split()).replace("|", "&#124;")
