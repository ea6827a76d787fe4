"""How a frame is matched: one file per method, and the steps that the methods share.

A method is a class derived from :class:`engine.matching.method.Method`. A new method is one file and one line in
:data:`CLASSES`; one from outside is given to :class:`engine.SceneMatcher` as its class.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING

from engine.errors import OptionError

if TYPE_CHECKING:
    from engine.matching.method import Method

CLASSES: Mapping[str, str] = {
    "ncc": "ncc.Ncc", "sift": "sift.Sift", "auto": "auto.Auto", "learned": "learned.Learned",
}  # fmt: skip
"""The module and class of each method, imported when a matcher is made: options need no torch."""
METHODS = tuple(CLASSES)
CLASSICAL = tuple(name for name in METHODS if name != "learned")
"""Methods that need no file of weights."""


def method_type(name: str) -> type[Method]:
    """The class of a method.

    Raises:
        OptionError: no method has this name.
    """
    if name not in METHODS:
        raise OptionError(f"method: expected one of {', '.join(METHODS)}, got {name!r}")
    module, _, of_module = CLASSES[name].partition(".")
    found: type[Method] = getattr(import_module(f"engine.matching.{module}"), of_module)
    return found
