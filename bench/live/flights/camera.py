"""The camera of a flight: ``python -m bench.live.flights.camera FRAMES BEGIN_FILE FAULT_FILE RATE_HZ``,
for ``exec:``.

It writes a folder's JPEG pictures at their times after the start given in BEGIN_FILE, on the monotonic clock;
until that file exists, it repeats the first one. While FAULT_FILE names such a fault, it is covered or frozen.
"""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from bench.live.flights.faults import reigning


def film(frames: list[bytes], begin_file: Path, fault_file: Path, rate_hz: float, out: BinaryIO) -> None:
    """Write pictures until nobody reads them or the last one has been written."""
    size = cv2.imdecode(np.frombuffer(frames[0], np.uint8), cv2.IMREAD_COLOR).shape
    black = cv2.imencode(".jpg", np.zeros(size, np.uint8))[1].tobytes()
    number, last = 0, frames[0]
    while number < len(frames):
        begin_ns = int(begin_file.read_text(encoding="ascii")) if begin_file.exists() else time.monotonic_ns()
        gone_s = (time.monotonic_ns() - begin_ns) * 1e-9
        number = int(gone_s * rate_hz) + 1
        time.sleep(max(0.0, number / rate_hz - gone_s))
        last = shown_picture(frames[min(number, len(frames) - 1)], black, last, reigning(fault_file))
        out.write(last)
        out.flush()


def shown_picture(seen: bytes, black: bytes, last: bytes, fault: str) -> bytes:
    """What a camera that sees a picture shows, the last one having been shown before."""
    return {"camera covered": black, "picture frozen": last}.get(fault, seen)


def main() -> None:
    """Write pictures until the pipe is closed."""
    folder, begin_file, fault_file, rate_hz = sys.argv[1:]
    frames = [path.read_bytes() for path in sorted(Path(folder).glob("*.jpg"))]
    with contextlib.suppress(BrokenPipeError):
        film(frames, Path(begin_file), Path(fault_file), float(rate_hz), sys.stdout.buffer)


if __name__ == "__main__":
    main()
