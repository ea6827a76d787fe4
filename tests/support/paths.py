"""Where the checkout and the shared flights lie."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared" / "data"
NO_SHARED = f"the shared flights are not there: {SHARED}"
