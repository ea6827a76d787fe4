"""Rename the arguments in a message: a field of a lower object, or what the user typed.

The argument at fault comes first, before a colon; others are in backquotes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from engine.errors import EngineError

_QUOTED = re.compile(r"`(\w+)`")


@contextmanager
def renamed_in_errors(**arguments: str) -> Iterator[None]:
    """Inside this context, an error about a field of a lower object names the argument that it came from.

    Args:
        arguments: argument by field.
    """
    try:
        yield
    except EngineError as error:
        renamed = rename_arguments(str(error), arguments)
        if renamed == str(error):
            raise
        raise type(error)(renamed) from None


def rename_arguments(message: str, names: Mapping[str, str], quote: str = "`") -> str:
    """Rename the arguments of a message: those before the first colon, and those in backquotes.

    Args:
        message: of an error.
        names: new name by old one.
        quote: around the new names of those in backquotes.
    """
    subject, colon, rest = message.partition(":")
    parts = subject.split(", ")
    if colon and all(part in names for part in parts):
        message = f"{', '.join(names[part] for part in parts)}:{rest}"
    return rename_quoted(message, names, quote)


def rename_quoted(text: str, names: Mapping[str, str], quote: str = "`") -> str:
    """Rename the arguments in backquotes; see :func:`rename_arguments`."""
    return _QUOTED.sub(lambda found: f"{quote}{names[found[1]]}{quote}" if found[1] in names else found[0], text)
