"""Arguments as they were typed: what a run says of ``start``, the user reads of ``--start``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import Any

from typer.core import TyperCommand

from engine.errors import CalibrationError, EngineError, MapError
from scenematch.runs.renaming import rename_arguments, rename_quoted

_NOTHING: Mapping[str, str] = MappingProxyType({})
_typed: ContextVar[Mapping[str, str]] = ContextVar("typed", default=_NOTHING)
"""Of the command that runs: what was typed, by argument."""
_paths: ContextVar[Mapping[str, str]] = ContextVar("paths", default=_NOTHING)
"""Of the command that runs: what was typed for an argument, by the path that it holds."""


class Command(TyperCommand):
    """A command whose parameters have the names of the arguments that it passes on, or an option like them."""

    def invoke(self, ctx: Any) -> Any:
        """Run it."""
        _typed.set({name: typed for parameter in self.params for name, typed in _names(parameter).items()})
        values = {typed_name(parameter): ctx.params.get(parameter.name) for parameter in self.params}
        _paths.set({str(value): typed for typed, value in values.items() if isinstance(value, Path)})
        return super().invoke(ctx)


def _names(parameter: Any) -> dict[str, str]:
    """The argument that a parameter may be called below the command line, with what was typed for it."""
    typed = typed_name(parameter)
    return {parameter.name: typed, typed.removeprefix("--").replace("-", "_").lower(): typed}


def typed_name(parameter: Any) -> str:
    """What is typed for a parameter of a command: its long option, or the name of its place."""
    option = next((name for name in parameter.opts if name.startswith("--")), None)
    return option or str(parameter.metavar or parameter.name.upper())


def ros_arguments_last(arguments: list[str]) -> list[str]:
    """The arguments of `bridge ros`, those of ROS last: NAME:=VALUE, and from `--ros-args` to a `--`."""
    own, others, in_ros = [], [], False
    for argument in arguments:
        if argument == "--ros-args":
            in_ros = True
        if in_ros or (":=" in argument and not argument.startswith("-")):
            others.append(argument)
        else:
            own.append(argument)
        in_ros = in_ros and argument != "--"
    return [*own, "--", *others] if others else own


def as_typed(text: str) -> str:
    """A text for a person with its arguments in backquotes as they were typed."""
    return rename_quoted(text, _typed.get(), quote="")


def error_as_typed(error: EngineError) -> str:
    """The message of an error with its arguments as they were typed.

    What is wrong within a map or a calibration stays a matter of the file.
    """
    if isinstance(error, MapError | CalibrationError):
        return as_typed(str(error))
    return rename_arguments(str(error), _typed.get(), quote="")


def argument_of(text: str) -> str | None:
    """The argument that an error is about, as it was typed: by its name, or by the file or folder that it holds.

    Args:
        text: message of the error; what stands before its first colon and space is the subject.

    Returns:
        The option or the name of the place, several of them joined by ", "; None where no argument is at fault.
    """
    subject, names = text.partition(": ")[0], _typed.get()
    parts = [names.get(part, part) for part in subject.split(", ")]
    if all(part in names.values() for part in parts):
        return ", ".join(parts)
    paths = (path for path in (Path(subject), *Path(subject).parents) if path != Path())
    return next((_paths.get()[str(path)] for path in paths if str(path) in _paths.get()), None)


def urls_as_typed(text: str, arguments: Sequence[str]) -> str:
    """A text with the URLs among the arguments as they were typed; a path has one slash where they have two."""
    for argument in arguments:
        url = argument.partition("=")[2] if argument.startswith("--") else argument
        if "://" in url and str(Path(url)) != url:
            text = text.replace(str(Path(url)), url)
    return text
