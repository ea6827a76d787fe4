"""The typer application: its commands by name, and how errors are reported."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Annotated, Any

import typer
from typer.main import get_command

from engine.errors import EngineError, OptionError
from scenematch.cli import argument_names, console
from scenematch.cli.commands import bridge, doctor, flight, locate, simulate
from scenematch.cli.commands import map as map_commands

app = typer.Typer(
    name="scenematch",
    help="Position fixes for a drone without GNSS: a downward camera matched against a georeferenced map.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},  # inherited by all commands
)
map_app = typer.Typer(help="Inspect, audit or fetch a map.")
bridge_app = typer.Typer(help="Send live fixes to an autopilot or to ROS.")

# In the order of the help.
_COMMANDS: tuple[tuple[typer.Typer, tuple[Callable[..., None], ...]], ...] = (
    (app, (simulate.demo, flight.check, flight.track, flight.compare, locate.locate)),
    (app, (simulate.simulate, flight.evaluate, flight.export, doctor.doctor)),
    (map_app, (map_commands.info, map_commands.audit, map_commands.fetch)),
    (bridge_app, (bridge.mavlink, bridge.ros)),
)
for group, functions in _COMMANDS:
    for function in functions:
        group.command(cls=argument_names.Command)(function)
app.add_typer(map_app, name="map")
app.add_typer(bridge_app, name="bridge")

# typer brings its own copy of click, or depends on click: its errors are found by class, not by import.
_UsageError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "UsageError")
INTERRUPTED = 130


@cache
def command() -> Any:
    """All commands as one, built once per process: reading their signatures takes a tenth of a second."""
    return get_command(app)


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit code.

    An error is one line on standard error and, with --json, also an object on standard output.
    """
    given = arguments
    if arguments[:2] == ["bridge", "ros"]:
        arguments = [*arguments[:2], *argument_names.ros_arguments_last(arguments[2:])]
    try:
        result = command().main(args=arguments or ["--help"], prog_name="scenematch", standalone_mode=False)
    except _UsageError as error:
        return _fail(_usage(error), 2, given, _usage_argument(error))
    except EngineError as error:
        text = argument_names.error_as_typed(error)
        return _fail(text, 2 if isinstance(error, OptionError) else 1, given, argument_names.argument_of(text))
    except OSError as error:
        text = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        return _fail(text, 1, given, argument_names.argument_of(text))
    except (KeyboardInterrupt, typer.Abort):
        result = INTERRUPTED
    if result == INTERRUPTED:
        return _fail("interrupted", INTERRUPTED, given)
    if not arguments:
        return 2
    return result if isinstance(result, int) else 0


def _usage(error: Any) -> str:
    """What was wrong with the command line, and where to find help."""
    where = error.ctx.command_path if error.ctx is not None else "scenematch"
    return f"{error.format_message().rstrip('.')} (see {where} --help)"


def _usage_argument(error: Any) -> str | None:
    """The argument that is wrong, missing or unknown; None if something else is wrong."""
    parameter = getattr(error, "param", None)
    return getattr(error, "option_name", None) if parameter is None else argument_names.typed_name(parameter)


def _fail(text: str, code: int, given: list[str], argument: str | None = None) -> int:
    text = argument_names.urls_as_typed(text, given)
    console.say(f"scenematch: {text}")
    if "--json" in given:
        with suppress(OSError):  # standard output may be what failed
            console.print_json({"error": text, "argument": argument})
    return code


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(version("scenematch-engine"))
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Options before the command."""
