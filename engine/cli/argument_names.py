"""Names of arguments as they were typed: what a run says of ``start``, the user reads of ``--start``."""

from __future__ import annotations

from collections.abc import Mapping
from contextvars import ContextVar
from types import MappingProxyType
from typing import Any

from typer.core import TyperCommand

from engine.errors import CalibrationError, EngineError, MapError
from engine.runs.renaming import rename_arguments, rename_quoted

_NOTHING: Mapping[str, str] = MappingProxyType({})
_typed: ContextVar[Mapping[str, str]] = ContextVar("typed", default=_NOTHING)
"""Of the command that runs: what was typed, by argument."""


class Command(TyperCommand):
    """A command whose parameters have the names of the arguments that it passes on, or an option like them."""

    def invoke(self, ctx: Any) -> Any:
        """Run it."""
        _typed.set({name: typed for parameter in self.params for name, typed in _names(parameter).items()})
        return super().invoke(ctx)


def _names(parameter: Any) -> dict[str, str]:
    """The argument that a parameter may be called below the command line, with what was typed for it."""
    option = next((name for name in parameter.opts if name.startswith("--")), None)
    if option is None:
        return {parameter.name: parameter.metavar or parameter.name.upper()}
    return {parameter.name: option, option[2:].replace("-", "_"): option}


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
