"""Settings files: write options as TOML with descriptions and defaults, and check every key when reading.

Options are dataclasses whose docstrings describe each field and its unit. A field that is a dataclass becomes a
table, a tuple a list, and a dict of dataclasses one table per name. The file is generated from the classes.
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
from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from engine.errors import OptionError

Options = TypeVar("Options")

NONE = "none"
"""Stands for None, which TOML cannot express."""
_SETTING = re.compile(r"([a-z0-9_]+(?:\.[a-z0-9_]+)*)=(.*)")
_WIDTH = 110
_ROLE = re.compile(r":\w+:`([^`]*)`")
_UNITS = {
    "m": "metres", "deg": "degrees", "px": "pixels", "ms": "milliseconds", "s": "seconds",
    "mps": "metres per second", "mps2": "metres per second squared", "share": "share, 0 to 1",
    "sigmas": "standard deviations",
}  # fmt: skip


def settings_text(options: Any, table: str = "", without: Collection[str] = ()) -> str:
    """The text of a settings file with all keys of ``options``, each below its description.

    The keys are commented out: a file fixes only what its user changes, and the rest follows the defaults.

    Args:
        options: a dataclass whose docstring has an ``Attributes:`` section.
        table: the table of the keys.
        without: keys to leave out.
    """
    return "\n".join(_table(options, (table,) if table else (), without)).lstrip("\n") + "\n"


def read_values(path: Path) -> dict[str, Any]:
    """The values of a settings file.

    Raises:
        OptionError: the file is not TOML.
        OSError: the file cannot be read.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"{path}: expected TOML, got something else: {error}") from None


def parse_setting(text: str) -> dict[str, Any] | None:
    """Parse NAME=VALUE; NAME may have dots, and a word needs no quotes. None for any other text."""
    found = _SETTING.fullmatch(text)
    if found is None:
        return None
    try:
        return nested({found[1]: tomllib.loads(f"value = {found[2]}")["value"]})
    except tomllib.TOMLDecodeError:
        return nested({found[1]: found[2]})


def merged(values: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """Nested values, overridden by others."""
    out = dict(values)
    for name, value in more.items():
        old = out.get(name)
        out[name] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return out


def changed(options: Any, within: str = "") -> dict[str, Any]:
    """Settings that differ from their defaults, by dotted name ("errors.map_m")."""
    defaults = type(options)()
    out: dict[str, Any] = {}
    for name in _kinds(type(options)):
        value = getattr(options, name)
        if is_dataclass(value):
            out |= changed(value, f"{within}{name}.")
        elif value != getattr(defaults, name):
            out[f"{within}{name}"] = value
    return out


def nested(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Convert settings by dotted name, as :func:`changed` returns them, to nested tables."""
    out: dict[str, Any] = {}
    for name, value in changes.items():
        *path, last = name.split(".")
        table = out
        for part in path:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise OptionError(f"{name}: expected a setting inside a table, but {part} is a setting")
        table[last] = NONE if value is None else value
    return out


def options_from_mapping(
    cls: type[Options], values: Mapping[str, Any], within: str = "", given: Mapping[str, Any] = {}
) -> Options:
    """Create options from nested mappings of names and values.

    Args:
        cls: dataclass of the options.
        values: values of its fields as parsed from TOML; "none" is None if a field is optional.
        within: dotted name of the enclosing table, for messages.
        given: fields that are not settings or take precedence.

    Raises:
        OptionError: a name is not a field of ``cls``, or a value has the wrong type or range.
    """
    kinds = _kinds(cls)
    prefix = f"{within}." if within else ""
    arguments: dict[str, Any] = {}
    for name, value in values.items():
        if name not in kinds:
            raise OptionError(f"{prefix}{name}: not a setting; {nearest(name, list(kinds))}")
        arguments[name] = _value(kinds[name], value, f"{prefix}{name}")
    try:
        return cls(**{**arguments, **given})
    except OptionError as error:
        if str(error).partition(":")[0] in given:
            raise
        raise OptionError(f"{prefix}{error}") from None


def nearest(name: str, known: list[str]) -> str:
    """Suggest what an unknown name was meant to be."""
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}"


def _kinds(cls: type[Any]) -> dict[str, Any]:
    """Types, by name, of the fields that a file can express: scalars, lists and tables."""
    hints = typing.get_type_hints(cls)
    kinds = {field.name: hints[field.name] for field in fields(cls)}
    return {
        name: kind for name, kind in kinds.items()
        if is_dataclass(kind) or _plain(kind) is not None or typing.get_origin(kind) in (tuple, dict)
    }  # fmt: skip


def _plain(kind: Any) -> type | None:
    """The scalar type of ``kind`` without "or None"; None if it is not a scalar."""
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
        if isinstance(value, dict):
            raise OptionError(f"{name}: expected a list, got {value!r}")
        items = value if isinstance(value, list) else [value]  # a single value stands for a list of one
        return tuple(_value(typing.get_args(kind)[0], item, name) for item in items)
    if typing.get_origin(kind) is dict:
        if not isinstance(value, dict):
            raise OptionError(f"{name}: expected tables [{name}.NAME], got {value!r}")
        return {key: _value(typing.get_args(kind)[1], item, f"{name}.{key}") for key, item in value.items()}
    if kind is Any:
        return value
    if value == NONE and isinstance(kind, types.UnionType):
        return None
    plain = _plain(kind)
    if plain is float and type(value) is int:
        return float(value)
    if type(value) is not plain:
        words = {bool: "true or false", int: "a whole number", float: "a number", str: "a quoted string"}
        raise OptionError(f"{name}: expected {words[typing.cast('type', plain)]}, got {value!r}")
    return value


def _table(options: Any, path: tuple[str, ...], without: Collection[str] = ()) -> list[str]:
    """Lines of a table and its nested tables, which TOML requires after the table's own keys."""
    descriptions, lines = field_descriptions(type(options)), []
    if path:
        about = (inspect.getdoc(type(options)) or "").partition("\n")[0]
        lines += ["", "", f"[{'.'.join(path)}]", f"# {about}"]
    tables: list[str] = []
    for name in _kinds(type(options)):
        if name in without:
            continue
        value = getattr(options, name)
        if is_dataclass(value):
            tables += _table(value, (*path, name))
            continue
        unit = _UNITS.get(name.rpartition("_")[2])
        text = textwrap.wrap(f"{descriptions[name]} [{unit}]" if unit else descriptions[name], _WIDTH)
        lines += ["", *(f"# {line}" for line in text), f"#{name} = {_literal(value)}"]
    return lines + tables


def _literal(value: Any) -> str:
    if value is None:
        return f'"{NONE}"'
    if isinstance(value, tuple):
        return f"[{', '.join(map(_literal, value))}]"
    # JSON's strings and booleans are valid TOML; so are Python's numbers, infinity included.
    return json.dumps(value, ensure_ascii=False) if isinstance(value, bool | str) else repr(value)


def field_descriptions(cls: Any, heading: str = "Attributes") -> dict[str, str]:
    """The descriptions in a section of a docstring, by name, each as one line."""
    _, _, section = (inspect.getdoc(cls) or "").partition(f"{heading}:\n")
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
