"""The closed loop, measured: five minutes by the engine's fixes alone, and every fault.

``python -m bench.accuracy.closed_loop [--seeds 31 32] [--out DIR]``: the table of docs/results/simulator.md.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from bench.command import parser_on_one_thread
from bench.pages.text import table_of
from scenematch import ClosedLoopSettings, WorldSettings, fly_closed_loop

FLIGHTS = (
    ("noon", "ncc", "none"),
    ("noon", "sift", "none"),
    ("noon", "auto", "none"),
    ("evening", "ncc", "none"),
    ("noon", "ncc", "killed"),
    ("noon", "ncc", "frozen"),
    ("noon", "ncc", "shifted"),
)
"""Condition of the frames over a map of noon, method, and fault."""
COLUMNS = (
    ("seed", "seed", "d"), ("frames of", "condition", "s"), ("method", "method", "s"), ("fault", "fault", "s"),
    ("flown s", "seconds", ".0f"), ("true track RMS m", "plan_rms_m", ".2f"), ("largest m", "plan_max_m", ".2f"),
    ("estimate RMS m", "estimate_rms_m", ".2f"), ("fixes", "found", "s"), ("used", "used", "d"),
    ("false", "false_fixes", "d"), ("unhealthy s", "unhealthy_s", ".1f"), ("held s", "hold_s", ".1f"),
    ("handed over", "handed_over", lambda is_done: "yes" if is_done else "no"),
)  # fmt: skip


def main() -> None:
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[31, 32])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--out", type=Path, help="keeps every flight's folder here")
    parser.add_argument("--flights", type=int, nargs="+", default=list(range(len(FLIGHTS))), help="which of them")
    arguments = parser.parse_args()
    print("\n".join(table_of([], *COLUMNS)[:2]))
    for seed in arguments.seeds:
        for number in arguments.flights:
            with tempfile.TemporaryDirectory() as scratch:
                folder = (arguments.out or Path(scratch)) / f"{seed}-{'-'.join(FLIGHTS[number])}"
                flown = row(folder, seed, arguments.minutes, *FLIGHTS[number])
                print(table_of([flown], *COLUMNS)[2], flush=True)


def row(folder: Path, seed: int, minutes: float, condition: str, method: str, fault: str) -> dict[str, Any]:
    """The figures of one flight."""
    world = WorldSettings(seed=seed, condition=condition)
    loop = ClosedLoopSettings(minutes=minutes, method=method, fault=fault)
    figures = fly_closed_loop(folder, world, loop, force=True)
    asked = {"seed": seed, "condition": condition, "method": method, "fault": fault}
    return {**figures, **asked, "found": f"{figures['fixes']} of {figures['frames']}"}


if __name__ == "__main__":
    main()
