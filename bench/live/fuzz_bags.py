"""Fuzz of the bag reader: small bags of the three formats, damaged at random: each a flight or one clear line."""

from __future__ import annotations

import logging
import multiprocessing
import queue
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

LIMIT_S = 2.0  # of processor time
PATIENCE_S = 30.0  # of the clock: other work may share the processor


def damaged(source: Path, target: Path, rng: np.random.Generator) -> None:
    """Copy a bag and damage one of its files: flipped, lost, doubled or overwritten bytes, or a lost end."""
    if source.is_dir():
        shutil.copytree(source, target)
        files = sorted(target.iterdir())
        file = files[rng.integers(len(files))]
    else:
        shutil.copy(source, target)
        file = target
    data = bytearray(file.read_bytes())
    for _ in range(rng.geometric(0.6)):
        at, length = int(rng.integers(len(data) or 1)), int(rng.integers(1, 64))
        piece = rng.bytes(length)
        choice = rng.integers(6)
        if choice == 0:
            data[at : at + 1] = bytes([data[at] ^ (1 << int(rng.integers(8)))]) if data else b""
        elif choice == 1:
            data[at : at + length] = piece[: len(data) - at]
        elif choice == 2:
            data[at:at] = piece
        elif choice == 3:
            del data[at : at + length]
        elif choice == 4:
            data[at : at + 4] = rng.choice([b"\xff" * 4, b"\x00" * 4, b"\xff\xff\xff\x7f"])
        elif rng.random() < 0.3:
            del data[at:]
    file.write_bytes(data)


def small_bag(path: Path, kind: str) -> None:
    from bench.inputs.bags import write_bag
    from engine.camera import Camera
    from engine.values import Frame, Prior

    rng = np.random.default_rng(1)
    frames = [
        Frame(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8), 10**9 + k * 10**8, 100.0, 10.0, 1.0, 2.0, 3.0, 4.0)
        for k in range(3)
    ]
    start = Prior(lat_deg=48.0, lon_deg=15.0, sigma_m=10.0)
    write_bag(path, ((f, start) for f in frames), Camera.from_fov(8, 6, 60.0), kind=kind)


def read_all(path: Path) -> str:
    """What became of a bag: "flight", or "refused"; anything that is not one clear line is raised."""
    from engine.errors import EngineError
    from scenematch.files.flight import open_flight
    from scenematch.files.ros.bags import read_bag_camera

    said = ""
    try:
        for item in open_flight(path):
            assert item.frame.image.dtype == np.uint8
        read_bag_camera(path)
    except EngineError as error:
        said = str(error)
    assert "\n" not in said, "more than a line"
    return "refused" if said else "flight"


def _worker(tasks: multiprocessing.Queue, answers: multiprocessing.Queue) -> None:
    logging.disable()
    while True:
        path = tasks.get()
        begin = time.process_time()
        try:
            outcome = read_all(path)
        except BaseException as error:
            outcome = f"CRASH {type(error).__name__}: {str(error)[:100]}"
        answers.put((outcome, time.process_time() - begin))


def fuzz(count: int, seed: int) -> tuple[Counter[str], float, list[float]]:
    """So many damaged bags, read in a process that is ended where it hangs; outcomes, and processor times."""
    from bench.inputs.bags import BAG_KINDS

    context = multiprocessing.get_context("spawn")
    rng, outcomes, times = np.random.default_rng(seed), Counter[str](), []
    begin = time.perf_counter()

    def start():
        tasks, answers = context.Queue(), context.Queue()
        worker = context.Process(target=_worker, args=(tasks, answers), daemon=True)
        worker.start()
        return tasks, answers, worker

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sources = {kind: folder / ("source.bag" if kind == "ros1" else kind) for kind in BAG_KINDS}
        for kind, source in sources.items():
            small_bag(source, kind)
        tasks, answers, worker = start()
        tasks.put(sources["ros1"])
        assert answers.get(timeout=60)[0] == "flight"  # imports are not the bags' fault
        for k in range(count):
            kind = BAG_KINDS[k % len(BAG_KINDS)]
            target = folder / ("damaged.bag" if kind == "ros1" else "damaged")
            damaged(sources[kind], target, rng)
            tasks.put(target)
            try:
                outcome, spent_s = answers.get(timeout=PATIENCE_S)
                outcome = "HANG" if spent_s > LIMIT_S else outcome
            except queue.Empty:
                outcome, spent_s = ("HANG" if worker.is_alive() else "CRASH died"), PATIENCE_S
                worker.kill()
                tasks, answers, worker = start()
                tasks.put(sources["ros1"])
                answers.get(timeout=60)
            times.append(spent_s)
            outcomes[f"{kind} {outcome}"] += 1
            shutil.rmtree(target) if target.is_dir() else target.unlink()
        worker.kill()
    return outcomes, time.perf_counter() - begin, times


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    counts, seconds, spent = fuzz(number, seed=int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    for name in sorted(counts):
        print(f"{counts[name]:6d}  {name}")
    print(f"{sum(counts.values())} bags in {seconds:.0f} s, the longest {max(spent):.2f} s of processor time")
