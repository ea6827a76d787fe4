"""The command line: parse, call, print. Every known error is one line and an exit code, never a traceback."""

from __future__ import annotations

import os
import sys

__all__ = ["main"]


def main() -> None:
    """Entry point of ``scenematch``: exit 0 done, 1 a run that could not be finished, 2 wrong usage."""
    # Decoders inside OpenCV write to standard error themselves; our own line reports the error.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from scenematch.cli.app import run

    sys.exit(run(sys.argv[1:]))
