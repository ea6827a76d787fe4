"""What a start takes: help and imports alone, and from the start of the process to the first fix, part by part.

``python -m bench.live.startup FOLDER METHOD STARTED_S`` is the measured process; it prints one JSON object.
``python -m bench.live.startup --entry ARGUMENTS`` measures a start of Python with these arguments.
"""

from __future__ import annotations

import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

Row = dict[str, Any]
PARTS = ("Python", "import engine", "open map and flight", "warm-up", "first frame")
ENTRIES = {
    "scenematch --help": ("-m", "scenematch", "--help"),
    "scenematch track --help": ("-m", "scenematch", "track", "--help"),
    "import engine": ("-c", "import engine"),
    "from engine import Camera, Frame, OrthoMap": ("-c", "from engine import Camera, Frame, OrthoMap"),
    "from engine import SceneMatcher": ("-c", "from engine import SceneMatcher"),
}
"""What is waited for before anything is asked of the engine: arguments of Python."""


def entries(rounds: int = 5) -> list[Row]:
    """Medians of the seconds that each takes, of those on a core, and of the most memory that was resident.

    The first start of each is left out: it compiles Python's bytecode, which an installation brings along.
    """
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    rows = []
    for what, arguments in ENTRIES.items():
        starts = [_started(environment, "--entry", *arguments) for _ in range(rounds + 1)][1:]
        seconds, core_s, resident_mb = (statistics.median(values) for values in zip(*starts, strict=True))
        rows.append({"what": what, "seconds": seconds, "core_s": core_s, "resident_mb": resident_mb})
    return rows


def _started(environment: dict[str, str], *arguments: str) -> Any:
    """What this module prints as a process with these arguments."""
    command = [sys.executable, "-m", "bench.live.startup", *arguments]
    ended = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    return json.loads(ended.stdout)


def _measured_entry(arguments: list[str]) -> list[float]:
    """Seconds, seconds on a core and megabytes of one start of Python.

    A small process starts it: the peak that the system counts for a child begins with that of its parent.
    """
    begin = time.perf_counter()
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begin
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, arguments)
    return [seconds, used.ru_utime + used.ru_stime, used.ru_maxrss * 1.024e-3]


def startup(methods: tuple[str, ...] = ("ncc", "sift", "auto"), rounds: int = 1) -> list[Row]:
    """Every method with everything kept from an earlier start, and the last one with less."""
    from scenematch.runs.simulation import write_flight
    from scenematch.simulator import plan_flight

    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        write_flight(root / "flight", plan_flight(1, frames=2))
        # The order matters: a start keeps what it made for the next.
        caches, uncompiled = root / "caches", root / "uncompiled"
        last = methods[-1]
        rows = [
            _row(root, last, "nothing kept", caches, caches, 1),
            _row(root, last, "map kept, nothing compiled", caches, uncompiled, 1),
        ]
        rows += [_row(root, method, "all kept", caches, caches, rounds) for method in methods]
    return rows


def _row(root: Path, method: str, kept: str, maps: Path, compiled: Path, rounds: int) -> Row:
    """Medians of some starts, in seconds."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(maps / "maps"), "NUMBA_CACHE_DIR": str(compiled / "numba")}
    count, flight = rounds + (kept == "all kept"), str(root / "flight")
    starts = [_started(environment, flight, method, repr(time.time())) for _ in range(count)]
    starts = starts[-rounds:]  # the first of those with everything kept may still have had something to keep
    medians = {part: statistics.median(start[part] for start in starts) for part in PARTS}
    return {
        "method": method,
        "kept": kept,
        "parts_s": medians,
        "total_s": sum(medians.values()),
        "core_s": statistics.median(start["core_s"] for start in starts),
        "resident_mb": statistics.median(start["resident_mb"] for start in starts),
        "fixed": all(start["fixed"] for start in starts),
    }


def measured() -> Row:
    """This process, part by part."""
    marks = [float(sys.argv[3]), time.time()]
    from engine import Camera, Fix, OrthoMap, SceneMatcher
    from engine.runtime.threads import set_threads
    from scenematch.files.flight import open_flight

    set_threads(1)
    marks.append(time.time())
    folder = Path(sys.argv[1])
    camera = Camera.load(folder / "camera.yaml")
    site = OrthoMap.open(folder / "map.tif", surface=folder / "dsm.tif")
    first = next(iter(open_flight(folder / "frames", folder / "telemetry.csv", camera)))
    marks.append(time.time())
    matcher = SceneMatcher(site, camera, sys.argv[2], "cpu")
    matcher.warmup()
    marks.append(time.time())
    result = matcher.locate(first.frame, first.prior)
    marks.append(time.time())
    spent = [end - begin for begin, end in itertools.pairwise(marks)]
    from bench.live.growth import resident_mb

    used = os.times()
    return {
        **dict(zip(PARTS, spent, strict=True)),
        "fixed": isinstance(result, Fix),
        "core_s": used.user + used.system,  # which other work on the machine hardly changes
        "resident_mb": resident_mb(field="VmHWM"),
    }


if __name__ == "__main__":
    print(json.dumps(_measured_entry(sys.argv[2:]) if sys.argv[1] == "--entry" else measured()))
