"""The closed loop, measured: five minutes by the engine's fixes alone, and every fault.

``python -m bench.accuracy.closed_loop [--seeds 31 32] [--out DIR]``: the table of docs/results/simulator.md.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from bench.command import parser_on_one_thread
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
HEAD = (
    "seed", "frames of", "method", "fault", "flown s", "true track RMS m", "largest m", "estimate RMS m",
    "fixes", "used", "false", "unhealthy s", "held s", "handed over",
)  # fmt: skip


def main() -> None:
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[31, 32])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--out", type=Path, help="keeps every flight's folder here")
    parser.add_argument("--flights", type=int, nargs="+", default=list(range(len(FLIGHTS))), help="which of them")
    arguments = parser.parse_args()
    print("|", " | ".join(HEAD), "|")
    print("|---" * len(HEAD) + "|")
    for seed in arguments.seeds:
        for number in arguments.flights:
            with tempfile.TemporaryDirectory() as scratch:
                folder = (arguments.out or Path(scratch)) / f"{seed}-{'-'.join(FLIGHTS[number])}"
                print("|", " | ".join(row(folder, seed, arguments.minutes, *FLIGHTS[number])), "|", flush=True)


def row(folder: Path, seed: int, minutes: float, condition: str, method: str, fault: str) -> list[str]:
    world = WorldSettings(seed=seed, condition=condition)
    loop = ClosedLoopSettings(minutes=minutes, method=method, fault=fault)
    figures = fly_closed_loop(folder, world, loop, force=True)
    return [
        str(seed),
        condition,
        method,
        fault,
        f"{figures['seconds']:.0f}",
        f"{figures['plan_rms_m']:.2f}",
        f"{figures['plan_max_m']:.2f}",
        f"{figures['estimate_rms_m']:.2f}",
        f"{figures['fixes']} of {figures['frames']}",
        str(figures["used"]),
        str(figures["false_fixes"]),
        f"{figures['unhealthy_s']:.1f}",
        f"{figures['hold_s']:.1f}",
        "yes" if figures["handed_over"] else "no",
    ]


if __name__ == "__main__":
    main()
