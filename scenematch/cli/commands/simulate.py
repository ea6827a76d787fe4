"""The command `simulate`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from engine.errors import OptionError
from scenematch.cli import console
from scenematch.cli.options import (
    MAP,
    OUTPUT,
    ForceOption,
    JsonOption,
    RerunOption,
    SurfaceOption,
    live_view,
    use_threads,
    with_options,
)

if TYPE_CHECKING:
    from scenematch.runs.live_viewing import LiveViewTarget
    from scenematch.runs.simulation import WorldSettings

_FLIGHT = {
    "map": "map.tif", "surface": "dsm.tif", "camera": "camera.yaml", "frames": "frames",
    "telemetry": "telemetry.csv",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """What is flown over."""

    seed: Annotated[
        int, typer.Option("--seed", min=0, metavar="N", help="Another number, another town and flight.")
    ] = 1
    condition: Annotated[
        str | None,
        typer.Option(
            "--condition", metavar="NAME", help="Light, season and air of the frames; noon unless given."
        ),
    ] = None
    relief_m: Annotated[float, typer.Option("--relief-m", metavar="H", help="Height of a town's hills.")] = 0.0
    map: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="FILE", help="Your own map as the world, in place of a town.", rich_help_panel=MAP
        ),
    ] = None
    surface: SurfaceOption = None
    camera_pitch_deg: Annotated[
        float,
        typer.Option(
            "--camera-pitch-deg", metavar="P", help="Of the camera, as a gimbal's: -90 straight down, -45 oblique."
        ),
    ] = -90.0

    def world(self) -> WorldSettings:
        """The same as the run takes it."""
        from scenematch.runs.simulation import WorldSettings

        return WorldSettings(**{each.name: getattr(self, each.name) for each in fields(self)})


@dataclass(frozen=True, kw_only=True)
class LoopOptions:
    """How the loop is closed, if it is."""

    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="Fly by the engine's fixes, with GPS off.")
    ] = False
    minutes: Annotated[
        float | None, typer.Option("--minutes", metavar="M", help="With --closed-loop: how long; 5 unless given.")
    ] = None
    method: Annotated[
        str | None,
        typer.Option("--method", metavar="auto|ncc|sift", help="With --closed-loop; auto unless given."),
    ] = None
    fault: Annotated[
        str | None,
        typer.Option("--fault", metavar="none|killed|shifted|frozen", help="With --closed-loop: what goes wrong."),
    ] = None

    def given(self) -> dict[str, Any]:
        """What was said of the loop, None where nothing was."""
        return {"minutes": self.minutes, "method": self.method, "fault": self.fault}


@with_options
def simulate(
    out: Annotated[
        Path,
        typer.Option("--out", metavar="DIR", help="Flight folder, created by this run.", rich_help_panel=OUTPUT),
    ],
    town: WorldOptions,
    loop: LoopOptions,
    frames: Annotated[
        int | None, typer.Option("--frames", min=1, metavar="N", help="Fly only the first N frames.")
    ] = None,
    rerun: RerunOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """A simulated flight with its truth.

    Writes a flight folder that track reads. With --closed-loop the vehicle steers by the engine's fixes, and the
    folder holds its track, estimate, figures and summary too.
    """
    use_threads()
    world = town.world()
    if loop.closed_loop:
        if frames is not None:
            raise OptionError("frames: expected without `closed_loop`, which has `minutes`")
        facts = _fly_closed_loop(out, world, loop.given(), live_view(rerun), force)
    else:
        from scenematch.runs.arguments import check_unused
        from scenematch.runs.simulation import simulate as simulate_flight

        check_unused(loop.given() | {"rerun": rerun}, "closed_loop")
        facts = simulate_flight(out, world, frames=frames, force=force, progress=console.PROGRESS)
    console.facts(facts, as_json, title=f"simulated flight {town.seed}")
    flight = {name: out / file for name, file in _FLIGHT.items()}
    if not loop.closed_loop:
        console.next_step(f"track {console.options(**flight, out=f'{out}-track')}", as_json=as_json)
        return
    shown = f"export {console.quoted(out)} --format geojson"
    following = shown if facts["availability"] else f"check {console.options(**flight)}"
    console.next_step(following, as_json=as_json, hint=f"open {out / 'report.html'}")


def _fly_closed_loop(
    out: Path, world: WorldSettings, loop: Mapping[str, Any], shown: LiveViewTarget, force: bool
) -> dict[str, Any]:
    """The figures of a flight by the engine's fixes; what is None of the loop's settings is its default."""
    from scenematch.runs.closed_loop import ClosedLoopSettings, fly_closed_loop

    settings = ClosedLoopSettings(**{name: value for name, value in loop.items() if value is not None})
    return fly_closed_loop(out, world, settings, force=force, live_view=shown, progress=console.PROGRESS)
