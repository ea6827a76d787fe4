"""How often is a wrong place accepted? Matches with an answer and without, by every method and score.

    python -m bench.accuracy.integrity [--matches N] [--resume] [--docs DIR]

Each match is of one frame, with a prior that is as far off as it says. What was matched is kept in
``.benchmarks/integrity`` as it goes; ``--resume`` goes on from there. The page is written of what there is.
"""

from __future__ import annotations

import json
import shutil
import zlib
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from bench import ROOT, SHARED
from bench.accuracy.judged import METHODS, Bench, Row
from bench.accuracy.trials import ground
from bench.command import parser_on_one_thread
from bench.pages import integrity
from engine.runtime.threads import set_threads

TOWNS = (95, 96, 97, 98)  # on which nothing was fitted
DRAW = 17  # of the frames and of what is done to them: raised when a rule was changed, for none is fitted to these
SHARES: dict[int | str, float] = {
    **dict.fromkeys(TOWNS, 0.16),
    **dict.fromkeys(("gazebo-a1", "gazebo-a2", "gazebo-a1-evening"), 0.07),
    **dict.fromkeys(("farmland 2012 on 2016", "farmland 2018 on 2020"), 0.045),
    "nust": 0.05,
    "caliterra": 0.01,  # whose large frames take long
}
PARTS = ROOT / ".benchmarks" / "integrity"
PART = 260  # matches; every kind comes round ten times
PROCESSES = 2

Job = tuple[int | str, int | str, tuple[int, ...]]


def jobs(matches: int) -> list[Job]:
    """Grounds with another one as the wrong map, and numbers of parts; the long ones first."""
    there = {name: share for name, share in SHARES.items() if isinstance(name, int) or _has(name)}
    names, total = list(there), sum(there.values())
    out: list[Job] = []
    for index, name in enumerate(names):
        count = max(1, round(matches * there[name] / total / PART))
        other = next(n for n in names[index:] + names if _place(n) != _place(name))
        out += [(name, other, tuple(range(k, count, PROCESSES))) for k in range(min(PROCESSES, count))]
    return sorted(out, key=lambda job: -len(job[2]))


def _place(name: int | str) -> str:
    """What a ground shows: flights and years of one place are no other map to each other."""
    return str(name).split()[0].split("-")[0]


def _has(name: str) -> bool:
    return (SHARED / ("naip" if name.startswith("farmland") else name)).is_dir()


def run(job: Job) -> None:
    """Match the parts of one ground that are not there yet."""
    name, other, numbers = job
    missing = [number for number in numbers if not _path(name, number).exists()]
    if not missing:
        return
    set_threads(1)
    bench = Bench(ground(name), ground(other, map_only=True))
    for number in missing:
        rng = np.random.default_rng([DRAW, zlib.crc32(str(name).encode()), number])
        trials = bench.trials(range(number * PART, (number + 1) * PART), rng)
        methods = rng.choice(list(METHODS), PART, p=list(METHODS.values()))
        rows = [bench.judged(made, str(method)) for made, method in zip(trials, methods, strict=True)]
        unfinished = _path(name, number).with_suffix(".unfinished")
        unfinished.write_text(json.dumps(rows), encoding="utf-8")
        unfinished.rename(_path(name, number))


def _path(name: int | str, number: int) -> Path:
    return PARTS / f"{str(name).replace(' ', '-')}.{number}.json"


def gathered() -> list[Row]:
    """All matches that are there."""
    return [Row(*row) for path in sorted(PARTS.glob("*.json")) for row in json.loads(path.read_text("utf-8"))]


def main() -> None:
    """Match, and write the page."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--matches", type=int, default=100_000)
    parser.add_argument("--resume", action="store_true", help="keep what an earlier run matched")
    options = parser.parse_args()
    if not options.resume:
        shutil.rmtree(PARTS, ignore_errors=True)
    PARTS.mkdir(parents=True, exist_ok=True)
    work = jobs(options.matches)
    with ProcessPoolExecutor(PROCESSES) as pool:
        for done, _ in enumerate(pool.map(run, work), 1):
            print(f"{done} of {len(work)} done, {PART * len(list(PARTS.glob('*.json'))):,} matches", flush=True)
    integrity.write(gathered(), options.docs)


if __name__ == "__main__":
    main()
