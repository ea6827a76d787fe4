"""Programs in an interpreter of their own."""

import subprocess
import sys
from typing import Any

from tests.support.paths import ROOT


def done_by(program: str, *words: str, **stated: Any) -> subprocess.CompletedProcess[str]:
    """What a program printed, told these words; it runs in the root of the repository and has to end well."""
    command = [sys.executable, "-c", program, *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT, **stated)
