"""Fill the templates of the report's pages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment

_FOLDER = Path(__file__).parent


@cache
def _templates() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = FileSystemLoader(_FOLDER)
    return Environment(
        loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined
    )


def filled(template: str, **values: Any) -> str:
    """The text of a template beside this file, with the values that it shows; texts are escaped."""
    return _templates().get_template(template).render(**values)


def fill_page(path: Path, template: str, data: Mapping[str, Any], **values: Any) -> None:
    """Write a page; equal values give equal bytes.

    Args:
        path: the file, replaced if it exists.
        template: its file beside this one.
        data: input of the page's script: ``box`` of the map, ``frames`` of the slider.
        values: what the template shows; texts are escaped.
    """
    from markupsafe import Markup

    style, script = (Markup((_FOLDER / f"page.{kind}").read_text(encoding="utf-8")) for kind in ("css", "js"))
    packed = Markup(json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"))
    path.write_text(
        filled(template, style=style, script=script, data=packed, **values), encoding="utf-8", newline="\n"
    )
