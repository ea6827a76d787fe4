"""The commands that fly over a generated town: `demo` and `simulate`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from engine.errors import OptionError
from scenematch.cli import console, options, tables
from scenematch.cli.options import MAP, OUTPUT, flag, option, with_options


@with_options
def demo(
    out: Annotated[Path, option("--out", "DIR", OUTPUT)] = Path("demo-report"),
    frames: Annotated[int | None, option("--frames", "N", min=2)] = None,
    seed: Annotated[int, option("--seed", "N", min=0)] = 1,
    force: options.ForceOption = False,
) -> None:
    """Track a built-in flight with both methods.

    Generates a town and the paper's flight over it, tracks it by NCC and SIFT, each with the paper's recipe and
    with this engine's, and prints the results beside the paper's Table I. Needs no data.

    Options:
        out: Report folder.
        frames: Fly only the first N frames.
        seed: Number of the generated town and flight.
    """
    from scenematch.runs.demo import run_demo

    options.use_threads()
    results = run_demo(out, frames=frames, seed=seed, force=force, progress=console.PROGRESS)
    if not console.answered_as_json(results):
        tables.print_paper_table(results, seed)
    console.say(f"report: {out.resolve()}")
    console.next_step("check --map MAP --frames FRAMES", hint=f"open {out}/ncc-engine/report.html")


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """What is flown over.

    Attributes:
        seed: Number of the generated town and flight.
        condition: Light, season and weather in the frames (default: noon).
        relief_m: Height of the town's hills.
        map: Fly over this map instead of a generated town.
        camera_pitch_deg: Pitch of the camera: -90 straight down, -45 oblique.
    """

    seed: Annotated[int, option("--seed", "N", min=0)] = 1
    condition: Annotated[str | None, option("--condition", "NAME")] = None
    relief_m: Annotated[float, option("--relief-m", "H")] = 0.0
    map: Annotated[Path | None, option("--map", "FILE", MAP)] = None
    surface: options.SurfaceOption = None
    camera_pitch_deg: Annotated[float, option("--camera-pitch-deg", "P")] = -90.0


@dataclass(frozen=True, kw_only=True)
class LoopOptions:
    """How the loop is closed, if it is.

    Attributes:
        closed_loop: Steer by the engine's fixes, with GPS off.
        minutes: With --closed-loop: minutes to fly (default: 5).
        method: With --closed-loop: matching method (default: auto).
        fault: With --closed-loop: engine killed, map shifted, or picture frozen.
    """

    closed_loop: Annotated[bool, flag("--closed-loop")] = False
    minutes: Annotated[float | None, option("--minutes", "M")] = None
    method: Annotated[str | None, option("--method", "auto|ncc|sift")] = None
    fault: Annotated[str | None, option("--fault", "none|killed|shifted|frozen")] = None


@with_options
def simulate(
    out: Annotated[Path, option("--out", "DIR", OUTPUT)],
    town: WorldOptions,
    loop: LoopOptions,
    frames: Annotated[int | None, option("--frames", "N", min=1)] = None,
    rerun: options.RerunOption = None,
    force: options.ForceOption = False,
) -> None:
    """Simulate a flight, with ground truth.

    Writes a flight folder that track can read. With --closed-loop the vehicle steers by the engine's fixes, and
    the folder also holds the track, the estimate, figures and a summary.

    Options:
        out: Flight folder, created by this run.
        frames: Fly only the first N frames.
    """
    from scenematch.runs.inputs import FOLDER_LAYOUT
    from scenematch.runs.simulation import WorldSettings

    options.use_threads()
    world = WorldSettings(**asdict(town))
    given: dict[str, Any] = {"minutes": loop.minutes, "method": loop.method, "fault": loop.fault}
    if loop.closed_loop:
        from scenematch.runs.closed_loop import ClosedLoopSettings, fly_closed_loop

        if frames is not None:
            raise OptionError("frames: expected without `closed_loop`, which has `minutes`")
        settings = ClosedLoopSettings(**{name: value for name, value in given.items() if value is not None})
        shown = options.live_view(rerun)
        facts = fly_closed_loop(out, world, settings, force=force, live_view=shown, progress=console.PROGRESS)
    else:
        from scenematch.runs.arguments import check_unused
        from scenematch.runs.simulation import simulate as simulate_flight

        check_unused(given | {"rerun": rerun}, "closed_loop")
        facts = simulate_flight(out, world, frames=frames, force=force, progress=console.PROGRESS)
    console.facts(facts, title=f"simulated flight {town.seed}")
    if loop.closed_loop:
        console.after_track(out, facts["availability"])
        return
    paths = {name: out / file for name, file in FOLDER_LAYOUT.items() if name != "truth"} | {"out": f"{out}-track"}
    given_again = " ".join(f"--{name} {console.quoted(path)}" for name, path in paths.items())
    console.next_step(f"track {given_again}")
