"""Arguments as the user typed them: an error about ``start`` is shown as one about ``--start``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import Any

from typer.core import TyperCommand

from engine.errors import CalibrationError, EngineError, MapError
from scenematch.runs.renaming import rename_arguments, rename_quoted

_PANELS = ("Arguments", "Map", "Input", "Options", "Expert", "Output")
"""Of the help, in their order."""
_NOTHING: Mapping[str, str] = MappingProxyType({})
_typed: ContextVar[Mapping[str, str]] = ContextVar("typed", default=_NOTHING)
"""Of the command that runs: what was typed, by argument."""
_paths: ContextVar[Mapping[str, str]] = ContextVar("paths", default=_NOTHING)
"""Of the command that runs: what was typed for an argument, by the path that it holds."""


_MADE_OF = {
    "--rerun": ("recording", "viewer"),
    "--correct": ("columns", "angles", "heading_offset_deg", "height_offset_m", "offset_s"),
}
"""Arguments that one option sets together, by that option."""


class Command(TyperCommand):
    """A command whose parameters are named after the arguments that it passes on, or have an option named so."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options into the help, one section per panel; rich is not used because it is slow to load."""
        panels: dict[str, list[Any]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                default = "Arguments" if parameter.param_type_name == "argument" else "Options"
                panels.setdefault(getattr(parameter, "rich_help_panel", None) or default, []).append(record)
        for name in sorted(panels, key=_PANELS.index):
            with formatter.section(name):
                formatter.write_dl(panels[name])

    def invoke(self, ctx: Any) -> Any:
        """Run it."""
        _typed.set({name: typed for parameter in self.params for name, typed in _names(parameter).items()})
        values = ((typed_name(parameter), ctx.params.get(parameter.name)) for parameter in self.params)
        every = (
            (name, each) for name, value in values for each in (value if isinstance(value, list) else [value])
        )
        _paths.set({str(each): name for name, each in every if isinstance(each, Path)})
        return super().invoke(ctx)


def _names(parameter: Any) -> dict[str, str]:
    """The argument that a parameter may be called below the command line, with what was typed for it."""
    typed = typed_name(parameter)
    names = (parameter.name, typed.removeprefix("--").replace("-", "_").lower(), *_MADE_OF.get(typed, ()))
    return dict.fromkeys(names, typed)


def name_settings(table: str, names: Iterable[str]) -> None:
    """Let errors name the settings of a table as ``--settings`` sets them; options take precedence."""
    typed = {name: f"--settings {table}.{name}" for name in names}
    _typed.set(typed | {f"{table}.{name}": text for name, text in typed.items()} | dict(_typed.get()))


def typed_name(parameter: Any) -> str:
    """What the user types for a parameter: its long option, or the name of the positional argument."""
    option = next((name for name in parameter.opts if name.startswith("--")), None)
    return option or str(parameter.metavar or parameter.name.upper())


def ros_arguments_last(arguments: list[str]) -> list[str]:
    """The arguments of `bridge ros` with those for ROS last: NAME:=VALUE, and from `--ros-args` to a `--`."""
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
    """A text for a person, with the arguments in backquotes shown as they were typed."""
    return rename_quoted(text, _typed.get(), quote="")


def error_as_typed(error: EngineError) -> str:
    """The message of an error with its arguments as they were typed.

    An error inside a map or a calibration still names the file.
    """
    if isinstance(error, MapError | CalibrationError):
        return as_typed(str(error))
    return rename_arguments(str(error), _typed.get(), quote="")


def argument_of(text: str) -> str | None:
    """The argument that an error is about, as it was typed: by its name, or by the file or folder that it holds.

    Args:
        text: message of the error; the part before its first colon and space is the subject.

    Returns:
        The option or positional argument, several joined by ", "; None if no argument is at fault.
    """
    subject, names = text.partition(": ")[0], _typed.get()
    parts = [names.get(part, part) for part in subject.split(", ")]
    if all(part in names.values() for part in parts):
        return ", ".join(parts)
    paths = (path for path in (Path(subject), *Path(subject).parents) if path != Path())
    return next((_paths.get()[str(path)] for path in paths if str(path) in _paths.get()), None)


def urls_as_typed(text: str, arguments: Sequence[str]) -> str:
    """A text with URLs shown as they were typed; paths had turned their two slashes into one."""
    for argument in arguments:
        url = argument.partition("=")[2] if argument.startswith("--") else argument
        if "://" in url and str(Path(url)) != url:
            text = text.replace(str(Path(url)), url)
    return text
