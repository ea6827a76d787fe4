"""The typer application: its commands by name, and how their errors end."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer.main import get_command

from engine.cli import (
    bridge_commands,
    campaign_commands,
    console,
    dataset_commands,
    flight_commands,
    map_commands,
)
from engine.cli.options import JsonOption
from engine.errors import EngineError, OptionError

app = typer.Typer(
    name="scenematch",
    help="Position fixes for a drone without GNSS: a downward camera matched against a georeferenced map.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command()(flight_commands.demo)
app.command()(flight_commands.track)
app.command()(flight_commands.compare)
app.command()(campaign_commands.campaign)
app.command()(flight_commands.init)
app.command()(flight_commands.locate)
app.command()(flight_commands.simulate)
app.command()(flight_commands.evaluate)
app.command()(flight_commands.export)
app.command()(flight_commands.bag)
map_app = typer.Typer(help="Facts about a map.")
map_app.command("info")(map_commands.info)
map_app.command("audit")(map_commands.audit)
app.add_typer(map_app, name="map")
dataset_app = typer.Typer(help="Published data sets.")
dataset_app.command("import")(dataset_commands.import_dataset)
dataset_app.command("check")(dataset_commands.check)
app.add_typer(dataset_app, name="dataset")
bridge_app = typer.Typer(help="Live, beside an autopilot.")
bridge_app.command("mavlink")(bridge_commands.mavlink)
bridge_app.command("mavlink-params")(bridge_commands.mavlink_params)
bridge_app.command("ros")(bridge_commands.ros)
app.add_typer(bridge_app, name="bridge")

# typer brings its own copy of click, or depends on click: what it raises is found by descent, not by import.
_UsageError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "UsageError")
INTERRUPTED = 130


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit code."""
    try:
        result = get_command(app).main(args=arguments or ["--help"], prog_name="scenematch", standalone_mode=False)
    except _UsageError as error:
        return _fail(_usage(error), 2)
    except OptionError as error:
        return _fail(str(error), 2)
    except EngineError as error:
        return _fail(str(error), 1)
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error), 1)
    except (KeyboardInterrupt, typer.Abort):
        result = INTERRUPTED
    if result == INTERRUPTED:
        return _fail("interrupted", INTERRUPTED)
    if not arguments:
        return 2
    return result if isinstance(result, int) else 0


def _usage(error: Any) -> str:
    """What was wrong with the command line, and where help is."""
    where = error.ctx.command_path if error.ctx is not None else "scenematch"
    return f"{error.format_message().rstrip('.')} (see {where} --help)"


def _fail(text: str, code: int) -> int:
    console.say(f"scenematch: {text}")
    return code


@app.command()
def doctor(as_json: JsonOption = False) -> None:
    """Versions, devices, what is missing."""
    from engine.cli.doctor import examine

    facts, healthy = examine()
    console.facts(facts, as_json, title="scenematch doctor")
    raise typer.Exit(0 if healthy else 1)


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
