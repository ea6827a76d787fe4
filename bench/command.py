"""The command lines of the benchmarks."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bench import RESULTS
from engine.runtime.threads import set_threads


def parser_on_one_thread(description: str | None, *, docs: bool = False) -> argparse.ArgumentParser:
    """What reads the options of a benchmark, whose process has one thread from here on.

    Args:
        description: the docstring of its module.
        docs: whether it writes a page, whose folder is an option.
    """
    set_threads(1)
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    if docs:
        parser.add_argument("--docs", type=Path, default=RESULTS, help="folder of the page")
    return parser


@contextmanager
def new_folder(path: Path) -> Iterator[None]:
    """A folder that did not exist, filled meanwhile; an error takes it away again.

    Raises:
        SystemExit: it exists.
    """
    if path.exists():
        raise SystemExit(f"out: expected a folder that does not exist, got {path}")
    path.mkdir(parents=True)
    try:
        yield
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise
