"""The latency budget: whether an answer comes on time, every time, what it is worth, and what it costs to start.

    python -m bench.live.latency [SECTION] [--quick] [--docs DIR]

A section is budgets, hogs, embedded, slow, queue, soak, tradeoff, startup, entries or all.

Figures go to .benchmarks/latency.json, section by section; ``all`` writes docs/results/latency.md as well.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from bench import RESULTS, ROOT
from bench.command import parser_on_one_thread
from bench.live.burden import PERIOD_S, hogs, throttle
from bench.live.embedded import embedded
from bench.live.endless import Course, draw, fly, summary, warm
from bench.live.soak import Soaked, queue, soak
from bench.live.startup import entries, startup
from bench.live.tradeoff import tradeoff
from bench.pages import latency
from engine.runtime.threads import set_threads

JSON = ROOT / ".benchmarks" / "latency.json"
BUDGETS_MS = (5.0, 10.0, 40.0, 121.0)
SHARES = (0.25, 0.1)
HEADLESS_EVERY = 4
Row = dict[str, Any]


def budgets(course: Course, auto_frames: int = 10_000, other_frames: int = 300) -> dict[str, Any]:
    """The endless flight at every budget, alone on the machine; and what grew over the frames of auto."""
    matcher = warm(course, "auto")
    growth = Soaked(matcher, auto_frames * len(BUDGETS_MS))
    rows = [
        summary(fly(course, matcher, auto_frames, budget_ms, growth.sample), "auto") for budget_ms in BUDGETS_MS
    ]
    grown = {**rows[-1], **growth.row()}
    headless = replace(course, headless_every=HEADLESS_EVERY)
    for who, method, flown in (
        (f"auto, heading missing in every {HEADLESS_EVERY}th frame", "auto", headless),
        ("ncc", "ncc", course),
        ("sift", "sift", course),
    ):
        matcher = warm(flown, method)
        rows += [summary(fly(flown, matcher, other_frames, budget_ms), who) for budget_ms in BUDGETS_MS]
    return {"rows": rows, "growth": grown}


def beside_hogs(course: Course, frames: int = 400) -> list[Row]:
    """The same by auto while one and two other processes burn a core each."""
    matcher, rows = warm(course, "auto"), []
    for count in (1, 2):
        with hogs(count):
            flights = [fly(course, matcher, frames, budget_ms) for budget_ms in BUDGETS_MS]
        rows += [summary(flown, f"auto beside {count} busy process{'es'[: 2 * count - 2]}") for flown in flights]
    return rows


def slow(course: Course, frames: int = 100) -> list[Row]:
    """The same in a process that becomes slow after its warm-up: it may run a share of every 20 ms only."""
    here, there = multiprocessing.Pipe()
    context, rows = multiprocessing.get_context("spawn"), []
    worker = context.Process(target=_fly_what_is_asked, args=(there, min(len(course.frames), frames)), daemon=True)
    worker.start()
    there.close()
    assert worker.pid is not None
    for share in SHARES:
        for budget_ms in BUDGETS_MS:
            here.send((budget_ms, frames, share))
            here.recv()  # warm
            throttle(worker.pid, share, here.poll)
            rows.append(here.recv())
    here.send(None)
    worker.join()
    return rows


def _fly_what_is_asked(asked: Connection, drawn: int) -> None:
    """The process that is slowed: takes (budget, frames, share), says when it is warm, and answers with a row."""
    set_threads(1)
    course = draw(drawn)
    while (order := asked.recv()) is not None:
        budget_ms, frames, share = order
        matcher = warm(course, "auto")
        asked.send("warm")
        busy, start = time.process_time(), time.perf_counter()
        flown = fly(course, matcher, frames, budget_ms)
        got = (time.process_time() - busy) / (time.perf_counter() - start)
        stop_ms = (1.0 - share) * PERIOD_S * 1e3
        asked.send(summary(flown, "auto, slowed", stop_ms, share=share, share_got=got))


SECTIONS: dict[str, Callable[..., Any]] = {
    "budgets": budgets,
    "hogs": beside_hogs,
    "embedded": lambda _, **sizes: embedded(**sizes),
    "slow": slow,
    "queue": queue,
    "soak": soak,
    "tradeoff": tradeoff,
    "startup": lambda _, **sizes: startup(**sizes),
    "entries": lambda _, **sizes: entries(**sizes),
}
QUICK: dict[str, dict[str, Any]] = {
    "budgets": {"auto_frames": 60, "other_frames": 20},
    "hogs": {"frames": 40},
    "embedded": {"frames": 20},
    "slow": {"frames": 10},
    "queue": {"seconds": 0.3},
    "soak": {"frames": 120},
    "tradeoff": {"frames": 20, "table_frames": 40, "paper_frames": 5},
    "startup": {"methods": ("ncc",), "rounds": 1},
    "entries": {"rounds": 1},
}
QUICK_DRAWN = 24


def main() -> None:
    """Measure what is asked for, keep the figures, and write the page of a whole run."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("section", nargs="?", default="all", choices=[*SECTIONS, "all"])
    parser.add_argument("--quick", action="store_true", help="a few frames of everything: does it run?")
    parser.add_argument("--docs", type=Path, help="folder of the page; docs/results, and .benchmarks if quick")
    options = parser.parse_args()
    course = draw(QUICK_DRAWN if options.quick else None)
    kept = JSON.with_stem("latency-quick") if options.quick else JSON
    whole = options.section == "all"
    results = json.loads(kept.read_text()) if kept.exists() and not whole else {}
    for name in SECTIONS if whole else [options.section]:
        start = time.perf_counter()
        results[name] = SECTIONS[name](course, **(QUICK[name] if options.quick else {}))
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
        kept.parent.mkdir(exist_ok=True)
        kept.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    if whole:
        latency.write(options.docs or (kept.parent if options.quick else RESULTS), results)


if __name__ == "__main__":
    main()
