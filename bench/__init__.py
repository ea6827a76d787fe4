"""Benchmarks: a speed is a ratio against a named peer, in one run, on one input, beside its accuracy."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
RESULTS = DOCS / "results"  # measured tables, one page a benchmark
SHARED = ROOT.parent / "shared" / "data"
