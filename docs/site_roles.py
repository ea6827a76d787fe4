"""A hook of mkdocs: roles in docstrings, :class: and its like, become links where the site has the name."""

import re

_ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod):<code>~?([\w.]+)</code>")


def on_page_content(html: str, **_: object) -> str:
    """Called by mkdocs with each page's HTML, before mkdocs-autorefs resolves its references."""
    return _ROLE.sub(_link, html)


def _link(role: re.Match[str]) -> str:
    """A reference that stays plain code where nothing of this name is shown."""
    name = role[1]
    return f'<autoref identifier="{name}" optional><code>{name.removeprefix("engine.")}</code></autoref>'
