"""Fill the templates of the report's pages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

Legend = list[tuple[str, str]]
"""Name and SVG mark of each entry."""
CROSS = "M6 2l10 10M16 2l-10 10"
"""Of a legend."""
_FOLDER = Path(__file__).parent


def fill_page(path: Path, template: str, data: Mapping[str, Any], **values: Any) -> None:
    """Write a page; equal values give equal bytes.

    Args:
        path: the file, replaced if it exists.
        template: its file beside this one.
        data: input of the page's script: ``box`` of the map, ``frames`` of the slider.
        values: what the template shows; texts are escaped.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    folder = FileSystemLoader(_FOLDER)
    pages = Environment(
        loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined
    )
    style, script = (Markup((_FOLDER / f"page.{kind}").read_text(encoding="utf-8")) for kind in ("css", "js"))
    packed = Markup(json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"))
    text = pages.get_template(template).render(style=style, script=script, data=packed, **values)
    path.write_text(text, encoding="utf-8", newline="\n")
