"""Settings files: options as TOML, written with their meaning and defaults, and read back with every key checked.

Options are dataclasses whose docstrings say what each field means and in what unit; a field that is a dataclass
itself is a table, a tuple is a list, and a dict of dataclasses is one table a name. Nothing is spelled out twice:
the file is made from the classes.
"""

from __future__ import annotations

import difflib
import inspect
import json
import re
import textwrap
import tomllib
import types
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from engine.errors import OptionError

Options = TypeVar("Options")

NONE = "none"
"""TOML has no word for nothing; this one stands for it."""
_WIDTH = 110
_ROLE = re.compile(r":\w+:`([^`]*)`")
_UNITS = {
    "m": "metres", "deg": "degrees", "px": "pixels", "ms": "milliseconds", "s": "seconds",
    "mps": "metres per second", "mps2": "metres per second squared", "share": "share, 0 to 1",
    "sigmas": "standard deviations",
}  # fmt: skip


def settings_text(options: Any) -> str:
    """A settings file with all that is in ``options``, each key under what its class says of it.

    The keys are commented out, so that a file pins only what its user changed and the rest follows the defaults.

    Args:
        options: a dataclass whose docstring has an ``Attributes:`` section.
    """
    return "\n".join(_table(options, ())).lstrip("\n") + "\n"


def read_settings(path: Path, cls: type[Options]) -> Options:
    """The options in a file; what it leaves out keeps its default.

    Raises:
        OptionError: the file is no TOML, or a key or value in it is none that ``cls`` has; the message names the
            file, the key and what is nearest to it.
        OSError: the file cannot be read.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"{path}: expected TOML, got something else: {error}") from None
    try:
        return options_from_mapping(cls, values)
    except OptionError as error:
        raise OptionError(f"{path}: {error}") from None


def changed(options: Any, within: str = "") -> dict[str, Any]:
    """What differs from the defaults, by its name in a settings file ("ncc.rule.min_sigmas")."""
    usual = type(options)()
    out: dict[str, Any] = {}
    for name in _kinds(type(options)):
        value = getattr(options, name)
        if is_dataclass(value):
            out |= changed(value, f"{within}{name}.")
        elif value != getattr(usual, name):
            out[f"{within}{name}"] = value
    return out


def nested(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Tables within tables, as a settings file has them, from what :func:`changed` gives."""
    out: dict[str, Any] = {}
    for name, value in changes.items():
        *path, last = name.split(".")
        table = out
        for part in path:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise OptionError(f"{name}: expected a setting of its own, but {part} is one")
        table[last] = NONE if value is None else value
    return out


def options_from_mapping(cls: type[Options], values: Mapping[str, Any], within: str = "") -> Options:
    """Options from names and values, tables within tables.

    Args:
        cls: the dataclass.
        values: of its fields, as TOML has them; "none" is None where a field may be.
        within: the table that they stand in, for messages.

    Raises:
        OptionError: a name is not a field of ``cls``, or a value is not of its kind or out of range.
    """
    kinds = _kinds(cls)
    prefix = f"{within}." if within else ""
    taken: dict[str, Any] = {}
    for name, value in values.items():
        if name not in kinds:
            raise OptionError(f"{prefix}{name}: not a setting; {_nearest(name, list(kinds))}")
        taken[name] = _value(kinds[name], value, f"{prefix}{name}")
    try:
        return cls(**taken)
    except OptionError as error:
        raise OptionError(f"{prefix}{error}") from None


def _nearest(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else f"known here are {', '.join(known)}"


def _kinds(cls: type[Any]) -> dict[str, Any]:
    """The fields that a file can hold, by name, with their types: numbers, words, lists and tables of these."""
    hints = typing.get_type_hints(cls)
    kinds = {field.name: hints[field.name] for field in fields(cls)}
    return {name: kind for name, kind in kinds.items() if _can_be_held(kind)}


def _can_be_held(kind: Any) -> bool:
    return is_dataclass(kind) or _plain(kind) is not None or typing.get_origin(kind) in (tuple, dict)


def _plain(kind: Any) -> type | None:
    """``kind`` without "or None" where it is a number, a word or a truth value; None where it is not."""
    if isinstance(kind, types.UnionType):
        kinds = [part for part in typing.get_args(kind) if part is not type(None)]
        kind = kinds[0] if len(kinds) == 1 else None
    return kind if kind in (bool, int, float, str) else None


def _value(kind: Any, value: Any, name: str) -> Any:
    if is_dataclass(kind):
        if not isinstance(value, dict):
            raise OptionError(f"{name}: expected a table, got {value!r}")
        return options_from_mapping(typing.cast("type[Any]", kind), value, name)
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise OptionError(f"{name}: expected a list, got {value!r}")
        return tuple(_value(typing.get_args(kind)[0], item, name) for item in value)
    if typing.get_origin(kind) is dict:
        if not isinstance(value, dict):
            raise OptionError(f"{name}: expected tables [{name}.NAME], got {value!r}")
        return {key: _value(typing.get_args(kind)[1], item, f"{name}.{key}") for key, item in value.items()}
    if value == NONE and isinstance(kind, types.UnionType):
        return None
    plain = _plain(kind)
    if plain is float and type(value) is int:
        return float(value)
    if type(value) is not plain:
        words = {bool: "true or false", int: "a whole number", float: "a number", str: "a word in quotes"}
        raise OptionError(f"{name}: expected {words[typing.cast('type', plain)]}, got {value!r}")
    return value


def _table(options: Any, path: tuple[str, ...]) -> list[str]:
    """Lines of a table and of those within it, which TOML wants after the table's own keys."""
    meanings, lines = meanings_of(type(options)), []
    if path:
        about = (inspect.getdoc(type(options)) or "").partition("\n")[0]
        lines += ["", "", f"[{'.'.join(path)}]", f"# {about}"]
    tables: list[str] = []
    for name in _kinds(type(options)):
        value = getattr(options, name)
        if is_dataclass(value):
            tables += _table(value, (*path, name))
            continue
        unit = _UNITS.get(name.rpartition("_")[2])
        text = textwrap.wrap(f"{meanings[name]} [{unit}]" if unit else meanings[name], _WIDTH)
        lines += ["", *(f"# {line}" for line in text), f"#{name} = {_literal(value)}"]
    return lines + tables


def _literal(value: Any) -> str:
    if value is None:
        return f'"{NONE}"'
    # JSON's strings and truth values are TOML's; numbers are Python's in both, infinity included.
    return json.dumps(value, ensure_ascii=False) if isinstance(value, bool | str) else repr(value)


def meanings_of(cls: type[Any]) -> dict[str, str]:
    """What the class's docstring says of each of its fields, in one line each."""
    _, _, section = (inspect.getdoc(cls) or "").partition("Attributes:\n")
    out: dict[str, str] = {}
    for line in section.splitlines():
        if line and not line.startswith(" "):
            break  # the next section
        if line.startswith("    ") and line[4:5].strip():
            name, _, meaning = line.strip().partition(": ")
            out[name] = meaning
        elif line.strip():
            out[next(reversed(out))] += " " + line.strip()
    return {name: _ROLE.sub(r"\1", meaning).replace("``", "") for name, meaning in out.items()}
