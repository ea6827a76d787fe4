"""How a frame is matched: one file a method, and the steps that the methods share.

A method is a class derived from :class:`engine.methods.method.Method`. A new one is a file and a line in
:data:`BY_PROFILE`.
"""

from __future__ import annotations

from collections.abc import Mapping

from engine.errors import OptionError
from engine.methods.auto import Auto
from engine.methods.learned import Learned
from engine.methods.method import Method
from engine.methods.ncc import Ncc
from engine.methods.paper import PaperNcc, PaperSift
from engine.methods.sift import Sift

BY_PROFILE: Mapping[str, Mapping[str, type[Method]]] = {
    "engine": {"ncc": Ncc, "sift": Sift, "auto": Auto, "learned": Learned},
    "paper": {"ncc": PaperNcc, "sift": PaperSift},
}
METHODS = tuple(BY_PROFILE["engine"])
CLASSICAL = tuple(name for name in METHODS if name != "learned")
"""Those that need no file of weights."""


def method_type(name: str, profile: str) -> type[Method]:
    """The class of a method.

    Raises:
        OptionError: there is none of this name, or not in this profile.
    """
    if name not in METHODS:
        raise OptionError(f"method: expected one of {', '.join(METHODS)}, got {name!r}")
    methods = BY_PROFILE[profile]
    if name not in methods:
        raise OptionError(f"method: the {profile}'s profile has {' and '.join(methods)}, got {name!r}")
    return methods[name]
